"""
Errors of stars with a PSF from few stars, and with correlated noise.

    python tests/benchmarks/bench_psf_errors.py [--harness DIR --optics FILE]
        [--stars 150 30 15 8] [--pairs 30 12] [--kernels bilinear drizzle]
        [--seeds 4] [--first-seed 1] [--size 1024] [--time]

Scenes have a star in each square of 46 pixels: some of 18 to 20.5 mag for the
PSF, all others of 17 to 19 mag. *Pulls* are differences from the truth over
errors, about the centre of the true PSF's core at each place, fluxes about
their median ratio. *Differences* are those of the same stars in two exposures
over both errors, each exposure with the PSF of stars of its own; with a
kernel, both images are resampled with it. What the PSF of an exposure is off
by in the mean moves all its stars by the same, as its pointing does: x and y
are given about the mean difference, too. The light beyond the stamps of
either exposure makes all fluxes differ by one ratio: they are given about
that, too, and what the ratio is off by over the errors ``wing_error`` of both.
In brackets the same without the part of the PSF. The scatter (+-) is that of
pulls whose errors are right: errors of one PSF move all stars of a scene
together, so that few scenes tell little of the mean. It is drawn from the
field's covariance, each scene by itself; what few stars do not tell is the
same in all scenes of one set of optics, which makes it larger. The optics are
those of `photutils_mgauss.simulation`, or the table FILE of the harness in DIR
(csst_psf). --time compares the photometry of 20,000 stars with and without.
"""
import argparse
import sys
import time
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
from astropy.table import Table
from scipy.ndimage import convolve

from photutils_mgauss import (
    MixturePSFPhotometry,
    csst_psf,
    fit_mixture_field,
)
from photutils_mgauss.field.normal import to_coefficients
from photutils_mgauss.psf.centre import centres

CELL, ZERO_POINT, SKY = 46, 32.24, 115.0
KERNELS = {'none': None, 'bilinear': np.full((2, 2), 0.25),
           'drizzle': np.array([[0.02, 0.1, 0.02], [0.1, 0.52, 0.1],
                                [0.02, 0.1, 0.02]])}
NAMES = 'x', 'y', 'flux'
DRAWS, STEP = 12, 0.05


class PackageOptics:
    """The optics of this package's simulation."""

    def __init__(self, size):
        self.psf = csst_psf((size, size))

    def draw(self, image, x, y, flux):
        half = 30
        stamps = self.psf.render(x, y, flux, 2 * half + 1)
        for stamp, i, j in zip(stamps, np.rint(x).astype(int),
                               np.rint(y).astype(int), strict=True):
            rows, columns = slice(max(j - half, 0), j + half + 1), slice(
                max(i - half, 0), i + half + 1)
            part = image[rows, columns]
            y_0, x_0 = max(half - j, 0), max(half - i, 0)
            part += stamp[y_0:y_0 + part.shape[0], x_0:x_0 + part.shape[1]]

    def centre(self, x, y, stddev):
        pixel = 0 if not self.psf.pixel_integrated else np.eye(2) / 12
        mixtures = [self.psf.mixture_at(*place)
                    for place in zip(x, y, strict=True)]
        return np.concatenate([centres(
            one.weights[None], one.means[None],
            one.covariances[None] + pixel, stddev) for one in mixtures])


class HarnessOptics:
    """A table of optics made by the harness."""

    def __init__(self, path):
        from csst_psf import TruePSF
        self.psf = TruePSF(path)

    def draw(self, image, x, y, flux):
        self.psf.render(image, x, y, flux, np.full(x.size, 40))

    def centre(self, x, y, stddev):
        steps = np.arange(-80, 81) / 4
        found = np.zeros((x.size, 2))
        for star in range(x.size):
            light = self.psf.epsf(x[star], y[star], os=4, size=161)
            for _ in range(60):
                along = [np.exp(-0.5 * ((steps - at) / stddev)**2)
                         for at in found[star]]
                seen = light * along[0] * along[1][:, None]
                move = np.array([
                    (seen.sum(axis=axis) * (steps - at)).sum() for axis, at
                    in enumerate(found[star])]) / seen.sum()
                found[star] += 2 * move
                if np.abs(move).max() < 1e-7:
                    break
        return found


def scene(optics, seed, n_psf, size):
    """Return the clean image, its errors, all stars, and PSF stars first."""
    rng = np.random.default_rng(seed)
    n = size // CELL
    x, y = ((np.mgrid[:n, :n].reshape(2, -1) + 0.5) * CELL
            + rng.uniform(-12, 12, (2, n * n)))
    order = rng.permutation(n * n)
    chosen = np.zeros(n * n, bool)
    chosen[order[:n_psf]] = True
    mag = np.where(chosen, rng.uniform(18, 20.5, n * n),
                   rng.uniform(17, 19, n * n))
    stars = Table({'x': x, 'y': y, 'flux': 10 ** (0.4 * (ZERO_POINT - mag))})
    clean = np.zeros((size, size))
    optics.draw(clean, *(np.asarray(stars[name]) for name in NAMES))
    error = np.sqrt(np.maximum(clean, 0) + SKY)
    return clean, error, stars[order[:n_psf]], stars[~chosen]


def measured(clean, error, psf_stars, test, seed, kernel):
    """Return the field of one exposure, and the table of its stars."""
    data = clean + np.random.default_rng(seed).normal(0, error)
    if kernel is not None:
        data = convolve(data, kernel)
        error = np.sqrt(convolve(error**2, kernel**2))
    field = fit_mixture_field(data, psf_stars, error=error)
    return field, MixturePSFPhotometry(field, 11)(data, error=error,
                                                  init_params=test)


def squares(tables, offsets):
    """Return the mean squares of pulls with and without the PSF's part."""
    out = []
    for name, offset in zip(NAMES, offsets, strict=True):
        full = sum(table[f'{name}_err']**2 for table in tables)
        part = sum(table[f'{name}_psf_err']**2 for table in tables)
        out.append([np.mean(offset**2 / full),
                    np.mean(offset**2 / (full - part))])
    return out


def pulls(optics, n_psf, size, seed):
    clean, error, stars, test = scene(optics, seed, n_psf, size)
    field, table = measured(clean, error, stars, test, seed + 1000, None)
    x, y, flux = (np.asarray(test[name]) for name in NAMES)
    centre = optics.centre(x, y, field.centre_stddev)
    ratio = np.median(table['flux_fit'] / flux)
    found = squares([table], [table['x_fit'] - x - centre[:, 0],
                              table['y_fit'] - y - centre[:, 1],
                              table['flux_fit'] - ratio * flux])
    return [[*one, scatter] for one, scatter in zip(
        found, scatter_of_squares(field, table, clean, error, test),
        strict=True)]


def scatter_of_squares(field, table, clean, error, test):
    """Return the variance of mean squares of pulls with right errors (3,)."""
    def places(one):
        found = MixturePSFPhotometry(one, 11)(clean, error=error,
                                              init_params=test)
        return np.array([found[f'{name}_fit'] for name in NAMES])

    rng, base = np.random.default_rng(1), places(field)
    values, vectors = np.linalg.eigh(field.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))
    drawn = []
    for _ in range(DRAWS):
        change = to_coefficients(root @ rng.normal(size=values.size),
                                 field.coefficients)
        # Small steps: positions answer in proportion.
        moved = (places(replace(field, coefficients=field.coefficients
                                + STEP * change)) - base) / STEP
        moved[2] -= np.median(moved[2] / base[2]) * base[2]
        drawn.append([np.mean(shift**2 / np.asarray(table[f'{name}_err'])**2)
                      for name, shift in zip(NAMES, moved, strict=True)])
    return np.var(drawn, axis=0, ddof=1)


def differences(optics, n_psf, size, kernel, seed):
    clean, error, stars, test = scene(optics, seed, 2 * n_psf, size)
    (field, one), (second, other) = (
        measured(clean, error, part, test, seed + noise, kernel)
        for part, noise in ((stars[:n_psf], 1000), (stars[n_psf:], 2000)))
    off = [np.asarray(one[f'{name}_fit'] - other[f'{name}_fit'])
           for name in NAMES]
    found = squares([one, other], off)
    places = squares([one, other], [off[0] - off[0].mean(),
                                    off[1] - off[1].mean(), 0])[:2]
    ratio = np.median(one['flux_fit'] / other['flux_fit'])
    for name in ('flux_fit', 'flux_err', 'flux_psf_err'):
        other[name] *= ratio
    about = squares([one, other], [0, 0, one['flux_fit'] - other['flux_fit']])
    pull = (ratio - 1) / np.hypot(field.wing_error, second.wing_error)
    return [*found, *places, about[2], [pull**2, np.nan]]


def report(label, one_scene, seeds):
    found = np.mean([one_scene(seed) for seed in seeds], axis=0)
    names = (*NAMES, 'x about the mean', 'y about the mean',
             'flux about the ratio', 'ratio')[:len(found)]
    words = []
    for name, (full, without, *variance) in zip(names, np.sqrt(found),
                                                strict=True):
        # Of a root of n scenes' mean square, which is 1 if errors are right.
        scatter = ''.join(f' +- {one / 2 / np.sqrt(len(seeds)):.2f}'
                          for one in variance)
        words.append(f'{name} {full:.2f}{scatter} ({without:.2f})')
    print(f'{label:32s}' + '   '.join(words), flush=True)


def compare_times(optics, size):
    """Print the CPU time of 20,000 stars with and without."""
    clean, error, stars, _ = scene(optics, 1, 150, size)
    field = fit_mixture_field(clean, stars, error=error, degree=2)
    many = stars[np.resize(np.arange(len(stars)), 20_000)]
    many['group_id'] = many['id'] = np.arange(len(many)) + 1
    times = {}
    for on in (False, True) * 3:
        photometry = MixturePSFPhotometry(field, 11, psf_errors=on)
        start = time.process_time()
        photometry(clean, error=error, init_params=many)
        times[on] = min(time.process_time() - start, times.get(on, np.inf))
    print(f'20,000 stars: {times[False]:.2f} s CPU without, '
          f'{times[True] / times[False]:.2f} times that with the errors of '
          'the PSF')


def main():
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--harness')
    parser.add_argument('--optics')
    parser.add_argument('--stars', type=int, nargs='*',
                        default=[150, 30, 15, 8])
    parser.add_argument('--pairs', type=int, nargs='*', default=[30, 12])
    parser.add_argument('--kernels', nargs='*',
                        default=['bilinear', 'drizzle'])
    parser.add_argument('--seeds', type=int, default=4)
    parser.add_argument('--first-seed', type=int, default=1)
    parser.add_argument('--size', type=int, default=1024)
    parser.add_argument('--time', action='store_true')
    options = parser.parse_args()
    warnings.simplefilter('ignore')
    if options.harness:
        sys.path.insert(0, options.harness)
        optics = HarnessOptics(options.optics)
    else:
        optics = PackageOptics(options.size)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    size = options.size
    for n in options.stars:
        report(f'pulls, {n} PSF stars', partial(pulls, optics, n, size),
               seeds)
    for n in options.pairs:
        report(f'differences, {n} PSF stars each',
               partial(differences, optics, n, size, None), seeds)
    for name in options.kernels:
        report(f'differences, 60 each, {name}',
               partial(differences, optics, 60, size, KERNELS[name]), seeds)
    if options.time:
        compare_times(optics, size)


if __name__ == '__main__':
    main()
