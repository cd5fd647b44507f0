"""The frames' equations: what changes of the state leave as it is."""
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.motion_scenes import make_truth, observe
from photutils_mgauss import ProperMotionFitter
from photutils_mgauss.motions.assemble import assemble
from photutils_mgauss.motions.joint import reduce_all
from photutils_mgauss.motions.matching import HowToMatch
from photutils_mgauss.motions.posing import Kept, pose, reduce_again
from photutils_mgauss.motions.prepare import prepare

OPTIONS = [{}, {'recipe': 'two-step'}, {'parallax': 'prior'},
           {'references': None}]


def prepared(rng, options):
    """Return the setup of a fit and the state it starts from."""
    truth = make_truth(rng, n_stars=300, n_qso=60, parallax=0.5)
    fitter = ProperMotionFitter(**{'references': 'qso', **options})
    wanted = fitter._options()
    how = HowToMatch('id', None, fitter.max_motion)
    sightings = assemble(observe(truth, rng, edge=3.0), fitter.references,
                         how, wanted.transform, wanted.wanted)
    return prepare(sightings, wanted)


def shaken(state, rng):
    """Return a state with other maps."""
    return replace(state, maps=state.maps + rng.normal(
        0, 5, state.maps.shape))


@pytest.mark.parametrize('options', OPTIONS)
def test_only_the_right_hand_side_changes_with_the_maps(options, rng):
    setup, state = prepared(rng, options)
    before = pose(setup, state)
    weights = before.weights.copy()
    moved = shaken(state, rng)
    expected = reduce_all(pose(setup, moved))
    problem = pose(setup, moved, Kept(before.weights, None))
    assert_array_equal(problem.weights, weights)
    got = reduce_all(problem, like=reduce_all(before))
    assert_array_equal(got.direct, expected.direct)
    assert_array_equal(got.matrix, expected.matrix)
    size = np.abs(expected.rhs).max()
    assert np.abs(expected.rhs - reduce_all(before).rhs).max() > 0.01 * size
    assert_allclose(got.rhs, expected.rhs, rtol=0, atol=1e-10 * size)


def without_some(state, rng):
    """Return a state with detections, ties and references rejected."""
    used, untied = state.used.copy(), state.untied.copy()
    used[rng.integers(0, len(used), 5), rng.integers(0, 360, 5)] = False
    untied[rng.integers(0, 360, 3)] = True
    return replace(shaken(state, rng), used=used, untied=untied,
                   dropped=np.array([301, 340]))


@pytest.mark.parametrize('options', OPTIONS)
def test_rejected_detections_change_the_equations_of_their_stars(options,
                                                                 rng):
    setup, state = prepared(rng, options)
    after = without_some(state, rng)
    expected = pose(setup, after)
    equations = reduce_all(expected)
    problem = pose(setup, state)
    kept = Kept(problem.weights, reduce_all(problem)).without_changes(
        problem, state, after)
    assert 0 < len(kept.changed) <= 10
    again = pose(setup, after, kept)
    assert_array_equal(again.weights, expected.weights)
    assert_array_equal(again.offsets, expected.offsets)
    got = reduce_again(again, kept)
    for name in ('matrix', 'direct', 'rhs'):
        right = getattr(equations, name)
        assert_allclose(getattr(got, name), right, rtol=0,
                        atol=1e-12 * np.abs(right).max())


def test_nothing_is_kept_where_errors_change(rng):
    setup, state = prepared(rng, {})
    problem = pose(setup, state)
    kept = Kept(problem.weights, reduce_all(problem))
    assert kept.without_changes(problem, state, state) is kept
    assert kept.without_changes(problem, state, replace(
        state, floor=state.floor + 1)) is None


def test_equations_are_made_anew_where_one_star_outweighs_the_others(rng):
    setup, state = prepared(rng, {})
    star = np.flatnonzero(state.used.all(axis=0))[7]
    setup.sightings.covariance[:, 0, star] *= 1e-6
    after = replace(state, used=state.used & (np.arange(360) != star))
    problem = pose(setup, state)
    kept = Kept(problem.weights, reduce_all(problem))
    assert kept.without_changes(problem, state, after) is None
