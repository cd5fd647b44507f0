r"""
Least-squares fits of Gaussian mixtures to PSF images (Nie et al., Sec. 2.2).

The image is a PSF sampled at pixel centres: pixel (i, j) holds the flux
density per native pixel at :math:`((i - x_o) / s_x, (j - y_o) / s_y)` from
the star, with :math:`(x_o, y_o)` the origin and s the oversampling. So the
pixels of a PSF of unit flux sum to :math:`s_x s_y`, as in photutils.
"""
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial
from html import escape

import numpy as np

from photutils_mgauss.fitting.search import (
    Equations,
    Stamp,
    StampProblem,
    covariance_of,
    mixture_of,
    narrow_first,
    refine_phases,
    run,
    search,
    stamp_shapes,
    workspace,
)
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.image import check_errors, read_stack, with_unit
from photutils_mgauss.utils.notebook import with_picture
from photutils_mgauss.utils.parallel import map_chunks
from photutils_mgauss.utils.validation import (
    as_choice,
    as_floats,
    as_integer,
    as_real,
    as_shape,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['FitStatus', 'MixtureFit', 'fit_mixture']


# Stamps that a thread takes at a time.
_LARGEST_CHUNK = 64


class FitStatus(IntEnum):
    """
    How a fit ended; ``sentence`` says it in words.

    Examples
    --------
    >>> from photutils_mgauss import FitStatus
    >>> FitStatus.EMPTY.sentence
    'There is no positive flux in the pixels used, so nothing to fit.'
    >>> [status.name for status in FitStatus if status.usable]
    ['CONVERGED', 'STOPPED', 'VANISHED', 'AT_LIMIT']
    """

    CONVERGED = 0
    STOPPED = 1
    VANISHED = 2
    AT_LIMIT = 3
    EMPTY = 4
    NOT_FINITE = 5
    TOO_FEW_PIXELS = 6
    NO_STAR = 7

    @property
    def sentence(self):
        """The status in words, with what can be done."""
        return _SENTENCES[self]

    @property
    def usable(self):
        """Whether there is a mixture."""
        return self < FitStatus.EMPTY


_SENTENCES = {
    FitStatus.CONVERGED: 'The fit converged.',
    FitStatus.STOPPED:
        'The fit was still improving at the last allowed step; its result is '
        'usable, fewer Gaussians would converge sooner.',
    FitStatus.VANISHED:
        'The fit converged with at least one Gaussian of no flux; fewer '
        'Gaussians describe the image as well.',
    FitStatus.AT_LIMIT:
        'The fit converged with a Gaussian as narrow as the pixels or as wide '
        'as the stamp allow; fewer Gaussians or a larger stamp may help.',
    FitStatus.EMPTY:
        'There is no positive flux in the pixels used, so nothing to fit.',
    FitStatus.NOT_FINITE:
        'Pixels that are not masked are NaN or infinite; mask them.',
    FitStatus.TOO_FEW_PIXELS:
        'Fewer pixels are usable than the Gaussians have parameters; use a '
        'larger stamp or radius, or fewer Gaussians.',
    FitStatus.NO_STAR:
        'The pixels are more negative than positive, or show no star above '
        'their noise; positive light is needed (negate the image of a '
        'negative star).',
}


@dataclass(frozen=True, eq=False, repr=False)
class MixtureFit(ComparedByValue):
    """
    The result of `fit_mixture` for one image.

    If ``status`` is not usable, ``mixture`` is None and numbers are NaN.

    Attributes
    ----------
    mixture : GaussianMixture or None
        The PSF, of unit flux, in native pixels; narrow Gaussians first.
    status : FitStatus
        How the fit ended; 0 is good.
    message : str
        The status in words.
    flux : float or `~astropy.units.Quantity`
        The total flux of the mixture in the image, its pixels being flux
        densities per native pixel.
    chi2 : float
        The sum of squared residuals over the pixels used, each divided by
        its error where errors were given.
    bic : float
        The Bayesian information criterion, ``chi2 + p ln n`` with errors and
        ``n ln(chi2 / n) + p ln n`` without, for p parameters and n pixels.
    enclosed_flux : float
        The fraction of the mixture's flux inside the pixels used.
    residual : (ny, nx) `~numpy.ndarray` or `~astropy.units.Quantity`
        Image minus model, also outside the pixels used.
    covariance : (6K, 6K) `~numpy.ndarray`
        The covariance of flux, x_mean, y_mean, x_stddev, y_stddev and rho
        of each Gaussian in turn, in the image's flux unit and native
        pixels. Without errors it is scaled by chi2 over the degrees of
        freedom. NaN for a Gaussian without flux.
    used : (ny, nx) `~numpy.ndarray` of bool
        The pixels that were used.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, fit_mixture
    >>> psf = GaussianMixture([1], [[0.1, 0]], [[[2, 0], [0, 1.5]]])
    >>> fit = fit_mixture(psf.render((15, 15), 7, 7, flux=20), 1)
    >>> fit.status.name, fit.flux
    ('CONVERGED', 20.0)
    >>> fit.mixture.means
    array([[0.1, 0. ]])
    >>> fit.residual.shape, fit.covariance.shape, bool(fit.used.all())
    ((15, 15), (6, 6), True)
    """

    mixture: GaussianMixture
    status: FitStatus
    message: str
    flux: float
    chi2: float
    bic: float
    enclosed_flux: float
    residual: np.ndarray
    covariance: np.ndarray
    used: np.ndarray

    def __repr__(self):
        n = self.mixture.n_components if self.mixture else 0
        return (f'<MixtureFit of {n} Gaussians, flux {self.flux:.6g}, chi2 '
                f'{self.chi2:.6g}: {self.message}>')

    def _repr_html_(self):
        if self.mixture is None:
            return f'<p><code>{escape(repr(self))}</code></p>'
        return with_picture(repr(self), lambda ax: self.plot(ax=ax))

    def plot(self, *, ax=None):
        """
        Show the residual image as a fraction of the model's peak.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        ValueError
            If there is no mixture.
        """
        from photutils_mgauss.plotting.fit import plot_residual
        if self.mixture is None:
            msg = f'a fit without a mixture cannot be drawn: {self.message}'
            raise ValueError(msg)
        return plot_residual(self, ax=ax)


def fit_with_unit(fit, unit):
    """Return a fit with flux and residual in the unit of its image or None."""
    if unit is None:
        return fit
    return replace(fit, flux=with_unit(fit.flux, unit),
                   residual=with_unit(fit.residual, unit))


def fit_mixture(image, n_components=3, *, oversampling=1, origin=None,
                error=None, mask=None, radius=None, enclosed_flux=None,
                normalize='free', signed=False, means='free',
                weighting='uniform', start=None, executor=None):
    r"""
    Fit a Gaussian mixture to the image of a PSF, or to each of a stack.

    Minimises

    .. math::

        \chi^2 = \sum_{ij} \frac{1}{\sigma_{ij}^2} \left[ I_{ij} - F\,
        P\left(\frac{i - x_o}{s_x}, \frac{j - y_o}{s_y}\right) \right]^2

    over the total flux F and the weights, means and covariances of the
    mixture P (Eqs. 2-3 of Nie et al.).

    Parameters
    ----------
    image : (ny, nx) or (n, ny, nx) array_like or NDData
        The PSF sampled at pixel centres. If it includes the pixel, the
        mixture will include it too. Negative wings are normal and not
        clipped. Its own mask counts, its unit comes back: see
        :ref:`pixels`.
    n_components : int, optional
        The number K of Gaussians.
    oversampling : int or (y, x) tuple of int, optional
        Image pixels per native pixel.
    origin : (x, y) array_like, optional
        The image pixel that is the origin of the means. None is the middle,
        (n - 1) / 2.
    error : float or array_like, optional
        The standard deviation of the pixels in the unit of ``image``,
        broadcast to it; positive where pixels are not masked. None gives all
        pixels the same weight.
    mask : array_like of bool, optional
        True for pixels to leave out, broadcast to the image. Masks of
        ``image`` and ``error`` count, too.
    radius : float, optional
        Use only pixels with centres within this distance [native pix] of the
        image's peak, which is found to a fraction of a pixel.
    enclosed_flux : float, optional
        Use only the circle about the peak that holds this fraction of the
        image's flux (the paper: 0.98).
    normalize : {'free', 'tied'}, optional
        Whether the total flux is fitted, or tied to the sum of the pixels
        used. If it is tied, the light of the wings beyond the stamp is
        forced into it.
    signed : bool, optional
        Whether weights may be negative.
    means : {'free', 'fixed'}, optional
        Whether each Gaussian has its own mean, or all are at the origin.
    weighting : {'uniform', 'astrometric', 'photometric'}, optional
        Whether the fit minimises only the residual, or also the
        pixel-phase errors that it causes for noise-free stars at many
        pixel phases: with 'astrometric' those of positions in stamps of 5
        x 5 and 7 x 7 native pixels, with 'photometric' those of fluxes in
        5 x 5 pixels. These errors are linear in the residual and are added
        to the sum of squares. Both need an oversampling of 2 or more.
    start : GaussianMixture or sequence of them, optional
        The starting point, one mixture of K Gaussians for all images or
        one for each, such as the fit of a neighbour. With None the
        function tries several starting points.
    executor : `~concurrent.futures.Executor`, optional
        The executor that fits a stack. None is a pool of threads on all
        cores.

    Returns
    -------
    MixtureFit or list of MixtureFit
        A list for a stack.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If an argument is not valid. For a single image also if it cannot
        be fitted: it is empty, has NaN in unmasked pixels, or has fewer
        pixels than parameters. In a stack such an image gets a status
        instead, and the others are still fitted.

    Notes
    -----
    The parameters of each Gaussian are its mean and the Cholesky factor of
    its precision matrix, so that every step is a valid mixture; fluxes are
    solved for exactly at each step. Standard deviations are kept above 0.4
    image pixels (also above a quarter of a native pixel with the weighting
    'photometric') and below the size of the stamp, and means on the stamp,
    by a penalty that is zero inside these limits.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, fit_mixture
    >>> truth = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
    ...                         [[[1, 0.1], [0.1, 1]], [[4, 0], [0, 5]]])
    >>> fit = fit_mixture(truth.render((21, 21), 10, 10, flux=50), 2)
    >>> fit.message
    'The fit converged.'
    >>> fit.flux
    50.0
    >>> fit.mixture.weights
    array([0.8, 0.2])
    """
    pixels, single = read_stack(image, error, mask)
    images = pixels.data
    problem = StampProblem(
        n_components=as_integer(n_components, 'n_components', minimum=1),
        oversampling=as_shape(oversampling, 'oversampling'),
        origin=_as_origin(origin, images.shape[1:]),
        radius=_optional(radius, 'radius', above=0),
        enclosed_flux=_optional(enclosed_flux, 'enclosed_flux', above=0,
                                maximum=1),
        tied=as_choice(normalize, 'normalize', ('free', 'tied')) == 'tied',
        signed=bool(signed),
        fixed=as_choice(means, 'means', ('free', 'fixed')) == 'fixed',
        weighting=_as_weighting(weighting, oversampling),
        has_error=pixels.error is not None)
    weights = _as_weights(pixels)
    starts = _as_starts(start, len(images), problem)
    with waiting('fit_mixture'):
        fits = map_chunks(partial(_fit_stack, problem),
                          (images, weights, starts), executor,
                          most=_LARGEST_CHUNK)
    fits = [fit_with_unit(fit, pixels.unit) for fit in fits]
    if not single:
        return fits
    if not fits[0].status.usable:
        msg = f'image cannot be fitted. {fits[0].message}'
        raise ValueError(msg)
    return fits[0]


# Checks of arguments.

def _optional(value, name, **limits):
    return None if value is None else as_real(value, name, **limits)


def _as_weighting(weighting, oversampling):
    choice = as_choice(weighting, 'weighting',
                       ('uniform', 'astrometric', 'photometric'))
    if choice != 'uniform' and np.min(oversampling) < 2:
        msg = (f'oversampling must be at least 2 with weighting={choice!r}, '
               f'got {oversampling}')
        raise ValueError(msg)
    return choice


def _as_origin(origin, shape):
    if origin is None:
        return (np.array(shape[::-1], float) - 1) / 2
    return as_floats(origin, 'origin', shape=(2,))


def _as_weights(pixels):
    """Return the weights (n, ny, nx), 0 for pixels that are masked."""
    if pixels.error is None and pixels.mask is None:
        return np.broadcast_to(1.0, pixels.shape)  # one number in memory
    used = (np.broadcast_to(True, pixels.shape) if pixels.mask is None
            else ~pixels.mask)
    if pixels.error is None:
        return used.astype(float)
    check_errors(pixels.error, used)
    return np.where(used, 1 / np.where(used, pixels.error, 1.0) ** 2, 0.0)


def _as_starts(start, n, problem):
    """Return an object array (n,) of mixtures or None."""
    several = not (start is None or isinstance(start, GaussianMixture))
    starts = list(start) if several else [start] * n
    if len(starts) != n:
        msg = f'start must have one mixture for each of {n}, got {len(starts)}'
        raise ValueError(msg)
    for mixture in starts if several else starts[:1]:
        if mixture is None:
            continue
        if not isinstance(mixture, GaussianMixture):
            msg = f'start must be a GaussianMixture, got {mixture!r:.80}'
            raise TypeError(msg)
        if mixture.n_components != problem.n_components:
            msg = (f'start must have {problem.n_components} Gaussians, got '
                   f'{mixture.n_components}')
            raise ValueError(msg)
    array = np.empty(n, object)
    array[:] = starts
    return array


# The fit of one stamp.

def _fit_stack(problem, images, weights, starts):
    shape = images.shape[1:]
    if problem.n_parameters > images[0].size:
        return [_failure(FitStatus.TOO_FEW_PIXELS, image) for image in images]
    spaces = [workspace(k, shape) for k in range(problem.n_components + 1)]
    return [_fit_image(problem, spaces, *item)
            for item in zip(images, weights, starts, strict=True)]


def _fit_image(problem, spaces, image, weight, start):
    status, weight, peak = _select(problem, image, weight)
    if status is not None:
        return _failure(status, image)
    stamp = Stamp.prepare(image, weight, peak, problem)
    if start is None:
        solution = search(stamp, problem, spaces)
    else:
        solution = run(stamp, problem, spaces,
                       stamp_shapes(start, problem, stamp.centre))
    if problem.weighting != 'uniform' and solution.has_flux:
        solution = refine_phases(stamp, problem, spaces, solution)
    if not solution.has_flux:
        return _failure(FitStatus.EMPTY, image)
    solution = narrow_first(solution)
    return _report(problem, stamp, image, solution,
                   Equations.at(solution, stamp, problem, spaces))


def _failure(status, image):
    nan = float('nan')
    return MixtureFit(None, status, status.sentence, nan, nan, nan, nan,
                      np.full(image.shape, nan), None, None)


def _select(problem, image, weight):
    """Return the status if it is hopeless, the weights cut, and the peak."""
    used = weight > 0
    if not used.any():
        return FitStatus.TOO_FEW_PIXELS, None, None
    if not np.isfinite(image[used]).all():
        return FitStatus.NOT_FINITE, None, None
    pixels = np.where(used, image, 0.0)
    if not pixels.max() > 0:
        return FitStatus.EMPTY, None, None
    peak = _find_peak(pixels)
    if problem.radius is not None or problem.enclosed_flux is not None:
        weight = weight * _inside(problem, pixels, peak)
        used = weight > 0
    if np.count_nonzero(used) < problem.n_parameters:
        return FitStatus.TOO_FEW_PIXELS, None, None
    if problem.tied and not pixels[used].sum() > 0:
        return FitStatus.EMPTY, None, None
    return None, weight, peak


def _find_peak(pixels):
    """
    Return the position (x, y) of the peak.

    The brightest pixel, moved by the parabola through it and its neighbours
    along each axis, by half a pixel at most.
    """
    j, i = np.unravel_index(pixels.argmax(), pixels.shape)
    return np.array([i + _vertex(pixels[j], i), j + _vertex(pixels[:, i], j)])


def _vertex(row, i):
    if not 0 < i < row.size - 1:
        return 0.0
    curvature = row[i - 1] - 2 * row[i] + row[i + 1]
    if not curvature < 0:
        return 0.0
    return float(np.clip((row[i - 1] - row[i + 1]) / (2 * curvature),
                         -0.5, 0.5))


def _inside(problem, pixels, peak):
    """Return which pixels are inside the circle asked for, (ny, nx)."""
    y, x = np.indices(pixels.shape)
    pitch = problem.pitch
    distance = np.hypot((x - peak[0]) / pitch[0], (y - peak[1]) / pitch[1])
    radius = np.inf if problem.radius is None else problem.radius
    if problem.enclosed_flux is not None:
        order = np.argsort(distance, axis=None, kind='stable')
        inside = np.cumsum(pixels.ravel()[order])
        enough = inside >= problem.enclosed_flux * inside[-1]
        radius = min(radius, distance.ravel()[order][enough.argmax()])
    return distance <= radius


# From the solution to the result.

def _report(problem, stamp, image, solution, equations):
    """Return the MixtureFit of a solution, narrow Gaussians first."""
    area = np.prod(problem.pitch)
    total = stamp.tie[0] if problem.tied else solution.fluxes.sum()
    mixture = mixture_of(solution, problem, stamp.centre)
    model = np.tensordot(mixture.weights, equations.images, 1)
    model = model[:, :image.shape[1]]
    residual = image - stamp.scale * total * model
    weight = stamp.weight[:, :image.shape[1]]
    used = weight > 0
    n = np.count_nonzero(used)
    weight = weight[used] * stamp.weight_unit
    chi2 = float((weight * residual[used] ** 2).sum())
    if _is_noise((weight * image[used] ** 2).sum(), chi2, n, problem):
        return _failure(FitStatus.NO_STAR, image)
    covariance = covariance_of(problem, stamp, solution, equations)
    if not problem.has_error:
        covariance *= chi2 / max(n - problem.n_parameters, 1)
    status = _judge(solution, equations.price)
    return MixtureFit(
        mixture, status, status.sentence, float(stamp.scale * total / area),
        chi2, _bic(chi2, n, problem), float(model[used].sum()), residual,
        covariance, used)


def _is_noise(power, chi2, n, problem):
    """
    Return whether a model takes no more from n pixels than from noise.

    Of white noise the best of all places and shapes takes about this many
    times the variance, which is that of the residual: a negative star is
    there, too.
    """
    p = problem.n_parameters
    variance = chi2 / max(n - p, 1)
    return power - chi2 < (2 * p + 4 * np.log(n)) * variance


def _judge(solution, price):
    """Return the status of a solution."""
    if (solution.fluxes == 0).any():
        return FitStatus.VANISHED
    if solution.stopped:
        return FitStatus.STOPPED
    return FitStatus.AT_LIMIT if price > 0 else FitStatus.CONVERGED


def _bic(chi2, n, problem):
    size = problem.n_parameters * np.log(n)
    if problem.has_error:
        return float(chi2 + size)
    return float(n * np.log(max(chi2, np.finfo(float).tiny) / n) + size)


