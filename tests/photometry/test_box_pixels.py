"""A fit of many images takes out the boxes of its stars, and nothing else."""
import tracemalloc
import warnings

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.moving_stars import make_wcs, observe, truth
from helpers.star_images import MIXTURE, PSF
from photutils_mgauss import ImageEpoch, PixelMotionFitter
from photutils_mgauss.photometry.box_pixels import ScaledImage
from photutils_mgauss.photometry.engine import cut_boxes, psf_arrays
from photutils_mgauss.photometry.joint_pixels import JointFit, boxes_around
from photutils_mgauss.pixel_motions.campaign import read_campaign
from photutils_mgauss.pixel_motions.stars import read_stars
from photutils_mgauss.utils.image import PixelData

YEARS = 2024.5, 2028.0
PLAIN = psf_arrays(PSF)


def as_kept(data, way):
    """Return an image as users may hold it."""
    if way == 'fortran':
        return np.asfortranarray(data)
    return data.astype(way)


def literal(image, box, seen):
    """Return data and weights of a box, column after column, one by one."""
    data, weights = [], []
    row, column, height, width = box
    for x in range(column, column + width):
        for y in range(row, row + height):
            value = image.pixels.data[y, x] / image.unit
            good = np.isfinite(value) and not (
                image.pixels.mask is not None and image.pixels.mask[y, x])
            error = (image.unit if image.pixels.error is None
                     else image.pixels.error[y, x])
            if image.light is not None:
                value -= image.light[y, x]
            data.append(value if good else 0.0)
            weights.append((image.unit / error)**2 if good and (
                y, x) not in seen else 0.0)
            seen.add((y, x))
    return data, weights


@pytest.mark.parametrize('parts', ['data', 'error', 'mask', 'light', 'all'])
def test_boxes_have_the_pixels_of_their_image(parts, rng):
    data = rng.normal(100, 5, (40, 50))
    data[3, 4:6] = np.nan, np.inf
    every = parts == 'all'
    image = ScaledImage(
        PixelData(data, rng.uniform(1, 2, data.shape)
                  if every or parts == 'error' else None,
                  rng.random(data.shape) < 0.1
                  if every or parts == 'mask' else None), 3.0,
        rng.normal(size=data.shape) if every or parts == 'light' else None)
    # Pairs that share pixels, in the middle and at all edges, and one beyond.
    x = np.array([5, 8, 0, 3, 49, 47, 25, 25, 20, 90.0])
    y = np.array([4, 7, 20, 21, 1, 38, 39, 30, -2, 90.0])
    boxes = cut_boxes(x, y, (7, 9), data.shape).reshape(-1, 2, 4)
    got = image.groups(boxes, None, PLAIN)
    for g, group in enumerate(boxes):
        seen, squares, count = set(), 0, 0
        for c, box in enumerate(group):
            values, weights = literal(image, box, seen)
            n = len(values)
            assert_allclose(got.data[g, c, :n], values, rtol=1e-14)
            assert_allclose(got.weights[g, c, :n], weights, rtol=1e-14)
            squares += np.dot(weights, np.square(values))
            count += np.count_nonzero(weights)
        assert_allclose(got.squares[g], squares, rtol=1e-13)
        assert got.n_pixels[g] == count


def test_own_light_is_added_to_both_boxes_of_a_pair(rng):
    image = ScaledImage(PixelData(rng.normal(size=(30, 30)), None, None), 2.0)
    own = np.array([[[50.0, 12.3, 14.0], [0.0, 16, 15]]])
    boxes = cut_boxes(own[0, :, 1], own[0, :, 2], (7, 7), (30, 30))[None]
    plain, lit = (image.groups(boxes, stars, PLAIN) for stars in (None, own))
    light = MIXTURE.render((30, 30), 12.3, 14.0, flux=50)
    for c, (row, column, height, width) in enumerate(boxes[0]):
        stamp = light[row:row + height, column:column + width]
        assert_allclose((lit.data - plain.data)[0, c], stamp.T.ravel(),
                        atol=1e-10)


@pytest.mark.parametrize('error', [0, -1, np.nan, np.inf])
def test_pixels_with_an_error_that_is_none_are_not_used(error):
    data, errors = np.zeros((20, 20)), np.ones((20, 20))
    errors[10, 10] = error
    boxes = cut_boxes(np.array([10.0]), np.array([11.0]), (5, 5), (20, 20))
    for mask in (None, errors != 1):
        image = ScaledImage(PixelData(data, errors, mask), 1.0)
        assert image.groups(boxes[None], None, PLAIN).n_pixels[0] == 24
        whole = image.whole()
        assert np.isnan(whole.data[10, 10]) or whole.mask[10, 10]


def test_the_images_of_a_fit_are_those_of_the_user(rng):
    images = observe(truth([20, 40], [20, 40]), 900, YEARS, rng)
    campaign = read_campaign(images, flux='image', fit_sky=True,
                             parallax=False, acceleration=False)
    for given, taken in zip(images, campaign.joint.images, strict=True):
        assert np.shares_memory(given.data, taken.pixels.data)
        # One number for all of an image stays one.
        assert not any(taken.pixels.error.strides)


@pytest.mark.parametrize('way', ['f8', '>f4', 'fortran'])
def test_a_fit_needs_the_memory_of_its_stars_not_of_its_images(way, rng):
    size = 2000
    stars = truth([20, 700], [30, 700])
    data = as_kept(rng.normal(0, 3, (size, size)), way)
    images = [ImageEpoch(data, PSF, make_wcs(), year, error=np.full(
        data.shape, 3.0, 'f4')) for year in YEARS]
    fitter = PixelMotionFitter()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        fitter.fit(images, stars)
        tracemalloc.start()
        fitter.fit(images, stars)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < data.nbytes / 8


@pytest.mark.parametrize('way', ['f4', '>f4', '>f8', 'i4', 'fortran'])
def test_the_same_numbers_give_the_same_stars_however_they_are_kept(way, rng):
    stars = truth([20, 24, 40], [20, 22, 57], [(3, 0, -2), (-1, 0, 2)])
    images = observe(stars, 900, YEARS, rng)
    # Numbers that all kinds can hold.
    plain = [np.rint(image.data) for image in images]
    tables = [PixelMotionFitter().fit([
        ImageEpoch(data, PSF, image.wcs, image.year, error=3.0)
        for data, image in zip(kept, images, strict=True)], stars).stars
        for kept in (plain, [as_kept(data, way) for data in plain])]
    for name in ('ra', 'pmra', 'pmdec_error', 'flux', 'chi2'):
        assert_array_equal(*(table[name] for table in tables))


@pytest.mark.parametrize('fit_sky', [True, False])
@pytest.mark.parametrize('flux', ['image', 'common'])
def test_scores_are_those_of_the_whole_equations(fit_sky, flux, rng):
    stars = truth([20, 40, 57, -30], [20, 40, 3, 5])
    campaign = read_campaign(observe(stars, 200, YEARS, rng), flux=flux,
                             fit_sky=fit_sky, parallax=False,
                             acceleration=False)
    values = read_stars(stars, campaign).values[:, None]
    views = campaign.views(values)
    fit = JointFit(campaign.joint, views, boxes_around(
        views.pixels, (9, 11), campaign.shapes), np.ones((4, 1, 4), bool))
    rows = np.array([3, 2, 0])
    moved = values[rows] + rng.normal(0, 20, (3, 1, 4))
    state, shared = fit.evaluate(moved, rows), campaign.joint.shared
    each = state.weights[..., 0]
    light = state.excess[..., 0] + each * state.fluxes[:, shared, 0]
    got = fit.scores(moved, rows)
    for c in range(shared.max() + 1):
        for found, whole in zip(got, (light, each), strict=True):
            assert_allclose(found[:, c], whole[:, shared == c].sum(axis=1),
                            rtol=1e-10)
    # The last star is in none of the images.
    assert not got[1][0].any()
    assert (got[1][1:] > 0).all()
