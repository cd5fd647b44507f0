"""Flux and position of stars, by Levenberg-Marquardt."""
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.descent import (
    LEAST_FALL,
    LONGEST,
    POOR_GAIN,
    STEP_TOLERANCE,
    next_damping,
    remainder,
)
from photutils_mgauss.kernels.grid import Merged, blend_weights, merge_nodes
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import copy_matrix, copy_vector
from photutils_mgauss.kernels.profile import (
    factorize,
    invert_block,
    solve_factored,
)
from photutils_mgauss.kernels.star_normal import (
    BoxScratch,
    Equations,
    Pixels,
    find_reach,
    gather,
    normal_equations,
    step_ahead,
)

# Fits of stars: flux, x and y of each, by Levenberg-Marquardt. The stars of a
# group are fitted jointly, see `star_normal`; the closer stars that see
# each other stand in the group, the shorter the rows of its matrix.

# Outcome of a fit; 1 to 4 as scipy.optimize.least_squares counts them.
_NOT_CONVERGED = 0
CONVERGED = 3
STALLED = 2
BAD_ERROR = -1

# With a PSF of fewer Gaussians a star is brought closer to its minimum where
# it is not farther than the first of these, in two steps where it is farther
# than the second, in pixels or fractions of the flux.
_FAR = 0.5
_NEAR = 3e-3


class Stars(NamedTuple):
    """
    Stars to fit, those of group g from starts[g] to starts[g + 1].

    boxes (n, 4), their initial flux, x and y and the limits of these, (n, 3),
    and the sky (n,) that is subtracted before the fit.
    """

    starts: np.ndarray
    boxes: np.ndarray
    initial: np.ndarray
    sky: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class StarFits(NamedTuple):
    """
    Results of n stars.

    values (n, 3) and their covariances (n, 3, 3), the sky and its error
    (n, 2), sums (n, 3) as of _measure_fit, outcome (n, 2) with the number of
    evaluations.
    """

    values: np.ndarray
    covariances: np.ndarray
    sky: np.ndarray
    sums: np.ndarray
    outcome: np.ndarray


class _Limits(NamedTuple):
    """Between what, or whether not at all, parameters (size,) may move."""

    lower: np.ndarray
    upper: np.ndarray
    fixed: np.ndarray

    @classmethod
    def empty(cls, size):
        return cls(np.empty(size), np.empty(size), np.empty(size, bool))


class _Work(NamedTuple):
    """
    Vectors and matrices of one step; columns (3, size), block (3, 3).

    undamped is a step as it would be without damping. share (n,) is by how
    much each star lowers chi2, status (n,) its outcome.
    """

    step: np.ndarray
    undamped: np.ndarray
    trial: np.ndarray
    frozen: np.ndarray
    scale: np.ndarray
    factor: np.ndarray
    steepest: np.ndarray
    columns: np.ndarray
    block: np.ndarray
    share: np.ndarray
    status: np.ndarray

    @classmethod
    def empty(cls, n):
        size = 3 * n + 1
        return cls(np.empty(size), np.empty(size), np.empty(size),
                   np.empty(size, bool), np.empty(size),
                   np.empty((size, size)), np.empty(size),
                   np.empty((3, size)), np.empty((3, 3)), np.empty(n),
                   np.empty(n, np.int64))


class FitScratch(NamedTuple):
    """
    The memory in which groups of stars are fitted.

    The equations at the last point and, in boxes, those at the next one; the
    numbers fitted, and what they are limited to; a simpler PSF.
    """

    boxes: BoxScratch
    equations: Equations
    work: _Work
    limits: _Limits
    parameters: np.ndarray
    merged: Merged

    @classmethod
    def empty(cls, stars, k, stop):
        """
        Return the memory for the largest group of some stars.

        k is how many Gaussians a node of the PSF has. Once stop (1,) is True,
        fits end.
        """
        n = int(np.max(np.diff(stars.starts), initial=1))
        boxes = BoxScratch.empty(n, stars.boxes, stop)
        size = 3 * n + 1
        return cls(boxes, Equations.empty(*boxes.data.shape, size),
                   _Work.empty(n), _Limits.empty(size), np.empty(size),
                   Merged.empty(k))


@inner
def _freeze(parameters, limits, gradient, size, frozen):
    """Freeze fixed parameters and those that press against a bound."""
    for a in range(size):
        frozen[a] = limits.fixed[a] or (
            parameters[a] <= limits.lower[a] and gradient[a] < 0) or (
            parameters[a] >= limits.upper[a] and gradient[a] > 0)


@inner
def _step_size(step, parameters, matrix, n):
    """
    Return the largest relative step of a group.

    In pixels for positions; for fluxes as a fraction of the flux or, if that
    is larger, of a tenth of its error.
    """
    size = 0.0
    for s in range(n):
        a = 3 * s
        size = max(size, abs(step[a + 1]), abs(step[a + 2]))
        if step[a] != 0:
            noise = 0.1 / sqrt(matrix[a, a])
            size = max(size, abs(step[a]) / max(abs(parameters[a]), noise))
    return size


@inner
def _undamp(damping, equations, size, work):
    """Lengthen a damped step to what each parameter alone would go."""
    copy_vector(work.step, size, work.undamped)
    if damping > 0:
        for a in range(size):
            if not work.frozen[a]:
                alone = abs(equations.gradient[a]) / equations.matrix[a, a]
                work.undamped[a] = max(abs(work.step[a]), alone)


@inner
def _take_step(parameters, step, limits, n, size, trial):
    """Put the bounded end of the step into trial, the actual into step."""
    for s in range(n):
        far = max(abs(step[3 * s + 1]), abs(step[3 * s + 2]))
        if far > LONGEST:
            step[3 * s + 1] *= LONGEST / far
            step[3 * s + 2] *= LONGEST / far
    for a in range(size):
        trial[a] = min(max(parameters[a] + step[a], limits.lower[a]),
                       limits.upper[a])
        step[a] = trial[a] - parameters[a]


@inner
def _expected(step, equations, size):
    """Return by how much the linear model says chi2 falls."""
    total = 0.0
    for a in range(size):
        row = equations.matrix[a, a] * step[a]
        for b in range(equations.first[a], a):
            row += 2 * equations.matrix[a, b] * step[b]
        total += step[a] * (2 * equations.gradient[a] - row)
    return total


@inner
def _factorize(equations, damping, size, work, stop):
    """Factor the damped matrix; return whether it is positive definite."""
    return factorize(equations.matrix, equations.first, work.frozen, damping,
                     size, work.steepest, work.scale, work.factor, work.block,
                     stop)


@inner
def _solve(parameters, equations, limits, n, size, work):
    """Put a step of the factored equations, and its end, into work."""
    for a in range(size):
        work.step[a] = 0.0 if work.frozen[a] else equations.gradient[a]
    solve_factored(work.factor, equations.first, work.scale, size, work.step)
    _take_step(parameters, work.step, limits, n, size, work.trial)


@inner
def _end(outcome, n, status, evaluations):
    """Give all stars of a group one outcome; return the evaluations."""
    for s in range(n):
        status[s] = outcome
    return evaluations


@inner
def _share_fall(step, old, new, n, share):
    """
    Put into share (n,) by how much each star's part of a step lowers chi2.

    By the mean of its slopes at the two ends.
    """
    for s in range(n):
        share[s] = 0.0
        for a in range(3 * s, 3 * s + 3):
            share[s] += step[a] * (old.gradient[a] + new.gradient[a])


@inner
def _end_early(best, fall, n, share, status):
    """
    Put the outcome of each star of a group that ran out of iterations.

    A few stars that cannot be told apart do not spoil all others.
    """
    for s in range(n):
        still = fall < LEAST_FALL * best or (
            n > 1 and abs(share[s]) < LEAST_FALL * best / n)
        status[s] = STALLED if still else _NOT_CONVERGED


@inner
def _keep(new, n, size, old):
    """Copy the equations of a better point."""
    area = new.weights.shape[1]
    copy_matrix(new.weights, n, area, old.weights)
    copy_matrix(new.residuals, n, area, old.residuals)
    copy_vector(new.gradient, size, old.gradient)
    copy_vector(new.first, size, old.first)
    for a in range(size):
        for b in range(new.first[a], a + 1):
            old.matrix[a, b] = new.matrix[a, b]


@inner
def _begin(parameters, n, fit_sky, pixels, psf, scratch, work, equations,
           chi2):
    """Evaluate the first point of a group; return its sum of squares."""
    for a in range(3 * n + fit_sky):
        work.steepest[a] = 0.0
    for s in range(n):
        work.share[s] = np.inf
    normal_equations(parameters, n, fit_sky, pixels, psf, scratch, equations,
                     equations, chi2)
    return chi2[1]


@inner
def _propose(parameters, equations, limits, damping, n, size, work):
    """
    Put the next step, and its end, into work.

    Returns by how much chi2 should fall, the step's size, and that which it
    would have without damping.
    """
    _solve(parameters, equations, limits, n, size, work)
    _undamp(damping, equations, size, work)
    return (_expected(work.step, equations, size),
            _step_size(work.step, parameters, equations.matrix, n),
            _step_size(work.undamped, parameters, equations.matrix, n))


@inner
def _accept(parameters, old, new, n, size, work):
    """Take the step."""
    _share_fall(work.step, old, new, n, work.share)
    copy_vector(work.trial, size, parameters)
    _keep(new, n, size, old)


@inner
def _approach(parameters, fit_sky, pixels, psf, scratch, merged, work, old,
              new, limits, chi2):
    """
    Bring a single star close to its minimum with a PSF of fewer Gaussians.

    At most two steps, of an evaluation each. Where they would be long or do
    not lower chi2, parameters stay what they were. Returns the evaluations.
    """
    nodes, _, x_grid, y_grid, integrated = psf
    index, weights = scratch.tiling.index, scratch.tiling.weights
    blend_weights(parameters[1], parameters[2], x_grid, y_grid, index,
                  weights)
    if not merge_nodes(index, weights[0], nodes, merged):
        return 0
    size = 3 + fit_sky
    simple = (merged.nodes, merged.falls, merged.axis, merged.axis,
              integrated)
    best = _begin(parameters, 1, fit_sky, pixels, simple, scratch, work, old,
                  chi2)
    far = _aim(parameters, old, limits, size, work, scratch.stop)
    if not far < _FAR:
        return 1
    if far > _NEAR:
        normal_equations(work.trial, 1, fit_sky, pixels, simple, scratch, old,
                         new, chi2)
        if not chi2[0] < best:
            return 2
        copy_vector(work.trial, size, parameters)
        if not _aim(parameters, new, limits, size, work,
                    scratch.stop) < far:
            return 2
    copy_vector(work.trial, size, parameters)
    return 1 + (far > _NEAR)


@inner
def _aim(parameters, equations, limits, size, work, stop):
    """Put an undamped step of a single star into work; return its size."""
    _freeze(parameters, limits, equations.gradient, size, work.frozen)
    if not _factorize(equations, 0.0, size, work, stop):
        return np.inf
    _solve(parameters, equations, limits, 1, size, work)
    return _step_size(work.step, parameters, equations.matrix, 1)


@inner
def _minimize(parameters, n, fit_sky, pixels, psf, scratch, work, old, new,
              limits, max_iterations, chi2):
    """
    Minimize chi2 of a group by Levenberg-Marquardt, from parameters.

    Puts the outcome of each star into work.status and returns the number of
    evaluations; old holds the equations at the result, chi2[1] its sum of
    squares. The last step of a single star, at most some 3e-5 pixels, is not
    evaluated: what it changes is known from the derivatives.
    """
    size = 3 * n + fit_sky
    best = _begin(parameters, n, fit_sky, pixels, psf, scratch, work, old,
                  chi2)
    floor = 1e-24 * best
    damping, last, fall = 0.0, 0.0, np.inf
    # Whether the derivatives of the one star there is are those of old.
    known = n == 1
    for iteration in range(max_iterations):
        _freeze(parameters, limits, old.gradient, size, work.frozen)
        if not _factorize(old, damping, size, work, scratch.stop):
            damping = max(10 * damping, 1e-6)
            if damping > 1e3:
                return _end(_NOT_CONVERGED, n, work.status, iteration + 1)
            continue
        expected, short, length = _propose(parameters, old, limits, damping,
                                           n, size, work)
        if known and remainder(length, last) < STEP_TOLERANCE:
            step_ahead(parameters, work.step, fit_sky, pixels, scratch, old,
                       chi2)
            copy_vector(work.trial, size, parameters)
            return _end(CONVERGED, n, work.status, iteration + 1)
        normal_equations(work.trial, n, fit_sky, pixels, psf, scratch, old,
                         new, chi2)
        if not chi2[0] <= best * (1 + 1e-12) + floor:
            if short < 1e-3 * STEP_TOLERANCE or damping > 1e12:
                return _end(STALLED, n, work.status, iteration + 2)
            damping, last, known = max(10 * damping, 1e-3), 0.0, False
            continue
        _accept(parameters, old, new, n, size, work)
        known = n == 1
        fall = best - chi2[0]
        # Of a smaller fall nothing is left after rounding: keep the damping.
        gain = fall / expected if expected > 1e-9 * best else POOR_GAIN
        best = chi2[1]
        if remainder(length, last) < STEP_TOLERANCE:
            return _end(CONVERGED, n, work.status, iteration + 2)
        damping, last = next_damping(damping, gain), length
    _end_early(best, fall, n, work.share, work.status)
    return max_iterations + 1


@inner
def _covariances(equations, limits, n, size, work, stop, out):
    """
    Put each star's 3 x 3 block of the inverse matrix into out (n, 3, 3).

    Returns the variance of the last parameter, or NaN if there is no inverse;
    then out is NaN, too.
    """
    for a in range(size):
        work.frozen[a] = limits.fixed[a]
    known = _factorize(equations, 0.0, size, work, stop)
    for s in range(n):
        if known and not stop[0]:
            invert_block(work.factor, equations.first, work.scale, 3 * s,
                         size, work.columns, work.block, out[s])
        for a in range(3):
            for b in range(3):
                if not known or work.frozen[3 * s + a] or (
                        work.frozen[3 * s + b]):
                    out[s, a, b] = np.nan
    root = work.factor[size - 1, size - 1] * work.scale[size - 1]
    return 1 / (root * root) if known else np.nan


@inner
def _measure_fit(initial, boxes, equations, n, out):
    """
    Put three sums of each star's box into out (n, 3).

    They are the sum of absolute residuals, the residual of the pixel at the
    initial position, NaN where it was not fitted, and the sum of squares.
    """
    for s in range(n):
        row, column, height, width = boxes[s]
        weights, residuals = equations.weights[s], equations.residuals[s]
        total = 0.0
        squares = 0.0
        for i in range(height * width):
            if weights[i] > 0:
                total += abs(residuals[i])
                squares += weights[i] * residuals[i] ** 2
        x = ceil(initial[s, 1] - 0.5) - column
        y = ceil(initial[s, 2] - 0.5) - row
        centre = np.nan
        middle = x * height + y
        if 0 <= x < width and 0 <= y < height and weights[middle] > 0:
            centre = residuals[middle]
        out[s, 0] = total
        out[s, 1] = centre
        out[s, 2] = squares


@inner
def _load_group(image, stars, first, n, fixed, parameters, limits, data,
                weights):
    """
    Fetch the pixels, initial values and limits of the n stars from first on.

    Returns the number of pixels, or -1 if an error is not positive and
    finite.
    """
    n_pixels = 0
    for s in range(n):
        i = first + s
        got = gather(image, stars.boxes[i], stars.sky[i], data[s],
                     weights[s])
        if got < 0:
            return -1
        n_pixels += got
        for b in range(3):
            a = 3 * s + b
            low, high = stars.lower[i, b], stars.upper[i, b]
            limits.lower[a], limits.upper[a] = low, high
            limits.fixed[a] = fixed[b]
            parameters[a] = min(max(stars.initial[i, b], low), high)
    parameters[3 * n] = 0.0
    limits.lower[3 * n], limits.upper[3 * n] = -np.inf, np.inf
    limits.fixed[3 * n] = False
    return n_pixels


@inner
def _scatter(sums, n_pixels, n_free):
    """Return the variance of residuals, NaN without degrees of freedom."""
    if n_pixels <= n_free:
        return np.nan
    total = 0.0
    for s in range(sums.shape[0]):
        total += sums[s, 2]
    return total / (n_pixels - n_free)


@inner
def _put_results(parameters, sky_variance, factor, first, n, fit_sky, fits):
    """Put the values of a group and its scaled covariances into fits."""
    for s in range(n):
        for b in range(3):
            fits.values[first + s, b] = parameters[3 * s + b]
            for c in range(3):
                fits.covariances[first + s, b, c] *= factor
        if fit_sky:
            fits.sky[first + s, 0] = parameters[3 * n]
            fits.sky[first + s, 1] = sqrt(factor * sky_variance)


@inner
def _fit_group(image, stars, first, n, fixed, fit_sky, psf, max_iterations,
               scratch, fits):
    """Fit the n stars from first on; see `fit_stars`."""
    boxes, old, work, limits, parameters, merged = scratch
    data, weights, new, around, chi2 = boxes
    n_pixels = _load_group(image, stars, first, n, fixed, parameters, limits,
                           data, weights)
    if n_pixels < 0:
        for s in range(first, first + n):
            fits.outcome[s, 0] = BAD_ERROR
        return
    rows = slice(first, first + n)
    pixels = Pixels(stars.boxes[rows], data, weights, image.gain)
    evaluations = 0
    if n == 1 and psf[0].shape[0] > 1 and max_iterations > 0:
        evaluations = _approach(parameters, fit_sky, pixels, psf, around,
                                merged, work, old, new, limits, chi2)
    evaluations += _minimize(
        parameters, n, fit_sky, pixels, psf, around, work, old, new, limits,
        max_iterations, chi2)
    sky_variance = _covariances(old, limits, n, 3 * n + fit_sky, work,
                                around.stop, fits.covariances[rows])
    _measure_fit(stars.initial[rows], pixels.boxes, old, n, fits.sums[rows])
    factor = 1.0
    if image.error.size == 0 and image.gain == 0:
        factor = _scatter(fits.sums[rows], n_pixels,
                          _count_free(limits, 3 * n + fit_sky))
    _put_results(parameters, sky_variance, factor, first, n, fit_sky, fits)
    for s in range(n):
        fits.outcome[first + s, 0] = work.status[s]
        fits.outcome[first + s, 1] = evaluations


@inner
def _count_free(limits, size):
    """Return how many numbers are fitted."""
    n = 0
    for a in range(size):
        n += not limits.fixed[a]
    return n


@kernel
def fit_stars(image, stars, fixed, fit_sky, psf, max_iterations, scratch,
              fits):
    """
    Fit flux, x and y of groups of stars.

    fixed (3,) holds for all; fit_sky adds one level for each group. Without
    errors the scatter of the residuals stands for them. scratch is a
    FitScratch; if its stop becomes True, the rest is left as it is.
    """
    starts = stars.starts
    find_reach(psf, scratch.boxes.around.sight)
    for g in range(starts.size - 1):
        _fit_group(image, stars, starts[g], starts[g + 1] - starts[g], fixed,
                   fit_sky, psf, max_iterations, scratch, fits)
