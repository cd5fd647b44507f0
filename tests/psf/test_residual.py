"""What a PSF leaves of bright stars, measured on the image."""
import numpy as np
import pytest

from photutils_mgauss.psf.residual import PSFResidual

HALF, SIZE = 9, 400


def left_over(dx, dy, u):
    """Return what a PSF leaves of a star: a ghost that grows with u."""
    return ((3e-4 + 1e-4 * u) * np.exp(-0.5 * ((dx - 5)**2 + dy**2) / 1.2**2)
            - 2e-4 * np.exp(-0.5 * (dx**2 + (dy + 4)**2) / 1.5**2))


def scene(n, seed, amplitude=1.0):
    """Return a residual image, its variances and stars (3, n)."""
    rng = np.random.default_rng(seed)
    stars = np.stack([*rng.uniform(12, SIZE - 13, (2, n)),
                      rng.uniform(1e5, 5e5, n)])
    y, x = np.indices((SIZE, SIZE))
    image = np.zeros((SIZE, SIZE))
    for a, b, flux in stars.T:
        part = (slice(int(b) - 11, int(b) + 12),
                slice(int(a) - 11, int(a) + 12))
        image[part] += amplitude * flux * left_over(
            x[part] - a, y[part] - b, 2 * a / SIZE - 1)
    variance = np.full(image.shape, 9.0)
    return rng.normal(image, 3.0), variance, stars


@pytest.mark.parametrize('place', [(60.3, 200.8), (350.0, 100.5)])
def test_it_is_what_is_left(place):
    found = PSFResidual.of(*scene(250, 1), HALF)
    image, _ = found.stamp(*place, HALF)
    x, y = place
    dy, dx = (np.indices(image.shape) - HALF)
    true = left_over(dx - (x - np.rint(x)), dy - (y - np.rint(y)),
                     2 * x / SIZE - 1)
    assert np.sqrt(np.mean((image - true)**2)) < 0.05 * np.abs(true).max()
    assert np.abs(image - true).max() < 0.2 * np.abs(true).max()


def test_nothing_is_nothing():
    found = PSFResidual.of(*scene(250, 2, amplitude=0), HALF)
    image, spread = found.stamp(100.2, 200.4, HALF)
    assert np.mean(image == 0) > 0.9
    assert np.mean(spread == 0) > 0.9


def test_few_stars_tell_nothing():
    assert PSFResidual.of(*scene(4, 3), HALF) is None


def test_it_is_taken_off_stars_at_the_edge_too():
    found = PSFResidual.of(*scene(250, 1), HALF)
    data, variance = np.zeros((2, SIZE, SIZE))
    found.take_off(data, variance, np.array([[1.2], [200.3], [1e5]]), HALF)
    image, spread = found.stamp(1.2, 200.3, HALF)
    np.testing.assert_allclose(data[191:210, :11], -1e5 * image[:, 8:])
    np.testing.assert_allclose(variance[191:210, :11],
                               (1e5 * spread[:, 8:])**2)
    assert not data[:, 11:].any()


def test_other_light_in_some_pixels_does_no_harm():
    image, variance, stars = scene(250, 1)
    rng = np.random.default_rng(5)
    for x, y in zip(*rng.integers(5, SIZE - 6, (2, 150)), strict=True):
        image[y - 1:y + 2, x - 1:x + 2] += 3000
    clean = PSFResidual.of(*scene(250, 1), HALF).stamp(200.0, 200.0, HALF)[0]
    spoiled = PSFResidual.of(image, variance, stars, HALF).stamp(
        200.0, 200.0, HALF)[0]
    assert np.sqrt(np.mean((spoiled - clean)**2)) < (
        0.1 * np.abs(clean).max())


@pytest.mark.parametrize('same', [False, True])
def test_a_level_of_the_sky_is_not_taken_for_wings(same):
    image, variance, stars = scene(250, 1, amplitude=0)
    rng = np.random.default_rng(7)
    # Of stars of one flux it cannot be told, and nothing is made up.
    stars[2] = 1e5 if same else 10**rng.uniform(4, 5.5, 250)
    level = 0.0 if same else 2.0
    found = PSFResidual.of(image + level, variance, stars, HALF)
    assert found.sky == pytest.approx(level, abs=0.05)
    assert np.abs(found.stamp(200.0, 200.0, HALF)[0]).mean() < 2e-6


def test_it_fades_beyond_the_radius():
    found = PSFResidual.of(*scene(250, 1), HALF)
    seen = found.image([200.2], [200.4], [1e5])
    y, x = np.indices(seen.shape)
    away = np.hypot(x - 200.2, y - 200.4)
    assert not seen[away > 1.3 * HALF].any()
    inside = found.stamp(200.2, 200.4, HALF)[0]
    np.testing.assert_allclose(seen[191:210, 191:210], 1e5 * inside)


def test_what_does_not_stand_out_of_noise_may_still_be_there():
    y, x = np.indices((41, 41)) - 20
    ring = np.hypot(x, y).astype(int).ravel()
    true = np.bincount(ring, left_over(x, y, 0).ravel()**2) / np.bincount(ring)
    unseen = []
    for amplitude in (0, 0.02):
        found = [PSFResidual.of(*scene(40, seed, amplitude), HALF)
                 for seed in range(4)]
        # Hardly any of it is seen.
        assert np.mean([np.mean(one.spread == 0) for one in found]) > 0.8
        unseen.append(np.mean([one.unseen[2:8]**2 + one.spread[2:8]**2
                               for one in found]))
    assert unseen[0] < unseen[1] / 2
    assert unseen[1] == pytest.approx(0.02**2 * true[2:8].mean(), rel=0.3)
    assert found[0].cautious().spread[9] == pytest.approx(
        np.hypot(found[0].spread[9], found[0].unseen[9]))
