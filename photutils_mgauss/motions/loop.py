"""The loop behind `ProperMotionFitter`: solve, judge, reject, and again."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.motions.frames import (
    Frames,
    Gauge,
    chi2_limit,
    floor_variance,
    solve_frames,
    worst_outliers,
)
from photutils_mgauss.motions.joint import (
    Estimates,
    Priors,
    Problem,
    reduce_all,
    solve_all,
)
from photutils_mgauss.motions.references import build_priors, perspective
from photutils_mgauss.motions.relative import (
    Family,
    mean_weights,
    remove_mean_field,
)
from photutils_mgauss.motions.stacked import invert_2x2

CONVERGED = 1e-3  # of the median error of a detection
MAX_ITERATIONS = 40


@dataclass(frozen=True, eq=False)
class Options:
    """What the fitter was asked for, checked; see `ProperMotionFitter`."""

    transform: object
    recipe: str
    parallax: object
    parallax_prior: tuple
    acceleration: bool
    systematic: object
    clip: float | None
    max_motion: float
    hold_out: float
    rng: object
    executor: object


@dataclass(frozen=True, eq=False)
class Scene:
    """
    Everything that stays the same while the fit iterates.

    ``priors`` are those of all references in use, ``anchors`` (n,) marks the
    references, ``relative`` says that there are none and all stars are.
    """

    sightings: object
    options: Options
    transform: object
    origin: np.ndarray
    working_year: float
    dt: np.ndarray
    observer: np.ndarray | None
    priors: Priors
    anchors: np.ndarray
    held: np.ndarray
    relative: bool
    drift: np.ndarray | None


@dataclass(frozen=True, eq=False)
class State:
    """
    What changes from one iteration to the next.

    ``maps`` (E, 2, b), ``used`` (E, n), ``floor`` (E,) variances per axis,
    ``dropped`` (k,) stars that are references no longer, ``untied`` (n,)
    stars whose detections disagree too much to find the frames with.
    """

    maps: np.ndarray
    used: np.ndarray
    floor: np.ndarray
    dropped: np.ndarray
    untied: np.ndarray


@dataclass(frozen=True, eq=False)
class Fit:
    """The last iteration: its problem, frames and estimates."""

    scene: Scene
    state: State
    problem: Problem
    frames: Frames
    estimates: Estimates


def n_star_parameters(options):
    """Return the number of parameters of a star."""
    return 4 + bool(options.parallax) + 2 * options.acceleration


def prepare(sightings, epochs, options):
    """Return the `Scene` and the first `State`."""
    years = sightings.years
    working = float(np.nanmean(sightings.epoch_years))
    dt = years - working
    count = np.isfinite(sightings.places[0]).sum(axis=0)
    with np.errstate(invalid='ignore'):
        origin = (np.nansum(sightings.places, axis=1)
                  / np.where(count, count, np.nan))
    transform = options.transform.fitted_to(origin)
    observer = (sightings.observers(epochs)
                if sightings.plane is not None else None)
    _check_parallax(options, observer)
    origin = np.where(np.isfinite(origin), origin,
                      np.reshape(transform.centre, (2, 1)))
    scene = Scene(sightings, options, transform, origin, working,
                  np.nan_to_num(dt), observer, None, None, None, False,
                  None)
    scene = _with_references(scene)
    untied = _scattered(scene)
    _check_references(scene, untied)
    maps = np.repeat(transform.identity()[None], len(dt), axis=0)
    return scene, State(maps, sightings.usable.copy(), _first_floor(scene),
                        np.empty(0, dtype=int), untied)


def _scattered(scene):
    """
    Return stars (n,) whose places are too far apart to be one star.

    Identifiers may be wrong, and one such star would outweigh all others.
    """
    places = np.where(scene.sightings.usable, scene.sightings.places, np.nan)
    count = scene.sightings.usable.sum(axis=0)
    many = np.flatnonzero(count > 1)
    spread = np.zeros(len(count))
    spread[many] = (np.nanmax(places[..., many], axis=1)
                    - np.nanmin(places[..., many], axis=1)).max(axis=0)
    typical = spread[scene.anchors & (count > 1)]
    limit = 30 * np.median(typical) if len(typical) else 0.0
    baseline = np.ptp(scene.sightings.epoch_years)
    scattered = spread > max(limit, scene.options.max_motion * baseline)
    return scattered | ~scene.sightings.agreed


def _check_parallax(options, observer):
    if options.parallax and options.recipe == 'paper':
        msg = ("parallax must be False for the recipe 'paper', got "
               f'{options.parallax!r}')
        raise ValueError(msg)
    if options.parallax and observer is None:
        msg = ('parallax must be False for epochs without a place in the '
               f'sky, got {options.parallax!r}')
        raise ValueError(msg)


def _with_references(scene):
    """Add priors, held-out references and known small displacements."""
    sightings, options = scene.sightings, scene.options
    n = len(sightings.names)
    seen = sightings.references >= 0
    stars = sightings.references[seen]
    held = _hold_out(stars, options)
    anchors = np.zeros(n, dtype=bool)
    catalogue = _select(sightings.catalogue, seen, len(stars))
    anchors[stars[catalogue.kinds != 'position']] = True
    anchors[held] = False
    use = ~np.isin(stars, held)
    priors = build_priors(_select(catalogue, use, use.sum()), stars[use],
                          scene.origin[:, stars[use]], scene.working_year,
                          sightings.unit, n_star_parameters(options))
    priors = _add_parallax_prior(priors, scene)
    relative = not anchors.any()
    if relative:
        anchors = np.ones(n, dtype=bool)
    return replace(scene, priors=priors, anchors=anchors, held=held,
                   relative=relative, drift=_drift(scene, catalogue, stars))


def _select(catalogue, which, n):
    """Return part of a catalogue; references by name are all quasars."""
    if catalogue is None:
        from photutils_mgauss.motions.references import UNKNOWN, Catalogue
        return Catalogue(None, np.full(n, 'qso'), np.full((5, n), np.nan),
                         np.repeat(UNKNOWN * np.eye(5)[..., None], n, axis=2),
                         np.full(n, np.nan), np.full(n, np.nan))
    return replace(
        catalogue, ids=None, kinds=catalogue.kinds[which],
        values=catalogue.values[:, which],
        covariance=catalogue.covariance[..., which],
        year=catalogue.year[which],
        radial_velocity=catalogue.radial_velocity[which])


def _hold_out(stars, options):
    n = round(options.hold_out * len(stars))
    if n == 0:
        return np.empty(0, dtype=int)
    rng = np.random.default_rng(options.rng)
    return np.sort(rng.choice(stars, n, replace=False))


def _add_parallax_prior(priors, scene):
    """Give stars of unknown parallax the one expected of them."""
    if scene.options.parallax != 'prior':
        return priors
    mean, sigma = scene.options.parallax_prior
    n, p = scene.origin.shape[1], n_star_parameters(scene.options)
    precision, moment = np.zeros((p, p, n)), np.zeros((p, n))
    constant = np.zeros(n)
    precision[..., priors.stars] = priors.precision
    moment[:, priors.stars] = priors.moment
    constant[priors.stars] = priors.constant
    free = precision[4, 4] == 0
    precision[4, 4, free] = sigma**-2
    moment[4, free] = mean / sigma**2
    constant[free] += mean**2 / sigma**2
    return Priors(np.arange(n), precision, moment, constant)


def _drift(scene, catalogue, stars):
    """
    Return displacements (2, E, k) of references beyond the model, or None.

    Known parallaxes where none are fitted, and perspective acceleration.
    """
    out = perspective(catalogue)[:, None, :]
    dt = scene.dt if scene.dt.shape[1] == 1 else scene.dt[:, stars]
    out = out * dt**2 / 2
    parallax = np.nan_to_num(catalogue.values[4])
    if scene.observer is not None and not scene.options.parallax:
        observer = scene.observer
        if observer.shape[2] > 1:
            observer = observer[..., stars]
        out = out + parallax * scene.sightings.plane.parallax_factors(
            scene.origin[:, None, stars], observer)
    return (stars, out) if np.any(out) else None


def _first_floor(scene):
    n_epochs = len(scene.sightings.epoch_years)
    if isinstance(scene.options.systematic, str):
        return np.zeros(n_epochs)
    floor = np.asarray(scene.options.systematic, dtype=float)
    if floor.shape not in ((), (n_epochs,)):
        msg = (f'systematic must be one value or one per epoch '
               f'({n_epochs}), got shape {floor.shape}')
        raise ValueError(msg)
    return np.broadcast_to(floor**2, n_epochs).copy()


def _check_references(scene, untied):
    """Raise where an epoch has fewer references than its map needs."""
    need = scene.transform.n_references
    if scene.transform.kind == 'none':
        return
    usable = scene.sightings.usable & scene.anchors & ~untied
    if scene.relative:
        usable = usable & (usable.sum(axis=0) > 1)
    counts = usable.sum(axis=1)
    if (counts < need).any():
        e = int(np.argmin(counts))
        what = ('stars in common with other epochs' if scene.relative
                else 'reference objects')
        if (untied & scene.anchors).any():
            what += ' whose places agree'
        msg = (f'epoch {e} must have at least {need} {what} for the '
               f'transform {scene.transform.kind!r}, got {counts[e]}')
        raise ValueError(msg)


def build_problem(scene, state):
    """Return the `Problem` of the present maps, masks and floors."""
    sightings, transform = scene.sightings, scene.transform
    offsets = np.empty_like(sightings.places)
    weights = np.empty_like(sightings.covariance)
    for e, coefficients in enumerate(state.maps):
        aligned = transform.apply(coefficients, sightings.places[:, e])
        offsets[:, e] = aligned - scene.origin
        weights[:, e] = np.where(
            state.used[e], invert_2x2(*measured(scene, state, e)), 0.0)
    if scene.drift is not None:
        stars, drift = scene.drift
        offsets[..., stars] -= drift
    np.nan_to_num(offsets, copy=False)
    priors = scene.priors.without(state.dropped)
    return Problem(
        offsets, weights, scene.origin, scene.dt,
        scene.observer if scene.options.parallax else None,
        sightings.plane, transform, priors, scene.options.acceleration,
        _ties(scene, state))


def measured(scene, state, e):
    """Return the covariances (3, n) of an epoch with its floor."""
    floor = np.broadcast_to(state.floor.T, (2, len(state.maps)))[:, e]
    xx, xy, yy = scene.sightings.covariance[:, e]
    return np.stack([xx + floor[0], xy, yy + floor[1]])


def _ties(scene, state):
    """Return which stars take part in finding the frames."""
    if scene.options.recipe == 'joint' or scene.relative:
        return ~state.untied
    ties = scene.anchors & ~state.untied
    ties[state.dropped] = False
    return ties


def gauge_of(scene):
    """Return the `Gauge` of a scene's frames."""
    dt = scene.dt.mean(axis=1)
    factors = None
    if scene.options.parallax:
        observer = scene.observer.mean(axis=2)
        factors = scene.sightings.plane.parallax_factors(
            np.array(scene.transform.centre)[:, None], observer)
    return Gauge.of(scene.transform, dt, factors, scene.options.acceleration)


def step(scene, state):
    """Solve for the frames once; return problem, frames and new maps."""
    problem = build_problem(scene, state)
    reduced = reduce_all(problem, scene.options.executor)
    frames = solve_frames(reduced, scene.transform, gauge_of(scene),
                          relative=scene.relative)
    maps = np.stack([scene.transform.project(one)
                     for one in state.maps + frames.correction])
    return problem, frames, replace(state, maps=maps)


def change(scene, frames):
    """Return the largest change of a map in units of a typical error."""
    size = np.abs(frames.correction).sum(axis=2).max(initial=0.0)
    variance = scene.sightings.covariance[0][scene.sightings.usable]
    if variance.size == 0:
        return 0.0
    return size / np.sqrt(np.median(variance))


def align(scene, state):
    """Iterate until the maps stand still."""
    before = np.inf
    for i in range(MAX_ITERATIONS):
        problem, frames, state = step(scene, state)
        size = change(scene, frames)
        if size < CONVERGED:
            break
        if i > 5 and not size < before:
            msg = ('epochs must agree on which star is which, got frames '
                   f'that still differ by {size:.1g} standard errors: are '
                   'the identifiers those of the same stars?')
            raise ValueError(msg)
        before = size
    return problem, frames, state


def fit(scene, state):
    """Return the `Fit` of a scene: align, reject, estimate the floors."""
    fits_floor = scene.options.systematic == 'fit' if isinstance(
        scene.options.systematic, str) else False
    for _ in range(MAX_ITERATIONS):
        problem, frames, state = align(scene, state)
        if scene.options.clip is None:
            break
        state, changed = _review(scene, state, problem, frames, fits_floor)
        if not changed:
            break
    for _ in range(4 * fits_floor):
        floor = _floors(scene, state, problem, frames, _sum_floor)
        still = np.allclose(floor, state.floor, rtol=0.02,
                            atol=1e-3 * _typical(scene))
        state = replace(state, floor=floor)
        problem, frames, state = align(scene, state)
        if still:
            break
    estimates = solve_all(problem, frames.correction, frames.factor,
                          scene.options.executor, residuals=True)
    if scene.relative and scene.transform.kind != 'none':
        state, estimates = _relative(scene, state, problem, frames,
                                     estimates)
    return Fit(scene, state, problem, frames, estimates)


def families(scene):
    """Return the common fields that stars without references may have."""
    generators, dt = scene.transform.generators, scene.dt.mean(axis=1)
    out = [Family((2, 3), generators, np.multiply.outer(dt, generators))]
    if scene.options.acceleration:
        p = n_star_parameters(scene.options)
        out.append(Family((p - 2, p - 1), generators,
                          np.multiply.outer(dt**2 / 2, generators)))
    if scene.options.parallax is True:
        family = gauge_of(scene).parallaxes
        b, m = scene.transform.n_terms, family.shape[1]
        if m:
            out.append(Family((4,), np.eye(b)[:, :m],
                              family.reshape(len(dt), 2 * b, m)))
    return out


def _relative(scene, state, problem, frames, estimates):
    """Return state and estimates with the stars' mean fields at zero."""
    maps = state.maps
    for family in families(scene):
        weights = mean_weights(estimates.values, estimates.covariance,
                               list(family.rows), problem.ties)
        estimates, field = remove_mean_field(
            problem, frames, estimates, family, weights,
            scene.options.executor)
        maps = maps - (family.drifts @ field).reshape(maps.shape)
    return replace(state, maps=maps), estimates


def _typical(scene):
    variance = scene.sightings.covariance[0][scene.sightings.usable]
    return np.median(variance) if variance.size else 1.0


def _review(scene, state, problem, frames, fits_floor):
    """Return the state without outliers, and whether anything changed."""
    if fits_floor:
        floor = _floors(scene, state, problem, frames, _median_floor)
        moved = np.abs(floor - state.floor) > (0.1 * state.floor
                                               + 0.01 * _typical(scene))
        if moved.any():
            # Residuals are judged once the floors are right: a floor that
            # is too small would make outliers of all bright stars.
            return replace(state, floor=floor), True
    estimates = solve_all(problem, frames.correction, frames.factor,
                          scene.options.executor, judge=True)
    dropped = _discrepant(scene, problem, frames)
    if len(dropped):
        return replace(state, dropped=np.union1d(state.dropped,
                                                 dropped)), True
    bad = worst_outliers(estimates.chi2, state.used, _spare(problem, state),
                         scene.options.clip)
    if bad.any():
        return replace(state, used=state.used & ~bad), True
    untied = state.untied | _inconsistent(scene, problem, estimates)
    return replace(state, untied=untied), bool(
        (untied & ~state.untied).any())


def _inconsistent(scene, problem, estimates):
    """Return stars (n,) that no more rejections can make agree."""
    dof = 2 * (problem.weights[0] > 0).sum(axis=0) - problem.n_parameters
    chi2 = np.nansum(estimates.raw, axis=0)
    out = (dof > 0) & (chi2 > chi2_limit(scene.options.clip,
                                         np.maximum(dof, 1)))
    # References agree with their catalogue, or are none any more.
    out[problem.priors.stars] &= ~scene.anchors[problem.priors.stars] | (
        scene.relative)
    return out


def _spare(problem, state):
    """Return the stars that can lose a detection and still be judged."""
    count = 2 * state.used.sum(axis=0)
    rank = np.zeros(count.shape, dtype=int)
    rank[problem.priors.stars] = prior_rank(problem.priors)
    return count + rank - 2 >= problem.n_parameters + 2


def prior_rank(priors):
    """Return the number of parameters (k,) each prior knows."""
    return np.linalg.matrix_rank(np.moveaxis(priors.precision, 2, 0),
                                 hermitian=True)


def _discrepant(scene, problem, frames):
    """
    Return references whose catalogue values the data contradict.

    The test is the rise of a star's chi-square when it has to agree with
    the catalogue, which a mistaken identity or motion makes large however
    well the star's own detections agree.
    """
    stars = problem.priors.stars[scene.anchors[problem.priors.stars]]
    if scene.relative or len(stars) <= scene.transform.n_references:
        return np.empty(0, dtype=int)
    alone = problem.select(stars)
    free = replace(alone, priors=Priors.none(problem.n_parameters))
    without = solve_all(free, frames.correction, frames.factor, None,
                        residuals=True)
    with_it = solve_all(alone, frames.correction, frames.factor, None,
                        residuals=True)
    bound = data_chi2(with_it, alone) + alone.priors.chi2(with_it.values)
    rise = bound - data_chi2(without, free)
    limit = chi2_limit(scene.options.clip, prior_rank(alone.priors))
    worst = np.nan_to_num(rise / limit, nan=0.0)
    # A few at a time: one bad reference pulls the frame from the others.
    most = max(1, len(stars) // 20)
    chosen = np.argsort(worst)[::-1][:most]
    return stars[chosen[worst[chosen] > 1]]


def data_chi2(estimates, problem):
    """Return the chi-square (n,) of the detections of each star."""
    x, y = estimates.residuals
    xx, xy, yy = problem.weights
    return np.sum(xx * x * x + 2 * xy * x * y + yy * y * y, axis=0)


def _floors(scene, state, problem, frames, estimate):
    """Return the floor variances (E,) from the references' residuals."""
    stars = np.flatnonzero(problem.ties & scene.anchors
                           & ~np.isin(np.arange(problem.n_stars),
                                      state.dropped))
    estimates = solve_all(problem.select(stars), frames.correction,
                          frames.factor, scene.options.executor,
                          residuals=True, judge=True)
    covariance = scene.sightings.covariance[..., stars]
    used = state.used[:, stars]
    return np.array([estimate(
        np.where(used[e], estimates.residuals[:, e], np.nan),
        covariance[:, e], estimates.expected[e], state.floor[e])
        for e in range(len(state.floor))])


def _sum_floor(residuals, covariance, expected, floor):
    return floor_variance(residuals, covariance, expected, floor)


def _median_floor(residuals, covariance, expected, floor):
    return floor_variance(residuals, covariance, expected, floor,
                          robust=True)
