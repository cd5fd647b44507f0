"""
How well tabulated optics agree with GalSim's own drawing of stars.

    python tests/benchmarks/bench_optics.py

Stars anywhere on a detector of 2048 x 2048 pixels are drawn by the package
from a 21 x 21 grid of PSFs, and by GalSim from the optics at the star.
"""
import argparse
import time

import numpy as np

from photutils_mgauss.simulation import Optics, render_stars


def deviation(optics, psf, x, y, half=12):
    """Return the largest difference of a star, in units of its peak."""
    i, j = round(x), round(y)
    expected = optics.profile(x, y).drawImage(
        nx=2 * half + 1, ny=2 * half + 1, scale=optics.pixel_scale,
        offset=(x - i, y - j), method='auto', dtype=float).array
    image = render_stars(psf, [x], [y], [1e6], optics.shape) / 1e6
    stamp = image[j - half:j + half + 1, i - half:i + half + 1]
    return np.abs(stamp - expected).max() / expected.max()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--nodes', type=int, default=21)
    parser.add_argument('--stars', type=int, default=8)
    options = parser.parse_args()
    optics = Optics((2048, 2048))
    start = time.process_time()
    psf = optics.to_gridded_psf(options.nodes, radius=16)
    print(f'{options.nodes}^2 nodes: {time.process_time() - start:.0f} s CPU')
    rng = np.random.default_rng(5)
    places = rng.uniform(20, 2027, (options.stars, 2))
    worst = [deviation(optics, psf, *place) for place in places]
    print(f'{options.stars} stars: largest difference / peak: median '
          f'{np.median(worst):.2e}, worst {np.max(worst):.2e}')


if __name__ == '__main__':
    main()
