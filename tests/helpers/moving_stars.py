"""Images of stars that move, made by literal equations."""
import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.wcs import WCS

from helpers.star_images import MIXTURE, PSF
from photutils_mgauss import ImageEpoch, barycentric_observer

SCALE = 74.0  # mas in a pixel
CENTRE = SkyCoord(150.0, 40.0, unit='deg')


def make_wcs(angle=0.0, shift=(0.0, 0.0), size=60):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval = CENTRE.ra.deg, CENTRE.dec.deg
    wcs.wcs.crpix = np.array([size / 2, size / 2]) + shift
    c, s = (SCALE / 3.6e6 * f(angle) for f in (np.cos, np.sin))
    wcs.wcs.cd = [[-c, s], [s, c]]
    return wcs


def truth(x, y, motion=(0, 0), parallax=0.0):
    """Return stars at pixels of the plain WCS, at their mean time."""
    x = np.atleast_1d(np.asarray(x, float))
    place = make_wcs().pixel_to_world(x, y)
    pmra, pmdec = np.broadcast_to(np.reshape(motion, (2, -1)), (2, x.size))
    return QTable({'id': np.arange(x.size), 'ra': place.ra, 'dec': place.dec,
                   'pmra': pmra * u.mas / u.yr, 'pmdec': pmdec * u.mas / u.yr,
                   'parallax': np.full(x.size, parallax) * u.mas})


def place_at(stars, dt, year):
    """Return where stars are seen, dt years after their mean time."""
    place = SkyCoord(stars['ra'], stars['dec'])
    ra, dec = place.ra.rad, place.dec.rad
    x, y, z = barycentric_observer('earth', year).xyz.to_value(u.au)
    factors = (x * np.sin(ra) - y * np.cos(ra),
               (x * np.cos(ra) + y * np.sin(ra)) * np.sin(dec)
               - z * np.cos(dec))
    return place.spherical_offsets_by(
        *(stars[name] * dt * u.yr + stars['parallax'] * factor
          for name, factor in zip(('pmra', 'pmdec'), factors, strict=True)))


def observe(stars, fluxes, years, rng, *, noise=3.0, sky=20.0, size=60,
            frames=None, error=True):
    """Return images; fluxes are (n,) or (n, E)."""
    years = np.asarray(years, float)
    frames = frames or [make_wcs(0.1 * k, (0.3 * k, -0.2 * k), size)
                        for k in range(len(years))]
    if np.ndim(fluxes) < 2:
        fluxes = np.broadcast_to(fluxes, len(stars))[:, None]
    fluxes = np.broadcast_to(fluxes, (len(stars), len(years)))
    out = []
    for k, (year, wcs) in enumerate(zip(years, frames, strict=True)):
        light = np.full((size, size), sky)
        x, y = wcs.world_to_pixel(place_at(stars, year - years.mean(), year))
        for star in range(len(stars)):
            light += MIXTURE.render((size, size), x[star], y[star],
                                    flux=fluxes[star, k])
        data = light + noise * rng.standard_normal(light.shape)
        out.append(ImageEpoch(data, PSF, wcs, year,
                              error=noise if error else None))
    return out
