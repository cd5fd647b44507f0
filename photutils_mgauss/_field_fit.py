r"""
Maximum-likelihood fit of a mixture field to the stamps of its stars.

Each shape :math:`\theta_p` (log weight, mean and the factors of the
precision matrix of each Gaussian) is a polynomial of detector position,
:math:`\theta_p = \sum_t c_{pt} B_t(x, y)`. A stamp has numbers of its own
(position and flux of the star and its neighbours, sky). Eliminating those from
the normal equations of stamp s leaves :math:`A_s` and :math:`b_s`, and the
whole problem is

.. math::

    \sum_s A_s \otimes B_s B_s^T\; \delta c = \sum_s b_s \otimes B_s ,

whose size does not depend on the number of stars.
"""
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from photutils_mgauss import _kernels

# Standard deviations of the prior on log weight, x, y (of the PSF's width),
# log_p, s, log_q: of a polynomial's constant, and of its other terms. Real
# PSFs vary less; the prior holds what the stars say nothing about.
_PRIOR_CONSTANT = np.array([2.0, 1.0, 1.0, 0.7, 0.7, 0.7])
_PRIOR_VARIATION = np.array([0.7, 0.4, 0.4, 0.3, 0.3, 0.3])

_SETTLE_STEPS = 4
_SETTLE_TOLERANCE = 1e-4


@dataclass
class Problem:
    """
    What is fitted, and the present state of the stamps' own numbers.

    Attributes
    ----------
    stamps : Stamps
    weights : (n, s, s) `~numpy.ndarray`
        One over the variance; 0 for pixels left out.
    basis : (n, T) `~numpy.ndarray`
        The polynomials at each star.
    sources, anchors, hold : (n, M, 3) `~numpy.ndarray`
        x, y and flux of each star and its neighbours, where the neighbours
        are expected, and the precision of that.
    n_sources : (n,) `~numpy.ndarray` of int
    sky : (n,) `~numpy.ndarray`
    fit_sky : bool
    used : (n,) `~numpy.ndarray` of bool
        Which stars the PSF is fitted to.
    """

    stamps: object
    weights: np.ndarray
    basis: np.ndarray
    sources: np.ndarray
    anchors: np.ndarray
    hold: np.ndarray
    n_sources: np.ndarray
    sky: np.ndarray
    fit_sky: bool
    used: np.ndarray

    def subset(self, index):
        """Return the problem of some of the stars; nothing is shared."""
        stamps = replace(self.stamps, data=self.stamps.data[index],
                         base=self.stamps.base[index],
                         good=self.stamps.good[index],
                         corners=self.stamps.corners[index])
        return replace(self, stamps=stamps, **{
            name: getattr(self, name)[index] for name in
            ('weights', 'basis', 'sources', 'anchors', 'hold', 'n_sources',
             'sky', 'used')})


@dataclass
class Equations:
    """
    The normal equations at some coefficients.

    Attributes
    ----------
    matrix, right : (P T, P T), (P T,) `~numpy.ndarray`
        Unknowns are ordered by shape, then term; without the prior.
    chi2 : (n,) `~numpy.ndarray`
    sources, sky : `~numpy.ndarray`
        The stamps' own numbers, settled.
    """

    matrix: np.ndarray
    right: np.ndarray
    chi2: np.ndarray
    sources: np.ndarray
    sky: np.ndarray


class Workers:
    """Split stars over the threads or processes of an executor."""

    def __init__(self, executor=None):
        self.n = len(os.sched_getaffinity(0)) if hasattr(
            os, 'sched_getaffinity') else os.cpu_count()
        self._own = executor is None
        self.executor = executor

    def __enter__(self):
        if self._own:
            self.executor = ThreadPoolExecutor(self.n)
        return self

    def __exit__(self, *args):
        if self._own:
            self.executor.shutdown()

    def map(self, function, n_stars, *args):
        """Call function(*args of a part of the stars) for each part."""
        edges = np.linspace(0, n_stars, min(self.n, n_stars) + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(edges)]
        jobs = [self.executor.submit(function, *(a[part] for a in args))
                for part in parts]
        return [job.result() for job in jobs]


def equations(problem, coefficients, workers):
    """Form the normal equations at coefficients (T, K, 6)."""
    parts = workers.map(
        _PartEquations(coefficients, problem.fit_sky), len(problem.basis),
        problem.stamps.data, problem.weights, problem.stamps.corners,
        problem.basis, problem.sources, problem.anchors, problem.hold,
        problem.n_sources, problem.sky, problem.used)
    matrix = sum(part.matrix for part in parts)
    matrix = np.triu(matrix) + np.triu(matrix, 1).T
    return Equations(matrix, sum(part.right for part in parts),
                     np.concatenate([part.chi2 for part in parts]),
                     np.concatenate([part.sources for part in parts]),
                     np.concatenate([part.sky for part in parts]))


@dataclass
class _PartEquations:
    """The kernel's call for some of the stars, picklable for processes."""

    coefficients: np.ndarray
    fit_sky: bool

    def __call__(self, data, weights, corners, basis, sources, anchors, hold,
                 n_sources, sky, used):
        n_terms, k, _ = self.coefficients.shape
        size = (6 * k - 3) * n_terms
        total, right = np.zeros((size, size)), np.zeros(size)
        chi2 = np.empty(len(data))
        sources, sky = sources.copy(), sky.copy()
        n = 3 * sources.shape[1] + 6 * k - 1
        _kernels.field_normal(
            data, weights, corners, basis, self.coefficients, sources,
            anchors, hold, n_sources, sky, self.fit_sky, used, _SETTLE_STEPS,
            _SETTLE_TOLERANCE, np.empty((n, n)), total, right, chi2)
        return Equations(total, right, chi2, sources, sky)


def model_stamps(problem, coefficients):
    """Draw the fitted stamps, neighbours and sky included, (n, s, s)."""
    out = np.empty_like(problem.stamps.data)
    _kernels.field_model(problem.stamps.corners, problem.basis, coefficients,
                         problem.sources, problem.n_sources, problem.sky, out)
    return out


@dataclass
class Prior:
    """
    Independent Gaussians about ``mean`` with ``precision``, (T, K, 6) each.

    The terms a lower degree does not have are the last ones.
    """

    mean: np.ndarray
    precision: np.ndarray

    @classmethod
    def about(cls, shapes, n_terms, width, strength=1.0):
        """Return the prior about the constant shapes (K, 6)."""
        mean = np.zeros((n_terms, *shapes.shape))
        mean[0] = shapes
        scale = np.array([1, width, width, 1, 1, 1])
        stddev = np.tile(_PRIOR_VARIATION * scale, (n_terms, len(shapes), 1))
        stddev[0] = _PRIOR_CONSTANT * scale
        return cls(mean, strength / stddev**2)

    def first(self, n_terms):
        """Return the prior of the first terms."""
        return Prior(self.mean[:n_terms], self.precision[:n_terms])

    def cost(self, coefficients):
        """Return the chi^2 of coefficients."""
        return np.sum(self.precision * (coefficients - self.mean) ** 2)

    def right(self, coefficients):
        """Return the pull towards the mean, in the order of unknowns."""
        return to_vector(self.precision * (self.mean - coefficients))


def to_vector(coefficients):
    """Return the fitted ones of (T, K, 6) by shape, then term."""
    return coefficients.reshape(len(coefficients), -1)[:, 3:].T.ravel()


def to_coefficients(vector, n_terms, k):
    """Undo `to_vector`; what is not fitted is 0."""
    full = np.zeros((n_terms, 6 * k))
    full[:, 3:] = vector.reshape(-1, n_terms).T
    return full.reshape(n_terms, k, 6)


def optimise(problem, coefficients, prior, workers, *, max_steps=30,
             tolerance=1e-3):
    """
    Minimise chi^2 plus prior by Levenberg-Marquardt steps.

    Stops when a step gains less than ``tolerance`` times the number of stars.
    The stamps' own numbers in ``problem`` are updated.

    Returns
    -------
    (T, K, 6) `~numpy.ndarray`, Equations
    """
    n_terms, k, _ = coefficients.shape
    present = equations(problem, coefficients, workers)
    cost = _cost(problem, present, prior, coefficients)
    damping = 1e-3
    curvature = to_vector(prior.precision)
    for _ in range(max_steps):
        problem.sources, problem.sky = present.sources, present.sky
        matrix = present.matrix + np.diag(curvature)
        step = _damped_step(matrix, present.right + prior.right(coefficients),
                            damping)
        trial = coefficients + to_coefficients(step, n_terms, k)
        new = equations(problem, trial, workers)
        new_cost = _cost(problem, new, prior, trial)
        if new_cost < cost:
            gain, cost = cost - new_cost, new_cost
            coefficients, present = trial, new
            damping = max(damping / 8, 1e-9)
            if gain < tolerance * problem.used.sum():
                break
        elif damping > 1e6:
            break
        else:
            damping *= 8
    problem.sources, problem.sky = present.sources, present.sky
    return coefficients, present


def _cost(problem, state, prior, coefficients):
    cost = state.chi2[problem.used].sum() + prior.cost(coefficients)
    return cost if np.isfinite(cost) else np.inf


def _damped_step(matrix, right, damping):
    scale = np.sqrt(np.diag(matrix))
    scaled = matrix / scale / scale[:, None]
    scaled[np.diag_indices_from(scaled)] += damping
    try:
        return np.linalg.solve(scaled, right / scale) / scale
    except np.linalg.LinAlgError:
        return np.zeros_like(right)
