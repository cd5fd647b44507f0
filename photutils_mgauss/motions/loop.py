"""The loop behind `ProperMotionFitter`: solve, judge, reject, and again."""
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from astropy.table import QTable
from scipy.special import chdtri

from photutils_mgauss.motions.chip_maps import (
    chip_covariance,
    reduce_chips,
    without_chips,
)
from photutils_mgauss.motions.error_scale import fit_error_scales
from photutils_mgauss.motions.frames import (
    Frames,
    fixed_frames,
    solve_frames,
)
from photutils_mgauss.motions.joint import (
    Estimates,
    measured_ranks,
    parallax_leak,
    solve_all,
)
from photutils_mgauss.motions.outliers import (
    chi2_limit,
    judge_all,
    worst_outliers,
)
from photutils_mgauss.motions.perspective import swerved
from photutils_mgauss.motions.posing import (
    Kept,
    measured,
    pose,
    reduce_again,
)
from photutils_mgauss.motions.prepare import Setup, State
from photutils_mgauss.motions.priors import weak_priors
from photutils_mgauss.motions.relative import remove_mean_fields
from photutils_mgauss.motions.second_look import MOST, fewest_rejections
from photutils_mgauss.motions.stacked import (
    dimensions_2x2,
    invert_2x2,
    variance_2x2,
)
from photutils_mgauss.motions.terms import Terms, chosen_terms, terms_table

CONVERGED = 1e-3  # of the median error of a detection
MAX_ITERATIONS = 40
WEAK = 1e4  # errors of a detection [per yr]: a prior that says nothing
SIGNIFICANT = 2.0  # standard deviations that call for a floor
FEW, MANY = 10, 0.25  # detections of a star, and their part, to be rejected


@dataclass(frozen=True, eq=False)
class Fit:
    """
    The last iteration, finished.

    Parameters
    ----------
    setup : `~photutils_mgauss.motions.prepare.Setup`
    state : `State`
    pose_again : callable
        Returns the `~photutils_mgauss.motions.problem.MotionProblem` that
        was solved: as large as all that was measured, it is made whenever it
        is asked for.
    frames : `~photutils_mgauss.motions.frames.Frames`
    estimates : `~photutils_mgauss.motions.joint.Estimates`
        Without residuals.
    rms : (E, 2) `~numpy.ndarray`
        Of the residuals of the references, NaN where there are none.
    chi2 : (n,) `~numpy.ndarray`
        Of the detections of each star and of what was known of it.
    ranks : (n,) int `~numpy.ndarray`
        Number of parameters of each star that were known beforehand.
    leak : tuple or None
        What parallaxes that are not fitted do to motions, see
        `~photutils_mgauss.motions.joint.parallax_leak`.
    """

    setup: Setup
    state: State
    pose_again: object
    frames: Frames
    estimates: Estimates
    rms: np.ndarray
    chi2: np.ndarray
    ranks: np.ndarray
    leak: tuple | None

    @property
    def problem(self):
        """The `~photutils_mgauss.motions.problem.MotionProblem` solved."""
        return self.pose_again()

    @property
    def n_parameters(self):
        """Number of parameters of a star."""
        return self.setup.options.n_star_parameters

    @property
    def n_stars(self):
        """Number of stars."""
        return self.setup.origin.shape[1]

    @property
    def dof(self):
        """Measured and known numbers of each star less parameters, (n,)."""
        count = self.ranks - self.n_parameters
        covariance = self.setup.sightings.covariance
        for e, used in enumerate(self.state.used):
            count = count + dimensions_2x2(covariance[:, e]) * used
        return count


def finished(setup, state, problem, frames, estimates, pose_again):
    """Return the `Fit` with these `last_estimates` of its stars."""
    observer, leak = setup.sightings.observer, None
    if observer is not None and not setup.options.parallax:
        leak = parallax_leak(replace(problem, observer=observer),
                             setup.options.executor)
    rms = _reference_rms(setup, state, estimates.residuals)
    return Fit(setup, state, pose_again, frames,
               replace(estimates, residuals=None), rms, estimates.total,
               problem.ranks, leak)


def references_in_use(setup, state):
    """Return which stars (n,) say where the frames are."""
    stars = setup.anchors.copy()
    stars[state.dropped] = False
    return stars


def last_estimates(setup, state, problem, frames):
    """Return the `Estimates`, with residuals of the references in use."""
    return solve(setup, problem, frames, residuals=True, residuals_of=(
        np.flatnonzero(references_in_use(setup, state))))


def _reference_rms(setup, state, residuals):
    """Return the rms (E, 2) of the residuals of the references in use."""
    used = state.used[:, references_in_use(setup, state)]
    used &= np.isfinite(residuals).all(axis=0)
    return np.array([
        np.sqrt(np.mean(residuals[:, e, own]**2, axis=1))
        if own.any() else [np.nan, np.nan] for e, own in enumerate(used)])


def _step(setup, state, kept):
    """
    Solve for the frames once; return problem, frames and new maps.

    And the equations of the frames, which with the weights serve the next
    step as `Kept`: only offsets change with the maps.
    """
    problem, back, reduced = pose(setup, state, kept), None, None
    if setup.transform.n_parameters == 0:
        frames = fixed_frames(problem)
    else:
        reduced = found = reduce_again(problem, kept, setup.options.executor)
        if setup.distortion is not None:
            found, back = without_chips(reduced, reduce_chips(
                problem, setup.distortion, state.distortion))
        frames = solve_frames(problem, found, relative=setup.relative)
    if back is not None:
        change = back(frames.correction).reshape(state.distortion.shape)
        state = replace(state, distortion=state.distortion + change)
    maps = np.stack([setup.transform.project(one)
                     for one in state.maps + frames.correction])
    swerve = state.swerve
    if len(setup.nearing.stars):
        found = solve(setup, problem.select(setup.nearing.stars), frames)
        swerve = swerved(setup, swerve, found.values)
    return problem, frames, replace(state, maps=maps, swerve=swerve), reduced


def _align(setup, state, kept=None):
    """
    Iterate until the maps stand still; return problem, frames, and state.

    And what is `Kept` for the next state.
    """
    before, typical = np.inf, np.sqrt(setup.sightings.typical_variance)
    for i in range(MAX_ITERATIONS):
        problem = frames = None  # as large as all that was measured
        problem, frames, after, reduced = _step(setup, state, kept)
        kept = Kept(problem.weights, reduced)
        # In units of a typical error.
        size = np.abs(frames.correction).sum(axis=2).max(initial=0) / typical
        turned = np.abs(after.swerve - state.swerve).max(initial=0) / typical
        state = replace(after, posed=replace(state, posed=None))
        if size < CONVERGED and turned < CONVERGED:
            break
        if i > 5 and not size < before:
            msg = ('epochs must agree on which star is which, got frames '
                   f'that still differ by {size:.1g} standard errors: are '
                   'the identifiers those of the same stars?')
            raise ValueError(msg)
        before = size
    return problem, frames, state, kept


def fit(setup, state):
    """Return the `Fit` of a setup: align, reject, estimate the floors."""
    if setup.terms is not None:
        setup, state = _with_terms(setup, state)
    problem, frames, state, kept = _cleaned(setup, state)
    after = _looked_again(setup, state, frames)
    if after is not state:
        problem = None
        problem, frames, state, kept = _align(setup, after)
    rounds = 12 if setup.options.scales_errors else 4
    for i in range(rounds * setup.options.fits_floor):
        after = _systematics(setup, state, problem, frames, anew=i == 0)
        still = not _moved(setup, state, after, 0.02)
        kept = kept and kept.without_changes(problem, state, after)
        problem = frames = None
        problem, frames, state, kept = _align(setup, after, kept)
        if still:
            break
    estimates = last_estimates(setup, state, problem, frames)
    if setup.relative and setup.transform.kind != 'none':
        estimates, common = remove_mean_fields(problem, frames, estimates,
                                               setup.options)
        state = replace(state, maps=state.maps - common)
    return finished(setup, state, problem, frames, estimates,
                    partial(pose, setup, state.posed))


def _with_terms(setup, state):
    """Return setup and state with the terms that are real, to begin with."""
    problem, _, after, _ = _cleaned(setup, state)
    kinds = chosen_terms(problem, setup.terms, setup.options.executor)
    if not kinds:
        return replace(setup, terms=None), state
    terms = setup.terms.only(kinds)
    return replace(setup, terms=None, distortion=terms), replace(
        state, maps=after.maps, floor=after.floor, distortion=terms.none())


def _cleaned(setup, state):
    """Return what `_align` does, with all outliers rejected."""
    kept = None
    for _ in range(MAX_ITERATIONS):
        problem = frames = None
        problem, frames, state, kept = _align(setup, state, kept)
        if setup.options.clip is None:
            break
        before = state
        state, changed = _review(setup, state, problem, frames)
        if not changed:
            break
        kept = kept.without_changes(problem, before, state)
    else:
        kept, state = None, replace(state, unfinished=True)
    return problem, frames, state, kept


def _looked_again(setup, state, frames):
    """
    Return the state with the fewest detections rejected.

    Where several choices are as good, the star is not to be trusted.
    """
    usable, clip = setup.sightings.usable, setup.options.clip
    stars = np.flatnonzero((usable & ~state.used).any(axis=0)
                           & ~state.crooked)
    if clip is None or not len(stars) or setup.sightings.kept.sum() > MOST:
        return state
    used, untied = state.used.copy(), state.untied.copy()
    used[:, stars] = usable[:, stars]
    problem = pose(setup, replace(state.posed, used=used)).select(stars)
    bad, found, single = fewest_rejections(problem, clip, partial(
        _solve_in, setup, frames))
    used[:, stars] = np.where(found, used[:, stars] & ~bad,
                              state.used[:, stars])
    doubtful = stars[found & ~single]
    untied[doubtful] |= ~setup.anchors[doubtful] | setup.relative
    return replace(state, used=used, untied=untied)


def _solve_in(setup, frames, problem, **wanted):
    return solve(setup, problem, frames, **wanted)


def fitted_terms(result):
    """Return the table of the terms of a `Fit`."""
    setup, terms = result.setup, result.setup.distortion
    if not isinstance(terms, Terms):
        return QTable(names=('epoch', 'term', 'dx', 'dy'),
                      dtype=(int, 'U9', float, float))
    coefficients = result.state.distortion
    chips = reduce_chips(result.problem, terms, coefficients)
    return terms_table(terms, coefficients, chip_covariance(
        chips, result.frames.factor), setup.sightings.epoch_years)


def measured_alone(result):
    """Return a `Fit` without priors, in the same frames."""
    if result.setup.relative:
        return result
    problem = result.problem.unbound
    estimates = last_estimates(result.setup, result.state, problem,
                               result.frames)
    return finished(result.setup, result.state, problem, result.frames,
                    estimates, lambda: result.problem.unbound)


def solve(setup, problem, frames, **wanted):
    """Return the `Estimates` of the stars of a problem in given frames."""
    return solve_all(problem, frames.correction, frames.factor,
                     setup.options.executor, **wanted)


def _review(setup, state, problem, frames):
    """Return the state without outliers, and whether anything changed."""
    if setup.options.fits_floor:
        after = _systematics(setup, state, problem, frames, robust=True)
        if _moved(setup, state, after, 0.1):
            # Residuals are judged once the floors are right: a floor that
            # is too small would make outliers of all bright stars.
            return after, True
    dropped = _discrepant(setup, problem, frames)
    if len(dropped):
        return replace(state, dropped=np.union1d(state.dropped,
                                                 dropped)), True
    judged = judge_all(problem, frames, setup.options.clip,
                       setup.options.executor)
    bad = worst_outliers(judged, setup.options.clip)
    bad[:, state.crooked[judged.stars]] = False
    if bad.any():
        return _rejected(setup, state, judged.stars, bad), True
    untied = state.untied | _inconsistent(setup, problem, judged)
    return replace(state, untied=untied), bool(
        (untied & ~state.untied).any())


def _rejected(setup, state, stars, bad):
    """
    Return the state without bad detections (E, k) of k stars.

    Where there are many, it is the star that does not move straight, and
    what would be left of them is no better than what was rejected.
    """
    usable = setup.sightings.usable[:, stars]
    left = state.used[:, stars] & ~bad
    lost = (usable & ~left).sum(axis=0)
    crooked = bad.any(axis=0) & (lost > FEW) & (
        lost > MANY * usable.sum(axis=0))
    used, untied, odd = (array.copy() for array in (
        state.used, state.untied, state.crooked))
    used[:, stars] = np.where(crooked, usable, left)
    untied[stars] |= crooked
    odd[stars] |= crooked
    return replace(state, used=used, untied=untied, crooked=odd)


def _inconsistent(setup, problem, judged):
    """Return stars (n,) that no more rejections can make agree."""
    dof = np.maximum(judged.count - problem.n_parameters, 0)
    # Stars are many, and numbers of degrees of freedom few.
    limits = chi2_limit(setup.options.clip, np.arange(dof.max() + 1))
    out = (dof > 0) & (judged.raw > limits[dof])
    # References agree with their catalogue, or are none any more.
    out[problem.priors.stars] &= ~setup.anchors[problem.priors.stars] | (
        setup.relative)
    return out


def _discrepant(setup, problem, frames):
    """
    Return references whose catalogue values the data contradict.

    The test is the rise of a star's chi-square when it has to agree with
    the catalogue, which a mistaken identity or motion makes large however
    well the star's own detections agree.
    """
    stars = problem.priors.stars[setup.anchors[problem.priors.stars]]
    if setup.relative or len(stars) <= setup.transform.n_references:
        return np.empty(0, dtype=int)
    alone = problem.select(stars)
    bound, free = (
        solve(setup, one, frames, residuals=True).total
        for one in (alone, alone.unbound))
    open_ = ~np.isfinite(free)
    tested = alone.ranks
    if open_.any():
        free[open_], missing = _barely_known(setup, alone, frames, open_)
        tested[open_] -= np.minimum(missing, tested[open_])
    rise = bound - free
    limit = chi2_limit(setup.options.clip, tested)
    worst = np.nan_to_num(np.divide(rise, limit, where=limit > 0,
                                    out=np.zeros_like(rise)), nan=0.0)
    # A few at a time: one bad reference pulls the frame from the others.
    most = max(1, len(stars) // 20)
    chosen = np.argsort(worst)[::-1][:most]
    return stars[chosen[worst[chosen] > 1]]


def _barely_known(setup, problem, frames, which):
    """
    Return chi-squares of stars whose detections do not suffice alone.

    They are those of the best parameters of all, which a prior finds that is
    too weak to count; and the number of parameters left open.
    """
    some = problem.unbound.select(np.flatnonzero(which))
    missing = some.n_parameters - measured_ranks(some)
    sigma = WEAK * np.sqrt(setup.sightings.typical_variance)
    weak = replace(some, priors=weak_priors(some.n_stars, some.n_parameters,
                                            sigma))
    return solve(setup, weak, frames, residuals=True).total, missing


def _moved(setup, state, after, part):
    """Return whether errors have changed by more than a part of them."""
    if after.scales is None:
        return (np.abs(after.floor - state.floor) > part * state.floor + (
            part / 10) * setup.sightings.typical_variance).any()
    used = state.used
    change = [np.log(variance_2x2(measured(setup, after, e)[:, used[e]])
                     / variance_2x2(measured(setup, state, e)[:, used[e]]))
              for e in range(len(used)) if used[e].any()]
    return np.abs(np.concatenate(change)).mean() > part / 2


def _systematics(setup, state, problem, frames, *, robust=False,
                 anew=False):
    """
    Return the state with the errors that residuals say.

    Those of the references, or for functions of magnitude of all stars.
    With ``anew`` the number of nodes of these is chosen again.
    """
    anchors = setup.anchors | setup.options.scales_errors
    stars = np.flatnonzero(problem.ties & anchors
                           & ~np.isin(np.arange(problem.n_stars),
                                      state.dropped))
    if not len(stars):
        return state
    estimates = solve(setup, problem.select(stars), frames, residuals=True,
                      judge=True)
    covariance = setup.sightings.covariance[..., stars]
    residuals = np.where(state.used[:, stars], estimates.residuals, np.nan)
    epochs = range(len(state.maps))
    if not setup.options.scales_errors:
        return replace(state, floor=np.array([floor_variance(
            residuals[:, e], covariance[:, e], estimates.expected[e],
            state.floor[e], robust=robust) for e in epochs]))
    scales = fit_error_scales(
        setup.magnitudes[:, stars], residuals, covariance,
        estimates.expected, robust=robust,
        like=None if anew else state.scales)
    factor, added = scales.at(setup.magnitudes)
    return replace(state, scales=scales, factor=factor, added=added,
                   floor=np.median(added, axis=1))


def floor_variance(residuals, covariance, expected, floor, *,
                   robust=False):
    r"""
    Return the variance per axis that makes one epoch's chi-square expected.

    Parameters
    ----------
    residuals : (2, n) `~numpy.ndarray`
    covariance : (3, n) `~numpy.ndarray`
        Covariances of the measurements without the floor.
    expected : (n,) `~numpy.ndarray`
        Expected chi-square of each, 2 minus its leverage, or 1 for a
        measurement in one direction.
    floor : float
        The present variance.
    robust : bool, optional
        Make the median of the chi-squares the expected one instead of their
        sum, for data with outliers.

    Notes
    -----
    Solves :math:`\sum r^T (\Sigma + s I)^{-1} r = \sum (2 - h)` for s by
    bisection in a safe bracket; 0 where the errors explain the residuals.
    """
    good = np.isfinite(residuals).all(axis=0) & np.isfinite(expected)
    good &= expected > 0.1
    residuals, covariance = residuals[:, good], covariance[:, good]
    expected = expected[good]
    # Medians of chi-squares of one and two degrees of freedom.
    middle = np.where(dimensions_2x2(covariance) == 1, chdtri(1, 0.5),
                      np.log(2))
    if expected.sum() < 4:
        return 0.0

    def excess(variance):
        xx, xy, yy = covariance
        a, b, c = invert_2x2(xx + variance, xy, yy + variance)
        x, y = residuals
        chi2 = a * x * x + 2 * b * x * y + c * y * y
        if robust:
            return np.log(2) * (np.median(chi2 / (expected * middle)) - 1)
        return chi2.sum() - expected.sum()
    # An excess that good errors alone would show every twentieth time is
    # not worth a floor, which would only make all errors too large.
    noise = (1 / np.sqrt(len(expected)) if robust
             else np.sqrt(2 * expected.sum()))
    low, high = 0.0, max(floor, np.max(residuals**2), 1e-30)
    if excess(0.0) <= SIGNIFICANT * noise:
        return 0.0
    for _ in range(60):
        half = (low + high) / 2
        low, high = (half, high) if excess(half) > 0 else (low, half)
    return (low + high) / 2
