"""All stars of a crowded image and its background, fitted together."""
from math import ceil, exp, floor, log, sqrt

import numpy as np

from photutils_mgauss.kernels.gaussian import fast_exp
from photutils_mgauss.kernels.image import ERRORS, add_sampled, add_star
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    _cholesky,
    _factor_inverse_columns,
    _invert_3x3,
)
from photutils_mgauss.kernels.tile import LANES, add_gaussian

# Crowded fields: all stars of an image together. Star i is fitted on a square
# stamp of width[i] pixels, odd, whose first pixel is (left, bottom)[i]; its
# pixels lie in jets (3, total) from offset[i] on, row by row: the PSF of unit
# flux and its derivatives by the star's x and y. Stamps may reach over the
# edges of the image. Parameters are ordered flux, x, y.

@kernel
def star_stamps(chosen, x, y, left, bottom, width, offset, rows, strides,
                count, integrated, jets):
    """
    Fill the stamps of the chosen stars.

    Star i's PSF are the first count[i] rows of rows[i]; paces is as of
    `paces`.
    """
    widest = 0
    for i in chosen:
        widest = max(widest, width[i])
    walk = np.empty(4 * LANES)
    tile = np.empty(3 * LANES * widest)
    for i in chosen:
        w = width[i]
        for first in range(0, w, LANES):
            height = min(LANES, w - first)
            walk[:] = 0.0
            tile[:3 * LANES * w] = 0.0
            for k in range(count[i]):
                a, mx, my, p, s, q = rows[i, k]
                add_gaussian(a, left[i] - x[i] - mx,
                             bottom[i] + first - y[i] - my, p, s, q,
                             strides[i, k], 0.0, 0.0, integrated, height, w,
                             walk, tile)
            for j in range(height):
                to = offset[i] + (first + j) * w
                for k in range(w):
                    at = 3 * LANES * k + j
                    jets[0, to + k] = tile[at]
                    jets[1, to + k] = tile[at + LANES]
                    jets[2, to + k] = tile[at + 2 * LANES]


@inner
def _walk_rows(start, end, way, fall, first, g, r, image):
    """Add g (n,) to rows start, start + way, ... end of image, r its fall."""
    for j in range(start, end + way, way):
        row = image[j]
        for i in range(g.size):
            row[first + i] += g[i]
            g[i] *= r[i]
            r[i] *= fall


@inner
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
        add_sampled(peak, cx, cy, p, s, q, reach, image)
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
        g[i] = peak * fast_exp(-0.5 * (p * u * u + q * dy * dy))
        slope = q * dy - p * s * u
        steep = fast_exp(-abs(slope))
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


@kernel
def add_wings(rows, flux, cx, cy, integrated, faintest, lanes, scratch,
              image):
    """Add a star, each Gaussian out to where it falls below faintest."""
    if integrated:
        add_star(rows, flux, cx, cy, True, faintest, scratch, image)
        return
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        peak = flux * a
        ratio = abs(peak) / faintest
        if ratio > 1:
            _add_lanes(peak, cx + mx, cy + my, p, s, q, 2 * log(ratio), lanes,
                       image)


@kernel
def add_stars(chosen, sign, x, y, flux, left, bottom, width, offset, wing,
              jets, rows, count, integrated, faintest, image):
    """
    Add sign times the chosen stars to the image.

    A star whose wing (half a width, integer) reaches over its stamp is drawn
    afresh, each Gaussian out to where it falls below faintest; others are
    copied from it.
    """
    ny, nx = image.shape
    scratch = np.empty((3, ERRORS.size))
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
        add_wings(rows[i, :count[i]], sign * flux[i], x[i] - x_low,
                  y[i] - y_low, integrated, faintest, lanes, scratch,
                  image[y_low:y_high, x_low:x_high])


@kernel
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


@kernel
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


@kernel
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


@kernel
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


@kernel
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


@inner
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


@inner
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


@inner
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


@inner
def _add_scaled(x, scale, y):
    """Add scale * y to x, both flat."""
    for i in range(x.size):
        x[i] += scale * y[i]


@inner
def _extend(x, scale, y):
    """Put y + scale * x into x, both flat."""
    for i in range(x.size):
        x[i] = y[i] + scale * x[i]


@kernel
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


@kernel
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
