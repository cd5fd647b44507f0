"""A PSF that is known already, tuned to the stars of an image."""
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    assess_psf,
    fit_mixture_field,
)
from photutils_mgauss.field.forms import TunedShapes, convolved
from photutils_mgauss.psf.rows import covariances_of_logs, log_rows

SHAPE = (300, 260)


def archive_at(x, y):
    u, v = x / 130 - 1, y / 150 - 1
    return GaussianMixture.from_stddevs(
        [0.6, 0.3, 0.1], [[0, 0], [0.2 * u, 0.1 * v], [0.3, -0.2]],
        [[1.0 + 0.1 * u, 1.1 - 0.05 * v], [1.8, 1.7 + 0.1 * u * v], [4, 4.2]],
        [0.1 * v, 0.1 * u, 0])


@pytest.fixture(scope='module')
def archive():
    places = [(x, y) for y in np.linspace(0, 299, 5)
              for x in np.linspace(0, 259, 5)]
    return GriddedMixturePSF([archive_at(*one) for one in places], places)


def drift(x, y):
    """Return what the focus adds to all covariances, linear in position."""
    u, v = x / 130 - 1, y / 150 - 1
    return np.array([[0.35 + 0.1 * u, 0.05], [0.05, 0.2 + 0.06 * v]])


def truth(archive):
    def at(x, y):
        return archive.mixture_at(x, y).convolve(drift(x, y))
    return at


def exposure(psf, n, seed, sky=30):
    rng = np.random.default_rng(seed)
    stars = Table({'x': rng.uniform(12, 247, n), 'y': rng.uniform(12, 287, n),
                   'flux': rng.uniform(1e4, 6e4, n)})
    clean = sum(psf(x, y).render(SHAPE, x, y, flux=flux)
                for x, y, flux in stars.iterrows())
    return (rng.poisson(clean + sky) - float(sky), stars,
            np.sqrt(clean + sky))


@pytest.fixture(scope='module')
def fifteen(archive):
    return exposure(truth(archive), 15, 4)


@pytest.fixture(scope='module')
def tuned(archive, fifteen):
    data, stars, error = fifteen
    return fit_mixture_field(data, stars, error=error, start=archive,
                             radius=8)


def test_the_drift_of_the_focus_is_recovered(tuned):
    for x, y in [(40, 50), (130, 150), (220, 250)]:
        found = tuned.convolution_at(x, y)
        assert_allclose(found, drift(x, y), atol=0.05)


def test_tuning_beats_the_archive_and_a_field_from_scratch(archive, fifteen,
                                                           tuned):
    data, stars, error = fifteen
    scratch = fit_mixture_field(data, stars, error=error, n_components=3,
                                degree=1, radius=8)
    grid = (4, 4)
    mine, old, new = (
        assess_psf(psf, truth(archive), grid, shape=SHAPE)
        for psf in (tuned, archive, scratch))
    for name in ('size_error', 'ellipticity_error'):
        rms = [np.sqrt(np.mean(one.table[name]**2)) for one in
               (mine, old, new)]
        assert rms[0] < 0.2 * rms[1]
        assert rms[0] < 0.7 * rms[2]


def test_a_sharper_focus_is_recovered_too(archive):
    def now(x, y):
        return archive.mixture_at(x, y).deconvolve([[0.25, 0], [0, 0.3]])
    data, stars, error = exposure(now, 15, 5)
    tuned = fit_mixture_field(data, stars, error=error, start=archive,
                              radius=8, degree=0)
    assert_allclose(tuned.convolution_at(99, 99),
                    [[-0.25, 0], [0, -0.3]], atol=0.03)


def test_an_unchanged_psf_stays_unchanged(archive):
    data, stars, error = exposure(archive.mixture_at, 15, 6)
    tuned = fit_mixture_field(data, stars, error=error, start=archive,
                              radius=8)
    errors = np.sqrt(np.diag(tuned.covariance)).reshape(6, -1).T
    assert np.abs(tuned.coefficients / errors).max() < 4
    assert_allclose(tuned.stars['x_fit'], stars['x'], atol=0.04)
    assert_allclose(tuned.stars['flux_fit'] / stars['flux'], 1, atol=0.05)


def test_the_centroid_stays_that_of_the_archive(archive):
    data, stars, error = exposure(archive.mixture_at, 15, 6)
    tuned = fit_mixture_field(data, stars, error=error, start=archive,
                              radius=8, centre='flux')
    for x, y in [(20, 30), (130, 140), (250, 290)]:
        assert_allclose(tuned.mixture_at(x, y).moments().mean,
                        archive.mixture_at(x, y).moments().mean, atol=1e-12)


def test_its_grid_has_the_nodes_of_the_archive_unless_told(archive, tuned):
    grid = tuned.to_grid()
    assert_allclose(grid.grid_xypos, archive.grid_xypos)
    node = grid.mixture_at(259, 0)
    assert_allclose(node.evaluate(1, 2), tuned.mixture_at(259, 0).evaluate(
        1, 2))
    assert tuned.to_grid((2, 3)).grid_shape == (2, 3)


@pytest.mark.long
def test_errors_of_the_changes_are_their_scatter(archive):
    added = np.array([[0.3, 0.05], [0.05, 0.2]])
    pulls = []
    for seed in range(16):
        data, stars, error = exposure(
            lambda x, y: archive.mixture_at(x, y).convolve(added), 15,
            100 + seed)
        tuned = fit_mixture_field(data, stars, error=error, start=archive,
                                  radius=8, degree=0)
        pulls.append((tuned.coefficients[0] - [0.3, 0.05, 0.2, 0, 0, 0])
                     / np.sqrt(np.diag(tuned.covariance)))
    # 96 numbers: 0.07 for their scatter if they were independent.
    assert 0.75 < np.std(pulls) < 1.25
    assert np.abs(np.mean(pulls, axis=0)).max() < 1


def test_start_may_be_a_mixture_field(tuned, fifteen):
    data, stars, error = fifteen
    again = fit_mixture_field(data, stars, error=error, start=tuned,
                              radius=8, degree=0)
    assert np.abs(again.convolution_at(130, 150)).max() < 0.02


def test_signed_mixtures_can_be_tuned():
    ring = GaussianMixture([1.4, -0.4], np.zeros((2, 2)),
                           [3 * np.eye(2), 1.5 * np.eye(2)])
    archive = GriddedMixturePSF([ring], [(130, 150)])
    now = ring.convolve(0.4 * np.eye(2))
    data, stars, error = exposure(lambda x, y: now, 20, 8)
    tuned = fit_mixture_field(data, stars, error=error, start=archive,
                              radius=8, degree=0)
    steps = np.arange(-5, 6)
    assert_allclose(tuned.mixture_at(50, 50).evaluate(steps, steps[:, None]),
                    now.evaluate(steps, steps[:, None]), atol=1e-3)


def test_a_start_without_mixtures_is_an_error(fifteen):
    data, stars, error = fifteen
    with pytest.raises(TypeError, match='start must have a method mixture_at'):
        fit_mixture_field(data, stars, error=error, start=3)


def test_a_small_convolution_is_exact_and_a_large_negative_one_is_valid():
    mixture = archive_at(30, 200)
    shapes = log_rows(mixture.weights, mixture.means,
                      mixture.covariances)[None]
    blur = np.array([[0.4, 0.1, 0.7]])
    expected = mixture.covariances + np.array([[0.4, 0.1], [0.1, 0.7]])
    assert_allclose(covariances_of_logs(convolved(shapes, blur))[0], expected,
                    rtol=1e-12)
    sharp = covariances_of_logs(convolved(shapes, -20 * blur))
    assert np.all(np.linalg.eigvalsh(sharp) >= 0)


def test_jacobians_are_the_slopes_of_the_shapes_relative_to_the_first():
    mixture = archive_at(30, 200)
    shapes = log_rows(mixture.weights, mixture.means, mixture.covariances)
    sign = np.sign(mixture.weights)
    local = TunedShapes.local(shapes[None], sign)
    numbers = np.array([[0.2, 0.1, -0.1, 0.05, 0.1, 0.02]])
    basis = np.ones((1, 1))
    jacobian = TunedShapes().jacobians(numbers, basis, local)
    for i in range(6):
        change = np.zeros((1, 6))
        change[0, i] = 1e-4
        up, down = (TunedShapes().shapes(numbers + sign * change, basis,
                                         local)[0][0] for sign in (1, -1))
        slope = (up - down) / 2e-4
        slope[:, :3] -= slope[0, :3]
        assert_allclose(jacobian[0, :, i], slope.ravel()[3:], atol=1e-6)
