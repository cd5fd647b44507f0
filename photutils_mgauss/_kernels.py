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


# Crowded fields: all stars of an image together. Star i is fitted on a square
# stamp of width[i] pixels, odd, whose first pixel is (left, bottom)[i]; its
# pixels lie in jets (3, total) from offset[i] on, row by row: the PSF of unit
# flux and its derivatives by the star's x and y. Stamps may reach over the
# edges of the image. Parameters are ordered flux, x, y.

@_jit
def _add_jet_row(peak, u0, dy, p, s, q, jets):
    """Add a Gaussian's value and derivatives by the centre to jets (3, n)."""
    n = jets.shape[1]
    start = min(max(int(np.rint(-u0)), 0), n - 1)
    u = u0 + start
    exponent = p * u * u + q * dy * dy
    if exponent > _LOG_NOTHING:
        return
    first = peak * exp(-0.5 * exponent)
    fall = exp(-p)
    rise = exp(-p * (u + 0.5))
    slope_y = q * dy
    g = first
    r = rise
    for i in range(start, n):
        a = p * (u0 + i) * g
        jets[0, i] += g
        jets[1, i] += a
        jets[2, i] += slope_y * g - s * a
        g *= r
        r *= fall
        if abs(g) < _NOTHING:
            break
    if start == 0:
        return
    g = first
    r = fall / rise
    for i in range(start - 1, -1, -1):
        g *= r
        if abs(g) < _NOTHING:
            break
        r *= fall
        a = p * (u0 + i) * g
        jets[0, i] += g
        jets[1, i] += a
        jets[2, i] += slope_y * g - s * a


@_jit
def _add_integrated_jet_row(peak, dx, dy, p, s, q, jets):
    for i in range(jets.shape[1]):
        gx, gy = _gradient(dx + i, dy, p, s, q, True)
        jets[0, i] += peak * _pixel_integral(dx + i, dy, p, s, q)
        jets[1, i] -= peak * gx
        jets[2, i] -= peak * gy


@_jit
def star_stamps(chosen, x, y, left, bottom, width, offset, rows, count,
                integrated, jets):
    """
    Fill the stamps of the chosen stars.

    Star i's PSF are the first count[i] rows of rows[i].
    """
    for i in chosen:
        w = width[i]
        jets[:, offset[i]:offset[i] + w * w] = 0
        for k in range(count[i]):
            a, mx, my, p, s, q = rows[i, k]
            dx = left[i] - x[i] - mx
            for j in range(w):
                dy = bottom[i] + j - y[i] - my
                first = offset[i] + j * w
                row = jets[:, first:first + w]
                if integrated:
                    _add_integrated_jet_row(a, dx, dy, p, s, q, row)
                else:
                    _add_jet_row(a, dx - s * dy, dy, p, s, q, row)


@_jit
def add_stars(chosen, sign, x, y, flux, left, bottom, width, offset, wing,
              jets, rows, count, integrated, image):
    """
    Add sign times the chosen stars to the image.

    A star whose wing (half a width, integer) reaches over its stamp is drawn
    afresh; others are copied from it.
    """
    ny, nx = image.shape
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
        render(rows[i, :count[i]], x[i] - x_low, y[i] - y_low,
               sign * flux[i], integrated, image[y_low:y_high, x_low:x_high])


@_jit
def star_equations(flux, left, bottom, width, offset, jets, weight, residual,
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
            block = blocks[pair]
            block[:] = 0
            x_low = max(0, left[i], left[j])
            x_high = min(nx, left[i] + width[i], left[j] + width[j])
            for row in range(max(0, bottom[i], bottom[j]),
                             min(ny, bottom[i] + width[i],
                                 bottom[j] + width[j])):
                first = offset[i] + (row - bottom[i]) * width[i] - left[i]
                other = offset[j] + (row - bottom[j]) * width[j] - left[j]
                for k in range(x_low, x_high):
                    v = weight[row, k]
                    b0 = v * jets[0, other + k]
                    b1 = v * jets[1, other + k]
                    b2 = v * jets[2, other + k]
                    for m in range(3):
                        a = jets[m, first + k]
                        block[m, 0] += a * b0
                        block[m, 1] += a * b1
                        block[m, 2] += a * b2
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
def _apply_joint(v, mesh_v, matrix, indptr, neighbour, blocks, node, share,
                 reach, mesh, out, mesh_out):
    """Multiply by the joint normal matrix of stars and background."""
    mesh_out[:] = mesh @ mesh_v
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
            v0, v1, v2 = v[j, 0], v[j, 1], v[j, 2]
            o0 += b[0, 0] * v0 + b[0, 1] * v1 + b[0, 2] * v2
            o1 += b[1, 0] * v0 + b[1, 1] * v1 + b[1, 2] * v2
            o2 += b[2, 0] * v0 + b[2, 1] * v1 + b[2, 2] * v2
        out[i, 0] = o0
        out[i, 1] = o1
        out[i, 2] = o2


@_jit
def _precondition(inverse, mesh, r, mesh_r, z, mesh_z):
    for i in range(r.shape[0]):
        for m in range(3):
            z[i, m] = (inverse[i, m, 0] * r[i, 0] + inverse[i, m, 1] * r[i, 1]
                       + inverse[i, m, 2] * r[i, 2])
    for m in range(mesh_r.size):
        mesh_z[m] = mesh_r[m] / mesh[m, m]


@_jit
def solve_joint(matrix, gradient, indptr, neighbour, blocks, node, share,
                reach, mesh, mesh_gradient, tolerance, max_steps, step,
                mesh_step):
    """
    Solve the joint normal equations by preconditioned conjugate gradients.

    Stars couple to their neighbours (`pair_blocks`) and to the four nodes
    node (n, 4) of the background around them, with the bilinear shares
    share (n, 4); mesh (m, m) is the background's own matrix. The preconditioner
    inverts each star's own block. Returns the number of steps.
    """
    n = gradient.shape[0]
    inverse = np.empty((n, 3, 3))
    for i in range(n):
        _invert_3x3(matrix[i], inverse[i])
    step[:] = 0
    mesh_step[:] = 0
    r = gradient.copy()
    for i in range(n):
        if inverse[i, 0, 0] == 0:
            r[i] = 0
    mesh_r = mesh_gradient.copy()
    z = np.empty_like(r)
    mesh_z = np.empty_like(mesh_r)
    _precondition(inverse, mesh, r, mesh_r, z, mesh_z)
    v = z.copy()
    mesh_v = mesh_z.copy()
    a = np.empty_like(r)
    mesh_a = np.empty_like(mesh_r)
    rz = (r * z).sum() + (mesh_r * mesh_z).sum()
    goal = tolerance * tolerance * rz
    for count in range(max_steps):
        if not rz > goal:
            return count
        _apply_joint(v, mesh_v, matrix, indptr, neighbour, blocks, node,
                     share, reach, mesh, a, mesh_a)
        alpha = rz / ((v * a).sum() + (mesh_v * mesh_a).sum())
        step += alpha * v
        mesh_step += alpha * mesh_v
        r -= alpha * a
        mesh_r -= alpha * mesh_a
        for i in range(n):
            if inverse[i, 0, 0] == 0:
                r[i] = 0
        _precondition(inverse, mesh, r, mesh_r, z, mesh_z)
        before = rz
        rz = (r * z).sum() + (mesh_r * mesh_z).sum()
        v = z + rz / before * v
        mesh_v = mesh_z + rz / before * mesh_v
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
def background_equations(residual, weight, x_grid, y_grid, limit, mesh,
                         gradient):
    """
    Put the normal equations of a bilinear background into mesh, gradient.

    Its nodes are ordered by y, then x. Pixels further than limit standard
    errors from the model take no part.
    """
    index = np.empty(4, np.int64)
    share = np.empty((3, 4))
    mesh[:] = 0
    gradient[:] = 0
    for y in range(residual.shape[0]):
        for x in range(residual.shape[1]):
            w = weight[y, x]
            r = residual[y, x]
            if w * r * r > limit * limit or w == 0:
                continue
            blend_weights(float(x), float(y), x_grid, y_grid, index, share)
            for a in range(4):
                gradient[index[a]] += w * r * share[0, a]
                for b in range(4):
                    mesh[index[a], index[b]] += (w * share[0, a]
                                                 * share[0, b])


@_jit
def add_background(level, x_grid, y_grid, sign, image):
    """Add sign times the bilinear background of the nodes to the image."""
    index = np.empty(4, np.int64)
    share = np.empty((3, 4))
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            blend_weights(float(x), float(y), x_grid, y_grid, index, share)
            for a in range(4):
                image[y, x] += sign * share[0, a] * level[index[a]]


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
    (cells along y, along x, 2h + 1, 2h + 1), each serving cell x cell pixels.
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
                p = jets[0, offset[i] + j * w + k]
                power += p * p
                if not (0 <= row < ny and 0 <= column < nx):
                    continue
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
