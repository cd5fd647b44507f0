"""Saturated pixels, the trails of their charge, and stars behind them."""
import astropy.units as u
import numpy as np
import pytest

from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.psf.wings import stars_behind
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.saturation import as_saturation, saturated_pixels

MIXTURE = GaussianMixture([0.7, 0.3], [(0, 0), (0, 0)],
                          [[[0.9, 0.1], [0.1, 0.8]], [[4, 0], [0, 4]]])


def mask_of(data, level):
    return saturated_pixels(read_pixels(data), level)


def test_around_a_small_plateau_a_pixel_is_masked():
    data = np.ones((9, 9))
    data[4, 4:6] = 100
    want = np.zeros((9, 9), bool)
    want[3:6, 3:7] = True
    np.testing.assert_array_equal(mask_of(data, 100), want)


@pytest.mark.parametrize('turned', [False, True])
def test_a_trail_that_has_not_filled_its_pixels_is_masked(turned):
    data = np.ones((30, 30))
    data[14:17, 14:17] = 100
    data[5:26, 15] = np.maximum(data[5:26, 15], 60)
    want = np.zeros((30, 30), bool)
    # Charge may be in pixels beyond its ends, not beside it.
    want[13:18, 14:17] = True
    want[4:27, 15] = True
    data, want = (each.T if turned else each for each in (data, want))
    np.testing.assert_array_equal(mask_of(data, 100), want)


def test_what_is_beside_a_round_plateau_is_left():
    y, x = np.indices((30, 30))
    full = np.hypot(x - 14, y - 15) < 4
    np.testing.assert_array_equal(mask_of(np.where(full, 100.0, 60), 100),
                                  full)


def run_along_columns(light, full):
    """Return an image whose charge above a level runs up and down."""
    seen = np.minimum(light, full)
    for column, true in zip(seen.T, light.T, strict=True):
        places = np.flatnonzero(true > full)
        for end in (range(places[0] - 1, -1, -1),
                    range(places[-1] + 1, len(true))) if places.size else ():
            charge = (true[places] - full).sum() / 2
            for row in end:
                taken = min(charge, full - column[row])
                column[row] += taken
                charge -= taken
    return seen


@pytest.mark.parametrize('runs', [False, True])
def test_only_pixels_that_hold_other_light_are_masked(runs):
    light = MIXTURE.render((60, 60), 30.3, 29.6, flux=1e6)
    seen = (run_along_columns(light, 3e4) if runs
            else np.minimum(light, 3e4))
    mask = mask_of(seen, 3e4)
    assert mask[seen != light].all()
    good = mask & (seen == light) & (light < 0.9 * 3e4)
    # One beyond each end of the columns, if any.
    assert good.sum() <= runs * 2 * mask.any(axis=0).sum()


def test_a_plateau_with_noise_is_masked_without_holes():
    rng = np.random.default_rng(3)
    y, x = np.indices((40, 40))
    full = np.hypot(x - 19, y - 21) < 6
    data = rng.normal(np.where(full, 100, 50), 2)
    np.testing.assert_array_equal(mask_of(data, 100), full)


def test_levels_have_units():
    data = np.ones((9, 9))
    data[4, 4] = 100
    image = read_pixels(data * u.kJy)
    assert saturated_pixels(image, 9e4 * u.Jy).sum() == 9
    assert not saturated_pixels(image, 2e5 * u.Jy).any()


def test_infinity_marks_what_is_not_finite():
    data = np.ones((9, 9))
    data[2, 2] = np.nan
    assert np.argwhere(mask_of(data, np.inf)).tolist() == [[2, 2]]
    assert not mask_of(data, 5).any()


@pytest.mark.parametrize('level', [0, -3, np.nan, 'high'])
def test_a_level_is_positive(level):
    with pytest.raises((TypeError, ValueError), match='saturation must be'):
        as_saturation(level)


def behind(data, hidden, **options):
    weight = np.where(hidden, 0, 1.0)
    model = MultiGaussianPSFModel(MIXTURE)
    return stars_behind(LocalPSF.of(model), np.where(hidden, 0, data), weight,
                        **options)


def test_the_place_is_that_of_the_wings_not_of_the_clump():
    data = MIXTURE.render((60, 60), 30.3, 25.6, flux=1e6)
    hidden = data > 3e3
    hidden[27:50, 29:32] = True
    star, = behind(data, hidden)
    y, x = np.nonzero(hidden)
    assert np.hypot(x.mean() - 30.3, y.mean() - 25.6) > 3
    assert np.hypot(star.x - 30.3, star.y - 25.6) < 0.15
    assert star.flux == pytest.approx(1e6, rel=0.1)
    assert star.clump == tuple(slice(at.min(), at.max() + 1)
                               for at in (y, x))


def test_bad_pixels_beside_a_star_hide_none():
    data = MIXTURE.render((60, 60), 30.3, 25.6, flux=1e5)
    hidden = np.zeros(data.shape, bool)
    hidden[25:27, 33:36] = hidden[5:9, 5:9] = True
    assert behind(data, hidden) == []
