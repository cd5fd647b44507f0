"""
Our PSF models inside photutils, each held to what photutils' own must do.

The numbers C1-C26 name the points of the contract that a test is about; they
are listed in docs/contract.rst.
"""
import copy
import gc
import inspect
import pickle

import numpy as np
import pytest
from astropy import units as u
from astropy.modeling import Fittable2DModel
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable, Table
from numpy.testing import assert_allclose
from photutils.datasets import make_model_image
from photutils.detection import DAOStarFinder
from photutils.psf import (
    IterativePSFPhotometry,
    PSFPhotometry,
    SourceGrouper,
    make_psf_model_image,
)

from helpers.psf_grids import make_grid, some_mixture
from helpers.star_images import check, draw, narrow_mixture, nearby
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MultiGaussianPSFModel,
)

MODELS = {
    'K=1': lambda: MultiGaussianPSFModel(narrow_mixture(1)),
    'K=3': lambda: MultiGaussianPSFModel(narrow_mixture(3)),
    'K=3 integrated': lambda: MultiGaussianPSFModel(narrow_mixture(3),
                                                    pixel_integrated=True),
    'grid': lambda: make_grid((0, 20, 50), (0, 20, 60)),
    'grid matched': lambda: make_grid((0, 20, 50), (0, 20, 60),
                                      interpolation='components'),
    'grid integrated': lambda: make_grid((0, 50), (0, 60),
                                         pixel_integrated=True),
    'photutils grid': lambda: make_grid(
        (0, 20, 50, 60), (0, 20, 40, 60)).to_gridded_psf(4, radius=14),
}


@pytest.fixture(params=MODELS)
def psf(request):
    """Return each PSF model in turn, photutils' own grid among them."""
    if request.param.startswith('photutils'):
        gc.collect()  # or 3.0 fits it as the grid of an earlier test
    return MODELS[request.param]()


@pytest.fixture
def stars():
    """Return four stars, two of them close together."""
    return QTable({'x': [12.3, 35.8, 40.1, 20.2],
                   'y': [14.6, 30.4, 31.9, 44.7],
                   'flux': [3000.0, 5000.0, 2000.0, 800.0]})


def test_c1_c2_it_is_a_model_of_x_and_y_with_the_expected_names(psf):
    assert isinstance(psf, Fittable2DModel)
    assert (psf.n_inputs, psf.n_outputs) == (2, 1)
    assert {'flux', 'x_0', 'y_0'} <= set(psf.param_names)
    assert not hasattr(psf, 'x_name')


def test_c3_c4_parameters_are_scalar_and_three_are_free(psf):
    assert all(getattr(psf, name).shape == () for name in psf.param_names)
    assert [n for n in psf.param_names if not psf.fixed[n]] == [
        'flux', 'x_0', 'y_0']
    assert not any(psf.tied.values())


def test_c6_names_hold_nothing_that_columns_end_with(psf):
    forbidden = ('_fit', '_err', '_init', '_fixed', '_bounds')
    assert not any(word in name for name in psf.param_names
                   for word in forbidden)
    assert not {'id', 'group_id', 'local_bkg', 'x', 'y'} & set(psf.param_names)


def test_c8_evaluate_takes_what_fits_and_images_hand_over(psf):
    y, x = np.mgrid[:9, :8]
    values = psf.parameters
    expected = psf.evaluate(x, y, *values)
    assert expected.shape == (9, 8)
    flat = psf.evaluate(x.ravel().astype(float), y.ravel().astype(float),
                        *values)
    assert_allclose(flat, expected.ravel())
    one = [np.array([v]) for v in values]
    assert_allclose(psf.evaluate(x, y, *one), expected)
    one[0] = one[0] * u.nJy
    assert psf.evaluate(x, y, *one).unit == u.nJy
    assert np.isfinite(psf(0, 0))
    assert np.shape(psf([0, 1], [0, 1])) == (2,)


def test_c9_nothing_reachable_is_not_finite(psf):
    y, x = np.mgrid[:9, :8]
    for flux, x_0, y_0 in [(0, 0, 0), (-5, 1e9, -1e9), (1e300, 4, 4),
                           (1e-300, 4, 4)]:
        values = list(psf.parameters)
        values[:3] = flux, x_0, y_0
        assert np.isfinite(psf.evaluate(x, y, *values)).all()


def test_c10_fit_deriv_has_a_column_for_every_parameter(psf):
    if psf.fit_deriv is None:
        pytest.skip(reason='before 3.1 the grid of photutils has none')
    y, x = np.mgrid[:9, :8]
    columns = psf.fit_deriv(x, y, *psf.parameters)
    assert len(columns) == len(psf.param_names)
    assert all(np.shape(column) == (9, 8) for column in columns)


def test_c11_c12_copies_do_not_touch_each_other(psf):
    for duplicate in (psf.copy, lambda: copy.deepcopy(psf)):
        twin = duplicate()
        twin.flux = 77
        twin.x_0.bounds = (1, 2)
        assert psf.flux != 77
        assert psf.x_0.bounds == (None, None)
        assert np.isfinite(twin(3, 4))


def test_c13_the_bounding_box_surrounds_the_star(psf):
    psf.x_0, psf.y_0 = 30, 40
    (y_low, y_high), (x_low, x_high) = psf.bounding_box.bounding_box()
    assert x_low < 30 < x_high
    assert y_low < 40 < y_high


def test_c14_the_name_can_be_set(psf):
    psf.name = 5
    assert psf.copy().name == 5


def test_c15_the_repr_is_one_short_line():
    for name, make in MODELS.items():
        if not name.startswith('photutils'):
            assert '\n' not in repr(make())
            assert len(repr(make())) < 120


def test_c17_an_image_with_random_parameters_is_finite(psf):
    image, table = make_psf_model_image(
        (60, 55), psf, 4, flux=(100, 1000), min_separation=10, seed=1,
        model_shape=(15, 15))
    assert np.isfinite(image).all()
    assert len(table) > 0


def test_c17_random_component_parameters_make_a_psf():
    image, _ = make_psf_model_image(
        (60, 55), MultiGaussianPSFModel(), 4, flux=(100, 1000),
        fraction_1=(0, 1), rho_2=(-0.9, 0.9), x_stddev_1=(0.5, 2), seed=1,
        model_shape=(15, 15))
    assert np.isfinite(image).all()


def test_c18_unit_flux_is_the_sum_over_pixels(psf):
    psf.x_0, psf.y_0 = 27.3, 30.1
    y, x = np.mgrid[-20:80, -20:80]
    assert_allclose(psf(x, y).sum(), psf.flux.value, rtol=2e-3)


@pytest.mark.parametrize('group', [False, True])
def test_photometry_recovers_the_stars(psf, stars, group):
    phot = PSFPhotometry(psf, (9, 9),
                         grouper=SourceGrouper(8) if group else None)
    if not group:
        stars = stars[[0, 1, 3]]
    result = phot(draw(psf, stars), init_params=nearby(stars))
    check(result, stars)
    assert (result['flags'] == 0).all()
    assert len(phot.results.meta['psf_model']) < 4000


def test_c5_error_columns_are_in_the_order_of_the_parameters(stars, rng):
    psf = MODELS['K=3']()
    psf.y_0.fixed = True
    psf.x_stddev_1.fixed = False
    image = draw(psf, stars[:1])
    start = stars[:1].copy()
    phot = PSFPhotometry(psf, (9, 9))
    result = phot(image + rng.normal(0, 1, image.shape),
                  error=np.ones_like(image), init_params=start)
    covariance = phot.fit_info[0]['param_cov']
    assert covariance.shape == (3, 3)
    errors = np.sqrt(np.diag(covariance))
    assert_allclose(errors, [result[f'{name}_err'][0] for name
                             in ('flux', 'x', 'x_stddev_1')])


def test_c7_free_shapes_get_their_columns(stars):
    psf = MODELS['K=1']()
    psf.x_stddev_1.fixed = False
    truth = psf.copy()
    truth.x_stddev_1 = 1.4
    result = PSFPhotometry(psf, (11, 11))(draw(truth, stars[:1]),
                                          init_params=nearby(stars[:1]))
    assert_allclose(result['x_stddev_1_fit'], 1.4, rtol=1e-5)
    assert {'x_stddev_1_init', 'x_stddev_1_err'} <= set(result.colnames)


def test_c16_xy_bounds_hold(psf, stars):
    start = stars[:1].copy()
    start['x'] += 1
    result = PSFPhotometry(psf, (9, 9), xy_bounds=0.5)(
        draw(psf, stars[:1]), init_params=start)
    assert_allclose(result['x_fit'], start['x'] - 0.5, atol=1e-6)


@pytest.mark.parametrize('mode', ['new', 'all'])
def test_iterative_photometry_finds_the_hidden_star(psf, stars, mode):
    image = draw(psf, stars)
    phot = IterativePSFPhotometry(
        psf, (9, 9), DAOStarFinder(3, 3), aperture_radius=4, mode=mode,
        grouper=SourceGrouper(8), maxiters=2, sub_shape=(15, 15))
    result = phot(image)
    near = np.hypot(result['x_fit'] - stars['x'][0],
                    result['y_fit'] - stars['y'][0])
    assert near.min() < 0.05


def test_c26_images_of_the_model_and_the_residual(psf, stars):
    image = draw(psf, stars)
    phot = PSFPhotometry(psf, (9, 9), grouper=SourceGrouper(8))
    phot(image, init_params=nearby(stars))
    assert np.abs(phot.make_residual_image(image, psf_shape=(31, 31))).max(
        ) < 0.02 * image.max()
    assert phot.make_model_image(image.shape).shape == image.shape
    again = phot.results_to_init_params()
    check(phot(image, init_params=again), stars)


def test_units_and_nddata(psf, stars):
    image = draw(psf, stars[:2])
    mask = np.zeros(image.shape, bool)
    mask[14, 13] = True
    data = NDData(image * u.nJy, mask=mask,
                  uncertainty=StdDevUncertainty(np.ones(image.shape)))
    start = nearby(stars[:2])
    start['flux'] = start['flux'] * u.nJy
    phot = PSFPhotometry(psf, (9, 9))
    result = phot(data, init_params=start)
    assert result['flux_fit'].unit == u.nJy
    assert result['flux_err'].unit == u.nJy
    check(QTable({n: getattr(result[n], 'value', result[n]) for n in (
        'id', 'x_fit', 'y_fit', 'flux_fit')}), stars[:2], rtol=0, atol=0.05)
    assert phot.make_residual_image(data).unit == u.nJy


def test_forced_photometry(psf, stars):
    psf.x_0.fixed = psf.y_0.fixed = True
    start = stars.copy()
    start['flux'] = 1.0
    result = PSFPhotometry(psf, (9, 9), grouper=SourceGrouper(8))(
        draw(psf, stars), init_params=start)
    assert_allclose(result['flux_fit'], stars['flux'], rtol=1e-6)


def grouped_fluxes(psf, stars):
    """Return fluxes of two stars fitted as one group."""
    pair = stars[1:3]
    result = PSFPhotometry(psf, (9, 9), grouper=SourceGrouper(20))(
        draw(psf, pair), init_params=nearby(pair))
    result.sort('id')
    return result['flux_fit'] / pair['flux']


@pytest.fixture
def no_collector():
    """Keep the classes that photutils caches alive."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


@pytest.mark.usefixtures('no_collector')
def test_c20_eighteen_groups_with_six_grids_are_all_right(stars):
    grids = [make_grid((0, 20, 60), (0, 60), seed=seed) for seed in range(6)]
    fluxes = [grouped_fluxes(psf, stars) for _ in range(3) for psf in grids]
    assert_allclose(fluxes, 1, rtol=1e-5)


@pytest.mark.usefixtures('no_collector')
def test_c20_models_of_one_k_are_not_mixed_up(stars):
    rng = np.random.default_rng(5)
    mixtures = [narrow_mixture(3), some_mixture(rng), some_mixture(rng, 2)]
    fluxes = [grouped_fluxes(MultiGaussianPSFModel(
        mixture, pixel_integrated=integrated), stars)
        for _ in range(2) for mixture in mixtures for integrated in (0, 1)]
    assert_allclose(fluxes, 1, rtol=1e-5)


@pytest.mark.usefixtures('no_collector')
def test_c20_shapes_freed_or_fixed_later_are_fitted_or_not(stars):
    psf = MultiGaussianPSFModel(narrow_mixture(1))
    image = draw(psf, stars[1:3])
    wide = psf.copy()
    for free in (False, True, False, True):
        wide.x_stddev_1.fixed = not free
        wide.x_stddev_1 = 1.3
        result = PSFPhotometry(wide, (9, 9), grouper=SourceGrouper(20))(
            image, init_params=nearby(stars[1:3]))
        assert ('x_stddev_1_fit' in result.colnames) == free
        if free:
            assert_allclose(result['x_stddev_1_fit'], 1.2, rtol=1e-4)
        else:
            assert abs(result['flux_fit'][0] / stars['flux'][1] - 1) > 1e-3


@pytest.mark.usefixtures('no_collector')
def test_c20_fixed_flags_set_through_the_model_dict_count_too(stars):
    psf = MultiGaussianPSFModel(narrow_mixture(1))
    grouped_fluxes(psf, stars)
    psf.fixed['x_stddev_1'] = False
    result = PSFPhotometry(psf, (9, 9), grouper=SourceGrouper(20))(
        draw(psf, stars[1:3]), init_params=nearby(stars[1:3]))
    assert 'x_stddev_1_err' in result.colnames


def test_c20_leaves_no_trace_in_names_and_pickles(psf):
    public = {'MultiGaussianPSFModel': MultiGaussianPSFModel,
              'GriddedMixturePSF': GriddedMixturePSF}
    name = repr(psf).strip('<').partition('(')[0]
    if name not in public:
        return
    assert str(psf).startswith(f'Model: {name}\n')
    again = pickle.loads(pickle.dumps(psf))
    assert isinstance(again, public[name])
    assert repr(again) == repr(psf)
    assert inspect.getdoc(type(psf)) == inspect.getdoc(public[name])


def test_c19_pixel_values_are_values_at_integer_positions(psf, stars):
    star = stars[:1]
    star['x'], star['y'] = 21.0, 33.0
    image = draw(psf, star)
    assert np.unravel_index(image.argmax(), image.shape) == (33, 21)
    assert_allclose(image[33, 22], psf.evaluate(
        np.array([22]), np.array([33]), 3000, 21, 33, *psf.parameters[3:])[0])


def test_c21_every_star_of_a_group_keeps_its_own_free_shape(stars):
    psf = MultiGaussianPSFModel(narrow_mixture(1))
    image = np.zeros((60, 55))
    widths = [1.1, 1.4]
    for star, width in zip(stars[1:3], widths, strict=True):
        one = psf.copy()
        one.x_stddev_1 = width
        image += draw(one, QTable(star))
    psf.x_stddev_1.fixed = False
    result = PSFPhotometry(psf, (11, 11), grouper=SourceGrouper(20))(
        image, init_params=nearby(stars[1:3]))
    result.sort('id')
    assert_allclose(result['x_stddev_1_fit'], widths, rtol=1e-4)


def test_c22_a_pixel_may_appear_twice(psf):
    once = psf.evaluate(np.array([1.0, 2]), np.array([1.0, 2]),
                        *psf.parameters)
    twice = psf.evaluate(np.array([1.0, 2, 1]), np.array([1.0, 2, 1]),
                         *psf.parameters)
    assert_allclose(twice, [*once, once[0]])


def test_c13_model_images_of_photutils_use_the_bounding_box(psf, stars):
    table = Table(stars)
    table.rename_columns(['x', 'y'], ['x_0', 'y_0'])
    image = make_model_image((60, 55), psf, table)
    assert_allclose(image, draw(psf, stars), atol=2e-2 * image.max())


def test_c23_grids_are_drawn_as_photutils_draws_its_own():
    plt = pytest.importorskip('matplotlib.pyplot')
    psf = make_grid((0, 20, 50, 60), (0, 20, 40, 60))
    figure = psf.plot_grid()
    assert len(figure.axes) >= 1
    assert len(figure.axes[0].images) == 1
    plt.close(figure)


def test_c24_reading_and_writing_go_through_the_registry(capsys):
    for cls in (GriddedMixturePSF, MultiGaussianPSFModel, GaussianMixture):
        for method in (cls.read, cls.write):
            method.list_formats()
            listed = capsys.readouterr().out
            assert 'fits' in listed
            assert 'asdf' in listed


@pytest.mark.parametrize('name', [n for n in MODELS if 'grid' in n])
def test_c25_outside_the_grid_the_edge_rules(name):
    psf = MODELS[name]()
    y, x = np.mgrid[-5:6, -5:6]
    at_edge = psf.evaluate(x, y + 30.0, 1.0, 0.0, 30.0)
    outside = psf.evaluate(x - 40.0, y + 30.0, 1.0, -40.0, 30.0)
    assert_allclose(outside, at_edge, rtol=1e-9, atol=1e-12)
