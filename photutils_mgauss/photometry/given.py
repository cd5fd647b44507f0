"""The list of stars that `MixturePSFPhotometry` is given."""
import astropy.units as u
import numpy as np
from astropy.table import Table

from photutils_mgauss.utils.star_columns import column_values

# Where stars without a place wait, each alone, while photutils estimates the
# fluxes of the others; it measures nothing so far out [pix].
_NOWHERE, _APART = -1e7, 1e5


def checked(photometry, init_params):
    """
    Check a list of stars, and move stars without a place out of the way.

    Parameters
    ----------
    photometry : `~photutils.psf.PSFPhotometry`
    init_params : `~astropy.table.Table` or None
        As the user gives it. What is no table is left for photutils to
        refuse.

    Returns
    -------
    init_params : `~astropy.table.Table` or None
        A copy where places are not finite or masked, else the same table.
    places : (2, n) `~numpy.ndarray` or None
        x and y as they are given, NaN where masked; None if all are finite.

    Raises
    ------
    TypeError, ValueError
        If the table is empty, has no positions, or has positions that are
        not numbers or not pixels.
    """
    if not isinstance(init_params, Table):
        return init_params, None
    mapper = photometry._param_mapper
    names = [mapper.find_column(init_params, axis) for axis in 'xy']
    if None in names:
        msg = ('init_params must contain valid column names for the x and y '
               'source positions, such as x_init and y_init, or x and y, got '
               f'{init_params.colnames}')
        raise ValueError(msg)
    if len(init_params) == 0:
        msg = 'init_params must contain at least one row, got none'
        raise ValueError(msg)
    places = [column_values(init_params, name, u.pix) for name in names]
    missing = ~np.isfinite(places).all(axis=0)
    if not missing.any():
        return init_params, None
    moved = init_params.copy()
    aside = _NOWHERE - _APART * np.arange(missing.sum())
    for name, place in zip(names, places, strict=True):
        moved[name] = np.where(missing, 0, place)
        moved[name][missing] = aside
    return moved, np.array(places)


def put_back(prepared, places):
    """Return the stars that were moved out of the way to where they were."""
    if places is None:
        return
    for axis, place in zip('xy', places, strict=True):
        prepared[f'{axis}_init'] = place
