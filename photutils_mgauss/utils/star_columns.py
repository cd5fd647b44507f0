"""Tables of sources as the user hands them over."""
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

_X_NAMES = ('x', 'x_fit', 'x_init', 'x_centroid', 'xcentroid', 'x_0')
_FLUX_NAMES = ('flux', 'flux_fit', 'flux_init', 'flux_0')


@dataclass(frozen=True, eq=False)
class Sources:
    """x, y, flux (NaN if unknown) of all sources, and which are stars."""

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    selected: np.ndarray


def read_sources(stars):
    """Return x, y and, where there is one, the flux of a table of stars."""
    if not isinstance(stars, Table):
        msg = f'stars must be an astropy Table, got {type(stars).__name__}'
        raise TypeError(msg)
    name = next((n for n in _X_NAMES if n in stars.colnames), None)
    if name is None:
        msg = f'stars must have a column x, got {stars.colnames}'
        raise ValueError(msg)
    x, y = _column(stars, name), _column(stars, 'y' + name.removeprefix('x'))
    flux = next((n for n in _FLUX_NAMES if n in stars.colnames), None)
    flux = np.full(x.size, np.nan) if flux is None else _column(stars, flux)
    selected = np.ones(x.size, bool)
    if 'selected' in stars.colnames:
        selected = np.asarray(stars['selected'], bool)
    return Sources(x, y, flux, selected)


def _column(table, name):
    if name not in table.colnames:
        msg = f'stars must have a column {name}, got {table.colnames}'
        raise ValueError(msg)
    column = table[name]
    column = getattr(column, 'value', column)
    return np.ma.filled(np.ma.asarray(column, float), np.nan)
