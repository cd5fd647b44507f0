"""All that stays the same while a fit of motions iterates, made once."""
import warnings
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from photutils_mgauss.motions.assemble import Sightings
from photutils_mgauss.motions.distortion import Distortion, distortion_of
from photutils_mgauss.motions.error_scale import ErrorScales
from photutils_mgauss.motions.perspective import Nearing
from photutils_mgauss.motions.priors import (
    Priors,
    add_parallax_prior,
    build_priors,
)
from photutils_mgauss.motions.terms import Terms, terms_of
from photutils_mgauss.sky.transforms import Transform
from photutils_mgauss.utils.validation import as_rng


@dataclass(frozen=True, eq=False)
class Options:
    """What the fitter was asked for, checked; see `ProperMotionFitter`."""

    transform: Transform
    recipe: str
    parallax: object
    parallax_prior: tuple
    acceleration: bool
    systematic: object
    clip: float | None
    max_motion: u.Quantity
    hold_out: float
    eps_t: str
    rng: object
    executor: object
    distortion: Transform
    distortion_prior: u.Quantity
    terms: tuple

    @property
    def n_star_parameters(self):
        """Number of parameters of a star."""
        return 4 + bool(self.parallax) + 2 * self.acceleration

    @property
    def fits_floor(self):
        """Whether the systematic errors are found from the scatter."""
        return isinstance(self.systematic, str)

    @property
    def scales_errors(self):
        """Whether errors are scaled, too, as functions of magnitude."""
        return self.fits_floor and self.systematic == 'magnitude'

    @property
    def wanted(self):
        """What of detections is needed besides places, errors and times."""
        return {name for name, needed in (
            ('magnitude', self.scales_errors or self.terms),
            ('colour', 'colour' in self.terms), ('pixels', self.terms))
            if needed}


@dataclass(frozen=True, eq=False)
class Setup:
    """
    Everything that stays the same while the fit iterates.

    Parameters
    ----------
    sightings : `~photutils_mgauss.motions.assemble.Sightings`
    options : `Options`
    transform : `~photutils_mgauss.sky.transforms.Transform`
        The kind of map, with coordinates that suit the field.
    origin : (2, n) `~numpy.ndarray`
        Mean places of the stars.
    working_year : float
    dt : (E, 1) or (E, n) `~numpy.ndarray`
        Years since then.
    priors : `~photutils_mgauss.motions.priors.Priors`
        Those of all references in use.
    places : `~photutils_mgauss.motions.priors.Priors`
        What references are left with that are held out or rejected: their
        places, where the epochs alone make no motion, else nothing.
    anchors : (n,) bool `~numpy.ndarray`
        Stars that say where the frames are: the references of known motion,
        or without any all stars.
    held : (k,) int `~numpy.ndarray`
        References held out.
    relative : bool
        Whether there are no references, and all stars are anchors.
    drift : (stars, displacements) or None
        Displacements (2, E, k) of k references by parallaxes that are known
        and not fitted.
    nearing : `~photutils_mgauss.motions.perspective.Nearing`
        Stars of known radial velocity.
    notes : tuple of str
        What could not be used, in sentences.
    magnitudes : (E, n) `~numpy.ndarray` or None
        Of the detections, if something depends on them.
    distortion : `~photutils_mgauss.motions.distortion.Distortion` or None
        Of the chips of cameras, if there are any, or the terms in use.
    terms : `~photutils_mgauss.motions.terms.Terms` or None
        Those asked for, until it is known which are real.
    """

    sightings: Sightings
    options: Options
    transform: Transform
    origin: np.ndarray
    working_year: float
    dt: np.ndarray
    priors: Priors
    places: Priors
    anchors: np.ndarray
    held: np.ndarray
    relative: bool
    drift: tuple | None
    nearing: Nearing
    notes: tuple
    magnitudes: np.ndarray | None
    distortion: Distortion | None
    terms: Terms | None

    def undistorted(self, state):
        """Return the places (2, E, n) with the distortion of chips gone."""
        if self.distortion is None:
            return self.sightings.places
        return (self.sightings.places
                + self.distortion.shift(state.distortion))


@dataclass(frozen=True, eq=False)
class State:
    """
    What changes from one iteration to the next.

    ``maps`` (E, 2, b), ``used`` (E, n), ``floor`` (E,) variances per axis,
    ``dropped`` (k,) stars that are references no longer, ``untied`` (n,)
    stars whose detections disagree too much to find the frames with,
    ``swerve`` (2, E, k) what stars of known radial velocity move beyond the
    model, ``crooked`` (n,) stars that no straight motion explains, whose
    detections are all kept, ``unfinished`` whether there may be outliers
    left, ``distortion`` (C, 2, b) the polynomials of chips [pix], if any,
    ``scales`` the `~photutils_mgauss.motions.error_scale.ErrorScales` of the
    epochs, ``factor`` (E, n) what they multiply covariances by and ``added``
    (E, n) the variances they add, if they are fitted. ``posed`` is the state
    that the last problem was posed in, whose frames led to this one.
    """

    maps: np.ndarray
    used: np.ndarray
    floor: np.ndarray
    dropped: np.ndarray
    untied: np.ndarray
    swerve: np.ndarray
    crooked: np.ndarray
    unfinished: bool = False
    distortion: np.ndarray | None = None
    scales: ErrorScales | None = None
    factor: np.ndarray | None = None
    added: np.ndarray | None = None
    posed: 'State | None' = None


def prepare(sightings, options):
    """Return the `Setup` of a fit, and the `State` it starts from."""
    _check_options(options, sightings)
    floor = _first_floor(options.systematic, sightings)
    stars, catalogue = sightings.references, sightings.catalogue
    held = _hold_out(stars, options)
    anchors = np.zeros(len(sightings.names), dtype=bool)
    anchors[stars[catalogue.kinds != 'position']] = True
    anchors[held] = False
    relative = not anchors.any()
    anchors |= relative
    if relative:
        _check_single(sightings, options)
    sightings, untied = _with_references(sightings, anchors, relative,
                                         options)
    if relative and not sightings.kept.all():
        _check_single(sightings, options)
    working = float(np.nanmean(sightings.epoch_years[sightings.kept]))
    dt = np.nan_to_num(sightings.years - working)
    origin, transform = _field(sightings, options.transform, ~untied)
    drift = _drift(sightings, origin, options)
    nearing, notes = _nearing(sightings, options)
    priors, places = _priors(sightings, held, origin, working, options)
    if options.parallax == 'prior':
        priors = add_parallax_prior(priors, len(anchors),
                                    options.parallax_prior)
    maps = np.repeat(transform.identity()[None], len(dt), axis=0)
    magnitudes = (None if sightings.magnitude is None
                  else in_one_system(sightings.magnitude))
    distortion = distortion_of(sightings, options.distortion,
                               options.distortion_prior.to_value(u.mas))
    terms = terms_of(sightings, options, magnitudes)
    return (Setup(sightings, options, transform, origin, working, dt, priors,
                  places, anchors, held, relative, drift, nearing, notes,
                  magnitudes, distortion, terms),
            State(maps, sightings.usable.copy(), floor,
                  np.empty(0, dtype=int), untied,
                  np.zeros((2, len(dt), len(nearing.stars))),
                  np.zeros(len(anchors), dtype=bool),
                  distortion=distortion and distortion.none()))


def in_one_system(each):
    """
    Return the magnitudes (E, n) of detections, in the mean system.

    Where an epoch has none, it is that of the others.
    """
    if not np.isfinite(each).any():
        msg = ('epochs must have a column of magnitudes or fluxes (mag or '
               "flux_fit) for systematic='magnitude' and terms, got none")
        raise ValueError(msg)
    with warnings.catch_warnings():
        # Stars without a magnitude.
        warnings.simplefilter('ignore', RuntimeWarning)
        zero = np.zeros((len(each), 1))
        for _ in range(3):
            mean = np.nanmedian(each - zero, axis=0)
            zero = np.nan_to_num(np.nanmedian(each - mean, axis=1))[:, None]
    each = each - (zero - zero.mean())
    return np.where(np.isfinite(each), each, mean + zero.mean())


def _check_options(options, sightings):
    if options.recipe == 'paper' and sightings.single:
        msg = ("recipe must be 'joint' or 'two-step' for epochs of one time "
               "and a catalogue, got 'paper'")
        raise ValueError(msg)
    if options.parallax and options.recipe == 'paper':
        msg = ("parallax must be False for the recipe 'paper', got "
               f'{options.parallax!r}')
        raise ValueError(msg)
    if options.parallax and sightings.plane is None:
        msg = ('parallax must be False for epochs without a place in the '
               f'sky, got {options.parallax!r}')
        raise ValueError(msg)


def _check_single(sightings, options):
    """Raise where maps would take up all motions there are."""
    if sightings.single and options.transform.kind != 'none':
        msg = ('references must have objects of known motion (class '
               "'star', 'qso' or 'galaxy') among the stars for epochs of "
               'one time, got none; or give the catalogue as another Epoch '
               'for motions relative to the mean of the stars')
        raise ValueError(msg)


def _priors(sightings, held, origin, working, options):
    """Return the `Priors` of references in use, and of places alone."""
    stars, catalogue = sightings.references, sightings.catalogue

    def build(some, which):
        return build_priors(some.select(which), stars[which],
                            origin[:, stars[which]], working,
                            sightings.unit, options.n_star_parameters)
    use = ~np.isin(stars, held)
    priors = build(catalogue, use)
    if not sightings.single:
        return priors, Priors.none(options.n_star_parameters)
    places = build(catalogue.places(), np.ones(len(stars), dtype=bool))
    return priors.with_others(places.of(held)), places


def _first_floor(systematic, sightings):
    n_epochs = len(sightings.epoch_years)
    if systematic is None or isinstance(systematic, str):
        return np.zeros(n_epochs)
    floor = np.asarray(systematic.to_value(u.Unit(sightings.unit)))
    if floor.shape not in ((), (n_epochs,)):
        msg = (f'systematic must be one value or one per epoch '
               f'({n_epochs}), got shape {floor.shape}')
        raise ValueError(msg)
    return np.broadcast_to(floor**2, n_epochs).copy()


def _hold_out(stars, options):
    n = round(options.hold_out * len(stars))
    if n == 0:
        return np.empty(0, dtype=int)
    rng = as_rng(options.rng)
    return np.sort(rng.choice(stars, n, replace=False))


def _scattered(sightings, anchors, max_motion):
    """
    Return stars (n,) whose places are too far apart to be one star.

    Identifiers may be wrong, and one such star would outweigh all others.
    """
    places = np.where(sightings.usable, sightings.places, np.nan)
    count = sightings.usable.sum(axis=0)
    many = np.flatnonzero(count > 1)
    spread = np.zeros(len(count))
    spread[many] = (np.nanmax(places[..., many], axis=1)
                    - np.nanmin(places[..., many], axis=1)).max(axis=0)
    typical = spread[anchors & (count > 1)]
    limit = 30 * np.median(typical) if len(typical) else 0.0
    if sightings.unit == 'mas':
        baseline = sightings.baseline * u.yr
        limit = max(limit, (max_motion * baseline).to_value(u.mas))
    return (spread > limit) | ~sightings.ties.agreed


def _with_references(sightings, anchors, relative, options):
    """
    Return sightings and scattered stars (n,) without epochs of no use.

    Those have fewer references than their map needs. One after another is
    left out, the worst first: what stars have in common changes with each.
    Raises where nothing would be left.
    """
    while True:
        untied = _scattered(sightings, anchors, options.max_motion)
        counts = _count_references(sightings, anchors & ~untied, relative)
        few = sightings.kept & (counts < options.transform.n_references)
        if options.transform.kind == 'none' or not few.any():
            return sightings, untied
        e = int(np.argmin(np.where(few, counts, np.inf)))
        what = ('stars in common with other epochs' if relative
                else 'reference objects')
        if (untied & anchors).any():
            what += ' whose places agree'
        rule = (f'must have at least {options.transform.n_references} '
                f'{what} for the transform {options.transform.kind!r}, got '
                f'{counts[e]}')
        left_out = ~sightings.kept
        left_out[e] = True
        if left_out.all() or not sightings.without(left_out).baseline > 0:
            msg = f'epoch {e} {rule}'
            raise ValueError(msg)
        said = (*sightings.doubts, f'Epoch {e} was left out: it {rule}.')
        sightings = replace(sightings.without(left_out), doubts=said)


def _count_references(sightings, anchors, relative):
    """Return how many usable anchors (n,) the epochs have, (E,)."""
    usable = sightings.usable & anchors
    if relative:
        usable = usable & (usable.sum(axis=0) > 1)
    return usable.sum(axis=1)


def _field(sightings, transform, sound):
    """
    Return the stars' mean places, and the maps' coordinates for them.

    The coordinates suit the stars whose places are ``sound`` (n,), if any.
    """
    places = sightings.places[:, sightings.kept]
    count = np.isfinite(places[0]).sum(axis=0)
    with np.errstate(invalid='ignore'):
        origin = (np.nansum(places, axis=1)
                  / np.where(count, count, np.nan))
    inside = np.where(sound | ~sound.any(), origin, np.nan)
    transform = transform.fitted_to(inside)
    return np.where(np.isfinite(origin), origin,
                    np.reshape(transform.centre, (2, 1))), transform


def _nearing(sightings, options):
    """
    Return the `Nearing` stars, and a sentence on those that are left out.

    Without a parallax a radial velocity says nothing about a motion, and
    the recipe of the paper knows of neither.
    """
    parallax = np.full(len(sightings.names), np.nan)
    parallax[sightings.references] = sightings.catalogue.values[4]
    known = np.isfinite(sightings.radial_velocity)
    if options.recipe == 'paper' or sightings.unit != 'mas':
        known[:] = False
    use = known & (np.isfinite(parallax) | bool(options.parallax))
    stars, left = np.flatnonzero(use), np.sum(known & ~use)
    nearing = Nearing(stars, sightings.radial_velocity[stars],
                      np.nan_to_num(sightings.velocity_error[stars]),
                      np.nan_to_num(parallax[stars]))
    if not left:
        return nearing, ()
    of = 'one star' if left == 1 else f'{left} stars'
    note = (f'The radial velocity of {of} is not used, because the parallax '
            'is not known: give references with parallaxes, or fit them.')
    return nearing, (note,)


def _drift(sightings, origin, options):
    """Return references and their displacements by known parallaxes."""
    stars, catalogue = sightings.references, sightings.catalogue
    parallax = np.nan_to_num(catalogue.values[4])
    if sightings.plane is None or options.parallax or not parallax.any():
        return None
    observer = sightings.observer
    if observer.shape[2] > 1:
        observer = observer[..., stars]
    return stars, parallax * sightings.plane.parallax_factors(
        origin[:, None, stars], observer)
