"""Least-squares fits of mixtures to an image of the PSF."""
from math import exp

import numpy as np

from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    _factor,
    _solve_factored,
    _solve_fluxes,
    copy_matrix,
    copy_vector,
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

_LOG_2PI = float(np.log(2 * np.pi))

# Rows of `limits`, see `penalty`.
_NARROW, _WIDE, _REACH_X, _REACH_Y, _STIFFNESS = range(5)

# What fit_stamp returns.
FIT_CONVERGED, FIT_STOPPED = range(2)


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


@kernel(allocates=True)
def penalty(shape, limits, matrix, gradient):
    """
    Return the price of a Gaussian outside its limits.

    The limits hold for the widths of its cuts along x and y (not narrower
    than the pixels can show) and of its projections (not wider than the
    stamp), and for its mean (on the stamp). Inside them the price is zero; it
    grows with the square of the excess. matrix (5, 5) and gradient (5,)
    receive its share of the normal equations.
    """
    x, y, log_l, t, log_m = shape
    m = exp(log_m)
    stiffness = limits[_STIFFNESS]
    slopes = np.zeros(5)
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


@kernel
def project(stamp, weight, centre, shapes, tie, signed, rows, fluxes,
            scratch):
    """
    Put the best fluxes for the shapes into fluxes; return the chi square.

    tie is the total flux and the weight of that condition (0: free). rows
    (m, ny, nx) are sums over the residual whose squares count too; m may be
    0. The images and the residual are left in scratch.
    """
    images, residual, _, gram, rhs, work, active, lanes = scratch[:8]
    total, tie_weight = tie
    draw_unit(shapes, centre[0], centre[1], lanes[:4], images)
    n = fluxes.size
    for k in range(n):
        rhs[k] = (_weighted_dot(images[k], stamp, weight, lanes[0])
                  + tie_weight * total)
        for other in range(k + 1):
            gram[k, other] = tie_weight + _weighted_dot(
                images[k], images[other], weight, lanes[0])
            gram[other, k] = gram[k, other]
    if rows.shape[0] > 0:
        _add_rows_to_fluxes(rows, stamp, images, lanes[0], gram, rhs)
    _solve_fluxes(gram, rhs, signed, fluxes, active, work)
    _residual(stamp, images, fluxes, residual)
    chi2 = _weighted_dot(residual, residual, weight, lanes[0])
    for row in rows:
        chi2 += _dot(row, residual, lanes[0]) ** 2
    lack = fluxes.sum() - total
    return chi2 + tie_weight * lack * lack


# Sums over pixels are taken column by column first: the compiler makes
# vectors of such sums, which it must not of a single one.

@inner
def _weighted_dot(a, b, weight, lane):
    """Return sum_pixels w a b; lane (nx,) is scratch."""
    lane[:] = 0.0
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += weight[j, i] * a[j, i] * b[j, i]
    return lane.sum()


@inner
def _dot(a, b, lane):
    """Return sum_pixels a b; lane (nx,) is scratch."""
    lane[:] = 0.0
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += a[j, i] * b[j, i]
    return lane.sum()


@inner(allocates=True)
def _add_rows_to_fluxes(rows, stamp, images, lane, gram, rhs):
    """Add rows (m, ny, nx) over the residual to the equations of fluxes."""
    seen = np.empty(images.shape[0])
    for row in rows:
        want = _dot(row, stamp, lane)
        for k in range(seen.size):
            seen[k] = _dot(row, images[k], lane)
        for k in range(seen.size):
            rhs[k] += seen[k] * want
            for other in range(seen.size):
                gram[k, other] += seen[k] * seen[other]


@inner(allocates=True)
def _add_rows(rows, centre, residual, images, fluxes, polynomials, columns,
              matrix, gradient):
    """Add rows (m, ny, nx) over the residual to the normal equations."""
    n = fluxes.size
    sums, slopes = np.empty(6), np.empty(6 * n)
    for row in rows:
        left = _dot(row, residual, columns[0])
        for k in range(n):
            low_moments(row, images[k], centre, columns, sums)
            _put_slopes(polynomials[k], sums, k, fluxes, slopes)
        for i in range(6 * n):
            gradient[i] += slopes[i] * left
            for j in range(6 * n):
                matrix[i, j] += slopes[i] * slopes[j]


@inner
def _put_slopes(polynomials, sums, k, fluxes, slopes):
    """Put the slopes by the numbers of Gaussian k into slopes (6K,)."""
    for i in range(6):
        slope = 0.0
        for a in range(6):
            slope += polynomials[i, a] * sums[a]
        slopes[_unknown(fluxes.size, k, i)] = slope * (fluxes[k] if i else 1.0)


@kernel
def normal_equations(weight, centre, shapes, fluxes, tie, rows, scratch,
                     matrix, gradient):
    """
    Put the normal equations into matrix (6K, 6K) and gradient (6K,).

    The unknowns are the K fluxes and five shape numbers for each Gaussian.
    The images and the residual come from `project`.
    """
    images, residual, weighted = scratch[:3]
    columns, polynomials, sums, moments, half, block = scratch[7:]
    n = fluxes.size
    for j in range(weight.shape[0]):
        for i in range(weight.shape[1]):
            weighted[j, i] = weight[j, i] * residual[j, i]
    for k in range(n):
        derivative_polynomials(shapes[k], polynomials[k])
        low_moments(images[k], weighted, centre, columns, sums)
        _put_slopes(polynomials[k], sums, k, fluxes, gradient)
    for k in range(n):
        for other in range(k + 1):
            moments_of_product(images[k], images[other], weight, centre[0],
                                centre[1], columns, moments)
            contract(polynomials[k], moments, polynomials[other], half,
                      block)
            _place(block, k, other, fluxes, matrix)
            matrix[k, other] += tie[1]
            matrix[other, k] = matrix[k, other]
    if rows.shape[0] > 0:
        _add_rows(rows, centre, residual, images, fluxes, polynomials,
                  columns, matrix, gradient)


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


@kernel
def add_penalties(shapes, limits, matrix, gradient):
    """Add the limits to the normal equations; return their price."""
    n = shapes.shape[0]
    price = 0.0
    for k in range(n):
        first = n + 5 * k
        price += penalty(shapes[k], limits,
                          matrix[first:first + 5, first:first + 5],
                          gradient[first:first + 5])
    return price


@inner
def _step(matrix, gradient, fluxes, damping, fixed_means, factor, step):
    """
    Put the damped step of all unknowns into step (6K,).

    The fluxes are not damped. A Gaussian without flux stands still. Returns
    the predicted decrease of the cost.
    """
    n = fluxes.size
    size = gradient.size
    floor = 0.0
    for i in range(n, size):
        floor = max(floor, matrix[i, i])
    for i in range(size):
        k = i if i < n else (i - n) // 5
        still = fluxes[k] == 0 or (fixed_means and i >= n
                                   and (i - n) % 5 < 2)
        step[i] = 0.0 if still else gradient[i]
        for j in range(i):
            other = j if j < n else (j - n) // 5
            factor[i, j] = (0.0 if still or fluxes[other] == 0
                            else matrix[i, j])
        factor[i, i] = matrix[i, i]
        if i >= n:
            factor[i, i] += damping * (matrix[i, i] + 1e-9 * floor)
        if still:
            factor[i, i] = 1.0
    if fixed_means:
        _uncouple_means(n, factor)
    _factor(factor, size)
    _solve_factored(factor, size, step)
    gain = 0.0
    for i in range(n, size):
        gain += step[i] * (gradient[i] + damping * step[i]
                           * (matrix[i, i] + 1e-9 * floor))
    return gain


@inner
def _uncouple_means(n, factor):
    for k in range(n):
        for c in range(2):
            i = n + 5 * k + c
            for j in range(i + 1, factor.shape[0]):
                factor[j, i] = 0.0


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
def fit_shapes(stamp, weight, centre, shapes, fluxes, tie, signed, rows,
               fixed_means, limits, tolerance, max_steps, scratch, matrices,
               vectors):
    """
    Fit K Gaussians to a stamp by Levenberg-Marquardt, in place.

    Parameters
    ----------
    stamp, weight : (ny, nx)
        Pixels and their weights; a weight of 0 leaves a pixel out, whatever
        finite number is in it.
    centre : (2,)
        The pixel x, y to which the means are relative.
    shapes, fluxes : (K, 5), (K,)
        Where to start (the fluxes are only written), and the result.
    tie : (2,)
        The total flux and the weight of that condition (0: free).
    signed : bool
        Whether fluxes may be negative.
    rows : (m, ny, nx)
        Sums over the residual whose squares are part of the cost.
    fixed_means : bool
        Whether means stay as they are.
    limits : (5,)
        See `penalty`.
    tolerance, max_steps
        Stop when two steps running lower the cost by less than this fraction,
        or after so many steps.
    scratch, matrices, vectors
        From `fitting.Workspace`.

    Returns
    -------
    cost, status, steps
    """
    matrix, factor = matrices
    gradient, step, trial, trial_fluxes = vectors
    idle_matrix, idle_gradient = factor, step
    cost = project(stamp, weight, centre, shapes, tie, signed, rows, fluxes,
                   scratch)
    if max_steps > 0:
        normal_equations(weight, centre, shapes, fluxes, tie, rows, scratch,
                         matrix, gradient)
    cost += add_penalties(shapes, limits, matrix, gradient)
    damping, growth, small = 1e-2, 2.0, 0
    for n_steps in range(1, max_steps + 1):
        gain = _step(matrix, gradient, fluxes, damping, fixed_means, factor,
                     step)
        _move(shapes, step, trial)
        trial_cost = project(stamp, weight, centre, trial, tie, signed, rows,
                             trial_fluxes, scratch)
        trial_cost += add_penalties(trial, limits, idle_matrix,
                                     idle_gradient)
        if not trial_cost < cost:
            damping *= growth
            growth *= 2
            if damping > 1e12 or not gain > 1e-14 * cost:
                return cost, FIT_CONVERGED, n_steps
            continue
        drop = cost - trial_cost
        copy_matrix(trial, trial.shape[0], trial.shape[1], shapes)
        copy_vector(trial_fluxes, trial_fluxes.size, fluxes)
        small = small + 1 if drop <= tolerance * cost else 0
        cost = trial_cost
        if small >= 2:
            return cost, FIT_CONVERGED, n_steps
        if n_steps == max_steps:
            break
        normal_equations(weight, centre, shapes, fluxes, tie, rows, scratch,
                         matrix, gradient)
        add_penalties(shapes, limits, matrix, gradient)
        quality = 2 * drop / max(gain, 1e-300) - 1
        damping = max(damping * max(0.2, 1 - quality ** 3), 1e-15)
        growth = 2.0
    return cost, FIT_STOPPED, max_steps


@kernel
def fit_starts(stamp, weight, centre, shapes, fluxes, tie, signed, rows,
               fixed_means, limits, tolerance, max_steps, scratch, matrices,
               vectors, costs, statuses):
    """
    Do `fit_shapes` from each of several starts, in place.

    shapes is (n, K, 5), fluxes (n, K); costs and statuses (n,) are written.
    """
    for i in range(costs.size):
        costs[i], statuses[i], _ = fit_shapes(
            stamp, weight, centre, shapes[i], fluxes[i], tie, signed, rows,
            fixed_means, limits, tolerance, max_steps, scratch, matrices,
            vectors)
