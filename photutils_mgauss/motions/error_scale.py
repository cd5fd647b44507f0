r"""
Errors right at every magnitude: a scale and a floor for each epoch.

Where the stated covariances :math:`\Sigma_i` of an epoch are too small for
some stars and too large for others, what is used is

.. math:: V_i = k(m_i)\,\Sigma_i + f\,I,

with a smooth function :math:`\log k` of the magnitude (a natural cubic spline
through few nodes) and a floor f. Residuals r, of which the fit left
:math:`d_i` degrees of freedom (2 minus the leverage), choose them,

.. math::
    \min \sum_i \frac{d_i}{2} \log\det V_i + r_i^T V_i^{-1} r_i ,

so that :math:`r^T V^{-1} r` is d in the mean at every magnitude. First for
all epochs together; then what an epoch has of its own multiplies and adds to
that. There are as many nodes as the Bayesian information criterion allows;
none, and no floor, where there is no need.
"""
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from photutils_mgauss.motions.stacked import (
    dimensions_2x2,
    invert_2x2,
    variance_2x2,
)

MOST_NODES = 6
EACH = 30.0  # degrees of freedom that a node needs
MOST = 20_000  # detections of an epoch that take part
FAR = 9.0  # chi-square from which detections count less, if some are bad
OWN = 1.0  # expected of the logarithm of an epoch's own factor
SMALLEST = -14.0  # logarithm of a floor that is none, in typical variances
LARGEST = 20.0
MOST_STEPS = 40
CLOSE = 1e-3  # of the cost: nothing beside what the criterion asks for


@dataclass(frozen=True, eq=False)
class ErrorScale:
    """
    What makes the errors of an epoch right.

    Parameters
    ----------
    nodes : (k,) `~numpy.ndarray`
        Magnitudes, at least one.
    logs : (k,) `~numpy.ndarray`
        The logarithm of the factor of variances there.
    floor : float
        A variance.
    """

    nodes: np.ndarray
    logs: np.ndarray
    floor: float

    def at(self, magnitude):
        """Return the factors of variances at magnitudes, unknown ones NaN."""
        middle = (self.nodes[0] + self.nodes[-1]) / 2
        known = np.where(np.isfinite(magnitude), magnitude, middle)
        return np.exp(self.logs @ _basis(self.nodes, known))


NO_SCALE = ErrorScale(np.zeros(1), np.zeros(1), 0.0)


def _basis(nodes, magnitude):
    """Return what each node contributes (k, n); constant beyond the ends."""
    if len(nodes) == 1:
        return np.ones((1, len(magnitude)))
    inside = np.clip(magnitude, nodes[0], nodes[-1])
    if len(nodes) == 2:
        part = (inside - nodes[0]) / (nodes[1] - nodes[0])
        return np.stack([1 - part, part])
    return CubicSpline(nodes, np.eye(len(nodes)), bc_type='natural')(inside).T


@dataclass(frozen=True, eq=False)
class _Sample:
    """
    Residuals (2, n), covariances (3, n), magnitudes, d (n,).

    ``lines`` (n,) are measurements in one direction, ``unit`` a variance,
    ``own`` what is expected of logarithms of the factor.
    """

    residuals: np.ndarray
    covariance: np.ndarray
    magnitude: np.ndarray
    expected: np.ndarray
    lines: np.ndarray
    robust: bool
    unit: float
    own: float

    def cost(self, basis, unknown):
        """
        Return the cost, its slopes, and the expected second slopes.

        The ``unknown`` are log k at the nodes of the ``basis`` (k, n), and
        the logarithm of the floor, if there is one more.
        """
        n = len(basis)
        own = np.exp(unknown[:n] @ basis) * self.covariance
        floor = np.exp(unknown[n]) if len(unknown) > n else 0.0
        xx, xy, yy = own + floor * np.array([[1.0], [0.0], [1.0]])
        a, b, c = invert_2x2(xx, xy, yy)
        x, y = self.residuals
        u, v = a * x + b * y, b * x + c * y
        part, weight = self._counted(u * x + v * y)
        # Across a scan nothing is measured: all variances are along.
        lines = self.lines
        share = a * own[0] + 2 * b * own[1] + c * own[2] - lines
        size = np.where(lines, -np.log(a + c), np.log(xx * yy - xy * xy))
        half = self.expected / np.where(lines, 1, 2)
        pull = own[0] * u * u + 2 * own[1] * u * v + own[2] * v * v
        total = np.sum(half * size + part)
        slopes = [basis @ (half * share - weight * pull)]
        bend = half * _squared(a, b, c, own, lines)
        curve = (basis * bend) @ basis.T
        if len(unknown) > n:
            slopes.append([floor * np.sum(
                half * (a + c) - weight * (u * u + v * v))])
            mixed = basis @ (half * floor * _product(a, b, c, own))
            last = floor**2 * np.sum(half * (a * a + 2 * b * b + c * c))
            curve = np.block([[curve, mixed[:, None]], [mixed, last]])
        return total, np.concatenate(slopes), curve

    def _counted(self, chi2):
        """Return what chi-squares cost, and what their slopes count."""
        if not self.robust:
            return chi2, 1.0
        far = np.maximum(chi2, FAR)
        return (np.where(chi2 > FAR, 2 * np.sqrt(FAR * far) - FAR, chi2),
                np.sqrt(FAR / far))


def _squared(a, b, c, own, lines):
    """Return the trace of (V^-1 k Sigma)^2, along scans alone."""
    xx, xy = a * own[0] + b * own[1], a * own[1] + b * own[2]
    yx, yy = b * own[0] + c * own[1], b * own[1] + c * own[2]
    return xx * xx + 2 * xy * yx + yy * yy - lines


def _product(a, b, c, own):
    """Return the trace of V^-1 k Sigma V^-1."""
    return ((a * own[0] + b * own[1]) * a + (a * own[1] + b * own[2]) * b
            + (b * own[0] + c * own[1]) * b + (b * own[1] + c * own[2]) * c)


@dataclass(frozen=True, eq=False)
class ErrorScales:
    """The `ErrorScale` of all epochs together, and what each adds to it."""

    common: ErrorScale
    own: tuple

    def at(self, magnitude):
        """Return factors (E, n) and floors (E, n) for magnitudes (E, n)."""
        own = np.stack([one.at(some) for one, some in zip(
            self.own, magnitude, strict=True)])
        common = np.stack([self.common.at(some) for some in magnitude])
        floor = np.array([one.floor for one in self.own])[:, None]
        return own * common, own * self.common.floor + floor


def fit_error_scales(magnitude, residuals, covariance, expected, *,
                     robust=False, like=None):
    """
    Return the `ErrorScales` of E epochs of n stars.

    Parameters
    ----------
    magnitude : (E, n) `~numpy.ndarray`
        In one system.
    residuals, covariance, expected : `~numpy.ndarray`
        (2, E, n), (3, E, n) and (E, n), as for one epoch.
    robust : bool, optional
        As for one epoch.
    like : ErrorScales, optional
        With the numbers of nodes to use.

    Returns
    -------
    ErrorScales
    """
    common = fit_error_scale(
        magnitude.ravel(), residuals.reshape(2, -1),
        covariance.reshape(3, -1), expected.ravel(), robust=robust,
        like=like and like.common)
    factor = common.at(magnitude.ravel()).reshape(magnitude.shape)
    scaled = factor * covariance
    scaled[::2] += common.floor
    own = [fit_error_scale(
        magnitude[e], residuals[:, e], scaled[:, e], expected[e],
        robust=robust, like=like and like.own[e], own=OWN)
        for e in range(len(magnitude))]
    return ErrorScales(common, tuple(own))


def fit_error_scale(magnitude, residuals, covariance, expected, *,
                    robust=False, like=None, own=np.inf):
    """
    Return the `ErrorScale` of one epoch.

    Parameters
    ----------
    magnitude : (n,) `~numpy.ndarray`
    residuals : (2, n) `~numpy.ndarray`
    covariance : (3, n) `~numpy.ndarray`
        As stated: xx, xy, yy.
    expected : (n,) `~numpy.ndarray`
        Degrees of freedom that each detection has left.
    robust : bool, optional
        Whether detections far off count less.
    like : ErrorScale, optional
        One with as many nodes, and a floor or not; by default the number
        is chosen.
    own : float, optional
        What is expected of the logarithm of the factor.

    Returns
    -------
    ErrorScale
    """
    good = (np.isfinite(residuals).all(axis=0) & (expected > 0.1)
            & np.isfinite(magnitude) & np.isfinite(covariance).all(axis=0))
    chosen = np.flatnonzero(good)
    chosen = chosen[::1 + len(chosen) // MOST]
    if not len(chosen):
        return NO_SCALE
    covariance = covariance[:, chosen]
    unit = float(np.median(variance_2x2(covariance)))
    sample = _Sample(residuals[:, chosen] / np.sqrt(unit), covariance / unit,
                     magnitude[chosen], expected[chosen],
                     dimensions_2x2(covariance) == 1, robust, unit, own)
    if like is not None:
        return _refitted(sample, like)
    return _chosen(sample)


def _refitted(sample, like):
    """Return an `ErrorScale` fitted anew, from the one before."""
    if like is NO_SCALE:
        return NO_SCALE
    n_nodes = len(like.nodes) if like.logs.any() else 0
    return _fitted(sample, n_nodes, like.floor > 0, like)[0]


def _chosen(sample):
    """Return the `ErrorScale` of the best number of nodes."""
    dof = sample.expected.sum()
    best, least = NO_SCALE, sample.cost(
        np.empty((0, len(sample.magnitude))), np.empty(0))[0]
    most = min(MOST_NODES, int(dof / EACH))
    for n_nodes in range(most + 1):
        if n_nodes > len(best.nodes) + 2:
            break  # Two more were no use already.
        for floored in (False, True):
            if n_nodes + floored == 0 or (n_nodes == 0 and most == 0):
                continue
            found, cost = _fitted(sample, n_nodes, floored)
            cost += (n_nodes + floored) * np.log(dof)
            if cost < least:
                best, least = found, cost
    return best


def _fitted(sample, n_nodes, floored, start=None):
    """Return the best `ErrorScale` of some nodes, and its cost."""
    nodes = np.unique(np.quantile(sample.magnitude, (
        [0.5] if n_nodes < 2 else np.linspace(0.02, 0.98, n_nodes))))
    n = len(nodes) if n_nodes else 0
    basis = _basis(nodes, sample.magnitude)[:n]
    first = np.zeros(n + floored)
    if floored:
        first[-1] = -1.0
    if start is not None:
        first[:n] = start.logs[:n]
        first[n:] = np.log(max(start.floor / sample.unit, 1e-6))
    found, cost = _minimum(sample, basis, first)
    floor = np.exp(found[-1]) if floored else 0.0
    logs = found[:n] if n else np.zeros(len(nodes))
    return ErrorScale(nodes, logs, float(floor * sample.unit)), cost


def _minimum(sample, basis, unknown):
    """Return the best unknowns, by scoring with steps that go down."""
    n, damping = len(basis), 1e-6
    prior = np.diag(np.where(np.arange(len(unknown)) < n,
                             2 / sample.own**2, 0.0))

    def cost(unknown):
        total, slopes, curve = sample.cost(basis, unknown)
        return (total + unknown @ prior @ unknown / 2,
                slopes + prior @ unknown, curve + prior)
    total, slopes, curve = cost(unknown)
    for _ in range(MOST_STEPS):
        scale = np.diag(curve).max(initial=1e-300)
        step = np.linalg.solve(
            curve + damping * scale * np.eye(len(unknown)), slopes)
        after = np.clip(unknown - np.clip(step, -2, 2), SMALLEST, LARGEST)
        new = cost(after)
        if new[0] > total + 1e-9:
            damping = max(10 * damping, 1e-4)
            continue
        gain, damping = total - new[0], damping / 10
        unknown, (total, slopes, curve) = after, new
        if gain < CLOSE:
            break
    return unknown, total
