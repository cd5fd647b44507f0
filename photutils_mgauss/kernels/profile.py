"""
Systems of equations whose matrix has its numbers near the diagonal.

In row a of the lower triangle nothing stands before column first[a]. The
Cholesky factor has zeros in the same places, and neither is looked at there:
the work grows with the square of the rows' length instead of that of the
matrix. Rows come in threes, one three a star, that begin in one column, at
the start of a three; a last one may be alone. What stop (1,) says is read in
every three, so that another thread can end a long computation.
"""
from math import sqrt

from photutils_mgauss.kernels.jit import inner, sums

# Matrices scaled to a diagonal of one whose Cholesky factor has a smaller
# square than this on its diagonal are taken for singular.
_SINGULAR = 1e-14


@sums
def _dot(x, y, first, end):
    """Return the sum of x y from first up to end."""
    total = 0.0
    for i in range(first, end):
        total += x[i] * y[i]
    return total


@sums
def _dots(x, i, y, j, first, end, out):
    """
    Put nine sums into out (3, 3), of three rows of x and three of y.

    The rows begin at i and j, the sums run from first up to end. Nine at a
    time do not wait for each other.
    """
    s00 = 0.0
    s01 = 0.0
    s02 = 0.0
    s10 = 0.0
    s11 = 0.0
    s12 = 0.0
    s20 = 0.0
    s21 = 0.0
    s22 = 0.0
    for k in range(first, end):
        x0, x1, x2 = x[i, k], x[i + 1, k], x[i + 2, k]
        y0, y1, y2 = y[j, k], y[j + 1, k], y[j + 2, k]
        s00 += x0 * y0
        s01 += x0 * y1
        s02 += x0 * y2
        s10 += x1 * y0
        s11 += x1 * y1
        s12 += x1 * y2
        s20 += x2 * y0
        s21 += x2 * y1
        s22 += x2 * y2
    out[0, 0], out[0, 1], out[0, 2] = s00, s01, s02
    out[1, 0], out[1, 1], out[1, 2] = s10, s11, s12
    out[2, 0], out[2, 1], out[2, 2] = s20, s21, s22


@inner
def _scale(matrix, frozen, size, steepest, scale):
    """Put the square roots of the diagonal into scale, 1 for frozen ones."""
    for a in range(size):
        d = matrix[a, a]
        steepest[a] = max(steepest[a], d)
        if frozen[a] or not d > 0:
            frozen[a] = True
            scale[a] = 1.0
        else:
            scale[a] = sqrt(d)


@inner
def _entry(a, b, sums, matrix, frozen, damping, steepest, scale, factor):
    """Put an entry into the factor, less sums and those of its block."""
    if frozen[a] or frozen[b]:
        value = 1.0 if a == b else 0.0
    else:
        value = matrix[a, b] / (scale[a] * scale[b])
        if a == b and damping > 0:
            value += damping * steepest[a] / matrix[a, a]
    value -= sums
    for c in range(b - b % 3, b):
        value -= factor[a, c] * factor[b, c]
    if a > b:
        factor[a, b] = value / factor[b, b]
        return True
    factor[a, a] = sqrt(value)
    return value > _SINGULAR


@inner
def factorize(matrix, first, frozen, damping, size, steepest, scale, factor,
              block, stop):
    """
    Put the Cholesky factor of the damped, scaled matrix into factor.

    scale (size,) takes the square roots of the diagonal; rows of frozen
    parameters become those of the unit matrix. Damping is in units of
    steepest, the largest diagonal so far: as a star gets faint its position
    must not become free to run away. Returns whether the matrix is positive
    definite to working precision. block (3, 3) is scratch.
    """
    _scale(matrix, frozen, size, steepest, scale)
    whole = size - size % 3
    for a in range(0, whole, 3):
        if stop[0]:
            return False
        for b in range(first[a], a + 3, 3):
            _dots(factor, a, factor, b, max(first[a], first[b]), b, block)
            for i in range(3):
                for j in range(min(3, a + i - b + 1)):
                    if not _entry(a + i, b + j, block[i, j], matrix, frozen,
                                  damping, steepest, scale, factor):
                        return False
    for a in range(whole, size):
        for b in range(first[a], a + 1):
            before = _dot(factor[a], factor[b], max(first[a], first[b]),
                          b - b % 3)
            if not _entry(a, b, before, matrix, frozen, damping, steepest,
                          scale, factor):
                return False
    return True


@inner
def solve_factored(factor, first, scale, size, vector):
    """Solve for the scaled vector in place, given the Cholesky factor."""
    for a in range(size):
        value = vector[a] / scale[a] - _dot(factor[a], vector, first[a], a)
        vector[a] = value / factor[a, a]
    for a in range(size - 1, -1, -1):
        value = vector[a] / factor[a, a]
        for b in range(first[a], a):
            vector[b] -= factor[a, b] * value
        vector[a] = value / scale[a]


@inner
def _next_of_inverse(factor, i, before, k, start, column):
    """Put entry i of column start + k of the factor's inverse."""
    value = -before if i != start + k else 1.0 - before
    for j in range(i - i % 3, i):
        value -= factor[i, j] * column[j]
    column[i] = value / factor[i, i]


@inner
def invert_block(factor, first, scale, start, size, columns, block, out):
    """
    Put the 3 x 3 block at start on the diagonal of the inverse into out.

    columns (3, size) is scratch, for columns of the inverse of the factor.
    """
    whole = size - size % 3
    for i in range(start, whole, 3):
        _dots(factor, i, columns, 0, max(first[i], start), i, block)
        for r in range(3):
            for k in range(3):
                _next_of_inverse(factor, i + r, block[r, k], k, start,
                                 columns[k])
    for i in range(whole, size):
        for k in range(3):
            before = _dot(factor[i], columns[k], start, i - i % 3)
            _next_of_inverse(factor, i, before, k, start, columns[k])
    for k in range(3):
        for j in range(3):
            out[k, j] = (_dot(columns[k], columns[j], start, size)
                         / (scale[start + k] * scale[start + j]))
