"""
Motions in crowded fields, from all pixels together and from catalogues.

Run as ``python tests/benchmarks/bench_crowded_motions.py``. Seven epochs at
the times of Nie et al. of a field with a star for every 16 pixels, motions of
3 mas a year, WCS known. Shown for each magnitude are the stars, and of
`CrowdedMixturePhotometry.fit_images` and of catalogues of single images the
share with a motion, the 68th percentile of its deviations [mas / yr] and their
scatter in units of the errors; at last CPU seconds over those of one image.
With ``--harness`` and ``--optics`` the optics of another simulator draw.
"""
import argparse
import time
import warnings
from pathlib import Path

import crowded_light as light
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    Epoch,
    ImageEpoch,
    ProperMotionFitter,
    paper_exposures,
)

PIXEL, DISPERSION, MARGIN = 74.0, 3.0, 20  # mas; mas / yr; pixels
SAME, EDGE = 0.7, 4  # pixels


def make_wcs(size, angle=0.0, shift=(0.0, 0.0)):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (30.0, 40.0)
    wcs.wcs.crpix = (size + 1) / 2 + np.array(shift)
    c, s = np.cos(angle) * PIXEL / 3.6e6, np.sin(angle) * PIXEL / 3.6e6
    wcs.wcs.cd = [[-c, s], [s, c]]
    return wcs


class Field:
    """Stars, their motions (2, n) east and north, and images of them."""

    def __init__(self, size, optics, seed):
        self.size, rng = size, np.random.default_rng(seed)
        self.stars = light.even_stars(size + 2 * MARGIN, seed)
        self.stars['x'] -= MARGIN
        self.stars['y'] -= MARGIN
        self.motion = rng.normal(0, DISPERSION, (2, len(self.stars)))
        years = np.array([one.time.jyear for one in paper_exposures()])
        self.images = [self._image(optics, year, year - years.mean(), k, rng,
                                   seed) for k, year in enumerate(years)]

    def _image(self, optics, year, dt, k, rng, seed):
        wcs = make_wcs(self.size, rng.uniform(-0.02, 0.02),
                       rng.uniform(-3, 3, 2))
        east, north = self.motion * dt / PIXEL
        sky = make_wcs(self.size).pixel_to_world(self.stars['x'] - east,
                                                 self.stars['y'] + north)
        seen = self.stars.copy()
        seen['x'], seen['y'] = wcs.world_to_pixel(sky)
        layers = light.expose(optics.draw(seen, (self.size, self.size)), seen,
                              1000 * seed + k).images
        return ImageEpoch(layers['sci'], optics.psf, wcs, year,
                          error=layers['err'], mask=layers['mask'], band='g')

    def deviations(self, table):
        """Return deviations of motions and errors (4, n), NaN if none."""
        good = np.flatnonzero(np.isfinite(table['pmra'].value))
        x, y = make_wcs(self.size).world_to_pixel(
            SkyCoord(table['ra'], table['dec'])[good])
        # A star of the table is the brightest that is near.
        _, near = cKDTree(np.column_stack(
            [self.stars['x'], self.stars['y']])).query(
                np.column_stack([x, y]), k=3, distance_upper_bound=SAME)
        magnitude = np.append(self.stars['mag'], np.inf)
        own = np.take_along_axis(near, np.argmin(
            magnitude[near], axis=1)[:, None], axis=1)[:, 0]
        found = own < len(self.stars)
        out = np.full((4, len(self.stars)), np.nan)
        for i, name in enumerate(('pmra', 'pmdec')):
            out[i, own[found]] = (table[name].value[good[found]]
                                  - self.motion[i, own[found]])
            out[2 + i, own[found]] = table[f'{name}_error'].value[good[found]]
        return out

    def inside(self):
        return np.all([(self.stars[axis] > EDGE) & (
            self.stars[axis] < self.size - 1 - EDGE) for axis in 'xy'], axis=0)


def measured(field, phot):
    """Return deviations of both ways, and the ratio of CPU seconds."""
    start = time.process_time()
    together = phot.fit_images(field.images, motions=True)
    middle = time.process_time()
    tables = [phot(image.data, error=image.error, mask=image.mask)
              for image in field.images]
    alone = (time.process_time() - middle) / len(tables)
    catalogues = ProperMotionFitter(transform=None, systematic=None).fit(
        [Epoch(table, image.wcs, image.year) for table, image in zip(
            tables, field.images, strict=True)]).stars
    return (field.deviations(together), field.deviations(catalogues),
            (middle - start) / alone)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--size', type=int, default=128)
    parser.add_argument('--seeds', type=int, nargs='+', default=[1, 2, 3, 4])
    parser.add_argument('--harness', type=Path)
    parser.add_argument('--optics', type=Path)
    options = parser.parse_args()
    warnings.simplefilter('ignore')
    optics = (light.Optics.of(options.size, 1) if options.harness is None else
              light.HarnessOptics.of(options.size, options.harness,
                                     options.optics))
    phot = CrowdedMixturePhotometry(optics.psf)
    measured(Field(48, optics, 0), phot)  # compiles
    fields = [Field(options.size, optics, seed) for seed in options.seeds]
    *ways, ratios = zip(*(measured(field, phot) for field in fields),
                        strict=True)
    ways = [np.concatenate(way, axis=1) for way in ways]
    magnitude = np.concatenate([np.where(
        field.inside(), field.stars['mag'], np.nan) for field in fields])
    print('mag    stars   together: share 68 % pull   catalogues')
    for low in range(18, 26):
        some = (magnitude >= low) & (magnitude < low + 1)
        words = f'{low}-{low + 1} {some.sum():5d}'
        for way in ways:
            away, error = way[:2, some], way[2:, some]
            words += (f'     {np.isfinite(away[0]).mean():6.1%} '
                      f'{np.nanpercentile(np.abs(away), 68):7.3f} '
                      f'{np.nanpercentile(np.abs(away / error), 68):5.2f}')
        print(words, flush=True)
    print(f'CPU seconds over those of one image: {np.median(ratios):.1f}')


if __name__ == '__main__':
    main()
