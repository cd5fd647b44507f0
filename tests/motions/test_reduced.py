"""The frames' equations: what a change of the maps alone leaves as it is."""
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.motion_scenes import make_truth, observe
from photutils_mgauss import ProperMotionFitter
from photutils_mgauss.motions.assemble import assemble
from photutils_mgauss.motions.joint import reduce_all
from photutils_mgauss.motions.loop import pose
from photutils_mgauss.motions.matching import HowToMatch
from photutils_mgauss.motions.prepare import prepare


@pytest.mark.parametrize('options', [
    {}, {'recipe': 'two-step'}, {'parallax': 'prior'}, {'references': None}])
def test_only_the_right_hand_side_changes_with_the_maps(options, rng):
    truth = make_truth(rng, n_stars=300, n_qso=60, parallax=0.5)
    fitter = ProperMotionFitter(**{'references': 'qso', **options})
    wanted = fitter._options()
    how = HowToMatch('id', None, fitter.max_motion)
    sightings = assemble(observe(truth, rng, edge=3.0), fitter.references,
                         how, wanted.transform, wanted.wanted)
    setup, state = prepare(sightings, wanted)
    before = pose(setup, state)
    moved = replace(state, maps=state.maps + rng.normal(
        0, 5, state.maps.shape))
    expected = reduce_all(pose(setup, moved))
    problem = pose(setup, moved, before.weights)
    assert_array_equal(problem.weights, before.weights)
    got = reduce_all(problem, like=reduce_all(before))
    assert_array_equal(got.direct, expected.direct)
    assert_array_equal(got.matrix, expected.matrix)
    size = np.abs(expected.rhs).max()
    assert np.abs(expected.rhs - reduce_all(before).rhs).max() > 0.01 * size
    assert_allclose(got.rhs, expected.rhs, rtol=0, atol=1e-10 * size)
