"""Exposures that show the same stars again: places count, not detections."""
import numpy as np
import pytest

from helpers.dithers import dithered
from photutils_mgauss import GaussianMixture, fit_mixture_field
from photutils_mgauss.field.normal import in_turn
from photutils_mgauss.field.places import places, same_stars
from photutils_mgauss.utils.star_columns import Sources

SIZE, N_STARS, N_IMAGES, SKY = 130, 10, 7, 30.0
PSF = GaussianMixture.from_stddevs([1.0], [[0, 0]], [[1.5, 1.5]])


def sources(x, y, flux=None):
    flux = np.full(len(x), np.nan) if flux is None else flux
    return Sources(np.asarray(x, float), np.asarray(y, float), flux,
                   np.ones(len(x), bool))


def turned(x, y, angle, shift):
    c, s = np.cos(angle), np.sin(angle)
    return c * x - s * y + shift[0], s * x + c * y + shift[1]


@pytest.mark.parametrize('shift', [(0, 0), (12.3, -7.8), (140.2, 60.0)])
def test_the_same_stars_are_found_after_a_shift_and_a_small_turn(rng, shift):
    x, y = rng.uniform(0, 400, (2, 40))
    lists, orders = [sources(x, y)], []
    for angle in (0.002, -0.004):
        order = rng.permutation(40)
        moved = np.array(turned(x, y, angle, shift))[:, order]
        lists.append(sources(*(moved + rng.normal(0, 0.05, moved.shape))))
        orders.append(order)
    first, *others = same_stars(lists)
    np.testing.assert_array_equal(first, np.arange(40))
    for number, order in zip(others, orders, strict=True):
        same = number == order
        assert same.mean() > 0.9
        # No star is taken for another one.
        assert (number[~same] >= 40).all()


def test_stars_of_other_fields_are_other_stars(rng):
    lists = [sources(*rng.uniform(0, 200, (2, 25))) for _ in range(6)]
    assert len(set(np.concatenate(same_stars(lists)))) > 0.97 * 150


def test_a_star_that_is_nowhere_has_its_own_number(rng):
    x, y = rng.uniform(0, 300, (2, 20))
    lists = [sources(np.append(x, np.nan), np.append(y, np.nan))] * 2
    one, two = same_stars(lists)
    np.testing.assert_array_equal(one[:-1], two[:-1])
    assert one[-1] != two[-1]


def test_a_star_far_from_where_it_was_is_at_another_place():
    star = np.array([0, 0, 0, 1])
    x = np.array([10.0, 15.0, 70.0, 10.0])
    assert places(star, x, np.full(4, 5.0), (100, 100)).tolist() == [
        0, 0, 1, 2]


def test_the_brightest_of_every_place_come_first():
    order = in_turn(np.array([0, 0, 1, 2, 1]), np.array([9, 8, 1, 5, 2]))
    assert order.tolist() == [0, 3, 4, 1, 2]


@pytest.fixture(scope='module')
def field():
    """Return the field of images in which each star has a neighbour."""
    rng = np.random.default_rng(5)
    x, y = (rng.permutation(np.linspace(28, SIZE - 28, N_STARS))
            for _ in range(2))
    flux = rng.uniform(2e4, 6e4, N_STARS)
    off = rng.uniform(-4, 4, (2, N_STARS))
    images, tables, errors = dithered(
        PSF, SIZE, SKY, (x, y, flux), (off, 0.02), N_IMAGES, rng.poisson, rng)
    return fit_mixture_field(images, tables, error=errors, radius=6,
                             n_components=2, normalise='stamps')


@pytest.mark.long
def test_stars_seen_often_are_few_stars(field):
    assert len(field.stars) == N_STARS * N_IMAGES
    assert len(set(field.stars['star'])) == N_STARS
    # So few stars were asked for the degree.
    assert len(field.choice)
    assert field.choice['degree'].max() <= 2


@pytest.mark.long
def test_the_psf_is_not_wild_where_no_star_is(field):
    truth = PSF.fwhm
    for x in (0, SIZE - 1):
        for y in (0, SIZE - 1):
            assert abs(field.mixture_at(x, y).fwhm / truth - 1) < 0.06
