"""What the columns of star lists are called, and what stands in them."""
import astropy.units as u
import numpy as np

from photutils_mgauss.sky.tangent_plane import MAS, local_axes, unit_vectors
from photutils_mgauss.utils.star_columns import find_column, first_values
from photutils_mgauss.utils.validation import shown

# Columns with more names than one, in order of preference.
COLUMNS = {
    'x': ('x_fit', 'x'), 'y': ('y_fit', 'y'),
    'x_err': ('x_err', 'x_error'), 'y_err': ('y_err', 'y_error'),
    'ra_err': ('ra_error', 'ra_err'), 'dec_err': ('dec_error', 'dec_err'),
    'flux': ('flux_fit', 'flux'),
    'magnitude': ('mag', 'phot_g_mean_mag'),
    'colour': ('colour', 'color', 'bp_rp'),
    'along_err': ('along_error', 'along_err'),
}
# What is not measured across a scan, in errors along it: far beyond what
# counts as a measurement, near enough that covariances can be inverted.
ACROSS = 1e5


def names_of(key):
    """Return the names that a column may have, the preferred one first."""
    return COLUMNS.get(key, (key,))


def numbers(table, key, unit=None):
    """
    Return a column as float64; NaN where masked, infinite or missing.

    A column without unit is taken to be in ``unit``.
    """
    values = first_values(table, names_of(key), unit)
    return np.where(np.isfinite(values), values, np.nan)


def numbers_if_there(table, key, unit=None):
    """Do the same, but return None where there is no such column."""
    if find_column(table, names_of(key)) is None:
        return None
    return numbers(table, key, unit)


def identifiers(table):
    """Return the column of identifiers, None where there is none."""
    if 'id' not in table.colnames:
        return None
    if np.any(getattr(table['id'], 'mask', False)):
        msg = "the column 'id' must not have masked values"
        raise ValueError(msg)
    ids = np.asarray(table['id'])
    values, counts = np.unique(ids, return_counts=True)
    if len(values) < len(ids):
        msg = (f"the column 'id' must hold unique values, got "
               f'{shown(values[counts > 1][0])} {counts.max()} times')
        raise ValueError(msg)
    return ids


def pixels(table, unit=u.pix):
    """Return x and y, (2, n)."""
    return np.stack([numbers(table, key, unit) for key in 'xy'])


def table_vectors(table):
    """Return ICRS unit vectors (3, n) of ra and dec, NaN for no places."""
    dec = numbers(table, 'dec', u.deg)
    return unit_vectors(numbers(table, 'ra', u.deg),
                        np.where(np.abs(dec) <= 90, dec, np.nan))


def scan_vectors(table):
    """Do the same for places along scans, moved by what was measured."""
    vectors = table_vectors(table)
    east, north = local_axes(vectors)
    sine, cosine = _scan_directions(table)
    step = numbers(table, 'along', u.mas) / MAS
    moved = vectors + step * (sine * east + cosine * north)
    return moved / np.sqrt(1 + step**2)


def _scan_directions(table):
    angle = np.radians(numbers(table, 'scan_angle', u.deg))
    return np.sin(angle), np.cos(angle)


def covariances(table, keys, unit):
    """
    Return xx, xy, yy (3, n) from two columns of errors.

    Errors that are not positive become NaN.
    """
    dx, dy = (numbers(table, key, unit) for key in keys)
    cross = np.zeros_like(dx)
    if 'xy_cov' in table.colnames:
        cross = numbers(table, 'xy_cov', unit**2)
    good = (dx > 0) & (dy > 0) & np.isfinite(dx) & np.isfinite(dy)
    return np.where(good, np.stack([dx * dx, cross, dy * dy]), np.nan)


def scan_covariances(table):
    """Return xx, xy, yy of scans, which say nothing across their way."""
    error = numbers(table, 'along_err', u.mas)
    sine, cosine = _scan_directions(table)
    across = (ACROSS * error)**2
    along = error**2 - across
    covariance = np.stack([across + along * sine**2, along * sine * cosine,
                           across + along * cosine**2])
    return np.where((error > 0) & np.isfinite(error + sine), covariance,
                    np.nan)


def brightness(table):
    """Return numbers (n,) that grow with the flux, NaN where unknown."""
    for key, sign in (('flux', 1), ('magnitude', -1)):
        values = numbers(table, key)
        if np.isfinite(values).any():
            return sign * values
    return values


def magnitudes(table):
    """Return magnitudes (n,), from fluxes if need be, NaN where unknown."""
    values = brightness(table)
    if find_column(table, names_of('flux')) is None:
        return -values
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(values > 0, -2.5 * np.log10(values), np.nan)
