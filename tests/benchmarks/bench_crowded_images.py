"""
Many images of one crowded field beside single images, averaged afterwards.

Run as ``python tests/benchmarks/bench_crowded_images.py``. Exposures of a
simulated field, shifted and turned a little, half of them through another
filter with colours of its own, are measured together, and each alone: lists
are matched to that of the first image and fluxes averaged. Printed are, for
each magnitude, completeness with a flux within 0.75 mag of the truth, false
stars, the bias of the colour in its own standard errors, the pulls of fluxes
and places, and, where one image finds half of the stars, by how many
magnitudes the limit is deeper: of n images that is 1.25 log10(n) by photon
noise. ``--motions`` gives the stars motions over four years, and compares
those from the pixels with lines through the places of single images.
``--quick`` is a small field.
"""
import argparse
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import crowded_light as light
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData, StdDevUncertainty
from astropy.wcs import WCS
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GriddedMixturePSF,
    ImageEpoch,
)

SCALE, MARGIN, RIM, RADIUS = 74.0, 20, 3, 0.7
NOT_STARS = 262144 | 65536


def make_wcs(size, turn=0.0, x=0.0, y=0.0):
    """Return the WCS of an exposure, turned and shifted [pix]."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (30.0, 40.0)
    wcs.wcs.crpix = (size + 1) / 2 + x, (size + 1) / 2 + y
    c, s = np.cos(turn), np.sin(turn)
    wcs.wcs.cd = SCALE / 3.6e6 * np.array([[-c, s], [s, c]])
    return wcs


class Field:
    """Exposures of one field, and the truth in pixels of the first."""

    def __init__(self, args, optics):
        rng = np.random.default_rng(args.seed)
        self.size, n = args.size, args.images
        truth = light.even_stars(self.size + 2 * MARGIN, args.seed)
        self.mag = np.asarray(truth['mag'])
        self.x, self.y = (truth[c] - MARGIN for c in 'xy')
        self.motion = rng.normal(0, 3.0 * args.motions, (2, len(truth)))
        colour = rng.normal(0.3, 0.3, len(truth))
        self.years = 2026 + np.linspace(0, 4, n)
        self.frames = [make_wcs(self.size, *(
            (k > 0) * rng.uniform(-w, w) for w in (0.02, 3, 3)))
            for k in range(n)]
        self.scenes, self.flux = [], []
        for k, wcs in enumerate(self.frames):
            one = truth.copy()
            if k >= (n + 1) // 2:
                one['flux'] = one['flux'] * 10**(-0.4 * colour)
            shift = self.motion / SCALE * (self.years[k] - self.years.mean())
            one['x'], one['y'] = wcs.world_to_pixel(
                self.frames[0].pixel_to_world(self.x - shift[0],
                                              self.y + shift[1]))
            self.flux.append(np.asarray(one['flux']))
            drawn = optics.draw(one, (self.size, self.size))
            self.scenes.append(light.expose(drawn, one,
                                            1000 * args.seed + k).images)
        self.flux = np.array(self.flux)
        low, high = RIM, self.size - 1 - RIM
        self.inside = np.all([(c > low) & (c < high)
                              for c in (self.x, self.y)], axis=0)

    def images(self, psf):
        return [ImageEpoch(NDData(one['sci'], StdDevUncertainty(one['err']),
                                  mask=one['mask']), psf, wcs, year)
                for one, wcs, year in zip(self.scenes, self.frames,
                                          self.years, strict=True)]

    def part(self, psf, side=64):
        """Return a corner of all images, to compile with."""
        return [ImageEpoch(NDData(
            one['sci'][:side, :side], StdDevUncertainty(
                one['err'][:side, :side])), psf, wcs, year)
            for one, wcs, year in zip(self.scenes, self.frames, self.years,
                                      strict=True)]


class Listed:
    """Stars in pixels of the first image, with their fluxes (n, E)."""

    def __init__(self, x, y, flux, error, common, motion=None):
        self.x, self.y, self.flux, self.error = x, y, flux, error
        self.common, self.motion = common, motion

    def match(self, field):
        """Return the rows (n,) of true stars, -1 for none."""
        away, row = cKDTree(np.column_stack([self.x, self.y])).query(
            np.column_stack([field.x, field.y]))
        with np.errstate(invalid='ignore', divide='ignore'):
            off = np.abs(2.5 * np.log10(self.mean()[row] / field.flux[0]))
        return np.where((away < RADIUS) & (off < 0.75), row, -1)

    def mean(self):
        """Return the mean flux (n,) in images of the first filter."""
        half = (self.flux.shape[1] + 1) // 2
        return mean(self, slice(None), slice(half))[0]


def mean(listed, rows, images):
    """Return weighted means of known fluxes in images, and their errors."""
    flux, error, common = (values[rows, images] for values in (
        listed.flux, listed.error, listed.common))
    weight = np.where(np.isfinite(flux) & (error > 0), error**-2.0, 0)
    weight /= np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    # Stars that are hidden in one image are hidden in all.
    square = (np.nansum(weight**2 * (error**2 - common**2), axis=1)
              + np.nansum(weight * common, axis=1)**2)
    return np.nansum(flux * weight, axis=1), np.sqrt(square)


def together(field, psf, motions, pool):
    phot = CrowdedMixturePhotometry(None, executor=pool)
    phot.fit_images(field.part(psf), motions=motions)
    start = time.process_time()
    table = phot.fit_images(field.images(psf), motions=motions)
    seconds = time.process_time() - start
    table = table[(table['flags'] & NOT_STARS) == 0]
    x, y = field.frames[0].world_to_pixel(SkyCoord(table['ra'],
                                                   table['dec']))
    motion = (np.array([table[name].value for name in ('pmra', 'pmdec')])
              if motions else None)
    return Listed(x, y, np.asarray(table['flux']),
                  np.asarray(table['flux_err']),
                  np.asarray(table['flux_confusion_err']), motion), seconds


def each_alone(field, psf, pool):
    """Return the list of each image in pixels of the first, and CPU s."""
    phot, out, seconds = CrowdedMixturePhotometry(psf, executor=pool), [], []
    first = field.scenes[0]
    phot(first['sci'][:64, :64], error=first['err'][:64, :64])
    for one, wcs in zip(field.scenes, field.frames, strict=True):
        start = time.process_time()
        table = phot(one['sci'], error=one['err'], mask=one['mask'])
        seconds.append(time.process_time() - start)
        table = table[(table['flags'] & NOT_STARS) == 0]
        x, y = field.frames[0].world_to_pixel(wcs.pixel_to_world(
            table['x_fit'], table['y_fit']))
        out.append(Listed(x, y, np.asarray(table['flux_fit'])[:, None],
                          np.asarray(table['flux_err'])[:, None],
                          np.asarray(table['flux_confusion_err'])[:, None]))
    return out, np.mean(seconds)


def averaged(lists, years):
    """Return single lists matched to the first, motions by least squares."""
    first = lists[0]
    n = len(first.x)
    place = np.full((len(lists), 2, n), np.nan)
    flux, error, common = np.full((3, n, len(lists)), np.nan)
    for k, one in enumerate(lists):
        away, row = cKDTree(np.column_stack([one.x, one.y])).query(
            np.column_stack([first.x, first.y]))
        near = away < RADIUS
        flux[near, k] = one.flux[row[near], 0]
        error[near, k] = one.error[row[near], 0]
        common[near, k] = one.common[row[near], 0]
        place[k, 0, near] = one.x[row[near]]
        place[k, 1, near] = one.y[row[near]]
    t = (years - years.mean())[:, None, None] + 0 * place
    known = np.isfinite(place).sum(axis=0)
    t -= np.nanmean(t, axis=0)
    with np.errstate(invalid='ignore', divide='ignore'):
        rate = np.nansum(t * place, axis=0) / np.nansum(t * t, axis=0)
    rate[known < 2] = np.nan
    return Listed(first.x, first.y, flux, error, common,
                  SCALE * rate * [[-1], [1]])


def scatter(values):
    return 1.48 * np.nanmedian(np.abs(values)) if values.size else np.nan


def width(values):
    """Return the scatter about the median."""
    return scatter(values - np.nanmedian(values)) if values.size else np.nan


def complete_at(field, row, mag):
    """Return the share of stars around a magnitude that are found."""
    near = field.inside & (np.abs(field.mag - mag) < 0.25)
    return np.mean(row[near] >= 0)


def limit(field, row):
    """Return the magnitude at which half of the stars are found."""
    edges = np.arange(22, 25.76, 0.125)
    share = np.array([complete_at(field, row, mag) for mag in edges])
    return float(np.interp(-0.5, -np.minimum.accumulate(share), edges))


def print_list(name, field, listed, seconds):
    row = listed.match(field)
    half = (len(field.frames) + 1) // 2
    print(f'\n{name}: {len(listed.x)} stars, {seconds:.1f} CPU s\n mag      n'
          '  complete  flux bias [mag]  colour bias [sigma]  pull of mean flux'
          '  of each')
    for low in range(18, 26):
        here = field.inside & (field.mag >= low) & (field.mag < low + 1)
        found = here & (row >= 0)
        at = row[found]
        one, e_one = mean(listed, at, slice(half))
        colour = np.nan
        if half < listed.flux.shape[1]:
            two, e_two = mean(listed, at, slice(half, None))
            both = (one > 0) & (two > 0)
            ratio = np.log(two[both] / one[both])
            true = np.log(field.flux[-1][found] / field.flux[0][found])[both]
            colour = np.median((ratio - true) / np.hypot(
                e_one[both] / one[both], e_two[both] / two[both]))
        true = field.flux[0][found]
        truth = field.flux[:listed.flux.shape[1], found].T
        bias = -2.5 * np.log10(np.median(one / true)) if at.size else np.nan
        print(f'{low}-{low + 1} {here.sum():6d}  '
              f'{found.sum() / max(here.sum(), 1):8.1%}  {bias:+15.4f}  '
              f'{colour:+19.2f}  {width((one - true) / e_one):17.2f}  '
              f'{width((listed.flux[at] - truth) / listed.error[at]):7.2f}')
    return row


def print_motions(field, lists):
    print('\nmotions: robust scatter of errors [mas / yr], share of all stars'
          ' that are within 2 mas / yr\n mag      n' + ''.join(
              f'{name:>24}' for name in lists))
    for low in range(18, 26):
        here = field.inside & (field.mag >= low) & (field.mag < low + 1)
        line = f'{low}-{low + 1} {here.sum():6d}'
        for listed, row in lists.values():
            found = here & (row >= 0)
            off = listed.motion[:, row[found]] - field.motion[:, found]
            good = (np.abs(off) < 2).sum() / 2 / max(here.sum(), 1)
            line += f'{scatter(off):14.3f}{good:10.1%}'
        print(line)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--size', type=int, default=512)
    parser.add_argument('--images', type=int, default=4)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--psf', help='a GriddedMixturePSF in a file '
                                      '(default: one of a mock camera)')
    parser.add_argument('--motions', action='store_true')
    parser.add_argument('--quick', action='store_true')
    args = parser.parse_args()
    if args.quick:
        args.size, args.images = 128, 2
    warnings.simplefilter('ignore')
    optics = (light.Optics(GriddedMixturePSF.read(args.psf)) if args.psf
              else light.Optics.of(args.size, args.seed))
    psf, field = optics.psf, Field(args, optics)
    with ThreadPoolExecutor(1) as pool:
        alone, single = each_alone(field, psf, pool)
        joint, seconds = together(field, psf, args.motions, pool)
    print_list('the first image alone', field, alone[0], single)
    stacked = averaged(alone, field.years)
    rows = {'single images': (stacked, print_list(
        'single images, averaged', field, stacked, single * len(alone)))}
    rows['together'] = joint, print_list('together', field, joint, seconds)
    one = alone[0].match(field)
    mag, deeper = limit(field, one), 1.25 * np.log10(args.images)
    print(f'\nat {mag:.2f} mag one image finds '
          f'{complete_at(field, one, mag):.1%}, together they find '
          f'{complete_at(field, rows["together"][1], mag):.1%}, one finds '
          f'{complete_at(field, one, mag - deeper):.1%} where stars are '
          f'{deeper:.2f} mag brighter; the time is {seconds / single:.1f} '
          'times that of one image')
    if args.motions:
        print_motions(field, rows)


if __name__ == '__main__':
    main()
