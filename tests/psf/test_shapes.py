"""Adaptive moments: exact cases, an independent program, bad images."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, ShapeStatus, adaptive_moments

MIX = GaussianMixture.from_stddevs(
    [0.6, 0.3, 0.1], [[0.1, -0.05], [-0.3, 0.2], [0.4, 0.5]],
    [[1.2, 1.4], [2.0, 1.7], [3.8, 3.3]], [0.2, -0.3, 0.1])


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.floats(1, 4), st.floats(1, 4), st.floats(-0.6, 0.6),
       st.floats(-3, 3), st.floats(-3, 3))
def test_a_gaussian_has_its_own_moments(sx, sy, rho, x, y):
    psf = GaussianMixture.from_stddevs([1], [[x, y]], [[sx, sy]], [rho])
    for got, rtol in ((adaptive_moments(psf), 1e-9),
                      (adaptive_moments(psf.render((61, 61), 30, 30)), 0.02)):
        r2 = sx**2 + sy**2
        assert_allclose([got.r2, got.flux], [r2, 1], rtol=rtol)
        assert_allclose([got.e1, got.e2],
                        [(sx**2 - sy**2) / r2, 2 * rho * sx * sy / r2],
                        atol=rtol)
        assert_allclose([got.x, got.y], [x, y], atol=rtol)


def test_a_mixture_has_the_moments_of_its_fine_image():
    axis = (np.arange(481) - 240) / 16
    image = MIX.evaluate(*np.meshgrid(axis, axis))
    exact, pixels = adaptive_moments(MIX), adaptive_moments(
        image, oversampling=16)
    assert_allclose(exact.r2, pixels.r2, rtol=1e-6)
    assert_allclose([exact.e1, exact.e2, exact.x, exact.y, exact.flux],
                    [pixels.e1, pixels.e2, pixels.x, pixels.y, pixels.flux],
                    atol=1e-6)


def test_moments_satisfy_their_definition():
    image = MIX.render((41, 41), 20.3, 19.8)
    got = adaptive_moments(image, origin=(0, 0))
    y, x = np.indices(image.shape)
    u, v = x - got.x, y - got.y
    m = 0.5 * got.r2 * np.array([[1 + got.e1, got.e2],
                                 [got.e2, 1 - got.e1]])
    p = np.linalg.inv(m)
    light = image * np.exp(-0.5 * (p[0, 0] * u**2 + 2 * p[0, 1] * u * v
                                   + p[1, 1] * v**2))
    light /= light.sum()
    assert_allclose([(light * u).sum(), (light * v).sum()], 0, atol=1e-6)
    second = [[(light * u * u).sum(), (light * u * v).sum()],
              [(light * u * v).sum(), (light * v * v).sum()]]
    assert_allclose(second, m / 2, rtol=1e-6, atol=1e-6)


def test_galsim_finds_the_same_moments(rng):
    galsim = pytest.importorskip('galsim')
    images = [GaussianMixture.from_stddevs(
        w, rng.normal(0, 0.3, (3, 2)), rng.uniform(0.9, 3.5, (3, 2)),
        rng.uniform(-0.4, 0.4, 3)).render((31, 33), 16, 15)
        for w in rng.dirichlet([3, 3, 3], 40)]
    images = np.array(images) + 1e-4 * rng.standard_normal((40, 31, 33))
    ours = adaptive_moments(images, origin=(-1, -1))
    for i, image in enumerate(images):
        theirs = galsim.hsm.FindAdaptiveMom(galsim.Image(image, scale=1.0))
        e = theirs.observed_shape
        r2 = 2 * theirs.moments_sigma**2 / np.sqrt(1 - e.e**2)
        assert_allclose(ours.r2[i], r2, rtol=1e-5)
        assert_allclose([ours.e1[i], ours.e2[i]], [e.e1, e.e2], atol=1e-5)
        centroid = theirs.moments_centroid
        assert_allclose([ours.x[i], ours.y[i]], [centroid.x, centroid.y],
                        atol=1e-5)


def test_oversampling_turns_into_native_pixels():
    image = MIX.affine([[3, 0], [0, 2]]).render((81, 91), 45.6, 41.0)
    got = adaptive_moments(image, oversampling=(2, 3))
    want = adaptive_moments(MIX)
    assert_allclose([got.r2, got.e1, got.e2], [want.r2, want.e1, want.e2],
                    atol=1e-4)
    assert_allclose([got.x, got.y], [want.x + 0.2, want.y + 0.5], atol=1e-4)
    assert_allclose(got.flux, want.flux / 6, rtol=1e-4)


def test_masked_pixels_are_filled_in():
    psf = GaussianMixture.from_stddevs([1], [[0, 0]], [[2, 1.6]], [0.3])
    image = psf.render((31, 31), 15, 15, flux=5)
    mask = np.zeros(image.shape, bool)
    mask[14:17, 16], mask[:, 12] = True, True
    spoiled = np.where(mask, np.nan, image)
    got, want = adaptive_moments(spoiled, mask=mask), adaptive_moments(image)
    assert_allclose([got.r2, got.e1, got.e2, got.flux],
                    [want.r2, want.e1, want.e2, want.flux], rtol=1e-4)


def test_errors_are_the_scatter_of_noisy_images(rng):
    psf = GaussianMixture.from_stddevs([1], [[0, 0]], [[2, 1.6]], [0.3])
    clean = psf.render((31, 31), 15, 15, flux=100)
    noisy = clean + 0.02 * rng.standard_normal((500, 31, 31))
    got = adaptive_moments(noisy, error=0.02)
    for name in ('r2', 'e1', 'e2', 'x', 'y'):
        scatter = np.std(getattr(got, name))
        assert_allclose(np.median(getattr(got, f'{name}_err')), scatter,
                        rtol=0.1)


def test_a_stack_gives_what_each_image_gives():
    stack = np.array([MIX.render((31, 31), 15 + d, 15) for d in (0, 0.2)])
    with ThreadPoolExecutor(2) as pool:
        several = adaptive_moments(stack, executor=pool)
    for i, image in enumerate(stack):
        assert several.r2[i] == adaptive_moments(image).r2
    mixtures = adaptive_moments([MIX, GaussianMixture(
        [1], [[0, 0]], [[[2, 0], [0, 2]]])])
    assert_allclose(mixtures.r2, [adaptive_moments(MIX).r2, 4])


def test_hopeless_images_end_with_a_status_in_words():
    good = MIX.render((21, 21), 10, 10)
    bad = np.array([good, np.zeros_like(good), -good,
                    np.where(good == good.max(), np.nan, good)])
    got = adaptive_moments(bad)
    assert got.status[0] == ShapeStatus.CONVERGED
    assert (got.status[1:] != 0).all()
    assert np.isnan(got.r2[1:]).all()
    assert got.status[3] == ShapeStatus.NOT_FINITE
    assert 'mask them' in got.message[3]


def test_noise_alone_ends(rng):
    got = adaptive_moments(rng.standard_normal((50, 15, 15)))
    assert np.isfinite(got.r2[got.status == 0]).all()


@pytest.mark.parametrize(('arguments', 'error', 'words'), [
    ({'image': np.ones(4)}, ValueError, 'image must have shape'),
    ({'image': 'psf'}, TypeError, 'image must be an array of numbers'),
    ({'image': np.ones((4, 4)), 'error': 0}, ValueError,
     'error must be positive'),
    ({'image': np.ones((4, 4)), 'oversampling': 0}, ValueError,
     'oversampling must be at least 1'),
])
def test_bad_arguments_are_named(arguments, error, words):
    with pytest.raises(error, match=words):
        adaptive_moments(**arguments)


def test_a_real_psf_has_the_size_galsim_measures(realdata):
    galsim = pytest.importorskip('galsim')
    image = fits.getdata(realdata('csst_psf') / 'csst_psf_9999.fits')
    image = image.astype(float)
    theirs = galsim.hsm.FindAdaptiveMom(galsim.Image(image, scale=1.0))
    r2 = 2 * theirs.moments_sigma**2 / np.sqrt(1 - theirs.observed_shape.e**2)
    assert_allclose(adaptive_moments(image).r2, r2, rtol=1e-5)
