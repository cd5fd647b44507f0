"""
Which rows of several exposures are the same star.

Rows are matched by an identifier, or by position (``pairing``).
"""
from dataclasses import dataclass, fields, replace

import astropy.units as u
import numpy as np

from photutils_mgauss.motions.baseline import COMMON
from photutils_mgauss.motions.detections import Detections
from photutils_mgauss.motions.pairing import (
    Known,
    Matches,
    Tolerance,
    match_positions,
)
from photutils_mgauss.sky.space_motion import NO_ERROR

POINTING = 2000.0  # mas: offsets of exposures that are looked for


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
            if not self.radius.unit.is_equivalent(unit):
                msg = (f'match_radius must be in a unit like {unit}, as the '
                       f'positions of the epochs are, got {self.radius}')
                raise ValueError(msg)
            radius = self.radius.to_value(unit)
        if unit == 'pix':
            return Tolerance(radius, 0.0, 20 * (radius or 0.0))
        pointing = POINTING if radius is None else max(POINTING, 2 * radius)
        return Tolerance(radius, self.max_motion.to_value(u.mas / u.yr),
                         pointing)


def match_epochs(detections, on_sky, catalogue, how, unit, orient):
    """
    Match epochs by identifier or position, as their user wants it.

    Parameters
    ----------
    detections : list of `~photutils_mgauss.motions.detections.Detections`
        Of which none are left in the end: those of all stars take over.
    on_sky : bool
        Whether all epochs have places in the sky.
    catalogue : `~photutils_mgauss.motions.references.Catalogue` or None
        Reference objects, matched along by position.
    how : `HowToMatch`
    unit : {'mas', 'pix'}
    orient : callable
        Returns the maps onto the common plane of epochs without a sky, by
        the pattern of their stars, and sentences on them.

    Returns
    -------
    every : `~photutils_mgauss.motions.detections.Detections`
        Those of all n stars at E epochs, and the names of the stars.
    matches : `Matches`
        Every star is in some epoch.
    known : (k,) int `~numpy.ndarray` or None
        The star of each object of the catalogue, -1 where it is in no
        epoch; None where it has no positions or is not matched by them.
    notes : tuple of str
        How epochs without a sky were found to be turned.
    """
    if _is_by_id(detections, on_sky, how, unit):
        matches, names = match_ids([one.ids for one in detections])
        return _stack(matches, names, detections), matches, None, ()
    known = _known_places(detections, catalogue)
    matches, notes = _match_on_plane(detections, on_sky, known, how, unit,
                                     orient)
    matches, names, known = _named(matches, detections, catalogue, known)
    return _stack(matches, names, detections), matches, known, notes


def _stack(matches, names, detections):
    """Return the `Detections` of all stars at all epochs, using them up."""
    lists = {field.name: [getattr(one, field.name) for one in detections]
             for field in fields(Detections)}
    # One kind after another goes, or all that was read would be there twice.
    detections.clear()

    def take(name, fill=np.nan):
        return matches.take(lists.pop(name), fill)
    n = len(names)
    return Detections(
        names, covariance=take('covariance'), plane=take('plane'),
        years=_stacked_years(matches, lists.pop('years'), lists['found']),
        found=take('found', False), usable=take('usable', False),
        flux=_mean(take('flux'), n),
        radial_velocity=_mean(take('radial_velocity'), n),
        velocity_error=_largest(take('velocity_error'), n),
        magnitude=take('magnitude'), colour=take('colour'),
        chip=take('chip', -1), pixels=take('pixels'),
        jacobian=take('jacobian'))


def _stacked_years(matches, years, found):
    """Return years (E, 1), or (E, n) where rows have times of their own."""
    if all(year.ndim == 0 for year in years):
        return np.array(years)[:, None]
    return matches.take([np.broadcast_to(year, one.shape)
                         for year, one in zip(years, found, strict=True)])


def _mean(values, n):
    """Return the means (n,) of what is known of stars at E epochs."""
    if values is None:
        return np.full(n, np.nan)
    known = np.isfinite(values)
    count = known.sum(axis=0)
    return (np.where(known, values, 0.0).sum(axis=0)
            / np.where(count, count, np.nan))


def _largest(values, n):
    """Return the largest (n,) of what is known of stars at E epochs."""
    return np.full(n, np.nan) if values is None else np.fmax.reduce(values)


def _is_by_id(detections, on_sky, how, unit):
    """Return whether to match by identifier."""
    have = all(one.ids is not None for one in detections)
    if how.by == 'id' and not have:
        msg = "epochs must all have a column 'id' to be matched by it"
        raise ValueError(msg)
    if how.by == 'sky' and not on_sky and how.radius is None:
        msg = ('match_radius (--match-radius) must be given to match epochs '
               'without a WCS by position')
        raise ValueError(msg)
    if how.by != 'auto':
        return how.by == 'id'
    if not on_sky:
        if not have and how.radius is None:
            msg = ("epochs without a WCS must have a column 'id', or "
                   'match_radius (--match-radius) must be given, or '
                   "match_by='pattern' (--match-by pattern)")
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


def _known_places(detections, catalogue):
    """Return the `Known` stars, None for a catalogue without positions."""
    if catalogue is None or not np.isfinite(catalogue.values[:2]).any():
        return None
    return _known(catalogue, float(np.nanmean(detections[0].years)))


def _match_on_plane(detections, on_sky, known, how, unit, orient):
    """
    Return matches by position, and sentences on what that took.

    Planes without a sky may be turned, and are if it makes more matches.
    """
    tolerance = how.tolerance(unit)
    if how.by == 'pattern' and not on_sky:
        maps, notes = orient()
        return _match_turned(detections, known, tolerance, maps), notes
    matches = _match_turned(detections, known, tolerance,
                            [None] * len(detections))
    if on_sky or not _are_few(matches, known):
        return matches, ()
    try:
        maps, notes = orient()
    except ValueError:  # No pattern: they stay as they are, and that is said.
        return matches, ()
    turned = _match_turned(detections, known, tolerance, maps)
    if _common(turned, known).sum() <= _common(matches, known).sum():
        return matches, ()
    return turned, notes


def _common(matches, known):
    """Return how many stars (E,) of each epoch are known from elsewhere."""
    seen = matches.seen
    count = seen.sum(axis=0)
    if known is not None:
        count[:known.position.shape[1]] += 1
    return (seen & (count > 1)).sum(axis=1)


def _are_few(matches, known):
    """Return whether most stars of some epoch are nowhere else."""
    return (_common(matches, known) < COMMON * matches.seen.sum(axis=1)).any()


def _match_turned(detections, known, tolerance, maps):
    """Return matches by position of planes that maps bring together."""
    years = [float(np.nanmean(one.years)) for one in detections]
    places, sigmas, reach = [], [], 0.0
    for one, found in zip(detections, maps, strict=True):
        sigma = one.sigma
        if found is not None:
            sigma *= np.sqrt(abs(np.linalg.det(found.matrix[:, 1:])))
            reach = max(reach, found.reach)
        places.append(one.plane if found is None else found.apply(one.plane))
        sigmas.append(sigma)
    if reach and tolerance.radius is None and tolerance.max_motion == 0:
        # Pixels, whose motions nobody knows a limit of.
        tolerance = replace(tolerance, radius=reach)
    return match_positions(places, sigmas, years, tolerance, known,
                           [one.chip for one in detections])


def _named(matches, detections, catalogue, known):
    """
    Return the matches of stars in some epoch, their names, and which is which.

    The last are the stars (k,) that the objects of the catalogue are, None
    for one without positions.
    """
    n_known = 0 if known is None else known.position.shape[1]
    seen = matches.seen.any(axis=0)
    number = np.where(seen, np.cumsum(seen) - 1, -1)
    matches = Matches(matches.rows[:, seen], matches.ambiguous[seen])
    if known is None or catalogue.ids is None:
        names = _names_of_epochs(matches, detections)
    else:
        names = _names_of_catalogue(catalogue.ids[seen[:n_known]],
                                    matches.rows.shape[1])
    return matches, names, None if known is None else number[:n_known]


def _known(catalogue, year):
    """Return the `Known` stars of a catalogue, at ``year`` if not dated."""
    variance = np.einsum('kkn->kn', catalogue.covariance)
    # An error that nobody knows is none, as it is for detections.
    sigma, drift = (np.sqrt(np.where(some < NO_ERROR, some, 0.0).mean(axis=0))
                    for some in (variance[:2], variance[2:4]))
    return Known(catalogue.values[:2], catalogue.motion(),
                 np.nan_to_num(catalogue.year, nan=year), sigma,
                 np.where(catalogue.fixed, 0.0, drift),
                 np.where(catalogue.fixed, 0.0, np.maximum(np.nan_to_num(
                     catalogue.values[4]), 0.0)))


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
    found, sigma = np.full(len(catalogue.kinds), -1), detections.sigma
    for e, year in enumerate(years):
        # Epoch by epoch: frames that differ would blur a star's mean place.
        known = _known(catalogue, year)
        matches = match_positions([detections.plane[:, e]], [sigma[e]],
                                  [year], tolerance, known)
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
