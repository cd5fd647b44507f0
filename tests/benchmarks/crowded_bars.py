"""
What is asked of crowded photometry, beside what is measured.

One row for each bar, from the scenes of `bench_crowded_light`,
`bench_crowded_psf` and `bench_crowded_images` and from one of saturated stars
here, all with the same optics: those of the mock camera of this package, or
of another simulator.
"""
import argparse
import warnings
from concurrent.futures import ThreadPoolExecutor

import bench_crowded_images as images
import bench_crowded_light as scenes
import bench_crowded_psf as own_psf
import crowded_light as light
import numpy as np
from astropy.table import QTable, Table
from crowded_scores import scatter

from photutils_mgauss import MixturePSFPhotometry, fit_mixture_field
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.saturation import saturated_pixels

PARTS = ('even', 'plane', 'cluster', 'galaxy', 'own', 'saturated', 'images')
CELL, N_SATURATED, BLEEDING = 40, 60, 0.7


class Bars:
    """Rows of what is asked and what is measured."""

    def __init__(self):
        self.rows = []

    def add(self, what, asked, measured, form='.2f', *, least=False,
            low=None):
        """Add numbers of which all are to be at most, or least, asked."""
        values = np.atleast_1d(np.asarray(measured, float))
        met = (values >= asked if least else values <= asked).all() and (
            low is None or (values >= low).all())
        word = ('at least ' if least else '') + format(asked, form)
        if low is not None:
            word = f'{low:{form}} to {asked:{form}}'
        self.rows.append((what, word, ' '.join(
            format(value, form) for value in values),
            'met' if met else 'missed'))

    def show(self):
        """Print all rows."""
        print('\n' + '\n'.join('  '.join(
            cell.ljust(n) for cell, n in zip(row, (58, 14, 44, 6),
                                             strict=True)).rstrip()
            for row in [('bar', 'asked', 'measured', ''), *self.rows]))


def even(bars, args, optics):
    """Measure two exposures of a bulge field."""
    for rows in scenes.even_part(args, optics):
        low, n, ratio, _, _, bias, place, flux = rows[rows[:, 0] < 24].T
        at = np.isin(low, (17, 18, 20, 22))
        bars.add('RMS/CRLB, true PSF, 17-18 18-19 20-21 22-23', 1.4,
                 ratio[at])
        bars.add('pulls of x and y, 17 to 24 mag', 1.1,
                 [place.min(), place.max()], low=0.9)
        # The width that a median tells of n normal errors is off by chance.
        chance = 1.17 / np.sqrt(n[:2].min())
        bars.add(f'pulls of flux, 17-19 mag (by chance +- {chance:.2f})',
                 1.1, flux[:2], low=0.9)
        bars.add('pulls of flux, 19 to 24 mag', 1.1,
                 [flux[2:].min(), flux[2:].max()], low=0.9)
        bars.add('bias of flux to 24 mag', 0.005, np.abs(bias).max(), '.4f')


def plane(bars, args, optics):
    n, beyond, new = scenes.plane_part(args, optics)
    bars.add('plane: fluxes that change by more than 0.2 sigma', 0, beyond,
             '.2%')
    bars.add(f'plane: new stars (of {n})', 0, new, '.0f')


def cluster(bars, args, optics):
    for rows in scenes.cluster_part(args, optics):
        part = rows[rows[:, 1] == 19.5]
        for row, share, bias, ratio in zip(
                part, (0.95, 0.95, 0.9), (0.02, 0.02, 0.05), (1.3, 1.7, 2.6),
                strict=True):
            where = f'cluster, 20 mag, from {row[0]:.2f} stars/px: '
            bars.add(where + 'complete', share, row[3], '.1%', least=True)
            bars.add(where + 'bias', bias, abs(row[5]), '.4f')
            bars.add(where + 'RMS/CRLB', ratio, row[6])


def galaxy(bars, args, optics):
    alone, *both = scenes.galaxy_part(args, optics)
    bars.add('the same stars without a galaxy: false there', 0.05,
             alone[1:, 2], '.1%')
    bars.add('the same, no star within 1 pixel', 0.05, alone[1:, 3], '.1%')
    for index, rows in zip((1, 4), both, strict=True):
        bars.add(f'galaxy, n = {index}: false beyond 40 pixels', 0.05,
                 rows[1:, 2], '.1%')
        bars.add(f'galaxy, n = {index}: no star within 1 pixel', 0.05,
                 rows[1:, 3], '.1%')
        bars.add(f'galaxy, n = {index}: stars found within', 0.5, rows[0, 1],
                 '.1%', least=True)


def own(bars, args, optics):
    """Measure with a PSF of the crowded image's own stars."""
    truth = light.even_stars(args.own_size, args.seeds[0] + 50)
    scene = light.expose(optics.draw(truth, (args.own_size,) * 2), truth,
                         args.seeds[0] + 50)
    lists = own_psf.compare(scene, optics.psf)
    mine, true = (np.array([own_psf.numbers(score, *mag) for mag in (
        (17, 19), (20, 21), (22, 23))]) for score in lists)
    where = 'own PSF, 17-19 20-21 22-23: '
    bars.add(where + 'RMS over that by the true one', 1.05,
             mine[:, 1] / true[:, 1])
    bars.add(where + 'completeness lost', 0.01, true[:, 3] - mine[:, 3],
             '.1%')
    bars.add(where + 'false', 0.02, mine[:, 4], '.1%')
    bars.add(where + 'bias of flux', 0.01, np.abs(mine[:, 5]), '.4f')


def run_over(image, share):
    """Let a share of what is above the full well run along columns."""
    for column in image.T:
        excess = share * np.maximum(column - light.FULL_WELL, 0)
        column[excess > 0] = light.FULL_WELL
        for row in np.flatnonzero(excess):
            for step in (1, -1):
                charge, at = excess[row] / 2, row + step
                while charge > 0 and 0 <= at < column.size:
                    taken = min(max(light.FULL_WELL - column[at], 0), charge)
                    column[at] += taken
                    charge -= taken
                    at += step
    return np.minimum(image, light.FULL_WELL)


def saturated_scene(args, optics, share):
    """Return an image, its stars, and magnitudes above saturation."""
    rng, n = np.random.default_rng(args.seeds[0]), args.own_size
    axis = np.arange(CELL, n - CELL / 2, CELL)
    x, y = (v.ravel() for v in np.meshgrid(axis, axis))
    order = rng.permutation(x.size)
    x, y = (v[order] + rng.uniform(-CELL / 4, CELL / 4, x.size)
            for v in (x, y))
    above = np.where(np.arange(x.size) < N_SATURATED, rng.uniform(
        0.3, 2.5, x.size), -rng.uniform(0.2, 4, x.size))
    middle = Table({'x': [n / 2], 'y': [n / 2], 'flux': [1.0]})
    peak = optics.draw(middle, (n, n)).max()
    stars = QTable({'x': x, 'y': y,
                    'flux': light.FULL_WELL / peak * 10**(0.4 * above)})
    drawn = rng.poisson(optics.draw(stars, (n, n)) + light.SKY).astype(float)
    drawn += rng.normal(0, light.READ_NOISE, drawn.shape)
    return run_over(drawn, share) - light.SKY, stars, above, rng


def saturated(bars, args, optics):
    """Measure saturated stars, with the PSF of those that are not."""
    for share in (0, BLEEDING):
        data, stars, above, rng = saturated_scene(args, optics, share)
        level = 0.98 * light.FULL_WELL - light.SKY
        floor = light.SKY + light.READ_NOISE**2
        error = np.sqrt(np.maximum(data, 0) + floor)
        field = fit_mixture_field(
            data, stars[above < 0], error=error, n_components=5, degree=2,
            mask=saturated_pixels(read_pixels(data, error), level))
        start = stars.copy()
        for name in 'xy':
            start[name] += rng.normal(0, 0.3, len(stars))
        table = MixturePSFPhotometry(field, 11, saturation=level,
                                     effective_gain=1.0)(
            data, error=np.full(data.shape, np.sqrt(floor)),
            init_params=start)
        off = centred(table, stars, (above < -0.2) & (above > -2.5))
        flagged = (table['flags'] & scenes.NOT_STARS) > 0
        bright = (above > 1.5) & flagged
        name = 'saturated, 1.5-2.5 mag above' + (', bleeding' if share
                                                 else '')
        bars.add(f'{name}: RMS [mpix]', 10, 1e3 * np.sqrt(
            np.mean(off[bright]**2)), '.1f')
        width = np.column_stack([table['x_err'], table['y_err']])
        bars.add(f'{name}: RMS of pulls', 1.1, np.sqrt(np.mean(
            (off / width)[bright]**2)), low=0.9)


def centred(table, stars, known):
    """Return errors (n, 2) without what is smooth in those of known stars."""
    off = np.column_stack([np.asarray(table[f'{c}_fit']) - stars[c]
                           for c in 'xy'])
    u, v = (stars[c] / stars[c].max() for c in 'xy')
    terms = np.column_stack([u**a * v**b for a in range(4)
                             for b in range(4 - a)])
    known = known & np.isfinite(off).all(axis=1)
    return off - terms @ np.linalg.lstsq(terms[known], off[known],
                                         rcond=None)[0]


def many(bars, args, optics):
    """Measure four exposures of one field, together and alone."""
    settings = argparse.Namespace(size=args.images_size, images=4,
                                  seed=args.seeds[0], motions=False)
    field = images.Field(settings, optics)
    with ThreadPoolExecutor(1) as pool:
        alone, single = images.each_alone(field, optics.psf, pool)
        joint, seconds = images.together(field, optics.psf, False, pool)
    one = alone[0].match(field)
    row = images.print_list('together', field, joint, seconds)
    mag = images.limit(field, one)
    bars.add(f'four images: complete at {mag:.2f} mag over sqrt(n)', 0.9,
             images.complete_at(field, row, mag) / images.complete_at(
                 field, one, mag - 1.25 * np.log10(4)), least=True)
    bars.add('four images: time of one', 6, seconds / single, '.1f')
    pulls = []
    for low in range(20, 25):
        here = field.inside & (row >= 0) & (field.mag >= low) & (
            field.mag < low + 1)
        pull = (joint.flux[row[here]] - field.flux[:, here].T) / (
            joint.error[row[here]])
        pulls.append(scatter(pull - np.nanmedian(pull)))
    bars.add('four images: pulls of flux, 20 to 25 mag', 1.1, pulls, low=0.9)


def run(args):
    """Measure the parts that are asked for, and print one table."""
    size = max(args.own_size, args.size)
    optics = (light.HarnessOptics.of(size, args.harness, args.optics)
              if args.harness else light.Optics.of(size, args.seed))
    args.seeds = args.seed, args.seed + 1
    bars = Bars()
    parts = dict(zip(PARTS, (even, plane, cluster, galaxy, own, saturated,
                             many), strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        try:
            for name in PARTS:
                if name in args.bars:
                    parts[name](bars, args, optics)
        finally:
            bars.show()
