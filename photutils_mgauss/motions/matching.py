"""
Which rows of several exposures are the same star.

Rows are matched by an identifier, or by position: one to one, nearest first,
within a tolerance that comes from the errors, the time between the exposures
and the known motions. Stars missing from some exposures are kept.
"""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss.motions.epoch import Detections
from photutils_mgauss.utils.robust import std_about_zero

# Field stars that tie one exposure to the next one before it is matched.
SAMPLE = 20000
N_SIGMA = 5.0
POINTING = 2000.0  # mas: offsets of exposures that are looked for


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
    rows = np.flatnonzero(stars < 0)
    taken = np.zeros(len(master.year), dtype=bool)
    taken[claimed] = True
    free = known[~taken[known]]
    if len(rows) and len(free):
        stars[rows] = _pair_left(master, free, places[:, rows], sigma[rows],
                                 year, tolerance, slack)
        master.ambiguous[stars[rows][stars[rows] >= 0]] = True
    return stars


def _pair_left(master, free, places, sigma, year, tolerance, slack):
    """
    Return for rows that are left the star that is left for them, or -1.

    A fast star is not the one nearest to where it was; but it is paired only
    where no other row and no other star is within the tolerance.
    """
    bound = tolerance.between(master, free, sigma.max(), year, slack).max()
    tree = cKDTree(master.at(year)[:, free].T)
    distance, near = tree.query(places.T, k=2, distance_upper_bound=bound)
    star = np.append(free, -1)[near]
    inside = [(star[:, k] >= 0) & (distance[:, k] <= tolerance.between(
        master, star[:, k], sigma, year, slack)) for k in range(2)]
    found = np.where(inside[0] & ~inside[1], star[:, 0], -1)
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


@dataclass(frozen=True)
class HowToMatch:
    """How epochs are matched; see `ProperMotionFitter`."""

    by: str
    radius: u.Quantity | None
    max_motion: u.Quantity

    def tolerance(self, unit):
        """Return the `Tolerance` in the units of a frame."""
        radius = None
        if self.radius is not None:
            radius = self.radius.to_value(u.Unit(unit))
        if unit == 'pix':
            return Tolerance(radius, 0.0, 20 * (radius or 0.0))
        pointing = POINTING if radius is None else max(POINTING, 2 * radius)
        return Tolerance(radius, self.max_motion.to_value(u.mas / u.yr),
                         pointing)


def match_epochs(detections, on_sky, catalogue, how, unit):
    """
    Match epochs by identifier or position, as their user wants it.

    Parameters
    ----------
    detections : list of `~photutils_mgauss.motions.epoch.Detections`
    on_sky : bool
        Whether all epochs have places in the sky.
    catalogue : `~photutils_mgauss.motions.references.Catalogue` or None
        Reference objects, matched along by position.
    how : `HowToMatch`
    unit : {'mas', 'pix'}

    Returns
    -------
    every : `~photutils_mgauss.motions.epoch.Detections`
        Those of all n stars at E epochs, and the names of the stars.
    matches : `Matches`
        Every star is in some epoch.
    known : (k,) int `~numpy.ndarray` or None
        The star of each object of the catalogue, -1 where it is in no
        epoch; None where it has no positions or is not matched by them.
    """
    if _is_by_id(detections, on_sky, how, unit):
        matches, names = match_ids([one.ids for one in detections])
        known = None
    else:
        matches, names, known = _match_on_plane(detections, catalogue,
                                                how.tolerance(unit))
    every = _stack(matches, names, detections)
    if not (every.found.sum(axis=0) > 1).any():
        msg = ('epochs must have stars in common, got none that is in two '
               'of them')
        raise ValueError(msg)
    return every, matches, known


def _stack(matches, names, detections):
    """Return the `Detections` of all stars at all epochs."""
    def take(name, fill=np.nan):
        return matches.take([getattr(one, name) for one in detections], fill)
    years = [one.years for one in detections]
    if all(year.ndim == 0 for year in years):
        years = np.array(years)[:, None]
    else:
        years = matches.take([
            np.broadcast_to(year, one.found.shape)
            for year, one in zip(years, detections, strict=True)])
    return Detections(names, take('plane'), take('covariance'), years,
                      _mean(take('flux')), _mean(take('radial_velocity')),
                      take('found', False), take('usable', False))


def _mean(values):
    """Return the means (n,) of what is known of stars at E epochs."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return (np.where(known, values, 0.0).sum(axis=0)
            / np.where(count, count, np.nan))


def _is_by_id(detections, on_sky, how, unit):
    """Return whether to match by identifier."""
    have = all(one.ids is not None for one in detections)
    if how.by == 'id' and not have:
        msg = "epochs must all have a column 'id' to be matched by it"
        raise ValueError(msg)
    if how.by == 'sky' and not on_sky and how.radius is None:
        msg = ('match_radius must be given to match epochs without a WCS '
               'by position')
        raise ValueError(msg)
    if how.by != 'auto':
        return how.by == 'id'
    if not on_sky:
        if not have and how.radius is None:
            msg = ("epochs without a WCS must have a column 'id', or "
                   'match_radius must be given')
            raise ValueError(msg)
        return have
    return have and _same_objects(detections, how.tolerance(unit))


def _same_objects(detections, tolerance):
    """
    Return whether equal identifiers are equal places in the sky.

    The row numbers photutils gives its sources are not identifiers.
    """
    if len({one.ids.dtype.kind in 'iuf' for one in detections}) > 1:
        return False
    matches, _ = match_ids([one.ids for one in detections])
    places = matches.take([one.plane for one in detections])
    common = np.isfinite(places[0]).sum(axis=0) > 1
    if not common.any():
        return False
    places = _without_offsets(places[..., common])
    spread = (np.nanmax(places, axis=1)
              - np.nanmin(places, axis=1)).max(axis=0)
    return np.median(spread) < tolerance.pointing


def _without_offsets(places):
    """Return places (2, E, n) less what each epoch is off in common."""
    for _ in range(5):  # Stars that are missing from epochs blur the mean.
        away = places - np.nanmean(places, axis=1, keepdims=True)
        offset = np.array([[np.median(one[np.isfinite(one)])
                            if np.isfinite(one).any() else 0.0
                            for one in axis] for axis in away])
        places = places - offset[..., None]
    return places


def _match_on_plane(detections, catalogue, tolerance):
    """
    Return matches by position, names, and the stars of the catalogue.

    The last is None for a catalogue without positions; its objects that no
    epoch has seen are not among the stars.
    """
    years = [float(np.nanmean(one.years)) for one in detections]
    sigmas = []
    for one in detections:
        with np.errstate(invalid='ignore'):
            sigmas.append(np.sqrt((one.covariance[0]
                                   + one.covariance[2]) / 2))
    known = None
    if catalogue is not None and np.isfinite(catalogue.values[:2]).any():
        known = (catalogue.values[:2], catalogue.motion(),
                 np.nan_to_num(catalogue.year, nan=years[0]))
    matches = match_positions([one.plane for one in detections], sigmas,
                              years, tolerance, known)
    n_known = 0 if known is None else known[0].shape[1]
    seen = matches.seen.any(axis=0)
    number = np.where(seen, np.cumsum(seen) - 1, -1)
    matches = Matches(matches.rows[:, seen], matches.ambiguous[seen])
    if known is None or catalogue.ids is None:
        names = _names_of_epochs(matches, detections)
    else:
        names = _names_of_catalogue(catalogue.ids[seen[:n_known]],
                                    matches.rows.shape[1])
    return matches, names, None if known is None else number[:n_known]


def _names_of_catalogue(ids, n):
    """Return the catalogue's identifiers, and new ones for the rest."""
    rest = np.arange(n - len(ids))
    if ids.dtype.kind in 'iu':
        return np.append(ids, (ids.max() + 1 if len(ids) else 0) + rest)
    return np.append(ids.astype(str), [f'new{k}' for k in rest])


def _names_of_epochs(matches, detections):
    """Return the epochs' identifiers if they are unique, else numbers."""
    n = matches.rows.shape[1]
    ids = [one.ids for one in detections]
    if any(one is None for one in ids) or len(
            {one.dtype.kind in 'iuf' for one in ids}) > 1:
        return np.arange(n)
    first = matches.seen.argmax(axis=0)
    names = np.concatenate([ids[e][matches.rows[e, first == e]]
                            for e in range(len(ids))])
    if len(np.unique(names)) < n:
        return np.arange(n)
    out = np.empty(n, dtype=names.dtype)
    out[np.argsort(first, kind='stable')] = names
    return out


def find_references(catalogue, detections, years, tolerance):
    """
    Return the star (k,) of each object of a catalogue, -1 where not seen.

    ``detections`` are those of all stars at E epochs, whose mean Julian
    years are ``years`` (E,).
    """
    if catalogue.ids is not None:
        return _lookup(catalogue.ids, detections.ids)
    found = np.full(len(catalogue.kinds), -1)
    for e, year in enumerate(years):
        # Epoch by epoch: frames that differ would blur a star's mean place.
        known = (catalogue.values[:2], catalogue.motion(),
                 np.nan_to_num(catalogue.year, nan=year))
        sigma = np.sqrt(detections.covariance[[0, 2], e].mean(axis=0))
        matches = match_positions([detections.plane[:, e]], [sigma], [year],
                                  tolerance, known)
        stars = matches.rows[0, :len(found)]
        new = (found < 0) & ~np.isin(stars, found)
        found[new] = stars[new]
    return found


def _lookup(ids, names):
    ids = np.asarray(ids)
    if (ids.dtype.kind in 'iuf') != (names.dtype.kind in 'iuf'):
        msg = (f'references must have identifiers like those of the epochs, '
               f'got {ids.dtype} and {names.dtype}')
        raise TypeError(msg)
    order = np.argsort(names)
    place = np.searchsorted(names, ids, sorter=order)
    place = order[np.minimum(place, len(names) - 1)]
    return np.where(names[place] == ids, place, -1)


def named_references(references, names, rows, epochs):
    """
    Return the stars that identifiers or a column mark as references.

    ``rows`` (E, n) are those of the stars in the tables of the epochs, -1
    where they are missing.
    """
    if isinstance(references, str):
        marked = np.zeros(len(names), dtype=bool)
        for epoch, row in zip(epochs, rows, strict=True):
            seen = row >= 0
            marked[seen] |= _marked(epoch.table, references)[row[seen]]
        return np.flatnonzero(marked)
    if not np.iterable(references):
        msg = ('references must be a table, identifiers, or the name of a '
               f'column of every epoch, got {references!r}')
        raise TypeError(msg)
    return _lookup(list(references), names)


def _marked(table, name):
    if name not in table.colnames:
        msg = (f'references must be a table, identifiers, or the name of a '
               f'column of every epoch, got {name!r}; there is '
               f'{table.colnames}')
        raise ValueError(msg)
    return np.ma.filled(np.ma.asarray(table[name]), False).astype(bool)
