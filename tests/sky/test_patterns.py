"""Maps between lists of places, from the pattern of bright objects."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss.sky.patterns import Pattern

FIELD = 2000.0


def similarity(rng, *, scale=1.0, mirror=False, shift=0.0):
    """Return a map (2, 3) of any angle, off by a part of the field."""
    angle, away = rng.uniform(0, 2 * np.pi, 2)
    slope = scale * np.array([[np.cos(angle), -np.sin(angle)],
                              [np.sin(angle), np.cos(angle)]])
    if mirror:
        slope = slope @ np.diag([-1, 1])
    middle = np.full(2, FIELD / 2)
    place = middle + shift * FIELD * np.array([np.cos(away), np.sin(away)])
    return np.column_stack([scale * middle - slope @ place, slope])


def two_lists(rng, matrix, n=200, noise=0.05, missing=0.1, scatter=0.05):
    """
    Return places and fluxes of a field seen twice, in two frames.

    The second frame has its own edges; some objects are missing in each.
    """
    sky = rng.uniform(-1.5 * FIELD, 2.5 * FIELD, (2, 16 * n))
    flux = 10 ** rng.uniform(2, 5, 16 * n)
    size = np.sqrt(abs(np.linalg.det(matrix[:, 1:])))
    out = []
    for place, edge in ((sky, FIELD), (matrix[:, :1] + matrix[:, 1:] @ sky,
                                       size * FIELD)):
        seen = ((place > 0) & (place < edge)).all(axis=0)
        seen &= rng.uniform(size=16 * n) > missing
        number = rng.permutation(np.flatnonzero(seen))
        out += [place[:, number] + rng.normal(0, noise * edge / FIELD,
                                              (2, len(number))),
                flux[number] * np.exp(rng.normal(0, scatter, len(number)))]
    return out


@pytest.mark.parametrize('keywords', [
    {}, {'mirror': True}, {'scale': 0.3}, {'scale': 4.0}, {'shift': 0.5},
    {'shift': 0.9}, {'mirror': True, 'shift': 0.7, 'scale': 1.7}])
@pytest.mark.parametrize('seed', range(3))
def test_a_similarity_is_found(seed, keywords):
    rng = np.random.default_rng(seed)
    matrix = similarity(rng, **keywords)
    first, flux, second, other = two_lists(rng, matrix)
    found = Pattern().find(first, second, flux, other)
    scale = keywords.get('scale', 1.0)
    corners = np.array([[500, 1500, 500, 1500], [500, 500, 1500, 1500.0]])
    expected = matrix[:, :1] + matrix[:, 1:] @ corners
    assert_allclose(found.apply(corners), expected, atol=3 * scale)


@pytest.mark.parametrize('change', [
    {'n': 15}, {'n': 3000}, {'missing': 0.4}, {'noise': 3.0},
    {'scatter': 1.0}])
def test_few_faint_missing_and_bad_objects_do_no_harm(rng, change):
    matrix = similarity(rng, shift=0.1)
    first, flux, second, other = two_lists(rng, matrix, **change)
    found = Pattern().find(first, second, flux, other)
    middle = np.full((2, 1), FIELD / 2)
    assert_allclose(found.apply(middle), matrix[:, :1]
                    + matrix[:, 1:] @ middle, atol=3.0)


def test_lists_without_fluxes_are_matched(rng):
    matrix = similarity(rng)
    first, flux, second, other = two_lists(rng, matrix)
    found = Pattern().find(first, second, flux * np.nan, other * np.nan)
    assert found.together > 50


def test_nothing_is_found_where_nothing_is_common(rng):
    for _ in range(5):
        first, flux, _, _ = two_lists(rng, similarity(rng))
        second, other, _, _ = two_lists(rng, similarity(rng))
        assert Pattern().find(first, second, flux, other) is None


def test_what_is_known_of_the_map_is_used(rng):
    matrix = similarity(rng, mirror=True, scale=2.0)
    first, flux, second, other = two_lists(rng, matrix)
    lists = first, second, flux, other
    assert Pattern(mirror=True, scale=(1.8, 2.2)).find(*lists) is not None
    assert Pattern(mirror=False).find(*lists) is None
    assert Pattern(scale=(0.9, 1.1)).find(*lists) is None


def test_fewer_objects_than_a_pattern_needs(rng):
    few = rng.uniform(0, FIELD, (2, 4))
    assert Pattern().find(few, few, np.ones(4), np.ones(4)) is None


@pytest.mark.parametrize('seed', range(20))
def test_five_objects_of_another_field_are_not_found(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, FIELD, (2, 5))
    for n in (5, 40, 400):
        targets = rng.uniform(0, FIELD, (2, n))
        assert Pattern().find(points, targets, np.ones(5), np.ones(n)) is None
