"""
Which rows of several exposures are the same star.

Rows are matched by an identifier, or by position: one to one, nearest first,
within a tolerance that comes from the errors, the time between the exposures
and the known motions. Stars missing from some exposures are kept.
"""
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

# Field stars that tie one exposure to the next one before it is matched.
SAMPLE = 20000
N_SIGMA = 5.0


@dataclass(frozen=True, eq=False)
class Matches:
    """
    The rows of E exposures that belong to each of n stars.

    Parameters
    ----------
    rows : (E, n) int `~numpy.ndarray`
        Row of each star in the table of each exposure, -1 where missing.
    ambiguous : (n,) bool `~numpy.ndarray`
        Whether another pairing lay within the tolerance too.
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

        Missing rows are filled with ``fill``.
        """
        leading = values[0].shape[:-1]
        kind = np.result_type(*values, type(fill))
        out = np.empty((*leading, *self.rows.shape), dtype=kind)
        for e, (value, rows) in enumerate(
                zip(values, self.rows, strict=True)):
            if value.shape[-1]:
                out[..., e, :] = value[..., rows]
            out[..., e, rows < 0] = fill
        return out


def match_ids(ids):
    """
    Match exposures by identifiers, one array of unique values for each.

    Returns
    -------
    matches : `Matches`
    names : (n,) `~numpy.ndarray`
        The identifier of each star, in order of first appearance.
    """
    kinds = {array.dtype.kind in 'iuf' for array in ids}
    if len(kinds) > 1:
        words = ', '.join(str(array.dtype) for array in ids)
        msg = ("the columns 'id' must be numbers in all epochs or in none, "
               f'got {words}')
        raise TypeError(msg)
    everything = np.concatenate(ids)
    names, first, number = np.unique(everything, return_index=True,
                                     return_inverse=True)
    order = np.argsort(first)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows = np.full((len(ids), len(names)), -1)
    splits = np.cumsum([len(array) for array in ids])[:-1]
    for e, numbers in enumerate(np.split(place[number], splits)):
        rows[e, numbers] = np.arange(len(numbers))
    return Matches(rows, np.zeros(len(names), dtype=bool)), names[order]


@dataclass(eq=False)
class _Master:
    """The stars known so far, where and when each was last seen."""

    position: np.ndarray   # (2, n)
    sigma: np.ndarray      # (n,)
    year: np.ndarray       # (n,)
    motion: np.ndarray     # (2, n), 0 where unknown
    known: np.ndarray      # (n,) whether the motion is known
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

    def between(self, master, stars, sigma, year, slack):
        """Return the radius for each pair of a known star and a row."""
        if self.radius is not None:
            return np.full(len(stars), self.radius)
        years = np.abs(year - master.year[stars])
        motion = np.where(master.known[stars], 0, self.max_motion * years)
        error = N_SIGMA * np.hypot(sigma, master.sigma[stars])
        return error + motion + slack


def match_positions(places, sigmas, years, tolerance, catalogue=None):
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
    catalogue : (position, motion, year), optional
        Stars whose motions are known: (2, n), (2, n) and (n,).

    Returns
    -------
    matches : `Matches`
        The stars of the catalogue come first, in its order.
    """
    master = _start(catalogue)
    rows = [None] * len(places)
    for e in np.argsort(years, kind='stable'):
        sigma = np.nan_to_num(sigmas[e], nan=0.0, posinf=0.0)
        rows[e] = _match_one(master, places[e], sigma, years[e], tolerance)
    table = np.full((len(places), len(master.year)), -1)
    for e, stars in enumerate(rows):
        table[e, stars] = np.arange(len(stars))
    return Matches(table, master.ambiguous)


def _start(catalogue):
    if catalogue is None:
        catalogue = np.empty((2, 0)), np.empty((2, 0)), np.empty(0)
    position, motion, year = catalogue
    n = position.shape[1]
    known = np.isfinite(motion).all(axis=0)
    return _Master(position.copy(), np.zeros(n), np.array(year, dtype=float),
                   np.where(known, motion, 0.0), known,
                   np.zeros(n, dtype=bool))


def _match_one(master, places, sigma, year, tolerance):
    """Return the star of each row, adding the rows that are new stars."""
    stars = np.full(places.shape[1], -1)
    finite = np.flatnonzero(np.isfinite(places).all(axis=0))
    usable = np.isfinite(master.position).all(axis=0)
    if usable.any() and len(finite):
        known = np.flatnonzero(usable)
        tree = cKDTree(master.at(year)[:, known].T)
        moved, slack = _tie(tree, places[:, finite], tolerance)
        stars[finite] = _pair(master, tree, known, moved, sigma[finite],
                              year, tolerance, slack)
        places = places.copy()
        places[:, finite] = moved
    old = stars >= 0
    master.update(stars[old], places[:, old], sigma[old], year)
    new = np.flatnonzero(~old)
    stars[new] = len(master.year) + np.arange(len(new))
    master.extend(places[:, new], sigma[new], year)
    return stars


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
    # Nearest first: of several rows that claim one star, one may have it.
    rows = np.flatnonzero(inside)
    rows = rows[np.argsort(distance[rows, 0], kind='stable')]
    claimed, winner, counts = np.unique(stars[rows], return_index=True,
                                        return_counts=True)
    stars[rows] = -1
    stars[rows[winner]] = claimed
    master.ambiguous[claimed[counts > 1]] = True
    master.ambiguous[first[doubt]] = True
    return stars


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
        rms = 1.4826 * np.median(np.hypot(*residual)) / np.sqrt(2)
        reach = min(reach, max(6 * rms, reach / 4))
    return matrix, rms
