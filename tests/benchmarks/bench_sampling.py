"""
The posterior by `sample_mixture` beside the paper's model written literally.

Run as ``python tests/benchmarks/bench_sampling.py``. Both sample the paper's
priors on the same stamp with the same NUTS of PyMC, seed and chains; the
literal model's labels are sorted out afterwards by the same function. Prints
wall-clock and CPU seconds (children included), R-hat, effective sizes, and
how far apart the two posteriors are in units of their width. With
``--sampler`` nutpie or numpyro, where installed, take the place of PyMC's
NUTS on our side; ``--no-literal`` leaves the literal model out.
"""
import argparse
import os
import time

import numpy as np
from psf_stamps import make_stamps

from photutils_mgauss.fitting.convergence import effective_size, split_r_hat
from photutils_mgauss.fitting.posterior import relabel, sample_mixture

PIXEL_SCALE = 0.074
NAMES = ('omega', 'alpha', 'beta', 'gamma')


def literal(image, k, start, arguments):
    """Sample Eqs. 1-4 as they are printed; return arrays in native pixels."""
    import pymc as pm
    import pytensor.tensor as pt

    pitch = PIXEL_SCALE / 2
    axis = (np.arange(image.shape[0]) + 0.5) * pitch
    x, y = np.meshgrid(axis, axis)
    middle = image.shape[0] * pitch / 2
    density = 4 * image / image.sum() / PIXEL_SCALE**2
    first = {'omega': start.weights,
             'alpha': middle + PIXEL_SCALE * start.means,
             'beta': PIXEL_SCALE * start.stddevs, 'gamma': start.rho}
    with pm.Model():
        sigma = pm.HalfNormal('sigma', 1)
        omega = pm.Dirichlet('omega', np.ones(k))
        alpha = pm.Normal('alpha', middle, 0.037, shape=(k, 2))
        beta = pm.HalfNormal('beta', 1, shape=(k, 2))
        gamma = pm.TruncatedNormal('gamma', 0, 0.9, lower=-1, upper=1,
                                   shape=k)
        mu = 0
        for i in range(k):
            q = 1 - gamma[i]**2
            u = (x - alpha[i, 0]) / beta[i, 0]
            v = (y - alpha[i, 1]) / beta[i, 1]
            mu = mu + omega[i] / (
                2 * np.pi * beta[i, 0] * beta[i, 1] * pt.sqrt(q)) * pt.exp(
                -(u**2 - 2 * gamma[i] * u * v + v**2) / (2 * q))
        pm.Normal('pixels', mu, sigma, observed=density)
        idata = pm.sample(
            draws=arguments.draws, tune=arguments.literal_tune,
            chains=arguments.chains, random_seed=arguments.seed,
            progressbar=False, cores=arguments.cores,
            compute_convergence_checks=False,
            initvals=first if arguments.start else None,
            init='adapt_diag' if arguments.start else 'auto')
    draws = [np.asarray(idata['posterior'][name].values) for name in NAMES]
    draws[1] = (draws[1] - middle) / PIXEL_SCALE
    draws[2] = draws[2] / PIXEL_SCALE
    return draws, idata


def clock():
    """Return wall-clock and CPU seconds, finished children included."""
    times = os.times()
    return np.array([time.perf_counter(), sum(times[:4])])


def flat(draws):
    """Return scalar draws (number, chains, draws)."""
    return np.concatenate([np.moveaxis(a.reshape(*a.shape[:2], -1), -1, 0)
                           for a in draws])


def describe(name, seconds, draws):
    """Print one line about a posterior."""
    scalars = flat(draws)
    print(f'{name}: {seconds[0]:.0f} s wall clock, {seconds[1]:.0f} CPU s, '
          f'largest R-hat {max(map(split_r_hat, scalars)):.4f}, smallest '
          f'effective size {min(map(effective_size, scalars)):.0f}')


def compare(image, own, start, own_seconds, arguments):
    """Print how the literal model does beside our draws."""
    middle = clock()
    raw, _ = literal(image, arguments.k, start, arguments)
    seconds = clock() - middle
    describe('literal, as sampled', seconds, raw)
    theirs = relabel(*raw, start)
    describe('literal, relabelled', seconds, theirs)
    wall, cpu = own_seconds / seconds
    print(f'sample_mixture takes {wall:.2f} of its time, {cpu:.2f} of its '
          'CPU time')
    one, other = flat(own), flat(theirs)
    shift = abs(one.mean(axis=(1, 2)) - other.mean(axis=(1, 2))) / one.std(
        axis=(1, 2))
    ratio = one.std(axis=(1, 2)) / other.std(axis=(1, 2))
    print(f'difference of means over width: median {np.median(shift):.3f}, '
          f'largest {shift.max():.3f}; ratio of widths '
          f'{ratio.min():.3f} to {ratio.max():.3f}')


def read_arguments():
    """Return the arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--stamps', help='npz file with an array stamps')
    parser.add_argument('--index', type=int, default=44)
    parser.add_argument('--k', type=int, default=3)
    parser.add_argument('--draws', type=int, default=1000)
    parser.add_argument('--tune', type=int, default=500)
    parser.add_argument('--literal-tune', type=int, default=1000)
    parser.add_argument('--chains', type=int, default=4)
    parser.add_argument('--cores', type=int, default=2)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--sampler', default='pymc')
    parser.add_argument('--no-literal', action='store_true')
    parser.add_argument('--start', action='store_true',
                        help='start the literal model at least squares too, '
                        'else its chains find other modes')
    return parser.parse_args()


def main():
    """Sample both ways and compare."""
    arguments = read_arguments()
    if arguments.stamps:
        with np.load(arguments.stamps) as file:
            image = file['stamps'][arguments.index]
    else:
        image = make_stamps(10)[arguments.index]
    before = clock()
    ours = sample_mixture(
        image, arguments.k, prior='paper', pixel_scale=PIXEL_SCALE,
        oversampling=2, draws=arguments.draws, tune=arguments.tune,
        chains=arguments.chains, cores=arguments.cores,
        sampler=arguments.sampler, rng=arguments.seed)
    middle = clock()
    own = [getattr(ours, name) for name in NAMES]
    describe(f'sample_mixture ({arguments.sampler})', middle - before, own)
    fit = ours.fit
    errors = np.sqrt(np.diag(fit.covariance)).reshape(-1, 6)
    widths = np.column_stack([
        ours.means.std(axis=(0, 1)), ours.stddevs.std(axis=(0, 1)),
        ours.rho.std(axis=(0, 1))])
    print('least-squares errors over posterior widths, median over '
          f'parameters: {np.median(errors[:, 1:] / widths):.3f}')
    if not arguments.no_literal:
        compare(image, own, ours.fit.mixture, middle - before, arguments)


if __name__ == '__main__':
    main()
