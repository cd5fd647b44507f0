"""One PSF field from several exposures."""
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from photutils_mgauss import (
    EmpiricalPSF,
    GaussianMixture,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
)

SHAPE = (200, 220)
# What the jitter of each exposure adds to all covariances.
JITTER = np.array([[0.0, 0, 0], [0.3, 0.1, 0.1], [0.1, -0.1, 0.5]])


def psf_at(x, y, exposure=None):
    u = x / 110 - 1
    psf = GaussianMixture.from_stddevs(
        [0.8, 0.2], np.zeros((2, 2)), [[1.2 + 0.1 * u, 1.3], [2.8, 2.6]],
        [0.05, 0])
    xx, xy, yy = (JITTER.mean(axis=0) if exposure is None
                  else JITTER[exposure])
    return psf.convolve([[xx, xy], [xy, yy]])


@pytest.fixture(scope='module')
def exposures():
    rng = np.random.default_rng(12)
    images, tables, errors = [], [], []
    for e in range(3):
        stars = Table({'x': rng.uniform(5, 214, 25),
                       'y': rng.uniform(5, 194, 25),
                       'flux': rng.uniform(2e4, 6e4, 25)})
        clean = sum(psf_at(x, y, e).render(SHAPE, x, y, flux=flux)
                    for x, y, flux in stars.iterrows())
        images.append(rng.poisson(clean + 30) - 30.0)
        tables.append(stars)
        errors.append(np.sqrt(clean + 30))
    return images, tables, errors


@pytest.fixture(scope='module')
def field(exposures):
    data, stars, error = exposures
    return fit_mixture_field(data, stars, error=error, n_components=2,
                             degree=1, radius=8)


def test_what_each_exposure_adds_is_found(field):
    table = field.exposures
    found = np.column_stack([table[name] for name in ('xx', 'xy', 'yy')])
    errors = np.column_stack([table[f'{name}_err'] for name in
                              ('xx', 'xy', 'yy')])
    pulls = (found - (JITTER - JITTER.mean(axis=0))) / errors
    assert np.abs(pulls).max() < 4
    assert np.all(errors < 0.03)


@pytest.mark.parametrize('exposure', [None, 0, 1, 2])
def test_the_psf_of_each_exposure_is_near_the_truth(field, exposure):
    steps = np.arange(-6, 6.1, 0.5)
    for x, y in [(30, 40), (180, 150)]:
        truth = psf_at(x, y, exposure).evaluate(steps, steps[:, None])
        mine = field.mixture_at(x, y, exposure=exposure).evaluate(
            steps, steps[:, None])
        assert np.abs(mine - truth).max() < 0.02 * truth.max()


def test_stars_tell_their_exposure(field, exposures):
    assert_allclose(np.bincount(field.stars['exposure']), 25)
    for e, stars in enumerate(exposures[1]):
        rows = field.stars['exposure'] == e
        assert_allclose(field.stars['x_fit'][rows], stars['x'], atol=0.05)
    assert 0.9 < np.median(field.stars['reduced_chi2']) < 1.1


def test_a_grid_may_be_that_of_one_exposure(field):
    grid = field.to_grid((2, 2), exposure=1)
    assert_allclose(grid.mixture_at(0, 0).evaluate(1, 1),
                    field.mixture_at(0, 0, exposure=1).evaluate(1, 1))


def test_a_field_may_be_that_of_one_exposure(field, exposures, tmp_path):
    alone = field.at_exposure(1)
    assert alone.mixture_at(30, 40) == field.mixture_at(30, 40, exposure=1)
    assert len(alone.stars) == len(alone.residual_stars) == 25
    assert_allclose(alone.to_grid((2, 2)).evaluate(0, 1, 1, 0, 0),
                    field.to_grid((2, 2), exposure=1).evaluate(0, 1, 1, 0, 0))
    alone.write(tmp_path / 'one.fits')
    again = MixtureField.read(tmp_path / 'one.fits')
    assert again.mixture_at(30, 40) == alone.mixture_at(30, 40)
    assert alone.aperture_correction_error(3, 30, 40) > 0
    with pytest.raises(ValueError, match='exposure must be below 3, got 3'):
        field.at_exposure(3)


def test_the_errors_of_an_exposure_hold_what_it_adds(field):
    mean, alone = (
        np.abs(errors.changes[..., 3]).max() for errors in (
            field.psf_errors(), field.at_exposure(1).psf_errors()))
    assert alone > mean


def test_photometry_of_an_exposure_takes_its_field(field, exposures):
    data, stars, error = (one[2] for one in exposures)
    chi2 = {e: np.median(MixturePSFPhotometry(field.at_exposure(e), 11)(
        data, error=error, init_params=stars)['reduced_chi2']) for e in (0,
                                                                         2)}
    assert 0.85 < chi2[2] < 1.25 < 1.5 < chi2[0]


def test_exposures_survive_a_file(field, tmp_path):
    field.write(tmp_path / 'field.fits')
    again = MixtureField.read(tmp_path / 'field.fits')
    assert_allclose(again.mixture_at(5, 5, exposure=2).covariances,
                    field.mixture_at(5, 5, exposure=2).covariances)


def test_one_exposure_in_a_list_is_one_exposure(exposures):
    data, stars, error = exposures
    options = {'n_components': 1, 'degree': 0, 'radius': 6}
    alone = fit_mixture_field(data[0], stars[0], error=error[0], **options)
    listed = fit_mixture_field(data[:1], stars[:1], error=error[:1],
                               **options)
    assert_allclose(listed.coefficients, alone.coefficients)
    assert listed.exposures is None


@pytest.mark.long
def test_cross_validation_takes_exposures(exposures):
    data, stars, error = exposures
    field = fit_mixture_field(data, stars, error=error, n_components=2,
                              degree='auto', radius=6)
    assert field.degree in (1, 2)


def test_an_empirical_psf_takes_exposures(exposures):
    data, stars, error = exposures
    empirical = EmpiricalPSF.from_stars(data, stars, error=error, degree=1,
                                        n_components=2, radius=7)
    image = empirical.image_at(110, 100)
    steps = (np.arange(len(image)) - len(image) // 2) / 2
    truth = psf_at(110, 100).evaluate(steps, steps[:, None])
    assert np.abs(image - truth).max() < 0.03 * truth.max()


@pytest.mark.parametrize(('change', 'text'), [
    (lambda d, s, e: (d[:2], s, e), 'data must hold an image for each of'),
    (lambda d, s, e: (d, s, e[:2]), 'error must hold an image for each of'),
    (lambda d, s, e: ([d[0], d[1], d[2][:90]], s, [e[0], e[1], e[2][:90]]),
     'data must be exposures of one detector'),
    (lambda d, s, e: ([], [], None), 'stars must hold at least 1 table'),
])
def test_lists_that_do_not_fit_are_errors(exposures, change, text):
    data, stars, error = change(*exposures)
    with pytest.raises(ValueError, match=text):
        fit_mixture_field(data, stars, error=error)


def test_an_exposure_that_does_not_exist_is_an_error(field):
    with pytest.raises(ValueError, match='exposure must be below 3, got 3'):
        field.mixture_at(1, 1, exposure=3)


GAMMAS = 2.0, 2.6


def moffat(r2, gamma):
    return 1.5 / (np.pi * gamma**2) * (1 + r2 / gamma**2) ** -2.5


@pytest.fixture(scope='module')
def seeing():
    """Return data, stars and error of two exposures of Moffat profiles."""
    rng = np.random.default_rng(4)
    y, x = np.indices((100, 100))
    found = [], [], []
    for gamma in GAMMAS:
        stars = Table({'x': rng.uniform(8, 92, 12),
                       'y': rng.uniform(8, 92, 12),
                       'flux': rng.uniform(2e4, 6e4, 12)})
        clean = sum(flux * moffat((x - x_0)**2 + (y - y_0)**2, gamma)
                    for x_0, y_0, flux in stars.iterrows())
        for images, one in zip(found, (rng.poisson(clean + 30) - 30.0, stars,
                                       np.sqrt(clean + 30)), strict=True):
            images.append(one)
    return found


def gaussian_of(gamma, accuracy):
    """Return the variance of the Gaussian nearest to a Moffat profile."""
    y, x = np.mgrid[-6:7, -6:7]
    r2 = (x**2 + y**2)[x**2 + y**2 <= 36]
    star = 4e4 * moffat(r2, gamma)
    error = np.sqrt(star + 30 + (accuracy * star) ** 2)
    return least_squares(lambda p: (
        p[0] / (2 * np.pi * p[1]) * np.exp(-r2 / (2 * p[1])) - star) / error,
        [4e4, 2.0]).x[1]


@pytest.mark.parametrize('which', [[0], [1], [0, 1]])
def test_one_gaussian_stays_near_the_core_of_a_psf_with_wings(seeing, which):
    # A model that errs much may not give its cores so little weight that
    # wings take it over.
    data, stars, error = ([one[i] for i in which] for one in seeing)
    field = fit_mixture_field(data, stars, error=error, n_components=1,
                              degree=0, radius=6, normalise='stamps')
    for number, i in enumerate(which):
        found = field.mixture_at(50, 50, exposure=number).covariances[0]
        assert gaussian_of(GAMMAS[i], 0) < np.trace(found) / 2 < (
            1.05 * gaussian_of(GAMMAS[i], 0.1))
