"""All stars of a crowded image and its background, fitted together."""
from math import sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import (
    cholesky,
    copy_vector,
    invert_3x3,
    solve_factored,
)

# Star i lies on a stamp (`crowded_stamps`); its parameters are ordered flux,
# x, y.

# The covariance of a star is that with so many stars free, itself included.
_MOST_FREE = 13


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


class CovarianceScratch(NamedTuple):
    """A star's neighbours, their places and matrix, and its inverse."""

    members: np.ndarray
    where: np.ndarray
    matrix: np.ndarray
    scale: np.ndarray
    columns: np.ndarray

    @classmethod
    def empty(cls, n):
        """Return the memory for n stars."""
        size = 3 * _MOST_FREE
        return cls(np.empty(_MOST_FREE, np.int64), np.full(n, -1),
                   np.empty((size, size)), np.empty(size),
                   np.empty((4, size)))


@kernel
def mesh_sums(weight, residual, background, rows, columns, n_columns, clip,
              out):
    """
    Put sums over the pixels of each node of a background into out (m, 3).

    In order: the weight; the weight of pixels not more than clip standard
    errors above the model; and that times what of those pixels is no star's,
    where pixels count as not more than clip standard errors below the model:
    stars are above a sky, nothing is below it. Pixels belong to the nodes of
    rows (ny,) and columns (nx,).
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
            elif r < 0:
                out[node, 1] += w
                out[node, 2] += w * background[j, i] - clip * sqrt(w)


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


# The unknowns of the joint equations are one flat vector: three numbers for
# each star, then the level of each node of the background.

@inner
def _apply_mesh(v, first, mesh, out):
    """Multiply v[first:] by the matrix of a background."""
    diagonal, tie, columns = mesh.diagonal, mesh.tie, mesh.columns
    for m in range(diagonal.size):
        at = first + m
        column = m % columns
        near = 0.0
        if column > 0:
            near += v[at - 1]
        if column < columns - 1:
            near += v[at + 1]
        if m >= columns:
            near += v[at - columns]
        if m < diagonal.size - columns:
            near += v[at + columns]
        out[at] = diagonal[m] * v[at] - tie * near


@inner
def apply_joint(v, stars, pairs, mesh, out):
    """
    Multiply by the joint normal matrix of stars and background.

    Returns the product of v and the outcome.
    """
    matrix, _, coupling, blocks = stars
    indptr, neighbour, _ = pairs
    node, share = mesh.node, mesh.share
    first = 3 * matrix.shape[0]
    _apply_mesh(v, first, mesh, out)
    product = 0.0
    for i in range(matrix.shape[0]):
        level = 0.0
        for c in range(4):
            level += share[i, c] * v[first + node[i, c]]
        o0 = coupling[i, 0] * level
        o1 = coupling[i, 1] * level
        o2 = coupling[i, 2] * level
        a = matrix[i]
        v0, v1, v2 = v[3 * i], v[3 * i + 1], v[3 * i + 2]
        o0 += a[0, 0] * v0 + a[0, 1] * v1 + a[0, 2] * v2
        o1 += a[1, 0] * v0 + a[1, 1] * v1 + a[1, 2] * v2
        o2 += a[2, 0] * v0 + a[2, 1] * v1 + a[2, 2] * v2
        light = (coupling[i, 0] * v0 + coupling[i, 1] * v1
                 + coupling[i, 2] * v2)
        for c in range(4):
            out[first + node[i, c]] += share[i, c] * light
        for pair in range(indptr[i], indptr[i + 1]):
            b = blocks[pair]
            j = 3 * neighbour[pair]
            w0, w1, w2 = v[j], v[j + 1], v[j + 2]
            o0 += b[0, 0] * w0 + b[0, 1] * w1 + b[0, 2] * w2
            o1 += b[1, 0] * w0 + b[1, 1] * w1 + b[1, 2] * w2
            o2 += b[2, 0] * w0 + b[2, 1] * w1 + b[2, 2] * w2
        out[3 * i], out[3 * i + 1], out[3 * i + 2] = o0, o1, o2
        product += v0 * o0 + v1 * o1 + v2 * o2
    for m in range(first, v.size):
        product += v[m] * out[m]
    return product


@inner
def _precondition(inverse, diagonal, r, z):
    """Put r times the inverse blocks into z; return the product of both."""
    product = 0.0
    for i in range(inverse.shape[0]):
        c = inverse[i]
        r0, r1, r2 = r[3 * i], r[3 * i + 1], r[3 * i + 2]
        z0 = c[0, 0] * r0 + c[0, 1] * r1 + c[0, 2] * r2
        z1 = c[1, 0] * r0 + c[1, 1] * r1 + c[1, 2] * r2
        z2 = c[2, 0] * r0 + c[2, 1] * r1 + c[2, 2] * r2
        z[3 * i], z[3 * i + 1], z[3 * i + 2] = z0, z1, z2
        product += r0 * z0 + r1 * z1 + r2 * z2
    first = 3 * inverse.shape[0]
    for m in range(diagonal.size):
        z[first + m] = r[first + m] / diagonal[m]
        product += r[first + m] * z[first + m]
    return product


@inner
def _begin(stars, mesh, inverse, r):
    """Put the right side into r, and the inverse of each star's block."""
    n = inverse.shape[0]
    for i in range(n):
        invert_3x3(stars.matrix[i], inverse[i])
        for c in range(3):
            r[3 * i + c] = stars.gradient[i, c]
    for m in range(mesh.gradient.size):
        r[3 * n + m] = mesh.gradient[m]


@kernel
def solve_joint(stars, pairs, mesh, tolerance, max_steps, inverse, scratch,
                step):
    """
    Solve the joint normal equations by preconditioned conjugate gradients.

    Each star's own block is the preconditioner; stars whose block is singular
    do not move. step (3 n + m,) begins at zero; inverse (n, 3, 3) and
    scratch (4, 3 n + m) are scratch. Returns the number of steps.
    """
    r, z, v, a = scratch[0], scratch[1], scratch[2], scratch[3]
    _begin(stars, mesh, inverse, r)
    # A preconditioner of zero keeps singular stars out of z, and so of v.
    rz = _precondition(inverse, mesh.diagonal, r, z)
    copy_vector(z, z.size, v)
    goal = tolerance * tolerance * rz
    for count in range(max_steps):
        if not rz > goal:
            return count
        alpha = rz / apply_joint(v, stars, pairs, mesh, a)
        for i in range(step.size):
            step[i] += alpha * v[i]
            r[i] -= alpha * a[i]
        before = rz
        rz = _precondition(inverse, mesh.diagonal, r, z)
        for i in range(step.size):
            v[i] = z[i] + rz / before * v[i]
    return max_steps


@inner
def put_block(blocks, which, row, column, a):
    """Put one of blocks (n, 3, 3) into a matrix of blocks."""
    for r in range(3):
        for c in range(3):
            a[3 * row + r, 3 * column + c] = blocks[which, r, c]


@inner
def members_of(i, indptr, neighbour, members):
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
def joint_matrix(members, count, matrix, blocks, indptr, neighbour, where,
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
def scale_matrix(a, size, scale):
    """Make the diagonal of a matrix 1; scale takes by what rows went."""
    for m in range(size):
        scale[m] = 1 / sqrt(a[m, m]) if a[m, m] > 0 else 0.0
    for r in range(size):
        for c in range(size):
            a[r, c] *= scale[r] * scale[c]
        if scale[r] == 0:
            a[r, r] = 1.0


@kernel
def joint_covariances(stars, pairs, partner, scratch, covariance,
                      correlation):
    """
    Put the covariance of each star, neighbours free, into covariance.

    covariance is (n, 3, 3); correlation (n,) takes the correlation of the
    flux with that of the star partner[i], 0 where it is none of the
    neighbours. A star's normal matrix is that of itself and up to 12 of its
    neighbours, those that come first. NaN where it is singular. scratch is a
    CovarianceScratch.
    """
    matrix, _, _, blocks = stars
    indptr, neighbour, _ = pairs
    members, where, a, scale, columns = scratch
    for i in range(matrix.shape[0]):
        count = members_of(i, indptr, neighbour, members)
        size = 3 * count
        joint_matrix(members, count, matrix, blocks, indptr, neighbour, where,
                      a)
        scale_matrix(a, size, scale)
        correlation[i] = 0.0
        solved = scale[0] > 0 and cholesky(a, size, 1e-12)
        for r in range(3):
            if solved:
                _inverse_column(a, size, r, columns[r])
            for c in range(3):
                covariance[i, r, c] = (columns[r, c] * scale[r] * scale[c]
                                       if solved else np.nan)
        if not solved:
            continue
        for m in range(1, count):
            if members[m] == partner[i]:
                _inverse_column(a, size, 3 * m, columns[3])
                correlation[i] = columns[0, 3 * m] / sqrt(
                    columns[0, 0] * columns[3, 3 * m])


@inner
def _inverse_column(factor, n, which, out):
    """Put a column of inverse(factor factor^T) into out[:n]."""
    for i in range(n):
        out[i] = 1.0 if i == which else 0.0
    solve_factored(factor, n, out)
