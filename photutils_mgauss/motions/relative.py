r"""
Motions relative to the mean of the stars, where nothing else fixes them.

Without reference objects a field of motions :math:`A_i q` common to all stars
cannot be told from maps that drift, :math:`r_e = q\,\Delta t_e`. It is chosen
such that the weighted mean field of the stars' own motions is zero,

.. math:: \mu_i' = \mu_i - A_i q, \quad q = P^{-1} c, \quad
    c = \sum_j w_j A_j^T \mu_j, \quad P = \sum_j w_j A_j^T A_j,

and the covariances follow from that same linear map. A common field of
parallaxes (or accelerations) is treated alike.
"""
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np

from photutils_mgauss.motions.frames import Gauge
from photutils_mgauss.motions.joint import eliminate, scaled_rows
from photutils_mgauss.motions.problem import MotionProblem, parts
from photutils_mgauss.motions.stacked import Summed, gram
from photutils_mgauss.utils.parallel import map_parallel
from photutils_mgauss.utils.robust import std_about_zero


@dataclass(frozen=True, eq=False)
class Family:
    """
    One kind of common field: which parameters, and how it may vary.

    ``rows`` are the parameters of a star it changes, ``generators``
    (len(rows) * b, m) the fields, ``drifts`` (E, 2 b, m) what the maps do.
    """

    rows: tuple
    generators: np.ndarray
    drifts: np.ndarray

    def fields(self, basis):
        """Return A_i, shape (len(rows), m, n)."""
        blocks = self.generators.reshape(len(self.rows), len(basis), -1)
        return np.einsum('rbm,bn->rmn', blocks, basis)


@dataclass(frozen=True, eq=False)
class Sums(Summed):
    """Sums over stars: P (m, m), c (m,) and the frames' part (m, q)."""

    normal: np.ndarray
    moment: np.ndarray
    frames: np.ndarray


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the stars, with what is needed of all of them."""

    problem: MotionProblem
    factor: np.ndarray
    family: Family
    weights: np.ndarray
    values: np.ndarray
    covariance: np.ndarray | None = None
    inverse: np.ndarray | None = None
    sums: Sums | None = None
    spread: np.ndarray | None = None


def _pieces(problem, frames, family, weights, estimates, **others):
    start = 0
    for part in parts(problem):
        rows = slice(start, start + part.n_stars)
        start = rows.stop
        yield Piece(part, frames.factor, family, weights[rows],
                    estimates.values[:, rows],
                    estimates.covariance[..., rows], **others)


def _frame_part(stars, factor):
    """Return R^T Z C of all stars, shape (p, n, q)."""
    return np.einsum('kin,knq->inq', stars.factor,
                     scaled_rows(stars, factor))


def _accumulate(piece):
    stars = eliminate(piece.problem)
    rows, fields = list(piece.family.rows), piece.family.fields(stars.basis)
    weighted = fields * piece.weights
    values = np.nan_to_num(piece.values[rows])
    return Sums(np.einsum('rmn,rkn->mk', weighted, fields),
                np.einsum('rmn,rn->m', weighted, values),
                np.einsum('rmn,rnq->mq', weighted,
                          _frame_part(stars, piece.factor)[rows]))


def _cross(piece, stars, fields):
    """Return Cov(c, v_i), shape (m, p, n)."""
    rows = list(piece.family.rows)
    own = np.einsum('rmn,rpn->mpn', fields * piece.weights,
                    gram(stars.factor)[rows])
    return own + np.einsum('mq,pnq->mpn', piece.sums.frames,
                           _frame_part(stars, piece.factor))


def _spread(piece):
    """Return this part's share of Cov(c, c)."""
    stars = eliminate(piece.problem)
    fields = piece.family.fields(stars.basis)
    cross = _cross(piece, stars, fields)[:, list(piece.family.rows)]
    return np.einsum('mrn,rkn->mk', cross, fields * piece.weights)


def _move(piece):
    """Return values and covariances of a part with the mean field gone."""
    stars = eliminate(piece.problem)
    rows, fields = list(piece.family.rows), piece.family.fields(stars.basis)
    values = piece.values.copy()
    shift = piece.inverse @ piece.sums.moment
    values[rows] -= np.einsum('rmn,m->rn', fields, shift)
    scaled = np.einsum('rmn,mk->rkn', fields, piece.inverse)
    half = np.einsum('rkn,kpn->rpn', scaled, _cross(piece, stars, fields))
    covariance = piece.covariance.copy()
    covariance[rows] -= half
    covariance[:, rows] -= half.swapaxes(0, 1)
    covariance[np.ix_(rows, rows)] += np.einsum(
        'rkn,kj,sjn->rsn', scaled, piece.spread, scaled)
    return values, covariance


def families(problem, *, parallax):
    """
    Return the common fields that stars without references may have.

    ``parallax`` says whether one of parallaxes is among them.
    """
    generators, dt = problem.transform.generators, problem.dt.mean(axis=1)
    out = [Family((2, 3), generators, np.multiply.outer(dt, generators))]
    if problem.acceleration:
        p = problem.n_parameters
        out.append(Family((p - 2, p - 1), generators,
                          np.multiply.outer(dt**2 / 2, generators)))
    if parallax:
        drifts = Gauge.of(problem).parallaxes
        b, m = problem.transform.n_terms, drifts.shape[1]
        if m:
            out.append(Family((4,), np.eye(b)[:, :m],
                              drifts.reshape(len(dt), 2 * b, m)))
    return out


def remove_mean_fields(problem, frames, estimates, options):
    """
    Return estimates whose mean fields are zero, and the maps' drift.

    The drift (E, 2, b) is what the maps had too much of.
    """
    drift = np.zeros_like(frames.correction)
    for family in families(problem, parallax=options.parallax is True):
        weights = mean_weights(estimates.values, estimates.covariance,
                               list(family.rows), problem.ties)
        estimates, field = remove_mean_field(
            problem, frames, estimates, family, weights, options.executor)
        drift += (family.drifts @ field).reshape(drift.shape)
    return estimates, drift


def remove_mean_field(problem, frames, estimates, family, weights, executor):
    """Return estimates without the mean field, and the field q (m,)."""
    def pieces(**others):
        return _pieces(problem, frames, family, weights, estimates, **others)
    run = partial(map_parallel, executor=executor)
    sums = reduce(add, run(_accumulate, pieces()))
    inverse = np.linalg.pinv(sums.normal, hermitian=True)
    spread = sum(run(_spread, pieces(sums=sums)))
    moved = run(_move, pieces(sums=sums, inverse=inverse, spread=spread))
    values, covariance = (np.concatenate(some, axis=-1)
                          for some in zip(*moved, strict=True))
    return (replace(estimates, values=values, covariance=covariance),
            inverse @ sums.moment)


def mean_weights(values, covariance, rows, usable):
    """
    Return the weights (n,) of the stars in the mean field.

    Inverse variances, the scatter of the true motions included; stars far
    from the others (5 times their scatter) take no part.
    """
    if not np.isfinite(values[rows][:, usable]).any():
        return np.zeros(len(usable))
    middle = np.nanmedian(values[rows][:, usable], axis=1)[:, None]
    away = values[rows] - middle
    scatter = std_about_zero(away[:, usable])
    variance = np.mean([covariance[k, k] for k in rows], axis=0)
    distance = np.abs(away).max(axis=0)
    near = usable & (distance <= 5 * np.sqrt(scatter**2 + variance))
    weights = 1 / (variance + scatter**2)
    return np.where(near & np.isfinite(weights), weights, 0.0)
