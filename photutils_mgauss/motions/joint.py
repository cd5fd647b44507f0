r"""
All stars and all frames in one least-squares solution.

The aligned position of star i at epoch e obeys

.. math:: z_{ie} = D_{ie} v_i - A_i r_e + \mathrm{noise},

with v the star's position, motion and parallax, and r the correction of the
epoch's map. A star enters through the small matrices

.. math::
    H_i = \sum_e D^T W D + \Lambda_i = (R^T R)^{-1}, \quad
    y_i = R\,(\sum_e D^T W z + \Lambda_i v_0), \quad
    Z_i = R\,[D^T W A]_e ,

and once the stars are eliminated the frames obey

.. math::
    S r = \sum_i Z_i^T y_i - [A^T W z]_e, \quad
    S = [A^T W A]_e - \sum_i Z_i^T Z_i ,

after which, exactly,

.. math::
    v_i = R^T (y_i + Z_i r), \quad
    \mathrm{Cov}(v_i, v_j) = \delta_{ij} H_i^{-1}
        + R_i^T Z_i S^{-1} Z_j^T R_j .

Arrays have the stars last: (E, n) for E epochs of n stars. The basis A is
evaluated at the mean place of a star, not at each measured one: the two agree
once the maps have converged, and only with a common basis are shifts of all
frames together exactly undetermined, as they must be.
"""
from dataclasses import dataclass, fields, replace
from functools import reduce
from operator import add

import numpy as np

from photutils_mgauss.motions.stacked import (
    apply,
    apply_transposed,
    gram,
    inverse_factor,
    invert_2x2,
)
from photutils_mgauss.utils.parallel import map_parallel

CHUNK = 8192  # stars worked on at a time: what fits into a processor's cache


@dataclass(frozen=True, eq=False)
class Priors:
    """
    What is known of k of the stars beforehand, as normal equations.

    Parameters
    ----------
    stars : (k,) int `~numpy.ndarray`
        Sorted numbers of the stars.
    precision : (p, p, k) `~numpy.ndarray`
        Inverse covariance of the parameters, 0 where nothing is known.
    moment : (p, k) `~numpy.ndarray`
        The precision times the expected parameters, positions relative to
        the star's origin. (The expected parameters themselves do not exist
        where the precision is singular.)
    constant : (k,) `~numpy.ndarray`
        The chi-square of parameters that are all zero.
    """

    stars: np.ndarray
    precision: np.ndarray
    moment: np.ndarray
    constant: np.ndarray

    @classmethod
    def none(cls, n_parameters):
        """Return priors of no star at all."""
        p = n_parameters
        return cls(np.empty(0, dtype=int), np.empty((p, p, 0)),
                   np.empty((p, 0)), np.empty(0))

    def pick(self, which, stars=None):
        """Return some of the priors, for ``stars`` or the same ones."""
        stars = self.stars[which] if stars is None else stars
        return Priors(stars, self.precision[..., which],
                      self.moment[:, which], self.constant[which])

    def chi2(self, values):
        """Return the chi-square (k,) of parameters (p, n) of all stars."""
        v = values[:, self.stars]
        return (np.sum(v * (apply(self.precision, v) - 2 * self.moment),
                       axis=0) + self.constant)

    def between(self, start, stop):
        """Return the priors of stars start <= i < stop, renumbered."""
        part = slice(*np.searchsorted(self.stars, [start, stop]))
        return self.pick(part, self.stars[part] - start)

    def without(self, stars):
        """Return the priors of all stars but these."""
        return self.pick(~np.isin(self.stars, stars))


@dataclass(frozen=True, eq=False)
class Problem:
    """
    Aligned positions of n stars at E epochs, and the model for them.

    Parameters
    ----------
    offsets : (2, E, n) `~numpy.ndarray`
        Aligned positions minus ``origin``; 0 where there are none.
    weights : (3, E, n) `~numpy.ndarray`
        Elements xx, xy, yy of the inverse covariances; 0 where unused.
    origin : (2, n) `~numpy.ndarray`
        Mean places of the stars.
    dt : (E, 1) or (E, n) `~numpy.ndarray`
        Times since the working epoch [yr].
    observer : (3, E, 1) or (3, E, n) `~numpy.ndarray` or None
        Barycentric places of the observer [au], None without parallax.
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane` or None
    transform : `~photutils_mgauss.sky.transforms.Transform`
    priors : `Priors`
    acceleration : bool
    ties : (n,) bool `~numpy.ndarray`
        The stars that take part in finding the frames.
    """

    offsets: np.ndarray
    weights: np.ndarray
    origin: np.ndarray
    dt: np.ndarray
    observer: np.ndarray | None
    plane: object
    transform: object
    priors: Priors
    acceleration: bool
    ties: np.ndarray

    @property
    def n_parameters(self):
        """Number of parameters of a star."""
        return 4 + (self.observer is not None) + 2 * self.acceleration

    @property
    def n_stars(self):
        """Number of stars."""
        return self.origin.shape[1]

    @property
    def n_epochs(self):
        """Number of epochs."""
        return self.offsets.shape[1]

    def part(self, start, stop):
        """Return the problem of stars start <= i < stop alone."""
        part = slice(start, stop)
        per_row = self.dt.shape[1] > 1
        observer = self.observer
        if observer is not None and observer.shape[2] > 1:
            observer = observer[..., part]
        return replace(
            self, offsets=self.offsets[..., part],
            weights=self.weights[..., part], origin=self.origin[:, part],
            dt=self.dt[:, part] if per_row else self.dt, observer=observer,
            priors=self.priors.between(start, stop), ties=self.ties[part])

    def select(self, stars):
        """Return the problem of the given stars alone."""
        stars = np.asarray(stars)
        observer = self.observer
        if observer is not None and observer.shape[2] > 1:
            observer = observer[..., stars]
        place = np.full(self.n_stars, -1)
        place[stars] = np.arange(len(stars))
        found = place[self.priors.stars]
        which = np.argsort(found)[np.sum(found < 0):]
        priors = self.priors.pick(which, found[which])
        return replace(
            self, offsets=self.offsets[..., stars],
            weights=self.weights[..., stars], origin=self.origin[:, stars],
            dt=self.dt[:, stars] if self.dt.shape[1] > 1 else self.dt,
            observer=observer, priors=priors, ties=self.ties[stars])

    def columns(self):
        """
        Return the design matrix D as p pairs of its x and y row.

        Each is (E, 1) or (E, n); None stands for zeros.
        """
        one = np.ones((self.n_epochs, 1))
        columns = [(one, None), (None, one), (self.dt, None),
                   (None, self.dt)]
        if self.observer is not None:
            columns.append(tuple(self.plane.parallax_factors(
                self.origin[:, None, :], self.observer)))
        if self.acceleration:
            half = self.dt**2 / 2
            columns += [(half, None), (None, half)]
        return columns


def parts(problem):
    """Yield the problem in parts that fit into a processor's cache."""
    for start in range(0, problem.n_stars, CHUNK):
        yield problem.part(start, min(start + CHUNK, problem.n_stars))


@dataclass(frozen=True, eq=False)
class Stars:
    """
    Stars with the frames left open: the R, y and Z of the equations above.

    ``factor`` (p, p, n), ``y`` (p, n); Z is the outer product of ``coupling``
    (p, 2, E, n) and ``basis`` (b, n). ``solved`` (n,) says which have one.
    """

    columns: list
    factor: np.ndarray
    y: np.ndarray
    coupling: np.ndarray
    basis: np.ndarray
    solved: np.ndarray

    def rows(self, k):
        """Return row k of Z of all stars, shape (M, n)."""
        z = self.coupling[k].swapaxes(0, 1)[:, :, None] * self.basis
        return z.reshape(-1, z.shape[-1])


def eliminate(problem):
    """Return the `Stars` of a problem."""
    columns = problem.columns()
    weighted = [_weigh(problem.weights, column) for column in columns]
    normal = _normal_matrices(columns, weighted, problem)
    moment = np.stack([_sum(x, problem.offsets[0])
                       + _sum(y, problem.offsets[1]) for x, y in weighted])
    _add_priors(problem.priors, normal, moment)
    factor, solved = inverse_factor(normal)
    basis = problem.transform.basis(problem.origin)
    return Stars(columns, factor, apply(factor, moment),
                 _combine(factor, weighted), basis, solved)


def _weigh(weights, column):
    """Return W D for one column of D, x and y, each (E, n)."""
    (xx, xy, yy), (x, y) = weights, column
    if y is None:
        return xx * x, xy * x
    if x is None:
        return xy * y, yy * y
    return xx * x + xy * y, xy * x + yy * y


def _sum(a, b):
    """Return the sum over epochs of a product, (n,)."""
    if a is None or b is None:
        return 0.0
    if b.shape[1] == 1:
        return b[:, 0] @ a
    return np.einsum('en,en->n', a, b)


def _normal_matrices(columns, weighted, problem):
    size = len(columns)
    normal = np.empty((size, size, problem.n_stars))
    for k, (x, y) in enumerate(weighted):
        for j in range(k + 1):
            normal[k, j] = normal[j, k] = (_sum(x, columns[j][0])
                                           + _sum(y, columns[j][1]))
    return normal


def _add_priors(priors, normal, moment):
    if len(priors.stars):
        normal[..., priors.stars] += priors.precision
        moment[:, priors.stars] += priors.moment


def _combine(factor, weighted):
    """Return R (D^T W), shape (p, 2, E, n)."""
    out = np.zeros((len(factor), 2, *weighted[0][0].shape))
    for k, row in enumerate(out):
        for j in range(k + 1):
            row[0] += factor[k, j] * weighted[j][0]
            row[1] += factor[k, j] * weighted[j][1]
    return out


@dataclass(frozen=True, eq=False)
class Reduced:
    """
    The frames' equations S r = rhs, and A^T W A before the elimination.

    Unknowns are ordered (epoch, axis, basis function).
    """

    matrix: np.ndarray
    rhs: np.ndarray
    direct: np.ndarray

    def __add__(self, other):
        return Reduced(self.matrix + other.matrix, self.rhs + other.rhs,
                       self.direct + other.direct)


def reduce_stars(problem):
    """Return the `Reduced` equations of the stars that tie the frames."""
    if not problem.ties.all():
        problem = problem.select(np.flatnonzero(problem.ties))
    stars = eliminate(problem)
    # A star that cannot be solved says nothing about the frames.
    weights = problem.weights * stars.solved
    direct = _direct(weights, stars.basis)
    rhs = -_direct_rhs(weights, problem.offsets, stars.basis).ravel()
    matrix = _block_diagonal(direct)
    for k in range(problem.n_parameters):
        rows = stars.rows(k)
        matrix -= rows @ rows.T
        rhs += rows @ stars.y[k]
    return Reduced(matrix, rhs, direct)


def _direct(weights, basis):
    """Return the diagonal blocks A^T W A, shape (E, 2b, 2b)."""
    xx, xy, yy = ([(basis * row) @ basis.T for row in element]
                  for element in weights)
    return np.stack([np.block([[a, b], [b, c]])
                     for a, b, c in zip(xx, xy, yy, strict=True)])


def _direct_rhs(weights, offsets, basis):
    """Return A^T W z, shape (E, 2, b)."""
    (xx, xy, yy), (x, y) = weights, offsets
    return np.stack([(xx * x + xy * y) @ basis.T,
                     (xy * x + yy * y) @ basis.T], axis=1)


def _block_diagonal(blocks):
    n, size, _ = blocks.shape
    out = np.zeros((n, size, n, size))
    out[np.arange(n), :, np.arange(n)] = blocks
    return out.reshape(n * size, n * size)


def reduce_all(problem, executor=None):
    """Return the `Reduced` equations of a whole problem."""
    return reduce(add, map_parallel(reduce_stars, parts(problem),
                                    executor=executor))


@dataclass(frozen=True, eq=False)
class Task:
    """A part of a problem with the frames found, to solve its stars."""

    problem: Problem
    correction: np.ndarray  # (E, 2, b)
    factor: np.ndarray      # (M, q), covariance of r is factor @ factor.T
    residuals: bool = False
    leverage: bool = False
    judge: bool = False


@dataclass(frozen=True, eq=False)
class Estimates:
    """
    Parameters of stars, relative to their origins, and covariances.

    ``values`` (p, n) and ``covariance`` (p, p, n); NaN where not solved.
    ``residuals`` (2, E, n) is measured minus fitted, ``predicted`` (3, E, n)
    the part of its covariance that the fit took away.

    Each detection is judged by how far it lies from the fit: ``chi2``
    (E, n) has two degrees of freedom and takes into account that a
    detection pulls the fit towards itself, NaN where nothing can be said;
    ``raw`` (E, n) is the plain chi-square, and ``expected`` (E, n) what to
    expect of that, 2 minus the leverage.
    """

    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray | None = None
    predicted: np.ndarray | None = None
    chi2: np.ndarray | None = None
    raw: np.ndarray | None = None
    expected: np.ndarray | None = None


def solve_stars(task):
    """Return the `Estimates` of a part of the stars."""
    stars = eliminate(task.problem)
    scaled = scaled_rows(stars, task.factor)
    shift = _shift(stars.basis, task.correction)
    values, covariance = _estimate(stars, shift, scaled)
    residuals = predicted = None
    judged = None, None, None
    if task.residuals or task.judge:
        residuals = _residuals(task.problem.offsets + shift, stars, values)
    if task.leverage or task.judge:
        predicted = _predicted(stars, task, scaled)
    if task.judge:
        judged = _judge(residuals, predicted, task.problem.weights)
    return Estimates(values, covariance,
                     residuals if task.residuals else None,
                     predicted if task.leverage else None, *judged)


def _residuals(offsets, stars, values):
    return offsets - np.stack([
        sum(_times(column[c], value) for column, value in zip(
            stars.columns, values, strict=True)) for c in range(2)])


def _judge(residuals, predicted, weights):
    """Return chi2, raw and expected of `Estimates`, each (E, n)."""
    x, y = residuals
    xx, xy, yy = weights
    used = (xx > 0) & np.isfinite(x)
    raw = xx * x * x + 2 * xy * x * y + yy * y * y
    leverage = (xx * predicted[0] + 2 * xy * predicted[1]
                + yy * predicted[2])
    covariance = invert_2x2(xx, xy, yy)
    with np.errstate(invalid='ignore'):
        left = covariance - predicted
        whole = covariance[0] * covariance[2] - covariance[1]**2
        # A detection that alone fixes its star has no residual to judge.
        sound = used & (left[0] > 0) & (
            left[0] * left[2] - left[1]**2 > 1e-4 * whole)
        a, b, c = invert_2x2(*left)
        chi2 = a * x * x + 2 * b * x * y + c * y * y
    return tuple(np.where(good, values, np.nan) for good, values in (
        (sound, chi2), (used, raw), (used, 2 - leverage)))


def _times(column, value):
    return 0.0 if column is None else column * value


def _estimate(stars, shift, scaled):
    inner = stars.y + np.einsum('kcen,cen->kn', stars.coupling, shift)
    values = apply_transposed(stars.factor, inner)
    covariance = gram(stars.factor)
    if scaled.shape[2]:
        middle = np.einsum('knq,jnq->kjn', scaled, scaled)
        covariance += gram(stars.factor, middle)
    values[:, ~stars.solved] = np.nan
    covariance[..., ~stars.solved] = np.nan
    return values, covariance


def _shift(basis, correction):
    """Return A r, shape (2, E, n)."""
    return np.swapaxes(correction @ basis, 0, 1)


def scaled_rows(stars, factor):
    """Return Z C for S^-1 = C C^T, shape (p, n, q)."""
    return np.stack([stars.rows(k).T @ factor
                     for k in range(len(stars.factor))])


def _predicted(stars, task, scaled):
    r"""
    Return the covariance of the fitted positions, (3, E, n).

    With :math:`U = D R^T Z - A` it is :math:`D H^{-1} D^T + U S^{-1} U^T`.
    """
    n_epochs = task.problem.n_epochs
    out = np.empty((3, *task.problem.offsets.shape[1:]))
    blocks = task.factor.reshape(n_epochs, 2, len(stars.basis),
                                 task.factor.shape[1])
    for e in range(n_epochs):
        rows = [_project(stars, e, c) for c in range(2)]
        frame = [np.einsum('kn,knq->nq', rows[c], scaled)
                 - stars.basis.T @ blocks[e, c] for c in range(2)]
        out[:, e] = (_products(*rows, 'kn,kn->n')
                     + _products(*frame, 'nq,nq->n'))
    return out


def _products(x, y, contraction):
    return np.stack([np.einsum(contraction, a, b)
                     for a, b in ((x, x), (x, y), (y, y))])


def _project(stars, e, c):
    """Return (R D^T) for one row of D, shape (p, n)."""
    out = np.zeros_like(stars.y)
    for j, column in enumerate(stars.columns):
        if column[c] is not None:
            out += stars.factor[:, j] * column[c][e]
    return out


def solve_all(problem, correction, factor, executor=None, *,
              residuals=False, leverage=False, judge=False):
    """Return the `Estimates` of all stars of a problem."""
    tasks = (Task(part, correction, factor, residuals, leverage, judge)
             for part in parts(problem))
    results = list(map_parallel(solve_stars, tasks, executor=executor))
    return Estimates(*(_join(results, field.name)
                       for field in fields(Estimates)))


def _join(results, name):
    arrays = [getattr(result, name) for result in results]
    if arrays[0] is None:
        return None
    return np.concatenate(arrays, axis=-1)


def cross_covariance(problem, factor):
    r"""
    Return the covariance between all parameters of all stars.

    Shape (n, p, n, p); meant for some hundred stars.
    """
    stars = eliminate(problem)
    n, p = problem.n_stars, problem.n_parameters
    out = np.zeros((n, p, n, p))
    if factor.size:
        scaled = np.einsum('kin,knq->niq', stars.factor,
                           scaled_rows(stars, factor))
        flat = scaled.reshape(n * p, -1)
        out += (flat @ flat.T).reshape(out.shape)
    out[np.arange(n), :, np.arange(n)] += np.moveaxis(
        gram(stars.factor), 2, 0)
    out[~stars.solved] = np.nan
    out[:, :, ~stars.solved] = np.nan
    return out


def parallax_leak(problem):
    r"""
    Return what a parallax does to motions fitted without one.

    For the problem with the parallax in it, split the normal matrix into
    the block a without, the column b and the corner c of the parallax: a
    parallax of one shifts the other parameters by :math:`a^{-1} b`, and the
    variance of a fitted parallax would be
    :math:`(c - b^T a^{-1} b)^{-1}`.

    Returns
    -------
    correlation : (2, n) `~numpy.ndarray`
        Of parallax and motion, if both were fitted.
    leak : (2, n) `~numpy.ndarray`
        Bias of the motion for one unit of parallax [1 / yr].
    """
    columns = problem.columns()[:5]
    weighted = [_weigh(problem.weights, column) for column in columns]
    normal = _normal_matrices(columns, weighted, problem)
    factor, solved = inverse_factor(normal[:4, :4])
    inverse = gram(factor)
    leak = apply(inverse, normal[:4, 4])
    corner = normal[4, 4] - np.sum(normal[:4, 4] * leak, axis=0)
    corner = np.maximum(corner, 0.0)
    motion = leak[2:4]
    variance = np.stack([inverse[2, 2], inverse[3, 3]])
    with np.errstate(invalid='ignore', divide='ignore'):
        correlation = -motion / np.sqrt(corner * variance + motion**2)
    correlation[:, ~solved] = np.nan
    motion[:, ~solved] = np.nan
    return correlation, motion
