"""
Positions with a PSF field from 150 stars, against the Cramer-Rao bound.

    python tests/benchmarks/bench_field.py --harness DIR SCENE [SCENE ...]
        [--stars 150] [--n-components 5] [--degree auto] [--peers psfex,epsf]
        [--time]

A scene is a folder with sci.fits, mask.fits, vartrue.fits, truth.ecsv and
meta.json; the harness is the folder of the modules that made it (csst_psf,
metrics, peers), which know the true PSF. Stars that were not used for the PSF
are fitted with the field's grid and with the true PSF, on the same pixels
with the same variance. Errors are in units of each star's bound, after the
cubic correction of positions that the harness makes. Peers are fitted by
photutils with their own pixels, in this process.
"""
import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table

from photutils_mgauss import (
    MixturePSFPhotometry,
    assess_psf,
    fit_mixture_field,
    select_psf_stars,
)

EDGES = np.arange(18, 27)
RADIUS = 10


def scatter(values):
    return 1.4826 * np.median(np.abs(values))


def read_scene(path, harness):
    """Return meta, images, truth table and true PSF."""
    from csst_psf import TruePSF
    from run_bench import load
    meta, images, truth = load(path)
    return meta, images, truth, TruePSF(harness / meta['psf'])


def number(text):
    return text if text == 'auto' else int(text)


def fit_field(meta, images, options):
    """Select stars and fit the field, timed after compilation."""
    data = images['sci'] - meta['bkg']
    stars = select_psf_stars(data, error=images['err'], mask=images['mask'],
                             fwhm=1.8, radius=RADIUS, saturation=7e4,
                             max_stars=options.stars)
    n = int(stars['selected'].sum())
    wall, cpu = time.perf_counter(), time.process_time()
    field = fit_mixture_field(
        data, stars, error=images['err'], mask=images['mask'],
        n_components=options.n_components, degree=options.degree,
        radius=RADIUS)
    print(f'  {n} stars selected, {field}: '
          f'{time.perf_counter() - wall:.1f} s, '
          f'{time.process_time() - cpu:.1f} s CPU', flush=True)
    return stars, field


def test_stars(meta, truth, stars):
    """Return the rows of truth that are whole and not PSF stars."""
    n = meta['n']
    x, y = np.asarray(truth['x']), np.asarray(truth['y'])
    keep = ~truth['sat'] & (np.minimum(x, y) > 12) & (
        np.maximum(x, y) < n - 13)
    chosen = stars[stars['selected']]
    for star in chosen:
        keep &= np.hypot(x - star['x'], y - star['y']) > 2
    return truth[keep]


def fit_with_field(psf, data, error, test):
    start = QTable({'x_init': np.asarray(test['x']) + 0.05,
                    'y_init': np.asarray(test['y']) - 0.05,
                    'flux_init': np.asarray(test['flux'])})
    result = MixturePSFPhotometry(psf, 2 * RADIUS + 1)(
        data, error=error, init_params=start)
    names = 'x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err', 'flux_err'
    return np.column_stack([np.asarray(result[name]) for name in names])


def fit_with_truth(psf, meta, data, variance, test):
    """Fit x, y, flux by Gauss-Newton steps with the true PSF."""
    place = np.column_stack([np.asarray(test[name], float)
                             for name in ('x', 'y', 'flux')])
    corner = np.floor(place[:, :2] + 0.5).astype(int) - RADIUS
    cut = [np.s_[y:y + 2 * RADIUS + 1, x:x + 2 * RADIUS + 1]
           for x, y in corner]
    pixels = np.array([data[one] for one in cut])
    weights = np.array([1 / variance[one] for one in cut])
    for _ in range(4):
        stamps = psf.stamps(place[:, 0], place[:, 1], RADIUS, meta['origin'])
        moved = np.floor(place[:, :2] + 0.5).astype(int) - RADIUS - corner
        for i in np.flatnonzero(moved.any(axis=1)):
            for stamp in stamps:
                stamp[i] = np.roll(stamp[i], moved[i, ::-1], (0, 1))
        flux = place[:, 2, None, None]
        slopes = np.stack([flux * stamps[1], flux * stamps[2], stamps[0]], 1)
        residual = pixels - flux * stamps[0]
        matrix = np.einsum('nihw,njhw,nhw->nij', slopes, slopes, weights)
        right = np.einsum('nihw,nhw,nhw->ni', slopes, residual, weights)
        place += np.linalg.solve(matrix, right[..., None])[..., 0]
    return place


def errors_in_bounds(meta, truth_psf, images, test, fitted):
    """Return x and y errors over the bound after the cubic correction."""
    import metrics
    bound = metrics.crlb(truth_psf, test, images['vartrue'], meta['origin'])
    x, y, mag = (np.asarray(test[name]) for name in ('x', 'y', 'mag'))
    dx, dy = metrics.poly_correct(x, y, fitted[:, 0] - x, fitted[:, 1] - y,
                                  mag < 21.5, meta['n'])
    return np.column_stack([dx, dy]), bound[:, :2]


def run_scene(path, options):
    """Return a list of (method, magnitudes, errors/bound, pulls)."""
    meta, images, truth, truth_psf = read_scene(path, options.harness)
    print(path, flush=True)
    data, variance = images['sci'] - meta['bkg'], images['vartrue']
    stars, field = fit_field(meta, images, options)
    test = test_stars(meta, truth, stars)
    grid = field.to_grid((30, 30))
    print_shapes(grid, truth_psf)
    mag = np.asarray(test['mag'])
    rows = []
    for name, fitted in [
            ('true PSF', fit_with_truth(truth_psf, meta, data, variance,
                                        test)),
            ('field', fit_with_field(grid, data, np.sqrt(variance), test)),
            *peers(path, meta, images, stars, test, options)]:
        error, bound = errors_in_bounds(meta, truth_psf, images, test, fitted)
        pull = (error / fitted[:, 3:5] if fitted.shape[1] > 3
                else np.full(error.shape, np.nan))
        rows.append((name, mag, error / bound, pull))
    return rows


def print_shapes(grid, truth_psf):
    def truth(x, y):
        return truth_psf.epsf(x, y, 2, 61)

    report = assess_psf(grid, truth, (30, 30), oversampling=2)
    for name in ('size_error', 'ellipticity_error', 'e1_error', 'e2_error'):
        values = np.asarray(report.table[name])
        print(f'  {name:18s} median {np.median(values):+.4f}  standard '
              f'deviation {values.std():.4f}  robust '
              f'{scatter(values - np.median(values)):.4f}')


def peers(path, meta, images, stars, test, options):
    """Yield name and fits of the peers asked for."""
    chosen = stars[stars['selected']]
    data, error = images['sci'] - meta['bkg'], np.sqrt(images['vartrue'])
    for name in options.peers:
        psf, model = make_peer(name, path, meta, data, chosen)
        yield name, fit_with_photutils(psf, data, error, test)
        if model is not None:
            from photutils_mgauss import GriddedMixturePSF
            chain = GriddedMixturePSF.from_gridded_psf(model, 3, radius=7)
            yield f'{name} -> K = 3', fit_with_field(chain, data, error,
                                                     test)


def make_peer(name, path, meta, data, stars):
    """Return the PSF for photutils, and its grid where it has one."""
    import peers as harness
    if name == 'epsf':
        table = Table({'x': stars['x'], 'y': stars['y']})
        return harness.build_epsf(data, table), None
    work = Path(path) / 'psfex_work'
    catalogue, _ = harness.run_sex(Path(path) / 'sci.fits', work,
                                   vignet=True)
    file = harness.run_psfex(keep_stars(catalogue, stars), work)
    grid = harness.gridded(harness.psfex_grid(file, meta['n']))
    return grid, grid


def keep_stars(catalogue, stars):
    """Write a copy of an LDAC catalogue that holds only the stars."""
    from astropy.io import fits
    with fits.open(catalogue) as hdus:
        rows = hdus[2].data
        near = np.hypot(
            rows['XWIN_IMAGE'][:, None] - 1 - np.asarray(stars['x']),
            rows['YWIN_IMAGE'][:, None] - 1 - np.asarray(stars['y']))
        hdus[2].data = rows[near.min(axis=1) < 2]
        out = Path(catalogue).with_name('chosen.ldac')
        hdus.writeto(out, overwrite=True)
    return out


def fit_with_photutils(psf, data, error, test):
    from photutils.psf import PSFPhotometry
    start = QTable({'x_init': np.asarray(test['x']) + 0.05,
                    'y_init': np.asarray(test['y']) - 0.05,
                    'flux_init': np.asarray(test['flux'])})
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        result = PSFPhotometry(psf, (11, 11))(data, error=error,
                                              init_params=start)
    return np.column_stack([np.asarray(result[name]) for name in
                            ('x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err',
                             'flux_err')])


def print_table(rows):
    """Print robust errors over the bound, and over those of the truth."""
    reference = rows[0]
    for name, mag, error, pull in rows:
        ratios = []
        print(f'{name}: error over bound, over that with the true PSF, pull')
        for low in EDGES[:-1]:
            here = (mag >= low) & (mag < low + 1)
            mine, best = scatter(error[here]), scatter(reference[2][here])
            ratios.append(mine / best)
            print(f'  {low}-{low + 1} mag  {here.sum():4d} stars  '
                  f'{mine:5.2f}  {ratios[-1]:5.3f}  '
                  f'{scatter(pull[here]):5.2f}')
        print(f'  mean ratio 18-22 mag {np.mean(ratios[:4]):.3f}, largest '
              f'{max(ratios):.3f}', flush=True)


def pooled(scenes):
    """Join the rows of the scenes, method by method."""
    return [(parts[0][0], *(np.concatenate([part[i] for part in parts])
                            for i in (1, 2, 3)))
            for parts in zip(*scenes, strict=True)]


def print_times(path, options):
    """Time 150 and 3,000 stars of 21x21, K = 5, degree 3."""
    import resource
    meta, images, truth, _ = read_scene(path, options.harness)
    data = images['sci'] - meta['bkg']
    bright = truth[np.argsort(truth['mag'])]
    for n in (150, 3000):
        stars = Table({'x': np.resize(np.asarray(bright['x'][:600]), n),
                       'y': np.resize(np.asarray(bright['y'][:600]), n)})
        stars['selected'] = True
        if n == 3000:
            data, images, stars = tiled(data, images, stars[:600])
        wall, cpu = time.perf_counter(), time.process_time()
        fit_mixture_field(data, stars, error=images['err'], n_components=5,
                          degree=3, radius=RADIUS)
        print(f'{len(stars)} stars: {time.perf_counter() - wall:.1f} s, '
              f'{time.process_time() - cpu:.1f} s CPU; largest memory '
              f'{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f}'
              ' GB, images included', flush=True)


def tiled(data, images, stars):
    """Return five copies of the scene in a row, as one image."""
    step = data.shape[1]
    places = [Table({'x': stars['x'] + i * step, 'y': stars['y']})
              for i in range(5)]
    from astropy.table import vstack
    return (np.tile(data, (1, 5)), {'err': np.tile(images['err'], (1, 5))},
            vstack(places))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('scenes', nargs='+')
    parser.add_argument('--harness', type=Path, required=True)
    parser.add_argument('--stars', type=int, default=150)
    parser.add_argument('--n-components', type=number, default=5)
    parser.add_argument('--degree', type=number, default='auto')
    parser.add_argument('--peers', type=lambda s: s.split(','), default=[])
    parser.add_argument('--time', action='store_true')
    options = parser.parse_args()
    sys.path.insert(0, str(options.harness))
    scenes = [run_scene(path, options) for path in options.scenes]
    print_table(pooled(scenes))
    if options.time:
        print_times(options.scenes[0], options)


if __name__ == '__main__':
    main()
