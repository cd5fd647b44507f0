"""
Photometry of many stars against photutils: stars per second and ratios.

    python tests/benchmarks/bench_photometry.py [--stars 100000] [--peer 300]

The same noisy stars on the same image are fitted by MixturePSFPhotometry and,
a part of them, by PSFPhotometry with the GriddedPSFModel of the same PSF and
with the same model; groups of 20 and 40 stars are fitted by PSFPhotometry
with its own fitter and with MixtureFitter. SExtractor's PSF mode is timed
where it is installed. Wall times are medians of three runs, full tables.
"""
import argparse
import platform
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import photutils
from astropy.io import fits
from astropy.table import QTable
from photutils.psf import PSFPhotometry

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureFitter,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
)
from photutils_mgauss._parallel import available_cores

STEP = 13  # between stars of the lattice, pixels


def make_psf(size):
    """Return a 4 x 4 grid of mixtures of three Gaussians, FWHM 2 pixels."""
    nodes = np.linspace(0, size, 4)
    xy = [(x, y) for y in nodes for x in nodes]
    return GriddedMixturePSF([_mixture(x / size, y / size) for x, y in xy],
                             xy)


def _mixture(u, v):
    return GaussianMixture.from_stddevs(
        [0.6, 0.3, 0.1], [[0, 0], [0.05 * u, 0.02], [-0.1, 0.1 * v]],
        [[0.8 + 0.05 * u, 0.85], [1.4, 1.3 + 0.1 * v], [2.6, 2.9]],
        [0.1 * v, -0.05, 0.02])


def make_scene(n, rng):
    """Return PSF, image, errors and a table of initial values."""
    side = int(np.ceil(np.sqrt(n)))
    size = STEP * side + 20
    x, y = np.meshgrid(*[np.arange(side) * STEP + 15.0] * 2)
    x = x.ravel()[:n] + rng.uniform(-0.5, 0.5, n)
    y = y.ravel()[:n] + rng.uniform(-0.5, 0.5, n)
    flux = 10 ** rng.uniform(3, 5, n)
    psf = make_psf(size)
    image = np.zeros((size, size))
    add_stars(image, psf, x, y, flux)
    error = np.sqrt(image + 100)
    image += error * rng.standard_normal(image.shape)
    start = QTable({'x': x + rng.normal(0, 0.15, n),
                    'y': y + rng.normal(0, 0.15, n),
                    'flux': flux * rng.uniform(0.8, 1.2, n)})
    return psf, image, error, start


def add_stars(image, psf, x, y, flux):
    """Add stars to an image, on stamps of 21 pixels."""
    padded = np.pad(image, 11)
    for first in range(0, x.size, 10000):
        part = slice(first, first + 10000)
        stamps = psf.render(x[part], y[part], flux[part], 21)
        left = np.rint(x[part]).astype(int) + 1
        low = np.rint(y[part]).astype(int) + 1
        for stamp, i, j in zip(stamps, left, low, strict=True):
            padded[j:j + 21, i:i + 21] += stamp
    image[:] = padded[11:-11, 11:-11]


def timed(function, repeat=3):
    """Return the median wall time, the CPU time with it, and the result."""
    runs = []
    for _ in range(repeat):
        wall, cpu = time.perf_counter(), time.process_time()
        result = function()
        runs.append((time.perf_counter() - wall, time.process_time() - cpu))
    return *sorted(runs)[repeat // 2], result


def compare_single(args, rng):
    """Print stars per second of all ways to fit single stars."""
    psf, image, error, start = make_scene(args.stars, rng)
    ours = MixturePSFPhotometry(psf, (11, 11))
    wall, _, _ = timed(lambda: ours(image, error=error,
                                    init_params=start[:10]), 1)
    print(f'first call, compiled or read from the cache: {wall:.1f} s')
    wall, cpu, _ = timed(lambda: ours(image, error=error, init_params=start))
    speed = args.stars / wall
    print(f'MixturePSFPhotometry: {speed:,.0f} stars/s, '
          f'{args.stars / cpu:,.0f} per CPU second, '
          f'{wall / args.stars * 1e6:.1f} us a star')
    few = start[:args.peer]
    for name, model in (('GriddedPSFModel', psf.to_gridded_psf(4, radius=15)),
                        ('GriddedMixturePSF', psf)):
        peer = PSFPhotometry(model, (11, 11))
        wall, _, _ = timed(lambda peer=peer: peer(image, error=error,
                                                  init_params=few), 1)
        print(f'PSFPhotometry with {name}: {len(few) / wall:,.0f} stars/s; '
              f'ours is {speed * wall / len(few):,.0f} times faster')
    return image, start, args.stars / cpu


def compare_groups(rng):
    """Print the times of groups with photutils' fitter and with ours."""
    psf = MultiGaussianPSFModel(GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [0, 0]], [[1, 1.1], [2, 2.1]], [0, 0]))
    for n in (20, 40):
        image, start = _group(psf, n, rng)
        error = np.full(image.shape, 5.0)
        call = {'error': error, 'init_params': start}
        tables, times = [], []
        for fitter in (None, MixtureFitter()):
            phot = PSFPhotometry(psf, (7, 7), fitter=fitter,
                                 group_warning_threshold=100)
            wall, _, table = timed(partial(phot, image, **call), 1)
            tables.append(table)
            times.append(wall)
        apart = np.abs(tables[0]['x_fit'] - tables[1]['x_fit']).max()
        print(f'group of {n}: TRF {times[0]:.2f} s, MixtureFitter '
              f'{times[1]:.3f} s, {times[0] / times[1]:.1f} times faster, '
              f'positions within {apart:.1e} pixels')
        ours = MixturePSFPhotometry(psf, (7, 7), group_warning_threshold=100)
        wall, _, _ = timed(partial(ours, image, **call))
        print(f'             MixturePSFPhotometry {wall:.4f} s, '
              f'{times[0] / wall:.0f} times faster')


def _group(psf, n, rng):
    # One star in 3 x 3 pixels or so, none closer to another than 1 pixel.
    across = int(np.ceil(np.sqrt(n)))
    side = 3 * across + 12
    x, y = np.divmod(np.arange(n), across) * np.array([[3], [3]]) + 7.0
    x, y = x + rng.uniform(-1, 1, n), y + rng.uniform(-1, 1, n)
    flux = 10 ** rng.uniform(3.5, 4.5, n)
    image = rng.normal(0, 5, (side, side))
    for a, b, f in zip(x, y, flux, strict=True):
        image += psf.mixture.render(image.shape, a, b, flux=f)
    start = QTable({'x': x + rng.normal(0, 0.05, n),
                    'y': y + rng.normal(0, 0.05, n), 'flux': flux,
                    'group_id': np.ones(n, int)})
    return image, start


def time_sextractor(image, speed):
    """Print SExtractor's speed in PSF mode on the image, if it is here."""
    program = shutil.which('source-extractor') or shutil.which('sex')
    psfex = shutil.which('psfex')
    if program is None or psfex is None:
        print('SExtractor or PSFEx is not installed: not compared')
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fits.writeto(folder / 'image.fits', image.astype('f4'))
        first = ['X_IMAGE', 'Y_IMAGE', 'FLUX_RADIUS', 'SNR_WIN',
                 'FLUX_APER(1)', 'FLUXERR_APER(1)', 'ELONGATION', 'FLAGS',
                 'VIGNET(25,25)']
        _run_sextractor(program, folder, first, 'FITS_LDAC', [])
        _run([psfex, 'cat.fits', '-CHECKPLOT_TYPE', 'NONE', '-CHECKIMAGE_TYPE',
              'NONE', '-WRITE_XML', 'N'], folder)
        columns = ['X_IMAGE', 'Y_IMAGE', 'XPSF_IMAGE', 'YPSF_IMAGE',
                   'FLUX_PSF', 'FLUXERR_PSF', 'CHI2_PSF']
        seconds = _run_sextractor(program, folder, columns, 'FITS_1.0',
                                  ['-PSF_NAME', 'cat.psf'])
        n = len(fits.getdata(folder / 'cat.fits'))
    print(f'SExtractor PSF mode: {n / seconds:,.0f} stars per CPU second, '
          f'detection included; ours is {speed * seconds / n:.1f} times '
          f'faster')


def _run_sextractor(program, folder, columns, kind, options):
    (folder / 'columns').write_text('\n'.join(columns))
    (folder / 'filter').write_text('CONV NORM\n1 2 1\n2 4 2\n1 2 1\n')
    return _run([program, 'image.fits', '-c', '/dev/null',
                 '-PARAMETERS_NAME', 'columns', '-FILTER_NAME', 'filter',
                 '-CATALOG_NAME', 'cat.fits', '-CATALOG_TYPE', kind,
                 '-PHOT_APERTURES', '10', '-DETECT_THRESH', '3',
                 '-BACK_TYPE', 'MANUAL', *options], folder)


def _run(command, folder):
    """Run a command, return its CPU seconds."""
    script = ('import resource, subprocess, sys; '
              'subprocess.run(sys.argv[1:], check=True, '
              'stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL); '
              'use = resource.getrusage(resource.RUSAGE_CHILDREN); '
              'print(use.ru_utime + use.ru_stime)')
    done = subprocess.run([sys.executable, '-c', script, *command],
                          cwd=folder, check=True, capture_output=True,
                          text=True)
    return float(done.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--stars', type=int, default=100_000)
    parser.add_argument('--peer', type=int, default=300,
                        help='stars that photutils fits')
    args = parser.parse_args()
    print(f'Python {platform.python_version()}, photutils '
          f'{photutils.__version__}, {available_cores()} cores')
    rng = np.random.default_rng(1)
    warnings.simplefilter('ignore')
    image, _, speed = compare_single(args, rng)
    compare_groups(rng)
    time_sextractor(image, speed)


if __name__ == '__main__':
    main()
