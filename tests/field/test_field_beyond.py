"""Degrees that few stars do not tell."""
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from photutils_mgauss import (
    GaussianMixture,
    MixturePSFPhotometry,
    fit_mixture_field,
)
from photutils_mgauss.field.beyond import _Sizes, evidence
from photutils_mgauss.field.normal import Prior, to_vector
from photutils_mgauss.field.stages import polynomials, term_degrees

SIZE, FLUX = 160, 3e4


@pytest.fixture
def linear():
    """Return a fit of data that are linear in 3 x 2 coefficients."""
    rng = np.random.default_rng(3)
    design = rng.normal(size=(12, 6))
    data, coefficients = rng.normal(size=12), rng.normal(size=(3, 2))
    # By number, then term.
    vector = coefficients.T.ravel()
    return design, data, SimpleNamespace(
        coefficients=coefficients, equations=SimpleNamespace(
            matrix=design.T @ design,
            right=design.T @ (data - design @ vector)))


def test_priors_are_compared_by_how_likely_they_make_the_data(linear):
    design, data, fit = linear
    found, expected = [], []
    for size in (0.2, 1.0, 5.0):
        variance = np.array([[1.0, 2], [0.5, 0.7], [size, 2 * size]])
        found.append(evidence(fit, Prior(np.zeros((3, 2)), 1 / variance))[0])
        expected.append(multivariate_normal(cov=np.eye(12) + (
            design * variance.T.ravel()) @ design.T).logpdf(data))
    assert_allclose(np.diff(found), np.diff(expected), rtol=1e-10)


def test_derivatives_by_variances_are_those_of_the_likelihood(linear):
    fit = linear[2]
    logs = np.array([[0.0, 0.7], [-0.7, -0.4], [-1.6, 0.1]])
    mean = np.array([[0.5, -0.3], [0, 0], [0, 0]])

    def likelihood(logs):
        return evidence(fit, Prior(mean, np.exp(-logs)))
    steps = 1e-4 * np.eye(6).reshape(6, 3, 2)
    expected = [(likelihood(logs + step)[0] - likelihood(logs - step)[0])
                / 2e-4 for step in steps]
    assert_allclose(likelihood(logs)[1].ravel(), expected, rtol=1e-6)


@pytest.fixture
def sizes():
    """Return a fit of linear data, six terms of three Gaussians' numbers."""
    rng = np.random.default_rng(8)
    shape, n = (6, 3, 6), 6 * (3 * 6 - 3)
    design = rng.normal(size=(60, n))
    stddev = np.tile([0.3, 2.0, 0.2, 0.5, 0.5, 0.5], (6, 3, 1))
    stddev[3:] /= 2
    vector = to_vector(stddev * rng.normal(size=shape))
    data = design @ vector + rng.normal(size=60)
    fit = SimpleNamespace(
        coefficients=np.zeros(shape), equations=SimpleNamespace(
            matrix=design.T @ design, right=design.T @ data),
        prior=Prior(np.zeros(shape), np.ones(shape)))
    return _Sizes(fit, slice(3, 6), np.ones(3 * 6 - 3))


def test_variances_are_those_to_be_expected(sizes):
    rng = np.random.default_rng(5)
    found = sizes.expected()
    # The mean over sizes drawn about the most likely ones, each as often as
    # the stars make it likely.
    middle = minimize(sizes._cost, np.zeros(8), jac=True).x
    root = np.linalg.cholesky(1.5 * sizes._covariance(middle))
    normal = rng.normal(size=(1500, 8))
    drawn = middle + normal @ root.T
    logs = 0.5 * (normal**2).sum(axis=1) - [sizes._cost(x)[0] for x in drawn]
    share = np.exp(logs - logs.max())
    expected = np.average([1 / sizes.prior(x).precision for x in drawn],
                          weights=share, axis=0)
    fitted = np.s_[1:, 1:]
    assert_allclose(np.log(1 / found.precision[fitted]),
                    np.log(expected[fitted]), atol=0.25)
    most_likely = 1 / sizes.prior(middle).precision
    assert np.all(expected[fitted] > 1.05 * most_likely[fitted])


def test_means_along_either_axis_vary_by_amounts_of_their_own(sizes):
    along_x, along_y = 1 / sizes.expected().precision[1, 1, 1:3]
    assert along_x > 3 * along_y


def smooth_gaussian(rng):
    """Return a PSF that varies in all degrees, by half in each next one."""
    degrees = term_degrees(21)
    falls = np.where(degrees > 0, 0.05 * 0.5**(degrees - 1.0), 0)
    coefficients = falls[:, None] * rng.normal(size=(21, 3))

    def at(x, y):
        places = (np.array([value]) / SIZE * 2 - 1 for value in (x, y))
        wide, high, tilt = (polynomials(*places, 5) @ coefficients)[0]
        return GaussianMixture.from_stddevs(
            [1], [[0, 0]], 1.2 * np.exp([[wide, high]]), [tilt])
    return at


def scene(rng, n_psf):
    """Return clean data, error, stars of the PSF, and stars to measure."""
    psf = smooth_gaussian(rng)
    grid = np.mgrid[12:SIZE - 8:17, 12:SIZE - 8:17].reshape(2, -1)
    x, y = grid + rng.uniform(-2, 2, grid.shape)
    clean = sum(psf(*place).render((SIZE, SIZE), *place, flux=FLUX)
                for place in zip(x, y, strict=True))
    stars = Table({'x': x, 'y': y, 'flux': np.full(x.size, FLUX)})
    stars = stars[rng.permutation(x.size)]
    return clean, np.sqrt(clean + 50), stars[:n_psf], stars[n_psf:]


def test_errors_know_of_terms_that_few_stars_do_not_tell():
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        clean, error, stars, test = scene(rng, 8)
        field = fit_mixture_field(
            clean + rng.normal(0, error), stars, error=error, n_components=1,
            radius=6, correlated_noise=False, normalise='stamps')
        # Stars without noise of their own.
        table = MixturePSFPhotometry(field.to_grid((5, 5)), 9)(
            clean, error=error, init_params=test)
        squares.append(np.mean(((table['flux_fit'] - test['flux'])
                                / table['flux_psf_err'])**2))
    assert 0.75 < np.sqrt(np.mean(squares)) < 1.25
