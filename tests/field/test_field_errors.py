"""What a field says of its own errors, and what it does with bad stars."""
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, fit_mixture_field
from photutils_mgauss.field.normal import to_coefficients

SHAPE = (160, 180)
PLACES = [(30, 30), (90, 80), (150, 40), (120, 140)]


def true_psf(x, y):
    u, v = x / 90 - 1, y / 80 - 1
    return GaussianMixture.from_stddevs(
        [0.7, 0.3], np.zeros((2, 2)),
        [[1.1 + 0.1 * u, 1.2 + 0.1 * v], [2.3, 2.2 + 0.2 * u]], [0.1, 0])


def scene(seed, sky=30.0):
    """Return data with noise of this seed, always the same stars, errors."""
    rng = np.random.default_rng(7)
    grid = np.mgrid[14:170:22, 14:150:20].reshape(2, -1)
    x, y = grid + rng.uniform(-2, 2, grid.shape)
    stars = Table({'x': x, 'y': y, 'flux': rng.uniform(4e3, 2e4, x.size)})
    rng = np.random.default_rng(seed)
    clean = sum(true_psf(x, y).render(SHAPE, x, y, flux=flux)
                for x, y, flux in stars.iterrows())
    return rng.poisson(clean + sky) - sky, stars, np.sqrt(clean + sky)


def fit(data, stars, error, **options):
    return fit_mixture_field(data, stars, error=error, **{
        'n_components': 2, 'degree': 1, 'radius': 7} | options)


def predictions(field):
    """Return numbers that the PSF predicts: pixels and an aperture's flux."""
    found = []
    for place in PLACES:
        psf = field.mixture_at(*place)
        found += [*psf.evaluate([0, 1, 0, 2], [0, 0, -2, 2]),
                  psf.encircled_energy(2.5)]
    return np.array(found)


def stated_errors(field):
    """Return the errors of the predictions from the field's covariance."""
    slopes = []
    for i in range(len(field.covariance)):
        step = np.zeros(len(field.covariance))
        step[i] = 1e-4
        change = to_coefficients(step, field.coefficients)
        slopes.append((predictions(replace(
            field, coefficients=field.coefficients + change))
            - predictions(replace(
                field, coefficients=field.coefficients - change))) / 2e-4)
    return np.sqrt(np.einsum('ip,ij,jp->p', slopes, field.covariance, slopes))


@pytest.mark.long
def test_errors_of_the_psf_are_as_large_as_its_covariance_says():
    truth = []
    for place in PLACES:
        psf = true_psf(*place)
        truth += [*psf.evaluate([0, 1, 0, 2], [0, 0, -2, 2]),
                  psf.encircled_energy(2.5)]
    fields = [fit(*scene(seed)) for seed in range(12)]
    errors = stated_errors(fields[0])
    pulls = (np.array([predictions(one) for one in fields]) - truth) / errors
    assert 0.7 < np.sqrt(np.mean(pulls**2)) < 1.2
    assert np.all(np.std(pulls, axis=0) < 1.6)


def test_the_aperture_correction_is_that_of_the_true_psf():
    field = fit(*scene(1))
    for x, y in PLACES:
        for radius in (1.5, 3, 6):
            truth = 1 / true_psf(x, y).encircled_energy(radius)
            assert_allclose(field.aperture_correction(radius, x, y), truth,
                            rtol=0.02)
        assert 0.97 < field.enclosed_flux(x, y) < 1


def test_an_aperture_times_its_correction_is_the_flux():
    data, stars, error = scene(2)
    bright = stars['flux'] > 1e4
    field = fit(data, stars, error, degree=0)
    y, x = np.mgrid[:SHAPE[0], :SHAPE[1]]
    ratio = []
    for star in field.stars[bright]:
        others = field.stars[field.stars['id'] != star['id']]
        if np.hypot(others['x'] - star['x'], others['y'] - star['y']).min() \
                < 14:
            continue
        inside = np.hypot(x - star['x_fit'], y - star['y_fit']) < 5
        correction = field.aperture_correction(
            np.sqrt(inside.sum() / np.pi), star['x'], star['y'])
        ratio.append(data[inside].sum() * correction / star['flux_fit'])
    assert len(ratio) >= 3
    assert_allclose(np.mean(ratio), 1, atol=0.02)


def damaged(kind):
    """Return a scene in which something is wrong with four stars."""
    data, stars, error = scene(3)
    x, y = np.rint([stars['x'][:4], stars['y'][:4]]).astype(int)
    rows, columns = y[:, None] + [-1, 0, 1], x[:, None] + [-1, 0, 1]
    if kind == 'NaN':
        data[rows, columns] = np.nan
    elif kind == 'zero variance':
        error[rows, columns] = 0
    elif kind == 'negative variance':
        error[rows, columns] = -1
    elif kind == 'infinite error':
        error[rows, columns] = np.inf
    elif kind == 'edge':
        stars['x'][:4] = [0, -0.4, 179, 60]
        stars['y'][:4] = [70, 50, 159, -3]
    elif kind == 'nothing there':
        stars['x'][:4], stars['y'][:4] = find_empty(stars)
    return data, stars, error


def find_empty(stars):
    y, x = np.mgrid[20:140:8, 20:160:8].reshape(2, -1)
    distance = np.hypot(x[:, None] - stars['x'], y[:, None] - stars['y'])
    best = np.argsort(-distance.min(axis=1))[:4]
    return x[best], y[best]


@pytest.mark.parametrize('kind', [
    'NaN', 'zero variance', 'negative variance', 'infinite error', 'edge',
    'nothing there'])
def test_the_fit_survives_bad_stars(kind):
    data, stars, error = damaged(kind)
    with np.errstate(all='raise', under='ignore'):
        field = fit(data, stars, error)
    assert np.isfinite(field.coefficients).all()
    for x, y in PLACES:
        assert_allclose(field.mixture_at(x, y).encircled_energy(2.5),
                        true_psf(x, y).encircled_energy(2.5), atol=0.02)
    if kind not in ('nothing there', 'edge'):
        assert np.isnan(field.residual_stars).any()


def test_a_field_with_far_too_few_stars_has_degree_0_and_says_so():
    data, stars, error = scene(4)
    with pytest.warns(AstropyUserWarning, match='2 stars are too few'):
        field = fit(data, stars[:2], error, degree=2)
    assert field.degree == 0
    assert np.isfinite(field.covariance).all()
