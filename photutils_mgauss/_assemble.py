"""From epochs and references to arrays: matched, and on one plane."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss._epoch import Epoch, plane_unit, read_epoch, sky_vectors
from photutils_mgauss._parallax import observer_position
from photutils_mgauss._references import (
    Catalogue,
    is_table,
    read_catalogue,
)
from photutils_mgauss._stacked import sandwich_2x2
from photutils_mgauss._tangent_plane import TangentPlane
from photutils_mgauss.alignment import tie_plane
from photutils_mgauss.matching import (
    Matches,
    match_ids,
    match_positions,
)


@dataclass(frozen=True, eq=False)
class Sightings:
    """
    All detections of n stars at E epochs, on one plane.

    Parameters
    ----------
    plane : `TangentPlane` or None
        None where nothing is known about the sky.
    unit : {'mas', 'pix'}
    names : (n,) `~numpy.ndarray`
        Identifiers of the stars.
    matches : `~photutils_mgauss.matching.Matches`
    places : (2, E, n) `~numpy.ndarray`
        Measured positions, NaN where there are none.
    covariance : (3, E, n) `~numpy.ndarray`
    years : (E, 1) or (E, n) `~numpy.ndarray`
        Julian years (TDB).
    usable : (E, n) bool `~numpy.ndarray`
        Detections with finite positions and good errors.
    flux : (E, n) `~numpy.ndarray`
    ties : list
        For each epoch None, or the map (2, 3) that took its own plane to
        the common one.
    catalogue : `Catalogue` or None
    references : (k,) int `~numpy.ndarray`
        The star of each object of the catalogue, -1 where not seen.
    """

    plane: TangentPlane | None
    unit: str
    names: np.ndarray
    matches: Matches
    places: np.ndarray
    covariance: np.ndarray
    years: np.ndarray
    usable: np.ndarray
    flux: np.ndarray
    ties: list
    catalogue: Catalogue | None
    references: np.ndarray

    @property
    def epoch_years(self):
        """Mean Julian year of each epoch, (E,)."""
        if self.years.shape[1] == 1:
            return self.years[:, 0]
        return np.nanmean(self.years, axis=1)

    def observers(self, epochs):
        """Return barycentric places (3, E, 1) or (3, E, n) [au]."""
        return np.stack([
            observer_position(epoch.observer, np.nan_to_num(
                years, nan=np.nanmean(years)))
            for epoch, years in zip(epochs, self.years, strict=True)],
            axis=1)


def check_epochs(epochs):
    """Return the epochs as a list, or raise for what cannot be fitted."""
    if isinstance(epochs, Epoch):
        msg = 'epochs must be a sequence of Epoch, got a single one'
        raise TypeError(msg)
    epochs = list(epochs)
    for epoch in epochs:
        if not isinstance(epoch, Epoch):
            msg = (f'epochs must be a sequence of Epoch, got '
                   f'{type(epoch).__name__}')
            raise TypeError(msg)
    if len(epochs) < 2:
        msg = f'epochs must be at least 2, got {len(epochs)}'
        raise ValueError(msg)
    years = [epoch.mean_year for epoch in epochs]
    if max(years) - min(years) <= 0:
        msg = (f'epochs must have a time baseline, got all '
               f'{len(years)} at {years[0]:.6f}')
        raise ValueError(msg)
    return epochs


def assemble(epochs, references, match):
    """
    Return the `Sightings` of epochs.

    ``references`` is what the fitter was given, ``match`` the way to match:
    an object with ``by`` and a ``tolerance(unit)``.
    """
    vectors = [sky_vectors(epoch) if epoch.is_sky else None
               for epoch in epochs]
    seen = [vector for vector in vectors if vector is not None]
    plane = _common_plane(seen)
    unit = _common_unit(epochs, references, plane)
    detections = [read_epoch(epoch, plane, vector) for epoch, vector in zip(
        epochs, vectors, strict=True)]
    catalogue = (read_catalogue(references, plane, unit)
                 if is_table(references) else None)
    by_id = _matches_by_id(detections, catalogue, match, unit)
    if by_id:
        matches, names = match_ids([one.ids for one in detections])
    else:
        matches, names = _match_on_plane(detections, catalogue, match, unit)
    _check_common(matches, detections)
    found = _find_references(catalogue, references, names, matches, epochs,
                             by_id)
    return _stack(plane, unit, names, matches, detections, catalogue, found)


def _common_plane(vectors):
    if not vectors:
        return None
    everything = np.concatenate(vectors, axis=1)
    if not np.isfinite(everything).all(axis=0).any():
        msg = ('epochs must have finite positions, got none inside the '
               'bounding box of its WCS')
        raise ValueError(msg)
    good = np.isfinite(everything).all(axis=0)
    return TangentPlane.around(everything[:, good])


def _common_unit(epochs, references, plane):
    if plane is not None:
        return 'mas'
    units = {plane_unit(epoch) for epoch in epochs}
    if is_table(references):
        unit = getattr(references['x'], 'unit', None) if (
            'x' in references.colnames) else None
        if unit is not None and unit.physical_type == 'angle':
            return 'mas'
    if len(units) > 1:
        msg = ('epochs must all have a scale or none, got columns in '
               'pixels and in angles; give pixel_scale')
        raise ValueError(msg)
    return units.pop()


def _matches_by_id(detections, catalogue, match, unit):
    """Return whether to match by identifier."""
    have = all(one.ids is not None for one in detections)
    on_sky = all(one.vectors is not None for one in detections)
    if match.by == 'id' and not have:
        msg = "epochs must all have a column 'id' to be matched by it"
        raise ValueError(msg)
    if match.by == 'sky' and not on_sky and match.radius is None:
        msg = ('match_radius must be given to match epochs without a WCS '
               'by position')
        raise ValueError(msg)
    if match.by != 'auto':
        return match.by == 'id'
    if not on_sky:
        if not have and match.radius is None:
            msg = ("epochs without a WCS must have a column 'id', or "
                   'match_radius must be given')
            raise ValueError(msg)
        return have
    return have and _same_objects(detections, catalogue,
                                  match.tolerance(unit))


def _same_objects(detections, catalogue, tolerance):
    """
    Return whether equal identifiers are equal places in the sky.

    The row numbers photutils gives its sources are not identifiers.
    """
    if len({one.ids.dtype.kind in 'iuf' for one in detections}) > 1:
        return False
    matches, _ = match_ids([one.ids for one in detections])
    places = matches.take([one.plane for one in detections])
    if not (np.isfinite(places[0]).sum(axis=0) > 1).any():
        return False
    common = np.isfinite(places[0]).sum(axis=0) > 1
    spread = (np.nanmax(places[..., common], axis=1)
              - np.nanmin(places[..., common], axis=1)).max(axis=0)
    return np.median(spread) < tolerance.pointing


def _match_on_plane(detections, catalogue, match, unit):
    tolerance = match.tolerance(unit)
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
    return matches, _names(matches, detections, catalogue, n_known)


def _names(matches, detections, catalogue, n_known):
    """Return the identifiers of stars matched by position."""
    n = matches.rows.shape[1]
    running = np.arange(n)
    if n_known and catalogue.ids is not None:
        if n == n_known:
            return catalogue.ids
        if catalogue.ids.dtype.kind in 'iu':
            start = catalogue.ids.max() + 1
            return np.append(catalogue.ids,
                             start + np.arange(n - n_known))
        return np.append(catalogue.ids.astype(str),
                         running[n_known:].astype(str))
    if any(one.ids is None for one in detections):
        return running
    ids = [one.ids for one in detections]
    if len({array.dtype.kind in 'iuf' for array in ids}) > 1:
        return running
    first = matches.seen.argmax(axis=0)
    names = np.concatenate([ids[e][matches.rows[e, first == e]]
                            for e in range(len(ids))])
    if len(np.unique(names)) < n or not matches.seen.any(axis=0).all():
        return running
    out = np.empty(n, dtype=names.dtype)
    out[np.argsort(first, kind='stable')] = names
    return out


def _check_common(matches, detections):
    found = matches.take([one.found for one in detections], fill=False)
    if not (found.sum(axis=0) > 1).any():
        msg = ('epochs must have stars in common, got none that is in two '
               'of them')
        raise ValueError(msg)


def _find_references(catalogue, references, names, matches, epochs, by_id):
    """Return the star number of each reference, -1 where there is none."""
    if references is None:
        return np.empty(0, dtype=int)
    if catalogue is None:
        return _named_references(references, names, matches, epochs)
    has_place = np.isfinite(catalogue.values[:2]).all(axis=0).any()
    if not by_id and has_place:
        return np.arange(len(catalogue.kinds))
    if catalogue.ids is None:
        msg = ("references must have a column 'id' for epochs matched by "
               'id, or whose references have no positions')
        raise ValueError(msg)
    return _lookup(catalogue.ids, names)


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


def _named_references(references, names, matches, epochs):
    """Return the stars that identifiers or a column mark as references."""
    if isinstance(references, str):
        marked = np.zeros(len(names), dtype=bool)
        for epoch, rows in zip(epochs, matches.rows, strict=True):
            mask = _marked(epoch.table, references)
            marked |= (rows >= 0) & mask[rows]
        return np.flatnonzero(marked)
    return _lookup(list(references), names)


def _marked(table, name):
    if name not in table.colnames:
        msg = (f'references must be a table, identifiers, or the name of a '
               f'column of every epoch, got {name!r}; there is '
               f'{table.colnames}')
        raise ValueError(msg)
    return np.ma.filled(np.ma.asarray(table[name]), False).astype(bool)


def _stack(plane, unit, names, matches, detections, catalogue, found):
    """Return the `Sightings`, planes without WCS tied to the others."""
    places = matches.take([one.plane for one in detections])
    years = [one.years for one in detections]
    if all(year.ndim == 0 for year in years):
        years = np.array(years)[:, None]
    else:
        years = matches.take([
            np.broadcast_to(year, one.found.shape)
            for year, one in zip(years, detections, strict=True)])
    usable = matches.take([one.usable for one in detections], fill=False)
    return Sightings(
        plane, unit, names, matches, places,
        matches.take([one.covariance for one in detections]), years, usable,
        matches.take([one.flux for one in detections]),
        [None] * len(detections), catalogue, found)


def tie_planes(sightings, on_sky, transform):
    """
    Return sightings whose planes without WCS lie on the common plane.

    The common plane is the catalogue's, or that of the epochs with a sky, or
    the first epoch's.
    """
    if all(on_sky) or transform.kind == 'none':
        return sightings
    targets, known = _targets(sightings, on_sky)
    places, covariance = sightings.places.copy(), sightings.covariance.copy()
    ties = list(sightings.ties)
    start = np.flatnonzero(on_sky)
    if not known and not len(start):
        targets = places[:, 0].copy()
    for e in np.flatnonzero(~np.asarray(on_sky)):
        aim = _at_epoch(sightings, targets, e) if known else targets
        ties[e] = _tie(places[:, e], aim, sightings.usable[e], transform, e)
        slope = ties[e][:, 1:]
        places[:, e] = ties[e][:, :1] + slope @ places[:, e]
        covariance[:, e] = sandwich_2x2(slope[..., None], covariance[:, e])
        if not known:
            targets = np.where(np.isfinite(targets), targets, places[:, e])
    return replace(sightings, places=places, covariance=covariance,
                   ties=ties)


def _targets(sightings, on_sky):
    """Return places (2, n) to tie to, and whether they are a catalogue's."""
    n = sightings.places.shape[2]
    targets = np.full((2, n), np.nan)
    found = sightings.references >= 0
    if sightings.catalogue is not None:
        values = sightings.catalogue.values[:2, found]
        targets[:, sightings.references[found]] = values
    if np.isfinite(targets[0]).sum() >= 3:
        return targets, True
    sky = np.flatnonzero(on_sky)
    if len(sky):
        part = sightings.places[:, sky]
        count = np.isfinite(part).sum(axis=1)
        with np.errstate(invalid='ignore'):
            targets = np.nansum(part, axis=1) / np.where(count, count,
                                                         np.nan)
    return targets, False


def _at_epoch(sightings, targets, e):
    """Return the catalogue's places at an epoch."""
    catalogue, out = sightings.catalogue, targets.copy()
    found = sightings.references >= 0
    years = sightings.epoch_years[e] - catalogue.year
    moved = (catalogue.values[:2] + np.nan_to_num(
        catalogue.motion()) * np.nan_to_num(years))
    out[:, sightings.references[found]] = moved[:, found]
    return out


def _tie(points, targets, usable, transform, e):
    """Fit the map of one plane onto its targets, without outliers."""
    good = usable & np.isfinite(targets).all(axis=0)
    for _ in range(8):
        if good.sum() < transform.n_references:
            msg = (f'epoch {e} must have at least {transform.n_references} '
                   f'stars in common with the others for the transform '
                   f'{transform.kind!r}, got {good.sum()}')
            raise ValueError(msg)
        tie = tie_plane(points[:, good], targets[:, good],
                        np.ones(good.sum()), transform)
        residual = np.hypot(*(targets - tie[:, :1] - tie[:, 1:] @ points))
        limit = 5 * np.median(residual[good])
        keep = usable & (residual <= max(limit, 1e-9))
        if (keep == good).all():
            break
        good = keep
    return tie
