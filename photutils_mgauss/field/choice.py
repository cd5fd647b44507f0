"""Choice of degree and number of Gaussians by stars left out of the fit."""
import numpy as np
from astropy.table import QTable

from photutils_mgauss.field import stages
from photutils_mgauss.field.normal import equations

N_FOLDS = 3
DEGREES = (0, 1, 2, 3, 4, 5)
COMPONENTS = (2, 3, 4, 5, 6, 7)
# While the number of Gaussians is chosen, the degree is at most this.
_DEGREE_FOR_COMPONENTS = 3


def choose(problem, n_components, degree, max_degree, strength, workers):
    """
    Replace 'auto' by what describes left-out stars best.

    Parameters
    ----------
    problem : FieldProblem
        With the terms of ``max_degree`` in its basis.
    n_components, degree : int or 'auto'
    max_degree : int
        The highest degree that the number of stars allows.
    strength : float
        Of the prior.
    workers : Workers

    Returns
    -------
    int, int, `~astropy.table.QTable`
        Number of Gaussians, degree, and the chi^2 per pixel of left-out
        stars for each pair that was tried.
    """
    tried = QTable(names=('n_components', 'degree', 'reduced_chi2'),
                   dtype=(int, int, float))
    if n_components == 'auto':
        top = (min(_DEGREE_FOR_COMPONENTS, max_degree) if degree == 'auto'
               else degree)
        scores = {k: _try(problem, k, top, strength, workers, tried)[top]
                  for k in COMPONENTS}
        n_components = min(scores, key=scores.get)
    if degree == 'auto':
        scores = _try(problem, n_components, max_degree, strength, workers,
                      tried)
        degree = min(scores, key=scores.get)
    return n_components, degree, tried


def _try(problem, n_components, top, strength, workers, tried):
    """Return the score of each degree up to the top one; note them."""
    chi2 = np.full((top + 1, len(problem.basis)), np.nan)
    for fold in range(N_FOLDS):
        out = np.arange(len(problem.basis)) % N_FOLDS == fold
        chi2[:, out] = _left_out(problem, out, n_components, top, strength,
                                 workers)
    # Stars that no degree describes say nothing about which is best.
    best = np.nanmin(chi2, axis=0)
    fair = stages.not_deviant(best, np.ones(best.size, bool))
    scores = dict(enumerate(chi2[:, fair].mean(axis=1)))
    for degree, score in scores.items():
        tried.add_row((n_components, degree, score))
    return scores


def _left_out(problem, out, n_components, top, strength, workers):
    """Return the reduced chi^2 of left-out stars for each degree."""
    inside, outside = (problem.subset(np.flatnonzero(rows))
                       for rows in (~out, out))
    outside.used = np.zeros(len(outside.basis), bool)
    stamps = outside.stamps
    # One variance for all candidates, not that of each one's model.
    variance = stamps.base + stamps.slope * np.maximum(stamps.data, 0)
    outside.weights = np.where(stamps.good, 1 / variance, 0)
    n_pixels = stamps.good.sum(axis=(1, 2))
    return [_settled(outside, coefficients, blurs, workers) / n_pixels
            for coefficients, blurs in stages.degrees(
                inside, n_components, top, strength, workers)]


def _settled(problem, coefficients, blurs, workers):
    """Return chi^2 of stars whose own numbers are fitted."""
    now = problem.subset(np.arange(len(problem.basis)))
    # The last exposures may have no star inside.
    now.local = np.pad(blurs, ((0, now.exposure.max() + 1), (0, 0)))[
        now.exposure]
    now.basis = np.ascontiguousarray(now.basis[:, :len(coefficients)])
    for _ in range(3):
        state = equations(now, coefficients, workers)
        now.sources, now.sky = state.sources, state.sky
    return state.chi2
