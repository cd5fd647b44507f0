"""A PSF where no star tells what it is."""
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, fit_mixture_field
from photutils_mgauss.field.extrapolation import is_wild, widths_beyond
from photutils_mgauss.field.fit import _tamed

SIDE = 180


def round_psf(stddev):
    return GaussianMixture([1], [[0, 0]], [np.eye(2) * stddev**2])


def made_up(degree, corner, accuracy):
    """Return a field as wide as 2 pixels, but for a corner without stars."""
    def mixture_at(x, y):
        return round_psf(corner if x > 90 and y > 90 else 2.0)

    places = np.indices((12, 12)).reshape(2, -1) * 9.0
    return SimpleNamespace(
        degree=degree, accuracy=accuracy, mixture_at=mixture_at,
        stars=QTable({'x': [10.0, 50.0], 'y': [20.0, 60.0],
                      'used': [True, True]}),
        to_grid=lambda _: SimpleNamespace(
            mixtures=[mixture_at(*place) for place in places.T]))


@pytest.mark.parametrize(('corner', 'wild'), [
    (2.0, False), (5.0, False), (7.0, True), (0.5, True), (900.0, True)])
def test_a_psf_is_wild_that_is_three_times_what_it_is_at_any_star(corner,
                                                                  wild):
    narrow, wide = widths_beyond(made_up(4, corner, 0))
    assert narrow == pytest.approx(min(corner / 2, 1), rel=0.01)
    assert wide == pytest.approx(max(corner / 2, 1), rel=0.01)
    assert is_wild(narrow, wide) == wild


@pytest.mark.parametrize(('corners', 'accuracy', 'degree', 'words'), [
    ({2: 2.0}, 0.004, 2, 'degree 2 is taken'),
    ({2: 900.0, 1: 2.0}, 0.004, 1, 'degree 1 is taken'),
    # Stars need the degree, or none will do.
    ({2: 2.0}, 0.02, 4, 'give a lower degree'),
    ({2: 900.0, 1: 900.0}, 0.0, 4, 'give a lower degree')])
def test_a_lower_degree_is_taken_if_stars_have_no_objection(
        corners, accuracy, degree, words):
    with pytest.warns(UserWarning, match=words):
        found = _tamed(made_up(4, 900.0, 0.001),
                       lambda n: made_up(n, corners[n], accuracy))
    assert found.degree == degree


def test_a_psf_that_is_tame_is_left_as_it_is():
    field = made_up(4, 2.2, 0.001)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        assert _tamed(field, None) is field


@pytest.mark.long
def test_stars_in_a_corner_tell_nothing_of_the_others(rng):
    x, y = rng.uniform(15, 80, (2, 60))
    data = np.zeros((SIDE, SIDE))
    for star in zip(x, y, strict=True):
        data += round_psf(1.4 + 0.2 * np.sin(star[0] / 12)).render(
            (SIDE, SIDE), *star, flux=3e4)
    error = np.sqrt(50 + data)
    given = {'error': error, 'n_components': 1, 'radius': 6,
             'normalise': 'stamps', 'reject': False}
    stars = QTable({'x': x, 'y': y})
    data += rng.normal(0, error)
    with pytest.warns(UserWarning, match='far from all stars the PSF of'):
        fit_mixture_field(data, stars, **given)
    # Who asks for a degree has it.
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        fit_mixture_field(data, stars, degree=4, **given)
