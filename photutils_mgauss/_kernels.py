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
def shape_rows(shapes, rows):
    """Put the rows that other kernels take into rows (K, 6)."""
    for k in range(shapes.shape[0]):
        a, mx, my, log_p, s, log_q = shapes[k]
        rows[k, 0] = exp(a + log_p + log_q) / _TWO_PI
        rows[k, 1] = mx
        rows[k, 2] = my
        rows[k, 3] = exp(2 * log_p)
        rows[k, 4] = s
        rows[k, 5] = exp(2 * log_q)


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
def _move(sources, n_sources, sky, fit_sky, step):
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
def field_normal(stamps, weights, corners, basis, coefficients, sources,
                 anchors, hold, n_sources, sky, fit_sky, used, n_steps,
                 normal, total, gradient, chi2):
    """
    Settle n stars and add the equations of the used ones to total, gradient.

    Each star's own numbers take n_steps Gauss-Newton steps, the PSF given;
    the last one is taken together with the equations of the shapes, so that
    chi2 (n,) and gradient are those after it.

    stamps, weights (n, s, s); corners (n, 2), the pixel (x, y) of each
    stamp's first; basis (n, T); coefficients (T, K, 6); sources, anchors,
    hold (n, M, 3); n_sources (n,); sky (n,) with fit_sky; used (n,). normal
    is scratch (D, D) with D = 3 M + 6 K - 1. total (P T, P T), upper
    triangle, and gradient (P T,) order unknowns by shape, then term, with
    P = 6 K - 3.
    """
    k = coefficients.shape[1]
    shapes = np.empty((k, 6))
    rows = np.empty((k, 6))
    block = np.empty((4, normal.shape[0]))
    step = np.empty(normal.shape[0])
    spread = np.empty(gradient.size)
    for star in range(stamps.shape[0]):
        _shapes_at(basis[star], coefficients, shapes)
        shape_rows(shapes, rows)
        left, bottom = corners[star]
        own = 3 * n_sources[star] + fit_sky
        for i in range(n_steps):
            last = used[star] and i == n_steps - 1
            size = _accumulate(
                stamps[star], weights[star], left, bottom, rows,
                sources[star], n_sources[star], sky[star], fit_sky, last,
                block, normal)
            _hold_neighbours(sources[star], anchors[star], n_sources[star],
                             hold[star], size, normal)
            _eliminate(normal, own, size)
            _back_substitute(normal, own, size, step)
            sky[star] = _move(sources[star], n_sources[star], sky[star],
                              fit_sky, step)
        chi2[star] = normal[size - 1, size - 1]
        if used[star]:
            _spread(normal, own, size, basis[star], spread, total, gradient)


@_jit
def _shapes_at(basis, coefficients, shapes):
    """Evaluate the polynomials, coefficients (T, K, 6), into (K, 6)."""
    shapes[:] = 0.0
    for t in range(basis.size):
        if basis[t] != 0:
            for k in range(shapes.shape[0]):
                for i in range(6):
                    shapes[k, i] += basis[t] * coefficients[t, k, i]


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
def field_model(corners, basis, coefficients, sources, n_sources, sky, out):
    """Put model stamps of n stars, neighbours and sky included, into out."""
    k = coefficients.shape[1]
    shapes = np.empty((k, 6))
    rows = np.empty((k, 6))
    for star in range(out.shape[0]):
        _shapes_at(basis[star], coefficients, shapes)
        shape_rows(shapes, rows)
        left, bottom = corners[star]
        out[star] = sky[star]
        for j in range(n_sources[star]):
            x, y, flux = sources[star, j]
            render(rows, x - left, y - bottom, flux, False, out[star])
