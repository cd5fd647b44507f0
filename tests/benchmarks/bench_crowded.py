"""
Crowded fields beside other programs: quality for each magnitude, CPU time.

Run as ``python tests/benchmarks/bench_crowded.py CROWDED SPARSE``, two
folders of one detector with ``sci.fits``, ``err.fits``, ``mask.fits`` and
``truth.ecsv`` (x, y, mag, flux); the crowded one also with ``vartrue.fits``
and ``meta.json`` (origin, zp_e_per_s, exptime). The PSF is made by
`fit_mixture_field` from the sparse exposure, never the true one. Photutils'
`PSFPhotometry` starts from our own list. SExtractor is run if its program is
installed; other lists are compared with ``--list NAME=FILE.ecsv`` (x, y,
flux). ``--crop`` takes a corner, ``--sizes`` asks how time grows with area.

Differences of centring conventions, smooth over the field, are taken out of
every list with a cubic fitted on bright stars. The bound is that of the
star alone, with our PSF and the true variance.
"""
import argparse
import json
import resource
import shutil
import subprocess
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GriddedMixturePSF,
    fit_mixture_field,
)

EDGES = np.arange(17, 26)
MARGIN = 12


def load(folder, crop=None):
    """Return images, truth and header values of a scene."""
    folder, part = Path(folder), (slice(crop), slice(crop))
    images = {path.stem: fits.getdata(path)[part].astype(float)
              for path in folder.glob('*.fits')}
    images['mask'] = images['mask'].astype(bool)
    meta = json.loads((folder / 'meta.json').read_text())
    truth = Table.read(folder / 'truth.ecsv')
    n = len(images['sci'])
    truth = truth[(truth['x'] > -0.5) & (truth['x'] < n - 0.5)
                  & (truth['y'] > -0.5) & (truth['y'] < n - 0.5)]
    return images, truth, meta


def make_psf(folder, origin, n_components, radius):
    """Fit the PSF to the brightest isolated stars of a sparse exposure."""
    from photutils.detection import DAOStarFinder
    images, _, meta = load(folder)
    data = images['sci'] - np.median(images['sci'])
    found = DAOStarFinder(300.0, 1.7)(data, mask=images['mask'])
    names = ('x_centroid', 'y_centroid') if (
        'x_centroid' in found.colnames) else ('xcentroid', 'ycentroid')
    x, y = (np.asarray(found[name]) for name in names)
    gap = cKDTree(np.column_stack([x, y])).query(
        np.column_stack([x, y]), k=2)[0][:, 1]
    good = ((gap > 14) & (np.asarray(found['peak']) < 7e4)
            & (np.minimum(x, y) > 20) & (np.maximum(x, y) < len(data) - 20))
    stars = Table({'x': x[good], 'y': y[good],
                   'flux': np.asarray(found['flux'])[good]})
    stars.sort('flux', reverse=True)
    field = fit_mixture_field(data, stars[:300], error=images['err'],
                              mask=images['mask'], radius=radius,
                              n_components=n_components)
    grid = field.to_grid((20, 20))
    shift = np.subtract(meta['origin'], origin)
    return GriddedMixturePSF(grid.mixtures, grid.grid_xypos + shift)


def bounds(psf, truth, variance):
    """Return the Cramer-Rao bound of each star's x and y, (n, 2)."""
    n, half = len(variance), 8
    offset = np.arange(-half, half + 1)
    out = np.full((len(truth), 2), np.nan)
    for i, (x, y, flux) in enumerate(truth['x', 'y', 'flux']):
        column, row = round(x) + offset, round(y) + offset
        column = column[(column >= 0) & (column < n)]
        row = row[(row >= 0) & (row < n)]
        xx, yy = np.meshgrid(column, row)
        jet = np.array([d.ravel() for d in psf.fit_deriv(
            xx.astype(float), yy.astype(float), flux, x, y)])
        fisher = (jet / variance[yy, xx].ravel()) @ jet.T
        out[i] = np.sqrt(np.diag(np.linalg.inv(fisher))[1:])
    return out


def pair(truth, table, zero, radius, tolerance):
    """Match one to one, closest first; return rows of truth and table."""
    magnitude = zero - 2.5 * np.log10(np.maximum(table['flux'], 1e-9))
    trees = [cKDTree(np.column_stack([t['x'], t['y']]))
             for t in (truth, table)]
    close = trees[0].sparse_distance_matrix(trees[1], radius,
                                            output_type='coo_matrix')
    good = np.abs(truth['mag'][close.row] - magnitude[close.col]) < tolerance
    i, j, d = close.row[good], close.col[good], close.data[good]
    order = np.argsort(d)
    i, j = i[order], j[order]
    rows, taken_i, taken_j = [], set(), set()
    for a, b in zip(i.tolist(), j.tolist(), strict=True):
        if a not in taken_i and b not in taken_j:
            taken_i.add(a)
            taken_j.add(b)
            rows.append((a, b))
    return np.array(rows, int).reshape(-1, 2).T


def centre(truth, table, zero, n):
    """Take the smooth difference of centring conventions out of a list."""
    def basis(t):
        u, v = 2 * t['x'] / n - 1, 2 * t['y'] / n - 1
        return np.column_stack([u**a * v**b for a in range(4)
                                for b in range(4 - a)])
    i, j = pair(truth, table, zero, 1.0, 0.5)
    bright = (truth['mag'][i] < 20.5) & ~truth['sat'][i]
    i, j = i[bright], j[bright]
    out = table.copy()
    for c in 'xy':
        shift = np.asarray(table[c][j] - truth[c][i])
        good = np.ones(shift.size, bool)
        for _ in range(6):
            terms = np.linalg.lstsq(basis(table[j][good]), shift[good],
                                    rcond=None)[0]
            rest = shift - basis(table[j]) @ terms
            good = np.abs(rest) < 5 * np.median(np.abs(rest)) + 1e-9
        out[c] = table[c] - basis(table) @ terms
    return out


def scatter(values):
    values = values[np.isfinite(values)]
    return 1.4826 * np.median(np.abs(values)) if values.size else np.nan


def report(name, table, truth, bound, zero, n):
    """Print one row for each magnitude."""
    table = centre(truth, table, zero, n)
    i, j = pair(truth, table, zero, 0.5, 1.0)
    magnitude = zero - 2.5 * np.log10(np.maximum(table['flux'], 1e-9))

    def inside(t):
        return ((t['x'] > MARGIN) & (t['x'] < n - 1 - MARGIN)
                & (t['y'] > MARGIN) & (t['y'] < n - 1 - MARGIN))
    counted = inside(truth) & ~truth['sat']
    listed = inside(table)
    false = listed.copy()
    false[j] = False
    print(f'\n{name}: {len(table)} stars\n mag   RMS/CRLB  median px  '
          'complete  false   flux bias  pull')
    for low in EDGES:
        here = counted & (truth['mag'] >= low) & (truth['mag'] < low + 1)
        there = listed & (magnitude >= low) & (magnitude < low + 1)
        k = here[i]
        error = np.column_stack([table[c][j[k]] - truth[c][i[k]]
                                 for c in 'xy'])
        pull = np.nan
        if 'x_err' in table.colnames:
            pull = scatter(error / np.column_stack(
                [table[f'{c}_err'][j[k]] for c in 'xy']))
        ratio = table['flux'][j[k]] / truth['flux'][i[k]]
        bias = -2.5 * np.log10(np.median(ratio)) if k.any() else np.nan
        print(f'{low}-{low + 1}  {scatter(error / bound[i[k]]):7.2f}  '
              f'{np.median(np.hypot(*error.T)):9.4f}  '
              f'{k.sum() / max(here.sum(), 1):8.1%}  '
              f'{(false & there).sum() / max(there.sum(), 1):6.1%}  '
              f'{bias:+8.4f}  {pull:6.2f}')


def completeness_curve(table, truth, zero, n, low=24):
    """Print completeness against false stars for cuts on significance."""
    print('\n24-25 mag: cut on flux / flux_err, complete, false')
    strength = np.asarray(table['flux'] / table['flux_err'])
    for cut in (0, 4, 6, 8, 10, 12, 15):
        part = centre(truth, table[strength > cut], zero, n)
        i, j = pair(truth, part, zero, 0.5, 1.0)
        mag = zero - 2.5 * np.log10(part['flux'])
        here = (truth['mag'] >= low) & (truth['mag'] < low + 1)
        there = (mag >= low) & (mag < low + 1)
        false = there.copy()
        false[j] = False
        print(f'{cut:4}  {here[i].sum() / here.sum():6.1%}  '
              f'{false.sum() / max(there.sum(), 1):6.1%}')


def plain(result):
    names = {'x': 'x_fit', 'y': 'y_fit', 'flux': 'flux_fit',
             'x_err': 'x_err', 'y_err': 'y_err', 'flux_err': 'flux_err'}
    return Table({a: np.asarray(result[b], float)
                  for a, b in names.items()})


def timed(name, function):
    start, result = time.process_time(), None
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        result = function()
    seconds = time.process_time() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f'{name}: {seconds:.1f} CPU s, peak memory {memory:.2f} GB',
          flush=True)
    return result


def photutils_list(psf, images, start):
    from photutils.psf import PSFPhotometry
    init = Table({'x': start['x'], 'y': start['y'], 'flux': start['flux']})
    phot = PSFPhotometry(psf, (7, 7), xy_bounds=1.0, aperture_radius=2.5)
    background = np.median(images['sci'])
    return plain(phot(images['sci'] - background, error=images['err'],
                      mask=images['mask'], init_params=init))


def sextractor_list(images):
    """Run SExtractor with windowed positions, if it is installed."""
    program = shutil.which('source-extractor') or shutil.which('sex')
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fits.writeto(folder / 'sci.fits', images['sci'].astype('f4'))
        (folder / 'p').write_text('XWIN_IMAGE\nYWIN_IMAGE\nFLUX_AUTO\n')
        subprocess.run(
            [program, 'sci.fits', '-CATALOG_TYPE', 'FITS_1.0', '-FILTER',
             'N', '-PARAMETERS_NAME', 'p', '-DETECT_THRESH', '2',
             '-DETECT_MINAREA', '3', '-DEBLEND_MINCONT', '0',
             '-CATALOG_NAME', 'c.fits', '-MEMORY_PIXSTACK', '6000000'],
            cwd=folder, check=True, capture_output=True)
        found = Table.read(folder / 'c.fits')
    table = Table({'x': found['XWIN_IMAGE'] - 1.0,
                   'y': found['YWIN_IMAGE'] - 1.0,
                   'flux': np.asarray(found['FLUX_AUTO'], float)})
    return table[np.isfinite(table['x']) & np.isfinite(table['y'])]


def grow(psf, images, sizes, **options):
    """Print CPU seconds for growing corners of the image."""
    for size in sizes:
        part = slice(size), slice(size)
        phot = CrowdedMixturePhotometry(psf, **options)
        timed(f'{size} x {size}', partial(
            phot, images['sci'][part], error=images['err'][part],
            mask=images['mask'][part]))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('crowded')
    parser.add_argument('sparse')
    parser.add_argument('--crop', type=int)
    parser.add_argument('--components', type=int, default=6)
    parser.add_argument('--radius', type=float, default=12)
    parser.add_argument('--list', action='append', default=[])
    parser.add_argument('--photutils', action='store_true')
    parser.add_argument('--sizes', type=int, nargs='*', default=[])
    args = parser.parse_args()
    images, truth, meta = load(args.crowded, args.crop)
    n = len(images['sci'])
    zero = meta['zp_e_per_s'] + 2.5 * np.log10(meta['exptime'])
    near = binary_dilation(images['mask'], iterations=2)
    truth['sat'] = near[tuple(np.rint(truth[c]).astype(int).clip(0, n - 1)
                              for c in 'yx')]
    psf = timed('PSF', lambda: make_psf(args.sparse, meta['origin'],
                                        args.components, args.radius))
    phot = CrowdedMixturePhotometry(psf)
    part = slice(64), slice(64)
    timed('compilation', lambda: phot(
        images['sci'][part], error=images['err'][part]))
    table = plain(timed('crowded', lambda: phot(
        images['sci'], error=images['err'], mask=images['mask'])))
    bound = bounds(psf, truth, images['vartrue'])
    report('crowded', table, truth, bound, zero, n)
    completeness_curve(table, truth, zero, n)
    lists = {'SExtractor': timed('SExtractor (CPU of this process only)',
                                 lambda: sextractor_list(images))}
    if args.photutils:
        lists['photutils'] = timed('photutils', lambda: photutils_list(
            psf, images, table))
    for item in args.list:
        name, _, path = item.partition('=')
        lists[name] = Table.read(path)
    for name, other in lists.items():
        if other is not None:
            report(name, other, truth, bound, zero, n)
    grow(psf, images, args.sizes)


if __name__ == '__main__':
    main()
