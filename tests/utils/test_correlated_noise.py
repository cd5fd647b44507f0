"""Correlated noise: measured on blank sky, put into the errors of stars."""
import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import convolve
from scipy.signal import correlate2d

from helpers.star_images import MIXTURE, PSF
from photutils_mgauss import MixturePSFPhotometry, fit_mixture_field
from photutils_mgauss.utils.correlated_noise import noise_correlation

SHAPE = (260, 250)
BILINEAR = np.full((2, 2), 0.25)
DROPS = np.array([[0.02, 0.1, 0.02], [0.1, 0.52, 0.1], [0.02, 0.1, 0.02]])
NO_MASK = np.empty((0, 0), bool)


def stars(seed=1, flux=3e4):
    rng = np.random.default_rng(seed)
    grid = np.mgrid[15:240:30, 15:250:30].reshape(2, -1)
    x, y = grid + rng.uniform(-3, 3, grid.shape)
    return Table({'x': x, 'y': y, 'flux': np.full(x.size, flux)})


def image(seed, kernel=None, table=None, sky=100.0):
    """Return data and error, resampled with a kernel."""
    table = stars() if table is None else table
    clean = sum(MIXTURE.render(SHAPE, x, y, flux=f) for x, y, f in table)
    error = np.sqrt(clean + sky)
    data = clean + np.random.default_rng(seed).normal(0, error)
    if kernel is None:
        return data, error
    return (convolve(data, kernel), np.sqrt(convolve(error**2, kernel**2)))


@pytest.mark.parametrize('kernel', [BILINEAR, DROPS])
def test_the_correlation_is_that_of_the_kernel(kernel):
    table = stars()
    found = noise_correlation(*image(2, kernel), NO_MASK, table['x'],
                              table['y'], 9)
    expected = correlate2d(kernel, kernel)
    expected /= expected.max()
    middle, half = len(found.matrix) // 2, len(expected) // 2
    inner = slice(middle - half, middle + half + 1)
    assert_allclose(found.matrix[inner, inner], expected, atol=0.06)
    assert 0.95 < found.scatter < 1.05
    assert 'correlated' in str(found)


@pytest.mark.parametrize('listed', [0, 12, 64])
def test_independent_noise_has_none_whoever_is_listed(listed):
    table = stars()[:listed]
    assert noise_correlation(*image(3), NO_MASK, table['x'], table['y'],
                             9) is None


def test_padding_and_masks_are_no_blank_sky():
    table = stars()
    data, error = image(4)
    data[:150] = 0.0
    data[:, :60] = np.nan
    mask = np.zeros(SHAPE, bool)
    mask[200:] = True
    data[200:] = 1e3
    assert noise_correlation(data, error, mask, table['x'], table['y'],
                             9) is None
    everything = np.ones(SHAPE, bool)
    assert noise_correlation(data, error, everything, table['x'], table['y'],
                             9) is None


def test_light_without_noise_is_no_correlated_noise():
    table = stars()[:5]
    clean = sum(MIXTURE.render(SHAPE, x, y, flux=f) for x, y, f in stars())
    assert noise_correlation(clean, np.ones(SHAPE), NO_MASK, table['x'],
                             table['y'], 9) is None


def test_errors_are_those_of_the_sandwich():
    """For one star, by sums over pairs of pixels."""
    table = stars()
    data, error = image(5, BILINEAR)
    with pytest.warns(AstropyUserWarning, match='is correlated'):
        result = MixturePSFPhotometry(PSF, 11)(data, error=error,
                                               init_params=table)
    plain = MixturePSFPhotometry(PSF, 11, correlated_noise=False)(
        data, error=error, init_params=table)
    star = 20
    x, y, flux = (result[f'{name}_fit'][star] for name in ('x', 'y', 'flux'))
    i, j = round(x), round(y)
    pixels_y, pixels_x = np.mgrid[j - 5:j + 6, i - 5:i + 6].reshape(2, -1)
    # Within a pixel, the star is taken at the middle of a quarter of it.
    x, y = (at + (np.floor(4 * (place - at + 0.5)) + 0.5) / 4 - 0.5
            for place, at in ((x, i), (y, j)))
    step = 1e-4
    design = np.array([
        MIXTURE.evaluate(pixels_x - x, pixels_y - y),
        flux * (MIXTURE.evaluate(pixels_x - x - step, pixels_y - y)
                - MIXTURE.evaluate(pixels_x - x + step, pixels_y - y))
        / (2 * step),
        flux * (MIXTURE.evaluate(pixels_x - x, pixels_y - y - step)
                - MIXTURE.evaluate(pixels_x - x, pixels_y - y + step))
        / (2 * step)])
    sigma = error[pixels_y, pixels_x]
    correlation = noise_correlation(data, error, NO_MASK, result['x_fit'],
                                    result['y_fit'], 8.5)
    white = design / sigma
    inverse = np.linalg.inv(white @ white.T)
    total = np.zeros((3, 3))
    reach = len(correlation.matrix) // 2
    for a in range(sigma.size):
        for b in range(sigma.size):
            dy, dx = pixels_y[a] - pixels_y[b], pixels_x[a] - pixels_x[b]
            if max(abs(dy), abs(dx)) <= reach:
                total += correlation.matrix[reach + dy, reach + dx] * np.outer(
                    white[:, a], white[:, b])
    expected = np.sqrt(np.diag(inverse @ total @ inverse) / np.diag(inverse))
    for name, growth in zip(('flux', 'x', 'y'), expected, strict=True):
        assert_allclose(result[f'{name}_err'][star]
                        / plain[f'{name}_err'][star], growth, rtol=0.02)
        assert_array_equal(result[f'{name}_fit'], plain[f'{name}_fit'])
    assert 'correlated' in result.meta['noise_correlation']


@pytest.mark.parametrize('kernel', [None, BILINEAR, DROPS])
def test_pulls_scatter_by_one(kernel):
    table = stars()
    differences = []
    photometry = MixturePSFPhotometry(PSF.copy() if kernel is None
                                      else resampled(kernel), 11)
    for seed in (10, 12, 14):
        pair = []
        for one in (seed, seed + 1):
            data, error = image(one, kernel)
            if kernel is not None and not photometry._told_of_correlation:
                with pytest.warns(AstropyUserWarning, match='is correlated'):
                    pair.append(photometry(data, error=error,
                                           init_params=table))
            else:
                pair.append(photometry(data, error=error, init_params=table))
        differences.append([
            (pair[0][f'{name}_fit'] - pair[1][f'{name}_fit'])
            / np.hypot(pair[0][f'{name}_err'], pair[1][f'{name}_err'])
            for name in ('x', 'y', 'flux')])
    # 3 x 64 stars: 5 % for each of the three.
    pulls = np.std(differences, axis=(0, 2))
    assert ((pulls > 0.85) & (pulls < 1.17)).all()


def resampled(kernel):
    """Return the PSF of a resampled image, of shifted mixtures."""
    from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel
    size = len(kernel) // 2
    shifts = [(dx, dy) for dy in range(len(kernel))
              for dx in range(len(kernel))]
    weights = [kernel[dy, dx] for dx, dy in shifts]
    return MultiGaussianPSFModel(MIXTURE.convolve(GaussianMixture(
        weights, np.array(shifts) - float(size),
        np.full((len(weights), 2, 2), 0.0) + 1e-6 * np.eye(2))))


@pytest.mark.long
def test_fields_take_the_correlation_into_account():
    table = stars(flux=1e5)
    found, stated = [], []
    for seed in range(20, 32):
        data, error = image(seed, BILINEAR, table)
        with pytest.warns(AstropyUserWarning,
                          match='errors of pixels are taken'):
            field = fit_mixture_field(data, table, error=error,
                                      n_components=2, degree=0, radius=8)
        # The first three numbers are those of the centre and the total.
        found.append(field.coefficients.ravel()[3:])
        stated.append(np.diag(field.covariance))
        # Of the errors as they were given.
        assert 0.9 < np.median(field.stars['reduced_chi2']) < 1.6
    ratios = np.var(found, axis=0, ddof=1) / np.mean(stated, axis=0)
    # Nine numbers of twelve images.
    assert 0.75 < np.sqrt(np.mean(ratios)) < 1.25


def test_without_errors_nothing_is_looked_for():
    table = stars()
    data, _ = image(5, BILINEAR)
    result = MixturePSFPhotometry(PSF, 11)(data, init_params=table)
    assert result.meta['noise_correlation'] == ''
