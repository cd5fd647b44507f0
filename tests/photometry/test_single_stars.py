"""Single stars: what a fit says of its last point is true of that point."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.photometry import engine

SIZE = 150


def mixture(u):
    return GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [0.1 * u, 0.05]],
        [[0.9 + 0.1 * u, 1], [2 - 0.3 * u, 2.2]], [0.1, -0.1 * u])


@pytest.fixture(scope='module')
def psf():
    return GriddedMixturePSF([mixture(u) for u in (0, 0.5, 0.7, 1)],
                             [(x, y) for y in (0, SIZE) for x in (0, SIZE)])


@pytest.fixture(scope='module')
def scene(psf):
    """Return image, errors, mask and stars among neighbours, on edges too."""
    rng = np.random.default_rng(3)
    x, y = (a.ravel() + rng.uniform(-1, 1, a.size)
            for a in np.meshgrid(*[np.arange(1, SIZE, 12.0)] * 2))
    flux = 10 ** rng.uniform(2, 6, x.size)
    image = np.zeros((SIZE, SIZE))
    for shift, factor in ((0, 1), (5, 10 ** rng.uniform(-2, 4, x.size))):
        for a, b, f in zip(x + shift, y + shift / 2, flux * factor,
                           strict=True):
            image += psf.mixture_at(a, b).render(image.shape, a, b, flux=f)
    error = np.sqrt(image + 100)
    image += error * rng.standard_normal(image.shape)
    mask = (rng.random(image.shape) < 0.05) | (image > 3e5)
    start = np.column_stack([flux, x + rng.uniform(-1, 1, x.size),
                             y + rng.uniform(-1, 1, x.size)])
    return image, error, mask, start


def groups(start, shape, fixed):
    n = len(start)
    endless = np.full((n, 3), np.inf)
    return engine.StarGroups(
        start, engine.cut_boxes(start[:, 1], start[:, 2], shape,
                                (SIZE, SIZE)), np.zeros(n),
        np.arange(n + 1), -endless, endless, np.full(3, fixed))


@pytest.mark.parametrize('gain', [None, 1.5])
@pytest.mark.parametrize('shape', [(11, 11), (5, 7), (19, 13)])
def test_residuals_are_those_of_the_values(psf, scene, shape, gain):
    image, error, mask, start = scene
    pixels = engine.kernel_image(image, error, mask, gain)
    arrays = engine.psf_arrays(psf)
    stars = groups(start, shape, False)
    fits = engine.fit_stars(pixels, arrays, stars)
    good = fits.outcome[:, 0] == 3
    assert good.mean() > 0.7
    # The same boxes, evaluated where the fits ended.
    there = engine.fit_stars(pixels, arrays, engine.StarGroups(
        fits.values, stars.boxes, stars.sky, stars.starts, stars.lower,
        stars.upper, np.full(3, True)), max_iterations=0)
    assert_allclose(fits.sums[good, 2], there.sums[good, 2], rtol=1e-6)
    assert_allclose(fits.sums[good, 0], there.sums[good, 0], rtol=1e-6)


def test_a_second_fit_stays_where_the_first_ended(psf, scene):
    image, error, mask, start = scene
    pixels = engine.kernel_image(image, error, mask)
    arrays = engine.psf_arrays(psf)
    stars = groups(start, (11, 11), False)
    fits = engine.fit_stars(pixels, arrays, stars)
    again = engine.fit_stars(pixels, arrays, engine.StarGroups(
        fits.values, stars.boxes, stars.sky, stars.starts, stars.lower,
        stars.upper, stars.fixed))
    good = (fits.outcome[:, 0] == 3) & (again.outcome[:, 0] == 3)
    error = np.sqrt(np.diagonal(fits.covariances, axis1=1, axis2=2))
    apart = np.abs(again.values - fits.values)
    assert good.mean() > 0.7
    assert (apart[good, 1:] < 1e-5).all()
    assert (apart[good, 0] < 1e-5 * (fits.values + error)[good, 0]).all()
    # Errors are those at most a last step away.
    assert_allclose(again.covariances[good], fits.covariances[good],
                    rtol=1e-3, atol=1e-6 * error[good].max() ** 2)


def test_the_order_of_gaussians_does_not_matter(psf, scene):
    # The first steps merge Gaussians of one number, which may be far from
    # each other, or of opposite signs.
    image, error, mask, start = scene
    pixels = engine.kernel_image(image, error, mask)
    stars = groups(start, (11, 11), False)
    rows, strides, *others = engine.psf_arrays(psf)
    fits = engine.fit_stars(pixels, (rows, strides, *others), stars)
    mixed, strides = rows.copy(), strides.copy()
    for node in (1, 2):
        mixed[node], strides[node] = rows[node, ::-1], strides[node, ::-1]
    # Two Gaussians more, whose light adds up to nothing.
    pair = np.repeat(rows[:, :1], 2, axis=1)
    pair[:, 1, 0] *= -1
    pair[:2, :, 0] *= -1
    more = np.concatenate([mixed, pair], axis=1)
    falls = np.concatenate([strides, np.repeat(strides[:, :1], 2, axis=1)],
                           axis=1)
    falls[:, -2:] = np.exp(-more[:, -2:, 3])
    good = fits.outcome[:, 0] == 3
    for other in ((mixed, strides, *others), (more, falls, *others)):
        again = engine.fit_stars(pixels, other, stars)
        same = good & (again.outcome[:, 0] == 3)
        assert same.sum() > 0.99 * good.sum()
        apart = np.abs(again.values - fits.values)[same]
        # Blended stars may have two minima.
        assert np.mean(apart[:, 1:].max(axis=1) < 1e-5) > 0.98
        assert np.mean(apart[:, 0] < 1e-5 * np.abs(fits.values[same, 0])
                       ) > 0.98
