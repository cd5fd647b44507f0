"""What noise that is correlated does to a field."""
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose
from scipy.ndimage import convolve

from photutils_mgauss import (
    GaussianMixture,
    MixturePSFPhotometry,
    fit_mixture_field,
)
from photutils_mgauss.field.forms import FreeShapes
from photutils_mgauss.field.noise import noise_covariance
from photutils_mgauss.field.normal import (
    FieldProblem,
    Prior,
    Workers,
    equations,
    model_stamps,
    to_coefficients,
    to_vector,
)
from photutils_mgauss.field.stages import FieldFit
from photutils_mgauss.field.stamps import Stamps
from photutils_mgauss.utils.correlated_noise import NoiseCorrelation

KERNEL = np.full((2, 2), 0.25)
# That of pixels which are means of 2 x 2 others.
NEAR = np.outer([0.5, 1, 0.5], [0.5, 1, 0.5])
PSF = GaussianMixture([0.7, 0.3], np.zeros((2, 2)),
                      [[[1.2, 0.2], [0.2, 1.0]], [[4, 0], [0, 4.5]]])


def two_stars():
    """Return a fit of two stars to their own model, and its growth."""
    shapes = np.zeros((1, 2, 6))
    shapes[0, :, 3::2] = [[-0.1, 0.1], [-0.7, -0.6]]
    shapes[0, 1, :3] = [-0.8, 0.2, -0.1]
    sources = np.array([[[5.1, 4.8, 3000]], [[4.7, 5.3, 2000.0]]])
    flat = np.ones((2, 11, 11))
    problem = FieldProblem(
        Stamps(0 * flat, 20 * flat, flat > 0, np.zeros((2, 2)),
               np.full((2, 1, 1), 0.5)), flat, np.ones((2, 1)), sources,
        sources.copy(), np.zeros(sources.shape), np.ones(2, int),
        np.zeros(2), True, np.ones(2, bool), np.zeros(2, int), FreeShapes(),
        np.zeros((2, 3)))
    model = model_stamps(problem, shapes)
    problem.stamps.data = model
    problem.weights = 1 / (20 + 0.5 * model)
    with Workers() as workers:
        found = equations(problem, shapes, workers)
    return FieldFit(problem, shapes, Prior.about(shapes[0], 1, 1.0), found,
                    0.0, flat < 0)


def all_slopes(fit):
    """Return derivatives of all pixels by shapes and the stars' numbers."""
    def pixels(shapes, sources, sky):
        changed = replace(fit.problem, sources=sources, sky=sky)
        return model_stamps(changed, fit.coefficients + to_coefficients(
            shapes, fit.coefficients)).ravel()

    numbers = [np.zeros(9), fit.problem.sources, np.zeros(2)]
    sizes = [number.size for number in numbers]
    start = np.concatenate([number.ravel() for number in numbers])

    def at(vector):
        parts = np.split(vector, np.cumsum(sizes)[:-1])
        return pixels(*(part.reshape(number.shape) for part, number
                        in zip(parts, numbers, strict=True)))
    steps = 1e-5 * np.diag(np.maximum(np.abs(start), 1))
    return np.array([(at(start + step) - at(start - step)) / (2 * step.max())
                     for step in steps]).T


def test_the_covariance_is_that_of_any_least_squares_fit():
    fit = two_stars()
    slopes, weights = all_slopes(fit), fit.problem.weights.ravel()
    prior = np.zeros(slopes.shape[1])
    prior[:9] = to_vector(fit.prior.precision)
    y, x = np.mgrid[:11, :11].reshape(2, -1)
    near = [np.maximum(1 - np.abs(one[:, None] - one) / 2, 0)
            * (np.abs(one[:, None] - one) < 2) for one in (x, y)]
    matrix = np.kron(np.eye(2), near[0] * near[1])
    # Their variances have been doubled.
    root = weights**-0.5 / np.sqrt(2)
    inverse = np.linalg.inv(slopes.T @ (weights[:, None] * slopes)
                            + np.diag(prior))
    gradient = slopes.T * weights * root
    expected = inverse @ (gradient @ matrix @ gradient.T + np.diag(prior)
                          ) @ inverse
    found = noise_covariance(
        fit, [NoiseCorrelation(np.pad(NEAR, 4), 1.0)], [2.0])
    assert_allclose(found, expected[:9, :9], rtol=1e-4,
                    atol=1e-6 * np.abs(expected[:9, :9]).max())


@pytest.mark.parametrize('growth', [1.0, 2.0])
def test_independent_pixels_have_the_covariance_of_their_equations(growth):
    fit = two_stars()
    matrix = fit.equations.matrix
    prior = np.diag(to_vector(fit.prior.precision))
    inverse = np.linalg.inv(matrix + prior)
    assert_allclose(noise_covariance(fit, growth=[growth]),
                    inverse @ (matrix / growth + prior) @ inverse, rtol=1e-6)


def resampled(seed):
    """Return data, clean data, error and stars of a resampled image."""
    rng = np.random.default_rng(3)
    grid = np.mgrid[15:190:35, 15:190:35].reshape(2, -1)
    x, y = grid + rng.uniform(-2, 2, grid.shape)
    clean = sum(PSF.render((205, 205), *place, flux=3e4)
                for place in zip(x, y, strict=True))
    noise = np.random.default_rng(seed).normal(0, np.sqrt(clean + 60))
    error = np.sqrt(convolve(clean + 60, KERNEL**2))
    clean = convolve(clean, KERNEL)
    return (clean + convolve(noise, KERNEL), clean, error,
            Table({'x': x + 0.5, 'y': y + 0.5, 'flux': np.full(x.size, 3e4)}))


@pytest.mark.long
def test_fluxes_know_what_smooth_noise_does_to_the_wings_of_a_psf():
    squares = []
    for seed in range(24):
        data, clean, error, stars = resampled(seed)
        with pytest.warns(AstropyUserWarning, match='pixels is correlated'):
            field = fit_mixture_field(
                data, stars[:6], error=error, degree=0, n_components=2,
                radius=7, normalise='stamps')
        # Without noise of their own, stars show that of the PSF alone.
        table = MixturePSFPhotometry(field, 11)(clean, error=error,
                                                init_params=stars[6:])
        off = (table['flux_fit'] - 3e4) / table['flux_psf_err']
        squares.append(np.mean(off**2))
    assert 0.75 < np.sqrt(np.mean(squares)) < 1.25
