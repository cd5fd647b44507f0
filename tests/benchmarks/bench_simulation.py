"""
Time and memory of simulated scenes, beside photutils' own image maker.

    python tests/benchmarks/bench_simulation.py            # 2048 x 2048
    python tests/benchmarks/bench_simulation.py --chip     # 9216 x 9232
"""
import argparse
import resource
import time

import numpy as np
from astropy.table import QTable
from photutils.datasets import make_model_image

from photutils_mgauss.simulation import (
    Instrument,
    crowded_field,
    csst_psf,
    simulate,
)
from photutils_mgauss.utils.parallel import available_cores


def clock(function):
    """Return a result, its wall time and its CPU time [s]."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = function()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def warm_up():
    simulate(crowded_field(64), instrument=Instrument(shape=(64, 64)), rng=1)


def crowded(shape):
    camera = Instrument(shape=shape)
    stars, wall, cpu = clock(lambda: crowded_field(shape, rng=1))
    print(f'catalogue of {len(stars)} stars: {wall:.1f} s, CPU {cpu:.1f} s')
    scene, wall, cpu = clock(
        lambda: simulate(stars, instrument=camera, rng=2))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f'image {scene.image.shape}: {wall:.1f} s, CPU {cpu:.1f} s '
          f'({cpu / len(stars) * 1e6:.0f} us a star, noise included), '
          f'peak memory {peak:.2f} GB, {available_cores()} cores')
    return cpu / len(stars)


def peer(ours, n=300):
    """Time photutils.datasets.make_model_image with the same PSF."""
    shape = (300, 300)
    rng = np.random.default_rng(3)
    stars = QTable({'x_0': rng.uniform(0, 300, n),
                    'y_0': rng.uniform(0, 300, n),
                    'flux': rng.uniform(100, 1000, n)})
    for name, psf in (('same mixtures', csst_psf(shape)),
                      ('GriddedPSFModel',
                       csst_psf(shape).to_gridded_psf(4, radius=21))):
        make_model_image((50, 50), psf, stars[:1], model_shape=(41, 41))
        _, _, cpu = clock(lambda psf=psf: make_model_image(
            shape, psf, stars, model_shape=(41, 41)))
        print(f'make_model_image, {name}: {cpu / n * 1e6:.0f} us a star '
              f'(CPU), {cpu / n / ours:.1f} times ours')


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--chip', action='store_true')
    chip = parser.parse_args().chip
    warm_up()
    peer(crowded((9232, 9216) if chip else (2048, 2048)))


if __name__ == '__main__':
    main()
