"""
What went wrong in other packages, and must not here.

The numbers are those of the list in docs/contract.rst.
"""
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.nddata import NDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GriddedPSFModel, PSFPhotometry, SourceGrouper

import photutils_mgauss
from helpers.psf_grids import PLACES, epsf_grid, make_grid, some_mixture
from helpers.psfex_models import X, Y, write_model
from helpers.star_images import check, draw, narrow_mixture, nearby
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureFitter,
    MultiGaussianPSFModel,
    fit_mixture,
    read_psfex,
)

ROWS, COLUMNS = np.mgrid[:15, :15]


@pytest.fixture
def stars():
    """Return two stars that overlap and one apart."""
    return QTable({'x': [20.3, 24.9, 40.0], 'y': [30.2, 31.7, 20.0],
                   'flux': [3000.0, 5000.0, 800.0]})


def test_p20_a_blend_is_the_weighted_sum_of_images():
    psf = make_grid((0, 10), (0, 20))
    images = [node.evaluate(COLUMNS - 4, ROWS - 5) for node in psf.mixtures]
    shares = [0.6 * 0.75, 0.4 * 0.75, 0.6 * 0.25, 0.4 * 0.25]
    blended = psf.evaluate(COLUMNS, ROWS, 1, 4, 5)
    assert_allclose(blended, np.tensordot(shares, images, 1), rtol=0,
                    atol=1e-15)


@pytest.mark.parametrize('scale', [1e-12, 1e12])
def test_p21_no_prior_pulls_a_fit_without_noise(scale):
    truth = narrow_mixture(2)
    image = truth.render((25, 25), 12, 12, flux=scale)
    fit = fit_mixture(image, 2)
    assert_allclose(fit.flux, scale, rtol=1e-6)
    assert_allclose(np.sort(fit.mixture.weights), np.sort(truth.weights),
                    rtol=1e-5)


def test_p22_positions_in_psfex_files_count_from_1(tmp_path):
    planes = [np.zeros((3, 3)), np.ones((3, 3)), np.zeros((3, 3))]
    model = read_psfex(write_model(tmp_path / 'a.psf', planes,
                                   contexts=(X, Y), degrees=(1,)))
    assert_array_equal(model.image_at(99, 0), 0)
    assert_allclose(model.image_at(299, 0), 1)


def test_p23_a_node_of_zeros_gives_no_nan(stars):
    psf = GriddedMixturePSF.from_gridded_psf(
        epsf_grid(lambda data: data[0:5:4].fill(0)), 2)
    assert psf.report['bridged'].sum() == 2
    assert np.isfinite(psf(COLUMNS, ROWS)).all()
    check(PSFPhotometry(psf, (9, 9))(draw(psf, stars[2:]),
                                     init_params=nearby(stars[2:])),
          stars[2:])


def test_p24_positions_keep_the_origin_of_the_epsf(stars):
    # Mean and peak of this PSF differ by a tenth of a pixel.
    skewed = GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [0.5, 0]], [[1.2, 1.2], [2, 2]], [0, 0])
    steps = np.arange(-40, 41) / 4
    data = np.tile(skewed.evaluate(steps, steps[:, None]), (4, 1, 1))
    peer = GriddedPSFModel(NDData(data, meta={
        'grid_xypos': [(0, 0), (60, 0), (0, 60), (60, 60)],
        'oversampling': 4}))
    psf = GriddedMixturePSF.from_gridded_psf(peer, 2)
    assert_allclose(psf.mixtures[0].moments().mean, [0.15, 0], atol=1e-4)
    check(PSFPhotometry(psf, (9, 9))(draw(peer, stars[2:]),
                                     init_params=nearby(stars[2:])),
          stars[2:], rtol=0, atol=1e-3)


def test_p25_the_flux_is_that_of_the_whole_psf_not_of_the_stamp():
    # Half of the light is beyond the fitted circle.
    wide = GaussianMixture([1], [[0, 0]], [[[9, 0], [0, 9]]])
    image = wide.render((31, 31), 15, 15, flux=100)
    fit = fit_mixture(image, 1, radius=3.5)
    assert_allclose(fit.flux, 100, rtol=1e-6)
    assert fit.enclosed_flux < 0.6


def test_p26_the_meaning_of_flux_does_not_change_with_shape():
    model = MultiGaussianPSFModel(narrow_mixture(2), flux=7, x_0=30, y_0=30)
    y, x = np.mgrid[:61, :61]
    for name, value in (('fraction_1', 0.1), ('x_stddev_1', 2.2),
                        ('rho_2', 0.8), ('y_mean_2', 0.7)):
        setattr(model, name, value)
        assert_allclose(model(x, y).sum(), 7, rtol=1e-6)


def test_p27_errors_are_the_scatter(rng):
    psf = make_grid((0, 300), (0, 300))
    x, y = (a.ravel() for a in np.mgrid[12:300:20, 12:300:20])
    stars = QTable({'x': x + rng.uniform(0, 1, x.size),
                    'y': y + rng.uniform(0, 1, x.size),
                    'flux': np.full(x.size, 2000.0)})
    image = np.zeros((310, 310))
    for star, stamp in zip(stars, psf.render(stars['x'], stars['y'], 2000.0,
                                             25), strict=True):
        j, i = round(star['y']), round(star['x'])
        image[j - 12:j + 13, i - 12:i + 13] += stamp
    result = PSFPhotometry(psf, (9, 9))(
        image + rng.normal(0, 2, image.shape), error=np.full(image.shape, 2.0),
        init_params=nearby(stars))
    result.sort('id')
    for name in ('x', 'y', 'flux'):
        pull = (result[f'{name}_fit'] - stars[name]) / result[f'{name}_err']
        # The scatter of 225 pulls is known to 5 per cent.
        assert_allclose(np.std(pull), 1, atol=0.15)


def test_p28_pixels_shared_by_two_stars_bias_no_flux(stars):
    psf = make_grid((0, 50), (0, 50))
    pair = stars[:2]
    result = PSFPhotometry(psf, (11, 11), grouper=SourceGrouper(10))(
        draw(psf, pair), init_params=nearby(pair))
    assert_array_equal(result['group_size'], 2)
    check(result, pair)


@pytest.mark.parametrize('flux', [1e-3, 1, 1e8])
def test_p29_the_last_digit_does_not_depend_on_the_flux_scale(flux, stars):
    psf = make_grid((0, 50), (0, 50))
    star = stars[:1]
    star['flux'] = flux
    image = draw(psf, star)
    result = PSFPhotometry(psf, (9, 9), fitter=MixtureFitter())(
        image, error=np.full(image.shape, 1e-3 * flux),
        init_params=nearby(star))
    assert_allclose(result['x_fit'], star['x'], atol=1e-5)
    assert_allclose(result['flux_fit'], flux, rtol=1e-5)


@pytest.mark.parametrize('interpolation', ['blend', 'components'])
def test_p30_threads_do_not_disturb_each_other(interpolation, rng):
    psf = make_grid(interpolation=interpolation)
    places = rng.uniform(0, 50, (200, 2))

    def value(place):
        return psf.copy().evaluate(COLUMNS, ROWS, 1, *place)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(value, places))
    assert_array_equal(together, [value(place) for place in places])


def test_p31_positions_broadcast_and_x_is_not_y():
    psf = make_grid()
    x, y = np.arange(7.0), np.arange(5.0)[:, None]
    image = psf(x, y)
    assert image.shape == (5, 7)
    for j in range(5):
        assert_allclose(image[j], [psf(i, j) for i in range(7)])
    assert not np.allclose(psf(x[:5], y), psf(x[:5], y).T)


@pytest.mark.parametrize('name', photutils_mgauss.__all__)
def test_p32_every_public_name_leads_somewhere(name):
    assert getattr(photutils_mgauss, name).__doc__ or name == '__version__'


def test_p33_models_are_pickled_by_their_public_class(stars):
    psf = make_grid((0, 50), (0, 50))
    PSFPhotometry(psf, (9, 9), grouper=SourceGrouper(10))(
        draw(psf, stars), init_params=nearby(stars))
    content = pickle.dumps(psf)
    assert b'photutils_mgauss.psf.gridded' in content
    assert b'GriddedMixturePSF_' not in content
    again = pickle.loads(content)
    assert_array_equal(again(COLUMNS, ROWS), psf(COLUMNS, ROWS))


@pytest.mark.parametrize('dtype', ['>f4', '<f4', '>f8', '>i4'])
def test_p34_images_and_coordinates_of_any_type(dtype, stars):
    psf = make_grid((0, 50), (0, 50))
    image = draw(psf, stars[2:]) * 1000
    star = stars[2:]
    star['flux'] *= 1000
    result = PSFPhotometry(psf, (9, 9))(image.astype(dtype),
                                        init_params=nearby(star))
    check(result, star, rtol=0, atol=1e-3)
    whole = np.arange(9)
    assert_array_equal(psf.fit_deriv(whole, whole, 1, 4, 4),
                       psf.fit_deriv(whole * 1.0, whole * 1.0, 1, 4, 4))


@pytest.mark.parametrize('grid', [((30,), (30,)), ((0, 25, 60), (9,)),
                                  ((9,), (0, 60)), ((0, 5, 60), (0, 60))])
def test_p35_grids_of_any_shape_measure_stars(grid, stars):
    psf = make_grid(*grid)
    check(PSFPhotometry(psf, (9, 9))(draw(psf, stars[2:]),
                                     init_params=nearby(stars[2:])),
          stars[2:])


@pytest.mark.parametrize('interpolation', ['blend', 'components'])
@pytest.mark.parametrize('place', [(20.0, 30.0), (0.0, 30.0), (60.0, 60.0),
                                   (20.0, 70.0)])
def test_p36_stars_on_nodes_on_edges_and_outside(interpolation, place):
    psf = make_grid((0, 20, 60), (0, 30, 60), interpolation=interpolation)
    step = 1e-9
    values = [psf.evaluate(COLUMNS + place[0] - 7, ROWS + place[1] - 7, 1,
                           place[0] + dx, place[1] + dy)
              for dx in (-step, 0, step) for dy in (-step, 0, step)]
    assert np.ptp(values, axis=0).max() < 1e-8
    star = QTable({'x': [place[0] + 20], 'y': [place[1] + 20],
                   'flux': [100.0]})
    moved = make_grid((20, 40, 80), (20, 50, 80), interpolation=interpolation)
    check(PSFPhotometry(moved, (9, 9))(
        draw(moved, star, (110, 110)), init_params=nearby(star)), star)


@pytest.mark.parametrize('stddevs', [(0.05, 0.05), (0.05, 30), (1, 1)])
@pytest.mark.parametrize('rho', [-0.999999, 0, 0.999999])
def test_p37_thin_narrow_and_equal_gaussians_are_finite(stddevs, rho):
    mixture = GaussianMixture.from_stddevs(
        [0.5, 0.5, 0], np.zeros((3, 2)), [stddevs] * 3, [rho] * 3)
    for psf in (MultiGaussianPSFModel(mixture).free_shape(),
                GriddedMixturePSF([mixture] * 9, PLACES),
                GriddedMixturePSF([mixture] * 9, PLACES,
                                  interpolation='components')):
        values = [10, 7.3, 6.9, *psf.parameters[3:]]
        assert np.isfinite(psf.evaluate(COLUMNS, ROWS, *values)).all()
        assert np.isfinite(psf.fit_deriv(COLUMNS, ROWS, *values)).all()


def test_p37_a_weight_of_zero_is_no_gaussian(rng):
    mixture = some_mixture(rng, 2)
    padded = GaussianMixture([*mixture.weights, 0],
                             [*mixture.means, (99, 99)],
                             [*mixture.covariances, 1e-12 * np.eye(2)])
    psf = GriddedMixturePSF([padded], [(0, 0)])
    assert_allclose(psf(COLUMNS, ROWS),
                    mixture.evaluate(COLUMNS, ROWS))
