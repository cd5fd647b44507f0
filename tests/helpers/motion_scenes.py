"""Simulated exposures of one field: stars and quasars with known motions."""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import (
    UnitSphericalRepresentation,
    get_body_barycentric,
)
from astropy.table import Table
from astropy.time import Time

from helpers.wcs import SCALE, tan_wcs
from photutils_mgauss import Epoch

# Observing times of Table 2 of Nie et al.
TIMES = Time(['2024-12-12T08:07:10', '2026-05-30T17:27:18',
              '2026-08-11T02:49:27', '2026-08-11T05:50:40',
              '2027-08-09T07:50:24', '2027-08-09T09:19:18',
              '2028-07-21T20:02:14'], scale='tdb')
SUBSETS = {2: [0, 6], 3: [0, 3, 6], 4: [0, 2, 4, 6], 5: [0, 1, 3, 4, 6],
           6: [0, 1, 2, 3, 4, 6], 7: list(range(7))}


@dataclass(eq=False)
class Truth:
    """
    Sources on the sky: ra, dec [deg] at year0, and what they do.

    ``pm`` (2, n) [mas/yr], ``parallax`` (n,) [mas], ``sigma`` (n,) [mas].
    """

    ra: np.ndarray
    dec: np.ndarray
    pm: np.ndarray
    parallax: np.ndarray
    qso: np.ndarray
    sigma: np.ndarray
    year0: float

    def at(self, year):
        """Return ra, dec [deg] seen from the Earth, by unit vectors."""
        places = UnitSphericalRepresentation(self.ra * u.deg,
                                             self.dec * u.deg)
        axes = places.unit_vectors()
        r, p, q = (one.to_cartesian().xyz.value
                   for one in (places, axes['lon'], axes['lat']))
        mas = np.radians(1 / 3.6e6)
        earth = get_body_barycentric('earth', Time(
            year, format='jyear', scale='tdb'), ephemeris='builtin')
        place = (r + mas * (year - self.year0)
                 * (self.pm[0] * p + self.pm[1] * q)
                 - mas * self.parallax * earth.xyz.to_value(u.au)[:, None])
        x, y, z = place
        return (np.degrees(np.arctan2(y, x)) % 360,
                np.degrees(np.arctan2(z, np.hypot(x, y))))


def make_truth(rng, *, n_stars=600, n_qso=600, ra=192.8595, dec=27.1283,
               half_width=330.0, parallax=0.0, sigma=None):
    """Return sources scattered over a square field [arcsec]."""
    n = n_stars + n_qso
    xi, eta = np.radians(rng.uniform(-half_width, half_width, (2, n)) / 3600)
    r0, d0 = np.radians(ra), np.radians(dec)
    c = np.array([np.cos(d0) * np.cos(r0), np.cos(d0) * np.sin(r0),
                  np.sin(d0)])
    e = np.array([-np.sin(r0), np.cos(r0), 0])
    v = (c[:, None] + np.multiply.outer(e, xi)
         + np.multiply.outer(np.cross(c, e), eta))
    qso = np.arange(n) >= n_stars
    pm = np.where(qso, 0, rng.normal([[-2.5], [-3.5]], 3.5, (2, n)))
    if sigma is None:
        sigma = 10 ** rng.uniform(np.log10(0.5), np.log10(8), n)
    return Truth(np.degrees(np.arctan2(v[1], v[0])) % 360,
                 np.degrees(np.arctan2(v[2], np.hypot(v[0], v[1]))), pm,
                 np.where(qso, 0, parallax), qso,
                 np.broadcast_to(sigma, n).copy(), TIMES[0].jyear)


def observe(truth, rng, *, times=TIMES, offset=100.0, edge=0.0, missing=0.1,
            floor=0.0, noise=1.0, wcs=None, **keywords):
    """
    Return epochs of a `Truth`.

    The WCS given with each is wrong by ``offset`` [mas], and by an affine
    part that amounts to ``edge`` [mas] at the edge of the chip.
    """
    epochs = []
    for time in times:
        pointing = rng.normal(0, 3, 2) / 3600
        true = wcs or tan_wcs(np.median(truth.ra) + pointing[0],
                              np.median(truth.dec) + pointing[1], **keywords)
        x, y = true.all_world2pix(*truth.at(time.jyear), 0)
        sigma = np.hypot(truth.sigma, floor) / (SCALE * 1e3)
        x = x + noise * sigma * rng.normal(size=len(x))
        y = y + noise * sigma * rng.normal(size=len(x))
        given = true.deepcopy()
        shift = rng.normal(0, offset, 2) / (SCALE * 1e3)
        given.wcs.crpix = given.wcs.crpix + shift
        stretch = rng.normal(0, edge / (4500 * SCALE * 1e3), (2, 2))
        given.wcs.cd = given.wcs.cd @ (np.eye(2) + stretch)
        table = Table({'id': np.arange(len(x)), 'x_fit': x, 'y_fit': y,
                       'x_err': truth.sigma / (SCALE * 1e3),
                       'y_err': truth.sigma / (SCALE * 1e3),
                       'qso': truth.qso})
        seen = rng.uniform(size=len(x)) >= missing
        epochs.append(Epoch(table[seen], given, time))
    return epochs


def pulls(stars, truth, *, names=('pmra', 'pmdec')):
    """Return (value - truth) / error of motions, shape (2, n)."""
    which = np.asarray(stars['id'], dtype=int)
    return np.stack([
        (stars[name].value - truth.pm[k, which]) / stars[f'{name}_error'].value
        for k, name in enumerate(names)])


def rms(values):
    """Return the root of the mean square of all but NaN."""
    return np.sqrt(np.nanmean(np.square(values)))


def plane_epochs(rng, n=40, years=(2020.0, 2021.5, 2024.0), error=0.01,
                 **columns):
    """Return epochs in pixels, with errors, and the true motions."""
    place, motion = rng.uniform(0, 500, (2, n)), rng.normal(0, 0.1, (2, n))
    epochs = []
    for year in years:
        x, y = (place + motion * (year - years[0])
                + rng.normal(0, error, (2, n)))
        epochs.append(Epoch(Table({
            'id': np.arange(n), 'x_fit': x, 'y_fit': y,
            'x_err': np.full(n, error), 'y_err': np.full(n, error),
            **columns}), time=year))
    return epochs, motion


def changed(epoch, **columns):
    """Return an epoch with some columns of its table replaced."""
    table = epoch.table.copy()
    for name, values in columns.items():
        table[name] = values
    return Epoch(table, epoch.wcs, epoch.time, observer=epoch.observer)
