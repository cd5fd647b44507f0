"""
The fit of a PSF field to the pixels of the stars of one or more images.

Input is read and checked here, `photutils_mgauss.field.stages` does the
fitting, and what it found becomes the public results.
"""
from dataclasses import replace

import numpy as np
from astropy.table import QTable

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import (
    core_width,
    residual_stars,
    star_table,
)
from photutils_mgauss.field.choice import choose
from photutils_mgauss.field.covariance import honest_covariance
from photutils_mgauss.field.forms import TunedShapes
from photutils_mgauss.field.input import (
    allow_for_correlation,
    possible_degree,
    read_sample,
)
from photutils_mgauss.field.mixture_field import MixtureField
from photutils_mgauss.field.normal import Workers
from photutils_mgauss.field.pixel import chosen_pixel, warn_of_phase
from photutils_mgauss.field.tuned_field import TunedMixtureField, known_shapes
from photutils_mgauss.utils.validation import as_choice, as_integer, as_real

__all__ = ['fit_mixture_field']

# The degrees of the polynomials without and with a PSF to start from.
_DEGREE, _TUNED_DEGREE = 4, 1


def fit_mixture_field(data, stars, *, error=None, mask=None, n_components=6,
                      degree=None, radius=10, local_bkg=False,
                      effective_gain=None, reject=True, regularization=1.0,
                      start=None, centre='core', pixel_integrated='auto',
                      correlated_noise=True,
                      executor=None):
    """
    Fit a PSF field to the pixels of stars.

    The parameters of ``n_components`` Gaussians, as polynomials of detector
    position, are fitted by maximum likelihood to the pixels of all stars,
    together with the position and flux of each. Neighbours inside a star's
    stamp are fitted along. Deviant stars and pixels are dropped.

    Several exposures of one detector share a field if lists are given for
    ``data``, ``stars``, ``error`` and ``mask``; the PSF of each exposure is
    the field convolved with a Gaussian of its own.

    Parameters
    ----------
    data : (ny, nx) array_like or NDData, or list of those
        The image, its background subtracted. Its own mask counts, its unit
        comes back: see :ref:`pixels`.
    stars : `~astropy.table.Table` or list of those
        The stars: ``x``, ``y`` and, if known, ``flux``; photutils' names with
        ``_fit``, ``_init`` or ``_centroid`` are understood. If it has a
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
        The number K of Gaussians; 'auto' tries 2 to 7 and keeps the number
        that describes stars left out of the fit best.
    degree : int or 'auto', optional
        The degree of the polynomials, 0 for a PSF that is the same
        everywhere; by default 4, or 1 with ``start``. It is lowered, with a
        warning, if there are too few stars. 'auto' tries 0 to 5 in the same
        way. Terms that the stars do not ask for are shrunk, so that a degree
        that is too high costs time more than accuracy.
    radius : float, optional
        The radius of the circle of pixels that is fitted [pix].
    local_bkg : bool, optional
        Whether to fit a constant background to each star's stamp.
    effective_gain : float, optional
        Electrons per unit of ``data``. Where the error of a pixel contains
        the noise of its own light, as `photutils.utils.calc_total_error`
        makes it, that part is replaced by the expected noise of the model,
        which removes a bias of faint fluxes. By default this is found out
        from ``data`` and ``error``; infinity leaves the error as it is.
    reject : bool, optional
        Whether to drop deviant stars and pixels.
    regularization : float, optional
        The strength of the prior on the shapes, 1 for the default. It keeps
        Gaussians apart that the stars cannot tell from each other. How much
        the shapes vary over the field is learnt from the stars.
    start : GriddedMixturePSF, optional
        A PSF that is known already, as from an archive, or anything with a
        method ``mixture_at``. Only what the stars can tell of it is fitted:
        a Gaussian that it is convolved with, and a change of its wings and
        of its asymmetry, polynomials of position; ``n_components`` does not
        count then. Fifteen stars are enough.
    centre : {'core', 'flux'}, optional
        What is at the origin of the PSF, which is where positions of stars
        are: the point about which the first moment vanishes under a Gaussian
        weight as large as the core of the PSF, its standard deviation the
        full width at half maximum in the middle of the detector; or the flux
        centroid, which wanders from image to image with the noise of the
        wings. With ``start`` it stays where that of ``start`` is.
    pixel_integrated : 'auto' or bool, optional
        Whether the Gaussians are those of the optics, integrated over each
        pixel, or those of the PSF in pixels, sampled at the middle of each.
        Sampled ones are quicker; integrated ones are needed where the pixels
        are too coarse. By default the stars decide: PSFs narrower than 1.6
        pixels, full width at half maximum in the pixels, are integrated.
        With ``start`` it is as in ``start``, whose optics can be sampled but
        not the reverse.
    correlated_noise : bool, optional
        Whether to look, on blank sky, if the noise of neighbouring pixels is
        correlated, as in resampled images, and to take errors as larger for
        that; a warning says so.
    executor : `~concurrent.futures.Executor`, optional
        Where stars are worked on; by default a pool of threads.

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
    if degree is None:
        degree = _DEGREE if start is None else _TUNED_DEGREE
    n_components = _number(n_components, 'n_components', 1)
    degree = _number(degree, 'degree', 0)
    radius = as_real(radius, 'radius', minimum=2)
    options = {'strength': as_real(regularization, 'regularization', above=0),
               'reject': reject}
    as_choice(centre, 'centre', ('core', 'flux'))
    pixel_integrated = _pixel_integrated(pixel_integrated, start)
    sample = read_sample(data, stars, error, mask, radius, effective_gain)
    if correlated_noise:
        allow_for_correlation(sample)
    top = possible_degree(degree, len(sample.row))
    problem = sample.problem(top, local_bkg)
    with Workers(executor) as workers:
        if start is not None:
            problem.pixel_integrated = pixel_integrated
            fit = stages.tune(_known(problem, sample, start), top, workers,
                              **options)
            return _tuned(fit, sample, start, radius, centre)
        problem.pixel_integrated = chosen_pixel(
            problem, pixel_integrated, options['strength'], workers)
        fit, choice = _free(problem, n_components, degree, top, workers,
                            options)
    return _result(fit, sample, radius, choice, centre)


def _free(problem, n_components, degree, top, workers, options):
    """Return the fit, and the table of what was tried for it."""
    n_components, degree, choice = choose(
        problem, n_components, degree if degree == 'auto' else top, top,
        options['strength'], workers)
    problem.basis = np.ascontiguousarray(
        problem.basis[:, :stages.n_terms(degree)])
    return (stages.run(problem, n_components, degree, workers, **options),
            choice)


def _number(value, name, minimum):
    if isinstance(value, str) and value == 'auto':
        return value
    return as_integer(value, name, minimum=minimum)


def _pixel_integrated(value, start):
    """Return whether to integrate over pixels, or 'auto'."""
    if not isinstance(value, (bool, np.bool_)) and value != 'auto':
        msg = f"pixel_integrated must be 'auto', True or False, got {value!r}"
        raise ValueError(msg)
    if start is None:
        return value if isinstance(value, str) else bool(value)
    known = bool(getattr(start, 'pixel_integrated', False))
    if value is True and not known:
        msg = ('pixel_integrated must not be True where start is sampled: its '
               "mixtures contain the pixel already; leave it at 'auto'")
        raise ValueError(msg)
    return known if isinstance(value, str) else bool(value)


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
    stddev = _centre_stddev(start.mixture_at(*_middle(sample)), centre,
                            bool(getattr(start, 'pixel_integrated', False)))
    covariance, unmodelled = honest_covariance(fit)
    return TunedMixtureField(
        start, fit.coefficients, sample.shape, radius, covariance,
        star_table(fit, sample, stddev), residual_stars(fit), fit.accuracy,
        sample.dropped(), stddev, fit.problem.pixel_integrated, unmodelled)


def _result(fit, sample, radius, choice, centre):
    sample = sample.without_deviant(fit.problem.used)
    covariance, unmodelled = honest_covariance(fit)
    field = MixtureField(
        fit.coefficients, sample.shape, radius, covariance, None,
        residual_stars(fit), fit.accuracy, sample.dropped(), choice,
        _exposure_table(fit, len(sample.reasons)),
        pixel_integrated=fit.problem.pixel_integrated, unmodelled=unmodelled)
    middle = field.mixture_at(*_middle(sample))
    if not field.pixel_integrated:
        warn_of_phase(middle)
    stddev = _centre_stddev(middle, centre, field.pixel_integrated)
    return replace(field, stars=star_table(fit, sample, stddev),
                   centre_stddev=stddev)


def _middle(sample):
    """Return the middle x, y of the detector."""
    return [(n - 1) / 2 for n in sample.shape[::-1]]


def _centre_stddev(mixture, centre, integrated):
    """Return the size of the weight under which a PSF is centred."""
    if centre == 'flux':
        return np.inf
    if integrated:
        mixture = mixture.convolve(stages.PIXEL_VARIANCE * np.eye(2))
    return core_width(mixture)


def _exposure_table(fit, n):
    if fit.blur_matrix is None:
        return None
    # The last exposures may have no star.
    blurs = np.pad(fit.blurs, ((0, n - len(fit.blurs)), (0, 0)))
    errors = np.full((n, 3), np.nan)
    errors[:len(fit.blurs)] = np.sqrt(np.diag(np.linalg.inv(
        fit.blur_matrix))).reshape(3, -1).T
    table = QTable({'exposure': np.arange(n)})
    for name, value, error in zip(('xx', 'xy', 'yy'), blurs.T, errors.T,
                                  strict=True):
        table[name], table[f'{name}_err'] = value, error
    return table
