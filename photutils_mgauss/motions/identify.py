"""Which stars are the reference objects."""
import numpy as np

from photutils_mgauss.motions.matching import match_positions


def find_references(catalogue, detections, years, tolerance):
    """
    Return the star (k,) of each object of a catalogue, -1 where not seen.

    ``detections`` are those of all stars at E epochs, whose mean Julian
    years are ``years`` (E,).
    """
    if catalogue.ids is not None:
        return _lookup(catalogue.ids, detections.ids)
    if not np.isfinite(catalogue.values[:2]).all(axis=0).any():
        msg = ("references must have a column 'id' or positions to be found "
               'among the stars')
        raise ValueError(msg)
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
