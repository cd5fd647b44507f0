"""The list of stars that the user gives, in the plane of the fit."""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table

from photutils_mgauss.motions.columns import table_vectors
from photutils_mgauss.sky.observers import julian_years
from photutils_mgauss.utils.star_columns import first_values


@dataclass(frozen=True, eq=False)
class StarList:
    """
    What is known of n stars before the fit.

    Attributes
    ----------
    ids : (n,) `~numpy.ndarray`
    values : (n, p) `~numpy.ndarray`
        Position in the plane [mas], motion and so on at the working year;
        0 for what is not known, NaN for positions that are not.
    """

    ids: np.ndarray
    values: np.ndarray


def read_stars(stars, campaign):
    """
    Return the `StarList` of a table or SkyCoord.

    Parameters
    ----------
    stars : `~astropy.table.Table` or `~astropy.coordinates.SkyCoord`
    campaign : `~photutils_mgauss.pixel_motions.campaign.Campaign`
    """
    table = _table_of(stars)
    missing = {'ra', 'dec'} - set(table.colnames)
    if missing:
        msg = (f'stars must have the column {min(missing)!r}, got '
               f'{table.colnames}')
        raise ValueError(msg)
    place = campaign.plane.project(table_vectors(table))
    motion = np.nan_to_num(np.stack([
        first_values(table, [name], u.mas / u.yr)
        for name in ('pmra', 'pmdec')]))
    local = campaign.plane.local_jacobian(np.nan_to_num(place))
    motion = np.einsum('ijn,jn->in', local, motion)
    values = np.zeros((len(table), campaign.n_parameters))
    values[:, :2] = (place + motion * (campaign.working_year
                                       - _years(table, campaign))).T
    values[:, 2:4] = motion.T
    if campaign.parallax:
        values[:, 4] = np.nan_to_num(first_values(table, ['parallax'],
                                                  u.mas))
    return StarList(_ids(table), values)


def _table_of(stars):
    if isinstance(stars, Table):
        return stars
    if not isinstance(stars, SkyCoord):
        msg = ('stars must be a Table with ra and dec or a SkyCoord, got '
               f'{type(stars).__name__}')
        raise TypeError(msg)
    icrs = stars.reshape(-1).icrs
    table = QTable({'ra': icrs.ra, 'dec': icrs.dec})
    if 's' in icrs.data.differentials:
        table['pmra'], table['pmdec'] = icrs.pm_ra_cosdec, icrs.pm_dec
        if icrs.obstime is not None:
            table['ref_epoch'] = np.broadcast_to(
                julian_years(icrs.obstime), len(table)) * u.yr
    return table


def _years(table, campaign):
    """Return the years positions are given at; the working year if unknown."""
    if 'ref_epoch' not in table.colnames:
        return np.full(len(table), campaign.working_year)
    years = np.broadcast_to(julian_years(table['ref_epoch'], 'ref_epoch'),
                            len(table))
    return np.where(np.isfinite(years), years, campaign.working_year)


def _ids(table):
    if 'id' not in table.colnames:
        return np.arange(1, len(table) + 1)
    ids = np.asarray(table['id'])
    if len(np.unique(ids)) < len(ids):
        msg = "the column 'id' of stars must hold unique values"
        raise ValueError(msg)
    return ids
