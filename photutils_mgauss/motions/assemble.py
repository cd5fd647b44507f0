"""From epochs and references to arrays: matched, and on one plane."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.motions.epoch import (
    Epoch,
    plane_unit,
    read_epoch,
    sky_vectors,
)
from photutils_mgauss.motions.frames import tie_plane
from photutils_mgauss.motions.matching import (
    Matches,
    match_ids,
    match_positions,
)
from photutils_mgauss.motions.references import (
    Catalogue,
    is_table,
    read_catalogue,
)
from photutils_mgauss.motions.stacked import sandwich_2x2
from photutils_mgauss.sky.observers import observer_position
from photutils_mgauss.sky.tangent_plane import TangentPlane

TRIALS = 300   # maps through a few stars that are tried for a plane
FAR = 0.01     # of the field: how far a star may be from its place
AGREED = 0.25  # least part of the stars that has to agree with a map
COMMON = 0.5   # part of an epoch's stars in another one, if all is well


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
    matches : `~photutils_mgauss.motions.matching.Matches`
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
    agreed : (n,) bool `~numpy.ndarray`
        Stars that lie where ``ties`` puts them, within a few residuals.
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
    agreed: np.ndarray

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
    plane = _common_plane(vectors)
    unit = _common_unit(epochs, references, plane)
    # Popped, so that a million directions are kept no longer than needed.
    detections = [read_epoch(epoch, plane, vectors.pop(0))
                  for epoch in epochs]
    on_sky = all(epoch.is_sky for epoch in epochs)
    catalogue = (read_catalogue(references, plane, unit)
                 if is_table(references) else None)
    by_id = _matches_by_id(detections, on_sky, match, unit)
    if by_id:
        matches, names = match_ids([one.ids for one in detections])
        known = None
    else:
        matches, names, known = _match_on_plane(detections, catalogue,
                                                match.tolerance(unit))
    _check_common(matches, detections)
    sightings = _stack(plane, unit, names, matches, detections, catalogue)
    if references is None:
        return sightings
    if catalogue is None:
        known = _named_references(references, names, matches, epochs)
    elif known is None:
        known = _find_references(sightings, match.tolerance(unit))
    return replace(sightings, references=known)


def _common_plane(vectors):
    """Return the plane at the mean direction, None if there is no sky."""
    seen = [vector for vector in vectors if vector is not None]
    if not seen:
        return None
    total = sum(np.nansum(vector, axis=1) for vector in seen)
    if not total.any():
        msg = ('epochs must have finite positions, got none inside the '
               'bounding boxes of their WCS')
        raise ValueError(msg)
    return TangentPlane.around(total)


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


def _matches_by_id(detections, on_sky, match, unit):
    """Return whether to match by identifier."""
    have = all(one.ids is not None for one in detections)
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
    return have and _same_objects(detections, match.tolerance(unit))


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


def _check_common(matches, detections):
    found = matches.take([one.found for one in detections], fill=False)
    if not (found.sum(axis=0) > 1).any():
        msg = ('epochs must have stars in common, got none that is in two '
               'of them')
        raise ValueError(msg)


def few_in_common(sightings):
    """Return a sentence for each epoch most of whose stars are alone."""
    seen = sightings.matches.seen
    shared = (seen & (seen.sum(axis=0) > 1)).sum(axis=1)
    return tuple(
        f'Only {some} of the {total} stars of epoch {e} were found in another '
        'epoch: if there should be more, its pointing may be off by more '
        'than matching looks for; see match_by and match_radius.'
        for e, (some, total) in enumerate(zip(shared, seen.sum(axis=1),
                                              strict=True))
        if some < COMMON * total)


def _find_references(sightings, tolerance):
    """Return the star of each object of a catalogue, -1 where not seen."""
    catalogue = sightings.catalogue
    if catalogue.ids is not None:
        return _lookup(catalogue.ids, sightings.names)
    if not np.isfinite(catalogue.values[:2]).all(axis=0).any():
        msg = ("references must have a column 'id' or positions to be found "
               'among the stars')
        raise ValueError(msg)
    found = np.full(len(catalogue.kinds), -1)
    for e in range(len(sightings.epoch_years)):
        # Epoch by epoch: frames that differ would blur a star's mean place.
        stars = _find_in_epoch(sightings, e, tolerance)
        new = (found < 0) & ~np.isin(stars, found)
        found[new] = stars[new]
    return found


def _find_in_epoch(sightings, e, tolerance):
    catalogue, year = sightings.catalogue, sightings.epoch_years[e]
    sigma = np.sqrt(sightings.covariance[[0, 2], e].mean(axis=0))
    known = (catalogue.values[:2], catalogue.motion(),
             np.nan_to_num(catalogue.year, nan=year))
    matches = match_positions([sightings.places[:, e]], [sigma], [year],
                              tolerance, known)
    return matches.rows[0, :len(catalogue.kinds)]


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
            seen = rows >= 0
            marked[seen] |= _marked(epoch.table, references)[rows[seen]]
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


def _stack(plane, unit, names, matches, detections, catalogue):
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
        [None] * len(detections), catalogue, np.empty(0, dtype=int),
        np.ones(len(names), dtype=bool))


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
    ties, agreed = list(sightings.ties), sightings.agreed.copy()
    start = np.flatnonzero(on_sky)
    if not known and not len(start):
        targets = places[:, 0].copy()
    for e in np.flatnonzero(~np.asarray(on_sky)):
        aim = _at_epoch(sightings, targets, e) if known else targets
        ties[e], far = _tie(places[:, e], aim, sightings.usable[e],
                            transform, e)
        agreed &= ~far
        slope = ties[e][:, 1:]
        places[:, e] = ties[e][:, :1] + slope @ places[:, e]
        covariance[:, e] = sandwich_2x2(slope[..., None], covariance[:, e])
        if not known:
            targets = np.where(np.isfinite(targets), targets, places[:, e])
    return replace(sightings, places=places, covariance=covariance,
                   ties=ties, agreed=agreed)


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
    """Return the map of a plane onto its targets, and outliers (n,)."""
    common = usable & np.isfinite(targets).all(axis=0)
    good = common
    for k in range(8):
        if good.sum() < transform.n_references:
            msg = (f'epoch {e} must have at least {transform.n_references} '
                   f'stars in common with the others for the transform '
                   f'{transform.kind!r}, got {good.sum()}')
            raise ValueError(msg)
        if k == 0:
            tie = _most_agreed(points[:, common], targets[:, common],
                               transform)
        else:
            tie = tie_plane(points[:, good], targets[:, good],
                            np.ones(good.sum()), transform)
        residual = np.hypot(*(targets - tie[:, :1] - tie[:, 1:] @ points))
        keep = common & (residual <= _limit(residual[good], k == 0))
        if (keep == good).all():
            break
        good = keep
    # A star may move fast and still be itself: one in the wrong place by a
    # part of the whole field is not.
    extent = FAR * np.max(np.ptp(targets[:, common], axis=1))
    if common.sum() > 3 and np.median(residual[good]) > 10 * extent > 0:
        msg = (f'epoch {e} must agree with the others on which star is '
               f'which, got {common.sum()} common stars that no map brings '
               'together: are the identifiers those of the same stars?')
        raise ValueError(msg)
    return tie, common & (residual > max(
        extent, 3 * _limit(residual[good], False)))


def _limit(residuals, first):
    """Return how far stars that belong to a tie may lie from it."""
    if first:
        return max(5 * np.quantile(residuals, AGREED), 1e-9)
    return max(5 * np.median(residuals), 1e-9)


def _most_agreed(points, targets, transform):
    """
    Return the map, of many through a few stars, most stars agree with.

    Identifiers that are wrong for most of the stars, such as running numbers
    of those without a name, do no harm as long as a quarter is right.
    """
    # Polynomials are tied by affine maps, which three stars make.
    n, size = points.shape[1], min(transform.n_references, 3)
    best = tie_plane(points, targets, np.ones(n), transform)
    extent = FAR * np.max(np.ptp(targets, axis=1))
    if n < 4 * size or _agreed(points, targets, best, 0.9) < extent:
        return best
    rng = np.random.default_rng(0)
    least = _agreed(points, targets, best)
    for _ in range(TRIALS):
        some = rng.choice(n, size + 1, replace=False)
        tie = tie_plane(points[:, some], targets[:, some],
                        np.ones(len(some)), transform)
        residual = _agreed(points, targets, tie)
        if residual < least:
            best, least = tie, residual
    return best


def _agreed(points, targets, tie, part=AGREED):
    """Return the distance within which a part of the stars agrees."""
    residual = targets - tie[:, :1] - tie[:, 1:] @ points
    return np.quantile(np.hypot(*residual), part)
