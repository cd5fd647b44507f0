"""Detections beyond the limit are found, whichever stars are judged."""
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.motion_scenes import changed, make_truth, observe, plane_epochs
from photutils_mgauss import ProperMotionFitter
from photutils_mgauss.motions.assemble import assemble
from photutils_mgauss.motions.frames import solve_frames
from photutils_mgauss.motions.joint import leverages, reduce_all, solve_all
from photutils_mgauss.motions.matching import HowToMatch
from photutils_mgauss.motions.outliers import chi2_limit, judge_all
from photutils_mgauss.motions.posing import pose
from photutils_mgauss.motions.prepare import prepare


def posed(rng, n_stars, n_qso, n_epochs=None, **options):
    """Return a problem with outliers of all sizes, and its frames."""
    truth = make_truth(rng, n_stars=n_stars, n_qso=n_qso, parallax=0.5)
    fitter = ProperMotionFitter(**{'references': 'qso', **options})
    wanted = fitter._options()
    how = HowToMatch('id', None, fitter.max_motion)
    epochs = observe(truth, rng, edge=3.0)[:n_epochs]
    sightings = assemble(epochs, fitter.references, how, wanted.transform,
                         wanted.wanted)
    setup, state = prepare(sightings, wanted)
    problem = pose(setup, state)
    shape = problem.offsets.shape[1:]
    size = np.where(rng.random(shape) < 0.03, rng.uniform(0, 10, shape), 0)
    errors = np.sqrt(2 / np.maximum(problem.weights[[0, 2]].sum(axis=0),
                                    1e-30))
    offsets = problem.offsets + size * errors * (problem.weights[0] > 0)
    problem = replace(problem, offsets=offsets)
    return problem, solve_frames(problem, reduce_all(problem),
                                 relative=setup.relative)


# Few references leave frames so uncertain that all stars are judged.
@pytest.mark.parametrize('options', [
    {'n_stars': 1500, 'n_qso': 200}, {'n_stars': 40, 'n_qso': 6},
    {'n_stars': 900, 'n_qso': 9, 'n_epochs': 4}, {'n_stars': 400, 'n_qso': 60,
                                    'n_epochs': 3},
    {'n_stars': 400, 'n_qso': 60, 'parallax': 'prior'},
    {'n_stars': 400, 'n_qso': 60, 'references': None},
    {'n_stars': 300, 'n_qso': 60, 'transform': 'poly-2'}])
@pytest.mark.parametrize('clip', [2.0, 5.0])
def test_no_star_with_an_outlier_is_passed_over(options, clip, rng):
    problem, frames = posed(rng, **options)
    whole = solve_all(problem, frames.correction, frames.factor, judge=True)
    judged = judge_all(problem, frames, clip)
    numbers = 2 * (problem.weights[0] > 0)
    assert_array_equal(judged.count, numbers.sum(axis=0))
    assert_allclose(judged.raw, np.nansum(whole.raw, axis=0), rtol=1e-9,
                    atol=1e-9)
    assert_allclose(judged.chi2, whole.chi2[:, judged.stars], rtol=1e-7)
    assert_array_equal(judged.numbers, numbers[:, judged.stars])
    beyond = np.flatnonzero((np.nan_to_num(whole.chi2) > chi2_limit(clip, 1))
                            .any(axis=0))
    enough = judged.count + problem.ranks >= problem.n_parameters + 4
    assert np.isin(beyond[enough[beyond]], judged.stars).all()
    assert enough[judged.stars].all()
    assert len(beyond) > 3


def test_where_frames_are_known_well_few_stars_are_judged(rng):
    problem, frames = posed(rng, n_stars=1500, n_qso=200)
    judged = judge_all(problem, frames, 5.0)
    beyond = (np.nanmax(judged.chi2, axis=0) > chi2_limit(5.0, 1)).sum()
    assert len(judged.stars) < 3 * beyond < 0.5 * problem.n_stars


def test_leverages_of_a_star_add_up_to_its_parameters(rng):
    problem, _ = posed(rng, n_stars=50, n_qso=20)
    alone = problem.unbound
    solved = (alone.weights[0] > 0).sum(axis=0) > 2
    assert_allclose(leverages(alone).sum(axis=0)[solved], 4)


def test_two_bad_detections_of_a_star_cost_no_good_one(rng):
    # The worst of what is left would often be a good one.
    n = 300
    epochs, _ = plane_epochs(rng, n=n, years=2020 + np.arange(7.0))
    bad = np.zeros((7, n), dtype=bool)
    for star in range(0, n, 3):
        bad[rng.choice(7, 2, replace=False), star] = True
    angle = rng.uniform(0, 2 * np.pi, (7, n))
    moved = [changed(epoch,
                     x_fit=epoch.table['x_fit'] + 0.2 * bad[e] * np.cos(
                         angle[e]),
                     y_fit=epoch.table['y_fit'] + 0.2 * bad[e] * np.sin(
                         angle[e])) for e, epoch in enumerate(epochs)]
    solution = ProperMotionFitter(systematic=None).fit(moved)
    residuals = solution.residuals
    used = np.zeros((7, n), dtype=bool)
    used[residuals['epoch'], residuals['id']] = residuals['used']
    certain = solution.stars['flags'] & 512 == 0
    assert certain.mean() > 0.95
    assert (used == ~bad)[:, certain].all()
