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
from functools import partial, reduce
from operator import add

import numpy as np

from photutils_mgauss.motions.problem import CHUNK, parts
from photutils_mgauss.motions.stacked import (
    Summed,
    apply,
    apply_transposed,
    dimensions_2x2,
    gram,
    inverse_factor,
    invert_2x2,
)
from photutils_mgauss.utils.parallel import map_parallel


@dataclass(frozen=True, eq=False)
class EliminatedStars:
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
        return z.reshape(np.prod(z.shape[:-1]), z.shape[-1])


def eliminate(problem):
    """Return the `EliminatedStars` of a problem."""
    columns, weighted, factor, y, solved = _alone(problem)
    basis = problem.transform.basis(problem.origin)
    return EliminatedStars(columns, factor, y, _combine(factor, weighted),
                           basis, solved)


def _alone(problem):
    """Return D, W D, R, y, and which stars are solved."""
    columns = problem.columns()
    weighted = [_weigh(problem.weights, column) for column in columns]
    normal = _normal_matrices(columns, weighted, problem)
    moment = np.stack([_sum(x, problem.offsets[0])
                       + _sum(y, problem.offsets[1]) for x, y in weighted])
    _add_priors(problem.priors, normal, moment)
    factor, solved = inverse_factor(normal)
    return columns, weighted, factor, apply(factor, moment), solved


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


def measured_ranks(problem, *, tolerance=1e-9):
    """
    Return how many parameters of each star its detections measure, (n,).

    Eigenvalues of the normal matrix, scaled to a unit diagonal, below the
    ``tolerance`` are none.
    """
    columns = problem.columns()
    weighted = [_weigh(problem.weights, column) for column in columns]
    normal = np.moveaxis(_normal_matrices(columns, weighted, problem), 2, 0)
    scale = np.sqrt(np.einsum('nkk->nk', normal))
    scale = 1 / np.where(scale > 0, scale, np.inf)
    normal = normal * scale[:, :, None] * scale[:, None, :]
    return np.sum(np.linalg.eigvalsh(normal) > tolerance, axis=1)


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
class Reduced(Summed):
    """
    The frames' equations S r = rhs, and A^T W A before the elimination.

    Unknowns are ordered (epoch, axis, basis function).
    """

    matrix: np.ndarray
    rhs: np.ndarray
    direct: np.ndarray


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


def reduced_rhs(problem):
    r"""
    Return the right hand side of the `Reduced` equations alone.

    It is :math:`-A^T W (z - D v)` with the v of a star in the frames as they
    are.
    """
    if not problem.ties.all():
        problem = problem.select(np.flatnonzero(problem.ties))
    _, away, solved = fitted(problem)
    return -_direct_rhs(problem.weights * solved, away,
                        problem.transform.basis(problem.origin)).ravel()


def fitted(problem):
    """
    Return what fits stars best in the frames as they are.

    Their parameters (p, n), the residuals (2, E, n), and which of them are
    solved (n,).
    """
    columns, _, factor, y, solved = _alone(problem)
    values = apply_transposed(factor, y)
    return values, _residuals(problem.offsets, columns, values), solved


def leverages(problem):
    """Return what part of its chi-square a detection fits itself, (E, n)."""
    columns, weighted, factor, _, _ = _alone(problem)
    inverse = gram(factor)
    out = np.zeros(problem.weights.shape[1:])
    for k, (x, y) in enumerate(weighted):
        for j, (own_x, own_y) in enumerate(columns):
            out += inverse[j, k] * (_times(own_x, x) + _times(own_y, y))
    return out


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


def each_part(function, problem, executor=None, *others):
    """
    Yield what a function returns for the parts of a problem, in order.

    ``others`` are further arguments, one for each part.
    """
    return map_parallel(function, parts(problem), *others, executor=executor)


def reduce_all(problem, executor=None, *, like=None):
    """
    Return the `Reduced` equations of a whole problem.

    ``like`` are those of a problem that differs in its offsets alone: but
    for the right hand side they are the same.
    """
    if like is not None:
        return replace(like, rhs=sum(each_part(reduced_rhs, problem,
                                               executor)))
    return reduce(add, each_part(reduce_stars, problem, executor))


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
    expect of that, 2 minus the leverage. ``total`` (n,) is the chi-square of
    a star, what was known of it included.
    """

    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray | None = None
    predicted: np.ndarray | None = None
    chi2: np.ndarray | None = None
    raw: np.ndarray | None = None
    expected: np.ndarray | None = None
    total: np.ndarray | None = None


def solve_stars(problem, correction, inverse, *, residuals=False,
                leverage=False, judge=False):
    """
    Return the `Estimates` of a part of the stars; see `solve_all`.

    ``inverse`` (M, M) is the covariance of the correction.
    """
    stars = eliminate(problem)
    framed = _framed(stars, inverse)
    middle = _middle(stars, framed)
    shift = _shift(stars.basis, correction)
    values, covariance = _estimate(stars, shift, middle)
    away = predicted = None
    judged = None, None, None
    if residuals or judge:
        away = _residuals(problem.offsets + shift, stars.columns, values)
    if leverage or judge:
        predicted = _predicted(stars, problem, inverse, framed, middle)
    if judge:
        judged = _judge(away, predicted, problem.weights)
    found = Estimates(values, covariance, away if residuals else None,
                      predicted if leverage else None, *judged)
    if not residuals:
        return found
    return replace(found, total=total_chi2(problem, found))


def _residuals(offsets, columns, values):
    """Return z - D v, (2, E, n)."""
    return offsets - np.stack([
        sum(_times(column[c], value) for column, value in zip(
            columns, values, strict=True)) for c in range(2)])


def _judge(residuals, predicted, weights):
    """Return chi2, raw and expected of `Estimates`, each (E, n)."""
    x, y = residuals
    xx, xy, yy = weights
    used = (xx > 0) & np.isfinite(x)
    raw = plain_chi2(residuals, weights)
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
        (sound, chi2), (used, raw),
        (used, dimensions_2x2(weights) - leverage)))


def plain_chi2(residuals, weights):
    """Return r^T W r of residuals (2, ...) and weights (3, ...)."""
    (x, y), (xx, xy, yy) = residuals, weights
    return xx * x * x + 2 * xy * x * y + yy * y * y


def _times(column, value):
    return 0.0 if column is None else column * value


def _framed(stars, inverse):
    """Return Z S^-1 A^T, which covariances are made of, (p, 2, E, n)."""
    n_epochs, n_stars = stars.coupling.shape[2:]
    out = np.empty_like(stars.coupling)
    for k, row in enumerate(out):
        moved = (inverse @ stars.rows(k)).reshape(
            n_epochs, 2, len(stars.basis), n_stars)
        np.einsum('ecbn,bn->cen', moved, stars.basis, out=row)
    return out


def _middle(stars, framed):
    """Return Z S^-1 Z^T, (p, p, n)."""
    size = len(framed)
    out = np.empty((size, size, framed.shape[3]))
    for k in range(size):
        for j in range(k + 1):
            out[k, j] = out[j, k] = np.einsum('cen,cen->n', framed[k],
                                              stars.coupling[j])
    return out


def _estimate(stars, shift, middle):
    inner = stars.y + np.einsum('kcen,cen->kn', stars.coupling, shift)
    values = apply_transposed(stars.factor, inner)
    covariance = gram(stars.factor) + gram(stars.factor, middle)
    values[:, ~stars.solved] = np.nan
    covariance[..., ~stars.solved] = np.nan
    return values, covariance


def _shift(basis, correction):
    """Return A r, shape (2, E, n)."""
    return np.swapaxes(correction @ basis, 0, 1)


def shifted(problem, correction):
    """Return a problem whose frames have been corrected by (E, 2, b)."""
    basis = problem.transform.basis(problem.origin)
    return replace(problem, offsets=problem.offsets
                   + _shift(basis, correction))


def frame_variances(basis, inverse):
    """Return the covariances A S^-1 A^T of single epochs, (3, E, n)."""
    size, n = basis.shape
    n_epochs = len(inverse) // (2 * size)
    blocks = inverse.reshape(n_epochs, 2, size, n_epochs, 2, size)
    out = np.empty((3, n_epochs, n))
    for k, (c, d) in enumerate(((0, 0), (0, 1), (1, 1))):
        for e in range(n_epochs):
            out[k, e] = (basis * (blocks[e, c, :, e, d] @ basis)).sum(axis=0)
    return out


def scaled_rows(stars, factor):
    """Return Z C for S^-1 = C C^T, shape (p, n, q)."""
    return np.stack([stars.rows(k).T @ factor
                     for k in range(len(stars.factor))])


def _predicted(stars, problem, inverse, framed, middle):
    r"""
    Return the covariance of the fitted positions, (3, E, n).

    With :math:`P = R D^T` and :math:`F = Z S^{-1} A^T` it is
    :math:`D H^{-1} D^T + (P^T Z - A) S^{-1} (P^T Z - A)^T =
    P^T (1 + Z S^{-1} Z^T) P - P^T F - F^T P + A S^{-1} A^T`.
    """
    out = frame_variances(stars.basis, inverse)
    for e in range(problem.n_epochs):
        rows = [_project(stars, e, c) for c in range(2)]
        # (1 + Z S^-1 Z^T) P - 2 F, whose product with P is made symmetric.
        halves = [row + np.einsum('jn,jkn->kn', row, middle)
                  - 2 * framed[:, c, e] for c, row in enumerate(rows)]
        for k, (c, d) in enumerate(((0, 0), (0, 1), (1, 1))):
            out[k, e] += ((rows[c] * halves[d]).sum(axis=0)
                          + (rows[d] * halves[c]).sum(axis=0)) / 2
    return out


def _project(stars, e, c):
    """Return (R D^T) for one row of D, shape (p, n)."""
    out = np.zeros_like(stars.y)
    for j, column in enumerate(stars.columns):
        if column[c] is not None:
            out += stars.factor[:, j] * column[c][e]
    return out


def solve_all(problem, correction, factor, executor=None, *,
              residuals_of=None, **wanted):
    """
    Return the `Estimates` of all stars of a problem with the frames found.

    Parameters
    ----------
    problem : `~photutils_mgauss.motions.problem.MotionProblem`
    correction : (E, 2, b) `~numpy.ndarray`
        The correction r of the frames.
    factor : (M, q) `~numpy.ndarray`
        The covariance of r is ``factor @ factor.T``.
    executor : `~concurrent.futures.Executor`, optional
    residuals_of : (k,) int `~numpy.ndarray`, optional
        The sorted numbers of the stars whose residuals are kept, where not
        all are needed.
    **wanted
        ``residuals``, ``leverage`` and ``judge``: whether to return the
        residuals, what the fit took away of their covariance, and what the
        detections are judged by.
    """
    solve = partial(_solve_part, correction=correction,
                    inverse=factor @ factor.T, **wanted)
    if residuals_of is None:
        residuals_of = np.arange(problem.n_stars)
    n_own = len(residuals_of)
    starts = np.arange(0, problem.n_stars, CHUNK)
    owns = np.split(residuals_of, np.searchsorted(residuals_of, starts[1:]))
    whole, start, first = None, 0, 0
    # Parts go as they come, or all arrays would be there twice.
    for part in each_part(solve, problem, executor, [
            own - start for own, start in zip(owns, starts, strict=True)]):
        if whole is None:
            whole = _for_all(part, problem.n_stars, n_own)
        stop = start + part.values.shape[1]
        for name, array in whole.items():
            if name == 'residuals':
                last = first + part.residuals.shape[2]
                array[..., first:last] = part.residuals
                first = last
            else:
                array[..., start:stop] = getattr(part, name)
        start = stop
    return Estimates(**whole)


def _solve_part(problem, own, **wanted):
    """
    Return the `Estimates` of a part, with the residuals of some stars.

    What waits for its turn must not be as large as all that was measured.
    """
    found = solve_stars(problem, **wanted)
    if found.residuals is None or len(own) == problem.n_stars:
        return found
    return replace(found, residuals=found.residuals[..., own])


def _for_all(part, n, n_own):
    """Return arrays for n stars, and for the residuals of some of them."""
    arrays = {field.name: getattr(part, field.name) for field in fields(part)}
    return {name: np.empty((*array.shape[:-1],
                            n_own if name == 'residuals' else n),
                           array.dtype)
            for name, array in arrays.items() if array is not None}


def total_chi2(problem, estimates):
    """Return the chi-square (n,) of detections and what was known before."""
    chi2 = np.zeros(problem.n_stars)
    # Epoch by epoch: products of all are as large as what was measured.
    for residuals, weights in zip(
            estimates.residuals.swapaxes(0, 1),
            problem.weights.swapaxes(0, 1), strict=True):
        chi2 += plain_chi2(residuals, weights)
    priors = problem.priors
    chi2[priors.stars] += priors.chi2(estimates.values)
    return chi2


def cross_covariance(problem, factor):
    r"""
    Return the covariance between all parameters of all stars.

    Shape (n, p, n, p), so for at most some hundred stars.
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


def parallax_leak(problem, executor=None):
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
        Bias of the motion for one unit of parallax [1 / yr], in local axes.
    """
    leaks = each_part(_leak, problem, executor)
    correlation, leak = (np.concatenate(some, axis=-1)
                         for some in zip(*leaks, strict=True))
    return correlation, leak


def _leak(problem):
    """Return the correlation and leak of a part of the stars."""
    columns = problem.columns()[:5]
    weighted = [_weigh(problem.weights, column) for column in columns]
    normal = _normal_matrices(columns, weighted, problem)
    factor, solved = inverse_factor(normal[:4, :4])
    if not solved.all():
        _add_known(problem.priors, normal, solved)
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
    inverse = problem.plane.local_inverse(problem.origin)
    return correlation, np.einsum('ijn,jn->in', inverse, motion)


def _add_known(priors, normal, solved):
    """Add what is known of stars that are not solved without."""
    which = np.flatnonzero(~solved[priors.stars])
    normal[:4, :4, priors.stars[which]] += priors.precision[:4, :4, which]
