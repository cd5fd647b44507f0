"""Tables of stars as the user hands them over, read once for all."""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import MaskedColumn, Table

# What may stand behind x, y and flux in the names of columns, in order of
# preference.
_ENDINGS = ('', '_fit', '_init', '_0', '_centroid', 'centroid', '_peak')


@dataclass(frozen=True, eq=False)
class Sources:
    """x, y, flux (NaN if unknown) of all sources, and which are stars."""

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    selected: np.ndarray


def check_table(table, name='table', needed=()):
    """Raise an error unless it is a table that has the columns needed."""
    if not isinstance(table, Table):
        msg = f'{name} must be an astropy Table, got {type(table).__name__}'
        raise TypeError(msg)
    missing = [column for column in needed if column not in table.colnames]
    if missing:
        msg = f'{name} must have the column {missing[0]}, got none'
        raise ValueError(msg)


def read_sources(table, name='stars', *, first='', unit=None):
    """
    Return where the stars of a table are, and their fluxes if it has them.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With the columns ``x`` and ``y``, or with ``x_fit``, ``x_init``,
        ``x_0``, ``x_centroid``, ``xcentroid`` or ``x_peak`` and their likes.
    name : str, optional
        What the call calls it, for messages.
    first : str, optional
        The ending of the columns that go before all others.
    unit : `~astropy.units.UnitBase`, optional
        That of the image, into which fluxes with another are converted.

    Returns
    -------
    Sources
    """
    check_table(table, name)
    endings = dict.fromkeys((first, *_ENDINGS))
    end = next((e for e in endings if f'x{e}' in table.colnames), None)
    if end is None or f'y{end}' not in table.colnames:
        msg = (f'{name} must have columns x{first} and y{first} or their '
               f'likes, got {table.colnames}')
        raise ValueError(msg)
    x, y = (column_values(table, f'{axis}{end}', u.pix) for axis in 'xy')
    flux = first_values(table, [f'flux{e}' for e in endings], unit)
    return Sources(x, y, flux, _selected(table))


def _selected(table):
    if 'selected' not in table.colnames:
        return np.ones(len(table), bool)
    return np.asarray(np.ma.filled(table['selected'], False), bool)


def words_column(words):
    """
    Return a column of words, empty ones included, none of them masked.

    ECSV takes the empty words of other columns for missing ones when they
    are read again.
    """
    column = MaskedColumn(words)
    column.info.serialize_method['ecsv'] = 'data_mask'
    return column


def find_column(table, names):
    """Return the first of some names that a table has, or None."""
    return next((name for name in names if name in table.colnames), None)


def first_values(table, names, unit=None):
    """Return the first of some columns as floats, NaN if there is none."""
    name = find_column(table, names)
    if name is None:
        return np.full(len(table), np.nan)
    return column_values(table, name, unit)


def column_values(table, name, unit=None):
    """
    Return a column as float64, NaN where masked.

    Parameters
    ----------
    table : `~astropy.table.Table`
    name : str
        Of the column.
    unit : `~astropy.units.UnitBase`, optional
        What a column with a unit is converted to; one without is taken to be
        in it. By default the numbers are taken as they are.

    Returns
    -------
    (n,) `~numpy.ndarray`

    Raises
    ------
    TypeError, ValueError
        If the column does not hold numbers, or has a unit of another kind.
    """
    return plain_values(table[name], unit, f'column {name!r}')


def plain_values(column, unit=None, name='column'):
    """Do the same for a column that is not in a table any more."""
    own = getattr(column, 'unit', None)
    own = None if own is None or own == '' else u.Unit(own)
    try:
        values = np.ma.filled(np.ma.asarray(
            getattr(column, 'value', column), dtype=float), np.nan)
    except (TypeError, ValueError) as error:
        msg = f'{name} must hold numbers'
        raise TypeError(msg) from error
    values = np.array(values)
    values[getattr(column, 'mask', False)] = np.nan
    if unit is None or own is None:
        return values
    try:
        return values * own.to(unit) if own != unit else values
    except u.UnitConversionError as error:
        msg = f'{name} must have a unit like {unit}, got {own}'
        raise ValueError(msg) from error
