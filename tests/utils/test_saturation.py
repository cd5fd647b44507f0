"""Saturated pixels, the trails of their charge, and stars behind them."""
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from scipy.ndimage import find_objects, label

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
        for part, in find_objects(label(true > full)[0]):
            for end in (range(part.start - 1, -1, -1),
                        range(part.stop, len(true))):
                charge = (true[part] - full).sum() / 2
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


def sky_of_stars(shape, turned, tail):
    """Return light (200, 200) of stars with a PSF so many times longer."""
    rng = np.random.default_rng(11)
    y, x = np.indices((200, 200))
    along, across = (np.array([np.cos(turned), np.sin(turned)]),
                     np.array([-np.sin(turned), np.cos(turned)]))
    light = np.full((200, 200), 100.0)
    places = np.stack(np.meshgrid(*[np.arange(25, 190, 30)] * 2), axis=-1)
    for number, place in enumerate(places.reshape(-1, 2)):
        dx, dy = x - place[0], y - place[1]
        dx, dy = dx - rng.uniform(-3, 3), dy - rng.uniform(-3, 3)
        r2 = ((along[0] * dx + along[1] * dy) ** 2 / shape
              + (across[0] * dx + across[1] * dy) ** 2 * shape)
        peak = 3e4 * (rng.uniform(2, 12) if number % 3 == 0
                      else rng.uniform(0.1, 0.85))
        light += peak * (np.exp(-r2 / 4) if tail == 'Gaussian'
                         else (1 + r2 / 6) ** -2.5)
    return light


@pytest.mark.parametrize('runs', ['none', 'columns', 'rows'])
@pytest.mark.parametrize(('shape', 'turned'), [
    (1, 0), (1.5, 0), (2, 0), (1.5, np.pi / 2), (2, np.pi / 2),
    (1.5, np.pi / 4), (1.3, np.radians(20))])
@pytest.mark.parametrize('tail', ['Gaussian', 'Moffat'])
def test_long_light_is_no_charge(shape, turned, tail, runs):
    light, full = sky_of_stars(shape, turned, tail), 3e4
    seen = np.minimum(light, full)
    if runs == 'columns':
        seen = run_along_columns(light, full)
    elif runs == 'rows':
        seen = run_along_columns(light.T, full).T
    mask = mask_of(seen, full)
    assert mask[seen != light].all()
    good = mask & (seen == light) & (light < 0.9 * full)
    # One beyond each end of a trail, if any.
    ends = {'none': 0, 'columns': np.count_nonzero(np.diff(mask, axis=0)),
            'rows': np.count_nonzero(np.diff(mask, axis=1))}[runs]
    assert good.sum() <= ends


@pytest.mark.parametrize('seed', range(4))
def test_noise_is_no_light(seed):
    data = np.random.default_rng(seed).normal(100, 20, (14, 90))
    data[5:10, 40:48] = 400
    mask = mask_of(data, 400)
    # Charge along rows, with a pixel beyond its ends.
    assert mask[5:10, [39, 48]].all()
    assert not mask[[4, 10]].any()


def test_light_is_round_where_all_is_masked():
    data = np.ones((9, 9))
    data[2:7, 4:7] = 100
    pixels = replace(read_pixels(data), mask=np.ones((9, 9), bool))
    np.testing.assert_array_equal(saturated_pixels(pixels, 100),
                                  mask_of(data, 100))


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
