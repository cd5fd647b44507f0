"""
Crowded fields as people have them: clusters, galaxies, a sloping sky.

Run as ``python tests/benchmarks/bench_crowded_light.py``. All scenes are
simulated with a PSF of this package, which is given to the solver. Parts:

``even``
    stars at the density of a bulge field, two exposures: RMS over the bound,
    completeness, false stars, biases, pulls of x, y and flux, and
    ``reduced_chi2``;
``plane``
    the first of them with a plane of 3 counts a pixel added: how far fluxes
    move in standard errors, and how many stars come and go;
``cluster``
    a King-like cluster whose core is saturated, masked or NaN: stars of 20
    mag at three densities;
``galaxy``
    a galaxy of 15 mag with a half-light radius of 60 pixels, n = 1 and 4,
    behind a few stars: false stars beyond 40 pixels, stars found within; and
    the same stars without it, which tell what is due to the galaxy.

Stars with the flag of what is no star, or of saturation, count as not found.
"""
import argparse
import time
import warnings
from dataclasses import replace
from itertools import pairwise

import crowded_light as light
import numpy as np
from astropy.table import Table
from crowded_scores import RADIUS, Score, pair, scatter

from photutils_mgauss import CrowdedMixturePhotometry

PARTS = ('even', 'plane', 'cluster', 'galaxy')
DENSITIES = (0, 0.05, 0.12, 0.25)
NOT_STARS = 262144 | 65536
CORE = 20
COLUMNS = ('x', 'y', 'flux')


def reduce(psf, scene):
    """Return a plain table of an image, its meta and CPU seconds."""
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        table = CrowdedMixturePhotometry(psf)(
            scene.images['sci'], error=scene.images['err'],
            mask=scene.images['mask'])
    seconds = time.process_time() - start
    plain = Table({name: np.asarray(table[f'{name}_fit'], float)
                   for name in COLUMNS}, meta=table.meta)
    for name in COLUMNS:
        plain[f'{name}_err'] = np.asarray(table[f'{name}_err'])
    plain['star'] = np.asarray(table['flags']) & NOT_STARS == 0
    return plain[np.isfinite(plain['x']) & (plain['flux'] > 0)], seconds


def flux_error(score, which):
    """Return error of the flux, its standard error, and the true flux."""
    row = np.full(len(score.scene.truth), -1)
    row[score.true] = score.row
    at = row[which]
    true = np.asarray(score.scene.truth['flux'])[which]
    return (np.asarray(score.table['flux'])[at] - true,
            np.asarray(score.table['flux_err'])[at], true)


def print_even(name, scene, table, seconds):
    score = Score.of(scene, table[table['star']], centred=True)
    errors = score.errors()
    row = np.full(len(scene.truth), -1)
    row[score.true] = score.row
    print(f'\n{name}: {len(table)} stars, {seconds:.1f} CPU s, reduced_chi2 '
          f'{table.meta["reduced_chi2"]:.3f}\n mag     n   RMS/CRLB  complete'
          '  false   flux bias  pull x, y  flux')
    rows = []
    for low, here, there in score.bins():
        found = here & (row >= 0)
        error = errors[found]
        width = np.column_stack([score.table[f'{c}_err'][row[found]]
                                 for c in 'xy'])
        off, flux_width, true = flux_error(score, found)
        pull = off / flux_width
        rows.append((low, here.sum(), scatter(error / scene.bound[found]),
                     found.sum() / max(here.sum(), 1),
                     (score.false & there).sum() / max(there.sum(), 1),
                     -2.5 * np.log10(1 + np.median(off / true)),
                     scatter(error / width),
                     scatter(pull - np.nanmedian(pull))))
        print('{0}-{8} {1:5d}  {2:7.2f}  {3:8.1%}  {4:6.1%}  {5:+8.4f}  '
              '{6:7.2f}  {7:6.2f}'.format(*rows[-1], low + 1))
    return np.array(rows, float)


def even_part(args, optics):
    rows = []
    for seed in args.seeds:
        scene = even_scene(args, optics, seed)
        rows.append(print_even(f'even stars, seed {seed}', scene,
                               *reduce(optics.psf, scene)))
    return rows


def even_scene(args, optics, seed):
    truth = light.even_stars(args.size, seed)
    shape = args.size, args.size
    return light.expose(optics.draw(truth, shape), truth,
                        seed).bounded(optics.psf)


def plane_part(args, optics):
    scene = even_scene(args, optics, args.seeds[0])
    x = np.arange(scene.size)
    # The same errors: it is the answer to the same noise that is asked for.
    before, _ = reduce(optics.psf, scene)
    scene.images['sci'] = scene.images['sci'] + 3 * x
    after, _ = reduce(optics.psf, scene)
    return print_plane(before, after, scene)


def print_plane(before, after, scene):
    both = [t[t['star']] for t in (before, after)]
    known = replace_truth(scene, both[0])
    i, j = pair(known, both[1], 0.5, 1.0)
    change = (np.asarray(both[1]['flux'])[j] - np.asarray(
        both[0]['flux'])[i]) / np.asarray(both[0]['flux_err'])[i]
    new = np.setdiff1d(np.arange(len(both[1])), j)
    print(f'\nplane of 3 counts/px: {len(both[0])} stars before, '
          f'{len(both[1])} after, {len(new)} new, '
          f'{len(both[0]) - len(i)} gone; |change| of flux in standard errors'
          f': median {np.median(np.abs(change)):.4f}, 99 % '
          f'{np.percentile(np.abs(change), 99):.3f}, largest '
          f'{np.abs(change).max():.3f}, {np.mean(np.abs(change) > 0.2):.2%} '
          'beyond 0.2')
    return len(both[0]), np.mean(np.abs(change) > 0.2), len(new)


def replace_truth(scene, table):
    """Return a scene whose truth is a list."""
    truth = table.copy()
    truth['mag'] = scene.magnitude(truth['flux'])
    return replace(scene, truth=truth)


def cluster_part(args, optics):
    rows = []
    for seed, centre, kind in ((args.seeds[0], 0.5, 'masked'),
                               (args.seeds[1], 0.3, 'nan')):
        truth = light.cluster_stars(args.size, seed, centre)
        shape = args.size, args.size
        scene = light.without_core(
            light.expose(optics.draw(truth, shape), truth, seed), CORE,
            kind).bounded(optics.psf)
        rows.append(print_cluster(
            f'cluster of {centre} stars/px in the middle, core {kind}', scene,
            centre, *reduce(optics.psf, scene)))
    return rows


def print_cluster(name, scene, centre, table, seconds):
    good = Score.of(scene, table[table['star']], centred=True)
    every = Score.of(scene, table, centred=True)
    errors, mag = good.errors(), np.asarray(scene.truth['mag'])
    found = np.isfinite(errors[:, 0])
    listed = np.isfinite(every.errors()[:, 0])
    density = light.king_density(scene.truth['x'], scene.truth['y'],
                                 scene.size, centre)
    there = light.king_density(good.table['x'], good.table['y'], scene.size,
                               centre)
    listed_mag = scene.magnitude(good.table['flux'])
    print(f'\n{name}: {len(table)} stars, {np.mean(~table["star"]):.1%} '
          f'flagged, {seconds:.1f} CPU s, reduced_chi2 '
          f'{table.meta["reduced_chi2"]:.3f}\n stars/px   mag        n '
          'complete (flagged too)  bias  RMS/CRLB pull x, y  flux  false')
    rows = []
    for low, high in pairwise(DENSITIES):
        for m_low, m_high in ((17, 19), (19.5, 20.5), (21.5, 22.5)):
            here = (good.counted & (density >= low) & (density < high)
                    & (mag >= m_low) & (mag < m_high))
            at = here & found
            off, width, true = flux_error(good, at)
            row = np.full(len(mag), -1)
            row[good.true] = good.row
            error = np.column_stack([good.table[f'{c}_err'][row[at]]
                                     for c in 'xy'])
            near = ((there >= low) & (there < high) & good.listed
                    & (listed_mag >= m_low) & (listed_mag < m_high))
            row = (low, m_low, here.sum(), found[here].mean(),
                   listed[here].mean(),
                   -2.5 * np.log10(1 + np.median(off / true)),
                   scatter(errors[at] / scene.bound[at]),
                   scatter(errors[at] / error), scatter(off / width),
                   (good.false & near).sum() / max(near.sum(), 1))
            rows.append(row)
            print('{0:.2f}-{10:.2f} {1}-{11} {2:5d}  {3:7.1%} ({4:.1%})  '
                  '{5:+8.4f}  {6:6.2f}  {7:6.2f}  {8:6.2f}  '
                  '{9:6.1%}'.format(*row, high, m_high))
    return np.array(rows, float)


def galaxy_part(args, optics):
    truth = light.even_stars(args.size, args.seeds[0], 0.02)
    stars = optics.draw(truth, (args.size, args.size))
    rows = []
    for name, galaxy in (('no galaxy', 0), *(
            (f'galaxy of n = {index:.0f}', light.sersic(
                args.size, index=index)) for index in (1.0, 4.0))):
        scene = light.expose(stars + galaxy, truth, args.seeds[0]).bounded(
            optics.psf)
        rows.append(print_galaxy(name, scene, *reduce(optics.psf, scene)))
    return rows


def print_galaxy(name, scene, table, seconds):
    score = Score.of(scene, table[table['star']], centred=True)
    # Half a pixel is two standard errors of a faint star, and many are beyond.
    loose = Score.of(scene, table[table['star']], centred=True,
                     radius=2 * RADIUS)
    truth, found = scene.truth, np.isfinite(score.errors()[:, 0])
    middle = scene.size / 2
    radius = np.hypot(truth['x'] - middle, truth['y'] - middle)
    far = np.hypot(score.table['x'] - middle, score.table['y'] - middle)
    bright = score.counted & (truth['mag'] < 23)
    print(f'\n{name}: {len(table)} stars, {np.mean(~table["star"]):.1%} '
          f'flagged, {seconds:.1f} CPU s\n radius    stars < 23 mag, found  '
          'listed  false: none within 0.5, 1 px  all listed, flux bias')
    rows = []
    for low, high in ((0, 40), (40, 80), (80, 140), (140, scene.size)):
        here = bright & (radius >= low) & (radius < high)
        near = score.listed & (far >= low) & (far < high)
        also = (table['flux'] > 0) & (np.hypot(
            table['x'] - middle, table['y'] - middle) < high) & (np.hypot(
                table['x'] - middle, table['y'] - middle) >= low)
        off, _, true = flux_error(score, here & found)
        bias = -2.5 * np.log10(1 + np.median(off / true)) if (
            true.size) else np.nan
        print(f'{low:3d}-{high:3d} {here.sum():6d}  {found[here].mean():7.1%}'
              f'   {near.sum():5d}  {score.false[near].mean():6.1%} '
              f'{loose.false[near].mean():6.1%}  {also.sum():5d}  {bias:+.4f}')
        rows.append((low, found[here].mean(), score.false[near].mean(),
                     loose.false[near].mean()))
    return np.array(rows)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS)
    parser.add_argument('--size', type=int, default=512)
    parser.add_argument('--seeds', type=int, nargs=2, default=(1, 2))
    args = parser.parse_args()
    optics = light.Optics.of(args.size, args.seeds[0])
    parts = {'even': even_part, 'plane': plane_part, 'cluster': cluster_part,
             'galaxy': galaxy_part}
    for part in args.parts:
        parts[part](args, optics)


if __name__ == '__main__':
    main()
