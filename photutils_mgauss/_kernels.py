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
from math import ceil, erf, exp, factorial, floor, log, sqrt

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


# Many stars on one image. A Gaussian is drawn where it exceeds ``faintest``,
# which the caller chooses so low that nobody sees the edge, and anyway down
# to this fraction of its peak. Nothing is fitted with these functions, so
# the step at the edge does no harm.
_DEPTH = 1e-3


def _quadrature_tables(tolerance=1e-6, most=8):
    """
    Return nodes and weights (most + 1, most) and the precisions they serve.

    The error of n points on a unit interval is bounded by
    (n!)^4 (2n - 1)!! P^n / ((2n + 1) (2n)!^3) for a Gaussian of unit peak and
    precision P; row n of the tables serves P up to ``limits[n]``.
    """
    nodes = np.zeros((most + 1, most))
    weights = np.zeros((most + 1, most))
    limits = np.zeros(most + 1)
    for n in range(1, most + 1):
        places, shares = np.polynomial.legendre.leggauss(n)
        nodes[n, :n], weights[n, :n] = places / 2, shares / 2
        twice = float(factorial(2 * n))
        odd = twice / (2**n * factorial(n))
        bound = factorial(n)**4 * odd / ((2 * n + 1) * twice**3)
        limits[n] = (tolerance / bound) ** (1 / n)
    return nodes, weights, limits


_POINTS, _SHARES, _LIMITS = _quadrature_tables()


@_jit
def _quadrature_order(precision):
    """Return the number of points that suffice, or 0 if none does."""
    for n in range(1, _LIMITS.size):
        if precision <= _LIMITS[n]:
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
def _add_integrated(peak, cx, cy, p, s, q, reach, scratch, out):
    """Add a Gaussian, integrated over each pixel, to out (ny, nx)."""
    n_x = _quadrature_order(p)
    n_y = _quadrature_order(q + s * s * p)
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
def render_image(x, y, flux, nodes, x_grid, y_grid, integrated, faintest,
                 bottom, out):
    """
    Add stars (n,) in the order given to out, detector rows bottom and up.

    The order of the stars alone decides about rounding: a band of rows has
    the pixels it would have in the whole image.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    scratch = np.empty((3, _LIMITS.size))
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            share = weights[0, corner] * flux[i]
            if share == 0:
                continue
            for k in range(nodes.shape[1]):
                a, mx, my, p, s, q = nodes[index[corner], k]
                if a == 0:
                    continue
                cx, cy = x[i] + mx, y[i] + my - bottom
                reach = 2 * log(max(abs(share * a) / faintest, 1 / _DEPTH))
                if integrated:
                    _add_integrated(share * a, cx, cy, p, s, q, reach,
                                    scratch, out)
                else:
                    _add_sampled(share * a, cx, cy, p, s, q, reach, out)
