"""A catalogue like Gaia's, and exposures of one night years before it."""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from helpers.wcs import SCALE, tan_wcs
from photutils_mgauss import Epoch

PIXEL = 1e3 * SCALE  # mas
YEAR = 2016.0


@dataclass(eq=False)
class Sky:
    """Stars: ra, dec [deg] in 2016, motions (2, n), errors of Gaia."""

    ra: np.ndarray
    dec: np.ndarray
    pm: np.ndarray
    magnitude: np.ndarray
    bright: np.ndarray

    @property
    def error(self):
        """Standard error of a Gaia position [mas]."""
        return 0.03 * 10 ** (0.2 * np.clip(self.magnitude - 15, 0, None))


def make_sky(rng, n=1500, half_width=100.0, dec=-30.0):
    """Return stars of a field of 2 x half_width arcsec."""
    magnitude = rng.uniform(14, 21, n)
    ra = 80 + rng.uniform(-1, 1, n) * half_width / 3600 / np.cos(
        np.radians(dec))
    return Sky(ra, dec + rng.uniform(-1, 1, n) * half_width / 3600,
               rng.normal([[1.0], [-2.0]], 4, (2, n)), magnitude,
               magnitude < 20)


def gaia_table(sky, rng):
    """Return the catalogue: motions of the bright, places of all."""
    n, error = len(sky.ra), sky.error
    cosine = np.cos(np.radians(sky.dec))
    east, north = error * rng.normal(size=(2, n))
    table = QTable({
        'source_id': np.arange(n) + 5000,
        'ra': (sky.ra + east / 3.6e6 / cosine) * u.deg,
        'dec': (sky.dec + north / 3.6e6) * u.deg,
        'ra_error': error * u.mas, 'dec_error': error * u.mas,
        'ref_epoch': np.full(n, YEAR) * u.yr})
    for k, name in enumerate(('pmra', 'pmdec')):
        value = sky.pm[k] + error * rng.normal(size=n)
        table[name] = np.where(sky.bright, value, np.nan) * u.mas / u.yr
        table[f'{name}_error'] = (np.where(sky.bright, error, np.nan)
                                  * u.mas / u.yr)
    return table


def observe_once(sky, rng, year=2004.0, which=None, centre=None, noise=1.0,
                 offset=200.0, shape=2900):
    """
    Return an exposure of the stars ``which`` (n,) bool.

    Its WCS is off by some ``offset`` [mas], in scale by 1e-5 and in roll by
    10 arcsec; positions have errors of 0.3 mas and more.
    """
    ra0, dec0 = centre or (80.0, float(np.mean(sky.dec)))
    true = tan_wcs(ra0, dec0, size=shape)
    dt = year - YEAR
    ra = sky.ra + sky.pm[0] * dt / 3.6e6 / np.cos(np.radians(sky.dec))
    x, y = true.all_world2pix(ra, sky.dec + sky.pm[1] * dt / 3.6e6, 0)
    sigma = 0.3 * 10 ** (0.1 * np.clip(sky.magnitude - 18, 0, None)) / PIXEL
    given = true.deepcopy()
    given.wcs.crpix = given.wcs.crpix + rng.normal(0, offset / PIXEL, 2)
    turn = rng.normal(0, 5e-5)
    given.wcs.cd = given.wcs.cd @ (np.array([[1, -turn], [turn, 1]])
                                   * (1 + rng.normal(0, 1e-5)))
    seen = ((x > 0) & (x < shape) & (y > 0) & (y < shape))
    if which is not None:
        seen &= which
    table = Table({
        'x_fit': x + noise * sigma * rng.normal(size=len(x)),
        'y_fit': y + noise * sigma * rng.normal(size=len(x)),
        'x_err': sigma, 'y_err': sigma, 'number': np.arange(len(x))})
    return Epoch(table[seen], given, year)


def pulls(stars, sky, which):
    """
    Return pulls (2, k) of the motions of the stars ``which`` (n,).

    Those whose match was ambiguous are left out.
    """
    number = np.asarray(stars['reference_row'])
    rows = (number >= 0) & (stars['flags'] & 16 == 0)
    rows[rows] = which[number[rows]]
    return np.stack([
        (stars[name].value[rows] - sky.pm[k, number[rows]])
        / stars[f'{name}_error'].value[rows]
        for k, name in enumerate(('pmra', 'pmdec'))])
