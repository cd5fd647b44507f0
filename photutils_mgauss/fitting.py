r"""
Least-squares fits of Gaussian mixtures to PSF images (Nie et al., Sec. 2.2).

The image is a PSF sampled at pixel centres: pixel (i, j) holds the flux
density per native pixel at :math:`((i - x_o) / s_x, (j - y_o) / s_y)` from
the star, with :math:`(x_o, y_o)` the origin and s the oversampling. So the
pixels of a PSF of unit flux sum to :math:`s_x s_y`, as in photutils.
"""
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import numpy as np

from photutils_mgauss import _kernels
from photutils_mgauss._parallel import map_chunks
from photutils_mgauss._validation import (
    as_choice,
    as_floats,
    as_integer,
    as_real,
    as_shape,
)
from photutils_mgauss.mixture import GaussianMixture

__all__ = ['FitStatus', 'MixtureFit', 'fit_mixture']

_TOLERANCE = 1e-8
_MAX_STEPS = 500
# How many steps every start gets before the best one goes on alone.
_FIRST_STEPS = 15
# A Gaussian narrower than this in stamp pixels falls between the pixel
# centres and can take any flux.
_MIN_STDDEV = 0.4
# How firmly the total flux is tied and limits are kept, in units of the
# power of the image.
_TIE = 1e6
_STIFFNESS = 1.0


class FitStatus(IntEnum):
    """How a fit ended; `sentence` says it in words."""

    CONVERGED = 0
    STOPPED = 1
    VANISHED = 2
    AT_LIMIT = 3
    EMPTY = 4
    NOT_FINITE = 5
    TOO_FEW_PIXELS = 6

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
}


@dataclass(frozen=True, eq=False, repr=False)
class MixtureFit:
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
    flux : float
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
    residual : (ny, nx) `~numpy.ndarray`
        Image minus model, also outside the pixels used.
    covariance : (6K, 6K) `~numpy.ndarray`
        Of flux, x_mean, y_mean, x_stddev, y_stddev and rho of each Gaussian
        in turn, in the image's flux unit and native pixels. Without errors
        it is scaled by chi2 over the degrees of freedom. NaN for a Gaussian
        without flux.
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

    def __repr__(self):
        n = self.mixture.n_components if self.mixture else 0
        return (f'<MixtureFit of {n} Gaussians, flux {self.flux:.6g}, chi2 '
                f'{self.chi2:.6g}: {self.message}>')


def fit_mixture(image, n_components=3, *, oversampling=1, origin=None,
                error=None, mask=None, radius=None, enclosed_flux=None,
                normalize='free', signed=False, means='free', start=None,
                executor=None):
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
    image : (ny, nx) or (n, ny, nx) array_like
        The PSF sampled at pixel centres; it contains the pixel or not as the
        mixture will. Negative wings are normal and not clipped.
    n_components : int, optional
        The number K of Gaussians.
    oversampling : int or (y, x) tuple of int, optional
        Image pixels per native pixel.
    origin : (x, y) array_like, optional
        The image pixel that is the origin of the means. None is the middle,
        (n - 1) / 2.
    error : float or array_like, optional
        The standard deviation of the pixels, broadcast to the image. None
        gives all pixels the same weight.
    mask : array_like of bool, optional
        True for pixels to leave out, broadcast to the image.
    radius : float, optional
        Use only pixels with centres within this distance [native pix] of the
        image's peak, which is found to a fraction of a pixel.
    enclosed_flux : float, optional
        Use only the circle about the peak that holds this fraction of the
        image's flux (the paper: 0.98).
    normalize : {'free', 'tied'}, optional
        Whether the total flux is fitted, or tied to the sum of the pixels
        used. Tied, the light of the wings beyond the stamp is squeezed into
        it.
    signed : bool, optional
        Whether weights may be negative.
    means : {'free', 'fixed'}, optional
        Whether each Gaussian has its own mean, or all are at the origin.
    start : GaussianMixture or sequence of them, optional
        Where to start, one mixture of K Gaussians for all images or one for
        each, such as the fit of a neighbour. None tries several starts of
        its own.
    executor : `~concurrent.futures.Executor`, optional
        Where to fit a stack. None is a pool of threads on all cores.

    Returns
    -------
    MixtureFit or list of MixtureFit
        A list for a stack.

    Raises
    ------
    TypeError
        If an argument has the wrong type.
    ValueError
        If an argument is not valid. For a single image also if it cannot be
        fitted: it is empty, or NaN in pixels that are not masked, or has
        fewer pixels than parameters. In a stack such an image gets a status
        instead and the others are not affected.

    Notes
    -----
    The parameters of each Gaussian are its mean and the Cholesky factor of
    its precision matrix, so that every step is a valid mixture; fluxes are
    solved for exactly at each step. Standard deviations are kept above 0.4
    image pixels and below the size of the stamp, and means on the stamp, by a
    price that is zero inside these limits.

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
    images = as_floats(image, 'image', finite=False)
    if images.ndim not in (2, 3):
        msg = ('image must have shape (ny, nx) or (n, ny, nx), got '
               f'{images.shape}')
        raise ValueError(msg)
    single = images.ndim == 2
    images = images.reshape(-1, *images.shape[-2:])
    problem = _Problem(
        n_components=as_integer(n_components, 'n_components', minimum=1),
        oversampling=as_shape(oversampling, 'oversampling'),
        origin=_as_origin(origin, images.shape[1:]),
        radius=_optional(radius, 'radius', above=0),
        enclosed_flux=_optional(enclosed_flux, 'enclosed_flux', above=0,
                                maximum=1),
        tied=as_choice(normalize, 'normalize', ('free', 'tied')) == 'tied',
        signed=bool(signed),
        fixed=as_choice(means, 'means', ('free', 'fixed')) == 'fixed',
        has_error=error is not None)
    weights = _as_weights(error, mask, images.shape)
    starts = _as_starts(start, len(images), problem)
    fits = map_chunks(partial(_fit_stack, problem),
                      (images, weights, starts), executor)
    if not single:
        return fits
    if not fits[0].status.usable:
        msg = f'image cannot be fitted. {fits[0].message}'
        raise ValueError(msg)
    return fits[0]


# Checks of arguments.

class _Problem(NamedTuple):
    """What is asked of every image of a stack."""

    n_components: int
    oversampling: tuple
    origin: np.ndarray
    radius: float | None
    enclosed_flux: float | None
    tied: bool
    signed: bool
    fixed: bool
    has_error: bool

    @property
    def pitch(self):
        """Image pixels per native pixel along (x, y)."""
        return np.array(self.oversampling[::-1], float)

    @property
    def n_parameters(self):
        per_gaussian = 4 if self.fixed else 6
        return self.n_components * per_gaussian - self.tied


def _optional(value, name, **limits):
    return None if value is None else as_real(value, name, **limits)


def _as_origin(origin, shape):
    if origin is None:
        return (np.array(shape[::-1], float) - 1) / 2
    return as_floats(origin, 'origin', shape=(2,))


def _as_weights(error, mask, shape):
    """Return the weights (n, ny, nx), 0 for pixels that are masked."""
    used = np.broadcast_to(True, shape)
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype != bool:
            msg = f'mask must be an array of bool, got dtype {mask.dtype}'
            raise TypeError(msg)
        used = ~_broadcast(mask, 'mask', shape)
    if error is None:
        return used.astype(float)
    error = _broadcast(as_floats(error, 'error', finite=False), 'error', shape)
    bad = used & ~((error > 0) & np.isfinite(error))
    if bad.any():
        msg = (f'error must be positive and finite, got {error[bad][0]}; mask '
               'pixels that must not be used')
        raise ValueError(msg)
    return np.where(used, 1 / np.where(used, error, 1.0) ** 2, 0.0)


def _broadcast(array, name, shape):
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        msg = (f'{name} must broadcast to the shape {shape[1:]} of an image, '
               f'got {array.shape}')
        raise ValueError(msg) from None


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

class Workspace:
    """
    The memory in which kernels fit K Gaussians to stamps of one shape.

    Parameters
    ----------
    n_components : int
        The number K of Gaussians.
    shape : (ny, nx) tuple of int
        The shape of the stamps.
    """

    def __init__(self, n_components, shape):
        k, n = n_components, 6 * n_components
        self.scratch = (
            np.empty((k, *shape)), np.empty(shape), np.empty((k, k)),
            np.empty(k), np.empty((k, k + 1)), np.empty(k, bool),
            np.empty((k, 6, 6)), np.empty((5, 5)), np.empty(6),
            np.empty((6, 6)))
        self.matrices = np.empty((n, n)), np.empty((n, n))
        self.vectors = (np.empty(n), np.empty(n), np.empty((k, 5)),
                        np.empty(k))


class _Stamp(NamedTuple):
    """
    One image, scaled for the kernels.

    ``pixels`` have a peak of 1 and ``weight`` makes their power 1: pixel
    unit ``scale`` and weight unit ``weight_unit``. ``tie`` and ``limits`` are
    the kernels'.
    """

    pixels: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    tie: tuple
    limits: np.ndarray
    scale: float
    weight_unit: float

    @classmethod
    def prepare(cls, image, weight, peak, problem):
        used = weight > 0
        pixels = np.where(used, image, 0.0)
        scale = pixels.max()
        pixels /= scale
        weight_unit = (weight * pixels**2).sum()
        centre = problem.origin if problem.fixed else np.rint(peak)
        total = pixels.sum()
        tie = (total, _TIE / total**2) if problem.tied else (0.0, 0.0)
        reach = _reach(used, centre)
        limits = np.array([np.log(_MIN_STDDEV), np.log(reach.max()), *reach,
                           _STIFFNESS])
        return cls(pixels, weight / weight_unit, centre, tie, limits, scale,
                   weight_unit)


def _reach(used, centre):
    """Return how far used pixels are from the centre along x and y."""
    j, i = np.nonzero(used)
    return np.array([np.abs(i - centre[0]).max() + 1,
                     np.abs(j - centre[1]).max() + 1])


def _fit_stack(problem, images, weights, starts):
    shape = images.shape[1:]
    spaces = {k: Workspace(k, shape) for k in {1, problem.n_components}}
    return [_fit_image(problem, spaces, *item)
            for item in zip(images, weights, starts, strict=True)]


def _fit_image(problem, spaces, image, weight, start):
    status, weight, peak = _select(problem, image, weight)
    if status is not None:
        return _failure(status, image)
    stamp = _Stamp.prepare(image, weight, peak, problem)
    if start is None:
        shapes = _search(stamp, problem, spaces)
    else:
        shapes = _shapes_of(start, problem, stamp.centre)
    solution = _run(stamp, problem, spaces, shapes, _MAX_STEPS)
    if not solution.fluxes.sum() > 0:
        return _failure(FitStatus.EMPTY, image)
    return _report(problem, stamp, image, _sorted(solution),
                   spaces[problem.n_components])


def _failure(status, image):
    nan = float('nan')
    return MixtureFit(None, status, status.sentence, nan, nan, nan, nan,
                      np.full(image.shape, nan), None)


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


class _Solution(NamedTuple):
    """The kernels' answer, in stamp pixels."""

    shapes: np.ndarray
    fluxes: np.ndarray
    cost: float
    stopped: bool


def _run(stamp, problem, spaces, shapes, max_steps):
    """Return what Levenberg-Marquardt makes of a start (K, 5)."""
    shapes = shapes.copy()
    fluxes = np.empty(len(shapes))
    space = spaces[len(shapes)]
    cost, status, _ = _kernels.fit_shapes(
        stamp.pixels, stamp.weight, stamp.centre, shapes, fluxes, stamp.tie,
        problem.signed, problem.fixed, stamp.limits, _TOLERANCE, max_steps,
        space.scratch, space.matrices, space.vectors)
    return _Solution(shapes, fluxes, cost, status == _kernels.FIT_STOPPED)


# Starts.

def _search(stamp, problem, spaces):
    """Return the shapes of the best of several short fits."""
    first = _run(stamp, problem, spaces, _core(stamp, problem), _MAX_STEPS)
    if problem.n_components == 1:
        return first.shapes
    trials = [_run(stamp, problem, spaces, _dress(start, first.shapes[0],
                                                  problem.fixed),
                   _FIRST_STEPS)
              for start in _templates(problem.n_components)]
    return min(trials, key=lambda trial: trial.cost).shapes


def _core(stamp, problem):
    """Return a round Gaussian with the peak's position and half-width."""
    above = np.count_nonzero(stamp.pixels > 0.5)
    stddev = max(np.sqrt(above / np.pi / (2 * np.log(2))), _MIN_STDDEV)
    mean = np.zeros(2)
    if not problem.fixed:
        mean = _find_peak(stamp.pixels) - stamp.centre
    return np.array([[*mean, -np.log(stddev), 0, -np.log(stddev)]])


def _templates(n):
    """
    Yield starts (n, 5) relative to the Gaussian fitted alone.

    Widths are in geometric progression between several pairs of limits, means
    are on a small spiral so that no two Gaussians are alike.
    """
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    for narrow, wide, offset in ((0.8, 3.0, 0.1), (0.7, 6.0, 0.1),
                                 (0.6, 1.8, 0.3), (0.9, 2.0, 0.8)):
        widths = np.geomspace(narrow, wide, n)
        yield np.column_stack([offset * np.cos(angle), offset * np.sin(angle),
                               -np.log(widths), np.zeros(n), -np.log(widths)])


def _dress(template, core, fixed):
    """Return a start in the frame in which the core is a unit circle."""
    x, y, log_l, t, log_m = core
    length, m = np.exp(log_l), np.exp(log_m)
    dx, dy, log_a, shear, log_b = template.T
    dy = dy / m
    dx = (dx - t * dy) / length
    if fixed:
        dx = dy = np.zeros(len(template))
    return np.column_stack([x + dx, y + dy, log_a + log_l,
                            np.exp(log_a) * t + shear * m, log_b + log_m])


def _shapes_of(mixture, problem, centre):
    """Return the shapes (K, 5) of a mixture in stamp pixels."""
    pitch = problem.pitch
    means = mixture.means * pitch + problem.origin - centre
    if problem.fixed:
        means = np.zeros_like(means)
    covariances = mixture.covariances * pitch * pitch[:, None]
    sxx, sxy, syy = (covariances[:, 0, 0], covariances[:, 0, 1],
                     covariances[:, 1, 1])
    length = np.sqrt(syy / (sxx * syy - sxy**2))
    return np.column_stack([means, np.log(length), -length * sxy / syy,
                            -0.5 * np.log(syy)])


# From the solution to the result.

def _report(problem, stamp, image, solution, space):
    """Return the MixtureFit of a solution, narrow Gaussians first."""
    area = np.prod(problem.pitch)
    total = stamp.tie[0] if problem.tied else solution.fluxes.sum()
    mixture = _mixture_of(solution, problem, stamp.centre)
    images = space.scratch[0]
    _kernels.draw_unit(solution.shapes, *stamp.centre, images)
    model = np.tensordot(mixture.weights, images, 1)
    residual = image - stamp.scale * total * model
    used = stamp.weight > 0
    n = np.count_nonzero(used)
    weight = stamp.weight[used] * stamp.weight_unit
    chi2 = float((weight * residual[used] ** 2).sum())
    covariance = _covariance(problem, stamp, solution, space)
    if not problem.has_error:
        covariance *= chi2 / max(n - problem.n_parameters, 1)
    status = _judge(solution, stamp)
    return MixtureFit(
        mixture, status, status.sentence, float(stamp.scale * total / area),
        chi2, _bic(chi2, n, problem), float(model[used].sum()), residual,
        covariance)


def _sorted(solution):
    """Return the solution with narrow Gaussians first."""
    order = np.argsort(-solution.shapes[:, 2] - solution.shapes[:, 4],
                       kind='stable')
    return solution._replace(shapes=solution.shapes[order],
                             fluxes=solution.fluxes[order])


def _mixture_of(solution, problem, centre):
    pitch = problem.pitch
    x, y, log_l, t, log_m = solution.shapes.T
    length, m = np.exp(log_l), np.exp(log_m)
    norm = np.hypot(t, m)
    stddevs = np.column_stack([norm / (length * m), 1 / m]) / pitch
    means = (np.column_stack([x, y]) + centre - problem.origin) / pitch
    fluxes = solution.fluxes
    return GaussianMixture.from_stddevs(fluxes / fluxes.sum(), means, stddevs,
                                        -t / norm)


def _judge(solution, stamp):
    """Return the status of a solution."""
    if (solution.fluxes == 0).any():
        return FitStatus.VANISHED
    if solution.stopped:
        return FitStatus.STOPPED
    price = sum(_kernels.penalty(shape, stamp.limits, np.empty((5, 5)),
                                 np.empty(5)) for shape in solution.shapes)
    return FitStatus.AT_LIMIT if price > 0 else FitStatus.CONVERGED


def _bic(chi2, n, problem):
    size = problem.n_parameters * np.log(n)
    if problem.has_error:
        return float(chi2 + size)
    return float(n * np.log(max(chi2, np.finfo(float).tiny) / n) + size)


def _covariance(problem, stamp, solution, space):
    """
    Return the covariance (6K, 6K) of the parameters users see.

    It is the inverse of the normal matrix, for the Gaussians that have flux
    and the parameters that are free.
    """
    n = problem.n_components
    matrix, gradient = np.empty((6 * n, 6 * n)), np.empty(6 * n)
    _kernels.project(stamp.pixels, stamp.weight, stamp.centre,
                     solution.shapes, stamp.tie, problem.signed,
                     solution.fluxes.copy(), space.scratch)
    _kernels.normal_equations(
        stamp.weight, stamp.centre, solution.shapes, solution.fluxes,
        stamp.tie, space.scratch, matrix, gradient)
    _kernels.add_penalties(solution.shapes, stamp.limits, matrix, gradient)
    # From fluxes first to Gaussian by Gaussian.
    place = np.column_stack([np.arange(n),
                             np.arange(n, 6 * n).reshape(n, 5)]).ravel()
    free = np.repeat(solution.fluxes != 0, 6)
    if problem.fixed:
        free &= np.tile([True, False, False, True, True, True], n)
    chosen = np.ix_(place[free], place[free])
    slopes = _slopes(solution, problem, stamp)[:, free]
    inverse = np.linalg.pinv(matrix[chosen], rcond=1e-15, hermitian=True)
    covariance = slopes @ inverse @ slopes.T / stamp.weight_unit
    unknown = np.repeat(solution.fluxes == 0, 6)
    covariance[unknown] = covariance[:, unknown] = np.nan
    return covariance


def _slopes(solution, problem, stamp):
    """Return d(what users see) / d(what is fitted), (6K, 6K)."""
    pitch = problem.pitch
    _, _, log_l, t, log_m = solution.shapes.T
    length, m = np.exp(log_l), np.exp(log_m)
    square = t**2 + m**2
    wide, high = np.sqrt(square) / (length * m) / pitch[0], 1 / m / pitch[1]
    n = len(t)
    blocks = np.zeros((n, 6, 6))
    blocks[:, 0, 0] = stamp.scale / pitch.prod()
    blocks[:, [1, 2], [1, 2]] = 1 / pitch
    blocks[:, 3, 3] = -wide
    blocks[:, 3, 4] = wide * t / square
    blocks[:, 3, 5] = -wide * t**2 / square
    blocks[:, 4, 5] = -high
    blocks[:, 5, 4] = -(m**2) / square**1.5
    blocks[:, 5, 5] = t * m**2 / square**1.5
    slopes = np.zeros((n, 6, n, 6))
    slopes[np.arange(n), :, np.arange(n)] = blocks
    return slopes.reshape(6 * n, 6 * n)
