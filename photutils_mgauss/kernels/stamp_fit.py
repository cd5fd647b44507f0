"""Least-squares fits of mixtures to an image of the PSF."""
from math import exp
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.descent import (
    FIRST_GROWTH,
    compiled_adapted_damping,
)
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    cholesky,
    clear,
    solve_factored,
    solve_non_negative,
    sum_of,
)
from photutils_mgauss.kernels.stamp_draw import (
    contract,
    derivative_polynomials,
    draw_unit,
    low_moments,
    moments_of_product,
)

# Least-squares fits of a mixture to a stamp. Everything is in stamp pixels
# about a centre near the middle of the stamp. A Gaussian of flux f is a row of
# five shape numbers, x, y, log l, t, log m, the mean and the Cholesky factor
# of the precision matrix:
#
#     g = f l m / (2 pi) exp(-(a^2 + b^2) / 2),  a = l u + t v,  b = m v,
#
# with (u, v) the offset from the mean. Every parameter vector is a Gaussian.
# All derivatives are g times a polynomial of degree 2 in x and y, so the
# normal matrix follows from the moments up to degree 4 of the products of two
# Gaussians: 5 sums a pixel and pair where the Jacobian would need 21 and more.
#
# The fluxes are linear. They are solved for exactly at every step, and the
# shapes move along the Jacobian projected off them (variable projection in
# Kaufman's form); the joint normal matrix with undamped fluxes does both.

# Rows of `limits`, see `penalty`.
_NARROW, _WIDE, _REACH_X, _REACH_Y, _STIFFNESS = range(5)

# The damping that fits start with, of the diagonal, the least one, and one
# so large that no step is left.
_FIRST_DAMPING = 1e-2
_LEAST_DAMPING = 1e-15
_MOST_DAMPING = 1e12

# Fits end where a step promises less than this fraction of the cost.
_LEAST_GAIN = 1e-14

# What fits return.
FIT_CONVERGED, FIT_STOPPED = range(2)


class StampTarget(NamedTuple):
    """
    What a mixture is fitted to, and how.

    ``pixels``, ``weight`` (ny, nx); a weight of 0 leaves a pixel out, whatever
    finite number is in it. ``centre`` (2,) is the pixel x, y to which means
    are relative. ``tie`` (2,) is the total flux and the weight of that
    condition (0: free), ``signed`` whether fluxes may be negative, ``rows``
    (m, ny, nx) sums over the residual whose squares are part of the cost,
    ``fixed_means`` whether means stay as they are, ``limits`` (5,) those of
    `penalty`.
    """

    pixels: np.ndarray
    weight: np.ndarray
    centre: np.ndarray
    tie: tuple
    signed: bool
    rows: np.ndarray
    fixed_means: bool
    limits: np.ndarray


class StampScratch(NamedTuple):
    """
    The memory in which kernels fit K Gaussians to stamps (ny, nx).

    `project` leaves the ``images`` (K, ny, nx) of unit flux and the
    ``residual`` (ny, nx) here, `normal_equations` the ``matrix`` (6K, 6K) and
    the ``gradient`` (6K,), and ``price`` (1,) is that of limits.
    """

    images: np.ndarray
    residual: np.ndarray
    weighted: np.ndarray
    gram: np.ndarray
    rhs: np.ndarray
    gram_factor: np.ndarray
    active: np.ndarray
    columns: np.ndarray
    polynomials: np.ndarray
    sums: np.ndarray
    moments: np.ndarray
    half: np.ndarray
    block: np.ndarray
    matrix: np.ndarray
    factor: np.ndarray
    gradient: np.ndarray
    step: np.ndarray
    trial: np.ndarray
    trial_fluxes: np.ndarray
    slopes: np.ndarray
    price: np.ndarray

    @classmethod
    def empty(cls, k, shape):
        """Return the memory for K Gaussians and stamps of a shape."""
        n = 6 * k
        return cls(
            images=np.empty((k, *shape)), residual=np.empty(shape),
            weighted=np.empty(shape), gram=np.empty((k, k)), rhs=np.empty(k),
            gram_factor=np.empty((k, k)), active=np.empty(k, bool),
            columns=np.empty((5, shape[1])), polynomials=np.empty((k, 6, 6)),
            sums=np.empty(6), moments=np.empty((5, 5)), half=np.empty((6, 6)),
            block=np.empty((6, 6)), matrix=np.empty((n, n)),
            factor=np.empty((n, n)), gradient=np.empty(n), step=np.empty(n),
            trial=np.empty((k, 5)), trial_fluxes=np.empty(k),
            slopes=np.empty(n), price=np.empty(1))


@inner
def _hinge(excess, slopes, stiffness, matrix, gradient):
    """Add the square of an excess > 0 to the normal equations of one shape."""
    if excess <= 0:
        return 0.0
    for i in range(5):
        gradient[i] -= stiffness * excess * slopes[i]
        for j in range(5):
            matrix[i, j] += stiffness * slopes[i] * slopes[j]
    return stiffness * excess * excess


@inner
def penalty(shape, limits, slopes, matrix, gradient):
    """
    Return the price of a Gaussian outside its limits.

    The limits hold for the widths of its cuts along x and y (not narrower
    than the pixels can show) and of its projections (not wider than the
    stamp), and for its mean (on the stamp). Inside them the price is zero; it
    grows with the square of the excess. matrix (5, 5) and gradient (5,)
    receive its share of the normal equations; slopes (at least 5,) is scratch.
    """
    x, y, log_l, t, log_m = shape
    m = exp(log_m)
    stiffness = limits[_STIFFNESS]
    for i in range(5):
        slopes[i] = 0.0
    slopes[2] = 1.0
    price = _hinge(log_l + limits[_NARROW], slopes, stiffness, matrix,
                   gradient)
    norm = t * t + m * m
    slopes[2], slopes[3], slopes[4] = 0.0, t / norm, m * m / norm
    price += _hinge(0.5 * np.log(norm) + limits[_NARROW], slopes, stiffness,
                    matrix, gradient)
    slopes[2], slopes[4] = -1.0, m * m / norm - 1
    price += _hinge(0.5 * np.log(norm) - log_l - log_m - limits[_WIDE],
                    slopes, stiffness, matrix, gradient)
    slopes[2], slopes[3], slopes[4] = 0.0, 0.0, -1.0
    price += _hinge(-log_m - limits[_WIDE], slopes, stiffness, matrix,
                    gradient)
    slopes[4] = 0.0
    slopes[0] = 1 / limits[_REACH_X] if x > 0 else -1 / limits[_REACH_X]
    price += _hinge(abs(x) / limits[_REACH_X] - 1, slopes, stiffness, matrix,
                    gradient)
    slopes[0] = 0.0
    slopes[1] = 1 / limits[_REACH_Y] if y > 0 else -1 / limits[_REACH_Y]
    price += _hinge(abs(y) / limits[_REACH_Y] - 1, slopes, stiffness, matrix,
                    gradient)
    return price


@inner
def _residual(stamp, images, fluxes, out):
    """Put stamp minus model into out (ny, nx)."""
    for j in range(stamp.shape[0]):
        for i in range(stamp.shape[1]):
            out[j, i] = stamp[j, i]
    for k in range(fluxes.size):
        for j in range(stamp.shape[0]):
            for i in range(stamp.shape[1]):
                out[j, i] -= fluxes[k] * images[k, j, i]


@inner
def project(target, shapes, fluxes, scratch):
    """
    Put the best fluxes for the shapes into fluxes; return the chi square.

    The images and the residual are left in scratch.
    """
    images, residual = scratch.images, scratch.residual
    lane = scratch.columns[0]
    draw_unit(shapes, target.centre[0], target.centre[1], scratch.columns[:4],
              images)
    _flux_equations(target, scratch)
    solve_non_negative(scratch.gram, scratch.rhs, target.signed, fluxes,
                       scratch.active, scratch.gram_factor)
    _residual(target.pixels, images, fluxes, residual)
    chi2 = _weighted_dot(residual, residual, target.weight, lane)
    for i in range(target.rows.shape[0]):
        chi2 += _dot(target.rows[i], residual, lane) ** 2
    total, tie_weight = target.tie
    lack = sum_of(fluxes) - total
    return chi2 + tie_weight * lack * lack


@inner
def _flux_equations(target, scratch):
    """Put the normal equations of the fluxes into gram and rhs."""
    images, gram, rhs = scratch.images, scratch.gram, scratch.rhs
    lane = scratch.columns[0]
    total, tie_weight = target.tie
    for k in range(rhs.size):
        rhs[k] = (_weighted_dot(images[k], target.pixels, target.weight, lane)
                  + tie_weight * total)
        for other in range(k + 1):
            gram[k, other] = tie_weight + _weighted_dot(
                images[k], images[other], target.weight, lane)
            gram[other, k] = gram[k, other]
    if target.rows.shape[0] > 0:
        _add_rows_to_fluxes(target, scratch)


# Sums over pixels are taken column by column first: the compiler makes
# vectors of such sums, which it must not of a single one.

@inner
def _weighted_dot(a, b, weight, lane):
    """Return sum_pixels w a b; lane (nx,) is scratch."""
    clear(lane, lane.size)
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += weight[j, i] * a[j, i] * b[j, i]
    return sum_of(lane)


@inner
def _dot(a, b, lane):
    """Return sum_pixels a b; lane (nx,) is scratch."""
    clear(lane, lane.size)
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += a[j, i] * b[j, i]
    return sum_of(lane)


@inner
def _add_rows_to_fluxes(target, scratch):
    """Add rows (m, ny, nx) over the residual to the equations of fluxes."""
    seen, lane = scratch.slopes, scratch.columns[0]
    gram, rhs = scratch.gram, scratch.rhs
    for r in range(target.rows.shape[0]):
        row = target.rows[r]
        want = _dot(row, target.pixels, lane)
        for k in range(rhs.size):
            seen[k] = _dot(row, scratch.images[k], lane)
        for k in range(rhs.size):
            rhs[k] += seen[k] * want
            for other in range(rhs.size):
                gram[k, other] += seen[k] * seen[other]


@inner
def _add_rows(target, fluxes, scratch):
    """Add rows (m, ny, nx) over the residual to the normal equations."""
    slopes, gradient = scratch.slopes, scratch.gradient
    for r in range(target.rows.shape[0]):
        row = target.rows[r]
        left = _dot(row, scratch.residual, scratch.columns[0])
        for k in range(fluxes.size):
            low_moments(row, scratch.images[k], target.centre,
                        scratch.columns, scratch.sums)
            _put_slopes(scratch.polynomials[k], scratch.sums, k, fluxes,
                        slopes)
        for i in range(slopes.size):
            gradient[i] += slopes[i] * left
            for j in range(slopes.size):
                scratch.matrix[i, j] += slopes[i] * slopes[j]


@inner
def _put_slopes(polynomials, sums, k, fluxes, slopes):
    """Put the slopes by the numbers of Gaussian k into slopes (6K,)."""
    for i in range(6):
        slope = 0.0
        for a in range(6):
            slope += polynomials[i, a] * sums[a]
        slopes[_unknown(fluxes.size, k, i)] = slope * (fluxes[k] if i else 1.0)


@inner
def normal_equations(target, shapes, fluxes, scratch):
    """
    Put the normal equations into matrix (6K, 6K) and gradient (6K,).

    The unknowns are the K fluxes and five shape numbers for each Gaussian.
    The images and the residual come from `project`. Penalties are not added.
    """
    weight, images = target.weight, scratch.images
    polynomials = scratch.polynomials
    for j in range(weight.shape[0]):
        for i in range(weight.shape[1]):
            scratch.weighted[j, i] = weight[j, i] * scratch.residual[j, i]
    for k in range(fluxes.size):
        derivative_polynomials(shapes[k], polynomials[k])
        low_moments(images[k], scratch.weighted, target.centre,
                    scratch.columns, scratch.sums)
        _put_slopes(polynomials[k], scratch.sums, k, fluxes, scratch.gradient)
    for k in range(fluxes.size):
        for other in range(k + 1):
            _add_pair(target, k, other, fluxes, scratch)
    if target.rows.shape[0] > 0:
        _add_rows(target, fluxes, scratch)


@inner
def _add_pair(target, k, other, fluxes, scratch):
    """Write what two Gaussians share into the normal matrix."""
    matrix = scratch.matrix
    moments_of_product(scratch.images[k], scratch.images[other],
                       target.weight, target.centre[0], target.centre[1],
                       scratch.columns, scratch.moments)
    contract(scratch.polynomials[k], scratch.moments,
             scratch.polynomials[other], scratch.half, scratch.block)
    _place(scratch.block, k, other, fluxes, matrix)
    matrix[k, other] += target.tie[1]
    matrix[other, k] = matrix[k, other]


@inner
def _unknown(n, k, i):
    """Return where number i (0: flux) of Gaussian k of n is stored."""
    return k if i == 0 else n + 5 * k + i - 1


@inner
def _place(block, k, other, fluxes, matrix):
    """Write the 6x6 block of two Gaussians into the normal matrix."""
    n = fluxes.size
    for i in range(6):
        row = _unknown(n, k, i)
        scale = fluxes[k] if i else 1.0
        for j in range(6):
            column = _unknown(n, other, j)
            value = scale * block[i, j] * (fluxes[other] if j else 1.0)
            matrix[row, column] = value
            matrix[column, row] = value


@inner
def _price(shapes, limits, slopes, matrix, gradient):
    """Add the limits to the normal equations; return their price."""
    n = shapes.shape[0]
    price = 0.0
    for k in range(n):
        first = n + 5 * k
        price += penalty(shapes[k], limits, slopes,
                         matrix[first:first + 5, first:first + 5],
                         gradient[first:first + 5])
    return price


@inner
def _damp(fluxes, damping, fixed_means, scratch):
    """
    Put the damped normal matrix into factor and the right side into step.

    The fluxes are not damped. A Gaussian without flux stands still. Returns
    what is added to the diagonal before it is damped.
    """
    n, size = fluxes.size, scratch.gradient.size
    matrix, factor, step = scratch.matrix, scratch.factor, scratch.step
    floor = 0.0
    for i in range(n, size):
        floor = max(floor, 1e-9 * matrix[i, i])
    for i in range(size):
        k = i if i < n else (i - n) // 5
        still = fluxes[k] == 0 or (fixed_means and i >= n
                                   and (i - n) % 5 < 2)
        step[i] = 0.0 if still else scratch.gradient[i]
        for j in range(i):
            other = j if j < n else (j - n) // 5
            factor[i, j] = (0.0 if still or fluxes[other] == 0
                            else matrix[i, j])
        factor[i, i] = matrix[i, i]
        if i >= n:
            factor[i, i] += damping * (matrix[i, i] + floor)
        if still:
            factor[i, i] = 1.0
    if fixed_means:
        _uncouple_means(n, factor)
    return floor


@inner
def _uncouple_means(n, factor):
    for k in range(n):
        for c in range(2):
            i = n + 5 * k + c
            for j in range(i + 1, factor.shape[0]):
                factor[j, i] = 0.0


@inner
def _find_step(fluxes, damping, fixed_means, scratch):
    """
    Put the damped step of all unknowns into step (6K,).

    Returns the predicted decrease of the cost.
    """
    matrix, step = scratch.matrix, scratch.step
    floor = _damp(fluxes, damping, fixed_means, scratch)
    # A pivot lost to rounding stops its unknown instead of the fit.
    cholesky(scratch.factor, step.size, 1e-14)
    solve_factored(scratch.factor, step.size, step)
    gain = 0.0
    for i in range(fluxes.size, step.size):
        gain += step[i] * (scratch.gradient[i] + damping * step[i]
                           * (matrix[i, i] + floor))
    return gain


@inner
def _move(shapes, step, out):
    """Put shapes moved by the step into out, no width by more than e-fold."""
    n = shapes.shape[0]
    for k in range(n):
        for i in range(5):
            change = step[n + 5 * k + i]
            if i == 2 or i == 4:
                change = min(max(change, -1.0), 1.0)
            out[k, i] = shapes[k, i] + change


@inner
def _cost(target, shapes, fluxes, scratch):
    """Return the cost of shapes; their fluxes are solved for."""
    cost = project(target, shapes, fluxes, scratch)
    # The equations of the last point may still be needed.
    return cost + _price(shapes, target.limits, scratch.slopes,
                         scratch.factor, scratch.step)


@inner
def _equations(target, shapes, fluxes, scratch):
    """Put the normal equations into scratch, those of the limits, too."""
    normal_equations(target, shapes, fluxes, scratch)
    scratch.price[0] = _price(shapes, target.limits, scratch.slopes,
                              scratch.matrix, scratch.gradient)


@inner
def _take_trial(scratch, shapes, fluxes):
    """Make the trial the present point."""
    for k in range(fluxes.size):
        fluxes[k] = scratch.trial_fluxes[k]
        for i in range(5):
            shapes[k, i] = scratch.trial[k, i]


@inner
def _fit_shapes(target, shapes, fluxes, tolerance, max_steps, scratch):
    """
    Fit K Gaussians to a stamp by Levenberg-Marquardt, in place.

    The damping is that of `adapted_damping`. Returns cost and status.
    """
    cost = _cost(target, shapes, fluxes, scratch)
    _equations(target, shapes, fluxes, scratch)
    damping, growth, n_small = _FIRST_DAMPING, FIRST_GROWTH, 0
    for n_steps in range(1, max_steps + 1):
        gain = _find_step(fluxes, damping, target.fixed_means, scratch)
        _move(shapes, scratch.step, scratch.trial)
        trial_cost = _cost(target, scratch.trial, scratch.trial_fluxes,
                           scratch)
        fall = cost - trial_cost
        damping, growth = compiled_adapted_damping(damping, growth, fall,
                                                   gain)
        damping = max(damping, _LEAST_DAMPING)
        if not fall > 0:
            if damping > _MOST_DAMPING or not gain > _LEAST_GAIN * cost:
                return cost, FIT_CONVERGED
            continue
        _take_trial(scratch, shapes, fluxes)
        n_small = n_small + 1 if fall <= tolerance * cost else 0
        cost = trial_cost
        if n_small >= 2:
            return cost, FIT_CONVERGED
        if n_steps < max_steps:
            _equations(target, shapes, fluxes, scratch)
    return cost, FIT_STOPPED


@kernel
def fit_starts(target, shapes, fluxes, tolerance, max_steps, scratch, costs,
               statuses):
    """
    Fit K Gaussians to a stamp from each of several starts, in place.

    Parameters
    ----------
    target : StampTarget
    shapes, fluxes : (n, K, 5), (n, K)
        Where to start (fluxes are only written), and the results.
    tolerance, max_steps
        Stop when two steps running lower the cost by less than this fraction,
        or after so many steps. Without steps the images, the normal equations
        and the price of limits at the last start are left in scratch.
    scratch : StampScratch
    costs, statuses : (n,)
        Are written.
    """
    for i in range(costs.size):
        costs[i], statuses[i] = _fit_shapes(
            target, shapes[i], fluxes[i], tolerance, max_steps, scratch)
