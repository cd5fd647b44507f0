"""
The chips of a camera: one WCS each in an exposure.

An exposure with a single WCS is one chip that has no name.
"""
import numpy as np
from astropy.table import vstack

from photutils_mgauss.sky.wcs import (
    check_celestial,
    pixel_jacobian,
    pixel_to_vectors,
)


def joined_chips(pairs, names):
    """
    Return one table of all chips, with a column ``chip``, and their WCS.

    ``pairs`` are tables and WCS, ``names`` what chips are called, by default
    numbers from 0.
    """
    pairs = [tuple(pair) for pair in pairs]
    names = list(range(len(pairs))) if names is None else list(names)
    if not pairs or any(len(pair) != 2 for pair in pairs):
        msg = 'pairs must be a sequence of (table, wcs), one for each chip'
        raise ValueError(msg)
    if len(names) != len(pairs) or len(set(names)) < len(names):
        msg = (f'names must be different for each of the {len(pairs)} chips, '
               f'got {names}')
        raise ValueError(msg)
    tables = []
    for name, (table, wcs) in zip(names, pairs, strict=True):
        check_celestial(wcs, f'the wcs of chip {name}')
        tables.append(table.copy(copy_data=False))
        tables[-1]['chip'] = np.full(len(table), name)
    return (vstack(tables, metadata_conflicts='silent'),
            dict(zip(names, (wcs for _, wcs in pairs), strict=True)))


def rows_of_chips(epoch):
    """Yield the WCS and the rows of each chip of an epoch, and its name."""
    if epoch.chips is None:
        yield epoch.wcs, np.arange(len(epoch.table)), None
        return
    chip = np.asarray(epoch.table['chip'])
    for name, wcs in epoch.chips.items():
        yield wcs, np.flatnonzero(chip == name), name


def chip_numbers(epoch, names):
    """
    Return the numbers (n,) of the chips that the rows of an epoch are on.

    They count the ``names``, by default those of the epoch's own.
    """
    place = {name: k for k, name in enumerate(names or epoch.chips)}
    return np.array([place[name] for name in np.asarray(
        epoch.table['chip']).tolist()], dtype=int)


def vectors_of_chips(epoch, x, y):
    """Return ICRS unit vectors (3, n) of the pixels of an epoch with WCS."""
    out = np.full((3, len(x)), np.nan)
    for wcs, rows, _ in rows_of_chips(epoch):
        out[:, rows] = pixel_to_vectors(wcs, x[rows], y[rows])
    return out


def jacobian_of_chips(epoch, plane, x, y, turn=None):
    """Return d(plane)/d(pixel), (2, 2, n), of an epoch with WCS."""
    out = np.full((2, 2, len(x)), np.nan)
    for wcs, rows, _ in rows_of_chips(epoch):
        out[..., rows] = pixel_jacobian(wcs, plane, x[rows], y[rows], turn)
    return out
