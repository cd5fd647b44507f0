"""
One image reduced by a process of its own: CPU time, wall time, memory.

``python crowded_area.py FOLDER --simulate 9232 9216`` simulates a crowded
chip and puts it into a folder; ``python crowded_area.py FOLDER`` reduces what
is there and prints a line of JSON.
"""
import argparse
import json
import pickle
import resource
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from photutils_mgauss import CrowdedMixturePhotometry, fit_mixture_field
from photutils_mgauss.simulation import (
    Instrument,
    crowded_field,
    simulate,
    sparse_field,
)

IMAGES = ('sci', 'err', 'mask')
# Stars brighter than this are counted [mag].
LIMIT = 23.0


def save(folder, images, psf, limit, n_bright):
    """
    Write images, in single precision, the PSF, and what to count.

    There are n_bright stars with more than the flux limit.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in IMAGES:
        kind = bool if name == 'mask' else np.float32
        np.save(folder / f'{name}.npy', images[name].astype(kind))
    (folder / 'psf').write_bytes(pickle.dumps((psf, limit, n_bright)))


def simulate_chip(folder, shape, components, radius):
    """
    Simulate a crowded exposure, and a sparse one to fit the PSF to.

    The detector has the paper's density of stars; `csst_psf` is its PSF,
    which the fit knows nothing of.
    """
    camera = Instrument(shape=shape)
    stars = sparse_field(shape, spacing=max(46, shape[1] // 40), rng=1)
    scene = simulate(stars, instrument=camera, rng=2)
    bright = scene.truth[scene.truth['psf_star'] & scene.truth['inside']]
    field = fit_mixture_field(
        scene.image - np.float32(scene.background), _plain(bright)[:400],
        error=scene.error, mask=scene.mask, n_components=components,
        radius=radius)
    psf = field.to_grid((20, 20))
    del scene, field
    scene = simulate(crowded_field(shape, rng=3), instrument=camera, rng=4)
    flux = scene.truth['flux'].value
    mag = scene.truth['mag'].value
    limit = float(np.median(flux * 10**(0.4 * (mag - LIMIT))))
    n_bright = int((scene.truth['inside'] & (flux > limit)).sum())
    save(folder, {'sci': scene.image, 'err': scene.error,
                  'mask': scene.mask}, psf, limit, n_bright)


def _plain(table):
    """Return a table without units."""
    from astropy.table import Table
    return Table({name: table[name].value for name in ('x', 'y', 'flux')})


def memory(key='VmHWM'):
    """Return the peak memory of this program, or another number [GB]."""
    # What getrusage tells includes that of the process it was forked from.
    try:
        lines = Path('/proc/self/status').read_text().splitlines()
    except OSError:  # not on Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    line, = [line for line in lines if line.startswith(f'{key}:')]
    return int(line.split()[1]) / 1e6


def run(folder, *words):
    """Run `main` in a fresh interpreter and return what it prints."""
    out = subprocess.run([sys.executable, __file__, str(folder), *words],
                         check=True, stdout=subprocess.PIPE, text=True)
    return out.stdout


def measure(folder, threads):
    """Return what the reduction of a folder takes."""
    return json.loads(run(folder, '--threads', str(threads)))


def reduce(folder, threads):
    """Reduce the image of a folder; return what it takes."""
    warnings.simplefilter('ignore')
    psf, limit, n_bright = pickle.loads((folder / 'psf').read_bytes())
    sci, err, mask = (np.load(folder / f'{name}.npy') for name in IMAGES)
    with ThreadPoolExecutor(threads) as pool:
        phot = CrowdedMixturePhotometry(psf, executor=pool)
        part = np.s_[:64, :64]
        phot(sci[part], error=err[part], mask=mask[part])
        start = memory('VmRSS')
        cpu, wall = time.process_time(), time.perf_counter()
        table = phot(sci, error=err, mask=mask)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    return {'shape': sci.shape, 'stars': len(table), 'cpu': cpu,
            'wall': wall, 'start': start, 'peak': memory(),
            'bright': float((table['flux_fit'] > limit).sum() / n_bright)}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('folder', type=Path)
    parser.add_argument('--threads', type=int, default=2)
    parser.add_argument('--simulate', type=int, nargs=2,
                        metavar=('NY', 'NX'))
    parser.add_argument('--components', type=int, default=6)
    parser.add_argument('--radius', type=float, default=12)
    args = parser.parse_args()
    if args.simulate:
        simulate_chip(args.folder, tuple(args.simulate), args.components,
                      args.radius)
    else:
        print(json.dumps(reduce(args.folder, args.threads)))


if __name__ == '__main__':
    main()
