"""
Time and quality of `fit_mixture` and `adaptive_moments` beside their peers.

Run as ``python tests/benchmarks/bench_fitting.py``; choose parts with
``--parts`` and read other stamps (n, 30, 30), sampled twice as finely as the
native pixels, from an npz file with ``--stamps``. Times are CPU seconds of
one core, medians over stamps, with the peer measured in the same run. The
ePSFs of the Hubble Space Telescope of the part ``phase`` are read from the
folder MGAUSS_REALDATA where it is set.
"""
import argparse
import os
import resource
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from astropy.io import fits
from phase_stars import phase_errors, summarise
from psf_stamps import make_stamps
from scipy.optimize import least_squares

from photutils_mgauss import adaptive_moments, fit_mixture

ONE_THREAD = ThreadPoolExecutor(1)
WIDTHS = np.array([1.2, 2.2, 4.3, 7.6, 3.2])
SHARES = np.array([0.7, 0.2, 0.1, 0.03, 0.1])


# The peer: scipy on the same model, derivatives by differences.

def scipy_starts(image, k, n_starts):
    """Yield one start made by hand and others scattered around it."""
    total, middle = image.sum(), (np.array(image.shape[::-1]) - 1) / 2
    start = np.column_stack([
        np.log(SHARES[:k] / SHARES[:k].sum() * total), np.tile(middle, (k, 1)),
        np.log(WIDTHS[:k]), np.log(WIDTHS[:k]), np.zeros(k)])
    rng = np.random.default_rng(7)
    for i in range(n_starts):
        spread = np.array([0.3, 0.5, 0.5, 0.3, 0.3, 0.3]) * (i > 0)
        yield (start + spread * rng.standard_normal(start.shape)).ravel()


def scipy_fit(image, start):
    """Return the sum of squares that scipy reaches from a start."""
    y, x = np.indices(image.shape)
    peak = image.max()

    def residual(values):
        model = 0
        for flux, mx, my, a, b, c in values.reshape(-1, 6):
            sx, sy, rho = np.exp(a), np.exp(b), np.tanh(c)
            u, v = (x - mx) / sx, (y - my) / sy
            q = 1 - rho**2
            model = model + np.exp(
                flux - 0.5 * (u * u - 2 * rho * u * v + v * v) / q) / (
                2 * np.pi * sx * sy * np.sqrt(q))
        return (model - image).ravel() / peak

    with np.errstate(all='ignore'):
        try:
            fit = least_squares(residual, start, x_scale='jac', max_nfev=300)
        except ValueError:  # it ran into infinities
            return np.inf
    return 2 * fit.cost * peak**2


def cpu_times(function, items):
    """Return results and CPU seconds of each call, the first one warmed."""
    function(items[0])
    results, seconds = [], []
    for item in items:
        start = time.process_time()
        results.append(function(item))
        seconds.append(time.process_time() - start)
    return results, np.array(seconds)


# The parts.

def speed(stamps, arguments):
    """Print the time of one fit, cold and from the neighbour, and scipy's."""
    n_side = round(len(stamps) ** 0.5)
    for k in (3, 5):
        fits, cold = cpu_times(lambda s, k=k: fit_mixture(
            s, k, oversampling=2), stamps)
        pairs = [(stamps[i], fits[i - 1].mixture)
                 for i in range(1, len(stamps)) if i % n_side]
        _, near = cpu_times(lambda p, k=k: fit_mixture(
            p[0], k, oversampling=2, start=p[1]), pairs)
        _, peer = cpu_times(lambda s, k=k: scipy_fit(
            s, next(scipy_starts(s, k, 1))), stamps[::len(stamps) // 20])
        cold, near, peer = (1e3 * np.median(t) for t in (cold, near, peer))
        print(f'speed K={k}: cold {cold:.2f} ms, from the neighbour '
              f'{near:.2f} ms, scipy (one start) {peer:.1f} ms: '
              f'{peer / cold:.0f}x and {peer / near:.0f}x faster')


def cost(stamps, arguments):
    """Print how often the cost is that of the best of five scipy starts."""
    for k, step in ((3, 1), (5, arguments.thin_5)):
        if str(k) not in arguments.cost_of:
            continue
        chosen = stamps[arguments.first::arguments.thin * step]
        ratio = np.array([
            fit_mixture(s, k).chi2 / min(
                scipy_fit(s, start) for start in scipy_starts(s, k, 5))
            for s in chosen])
        print(f'cost K={k}, {len(chosen)} stamps, over the best of 5 scipy '
              f'starts: at most 1.001 on {np.mean(ratio <= 1.001):.1%}, 1.05 '
              f'on {np.mean(ratio <= 1.05):.1%}, below 0.999 on '
              f'{np.mean(ratio < 0.999):.1%}')


def quality(stamps, arguments):
    """Print the shape errors of the fits, and the flux they leave out."""
    truth = adaptive_moments(stamps)
    circle = {'enclosed_flux': 0.98}  # the paper's
    for normalize, cut in (('free', {}), ('tied', {}), ('free', circle),
                           ('tied', circle)):
        for k in (1, 2, 3, 4, 5):
            fits = fit_mixture(stamps, k, normalize=normalize, **cut)
            left = np.array([fit.residual for fit in fits])
            model = adaptive_moments(stamps - left)
            size = truth.relative_size_error(model)
            shape = truth.ellipticity_error(model)
            lost = left.sum(axis=(1, 2)) / stamps.sum(axis=(1, 2))
            where = 'circle of 98 %' if cut else 'whole stamp'
            print(f'quality {normalize}, {where}, K={k}: dR2/R2 '
                  f'{size.mean():+.5f} +- {size.std():.5f}, d eps '
                  f'{shape.mean():+.5f} +- {shape.std():.5f}, flux not in '
                  f'the model {lost.mean():.2%}')


def throughput(stamps, arguments):
    """Print the time and memory of 18 detectors of 30 x 30 stamps."""
    rng = np.random.default_rng(3)
    many = np.concatenate([
        stamps + 1e-4 * stamps.max() * rng.standard_normal(stamps.shape)
        for _ in range(-(-16200 // len(stamps)))])[:16200]
    fit_mixture(many[:2], 3)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    wall, cpu = time.perf_counter(), time.process_time()
    fits = fit_mixture(many, 3)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f'throughput: {len(fits)} stamps of K=3 in {wall:.1f} s of wall '
          f'clock, {cpu:.1f} CPU s, memory {before:.0f} -> {after:.0f} MB '
          f'(the stamps alone are {many.nbytes / 2**20:.0f} MB)')


def moments(stamps, arguments):
    """Print time and agreement of adaptive moments with GalSim."""
    try:
        import galsim
    except ImportError:
        print('moments: GalSim is not installed, nothing to compare with')
        return
    images = [galsim.Image(np.ascontiguousarray(s), scale=1.0)
              for s in stamps]
    adaptive_moments(stamps, executor=ONE_THREAD)
    times = []
    for _ in range(5):
        start = time.process_time()
        theirs = [galsim.hsm.FindAdaptiveMom(image) for image in images]
        middle = time.process_time()
        ours = adaptive_moments(stamps, executor=ONE_THREAD)
        times.append((middle - start, time.process_time() - middle))
    theirs_time, ours_time = np.median(times, axis=0) / len(stamps)
    e = np.array([(t.observed_shape.e1, t.observed_shape.e2) for t in theirs])
    r2 = np.array([2 * t.moments_sigma**2 for t in theirs]) / np.sqrt(
        1 - (e**2).sum(axis=1))
    worst = max(abs(ours.e1 - e[:, 0]).max(), abs(ours.e2 - e[:, 1]).max())
    print(f'moments: {1e6 * ours_time:.0f} us a stamp, GalSim '
          f'{1e6 * theirs_time:.0f} us, ratio {ours_time / theirs_time:.2f}; '
          f'R2 equal to {abs(ours.r2 / r2 - 1).max():.1e}, e to {worst:.1e}')


def phase(stamps, arguments):
    """Print pixel-phase errors on optics and on ePSFs of Hubble."""
    chosen = stamps[::arguments.thin]
    for k in (3, 5, 6):
        for weighting in arguments.weighting.split(','):
            print_phases('optics', chosen, 2, k, weighting)
    folder = os.environ.get('MGAUSS_REALDATA')
    if folder is None:
        print('phase: MGAUSS_REALDATA is not set, no ePSFs of Hubble')
        return
    epsfs = hubble_epsfs(Path(folder))
    inner = epsfs[1:-1, 1:-1].reshape(-1, *epsfs.shape[2:])
    for k in (3, 5, 8):
        for weighting in arguments.weighting.split(','):
            print_phases('F814W, inner nodes', inner, 4, k, weighting)
    if 'astrometric' in arguments.weighting:
        print_phases('F814W, all nodes',
                     epsfs.reshape(-1, *epsfs.shape[2:]), 4, 8, 'astrometric')


def hubble_epsfs(folder):
    """Return the ePSFs (8, 7, 41, 41) of F814W, the middle of the file's."""
    path = folder / 'hst_wfc3uvis_f814w' / 'PSFSTD_WFC3UV_F814W.fits'
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        with fits.open(path, ignore_missing_end=True) as hdus:
            data = hdus[0].data.astype(float)
    return data.reshape(8, 7, *data.shape[1:])[:, :, 30:71, 30:71]


def print_phases(name, images, oversampling, k, weighting):
    """Print one line for each width of the stars' stamps."""
    start = time.process_time()
    fits = fit_mixture(images, k, oversampling=oversampling,
                       weighting=weighting)
    seconds = (time.process_time() - start) / len(images)
    for size in (5, 7):
        rms, half, binned, pooled = summarise(np.array([
            phase_errors(image, fit, oversampling, size)
            for image, fit in zip(images, fits, strict=True)]))
        print(f'phase {name} ({len(images)}) K={k} {weighting}, '
              f'{1e3 * seconds:.0f} ms a fit, {size}x{size}: rms '
              f'{np.median(rms):.2f} (worst node {rms.max():.2f}, at most 1 '
              f'on {np.mean(rms <= 1):.0%}), half range '
              f'{np.median(half):.2f}, of medians in 8 bins '
              f'{np.median(binned):.2f}, all nodes together {pooled:.2f} '
              'mpix')


PARTS = {'phase': phase, 'speed': speed, 'cost': cost, 'quality': quality,
         'throughput': throughput, 'moments': moments}


def main():
    """Read the arguments and run the parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--parts', default=','.join(PARTS))
    parser.add_argument('--stamps', help='npz file with an array stamps')
    parser.add_argument('--n', type=int, default=30, help='nodes a side')
    parser.add_argument('--thin', type=int, default=9,
                        help='compare the cost on every so many stamps')
    parser.add_argument('--thin-5', type=int, default=4,
                        help='and on fewer by this factor for K = 5')
    parser.add_argument('--weighting', default='uniform,astrometric',
                        help='the weightings of the part phase')
    parser.add_argument('--first', type=int, default=0,
                        help='begin the thinned stamps at this one')
    parser.add_argument('--cost-of', default='3,5',
                        help='the numbers of Gaussians of the part cost')
    arguments = parser.parse_args()
    if arguments.stamps:
        with np.load(arguments.stamps) as file:
            stamps = file['stamps']
    else:
        stamps = make_stamps(arguments.n)
    for name in arguments.parts.split(','):
        PARTS[name](stamps, arguments)


if __name__ == '__main__':
    main()
