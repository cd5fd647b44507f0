r"""
PSF photometry with mixtures of Gaussians, in the tables of photutils.

`MixturePSFPhotometry` is `photutils.psf.PSFPhotometry` with another engine
for the fits: the same call, the same table, hundreds of times faster. It
minimizes

.. math::

    E = \sum_i \frac{[f_i - F\, P(x_i - x_0, y_i - y_0)]^2}{\sigma_i^2}

(Eq. 9 of Nie et al.) over the position and the flux of each star, or of all
stars of a group together.
"""
import warnings
from functools import partial

import numpy as np
from astropy.nddata import NDData
from astropy.utils.exceptions import AstropyUserWarning
from photutils.psf import PSFPhotometry

from photutils_mgauss.photometry import engine
from photutils_mgauss.photometry import table as _table
from photutils_mgauss.photometry.apertures import aperture_correction
from photutils_mgauss.photometry.bright_residual import without_residual
from photutils_mgauss.photometry.contexts import (
    context_columns,
    fit_with_contexts,
    keep_contexts,
)
from photutils_mgauss.photometry.errors import with_all_errors
from photutils_mgauss.photometry.fitter import MixtureFitter, as_max_steps
from photutils_mgauss.photometry.given import checked, put_back
from photutils_mgauss.photometry.saturated import (
    SaturatedStars,
    flag,
    with_misfit,
)
from photutils_mgauss.photometry.wing_errors import (
    wing_errors,
    with_wing_errors,
)
from photutils_mgauss.utils import compat
from photutils_mgauss.utils.correlated_noise import noise_correlation
from photutils_mgauss.utils.image import PixelData, read_pixels, with_unit
from photutils_mgauss.utils.per_thread import PerThread, keep
from photutils_mgauss.utils.saturation import as_saturation
from photutils_mgauss.utils.star_columns import plain_values
from photutils_mgauss.utils.validation import (
    as_choice,
    as_integer,
    as_real,
    check_callables,
)
from photutils_mgauss.utils.waiting import patient, waiting

__all__ = ['MixturePSFPhotometry']


class MixturePSFPhotometry(PSFPhotometry):
    """
    PSF photometry of many stars with a PSF made of Gaussians.

    A drop-in replacement of `photutils.psf.PSFPhotometry` with the same
    keywords, methods and columns. It fits stars in compiled code, on all
    cores; grouped stars are fitted jointly.

    Parameters
    ----------
    psf_model : GriddedMixturePSF, MultiGaussianPSFModel or MixtureField
        The PSF. If it depends on the colour or the flux of stars, as fields
        with ``contexts`` do, each star is fitted with its own PSF;
        ``init_params`` needs a column with the name of the context. Parameters
        that are ``fixed`` are not fitted: with ``x_0`` and ``y_0`` fixed the
        photometry is forced. Any other PSF model, a model whose shape is free,
        and a grid with another ``interpolation`` than 'blend' or ``outside``
        than 'clamp' is left to `~photutils.psf.PSFPhotometry`, and a warning
        says so.
    fit_shape : int or (ny, nx) tuple of int
        The shape of the fitted region, odd.
    fitter : object, optional
        ``None`` or a `MixtureFitter` for the compiled engine. With any other
        fitter everything is left to `~photutils.psf.PSFPhotometry`, and a
        warning says so.
    executor : `~concurrent.futures.Executor`, optional
        The executor for the fits; by default a pool of threads on all cores.
    n_threads : int, optional
        The number of threads for the fits, instead of all cores; cannot be
        combined with ``executor``. The compiled engine needs no free-threaded
        Python for this.
    fit_sky : bool, optional
        Whether to fit a level of the sky for each group, on top of
        ``local_bkg``; adds the columns ``sky`` and ``sky_err``.
    effective_gain : float, optional
        If given, ``error`` has only the noise of the background, and the noise
        of the stars' own light is added: light divided by ``effective_gain``,
        in the same units. Without ``error`` the former is estimated.
    variance : {'model', 'data'}, optional
        Whether the variance uses the light of the fitted model or of the
        pixels. With the pixels (Eq. 10 of Nie et al.), those that are low by
        chance get too much weight, and fluxes come out too low. Only used with
        ``effective_gain``.
    xy_cov : bool, optional
        Whether to add the column ``xy_cov``, the covariance of ``x_fit`` and
        ``y_fit`` [pix^2].
    psf_errors : bool, optional
        Whether the errors include the errors of the PSF, if ``psf_model`` has
        them, as a `MixtureField` and its grid do. This part also has its own
        columns, ``x_psf_err``, ``y_psf_err`` [pix] and ``flux_psf_err``; stars
        near each other share it.
    correlated_noise : bool, optional
        Whether to measure on blank sky if the noise of neighbouring pixels is
        correlated, as in resampled images, and to increase the errors
        accordingly. A warning and ``meta['noise_correlation']`` of the table
        have the result. Only used with ``error``.
    saturation : float or `~astropy.units.Quantity`, optional
        The level at which pixels saturate, in the unit of the data and, like
        the data, without the background; infinity if masks or NaN mark
        saturated pixels. If given, these pixels and the trails of their charge
        along rows or columns are left out. Such stars are fitted to the
        others, which also give the first position, in as many pixels as
        needed, and have bit 65536 in ``flags``. Their errors are multiplied by
        the root of ``reduced_chi2`` if it is above one.
    residual_radius : float, optional
        If given, spikes, rings and ghosts of bright stars that the PSF lacks
        are measured on the image, out to this distance [pix] and fading beyond
        it. They are the mean residual of all bright stars, as far as it is
        significant. This residual is subtracted from each of these stars, and
        all stars are fitted again. ``psf_residual`` has the result; a warning
        says if there are too few stars. Not for a PSF that depends on colours
        or fluxes, nor for one that is left to photutils.
    aperture_radius_correction : float, optional
        If given, adds the column ``aperture_correction``: the factor from a
        flux within this radius [pix] to the total flux, the inverse of the
        PSF's encircled energy at the star.
    **kwargs
        The keywords of the installed `~photutils.psf.PSFPhotometry`:
        ``finder``, ``grouper``, ``fitter_maxiters``, ``xy_bounds``,
        ``aperture_radius``, ``local_bkg_estimator``,
        ``group_warning_threshold``, ``progress_bar``, ....

    Attributes
    ----------
    results : `~astropy.table.QTable`
        The table of the last call, with the columns of photutils. Several
        threads may call one object; each sees the table of its own last call.
    init_params : `~astropy.table.QTable`
        The initial parameters.
    psf_residual : PSFResidual or None
        The mean residual of bright stars, if the last call measured it; its
        ``image(x, y, flux)`` draws it for given stars.
    fit_info : list of dict
        ``param_cov`` (covariance of the free parameters, in the order flux,
        x, y), ``status`` and ``message`` of each star, in the order of
        ``results``; made when asked for.

    Raises
    ------
    ValueError
        In the call, as in photutils: for arrays of different shapes, errors
        that are not positive under a star, ids that are not unique, or a
        ``fitter_maxiters`` below 1.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from photutils_mgauss import (GaussianMixture, MixturePSFPhotometry,
    ...                               MultiGaussianPSFModel)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> data = mixture.render((31, 31), 14.2, 15.7, flux=500)
    >>> stars = QTable({'x': [14.], 'y': [16.], 'flux': [400.]})
    >>> psfphot = MixturePSFPhotometry(MultiGaussianPSFModel(mixture), 11)
    >>> table = psfphot(data, init_params=stars)
    >>> [round(float(table[name][0]), 6)
    ...  for name in ('x_fit', 'y_fit', 'flux_fit')]
    [14.2, 15.7, 500.0]
    """

    data_unit = PerThread('The unit of the data of the last call.')
    finder_results = PerThread('What the finder found in the last call.')
    init_params = PerThread('Where the fits of the last call started.')
    results = PerThread('The table of the last call.')
    psf_residual = PerThread('What the PSF leaves of bright stars.')
    _fit_info = PerThread('How the fits of the last call went.')
    make_model_image = patient(PSFPhotometry.make_model_image)
    make_residual_image = patient(PSFPhotometry.make_residual_image)

    def __init__(self, psf_model, fit_shape, *, fitter=None, executor=None,
                 n_threads=None, fit_sky=False, effective_gain=None,
                 variance='model', xy_cov=False, psf_errors=True,
                 correlated_noise=True,
                 aperture_radius_correction=None, saturation=None,
                 residual_radius=None, **kwargs):
        check_callables(kwargs, ('finder', 'grouper', 'local_bkg_estimator'))
        fitter = MixtureFitter() if fitter is None else fitter
        if n_threads is not None and compat.HAS_THREADS:
            kwargs['n_threads'] = n_threads
        super().__init__(engine.as_model(psf_model), fit_shape, fitter=fitter,
                         **kwargs)
        self._n_threads = (None if n_threads is None else
                           as_integer(n_threads, 'n_threads', minimum=1))
        if n_threads is not None and executor is not None:
            msg = ('n_threads and executor must not both be given: the '
                   'executor has its own number of threads')
            raise ValueError(msg)
        self.executor = executor
        self._told_of_photutils = self._told_of_correlation = False
        self.psf_errors = bool(psf_errors)
        self.correlated_noise = bool(correlated_noise)
        self.fit_sky = bool(fit_sky)
        self.effective_gain = (
            None if effective_gain is None
            else as_real(effective_gain, 'effective_gain', above=0))
        self.variance = as_choice(variance, 'variance', ('model', 'data'))
        self.xy_cov = bool(xy_cov)
        self.saturation = as_saturation(saturation)
        self._saturated = SaturatedStars()
        self.residual_radius = (
            None if residual_radius is None
            else as_real(residual_radius, 'residual_radius', minimum=3))
        self.psf_residual = None
        self.aperture_radius_correction = (
            None if aperture_radius_correction is None
            else as_real(aperture_radius_correction,
                         'aperture_radius_correction', above=0))

    def __call__(self, data, *, mask=None, error=None, init_params=None):
        """
        Fit the stars of an image.

        Parameters
        ----------
        data : (ny, nx) array_like or NDData
            The image, its background subtracted. Its own mask counts, its
            unit comes back: see :ref:`pixels`.
        mask : (ny, nx) array_like of bool, optional
            True for pixels to leave out. Masks of ``data`` and ``error``
            count, too; pixels that are not finite are left out as well.
        error : float or (ny, nx) array_like, optional
            The standard deviation of each pixel in the unit of ``data``.
        init_params : `~astropy.table.Table`, optional
            The initial positions, as for photutils; by default those that
            ``finder`` finds.

        Returns
        -------
        `~astropy.table.QTable` or None
            The table of results; None if there are no stars.
        """
        if not self._can_fit and not self._told_of_photutils:
            self._told_of_photutils = True
            warnings.warn(self._why_photutils(), AstropyUserWarning,
                          stacklevel=2)
        if isinstance(data, NDData):
            compat.check_nddata(mask, error)
        with waiting(type(self).__name__, self.progress_bar):
            call = compat.for_one_call(self)
            try:
                table = call._measure(read_pixels(data, error, mask),
                                      init_params)
            finally:
                keep(self, psf_residual=call.psf_residual,
                     _fit_info=call._fit_info, **{
                         name: getattr(call, name)
                         for name in compat.OF_A_CALL if name != 'fit_info'})
            self._tell_of_correlation()
        return table

    def _measure(self, pixels, init_params):
        """Do what a call does; changes this object."""
        self._check_residual()
        self.psf_residual = None
        pixels = self._without_saturated(pixels)
        data, error = (array if array is None
                       else with_unit(array, pixels.unit)
                       for array in (pixels.data, pixels.error))
        if not self._can_fit:
            return super().__call__(data, mask=pixels.mask, error=error,
                                    init_params=init_params)
        given, places = checked(self, init_params)
        data, mask, error, init_params = compat.prepare_inputs(
            self, data, pixels.mask, error, given)
        if init_params is None:
            return None
        put_back(init_params, places)
        keep_contexts(self.psf_model, given, init_params)
        self._check_inputs(init_params)
        self.init_params = init_params
        image = self._make_image(data, mask, error)
        result, group_size = self._fit_contexts(image, init_params)
        before = image
        if not self.psf_model.contexts:
            result, image, self.psf_residual = without_residual(
                result, image, self.psf_model, self.residual_radius,
                partial(self._fit_again, init_params),
                np.asarray(init_params['group_id']))
        wings = wing_errors(result, before, image, self.psf_model,
                            self.psf_residual)
        result = with_misfit(result, error is not None
                             or self.effective_gain is not None)
        correlation = self._correlation(image, result)
        result, psf_part = with_all_errors(
            result, image, self.psf_model,
            psf_errors=self.psf_errors, correlation=correlation,
            fit_sky=self.fit_sky, executor=self.executor,
            n_threads=self._n_threads)
        result, psf_part = with_wing_errors(result, psf_part, *wings)
        self.results = self._make_table(result, group_size, data.shape,
                                        error is not None, psf_part)
        self.results.meta['noise_correlation'] = (
            '' if correlation is None else str(correlation))
        self._warn_of_failures(result)
        return self.results

    def _check_residual(self):
        """Raise an error if no residual can be measured though asked for."""
        if self.residual_radius is None or (
                self._can_fit and not self.psf_model.contexts):
            return
        msg = ('residual_radius must be None for a psf_model that '
               'depends on colours or fluxes or is left to photutils, got '
               f'{self.residual_radius:g}')
        raise ValueError(msg)

    def _without_saturated(self, pixels):
        """Mask saturated pixels, and see what stars are behind them."""
        pixels, self._saturated = SaturatedStars.of(
            pixels, self.saturation,
            self.psf_model if self._can_fit else None)
        self._data_processor.finder = self._saturated.finder(self.finder)
        return pixels

    def _fit_contexts(self, image, init_params):
        """Fit the stars, each with the PSF of its own colour or flux."""
        if not self.psf_model.contexts:
            return self._fit(image, init_params)
        columns, missing = context_columns(self.psf_model, init_params)
        result, group_size, settled = fit_with_contexts(
            lambda image: self._fit(image, init_params), image,
            self.psf_model, columns)
        if not settled:
            missing.append(
                'stars still moved when their PSFs were adapted to colours '
                'or fluxes for the last time: check stars that are close to '
                'each other')
        for sentence in missing:
            warnings.warn(sentence, AstropyUserWarning, stacklevel=4)
        return result, group_size

    def _correlation(self, image, result):
        """Return the correlation of the noise if it counts."""
        if not self.correlated_noise:
            return None
        return noise_correlation(image.data, image.error, image.mask,
                                 *result.values[:, 1:].T,
                                 max(self.fit_shape) / 2 + 3)

    def _tell_of_correlation(self):
        """Warn once that noise is correlated."""
        found = (self.results is not None and self.results.meta.get(
            'noise_correlation'))
        if found and not self._told_of_correlation:
            self._told_of_correlation = True
            warnings.warn(f'{found} Errors are enlarged for it.',
                          AstropyUserWarning, stacklevel=3)

    @property
    def fit_info(self):
        """What is known of each fit, a list of dictionaries."""
        info = self._fit_info
        return info.entries if isinstance(info, _table.FitInfo) else info

    @fit_info.setter
    def fit_info(self, info):
        self._fit_info = info

    @staticmethod
    def fit_many(images, coordinates, **kwargs):
        """
        Fit each star to the pixels of several images together.

        Parameters
        ----------
        images : sequence of (data, psf, wcs)
            The images.
        coordinates : (n,) `~astropy.coordinates.SkyCoord`
            Where the stars are.
        **kwargs
            Further keywords of `fit_many`.

        Returns
        -------
        `~astropy.table.QTable`
            See `fit_many`.
        """
        from photutils_mgauss.photometry.many_images import fit_many
        return fit_many(images, coordinates, **kwargs)

    @property
    def _can_fit(self):
        return (isinstance(self.fitter, MixtureFitter)
                and engine.is_fixed_shape(self.psf_model))

    def _why_photutils(self):
        """Return a sentence on why photutils fits, and what to do."""
        if isinstance(self.fitter, MixtureFitter):
            reason, remedy = engine.why_not(self.psf_model)
        else:
            reason = f'fitter is a {type(self.fitter).__name__}'
            remedy = 'leave it out'
        return ('Photutils fits the stars, without compiled code, because '
                f'{reason}. For fast fits {remedy}.')

    @property
    def _free(self):
        """Which of flux, x and y are fitted, (3,)."""
        return ~np.array([getattr(self.psf_model, name).fixed
                          for name in ('flux', 'x_0', 'y_0')])

    def _check_inputs(self, init_params):
        if not self._free.any():
            msg = 'psf_model must have a free parameter, got none'
            raise ValueError(msg)
        ids, counts = np.unique(np.asarray(init_params['id']),
                                return_counts=True)
        if (counts > 1).any():
            msg = (f'init_params must have unique values of id, got '
                   f'{ids[counts.argmax()]} {counts.max()} times')
            raise ValueError(msg)

    def _make_image(self, data, mask, error):
        gain = self.effective_gain
        if gain is not None and error is None:
            # Photons alone would leave faint pixels without an error.
            error = PixelData(data, None, mask).with_error().error
        if gain is not None and self.variance == 'data':
            error = np.sqrt(np.square(error, dtype=float)
                            + np.maximum(data, 0, dtype=float) / gain)
            gain = None
        return engine.kernel_image(data, error, mask, gain)

    def _fit(self, image, init_params):
        """Return the FitResult and the group sizes of all stars."""
        start = _Start(self, image, init_params)
        groups = np.asarray(init_params['group_id'])
        _, inverse, counts = np.unique(groups, return_inverse=True,
                                       return_counts=True)
        rows = np.flatnonzero(start.valid)
        order, starts = engine.sort_groups(
            inverse[rows], *start.initial[rows, 1:].T)
        rows = rows[order]
        stars = start.stars(rows, starts, ~self._free)
        fits = engine.fit_stars(
            image, engine.psf_arrays(self.psf_model), stars,
            fit_sky=self.fit_sky, executor=self.executor,
            n_threads=self._n_threads,
            max_iterations=as_max_steps(self.fitter_maxiters,
                                        'fitter_maxiters'),
            progress_bar=self.progress_bar)
        _check_errors(fits, stars)
        return start.result(rows, fits), counts[inverse]

    def _fit_again(self, init_params, image, rows):
        """Return the FitResult of stars and their groups, and their rows."""
        if rows is None:
            return self._fit(image, init_params)[0], slice(None)
        groups = np.asarray(init_params['group_id'])
        some = np.flatnonzero(np.isin(groups, groups[rows]))
        return self._fit(image, init_params[some])[0], some

    def _make_table(self, result, group_size, data_shape, has_error,
                    psf_part):
        has_error = has_error or self.effective_gain is not None
        quality = _table.fit_quality(result, np.count_nonzero(self._free),
                                     has_error)
        flags = flag(_table.define_flags(result, self.fit_shape, data_shape),
                     result.saturated)
        columns = _table.make_columns(result, quality, flags, self.data_unit)
        columns |= self._extra_columns(result)
        columns |= _table.psf_columns(psf_part, self.data_unit)
        table, rows = _table.assemble(self.init_params, group_size, columns,
                                      compat.results_meta(self))
        self.fit_info = _table.FitInfo(result, rows)
        return table

    def _extra_columns(self, result):
        columns = {}
        if self.xy_cov:
            columns['xy_cov'] = result.covariances[:, 1, 2].copy()
        if self.fit_sky:
            unit = 1 if self.data_unit is None else self.data_unit
            columns['sky'] = result.sky[:, 0] * unit
            columns['sky_err'] = result.sky[:, 1] * unit
        if self.aperture_radius_correction is not None:
            columns['aperture_correction'] = aperture_correction(
                self.psf_model, result.values[:, 1], result.values[:, 2],
                self.aperture_radius_correction)
        return columns

    def _warn_of_failures(self, result):
        if (result.valid & ~result.converged).any():
            msg = ('One or more fit(s) may not have converged. Please check '
                   'the "flags" column in the output table.')
            warnings.warn(msg, AstropyUserWarning, stacklevel=4)


class _Start:
    """The initial values of all stars, and which of them can be fitted."""

    def __init__(self, photometry, image, init_params):
        self.initial = np.column_stack(
            [plain_values(init_params[f'{name}_init'])
             for name in ('flux', 'x', 'y')])
        self.local_bkg = plain_values(init_params['local_bkg'])
        self.free = photometry._free
        # Saturated stars start from their wings, whatever they are given.
        stars = photometry._saturated
        self.shapes, self.saturated = stars.widths(
            *self.initial[:, 1:].T, photometry.fit_shape)
        self._set_bounds(photometry)
        stars.starts(self.saturated, self.initial, self.free)
        rows = self.saturated[self.saturated >= 0]
        self.initial[rows] = np.clip(self.initial[rows], self.lower[rows],
                                     self.upper[rows])
        self._set_boxes(photometry.fit_shape, image)

    def _set_bounds(self, photometry):
        self.lower = np.full(self.initial.shape, -np.inf)
        self.upper = np.full(self.initial.shape, np.inf)
        flagged = np.zeros(3, bool)
        xy_bounds = photometry.xy_bounds
        for k, name in enumerate(('flux', 'x_0', 'y_0')):
            low, high = getattr(photometry.psf_model, name).bounds
            if low is not None:
                self.lower[:, k] = low
            if high is not None:
                self.upper[:, k] = high
            bound = None if xy_bounds is None or k == 0 else xy_bounds[k - 1]
            if bound is not None:
                self.lower[:, k] = self.initial[:, k] - bound
                self.upper[:, k] = self.initial[:, k] + bound
            flagged[k] = self.free[k] and (
                compat.FLAGS_MODEL_BOUNDS or (k > 0
                                              and xy_bounds is not None))
        self.flagged_bounds = flagged

    def _set_boxes(self, fit_shape, image):
        """Find the pixels of each star, and what keeps it from being fit."""
        n = len(self.initial)
        data_shape = image.data.shape
        self.reasons = np.zeros(n, int)
        self.boxes = np.zeros((n, 4), np.int64)
        flux, x, y = self.initial.T
        margin = max(fit_shape) // 2 + 1
        with np.errstate(invalid='ignore'):
            near = ((x >= -margin) & (y >= -margin)
                    & (x < data_shape[1] + margin)
                    & (y < data_shape[0] + margin))
        finite = np.isfinite(x) & np.isfinite(y) & np.isfinite(flux)
        self.reasons[finite & ~near] = _table.NO_OVERLAP
        usable = finite & near
        self.boxes[usable] = engine.cut_boxes(
            x[usable], y[usable], self.shapes[usable], data_shape)
        area = self.boxes[:, 2] * self.boxes[:, 3]
        self.reasons[usable & (area == 0)] = _table.NO_OVERLAP
        self.n_pixels = engine.count_pixels(image, self.boxes)
        self.reasons[(area > 0) & (self.n_pixels == 0)] = _table.FULLY_MASKED
        few = (self.n_pixels > 0) & (self.n_pixels
                                     < np.count_nonzero(self.free))
        self.reasons[few] = _table.TOO_FEW_PIXELS
        self.valid = (self.n_pixels > 0) & ~few

    def stars(self, rows, starts, fixed):
        """Return the stars of the rows, ready to be fitted."""
        # A background that is not finite is not subtracted, only flagged.
        sky = np.where(np.isfinite(self.local_bkg), self.local_bkg, 0.0)
        return engine.StarGroups(
            self.initial[rows], self.boxes[rows], sky[rows], starts,
            self.lower[rows], self.upper[rows], fixed)

    def result(self, rows, fits):
        """Return the results of all stars, of which rows were fitted."""
        full = engine.Fits.empty(len(self.initial))
        for target, source in zip(full.arrays, fits.arrays, strict=True):
            target[rows] = source
        return _table.FitResult(
            self.initial, self.lower, self.upper, self.local_bkg,
            self.n_pixels, self.reasons, self.valid, self.free,
            self.flagged_bounds, full.values, full.covariances, full.sky,
            full.sums, full.outcome, self.saturated, self.shapes)


def _check_errors(fits, stars):
    bad = fits.outcome[:, 0] == engine.BAD_ERROR
    if bad.any():
        _, x, y = stars.initial[bad.argmax()]
        msg = ('error must be positive and finite under the stars, got a '
               f'value that is not near x={x:.1f}, y={y:.1f}')
        raise ValueError(msg)
