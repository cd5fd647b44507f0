"""
What other programs call a PSF, made of grids of mixtures and made into them.

The constructors that must fit call the room `fitting`, which stands above
this one, when they are called.
"""
from collections.abc import Mapping
from functools import partial

import numpy as np
from photutils.psf import GriddedPSFModel

from photutils_mgauss.files.damage import UnusableFileError
from photutils_mgauss.files.storage import read_stored
from photutils_mgauss.utils.parallel import told
from photutils_mgauss.utils.waiting import waiting

# The kinds of files of which a user may choose an extension or a detector.
_WITH_EXTENSIONS = ('psfex', 'stpsf', 'optical', 'epsf')
_WITH_DETECTORS = ('stdpsf',)


class GridConversions:
    """The constructors and conversions of `GriddedMixturePSF`."""

    @classmethod
    @waiting('GriddedMixturePSF.from_file')
    def from_file(cls, path, n_components=None, *, ext=None, detector=None,
                  oversampling=None, grid_shape=(30, 30), **kwargs):
        """
        Make a grid of the PSF in a file of any kind.

        Parameters
        ----------
        path : str or path-like
            A file of this package (a grid, a field or a mixture), a PSFEx
            model, a grid of ePSFs as STDPSF or STPSF write it, what
            ``calc_psf`` of STPSF writes, or images of one ePSF each. It may
            be compressed (``.fits.gz``, ``.psf.gz``).
        n_components : int, optional
            The number K of Gaussians, where mixtures are to be fitted; see
            `from_gridded_psf`.
        ext : int, str or (str, int) tuple, optional
            The extension with the PSF, by number, name, or name and version,
            of PSFEx models and images of which the file holds several;
            ``'all'`` for a dict of all. Of a ``calc_psf`` file it is
            OVERDIST by default, or else OVERSAMP.
        detector : int or str, optional
            The chip of an STDPSF file that covers several, numbered as in
            `~photutils.psf.GriddedPSFModel`; ``'all'`` for a dict of all.
        oversampling : int, optional
            Samples per pixel of images whose header has no OVERSAMP.
        grid_shape : int or (ny, nx) tuple of int, optional
            The number of nodes along y and x, for PSFs that are functions
            of the position: PSFEx models and fields.
        **kwargs
            As for `from_gridded_psf`, where mixtures are to be fitted.

        Returns
        -------
        GriddedMixturePSF or dict of them
            It contains the pixel; optical images are integrated over it.

        Raises
        ------
        OSError
            If the file cannot be opened.
        ValueError
            If the file is damaged, holds no PSF, or several and neither
            ``ext`` nor ``detector`` says which to read.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from astropy.io import fits
        >>> from photutils_mgauss import GriddedMixturePSF
        >>> y, x = np.mgrid[-20:21, -20:21] / 4
        >>> chips = [fits.ImageHDU(np.exp(-(x**2 + y**2) / 2 / width**2),
        ...                        name=f'CHIP{width}') for width in (1, 2)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / 'epsfs.fits'
        ...     fits.HDUList([fits.PrimaryHDU(), *chips]).writeto(path)
        ...     psfs = GriddedMixturePSF.from_file(
        ...         path, 1, ext='all', oversampling=4)
        >>> {name: float(round(psf.mixtures[0].moments().covariance[0, 0], 3))
        ...  for name, psf in psfs.items()}
        {'CHIP1': 1.0, 'CHIP2': 4.0}
        """
        from photutils_mgauss.files import epsfs
        kind = epsfs.psf_kind(path)
        if kind == 'image' and oversampling is not None:
            kind = 'epsf'
        _check_choices(path, kind, ext=ext, detector=detector)
        if kind == 'mixtures':
            return _of_stored(cls, path, grid_shape)
        if kind == 'psfex':
            return cls.from_psfex(path, n_components, ext=ext,
                                  grid_shape=grid_shape, **kwargs)
        if kind in ('optical', 'epsf'):
            images = epsfs.read_image_psf(path, ext=ext,
                                          oversampling=oversampling)
            return _of_each(images, partial(
                cls.from_image_psf, n_components=n_components, **kwargs))
        grid = (epsfs.read_stdpsf(path, detector) if kind == 'stdpsf'
                else epsfs.read_stpsf(path, ext))
        return cls.from_gridded_psf(grid, n_components, **kwargs)

    @classmethod
    def from_gridded_psf(cls, psf, n_components=None, *, radius=None,
                         executor=None, progress_bar=False, checkpoint=None,
                         **kwargs):
        """
        Fit mixtures to the ePSFs of a photutils grid.

        Parameters
        ----------
        psf : `~photutils.psf.GriddedPSFModel` or `~photutils.psf.STDPSFGrid`
            The grid of ePSFs, or a dict of them: one for each detector.
            Where two chips meet an STDPSF grid has two nodes at one place;
            the one of the upper or right chip is put one pixel further. A
            `~photutils.psf.GriddedPSFModel` does not tell which of the two
            is whose, and is refused.
        n_components : int, optional
            The number K of Gaussians. By default 3; where these would make
            fluxes change by more than 0.3 % rms with the place of a star in
            its pixel, as for undersampled cameras, 5 or 8, fitted with the
            weighting ``'photometric'`` of `fit_mixture` where the
            oversampling allows it. A warning tells where even that is not
            enough.
        radius : float, optional
            Only ePSF pixels within this distance of the star are fitted
            [native pix]. By default the largest circle that keeps two
            oversampled pixels away from the edge of the stamp. Rows and
            columns of fill values at the edge are never fitted.
        executor : `~concurrent.futures.Executor`, optional
            Where the nodes are fitted; by default in a pool of threads.
        progress_bar : bool, optional
            Whether to show a progress bar.
        checkpoint : str or path-like, optional
            A folder in which finished fits are kept. A call with the same
            images and settings takes them from there, whatever ended the
            first one. Many detectors can share a folder.
        **kwargs
            Further keywords of `fit_mixture`, except that ``start`` is
            ``'centre'`` (the default: from the fit of the middle node) or
            ``'own'`` (every node looks for its own); and ``interpolation``
            and ``outside`` of `GriddedMixturePSF`.

        Returns
        -------
        GriddedMixturePSF or dict of them
            In the flux convention of ``psf``. It contains the pixel, as
            ePSFs do. Nodes whose ePSF is blank, or cannot be fitted, are
            bridged from their neighbours; `report` tells which.

        Raises
        ------
        ValueError
            If two nodes are at one place, the nodes form no rectangular
            grid, or no node can be fitted.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture, GriddedMixturePSF
        >>> mixture = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 1]]])
        >>> epsf = GriddedMixturePSF([mixture], [(0, 0)]).to_gridded_psf()
        >>> psf = GriddedMixturePSF.from_gridded_psf(epsf, n_components=1)
        >>> psf.mixtures[0].covariances
        array([[[2., 0.],
                [0., 1.]]])
        """
        from photutils_mgauss.fitting import grid
        return _of_each(psf, cls._fitted_by(
            grid.fit_gridded_psf, n_components=n_components, radius=radius,
            executor=executor, progress_bar=progress_bar,
            checkpoint=checkpoint, **kwargs))

    @classmethod
    def from_psfex(cls, path, n_components=None, *, ext=None,
                   grid_shape=(30, 30), limits=None, contexts=None, **kwargs):
        """
        Fit mixtures to a PSFEx model, evaluated on a grid.

        Parameters
        ----------
        path : str, path-like, `PSFExModel` or a dict of these
            The ``.psf`` file, or one for each detector.
        n_components : int, optional
            The number K of Gaussians; see `from_gridded_psf`.
        ext : int, str or (str, int) tuple, optional
            Which model of a file with several, as in `read_psfex`; ``'all'``
            for a dict of all.
        grid_shape : int or (ny, nx) tuple of int, optional
            The number of nodes along y and x. There is one along an axis
            that the model does not depend on.
        limits : ((x_min, x_max), (y_min, y_max)), optional
            Where the outermost nodes are [pix]. By default those of the
            stars PSFEx used.
        contexts : dict, optional
            The values of all contexts that are not positions.
        **kwargs
            As for `from_gridded_psf`.

        Returns
        -------
        GriddedMixturePSF or dict of them
            A star of flux 1 has the flux 1 on the detector; PSFEx does not
            normalise its images. It contains the pixel, as they do.

        Raises
        ------
        ValueError
            If the file is not a PSFEx model, or holds several and ``ext``
            does not say which to read, see `read_psfex`.
        """
        from photutils_mgauss.files.psfex import read_psfex
        from photutils_mgauss.fitting import grid
        if ext is not None:
            path = _of_each(path, partial(read_psfex, ext=ext))
        return _of_each(path, cls._fitted_by(
            grid.fit_psfex, n_components=n_components, grid_shape=grid_shape,
            limits=limits, contexts=contexts, **kwargs))

    @classmethod
    def from_image_psf(cls, psf, n_components=None, *, grid_xypos=None,
                       **kwargs):
        """
        Fit mixtures to one or several ePSF images.

        Parameters
        ----------
        psf : `~photutils.psf.ImagePSF`, result of \
`~photutils.psf.EPSFBuilder`, or sequence of these
            One for the whole detector, or one for each of ``grid_xypos``,
            of equal shapes, origins and oversampling.
        n_components : int, optional
            The number K of Gaussians; see `from_gridded_psf`.
        grid_xypos : (N, 2) array_like, optional
            The positions (x, y) of several ePSFs [pix]. Nodes that are
            missing from a rectangular grid are bridged.
        **kwargs
            As for `from_gridded_psf`.

        Returns
        -------
        GriddedMixturePSF
            In the flux convention of ``psf``, with its origin.

        Raises
        ------
        TypeError
            If ``psf`` is not made of `~photutils.psf.ImagePSF` models.
        ValueError
            If the ePSFs differ in shape, origin or oversampling, or there is
            not one for each position.
        """
        from photutils_mgauss.fitting import grid
        return cls._fitted_by(
            grid.fit_image_psf, n_components=n_components,
            grid_xypos=grid_xypos, **kwargs)(psf)

    @classmethod
    def _fitted_by(cls, fit, *, interpolation='blend', outside='clamp',
                   **kwargs):
        """Return a function that makes a grid of what another one fits."""
        def make(psf):
            return cls._of_grid(*fit(psf, **kwargs), outside=outside,
                                interpolation=interpolation)
        return make

    @classmethod
    def from_field(cls, field, *, grid_shape=(30, 30)):
        """
        Sample a mixture field on a grid.

        Parameters
        ----------
        field : MixtureField or a dict of them
            The PSF as a function of position, or one for each detector.
        grid_shape : int or (ny, nx) tuple of int, optional
            The number of nodes along y and x.

        Returns
        -------
        GriddedMixturePSF or dict of them

        Raises
        ------
        TypeError
            If the field is not a `MixtureField`.
        """
        if isinstance(field, Mapping):
            return {name: cls.from_field(one, grid_shape=grid_shape)
                    for name, one in field.items()}
        if not hasattr(field, 'to_grid'):
            msg = f'field must be a MixtureField, got {field!r:.80}'
            raise TypeError(msg)
        return field.to_grid(grid_shape)

    def to_gridded_psf(self, oversampling=4, *, radius=None):
        """
        Return the grid as ePSF images, in photutils' own class.

        Parameters
        ----------
        oversampling : int, optional
            ePSF pixels per detector pixel.
        radius : float, optional
            Half the width of the stamps [pix]; by default that of the
            bounding box.

        Returns
        -------
        `~photutils.psf.GriddedPSFModel`

        Raises
        ------
        ValueError
            If photutils cannot hold a grid of this shape: it needs one node
            or at least two along each axis.
        """
        from astropy.nddata import NDData
        radius = self._half_size().max() if radius is None else radius
        steps = np.arange(-np.ceil(radius * oversampling),
                          np.ceil(radius * oversampling) + 1) / oversampling
        meta = {'grid_xypos': [tuple(xy) for xy in self.grid_xypos.tolist()],
                'oversampling': oversampling}
        with waiting('GriddedMixturePSF.to_gridded_psf'):
            data = [scale * mixture.evaluate(
                        steps, steps[:, None],
                        pixel_integrated=self.pixel_integrated)
                    for mixture, scale in zip(told(self.mixtures),
                                              self.scales, strict=True)]
            return GriddedPSFModel(NDData(np.array(data), meta=meta),
                                   flux=self.flux.value, x_0=self.x_0.value,
                                   y_0=self.y_0.value)

    def to_galsim(self, x, y):
        """
        Return the PSF at a detector position as a GalSim object.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        `galsim.GSObject`
            In pixels, its flux that of a star of flux 1. If the mixtures
            contain the pixel it does, too: draw it with
            ``method='no_pixel'`` and ``scale=1``.

        Raises
        ------
        ImportError
            If galsim is not installed.
        """
        import galsim
        mixture = self.mixture_at(x, y)
        scale = self.scale_at(x, y)
        return galsim.Add([_galsim_gaussian(*gaussian, scale, galsim)
                           for gaussian in zip(
                               mixture.weights, mixture.means,
                               mixture.covariances, strict=True)])

    def plot_grid(self, **kwargs):
        """
        Draw the PSFs of all nodes, as photutils' grids do.

        Parameters
        ----------
        **kwargs
            Keywords of ``photutils.psf.GriddedPSFModel.plot_grid``.

        Returns
        -------
        `matplotlib.figure.Figure`
        """
        with waiting('GriddedMixturePSF.plot_grid'):
            return self.to_gridded_psf(2).plot_grid(**kwargs)


def _check_choices(path, kind, *, ext, detector):
    """Raise for a kind of file that has no PSF, or no such choice."""
    if kind == 'image':
        msg = (f'{path}: must hold a PSF: one of this package, a PSFEx model, '
               'a grid of ePSFs, or an image with the keyword OVERSAMP or '
               'with oversampling (--oversampling)')
        raise UnusableFileError(msg)
    for name, value, kinds in (('ext', ext, _WITH_EXTENSIONS),
                               ('detector', detector, _WITH_DETECTORS)):
        if value is not None and kind not in kinds:
            msg = (f'{path}: {name} (--{name}) must not be given for a file '
                   f'of this kind ({kind}), got {value}')
            raise ValueError(msg)


def _of_stored(cls, path, grid_shape):
    """Return what a file of this package holds, as a grid."""
    stored = read_stored(path)
    if isinstance(stored, cls):
        return stored
    if hasattr(stored, 'to_grid'):
        return stored.to_grid(grid_shape)
    integrated = getattr(stored, 'pixel_integrated', False)
    mixture = getattr(stored, 'mixture', stored)
    return cls([mixture], [(0, 0)], pixel_integrated=integrated)


def _of_each(source, make):
    """Return what is made of a source, or of each of a dict of them."""
    if isinstance(source, Mapping):
        return {name: make(one) for name, one in source.items()}
    return make(source)


def _galsim_gaussian(weight, mean, covariance, scale, galsim):
    """Return one Gaussian: a round one of the same area, sheared."""
    root = np.linalg.cholesky(covariance)
    size = np.linalg.det(covariance) ** 0.25
    round_one = galsim.Gaussian(sigma=size, flux=scale * weight)
    return round_one.transform(*(root / size).ravel()).shift(*mean)
