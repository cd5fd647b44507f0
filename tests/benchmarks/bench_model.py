"""
What one call of the astropy model costs, beside photutils' own models.

Run as ``python tests/benchmarks/bench_model.py``. CPU microseconds, medians
over rounds in which the statements take turns.
"""
import statistics
import time

import numpy as np
import photutils
from photutils.psf import CircularGaussianPRF, GaussianPSF

from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel

ROUNDS, CALLS = 15, 200


def mixture(k):
    """Return K concentric Gaussians."""
    sizes = 1.2 * 1.6 ** np.arange(k)
    weights = 0.5 ** np.arange(k)
    return GaussianMixture.from_stddevs(
        weights / weights.sum(), np.zeros((k, 2)),
        np.column_stack([sizes, sizes]), np.zeros(k))


def cases():
    """Return functions to time, by name."""
    y, x = (a.ravel().astype(float) for a in np.mgrid[:11, :11])
    three = MultiGaussianPSFModel(mixture(3), x_0=5.2, y_0=4.9)
    pixel = MultiGaussianPSFModel(mixture(3), x_0=5.2, y_0=4.9,
                                  pixel_integrated=True)
    free = three.copy().free_shape()
    peer, prf = GaussianPSF(x_0=5.2, y_0=4.9), CircularGaussianPRF(
        x_0=5.2, y_0=4.9)
    return {
        'K=3 copy()': three.copy,
        'GaussianPSF copy()': peer.copy,
        'K=3 evaluate': lambda: three.evaluate(x, y, *three.parameters),
        'K=3 integrated evaluate':
            lambda: pixel.evaluate(x, y, *pixel.parameters),
        'GaussianPSF evaluate': lambda: peer.evaluate(x, y, *peer.parameters),
        'CircularGaussianPRF evaluate':
            lambda: prf.evaluate(x, y, *prf.parameters),
        'K=3 fit_deriv, 3 free':
            lambda: three.fit_deriv(x, y, *three.parameters),
        'K=3 fit_deriv, 18 free':
            lambda: free.fit_deriv(x, y, *free.parameters),
        'GaussianPSF fit_deriv, 6':
            lambda: peer.fit_deriv(x, y, *peer.parameters),
    }


def cpu_microseconds(function):
    """Return the CPU time of one call, averaged over many."""
    start = time.process_time()
    for _ in range(CALLS):
        function()
    return 1e6 * (time.process_time() - start) / CALLS


def main():
    """Time every case in turn and print medians."""
    functions = cases()
    for function in functions.values():
        function()
    times = {name: [] for name in functions}
    for _ in range(ROUNDS):
        for name, function in functions.items():
            times[name].append(cpu_microseconds(function))
    print(f'photutils {photutils.__version__}, 11x11 pixels, CPU us a call')
    for name, values in times.items():
        print(f'{name:32} {statistics.median(values):8.1f} '
              f'({min(values):.1f} to {max(values):.1f})')


if __name__ == '__main__':
    main()
