"""
How good a crowded image is measured with the PSF of its own stars.

Run as ``python tests/benchmarks/bench_crowded_psf.py SCENE TRUE_PSF``: a
folder with ``sci.fits``, ``err.fits``, ``mask.fits``, ``truth.ecsv`` and
``meta.json`` as `bench_crowded.py` takes them, and a file with the true PSF
of the image, as `GriddedMixturePSF.from_gridded_psf` fits it to a
`GriddedPSFModel` and `GriddedMixturePSF.write` stores it. The image is
measured twice by the same solver, with the true PSF and with that of
`fit_crowded_psf`; ``--simulate SIZE SEED`` makes both with this package
instead. Printed are, for each range of magnitudes, the root mean square of
the positions of both, robust and of all errors below half a pixel,
completeness, false stars and the bias of fluxes; and CPU seconds.
"""
import argparse
import time

import numpy as np
from astropy.table import Table
from crowded_scores import Scene, Score, scatter

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GriddedMixturePSF,
    Instrument,
    crowded_field,
    csst_psf,
    fit_crowded_psf,
    simulate,
)

RANGES = ((17, 19), (19, 20), (20, 21), (21, 22), (22, 23), (23, 24))
COLUMNS = ('x_fit', 'y_fit', 'flux_fit')


def simulated(size, seed):
    """Return a scene of this package, and its PSF."""
    shape = (size, size)
    psf = csst_psf(shape)
    made = simulate(crowded_field(shape, rng=seed), psf=psf, rng=seed + 1,
                    instrument=Instrument(shape=shape))
    truth = made.truth[made.truth['inside']]
    flux, magnitude = np.asarray(truth['flux']), truth['mag'].value
    table = Table({'x': np.asarray(truth['x']), 'y': np.asarray(truth['y']),
                   'flux': flux, 'mag': magnitude,
                   'sat': np.zeros(len(truth), bool)})
    zero = np.median(magnitude + 2.5 * np.log10(flux))
    images = {'sci': made.image, 'err': made.error, 'mask': made.mask}
    return Scene(images, table, (0, 0), zero), psf


def measure(scene, psf):
    """Return the stars of a scene, centred, and CPU seconds."""
    images, start = scene.images, time.process_time()
    found = CrowdedMixturePhotometry(psf)(
        images['sci'], error=images['err'], mask=images['mask'])
    seconds = time.process_time() - start
    table = Table([np.asarray(found[name], float) for name in COLUMNS],
                  names=['x', 'y', 'flux'])
    return Score.of(scene, table[np.isfinite(table['x'])
                                 & (table['flux'] > 0)]), seconds


def numbers(score, low, high):
    """Return n, robust and plain RMS, completeness, false stars and bias."""
    scene, true = score.scene, np.asarray(score.scene.truth['mag'])
    row = np.full(len(true), -1)
    row[score.true] = score.row
    here = score.counted & (true >= low) & (true < high)
    magnitude = scene.magnitude(score.table['flux'])
    there = score.listed & (magnitude >= low) & (magnitude < high)
    found = here & (row >= 0)
    errors = score.errors()[found]
    ratio = score.table['flux'][row[found]] / scene.truth['flux'][found]
    return (here.sum(), scatter(errors), np.sqrt(np.mean(errors**2)),
            found.sum() / here.sum(), (score.false & there).sum()
            / max(there.sum(), 1), -2.5 * np.log10(np.median(ratio)))


def print_both(own, true):
    """Print one row for each range of magnitudes."""
    print('mag       n   RMS own  true  ratio | all errors  true  ratio | '
          'complete   true  | false  true  | bias    true')
    for low, high in RANGES:
        (n, *a), (_, *b) = (numbers(one, low, high) for one in (own, true))
        print(f'{low}-{high} {n:6d} {a[0]:8.4f} {b[0]:7.4f} '
              f'{a[0] / b[0]:5.3f} | {a[1]:8.4f} {b[1]:8.4f} '
              f'{a[1] / b[1]:5.3f} | {a[2]:7.2%} {b[2]:7.2%} | {a[3]:5.2%} '
              f'{b[3]:5.2%} | {a[4]:+.4f} {b[4]:+.4f}')


def compare(scene, psf):
    """Print how good a scene is measured; return both lists' scores."""
    true, seconds = measure(scene, psf)
    print(f'true PSF: {len(true.table)} stars, {seconds:.1f} CPU s')
    start = time.process_time()
    images = scene.images
    field = fit_crowded_psf(images['sci'], error=images['err'],
                            mask=images['mask'])
    print(f'{field}: {time.process_time() - start:.1f} CPU s')
    own, seconds = measure(scene, field.to_grid(1 + 4 * field.degree))
    print(f'own PSF: {len(own.table)} stars, {seconds:.1f} CPU s')
    print_both(own, true)
    return own, true


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('scene', nargs='?')
    parser.add_argument('psf', nargs='?')
    parser.add_argument('--crop', type=int)
    parser.add_argument('--simulate', nargs=2, type=int,
                        metavar=('SIZE', 'SEED'))
    args = parser.parse_args()
    if args.simulate:
        scene, psf = simulated(*args.simulate)
    elif args.psf:
        scene = Scene.load(args.scene, args.crop)
        psf = GriddedMixturePSF.read(args.psf)
    else:
        parser.error('give SCENE and TRUE_PSF, or --simulate')
    compare(scene, psf)


if __name__ == '__main__':
    main()
