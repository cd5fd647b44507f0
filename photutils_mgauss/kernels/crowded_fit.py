"""All stars of a crowded image and its background, fitted together."""
from math import sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    _cholesky,
    _factor_inverse_columns,
    _invert_3x3,
)

# Star i lies on a stamp (`crowded_stamps`); its parameters are ordered flux,
# x, y.

# The covariance of a star is that with so many stars free, itself included.
_MOST_FREE = 13


class Cells(NamedTuple):
    """
    Points sorted into square cells, in rows of so many columns.

    Nothing is in the outermost cells; cell (n,) is where each point is, order
    lists the points of cell c from start[c] to start[c + 1].
    """

    cell: np.ndarray
    columns: int
    start: np.ndarray
    order: np.ndarray


class Pairs(NamedTuple):
    """
    Neighbours as rows of a sparse matrix.

    Star i's are neighbour[indptr[i]:indptr[i + 1]]; twin is where the same
    pair stands the other way round.
    """

    indptr: np.ndarray
    neighbour: np.ndarray
    twin: np.ndarray


class StarEquations(NamedTuple):
    """
    Normal equations of the stars.

    Each star's own matrix (n, 3, 3) and gradient (n, 3), the sums of weighted
    derivatives that couple it to the background, coupling (n, 3), and the
    matrices of pairs, blocks (n_pairs, 3, 3).
    """

    matrix: np.ndarray
    gradient: np.ndarray
    coupling: np.ndarray
    blocks: np.ndarray


class MeshEquations(NamedTuple):
    """
    Normal equations of the nodes of a background.

    The matrix has a diagonal (m,), and -tie between nodes that are
    neighbours, in rows of so many columns. Stars couple to four nodes each,
    node (n, 4), with the shares share (n, 4).
    """

    diagonal: np.ndarray
    gradient: np.ndarray
    tie: float
    columns: int
    node: np.ndarray
    share: np.ndarray


@kernel
def mesh_sums(weight, residual, background, rows, columns, n_columns, clip,
              out):
    """
    Put sums over the pixels of each node of a background into out (m, 3).

    In order: the weight; the weight of pixels within clip standard errors of
    the model; and that times what of those pixels is no star's. Pixels
    belong to the nodes of rows (ny,) and columns (nx,).
    """
    for node in range(out.shape[0]):
        out[node, 0] = out[node, 1] = out[node, 2] = 0.0
    for j in range(weight.shape[0]):
        first = rows[j] * n_columns
        for i in range(weight.shape[1]):
            w, r = weight[j, i], residual[j, i]
            node = first + columns[i]
            out[node, 0] += w
            if w * r * r <= clip * clip:
                out[node, 1] += w
                out[node, 2] += w * (r + background[j, i])


@inner
def _next_row(i, row, cells):
    """Return where the points around i begin and end, in a row of cells."""
    middle = cells.cell[i] + row * cells.columns
    return cells.start[middle - 1], cells.start[middle + 2]


@kernel
def count_near(x, y, reach, cells, count):
    """
    Put the number of other points within reach of each into count (n,).

    Cells are as wide as reach.
    """
    for i in range(x.size):
        count[i] = 0
        for row in range(-1, 2):
            first, last = _next_row(i, row, cells)
            for at in range(first, last):
                j = cells.order[at]
                if j != i and sqrt((x[j] - x[i])**2
                                   + (y[j] - y[i])**2) <= reach:
                    count[i] += 1


@kernel
def list_near(x, y, reach, cells, pairs, distance):
    """
    List the points within reach of each, nearest first.

    Fills neighbour and twin of the pairs, and distance (n_pairs,). Cells are
    as wide as reach.
    """
    indptr, neighbour, twin = pairs
    for i in range(x.size):
        end = indptr[i]
        for row in range(-1, 2):
            first, last = _next_row(i, row, cells)
            for at in range(first, last):
                j = cells.order[at]
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
            twin[pair] = find_pair(neighbour[pair], i, indptr, neighbour)


@inner
def find_pair(i, j, indptr, neighbour):
    """Return where star j stands among the neighbours of i, -1 for nowhere."""
    for pair in range(indptr[i], indptr[i + 1]):
        if neighbour[pair] == j:
            return pair
    return -1


@kernel
def own_equations(flux, stamps, weight, residual, equations):
    """Fill matrix, gradient and coupling of each star."""
    left, bottom, width, offset, derivatives = stamps
    matrix, gradient, coupling, _ = equations
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
                d0 = derivatives[0, first + k]
                d1 = derivatives[1, first + k]
                d2 = derivatives[2, first + k]
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
        coupling[i, 0] = s0
        coupling[i, 1] = f * s1
        coupling[i, 2] = f * s2


@kernel
def pair_blocks(flux, stamps, pairs, weight, blocks):
    """Put the normal matrices of pairs into blocks (n_pairs, 3, 3)."""
    indptr, neighbour, twin = pairs
    for i in range(flux.size):
        for pair in range(indptr[i], indptr[i + 1]):
            j = neighbour[pair]
            if j < i:
                continue
            block = blocks[pair]
            _pair_block(i, j, stamps, weight, block)
            for m in range(3):
                for n in range(3):
                    if m > 0:
                        block[m, n] *= flux[i]
                    if n > 0:
                        block[m, n] *= flux[j]
                    blocks[twin[pair], n, m] = block[m, n]


@inner
def _pair_block(i, j, stamps, weight, block):
    """Put the products of the derivatives of two stars into block (3, 3)."""
    left, bottom, width, offset, derivatives = stamps
    ny, nx = weight.shape
    b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = 0.0
    x_low = max(0, left[i], left[j])
    x_high = min(nx, left[i] + width[i], left[j] + width[j])
    for row in range(max(0, bottom[i], bottom[j]),
                     min(ny, bottom[i] + width[i], bottom[j] + width[j])):
        first = offset[i] + (row - bottom[i]) * width[i] - left[i]
        other = offset[j] + (row - bottom[j]) * width[j] - left[j]
        for k in range(x_low, x_high):
            v = weight[row, k]
            e0 = v * derivatives[0, other + k]
            e1 = v * derivatives[1, other + k]
            e2 = v * derivatives[2, other + k]
            d0 = derivatives[0, first + k]
            d1 = derivatives[1, first + k]
            d2 = derivatives[2, first + k]
            b00 += d0 * e0
            b01 += d0 * e1
            b02 += d0 * e2
            b10 += d1 * e0
            b11 += d1 * e1
            b12 += d1 * e2
            b20 += d2 * e0
            b21 += d2 * e1
            b22 += d2 * e2
    block[0, 0], block[0, 1], block[0, 2] = b00, b01, b02
    block[1, 0], block[1, 1], block[1, 2] = b10, b11, b12
    block[2, 0], block[2, 1], block[2, 2] = b20, b21, b22


@inner
def _apply_mesh(v, mesh, out):
    """Multiply v (m,) by the matrix of a background."""
    diagonal, tie, columns = mesh.diagonal, mesh.tie, mesh.columns
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
        out[m] = diagonal[m] * v[m] - tie * near


@inner
def _apply_joint(v, mesh_v, stars, pairs, mesh, out, mesh_out):
    """
    Multiply by the joint normal matrix of stars and background.

    Returns the product of v and the outcome.
    """
    _apply_mesh(mesh_v, mesh, mesh_out)
    matrix, _, coupling, blocks = stars
    indptr, neighbour, _ = pairs
    node, share = mesh.node, mesh.share
    product = 0.0
    for i in range(v.shape[0]):
        level = 0.0
        for c in range(4):
            level += share[i, c] * mesh_v[node[i, c]]
        o0 = coupling[i, 0] * level
        o1 = coupling[i, 1] * level
        o2 = coupling[i, 2] * level
        a = matrix[i]
        v0, v1, v2 = v[i, 0], v[i, 1], v[i, 2]
        o0 += a[0, 0] * v0 + a[0, 1] * v1 + a[0, 2] * v2
        o1 += a[1, 0] * v0 + a[1, 1] * v1 + a[1, 2] * v2
        o2 += a[2, 0] * v0 + a[2, 1] * v1 + a[2, 2] * v2
        light = (coupling[i, 0] * v0 + coupling[i, 1] * v1
                 + coupling[i, 2] * v2)
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


@inner(allocates=True)
def _inverses(matrix):
    """Return the inverse of each star's own matrix, 0 where singular."""
    inverse = np.empty(matrix.shape)
    for i in range(matrix.shape[0]):
        _invert_3x3(matrix[i], inverse[i])
    return inverse


@kernel(allocates=True)
def solve_joint(stars, pairs, mesh, tolerance, max_steps, step, mesh_step):
    """
    Solve the joint normal equations by preconditioned conjugate gradients.

    Each star's own block is the preconditioner; stars whose block is singular
    do not move. step (n, 3) and mesh_step (m,) begin at zero. Returns the
    number of steps.
    """
    inverse = _inverses(stars.matrix)
    r, mesh_r = stars.gradient.copy(), mesh.gradient.copy()
    z, mesh_z = np.empty_like(r), np.empty_like(mesh_r)
    # A preconditioner of zero keeps singular stars out of z, and so of v.
    rz = _precondition(inverse, mesh.diagonal, r, mesh_r, z, mesh_z)
    v, mesh_v = z.copy(), mesh_z.copy()
    a, mesh_a = np.empty_like(r), np.empty_like(mesh_r)
    goal = tolerance * tolerance * rz
    for count in range(max_steps):
        if not rz > goal:
            return count
        alpha = rz / _apply_joint(v, mesh_v, stars, pairs, mesh, a, mesh_a)
        _add_scaled(step.reshape(-1), alpha, v.reshape(-1))
        _add_scaled(mesh_step, alpha, mesh_v)
        _add_scaled(r.reshape(-1), -alpha, a.reshape(-1))
        _add_scaled(mesh_r, -alpha, mesh_a)
        before = rz
        rz = _precondition(inverse, mesh.diagonal, r, mesh_r, z, mesh_z)
        _extend(v.reshape(-1), rz / before, z.reshape(-1))
        _extend(mesh_v, rz / before, mesh_z)
    return max_steps


@inner
def put_block(blocks, which, row, column, a):
    """Put one of blocks (n, 3, 3) into a matrix of blocks."""
    for r in range(3):
        for c in range(3):
            a[3 * row + r, 3 * column + c] = blocks[which, r, c]


@inner
def _members(i, indptr, neighbour, members):
    """Put a star and its first neighbours into members; return how many."""
    members[0] = i
    count = 1
    for pair in range(indptr[i], indptr[i + 1]):
        if count == members.size:
            break
        members[count] = neighbour[pair]
        count += 1
    return count


@inner
def _joint_matrix(members, count, matrix, blocks, indptr, neighbour, where,
                  a):
    """
    Put the normal matrix of some stars into a (3 count, 3 count).

    where (n,) is -1 before and after.
    """
    for m in range(count):
        where[members[m]] = m
    for r in range(3 * count):
        for c in range(3 * count):
            a[r, c] = 0.0
    for m in range(count):
        star = members[m]
        put_block(matrix, star, m, m, a)
        for pair in range(indptr[star], indptr[star + 1]):
            other = where[neighbour[pair]]
            if other >= 0:
                put_block(blocks, pair, m, other, a)
    for m in range(count):
        where[members[m]] = -1


@inner
def _scale_matrix(a, size, scale):
    """Make the diagonal of a matrix 1; scale takes by what rows went."""
    for m in range(size):
        scale[m] = 1 / sqrt(a[m, m]) if a[m, m] > 0 else 0.0
    for r in range(size):
        for c in range(size):
            a[r, c] *= scale[r] * scale[c]
        if scale[r] == 0:
            a[r, r] = 1.0


@kernel(allocates=True)
def joint_covariances(stars, pairs, partner, covariance, correlation):
    """
    Put the covariance of each star, neighbours free, into covariance.

    covariance is (n, 3, 3); correlation (n,) takes the correlation of the
    flux with that of the star partner[i], 0 where it is none of the
    neighbours. A star's normal matrix is that of itself and up to 12 of its
    neighbours, those that come first. NaN where it is singular.
    """
    matrix, _, _, blocks = stars
    indptr, neighbour, _ = pairs
    n = matrix.shape[0]
    members = np.empty(_MOST_FREE, np.int64)
    where = np.full(n, -1, np.int64)
    a = np.empty((3 * _MOST_FREE, 3 * _MOST_FREE))
    scale = np.empty(3 * _MOST_FREE)
    columns = np.empty((3 * _MOST_FREE, 3))
    alone = np.empty((3 * _MOST_FREE, 1))
    for i in range(n):
        count = _members(i, indptr, neighbour, members)
        size = 3 * count
        _joint_matrix(members, count, matrix, blocks, indptr, neighbour, where,
                      a)
        _scale_matrix(a, size, scale)
        correlation[i] = 0.0
        solved = scale[0] > 0 and _cholesky(a, size)
        if solved:
            _factor_inverse_columns(a, size, 0, 3, columns)
        for r in range(3):
            for c in range(3):
                covariance[i, r, c] = (columns[r, c] * scale[r] * scale[c]
                                       if solved else np.nan)
        if not solved:
            continue
        for m in range(1, count):
            if members[m] == partner[i]:
                _factor_inverse_columns(a, size, 3 * m, 1, alone)
                correlation[i] = columns[3 * m, 0] / sqrt(
                    columns[0, 0] * alone[3 * m, 0])
