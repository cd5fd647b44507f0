"""
The course of a field fit: start, weights, rejection, degree after degree.

Nothing here knows of images or tables; see `photutils_mgauss.field`.
"""
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.field.forms import TunedShapes
from photutils_mgauss.field.normal import (
    Equations,
    FieldProblem,
    Prior,
    model_stamps,
    optimise,
    to_vector,
)
from photutils_mgauss.utils.robust import std_about_zero

# Stars used while the degree is low: enough for its few coefficients.
_START_STARS = 40
_STARS_PER_TERM = 40
# A pixel is deviant beyond this many standard deviations.
_PIXEL_LIMIT = 5.0
# What a model that is not final may err by, in shares of the light, before it
# calls bright pixels and stars deviant: those at the corners, which no others
# support, would be lost first.
_ALLOWANCE = 0.03
# A star is deviant if its reduced chi^2 is beyond the median by this many
# robust standard deviations and by this share of the median, or if it has
# more than this share of deviant pixels.
_STAR_LIMIT = 6.0
_STAR_EXCESS = 0.3
_MAX_DEVIANT_PIXELS = 0.1
# Of a unit pixel along either axis [pix^2].
PIXEL_VARIANCE = 1 / 12
# Relative error of the PSF assumed before anything is known of it, and at
# most in the weights: cores would lose theirs to wings where few Gaussians
# err more, which makes these wider, so that they err more, and so on upwards.
_FIRST_ACCURACY = 0.1
# What few Gaussians may lack of coarse optics in any pixel, as a share of a
# star's flux. The many faint pixels of rings would otherwise decide what the
# Gaussians are, at the cost of the core, which has the positions.
_LACK = 1e-3


class Course(NamedTuple):
    """
    How a fit gets to the last degree, and when it ends there.

    Only ``degrees`` are fitted on the way, or all. The prior takes the widths
    of the coefficients found under it ``adaptations`` times, each time until
    a step gains less than ``tolerance`` per star.
    """

    degrees: tuple = None
    adaptations: int = 3
    tolerance: float = 0.01


CAREFUL = Course()
# Where passes are long, as with many Gaussians, every other degree is enough
# to find the way.
BRISK = Course((0, 2), 2, 0.05)


@dataclass
class FieldFit:
    """
    The state of the fit.

    Attributes
    ----------
    problem : FieldProblem
    coefficients : (T, K, 6) `~numpy.ndarray`
    prior : Prior
    equations : Equations
        At the coefficients.
    accuracy : float
        The relative error of the PSF, which is part of the weights.
    deviant_pixels : (n, s, s) `~numpy.ndarray` of bool
    blurs : (E, 3) `~numpy.ndarray`
        The covariance xx, xy, yy that each exposure adds [pix^2].
    blur_covariance : (3 E, 3 E) `~numpy.ndarray` or None
        Their errors, by number, then exposure, if there are several.
    fattening : (3,) `~numpy.ndarray` or None
        The covariance that each unit of flux adds [pix^2], if that is fitted.
    lack : float
        What the Gaussians may lack in any pixel, as a share of the star's
        flux, which is part of the weights.
    """

    problem: FieldProblem
    coefficients: np.ndarray
    prior: Prior
    equations: Equations
    accuracy: float
    deviant_pixels: np.ndarray
    blurs: np.ndarray = field(default_factory=lambda: np.zeros((1, 3)))
    blur_covariance: np.ndarray = None
    fattening: np.ndarray = None
    lack: float = 0.0

    def added(self):
        """Return what is added to the covariances of each star, (n, 3)."""
        added = self.blurs[self.problem.exposure]
        if self.fattening is not None:
            added = added + self.fluxes()[:, None] * self.fattening
        return added

    def fluxes(self):
        """Return the fluxes (n,) of the stars, for weights that sum to 1."""
        shapes = self.problem.shapes(self.coefficients)
        return (self.problem.sources[:, 0, 2]
                * np.exp(shapes[..., 0]).sum(axis=1))


def n_terms(degree):
    """Return the number of terms of a polynomial of x and y."""
    return (degree + 1) * (degree + 2) // 2


def term_degrees(n):
    """Return the degrees of the first n terms."""
    return np.repeat(np.arange(n), np.arange(n) + 1)[:n]


def polynomials(u, v, degree):
    """
    Return products of Legendre polynomials of total degree <= degree.

    u, v (n,) are in [-1, 1] on the detector; the result is (n, T), terms of a
    lower degree first.
    """
    legendre = np.polynomial.legendre.legvander
    a, b = legendre(u, degree), legendre(v, degree)
    terms = [(total - j, j) for total in range(degree + 1)
             for j in range(total + 1)]
    return np.stack([a[..., i] * b[..., j] for i, j in terms], axis=-1)


def first_width(problem):
    """
    Estimate the standard deviation of the PSF from the stacked stars.

    That of the PSF in pixels, or of the optics where these are fitted.
    """
    width = stacked_width(problem.stamps)
    return (np.sqrt(width**2 - PIXEL_VARIANCE) if problem.pixel_integrated
            else width)


def stacked_width(stamps):
    """Estimate the standard deviation of the PSF in pixels from stars."""
    data, good = stamps.data, stamps.good
    inner = stamps.offsets() <= 2.5
    light = np.where(good, data, 0)[:, inner].sum(axis=1)
    bright = light > 0
    shares = np.where(good, data, np.nan)[bright]
    shares = shares / light[bright, None, None]
    usable = good[bright].any(axis=0)
    stack = np.zeros(usable.shape)
    stack[usable] = np.nanmedian(shares[:, usable], axis=0)
    order = np.argsort(stamps.offsets(), axis=None)
    radius = stamps.offsets().ravel()[order]
    growth = np.cumsum(stack.ravel()[order])
    half = radius[np.argmax(growth >= 0.5 * growth.max())]
    # Half the light of a Gaussian is inside 1.18 standard deviations.
    return max(half, 0.7) / 1.18


class Ladder(NamedTuple):
    """
    A start: what sizes, in units of the width, and weights go from and to.

    offset is how far from the centre, in units of the size, each Gaussian
    is, turn the direction of the first one [rad].
    """

    smallest: float
    largest: float
    offset: float
    least: float
    turn: float


PLAIN = Ladder(0.8, 3.5, 0.2, 0.05, 0.0)
# Optics have many mixtures that are the best among their neighbours; which
# of them is found depends on how many Gaussians share the core. Where pixels
# hide the details, a poor one costs more than noise does.
_LADDERS = tuple(
    Ladder(*sizes, offset, least, turn) for turn in (0.0, 2.0)
    for sizes, offset, least in (((0.8, 3.5), 0.2, 0.05),
                                 ((0.5, 4.0), 0.2, 0.05),
                                 ((0.7, 2.0), 0.5, 0.2)))
# Stars and steps for a look at each, and the relative error of the PSF that
# lets the cores decide.
_LADDER_STARS, _LADDER_STEPS, _LADDER_ACCURACY = 25, 20, 0.02


def ladder(n_components, width, start=PLAIN):
    """Return shapes (K, 6) of round Gaussians of growing size."""
    shapes = np.zeros((n_components, 6))
    if n_components == 1:
        sizes, weights = np.ones(1), np.ones(1)
    else:
        sizes = np.geomspace(start.smallest, start.largest, n_components)
        weights = np.geomspace(1, start.least, n_components)
    shapes[:, 0] = np.log(weights)
    shapes[:, 3] = shapes[:, 5] = -np.log(sizes * width)
    # Gaussians of one centre only move apart if they start apart.
    angle = 2.4 * np.arange(n_components) + start.turn
    shapes[:, 1] = start.offset * width * sizes * np.cos(angle)
    shapes[:, 2] = start.offset * width * sizes * np.sin(angle)
    shapes[:, 1:3] -= shapes[0, 1:3]
    return shapes


def begin(problem, n_components, strength, workers, ladders=None):
    """
    Fit one round Gaussian, then the mixture, the same everywhere.

    The mixture starts from the best of ``ladders``; by default these are
    several where pixels are integrated.
    """
    workers.tell('the mean PSF')
    if ladders is None:
        ladders = _LADDERS if problem.pixel_integrated else (PLAIN,)
    brightest = problem.brightest()[:_START_STARS]
    few = problem.subset(brightest)
    few.basis = np.ones((len(brightest), 1))
    width = first_width(few)
    one = ladder(1, width)
    state = _new_state(few, one, width, strength)
    weigh(state, reject=False)
    advance(state, workers, tolerance=0.1)
    width = np.exp(-state.coefficients[0, 0, [3, 5]].mean())
    ladders = [ladder(n_components, width, start) for start in ladders]
    shapes, found = _best_ladder(state.problem, ladders, width, strength,
                                 workers)
    mixture = _new_state(state.problem, shapes, width, strength)
    mixture.coefficients[0] = found
    weigh(mixture, reject=False)
    advance(mixture, workers, max_steps=60, tolerance=0.05)
    mixture.prior.mean[0] = shapes
    return mixture.coefficients, shapes, width


def _best_ladder(problem, ladders, width, strength, workers):
    """Return the best of the starts, and the shapes (K, 6) it has led to."""
    if len(ladders) == 1:
        return ladders[0], ladders[0]
    states = []
    for shapes in ladders:
        few = problem.subset(np.arange(len(problem.basis))[:_LADDER_STARS])
        state = _new_state(few, shapes, width, strength)
        state.accuracy = _LADDER_ACCURACY
        weigh(state, reject=False)
        advance(state, workers, max_steps=_LADDER_STEPS, tolerance=0.3)
        states.append(state)
    best = min(states, key=lambda state: state.equations.chi2.sum())
    return best.prior.mean[0], best.coefficients[0]


def _new_state(problem, shapes, width, strength):
    terms = problem.basis.shape[1]
    coefficients = np.zeros((terms, *shapes.shape))
    coefficients[0] = shapes
    prior = Prior.about(shapes, terms, width, strength, _widest(problem))
    return FieldFit(problem, coefficients, prior, None, _FIRST_ACCURACY,
                    np.zeros(problem.stamps.good.shape, bool),
                    lack=_lack(problem))


def _lack(problem):
    """Return what Gaussians may lack, nothing where they are sampled."""
    return _LACK if problem.pixel_integrated else 0.0


def _widest(problem):
    """
    Return the largest standard deviation of a Gaussian [pix].

    What falls by less than a factor e to the edge of a stamp is its sky.
    """
    return problem.stamps.radius / np.sqrt(2)


def advance(state, workers, **options):
    """Optimise the coefficients at the present weights, in place."""
    state.coefficients, state.equations = optimise(
        state.problem, state.coefficients, state.prior, workers, **options)


def weigh(state, *, reject, share=1.0):
    """
    Renew weights and rejections from the present model, in place.

    The variance is that of the model, not of the data. It includes ``share``
    of the present relative error of the PSF, or with None what it included
    before: while the model is still poor, bright stars would otherwise drown
    all others, and every star would be deviant.
    """
    problem = state.problem
    stamps, good = problem.stamps, problem.stamps.good
    if state.equations is None:
        light = np.maximum(stamps.data, 0)
        residual = None
    else:
        model = model_stamps(problem, state.coefficients)
        residual = stamps.data - model
        light = np.maximum(model - problem.sky[:, None, None], 0)
    variance = stamps.base + stamps.slope * light
    if residual is not None and share is not None:
        state.accuracy = share * _accuracy(residual, light, variance,
                                           problem)
    forgiven = min(state.accuracy, _FIRST_ACCURACY)
    variance = variance + (forgiven * light) ** 2 + _lacking(state, light)
    if reject and residual is not None:
        _reject(state, residual, variance + (_ALLOWANCE * light) ** 2)
    problem.weights = np.where(good & ~state.deviant_pixels, 1 / variance, 0)


def _lacking(state, light):
    """Return the variance (n, 1, 1) of what Gaussians lack in any pixel."""
    if state.lack == 0:
        return 0.0
    # What weights sum to is not known before the first fit.
    flux = (light.sum(axis=(1, 2)) if state.equations is None
            else state.fluxes())
    return (state.lack * flux[:, None, None]) ** 2


def _accuracy(residual, light, variance, problem):
    """
    Return the relative error of the PSF that chi^2 asks for.

    The median over stars, less what it may be by chance: one blend does not
    change it.
    """
    w = np.where(problem.weights > 0, light**2, 0)[problem.used]
    excess = np.sum(w * (residual**2 - variance)[problem.used], axis=(1, 2))
    squares = excess / np.maximum(np.sum(w**2, axis=(1, 2)), 1e-300)
    middle = np.median(squares)
    scatter = mad_std(squares)
    return np.sqrt(max(middle - 2.5 * scatter / np.sqrt(len(squares)), 0))


def _reject(state, residual, variance):
    problem = state.problem
    good = problem.stamps.good
    pulls = np.where(good, residual / np.sqrt(variance), np.nan)
    state.deviant_pixels = _deviant_pixels(pulls, problem.used)
    kept = good & ~state.deviant_pixels
    chi2 = np.nansum(np.where(kept, pulls**2, 0), axis=(1, 2))
    reduced = chi2 / np.maximum(kept.sum(axis=(1, 2)), 1)
    share = state.deviant_pixels.sum(axis=(1, 2)) / good.sum(axis=(1, 2))
    used = not_deviant(reduced, problem.used)
    used &= share <= _MAX_DEVIANT_PIXELS
    used &= problem.sources[:, 0, 2] > 0
    middle = problem.stamps.corners + problem.stamps.radius
    moved = np.abs(problem.sources[:, 0, :2] - middle).max(axis=1)
    used &= moved < max(2.0, 0.3 * problem.stamps.radius)
    # Of two stars, both may deviate from their mean.
    if used.any():
        problem.used = used


def _deviant_pixels(pulls, used):
    """
    Return which pixels are beyond the limit and beyond their peers.

    Where the pixels of most stars at one offset are off, it is the model
    that errs.
    """
    columns = np.isfinite(pulls[used]).any(axis=0)
    typical = np.ones(columns.shape)
    typical[columns] = std_about_zero(pulls[used][:, columns], axis=0)
    limit = _PIXEL_LIMIT * np.maximum(typical, 1)
    return np.abs(np.nan_to_num(pulls)) > limit


def not_deviant(reduced, used):
    """Return which stars' reduced chi^2 is like that of the used ones."""
    middle = np.median(reduced[used])
    scatter = mad_std(reduced[used])
    limit = middle + max(_STAR_LIMIT * scatter, _STAR_EXCESS * middle)
    return reduced <= limit


def run(problem, n_components, degree, workers, *, strength=1.0, reject=True,
        course=CAREFUL, poor=np.inf):
    """
    Fit the field, raising the degree from 0.

    ``problem.basis`` holds the terms of ``degree``. Returns a `FieldFit`,
    which is not finished (see `finish`) if its accuracy is ``poor`` or worse.
    """
    state = _first_state(problem, n_components, degree, strength, workers)
    brightest = problem.brightest()
    for low in range(degree + 1):
        if course.degrees is not None and low not in course.degrees:
            continue
        count = _STARS_PER_TERM * n_terms(low + 1)
        if low == degree and count >= len(brightest):
            break
        _stage(state, np.sort(brightest[:count]), low, workers, reject)
    return _finish(state, degree, workers, reject, course, poor)


def degrees(problem, n_components, top, strength, workers):
    """Yield a `FieldFit` of each degree from 0 to the top one."""
    state = _first_state(problem, n_components, top, strength, workers)
    for degree in range(top + 1):
        yield _stage(state, np.arange(len(problem.basis)), degree, workers,
                     True, adapt=True)


def _first_state(problem, n_components, degree, strength, workers):
    start, shapes, width = begin(problem, n_components, strength, workers)
    prior = Prior.about(shapes, n_terms(degree), width, strength,
                        _widest(problem), problem.n_extra)
    start = np.concatenate([start, np.zeros((problem.n_extra,
                                             *shapes.shape))])
    return FieldFit(problem, start, prior, None, _FIRST_ACCURACY,
                    np.zeros(problem.stamps.good.shape, bool),
                    np.zeros((problem.exposure.max() + 1, 3)),
                    lack=_lack(problem))


def _stage(state, index, degree, workers, reject, *, adapt=False):
    """
    Fit some of the stars at a low degree.

    Only coefficients remain in ``state``; the fit itself is returned.
    """
    terms = n_terms(degree)
    few = state.problem.subset(index).with_terms(terms)
    workers.tell(f'degree {degree}')
    part = FieldFit(few, raised(state.coefficients, terms, few.n_extra),
                    state.prior.first(terms), None, state.accuracy,
                    np.zeros(few.stamps.good.shape, bool), state.blurs,
                    lack=state.lack)
    few.local = part.added()
    _settle_all(part, workers)
    for _ in range(2):
        _fit_blurs(part, workers)
        weigh(part, reject=reject, share=0.5)
        advance(part, workers, tolerance=0.3, max_steps=10)
    if adapt and degree:
        _adapt(part, workers, reject)
    state.coefficients, state.accuracy = part.coefficients, part.accuracy
    state.blurs = part.blurs
    return part


def _fit_blurs(state, workers):
    """
    Fit what each exposure adds to the covariances, all else given.

    Their mean belongs to the field.
    """
    problem, n = state.problem, len(state.blurs)
    if n < 2:
        if state.fattening is not None:
            problem.local = state.added()
        return
    tuned = added_shapes(state)
    width = np.exp(-tuned.local[:, 0, [3, 5]].mean())
    prior = Prior(np.zeros((n, 3)), np.full((n, 3), width**-4.0))
    blurs, found = optimise(tuned, state.blurs, prior, workers, max_steps=10,
                            tolerance=0.03)
    state.blurs = blurs - blurs.mean(axis=0)
    state.blur_covariance = np.linalg.inv(found.matrix + np.diag(
        to_vector(prior.precision)))
    problem.sources, problem.sky = tuned.sources, tuned.sky
    problem.local = state.added()


def added_shapes(state):
    """
    Return the problem of what exposures add to the covariances of stars.

    What fluxes add is part of the shapes that are known.
    """
    problem, n = state.problem, len(state.blurs)
    known = replace(problem, local=state.added()
                    - state.blurs[problem.exposure])
    return replace(
        problem, form=TunedShapes(), basis=np.eye(n)[problem.exposure],
        places_once=False,
        local=TunedShapes.local(known.shapes(state.coefficients), 1.0))


def _settle_all(state, workers):
    """Fit every stamp's own numbers to the present field."""
    state.equations = None
    weigh(state, reject=False)
    advance(state, workers, max_steps=0)


def tune(problem, degree, workers, *, strength=1.0, reject=True):
    """
    Fit changes of a known PSF, polynomials of the degree.

    ``problem.local`` holds the known PSF. Returns a `FieldFit`.
    """
    prior = Prior.of_changes(n_terms(degree), first_width(problem), strength)
    state = FieldFit(problem, prior.mean, prior, None, _FIRST_ACCURACY,
                     np.zeros(problem.stamps.good.shape, bool))
    return _finish(state, degree, workers, reject)


def _finish(state, degree, workers, reject, course=CAREFUL, poor=np.inf):
    terms = n_terms(degree)
    state.problem = state.problem.with_terms(terms)
    state.coefficients = raised(state.coefficients, terms,
                                 state.problem.n_extra)
    return polish(state, workers, reject, course=course, poor=poor)


def polish(state, workers, reject, *, course=CAREFUL, poor=np.inf):
    """
    Fit all at the last degree until nothing changes; return the state.

    Not until then if its accuracy, once that is known, is ``poor`` or worse.
    """
    workers.tell('all stars')
    _settle_all(state, workers)
    for tolerance in (0.3, 0.1):
        _fit_blurs(state, workers)
        weigh(state, reject=reject, share=0.3)
        advance(state, workers, tolerance=tolerance, max_steps=8)
    _fit_blurs(state, workers)
    weigh(state, reject=reject)
    return (finish(state, workers, reject, course) if state.accuracy < poor
            else state)


def finish(state, workers, reject, course=CAREFUL):
    """Fit all at the last weights and let the prior adapt to them."""
    advance(state, workers, tolerance=0.01, max_steps=8)
    workers.tell('shrinkage')
    several = len(state.coefficients) > 1
    for _ in range(course.adaptations if several else 0):
        _adapt(state, workers, reject, course.tolerance)
    return state


def with_errors(state, misfit, workers):
    """
    Return the fit as it looks under weights of noise and misfit alone.

    The shapes stay, each stamp's own numbers are fitted anew. Nothing of the
    problem is shared.
    """
    every = np.arange(len(state.problem.basis))
    plain = replace(state, problem=state.problem.subset(every),
                    accuracy=misfit, lack=0.0)
    weigh(plain, reject=False, share=None)
    advance(plain, workers, max_steps=0)
    return plain


def _adapt(state, workers, reject, tolerance=CAREFUL.tolerance):
    """Let the prior follow the coefficients, and these the prior."""
    state.prior = state.prior.adapted(
        state.coefficients, state.equations.matrix,
        _groups(state.coefficients, state.problem.form.kinds,
                state.problem.n_extra))
    # A higher error would mean less weight for the cores, and so on upwards.
    weigh(state, reject=reject, share=None)
    advance(state, workers, tolerance=tolerance, max_steps=10)


def _groups(coefficients, kinds, n_extra):
    """Return which coefficients are of one degree, or term, and kind."""
    degrees = term_degrees(len(coefficients) - n_extra)
    degrees = np.append(degrees, degrees[-1] + 1 + np.arange(n_extra))
    groups = np.empty(coefficients.shape, int)
    groups[:] = kinds
    groups += 3 * (degrees - 1).reshape(-1, *[1] * (groups.ndim - 1))
    groups[0] = -1
    if groups.ndim == 3:
        # Not fitted: they would repeat position and flux of the stars.
        groups[:, 0, :3] = -1
    return groups


def raised(coefficients, terms, n_extra):
    """Return the coefficients with further terms of zero."""
    known = len(coefficients) - n_extra
    full = np.zeros((terms + n_extra, *coefficients.shape[1:]))
    full[:known] = coefficients[:known]
    full[terms:] = coefficients[known:]
    return full
