"""
Quality and speed of `ProperMotionFitter`, each figure beside what is asked.

Run as ``python tests/benchmarks/bench_proper_motion.py``; choose parts with
``--parts``. Real data are read from MGAUSS_REALDATA where it is set. Seven
simulated epochs in a folder (epochs.ecsv, truth.ecsv, epoch_<i>.hdr) are
added with ``--epochs``. Times are CPU seconds of one thread; ratios are to a
peer measured in the same run.
"""
import argparse
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.io.fits import Header
from astropy.table import Table
from astropy.wcs import WCS
from scipy.optimize import curve_fit
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.motion_scenes import (
    SUBSETS,
    TIMES,
    make_truth,
    observe,
    pulls,
)
from helpers.one_epoch import gaia_table, make_sky, observe_once
from helpers.one_epoch import pulls as one_epoch_pulls
from photutils_mgauss import Epoch, ProperMotionFitter
from photutils_mgauss.motions.frames import solve_frames
from photutils_mgauss.motions.joint import reduce_all, solve_all
from photutils_mgauss.motions.matching import Tolerance, match_positions
from photutils_mgauss.motions.priors import Priors
from photutils_mgauss.motions.problem import MotionProblem
from photutils_mgauss.sky.observers import observer_position
from photutils_mgauss.sky.tangent_plane import TangentPlane
from photutils_mgauss.sky.transforms import Transform


class OneThread:
    """An executor that does the work itself."""

    @staticmethod
    def map(function, *iterables):
        """Return the map of Python."""
        return map(function, *iterables)


def rms(values):
    return float(np.sqrt(np.nanmean(np.square(values))))


def line(what, asked, measured):
    print(f'{what:58s} {asked:>16s} {measured}')


def heading(title):
    print(f'\n{title}\n{"-" * len(title)}')


# Pulls

def bench_pulls():
    heading('Pulls: error over its standard error (asked 0.95-1.05)')
    rng = np.random.default_rng(1)
    n = 4000
    sigma = np.concatenate([rng.uniform(0.5, 1.5, n // 2),
                            rng.uniform(3, 10, n // 2),
                            rng.uniform(0.5, 8, 900)])
    truth = make_truth(rng, n_stars=n, n_qso=900, sigma=sigma,
                       parallax=rng.gamma(2, 0.4, n + 900))
    epochs = observe(truth, rng, edge=3.0)
    gaia = catalogue(truth, rng, np.flatnonzero(truth.qso)[:600])
    fit = ProperMotionFitter(references=gaia, parallax=True).fit(epochs)
    stars = fit.stars
    which = np.asarray(stars['id'])
    test = ~truth.qso[which]
    parallax = ((stars['parallax'].value - truth.parallax[which])
                / stars['parallax_error'].value)
    places = place_pulls(stars, truth)
    for name, group in (('bright', truth.sigma[which] < 2),
                        ('faint', truth.sigma[which] >= 2)):
        chosen = test & group
        values = [rms(pull[chosen]) for pull in (
            *places, *pulls(stars, truth), parallax)]
        line(f'  {name} ({chosen.sum()}): ra dec pmra pmdec parallax',
             '0.95-1.05', ' '.join(f'{value:.3f}' for value in values))


def catalogue(truth, rng, which, error=0.05):
    """Return quasars with catalogue positions at the truth's epoch."""
    noise = error / 3.6e6 * rng.normal(size=(2, len(which)))
    return Table({
        'id': which, 'class': np.full(len(which), 'qso'),
        'ra': truth.ra[which] + noise[0] / np.cos(
            np.radians(truth.dec[which])),
        'dec': truth.dec[which] + noise[1],
        'ra_error': np.full(len(which), error),
        'dec_error': np.full(len(which), error),
        'ref_epoch': np.full(len(which), truth.year0)})


def place_pulls(stars, truth):
    which = np.asarray(stars['id'])
    years = stars['ref_epoch'][0].value - truth.year0
    cosine = np.cos(np.radians(truth.dec[which]))
    away = ((stars['ra'].value - truth.ra[which]) * cosine * 3.6e6
            - truth.pm[0, which] * years,
            (stars['dec'].value - truth.dec[which]) * 3.6e6
            - truth.pm[1, which] * years)
    return [offset / stars[name].value for offset, name in zip(
        away, ('ra_error', 'dec_error'), strict=True)]


def bench_field_mean(n_fields=100):
    heading('The mean motion of a field, by the covariance between stars')
    pull = []
    for seed in range(n_fields):
        rng = np.random.default_rng(100 + seed)
        truth = make_truth(rng, n_stars=100, n_qso=30, sigma=1.0)
        fit = ProperMotionFitter(references='qso', systematic=None,
                                 clip=None).fit(observe(truth, rng))
        stars = fit.stars[~truth.qso[np.asarray(fit.stars['id'])]]
        covariance = fit.covariance(stars['id'])
        for k, name in ((2, 'pmra'), (3, 'pmdec')):
            away = stars[name].value - truth.pm[k - 2, stars['id']]
            pull.append(np.mean(away) / np.sqrt(
                covariance[:, k, :, k].mean()))
    noise = 1 / np.sqrt(2 * len(pull))
    line(f'  pull of {len(pull)} field means (+- {noise:.2f})', '0.95-1.05',
         f'{rms(pull):.3f}')


# One epoch and a catalogue like Gaia's

def bench_one_epoch(n_fields=10):
    heading('One epoch of 2004 and a catalogue of 2016: pulls, and beside '
            'two epochs')
    found, ratio, away = {True: [], False: []}, [], []
    for seed in range(n_fields):
        rng = np.random.default_rng(seed)
        sky = make_sky(rng)
        gaia, epoch = gaia_table(sky, rng), observe_once(sky, rng)
        solution = ProperMotionFitter(references=gaia).fit([epoch])
        for bright, pull in found.items():
            pull.append(one_epoch_pulls(solution.stars, sky,
                                        sky.bright == bright))
        some = compare_with_two(gaia, epoch, sky)
        ratio.append(some[0])
        away.append(some[1])
    for bright, pulls_ in found.items():
        pull, word = np.hstack(pulls_), 'with' if bright else 'without'
        line(f'  {word} a motion in the catalogue ({pull.size})',
             '0.95-1.05', f'{rms(pull):.3f}')
    line('  error over that of two epochs (least, most)', '1',
         f'{np.min(ratio):.6f} {np.max(ratio):.6f}')
    line('  largest difference of a motion, in its errors', '0',
         f'{np.max(away):.4f}')


def compare_with_two(gaia, epoch, sky):
    """Return the ratios of errors, and differences of motions in those."""
    keywords = {'systematic': None, 'clip': None, 'ref_epoch': 2016.0}
    one = ProperMotionFitter(references=gaia, **keywords).fit([epoch]).stars
    motions = gaia[sky.bright]
    motions.remove_columns(['ra_error', 'dec_error'])
    places = Epoch(gaia['ra', 'dec', 'ra_error', 'dec_error'], time=2016.0)
    two = ProperMotionFitter(references=motions, **keywords).fit(
        [epoch, places]).stars
    two = two[two['n_good_obs'] == 2]
    _, nearest = cKDTree(np.column_stack([two['ra'], two['dec']])).query(
        np.column_stack([one['ra'], one['dec']]))
    use = one['reference_row'] >= 0
    one, two = one[use], two[nearest[use]]
    error = one['pmra_error'].value
    return (error / two['pmra_error'].value,
            np.abs(one['pmra'].value - two['pmra'].value) / error)


# The paper

def paper_scene(seed=3, n_stars=614, n_qso=590, **keywords):
    """Return the paper's field: numbers, dates, and errors of 2.25 mas."""
    rng = np.random.default_rng(seed)
    sigma = 2.25 * np.exp(0.8 * rng.normal(size=n_stars + n_qso))
    truth = make_truth(rng, n_stars=n_stars, n_qso=n_qso,
                       sigma=np.maximum(sigma, 0.7), **keywords)
    return rng, truth


def bench_fig11():
    heading('Fig. 11: median formal error [mas/yr] for 2 to 7 epochs')
    rng, truth = paper_scene()
    epochs = observe(truth, rng, missing=0)
    references = rng.choice(np.flatnonzero(truth.qso), 100, replace=False)
    print('  epochs: pmra pmdec; over the bound with known frames '
          '(asked <= 1.03)')
    for n, which in SUBSETS.items():
        some = [epochs[k] for k in which]
        # The bound is a formal error: the wrong WCS must cost it no data.
        fit, bound = (ProperMotionFitter(systematic=None, clip=None,
                                         **keywords).fit(some)
                      for keywords in ({'references': references},
                                       {'transform': None}))
        test = ~np.isin(fit.stars['id'], references)
        got, best = (np.array([np.median(one.stars[f'{name}_error'].value[
            test]) for name in ('pmra', 'pmdec')]) for one in (fit, bound))
        quoted = {5: 'paper 1.0', 7: 'paper 0.8'}.get(n, '')
        line(f'  {n}', '<= 1.03', f'{got.round(3)} ratio '
             f'{(got / best).round(3)} {quoted}')


def bench_recipes():
    heading('Bright stars (under 1.5 mas), parallax and a 3 mas affine '
            'residual: rms error [mas/yr] / rms pull')
    rng, truth = paper_scene(
        parallax=np.random.default_rng(9).gamma(2, 0.25, 1204))
    epochs = observe(truth, rng, edge=3.0, missing=0)
    gaia = gaia_stars(truth, rng)
    quasars = np.flatnonzero(truth.qso)
    recipes = (
        ('paper, eps_t as printed', '(about 1.5)',
         {'recipe': 'paper', 'references': quasars}),
        ('paper, eps_t corrected', '(about 1.0)',
         {'recipe': 'paper', 'references': quasars, 'eps_t': 'corrected'}),
        ('two steps, affine, no parallax', '',
         {'recipe': 'two-step', 'references': quasars}),
        ('joint, affine, no parallax', '', {'references': quasars}),
        ('joint, affine, parallax prior', '<= 0.6',
         {'references': quasars, 'parallax': 'prior'}),
        ('joint, parallax prior, 100 Gaia stars too', '',
         {'references': gaia, 'parallax': 'prior'}))
    for name, asked, keywords in recipes:
        stars = ProperMotionFitter(**keywords).fit(epochs).stars
        which = np.asarray(stars['id'])
        bright = (truth.sigma[which] < 1.5) & ~truth.qso[which]
        bright &= ~np.isin(which, gaia['id'])
        away = np.stack([stars[name].value - truth.pm[k, which]
                         for k, name in enumerate(('pmra', 'pmdec'))])
        pull = pulls(stars, truth)[:, bright]
        line(f'  {name} ({bright.sum()})', asked,
             f'{rms(away[:, bright]):.3f} / {rms(pull):.2f}')


def gaia_stars(truth, rng, n=100):
    """Return all quasars, and bright stars with motions and parallaxes."""
    order = np.argsort(np.where(truth.qso, np.inf, truth.sigma))[:n]
    quasars = np.flatnonzero(truth.qso)
    which = np.append(order, quasars)
    star = np.arange(len(which)) < n
    error = np.where(star, 0.1, np.nan)
    noise = 0.1 * rng.normal(size=(3, len(which)))
    return Table({
        'id': which, 'class': np.where(star, 'star', 'qso'),
        'pmra': truth.pm[0, which] + noise[0], 'pmra_error': error,
        'pmdec': truth.pm[1, which] + noise[1], 'pmdec_error': error,
        'parallax': truth.parallax[which] + noise[2],
        'parallax_error': error,
        'ref_epoch': np.full(len(which), 2016.0)})


def bench_parallax_bias():
    heading('What an ignored parallax does [mas/yr per mas] '
            '(0.43 and 0.12-0.19 in pmra and pmdec)')
    rng = np.random.default_rng(2)
    truth = make_truth(rng, n_stars=200, n_qso=200, sigma=0.05, parallax=1.0)
    epochs = observe(truth, rng, missing=0)
    fit = ProperMotionFitter(recipe='paper', eps_t='corrected',
                             references='qso').fit(epochs)
    stars = fit.stars[~truth.qso[np.asarray(fit.stars['id'])]]
    for k, name in enumerate(('pmra', 'pmdec')):
        bias = np.median(stars[name].value - truth.pm[k, stars['id']])
        said = np.median(stars[f'{name}_per_parallax'].value)
        line(f'  paper recipe, {name}', '', f'{bias:+.3f}, the table says '
             f'{said:+.3f}')


def bench_joint_and_two_step():
    heading('Joint over two-step, rms error by formal position error')
    sums = {}
    for seed in range(60):
        rng = np.random.default_rng(50 + seed)
        truth = make_truth(rng, n_stars=1500, n_qso=60,
                           sigma=10 ** rng.uniform(-0.3, 1, 1560))
        epochs = observe(truth, rng, edge=3.0)
        for recipe in ('joint', 'two-step'):
            stars = ProperMotionFitter(recipe=recipe, references='qso').fit(
                epochs).stars
            which = np.asarray(stars['id'])
            away = np.stack([stars['pmra'].value - truth.pm[0, which],
                             stars['pmdec'].value - truth.pm[1, which]])
            for low, high in ((0.5, 1), (1, 2), (2, 4), (4, 10)):
                group = ((truth.sigma[which] >= low) & ~truth.qso[which]
                         & (truth.sigma[which] < high))
                total = sums.setdefault((low, high), {}).setdefault(
                    recipe, [])
                total.append(np.nanmean(away[:, group]**2))
    for (low, high), found in sums.items():
        ratio = np.sqrt(np.mean(found['joint']) / np.mean(found['two-step']))
        line(f'  {low}-{high} mas', '<= 1', f'{ratio:.4f}')


# Other people's epochs

def bench_epochs(folder):
    heading(f'Seven epochs in {folder.name}: median formal error, rms/formal')
    truth = Table.read(folder / 'truth.ecsv')
    table = Table.read(folder / 'epochs.ecsv')
    table = table[table['detected']]
    epochs = []
    for k, time_ in enumerate(TIMES):
        mine = table[table['epoch'] == k]
        wcs = WCS(Header.fromtextfile(folder / f'epoch_{k}.hdr'))
        columns = mine['id', 'x', 'y', 'x_err', 'y_err']
        epochs.append(Epoch(columns, wcs, time_.jyear))
    rng = np.random.default_rng(3)
    quasars = np.flatnonzero(truth['qso'])
    references = rng.choice(quasars, 100, replace=False)
    for n, which in SUBSETS.items():
        some = [epochs[k] for k in which]
        fit, bound = (ProperMotionFitter(systematic=None, match_by='id',
                                         clip=None, **keywords).fit(
                                             some).stars
                      for keywords in ({'references': references},
                                       {'transform': None}))
        both = (fit['n_good_obs'] == n) & ~np.isin(fit['id'], references)
        got, best = (np.array([np.median(one[f'{name}_error'].value[both])
                               for name in ('pmra', 'pmdec')])
                     for one in (fit, bound))
        pull = [rms((fit[name].value - truth[name][fit['id']])[both]
                    / fit[f'{name}_error'].value[both])
                for name in ('pmra', 'pmdec')]
        quoted = {5: 'paper 1.0', 7: 'paper 0.8'}.get(n, '')
        line(f'  {n} epochs ({both.sum()})', '<= 1.03',
             f'{got.round(3)} ratio {(got / best).round(3)} pulls '
             f'{np.round(pull, 2)} {quoted}')


# Speed

def make_problem(n, *, transform, parallax, seed=1):
    """Return the arrays of n stars at the seven epochs, 10 % missing."""
    rng = np.random.default_rng(seed)
    plane = TangentPlane(192.86, 27.13)
    origin = rng.uniform(-3.3e5, 3.3e5, (2, n))
    years = TIMES.jyear
    dt = (years - years.mean())[:, None]
    sigma = rng.uniform(0.5, 8, (2, 7, n))
    seen = rng.uniform(size=(7, n)) > 0.1
    motion = rng.normal(0, 4, (2, 1, n))
    offsets = (motion * dt + sigma * rng.normal(size=sigma.shape)) * seen
    weights = np.stack([seen / sigma[0]**2, np.zeros((7, n)),
                        seen / sigma[1]**2])
    observer = observer_position('earth', years)[..., None]
    p = 5 if parallax else 4
    quasars = np.arange(min(1000, n // 10))
    offsets[..., quasars] -= (motion * dt * seen)[..., quasars]
    precision = np.zeros((p, p, len(quasars)))
    precision[range(2, p), range(2, p)] = 1e8
    zero = np.zeros((p, len(quasars)))
    return MotionProblem(offsets, weights, origin, dt,
                         observer if parallax else None, plane,
                         Transform.parse(transform).fitted_to(origin),
                         Priors(quasars, precision, zero, zero[0]), False,
                         np.ones(n, dtype=bool))


def cpu(function):
    start = time.thread_time()
    result = function()
    return time.thread_time() - start, result


def solve_jointly(problem):
    frames = solve_frames(problem, reduce_all(problem, OneThread))
    return solve_all(problem, frames.correction, frames.factor, OneThread)


def bench_speed(n):
    heading(f'Speed, one thread, {n:.0e} stars x 7 epochs (CPU seconds)')
    factor = n / 1e6
    problem = make_problem(n, transform=None, parallax=True)
    empty = np.zeros((problem.n_epochs * 2 * problem.transform.n_terms, 0))
    correction = np.zeros((7, 2, problem.transform.n_terms))
    seconds, _ = cpu(lambda: solve_all(problem, correction, empty, OneThread))
    line('  separate fits of five parameters', f'< {3 * factor:g}',
         f'{seconds:.2f}')
    del problem
    for parallax in (False, True):
        problem = make_problem(n, transform='affine', parallax=parallax)
        seconds, _ = cpu(lambda p=problem: solve_jointly(p))
        line(f'  one joint solution, {problem.n_parameters} parameters, '
             'covariances', f'< {30 * factor:g}', f'{seconds:.2f}')
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    line('  largest memory so far [GB]', '< 2', f'{peak:.2f}')


def bench_whole(n):
    heading(f'The whole fit from tables and WCS, one thread, {n:.0e} stars')
    rng = np.random.default_rng(1)
    truth = make_truth(rng, n_stars=n - 1000, n_qso=1000)
    epochs = observe(truth, rng, edge=3.0)
    for name, asked, keywords in (
            ('no rejection', 30, {'clip': None, 'systematic': None}),
            ('rejection and floors', 120, {})):
        fitter = ProperMotionFitter(references='qso', executor=OneThread,
                                    match_by='id', **keywords)
        seconds, _ = cpu(lambda f=fitter: f.fit(epochs))
        line(f'  {name}', f'< {asked * n / 1e6:g}', f'{seconds:.1f}')
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    line('  largest memory so far, tables included [GB]', '', f'{peak:.2f}')


def straight(t, x, mu):
    return x + mu * t


def bench_curve_fit(n=10000, sample=1000):
    heading(f'Beside a loop of curve_fit, {n} stars x 7 epochs')
    problem = make_problem(n, transform=None, parallax=False)
    empty = np.zeros((problem.n_epochs * 2 * problem.transform.n_terms, 0))
    correction = np.zeros((7, 2, problem.transform.n_terms))
    ours = np.median([cpu(lambda: solve_all(
        problem, correction, empty, OneThread))[0] for _ in range(5)])

    def loop():
        out = []
        for i in range(sample):
            use = problem.weights[0][:, i] > 0
            t = problem.dt[use, 0]
            if use.sum() < 3:
                continue
            for k in (0, 1):
                value, cov = curve_fit(
                    straight, t, problem.offsets[k][use, i], (0.0, 0.0),
                    problem.weights[2 * k][use, i]**-0.5,
                    absolute_sigma=True)
                out.append((i, k, value[1], cov[1, 1]))
        return out
    seconds, out = cpu(loop)
    free = replace(problem, priors=Priors.none(4))
    found = solve_all(free, correction, empty, OneThread)
    i, k, slope, variance = np.array(out).T
    i, k = i.astype(int), k.astype(int)
    line('  largest difference of a motion [mas/yr]', '',
         f'{np.abs(found.values[2 + k, i] - slope).max():.1e}')
    ratio = found.covariance[2 + k, 2 + k, i] / variance
    line('  largest relative difference of a variance', '',
         f'{np.abs(ratio - 1).max():.1e}')
    seconds *= n / sample
    line('  curve_fit / batched', '>= 100', f'{seconds:.2f} s / {ours:.4f} s '
         f'= {seconds / ours:.0f}')


def bench_matching(n):
    heading(f'Matching on the sky, {n:.0e} stars x 7 epochs')
    rng = np.random.default_rng(0)
    side = 3600 * np.sqrt(n)
    place, motion = rng.uniform(0, side, (2, n)), rng.normal(0, 5, (2, n))
    years = TIMES.jyear
    places, sigmas, numbers = [], [], []
    for year in years:
        seen = rng.permutation(np.flatnonzero(rng.uniform(size=n) < 0.9))
        sigma = rng.uniform(1, 20, len(seen))
        places.append(place[:, seen] + motion[:, seen] * (year - years[0])
                      + sigma * rng.normal(size=(2, len(seen)))
                      + rng.normal(0, 300, (2, 1)))
        sigmas.append(sigma)
        numbers.append(seen)
    seconds, matches = cpu(lambda: match_positions(
        places, sigmas, years, Tolerance(None, 50.0, 2000.0)))
    found = matches.take(numbers, fill=-1)
    wrong = np.sum((found >= 0) & (found != found.max(axis=0)))
    line('  seconds', f'< {60 * n / 1e6:g}', f'{seconds:.1f}')
    line('  rows with the wrong star', '',
         f'{wrong / sum(map(len, numbers)):.1e}')


PARTS = ('pulls', 'one_epoch', 'paper', 'recipes', 'epochs', 'speed', 'whole')


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--parts', default=','.join(PARTS))
    parser.add_argument('--n', type=float, default=1e6,
                        help='number of stars for the times')
    parser.add_argument('--epochs', type=Path)
    chosen = parser.parse_args()
    parts, n = chosen.parts.split(','), int(chosen.n)
    print(f'{"":58s} {"asked":>16s} measured')
    if 'pulls' in parts:
        bench_pulls()
        bench_field_mean()
    if 'one_epoch' in parts:
        bench_one_epoch()
    if 'paper' in parts:
        bench_fig11()
    if 'recipes' in parts:
        bench_recipes()
        bench_parallax_bias()
        bench_joint_and_two_step()
    if 'epochs' in parts and chosen.epochs:
        bench_epochs(chosen.epochs)
    if 'speed' in parts:
        bench_curve_fit()
        bench_speed(n)
        bench_matching(n)
    if 'whole' in parts:
        bench_whole(n)


if __name__ == '__main__':
    main()
