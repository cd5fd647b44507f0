"""From where exposures were taken: a name, or a table of places."""
from functools import cache
from pathlib import Path

from photutils_mgauss.cli import tools

_NAMES = ('earth', 'leo', 'l2')
# What columns of times are called, also in tables of ephemerides.
_TIMES = ('time', 'jd_tdb', 'jdtdb', 'datetime_jd', 'jd', 'mjd', 'jyear')


def check_observer(name, n):
    """Raise if ``--observer`` is nothing for n exposures."""
    if name is None or name.lower() in _NAMES:
        return
    if not Path(name).is_file():
        msg = (f'--observer must be {", ".join(_NAMES)} or the name of a '
               f'table of places, got {name}')
        raise ValueError(msg)
    with tools.about(name):
        years, places = _read(name)
        if years is None and len(places) != n:
            msg = (f'must have a column of times ({", ".join(_TIMES)}), or a '
                   f'row for each of the {n} exposures, got {len(places)}')
            raise ValueError(msg)


def observer_at(name, path, paths, time):
    """
    Return what `Epoch` takes as the observer of an exposure.

    Places between the times of a table are interpolated by cubic splines.

    Parameters
    ----------
    name : str or None
        The value of ``--observer``.
    path : str
        The exposure, one of ``paths``.
    time : `~astropy.time.Time`, float or column of these
        When it was taken.
    """
    if name is None or name.lower() in _NAMES:
        return name
    import numpy as np
    from astropy.coordinates import CartesianRepresentation

    from photutils_mgauss.sky.observers import julian_years
    years, places = _read(name)
    if years is None:
        place = places[paths.index(str(path))]
    else:
        place = _interpolated(name, years, places,
                              float(np.nanmean(julian_years(time))))
    return CartesianRepresentation(*place, unit='au')


@cache
def _read(name):
    """Return Julian years (n,) or None, and places (n, 3) [au]."""
    import astropy.units as u
    import numpy as np

    from photutils_mgauss.files.tables import read_table
    table, _ = read_table(name)
    columns = {column.lower(): table[column] for column in table.colnames}
    if not {'x', 'y', 'z'} <= set(columns):
        msg = (f'{name}: must have the columns x, y and z [au], got '
               f'{", ".join(table.colnames)}')
        raise ValueError(msg)
    places = np.column_stack([
        u.Quantity(columns[axis], dtype=float).to_value(u.au)
        if getattr(columns[axis], 'unit', None) is not None
        else np.asarray(columns[axis], float) for axis in 'xyz'])
    key = next((key for key in _TIMES if key in columns), None)
    return None if key is None else _years(columns[key]), places


def _years(column):
    """Return times of a table as Julian years, TDB unless they say more."""
    import numpy as np
    from astropy.time import Time

    from photutils_mgauss.files.image_header import any_time
    from photutils_mgauss.sky.observers import ANY_YEAR, julian_years
    if isinstance(column, Time):
        return julian_years(column, within=ANY_YEAR)
    values = getattr(column, 'value', column)
    return np.array([julian_years(any_time(value, 'tdb'), within=ANY_YEAR)
                     for value in np.asarray(values).tolist()], float)


def _interpolated(name, years, places, year):
    """Return the place (3,) at a time."""
    import numpy as np
    from scipy.interpolate import CubicSpline
    order = np.argsort(years)
    years, places = years[order], places[order]
    # Some slack [yr], as times may be in other scales.
    slack = 100 / 86400 / 365.25
    if not years[0] - slack <= year <= years[-1] + slack:
        msg = (f'{name}: must have places at all times, got none at '
               f'{year:.4f}, which is not between {years[0]:.4f} and '
               f'{years[-1]:.4f}')
        raise ValueError(msg)
    if len(years) == 1:
        return places[0]
    return CubicSpline(years, places)(year)
