"""
The fit of a PSF field to the pixels of the stars of one or more images.

Input is read and checked here, `photutils_mgauss.field.stages` does the
fitting, and what it found becomes the public results.
"""
import logging
import warnings
from dataclasses import replace

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import (
    core_width,
    residual_stars,
    star_table,
)
from photutils_mgauss.field.beyond import add_degrees
from photutils_mgauss.field.brighter_fatter import measure_fattening
from photutils_mgauss.field.choice import (
    MANY_STARS,
    POOR,
    choose,
    run_with_enough_components,
    warn_of_few,
)
from photutils_mgauss.field.contexts import lateral_shifts
from photutils_mgauss.field.covariance import (
    honest_covariance,
    plain_covariance,
)
from photutils_mgauss.field.extrapolation import is_wild, widths_beyond
from photutils_mgauss.field.forms import TunedShapes
from photutils_mgauss.field.growth import (
    FIRST_RADIUS,
    light_inside,
    measure_wings,
    own_radius,
    stars_of_exposures,
)
from photutils_mgauss.field.input import (
    allow_for_correlation,
    possible_degree,
    read_exposures,
    read_sample,
    warn_of_sky,
)
from photutils_mgauss.field.misfit import misfit
from photutils_mgauss.field.mixture_field import MixtureField
from photutils_mgauss.field.noise import noise_covariance
from photutils_mgauss.field.normal import Workers, model_stamps
from photutils_mgauss.field.options import FieldOptions
from photutils_mgauss.field.pixel import chosen_pixel, warn_of_phase
from photutils_mgauss.field.progress import progress
from photutils_mgauss.field.tuned_field import TunedMixtureField, known_shapes
from photutils_mgauss.utils.waiting import waiting

__all__ = ['fit_mixture_field']

_LOG = logging.getLogger('photutils_mgauss')
# How often the field follows what bright stars are wider by.
_FATTER_STEPS = 2
# So large a share of the stars, and so many, are not lost unless something is
# wrong.
_LOST, _FEWEST_LOST = 1 / 3, 3
# The weight of the centre in widths of the core, and at most in radii of the
# stamp. A narrower one follows aberrations in a way that no distortion of low
# degree can describe, a wider one sees more noise.
_CENTRE_SIZE, _CENTRE_SHARE = 2.0, 0.36


def fit_mixture_field(data, stars, *, error=None, mask=None, n_components=None,
                      degree=None, radius=None, local_bkg=False,
                      effective_gain=None, reject=True, regularization=1.0,
                      start=None, centre='core', normalise='auto',
                      pixel_integrated='auto', correlated_noise=True,
                      contexts=(), brighter_fatter=False, executor=None,
                      progress_bar=False):
    """
    Fit a PSF field to the pixels of stars.

    The function fits ``n_components`` Gaussians, whose parameters are
    polynomials of detector position, by maximum likelihood to the pixels
    of all stars, together with the position and flux of each star and of
    neighbours inside its stamp. It rejects deviant stars and pixels.

    If you give lists for ``data``, ``stars``, ``error`` and ``mask``,
    several exposures of one detector share a field; the PSF of each
    exposure is the field convolved with its own Gaussian. Stars that
    several exposures show at about the same place, as after small dithers,
    count once where the number of stars decides, and are left out
    together. The pattern of the stars tells which they are.

    Parameters
    ----------
    data : (ny, nx) array_like or NDData, or list of those
        The image, its background subtracted. Its own mask counts, its unit
        comes back: see :ref:`pixels`.
    stars : `~astropy.table.Table` or list of those
        The stars: ``x``, ``y`` and, if known, ``flux``; photutils' names
        with ``_fit``, ``_init`` or ``_centroid`` are accepted. If it has a
        column ``selected``, as tables of `select_psf_stars` do, the PSF is
        fitted to those stars and the others count as neighbours.
    error : float or (ny, nx) array_like, or list of those, optional
        The standard deviation of each pixel in the unit of ``data``. By
        default it is estimated from the scatter of the pixels.
    mask : (ny, nx) array_like of bool or list of those, optional
        True for pixels to leave out. Masks of ``data`` and ``error`` count,
        too; pixels that are not finite, or whose error is not positive, are
        left out as well.
    n_components : int or 'auto', optional
        The number K of Gaussians; 'auto' chooses the number from 2 to 7
        that best describes stars left out of the fit. By default it is
        'auto' with 8 to 59 stars, and else 6. It becomes 8, in twice the
        time, where 6 miss 0.5 % of the light of bright pixels of 60 stars
        or more, or where 300 stars or more, when left out of the fit, are
        clearly better described by 8; not if stars are so narrow that
        pixels are integrated. A warning says where fewer than 6, if you
        give them, miss 0.5 % more of that light than 6 do.
    degree : int or 'auto', optional
        The degree of the polynomials, 0 for a PSF that is the same
        everywhere; by default 4, or 'auto' with 8 to 59 stars, or 1 with
        ``start``. It is lowered, with a warning, if there are too few
        stars; the default also if the PSF far from all stars would be three
        times as narrow or as wide as at any star, and a lower degree
        describes the stars as well. 'auto' chooses a degree from 0
        to 5 in the same way as the number of Gaussians; with fewer than 60
        stars the field has the terms of one degree more, and of all up to
        4, with a prior about zero, so that errors include what the stars
        cannot tell of them. Terms that are not significant are shrunk, so
        that a degree that is too high takes more time but loses little
        accuracy.
    radius : float, optional
        The radius of the circle of fitted pixels [pix]. By default four
        times the width at half maximum of the stars, but at least 10 and
        at most 20.
    local_bkg : bool, optional
        Whether to fit a constant background to each star's stamp.
    effective_gain : float, optional
        Electrons per unit of ``data``. If the error of a pixel includes
        the noise of its own light, as from
        `photutils.utils.calc_total_error`, the fit replaces this part by
        the expected noise of the model, which removes a bias of faint
        fluxes. By default the gain is determined from ``data`` and
        ``error``; infinity leaves the errors unchanged.
    reject : bool, optional
        Whether to drop deviant stars and pixels.
    regularization : float, optional
        The strength of the prior on the shapes. The prior keeps Gaussians
        apart that the stars cannot distinguish. The stars determine how
        much the shapes vary over the field.
    start : GriddedMixturePSF, optional
        A known PSF, for example from an archive, or any object with a
        method ``mixture_at``. The fit then only adjusts it: it convolves
        it with a Gaussian and changes its wings and its asymmetry, with
        polynomials of position; ``n_components`` has no effect. Fifteen
        stars are enough.
    centre : {'core', 'flux', 'catalogue'}, optional
        The origin of the PSF, which defines the positions of stars. 'core'
        is the point about which the first moment vanishes under a Gaussian
        weight whose standard deviation is twice the full width at half
        maximum in the middle of the detector, if the stamps are large
        enough. 'flux' is the flux centroid, which changes from image to
        image with the noise of the wings. 'catalogue', with ``contexts``,
        is 'core' for the mean star; stars of other colours are shifted to
        agree with the positions in ``stars``, which must not depend on
        colour, as those of a catalogue. With ``start`` the origin is that
        of ``start``.
    normalise : {'auto', 'stamps', 'curve-of-growth'}, optional
        The definition of the total flux of a star: 'stamps' is the flux of
        the Gaussians fitted to the stamps; 'curve-of-growth' adds the
        light in rings beyond the stamps, up to three radii, and its
        extrapolation with the power law of the outer rings, as one wide
        Gaussian. By default this light is added if the rings of at least
        five stars show it significantly; a message of the level INFO says
        so. With ``start`` it is that of ``start``.
    pixel_integrated : 'auto' or bool, optional
        Whether the Gaussians describe the optics and are integrated over
        each pixel, or include the pixel and are sampled at its middle.
        Sampled Gaussians are faster; coarse pixels need integrated ones.
        By default PSFs with a full width at half maximum below 1.6 pixels
        are integrated. With ``start`` it is as in ``start``, whose optics
        can be sampled but not the reverse.
    correlated_noise : bool, optional
        Whether to measure on blank sky if the noise of neighbouring pixels
        is correlated, as in resampled images, and to increase the errors
        accordingly; a warning says so.
    contexts : sequence of str, optional
        Columns of ``stars``, such as ``('colour',)``, on which the shapes
        depend linearly, in addition to position. A star with an unknown
        value (masked or NaN) gets the mean of the others. Not with
        ``start``.
    brighter_fatter : bool or 'auto', optional
        Whether each unit of flux adds a covariance to all Gaussians,
        because charge repels charge. With 'auto' the field includes this
        only if it is significant, and a warning says so. It is off by
        default, because a misfit of the Gaussians may look the same.
        ``field.mixture_at(x, y)`` is then the PSF of faint stars; for
        other stars give their ``flux``. Not with ``start``.
    executor : `~concurrent.futures.Executor`, optional
        The executor that works on stars; by default a pool of threads.
    progress_bar : bool, optional
        Whether to show a bar with the current stage of the fit and the
        number of passes over the pixels of the stars.

    Returns
    -------
    MixtureField
        Or, with ``start``, a `TunedMixtureField`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid, shapes differ, or no star can be used.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from photutils_mgauss import GaussianMixture, fit_mixture_field
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> stars = Table({'x': [12.3, 40.1], 'y': [14.6, 33.9]})
    >>> data = sum(psf.render((50, 55), x, y, flux=1000) for x, y in stars)
    >>> field = fit_mixture_field(data, stars, error=np.ones((50, 55)),
    ...                           n_components=1, degree=0)
    >>> field.mixture_at(20, 20).covariances[0].round(3)
    array([[2. , 0.3],
           [0.3, 1.5]])
    """
    options = FieldOptions(
        n_components, degree, radius, local_bkg, effective_gain, reject,
        regularization, start, centre, normalise, pixel_integrated,
        correlated_noise, contexts, brighter_fatter)
    given = data, stars, error, mask
    how = {'executor': executor, 'progress_bar': progress_bar}
    with waiting('fit_mixture_field', progress_bar):
        field = field_of_stars(*given, options, **how)
        warn_of_lost(field, stacklevel=3)
        if options.start is None and isinstance(options.n_components, int):
            warn_of_few(field, lambda n: field_of_stars(*given, replace(
                options, n_components=n, degree=field.degree,
                normalise='stamps'), **how), stacklevel=3)
    return field


def field_of_stars(data, stars, error, mask, options, *, executor=None,
                   progress_bar=False):
    """
    Fit a field as `fit_mixture_field` does, whatever its Gaussians miss.

    Parameters
    ----------
    data, stars, error, mask
        As there.
    options : FieldOptions
    executor : `~concurrent.futures.Executor`, optional
    progress_bar : bool, optional

    Returns
    -------
    MixtureField or TunedMixtureField
    """
    given = data, stars, error, mask
    sample, radius = _read(given, options)
    if not options.local_bkg:
        warn_of_sky(sample)
    if options.correlated_noise:
        allow_for_correlation(sample)
    n_components, degree = options.size(sample.n_places)
    top = possible_degree(degree, sample)
    problem = sample.problem(top, options.local_bkg)
    with Workers(executor) as workers, progress(workers, progress_bar):
        if options.start is not None:
            return _tuned_field(problem, sample, radius, top, options,
                                workers)
        field = _free_field(problem, sample, radius, n_components, degree,
                            top, options, workers)
        if options.degree is None:
            field = _tamed(field, lambda lower: _free_field(
                sample.problem(lower, options.local_bkg), sample, radius,
                n_components, lower, lower, options, workers))
    if options.normalise == 'stamps':
        return field
    return _with_wings(field, sample, read_exposures(*given),
                       options.normalise)


def warn_of_lost(field, *, stacklevel):
    """Warn if so many stars of a list are not used that it may be wrong."""
    n_stars = np.count_nonzero(field.stars['used']) + len(field.dropped)
    reasons = [str(reason) for reason in field.dropped['reason']]
    if len(reasons) <= max(_LOST * n_stars, _FEWEST_LOST - 1):
        return
    counts = ', '.join(f'{reasons.count(reason)} {reason}'
                       for reason in sorted(set(reasons)))
    warnings.warn(
        f'{len(reasons)} of the {n_stars} stars given are not used ({counts}):'
        ' check that x and y are those of this image, and that error and mask '
        'are right', AstropyUserWarning, stacklevel=stacklevel)


def _read(given, options):
    """Return the sample and the radius of its stamps."""
    how = options.effective_gain, options.contexts
    if options.radius is not None:
        return read_sample(*given, options.radius, *how), options.radius
    sample = read_sample(*given, FIRST_RADIUS, *how)
    radius = own_radius(sample.stamps)
    if radius != FIRST_RADIUS:
        sample = read_sample(*given, radius, *how)
    return sample, radius


def _tuned_field(problem, sample, radius, degree, options, workers):
    """Return a known PSF as the stars change it."""
    problem.pixel_integrated = options.pixel_integrated
    fit = stages.tune(_known(problem, sample, options.start), degree, workers,
                      strength=options.regularization, reject=options.reject)
    return _tuned(fit, sample, options.start, radius, options.centre)


def _free_field(problem, sample, radius, n_components, degree, top, options,
                workers):
    """Return the field of a PSF of which nothing is known."""
    problem.pixel_integrated = chosen_pixel(
        problem, options.pixel_integrated, options.regularization, workers)
    fit, choice = _free(problem, n_components, degree, top, workers, options)
    fit, fatter = _fatter(fit, options.brighter_fatter, workers,
                          options.reject)
    return _result(fit, sample, radius, choice, options.centre, fatter)


def _tamed(field, refit):
    """Return a field of lower degree if one is wild where no star is."""
    widths = widths_beyond(field)
    if not is_wild(*widths):
        return field
    lower, left = field, widths
    while lower.degree > 1 and is_wild(*left):
        lower = refit(lower.degree // 2)
        left = widths_beyond(lower)
    better = (not is_wild(*left)
              and lower.accuracy <= max(field.accuracy, POOR))
    warnings.warn(
        f'far from all stars the PSF of degree {field.degree} is between '
        f'{widths[0]:.2g} times the smallest and {widths[1]:.2g} times the '
        'largest width that it has at a star; '
        + (f'degree {lower.degree} is taken, which describes the stars as well'
           if better else 'give a lower degree, such as 1, to measure there'),
        AstropyUserWarning, stacklevel=4)
    return lower if better else field


def _fatter(fit, wanted, workers, reject):
    """Return the fit, and how fluxes widen stars if it knows of that."""
    if wanted is False:
        return fit, None
    found = measure_fattening(fit, workers)
    if wanted is True and found is None:
        msg = ('brighter_fatter must be False for so few stars, or stars of '
               'one flux')
        raise ValueError(msg)
    if found is None or not (wanted is True or found.is_real):
        return fit, None
    # Nothing of it is shared.
    before = replace(fit, problem=fit.problem.subset(
        np.arange(len(fit.problem.basis))))
    for _ in range(_FATTER_STEPS):
        fit.fattening = found.value
        stages.polish(fit, workers, reject)
        # Stars that were dropped meanwhile may be too many to measure again.
        found = measure_fattening(fit, workers) or found
    if wanted == 'auto':
        if not found.is_real:
            # Once more stars count, or others, it may be gone.
            return before, None
        warnings.warn(
            'bright stars are wider than faint ones: the brightest by '
            f'{found.largest * (found.value[0] + found.value[2]) / 2:.4f} '
            f'pix^2 (chi^2 {found.significance:.0f} for 3 numbers); the PSF '
            'is that of faint stars, and brighter_fatter of the field says '
            'how others differ', AstropyUserWarning, stacklevel=5)
    return fit, found


def _with_wings(field, sample, exposures, normalise):
    """Return the field with the light beyond the stamps."""
    wings, why_not = measure_wings(
        (pixels for pixels, _ in exposures), sample.catalogues,
        stars_of_exposures(field, len(sample.reasons)),
        light_inside(field, *_middle(sample)), field.radius)
    if wings is None:
        if normalise != 'auto':
            msg = f"normalise='curve-of-growth' {why_not}"
            raise ValueError(msg)
        _LOG.info('the light beyond the stamps is not in the PSF: to measure '
                  'it %s', why_not)
        return field
    if normalise == 'auto' and not wings.is_seen:
        _LOG.info('stars show no light beyond their stamps, %.4f of the flux '
                  'at most: the PSF is that of the stamps',
                  wings.share + wings.error)
        return replace(field, wing_error=float(np.hypot(wings.share,
                                                        wings.error)))
    if wings.share == 0:
        warnings.warn(
            "normalise='curve-of-growth' found no light beyond the "
            f'stamps, {wings.error:.4f} of the flux at most; nothing was '
            'added', AstropyUserWarning, stacklevel=4)
    _LOG.info('%.4f +- %.4f of the light of stars is beyond their stamps; it '
              'is in the PSF as one wide Gaussian, and in fluxes',
              wings.share, wings.error)
    return with_light_beyond(field, wings)


def with_light_beyond(field, wings):
    """Return a field with the light of `Wings` in its PSF and its fluxes."""
    new = field.stars.copy()
    new['flux_fit'] = new['flux_fit'] / (1 - wings.share)
    return replace(field, stars=new, wing_share=wings.share,
                   wing_stddev=wings.stddev, wing_error=wings.error)


def _free(problem, n_components, degree, top, workers, options):
    """Return the fit, and the table of what was tried for it."""
    many = problem.n_places >= MANY_STARS
    few = degree == 'auto' and not many
    strength, reject = options.regularization, options.reject
    n_components, degree, choice = choose(
        problem, n_components, degree if degree == 'auto' else top, top,
        strength, workers)
    if options.n_components is None and many and not problem.pixel_integrated:
        fit = run_with_enough_components(problem, degree, workers,
                                         strength=strength, reject=reject)
    else:
        fit = stages.run(problem, n_components, degree, workers,
                         strength=strength, reject=reject)
    if few:
        fit = add_degrees(fit, problem.basis, degree, workers, reject=reject)
    if problem.pixel_integrated:
        _allow_for_misfit(fit, workers)
    return fit, choice


def _allow_for_misfit(fit, workers):
    """Set what the light in pixels is off by, and stars' numbers to it."""
    found = misfit(stages.with_errors(fit, 0.0, workers))
    plain = stages.with_errors(fit, found, workers)
    fit.accuracy = found
    fit.problem.sources, fit.problem.sky = (plain.problem.sources,
                                            plain.problem.sky)
    fit.equations = replace(fit.equations, chi2=plain.equations.chi2)


def _known(problem, sample, start):
    """Return the problem of the changes of a known PSF."""
    if not callable(getattr(start, 'mixture_at', None)):
        msg = (f'start must have a method mixture_at, as GriddedMixturePSF '
               f'has, got {type(start).__name__}')
        raise TypeError(msg)
    local = known_shapes(start, *sample.expected(),
                         problem.pixel_integrated)
    return replace(problem, form=TunedShapes(), local=local)


def _tuned(fit, sample, start, radius, centre):
    sample = sample.without_deviant(fit.problem.used)
    stddev = _centre_stddev(start.mixture_at(*_middle(sample)), radius, centre,
                            bool(getattr(start, 'pixel_integrated', False)))
    covariance, unmodelled = _errors(fit, sample)
    return TunedMixtureField(
        start, fit.coefficients, sample.shape, radius, covariance,
        star_table(fit, sample, stddev), residual_stars(fit), fit.accuracy,
        sample.dropped(), stddev, fit.problem.pixel_integrated, unmodelled)


def _errors(fit, sample):
    """Return the covariance of coefficients, and what is not modelled."""
    covariance, unmodelled = honest_covariance(fit)
    if fit.lack or any(sample.correlations):
        covariance = covariance + (noise_covariance(
            fit, sample.correlations, sample.growth) - plain_covariance(fit))
    return covariance, unmodelled


def _result(fit, sample, radius, choice, centre, fatter):
    sample = sample.without_deviant(fit.problem.used)
    covariance, unmodelled = _errors(fit, sample)
    n_terms = len(fit.coefficients) - fit.problem.n_extra
    field = MixtureField(
        fit.coefficients[:n_terms], sample.shape, radius, covariance, None,
        residual_stars(fit), fit.accuracy, sample.dropped(), choice,
        _exposure_table(fit, len(sample.reasons)),
        pixel_integrated=fit.problem.pixel_integrated, unmodelled=unmodelled,
        brighter_fatter=_fatter_table(fatter),
        **_context_parts(fit, sample, n_terms))
    middle = field.mixture_at(*_middle(sample))
    if not field.pixel_integrated:
        warn_of_phase(middle)
    stddev = _centre_stddev(middle, radius, centre, field.pixel_integrated)
    table = star_table(fit, sample, stddev)
    if centre == 'catalogue':
        field = _moved(field, table, fit, core_width(middle))
    return replace(field, stars=table, centre_stddev=stddev)


def _context_parts(fit, sample, n_terms):
    """Return what a field knows of contexts."""
    if sample.contexts is None:
        return {}
    found = fit.coefficients[n_terms:]
    found = found.reshape(len(sample.contexts.names), -1, *found.shape[1:])
    return {'contexts': sample.contexts.to_table(),
            'context_coefficients': found,
            'lateral_shifts': np.zeros((*found.shape[:2], 2))}


def _moved(field, table, fit, width):
    """
    Return the field whose light moves with contexts.

    The positions in the table of stars follow.
    """
    problem = fit.problem
    signal = np.sqrt(np.sum(problem.weights * model_stamps(
        problem, fit.coefficients) ** 2, axis=(1, 2)))
    # The error of a Gaussian's position, which is its width over signal to
    # noise.
    errors = width / gaussian_sigma_to_fwhm / np.maximum(signal, 1e-3)
    offsets = np.column_stack([table['x_fit'] - table['x'],
                               table['y_fit'] - table['y']])
    used = problem.used
    smooth = problem.basis[:, :len(field.coefficients)]
    found = lateral_shifts(offsets[used], errors[used], smooth[used],
                           problem.extra[used])
    for name, shift in zip(('x_fit', 'y_fit'), (problem.extra @ found).T,
                           strict=True):
        table[name] -= shift
    return replace(field, lateral_shifts=found.reshape(
        field.lateral_shifts.shape))


def _fatter_table(fatter):
    if fatter is None:
        return None
    errors = np.sqrt(np.diag(fatter.covariance))
    table = QTable()
    for name, value, error in zip(('xx', 'xy', 'yy'), fatter.value, errors,
                                  strict=True):
        table[name], table[f'{name}_err'] = [value], [error]
    table['significance'] = [fatter.significance]
    table['largest'] = [fatter.largest]
    return table


def _middle(sample):
    """Return the middle x, y of the detector."""
    return [(n - 1) / 2 for n in sample.shape[::-1]]


def _centre_stddev(mixture, radius, centre, integrated):
    """Return the size of the weight under which a PSF is centred."""
    if centre == 'flux':
        return np.inf
    if integrated:
        mixture = mixture.convolve(stages.PIXEL_VARIANCE * np.eye(2))
    width = core_width(mixture)
    return max(width, min(_CENTRE_SIZE * width, _CENTRE_SHARE * radius))


def _exposure_table(fit, n):
    if fit.blur_covariance is None:
        return None
    # The last exposures may have no star.
    blurs = np.pad(fit.blurs, ((0, n - len(fit.blurs)), (0, 0)))
    errors = np.full((n, 3), np.nan)
    errors[:len(fit.blurs)] = np.sqrt(np.diag(
        fit.blur_covariance)).reshape(3, -1).T
    table = QTable({'exposure': np.arange(n)})
    for name, value, error in zip(('xx', 'xy', 'yy'), blurs.T, errors.T,
                                  strict=True):
        table[name], table[f'{name}_err'] = value, error
    return table
