"""
What the first call of a fresh installation waits for: compilation.

Run as ``python tests/benchmarks/bench_first_use.py``. Each job runs in a
process of its own with an empty cache of compiled code, and the last one runs
all jobs in one process. Printed is what the first call takes beyond the second
one, in wall-clock and CPU seconds, and the ratio of the wall-clock seconds to
those of ``import photutils.psf`` in the same process.
"""
import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time

JOBS = ('photometry', 'fit_mixture', 'crowded', 'field')


def scene():
    """Return a PSF grid, an image, its errors, and a table of stars."""
    import numpy as np
    from astropy.table import QTable

    from photutils_mgauss import GaussianMixture, GriddedMixturePSF

    mixture = GaussianMixture.from_stddevs(
        [0.7, 0.2, 0.1], np.zeros((3, 2)), [(1, 1.1), (2, 1.8), (3.5, 3.3)],
        [0.1, 0, -0.1])
    corners = [(0, 0), (199, 0), (0, 199), (199, 199)]
    psf = GriddedMixturePSF([mixture] * 4, corners)
    rng = np.random.default_rng(7)
    y, x = np.mgrid[15:190:17, 15:190:17]
    stars = QTable({'x_0': x.ravel() + rng.uniform(-.5, .5, x.size),
                    'y_0': y.ravel() + rng.uniform(-.5, .5, x.size),
                    'flux': rng.uniform(2e4, 1e5, x.size)})
    data = np.zeros((200, 200))
    grid_y, grid_x = np.mgrid[:200, :200]
    for star in stars:
        data += star['flux'] * mixture.evaluate(grid_x - star['x_0'],
                                                grid_y - star['y_0'])
    error = np.sqrt(100 + data)
    data += rng.normal(0, error)
    return psf, data, error, stars


def run_job(name, psf, data, error, stars):
    """Do what users do first."""
    import photutils_mgauss as package

    if name == 'photometry':
        package.MixturePSFPhotometry(psf, (11, 11), aperture_radius=4)(
            data, error=error, init_params=stars)
    elif name == 'fit_mixture':
        package.fit_mixture(psf.mixture_at(50, 50).render((31, 31), 15, 15))
    elif name == 'crowded':
        package.CrowdedMixturePhotometry(psf, executor=None)(
            data, error=error)
    elif name == 'field':
        package.fit_mixture_field(data, stars, error=error, n_components=2,
                                  degree=1)


def clock():
    """Return wall-clock and CPU seconds."""
    return time.perf_counter(), time.process_time()


def measure(names):
    """Return the seconds that first calls of some jobs take longer."""
    start = clock()
    import photutils.psf  # noqa: F401

    stop = clock()
    seconds = {'import': [b - a for a, b in zip(start, stop, strict=True)]}
    ingredients = scene()
    for name in names:
        marks = [clock()]
        for _ in range(2):
            run_job(name, *ingredients)
            marks.append(clock())
        wall, cpu = ([2 * b - a - c for a, b, c in zip(*marks, strict=True)])
        seconds[name] = [wall, cpu]
    return seconds


def run_in_new_process(names):
    """Measure with an empty cache of compiled code."""
    with tempfile.TemporaryDirectory() as folder:
        result = subprocess.run(
            [sys.executable, '-W', 'ignore', __file__, '--inside', *names],
            check=True, capture_output=True, text=True,
            env={**os.environ, 'NUMBA_CACHE_DIR': folder})
    return json.loads(result.stdout)


def main():
    """Measure and print one row for each job and one for all."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--inside', nargs='+', help=argparse.SUPPRESS)
    parser.add_argument('--repeats', type=int, default=1)
    options = parser.parse_args()
    if options.inside:
        print(json.dumps(measure(options.inside)))
        return
    print(f'Python {platform.python_version()}, {os.cpu_count()} cores, load '
          f'{os.getloadavg()[0]:.1f}; seconds beyond a second call')
    print(f'{"first call":14}{"wall":>8}{"CPU":>8}{"/ import":>10}')
    rows = [(name, [name]) for name in JOBS] + [('all', list(JOBS))]
    for label, names in rows:
        runs = [run_in_new_process(names) for _ in range(options.repeats)]
        wall, cpu = (statistics.median(sum(run[name][i] for name in names)
                                       for run in runs) for i in (0, 1))
        peer = statistics.median(run['import'][0] for run in runs)
        print(f'{label:14}{wall:8.1f}{cpu:8.1f}{wall / peer:10.1f}',
              flush=True)


if __name__ == '__main__':
    main()
