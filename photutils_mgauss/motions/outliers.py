r"""
Detections that do not belong to their stars.

A detection is judged by the chi-square of its residual r, with the covariance
:math:`C - P` that the fit leaves of its own (see ``joint``). Few are so far
off that it has to be known. Of

.. math:: C - P = M - Q, \quad Q = G\,S^{-1} G^T, \quad G = (H_W - 1)\,A ,

M is what frames that are known exactly would leave, and :math:`1 - H_W` makes
residuals of positions. With the variances of the frames in units of those of
the star's detections, :math:`q = \sum_e \mathrm{tr}(W A S^{-1} A^T)_e`, no
residual can have more than a share q of M from the frames, so that

.. math::
    r^T (C - P)^{-1} r \le \frac{1}{1 - q}\,\min\left(\chi^2,
    \frac{r^T W r}{1 - h}\right) ,

where :math:`\chi^2` is that of the whole star, which would fall by
:math:`r^T M^{-1} r` without the detection, and h the detection's leverage.
Stars are judged where this is beyond the limit.
"""
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from scipy.special import chdtri, ndtr

from photutils_mgauss.motions.joint import (
    each_part,
    fitted,
    frame_variances,
    leverages,
    plain_chi2,
    shifted,
    solve_stars,
)
from photutils_mgauss.motions.stacked import dimensions_2x2


@dataclass(frozen=True, eq=False)
class Judged:
    """
    What the detections of n stars say, and each detection of k of them.

    Parameters
    ----------
    count : (n,) int `~numpy.ndarray`
        How many numbers were measured of each star.
    raw : (n,) `~numpy.ndarray`
        The chi-square of its detections, 0 where they do not suffice.
    stars : (k,) int `~numpy.ndarray`
        Those that can lose a detection, and may have one beyond the limit.
    chi2 : (E, k) `~numpy.ndarray`
        Of each of their detections, NaN where nothing can be said.
    numbers : (E, k) int `~numpy.ndarray`
        How many numbers each of these measures, 0 where unused.
    """

    count: np.ndarray
    raw: np.ndarray
    stars: np.ndarray
    chi2: np.ndarray
    numbers: np.ndarray


def judge_all(problem, frames, clip, executor=None):
    """Return what detections say in the frames found, as `Judged`."""
    judge = partial(_judge, correction=frames.correction,
                    inverse=frames.factor @ frames.factor.T,
                    limit=chi2_limit(clip, 1))
    found, start = [], 0
    for one in each_part(judge, problem, executor):
        one.stars[:] += start
        start += len(one.count)
        found.append(one)
    return Judged(*(np.concatenate([getattr(one, field.name)
                                    for one in found], axis=-1)
                    for field in fields(Judged)))


def _judge(problem, correction, inverse, limit):
    """Return the `Judged` of a part of the stars."""
    numbers = measured_numbers(problem.weights)
    count = numbers.sum(axis=0, dtype=int)
    aligned = shifted(problem, correction)
    values, residuals, solved = fitted(aligned)
    raw = plain_chi2(residuals, problem.weights)
    raw[:, ~solved] = 0.0
    stars = np.flatnonzero(solved & _can_lose_one(problem, count))
    if len(stars):
        whole = raw.sum(axis=0)
        whole[problem.priors.stars] += problem.priors.chi2(values)
        least = limit * (1 - _frames_share(problem, inverse))
        stars = stars[~(whole[stars] < least[stars])]
        some = problem.select(stars)
        left = 1 - leverages(some)
        stars = stars[~(raw[:, stars] < least[stars] * left).all(axis=0)]
    chi2 = solve_stars(problem.select(stars), correction, inverse,
                       judge=True).chi2
    return Judged(count, raw.sum(axis=0), stars, chi2, numbers[:, stars])


def _frames_share(problem, inverse):
    """Return the q (n,) of the module."""
    (xx, xy, yy), (a, b, c) = problem.weights, frame_variances(
        problem.transform.basis(problem.origin), inverse)
    return np.sum(xx * a + 2 * xy * b + yy * c, axis=0)


def measured_numbers(weights):
    """Return how many numbers detections of weights (3, ...) measure."""
    used = weights[0] + weights[2] > 0
    return (dimensions_2x2(weights) * used).astype(np.int8)


def _can_lose_one(problem, count):
    """
    Return the stars (n,) that can lose a detection and still be judged.

    ``count`` (n,) is how many numbers were measured of each.
    """
    return count + problem.ranks - 2 >= problem.n_parameters + 2


def chi2_limit(clip, dof):
    """Return the chi-square as rare as a deviation by ``clip`` sigma."""
    return chdtri(dof, 2 * ndtr(-clip))


def worst_outliers(judged, clip):
    """
    Return which detections (E, k) of the stars judged to reject now.

    The worst of each star, which is farthest beyond the `chi2_limit` of its
    chi-square. Only one of a star's goes at a time, or a twentieth of many,
    because a bad one spoils the residuals of the good.
    """
    excess = np.nan_to_num(judged.chi2, nan=0.0)
    excess[judged.numbers == 0] = 0.0
    one, two = chi2_limit(clip, np.array([1, 2]))
    excess /= np.where(judged.numbers == 1, one, two)
    worst = excess.argmax(axis=0)
    out = np.zeros(excess.shape, dtype=bool)
    stars = np.arange(len(worst))
    out[worst, stars] = excess[worst, stars] > 1
    most = len(excess) // 20
    if most > 1:
        # Those about as bad as the worst, which has spoilt the others.
        rank = excess.argsort(axis=0)[::-1].argsort(axis=0)
        used = np.sum(judged.numbers > 0, axis=0)
        out |= ((rank < used // 20)
                & (excess > np.maximum(1, excess.max(axis=0) / 4)))
    return out
