r"""
Crowded fields: all stars of an image found and fitted together.

Every star is fitted with its neighbours free, all other stars subtracted, as
Sec. 5 of Nie et al. asks of a method for the Galactic bulge.
"""
import numpy as np

from photutils_mgauss.crowded.correlated import growths
from photutils_mgauss.crowded.plan import Plan
from photutils_mgauss.crowded.residual import (
    nearest_background,
    without_residual,
)
from photutils_mgauss.crowded.solved import Solved
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.table import positions
from photutils_mgauss.crowded.tile import TileOptions
from photutils_mgauss.photometry.engine import as_model
from photutils_mgauss.photometry.flags import decode_psf_flags
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.psf.star_errors import add_psf_errors
from photutils_mgauss.utils.checkpoint import Checkpoint
from photutils_mgauss.utils.flags import REPEATED
from photutils_mgauss.utils.image import read_pixels, with_unit
from photutils_mgauss.utils.per_thread import PerThread, keep
from photutils_mgauss.utils.saturation import as_saturation, without_saturated
from photutils_mgauss.utils.star_columns import read_sources
from photutils_mgauss.utils.validation import as_integer, as_real, as_shape
from photutils_mgauss.utils.waiting import waiting

__all__ = ['CrowdedMixturePhotometry']

# Stars are drawn out to where this fraction of the noise is left of them.
_FAINTEST = 1e-3
# Stars are looked for again if correlated noise makes the variance of fluxes
# larger than this.
_LITTLE = 1.1

# What replaces keywords of photutils' classes.
_INSTEAD = {
    'finder': 'it finds the stars itself, from "threshold" standard errors; '
              'a list of your own is "init_params" of the call, with '
              '"find_neighbors=False" where it has all stars',
    'grouper': 'all stars are fitted together; leave it out',
    'fit_shape': 'all pixels are fitted; leave it out',
    'aperture_radius': 'no first fluxes are needed; leave it out',
    'fitter': 'it has a fitter of its own; leave it out',
    **dict.fromkeys(('local_bkg_estimator', 'localbkg_estimator'),
                    'the background is fitted: see "background_size"'),
}


def _instead_of(name):
    """Return a sentence on a keyword that does not exist."""
    return (f'CrowdedMixturePhotometry has no keyword {name!r}'
            + (f': {_INSTEAD[name]}' if name in _INSTEAD else ''))


class CrowdedMixturePhotometry:
    r"""
    PSF photometry of crowded fields.

    The class searches the residual for stars, the brightest first, and for
    companions of known stars with these free to readjust. It fits all stars
    and a smooth background together, that is, it minimises

    .. math::

        \chi^2 = \sum_{\mathrm{pix}} \frac{1}{\sigma^2} \Big[D - b -
        \sum_i f_i\,P(\mathbf{r} - \mathbf{r}_i)\Big]^2,

    with Gauss-Newton steps for all parameters at once. It removes stars that
    are no longer significant, and repeats these steps until it finds no more
    significant stars.

    Parameters
    ----------
    psf_model : GriddedMixturePSF, MultiGaussianPSFModel, MixtureField or None
        The PSF; a field is put on a grid. With None, `fit_crowded_psf` makes
        the PSF of each image from its own stars.
    threshold : float, optional
        The smallest significance for adding a star, in standard errors of its
        flux.
    keep : float, optional
        The smallest significance for keeping a star, in standard errors of its
        flux with its neighbours free.
    depth : float, optional
        If this is below ``threshold``, the fit includes stars down to this
        significance, which improves the results of the others. The table does
        not list them.
    count_slope : float, optional
        The prior of the flux of a star that the search found: the number of
        stars per unit flux falls with this power of the flux. Fluxes of bright
        stars stay the same; if two stars share light, the fainter one gets
        less of it. 0 means no prior.
    background_size : float or None, optional
        The distance of the nodes of the bilinear background [pix], larger for
        PSFs wider than 3 pixels, or None if no background is fitted.
    psf_error : float, optional
        The uncertainty of the PSF, as a fraction: smaller residuals of bright
        stars do not count as stars.
    effective_gain : float, optional
        Electrons per unit of the data. With it the photon noise in ``error``
        is replaced by that of the model, which avoids a bias of faint fluxes.
        By default it is determined from ``data`` and ``error``; infinity
        leaves the errors unchanged.
    maxiters : int, optional
        The largest number of searches at the final threshold.
    tile_shape : int or (ny, nx) tuple of int, optional
        The largest size of the equal tiles into which the image is divided; by
        default half of its longer side, but at least 1024 and at most 2048.
        Smaller tiles need less memory and use more workers, but cost more.
    overlap : int, optional
        The smallest margin of a tile beyond its borders [pix]; with less than
        two nodes of the background the result depends on the tiles.
    executor : `~concurrent.futures.Executor`, optional
        The executor that solves tiles; by default a pool of threads on all
        cores.
    progress_bar : bool, optional
        Whether to show a bar with the stars found and their chi2.
    checkpoint : str or path-like, optional
        A folder for finished tiles. A call with the same image and settings
        uses the tiles in it, for example after an interrupt.
    psf_errors : bool, optional
        Whether the errors include the errors of the PSF, if ``psf_model`` has
        them, as the grid of a `MixtureField` does; see `MixturePSFPhotometry`.
        For this each star is treated as isolated.
    confusion : bool, optional
        Whether errors and fluxes allow for stars that are too faint or too
        close to others to be found. Their number follows from the detected
        stars around. Not used if ``find_neighbors`` is False, because the list
        then has all stars.
    correlated_noise : bool, optional
        Whether to measure, where the light of stars is faint, if the noise of
        neighbouring pixels is correlated, as in resampled images. If it is, a
        warning and ``meta['noise_correlation']`` of the table say so, the
        errors are increased, and the search is repeated, which doubles the
        time, with ``threshold``, ``keep`` and ``depth`` in units of these
        errors. Only used with ``error``.
    saturation : float or `~astropy.units.Quantity`, optional
        The level at which pixels saturate, in the unit of the data. If given,
        these pixels and the trails of their charge along rows or columns are
        masked. Stars with masked centres are fitted to their wings in any
        case.
    residual_radius : float, optional
        If given, spikes, rings and ghosts of bright stars that the PSF lacks
        are measured on the image, out to this distance [pix] and fading beyond
        it, as by `MixturePSFPhotometry`. They are the mean residual of bright
        stars after the fit of all stars. They are subtracted from all of these
        stars and the image is solved again, which doubles the time. A warning
        says if there are too few stars. Not available in `fit_images`.
    find_neighbors : bool, optional
        Whether to find stars that are missing from a given list and fit them
        together with it. The table does not list them. If False, the list has
        to be complete.
    xy_bounds : float or None, optional
        The largest shift, along each axis, of a star of a given list from its
        place [pix].
    **elsewhere
        For a keyword that only photutils has, the error says what replaces it.

    Attributes
    ----------
    results : `~astropy.table.QTable`
        The last table; if several threads call the object, the last table of
        this thread.
    field : MixtureField or None
        The PSF made from the stars of the last image, if ``psf_model`` is
        None.
    psf_residual : PSFResidual or None
        The mean residual of bright stars, if the last call measured it; its
        ``image(x, y, flux)`` draws it for given stars.
    psf_used : GriddedMixturePSF or MultiGaussianPSFModel
        The PSF used for the last table, ``psf_model`` unless that is None.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Notes
    -----
    Columns in addition to photutils' own: ``xy_cov``, the covariance of x and
    y [pix^2]; ``x_psf_err``, ``y_psf_err`` and ``flux_psf_err``, the part of
    the errors that is due to the PSF, if it is known; ``x_confusion_err``,
    ``y_confusion_err`` and ``flux_confusion_err``, the part due to undetected
    stars, and ``flux_confusion``, the light of these stars that was subtracted
    from ``flux_fit``; ``significance`` of the detection; ``crowding``, the
    star's share of the light of all stars in its fit pixels;
    ``neighbor_distance`` [pix] and ``neighbor_correlation``, the correlation
    with the nearest neighbour's flux; ``iter_detected``. Bits of ``flags`` in
    addition to photutils' own: 65536, most of the star is masked, as for
    saturated stars; 131072, a blend: the correlation exceeds 0.5; 262144,
    probably not a star but part of an extended source, or with another source
    under it. With a given list, also: 524288, no significant star is here: its
    flux has fewer than ``keep`` standard errors; 1048576, a repeat: another
    entry is the same star, and this row repeats its row. With motions, also:
    2097152, the images do not determine the motion of the star, which is NaN.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import (CrowdedMixturePhotometry,
    ...                               GaussianMixture, GriddedMixturePSF)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[0.7, 0], [0, 0.8]]])
    >>> psf = GriddedMixturePSF([mixture], [(0, 0)])
    >>> data = 20 + sum(mixture.render((40, 40), x, y, flux=f)
    ...                 for x, y, f in [(15.2, 17, 3e4), (16.9, 18.1, 9e3)])
    >>> rng = np.random.default_rng(1)
    >>> error = np.sqrt(data)
    >>> phot = CrowdedMixturePhotometry(psf)
    >>> table = phot(data + error * rng.normal(size=data.shape), error=error)
    >>> for name in ('x_fit', 'x_err', 'flux_fit'):
    ...     table[name].info.format = '.0f' if name[0] == 'f' else '.3f'
    >>> table['x_fit', 'x_err', 'flux_fit'].pprint()
    x_fit  x_err flux_fit
    ------ ----- --------
    15.200 0.007    29838
    16.893 0.016     8713
    """

    results = PerThread('The table of the last call.')
    field = PerThread('The PSF made of the stars of the last image.')
    psf_used = PerThread('The PSF of the last table.')
    psf_residual = PerThread('What the PSF leaves of bright stars.')
    _noise = PerThread('The noise of a pixel of the last image.')

    def __init__(self, psf_model, *, threshold=4.5, keep=2.0, depth=3.5,
                 count_slope=1.5, background_size=64, psf_error=0.01,
                 effective_gain=None, maxiters=3, tile_shape=None,
                 overlap=128, executor=None, progress_bar=False,
                 find_neighbors=True, xy_bounds=1.0, checkpoint=None,
                 psf_errors=True, confusion=True, correlated_noise=True,
                 saturation=None, residual_radius=None, **elsewhere):
        if elsewhere:
            raise TypeError(_instead_of(next(iter(elsewhere))))
        self.psf_model = psf_model = as_model(psf_model)
        self.threshold = as_real(threshold, 'threshold', above=0)
        self.keep = as_real(keep, 'keep', minimum=0)
        self.depth = as_real(depth, 'depth', above=0)
        self.count_slope = as_real(count_slope, 'count_slope', minimum=0)
        self.background_size = background_size
        if background_size is not None:
            self.background_size = as_real(background_size, 'background_size',
                                           minimum=8)
        self.psf_error = as_real(psf_error, 'psf_error', minimum=0)
        self.effective_gain = effective_gain
        if effective_gain is not None and effective_gain != np.inf:
            self.effective_gain = as_real(effective_gain, 'effective_gain',
                                          above=0)
        self.maxiters = as_integer(maxiters, 'maxiters', minimum=1)
        self.tile_shape = tile_shape
        if tile_shape is not None:
            self.tile_shape = as_shape(tile_shape, 'tile_shape', minimum=32)
        self.overlap = as_integer(overlap, 'overlap', minimum=8)
        self.executor = executor
        self.progress_bar = bool(progress_bar)
        self.find_neighbors = bool(find_neighbors)
        self.xy_bounds = xy_bounds
        if xy_bounds is not None:
            self.xy_bounds = as_real(xy_bounds, 'xy_bounds', above=0)
        self.checkpoint = checkpoint
        self._checkpoint = Checkpoint(checkpoint)
        self.results = self.field = self.psf_residual = None
        self.residual_radius = (
            None if residual_radius is None
            else as_real(residual_radius, 'residual_radius', minimum=3))
        self._noise = np.inf
        self.psf_errors = bool(psf_errors)
        self.confusion = bool(confusion)
        self.correlated_noise = bool(correlated_noise)
        self.saturation = as_saturation(saturation)
        self.psf_used = psf_model
        self._psf = None if psf_model is None else LocalPSF.of(psf_model)

    def __repr__(self):
        psf = ('PSF from the image' if self.psf_model is None
               else repr(self.psf_model))
        found = ('' if self.results is None
                 else f', {len(self.results)} stars measured last')
        return (f'<CrowdedMixturePhotometry({psf}, threshold='
                f'{self.threshold:g}, background_size='
                f'{self.background_size}){found}>')

    def __call__(self, data, *, mask=None, error=None, init_params=None):
        """
        Find and fit the stars of an image.

        Parameters
        ----------
        data : (ny, nx) array_like or NDData
            The image. Its own mask counts, its unit comes back: see
            :ref:`pixels`.
        mask : (ny, nx) array_like of bool, optional
            True for pixels to leave out. Masks of ``data`` and ``error``
            count, too; pixels that are not finite, or whose error is not
            positive, are left out as well.
        error : float or (ny, nx) array_like, optional
            The standard deviation of each pixel in the unit of ``data``. By
            default it is estimated, one number for the image.
        init_params : `~astropy.table.Table`, optional
            Positions ``x_init``, ``y_init`` (or ``x``, ``y``, ...) and, if
            known, ``flux_init`` of the stars to list. The result has exactly
            these stars, in the same order.

        Returns
        -------
        `~astropy.table.QTable`
            One row for each star.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        UnfinishedTilesError
            If a worker failed; the finished tiles are in the error.
        """
        with waiting('CrowdedMixturePhotometry', self.progress_bar):
            image = without_saturated(read_pixels(data, error, mask),
                                      self.saturation).with_error()
            given = (None if init_params is None
                     else self._listed(init_params, image.unit))
            psf = self._psf_of(image)
            options = self._options(image).widened(psf.scale)
            solved = self._solve(image, psf, options, given)
            known = None
            if self.residual_radius is not None and not solved.unfinished:
                image, known = without_residual(
                    image, self.psf_used, solved.table, self.residual_radius)
                if known is not None:
                    solved = self._solve(image, psf, options, given)
            if self.psf_errors:
                add_psf_errors(solved.table, image, self.psf_used,
                               executor=self.executor)
        keep(self, results=solved.table, psf_residual=known,
             _noise=options.noise)
        solved.check()
        return solved.table

    def _solve(self, image, psf, options, given):
        """Return the `Solved` image, deep as its noise allows."""
        solved = self._solve_once(image, psf, options, given)
        growth = growths(solved.correlation, psf)[0]
        if growth > _LITTLE and self.find_neighbors and not solved.unfinished:
            # What correlated noise makes of itself was taken for stars.
            solved = self._solve_once(image, psf, options.less_deep(
                np.sqrt(growth)), given)
        solved.tell_of_correlation(stacklevel=4)
        return solved

    def _solve_once(self, image, psf, options, given):
        plan = Plan(image, psf, options, self.tile_shape,
                    round(self.overlap * psf.scale), given, self._checkpoint)
        return Solved.of(plan, self.executor, self.progress_bar, stacklevel=5)

    def fit_images(self, images, stars=None, *, motions=False):
        """
        Find and fit the stars of one field in many images together.

        The images may be shifted, rotated, of other filters, depths and PSFs.
        The search combines all images. The result is one list of stars with
        common positions and a flux for each image, also for images in which
        the star is not significant.

        Parameters
        ----------
        images : sequence of (data, psf, wcs) or `ImageEpoch`
            As for `fit_many`, but with the sky not subtracted. If ``psf`` is
            None, the PSF is ``psf_model`` or, if that is None too, it is made
            from the image's own stars.
        stars : `~astropy.table.Table` or SkyCoord, optional
            The stars to list, with ``ra`` and ``dec`` [deg]. The result has
            exactly these stars, in the same order.
        motions : bool, optional
            Whether each star has its own proper motion; needs `ImageEpoch`,
            whose ``band`` distinguishes filters.

        Returns
        -------
        `~astropy.table.QTable`
            ``id``, ``ra``, ``dec`` [deg], ``ra_error``, ``dec_error`` [mas],
            ``radec_cov`` [mas^2] and, with motions, ``pmra``, ``pmdec`` [mas /
            yr] with errors; for each of E images ``x_fit``, ``y_fit`` [pix],
            ``flux``, ``flux_err``, ``local_bkg``, ``n_pixels_fit``,
            ``image_chi2`` and ``crowding``, (n, E), NaN if an image does not
            show the star; ``n_images``, the number of images that do, and for
            all of them together ``significance``, ``reduced_chi2``, ``flags``
            and the columns about neighbours.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        UnfinishedTilesError
            If a worker failed; the finished tiles are in the error.

        Examples
        --------
        >>> import numpy as np
        >>> from astropy.nddata import NDData, StdDevUncertainty
        >>> from astropy.wcs import WCS
        >>> from photutils_mgauss import (CrowdedMixturePhotometry,
        ...                               GaussianMixture, GriddedMixturePSF)
        >>> wcs = WCS(naxis=2)
        >>> wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
        >>> wcs.wcs.cdelt = -1e-5, 1e-5
        >>> mixture = GaussianMixture([1], [[0, 0]], [[[0.7, 0], [0, 0.8]]])
        >>> psf = GriddedMixturePSF([mixture], [(0, 0)])
        >>> rng = np.random.default_rng(1)
        >>> images = []
        >>> for flux in (250, 500):
        ...     data = 20 + mixture.render((40, 40), 15.2, 17, flux=flux)
        ...     error = np.sqrt(data)
        ...     noisy = data + error * rng.normal(size=data.shape)
        ...     images.append((NDData(noisy, StdDevUncertainty(error)), psf,
        ...                    wcs))
        >>> table = CrowdedMixturePhotometry(None).fit_images(images)
        >>> len(table), table['flux'].shape
        (1, (1, 2))
        """
        if self.residual_radius is not None:
            msg = ('residual_radius must be None for fit_images, got '
                   f'{self.residual_radius:g}')
            raise ValueError(msg)
        from photutils_mgauss.crowded.many_images import Settings, fit_images
        with waiting('CrowdedMixturePhotometry.fit_images',
                     self.progress_bar):
            table, unfinished, errors = fit_images(images, stars, Settings(
                self._options, self._model_of, self._bound, self.tile_shape,
                self.overlap, self.executor, self.progress_bar,
                self._checkpoint, self.saturation), motions=motions)
        Solved(table, unfinished, errors).check()
        return table

    def _psf_of(self, image):
        """Return the PSF of an image, made of its stars if none is known."""
        if self._psf is not None:
            return self._psf
        return LocalPSF.of(self._model_of(image))

    def _model_of(self, image):
        """Return the PSF model, made of an image's stars if none is known."""
        if self.psf_model is not None:
            return self.psf_model
        from photutils_mgauss.crowded.psf_loop import LoopOptions
        field, model = self.fit_field(image, LoopOptions(
            progress_bar=self.progress_bar))
        keep(self, field=field, psf_used=model)
        return model

    def fit_field(self, image, options):
        """
        Fit the PSF of an image to its stars.

        Parameters
        ----------
        image : `~photutils_mgauss.utils.image.PixelData`
            With errors.
        options : `~photutils_mgauss.crowded.psf_loop.LoopOptions`

        Returns
        -------
        MixtureField, GriddedMixturePSF
        """
        from photutils_mgauss.crowded.psf_loop import fit_field, grid_of
        field = fit_field(image, options, self._with_psf, self.effective_gain)
        return field, grid_of(field)

    def _with_psf(self, psf_model, **changes):
        """Return the same photometry with a PSF and other settings."""
        same = {name: getattr(self, name) for name in (
            'count_slope', 'background_size', 'maxiters', 'tile_shape',
            'overlap', 'executor', 'checkpoint', 'saturation')}
        return type(self)(psf_model, psf_errors=False, confusion=False,
                          correlated_noise=False, **same | changes)

    def _listed(self, init_params, unit):
        x, y, flux, number = _given(init_params, unit)
        return Stars(x, y, flux, number=number, bound=self._bound)

    @property
    def _bound(self):
        """How far a listed star may be from its place [pix]."""
        return np.inf if self.xy_bounds is None else self.xy_bounds

    def _options(self, image):
        """Return the `TileOptions` of a `PixelData` with errors."""
        _, variance = image.sample()
        gain = self.effective_gain
        if gain is None:
            gain = image.gain()
        if variance.size == 0:
            variance = np.ones(1)
        return TileOptions(
            threshold=self.threshold, keep=self.keep,
            background_size=self.background_size, psf_error=self.psf_error,
            gain=None if gain in (None, np.inf) else float(gain),
            floor=float(variance.min()),
            noise=float(np.sqrt(np.median(variance))),
            max_rounds=self.maxiters, find_neighbors=self.find_neighbors,
            xy_bounds=self._bound,
            depth=self.depth, count_slope=self.count_slope,
            confusion=self.confusion,
            correlated_noise=self.correlated_noise and not image.estimated)

    def decode_flags(self, *, return_bit_values=False):
        """
        Put the flags of the last table into words.

        Parameters
        ----------
        return_bit_values : bool, optional
            Whether to return the bits instead of their names.

        Returns
        -------
        list of list
            For each row of the table a list with a name for each bit that is
            set, as of `decode_psf_flags`.

        Raises
        ------
        ValueError
            If there is no table yet.
        """
        return decode_psf_flags(self._last_table('decode_flags')['flags'],
                                return_bit_values=return_bit_values)

    def _last_table(self, method):
        """Return the table of the last call, for a method that needs it."""
        if self.results is None:
            msg = f'{method} needs stars: call the object first'
            raise ValueError(msg)
        return self.results

    def make_model_image(self, shape, *, psf_shape=None,
                         include_local_bkg=False):
        """
        Draw the stars of the last table.

        Parameters
        ----------
        shape : (ny, nx) tuple of int
            The shape of the image.
        psf_shape : int or (ny, nx) tuple of int, optional
            The size of the stamp drawn for each star; by default as far as its
            light is visible.
        include_local_bkg : bool, optional
            Whether to add the background, as interpolated from the nearest
            star.

        Returns
        -------
        (ny, nx) `~numpy.ndarray` or `~astropy.units.Quantity`

        Raises
        ------
        ValueError
            If there is no table yet.
        """
        table = self._last_table('make_model_image')
        shape = as_shape(shape, 'shape')
        stars = np.array(positions(table))
        stars[2, (table['flags'] & REPEATED) > 0] = 0
        window = None if psf_shape is None else as_shape(psf_shape,
                                                         'psf_shape')
        image = MixtureRenderer(self.psf_used).image(
            stars, _FAINTEST * self._noise, shape, window)
        if include_local_bkg and len(table):
            image += nearest_background(table, shape)
        return with_unit(image, getattr(table['flux_fit'], 'unit', None))

    def make_residual_image(self, data, *, psf_shape=None,
                            include_local_bkg=False):
        """
        Subtract the stars of the last table from an image.

        Parameters
        ----------
        data : (ny, nx) array_like or NDData
            The image.
        psf_shape, include_local_bkg
            See `make_model_image`.

        Returns
        -------
        (ny, nx) `~numpy.ndarray` or `~astropy.units.Quantity`
        """
        pixels = read_pixels(data)
        return with_unit(pixels.data, pixels.unit) - self.make_model_image(
            pixels.shape, psf_shape=psf_shape,
            include_local_bkg=include_local_bkg)


def _given(table, unit):
    """Return x, y, flux (NaN if unknown) and the row of each position."""
    found = read_sources(table, 'init_params', first='_init', unit=unit)
    return found.x, found.y, found.flux, np.arange(len(table))
