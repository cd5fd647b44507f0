"""A camera of several chips with a distortion that its WCS do not have."""
from dataclasses import dataclass

import numpy as np
from astropy.table import Table

from helpers.wcs import SCALE, tan_wcs
from photutils_mgauss import Epoch
from photutils_mgauss.sky.transforms import exponents

PIXELS = 1000
GAP = 60
YEAR = 2016.0
ERROR = 0.01  # pix


@dataclass(eq=False)
class Field:
    """Stars (ra, dec [deg], motions) and a distortion (C, 2, b) [pix]."""

    ra: np.ndarray
    dec: np.ndarray
    pm: np.ndarray
    distortion: np.ndarray
    columns: int

    @property
    def n_chips(self):
        """Number of chips."""
        return len(self.distortion)


def make_field(rng, *, columns=3, rows=2, per_chip=80, size=5.0):
    """Return a field whose distortions are some ``size`` [pix]."""
    n = int(per_chip * columns * rows * 1.3)
    step = (PIXELS + GAP) * SCALE / 3600
    powers = exponents(3).sum(axis=1)
    distortion = rng.normal(0, size / 3, (columns * rows, 2, len(powers)))
    return Field(150 + rng.uniform(-0.55, 0.55, n) * columns * step,
                 rng.uniform(-0.55, 0.55, n) * rows * step,
                 rng.normal(0, 5, (2, n)),
                 distortion * (powers > 1), columns)


def chip_wcs(field, k, ra, dec, rotation):
    """Return the WCS of a chip of a camera that looks at (ra, dec)."""
    wcs = tan_wcs(ra, dec, rotation=rotation, size=PIXELS)
    column, row = k % field.columns, k // field.columns
    middle = np.array([field.columns, field.n_chips // field.columns]) / 2
    wcs.wcs.crpix = (middle - [column, row]) * (PIXELS + GAP) - GAP / 2
    return wcs


def distorted(coefficients, x, y):
    """Return pixels whose polynomial correction gives x and y."""
    def correction(u, v):
        u, v = 2 * u / PIXELS - 1, 2 * v / PIXELS - 1
        basis = np.stack([u**i * v**j for i, j in exponents(3)])
        return coefficients @ basis
    at = np.stack([x, y])
    for _ in range(20):
        at = np.stack([x, y]) - correction(*at)
    return at


def expose(field, rng, year, *, dither=0.002, roll=2.0, with_ids=True):
    """Return an exposure, the WCS given all off in common."""
    ra, dec = 150 + rng.normal(0, dither), rng.normal(0, dither)
    rotation, pairs = rng.normal(0, roll), []
    off = rng.normal(0, 0.3 / 3600, 2)
    dt = (year - YEAR) / 3.6e6
    for k in range(field.n_chips):
        true = chip_wcs(field, k, ra, dec, rotation)
        x, y = true.all_world2pix(field.ra + field.pm[0] * dt,
                                  field.dec + field.pm[1] * dt, 0)
        near = np.flatnonzero((np.abs(x - PIXELS / 2) < 0.52 * PIXELS)
                              & (np.abs(y - PIXELS / 2) < 0.52 * PIXELS))
        x, y = distorted(field.distortion[k], x[near], y[near])
        error = np.full(len(near), ERROR)
        table = Table({'x_fit': x + rng.normal(0, error),
                       'y_fit': y + rng.normal(0, error),
                       'x_err': error, 'y_err': error})
        if with_ids:
            table['id'] = near
        pairs.append((table, chip_wcs(field, k, ra + off[0], dec + off[1],
                                      rotation)))
    return Epoch.of_chips(pairs, year)


def known_stars(field, rng, n):
    """Return the first n stars as a catalogue like Gaia's."""
    error = np.full(n, 0.1)
    noise = rng.normal(0, 0.1, (4, n))
    return Table({
        'id': np.arange(n), 'ra': field.ra[:n] + noise[0] / 3.6e6,
        'dec': field.dec[:n] + noise[1] / 3.6e6,
        'pmra': field.pm[0, :n] + noise[2],
        'pmdec': field.pm[1, :n] + noise[3],
        'ra_error': error, 'dec_error': error, 'pmra_error': error,
        'pmdec_error': error, 'ref_epoch': np.full(n, YEAR)})
