"""
One stamp and the search for its mixture, in the units of the kernels.

`Stamp` holds scaled pixels, `run` is one Levenberg-Marquardt fit, `search`
finds where to start it, and the rest turns shape numbers into mixtures and
back.
"""
from functools import partial
from math import ceil
from typing import NamedTuple

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.fitting.phases import flux_rows, phase_rows
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.rows import log_rows

# Rows of pixels are a multiple of this long, which makes loops over them
# vectors without remainder.
_LANES = 8
_TOLERANCE = 1e-8
_MAX_STEPS = 500
# A Gaussian narrower than this in stamp pixels falls between the pixel
# centres and can take any flux.
_MIN_STDDEV = 0.4
# No Gaussian of a PSF that contains the pixel is much narrower than the pixel,
# whose standard deviation is 0.29; others change their flux between phases
# that samples show [native pix].
_PIXEL_STDDEV = 0.25
# A net flux below this fraction of what cancels in it is rounding error.
_LEAST_FLUX = 1e-4
# How firmly the total flux is tied and limits are kept, in units of the
# power of the image.
_TIE = 1e6
_STIFFNESS = 1.0
# What a centroid error of one native pixel costs, in the same unit, rising so
# that no step goes far, or an error of the flux by itself. At each price the
# map to these errors follows the solution so many times, each after so many
# steps, or until the cost changes by less than this fraction.
_PRICES = {'astrometric': (1.0, 10.0, 100.0), 'photometric': (1.0,)}
_PHASE_ROUNDS = 8
_PHASE_STEPS = 4
_PHASE_TOLERANCE = 1e-2
# The steps every split gets, and the better half again: so many, and so many
# more for each Gaussian; and the fraction of them, and the least number, that
# go on at the end. With fewer Gaussians than asked for, trials are shorter and
# the fit of the best need not converge.
_TRIAL_STEPS = (3, 2)
_FINALISTS = 0.05
_LEAST_FINALISTS = 2
_PREVIEW_TRIAL_STEPS, _PREVIEW_STEPS = 6, 20


class StampProblem(NamedTuple):
    """What is asked of every image of a stack."""

    n_components: int
    oversampling: tuple
    origin: np.ndarray
    radius: float | None
    enclosed_flux: float | None
    tied: bool
    signed: bool
    fixed: bool
    weighting: str
    has_error: bool

    @property
    def pitch(self):
        """Image pixels per native pixel along (x, y)."""
        return np.array(self.oversampling[::-1], float)

    @property
    def least_stddev(self):
        """The least standard deviation of a Gaussian, in image pixels."""
        if self.weighting != 'photometric':
            return _MIN_STDDEV
        return max(_MIN_STDDEV, _PIXEL_STDDEV * self.pitch.min())

    @property
    def n_parameters(self):
        """How many numbers a fit has."""
        per_gaussian = 4 if self.fixed else 6
        return self.n_components * per_gaussian - self.tied


def workspace(n_components, shape):
    """Return the memory in which kernels fit K Gaussians to stamps."""
    return kernels.StampScratch.empty(n_components,
                                      (shape[0], _wide(shape[1])))


class Stamp(NamedTuple):
    """
    One image, scaled for the kernels.

    ``pixels`` have a peak of 1 and ``weight`` makes their power 1: pixel
    unit ``scale`` and weight unit ``weight_unit``. Columns of no weight are
    added on the right. Means are relative to ``centre``; ``tie``, ``rows``
    and ``limits`` are the kernels'.
    """

    pixels: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    peak: np.ndarray
    tie: tuple
    rows: np.ndarray
    limits: np.ndarray
    scale: float
    weight_unit: float

    @classmethod
    def prepare(cls, image, weight, peak, problem):
        """Return an image as the kernels fit it, scaled and centred."""
        used = weight > 0
        pixels = np.where(used, image, 0.0)
        scale = pixels.max()
        pixels /= scale
        weight_unit = (weight * pixels**2).sum()
        centre = problem.origin if problem.fixed else np.rint(peak)
        total = pixels.sum()
        tie = (total, _TIE / total**2) if problem.tied else (0.0, 0.0)
        reach = _reach(used, centre)
        limits = np.array([np.log(problem.least_stddev), np.log(reach.max()),
                           *reach, _STIFFNESS])
        pixels = _widened(pixels)
        return cls(pixels, _widened(weight / weight_unit), centre, peak, tie,
                   np.empty((0, *pixels.shape)), limits, scale, weight_unit)

    def target(self, problem):
        """Return the stamp as the kernels take it."""
        return kernels.StampTarget(
            self.pixels, self.weight, self.centre, self.tie, problem.signed,
            self.rows, problem.fixed, self.limits)


def _wide(nx):
    """Return the next length that is whole vectors."""
    return -(-nx // _LANES) * _LANES


def _widened(pixels):
    """Return the pixels with zeros on the right, for whole vectors a row."""
    ny, nx = pixels.shape
    wide = np.zeros((ny, _wide(nx)))
    wide[:, :nx] = pixels
    return wide


def _reach(used, centre):
    """Return how far used pixels are from the centre along x and y."""
    j, i = np.nonzero(used)
    return np.array([np.abs(i - centre[0]).max() + 1,
                     np.abs(j - centre[1]).max() + 1])


class Solution(NamedTuple):
    """The kernels' answer, in stamp pixels."""

    shapes: np.ndarray
    fluxes: np.ndarray
    cost: float
    stopped: bool

    @property
    def has_flux(self):
        """Whether flux is left where Gaussians cancel."""
        return self.fluxes.sum() > _LEAST_FLUX * np.abs(self.fluxes).sum()


class Trials(NamedTuple):
    """The kernels' answers from several starts, the best first."""

    shapes: np.ndarray
    fluxes: np.ndarray
    costs: np.ndarray
    statuses: np.ndarray

    @property
    def best(self):
        """The start that came lowest."""
        return Solution(self.shapes[0], self.fluxes[0], float(self.costs[0]),
                        bool(self.statuses[0] == kernels.FIT_STOPPED))


def run(stamp, problem, spaces, shapes, max_steps=_MAX_STEPS):
    """Return what Levenberg-Marquardt makes of a start (K, 5)."""
    return _run_all(stamp, problem, spaces, shapes[None], max_steps).best


def _run_all(stamp, problem, spaces, starts, max_steps):
    """Return what it makes of each of several starts (n, K, 5)."""
    n, k = starts.shape[:2]
    trials = Trials(starts.copy(), np.empty((n, k)), np.empty(n), np.empty(n))
    kernels.fit_starts(
        stamp.target(problem), trials.shapes, trials.fluxes, _TOLERANCE,
        max_steps, spaces[k], trials.costs, trials.statuses)
    order = np.argsort(trials.costs, kind='stable')
    return Trials(*(each[order] for each in trials))


def search(stamp, problem, spaces):
    """
    Return the best mixture of K Gaussians that starts of its own lead to.

    One Gaussian is fitted alone; then, one at a time, another is added by
    every way of `_splits`, each is improved for a few steps, and the best is
    fitted. Of starts with K Gaussians at once one in three or fewer finds the
    minimum; this way nearly all do.
    """
    improved = partial(_run_all, stamp, problem, spaces)
    best = run(stamp, problem, spaces, _core(stamp, problem))
    for k in range(2, problem.n_components + 1):
        starts = _splits(best.shapes, problem)
        n = len(starts)
        if k < problem.n_components:
            trial, n_best, steps = _PREVIEW_TRIAL_STEPS, 1, _PREVIEW_STEPS
        else:
            trial = _TRIAL_STEPS[0] + _TRIAL_STEPS[1] * k
            n_best = max(_LEAST_FINALISTS, ceil(_FINALISTS * n))
            steps = _MAX_STEPS
        for share in (n, max(2, n // 2)):
            starts = improved(starts[:share], trial).shapes
        best = improved(starts[:n_best], steps).best
    return best


def refine_phases(stamp, problem, spaces, solution):
    """
    Return the solution refitted with pixel-phase errors in its cost.

    The map from residuals to these errors changes with the model: a few
    steps are taken with one map, then the next is made. Each solution is
    judged by its own map and the best is kept.
    """
    improving = False
    for price in _PRICES[problem.weighting]:
        mapped, priced = _price(stamp, problem, spaces, solution, price)
        if not priced.has_flux:
            break
        solution = best = priced
        improving = False
        for _ in range(_PHASE_ROUNDS):
            before = solution.cost
            trial = run(mapped, problem, spaces, solution.shapes,
                        _PHASE_STEPS)
            if not trial.has_flux:
                break
            mapped, solution = _price(stamp, problem, spaces, trial, price)
            if not solution.has_flux:
                break
            small = _PHASE_TOLERANCE * best.cost
            improving = solution.cost < best.cost - small
            best = min(best, solution, key=lambda each: each.cost)
            if abs(solution.cost - before) < small:
                break
        solution = best
    return solution._replace(stopped=improving)


def _price(stamp, problem, spaces, solution, price):
    """Return the stamp with a solution's own map, and the cost by it."""
    rows = np.sqrt(price) * _phase_rows(stamp, problem, solution)
    stamp = stamp._replace(rows=rows)
    return stamp, run(stamp, problem, spaces, solution.shapes, 0)


def _phase_rows(stamp, problem, solution):
    """Return pixel-phase errors of the kernels' residual as few rows."""
    errors = flux_rows if problem.weighting == 'photometric' else phase_rows
    rows = errors(mixture_of(solution, problem, stamp.centre),
                  solution.fluxes.sum() / problem.pitch.prod(),
                  stamp.pixels.shape, problem.pitch, problem.origin,
                  stamp.weight > 0)
    rows = rows.reshape(-1, stamp.pixels.size)
    # The rows count by the sum of their squares alone, so rotated ones do.
    power, directions = np.linalg.eigh(rows @ rows.T)
    seen = power > 1e-8 * power[-1]
    return (directions[:, seen].T @ rows).reshape(-1, *stamp.pixels.shape)


def _core(stamp, problem):
    """Return a round Gaussian with the peak's position and half-width."""
    above = np.count_nonzero(stamp.pixels > 0.5)
    stddev = max(np.sqrt(above / np.pi / (2 * np.log(2))), _MIN_STDDEV)
    mean = np.zeros(2) if problem.fixed else stamp.peak - stamp.centre
    return np.array([[*mean, -np.log(stddev), 0, -np.log(stddev)]])


def _splits(shapes, problem):
    """
    Return starts (n, K + 1, 5) with one Gaussian more than shapes (K, 5).

    Each Gaussian in turn is split in width, along x, along y, and into two of
    different elongation; the last start adds a Gaussian wider than all.
    """
    k = len(shapes)
    children = shapes[:, None, None] + _moves(shapes, problem)
    others = np.nonzero(~np.eye(k, dtype=bool))[1].reshape(k, k - 1)
    starts = np.empty((k, children.shape[1], k + 1, 5))
    starts[:, :, :-2] = shapes[others][:, None]
    starts[:, :, -2:] = children
    widest = shapes[np.argmin(shapes[:, 2] + shapes[:, 4])]
    last = np.vstack([shapes, widest + _widening(widest[3], 2.5)])
    return np.concatenate([starts.reshape(-1, k + 1, 5), last[None]])


def _moves(shapes, problem):
    """Return how each parent's two children differ from it, (K, n, 2, 5)."""
    length, t, m = np.exp(shapes[:, 2]), shapes[:, 3], np.exp(shapes[:, 4])
    moves = np.zeros((len(shapes), 6, 2, 5))
    for i, factor in enumerate((1 / 1.5, 1.5)):
        sign = 1 - 2 * i
        width, stretch, shear, along_x, along_y, hole = np.swapaxes(
            moves[:, :, i], 0, 1)
        width[:] = _widening(t, factor)
        stretch[:, 2], stretch[:, 4] = 0.4 * sign, -0.4 * sign
        shear[:, 3] = 0.5 * sign * m
        # By 0.6 where the parent is a circle of radius 1.
        along_x[:, 0] = 0.6 * sign / length
        along_y[:, 1] = 0.6 * sign / m
        along_y[:, 0] = -0.6 * sign * t / (m * length)
        # A hole in a Gaussian narrower than the parent.
        hole[:] = _widening(t, (0.5, 0.8)[i])
    wanted = [True, True, True, *2 * [not problem.fixed], problem.signed]
    return moves[:, wanted]


def _widening(t, factor):
    """Return what multiplies the widths of Gaussians by a factor, (..., 5)."""
    move = np.zeros((*np.shape(t), 5))
    move[..., 2] = move[..., 4] = -np.log(factor)
    move[..., 3] = t / factor - t
    return move


# Between shapes and mixtures.

def stamp_shapes(mixture, problem, centre):
    """Return the shapes (K, 5) of a mixture in stamp pixels."""
    pitch = problem.pitch
    means = mixture.means * pitch + problem.origin - centre
    if problem.fixed:
        means = np.zeros_like(means)
    logs = log_rows(np.ones(len(means)), means,
                    mixture.covariances * pitch * pitch[:, None])
    return np.column_stack([means, logs[:, 3],
                            -np.exp(logs[:, 3]) * logs[:, 4], logs[:, 5]])


def narrow_first(solution):
    """Return the solution with narrow Gaussians first."""
    order = np.argsort(-solution.shapes[:, 2] - solution.shapes[:, 4],
                       kind='stable')
    return solution._replace(shapes=solution.shapes[order],
                             fluxes=solution.fluxes[order])


def mixture_of(solution, problem, centre):
    """Return a solution as a mixture about the origin, in native pixels."""
    pitch = problem.pitch
    x, y, log_l, t, log_m = solution.shapes.T
    length, m = np.exp(log_l), np.exp(log_m)
    norm = np.hypot(t, m)
    stddevs = np.column_stack([norm / (length * m), 1 / m]) / pitch
    means = (np.column_stack([x, y]) + centre - problem.origin) / pitch
    fluxes = solution.fluxes
    return GaussianMixture.from_stddevs(fluxes / fluxes.sum(), means, stddevs,
                                        -t / norm)


class Equations(NamedTuple):
    """What kernels know of a solution, the sums for astrometry left out."""

    images: np.ndarray
    matrix: np.ndarray
    fluxes: np.ndarray
    price: float

    @classmethod
    def at(cls, solution, stamp, problem, spaces):
        """Form the normal equations at a solution."""
        stamp = stamp._replace(rows=stamp.rows[:0])
        fluxes = run(stamp, problem, spaces, solution.shapes, 0).fluxes
        space = spaces[len(fluxes)]
        return cls(space.images, space.matrix, fluxes, space.price[0])


def covariance_of(problem, stamp, solution, equations):
    """
    Return the covariance (6K, 6K) of the parameters users see.

    It is the inverse of the normal matrix, for the Gaussians that have flux
    and the parameters that are free.
    """
    n, fluxes = problem.n_components, equations.fluxes
    matrix = equations.matrix
    # From fluxes first to Gaussian by Gaussian.
    place = np.column_stack([np.arange(n),
                             np.arange(n, 6 * n).reshape(n, 5)]).ravel()
    free = np.repeat(fluxes != 0, 6)
    if problem.fixed:
        free &= np.tile([True, False, False, True, True, True], n)
    chosen = np.ix_(place[free], place[free])
    slopes = _slopes(solution, problem, stamp)[:, free]
    powers, directions = np.linalg.eigh(matrix[chosen])
    seen = powers > 1e-15 * powers[-1:]
    slopes = slopes @ (directions[:, seen] / np.sqrt(powers[seen]))
    covariance = slopes @ slopes.T
    covariance /= stamp.weight_unit * stamp.scale**2
    unknown = np.repeat(fluxes == 0, 6)
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
