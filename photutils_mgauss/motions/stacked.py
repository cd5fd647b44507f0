"""
Linear algebra of many small matrices, one star after another in memory.

A stack of n symmetric p x p matrices has shape (p, p, n). Loops run over
the few rows and columns, so every operation is one long vector operation;
the library routines for (n, p, p) stacks are several times slower here.
"""
from dataclasses import fields
from operator import add, sub

import numpy as np

THIN = 1000.0  # times another error: nothing was measured in that direction


def inverse_factor(matrices, *, tolerance=1e-10):
    r"""
    Return lower triangular R with :math:`R^T R = A^{-1}`, and which exist.

    Parameters
    ----------
    matrices : (p, p, n) `~numpy.ndarray`
        Symmetric matrices; only the lower triangles are read.
    tolerance : float, optional
        A matrix is singular where, scaled to a unit diagonal, a pivot
        falls below this.

    Returns
    -------
    factor : (p, p, n) `~numpy.ndarray`
        Zero for singular matrices.
    exists : (n,) bool `~numpy.ndarray`
    """
    size = len(matrices)
    diagonal = np.stack([matrices[k, k] for k in range(size)])
    exists = (diagonal > 0).all(axis=0) & np.isfinite(diagonal).all(axis=0)
    scale = 1 / np.sqrt(np.where(exists, diagonal, 1))
    lower = np.zeros_like(matrices)
    for j in range(size):
        exists &= _factor_column(lower, matrices, scale, j, exists, tolerance)
    return _invert_lower(lower) * (scale * exists), exists


def _factor_column(lower, matrices, scale, j, exists, tolerance):
    """Fill column j of the Cholesky factor; return where its pivot held."""
    pivot = (matrices[j, j] * scale[j]**2
             - np.einsum('kn,kn->n', lower[j, :j], lower[j, :j]))
    held = pivot > tolerance
    lower[j, j] = np.sqrt(np.where(held & exists, pivot, 1))
    for i in range(j + 1, len(lower)):
        value = (matrices[i, j] * scale[i] * scale[j]
                 - np.einsum('kn,kn->n', lower[i, :j], lower[j, :j]))
        lower[i, j] = np.where(held & exists, value, 0) / lower[j, j]
    return held


def _invert_lower(lower):
    inverse = np.zeros_like(lower)
    for i in range(len(lower)):
        inverse[i, i] = 1 / lower[i, i]
        for j in range(i):
            inner = np.einsum('kn,kn->n', lower[i, j:i], inverse[j:i, j])
            inverse[i, j] = -inverse[i, i] * inner
    return inverse


def gram(factor, middle=None):
    r"""Return :math:`R^T R` or :math:`R^T M R` of stacks (p, p, n)."""
    if middle is None:
        return np.einsum('kin,kjn->ijn', factor, factor)
    half = np.einsum('kln,ljn->kjn', middle, factor)
    return np.einsum('kin,kjn->ijn', factor, half)


def apply(matrices, vectors):
    """Return the products (p, n) of (p, q, n) matrices and (q, n)."""
    return np.einsum('ijn,jn->in', matrices, vectors)


def apply_transposed(matrices, vectors):
    """Return the products (q, n) of transposed (p, q, n) and (p, n)."""
    return np.einsum('jin,jn->in', matrices, vectors)


def invert_2x2(xx, xy, yy):
    """Return the elements of the inverses of symmetric 2 x 2 matrices."""
    det = xx * yy - xy * xy
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.stack([yy / det, -xy / det, xx / det])


def sandwich_2x2(jacobian, covariance):
    """
    Return the elements xx, xy, yy of :math:`J C J^T`.

    ``jacobian`` is (2, 2, ...), ``covariance`` (3, ...).
    """
    (a, b), (c, d) = jacobian
    xx, xy, yy = covariance
    return np.stack([a * a * xx + 2 * a * b * xy + b * b * yy,
                     a * c * xx + (a * d + b * c) * xy + b * d * yy,
                     c * c * xx + 2 * c * d * xy + d * d * yy])


def is_definite_2x2(covariance):
    """Return which of the matrices (3, n) are positive definite."""
    xx, xy, yy = covariance
    with np.errstate(invalid='ignore'):
        return (xx > 0) & (yy > 0) & (xx * yy - xy * xy > 1e-12 * xx * yy)


def dimensions_2x2(covariance):
    """Return 1 for covariances (3, ...) of a single direction, else 2."""
    xx, xy, yy = covariance
    with np.errstate(invalid='ignore'):
        thin = (xx + yy)**2 > THIN**2 * (xx * yy - xy * xy)
    return np.where(thin, 1, 2)


def variance_2x2(covariance):
    """
    Return the mean variance of both axes of covariances (3, ...).

    Of those of a single direction, the variance in that direction.
    """
    xx, xy, yy = covariance
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(dimensions_2x2(covariance) == 1,
                        (xx * yy - xy * xy) / (xx + yy), (xx + yy) / 2)


class Summed:
    """A dataclass of arrays; two are added or subtracted field by field."""

    def __add__(self, other):
        return self._combined(add, other)

    def __sub__(self, other):
        return self._combined(sub, other)

    def _combined(self, how, other):
        return type(self)(*(how(getattr(self, field.name),
                                getattr(other, field.name))
                            for field in fields(self)))
