"""Odd arguments of every public function; see `arguments`."""
import contextlib
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import photutils_mgauss as mg
from fuzz import public_calls
from fuzz.arguments import ODD_VALUES, outcome

pytestmark = pytest.mark.skipif(
    sys.platform == 'win32', reason='time is limited as POSIX does')

# What calls return, what has no arguments of its own, what takes minutes, and
# what needs a package or a file.
NOT_CALLED = {
    'CramerRao', 'FitStatus', 'InjectionResult', 'MixtureFit',
    'MixtureFitter', 'MixturePosterior', 'Optics', 'PixelMotionSolution',
    'PixelPhaseError', 'Scene', 'ShapeStatus', 'Shapes', 'SimulatedCatalogue',
    'TunedMixtureField', 'UnfinishedTilesError', 'read_psfex',
    'sample_mixture'}


@pytest.fixture(scope='module', autouse=True)
def _elsewhere(tmp_path_factory):
    """Work in a folder of its own: odd texts may be names of folders."""
    with contextlib.chdir(tmp_path_factory.mktemp('odd')):
        yield


@pytest.fixture(scope='module')
def parts():
    """Return the calls of each part of the package by name, compiled."""
    found = {part.__name__: part() for part in public_calls.PARTS}
    for calls in found.values():
        for function, valid in calls.values():
            outcome(function, valid)
    return found


@pytest.fixture(scope='module')
def calls(parts):
    return {name: call for part in parts.values()
            for name, call in part.items()}


def test_every_public_function_is_called(calls):
    called = {name.partition('.')[0].partition(' ')[0] for name in calls}
    public = {name for name in mg.__all__ if callable(getattr(mg, name))}
    assert public - called == NOT_CALLED


def test_the_calls_are_valid(calls):
    results = {name: outcome(*call) for name, call in calls.items()}
    assert {name: words for name, (found, words) in results.items()
            if found != 'value'} == {}


odd_values = st.one_of(
    st.sampled_from(list(ODD_VALUES.values())),
    st.builds(lambda value: lambda: value, st.one_of(
        st.floats(), st.integers(), st.text(max_size=5),
        st.lists(st.floats(), max_size=4),
        st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4).map(
            lambda values: np.reshape(values, (2, 2))))))


@settings(derandomize=True, deadline=None, max_examples=40)
@pytest.mark.parametrize('part', [p.__name__ for p in public_calls.PARTS])
@given(draw=st.data())
def test_an_odd_argument_gives_a_value_or_a_clean_error(part, draw, parts):
    name = draw.draw(st.sampled_from(sorted(parts[part])))
    function, valid = parts[part][name]
    argument = draw.draw(st.sampled_from(sorted(valid)))
    value = draw.draw(odd_values)()
    found, words = outcome(function, {**valid, argument: value})
    assert found in ('value', 'clean error'), (
        f'{name}({argument}={value!r:.60}): {words}')
