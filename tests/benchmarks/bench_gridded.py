"""
Speed of grids of mixtures beside photutils' GriddedPSFModel.

Run as ``python tests/benchmarks/bench_gridded.py``; ``--nodes`` sets how many
nodes the focal plane has. Times are CPU seconds of one thread, medians, with
the peer measured in the same run; the focal plane is fitted on all cores.
"""
import argparse
import platform
import time

import numpy as np
import photutils
from astropy.table import QTable
from photutils.psf import PSFPhotometry

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.fitting.grid import fit_node_images
from photutils_mgauss.fitting.node_images import NodeImages
from photutils_mgauss.utils.parallel import available_cores

WIDTHS = np.array([1.1, 1.9, 3.5, 5.0, 2.5])
SHARES = np.array([0.7, 0.2, 0.1, 0.03, 0.1])


def mixture_of(k, rng):
    """Return a mixture of K Gaussians a little off a common shape."""
    stddevs = WIDTHS[:k, None] * rng.uniform(0.95, 1.05, (k, 2))
    return GaussianMixture.from_stddevs(
        SHARES[:k] / SHARES[:k].sum(), rng.normal(0, 0.05, (k, 2)), stddevs,
        rng.uniform(-0.1, 0.1, k))


def make_grid(k, n, size=1000, **kwargs):
    """Return a grid of n x n random mixtures."""
    rng = np.random.default_rng(5)
    axis = np.linspace(0, size, n)
    places = [(x, y) for y in axis for x in axis]
    return GriddedMixturePSF([mixture_of(k, rng) for _ in places], places,
                             **kwargs)


def median_times(*calls, rounds=10, repeats=50):
    """
    Return the median CPU times of calls.

    They take turns in blocks, so that all see the same load of the machine
    and none pays for the memory that another one filled.
    """
    times = np.empty((rounds, len(calls), repeats))
    for block in range(rounds):
        for j, call in enumerate(calls):
            call(0)
            for i in range(repeats):
                start = time.thread_time()
                call(block * repeats + i)
                times[block, j, i] = time.thread_time() - start
    return np.median(times, axis=(0, 2))


def evaluator(psf, x, y):
    """Return a call that evaluates the PSF, each time somewhere else."""
    def call(i):
        psf.evaluate(x, y, 10.0, 410 + 0.01 * i, 312 + 0.02 * i)
    return call


def show(name, ours, peer=None, note=''):
    """Print a line of microseconds and the ratio to the peer."""
    ratio = '' if peer is None else (
        f'{1e6 * peer:10.1f} us   {peer / ours:6.1f} times')
    print(f'{name:42s}{1e6 * ours:10.1f} us{ratio} {note}')


def bench_evaluate():
    rng = np.random.default_rng(1)
    y, x = np.mgrid[300:325, 400:425].astype(float)
    points = rng.uniform((400, 300), (425, 325), (625, 2)).T
    psf = make_grid(3, 8)
    peer = psf.to_gridded_psf(4, radius=12.5)
    matched = make_grid(3, 8, interpolation='components')
    for name, places in (('25x25 lattice', (x, y)), ('625 points', points)):
        ours, pairs, theirs = median_times(*(
            evaluator(model, *places) for model in (psf, matched, peer)))
        show(f'evaluate, {name}', ours, theirs)
        show(f'evaluate, {name}, matched', pairs, theirs)
    show('fit_deriv, 25x25 lattice', *median_times(
        lambda i: psf.fit_deriv(x, y, 10.0, 410 + 0.01 * i, 312.0)))
    large = make_grid(5, 30)
    show('copy, 30x30 nodes of 5', *median_times(
        lambda i: large.copy(), lambda i: peer.copy()))
    grid = large._grid
    print(f'memory of 30x30 nodes of 5: '
          f'{sum(a.nbytes for a in (*grid.arrays, grid.rows)) / 1e3:.0f} kB')


def bench_render(n=100_000):
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, 1000, (2, n))
    for interpolation in ('blend', 'components'):
        psf = make_grid(3, 8, interpolation=interpolation)
        psf.render(x[:2], y[:2], 1, 11)
        start = time.thread_time()
        psf.render(x, y, 1, 11)
        used = time.thread_time() - start
        print(f'render {n} stars of 11x11, {interpolation}: {used:.2f} s, '
              f'{n / used:.0f} stars/s')


def bench_photometry(n=15):
    rng = np.random.default_rng(3)
    psf = make_grid(3, 8)
    peer = psf.to_gridded_psf(4, radius=12.5)
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(30, 970, n)] * 2))
    stars = QTable({'x': x + rng.uniform(0, 1, x.size),
                    'y': y + rng.uniform(0, 1, x.size),
                    'flux': np.full(x.size, 1000.0)})
    image = rng.normal(0, 1, (1000, 1000))
    stamps = psf.render(stars['x'], stars['y'], 1000.0, 25)
    for star, stamp in zip(stars, stamps, strict=True):
        j, i = round(star['y']), round(star['x'])
        image[j - 12:j + 13, i - 12:i + 13] += stamp
    error, times = np.ones(image.shape), {}
    for name, model in (('ours', psf), ('peer', peer), ('ours', psf),
                        ('peer', peer), ('ours', psf), ('peer', peer)):
        start = time.process_time()
        PSFPhotometry(model, (11, 11))(image, error=error, init_params=stars)
        used = (time.process_time() - start) / len(stars)
        times[name] = min(used, times.get(name, np.inf))
    show('PSFPhotometry, one star of 11x11', times['ours'], times['peer'])


def bench_focal_plane(n_nodes):
    rng = np.random.default_rng(4)
    steps = (np.arange(30) - 14.5) / 2
    images = np.array([mixture_of(5, rng).evaluate(steps, steps[:, None])
                       for _ in range(900)])
    images += rng.normal(0, 1e-4 * images.max(), images.shape)
    axis = np.arange(30.0)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    nodes = NodeImages(images, places, (2, 2))
    fit_node_images(NodeImages(images[:4], places[[0, 1, 30, 31]], (2, 2)), 3)
    start, done = time.perf_counter(), 0
    used = time.process_time()
    while done < n_nodes:
        _, report = fit_node_images(nodes, 3)
        done += len(report)
    wall, used = time.perf_counter() - start, time.process_time() - used
    print(f'fit {done} nodes of 30x30 at 2x, K = 3, with report: {wall:.1f} s '
          f'on {available_cores()} cores, {used:.1f} CPU s, '
          f'{1e3 * used / done:.2f} ms a node; 16200 nodes: '
          f'{16200 * used / done / 2:.0f} s on two free cores')


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--nodes', type=int, default=1800)
    options = parser.parse_args()
    print(f'Python {platform.python_version()}, photutils '
          f'{photutils.__version__}, numpy {np.__version__}')
    print(f'{"":42s}{"ours":>13s}{"photutils":>13s}')
    bench_evaluate()
    bench_render()
    bench_photometry()
    bench_focal_plane(options.nodes)


if __name__ == '__main__':
    main()
