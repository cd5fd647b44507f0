"""
What other programs call a PSF, made of grids of mixtures and made into them.

The constructors that must fit call the room `fitting`, which stands above
this one, when they are called.
"""
from collections.abc import Mapping
from functools import partial

import numpy as np
from photutils.psf import GriddedPSFModel


class GridConversions:
    """The constructors and conversions of `GriddedMixturePSF`."""

    @classmethod
    def from_gridded_psf(cls, psf, n_components=3, *, radius=None,
                         executor=None, progress_bar=False, checkpoint=None,
                         **kwargs):
        """
        Fit mixtures to the ePSFs of a photutils grid.

        Parameters
        ----------
        psf : `~photutils.psf.GriddedPSFModel` or `~photutils.psf.STDPSFGrid`
            The grid of ePSFs, or a dict of them: one for each detector.
            Where two chips meet an STDPSF grid has two nodes at one place;
            the one of the upper or right chip is put one pixel further.
        n_components : int, optional
            The number K of Gaussians.
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
            If no node can be fitted.

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
        return _of_each(psf, partial(
            grid.fit_gridded_psf, n_components=n_components, radius=radius,
            executor=executor, progress_bar=progress_bar,
            checkpoint=checkpoint, **kwargs))

    @classmethod
    def from_psfex(cls, path, n_components=3, *, grid_shape=(30, 30),
                   limits=None, contexts=None, **kwargs):
        """
        Fit mixtures to a PSFEx model, evaluated on a grid.

        Parameters
        ----------
        path : str, path-like, `PSFExModel` or a dict of these
            The ``.psf`` file, or one for each detector.
        n_components : int, optional
            The number K of Gaussians.
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
            If the file is not a PSFEx model, see `read_psfex`.
        """
        from photutils_mgauss.fitting import grid
        return _of_each(path, partial(
            grid.fit_psfex, n_components=n_components, grid_shape=grid_shape,
            limits=limits, contexts=contexts, **kwargs))

    @classmethod
    def from_image_psf(cls, psf, n_components=3, *, grid_xypos=None,
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
            The number K of Gaussians.
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
        return grid.fit_image_psf(psf, n_components, grid_xypos=grid_xypos,
                                  **kwargs)

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
        data = [scale * mixture.evaluate(
                    steps, steps[:, None],
                    pixel_integrated=self.pixel_integrated)
                for mixture, scale in zip(self.mixtures, self.scales,
                                          strict=True)]
        meta = {'grid_xypos': [tuple(xy) for xy in self.grid_xypos.tolist()],
                'oversampling': oversampling}
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
        return self.to_gridded_psf(2).plot_grid(**kwargs)


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
