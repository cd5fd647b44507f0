"""
Photometry of many stars against photutils: speed, agreement, errors.

    python tests/benchmarks/bench_photometry.py [--parts speed,groups,...]
        [--stars 100000] [--peer 300]

speed: the same noisy stars on the same image (11 x 11 pixels, K = 3 blended
to 12 Gaussians) by MixturePSFPhotometry and, a part of them, by PSFPhotometry
with the GriddedPSFModel of the same PSF and with the same model. groups: 20
and 40 stars by PSFPhotometry with its own fitter and with MixtureFitter.
sextractor: its PSF mode, where SExtractor and PSFEx are installed.
compilation: the first call of a fresh process with an empty cache. agreement:
the largest differences from PSFPhotometry. errors: pulls, scatter over the
Cramer-Rao bound, bias of fluxes. phase: pixel-phase errors of optical PSFs.
Times are medians of three runs, full tables.
"""
import argparse
import os
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
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import vstack
from photometry_accuracy import (
    compare_errors,
    compare_phases,
    compare_variances,
)
from photometry_scenes import add_stars, make_group, make_scene
from photutils.psf import PSFPhotometry, SourceGrouper

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureFitter,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
)
from photutils_mgauss.utils.parallel import available_cores

PARTS = ('speed', 'groups', 'sextractor', 'compilation', 'agreement',
         'errors', 'phase')

# Stars of the image that SExtractor works on, and of that from which PSFEx
# makes its model, which takes a second for each fifty.
N_SEXTRACTOR, N_PSFEX = 20_000, 400


def timed(function, repeat=3):
    """Return the median wall time, the CPU time with it, and the result."""
    runs = []
    for _ in range(repeat):
        wall, cpu = time.perf_counter(), time.process_time()
        result = function()
        runs.append((time.perf_counter() - wall, time.process_time() - cpu))
    return *sorted(runs)[repeat // 2], result


def time_ours(n, rng):
    """Return our stars per second and per CPU second, and the scene."""
    psf, image, error, start = make_scene(n, rng)
    ours = MixturePSFPhotometry(psf, (11, 11))
    ours(image, error=error, init_params=start[:10])
    wall, cpu, _ = timed(lambda: ours(image, error=error, init_params=start))
    print(f'MixturePSFPhotometry: {n / wall:,.0f} stars/s, '
          f'{n / cpu:,.0f} per CPU second, {wall / n * 1e6:.1f} us a star')
    return n / wall, n / cpu, (psf, image, error, start)


def compare_single(args, rng):
    """Print stars per second of all ways to fit single stars."""
    speed, by_cpu, (psf, image, error, start) = time_ours(args.stars, rng)
    few = start[:args.peer]
    for name, model in (('GriddedPSFModel', psf.to_gridded_psf(4, radius=15)),
                        ('GriddedMixturePSF', psf)):
        peer = PSFPhotometry(model, (11, 11))
        wall, cpu, _ = timed(lambda peer=peer: peer(image, error=error,
                                                    init_params=few))
        print(f'PSFPhotometry with {name}: {len(few) / wall:,.0f} stars/s, '
              f'{len(few) / cpu:,.0f} per CPU second; ours is '
              f'{speed * wall / len(few):,.0f} times faster, in CPU time '
              f'{by_cpu * cpu / len(few):,.0f} times')


def compare_groups(args, rng, sizes=(20, 40)):
    """Print the CPU times of groups with photutils' fitter and with ours."""
    psf = MultiGaussianPSFModel(GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [0, 0]], [[1, 1.1], [2, 2.1]], [0, 0]))
    for n in sizes:
        image, start = make_group(psf, n, rng)
        call = {'error': np.full(image.shape, 5.0)}
        times, tables = [], []
        for phot in (
                PSFPhotometry(psf, (7, 7), group_warning_threshold=100),
                PSFPhotometry(psf, (7, 7), fitter=MixtureFitter(),
                              group_warning_threshold=100),
                MixturePSFPhotometry(psf, (7, 7),
                                     group_warning_threshold=100)):
            phot(image, init_params=start[:2], **call)  # compiles
            _, cpu, table = timed(partial(phot, image, init_params=start,
                                          **call))
            times.append(cpu)
            tables.append(table)
        apart = max(np.abs(tables[0]['x_fit'] - table['x_fit']).max()
                    for table in tables[1:])
        print(f'group of {n}: TRF {times[0]:.2f} s of CPU, MixtureFitter '
              f'{times[1]:.3f} s ({times[0] / times[1]:.1f} times faster), '
              f'MixturePSFPhotometry {times[2]:.4f} s '
              f'({times[0] / times[2]:.0f} times), positions within '
              f'{apart:.1e} pixels')


def compare_sextractor(args, rng):
    """Print SExtractor's speed in PSF mode and ours, on one image."""
    program = shutil.which('source-extractor') or shutil.which('sex')
    psfex = shutil.which('psfex')
    if program is None or psfex is None:
        print('SExtractor or PSFEx is not installed: not compared')
        return
    n = min(args.stars, N_SEXTRACTOR)
    _, speed, (_, image, _, _) = time_ours(n, rng)
    few = int(image.shape[0] * np.sqrt(N_PSFEX / n))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _make_psfex(program, psfex, folder, image[:few, :few])
        found, seconds = _time_sextractor(program, folder, image)
    print(f'SExtractor PSF mode: {found / seconds:,.0f} stars per CPU '
          'second, detection included; ours is '
          f'{speed * seconds / found:.1f} times faster')


def _make_psfex(program, psfex, folder, image):
    fits.writeto(folder / 'image.fits', image.astype('f4'))
    columns = ['X_IMAGE', 'Y_IMAGE', 'FLUX_RADIUS', 'SNR_WIN',
               'FLUX_APER(1)', 'FLUXERR_APER(1)', 'ELONGATION', 'FLAGS',
               'VIGNET(25,25)']
    _run_sextractor(program, folder, columns, 'FITS_LDAC', [])
    _run([psfex, 'cat.fits', '-CHECKPLOT_TYPE', 'NONE', '-CHECKIMAGE_TYPE',
          'NONE', '-WRITE_XML', 'N'], folder)


def _time_sextractor(program, folder, image):
    """Return how many stars SExtractor fitted, and its CPU seconds."""
    fits.writeto(folder / 'image.fits', image.astype('f4'), overwrite=True)
    columns = ['X_IMAGE', 'Y_IMAGE', 'XPSF_IMAGE', 'YPSF_IMAGE', 'FLUX_PSF',
               'FLUXERR_PSF', 'CHI2_PSF']
    seconds = _run_sextractor(program, folder, columns, 'FITS_1.0',
                              ['-PSF_NAME', 'cat.psf'])
    return len(fits.getdata(folder / 'cat.fits')), seconds


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


def time_compilation(args, rng):
    """Print how long the first call takes without any cache."""
    script = ('import sys, time, numpy as np; '
              f'sys.path.insert(0, {str(Path(__file__).parent)!r}); '
              'from photometry_scenes import make_scene; '
              'from photutils_mgauss import MixturePSFPhotometry; '
              'psf, image, error, start = make_scene('
              '100, np.random.default_rng(1)); '
              'begin = time.perf_counter(); '
              'MixturePSFPhotometry(psf, 11)(image, error=error, '
              'init_params=start); print(time.perf_counter() - begin)')
    with tempfile.TemporaryDirectory() as name:
        environment = {**os.environ, 'NUMBA_CACHE_DIR': name}
        walls = [float(subprocess.run(
            [sys.executable, '-c', script], env=environment, check=True,
            capture_output=True, text=True).stdout) for _ in range(2)]
    print(f'first call of a process: {walls[0]:.1f} s with nothing compiled, '
          f'{walls[1]:.2f} s from the cache on disk')


class PatientFitter(TRFLSQFitter):
    """The default fitter of photutils, with its tolerances lowered."""

    def __call__(self, model, x, y, z, weights=None, maxiter=100,
                 inplace=False):
        return super().__call__(model, x, y, z, weights=weights,
                                maxiter=1000, acc=1e-13, inplace=inplace)


def compare_answers(args, rng):
    """Print the largest differences from PSFPhotometry."""
    psf, image, error, start = make_scene(100, rng)
    mask = np.zeros(image.shape, bool)
    mask[np.rint(start['y'][::3]).astype(int) + 1,
         np.rint(start['x'][::3]).astype(int)] = True
    print('largest differences from PSFPhotometry (TRF, tolerances 1e-13)')
    _compare_tables('isolated', psf, image, error, start)
    _compare_tables('masked', psf, image, error, start, mask=mask)
    cut = 15  # The middle of the first row and the first column of stars.
    edge = start.copy()
    edge['x'] -= cut
    edge['y'] -= cut
    moved = GriddedMixturePSF(psf.mixtures, np.array(psf.grid_xypos) - cut)
    _compare_tables('on edges', moved, image[cut:, cut:].copy(),
                    error[cut:, cut:].copy(), edge)
    second = start.copy()
    for name, change in (('x', 2.5), ('y', 1.5)):
        second[name] += change
    second['flux'] *= 0.7
    add_stars(image, psf, *(np.asarray(second[name])
                            for name in ('x', 'y', 'flux')))
    _compare_tables('pairs', psf, image, error, vstack([start, second]),
                    grouper=SourceGrouper(6))


def _compare_tables(name, psf, image, error, start, *, mask=None,
                    grouper=None):
    theirs, ours = (cls(psf, 11, grouper=grouper, **fitter)(
        image, error=error, mask=mask, init_params=start)
        for cls, fitter in ((PSFPhotometry, {'fitter': PatientFitter()}),
                            (MixturePSFPhotometry, {})))
    apart = [np.abs(ours[n] - theirs[n]).max() for n in ('x_fit', 'y_fit')]
    ratios = {n: np.abs(ours[n] / theirs[n] - 1).max() for n in (
        'flux_fit', 'x_err', 'y_err', 'flux_err', 'reduced_chi2')}
    flags = np.count_nonzero(ours['flags'] != theirs['flags'])
    print(f'{name}, {len(start)} stars: {max(apart):.0e} pix; relative '
          + ', '.join(f'{n} {r:.0e}' for n, r in ratios.items())
          + f'; {flags} flags differ')


def compare_with_bound(args, rng):
    compare_errors(rng)
    compare_variances(rng)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--parts', default=','.join(PARTS),
                        help=f'some of {",".join(PARTS)}')
    parser.add_argument('--stars', type=int, default=100_000)
    parser.add_argument('--peer', type=int, default=300,
                        help='stars that photutils fits')
    args = parser.parse_args()
    print(f'Python {platform.python_version()}, photutils '
          f'{photutils.__version__}, {available_cores()} cores')
    warnings.simplefilter('ignore')
    run = dict(zip(PARTS, (
        compare_single, compare_groups, compare_sextractor, time_compilation,
        compare_answers, compare_with_bound,
        lambda args, rng: compare_phases()), strict=True))
    for part in args.parts.split(','):
        if part not in run:
            parser.error(f'no part {part!r}, only {", ".join(PARTS)}')
        print(f'--- {part}')
        run[part](args, np.random.default_rng(1))


if __name__ == '__main__':
    main()
