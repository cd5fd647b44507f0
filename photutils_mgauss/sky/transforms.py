"""
Maps of one plane onto another: shifts to polynomials of any degree.

A map is a polynomial in plane coordinates scaled to about [-1, 1]; the kinds
differ in which combinations of its coefficients may change.
"""
import re
from dataclasses import dataclass, replace

import numpy as np

KINDS = {'shift': 2, 'rigid': 3, 'similarity': 4, 'affine': 6}


def exponents(degree):
    """Return the (b, 2) exponents of x and y, lowest degrees first."""
    return np.array([(total - j, j) for total in range(degree + 1)
                     for j in range(total + 1)])


def monomials(points, degree):
    """Return the (b, n) monomials of points (2, n)."""
    x, y = (_powers(axis, degree) for axis in points)
    return np.stack([x[i] * y[j] for i, j in exponents(degree)])


def _powers(values, degree):
    powers = [np.ones_like(values)]
    for _ in range(degree):
        powers.append(powers[-1] * values)
    return powers


@dataclass(frozen=True)
class Transform:
    """
    A kind of map, and the coordinates its polynomials are written in.

    Parameters
    ----------
    kind : str
        'none', 'shift', 'rigid', 'similarity', 'affine' or 'polynomial'.
    degree : int
        Degree of the polynomials.
    centre : (2,) tuple of float
        Origin of the scaled coordinates.
    scale : float
        Length of one scaled unit.
    """

    kind: str
    degree: int = 1
    centre: tuple = (0.0, 0.0)
    scale: float = 1.0

    @classmethod
    def parse(cls, name, option='transform'):
        """Return the transform called ``name``, the value of an option."""
        if name is None:
            return cls('none')
        if isinstance(name, str):
            if name in KINDS:
                return cls(name)
            match = re.fullmatch(r'poly(?:nomial)?-?(\d+)', name)
            if match and int(match[1]) > 0:
                return cls('polynomial', int(match[1]))
        words = ', '.join(repr(kind) for kind in KINDS)
        msg = (f"{option} must be one of {words}, 'poly-n' with a degree "
               f'n > 0, or None, got {name!r}')
        raise ValueError(msg)

    def fitted_to(self, points):
        """Return this kind of map with coordinates that suit ``points``."""
        low, high = np.nanmin(points, axis=1), np.nanmax(points, axis=1)
        scale = float(np.max(high - low)) / 2
        centre = tuple(float(value) for value in (low + high) / 2)
        return replace(self, centre=centre, scale=scale or 1.0)

    @property
    def n_terms(self):
        """Number of basis functions b on each axis."""
        return (self.degree + 1) * (self.degree + 2) // 2

    @property
    def n_parameters(self):
        """Number of free parameters of one map."""
        return self.generators.shape[1]

    @property
    def n_references(self):
        """Number of reference objects a map needs."""
        return max(-(-self.n_parameters // 2), 1)

    @property
    def generators(self):
        """The (2 b, m) combinations of coefficients that may change."""
        b = self.n_terms
        identity = np.eye(2 * b)
        if self.kind == 'polynomial' or self.kind == 'affine':
            return identity
        shift_x, shift_y = identity[0], identity[b]
        x_of_x, x_of_y = identity[1], identity[2]
        y_of_x, y_of_y = identity[b + 1], identity[b + 2]
        turn, stretch = y_of_x - x_of_y, x_of_x + y_of_y
        columns = {'none': [], 'shift': [shift_x, shift_y],
                   'rigid': [shift_x, shift_y, turn],
                   'similarity': [shift_x, shift_y, turn, stretch]}
        return np.array(columns[self.kind]).reshape(-1, 2 * b).T

    def scaled(self, points):
        """Return scaled coordinates of points (2, n)."""
        centre = np.reshape(self.centre, (2,) + (1,) * (points.ndim - 1))
        return (points - centre) / self.scale

    def basis(self, points):
        """Return the basis functions (b, n) at points (2, n)."""
        return monomials(self.scaled(points), self.degree)

    def identity(self):
        """Return the coefficients (2, b) of the map that changes nothing."""
        out = np.zeros((2, self.n_terms))
        out[:, 0] = self.centre
        out[0, 1] = out[1, 2] = self.scale
        return out

    def apply(self, coefficients, points):
        """Return mapped points (2, n)."""
        return coefficients @ self.basis(points)

    def jacobian(self, coefficients, points):
        """Return d(mapped)/d(point), shape (2, 2, n)."""
        x, y = (_powers(axis, self.degree) for axis in self.scaled(points))
        zero = np.zeros_like(x[0])
        along_x = np.stack([i * x[i - 1] * y[j] if i else zero
                            for i, j in exponents(self.degree)])
        along_y = np.stack([j * x[i] * y[j - 1] if j else zero
                            for i, j in exponents(self.degree)])
        return np.stack([coefficients @ along_x, coefficients @ along_y],
                        axis=1) / self.scale

    def project(self, coefficients):
        """
        Return the nearest coefficients that belong to this kind of map.

        Only rotations need it: they are not closed under addition.
        """
        if self.kind != 'rigid':
            return coefficients
        left, _, right = np.linalg.svd(coefficients[:, 1:3])
        out = coefficients.copy()
        out[:, 1:3] = self.scale * (left @ right)
        return out


def fit_map(transform, points, targets, weights):
    """
    Fit the coefficients (2, b) that map points to targets.

    The kinds that preserve shapes try both handednesses: pixels may run
    against right ascension.
    """
    if transform.kind in ('rigid', 'similarity', 'shift', 'none'):
        return _fit_shape(transform, points, targets, weights)
    basis = transform.basis(points) * np.sqrt(weights)
    values = targets * np.sqrt(weights)
    return np.linalg.lstsq(basis.T, values.T, rcond=None)[0].T


def fit_linear(transform, points, targets):
    """
    Fit the map (2, 3) of points to targets, in coordinates not scaled.

    Polynomials become affine.
    """
    if transform.kind == 'polynomial':
        transform = Transform('affine')
    transform = transform.fitted_to(points)
    coefficients = fit_map(transform, points, targets,
                           np.ones(points.shape[1]))
    slope = coefficients[:, 1:3] / transform.scale
    start = coefficients[:, 0] - slope @ np.array(transform.centre)
    return np.column_stack([start, slope])


def _fit_shape(transform, points, targets, weights):
    """Fit a shift, rotation or similarity (Procrustes' problem)."""
    total = weights.sum()
    scaled = transform.scaled(points)
    mean, aim = scaled @ weights / total, targets @ weights / total
    out = transform.identity()
    if transform.kind == 'none':
        return out
    if transform.kind != 'shift':
        a, b = scaled - mean[:, None], targets - aim[:, None]
        left, singular, right = np.linalg.svd((b * weights) @ a.T)
        stretch = singular.sum() / np.sum(weights * a**2)
        size = transform.scale if transform.kind == 'rigid' else stretch
        out[:, 1:3] = size * (left @ right)
    out[:, 0] = aim - out[:, 1:3] @ mean
    return out
