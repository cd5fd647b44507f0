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
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg.lapack import dposv

from photutils_mgauss import kernels
from photutils_mgauss.field.places import in_turn
from photutils_mgauss.psf.rows import kernel_rows_of_logs
from photutils_mgauss.utils.parallel import SINGLE_BLAS, Threads

# The chi^2 of a size beyond the widest, its logarithm by one.
_WALL = 1e4
# Standard deviations of the prior on log weight, x, y (of the PSF's width),
# log_p, s, log_q: of a polynomial's constant, and of its other terms. A good
# star overrules them by far; they decide what the stars say nothing about,
# as which of two equal Gaussians is which. A weaker prior lets the wings
# wander, and with them the centroid.
_PRIOR_CONSTANT = np.array([0.8, 0.4, 0.4, 0.3, 0.3, 0.3])
_PRIOR_VARIATION = np.array([0.15, 0.1, 0.1, 0.07, 0.07, 0.07])
# Standard deviations of the prior on changes of a known PSF: of covariances,
# of log weights, of means, in powers of the PSF's width; and the share of
# them that varies over the field.
_PRIOR_CHANGE = np.array([1.0, 1.0, 1.0, 0.5, 0.3, 0.3])
_PRIOR_CHANGE_POWER = np.array([2, 2, 2, 0, 1, 1])
_PRIOR_CHANGE_VARIATION = 0.3

# Gauss-Newton steps of the stamps' own numbers for each step of the shapes.
_SETTLE_STEPS = 2
# Stars whose derivatives are in memory at a time.
_CHUNK = 256


@dataclass
class FieldProblem:
    """
    What is fitted, and the present state of the stamps' own numbers.

    Attributes
    ----------
    stamps : Stamps
    weights : (n, s, s) `~numpy.ndarray`
        One over the variance; 0 for pixels left out.
    basis : (n, T) `~numpy.ndarray`
        The polynomials at each star; while it is fitted with them, the terms
        of ``extra`` behind them.
    sources, anchors, hold : (n, M, 3) `~numpy.ndarray`
        x, y and flux of each star and its neighbours, where the neighbours
        are expected, and the precision of that.
    n_sources : (n,) `~numpy.ndarray` of int
    sky : (n,) `~numpy.ndarray`
    fit_sky : bool
    used : (n,) `~numpy.ndarray` of bool
        Which stars the PSF is fitted to.
    exposure : (n,) `~numpy.ndarray` of int
    form : FreeShapes or TunedShapes
        What the polynomials mean.
    local : (n, ...) `~numpy.ndarray`
        What the form needs to know of each star.
    pixel_integrated : bool
        Whether the shapes are integrated over pixels, not sampled.
    extra : (n, X) `~numpy.ndarray`, optional
        Terms that do not depend on the degree, as those of colours.
    star, place : (n,) `~numpy.ndarray` of int, optional
        Which star each detection is of, and at which place; by default all
        are different.
    places_once : bool, optional
        Whether all detections at one place count as much as one of them.
        They share what is wrong there, as the light of faint neighbours, and
        would say twenty times that the PSF is different there.
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
    exposure: np.ndarray
    form: object
    local: np.ndarray
    pixel_integrated: bool = False
    extra: np.ndarray = None
    star: np.ndarray = None
    place: np.ndarray = None
    places_once: bool = True

    def __post_init__(self):
        for name in ('star', 'place'):
            if getattr(self, name) is None:
                setattr(self, name, np.arange(len(self.basis)))
        if self.extra is None:
            self.extra = np.zeros((len(self.basis), 0))

    @property
    def n_places(self):
        """At how many places of the detector stars are."""
        return np.unique(self.place).size

    @property
    def n_extra(self):
        """The number of terms that do not depend on the degree."""
        return self.extra.shape[1]

    def with_terms(self, n_terms):
        """Return the problem with the first polynomials and the extra."""
        return replace(self, basis=np.hstack([self.basis[:, :n_terms],
                                              self.extra]))

    def subset(self, index):
        """Return the problem of some of the stars; nothing is shared."""
        return replace(self, stamps=self.stamps.subset(index), **{
            name: getattr(self, name)[index] for name in
            ('weights', 'basis', 'sources', 'anchors', 'hold', 'n_sources',
             'sky', 'used', 'exposure', 'local', 'extra', 'star', 'place')})

    def shares(self):
        """Return as how much of a star each detection counts, (n,)."""
        if not self.places_once:
            return np.ones(len(self.place))
        numbers = np.bincount(self.place, self.used)
        return 1 / np.maximum(numbers[self.place], 1)

    def brightest(self):
        """Return the order of detections: bright first, places in turn."""
        return in_turn(self.place, self.sources[:, 0, 2])

    def shapes(self, coefficients):
        """Return the shapes of the PSF at each star, (n, K, 6)."""
        return self.form.shapes(coefficients, self.basis, self.local)[0]


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
    """
    Split stars over the threads or processes of an executor.

    Linear algebra has no threads meanwhile: those of its many small matrices
    would mostly wait for each other.
    """

    # The same on every machine, so that sums over parts round alike.
    N_PARTS = 16

    def __init__(self, executor=None):
        self._own = executor is None
        self.executor = executor
        # Who is told of the stage that begins, and of each pass, with None.
        self.told = None

    def __enter__(self):
        SINGLE_BLAS.__enter__()
        if self._own:
            self.executor = Threads()
        return self

    def __exit__(self, *error):
        try:
            if self._own:
                self.executor.__exit__(*error)
        finally:
            SINGLE_BLAS.__exit__(*error)

    def tell(self, stage=None):
        """Tell who watches that a stage begins, or that a pass is done."""
        if self.told is not None:
            self.told(stage)

    def map(self, function, n_stars, *args):
        """Call function(*args of a part of the stars) for each part."""
        edges = np.linspace(0, n_stars,
                            min(self.N_PARTS, n_stars) + 1).astype(int)
        parts = [slice(a, b) for a, b in pairwise(edges)]
        jobs = [self.executor.submit(function, *(a[part] for a in args))
                for part in parts]
        return [job.result() for job in jobs]


def equations(problem, coefficients, workers):
    """Form the normal equations at the coefficients."""
    shares, weights = problem.shares(), problem.weights
    if (shares != 1).any():  # else all weights would be copied at each step
        weights = weights * shares[:, None, None]
    parts = workers.map(
        _PartEquations(coefficients, problem.fit_sky, problem.form,
                       problem.pixel_integrated),
        len(problem.basis), problem.stamps.data, weights,
        problem.stamps.corners, problem.basis, problem.local,
        problem.sources, problem.anchors, problem.hold, problem.n_sources,
        problem.sky, problem.used)
    workers.tell()
    own, chi2, sources, sky = (np.concatenate(columns)
                               for columns in zip(*parts, strict=True))
    return Equations(*_spread(own, problem.basis), chi2 / shares, sources,
                     sky)


def _spread(own, basis):
    """
    Return matrix and right side of all coefficients.

    ``own`` (n, P (P + 3) / 2) are the equations of stars' shapes, as in
    `kernels.FieldSums`: sums of their products with pairs of terms are one
    product of matrices.
    """
    n_terms = basis.shape[1]
    n = (int(np.sqrt(8 * own.shape[1] + 9)) - 3) // 2
    first, second = np.triu_indices(n_terms)
    pairs = own.T @ (basis[:, first] * basis[:, second])
    place, of_terms = _triangle(n, 1), _triangle(n_terms)
    ends = place[:, -1]
    place = np.maximum(place[:, :-1], place[:, :-1].T)
    matrix = pairs[place[:, None, :, None], of_terms[:, None]]
    return (matrix.reshape(n * n_terms, -1), (own[:, ends].T @ basis).ravel())


def _triangle(n, more=0):
    """
    Return where the elements (n, n) of a symmetric matrix are kept.

    Its upper triangle is, with ``more`` columns behind it.
    """
    place = np.zeros((n, n + more), int)
    kept = np.triu_indices(n, 0, n + more)
    place[kept] = np.arange(kept[0].size)
    return place if more else np.maximum(place, place.T)


@dataclass
class _PartEquations:
    """The kernel's call for some of the stars, picklable for processes."""

    coefficients: np.ndarray
    fit_sky: bool
    form: object
    integrated: bool

    def __call__(self, data, weights, corners, basis, local, sources,
                 anchors, hold, n_sources, sky, used):
        n = to_vector(self.coefficients).size // basis.shape[1]
        own = np.zeros((len(data), n * (n + 3) // 2))
        chi2 = np.empty(len(data))
        sources, sky = sources.copy(), sky.copy()
        for first in range(0, len(data), _CHUNK):
            part = slice(first, first + _CHUNK)
            now = self.coefficients, basis[part], local[part]
            rows = kernel_rows_of_logs(*self.form.shapes(*now))
            size = 3 * sources.shape[1] + 6 * rows.shape[1] - 1
            stars = kernels.FieldStars(*(column[part] for column in (
                data, weights, corners, sources, anchors, hold, n_sources,
                sky, used)))
            kernels.field_normal(
                stars, kernels.FieldShapes(rows, self.form.jacobians(*now),
                                           self.integrated),
                self.fit_sky, _SETTLE_STEPS, np.empty((size, size)),
                kernels.FieldSums(own[part], chi2[part]))
        return own, chi2, sources, sky


def model_stamps(problem, coefficients):
    """Draw the fitted stamps, neighbours and sky included, (n, s, s)."""
    out = np.empty_like(problem.stamps.data)
    rows = kernel_rows_of_logs(*problem.form.shapes(
        coefficients, problem.basis, problem.local))
    kernels.field_model(problem.stamps.corners, rows,
                        problem.pixel_integrated or None, problem.sources,
                        problem.n_sources, problem.sky, out)
    return out


@dataclass
class Prior:
    """
    Independent Gaussians about ``mean`` with ``precision``.

    Both have the shape of the coefficients, (T, K, 6) or (T, N).

    The terms a lower degree does not have are the last ones before the
    ``n_extra`` that all have. Mixtures' mean sizes meet a wall at ``widest``
    [pix].
    """

    mean: np.ndarray
    precision: np.ndarray
    strength: float = 1.0
    widest: float = np.inf
    n_extra: int = 0

    @classmethod
    def about(cls, shapes, n_terms, width, strength=1.0, widest=np.inf,
              n_extra=0):
        """Return the prior about the constant shapes (K, 6)."""
        n_terms += n_extra
        mean = np.zeros((n_terms, *shapes.shape))
        mean[0] = shapes
        scale = np.array([1, width, width, 1, 1, 1])
        stddev = np.tile(_PRIOR_VARIATION * scale, (n_terms, len(shapes), 1))
        stddev[0] = _PRIOR_CONSTANT * scale
        return cls(mean, strength / stddev**2, strength, widest, n_extra)

    @classmethod
    def of_changes(cls, n_terms, width, strength=1.0):
        """Return the prior of changes of a known PSF, about none."""
        stddev = np.tile(_PRIOR_CHANGE * width**_PRIOR_CHANGE_POWER,
                         (n_terms, 1))
        stddev[1:] *= _PRIOR_CHANGE_VARIATION
        return cls(np.zeros((n_terms, 6)), strength / stddev**2, strength)

    def first(self, n_terms):
        """Return the prior of the first terms, and of the extra ones."""
        kept = np.r_[:n_terms, len(self.mean) - self.n_extra:len(self.mean)]
        return replace(self, mean=self.mean[kept],
                       precision=self.precision[kept])

    def adapted(self, coefficients, matrix, groups):
        r"""
        Return the prior whose widths are those of what was found.

        Each group of coefficients that vary over the field gets the variance
        :math:`\langle c^2 + \sigma_c^2 \rangle`, a step towards the widths
        under which the data are most likely (MacKay 1992, Neural
        Computation 4, 415). High terms that are mostly noise are shrunk,
        those that the stars ask for are not.

        Parameters
        ----------
        coefficients : `~numpy.ndarray`
        matrix : (N, N) `~numpy.ndarray`
            The normal equations at them, without the prior.
        groups : `~numpy.ndarray` of int
            The group of each coefficient, -1 for those to leave alone.
        """
        posterior = np.diag(np.linalg.inv(
            matrix + np.diag(to_vector(self.precision))))
        squares = coefficients**2 + to_coefficients(posterior,
                                                    coefficients)
        ratio = squares * self.precision / self.strength
        precision = self.precision.copy()
        for group in np.unique(groups[groups >= 0]):
            inside = groups == group
            precision[inside] /= np.mean(ratio[inside])
        return replace(self, precision=precision)

    def cost(self, coefficients):
        """Return the chi^2 of coefficients."""
        return (np.sum(self.precision * (coefficients - self.mean) ** 2)
                + _WALL * np.sum(self._beyond(coefficients) ** 2))

    def right(self, coefficients):
        """Return the pull towards the mean, in the order of unknowns."""
        return to_vector(self.precision * (self.mean - coefficients)
                         + _WALL * self._beyond(coefficients))

    def curvature(self, coefficients):
        """Return the diagonal that belongs to it."""
        return to_vector(self.precision
                         + _WALL * (self._beyond(coefficients) > 0))

    def _beyond(self, coefficients):
        """Return by how much log sizes are beyond the wall, 0 elsewhere."""
        out = np.zeros(coefficients.shape)
        if np.isfinite(self.widest):
            sizes = [3, 5]
            out[0, :, sizes] = np.maximum(
                -np.log(self.widest) - coefficients[0, :, sizes], 0)
        return out


def to_vector(coefficients):
    """
    Return the fitted coefficients by number, then term.

    Of shapes (T, K, 6) the first three are left out; of (T, N) none is.
    """
    first = 3 if coefficients.ndim == 3 else 0
    return coefficients.reshape(len(coefficients), -1)[:, first:].T.ravel()


def to_coefficients(vector, like):
    """Undo `to_vector` in the shape of others; what is not fitted is 0."""
    full = np.zeros((len(like), like[0].size))
    first = 3 if like.ndim == 3 else 0
    full[:, first:] = vector.reshape(-1, len(like)).T
    return full.reshape(like.shape)


def optimise(problem, coefficients, prior, workers, *, max_steps=30,
             tolerance=1e-3, damping=1e-3):
    """
    Minimise chi^2 plus prior by Levenberg-Marquardt steps.

    Stops when a step gains less than ``tolerance`` times the number of stars;
    ``damping`` is that of the first step. The stamps' own numbers in
    ``problem`` are updated.

    Returns
    -------
    `~numpy.ndarray`, Equations
    """
    present = equations(problem, coefficients, workers)
    cost = _cost(problem, present, prior, coefficients)
    growth = kernels.FIRST_GROWTH
    n_stars = problem.shares()[problem.used].sum()
    for _ in range(max_steps):
        problem.sources, problem.sky = present.sources, present.sky
        matrix = present.matrix + np.diag(prior.curvature(coefficients))
        right = present.right + prior.right(coefficients)
        step = _damped_step(matrix, right, damping)
        expected = step @ (2 * right - matrix @ step)
        trial = coefficients + to_coefficients(step, coefficients)
        new = equations(problem, trial, workers)
        gain = cost - _cost(problem, new, prior, trial)
        if gain > 0:
            coefficients, present, cost = trial, new, cost - gain
            if max(gain, expected) < tolerance * n_stars:
                break
        elif damping > 1e6:
            break
        damping, growth = kernels.adapted_damping(damping, growth, gain,
                                                  expected)
    problem.sources, problem.sky = present.sources, present.sky
    return coefficients, present


def _cost(problem, state, prior, coefficients):
    cost = ((problem.shares() * state.chi2)[problem.used].sum()
            + prior.cost(coefficients))
    # Where Gaussians are too thin for their equations to be told from
    # rounding, there is no next step.
    diagonal = np.diag(state.matrix) + to_vector(prior.precision)
    return cost if np.isfinite(cost) and np.all(diagonal > 0) else np.inf


def _damped_step(matrix, right, damping):
    scale = np.sqrt(np.diag(matrix))
    scaled = matrix / scale / scale[:, None]
    scaled[np.diag_indices_from(scaled)] += damping
    _, step, failed = dposv(scaled, right / scale)
    if failed:
        # Rounding has left it a negative direction.
        step = np.empty(right.size)
        kernels.solve(np.column_stack([scaled, right / scale]), step)
    return step / scale
