"""The astropy model: parameters, derivatives, fits, copies, units."""
import copy
import pickle

import numpy as np
import pytest
from astropy import units as u
from astropy.modeling.fitting import (
    DogBoxLSQFitter,
    LevMarLSQFitter,
    TRFLSQFitter,
)
from astropy.modeling.models import Const2D
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GaussianPSF

from helpers.strategies import SETTINGS, mixtures, numbers
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MultiGaussianPSFModel,
)

Y, X = np.mgrid[:21, :23]


@pytest.fixture
def mixture():
    """Return three different, offset, tilted Gaussians."""
    return GaussianMixture.from_stddevs(
        [0.6, 0.3, 0.1], [[0, 0], [0.1, -0.1], [0.2, 0.3]],
        [[1, 1.1], [2, 1.8], [4, 4.5]], [0.1, -0.2, 0.3])


@pytest.fixture
def model(mixture):
    """Return a model of them near the middle of the lattice."""
    return MultiGaussianPSFModel(mixture, flux=100, x_0=11.2, y_0=9.7)


def test_parameters_come_in_the_promised_order():
    assert MultiGaussianPSFModel(n_components=2).param_names == (
        'flux', 'x_0', 'y_0', 'fraction_1',
        'x_mean_1', 'y_mean_1', 'x_stddev_1', 'y_stddev_1', 'rho_1',
        'x_mean_2', 'y_mean_2', 'x_stddev_2', 'y_stddev_2', 'rho_2')
    model = MultiGaussianPSFModel()
    assert model.n_components == 3
    free = [name for name in model.param_names if not model.fixed[name]]
    assert free == ['flux', 'x_0', 'y_0']


@given(mixtures(signed=True))
@settings(**SETTINGS)
def test_the_width_of_a_model_is_that_of_its_mixture(mixture):
    model = MultiGaussianPSFModel(mixture, flux=7, x_0=3)
    assert_allclose(model.fwhm, mixture.fwhm, rtol=1e-9)


def test_the_model_gives_its_mixture_back(mixture):
    model = MultiGaussianPSFModel(mixture, x_0=3)
    assert_allclose(model.weights, mixture.weights, rtol=1e-12, atol=1e-14)
    assert_allclose(model.mixture.means, mixture.means)
    assert_allclose(model.mixture.covariances, mixture.covariances,
                    rtol=1e-12)


@pytest.mark.parametrize('integrated', [False, True])
def test_the_model_is_flux_times_its_mixture(mixture, integrated):
    model = MultiGaussianPSFModel(mixture, flux=7, x_0=10.3, y_0=8.8,
                                  pixel_integrated=integrated)
    assert_allclose(model(X, Y), mixture.render(
        X.shape, 10.3, 8.8, flux=7, pixel_integrated=integrated), rtol=1e-11)


@given(st.lists(numbers(0, 1), min_size=3, max_size=3),
       st.lists(numbers(-30, 30), min_size=4, max_size=4),
       st.lists(numbers(-2, 2), min_size=4, max_size=4))
@settings(**SETTINGS)
def test_any_values_make_a_finite_psf_of_unit_flux(fractions, stddevs, rho):
    model = MultiGaussianPSFModel(n_components=4)
    # As a fit steps, which may leave the range that a user is held to.
    values = dict(zip(model.param_names, model.parameters, strict=True))
    for k in range(4):
        if k < 3:
            values[f'fraction_{k + 1}'] = fractions[k]
        values[f'x_stddev_{k + 1}'] = stddevs[k]
        values[f'rho_{k + 1}'] = rho[k]
    model.parameters = list(values.values())
    assert_allclose(model.weights.sum(), 1, rtol=1e-12)
    assert np.isfinite(model.evaluate(X, Y, *model.parameters)).all()
    assert_allclose(model.mixture.weights.sum(), 1, rtol=1e-12)
    assert all(np.isfinite(column).all()
               for column in model.free_shape().fit_deriv(
                   X, Y, *model.parameters))


@pytest.mark.parametrize('integrated', [False, True])
def test_every_derivative_is_the_central_difference(mixture, integrated):
    model = MultiGaussianPSFModel(mixture, flux=100, x_0=11.2, y_0=9.7,
                                  pixel_integrated=integrated)
    for name in model.param_names:
        getattr(model, name).fixed = False
    columns = model.fit_deriv(X, Y, *model.parameters)
    assert len(columns) == len(model.param_names)
    for i, column in enumerate(columns):
        step = np.zeros_like(model.parameters)
        step[i] = 1e-5 * max(1, abs(model.parameters[i]))
        expected = (model.evaluate(X, Y, *(model.parameters + step))
                    - model.evaluate(X, Y, *(model.parameters - step))
                    ) / (2 * step[i])
        assert_allclose(column, expected, rtol=1e-6,
                        atol=1e-7 * np.abs(expected).max(),
                        err_msg=model.param_names[i])


def test_only_free_columns_are_computed(model):
    columns = model.fit_deriv(X, Y, *model.parameters)
    assert all(column.any() for column in columns[:3])
    assert not any(column.any() for column in columns[3:])
    model.rho_2.fixed = False
    model.flux.fixed = True
    columns = model.fit_deriv(X, Y, *model.parameters)
    computed = [name for name, column
                in zip(model.param_names, columns, strict=True)
                if column.any()]
    assert computed == ['x_0', 'y_0', 'rho_2']


def test_derivatives_are_finite_at_flux_zero(model):
    model = model.free_shape()
    model.flux = 0
    columns = model.fit_deriv(X, Y, *model.parameters)
    assert np.isfinite(columns).all()
    assert_allclose(columns[0], model.evaluate(X, Y, 1,
                                               *model.parameters[1:]))


@pytest.mark.parametrize('theta', [0, 30, 90, -55])
def test_one_gaussian_is_the_one_of_photutils(theta):
    peer = GaussianPSF(flux=50, x_0=10.4, y_0=9.1, x_fwhm=3.1, y_fwhm=4.7,
                       theta=theta)
    to_stddev = 1 / (2 * np.sqrt(2 * np.log(2)))
    sx, sy = 3.1 * to_stddev, 4.7 * to_stddev
    c, s = np.cos(np.deg2rad(theta)), np.sin(np.deg2rad(theta))
    rotation = np.array([[c, -s], [s, c]])
    covariance = rotation @ np.diag([sx**2, sy**2]) @ rotation.T
    model = MultiGaussianPSFModel(
        GaussianMixture([1], [[0, 0]], [covariance]), flux=50, x_0=10.4,
        y_0=9.1)
    peak = peer(10.4, 9.1)
    assert_allclose(model(X, Y), peer(X, Y), rtol=0, atol=1e-12 * peak)
    ours = model.fit_deriv(X, Y, *model.parameters)[:3]
    theirs = peer.fit_deriv(X, Y, *peer.parameters)[:3]
    for a, b in zip(ours, theirs, strict=True):
        assert_allclose(a, b, rtol=0, atol=1e-12 * peak)


@pytest.mark.parametrize('fitter', [TRFLSQFitter, LevMarLSQFitter,
                                    DogBoxLSQFitter])
@pytest.mark.parametrize('integrated', [False, True])
def test_freed_shapes_fit_to_the_truth(fitter, integrated):
    truth = GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [0.15, -0.1]], [[1.2, 1.0], [2.5, 2.9]],
        [0.2, -0.1])
    y, x = np.mgrid[:31, :31]
    image = truth.render((31, 31), 15.3, 14.8, flux=1000,
                         pixel_integrated=integrated)
    start = MultiGaussianPSFModel(
        GaussianMixture.from_stddevs(
            [0.5, 0.5], [[0, 0], [0, 0]], [[1, 1], [3, 3]], [0, 0]),
        flux=800, x_0=15, y_0=15, pixel_integrated=integrated).free_shape()
    fitted = fitter()(start, x, y, image, maxiter=1000)
    assert_allclose(fitted.flux, 1000, rtol=1e-5)
    assert_allclose(fitted.parameters[1:3], [15.3, 14.8], atol=1e-5)
    assert_allclose(fitted.mixture.weights, truth.weights, atol=1e-4)
    assert_allclose(fitted.mixture.stddevs, truth.stddevs, atol=1e-4)


def test_astropy_fits_a_model_with_units(model):
    image = model(X, Y) * u.nJy
    start = model.copy()
    start.x_0 = 11
    start.flux = 80
    start = MultiGaussianPSFModel(model.mixture, flux=80 * u.nJy, x_0=11,
                                  y_0=10)
    fitted = TRFLSQFitter()(start, X, Y, image)
    assert fitted.flux.unit == u.nJy
    assert_allclose(fitted.flux.value, 100)
    assert_allclose(fitted.x_0, 11.2)


def test_positions_may_carry_units(model):
    x, y, image = X * u.pix, Y * u.pix, model(X, Y) * u.nJy
    start = MultiGaussianPSFModel(model.mixture, flux=90 * u.nJy,
                                  x_0=11 * u.pix, y_0=10 * u.pix)
    assert start.input_units == {'x': u.pix, 'y': u.pix}
    fitted = TRFLSQFitter()(start, x, y, image)
    assert fitted.x_0.unit == u.pix
    assert_allclose(fitted.x_0.value, 11.2)


@pytest.mark.parametrize('grid', [False, True])
def test_points_on_the_sky_are_not_pixels(model, grid):
    if grid:
        model = GriddedMixturePSF([model.mixture], [(0, 0)])
    assert model(3 * u.pix, 2 * u.pix) == model(3, 2)
    with pytest.raises(u.UnitsError, match=r'y must be in pixels.*got deg'):
        model(3, 2 * u.deg)


def test_flux_may_be_a_quantity(model):
    bright = MultiGaussianPSFModel(model.mixture, flux=3 * u.Jy)
    assert bright(0, 0).unit == u.Jy
    assert_allclose(bright(0, 0).value, 3 * model.mixture.evaluate(0, 0))
    assert bright.evaluate(X, Y, np.array([2.0]) * u.mJy,
                           *bright.parameters[1:]).unit == u.mJy


@pytest.mark.parametrize(('x', 'y', 'shape'), [
    (0, 0, ()), ([0, 1], 0, (2,)), ([0, 1], [[2], [3]], (2, 2))])
def test_inputs_broadcast(model, x, y, shape):
    assert np.shape(model.evaluate(x, y, *model.parameters)) == shape


def test_one_call_evaluates_one_star_per_pixel(model):
    x_0, flux = np.array([5.0, 9.0]), np.array([1.0, 10.0])
    values = model.evaluate([5, 10], [4, 4], flux, x_0, 4.0,
                            *model.parameters[3:])
    assert_allclose(values, flux * model.mixture.evaluate([0, 1], 0))


def test_a_copy_is_of_its_own(model):
    model.meta['night'] = ['first']
    model.xy = 'shared'
    twin = model.copy()
    twin.flux = 1
    twin.x_0.bounds = (0, 1)
    twin.rho_1.fixed = False
    twin.meta['night2'] = 1
    assert model.flux == 100
    assert model.x_0.bounds == (None, None)
    assert model.rho_1.fixed
    assert 'night2' not in model.meta
    assert twin.flux.model is twin
    assert not np.shares_memory(twin._parameters, model._parameters)
    assert isinstance(twin, MultiGaussianPSFModel)


@pytest.mark.parametrize('duplicate', [
    copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)),
    MultiGaussianPSFModel.copy, MultiGaussianPSFModel.deepcopy])
def test_duplicates_are_the_same_model(model, duplicate):
    model = model.free_shape()
    model.flux.bounds = (0, 1e6)
    model.meta['filter'] = ['F814W']
    model.name = 'star'
    twin = duplicate(model)
    assert repr(twin) == repr(model)
    assert_array_equal(twin.parameters, model.parameters)
    assert twin.fixed == model.fixed
    assert twin.bounds == model.bounds
    assert twin.meta == model.meta
    assert twin.name == 'star'
    assert_array_equal(twin(X, Y), model(X, Y))


def test_a_deep_copy_has_its_own_meta(model):
    model.meta['list'] = [1]
    copy.deepcopy(model).meta['list'].append(2)
    assert model.meta['list'] == [1]


def test_a_subclass_stays_a_subclass(mixture):
    twin = copy.deepcopy(Tuned(mixture).free_shape())
    assert isinstance(twin, Tuned)
    assert isinstance(pickle.loads(pickle.dumps(twin)), Tuned)


class Tuned(MultiGaussianPSFModel):
    """A subclass as a user may write it."""


def test_repr_and_str_use_the_public_name(model):
    assert repr(model) == ('<MultiGaussianPSFModel(flux=100, x_0=11.2, '
                           'y_0=9.7, n_components=3)>')
    assert str(model).startswith('Model: MultiGaussianPSFModel\n')


def test_the_bounding_box_moves_with_the_star(model):
    (y_low, y_high), (x_low, x_high) = model.bounding_box.bounding_box()
    assert_allclose([(x_low + x_high) / 2, (y_low + y_high) / 2], [11.2, 9.7])
    model.x_0 = 50
    (_, _), (x_low, x_high) = model.bounding_box.bounding_box()
    assert_allclose((x_low + x_high) / 2, 50)
    y, x = np.mgrid[-20:40, 20:80]
    inside = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
    assert_allclose(model(x, y)[inside].sum(), 100, rtol=1e-5)


def test_convolve_convolves_the_mixture(model):
    wide = model.convolve([[2, 0.5], [0.5, 1]])
    assert_allclose(wide.mixture.covariances,
                    model.mixture.convolve([[2, 0.5], [0.5, 1]]).covariances)
    assert wide.flux == model.flux
    assert wide.x_0 == model.x_0


def test_models_add_up_to_compound_models(model):
    second = model.copy()
    second.x_0 = 3
    assert_allclose((model + second)(X, Y), model(X, Y) + second(X, Y))


def test_big_endian_and_integer_pixels_are_welcome(model):
    expected = model(X.astype(float), Y.astype(float))
    for dtype in ('>f4', '>i4', 'i8', 'f4'):
        assert_array_equal(model(X.astype(dtype), Y.astype(dtype)), expected)


def test_bad_arguments_are_named():
    with pytest.raises(TypeError, match='mixture must be a GaussianMixture'):
        MultiGaussianPSFModel([1, 2])
    with pytest.raises(ValueError, match='n_components must be at least 1'):
        MultiGaussianPSFModel(n_components=0)
    with pytest.raises(TypeError, match='n_components must be an integer'):
        MultiGaussianPSFModel(n_components=2.5)
    with pytest.raises(TypeError, match='unrecognized parameter'):
        MultiGaussianPSFModel(colour='red')
    mixture = GaussianMixture.from_stddevs(
        [0.5, 0.5, 0.3, -0.3], np.zeros((4, 2)), np.ones((4, 2)), np.zeros(4))
    with pytest.raises(ValueError, match='put negative ones first'):
        MultiGaussianPSFModel(mixture)


@pytest.mark.parametrize(('name', 'value'), [
    ('rho_1', 1.5), ('rho_2', -1.0), ('fraction_1', 2.0),
    ('fraction_1', -0.5), ('x_stddev_1', -1.0), ('y_stddev_2', 0.0)])
def test_values_that_no_gaussian_has_are_refused(mixture, name, value):
    model = MultiGaussianPSFModel(mixture)
    with pytest.raises(ValueError, match=f'{name} must be'):
        setattr(model, name, value)
    with pytest.raises(ValueError, match=f'{name} must be'):
        getattr(model, name).value = value


def test_ties_are_part_of_the_derivatives(mixture):
    start = MultiGaussianPSFModel(mixture, flux=5000, x_0=11,
                                  y_0=10).free_shape()
    data = start(X, Y)
    start.y_stddev_1.tied = lambda model: model.x_stddev_1
    squares = [np.sum((TRFLSQFitter()(
        start.copy(), X, Y, data, maxiter=1000, estimate_jacobian=numerical)(
            X, Y) - data)**2) for numerical in (False, True)]
    assert squares[0] < 1.01 * squares[1]


@pytest.mark.parametrize('fitter', [TRFLSQFitter, LevMarLSQFitter])
def test_a_fitted_sum_draws_what_was_fitted(mixture, fitter):
    star = MultiGaussianPSFModel(mixture, flux=5000, x_0=11, y_0=10)
    data = star(X, Y) + 3
    star.flux, star.x_0 = 4500, 11.2
    scene = star + Const2D(2)
    scene.y_0_0.tied = lambda scene: scene.x_0_0 - 1
    fitted = fitter()(scene, X, Y, data, maxiter=1000)
    assert_allclose(fitted(X, Y), data, atol=1e-3)
    assert fitted.left.flux == fitted.flux_0
    # A copy has Parameters of its own, the same for the sum and its parts.
    again = fitted.copy()
    again.flux_0 = 1
    assert again.left.flux.value == 1
    assert fitted.left.flux.value > 4900


def test_the_one_that_photutils_puts_into_all_parameters_is_taken():
    model = MultiGaussianPSFModel()
    for name in model.param_names:
        setattr(model, name, 1)
    assert np.isfinite(model(1, 1))




def test_the_text_of_a_model_of_several_stars_has_all_fluxes():
    mixture = GaussianMixture([1], [(0, 0)], [np.eye(2)])
    model = MultiGaussianPSFModel(mixture, flux=[1.5, 2], x_0=[1, 2], y_0=3)
    assert repr(model) == ('<MultiGaussianPSFModel(flux=[1.5, 2], '
                           'x_0=[1, 2], y_0=3, n_components=1)>')
