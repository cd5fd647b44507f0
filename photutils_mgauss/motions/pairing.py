"""
Pairs of rows and stars by position: one to one, nearest first.

A tolerance comes from the errors, the time between the exposures and the
known motions. Stars missing from some exposures are kept.
"""
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss.motions.linking import calm_motion, lines_of
from photutils_mgauss.sky.transforms import monomials
from photutils_mgauss.utils.robust import std_about_zero

# Field stars that tie one exposure to the next one before it is matched.
SAMPLE = 20000
N_SIGMA = 5.0
# Motions of a catalogue that tell how likely others are, and how many of them
# are next to one that is looked for.
ENOUGH, NEXT = 50, 5
# Part of the motions of catalogues that are wrong by more than their errors.
WRONG = 1e-3
DOUBTFUL = 0.01  # chance of a pair of unrelated objects that is flagged
# Of the polynomials that bend a chip onto known stars, one after another.
DEGREES = (1, 1, 2, 3, 3, 3)


@dataclass(frozen=True, eq=False)
class Matches:
    """
    The rows of E exposures that belong to each of n stars.

    Parameters
    ----------
    rows : (E, n) int `~numpy.ndarray`
        Row of each star in the table of each exposure, -1 where missing.
    ambiguous : (n,) bool `~numpy.ndarray`
        Whether another pairing lay within the tolerance too, or the row may
        be an unrelated one.
    """

    rows: np.ndarray
    ambiguous: np.ndarray

    @property
    def seen(self):
        """Where stars have a row, (E, n)."""
        return self.rows >= 0

    def take(self, values, fill=np.nan):
        """
        Return one array per exposure, (..., n_e), as (..., E, n).

        Missing rows, and exposures whose array is None, are filled with
        ``fill``; None where all arrays are.
        """
        known = [value for value in values if value is not None]
        if not known:
            return None
        kind = np.result_type(*known, type(fill))
        out = np.empty((*known[0].shape[:-1], *self.rows.shape), kind)
        for e, (value, rows) in enumerate(
                zip(values, self.rows, strict=True)):
            if value is None or not value.shape[-1]:
                out[..., e, :] = fill
            else:
                out[..., e, :] = value[..., rows]
                out[..., e, rows < 0] = fill
        return out


class Known(NamedTuple):
    """
    Stars known beforehand: places and motions (2, n) at Julian years (n,).

    Motions are NaN where they are not known. ``sigma`` and ``drift`` (n,)
    are the standard errors of the places and, per year, of the motions,
    ``parallax`` (n,) how far parallaxes may take them from there.
    """

    position: np.ndarray
    motion: np.ndarray
    year: np.ndarray
    sigma: np.ndarray | float = 0.0
    drift: np.ndarray | float = 0.0
    parallax: np.ndarray | float = 0.0


@dataclass(eq=False)
class _Master:
    """The stars known so far, where and when each was last seen."""

    position: np.ndarray   # (2, n)
    sigma: np.ndarray      # (n,)
    year: np.ndarray       # (n,)
    motion: np.ndarray     # (2, n), 0 where unknown
    known: np.ndarray      # (n,) whether the motion is known
    drift: np.ndarray      # (n,) standard error of the motion
    parallax: np.ndarray   # (n,) 0 where unknown
    ambiguous: np.ndarray  # (n,)

    def at(self, year):
        return self.position + self.motion * (year - self.year)

    def update(self, stars, position, sigma, year):
        self.position[:, stars] = position
        self.sigma[stars] = sigma
        self.year[stars] = year

    def extend(self, position, sigma, year):
        n = position.shape[1]
        self.position = np.hstack([self.position, position])
        self.sigma = np.append(self.sigma, sigma)
        self.year = np.append(self.year, np.full(n, year))
        self.motion = np.hstack([self.motion, np.zeros((2, n))])
        self.known = np.append(self.known, np.zeros(n, dtype=bool))
        self.drift = np.append(self.drift, np.zeros(n))
        self.parallax = np.append(self.parallax, np.zeros(n))
        self.ambiguous = np.append(self.ambiguous, np.zeros(n, dtype=bool))


@dataclass(frozen=True)
class Tolerance:
    """
    How far apart, in frame units, two sightings of a star may be.

    Parameters
    ----------
    radius : float or None
        One radius for all pairs; None takes it from the errors: five times
        both standard errors, ``max_motion`` times the years between them
        where the motion is not known, and the residuals of the frames.
    max_motion : float
        Largest unknown motion [unit / yr].
    pointing : float
        Largest offset between exposures [unit].
    """

    radius: float | None
    max_motion: float
    pointing: float

    def between(self, master, stars, sigma, year, slack, *, doubt=False):
        """
        Return the radius for each pair of a known star and a row.

        With ``doubt`` motions that are known may be wrong.
        """
        if self.radius is not None:
            return np.full(len(stars), self.radius)
        years = np.abs(year - master.year[stars])
        motion = years * np.where(
            master.known[stars] & (not doubt),
            N_SIGMA * master.drift[stars], self.max_motion)
        error = N_SIGMA * np.hypot(sigma, master.sigma[stars])
        # From one end of its ellipse to the other.
        return error + motion + slack + 2 * master.parallax[stars]


def match_positions(places, sigmas, years, tolerance, catalogue=None,
                    chips=None):
    """
    Match exposures by position.

    Parameters
    ----------
    places : list of (2, n_e) `~numpy.ndarray`
        Positions in one plane; NaN rows become stars of their own.
    sigmas : list of (n_e,) `~numpy.ndarray`
        Standard errors of the positions; NaN counts as 0.
    years : (E,) sequence of float
        Times of the exposures [yr].
    tolerance : `Tolerance`
    catalogue : `Known` or sequence, optional
        Stars whose motions are known.
    chips : list of (n_e,) `~numpy.ndarray` or None, optional
        The chips that rows are on, where an exposure has several, each of
        which may be distorted.

    Returns
    -------
    matches : `Matches`
        The stars of the catalogue come first, in its order.
    """
    master = _start(catalogue)
    n_known = len(master.year)
    rows, slack = [None] * len(places), 0.0
    calm = tolerance
    if tolerance.radius is None:
        calm = replace(tolerance, max_motion=calm_motion(
            places, years, tolerance.max_motion))
    for e in np.argsort(years, kind='stable'):
        sigma = np.nan_to_num(sigmas[e], nan=0.0, posinf=0.0)
        rows[e], own = _match_one(master, places[e], sigma, years[e], calm,
                                  None if chips is None else chips[e])
        slack = max(slack, own)
    if calm.max_motion < tolerance.max_motion:
        rows = _linked(master, rows, n_known, tolerance, slack)
    table = np.full((len(places), len(master.year)), -1)
    for e, stars in enumerate(rows):
        table[e, stars] = np.arange(len(stars))
    kept = (table >= 0).any(axis=0)
    kept[:n_known] = True
    return Matches(table[:, kept], master.ambiguous[kept])


def _start(catalogue):
    if catalogue is None:
        catalogue = np.empty((2, 0)), np.empty((2, 0)), np.empty(0)
    position, motion, year, sigma, drift, parallax = Known(*catalogue)
    n = position.shape[1]
    known = np.isfinite(motion).all(axis=0)
    sigma, drift, parallax = (np.zeros(n) + one
                              for one in (sigma, drift, parallax))
    return _Master(position.copy(), sigma, np.array(year, dtype=float),
                   np.where(known, motion, 0.0), known, drift,
                   parallax, np.zeros(n, dtype=bool))


def _match_one(master, places, sigma, year, tolerance, chip):
    """
    Return the star of each row, and the tolerance that is not from errors.

    Rows that are new stars are added.
    """
    stars, slack = np.full(places.shape[1], -1), 0.0
    finite = np.flatnonzero(np.isfinite(places).all(axis=0))
    usable = np.isfinite(master.position).all(axis=0)
    if usable.any() and len(finite):
        known = np.flatnonzero(usable)
        tree = cKDTree(master.at(year)[:, known].T)
        if chip is None:
            moved, slack = _tie(tree, places[:, finite], tolerance)
        else:
            moved, slack = _tie_chips(tree, places[:, finite], tolerance,
                                      chip[finite])
        stars[finite] = _pair(master, tree, known, moved, sigma[finite],
                              year, tolerance, slack)
        places = places.copy()
        places[:, finite] = moved
    old = stars >= 0
    master.update(stars[old], places[:, old], sigma[old], year)
    new = np.flatnonzero(~old)
    stars[new] = len(master.year) + np.arange(len(new))
    master.extend(places[:, new], sigma[new], year)
    return stars, slack


def _linked(master, rows, n_known, tolerance, slack):
    """Return the stars of rows with those of fast ones joined."""
    count = np.bincount(np.concatenate(rows), minlength=len(master.year))
    alone = np.flatnonzero((count == 1) & np.isfinite(master.position).all(
        axis=0) & (np.arange(len(count)) >= n_known))
    lines, couples = lines_of(
        master.position[:, alone], master.sigma[alone], master.year[alone],
        tolerance.max_motion, slack)
    new = np.arange(len(count))
    for group in (*lines, *couples):
        new[alone[group]] = alone[group].min()
    for group in couples:
        master.ambiguous[alone[group]] = True
    return [new[stars] for stars in rows]


def _pair(master, tree, known, places, sigma, year, tolerance, slack):
    """Return the star nearest to each row, one to one, or -1."""
    bound = tolerance.between(master, known, sigma.max(), year, slack).max()
    distance, near = tree.query(places.T, k=2, distance_upper_bound=bound)
    near = np.append(known, -1)[near]
    first, second = near.T
    limit = tolerance.between(master, first, sigma, year, slack)
    limit2 = tolerance.between(master, second, sigma, year, slack)
    inside = (first >= 0) & (distance[:, 0] <= limit)
    doubt = inside & (second >= 0) & (distance[:, 1] <= limit2)
    stars = np.where(inside, first, -1)
    area = max(np.prod(np.ptp(places, axis=1)), 1e-300)
    chance = _chance(master, stars, places, sigma, year, slack,
                     np.sum(~inside) / area)
    stars[chance > 0.5] = -1
    inside &= stars >= 0
    doubt &= inside
    doubt |= inside & (chance > DOUBTFUL)
    # Nearest first: of several rows that claim one star, one may have it.
    rows = np.flatnonzero(inside)
    rows = rows[np.argsort(distance[rows, 0], kind='stable')]
    claimed, winner, counts = np.unique(stars[rows], return_index=True,
                                        return_counts=True)
    stars[rows] = -1
    stars[rows[winner]] = claimed
    master.ambiguous[claimed[counts > 1]] = True
    master.ambiguous[first[doubt]] = True
    rows = np.flatnonzero(stars < 0)
    taken = np.zeros(len(master.year), dtype=bool)
    taken[claimed] = True
    free = known[~taken[known]]
    if len(rows) and len(free):
        stars[rows] = _pair_left(master, free, places[:, rows], sigma[rows],
                                 year, tolerance, slack, area)
        master.ambiguous[stars[rows][stars[rows] >= 0]] = True
    return stars


def _chance(master, stars, places, sigma, year, slack, unrelated):
    """
    Return how probable it is that rows (n,) are not the stars next to them.

    Where motions are not known, those of the catalogue say how likely the
    displacement is. ``unrelated`` is the density of rows without a star.
    """
    chance = np.zeros(len(stars))
    which = np.flatnonzero((stars >= 0) & ~master.known[stars])
    motions = master.motion[:, master.motion.any(axis=0)].T
    if not len(which) or len(motions) < ENOUGH:
        return chance
    star = stars[which]
    # Hardly any time makes any motion a likely one.
    years = np.maximum(np.abs(year - master.year[star]), 1e-9)
    moved = places[:, which] - master.position[:, star]
    moved *= np.where(year < master.year[star], -1, 1) / years
    error = N_SIGMA * np.hypot(sigma[which], master.sigma[star]) + slack
    tree = cKDTree(motions)
    reach = np.maximum(tree.query(moved.T, k=NEXT)[0][:, -1], error / years)
    count = tree.query_ball_point(moved.T, reach * (1 + 1e-9),
                                  return_length=True)
    likely = count / (len(motions) * np.pi * (reach * years)**2)
    chance[which] = unrelated / (unrelated + likely)
    return chance


def _pair_left(master, free, places, sigma, year, tolerance, slack, area):
    """
    Return for rows that are left the star that is left for them, or -1.

    A fast star is not the one nearest to where it was; but it is paired only
    where no other row and no other star is within the tolerance. Nor is a
    star whose catalogue has a wrong motion near where that leads. Neither is
    paired where a row is rather one of the others that have no star, of
    which there are some in an ``area``.
    """
    between = partial(tolerance.between, master, year=year, slack=slack,
                      doubt=True)
    bound = between(free, sigma.max()).max()
    tree = cKDTree(master.at(year)[:, free].T)
    distance, near = tree.query(places.T, k=2, distance_upper_bound=bound)
    star = np.append(free, -1)[near]
    inside = [(star[:, k] >= 0)
              & (distance[:, k] <= between(star[:, k], sigma))
              for k in range(2)]
    found = np.where(inside[0] & ~inside[1], star[:, 0], -1)
    unrelated = (places.shape[1] - 1) / area
    chance = _chance(master, found, places, sigma, year, slack, unrelated)
    wrong = WRONG / (np.pi * np.maximum(between(found, sigma), 1e-300)**2)
    chance = np.where(master.known[found], unrelated / (unrelated + wrong),
                      chance)
    found[chance > 0.5] = -1
    wanted, counts = np.unique(star[:, 0][inside[0]], return_counts=True)
    return np.where(np.isin(found, wanted[counts == 1]), found, -1)


def _tie(tree, places, tolerance):
    """
    Shift and stretch an exposure onto the known stars.

    Returns the moved positions and the residual of the tie, the part of the
    tolerance that errors do not explain.
    """
    if tolerance.radius is not None and tolerance.pointing == 0:
        return places, 0.0
    sample = places[:, _sample(places.shape[1])]
    shift = _vote(tree, sample, tolerance.pointing)
    reach = tolerance.pointing / 20
    moved = places + shift[:, None]
    matrix, rms = _affine_tie(tree, sample + shift[:, None], reach)
    moved = matrix[:, :1] + matrix[:, 1:] @ moved
    return moved, 3 * rms


def _tie_chips(tree, places, tolerance, chip):
    """
    Move the chips of an exposure onto the known stars, each for itself.

    Returns the same as `_tie`.
    """
    moved, slack = places.copy(), 0.0
    reach = max(tolerance.pointing, 2 * (tolerance.radius or 0.0))
    for name in np.unique(chip):
        own = np.flatnonzero(chip == name)
        shift = _vote(tree, places[:, own], reach)
        moved[:, own], rms = _bent(tree, places[:, own] + shift[:, None],
                                   reach / 2)
        slack = max(slack, 3 * rms)
    return moved, slack


def _bent(tree, places, reach):
    """
    Return places bent onto their nearest neighbours, and the scatter left.

    By polynomials whose degree rises as far as there are stars enough.
    """
    middle = places.mean(axis=1, keepdims=True)
    scaled = (places - middle) / max(np.ptp(places), 1e-300)
    moved, rms = places, 0.0
    for degree in DEGREES:
        basis = monomials(scaled, degree)
        distance, near = tree.query(moved.T,
                                    distance_upper_bound=max(reach, 1e-300))
        good = np.isfinite(distance)
        if good.sum() < 4 * len(basis):
            break
        target = tree.data[near[good]].T
        fit = np.linalg.lstsq(basis[:, good].T, target.T, rcond=None)[0].T
        moved = fit @ basis
        residual = target - moved[:, good]
        rms = std_about_zero(np.hypot(*residual)) / np.sqrt(2)
        reach = min(reach, max(6 * rms, reach / 2))
    return moved, rms


def _sample(n):
    # A fixed seed: which stars tie the frames must not change the matches.
    if n <= SAMPLE:
        return slice(None)
    return np.random.default_rng(0).choice(n, SAMPLE, replace=False)


def _vote(tree, places, reach):
    """Return the shift most pairs within ``reach`` agree on."""
    if reach == 0:
        return np.zeros(2)
    neighbours = tree.query_ball_point(places.T[:2000], reach)
    counts = [len(found) for found in neighbours]
    if not sum(counts):
        return np.zeros(2)
    rows = np.repeat(np.arange(len(counts)), counts)
    found = np.concatenate(neighbours).astype(int)
    shifts = tree.data[found].T - places[:, rows]
    width = reach / 20
    votes, edges, _ = np.histogram2d(*shifts, bins=40,
                                     range=[[-reach, reach]] * 2)
    # Pairs on the edge of a cell count in the sum over its neighbours.
    summed = sum(np.roll(votes, (i, j), axis=(0, 1))
                 for i in (-1, 0, 1) for j in (-1, 0, 1))
    cell = np.unravel_index(summed.argmax(), summed.shape)
    centre = np.array([edges[k] + width / 2 for k in cell])
    near = np.abs(shifts - centre[:, None]).max(axis=0) < 1.5 * width
    return np.median(shifts[:, near], axis=1)


def _affine_tie(tree, places, reach):
    """Fit an affine map to the stars' nearest neighbours, robustly."""
    matrix = np.array([[0.0, 1, 0], [0, 0, 1]])
    scale = max(np.ptp(places), 1e-300)
    design = np.vstack([np.ones(places.shape[1]), places / scale])
    rms = reach / 3
    for _ in range(5):
        moved = matrix[:, :1] + matrix[:, 1:] @ places
        distance, near = tree.query(moved.T,
                                    distance_upper_bound=max(reach, 1e-300))
        good = np.isfinite(distance)
        if good.sum() < 12:
            # Too few to tell a stretch from motions: the shift has to do.
            return matrix, rms
        target = tree.data[near[good]].T
        fit = np.linalg.lstsq(design[:, good].T, target.T, rcond=None)[0].T
        matrix = fit / np.array([1, scale, scale])
        residual = target - fit @ design[:, good]
        rms = std_about_zero(np.hypot(*residual)) / np.sqrt(2)
        reach = min(reach, max(6 * rms, reach / 4))
    return matrix, rms
