"""Flux and position of stars, by Levenberg-Marquardt."""
from math import ceil, sqrt

import numpy as np

from photutils_mgauss.kernels.descent import (
    LEAST_FALL,
    LONGEST,
    POOR_GAIN,
    STEP_TOLERANCE,
    next_damping,
    remainder,
)
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    _factorize,
    _solve,
    copy_matrix,
    copy_vector,
)
from photutils_mgauss.kernels.tile import LANES, fill_derivatives

# Fits of stars: flux, x and y of each, by Levenberg-Marquardt.
#
# A group of n stars is fitted jointly on the pixels of its n boxes, (first
# row, first column, height, width) each; a single star is a group of one.
# Where boxes overlap their pixels count once for each box. Parameters are
# ordered flux, x, y of the first star, of the second, ..., and last, where it
# is fitted, the sky level common to the group.

# Outcome of a fit; 1 to 4 as scipy.optimize.least_squares counts them.
_NOT_CONVERGED = 0
CONVERGED = 3
STALLED = 2
BAD_ERROR = -1

# Stars whose unit-flux image is nowhere above this in a box are left out of
# its normal matrix (not of its model).
_UNSEEN = 1e-18


@kernel
def count_pixels(mask, boxes, out):
    """Put the number of pixels of each box that mask leaves into out (n,)."""
    for i in range(boxes.shape[0]):
        row, column, height, width = boxes[i]
        n = 0
        for y in range(row, row + height):
            for x in range(column, column + width):
                n += not mask[y, x]
        out[i] = n


@inner
def _gather(image, error, mask, box, sky, data, variance):
    """
    Copy the pixels of a box less its sky, column after column.

    Masked pixels get an infinite variance. error and mask may be empty, for
    1 and none. Returns the number of pixels, or -1 if an error is not
    positive and finite.
    """
    row, column, height, width = box
    n = 0
    for i in range(width):
        for j in range(height):
            k = i * height + j
            y, x = row + j, column + i
            if mask.size and mask[y, x]:
                data[k] = 0.0
                variance[k] = np.inf
                continue
            data[k] = image[y, x] - sky
            variance[k] = 1.0
            n += 1
            if error.size:
                sigma = error[y, x]
                if not 0 < sigma < np.inf:
                    return -1
                variance[k] = sigma * sigma
    return n


@inner
def _weigh(data, variance, sky, gain, old, residual, weight, chi2):
    """
    Turn the model of the stars in residual into residuals, and weigh them.

    weight takes the new weights; chi2 (2,) gets the sums of squares with the
    old weights and with the new ones added. A gain of 0 means that variance
    does not depend on the model.
    """
    with_old = 0.0
    with_new = 0.0
    for i in range(data.size):
        model = residual[i]
        v = variance[i]
        if gain > 0 and model > 0:
            v += model / gain
        w = 1 / v
        r = data[i] - sky - model
        weight[i] = w
        residual[i] = r
        with_old += old[i] * r * r
        with_new += w * r * r
    chi2[0] += with_old
    chi2[1] += with_new


@inner
def _add_gradient(derivatives, flux, weight, residual, gradient):
    """Add a star's part of the right-hand side in one box."""
    b0 = 0.0
    b1 = 0.0
    b2 = 0.0
    for i in range(weight.size):
        wr = weight[i] * residual[i]
        b0 += wr * derivatives[0, i]
        b1 += wr * derivatives[1, i]
        b2 += wr * derivatives[2, i]
    gradient[0] += b0
    gradient[1] += flux * b1
    gradient[2] += flux * b2


@inner
def _add_block(one, flux_1, two, flux_2, weight, block):
    """Add the 3 x 3 block of the normal matrix that joins two stars."""
    a00 = 0.0
    a01 = 0.0
    a02 = 0.0
    a10 = 0.0
    a11 = 0.0
    a12 = 0.0
    a20 = 0.0
    a21 = 0.0
    a22 = 0.0
    for i in range(weight.size):
        w0 = weight[i] * one[0, i]
        w1 = weight[i] * one[1, i]
        w2 = weight[i] * one[2, i]
        t0, t1, t2 = two[0, i], two[1, i], two[2, i]
        a00 += w0 * t0
        a01 += w0 * t1
        a02 += w0 * t2
        a10 += w1 * t0
        a11 += w1 * t1
        a12 += w1 * t2
        a20 += w2 * t0
        a21 += w2 * t1
        a22 += w2 * t2
    block[0, 0] += a00
    block[0, 1] += flux_2 * a01
    block[0, 2] += flux_2 * a02
    block[1, 0] += flux_1 * a10
    block[1, 1] += flux_1 * flux_2 * a11
    block[1, 2] += flux_1 * flux_2 * a12
    block[2, 0] += flux_1 * a20
    block[2, 1] += flux_1 * flux_2 * a21
    block[2, 2] += flux_1 * flux_2 * a22


@inner
def _add_sky(derivatives, flux, weight, column):
    """Add what joins a star and the sky level, in one box."""
    for i in range(weight.size):
        column[0] += weight[i] * derivatives[0, i]
        column[1] += weight[i] * derivatives[1, i] * flux
        column[2] += weight[i] * derivatives[2, i] * flux


@inner
def _model_stars(parameters, n, box, psf, scratch, residual):
    """
    Put the sum of n stars in a box into residual.

    Fills each star's derivatives, and whether any of it is seen in the box.
    scratch is (derivatives, seen, tiling).
    """
    derivatives, seen, tiling = scratch
    residual[:] = 0.0
    for s in range(n):
        own = derivatives[s, :, :residual.size]
        fill_derivatives(parameters[3 * s + 1], parameters[3 * s + 2], box,
                         psf, tiling, own)
        flux = parameters[3 * s]
        top = 0.0
        for i in range(residual.size):
            residual[i] += flux * own[0, i]
            top = max(top, abs(own[0, i]))
        seen[s] = top > _UNSEEN


@inner
def _add_equations(parameters, n, fit_sky, derivatives, seen, weight, residual,
                   matrix, gradient):
    """Add what one box contributes to the normal equations of a group."""
    sky = 3 * n
    for s in range(n):
        if not seen[s]:
            continue
        flux = parameters[3 * s]
        one = slice(3 * s, 3 * s + 3)
        own = derivatives[s, :, :weight.size]
        _add_gradient(own, flux, weight, residual, gradient[one])
        for t in range(s + 1):
            if seen[t]:
                _add_block(own, flux, derivatives[t, :, :weight.size],
                           parameters[3 * t], weight,
                           matrix[one, 3 * t:3 * t + 3])
        if fit_sky:
            _add_sky(own, flux, weight, matrix[sky, one])
    if fit_sky:
        for i in range(weight.size):
            matrix[sky, sky] += weight[i]
            gradient[sky] += weight[i] * residual[i]


@inner
def _normal_equations(parameters, n, fit_sky, pixels, psf, scratch, old, new,
                      chi2):
    """
    Evaluate a group: normal matrix and right-hand side, chi2 (2,).

    pixels is (boxes, data, variance, gain). old and new are the tuples
    (weights, residuals, matrix, gradient) of the last point and of this one.
    Only the lower triangle of the matrix is filled.
    """
    boxes, data, variance, gain = pixels
    derivatives, seen, _ = scratch
    weights, residuals, matrix, gradient = new
    size = 3 * n + fit_sky
    matrix[:size, :size] = 0.0
    gradient[:size] = 0.0
    chi2[:] = 0.0
    sky = parameters[3 * n] if fit_sky else 0.0
    for c in range(n):
        used = boxes[c, 2] * boxes[c, 3]
        residual, weight = residuals[c, :used], weights[c, :used]
        _model_stars(parameters, n, boxes[c], psf, scratch, residual)
        _weigh(data[c, :used], variance[c, :used], sky, gain,
               old[0][c, :used], residual, weight, chi2)
        _add_equations(parameters, n, fit_sky, derivatives, seen, weight,
                       residual, matrix, gradient)


@inner
def _freeze(parameters, lower, upper, gradient, fixed, size, frozen):
    """Freeze fixed parameters and those that press against a bound."""
    for a in range(size):
        frozen[a] = fixed[a] or (
            parameters[a] <= lower[a] and gradient[a] < 0) or (
            parameters[a] >= upper[a] and gradient[a] > 0)


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
def _undamp(step, matrix, gradient, frozen, size):
    """Lengthen a damped step to what each parameter alone would go."""
    for a in range(size):
        if not frozen[a]:
            step[a] = max(abs(step[a]), abs(gradient[a]) / matrix[a, a])


@inner
def _take_step(parameters, step, lower, upper, n, size, trial):
    """Put the bounded end of the step into trial, the actual into step."""
    for s in range(n):
        far = max(abs(step[3 * s + 1]), abs(step[3 * s + 2]))
        if far > LONGEST:
            step[3 * s + 1] *= LONGEST / far
            step[3 * s + 2] *= LONGEST / far
    for a in range(size):
        trial[a] = min(max(parameters[a] + step[a], lower[a]), upper[a])
        step[a] = trial[a] - parameters[a]


@inner
def _expected(step, matrix, gradient, size):
    """Return by how much the linear model says chi2 falls."""
    total = 0.0
    for a in range(size):
        row = matrix[a, a] * step[a]
        for b in range(a):
            row += 2 * matrix[a, b] * step[b]
        total += step[a] * (2 * gradient[a] - row)
    return total


@inner
def _minimize(parameters, n, fit_sky, pixels, psf, scratch, work, old, new,
              limits, max_iterations, chi2):
    """
    Minimize chi2 of a group by Levenberg-Marquardt, from parameters.

    Returns the outcome and the number of evaluations; old holds the
    equations at the result, chi2[1] its sum of squares. work is (step,
    trial, frozen, scale, factor, steepest), limits (lower, upper, fixed).
    """
    step, trial, frozen, scale, factor, steepest = work
    lower, upper, fixed = limits
    size = 3 * n + fit_sky
    steepest[:size] = 0.0
    _normal_equations(parameters, n, fit_sky, pixels, psf, scratch, old, old,
                      chi2)
    best = chi2[1]
    floor = 1e-24 * best
    damping = 0.0
    last = 0.0
    fall = np.inf
    for iteration in range(max_iterations):
        _freeze(parameters, lower, upper, old[3], fixed, size, frozen)
        if not _factorize(old[2], frozen, damping, size, steepest, scale,
                          factor):
            damping = max(10 * damping, 1e-6)
            if damping > 1e3:
                return _NOT_CONVERGED, iteration + 1
            continue
        for a in range(size):
            step[a] = 0.0 if frozen[a] else old[3][a]
        _solve(factor, scale, size, step)
        _take_step(parameters, step, lower, upper, n, size, trial)
        expected = _expected(step, old[2], old[3], size)
        short = _step_size(step, parameters, old[2], n)
        if damping > 0:
            _undamp(step, old[2], old[3], frozen, size)
        length = _step_size(step, parameters, old[2], n)
        _normal_equations(trial, n, fit_sky, pixels, psf, scratch, old, new,
                          chi2)
        if not chi2[0] <= best * (1 + 1e-12) + floor:
            if short < 1e-3 * STEP_TOLERANCE or damping > 1e12:
                return STALLED, iteration + 2
            damping = max(10 * damping, 1e-3)
            last = 0.0
            continue
        # Of a smaller fall nothing is left after rounding: keep the damping.
        gain = ((best - chi2[0]) / expected if expected > 1e-9 * best
                else POOR_GAIN)
        fall = best - chi2[0]
        copy_vector(trial, size, parameters)
        best = chi2[1]
        area = new[0].shape[1]
        copy_matrix(new[0], n, area, old[0])
        copy_matrix(new[1], n, area, old[1])
        copy_matrix(new[2], size, size, old[2])
        copy_vector(new[3], size, old[3])
        if remainder(length, last) < STEP_TOLERANCE:
            return CONVERGED, iteration + 2
        last = length
        damping = next_damping(damping, gain)
    return (STALLED if fall < LEAST_FALL * best else _NOT_CONVERGED,
            max_iterations + 1)


@inner
def _covariances(matrix, fixed, n, size, work, out):
    """
    Put each star's 3 x 3 block of the inverse matrix into out (n, 3, 3).

    Returns the variance of the last parameter, or NaN if there is no inverse;
    then out is NaN, too.
    """
    step, _, frozen, scale, factor, steepest = work
    for a in range(size):
        frozen[a] = fixed[a]
    if not _factorize(matrix, frozen, 0.0, size, steepest, scale, factor):
        out[:n] = np.nan
        return np.nan
    for a in range(size):
        step[:size] = 0.0
        step[a] = 1.0
        _solve(factor, scale, size, step)
        if a < 3 * n:
            s = a // 3
            for b in range(3):
                out[s, a - 3 * s, b] = step[3 * s + b]
                if frozen[a] or frozen[3 * s + b]:
                    out[s, a - 3 * s, b] = np.nan
    return step[size - 1]


@inner
def _measure_fit(x_init, y_init, boxes, weights, residuals, n, out):
    """
    Put three sums of each star's box into out (n, 3).

    They are the sum of absolute residuals, the residual of the pixel at the
    initial position, NaN where it was not fitted, and the sum of squares.
    """
    for s in range(n):
        row, column, height, width = boxes[s]
        total = 0.0
        squares = 0.0
        for i in range(height * width):
            if weights[s, i] > 0:
                total += abs(residuals[s, i])
                squares += weights[s, i] * residuals[s, i] ** 2
        x = ceil(x_init[s] - 0.5) - column
        y = ceil(y_init[s] - 0.5) - row
        centre = np.nan
        if 0 <= x < width and 0 <= y < height and weights[
                s, x * height + y] > 0:
            centre = residuals[s, x * height + y]
        out[s, 0] = total
        out[s, 1] = centre
        out[s, 2] = squares


@inner
def _load_group(image, error, mask, stars, fixed, parameters, limits, data,
                variance):
    """
    Fetch the pixels, initial values and limits of one group.

    stars is (boxes, initial, sky, lower, upper). Returns the number of
    pixels, or -1 if an error is not positive and finite.
    """
    boxes, initial, sky, lower, upper = stars
    n = boxes.shape[0]
    n_pixels = 0
    for s in range(n):
        got = _gather(image, error, mask, boxes[s], sky[s], data[s],
                      variance[s])
        if got < 0:
            return -1
        n_pixels += got
        for b in range(3):
            a = 3 * s + b
            limits[0][a], limits[1][a] = lower[s, b], upper[s, b]
            limits[2][a] = fixed[b]
            parameters[a] = min(max(initial[s, b], lower[s, b]), upper[s, b])
    parameters[3 * n] = 0.0
    limits[0][3 * n], limits[1][3 * n] = -np.inf, np.inf
    limits[2][3 * n] = False
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
def _largest(starts, boxes):
    """Return the most stars of a group and the most pixels of a box."""
    most, area = 1, 1
    for g in range(starts.size - 1):
        most = max(most, starts[g + 1] - starts[g])
    for s in range(boxes.shape[0]):
        area = max(area, boxes[s, 2] * boxes[s, 3])
    return most, area


@kernel(allocates=True)
def fit_stars(image, error, mask, starts, boxes, initial, sky, lower, upper,
              fixed, fit_sky, gain, psf, max_iterations, fitted, fitted_sky,
              covariances, sums, outcome):
    """
    Fit flux, x and y of groups of stars.

    The stars of group g are starts[g] to starts[g + 1]. initial, lower and
    upper are (n, 3); fixed (3,) holds for all; sky (n,) is subtracted before
    the fit, and fit_sky adds one level for each group. error and mask may be
    empty; without errors the scatter of the residuals stands for them.
    Results: fitted (n, 3), fitted_sky (n, 2) with its error, covariances
    (n, 3, 3), sums (n, 3) as of _measure_fit, outcome (n, 2) with the number
    of evaluations.
    """
    most, area = _largest(starts, boxes)
    n_free = 0
    for c in range(fixed.size):
        n_free += not fixed[c]
    size = 3 * most + 1
    data, variance = np.empty((most, area)), np.empty((most, area))
    old = (np.zeros((most, area)), np.empty((most, area)),
           np.empty((size, size)), np.empty(size))
    new = (np.zeros((most, area)), np.empty((most, area)),
           np.empty((size, size)), np.empty(size))
    tiling = (np.empty(4 * LANES), np.empty(3 * LANES * area),
              np.empty(4, np.int64), np.empty((3, 4)))
    scratch = (np.empty((most, 3, area)), np.empty(most, np.bool_), tiling)
    work = (np.empty(size), np.empty(size), np.empty(size, np.bool_),
            np.empty(size), np.empty((size, size)), np.empty(size))
    limits = (np.empty(size), np.empty(size), np.empty(size, np.bool_))
    parameters, chi2 = np.empty(size), np.empty(2)
    for g in range(starts.size - 1):
        n = starts[g + 1] - starts[g]
        stars = slice(starts[g], starts[g + 1])
        n_pixels = _load_group(
            image, error, mask, (boxes[stars], initial[stars], sky[stars],
                                 lower[stars], upper[stars]),
            fixed, parameters, limits, data, variance)
        if n_pixels < 0:
            outcome[stars, 0] = BAD_ERROR
            continue
        pixels = (boxes[stars], data, variance, gain)
        status, evaluations = _minimize(
            parameters, n, fit_sky, pixels, psf, scratch, work, old, new,
            limits, max_iterations, chi2)
        sky_variance = _covariances(old[2], limits[2], n, 3 * n + fit_sky,
                                    work, covariances[stars])
        _measure_fit(initial[stars, 1], initial[stars, 2], boxes[stars],
                     old[0], old[1], n, sums[stars])
        factor = 1.0
        if error.size == 0 and gain == 0:
            factor = _scatter(sums[stars], n_pixels, n * n_free + fit_sky)
        for s in range(n):
            for b in range(3):
                fitted[starts[g] + s, b] = parameters[3 * s + b]
                for c in range(3):
                    covariances[starts[g] + s, b, c] *= factor
        if fit_sky:
            fitted_sky[stars, 0] = parameters[3 * n]
            fitted_sky[stars, 1] = sqrt(factor * sky_variance)
        outcome[stars, 0] = status
        outcome[stars, 1] = evaluations


@kernel(allocates=True)
def star_derivatives(x_0, y_0, box, psf, out):
    """Put the unit-flux PSF in a box, d/dx_0 and d/dy_0 into out (3, n)."""
    tiling = (np.empty(4 * LANES), np.empty(3 * LANES * box[3]),
              np.empty(4, np.int64), np.empty((3, 4)))
    fill_derivatives(x_0, y_0, box, psf, tiling, out)


@kernel(allocates=True)
def star_equations(image, error, mask, boxes, parameters, psf, chi2, n_pixels,
                   matrices, gradients):
    """
    Evaluate stars, each by itself: chi2 (n,), (n, 3, 3) and (n, 3).

    parameters (n, 3) are flux, x and y. Stars without pixels contribute
    nothing; n_pixels (n,) is -1 where an error is not positive and finite.
    """
    _, area = _largest(np.empty(0, np.int64), boxes)
    data, variance = np.empty((1, area)), np.empty((1, area))
    new = (np.zeros((1, area)), np.empty((1, area)), np.empty((3, 3)),
           np.empty(3))
    tiling = (np.empty(4 * LANES), np.empty(3 * LANES * area),
              np.empty(4, np.int64), np.empty((3, 4)))
    scratch = (np.empty((1, 3, area)), np.empty(1, np.bool_), tiling)
    sums = np.empty(2)
    for i in range(boxes.shape[0]):
        matrices[i] = 0.0
        gradients[i] = 0.0
        chi2[i] = 0.0
        n_pixels[i] = _gather(image, error, mask, boxes[i], 0.0, data[0],
                              variance[0])
        if n_pixels[i] <= 0:
            continue
        pixels = (boxes[i:i + 1], data, variance, 0.0)
        _normal_equations(parameters[i], 1, False, pixels, psf, scratch, new,
                          new, sums)
        chi2[i] = sums[1]
        for a in range(3):
            gradients[i, a] = new[3][a]
            for b in range(a + 1):
                matrices[i, a, b] = new[2][a, b]
                matrices[i, b, a] = new[2][a, b]
