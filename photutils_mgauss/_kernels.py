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
from math import ceil, erf, exp, sqrt

import numpy as np
from numba import njit

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
def evaluate(x, y, rows, integrated, out):
    """Put the mixture at the points into out (n,)."""
    for i in range(x.size):
        total = 0.0
        for k in range(rows.shape[0]):
            a, mx, my, p, s, q = rows[k]
            total += a * _value(x[i] - mx, y[i] - my, p, s, q, integrated)
        out[i] = total


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

    flux, x_0 and y_0 have one element or n.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    for i in range(x.size):
        c = i if x_0.size > 1 else 0
        if i == 0 or x_0.size > 1:
            blend_weights(x_0[c], y_0[c], x_grid, y_grid, index, weights)
        total = 0.0
        for corner in range(4):
            if weights[0, corner] == 0:
                continue
            part = 0.0
            for k in range(nodes.shape[1]):
                a, mx, my, p, s, q = nodes[index[corner], k]
                if a != 0:
                    part += a * _value(x[i] - x_0[c] - mx, y[i] - y_0[c] - my,
                                       p, s, q, integrated)
            total += weights[0, corner] * part
        out[i] = total * flux[i if flux.size > 1 else 0]


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
    for i in range(x.size):
        total = 0.0
        by_x = 0.0
        by_y = 0.0
        for corner in range(4):
            value = 0.0
            gx = 0.0
            gy = 0.0
            for k in range(nodes.shape[1]):
                a, mx, my, p, s, q = nodes[index[corner], k]
                if a == 0:
                    continue
                dx, dy = x[i] - x_0 - mx, y[i] - y_0 - my
                dgx, dgy = _gradient(dx, dy, p, s, q, integrated)
                value += a * _value(dx, dy, p, s, q, integrated)
                gx += a * dgx
                gy += a * dgy
            w = weights[0, corner]
            total += w * value
            by_x += weights[1, corner] * value - w * gx
            by_y += weights[2, corner] * value - w * gy
        out[0, i] = total
        out[1, i] = by_x
        out[2, i] = by_y


@_jit
def render_grid(x, y, flux, left, bottom, nodes, x_grid, y_grid, integrated,
                out):
    """
    Add star i to its stamp out[i], whose first pixel is (left, bottom)[i].

    x, y, flux, left and bottom are (n,), out is (n, ny, nx).
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            w = weights[0, corner] * flux[i]
            if w != 0:
                render(nodes[index[corner]], x[i] - left[i], y[i] - bottom[i],
                       w, integrated, out[i])


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
def draw_unit(shapes, cx, cy, images):
    """Put Gaussians of unit flux into images (K, ny, nx)."""
    for k in range(shapes.shape[0]):
        mx, my, log_l, t, log_m = shapes[k]
        length, m = exp(log_l), exp(log_m)
        peak = exp(log_l + log_m - _LOG_2PI)
        for j in range(images.shape[1]):
            row = images[k, j]
            row[:] = 0.0
            v = j - cy - my
            q = m * m * v * v
            if q < _LOG_NOTHING:
                _add_row(peak * exp(-0.5 * q), -cx - mx + t / length * v,
                         length * length, row)


@_jit
def _columns_of_product(a, b, weight, cy, columns):
    """
    Put sum_y w a b y^m into columns[m, x], m <= 4.

    Four columns at a time with sums of their own: the compiler packs them
    into vectors, which it must not do to a single sum.
    """
    ny, nx = a.shape
    blocks = nx - nx % 4
    for i in range(0, blocks, 4):
        p0, p1, p2, p3 = 0.0, 0.0, 0.0, 0.0
        q0, q1, q2, q3 = 0.0, 0.0, 0.0, 0.0
        r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for j in range(ny):
            v = j - cy
            h0 = weight[j, i] * a[j, i] * b[j, i]
            h1 = weight[j, i + 1] * a[j, i + 1] * b[j, i + 1]
            h2 = weight[j, i + 2] * a[j, i + 2] * b[j, i + 2]
            h3 = weight[j, i + 3] * a[j, i + 3] * b[j, i + 3]
            p0, p1, p2, p3 = p0 + h0, p1 + h1, p2 + h2, p3 + h3
            h0, h1, h2, h3 = h0 * v, h1 * v, h2 * v, h3 * v
            q0, q1, q2, q3 = q0 + h0, q1 + h1, q2 + h2, q3 + h3
            h0, h1, h2, h3 = h0 * v, h1 * v, h2 * v, h3 * v
            r0, r1, r2, r3 = r0 + h0, r1 + h1, r2 + h2, r3 + h3
            h0, h1, h2, h3 = h0 * v, h1 * v, h2 * v, h3 * v
            s0, s1, s2, s3 = s0 + h0, s1 + h1, s2 + h2, s3 + h3
            h0, h1, h2, h3 = h0 * v, h1 * v, h2 * v, h3 * v
            t0, t1, t2, t3 = t0 + h0, t1 + h1, t2 + h2, t3 + h3
        _put(columns[0], i, p0, p1, p2, p3)
        _put(columns[1], i, q0, q1, q2, q3)
        _put(columns[2], i, r0, r1, r2, r3)
        _put(columns[3], i, s0, s1, s2, s3)
        _put(columns[4], i, t0, t1, t2, t3)
    for i in range(blocks, nx):
        p, q, r, s, t = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(ny):
            v = j - cy
            h = weight[j, i] * a[j, i] * b[j, i]
            p += h
            q += h * v
            r += h * v * v
            s += h * v * v * v
            t += h * v * v * v * v
        columns[0, i], columns[1, i], columns[2, i] = p, q, r
        columns[3, i], columns[4, i] = s, t


@_jit
def _put(row, i, a, b, c, d):
    row[i], row[i + 1], row[i + 2], row[i + 3] = a, b, c, d


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
    images, residual, gram, rhs, work, active = scratch[:6]
    total, tie_weight = tie
    draw_unit(shapes, centre[0], centre[1], images)
    n = fluxes.size
    for k in range(n):
        rhs[k] = _weighted_dot(images[k], stamp, weight) + tie_weight * total
        for other in range(k + 1):
            dot = _weighted_dot(images[k], images[other], weight) + tie_weight
            gram[k, other] = gram[other, k] = dot
    if rows.shape[0] > 0:
        _add_rows_to_fluxes(rows, stamp, images, gram, rhs)
    _solve_fluxes(gram, rhs, signed, fluxes, active, work)
    _residual(stamp, images, fluxes, residual)
    chi2 = _weighted_dot(residual, residual, weight)
    for row in rows:
        chi2 += _dot(row, residual) ** 2
    lack = fluxes.sum() - total
    return chi2 + tie_weight * lack * lack


@_jit
def _dot(a, b):
    """Return sum_pixels a b."""
    total = 0.0
    for j in range(a.shape[0]):
        for i in range(a.shape[1]):
            total += a[j, i] * b[j, i]
    return total


@_jit
def _add_rows_to_fluxes(rows, stamp, images, gram, rhs):
    """Add rows (m, ny, nx) over the residual to the equations of fluxes."""
    seen = np.empty(images.shape[0])
    for row in rows:
        want = _dot(row, stamp)
        for k in range(seen.size):
            seen[k] = _dot(row, images[k])
        for k in range(seen.size):
            rhs[k] += seen[k] * want
            for other in range(seen.size):
                gram[k, other] += seen[k] * seen[other]


@_jit
def _add_rows(rows, centre, residual, images, fluxes, polynomials, matrix,
              gradient):
    """Add rows (m, ny, nx) over the residual to the normal equations."""
    n = fluxes.size
    sums, slopes = np.empty(6), np.empty(6 * n)
    for row in rows:
        left = _dot(row, residual)
        for k in range(n):
            _row_moments(row, images[k], centre, sums)
            for i in range(6):
                slope = 0.0
                for a in range(6):
                    slope += polynomials[k, i, a] * sums[a]
                slopes[_unknown(n, k, i)] = slope * (fluxes[k] if i else 1.0)
        for i in range(6 * n):
            gradient[i] += slopes[i] * left
            for j in range(6 * n):
                matrix[i, j] += slopes[i] * slopes[j]


@_jit
def _row_moments(row, image, centre, sums):
    """Put sum_pixels row image (1, x, y, xx, xy, yy) into sums (6,)."""
    sums[:] = 0.0
    for j in range(image.shape[0]):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for i in range(image.shape[1]):
            h = row[j, i] * image[j, i]
            x = i - centre[0]
            s0 += h
            s1 += h * x
            s2 += h * x * x
        y = j - centre[1]
        sums[0] += s0
        sums[1] += s1
        sums[2] += y * s0
        sums[3] += s2
        sums[4] += y * s1
        sums[5] += y * y * s0


@_jit
def _weighted_dot(a, b, weight):
    """Return sum_pixels w a b, in four sums that make a vector."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    blocks = a.shape[1] - a.shape[1] % 4
    for j in range(a.shape[0]):
        for i in range(0, blocks, 4):
            s0 += weight[j, i] * a[j, i] * b[j, i]
            s1 += weight[j, i + 1] * a[j, i + 1] * b[j, i + 1]
            s2 += weight[j, i + 2] * a[j, i + 2] * b[j, i + 2]
            s3 += weight[j, i + 3] * a[j, i + 3] * b[j, i + 3]
        for i in range(blocks, a.shape[1]):
            s0 += weight[j, i] * a[j, i] * b[j, i]
    return s0 + s1 + s2 + s3


@_jit
def normal_equations(weight, centre, shapes, fluxes, tie, rows, scratch,
                     matrix, gradient):
    """
    Put the normal equations into matrix (6K, 6K) and gradient (6K,).

    The unknowns are the K fluxes and five shape numbers for each Gaussian.
    The images and the residual come from `project`.
    """
    images, residual = scratch[:2]
    polynomials, columns, moments, half, block = scratch[6:]
    n = fluxes.size
    for k in range(n):
        _polynomials(shapes[k], polynomials[k])
        _moments_of_product(images[k], residual, weight, centre[0], centre[1],
                            columns, moments)
        for i in range(6):
            slope = 0.0
            for a in range(6):
                slope += (polynomials[k, i, a]
                          * moments[_POWER_X[a], _POWER_Y[a]])
            gradient[_unknown(n, k, i)] = slope * (fluxes[k] if i else 1.0)
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
        _add_rows(rows, centre, residual, images, fluxes, polynomials, matrix,
                  gradient)


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
        normal_equations(weight, centre, shapes, fluxes, tie, rows, scratch,
                         matrix, gradient)
        add_penalties(shapes, limits, matrix, gradient)
        small = small + 1 if drop <= tolerance * cost else 0
        cost = trial_cost
        if small >= 2:
            return cost, FIT_CONVERGED, n_steps
        quality = 2 * drop / max(gain, 1e-300) - 1
        damping = max(damping * max(0.2, 1 - quality ** 3), 1e-15)
        growth = 2.0
    return cost, FIT_STOPPED, max_steps


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
