"""Small systems of linear equations."""
from math import sqrt

from photutils_mgauss.kernels.jit import inner, kernel


@inner
def cholesky(a, n, least):
    """
    Overwrite the lower triangle of a (n, n) by its Cholesky factor.

    A pivot below the fraction least of its diagonal is lost to rounding. It
    is replaced by a huge one, which makes the unknown zero instead of ending
    a fit. Returns whether no pivot was lost.
    """
    whole = True
    for j in range(n):
        diagonal = a[j, j]
        pivot = diagonal
        for k in range(j):
            pivot -= a[j, k] * a[j, k]
        if not pivot > least * diagonal:
            pivot = 1e30 * max(diagonal, 1e-30)
            whole = False
        root = sqrt(pivot)
        a[j, j] = root
        for i in range(j + 1, n):
            value = a[i, j]
            for k in range(j):
                value -= a[i, k] * a[j, k]
            a[i, j] = value / root
    return whole


@inner
def solve_factored(factor, n, x):
    """Overwrite x (n,) by the solution of factor factor^T y = x."""
    for i in range(n):
        for k in range(i):
            x[i] -= factor[i, k] * x[k]
        x[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= factor[k, i] * x[k]
        x[i] /= factor[i, i]


@inner
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
        x[count] = rhs[i]
        count += 1
    cholesky(work, count, 1e-14)
    solve_factored(work, count, x)
    for i in range(n - 1, -1, -1):
        if active[i]:
            count -= 1
            x[i] = x[count]
        else:
            x[i] = 0.0


@inner
def _lowest(x):
    """Return the index of the smallest number."""
    worst = 0
    for i in range(1, x.size):
        if x[i] < x[worst]:
            worst = i
    return worst


@inner
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


@inner
def solve_non_negative(gram, rhs, signed, x, active, work):
    """
    Solve min |G x - z| with x >= 0, unless signed.

    gram is G^T G, rhs G^T z. Lawson and Hanson's active set, started from
    all unknowns free. active (n,) and work (n, n) are scratch.
    """
    n = rhs.size
    for i in range(n):
        active[i] = True
    _solve_subset(gram, rhs, active, x, work)
    if signed:
        return
    for _ in range(3 * n):
        worst = _lowest(x)
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


@inner
def eliminate(normal, n, size):
    """Eliminate the first n unknowns from the upper triangle, in place."""
    for k in range(n):
        upper = normal[k]
        pivot = upper[k]
        if not pivot > 0:
            continue
        for i in range(k + 1, min(size, normal.shape[0])):
            factor = upper[i] / pivot
            if factor != 0:
                row = normal[i]
                for j in range(i, size):
                    row[j] -= factor * upper[j]


@inner
def back_substitute(normal, n, size, step):
    """Solve for the first n unknowns after their elimination."""
    for k in range(n - 1, -1, -1):
        right = normal[k, size - 1]
        for j in range(k + 1, n):
            right -= normal[k, j] * step[j]
        step[k] = right / normal[k, k] if normal[k, k] > 0 else 0.0


@kernel
def solve(augmented, step):
    """
    Solve a symmetric positive definite system for step (n,).

    augmented (n, n + 1) holds the matrix and the right side; only the upper
    triangle is read, and destroyed.
    """
    n = step.size
    eliminate(augmented, n, n + 1)
    back_substitute(augmented, n, n + 1, step)


@inner
def invert_3x3(a, out):
    """Invert a symmetric matrix; zeros if it is not positive definite."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    det = a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02
    if not det > 1e-12 * a[0, 0] * a[1, 1] * a[2, 2]:
        for i in range(3):
            for j in range(3):
                out[i, j] = 0.0
        return
    out[0, 0] = c00 / det
    out[0, 1] = out[1, 0] = c01 / det
    out[0, 2] = out[2, 0] = c02 / det
    out[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2]) / det
    out[1, 2] = out[2, 1] = (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]) / det
    out[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]) / det


# Plain loops: the same as a statement about whole arrays, with its check of
# shapes, takes seconds to compile.

@inner
def clear(values, n):
    """Make the first n numbers zero."""
    for i in range(n):
        values[i] = 0.0


@inner
def sum_of(values):
    """Return the sum of numbers, in their order."""
    result = 0.0
    for i in range(values.size):
        result += values[i]
    return result


@inner
def copy_vector(source, n, target):
    """Copy the first n numbers."""
    for i in range(n):
        target[i] = source[i]


@inner
def copy_matrix(source, n_rows, n_columns, target):
    """Copy the first rows and columns."""
    for i in range(n_rows):
        for j in range(n_columns):
            target[i, j] = source[i, j]
