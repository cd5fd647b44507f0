"""Motions of crowded stars: what is thought of them, and who is one star."""
from types import SimpleNamespace

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    ImageEpoch,
    kernels,
    render_stars,
)
from photutils_mgauss.crowded.many_equations import FARTHEST
from photutils_mgauss.crowded.many_table import _by_itself
from photutils_mgauss.crowded.many_tile import ManyTile
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.utils.flags import MOTIONLESS, decode

YEARS = np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5])


def a_psf(width):
    return GriddedMixturePSF([GaussianMixture.from_stddevs(
        [0.8, 0.2], [(0, 0), (0.05, 0)], [(width, 0.85), (1.7, 1.6)])],
        [(0, 0)])


def test_bright_stars_stay_single_where_the_psf_is_a_little_wrong():
    rng = np.random.default_rng(4)
    grid = 12 + 20 * np.arange(5.0)
    x, y = (axis.ravel() + rng.uniform(-0.5, 0.5, 25)
            for axis in np.meshgrid(grid, grid))
    motion = rng.normal(0, 0.05, (2, 25))
    flux = np.full(25, 3e5)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (30.0, 5.0)
    wcs.wcs.cdelt = -2e-5, 2e-5
    images = []
    for year in YEARS:
        light = 40 + render_stars(a_psf(0.806), x + year * motion[0],
                                  y + year * motion[1], flux, (105, 105))
        images.append(ImageEpoch(rng.normal(light, np.sqrt(light)),
                                 a_psf(0.8), wcs, 2028 + year,
                                 error=np.sqrt(light), band='g'))
    table = CrowdedMixturePhotometry(None).fit_images(images, motions=True)
    seen = np.array(wcs.world_to_pixel(SkyCoord(table['ra'], table['dec'])))
    away = np.hypot(*(seen[:, :, None] - np.stack([x, y])[:, None]))
    assert_array_equal((away < 1).sum(axis=0), 1)
    # A pixel is 72 mas, and columns run against right ascension.
    off = table['pmra'].value[away.argmin(axis=0)] + 72 * motion[0]
    assert np.abs(off).max() < 0.5


def test_what_is_thought_of_a_star_does_not_move_it():
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 4, 6))
    known = root @ root.transpose(0, 2, 1)
    true = rng.normal(size=(3, 4))
    hold = np.zeros((3, 4))
    hold[:, 2:] = 0.7
    usual = np.array([0.0, 0.0, 0.3, -0.2])
    both = known + hold[:, :, None] * np.eye(4)
    drawn = np.linalg.solve(both, (np.einsum('nij,nj->ni', known, true)
                                   + hold * usual)[..., None])[..., 0]
    stars = Stars(*drawn[:, :2].T, np.ones(3)).replaced(rate=drawn[:, 2:])
    tile = SimpleNamespace(stars=stars, equations=SimpleNamespace(
        hold=hold, drift=drawn - usual))
    stars, place = _by_itself(tile, np.linalg.inv(both))
    assert_allclose(np.column_stack([stars.x, stars.y, stars.rate]), true)
    assert_allclose(place, np.linalg.inv(known))


def test_a_motion_that_pixels_do_not_tell_stays_unknown():
    hold = np.array([[0.0, 0.0, 0.7, 0.7]])
    place = np.diag([0.1, 0.1, 1 / 0.7, 1 / 0.7])[None]
    stars = Stars([3.0], [4.0], [1.0]).replaced(rate=np.zeros((1, 2)))
    tile = SimpleNamespace(stars=stars, equations=SimpleNamespace(
        hold=hold, drift=np.zeros((1, 4))))
    stars, place = _by_itself(tile, place)
    assert stars.x[0] == 3
    assert_allclose(place[0, :2, :2], 0.1 * np.eye(2))
    assert not (np.abs(np.diagonal(place[0])[2:]) < 1e6).any()


def test_stars_of_one_image_have_a_place_and_no_motion():
    # An image tells where a star is at its own time, and no more.
    rng = np.random.default_rng(6)
    n, hold = 200, np.array([0.0, 0.0, 1.0, 1.0])
    years, root = rng.uniform(-3, 3, n), rng.normal(size=(n, 2, 2))
    seen = np.zeros((n, 2, 4))
    seen[:, [0, 1], [0, 1]] = 1
    seen[:, [0, 1], [2, 3]] = years[:, None]
    known = seen.transpose(0, 2, 1) @ root @ root.transpose(0, 2, 1) @ seen
    place = np.linalg.inv(known + np.diag(hold))
    stars = Stars(*rng.normal(size=(2, n)), np.ones(n)).replaced(
        rate=np.zeros((n, 2)))
    tile = SimpleNamespace(stars=stars, equations=SimpleNamespace(
        hold=np.tile(hold, (n, 1)), drift=np.ones((n, 4))))
    alone, covariance = _by_itself(tile, place)
    assert_allclose(covariance[:, :2, :2], place[:, :2, :2])
    assert np.isnan(covariance[:, 2:, 2:]).all()
    assert_array_equal(alone.x, stars.x)


def test_stars_without_a_motion_have_a_flag():
    rng = np.random.default_rng(8)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (30.0, 5.0)
    wcs.wcs.cdelt = -2e-5, 2e-5
    x, y = np.array([[10.3, 22.1, 46.2], [12.2, 19.7, 14.8]])
    images = []
    for year, width in ((2026, 55), (2028, 35)):
        light = 40 + render_stars(a_psf(0.8), x, y, np.full(3, 3e4),
                                  (30, width))
        images.append(ImageEpoch(rng.normal(light, np.sqrt(light)),
                                 a_psf(0.8), wcs, year, error=np.sqrt(light),
                                 band='g'))
    phot = CrowdedMixturePhotometry(None)
    table = phot.fit_images(images, motions=True)
    unknown = ~np.isfinite(table['pmra'].value)
    assert_array_equal(unknown, table['n_images'] == 1)
    assert_array_equal((table['flags'] & MOTIONLESS) > 0, unknown)
    assert unknown.sum() == 1
    assert decode(MOTIONLESS) == ['no_motion']
    # Nothing is missing where no motions are asked for.
    table = phot.fit_images(images)
    assert not (table['flags'] & MOTIONLESS).any()


def test_how_stars_move_is_learnt_from_the_best_known():
    rng = np.random.default_rng(3)
    rate = np.array([0.04, -0.02]) + rng.normal(0, 0.03, (400, 2))
    error = np.full((400, 2), 0.001)
    # What is known of three in four says nothing of the field.
    rate[100:], error[100:] = rng.normal(0, 2, (300, 2)), 2.0
    factors = np.tile(np.eye(2), (6, 1, 2))
    factors[:, :, 2:] *= YEARS[:, None, None]
    tile = SimpleNamespace(
        stars=SimpleNamespace(rate=rate), job=SimpleNamespace(
            factors=factors), equations=SimpleNamespace(
                motion_errors=lambda: error), _form_equations=lambda: None)
    ManyTile.learn_motions(tile)
    assert_allclose(tile.usual[0], (0.04, -0.02), atol=0.01)
    assert_allclose(tile.usual[1], 2 * 0.03, rtol=0.25)
    tile.stars.rate, tile.usual = 100 * rate, None
    ManyTile.learn_motions(tile)
    assert_allclose(tile.usual[1], FARTHEST / 2.5)
    few = SimpleNamespace(**vars(tile) | {
        'usual': None, 'stars': SimpleNamespace(rate=rate[:40])})
    ManyTile.learn_motions(few)
    assert few.usual is None


def test_stars_without_a_solution_are_taken_with_the_nearest_only():
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 8))
    free = root @ root.T
    # The third star cannot be told from the second.
    free[4:], free[:, 4:] = free[2:4], free[:, 2:4]
    together = kernels.Together(np.arange(3)[None], np.array([3]),
                                free[None].copy())
    kernels.invert_places(together)
    expected = np.zeros((6, 6))
    expected[:2, :2] = np.linalg.inv(free[:2, :2])
    assert_allclose(together.free[0], expected)
