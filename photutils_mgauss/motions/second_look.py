"""
Which detections of a star to reject, judged together.

Whoever rejects the worst detection first, and then the worst of the others,
may reject good ones: two bad ones pull the fit between them. Of stars with few
detections each choice can be tried.
"""
from itertools import combinations

import numpy as np

from photutils_mgauss.motions.outliers import chi2_limit, measured_numbers
from photutils_mgauss.motions.stacked import dimensions_2x2

MOST = 8  # epochs, of which all choices are tried
LOST = 2  # detections of a star that are rejected together


def fewest_rejections(problem, clip, solve):
    """
    Return which detections (E, n) to reject, and what of it is certain.

    These are the fewest that leave detections which agree, and of several
    choices the one that leaves the smallest chi-square.

    Parameters
    ----------
    problem : `~photutils_mgauss.motions.problem.MotionProblem`
        Of n stars, with the weights of all their detections.
    clip : float
        The standard deviations beyond which detections do not agree.
    solve : callable
        Returns the `~photutils_mgauss.motions.joint.Estimates` of a problem.

    Returns
    -------
    bad : (E, n) bool `~numpy.ndarray`
    found : (n,) bool `~numpy.ndarray`
        Whether any choice leaves detections that agree.
    single : (n,) bool `~numpy.ndarray`
        Whether only one of that size does.
    """
    used = problem.weights[0] + problem.weights[2] > 0
    n_epochs, n = used.shape
    least, second = np.full((2, n), np.inf)
    bad, found = np.zeros((n_epochs, n), dtype=bool), np.zeros(n, dtype=bool)
    for size in range(LOST + 1):
        left = np.flatnonzero(~found)
        for drop in map(list, combinations(range(n_epochs), size)):
            stars = left[used[drop][:, left].all(axis=0)]
            if not len(stars):
                continue
            some = problem.select(stars)
            some.weights[:, drop] = 0.0
            chi2 = _chi2_if_agreed(some, clip, solve)
            better = chi2 < least[stars]
            second[stars] = np.minimum(second[stars], np.where(
                better, least[stars], chi2))
            stars, chi2 = stars[better], chi2[better]
            least[stars] = chi2
            bad[:, stars] = False
            bad[np.ix_(drop, stars)] = True
        found |= np.isfinite(least)
    return bad, found, found & ~np.isfinite(second)


def _chi2_if_agreed(problem, clip, solve):
    """Return chi-squares of stars (n,), infinite where detections disagree."""
    estimates = solve(problem, residuals=True, judge=True)
    numbers = measured_numbers(problem.weights)
    dof = numbers.sum(axis=0, dtype=int) + problem.ranks - problem.n_parameters
    each = chi2_limit(clip, dimensions_2x2(problem.weights))
    agreed = (dof > 0) & (estimates.total <= chi2_limit(clip, np.maximum(
        dof, 1))) & ~(estimates.chi2 > each).any(axis=0)
    return np.where(agreed, estimates.total, np.inf)
