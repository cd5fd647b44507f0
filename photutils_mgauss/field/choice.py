"""
Choice of degree and number of Gaussians by stars left out of the fit.

Candidates are fitted to all stars. From there each part of the stars in turn
is left out, the shapes are fitted to the others, and what they say of those
left out, whose positions and fluxes are fitted, is the score.
"""
import logging
import warnings

import numpy as np
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.field import stages
from photutils_mgauss.field.normal import equations, optimise

_LOG = logging.getLogger('photutils_mgauss')
DEGREES = (0, 1, 2, 3, 4, 5)
COMPONENTS = (2, 3, 4, 5, 6, 7)
# What is taken without a choice, and from how few to how many stars there is
# one by default: below there is nobody to ask, above it changes little.
_USUAL_COMPONENTS, _USUAL_DEGREE = 6, 4
_FEWEST_STARS, MANY_STARS = 8, 60
# While the number of Gaussians is chosen, the degree is at most this, and the
# brightest stars decide.
_DEGREE_FOR_COMPONENTS, _STARS_FOR_COMPONENTS = 2, 100
_FIRST_COMPONENTS = 5
# What many stars get where the usual number leaves more than this share of the
# light of a pixel unexplained, as strong aberrations do. It is the noise of
# 40,000 electrons: with less missing, the noise of all but the brightest
# stars' peaks is larger, and more Gaussians take more time for nothing.
_MORE_COMPONENTS, POOR = 8, 0.005
# From so many stars on, left-out ones decide between the two numbers instead:
# the noise of fewer hides what six Gaussians miss.
_HUNDREDS = 300
# The fit without some stars starts where the one with all of them ended. It
# must forget them: no damping.
_FOLD_STEPS, _FOLD_TOLERANCE, _FOLD_DAMPING = 4, 0.1, 1e-7
# A higher degree than the usual one is tried if the last step up has gained
# more than so many standard deviations. Hundreds of stars ask for more
# Gaussians if these gain that, and this much of a star's chi^2: what misses
# less moves no star by more than its own noise, and may be a poor start.
_CLEAR_GAIN, _LEAST_GAIN = 3.0, 1.0


def n_folds(n_stars):
    """Return into how many parts the stars are divided."""
    # Few stars are left out in smaller parts.
    return 3 if n_stars >= MANY_STARS else 5


def by_default(n_components, degree, n_stars):
    """Replace None by 'auto' where few stars have to decide."""
    few = _FEWEST_STARS <= n_stars < MANY_STARS
    usual = ('auto', 'auto') if few else (_USUAL_COMPONENTS, _USUAL_DEGREE)
    return (usual[0] if n_components is None else n_components,
            usual[1] if degree is None else degree)


def full_degree(degree):
    """Return the degree up to which there are terms if few stars chose one."""
    return max(degree + 1, _USUAL_DEGREE)


def run_with_enough_components(problem, degree, workers, *, strength=1.0,
                               reject=True):
    """
    Fit the usual number of Gaussians to many stars, or more if need be.

    Hundreds of stars decide by those left out, fewer by what the usual
    number misses. Either is known before that fit is finished.

    Parameters
    ----------
    problem : FieldProblem
    degree : int
    workers : Workers
    strength : float, optional
        Of the prior.
    reject : bool, optional
        Whether to drop deviant stars and pixels.

    Returns
    -------
    FieldFit
        Of more Gaussians only if these err less.
    """
    how = {'strength': strength, 'reject': reject}
    hundreds = problem.n_places >= _HUNDREDS
    fit = stages.run(problem, _USUAL_COMPONENTS, degree, workers,
                     poor=0.0 if hundreds else POOR, **how)
    if not hundreds and fit.accuracy < POOR:
        return fit
    workers.tell(f'{_MORE_COMPONENTS} Gaussians')
    more = stages.run(problem, _MORE_COMPONENTS, degree, workers,
                      course=stages.BRISK, poor=0.0, **how)
    if not (_describes_more(fit, more, workers) if hundreds
            else more.accuracy < fit.accuracy):
        return stages.finish(fit, workers, reject)
    _LOG.info('%d Gaussians miss %.1f %% of the light in bright pixels: '
              'the field has %d, which miss %.1f %%',
              _USUAL_COMPONENTS, 100 * fit.accuracy,
              _MORE_COMPONENTS, 100 * more.accuracy)
    return stages.finish(more, workers, reject, stages.BRISK)


def warn_of_few(field, refit, *, stacklevel):
    """
    Warn if fewer Gaussians than usual miss light that these would have.

    Parameters
    ----------
    field : MixtureField
    refit : callable
        ``refit(n)`` returns the field of n Gaussians from the same stars.
    stacklevel : int
        That of the warning.
    """
    n = field.n_components
    if n >= _USUAL_COMPONENTS or field.accuracy < POOR:
        return
    with warnings.catch_warnings():
        # The field has given those that concern the stars.
        warnings.simplefilter('ignore', AstropyUserWarning)
        more = refit(_USUAL_COMPONENTS)
    if field.accuracy - more.accuracy > POOR:
        warnings.warn(
            f'n_components={n} misses {field.accuracy:.1%} of the light in '
            f'the pixels of bright stars, n_components={more.n_components} '
            f'{more.accuracy:.1%}', AstropyUserWarning, stacklevel=stacklevel)


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
        stars for each set that was tried.
    """
    tried = QTable(names=('n_components', 'degree', 'regularization',
                          'reduced_chi2'), dtype=(int, int, float, float))
    top = min(_DEGREE_FOR_COMPONENTS,
              max_degree if degree == 'auto' else degree)
    few = _brightest(problem, _STARS_FOR_COMPONENTS)

    def score(number):
        return _score(few, number, top, strength, workers, tried)
    if n_components == 'auto':
        n_components = _climb(score, _FIRST_COMPONENTS, COMPONENTS)
    if degree == 'auto':
        degree = _best_degree(problem, n_components, max_degree, strength,
                              workers, tried)
    return n_components, degree, tried


def _brightest(problem, n_stars):
    return problem.subset(np.sort(problem.brightest()[:n_stars]))


def _climb(score, first, steps):
    """Return the step next to which none is better."""
    place = steps.index(first)
    lowest = score(first)
    for way in (1, -1):
        start = place
        while 0 <= place + way < len(steps):
            new = score(steps[place + way])
            # A star that one of the two describes is a fair one.
            before, after = _mean(np.array([lowest, new]))
            if after >= before:
                break
            place, lowest = place + way, new
        if place != start:
            break
    return steps[place]


def _score(problem, n_components, top, strength, workers, tried):
    """Return the chi^2 of each star for a number of Gaussians."""
    *_, last = stages.degrees(problem, n_components, top, strength, workers)
    chi2 = _left_out(last, workers)
    tried.add_row((n_components, top, strength, _mean(chi2[None])[0]))
    return chi2


def _best_degree(problem, n_components, top, strength, workers, tried):
    """Return the degree of the lowest score."""
    found = []
    for degree, fit in enumerate(stages.degrees(
            problem, n_components, top, strength, workers)):
        if degree > _USUAL_DEGREE and not _clear(*found[-2:]):
            break
        found.append(_left_out(fit, workers))
    scores = _mean(np.array(found))
    for degree, score in enumerate(scores):
        tried.add_row((n_components, degree, strength, score))
    return int(np.argmin(scores))


def _describes_more(before, after, workers):
    """Return whether a fit describes left-out stars better than another."""
    n_pixels = np.median(before.problem.stamps.good.sum(axis=(1, 2)))
    return _clear(*(_left_out(fit, workers) for fit in (before, after)),
                  _LEAST_GAIN / n_pixels)


def _clear(before, after, least=0.0):
    """Return whether the chi^2 of the stars has clearly become lower."""
    gain = (before - after)[_fair(np.array([before, after]))]
    error = gain.std() / np.sqrt(max(gain.size, 1))
    return gain.mean() > max(_CLEAR_GAIN * error, least)


def _mean(chi2):
    """Return the score of each candidate from its stars' (m, n)."""
    return chi2[:, _fair(chi2)].mean(axis=1)


def _fair(chi2):
    """Return which stars some candidate describes."""
    best = chi2.min(axis=0)
    return stages.not_deviant(best, np.ones(best.size, bool))


def _left_out(fit, workers):
    """
    Return the reduced chi^2 of every star when it is left out.

    All detections of a star are left out together, and count once.
    """
    stars, number = np.unique(fit.problem.star, return_inverse=True)
    folds = number % n_folds(stars.size)
    chi2 = np.empty(number.size)
    for fold in np.unique(folds):
        inside, outside = (fit.problem.subset(np.flatnonzero(rows))
                           for rows in (folds != fold, folds == fold))
        coefficients, _ = optimise(
            inside, fit.coefficients, fit.prior, workers,
            max_steps=_FOLD_STEPS, tolerance=_FOLD_TOLERANCE,
            damping=_FOLD_DAMPING)
        chi2[folds == fold] = _settled(outside, coefficients, workers)
    return np.array([np.median(chi2[number == i]) for i in range(stars.size)])


def _settled(problem, coefficients, workers):
    """Return the reduced chi^2 of stars whose own numbers are fitted."""
    stamps = problem.stamps
    problem.used = np.zeros(len(problem.basis), bool)
    # One variance for all candidates, not that of each one's model.
    variance = stamps.base + stamps.slope * np.maximum(stamps.data, 0)
    problem.weights = np.where(stamps.good, 1 / variance, 0)
    for _ in range(3):
        state = equations(problem, coefficients, workers)
        problem.sources, problem.sky = state.sources, state.sky
    return state.chi2 / stamps.good.sum(axis=(1, 2))
