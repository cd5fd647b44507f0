"""
Motions from the pixels of all epochs beside those of catalogues.

Run as ``python tests/benchmarks/bench_pixel_motions.py``. Parts: ``table``
isolated stars of one signal-to-noise ratio an epoch in seven images at the
times of Nie et al., frames known, from catalogues (single-epoch photometry of
what is found at 5 sigma, at least three epochs) and from the pixels, against
the Cramer-Rao bound by numeric derivatives; ``parallax`` stars of 1 mas in 20
epochs; ``limit`` the same stars, whose errors are compared with those of the
mean of the posterior probability for known fluxes and a flat prior, integrated
over motions and places by sampling: no estimator that treats all places and
motions alike has a smaller mean square error; ``speed`` many stars, CPU
seconds and memory; ``scene`` 614 stars and 590 quasars in a field of a few
arcminutes, PSFs and frames from the images, what stars are found included,
errors of motions against magnitude.

A star counts as measured if it has a motion, no flag, and a significance of
at least 5 in all images together. RMS and pulls are over all of these, none
rejected.
"""
import argparse
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.stats import mad_std
from astropy.table import QTable
from astropy.wcs import WCS
from photutils.detection import DAOStarFinder
from scipy.ndimage import map_coordinates, spline_filter
from scipy.special import ndtri
from scipy.stats import qmc

from photutils_mgauss import (
    Epoch,
    GaussianMixture,
    GriddedMixturePSF,
    ImageEpoch,
    Instrument,
    MixturePSFPhotometry,
    PixelMotionFitter,
    ProperMotionFitter,
    fit_mixture_field,
    paper_exposures,
    render_stars,
    select_psf_stars,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.sky.observers import observer_position

MIXTURE = GaussianMixture.from_stddevs(
    [0.75, 0.25], [(0, 0), (0.05, 0)], [(0.85, 0.9), (1.9, 1.8)], [0.05, 0.1])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])
NOISE, SCALE = 5.0, 74.0  # of a pixel; mas in one
BOX, SPACING = 11, 29


def make_wcs(angle, shift, size):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval = 192.8595, 27.1283
    wcs.wcs.crpix = np.array([size, size]) / 2 + shift
    c, s = np.cos(angle) * SCALE / 3.6e6, np.sin(angle) * SCALE / 3.6e6
    wcs.wcs.cd = [[-c, s], [s, c]]
    return wcs


class Sky:
    """Stars on a lattice, seen in images at some years."""

    def __init__(self, n_side, years, signal, rng, parallax=0.0):
        self.rng, self.years, self.parallax = rng, np.asarray(years), parallax
        self.size = SPACING * (n_side + 1)
        self.wcs = [make_wcs(rng.normal(0, 0.002), rng.normal(0, 2, 2),
                             self.size) for _ in years]
        grid = SPACING * np.arange(1, n_side + 1.0)
        x, y = (axis.ravel() + rng.uniform(-0.5, 0.5, axis.size)
                for axis in np.meshgrid(grid, grid))
        self.start = make_wcs(0, 0, self.size).pixel_to_world(x, y)
        self.motion = rng.normal(0, 5, (2, x.size))  # mas / yr
        stamp = MIXTURE.render((41, 41), 20, 20)
        self.flux = signal * NOISE / np.sqrt(np.sum(stamp**2))
        self.mean = self.years.mean()

    def factors(self):
        """Return parallax factors east and north (E, n)."""
        ra, dec = self.start.ra.rad, self.start.dec.rad
        x, y, z = observer_position(None, self.years)[:, :, None]
        return (x * np.sin(ra) - y * np.cos(ra),
                (x * np.cos(ra) + y * np.sin(ra)) * np.sin(dec)
                - z * np.cos(dec))

    def places(self, k):
        dt = self.years[k] - self.mean
        east, north = (self.motion[i] * dt + self.parallax * factor[k]
                       for i, factor in enumerate(self.factors()))
        return self.start.spherical_offsets_by(east * u.mas, north * u.mas)

    def images(self):
        shape, out = (self.size, self.size), []
        for k, wcs in enumerate(self.wcs):
            x, y = wcs.world_to_pixel(self.places(k))
            light = render_stars(PSF, x, y, np.full(x.size, self.flux), shape)
            data = light + 100 + self.rng.normal(0, NOISE, shape)
            out.append(ImageEpoch(data, PSF, wcs, self.years[k], error=NOISE))
        return out

    def known(self):
        """Return the stars a third of a pixel off, at rest."""
        east, north = self.rng.normal(0, 0.3 * SCALE, (2, len(self.start)))
        return SkyCoord(self.start.spherical_offsets_by(
            east * u.mas, north * u.mas))

    def bound(self):
        """Return errors (4 or 5,) of place, motion and parallax [mas]."""
        fisher = SCALE**-2 * mean_fisher(self.flux)
        east, north = (factor.mean(axis=1) for factor in self.factors())
        total = 0.0
        for dt, *pair in zip(self.years - self.mean, east, north,
                             strict=True):
            d = np.zeros((2, 5 if self.parallax else 4))
            d[0, 0] = d[1, 1] = 1
            d[0, 2] = d[1, 3] = dt
            if self.parallax:
                d[:, 4] = pair
            total = total + d.T @ fisher @ d
        return np.sqrt(np.diag(np.linalg.inv(total)))


def mean_fisher(flux, step=1e-3):
    """Return the matrix (2, 2) of x and y, flux and sky eliminated."""
    total = []
    for dx, dy in np.random.default_rng(1).uniform(-0.5, 0.5, (40, 2)):
        def draw(x, y):
            return MIXTURE.render((BOX, BOX), 5 + x, 5 + y).ravel()
        rows = np.stack([
            flux * (draw(dx + step, dy) - draw(dx - step, dy)) / (2 * step),
            flux * (draw(dx, dy + step) - draw(dx, dy - step)) / (2 * step),
            draw(dx, dy), np.ones(BOX * BOX)]) / NOISE
        cross = rows @ rows.T
        total.append(cross[:2, :2] - cross[:2, 2:] @ np.linalg.solve(
            cross[2:, 2:], cross[2:, :2]))
    return np.mean(total, axis=0)


def score(names, table, truth, bound, measured):
    """Return measured share, RMS and robust scatter over bound, and pull."""
    away = np.array([(table[name] - true).value
                     for name, true in zip(names, truth, strict=True)])
    error = np.array([table[f'{name}_error'].value for name in names])
    away, error = away[:, measured], error[:, measured]
    scaled = away / bound[:, None]
    return (measured.mean(), np.sqrt(np.mean(scaled**2)), mad_std(scaled),
            np.sqrt(np.mean((away / error)**2)))


def from_pixels(sky, images, **options):
    stars = PixelMotionFitter(parallax=bool(sky.parallax), **options).fit(
        images, sky.known()).stars
    return stars, ((stars['flags'] == 0) & (stars['significance'] >= 5)
                   & np.isfinite(stars['pmra']))


def from_catalogues(sky, images):
    """Return motions of stars found at 5 sigma in at least three images."""
    phot, tables = MixturePSFPhotometry(PSF, BOX), []
    for k, image in enumerate(images):
        x, y = sky.wcs[k].world_to_pixel(sky.places(k))
        table = phot(np.asarray(image.data) - 100, error=np.full(
            image.data.shape, NOISE), init_params=QTable(
                {'x': x, 'y': y, 'flux': np.full(x.size, sky.flux)}))
        table['id'] = np.arange(len(table))
        found = table['flux_fit'] > 5 * table['flux_err']
        found &= np.hypot(table['x_fit'] - x, table['y_fit'] - y) < 2
        tables.append(Epoch(table[found], sky.wcs[k], sky.years[k]))
    empty = QTable({'pmra': np.full(len(sky.start), np.nan) * u.mas / u.yr})
    for name in ('pmdec', 'pmra_error', 'pmdec_error'):
        empty[name] = empty['pmra'].copy()
    try:
        got = ProperMotionFitter(transform=None, match_by='id', clip=None,
                                 systematic=None).fit(tables).stars
    except ValueError:  # nothing has been found
        return empty, np.zeros(len(empty), bool)
    for name in empty.colnames:
        empty[name][np.asarray(got['id'])] = got[name]
    count = np.zeros(len(empty), int)
    count[np.asarray(got['id'])] = got['n_good_obs']
    return empty, (count >= 3) & np.isfinite(empty['pmra'].value)


def print_table(options):
    years = [exposure.time.jyear for exposure in paper_exposures()]
    print('S/N   catalogues: measured RMS/bound scatter/bound pull   pixels: '
          'measured RMS/bound scatter/bound pull   flux bias')
    for signal in options.signals:
        sky = Sky(options.side, years, signal,
                  np.random.default_rng([options.seed, int(10 * signal)]))
        images, bound = sky.images(), sky.bound()[2:4]
        words = f'{signal:4.1f}'
        got = {}
        for name, make in (('catalogues', from_catalogues),
                           ('pixels', from_pixels)):
            stars, measured = make(sky, images)
            got[name] = stars
            values = ((0.0, np.nan, np.nan, np.nan) if not measured.any() else
                      score(('pmra', 'pmdec'), stars,
                            sky.motion * u.mas / u.yr, bound, measured))
            words += '      {:6.1%} {:6.3f} {:6.3f} {:6.3f}'.format(*values)
        bias = np.nanmean(got['pixels']['flux'].value) / sky.flux - 1
        print(words + f'      {bias:+.3f}', flush=True)


def print_parallax(options):
    years = 2024.0 + np.arange(20) * 0.23
    for signal in (3, 5, 10):
        sky = Sky(options.side, years, signal,
                  np.random.default_rng([options.seed, signal]), parallax=1.0)
        stars, measured = from_pixels(sky, sky.images())
        values = score(('parallax',), stars, [1 * u.mas], sky.bound()[4:],
                       measured)
        mean = np.mean(stars['parallax'][measured].value)
        print('parallax, S/N {:4.1f}: {:6.1%} {:6.3f} {:6.3f} {:6.3f}, mean '
              '{:.3f} mas'.format(signal, *values, mean), flush=True)


class Best:
    """
    Means of the posterior of motions for known fluxes and a flat prior.

    Products of the PSF with the data are looked up in maps of the places
    around each star; ``n_points`` points are drawn from a Gaussian that is
    wider than the errors are.
    """

    step, reach, wide, n_points = 0.08, 2.4, 2.0, 4096

    def __init__(self, sky, images):
        self.sky, self.images = sky, images
        axis = np.arange(-self.reach, self.reach + self.step / 2, self.step)
        stamps = np.array([[MIXTURE.render((BOX, BOX), BOX // 2 + x,
                                           BOX // 2 + y).ravel()
                            for x in axis] for y in axis])
        # Without a mean they do not see the sky.
        self.stamps = stamps - stamps.mean(axis=-1, keepdims=True)
        points = ndtri(qmc.Sobol(4, rng=np.random.default_rng(3)).random(
            self.n_points))
        self.drawn = 0.5 * np.sum(points**2, axis=1)
        self.away = self.wide * points * sky.bound()

    def errors(self):
        """Return the errors of motions (2, n) [mas / yr]."""
        total = np.broadcast_to(self.drawn, (len(self.sky.start),
                                             self.n_points)).copy()
        squares = spline_filter(np.sum(self.stamps**2, axis=-1))
        for k, image in enumerate(self.images):
            x, y = self.sky.wcs[k].world_to_pixel(self.sky.places(k))
            to_pixels = np.linalg.inv(self.sky.wcs[k].wcs.cd * 3.6e6)
            dt = self.sky.years[k] - self.sky.mean
            moved = (self.away[:, :2] + self.away[:, 2:] * dt) @ to_pixels.T
            for star, place in enumerate(zip(x, y, strict=True)):
                total[star] += self._chances(image, place, moved, squares)
        weight = np.exp(total - total.max(axis=1, keepdims=True))
        return (weight @ self.away[:, 2:] / weight.sum(axis=1)[:, None]).T

    def _chances(self, image, place, moved, squares):
        """Return the logarithm of the likelihood at places around one."""
        i, j = (int(np.rint(one)) for one in place)
        half = BOX // 2
        box = image.data[j - half:j + half + 1, i - half:i + half + 1]
        light = spline_filter(self.stamps @ box.ravel())
        at = [(moved[:, a] + place[a] - (i, j)[a] + self.reach) / self.step
              for a in (1, 0)]
        n, m = (map_coordinates(one, at, prefilter=False, mode='nearest')
                for one in (light, squares))
        flux = self.sky.flux
        return (flux * n - flux**2 * m / 2) / NOISE**2


def print_limit(options):
    years = [exposure.time.jyear for exposure in paper_exposures()]
    for signal in options.signals:
        squares = []
        for seed in range(options.seed, options.seed + options.repeats):
            sky = Sky(options.side, years, signal,
                      np.random.default_rng([seed, int(10 * signal)]))
            images = sky.images()
            stars, measured = from_pixels(sky, images)
            pixels = np.array([stars[name].value for name in (
                'pmra', 'pmdec')]) - sky.motion
            squares.append(np.stack([pixels, Best(sky, images).errors()])[
                ..., measured]**2 / sky.bound()[2:4, None]**2)
        squares = np.concatenate(squares, axis=-1).reshape(2, -1)
        rms = np.sqrt(squares.mean(axis=1))
        error = squares.std(axis=1) / np.sqrt(squares.shape[1]) / 2 / rms
        parts = squares / squares.mean(axis=1, keepdims=True)
        ratio = rms[0] / rms[1]
        unsure = ratio * np.std(parts[0] - parts[1]) / np.sqrt(
            squares.shape[1]) / 2
        print(f'limit, S/N {signal:4.1f}: pixels {rms[0]:.3f} +- '
              f'{error[0]:.3f} of the bound, posterior for known fluxes '
              f'{rms[1]:.3f}, ratio {ratio:.4f} +- {unsure:.4f}', flush=True)


def print_speed(options):
    years = [exposure.time.jyear for exposure in paper_exposures()]
    sky = Sky(options.speed_side, years, 10.0, np.random.default_rng(1))
    images, stars = sky.images(), sky.known()
    PixelMotionFitter().fit(images, stars[:50])
    before = memory_from_here()
    start, wall = time.process_time(), time.perf_counter()
    PixelMotionFitter().fit(images, stars)
    print(f'{len(stars)} stars x {len(images)} images of {BOX} x {BOX}: '
          f'{time.process_time() - start:.1f} s CPU, '
          f'{time.perf_counter() - wall:.1f} s, '
          f'{peak_memory() - before:.0f} MB beside the images, which have '
          f'{sum(image.data.nbytes for image in images) / 2**20:.0f} MB')


def memory_from_here():
    """Forget the largest memory so far; return it now [MB]. Linux only."""
    Path('/proc/self/clear_refs').write_text('5')
    return peak_memory()


def peak_memory():
    """Return the largest memory since then [MB]."""
    lines = Path('/proc/self/status').read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines
                if line.startswith('VmHWM'))


def measured_epoch(scene):
    """Return the PSF of an image from its stars, and its catalogue."""
    data = scene.image - np.median(scene.image)
    stars = select_psf_stars(data, error=scene.error, mask=scene.mask)
    field = fit_mixture_field(data, stars, error=scene.error, mask=scene.mask,
                              n_components=3, degree=1)
    finder = DAOStarFinder(5 * mad_std(data), 2.0)
    catalogue = MixturePSFPhotometry(
        field, (BOX, BOX), finder=finder, aperture_radius=3, xy_cov=True)(
        data, error=scene.error, mask=scene.mask)
    catalogue.remove_column('id')
    good = (catalogue['flags'] == 0) & (
        catalogue['flux_fit'] > 5 * catalogue['flux_err'])
    return field, Epoch(catalogue[good], scene.wcs, scene.time)


def paper_scene(options):
    """Return sources, and motions of them from catalogues and pixels."""
    sources = sky_field(614, 590, size=options.field, parallaxes=False,
                        separation=1.0, rng=options.seed)
    side = round(options.field * 6e4 / SCALE)
    scenes = simulate_epochs(sources, paper_exposures(offset=1.0),
                             instrument=Instrument(shape=(side, side)),
                             rng=options.seed + 1)
    fields, epochs = zip(*map(measured_epoch, scenes), strict=True)
    quasars = sources[sources['kind'] == 'qso']['ra', 'dec']
    quasars['class'] = 'qso'
    frames = ProperMotionFitter(references=quasars).fit(epochs)
    images = [ImageEpoch(scene.image, field, epoch.wcs, scene.time,
                         error=scene.error, mask=scene.mask,
                         band=scene.exposure.band.name)
              for scene, field, epoch in zip(scenes, fields, frames.epochs,
                                             strict=True)]
    return sources, frames.stars, PixelMotionFitter(references=frames).fit(
        images).stars


def print_scene(options):
    """Print errors of stars against magnitude, a line for half of one."""
    sources, *both = paper_scene(options)
    stars = np.flatnonzero(sources['kind'] == 'star')
    columns = [np.asarray(sources['mag_g'])[stars]]
    for table in both:
        good = np.isfinite(table['pmra_error'].value)
        some = table[good & (np.asarray(table['reference']) == '')]
        index, away, _ = SkyCoord(sources['ra'], sources['dec'])[
            stars].match_to_catalog_sky(SkyCoord(some['ra'], some['dec']))
        same = away < 0.15 * u.arcsec
        for axis in ('pmra', 'pmdec'):
            off = (some[axis][index] - sources[axis][stars]).value
            error = some[f'{axis}_error'][index].value
            columns += [np.where(same, off, np.nan),
                        np.where(same, error, np.nan)]
    columns = np.array(columns)
    print('g      stars   catalogues: measured, median error, scatter   '
          'pixels: the same [mas / yr]')
    for low in np.arange(20, 26, 0.5):
        some = columns[:, (columns[0] >= low) & (columns[0] < low + 0.5)]
        words = f'{low + 0.25:5.2f}  {some.shape[1]:4d}'
        for first in (1, 5):
            off, error = some[first:first + 4:2], some[first + 1:first + 4:2]
            there = np.isfinite(off)
            scatter = 1.4826 * np.nanmedian(np.abs(off))
            words += (f'     {there.mean():6.1%} {np.nanmedian(error):7.3f} '
                      f'{scatter:7.3f}')
        print(words, flush=True)
    for name, first in (('catalogues', 1), ('pixels', 5)):
        error = np.hypot(columns[first + 1], columns[first + 3]) / np.sqrt(2)
        fine = error < 2
        print(f'{name}: {fine.sum()} stars with errors below 2 mas / yr, the '
              f'faintest of g = {columns[0][fine].max():.2f}; half of those '
              f'to g = {last_half(columns[0], fine):.2f}', flush=True)


def last_half(magnitude, fine):
    """Return the magnitude at which half of the stars are fine."""
    order = np.argsort(magnitude)
    share = np.convolve(fine[order], np.ones(31) / 31, mode='same')
    bright = magnitude[order] < np.median(magnitude)
    below = np.flatnonzero((share < 0.5) & ~bright)
    return magnitude[order][below[0]]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('parts', nargs='*',
                        default=['table', 'parallax', 'speed'])
    parser.add_argument('--side', type=int, default=30)
    parser.add_argument('--repeats', type=int, default=1,
                        help='seeds of the limit')
    parser.add_argument('--speed-side', type=int, default=100)
    parser.add_argument('--field', type=float, default=2.4,
                        help='side of the scene [arcmin]')
    parser.add_argument('--seed', type=int, default=7)
    parser.add_argument('--signals', type=float, nargs='+',
                        default=[2.5, 3, 4, 5, 7, 10])
    options = parser.parse_args()
    warnings.simplefilter('ignore')
    for part in options.parts:
        {'table': print_table, 'parallax': print_parallax,
         'limit': print_limit, 'speed': print_speed,
         'scene': print_scene}[part](options)


if __name__ == '__main__':
    main()
