r"""
The loops over pixels: every compiled function of the package.

All arrays are float64 and C-contiguous; results go into arrays passed in.
The kernels release the interpreter lock, use one thread each and raise
nothing; callers check arguments first and spread work over threads. They
live in one file because the compiler's cache on disk does not notice an edit
in another one.

A Gaussian of covariance :math:`\Sigma` is handed over as a row of six
numbers, *amplitude, x, y, p, s, q*: its peak value, its centre, and the
factors of its exponent when :math:`x` is conditioned on :math:`y`,

.. math::

    g = A \exp\left[-\tfrac12 \left(p\,(x - s y)^2 + q\,y^2\right)\right],
    \quad q = 1 / \Sigma_{yy},\ s = \Sigma_{xy} / \Sigma_{yy},\
    p = \Sigma_{yy} / \det\Sigma .

This form loses no digits to cancellation when the Gaussian is thin and
tilted, and it is what a walk along a pixel row needs.
"""
from decimal import Decimal
from math import ceil, erf, exp, factorial, floor, log, sqrt

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

_jit = njit(cache=True, nogil=True, error_model='numpy')

# Nodes and weights of 8-point Gauss-Legendre quadrature on (-1/2, 1/2);
# numpy.polynomial.legendre.leggauss(8), halved.
_NODES = np.polynomial.legendre.leggauss(8)[0] / 2
_NODE_WEIGHTS = np.polynomial.legendre.leggauss(8)[1] / 2

# Below this fraction of its peak a Gaussian is left out of a row: the numbers
# that follow are subnormal, a hundred times slower and 280 orders of
# magnitude below anything visible, so the cut makes no step in value or slope.
_NOTHING = 1e-290
_LOG_NOTHING = -2 * np.log(_NOTHING)

_HALF_PI_ROOT = sqrt(np.pi / 2)


# The exponential function, in a form that the compiler turns into vector
# instructions: four to five times as fast in a loop over pixels as the one of
# the C library, and as accurate.

# 1.5 * 2^52: adding it rounds to an integer, which then is in the low bits.
_ROUND = 1.5 * 2.0**52
_LOG2_E = 1 / np.log(2)
# log(2) in two parts; 32 bits times an exponent of 11 bits make no error.
_LOG2_HIGH = np.floor(np.log(2) * 2.0**32) / 2.0**32
_LOG2_LOW = float(Decimal(2).ln() - Decimal(_LOG2_HIGH))
# Taylor's series; |r| < log(2) / 2 leaves 4e-18 after 13 terms.
_TERMS = tuple(1 / factorial(n) for n in range(13, -1, -1))


@intrinsic
def _float_of_bits(context, bits):
    def generate(context, builder, signature, args):
        return builder.bitcast(args[0],
                               context.get_value_type(types.float64))
    return types.float64(types.int64), generate


@intrinsic
def _bits_of_float(context, number):
    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(types.int64))
    return types.int64(types.float64), generate


@_jit
def _exp(x):
    """Return exp(x) for x <= 0, and 0 where that is below 1e-299."""
    shifted = x * _LOG2_E + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LOG2_HIGH) - n * _LOG2_LOW
    series = _TERMS[0]
    for term in _TERMS[1:]:
        series = series * r + term
    power = _float_of_bits((_bits_of_float(shifted) + 1023) << 52)
    return 0.0 if x < -688 else series * power


@_jit
def exponentials(x, out):
    """Put exp(x), x <= 0, into out (n,); for tests."""
    for i in range(x.size):
        out[i] = _exp(x[i])


# One Gaussian at one point. (dx, dy) is the offset from the centre.

@_jit
def _gaussian(dx, dy, p, s, q):
    """Return a Gaussian of unit peak."""
    u = dx - s * dy
    return exp(-0.5 * (p * u * u + q * dy * dy))


@_jit
def _slice_integral(lower, upper, p):
    """Integrate exp(-p t^2 / 2) from lower to upper."""
    root = sqrt(0.5 * p)
    return _HALF_PI_ROOT / sqrt(p) * (erf(root * upper) - erf(root * lower))


@_jit
def _panels(p, s, q):
    """Return how many quadrature panels a pixel needs along y."""
    # At fixed x the Gaussian has the precision q + s^2 p along y. Eight
    # points over two standard deviations leave less than 1e-11 of the peak.
    return max(1, ceil(0.5 * sqrt(q + s * s * p)))


@_jit
def _pixel_integral(dx, dy, p, s, q):
    """Integrate a Gaussian of unit peak over the unit pixel at (dx, dy)."""
    n = _panels(p, s, q)
    total = 0.0
    for panel in range(n):
        middle = dy - 0.5 + (panel + 0.5) / n
        for node in range(_NODES.size):
            t = middle + _NODES[node] / n
            shift = dx - s * t
            total += (_NODE_WEIGHTS[node] * exp(-0.5 * q * t * t)
                      * _slice_integral(shift - 0.5, shift + 0.5, p))
    return total / n


@_jit
def _value(dx, dy, p, s, q, integrated):
    if integrated:
        return _pixel_integral(dx, dy, p, s, q)
    return _gaussian(dx, dy, p, s, q)


@_jit
def _edge(dx, dy, p, s, q):
    """
    Integrate g and dg/dx over y in dy +- 1/2 on the line x = dx.

    Both are closed forms: at fixed x, g is a Gaussian in y of mean m and
    precision r.
    """
    r = q + s * s * p
    m = s * p * dx / r
    low, high = dy - 0.5 - m, dy + 0.5 - m
    ridge = exp(-0.5 * (p * q / r) * dx * dx)
    value = ridge * _slice_integral(low, high, r)
    # Integral of (y - m) g.
    first = ridge * (exp(-0.5 * r * low * low)
                     - exp(-0.5 * r * high * high)) / r
    slope = -p * ((dx - s * m) * value - s * first)
    return value, slope


@_jit
def _gradient(dx, dy, p, s, q, integrated):
    """Return dg/dx and dg/dy, of the value or of the pixel integral."""
    if not integrated:
        g = _gaussian(dx, dy, p, s, q)
        a = p * (dx - s * dy)
        return -a * g, -(q * dy - s * a) * g
    # The derivative of an integral over a pixel is the difference between
    # its two sides.
    right, _ = _edge(dx + 0.5, dy, p, s, q)
    left, _ = _edge(dx - 0.5, dy, p, s, q)
    pt, st, qt = _transposed(p, s, q)
    top, _ = _edge(dy + 0.5, dx, pt, st, qt)
    bottom, _ = _edge(dy - 0.5, dx, pt, st, qt)
    return right - left, top - bottom


@_jit
def _transposed(p, s, q):
    """Return the factors of the same Gaussian with x and y exchanged."""
    r = q + s * s * p
    return r, s * p / r, p * q / r


@_jit
def _hessian(dx, dy, p, s, q, integrated):
    """Return d2g/dx2, d2g/dxdy, d2g/dy2, of value or pixel integral."""
    if not integrated:
        g = _gaussian(dx, dy, p, s, q)
        a = p * (dx - s * dy)
        b = q * dy - s * a
        return ((a * a - p) * g, (a * b + s * p) * g,
                (b * b - q - s * s * p) * g)
    _, right = _edge(dx + 0.5, dy, p, s, q)
    _, left = _edge(dx - 0.5, dy, p, s, q)
    pt, st, qt = _transposed(p, s, q)
    _, top = _edge(dy + 0.5, dx, pt, st, qt)
    _, bottom = _edge(dy - 0.5, dx, pt, st, qt)
    corners = (_gaussian(dx + 0.5, dy + 0.5, p, s, q)
               - _gaussian(dx - 0.5, dy + 0.5, p, s, q)
               - _gaussian(dx + 0.5, dy - 0.5, p, s, q)
               + _gaussian(dx - 0.5, dy - 0.5, p, s, q))
    return right - left, corners, top - bottom


# Mixtures at arbitrary points. rows is (K, 6); x and y are (n,).

@_jit
def _add_values(x, y, x_0, y_0, row, scale, integrated, out):
    """Add a Gaussian, centred on (x_0, y_0) plus its mean, to out (n,)."""
    a, mx, my, p, s, q = row
    peak = scale * a
    left, bottom = x_0 + mx, y_0 + my
    if integrated:
        for i in range(x.size):
            out[i] += peak * _pixel_integral(x[i] - left, y[i] - bottom, p, s,
                                             q)
        return
    for i in range(x.size):
        dy = y[i] - bottom
        u = x[i] - left - s * dy
        out[i] += peak * _exp(-0.5 * (p * u * u + q * dy * dy))


@_jit
def _add_jet(x, y, x_0, y_0, row, scales, integrated, out):
    """
    Add value, slope by x_0 and slope by y_0 of a Gaussian to out (3, n).

    scales (3,) is what multiplies it, and the slopes of that.
    """
    a, mx, my, p, s, q = row
    value, by_x, by_y = a * scales[0], a * scales[1], a * scales[2]
    left, bottom = x_0 + mx, y_0 + my
    if integrated:
        for i in range(x.size):
            dx, dy = x[i] - left, y[i] - bottom
            g = _pixel_integral(dx, dy, p, s, q)
            gx, gy = _gradient(dx, dy, p, s, q, True)
            out[0, i] += value * g
            out[1, i] += by_x * g - value * gx
            out[2, i] += by_y * g - value * gy
        return
    for i in range(x.size):
        dy = y[i] - bottom
        u = x[i] - left - s * dy
        g = _exp(-0.5 * (p * u * u + q * dy * dy))
        slope = p * u
        out[0, i] += value * g
        out[1, i] += (by_x + value * slope) * g
        out[2, i] += (by_y + value * (q * dy - s * slope)) * g


@_jit
def evaluate(x, y, rows, integrated, out):
    """Put the mixture at the points into out (n,)."""
    out[:] = 0.0
    for k in range(rows.shape[0]):
        _add_values(x, y, 0.0, 0.0, rows[k], 1.0, integrated, out)


@_jit
def gradient(x, y, rows, integrated, out):
    """Put d/dx and d/dy of the mixture into out (2, n)."""
    for i in range(x.size):
        gx = 0.0
        gy = 0.0
        for k in range(rows.shape[0]):
            a, mx, my, p, s, q = rows[k]
            dgx, dgy = _gradient(x[i] - mx, y[i] - my, p, s, q, integrated)
            gx += a * dgx
            gy += a * dgy
        out[0, i] = gx
        out[1, i] = gy


@_jit
def jets(x, y, rows, integrated, out):
    """
    Put each Gaussian and its five derivatives into out (K, 6, n).

    In order g, g_x, g_y, g_xx, g_xy, g_yy. They are all that any parameter
    of a Gaussian needs, because a Gaussian obeys the heat equation:
    dg/dSigma_xx = g_xx / 2, dg/dSigma_xy = g_xy, dg/dSigma_yy = g_yy / 2.
    """
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        for i in range(x.size):
            dx, dy = x[i] - mx, y[i] - my
            gx, gy = _gradient(dx, dy, p, s, q, integrated)
            gxx, gxy, gyy = _hessian(dx, dy, p, s, q, integrated)
            out[k, 0, i] = a * _value(dx, dy, p, s, q, integrated)
            out[k, 1, i] = a * gx
            out[k, 2, i] = a * gy
            out[k, 3, i] = a * gxx
            out[k, 4, i] = a * gxy
            out[k, 5, i] = a * gyy


# The shape parameters of an astropy model, (6 K - 1,): K - 1 stick-breaking
# fractions, then x, y, stddev_x, stddev_y, rho of each Gaussian.

@_jit
def model_rows(values, min_stddev, max_rho, rows):
    """Put the mixture of any parameters, valid or not, into rows (K, 6)."""
    n = rows.shape[0]
    rest = 1.0
    for k in range(n):
        fraction = values[k] if k < n - 1 else 1.0
        first = n - 1 + 5 * k
        sx = max(abs(values[first + 2]), min_stddev)
        sy = max(abs(values[first + 3]), min_stddev)
        rho = min(max(values[first + 4], -max_rho), max_rho)
        p = 1 / (sx * sx * (1 - rho) * (1 + rho))
        q = 1 / (sy * sy)
        rows[k, 0] = rest * fraction * sqrt(p * q) / (2 * np.pi)
        rows[k, 1] = values[first]
        rows[k, 2] = values[first + 1]
        rows[k, 3] = p
        rows[k, 4] = rho * sx / sy
        rows[k, 5] = q
        rest *= 1 - fraction


# Mixtures on a pixel lattice.

@_jit
def _add_row(peak, u0, p, out):
    """
    Add peak * exp(-p u^2 / 2) for u = u0, u0 + 1, ... to out (n,).

    The quotient of neighbouring pixels falls by exp(-p) each step, so a pixel
    costs two multiplications. The walk starts at the pixel nearest the peak
    and goes outward both ways: from far out, the first value would underflow.
    """
    n = out.size
    start = min(max(int(np.rint(-u0)), 0), n - 1)
    u = u0 + start
    if p * u * u > _LOG_NOTHING:
        return
    first = peak * exp(-0.5 * p * u * u)
    fall = exp(-p)
    out[start] += first
    g = first
    r = exp(-p * (u + 0.5))
    for i in range(start + 1, n):
        g *= r
        if abs(g) < _NOTHING:
            break
        r *= fall
        out[i] += g
    g = first
    r = exp(-p * (0.5 - u))
    for i in range(start - 1, -1, -1):
        g *= r
        if abs(g) < _NOTHING:
            break
        r *= fall
        out[i] += g


@_jit
def _add_integrated_row(peak, dx, dy, p, s, q, out):
    """Add the pixel integrals of one row; dx is the offset of its first."""
    panels = _panels(p, s, q)
    for panel in range(panels):
        middle = dy - 0.5 + (panel + 0.5) / panels
        for node in range(_NODES.size):
            t = middle + _NODES[node] / panels
            ridge = (peak * _NODE_WEIGHTS[node] / panels
                     * exp(-0.5 * q * t * t) * _HALF_PI_ROOT / sqrt(p))
            if abs(ridge) < _NOTHING:
                continue
            root = sqrt(0.5 * p)
            left = erf(root * (dx - 0.5 - s * t))
            for i in range(out.size):
                right = erf(root * (dx + i + 0.5 - s * t))
                out[i] += ridge * (right - left)
                left = right


@_jit
def render(rows, x_0, y_0, flux, integrated, out):
    """Add flux times the mixture, centred on (x_0, y_0), to out (ny, nx)."""
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        dx = -x_0 - mx
        for j in range(out.shape[0]):
            dy = j - y_0 - my
            if integrated:
                _add_integrated_row(flux * a, dx, dy, p, s, q, out[j])
            elif q * dy * dy < _LOG_NOTHING:
                ridge = flux * a * exp(-0.5 * q * dy * dy)
                _add_row(ridge, dx - s * dy, p, out[j])


# A grid of mixtures, four neighbours blended. nodes is (M, K, 6), ordered by
# y, then x; x_grid (nx,) and y_grid (ny,) ascend, nx * ny = M.

@_jit
def _cell(position, grid):
    """
    Return the cell, its blend fraction and the fraction's slope.

    Outside the grid the fraction is clamped to the edge and does not change.
    """
    if grid.size == 1:
        return 0, 0.0, 0.0
    i = np.searchsorted(grid, position, side='right') - 1
    i = min(max(i, 0), grid.size - 2)
    width = grid[i + 1] - grid[i]
    fraction = (position - grid[i]) / width
    if fraction < 0:
        return i, 0.0, 0.0
    if fraction > 1:
        return i, 1.0, 0.0
    return i, fraction, 1 / width


@_jit
def blend_weights(x_0, y_0, x_grid, y_grid, index, weights):
    """
    Find the four neighbours, for index (4,), and their bilinear weights.

    weights (3, 4) takes the weights and their derivatives by x_0 and y_0.
    """
    i, fx, sx = _cell(x_0, x_grid)
    j, fy, sy = _cell(y_0, y_grid)
    i_next = min(i + 1, x_grid.size - 1)
    j_next = min(j + 1, y_grid.size - 1)
    for corner in range(4):
        right = corner % 2 == 1
        top = corner >= 2
        index[corner] = ((j_next if top else j) * x_grid.size
                         + (i_next if right else i))
        wx = fx if right else 1 - fx
        wy = fy if top else 1 - fy
        weights[0, corner] = wx * wy
        weights[1, corner] = (sx if right else -sx) * wy
        weights[2, corner] = wx * (sy if top else -sy)


@_jit
def evaluate_grid(x, y, flux, x_0, y_0, nodes, x_grid, y_grid, integrated,
                  out):
    """
    Put the blended PSF at the points into out (n,).

    flux has one element or n; x_0 and y_0 have one element, or n for a star
    of its own at each point.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    per_point = x_0.size > 1
    out[:] = 0.0
    for star in range(x_0.size):
        points = slice(star, star + 1) if per_point else slice(0, x.size)
        blend_weights(x_0[star], y_0[star], x_grid, y_grid, index, weights)
        for corner in range(4):
            w = weights[0, corner]
            if w == 0:
                continue
            for row in nodes[index[corner]]:
                if row[0] != 0:
                    _add_values(x[points], y[points], x_0[star], y_0[star],
                                row, w, integrated, out[points])
    for i in range(x.size):
        out[i] *= flux[i if flux.size > 1 else 0]


@_jit
def differentiate_grid(x, y, x_0, y_0, nodes, x_grid, y_grid, integrated,
                       out):
    """
    Put the unit-flux blended PSF, d/dx_0 and d/dy_0 into out (3, n).

    x_0 and y_0 are numbers. The blend changes with position too: its
    derivative is part of the result.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    blend_weights(x_0, y_0, x_grid, y_grid, index, weights)
    out[:] = 0.0
    for corner in range(4):
        for row in nodes[index[corner]]:
            if row[0] != 0:
                _add_jet(x, y, x_0, y_0, row, weights[:, corner], integrated,
                         out)


@_jit
def _add_stamp(rows, x_0, y_0, flux, integrated, px, py, out):
    """Add a star to a stamp (ny, nx) whose pixels are at px and py (n,)."""
    if integrated:
        render(rows, x_0, y_0, flux, integrated, out)
        return
    # A stamp has few pixels in a row: taken as one row, it fills vectors.
    for row in rows:
        if row[0] != 0:
            _add_values(px, py, x_0, y_0, row, flux, False,
                        out.reshape(px.size))


@_jit
def _pixel_positions(ny, nx):
    px = np.empty(ny * nx)
    py = np.empty(ny * nx)
    for i in range(px.size):
        py[i] = i // nx
        px[i] = i % nx
    return px, py


@_jit
def render_grid(x, y, flux, left, bottom, nodes, x_grid, y_grid, integrated,
                out):
    """
    Add star i to its stamp out[i], whose first pixel is (left, bottom)[i].

    x, y, flux, left and bottom are (n,), out is (n, ny, nx).
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    px, py = _pixel_positions(out.shape[1], out.shape[2])
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            w = weights[0, corner] * flux[i]
            if w != 0:
                _add_stamp(nodes[index[corner]], x[i] - left[i],
                           y[i] - bottom[i], w, integrated, px, py, out[i])


# A grid of mixtures whose Gaussians are matched, blended one by one: the four
# that belong together are replaced by the one with the flux, centroid and
# second moments of their sum. sums is (M, K, 6) and holds of each Gaussian
# the integrals of 1, x, y, x^2, xy, y^2, which blend linearly.

@_jit
def match_rows(x_0, y_0, sums, x_grid, y_grid, rows, slopes):
    """
    Put the K blended Gaussians at (x_0, y_0) into rows (K, 6).

    slopes (2, K, 6) takes the derivatives by x_0 and y_0 of log flux, mean
    and covariance (xx, xy, yy).
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    blend_weights(x_0, y_0, x_grid, y_grid, index, weights)
    blended = np.empty(6)
    slope = np.empty(6)
    for k in range(rows.shape[0]):
        _blend_sums(index, weights[0], sums, k, blended)
        rows[k] = 0.0
        slopes[:, k] = 0.0
        if blended[0] == 0:
            rows[k, 3] = rows[k, 5] = 1.0
            continue
        f, mx, my, sxx, sxy, syy = _central(blended)
        s = sxy / syy
        p = 1 / (sxx - s * sxy)
        rows[k] = np.array([f * sqrt(p / syy) / (2 * np.pi), mx, my, p, s,
                            1 / syy])
        for axis in range(2):
            _blend_sums(index, weights[1 + axis], sums, k, slope)
            df = slope[0] / f
            dx = slope[1] / f - mx * df
            dy = slope[2] / f - my * df
            slopes[axis, k, 0] = df
            slopes[axis, k, 1] = dx
            slopes[axis, k, 2] = dy
            slopes[axis, k, 3] = (slope[3] / f - (sxx + mx * mx) * df
                                  - 2 * mx * dx)
            slopes[axis, k, 4] = (slope[4] / f - (sxy + mx * my) * df
                                  - mx * dy - my * dx)
            slopes[axis, k, 5] = (slope[5] / f - (syy + my * my) * df
                                  - 2 * my * dy)


@_jit
def _blend_sums(index, weights, sums, k, out):
    for j in range(6):
        out[j] = 0.0
        for corner in range(4):
            out[j] += weights[corner] * sums[index[corner], k, j]


@_jit
def _central(sums):
    """Return flux, mean and covariance of what has these integrals."""
    f = sums[0]
    mx, my = sums[1] / f, sums[2] / f
    return (f, mx, my, sums[3] / f - mx * mx, sums[4] / f - mx * my,
            sums[5] / f - my * my)


@_jit
def evaluate_matched(x, y, flux, x_0, y_0, sums, x_grid, y_grid, integrated,
                     out):
    """Put the PSF of matched Gaussians into out; as `evaluate_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    per_point = x_0.size > 1
    out[:] = 0.0
    for star in range(x_0.size):
        points = slice(star, star + 1) if per_point else slice(0, x.size)
        match_rows(x_0[star], y_0[star], sums, x_grid, y_grid, rows, slopes)
        for row in rows:
            _add_values(x[points], y[points], x_0[star], y_0[star], row, 1.0,
                        integrated, out[points])
    for i in range(x.size):
        out[i] *= flux[i if flux.size > 1 else 0]


@_jit
def differentiate_matched(x, y, x_0, y_0, sums, x_grid, y_grid, integrated,
                          out):
    """Put value and derivatives into out (3, n); as `differentiate_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    match_rows(x_0, y_0, sums, x_grid, y_grid, rows, slopes)
    out[:] = 0.0
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        for i in range(x.size):
            dx, dy = x[i] - x_0 - mx, y[i] - y_0 - my
            g = _value(dx, dy, p, s, q, integrated)
            gx, gy = _gradient(dx, dy, p, s, q, integrated)
            gxx, gxy, gyy = _hessian(dx, dy, p, s, q, integrated)
            out[0, i] += a * g
            for axis in range(2):
                # The heat equation turns slopes of the covariance into
                # second derivatives.
                d = slopes[axis, k]
                out[1 + axis, i] += a * (
                    d[0] * g - d[1] * gx - d[2] * gy + 0.5 * d[3] * gxx
                    + d[4] * gxy + 0.5 * d[5] * gyy)
            out[1, i] -= a * gx
            out[2, i] -= a * gy


@_jit
def render_matched(x, y, flux, left, bottom, sums, x_grid, y_grid,
                   integrated, out):
    """Add stars of matched Gaussians to stamps; as `render_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    px, py = _pixel_positions(out.shape[1], out.shape[2])
    for i in range(x.size):
        match_rows(x[i], y[i], sums, x_grid, y_grid, rows, slopes)
        _add_stamp(rows, x[i] - left[i], y[i] - bottom[i], flux[i],
                   integrated, px, py, out[i])


# Many stars on one image. A Gaussian is drawn where it exceeds ``faintest``,
# which the caller chooses so low that nobody sees the edge, and anyway down
# to this fraction of its peak. Nothing is fitted with these functions, so
# the step at the edge does no harm.
_DEPTH = 1e-3


def _quadrature_tables(most=8):
    """
    Return nodes and weights (most + 1, most) of 0 to 8 points, and errors.

    On a unit interval n points miss a Gaussian of unit peak and precision P
    by less than errors[n] P^n, (n!)^4 (2n - 1)!! / ((2n + 1) (2n)!^3).
    """
    nodes = np.zeros((most + 1, most))
    weights = np.zeros((most + 1, most))
    errors = np.zeros(most + 1)
    for n in range(1, most + 1):
        places, shares = np.polynomial.legendre.leggauss(n)
        nodes[n, :n], weights[n, :n] = places / 2, shares / 2
        twice = float(factorial(2 * n))
        odd = twice / (2**n * factorial(n))
        errors[n] = factorial(n)**4 * odd / ((2 * n + 1) * twice**3)
    return nodes, weights, errors


_POINTS, _SHARES, _ERRORS = _quadrature_tables()

# What integrating by points may miss, in units of the brightest Gaussian of
# the star. The error is even about the star, so that it moves nothing.
_QUADRATURE_ERROR = 1e-5


@_jit
def _quadrature_order(precision, tolerance):
    """Return the number of points that suffice, or 0 if none does."""
    power = 1.0
    for n in range(1, _ERRORS.size):
        power *= precision
        if _ERRORS[n] * power <= tolerance:
            return n
    return 0


@_jit
def _walk(peak, right, left, fall, start, first, last, row):
    """
    Add a row Gaussian to row[first:last + 1], from its value at start.

    right and left are the first quotients of neighbours, fall their change.
    """
    row[start] += peak
    g = peak
    for i in range(start + 1, last + 1):
        g *= right
        right *= fall
        row[i] += g
    g = peak
    for i in range(start - 1, first - 1, -1):
        g *= left
        left *= fall
        row[i] += g


@_jit
def _add_sampled(peak, cx, cy, p, s, q, reach, out):
    """Add a Gaussian, sampled at pixel centres, to out (ny, nx)."""
    half = sqrt(reach / q)
    fall = exp(-p)
    low, high = max(0, ceil(cy - half)), min(out.shape[0] - 1, cy + half)
    for j in range(low, floor(high) + 1):
        dy = j - cy
        centre = cx + s * dy
        width = sqrt(max(0.0, reach - q * dy * dy) / p)
        first = max(0, ceil(centre - width))
        last = min(out.shape[1] - 1, floor(centre + width))
        if first > last:
            continue
        start = min(max(int(np.rint(centre)), first), last)
        u = start - centre
        _walk(peak * exp(-0.5 * (p * u * u + q * dy * dy)),
              exp(-p * (u + 0.5)), exp(-p * (0.5 - u)), fall, start, first,
              last, out[j])


@_jit
def _prepare_points(n, p, scratch):
    """
    Put what the points along x share into scratch (3, n).

    A point at the fraction t of a pixel has the value of the pixel's centre
    at u times exp(-p u t) and the first row; the quotients to its neighbours
    are those of u times the second and third.
    """
    for a in range(n):
        t = _POINTS[n, a]
        scratch[0, a] = _SHARES[n, a] * exp(-0.5 * p * t * t)
        scratch[1, a] = exp(-p * (0.5 + t))
        scratch[2, a] = exp(-p * (0.5 - t))


@_jit
def _add_integrated(peak, cx, cy, p, s, q, reach, tolerance, scratch, out):
    """Add a Gaussian, integrated over each pixel, to out (ny, nx)."""
    n_x = _quadrature_order(p, tolerance)
    n_y = _quadrature_order(q + s * s * p, tolerance)
    if n_x * n_y == 0:
        _add_thin(peak, cx, cy, p, s, q, reach, out)
        return
    _prepare_points(n_x, p, scratch)
    half = sqrt(reach / q) + 0.5
    fall = exp(-p)
    low, high = max(0, ceil(cy - half)), min(out.shape[0] - 1, cy + half)
    for j in range(low, floor(high) + 1):
        for b in range(n_y):
            dy = j - cy + _POINTS[n_y, b]
            centre = cx + s * dy
            width = sqrt(max(0.0, reach - q * dy * dy) / p) + 0.5
            first = max(0, ceil(centre - width))
            last = min(out.shape[1] - 1, floor(centre + width))
            if first > last:
                continue
            start = min(max(int(np.rint(centre)), first), last)
            u = start - centre
            ridge = (peak * _SHARES[n_y, b]
                     * exp(-0.5 * (p * u * u + q * dy * dy)))
            slope = exp(-p * u)
            for a in range(n_x):
                _walk(ridge * exp(-p * u * _POINTS[n_x, a]) * scratch[0, a],
                      slope * scratch[1, a], scratch[2, a] / slope, fall,
                      start, first, last, out[j])


@_jit
def _add_thin(peak, cx, cy, p, s, q, reach, out):
    """Add a Gaussian much thinner than a pixel, integrated over each."""
    half_y = sqrt(reach / q) + 0.5
    half_x = sqrt(reach * (1 / p + s * s / q)) + 0.5
    first = max(0, ceil(cx - half_x))
    last = min(out.shape[1] - 1, floor(cx + half_x))
    low, high = max(0, ceil(cy - half_y)), min(out.shape[0] - 1, cy + half_y)
    if first > last:
        return
    for j in range(low, floor(high) + 1):
        _add_integrated_row(peak, first - cx, j - cy, p, s, q,
                            out[j, first:last + 1])


@_jit
def _add_star(rows, flux, cx, cy, integrated, faintest, scratch, out):
    """Add a star at (cx, cy) of out; rows is (K, 6), scratch (3, 9)."""
    highest = 0.0
    for k in range(rows.shape[0]):
        highest = max(highest, abs(rows[k, 0]))
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        peak = flux * a
        if peak == 0:
            continue
        reach = 2 * log(max(abs(peak) / faintest, 1 / _DEPTH))
        if integrated:
            _add_integrated(peak, cx + mx, cy + my, p, s, q, reach,
                            _QUADRATURE_ERROR * highest / abs(a), scratch,
                            out)
        else:
            _add_sampled(peak, cx + mx, cy + my, p, s, q, reach, out)


@_jit
def render_image(x, y, flux, nodes, x_grid, y_grid, integrated, faintest,
                 left, bottom, out):
    """
    Add stars (n,) in the order given to out.

    The first pixel of out is the detector's (left, bottom). The order of the
    stars alone decides about rounding: a band of rows has the pixels it would
    have in the whole image.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    scratch = np.empty((3, _ERRORS.size))
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            _add_star(nodes[index[corner]], weights[0, corner] * flux[i],
                      x[i] - left, y[i] - bottom, integrated, faintest,
                      scratch, out)


@_jit
def render_matched_image(x, y, flux, sums, x_grid, y_grid, integrated,
                         faintest, left, bottom, out):
    """Add stars as `render_image` does, with matched Gaussians blended."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, *sums.shape[1:]))
    scratch = np.empty((3, _ERRORS.size))
    for i in range(x.size):
        match_rows(x[i], y[i], sums, x_grid, y_grid, rows, slopes)
        _add_star(rows, flux[i], x[i] - left, y[i] - bottom, integrated,
                  faintest, scratch, out)


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


@_jit
def draw_unit(shapes, cx, cy, lanes, images):
    """
    Put Gaussians of unit flux into images (K, ny, nx).

    lanes (4, nx) is scratch.
    """
    for k in range(shapes.shape[0]):
        if _is_steep(shapes[k], cx, cy, images[k].shape):
            _draw_by_rows(shapes[k], cx, cy, images[k])
        else:
            _draw_by_columns(shapes[k], cx, cy, lanes, images[k])


# Exponents within this keep their exponential, and its inverse, a number.
_STEEP = 600.0


@_jit
def _is_steep(shape, cx, cy, size):
    """
    Return whether a walk along columns leaves the range of numbers.

    It starts near the row of the mean, where a thin, tilted Gaussian may be
    0 in columns that it reaches elsewhere, or change too much to the next.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    v = min(max(np.rint(cy + my), 0.0), size[0] - 1.0) - cy - my
    far = length * max(abs(cx + mx), abs(size[1] - 1 - cx - mx)) + abs(t * v)
    slope, square = abs(t) * far + m * m * abs(v), far * far + m * m * v * v
    # So written, what is not a number is steep.
    return not (slope <= _STEEP
                and (abs(t) <= m or square <= 2 * _STEEP))


@_jit
def _draw_by_rows(shape, cx, cy, image):
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    peak = exp(log_l + log_m - _LOG_2PI)
    for j in range(image.shape[0]):
        row = image[j]
        row[:] = 0.0
        v = j - cy - my
        q = m * m * v * v
        if q < _LOG_NOTHING:
            _add_row(peak * exp(-0.5 * q), -cx - mx + t / length * v,
                     length * length, row)


@_jit
def _draw_by_columns(shape, cx, cy, lanes, image):
    """
    Draw all columns at once, from the row of the mean up and down.

    The quotient of a pixel and the next of its column changes by the same
    factor each row, so a pixel costs two multiplications.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    peak = exp(log_l + log_m - _LOG_2PI)
    start = min(max(int(np.rint(cy + my)), 0), image.shape[0] - 1)
    v = start - cy - my
    b = m * v
    bend = t * t + m * m
    half, fall = exp(-0.5 * bend), exp(-bend)
    upper, up, lower, down = lanes[0], lanes[1], lanes[2], lanes[3]
    a = t * v - length * (cx + mx)
    for i in range(upper.size):
        square = (length * i + a) * (length * i + a) + b * b
        upper[i] = peak * _exp(-0.5 * square)
    turn = exp(-length * t)
    up[0], down[0] = half * exp(-a * t - m * b), half * exp(a * t + m * b)
    for i in range(1, upper.size):
        up[i], down[i] = up[i - 1] * turn, down[i - 1] / turn
    for i in range(upper.size):
        lower[i] = upper[i] * down[i]
        down[i] *= fall
    _walk_columns(start, image.shape[0], 1, fall, upper, up, image)
    _walk_columns(start - 1, -1, -1, fall, lower, down, image)


@_jit
def _walk_columns(start, end, way, fall, value, quotient, image):
    """Put value (nx,) into rows start, start + way, ... before end."""
    for j in range(start, end, way):
        row = image[j]
        for i in range(value.size):
            row[i] = value[i]
            following = value[i] * quotient[i]
            value[i] = following if following > _NOTHING else 0.0
            quotient[i] *= fall


@_jit
def _columns_of_product(a, b, weight, cy, columns):
    """Put sum_y w a b y^m into columns[m, x], m <= 4."""
    ny, nx = a.shape
    columns[:] = 0.0
    c0, c1, c2 = columns[0], columns[1], columns[2]
    c3, c4 = columns[3], columns[4]
    # Two rows at once: a sum is loaded and stored half as often.
    for j in range(0, ny - 1, 2):
        v, z = j - cy, j + 1 - cy
        for i in range(nx):
            g = weight[j, i] * a[j, i] * b[j, i]
            h = weight[j + 1, i] * a[j + 1, i] * b[j + 1, i]
            c0[i] += g + h
            g, h = g * v, h * z
            c1[i] += g + h
            g, h = g * v, h * z
            c2[i] += g + h
            g, h = g * v, h * z
            c3[i] += g + h
            c4[i] += g * v + h * z
    if ny % 2:
        v = ny - 1 - cy
        for i in range(c0.size):
            g = weight[ny - 1, i] * a[ny - 1, i] * b[ny - 1, i]
            c0[i] += g
            c1[i] += g * v
            c2[i] += g * (v * v)
            c3[i] += g * (v * v * v)
            c4[i] += g * (v * v * v * v)


@_jit
def _moments_of_product(a, b, weight, cx, cy, columns, out):
    """
    Put sum_pixels w a b x^n y^m into out[n, m], n + m <= 4.

    columns (5, nx) is scratch.
    """
    _columns_of_product(a, b, weight, cy, columns)
    a0, a1, a2, a3, a4 = 0.0, 0.0, 0.0, 0.0, 0.0
    b0, b1, b2, b3 = 0.0, 0.0, 0.0, 0.0
    c0, c1, c2 = 0.0, 0.0, 0.0
    d0, d1, e0 = 0.0, 0.0, 0.0
    for i in range(columns.shape[1]):
        x = i - cx
        xx = x * x
        s0, s1, s2 = columns[0, i], columns[1, i], columns[2, i]
        a0, a1, a2 = a0 + s0, a1 + s1, a2 + s2
        a3, a4 = a3 + columns[3, i], a4 + columns[4, i]
        b0, b1 = b0 + x * s0, b1 + x * s1
        b2, b3 = b2 + x * s2, b3 + x * columns[3, i]
        c0, c1, c2 = c0 + xx * s0, c1 + xx * s1, c2 + xx * s2
        d0, d1 = d0 + xx * x * s0, d1 + xx * x * s1
        e0 += xx * xx * s0
    out[0, 0], out[0, 1], out[0, 2], out[0, 3], out[0, 4] = a0, a1, a2, a3, a4
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = b0, b1, b2, b3
    out[2, 0], out[2, 1], out[2, 2] = c0, c1, c2
    out[3, 0], out[3, 1], out[4, 0] = d0, d1, e0


@_jit
def _low_moments(a, b, centre, columns, sums):
    """
    Put sum_pixels a b (1, x, y, xx, xy, yy) into sums (6,).

    columns (at least 3, nx) is scratch.
    """
    c0, c1, c2 = columns[0], columns[1], columns[2]
    c0[:], c1[:], c2[:] = 0.0, 0.0, 0.0
    for j in range(a.shape[0]):
        v = j - centre[1]
        v2 = v * v
        for i in range(c0.size):
            h = a[j, i] * b[j, i]
            c0[i] += h
            c1[i] += h * v
            c2[i] += h * v2
    s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(c0.size):
        x = i - centre[0]
        s0, s1, s2 = s0 + c0[i], s1 + x * c0[i], s2 + c1[i]
        s3, s4, s5 = s3 + x * x * c0[i], s4 + x * c1[i], s5 + c2[i]
    sums[0], sums[1], sums[2] = s0, s1, s2
    sums[3], sums[4], sums[5] = s3, s4, s5


@_jit
def _polynomials(shape, out):
    """
    Put g and its derivatives by the five shape numbers into out (6, 6).

    As multiples of g: the coefficients of 1, x, y, xx, xy, yy.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    # a = length x + t y + a0, b = m y + b0.
    a0 = -length * mx - t * my
    b0 = -m * my
    out[:] = 0.0
    out[0, 0] = 1.0
    out[1, 0], out[1, 1], out[1, 2] = length * a0, length * length, length * t
    out[2, 0] = t * a0 + m * b0
    out[2, 1] = t * length
    out[2, 2] = t * t + m * m
    # 1 - length u a
    out[3, 0] = 1.0 + length * mx * a0
    out[3, 1] = -length * a0 + length * mx * length
    out[3, 2] = length * mx * t
    out[3, 3] = -length * length
    out[3, 4] = -length * t
    # -v a
    out[4, 0] = my * a0
    out[4, 1] = my * length
    out[4, 2] = my * t - a0
    out[4, 4] = -length
    out[4, 5] = -t
    # 1 - b^2
    out[5, 0] = 1.0 - b0 * b0
    out[5, 2] = -2 * m * b0
    out[5, 5] = -m * m


# The powers of x and y in the monomials 1, x, y, xx, xy, yy.
_POWER_X = np.array([0, 1, 0, 2, 1, 0])
_POWER_Y = np.array([0, 0, 1, 0, 1, 2])


@_jit
def _contract(left, moments, right, half, out):
    """
    Put the moments of a product, seen by its parameters, into out (6, 6).

    left and right (6, 6) are the polynomials of the two Gaussians; half
    (6, 6) is scratch.
    """
    half[:] = 0.0
    for a in range(6):
        for c in range(6):
            moment = moments[_POWER_X[a] + _POWER_X[c],
                             _POWER_Y[a] + _POWER_Y[c]]
            for j in range(6):
                half[a, j] += moment * right[j, c]
    out[:] = 0.0
    for i in range(6):
        for a in range(6):
            for j in range(6):
                out[i, j] += left[i, a] * half[a, j]


@_jit
def _factor(matrix, n):
    """
    Overwrite the lower triangle of matrix (n, n) by its Cholesky factor.

    A pivot lost to rounding is replaced by a huge one, which sets the unknown
    to zero instead of ending the fit.
    """
    for j in range(n):
        diagonal = matrix[j, j]
        pivot = diagonal
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not pivot > 1e-14 * diagonal:
            pivot = 1e30 * max(diagonal, 1e-30)
        root = sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root


@_jit
def _solve_factored(factor, n, x):
    """Overwrite x (n,) by the solution of factor factor^T y = x."""
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


@_jit
def _solve_subset(gram, rhs, active, x, work):
    """Solve gram x = rhs over the active unknowns; the others are zero."""
    n = rhs.size
    count = 0
    for i in range(n):
        if not active[i]:
            continue
        column = 0
        for j in range(i + 1):
            if active[j]:
                work[count, column] = gram[i, j]
                column += 1
        work[count, n] = rhs[i]
        count += 1
    _factor(work, count)
    solution = work[:count, n].copy()
    _solve_factored(work, count, solution)
    count = 0
    for i in range(n):
        x[i] = 0.0
        if active[i]:
            x[i] = solution[count]
            count += 1


@_jit
def _steepest(gram, rhs, active, x):
    """Return the inactive unknown that would lower the cost most, or -1."""
    best, gain = -1, 0.0
    for i in range(rhs.size):
        if active[i]:
            continue
        slope = rhs[i]
        for j in range(rhs.size):
            slope -= gram[i, j] * x[j]
        if slope > 1e-12 * abs(rhs[i]) + gain:
            best, gain = i, slope
    return best


@_jit
def _solve_fluxes(gram, rhs, signed, x, active, work):
    """
    Solve min |G x - z| with x >= 0, unless signed.

    gram is G^T G, rhs G^T z. Lawson and Hanson's active set, started from
    all unknowns free. work is (n, n + 1).
    """
    n = rhs.size
    active[:] = True
    _solve_subset(gram, rhs, active, x, work)
    if signed:
        return
    for _ in range(3 * n):
        worst = np.argmin(x)
        if x[worst] < 0:
            active[worst] = False
            _solve_subset(gram, rhs, active, x, work)
            continue
        best = _steepest(gram, rhs, active, x)
        if best < 0:
            return
        active[best] = True
        _solve_subset(gram, rhs, active, x, work)
        if x[best] <= 0:
            active[best] = False
            _solve_subset(gram, rhs, active, x, work)
            return
    for i in range(n):
        x[i] = max(x[i], 0.0)


@_jit
def _hinge(excess, slopes, stiffness, matrix, gradient):
    """Add the square of an excess > 0 to the normal equations of one shape."""
    if excess <= 0:
        return 0.0
    for i in range(5):
        gradient[i] -= stiffness * excess * slopes[i]
        for j in range(5):
            matrix[i, j] += stiffness * slopes[i] * slopes[j]
    return stiffness * excess * excess


@_jit
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


@_jit
def _residual(stamp, images, fluxes, out):
    """Put stamp minus model into out (ny, nx)."""
    for j in range(stamp.shape[0]):
        for i in range(stamp.shape[1]):
            out[j, i] = stamp[j, i]
    for k in range(fluxes.size):
        for j in range(stamp.shape[0]):
            for i in range(stamp.shape[1]):
                out[j, i] -= fluxes[k] * images[k, j, i]


@_jit
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

@_jit
def _weighted_dot(a, b, weight, lane):
    """Return sum_pixels w a b; lane (nx,) is scratch."""
    lane[:] = 0.0
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += weight[j, i] * a[j, i] * b[j, i]
    return lane.sum()


@_jit
def _dot(a, b, lane):
    """Return sum_pixels a b; lane (nx,) is scratch."""
    lane[:] = 0.0
    for j in range(a.shape[0]):
        for i in range(lane.size):
            lane[i] += a[j, i] * b[j, i]
    return lane.sum()


@_jit
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


@_jit
def _add_rows(rows, centre, residual, images, fluxes, polynomials, columns,
              matrix, gradient):
    """Add rows (m, ny, nx) over the residual to the normal equations."""
    n = fluxes.size
    sums, slopes = np.empty(6), np.empty(6 * n)
    for row in rows:
        left = _dot(row, residual, columns[0])
        for k in range(n):
            _low_moments(row, images[k], centre, columns, sums)
            _put_slopes(polynomials[k], sums, k, fluxes, slopes)
        for i in range(6 * n):
            gradient[i] += slopes[i] * left
            for j in range(6 * n):
                matrix[i, j] += slopes[i] * slopes[j]


@_jit
def _put_slopes(polynomials, sums, k, fluxes, slopes):
    """Put the slopes by the numbers of Gaussian k into slopes (6K,)."""
    for i in range(6):
        slope = 0.0
        for a in range(6):
            slope += polynomials[i, a] * sums[a]
        slopes[_unknown(fluxes.size, k, i)] = slope * (fluxes[k] if i else 1.0)


@_jit
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
        _polynomials(shapes[k], polynomials[k])
        _low_moments(images[k], weighted, centre, columns, sums)
        _put_slopes(polynomials[k], sums, k, fluxes, gradient)
    for k in range(n):
        for other in range(k + 1):
            _moments_of_product(images[k], images[other], weight, centre[0],
                                centre[1], columns, moments)
            _contract(polynomials[k], moments, polynomials[other], half,
                      block)
            _place(block, k, other, fluxes, matrix)
            matrix[k, other] += tie[1]
            matrix[other, k] = matrix[k, other]
    if rows.shape[0] > 0:
        _add_rows(rows, centre, residual, images, fluxes, polynomials,
                  columns, matrix, gradient)


@_jit
def _unknown(n, k, i):
    """Return where number i (0: flux) of Gaussian k of n is stored."""
    return k if i == 0 else n + 5 * k + i - 1


@_jit
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


@_jit
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


@_jit
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


@_jit
def _uncouple_means(n, factor):
    for k in range(n):
        for c in range(2):
            i = n + 5 * k + c
            for j in range(i + 1, factor.shape[0]):
                factor[j, i] = 0.0


@_jit
def _move(shapes, step, out):
    """Put shapes moved by the step into out, no width by more than e-fold."""
    n = shapes.shape[0]
    for k in range(n):
        for i in range(5):
            change = step[n + 5 * k + i]
            if i == 2 or i == 4:
                change = min(max(change, -1.0), 1.0)
            out[k, i] = shapes[k, i] + change


@_jit
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
        shapes[:] = trial
        fluxes[:] = trial_fluxes
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


@_jit
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


@_jit
def bleed(columns, full_well):
    """
    Spread the charge above the full well along each column (n, ny), in place.

    Half of the excess of a pixel goes each way, into the nearest pixels with
    room; what reaches an end is lost.
    """
    ny = columns.shape[1]
    excess = np.empty(ny)
    for column in columns:
        for j in range(ny):
            excess[j] = 0.5 * max(0.0, column[j] - full_well)
            column[j] = min(column[j], full_well)
        for way in range(2):
            carried = 0.0
            for step in range(ny):
                j = step if way == 0 else ny - 1 - step
                carried += excess[j]
                room = full_well - column[j]
                if carried >= room:
                    carried -= room
                    column[j] = full_well
                else:
                    column[j] += carried
                    carried = 0.0


@_jit
def _spline_taps(t, taps):
    """Put the cubic B-spline at 1 + t, t, 1 - t and 2 - t into taps (4,)."""
    taps[0] = (1 - t) ** 3 / 6
    taps[1] = (4 + t * t * (3 * t - 6)) / 6
    taps[3] = t ** 3 / 6
    taps[2] = 1 - taps[0] - taps[1] - taps[3]


@_jit
def _add_epsf(image, share, x, y, reach, oversampling, wx, wy, out):
    """Add a star at (x, y) of out, from the spline of an ePSF image."""
    low_y = max(0, ceil(y - reach))
    high_y = min(out.shape[0] - 1, floor(y + reach))
    low_x = max(0, ceil(x - reach))
    high_x = min(out.shape[1] - 1, floor(x + reach))
    # All pixels of a star fall on the same fraction of the fine lattice.
    step = int(oversampling)
    v = (low_y - y) * oversampling + 0.5 * (image.shape[0] - 1)
    u = (low_x - x) * oversampling + 0.5 * (image.shape[1] - 1)
    row, column = int(floor(v)), int(floor(u))
    _spline_taps(v - row, wy)
    _spline_taps(u - column, wx)
    for j in range(low_y, high_y + 1):
        m = row - 1 + (j - low_y) * step
        for i in range(low_x, high_x + 1):
            n = column - 1 + (i - low_x) * step
            total = 0.0
            for b in range(4):
                line = (wx[0] * image[m + b, n] + wx[1] * image[m + b, n + 1]
                        + wx[2] * image[m + b, n + 2]
                        + wx[3] * image[m + b, n + 3])
                total += wy[b] * line
            out[j, i] += share * total


@_jit
def render_epsfs(x, y, flux, reach, images, x_grid, y_grid, oversampling,
                 left, bottom, out):
    """
    Add stars (n,) made of ePSF images to out, in the order given.

    images (M, ny, nx) are coefficients of cubic splines, ordered as nodes of
    `render_image` are; reach (n,) is half the side of the square a star
    fills [pix], at least one pixel less than that of the images.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    wx = np.empty(4)
    wy = np.empty(4)
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            share = weights[0, corner] * flux[i]
            if share != 0:
                _add_epsf(images[index[corner]], share, x[i] - left,
                          y[i] - bottom, reach[i], oversampling, wx, wy, out)
# Adaptive moments: the elliptical Gaussian weight W that matches what it
# weighs, centroid to centroid and covariance M to twice the weighted one. The
# state is x, y, M_xx, M_xy, M_yy; sums are of W times 1, u, v, uu, uv, vv over
# the light, with (u, v) the offset from x, y.

MOMENTS_CONVERGED, MOMENTS_STOPPED, MOMENTS_EMPTY, MOMENTS_DIVERGED = range(4)


@_jit
def _row_of(state, row):
    """Put the Gaussian of unit peak that a state describes into row (6,)."""
    x, y, xx, xy, yy = state
    row[0], row[1], row[2] = 1.0, x, y
    row[4] = xy / yy
    row[3] = 1 / (xx - row[4] * xy)
    row[5] = 1 / yy


@_jit
def _image_sums(image, used, fill, row, line, sums):
    """
    Sum an image under the weight of a row; unused pixels hold fill * W.

    line (nx,) is scratch.
    """
    _, x, y, p, s, q = row
    sums[:] = 0.0
    for j in range(image.shape[0]):
        v = j - y
        if q * v * v > _LOG_NOTHING:
            continue
        line[:] = 0.0
        _add_row(exp(-0.5 * q * v * v), -x - s * v, p, line)
        s0, s1, s2 = 0.0, 0.0, 0.0
        for i in range(line.size):
            value = image[j, i] if used[j, i] else fill * line[i]
            h = value * line[i]
            u = i - x
            s0 += h
            s1 += h * u
            s2 += h * u * u
        sums[0] += s0
        sums[1] += s1
        sums[2] += v * s0
        sums[3] += s2
        sums[4] += v * s1
        sums[5] += v * v * s0


@_jit
def _mixture_sums(mixture, state, sums):
    """Integrate a mixture (K, 6: weight, x, y, xx, xy, yy) under a state."""
    x, y, xx, xy, yy = state
    sums[:] = 0.0
    norm = sqrt(xx * yy - xy * xy)
    for k in range(mixture.shape[0]):
        weight, mx, my, sxx, sxy, syy = mixture[k]
        a, b, c = xx + sxx, xy + sxy, yy + syy
        determinant = a * c - b * b
        dx, dy = mx - x, my - y
        # (M + S)^-1 d, then M times it: the mean of the product.
        ex = (c * dx - b * dy) / determinant
        ey = (a * dy - b * dx) / determinant
        h = (weight * norm / sqrt(determinant)
             * exp(-0.5 * (dx * ex + dy * ey)))
        u, v = xx * ex + xy * ey, xy * ex + yy * ey
        # M (M + S)^-1 S: the covariance of the product.
        tx, ty = (c * sxx - b * sxy) / determinant, (
            a * sxy - b * sxx) / determinant
        wx, wy = (c * sxy - b * syy) / determinant, (
            a * syy - b * sxy) / determinant
        sums[0] += h
        sums[1] += h * u
        sums[2] += h * v
        sums[3] += h * (xx * tx + xy * ty + u * u)
        sums[4] += h * (xx * wx + xy * wy + u * v)
        sums[5] += h * (xy * wx + yy * wy + v * v)


@_jit
def _adapt(state, sums, largest):
    """
    Move the state towards the match; return its relative change.

    If the light is a Gaussian of covariance S the weighted covariance C
    obeys C^-1 = M^-1 + S^-1 and the centroid moves by C S^-1 of the way, so
    S and the centre follow in one step. A negative value is a failure.
    """
    if not sums[0] > 0:
        return -1.0
    xx, xy, yy = state[2:]
    u, v = sums[1] / sums[0], sums[2] / sums[0]
    cxx = sums[3] / sums[0] - u * u
    cxy = sums[4] / sums[0] - u * v
    cyy = sums[5] / sums[0] - v * v
    determinant = cxx * cyy - cxy * cxy
    if not (cxx > 0 and determinant > 0):
        return -2.0
    area = xx * yy - xy * xy
    pxx = cyy / determinant - yy / area
    pxy = -cxy / determinant + xy / area
    pyy = cxx / determinant - xx / area
    precision = pxx * pyy - pxy * pxy
    if pxx > 0 and precision > 0.05 / area:
        nxx, nxy, nyy = pyy / precision, -pxy / precision, pxx / precision
    else:
        # No Gaussian of finite size would look like this; grow carefully.
        nxx, nxy, nyy = 4 * cxx, 4 * cxy, 4 * cyy
    if not nxx + nyy < largest:
        return -2.0
    # How far the centre is: (1 + S M^-1) times the weighted offset.
    gx = u + (nxx * (yy * u - xy * v) + nxy * (xx * v - xy * u)) / area
    gy = v + (nxy * (yy * u - xy * v) + nyy * (xx * v - xy * u)) / area
    size = xx + yy
    change = max(abs(nxx - xx), abs(nxy - xy), abs(nyy - yy)) / size
    step = sqrt((gx * gx + gy * gy) / size)
    change = max(change, step)
    shrink = min(1.0, 2 / step) if step > 0 else 1.0
    state[0] += shrink * gx
    state[1] += shrink * gy
    state[2], state[3], state[4] = nxx, nxy, nyy
    return change


@_jit
def _ending(change):
    if change == -1.0:
        return MOMENTS_EMPTY
    if change == -2.0:
        return MOMENTS_DIVERGED
    return MOMENTS_CONVERGED


@_jit
def adapt_to_images(images, used, states, tolerance, max_steps, largest,
                    sums, status):
    """
    Bring the states (n, 5) to the adaptive moments of images (n, ny, nx).

    used tells which pixels count; the others are filled with the matching
    Gaussian. sums (n, 6) receives the last sums, status (n,) how it ended.
    """
    row = np.empty(6)
    line = np.empty(images.shape[2])
    for i in range(images.shape[0]):
        state = states[i]
        fill = 0.0
        status[i] = MOMENTS_STOPPED
        for _ in range(max_steps):
            _row_of(state, row)
            _image_sums(images[i], used[i], fill, row, line, sums[i])
            area = state[2] * state[4] - state[3] * state[3]
            fill = sums[i, 0] / (np.pi * sqrt(area))
            change = _adapt(state, sums[i], largest)
            if change < tolerance:
                status[i] = _ending(change)
                break


@_jit
def adapt_to_mixtures(mixtures, states, tolerance, max_steps, largest, sums,
                      status):
    """Bring the states (n, 5) to the moments of mixtures (n, K, 6)."""
    for i in range(mixtures.shape[0]):
        status[i] = MOMENTS_STOPPED
        for _ in range(max_steps):
            _mixture_sums(mixtures[i], states[i], sums[i])
            change = _adapt(states[i], sums[i], largest)
            if change < tolerance:
                status[i] = _ending(change)
                break
# Fits of stars: flux, x and y of each, by Levenberg-Marquardt.
#
# A group of n stars is fitted jointly on the pixels of its n boxes, (first
# row, first column, height, width) each; a single star is a group of one.
# Where boxes overlap their pixels count once for each box. Parameters are
# ordered flux, x, y of the first star, of the second, ..., and last, where it
# is fitted, the sky level common to the group.

# Outcome of a fit; 1 to 4 as scipy.optimize.least_squares counts them.
_NOT_CONVERGED = 0
_CONVERGED = 3
_STALLED = 2
_BAD_ERROR = -1

# Stars whose unit-flux image is nowhere above this in a box are left out of
# its normal matrix (not of its model).
_UNSEEN = 1e-18

# How far a star may move in one step, in pixels.
_LONGEST = 1.0

# Fits stop when the next step is expected to be below this, in pixels and as
# a fraction of the flux.
_STEP_TOLERANCE = 1e-6

# What fraction of the fall of chi2 that the normal equations promise a step
# should bring: below the first damping grows, above the second it falls.
_POOR_GAIN = 0.25
_FAIR_GAIN = 0.75

# The least factor by which steps are taken to get shorter.
_LEAST_RATE = 0.03

# Out of iterations, fits whose chi2 fell by a smaller fraction than this in
# the last step count as good, as they do in scipy: along a valley, such as
# that of two stars in one place, steps may remain long.
_LEAST_FALL = 1e-8


# The PSF of a star and its derivatives by position are summed in a tile, one
# flat array: for each pixel column _LANES values of the PSF, as many of its
# derivative by x_0, and as many by y_0. Neighbouring rows are neighbours in
# memory and fixed offsets lie between the parts, so that the compiler works on
# several rows at once; their number is a constant, for a remainder of a few
# rows one by one would take longer than all the others.
_LANES = 16

# The smallest share of a Gaussian in a blend, so that the slope of the share
# can be divided by it; lost in rounding where it stands for zero.
_LEAST_SHARE = 1e-30


@_jit
def paces(nodes, out):
    """
    Put the constant factors of walks over Gaussians into out (M, K, 4).

    The precision along y at fixed x; how the quotient of columns grows from
    row to row; how the quotients of rows, and of columns, fall.
    """
    for m in range(nodes.shape[0]):
        for k in range(nodes.shape[1]):
            _, _, _, p, s, q = nodes[m, k]
            t = q + s * s * p
            out[m, k, 0] = t
            out[m, k, 1] = exp(p * s)
            out[m, k, 2] = exp(-t)
            out[m, k, 3] = exp(-p)


@_jit
def _walk_starts(a, dx, dy, p, s, q, pace, by_x, by_y, height, walk):
    """
    Put what a walk along the columns starts from into walk (4, _LANES) flat.

    For each row the Gaussian in the first column, its quotient with the next
    one, and the factors of the Gaussian in its derivative by x and, short of
    s times the former, by y. Rows from height on stay as they are. Returns
    whether anything is there. The values of the first column are a Gaussian
    in y, walked outward from its peak. pace is as of `paces`.
    """
    t, grow, drop, _ = pace
    u = dx
    slope = q * dy - p * s * u
    top = min(max(int(np.rint(-slope / t)), 0), height - 1)
    u -= s * top
    slope += t * top
    first = a * exp(-0.5 * (p * u * u + q * (dy + top) ** 2))
    if abs(first) < _NOTHING:
        return False
    g = first
    r = exp(-slope - 0.5 * t)
    for j in range(top, height):
        walk[j] = g
        g *= r
        r *= drop
    g = first
    r = exp(slope - 0.5 * t)
    for j in range(top - 1, -1, -1):
        g *= r
        r *= drop
        walk[j] = g
    r = exp(-p * (dx + 0.5))
    for j in range(height):
        walk[_LANES + j] = r
        r *= grow
    by_y += s * by_x
    for j in range(height):
        walk[2 * _LANES + j] = p * (dx - s * j) + by_x
        walk[3 * _LANES + j] = q * (dy + j) + by_y
    return True


@_jit
def _add_walk(p, s, fall, width, walk, tile):
    """Add a Gaussian to a tile, two multiplications a pixel."""
    for i in range(width):
        column = 3 * _LANES * i
        pi = p * i
        for j in range(_LANES):
            g = walk[j]
            r = walk[_LANES + j]
            h = (walk[2 * _LANES + j] + pi) * g
            tile[column + j] += g
            tile[column + _LANES + j] += h
            tile[column + 2 * _LANES + j] += walk[3 * _LANES + j] * g - s * h
            walk[j] = g * r
            walk[_LANES + j] = r * fall


@_jit
def _add_points(a, dx, dy, p, s, q, by_x, by_y, integrated, height, width,
                tile):
    """Add a Gaussian to a tile, each pixel for itself."""
    for i in range(width):
        for j in range(height):
            u, v = dx + i, dy + j
            g = a * _value(u, v, p, s, q, integrated)
            gx, gy = _gradient(u, v, p, s, q, integrated)
            k = 3 * _LANES * i + j
            tile[k] += g
            tile[k + _LANES] += by_x * g - a * gx
            tile[k + 2 * _LANES] += by_y * g - a * gy


@_jit
def _add_gaussian(a, dx, dy, p, s, q, pace, by_x, by_y, integrated, height,
                  width, walk, tile):
    """
    Add a Gaussian, its first pixel at (dx, dy) from the peak, to a tile.

    a includes its share in the blend, whose relative slopes are by_x and
    by_y.
    """
    left = min(dx - s * dy, dx - s * (dy + height - 1))
    # A walk that begins too far out begins at zero.
    steep = (p > 50 or q > 50 or p * abs(s) * height > 200
             or (left < 0 and p * left * left > 600))
    if integrated or steep:
        _add_points(a, dx, dy, p, s, q, by_x, by_y, integrated, height,
                    width, tile)
    elif _walk_starts(a, dx - s * dy, dy, p, s, q, pace, by_x, by_y, height,
                      walk):
        _add_walk(p, s, pace[3], width, walk, tile)


@_jit
def _fill_tile(x_0, y_0, row, column, height, width, psf, tiling):
    """Put the PSF and its derivatives in up to _LANES rows into the tile."""
    nodes, paces, _, _, integrated = psf
    walk, tile, index, weights = tiling
    walk[:] = 0.0
    tile[:3 * _LANES * width] = 0.0
    for corner in range(4):
        w, wx, wy = weights[0, corner], weights[1, corner], weights[2, corner]
        if w == 0 and wx == 0 and wy == 0:
            continue
        w = max(w, _LEAST_SHARE)
        for k in range(nodes.shape[1]):
            a, mx, my, p, s, q = nodes[index[corner], k]
            if a != 0:
                _add_gaussian(w * a, column - x_0 - mx, row - y_0 - my, p, s,
                              q, paces[index[corner], k], wx / w, wy / w,
                              integrated, height, width, walk, tile)


@_jit
def _fill_jet(x_0, y_0, box, psf, tiling, jet):
    """
    Put the unit-flux PSF in a box and its derivatives by x_0 and y_0.

    They go into jet (3, width * height), column after column. psf is (nodes,
    paces, x_grid, y_grid, integrated), tiling is scratch (walk, tile, index,
    weights). The change of the blend with position is included.
    """
    _, tile, index, weights = tiling
    blend_weights(x_0, y_0, psf[2], psf[3], index, weights)
    row, column, height, width = box
    for bottom in range(0, height, _LANES):
        rows = min(_LANES, height - bottom)
        _fill_tile(x_0, y_0, row + bottom, column, rows, width, psf, tiling)
        for part in range(3):
            for i in range(width):
                k = (3 * i + part) * _LANES
                to = i * height + bottom
                for j in range(rows):
                    jet[part, to + j] = tile[k + j]


@_jit
def count_pixels(mask, boxes, out):
    """Put the number of pixels of each box that mask leaves into out (n,)."""
    for i in range(boxes.shape[0]):
        row, column, height, width = boxes[i]
        n = 0
        for y in range(row, row + height):
            for x in range(column, column + width):
                n += not mask[y, x]
        out[i] = n


@_jit
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


@_jit
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


@_jit
def _add_gradient(jet, flux, weight, residual, gradient):
    """Add a star's part of the right-hand side in one box."""
    b0 = 0.0
    b1 = 0.0
    b2 = 0.0
    for i in range(weight.size):
        wr = weight[i] * residual[i]
        b0 += wr * jet[0, i]
        b1 += wr * jet[1, i]
        b2 += wr * jet[2, i]
    gradient[0] += b0
    gradient[1] += flux * b1
    gradient[2] += flux * b2


@_jit
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


@_jit
def _add_sky(jet, flux, weight, column):
    """Add what joins a star and the sky level, in one box."""
    for i in range(weight.size):
        column[0] += weight[i] * jet[0, i]
        column[1] += weight[i] * jet[1, i] * flux
        column[2] += weight[i] * jet[2, i] * flux


@_jit
def _model_stars(parameters, n, box, psf, scratch, residual):
    """
    Put the sum of n stars in a box into residual.

    Fills each star's jet, and whether any of it is seen in the box. scratch
    is (jets, seen, tiling).
    """
    jets, seen, tiling = scratch
    residual[:] = 0.0
    for s in range(n):
        jet = jets[s, :, :residual.size]
        _fill_jet(parameters[3 * s + 1], parameters[3 * s + 2], box, psf,
                  tiling, jet)
        flux = parameters[3 * s]
        top = 0.0
        for i in range(residual.size):
            residual[i] += flux * jet[0, i]
            top = max(top, abs(jet[0, i]))
        seen[s] = top > _UNSEEN


@_jit
def _add_equations(parameters, n, fit_sky, jets, seen, weight, residual,
                   matrix, gradient):
    """Add what one box contributes to the normal equations of a group."""
    sky = 3 * n
    for s in range(n):
        if not seen[s]:
            continue
        flux = parameters[3 * s]
        one = slice(3 * s, 3 * s + 3)
        own = jets[s, :, :weight.size]
        _add_gradient(own, flux, weight, residual, gradient[one])
        for t in range(s + 1):
            if seen[t]:
                _add_block(own, flux, jets[t, :, :weight.size],
                           parameters[3 * t], weight,
                           matrix[one, 3 * t:3 * t + 3])
        if fit_sky:
            _add_sky(own, flux, weight, matrix[sky, one])
    if fit_sky:
        for i in range(weight.size):
            matrix[sky, sky] += weight[i]
            gradient[sky] += weight[i] * residual[i]


@_jit
def _normal_equations(parameters, n, fit_sky, pixels, psf, scratch, old, new,
                      chi2):
    """
    Evaluate a group: normal matrix and right-hand side, chi2 (2,).

    pixels is (boxes, data, variance, gain). old and new are the tuples
    (weights, residuals, matrix, gradient) of the last point and of this one.
    Only the lower triangle of the matrix is filled.
    """
    boxes, data, variance, gain = pixels
    jets, seen, _ = scratch
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
        _add_equations(parameters, n, fit_sky, jets, seen, weight, residual,
                       matrix, gradient)


@_jit
def _factorize(matrix, frozen, damping, size, steepest, scale, factor):
    """
    Put the Cholesky factor of the damped, scaled matrix into factor.

    scale (size,) takes the square roots of the diagonal; rows of frozen
    parameters become those of the unit matrix. Damping is in units of
    steepest, the largest diagonal so far: as a star gets faint its position
    must not become free to run away. Returns whether the matrix is positive
    definite to working precision.
    """
    for a in range(size):
        d = matrix[a, a]
        steepest[a] = max(steepest[a], d)
        if frozen[a] or not d > 0:
            frozen[a] = True
            scale[a] = 1.0
        else:
            scale[a] = sqrt(d)
    for a in range(size):
        for b in range(a + 1):
            if frozen[a] or frozen[b]:
                value = 1.0 if a == b else 0.0
            else:
                value = matrix[a, b] / (scale[a] * scale[b])
                if a == b and damping > 0:
                    value += damping * steepest[a] / matrix[a, a]
            for c in range(b):
                value -= factor[a, c] * factor[b, c]
            if a == b:
                if not value > 1e-14:
                    return False
                factor[a, a] = sqrt(value)
            else:
                factor[a, b] = value / factor[b, b]
    return True


@_jit
def _solve(factor, scale, size, vector):
    """Solve for the scaled vector in place, given the Cholesky factor."""
    for a in range(size):
        value = vector[a] / scale[a]
        for b in range(a):
            value -= factor[a, b] * vector[b]
        vector[a] = value / factor[a, a]
    for a in range(size - 1, -1, -1):
        value = vector[a]
        for b in range(a + 1, size):
            value -= factor[b, a] * vector[b]
        vector[a] = value / factor[a, a]
    for a in range(size):
        vector[a] /= scale[a]


@_jit
def _freeze(parameters, lower, upper, gradient, fixed, size, frozen):
    """Freeze fixed parameters and those that press against a bound."""
    for a in range(size):
        frozen[a] = fixed[a] or (
            parameters[a] <= lower[a] and gradient[a] < 0) or (
            parameters[a] >= upper[a] and gradient[a] > 0)


@_jit
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


@_jit
def _undamp(step, matrix, gradient, frozen, size):
    """Lengthen a damped step to what each parameter alone would go."""
    for a in range(size):
        if not frozen[a]:
            step[a] = max(abs(step[a]), abs(gradient[a]) / matrix[a, a])


@_jit
def _remainder(length, last):
    """
    Return how far the minimum is expected to be after a step.

    Convergence is linear at the worst, each step shorter than the last one by
    the same factor. A first step, with a last one of 0, says nothing of it,
    and early steps make it look better than it will be.
    """
    rate = max(length / last, _LEAST_RATE) if last > 0 else 0.5
    return length * (rate / (1 - rate) if rate < 0.9 else 10.0)


@_jit
def _take_step(parameters, step, lower, upper, n, size, trial):
    """Put the bounded end of the step into trial, the actual into step."""
    for s in range(n):
        far = max(abs(step[3 * s + 1]), abs(step[3 * s + 2]))
        if far > _LONGEST:
            step[3 * s + 1] *= _LONGEST / far
            step[3 * s + 2] *= _LONGEST / far
    for a in range(size):
        trial[a] = min(max(parameters[a] + step[a], lower[a]), upper[a])
        step[a] = trial[a] - parameters[a]


@_jit
def _expected(step, matrix, gradient, size):
    """Return by how much the linear model says chi2 falls."""
    total = 0.0
    for a in range(size):
        row = matrix[a, a] * step[a]
        for b in range(a):
            row += 2 * matrix[a, b] * step[b]
        total += step[a] * (2 * gradient[a] - row)
    return total


@_jit
def _next_damping(damping, gain):
    """
    Return the damping after a step that brought gain of what it promised.

    A faint star needs some even at its minimum, where the curvature that the
    normal matrix leaves out makes undamped steps overshoot.
    """
    if gain < _POOR_GAIN:
        return max(4 * damping, 1e-2)
    if gain < _FAIR_GAIN:
        return damping
    return damping / 10 if damping > 1e-4 else 0.0


@_jit
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
            if short < 1e-3 * _STEP_TOLERANCE or damping > 1e12:
                return _STALLED, iteration + 2
            damping = max(10 * damping, 1e-3)
            last = 0.0
            continue
        # Of a smaller fall nothing is left after rounding: keep the damping.
        gain = ((best - chi2[0]) / expected if expected > 1e-9 * best
                else _POOR_GAIN)
        fall = best - chi2[0]
        parameters[:size] = trial[:size]
        best = chi2[1]
        for source, target in ((new[0], old[0]), (new[1], old[1])):
            target[:n] = source[:n]
        old[2][:size, :size] = new[2][:size, :size]
        old[3][:size] = new[3][:size]
        if _remainder(length, last) < _STEP_TOLERANCE:
            return _CONVERGED, iteration + 2
        last = length
        damping = _next_damping(damping, gain)
    return (_STALLED if fall < _LEAST_FALL * best else _NOT_CONVERGED,
            max_iterations + 1)


@_jit
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


@_jit
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


@_jit
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


@_jit
def _scatter(sums, n_pixels, n_free):
    """Return the variance of residuals, NaN without degrees of freedom."""
    return sums[:, 2].sum() / (n_pixels - n_free) if (
        n_pixels > n_free) else np.nan


@_jit
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
    most = np.max(np.diff(starts)) if starts.size > 1 else 1
    area = np.max(boxes[:, 2] * boxes[:, 3]) if boxes.size else 1
    size = 3 * most + 1
    data, variance = np.empty((most, area)), np.empty((most, area))
    old = (np.zeros((most, area)), np.empty((most, area)),
           np.empty((size, size)), np.empty(size))
    new = (np.zeros((most, area)), np.empty((most, area)),
           np.empty((size, size)), np.empty(size))
    tiling = (np.empty(4 * _LANES), np.empty(3 * _LANES * area),
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
            outcome[stars, 0] = _BAD_ERROR
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
            factor = _scatter(sums[stars], n_pixels,
                              n * np.sum(~fixed) + fit_sky)
        covariances[stars] *= factor
        for s in range(n):
            for b in range(3):
                fitted[starts[g] + s, b] = parameters[3 * s + b]
        if fit_sky:
            fitted_sky[stars, 0] = parameters[3 * n]
            fitted_sky[stars, 1] = sqrt(factor * sky_variance)
        outcome[stars, 0] = status
        outcome[stars, 1] = evaluations


@_jit
def star_jet(x_0, y_0, box, psf, out):
    """Put the unit-flux PSF in a box, d/dx_0 and d/dy_0 into out (3, n)."""
    tiling = (np.empty(4 * _LANES), np.empty(3 * _LANES * box[3]),
              np.empty(4, np.int64), np.empty((3, 4)))
    _fill_jet(x_0, y_0, box, psf, tiling, out)


@_jit
def star_equations(image, error, mask, boxes, parameters, psf, chi2, n_pixels,
                   matrices, gradients):
    """
    Evaluate stars, each by itself: chi2 (n,), (n, 3, 3) and (n, 3).

    parameters (n, 3) are flux, x and y. Stars without pixels contribute
    nothing; n_pixels (n,) is -1 where an error is not positive and finite.
    """
    area = max(1, np.max(boxes[:, 2] * boxes[:, 3]))
    data, variance = np.empty((1, area)), np.empty((1, area))
    new = (np.zeros((1, area)), np.empty((1, area)), np.empty((3, 3)),
           np.empty(3))
    tiling = (np.empty(4 * _LANES), np.empty(3 * _LANES * area),
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


# A field of mixtures fitted to the stamps of n stars.
#
# shapes (K, 6) are the numbers that vary over the detector: log weight, x, y,
# log_p, s, log_q with p = exp(2 log_p), q = exp(2 log_q), so that any values
# are a valid mixture. The first three of the first Gaussian are never fitted:
# they would repeat the flux and the position of the stars.
#
# sources (M, 3) are x, y and flux of a star and of the neighbours in its
# stamp, of which the first n_sources count. In the normal equations of one
# stamp come first the Q numbers of its own, then the 6 K - 3 shapes, then the
# residual, all in one triangle: eliminating the first Q is a Schur complement
# that leaves the equations of the shapes, their right side and chi^2.

_TWO_PI = 2 * np.pi


@_jit
def _design(x, y, rows, sources, n_sources, first, row):
    """
    Put derivatives of a pixel into row and return the model.

    Those by the shapes are added from index ``first`` on, unless it is
    negative.
    """
    model = 0.0
    for j in range(n_sources):
        flux = sources[j, 2]
        value = 0.0
        gx = 0.0
        gy = 0.0
        for k in range(rows.shape[0]):
            a, mx, my, p, s, q = rows[k]
            dx = x - sources[j, 0] - mx
            dy = y - sources[j, 1] - my
            u = dx - s * dy
            pu = p * u
            qy = q * dy
            exponent = pu * u + qy * dy
            if not exponent < _LOG_NOTHING:
                continue
            g = a * exp(-0.5 * exponent)
            by_x = pu * g
            by_y = qy * g - s * by_x
            value += g
            gx += by_x
            gy += by_y
            if first >= 0:
                _add_shape_derivatives(flux, g, by_x, by_y, pu, u, qy, dy,
                                       first + 6 * k - 3, k > 0, row)
        row[3 * j] = flux * gx
        row[3 * j + 1] = flux * gy
        row[3 * j + 2] = value
        model += flux * value
    return model


@_jit
def _add_shape_derivatives(flux, g, by_x, by_y, pu, u, qy, dy, at, moves,
                           row):
    fg = flux * g
    if moves:
        row[at] += fg
        row[at + 1] += flux * by_x
        row[at + 2] += flux * by_y
    row[at + 3] += fg * (1 - pu * u)
    row[at + 4] += fg * pu * dy
    row[at + 5] += fg * (1 - qy * dy)


@_jit
def _accumulate(stamp, weight, left, bottom, rows, sources, n_sources, sky,
                fit_sky, with_shapes, block, normal):
    """
    Sum the normal equations of a stamp into normal; return their size.

    The size includes the column of the residual. block is scratch (4, D):
    four pixels at a time save three of four walks through normal.
    """
    own = 3 * n_sources + fit_sky
    size = own + 1
    first = -1
    if with_shapes:
        size += 6 * rows.shape[0] - 3
        first = own
    normal[:size, :size] = 0.0
    filled = 0
    for j in range(stamp.shape[0]):
        for i in range(stamp.shape[1]):
            w = weight[j, i]
            if w <= 0:
                continue
            row = block[filled]
            row[:size] = 0.0
            if fit_sky:
                row[own - 1] = 1.0
            model = _design(left + i, bottom + j, rows, sources, n_sources,
                            first, row)
            row[size - 1] = stamp[j, i] - sky - model
            root = sqrt(w)
            for m in range(size):
                row[m] *= root
            filled += 1
            if filled == 4:
                _add_products(block, size, normal)
                filled = 0
    block[filled:, :size] = 0.0
    _add_products(block, size, normal)
    return size


@_jit
def _add_products(block, size, normal):
    """Add the products of the columns of block (4, D), upper triangle."""
    r0, r1, r2, r3 = block[0], block[1], block[2], block[3]
    for m in range(size):
        out = normal[m]
        c0, c1, c2, c3 = r0[m], r1[m], r2[m], r3[m]
        for n in range(m, size):
            out[n] += c0 * r0[n] + c1 * r1[n] + c2 * r2[n] + c3 * r3[n]


@_jit
def _hold_neighbours(sources, anchors, n_sources, hold, size, normal):
    """Add the prior of the neighbours: anchors with the precisions hold."""
    for j in range(1, n_sources):
        for i in range(3):
            at = 3 * j + i
            offset = anchors[j, i] - sources[j, i]
            normal[at, at] += hold[j, i]
            normal[at, size - 1] += hold[j, i] * offset
            normal[size - 1, size - 1] += hold[j, i] * offset * offset


@_jit
def _eliminate(normal, n, size):
    """Eliminate the first n unknowns from the upper triangle, in place."""
    for k in range(n):
        pivot = normal[k, k]
        if not pivot > 0:
            continue
        for i in range(k + 1, size):
            factor = normal[k, i] / pivot
            if factor != 0:
                for j in range(i, size):
                    normal[i, j] -= factor * normal[k, j]


@_jit
def _back_substitute(normal, n, size, step):
    """Solve for the first n unknowns after their elimination."""
    for k in range(n - 1, -1, -1):
        right = normal[k, size - 1]
        for j in range(k + 1, n):
            right -= normal[k, j] * step[j]
        step[k] = right / normal[k, k] if normal[k, k] > 0 else 0.0


@_jit
def solve(augmented, step):
    """
    Solve a symmetric positive definite system for step (n,).

    augmented (n, n + 1) holds the matrix and the right side; only the upper
    triangle is read, and destroyed.
    """
    n = step.size
    for k in range(n):
        pivot = augmented[k, k]
        if not pivot > 0:
            continue
        upper = augmented[k]
        for i in range(k + 1, n):
            factor = upper[i] / pivot
            row = augmented[i]
            for j in range(i, n + 1):
                row[j] -= factor * upper[j]
    _back_substitute(augmented, n, n + 1, step)


@_jit
def _shift_sources(sources, n_sources, sky, fit_sky, step):
    """Add the step to a stamp's own numbers; return the sky."""
    for j in range(n_sources):
        for i in range(2):
            # A longer step would leave the core, where linear is wrong.
            sources[j, i] += min(max(step[3 * j + i], -0.5), 0.5)
        sources[j, 2] += step[3 * j + 2]
    if fit_sky:
        return sky + step[3 * n_sources]
    return sky


@_jit
def field_normal(stamps, weights, corners, basis, rows, jacobians, sources,
                 anchors, hold, n_sources, sky, fit_sky, used, n_steps,
                 normal, total, gradient, chi2):
    """
    Settle n stars and add the equations of the used ones to total, gradient.

    Each star's own numbers take n_steps Gauss-Newton steps, the PSF given;
    the last one is taken together with the equations of the shapes, so that
    chi2 (n,) and gradient are those after it.

    stamps, weights (n, s, s); corners (n, 2), the pixel (x, y) of each
    stamp's first; basis (n, T); rows (n, K, 6), the PSF of each star;
    jacobians (n, 6 K - 3, P), the derivatives of its shapes by the P numbers
    that are polynomials, or (0, 0, 0) if they are the shapes themselves;
    sources, anchors, hold (n, M, 3); n_sources (n,); sky (n,) with fit_sky;
    used (n,). normal is scratch (D, D) with D = 3 M + 6 K - 1. total
    (P T, P T), upper triangle, and gradient (P T,) order unknowns by number,
    then term.
    """
    block = np.empty((4, normal.shape[0]))
    step = np.empty(normal.shape[0])
    spread = np.empty(gradient.size)
    condensed = np.empty((jacobians.shape[2], jacobians.shape[2] + 1))
    for star in range(stamps.shape[0]):
        left, bottom = corners[star]
        own = 3 * n_sources[star] + fit_sky
        for i in range(n_steps):
            last = used[star] and i == n_steps - 1
            size = _accumulate(
                stamps[star], weights[star], left, bottom, rows[star],
                sources[star], n_sources[star], sky[star], fit_sky, last,
                block, normal)
            _hold_neighbours(sources[star], anchors[star], n_sources[star],
                             hold[star], size, normal)
            _eliminate(normal, own, size)
            _back_substitute(normal, own, size, step)
            sky[star] = _shift_sources(sources[star], n_sources[star],
                                       sky[star], fit_sky, step)
        chi2[star] = normal[size - 1, size - 1]
        if not used[star]:
            continue
        if jacobians.size:
            _condense(normal, own, size, jacobians[star], condensed)
            _spread(condensed, 0, condensed.shape[1], basis[star], spread,
                    total, gradient)
        else:
            _spread(normal, own, size, basis[star], spread, total, gradient)


@_jit
def _condense(normal, own, size, jacobian, out):
    """Put J^T A J and J^T b into out (P, P + 1), upper triangle."""
    n, p = jacobian.shape
    out[:] = 0.0
    line = np.empty(p + 1)
    for i in range(n):
        line[:] = 0.0
        for j in range(n):
            a = normal[own + min(i, j), own + max(i, j)]
            for m in range(p):
                line[m] += a * jacobian[j, m]
        line[p] = normal[own + i, size - 1]
        for k in range(p):
            share = jacobian[i, k]
            if share != 0:
                for m in range(k, p + 1):
                    out[k, m] += share * line[m]


@_jit
def _spread(normal, own, size, basis, spread, total, gradient):
    """Add A (x) B B^T to total, A being what is left of normal."""
    n_terms = basis.size
    for p in range(size - own - 1):
        for q in range(p, size - own - 1):
            for t in range(n_terms):
                spread[q * n_terms + t] = normal[own + p, own + q] * basis[t]
        right = normal[own + p, size - 1]
        for t in range(n_terms):
            b = basis[t]
            if b != 0:
                at = p * n_terms + t
                gradient[at] += b * right
                for j in range(p * n_terms, spread.size):
                    total[at, j] += b * spread[j]


@_jit
def field_model(corners, rows, sources, n_sources, sky, out):
    """Put model stamps of n stars, neighbours and sky included, into out."""
    for star in range(out.shape[0]):
        left, bottom = corners[star]
        out[star] = sky[star]
        for j in range(n_sources[star]):
            x, y, flux = sources[star, j]
            render(rows[star], x - left, y - bottom, flux, False, out[star])


# Crowded fields: all stars of an image together. Star i is fitted on a square
# stamp of width[i] pixels, odd, whose first pixel is (left, bottom)[i]; its
# pixels lie in jets (3, total) from offset[i] on, row by row: the PSF of unit
# flux and its derivatives by the star's x and y. Stamps may reach over the
# edges of the image. Parameters are ordered flux, x, y.

@_jit
def star_stamps(chosen, x, y, left, bottom, width, offset, rows, paces, count,
                integrated, jets):
    """
    Fill the stamps of the chosen stars.

    Star i's PSF are the first count[i] rows of rows[i]; paces is as of
    `paces`.
    """
    widest = 0
    for i in chosen:
        widest = max(widest, width[i])
    walk = np.empty(4 * _LANES)
    tile = np.empty(3 * _LANES * widest)
    for i in chosen:
        w = width[i]
        for first in range(0, w, _LANES):
            height = min(_LANES, w - first)
            walk[:] = 0.0
            tile[:3 * _LANES * w] = 0.0
            for k in range(count[i]):
                a, mx, my, p, s, q = rows[i, k]
                _add_gaussian(a, left[i] - x[i] - mx,
                              bottom[i] + first - y[i] - my, p, s, q,
                              paces[i, k], 0.0, 0.0, integrated, height, w,
                              walk, tile)
            for j in range(height):
                to = offset[i] + (first + j) * w
                for k in range(w):
                    at = 3 * _LANES * k + j
                    jets[0, to + k] = tile[at]
                    jets[1, to + k] = tile[at + _LANES]
                    jets[2, to + k] = tile[at + 2 * _LANES]


@_jit
def _walk_rows(start, end, way, fall, first, g, r, image):
    """Add g (n,) to rows start, start + way, ... end of image, r its fall."""
    for j in range(start, end + way, way):
        row = image[j]
        for i in range(g.size):
            row[first + i] += g[i]
            g[i] *= r[i]
            r[i] *= fall


@_jit
def _add_lanes(peak, cx, cy, p, s, q, reach, lanes, image):
    """
    Add a Gaussian, sampled at pixel centres, to a box of the image.

    The box is that of the ellipse where the exponent is -reach / 2. Rows are
    walked outward from the peak, all columns of the box at once; lanes is
    (4, n), n at least the length of a row of the image.
    """
    ny, nx = image.shape
    half_x, half_y = sqrt(reach * (1 / p + s * s / q)), sqrt(reach / q)
    if p * abs(s) * half_x > 300:
        _add_sampled(peak, cx, cy, p, s, q, reach, image)
        return
    first = max(0, int(ceil(cx - half_x)))
    n = min(nx - 1, int(floor(cx + half_x))) + 1 - first
    low = max(0, int(ceil(cy - half_y)))
    high = min(ny - 1, int(floor(cy + half_y)))
    if n <= 0 or low > high:
        return
    start = min(max(int(np.rint(cy)), low), high)
    dy = start - cy
    t = q + s * s * p
    fall = exp(-t)
    g, r, h, d = lanes[0, :n], lanes[1, :n], lanes[2, :n], lanes[3, :n]
    for i in range(n):
        u = first + i - cx - s * dy
        g[i] = peak * _exp(-0.5 * (p * u * u + q * dy * dy))
        slope = q * dy - p * s * u
        steep = _exp(-abs(slope))
        up = steep if slope > 0 else 1 / steep
        r[i] = up
        d[i] = 1 / up
    half = exp(-0.5 * t)
    for i in range(n):
        r[i] *= half
        d[i] *= half
        h[i] = g[i] * d[i]
        d[i] *= fall
    _walk_rows(start, high, 1, fall, first, g, r, image)
    _walk_rows(start - 1, low, -1, fall, first, h, d, image)


@_jit
def _add_wings(rows, flux, cx, cy, integrated, faintest, lanes, scratch,
               image):
    """Add a star, each Gaussian out to where it falls below faintest."""
    if integrated:
        _add_star(rows, flux, cx, cy, True, faintest, scratch, image)
        return
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        peak = flux * a
        ratio = abs(peak) / faintest
        if ratio > 1:
            _add_lanes(peak, cx + mx, cy + my, p, s, q, 2 * log(ratio), lanes,
                       image)


@_jit
def add_stars(chosen, sign, x, y, flux, left, bottom, width, offset, wing,
              jets, rows, count, integrated, faintest, image):
    """
    Add sign times the chosen stars to the image.

    A star whose wing (half a width, integer) reaches over its stamp is drawn
    afresh, each Gaussian out to where it falls below faintest; others are
    copied from it.
    """
    ny, nx = image.shape
    scratch = np.empty((3, _ERRORS.size))
    lanes = np.empty((4, nx))
    for i in chosen:
        w = width[i]
        if wing[i] <= w // 2:
            for j in range(max(0, -bottom[i]), min(w, ny - bottom[i])):
                first = offset[i] + j * w - left[i]
                for k in range(max(0, left[i]), min(left[i] + w, nx)):
                    image[bottom[i] + j, k] += (sign * flux[i]
                                                * jets[0, first + k])
            continue
        grow = wing[i] - w // 2
        x_low = max(0, left[i] - grow)
        x_high = min(nx, left[i] + w + grow)
        y_low = max(0, bottom[i] - grow)
        y_high = min(ny, bottom[i] + w + grow)
        if x_low >= x_high or y_low >= y_high:
            continue
        _add_wings(rows[i, :count[i]], sign * flux[i], x[i] - x_low,
                   y[i] - y_low, integrated, faintest, lanes, scratch,
                   image[y_low:y_high, x_low:x_high])


@_jit
def mesh_sums(weight, residual, background, rows, columns, n_columns, clip,
              out):
    """
    Put sums over the pixels of each node of a background into out (m, 3).

    In order: the weight; the weight of pixels within clip standard errors of
    the model; and that times what of those pixels is no star's. Pixels
    belong to the nodes of rows (ny,) and columns (nx,).
    """
    out[:] = 0
    for j in range(weight.shape[0]):
        first = rows[j] * n_columns
        for i in range(weight.shape[1]):
            w, r = weight[j, i], residual[j, i]
            node = first + columns[i]
            out[node, 0] += w
            if w * r * r <= clip * clip:
                out[node, 1] += w
                out[node, 2] += w * (r + background[j, i])


@_jit
def count_near(x, y, reach, cell, columns, start, order, count):
    """
    Put the number of other points within reach of each into count (n,).

    Points lie in cells as wide as reach, in rows of so many columns with
    nothing in the outermost; cell (n,) is where each is, order lists the
    points of cell c from start[c] to start[c + 1].
    """
    for i in range(x.size):
        count[i] = 0
        for row in range(-1, 2):
            middle = cell[i] + row * columns
            for at in range(start[middle - 1], start[middle + 2]):
                j = order[at]
                if j != i and sqrt((x[j] - x[i])**2
                                   + (y[j] - y[i])**2) <= reach:
                    count[i] += 1


@_jit
def list_near(x, y, reach, cell, columns, start, order, indptr, neighbour,
              distance, twin):
    """
    List the points within reach of each, nearest first.

    Those of point i go into neighbour from indptr[i] on, with their distance;
    twin says where the same pair stands the other way round. For the rest
    see `count_near`.
    """
    for i in range(x.size):
        end = indptr[i]
        for row in range(-1, 2):
            middle = cell[i] + row * columns
            for at in range(start[middle - 1], start[middle + 2]):
                j = order[at]
                gap = sqrt((x[j] - x[i])**2 + (y[j] - y[i])**2)
                if j == i or gap > reach:
                    continue
                to = end
                while to > indptr[i] and (distance[to - 1] > gap or (
                        distance[to - 1] == gap and neighbour[to - 1] > j)):
                    neighbour[to] = neighbour[to - 1]
                    distance[to] = distance[to - 1]
                    to -= 1
                neighbour[to] = j
                distance[to] = gap
                end += 1
    for i in range(x.size):
        for pair in range(indptr[i], indptr[i + 1]):
            j = neighbour[pair]
            for other in range(indptr[j], indptr[j + 1]):
                if neighbour[other] == i:
                    twin[pair] = other


@_jit
def own_equations(flux, left, bottom, width, offset, jets, weight, residual,
                  matrix, gradient, reach):
    """
    Put each star's own normal equations into matrix (n, 3, 3), gradient.

    reach (n, 3) takes the sums of weighted derivatives, which couple the
    star to the background.
    """
    ny, nx = weight.shape
    for i in range(flux.size):
        w = width[i]
        m00 = m01 = m02 = m11 = m12 = m22 = 0.0
        g0 = g1 = g2 = s0 = s1 = s2 = 0.0
        for j in range(max(0, -bottom[i]), min(w, ny - bottom[i])):
            first = offset[i] + j * w - left[i]
            row = bottom[i] + j
            for k in range(max(0, left[i]), min(left[i] + w, nx)):
                v = weight[row, k]
                d0 = jets[0, first + k]
                d1 = jets[1, first + k]
                d2 = jets[2, first + k]
                e0, e1, e2 = v * d0, v * d1, v * d2
                r = residual[row, k]
                m00 += d0 * e0
                m01 += d0 * e1
                m02 += d0 * e2
                m11 += d1 * e1
                m12 += d1 * e2
                m22 += d2 * e2
                g0 += r * e0
                g1 += r * e1
                g2 += r * e2
                s0 += e0
                s1 += e1
                s2 += e2
        f = flux[i]
        matrix[i, 0, 0] = m00
        matrix[i, 0, 1] = matrix[i, 1, 0] = f * m01
        matrix[i, 0, 2] = matrix[i, 2, 0] = f * m02
        matrix[i, 1, 1] = f * f * m11
        matrix[i, 1, 2] = matrix[i, 2, 1] = f * f * m12
        matrix[i, 2, 2] = f * f * m22
        gradient[i, 0] = g0
        gradient[i, 1] = f * g1
        gradient[i, 2] = f * g2
        reach[i, 0] = s0
        reach[i, 1] = f * s1
        reach[i, 2] = f * s2


@_jit
def pair_blocks(indptr, neighbour, twin, flux, left, bottom, width, offset,
                jets, weight, blocks):
    """
    Put the 3 x 3 normal matrices of neighbours into blocks (n_pairs, 3, 3).

    Star i's neighbours are neighbour[indptr[i]:indptr[i + 1]]; twin is where
    the same pair stands the other way round.
    """
    ny, nx = weight.shape
    for i in range(flux.size):
        for pair in range(indptr[i], indptr[i + 1]):
            j = neighbour[pair]
            if j < i:
                continue
            b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = 0.0
            x_low = max(0, left[i], left[j])
            x_high = min(nx, left[i] + width[i], left[j] + width[j])
            for row in range(max(0, bottom[i], bottom[j]),
                             min(ny, bottom[i] + width[i],
                                 bottom[j] + width[j])):
                first = offset[i] + (row - bottom[i]) * width[i] - left[i]
                other = offset[j] + (row - bottom[j]) * width[j] - left[j]
                for k in range(x_low, x_high):
                    v = weight[row, k]
                    e0 = v * jets[0, other + k]
                    e1 = v * jets[1, other + k]
                    e2 = v * jets[2, other + k]
                    d0 = jets[0, first + k]
                    d1 = jets[1, first + k]
                    d2 = jets[2, first + k]
                    b00 += d0 * e0
                    b01 += d0 * e1
                    b02 += d0 * e2
                    b10 += d1 * e0
                    b11 += d1 * e1
                    b12 += d1 * e2
                    b20 += d2 * e0
                    b21 += d2 * e1
                    b22 += d2 * e2
            block = blocks[pair]
            block[0, 0], block[0, 1], block[0, 2] = b00, b01, b02
            block[1, 0], block[1, 1], block[1, 2] = b10, b11, b12
            block[2, 0], block[2, 1], block[2, 2] = b20, b21, b22
            block[1:] *= flux[i]
            block[:, 1:] *= flux[j]
            for m in range(3):
                for n in range(3):
                    blocks[twin[pair], n, m] = block[m, n]


@_jit
def _invert_3x3(a, out):
    """Invert a symmetric matrix; zeros if it is not positive definite."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not det > 1e-12 * a[0, 0] * a[1, 1] * a[2, 2]:
        out[:] = 0
        return
    out[0, 0] = c00 / det
    out[0, 1] = out[1, 0] = c01 / det
    out[0, 2] = out[2, 0] = c02 / det
    out[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]) / det
    out[1, 2] = out[2, 1] = (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]) / det
    out[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]) / det


@_jit
def _apply_mesh(v, mesh, tie, columns, out):
    """Multiply by the matrix of a background, as of `solve_joint`."""
    for m in range(v.size):
        column = m % columns
        near = 0.0
        if column > 0:
            near += v[m - 1]
        if column < columns - 1:
            near += v[m + 1]
        if m >= columns:
            near += v[m - columns]
        if m < v.size - columns:
            near += v[m + columns]
        out[m] = mesh[m] * v[m] - tie * near


@_jit
def _apply_joint(v, mesh_v, matrix, indptr, neighbour, blocks, node, share,
                 reach, mesh, tie, columns, out, mesh_out):
    """
    Multiply by the joint normal matrix of stars and background.

    Returns the product of v and the outcome.
    """
    _apply_mesh(mesh_v, mesh, tie, columns, mesh_out)
    product = 0.0
    for i in range(v.shape[0]):
        level = 0.0
        for c in range(4):
            level += share[i, c] * mesh_v[node[i, c]]
        o0 = reach[i, 0] * level
        o1 = reach[i, 1] * level
        o2 = reach[i, 2] * level
        a = matrix[i]
        v0, v1, v2 = v[i, 0], v[i, 1], v[i, 2]
        o0 += a[0, 0] * v0 + a[0, 1] * v1 + a[0, 2] * v2
        o1 += a[1, 0] * v0 + a[1, 1] * v1 + a[1, 2] * v2
        o2 += a[2, 0] * v0 + a[2, 1] * v1 + a[2, 2] * v2
        light = reach[i, 0] * v0 + reach[i, 1] * v1 + reach[i, 2] * v2
        for c in range(4):
            mesh_out[node[i, c]] += share[i, c] * light
        for pair in range(indptr[i], indptr[i + 1]):
            b = blocks[pair]
            j = neighbour[pair]
            w0, w1, w2 = v[j, 0], v[j, 1], v[j, 2]
            o0 += b[0, 0] * w0 + b[0, 1] * w1 + b[0, 2] * w2
            o1 += b[1, 0] * w0 + b[1, 1] * w1 + b[1, 2] * w2
            o2 += b[2, 0] * w0 + b[2, 1] * w1 + b[2, 2] * w2
        out[i, 0] = o0
        out[i, 1] = o1
        out[i, 2] = o2
        product += v0 * o0 + v1 * o1 + v2 * o2
    for m in range(mesh_v.size):
        product += mesh_v[m] * mesh_out[m]
    return product


@_jit
def _precondition(inverse, mesh, r, mesh_r, z, mesh_z):
    """Put r times the inverse blocks into z; return the product of both."""
    product = 0.0
    for i in range(r.shape[0]):
        c = inverse[i]
        r0, r1, r2 = r[i, 0], r[i, 1], r[i, 2]
        z0 = c[0, 0] * r0 + c[0, 1] * r1 + c[0, 2] * r2
        z1 = c[1, 0] * r0 + c[1, 1] * r1 + c[1, 2] * r2
        z2 = c[2, 0] * r0 + c[2, 1] * r1 + c[2, 2] * r2
        z[i, 0], z[i, 1], z[i, 2] = z0, z1, z2
        product += r0 * z0 + r1 * z1 + r2 * z2
    for m in range(mesh_r.size):
        mesh_z[m] = mesh_r[m] / mesh[m]
        product += mesh_r[m] * mesh_z[m]
    return product


@_jit
def _add_scaled(x, scale, y):
    """Add scale * y to x, both flat."""
    for i in range(x.size):
        x[i] += scale * y[i]


@_jit
def _extend(x, scale, y):
    """Put y + scale * x into x, both flat."""
    for i in range(x.size):
        x[i] = y[i] + scale * x[i]


@_jit
def solve_joint(matrix, gradient, indptr, neighbour, blocks, node, share,
                reach, mesh, tie, columns, mesh_gradient, tolerance,
                max_steps, step, mesh_step):
    """
    Solve the joint normal equations by preconditioned conjugate gradients.

    Stars couple to their neighbours (`pair_blocks`) and to the four nodes
    node (n, 4) of the background around them, with the bilinear shares
    share (n, 4). The background's own matrix has the diagonal mesh (m,) and
    -tie between nodes that are neighbours, in rows of so many columns. Each
    star's own block is the preconditioner; stars whose block is singular do
    not move. Returns the number of steps.
    """
    n = gradient.shape[0]
    inverse = np.empty((n, 3, 3))
    for i in range(n):
        _invert_3x3(matrix[i], inverse[i])
    step[:] = 0
    mesh_step[:] = 0
    r, mesh_r = gradient.copy(), mesh_gradient.copy()
    z, mesh_z = np.empty_like(r), np.empty_like(mesh_r)
    # A preconditioner of zero keeps singular stars out of z, and so of v.
    rz = _precondition(inverse, mesh, r, mesh_r, z, mesh_z)
    v, mesh_v = z.copy(), mesh_z.copy()
    a, mesh_a = np.empty_like(r), np.empty_like(mesh_r)
    goal = tolerance * tolerance * rz
    for count in range(max_steps):
        if not rz > goal:
            return count
        alpha = rz / _apply_joint(v, mesh_v, matrix, indptr, neighbour,
                                  blocks, node, share, reach, mesh, tie,
                                  columns, a, mesh_a)
        _add_scaled(step.reshape(-1), alpha, v.reshape(-1))
        _add_scaled(mesh_step, alpha, mesh_v)
        _add_scaled(r.reshape(-1), -alpha, a.reshape(-1))
        _add_scaled(mesh_r, -alpha, mesh_a)
        before = rz
        rz = _precondition(inverse, mesh, r, mesh_r, z, mesh_z)
        _extend(v.reshape(-1), rz / before, z.reshape(-1))
        _extend(mesh_v, rz / before, mesh_z)
    return max_steps


@_jit
def _cholesky(a, n):
    """Factor a[:n, :n] in place; False where it is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            if i == j:
                if not total > 1e-12:
                    return False
                a[i, i] = sqrt(total)
            else:
                a[i, j] = total / a[j, j]
    return True


@_jit
def _factor_inverse_columns(a, n, first, count, out):
    """
    Put columns first, ... of inverse(L L^T) into out[:n, :count].

    a holds L below and on its diagonal.
    """
    for c in range(count):
        for i in range(n):
            total = 1.0 if i == first + c else 0.0
            for k in range(i):
                total -= a[i, k] * out[k, c]
            out[i, c] = total / a[i, i]
        for i in range(n - 1, -1, -1):
            total = out[i, c]
            for k in range(i + 1, n):
                total -= a[k, i] * out[k, c]
            out[i, c] = total / a[i, i]


@_jit
def joint_covariances(matrix, indptr, neighbour, blocks, partner, covariance,
                      correlation):
    """
    Put the covariance of each star, neighbours free, into covariance.

    covariance is (n, 3, 3); correlation (n,) takes the correlation of the
    flux with that of the star partner[i], 0 where it is none of the
    neighbours. A star's normal matrix is that of itself and up to 12 of its
    neighbours, those that come first. NaN where it is singular.
    """
    most = 13
    members = np.empty(most, np.int64)
    where = np.full(matrix.shape[0], -1, np.int64)
    a = np.empty((3 * most, 3 * most))
    scale = np.empty(3 * most)
    columns = np.empty((3 * most, 3))
    alone = np.empty((3 * most, 1))
    for i in range(matrix.shape[0]):
        count = 1
        members[0] = i
        for pair in range(indptr[i], indptr[i + 1]):
            if count == most:
                break
            members[count] = neighbour[pair]
            count += 1
        size = 3 * count
        for m in range(count):
            where[members[m]] = m
        a[:size, :size] = 0
        for m in range(count):
            star = members[m]
            a[3 * m:3 * m + 3, 3 * m:3 * m + 3] = matrix[star]
            for pair in range(indptr[star], indptr[star + 1]):
                other = where[neighbour[pair]]
                if other >= 0:
                    for r in range(3):
                        for c in range(3):
                            a[3 * m + r, 3 * other + c] = blocks[pair, r, c]
        for m in range(count):
            where[members[m]] = -1
        for m in range(size):
            scale[m] = 1 / sqrt(a[m, m]) if a[m, m] > 0 else 0.0
        for r in range(size):
            for c in range(size):
                a[r, c] *= scale[r] * scale[c]
            if scale[r] == 0:
                a[r, r] = 1.0
        correlation[i] = 0.0
        if scale[0] == 0 or not _cholesky(a, size):
            covariance[i] = np.nan
            continue
        _factor_inverse_columns(a, size, 0, 3, columns)
        for r in range(3):
            for c in range(3):
                covariance[i, r, c] = columns[r, c] * scale[r] * scale[c]
        for m in range(1, count):
            if members[m] == partner[i]:
                _factor_inverse_columns(a, size, 3 * m, 1, alone)
                correlation[i] = columns[3 * m, 0] / sqrt(
                    columns[0, 0] * alone[3 * m, 0])


@_jit
def score(residual, weight, template, x_low, x_high, y_low, y_high, hint,
          significance, flux):
    """
    Ask at each pixel of a window how significant a star there would be.

    A star of the template (2h + 1, 2h + 1) and a constant are fitted together
    around the pixel; flux takes the star's flux, significance its ratio to
    the standard error, 0 where less than a third of the information is left
    by weights of zero. Pixels are passed over unless the nine around them
    together stand out by hint standard errors.
    """
    ny, nx = residual.shape
    h = template.shape[0] // 2
    power = (template**2).sum()
    for y in range(y_low, y_high):
        for x in range(x_low, x_high):
            rs = ws = 0.0
            for j in range(max(0, y - 1), min(ny, y + 2)):
                for i in range(max(0, x - 1), min(nx, x + 2)):
                    rs += weight[j, i] * residual[j, i]
                    ws += weight[j, i]
            if not rs > hint * sqrt(ws):
                continue
            pr = pp = ps = rs = ws = seen = 0.0
            for j in range(max(-h, -y), min(h + 1, ny - y)):
                for i in range(max(-h, -x), min(h + 1, nx - x)):
                    w = weight[y + j, x + i]
                    t = template[h + j, h + i]
                    r = residual[y + j, x + i]
                    wt = w * t
                    pr += wt * r
                    pp += wt * t
                    ps += wt
                    rs += w * r
                    ws += w
                    if w > 0:
                        seen += t * t
            info = pp - ps * ps / ws
            if 3 * seen > power and info > 0:
                flux[y, x] = (pr - ps * rs / ws) / info
                significance[y, x] = flux[y, x] * sqrt(info)


@_jit
def _template_products(x, y, template, weight, residual, light, out):
    """
    Put the sums of t w r, t^2 w and (t w light)^2 around a pixel into out.

    False where weights of zero leave less than a third of the information.
    """
    ny, nx = residual.shape
    h = template.shape[0] // 2
    tr = tt = tl = seen = power = 0.0
    for j in range(-h, h + 1):
        for i in range(-h, h + 1):
            t = template[h + j, h + i]
            power += t * t
            if not (0 <= y + j < ny and 0 <= x + i < nx):
                continue
            w = weight[y + j, x + i]
            if w == 0:
                continue
            tw = t * w
            seen += t * t
            tr += tw * residual[y + j, x + i]
            tt += tw * t
            tl += (tw * light[y + j, x + i])**2
    out[0] = tr
    out[1] = tt
    out[2] = tl
    return 3 * seen >= power


@_jit
def _template_overlap(x, y, template, weight, left, bottom, width, jets, flux,
                      out):
    """Put the sums of t w times a star's derivatives into out (3,)."""
    ny, nx = weight.shape
    h = template.shape[0] // 2
    o0 = o1 = o2 = 0.0
    x_low, x_high = max(0, left, x - h), min(nx, left + width, x + h + 1)
    for row in range(max(0, bottom, y - h),
                     min(ny, bottom + width, y + h + 1)):
        first = (row - bottom) * width - left
        for k in range(x_low, x_high):
            tw = template[row - y + h, k - x + h] * weight[row, k]
            o0 += tw * jets[0, first + k]
            o1 += tw * jets[1, first + k]
            o2 += tw * jets[2, first + k]
    out[0] = o0
    out[1] = flux * o1
    out[2] = flux * o2


@_jit
def score_beside(x, y, flux, left, bottom, width, offset, jets, matrix,
                 gradient, indptr, neighbour, blocks, templates, cell, weight,
                 residual, light, reach, least, threshold, significance,
                 found):
    r"""
    Ask how significant a further star would be on pixels close to stars.

    For a pixel within reach of a star, nearest to it, the stars around are
    free to readjust: with the candidate's own information h, gradient g, its
    overlaps a with the stars' parameters and their normal matrix N and
    gradient n,

    .. math:: S = (g - a^T N^{-1} n) / \sqrt{h - a^T N^{-1} a + v},

    where v is the variance of g by errors of the PSF, the sum over pixels of
    :math:`(t w\,\mathrm{light})^2`. Pixels where less than the fraction
    least of h is left cannot be told from the stars and keep 0. templates is
    (cells along y, along x, 2h + 1, 2h + 1), each for cell x cell pixels.
    """
    ny, nx = residual.shape
    most = 4
    members = np.empty(most, np.int64)
    a = np.empty((3 * most, 3 * most))
    rhs = np.empty((3 * most, 2))
    overlap = np.empty(3)
    sums = np.empty(3)
    side = int(ceil(reach))
    for i in range(x.size):
        for row in range(max(0, int(np.rint(y[i])) - side),
                         min(ny, int(np.rint(y[i])) + side + 1)):
            for k in range(max(0, int(np.rint(x[i])) - side),
                           min(nx, int(np.rint(x[i])) + side + 1)):
                gap = (x[i] - k)**2 + (y[i] - row)**2
                if gap > reach * reach:
                    continue
                members[0] = i
                count = 1
                nearest = True
                for pair in range(indptr[i], indptr[i + 1]):
                    j = neighbour[pair]
                    other = (x[j] - k)**2 + (y[j] - row)**2
                    if other < gap:
                        nearest = False
                        break
                    if other < 9 and count < most:
                        members[count] = j
                        count += 1
                if not nearest:
                    continue
                significance[row, k] = 0.0
                template = templates[row // cell, k // cell]
                if not _template_products(k, row, template, weight, residual,
                                          light, sums):
                    continue
                # What the stars' freedom can add is bounded.
                if not sums[0] > threshold * sqrt(0.3 * least * sums[1]):
                    continue
                size = 3 * count
                for m in range(count):
                    star = members[m]
                    _template_overlap(
                        k, row, template, weight, left[star], bottom[star],
                        width[star], jets[:, offset[star]:], flux[star],
                        overlap)
                    for c in range(3):
                        rhs[3 * m + c, 0] = overlap[c]
                        rhs[3 * m + c, 1] = gradient[star, c]
                        for d in range(3):
                            a[3 * m + c, 3 * m + d] = matrix[star, c, d]
                    for n in range(m):
                        for c in range(3):
                            for d in range(3):
                                a[3 * m + c, 3 * n + d] = 0.0
                        for pair in range(indptr[star], indptr[star + 1]):
                            if neighbour[pair] == members[n]:
                                for c in range(3):
                                    for d in range(3):
                                        a[3 * m + c, 3 * n + d] = blocks[
                                            pair, c, d]
                for c in range(size):
                    s = 1 / sqrt(a[c, c]) if a[c, c] > 0 else 0.0
                    rhs[c, 0] *= s
                    rhs[c, 1] *= s
                    for d in range(c + 1):
                        a[c, d] *= s
                    for d in range(c, size):
                        a[d, c] *= s
                    a[c, c] = 1.0 + 1e-9
                if not _cholesky(a, size):
                    continue
                info = sums[1]
                g = sums[0]
                for c in range(size):
                    u, v = rhs[c, 0], rhs[c, 1]
                    for d in range(c):
                        u -= a[c, d] * rhs[d, 0]
                        v -= a[c, d] * rhs[d, 1]
                    rhs[c, 0] = u / a[c, c]
                    rhs[c, 1] = v / a[c, c]
                    info -= rhs[c, 0] * rhs[c, 0]
                    g -= rhs[c, 0] * rhs[c, 1]
                if info < least * sums[1]:
                    continue
                significance[row, k] = g / sqrt(info + sums[2])
                found[row, k] = g / info


@_jit
def star_quality(flux, x, y, left, bottom, width, offset, jets, weight,
                 residual, light, out):
    """
    Put sums over each star's stamp into out (n, 6).

    In order: the number of pixels with weight, chi2, the sum of absolute
    residuals, the residual of the star's central pixel, the star's own share
    of the light of all stars, and the share of its information on the flux
    that pixels with weight hold.
    """
    ny, nx = weight.shape
    for i in range(flux.size):
        w = width[i]
        count = chi2 = deviation = own = total = seen = power = 0.0
        for j in range(w):
            row = bottom[i] + j
            for k in range(w):
                column = left[i] + k
                if not (0 <= row < ny and 0 <= column < nx):
                    continue
                p = jets[0, offset[i] + j * w + k]
                power += p * p
                v = weight[row, column]
                if v == 0:
                    continue
                r = residual[row, column]
                count += 1
                chi2 += v * r * r
                deviation += abs(r)
                own += p * flux[i]
                total += max(light[row, column], 0.0)
                seen += p * p
        out[i, 0] = count
        out[i, 1] = chi2
        out[i, 2] = deviation
        row, column = int(np.rint(y[i])), int(np.rint(x[i]))
        out[i, 3] = np.nan
        if 0 <= row < ny and 0 <= column < nx and weight[row, column] > 0:
            out[i, 3] = residual[row, column]
        out[i, 4] = min(own / total, 1.0) if total > 0 else np.nan
        out[i, 5] = seen / power if power > 0 else 0.0
