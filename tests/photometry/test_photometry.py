"""Laws of the fast photometry; the oracle is photutils itself."""
import warnings
from functools import partial

import astropy
import numpy as np
import pytest
from astropy import units as u
from astropy.modeling.fitting import TRFLSQFitter
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable
from astropy.utils import minversion
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import PSFPhotometry, SourceGrouper

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureFitter,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
)

SHAPE = (140, 150)
# For groups photutils has no derivatives. Before 7.2.3 and 8.0.2 astropy took
# differences over 1e-4 of a position then, the root of the step meant, and
# stopped that much beside the minimum.
COARSE_STEPS = not minversion(astropy, '7.2.3') or (
    minversion(astropy, '8.0.0') and not minversion(astropy, '8.0.2'))


def mixture(f):
    """Return a mixture that changes with f in (0, 1)."""
    return GaussianMixture.from_stddevs(
        [0.6, 0.3, 0.1], [[0, 0], [0.05 * f, 0.02], [-0.1, 0.1 * f]],
        [[0.9 + 0.2 * f, 0.95], [1.4, 1.3 + 0.1 * f], [2.6, 2.9]],
        [0.1 * f, -0.05, 0.02])


@pytest.fixture(scope='module')
def grid():
    xy = [(x, y) for y in (0, 70, 140) for x in (0, 75, 150)]
    return GriddedMixturePSF([mixture((x + y) / 300) for x, y in xy], xy)


def draw(psf, x, y, flux, noise=10.0, seed=1):
    """Return an image of stars with Poisson-like noise, and its errors."""
    stamps = psf.render(x, y, flux, 41)
    image = np.zeros((SHAPE[0] + 82, SHAPE[1] + 82))
    for stamp, left, low in zip(stamps, np.rint(x).astype(int) + 21,
                                np.rint(y).astype(int) + 21, strict=True):
        image[low:low + 41, left:left + 41] += stamp
    image = image[41:-41, 41:-41]
    error = np.sqrt(image + noise**2)
    rng = np.random.default_rng(seed)
    return image + error * rng.standard_normal(SHAPE), error


def isolated(rng, n=30):
    """Return positions on a loose lattice, and bright fluxes."""
    x, y = np.meshgrid(np.arange(12, 140, 21), np.arange(12, 130, 21))
    x = (x.ravel() + rng.uniform(-0.5, 0.5, x.size))[:n]
    y = (y.ravel() + rng.uniform(-0.5, 0.5, y.size))[:n]
    return x, y, 10 ** rng.uniform(4, 5.5, x.size)


def guess(x, y, flux, rng):
    return QTable({'x': x + rng.normal(0, 0.1, x.size),
                   'y': y + rng.normal(0, 0.1, x.size),
                   'flux': flux * rng.uniform(0.9, 1.1, x.size)})


def both(psf, data, shape=(9, 9), call=None, **kwargs):
    """Return the tables of photutils and ours."""
    tables = []
    for cls in (PSFPhotometry, MixturePSFPhotometry):
        with warnings.catch_warnings():
            warnings.filterwarnings('ignore', message='.*converged.*')
            warnings.filterwarnings('ignore', message='.*finite values.*')
            warnings.filterwarnings('ignore', message='Photutils fits the')
            tables.append(cls(psf, shape, **kwargs)(data, **call))
    return tables


def check_same(theirs, ours, *, grouped=False):
    """Check that two tables agree as promised."""
    tolerance = 3e-4 if grouped and COARSE_STEPS else 1e-5
    assert ours.colnames == theirs.colnames
    assert type(ours) is type(theirs)
    for name in ours.colnames:
        assert ours[name].dtype == theirs[name].dtype, name
        assert getattr(ours[name], 'unit', None) == getattr(
            theirs[name], 'unit', None), name
    ours, theirs = ({name: getattr(table[name], 'value', table[name])
                     for name in table.colnames} for table in (ours, theirs))
    for name in ('x_fit', 'y_fit'):
        assert_allclose(ours[name], theirs[name], rtol=0, atol=tolerance)
    assert_allclose(ours['flux_fit'], theirs['flux_fit'], rtol=tolerance)
    for name in ('x_err', 'y_err', 'flux_err', 'reduced_chi2'):
        assert_allclose(ours[name], theirs[name], rtol=0.01)
    for name in ('qfit', 'cfit'):
        assert_allclose(ours[name], theirs[name], rtol=1e-3, atol=1e-5)
    for name in ('id', 'group_id', 'group_size', 'n_pixels_fit', 'flags',
                 'x_init', 'y_init', 'flux_init', 'local_bkg'):
        assert_array_equal(ours[name], theirs[name], name)


def test_isolated_stars_come_out_as_from_photutils(grid, rng):
    x, y, flux = isolated(rng)
    data, error = draw(grid, x, y, flux)
    call = {'error': error, 'init_params': guess(x, y, flux, rng)}
    check_same(*both(grid, data, call=call))


def test_without_errors_the_scatter_scales_the_covariance(grid, rng):
    x, y, flux = isolated(rng, 8)
    data, _ = draw(grid, x, y, flux)
    call = {'init_params': guess(x, y, flux, rng)}
    theirs, ours = both(grid, data, call=call)
    check_same(theirs, ours)
    assert np.isnan(ours['reduced_chi2']).all()


@pytest.mark.parametrize('integrated', [False, True])
def test_one_mixture_for_all_comes_out_the_same(rng, integrated):
    psf = MultiGaussianPSFModel(mixture(0.3), pixel_integrated=integrated)
    x, y, flux = isolated(rng, 8)
    drawn = GriddedMixturePSF([mixture(0.3)], [(0, 0)],
                              pixel_integrated=integrated)
    data, error = draw(drawn, x, y, flux)
    call = {'error': error, 'init_params': guess(x, y, flux, rng)}
    check_same(*both(psf, data, call=call))


def test_grouped_stars_come_out_as_from_photutils(grid, rng):
    x, y, flux = isolated(rng, 12)
    x = np.concatenate([x, x[:9] + 2.6, x[:3] - 3.4])
    y = np.concatenate([y, y[:9] + 1.1, y[:3] + 2.8])
    flux = np.concatenate([flux, 0.5 * flux[:9], 0.8 * flux[:3]])
    data, error = draw(grid, x, y, flux)
    call = {'error': error, 'init_params': guess(x, y, flux, rng)}
    theirs, ours = both(grid, data, call=call, grouper=SourceGrouper(6))
    assert set(ours['group_size']) == {1, 2, 3}
    check_same(theirs, ours, grouped=True)


def test_masked_and_edge_stars_come_out_as_from_photutils(grid, rng):
    x = np.array([-1.2, 0.3, 149.2, 75.1, 60.4, 20.2, 100.3, -40, np.nan])
    y = np.array([70.2, 0.4, 139.3, 139.2, 60.7, 20.1, 100.2, 30, 30])
    flux = np.full(x.size, 1e5)
    drawn = np.isfinite(x) & (x > -20)
    data, error = draw(grid, x[drawn], y[drawn], flux[drawn])
    mask = np.zeros(SHAPE, bool)
    mask[60, 58:62] = mask[57:60, 61] = True
    mask[15:26, 15:26] = True
    mask[95:106, 95:106] = True
    mask[100, 100:102] = False
    data[63, 58] = np.nan
    mask[63, 58] = True
    start = guess(x, y, flux, rng)
    call = {'error': error, 'mask': mask, 'init_params': start}
    theirs, ours = both(grid, data, call=call)
    assert (ours['flags'] & 64).any()
    assert (ours['flags'] & 128).any()
    assert (ours['flags'] & 256).any()
    check_same(theirs, ours)


def test_a_nan_pixel_beside_a_mask_is_left_out(grid, rng):
    x, y, flux = isolated(rng, 2)
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    row, column = int(y[0]) + 2, int(x[0])
    mask = np.zeros(SHAPE, bool)
    mask[row, column] = True
    fit = MixturePSFPhotometry(grid, 9)
    masked = fit(data, error=error, mask=mask, init_params=start)
    data[row, column] = np.nan
    mask[row, column] = False
    mask[0, 0] = True
    with pytest.warns(UserWarning, match='finite'):
        table = fit(data, error=error, mask=mask, init_params=start)
    assert_array_equal(table['x_fit'], masked['x_fit'])
    assert_array_equal(table['n_pixels_fit'], [80, 81])


def test_quantities_and_nddata_give_units(grid, rng):
    x, y, flux = isolated(rng, 5)
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    plain = MixturePSFPhotometry(grid, 9)(data, error=error,
                                          init_params=start)
    start['flux'] = start['flux'] * 1.0
    nddata = NDData(data, uncertainty=StdDevUncertainty(error), unit='nJy')
    start['flux'] = start['flux'] << u.nJy
    theirs, ours = both(grid, nddata, call={'init_params': start})
    check_same(theirs, ours)
    assert_allclose(ours['flux_fit'].value, plain['flux_fit'], rtol=1e-12)


@pytest.mark.parametrize('dtype', ['f4', '>f4', '>f8', 'i4', '>i2'])
def test_images_of_any_type_are_fitted(grid, rng, dtype):
    x, y, flux = isolated(rng, 5)
    data, error = draw(grid, x, y, flux)
    data = np.round(data / 10).astype(dtype)
    start = guess(x, y, flux / 10, rng)
    start['local_bkg'] = 0.5
    fit = MixturePSFPhotometry(grid, 9)
    got = fit(data, error=error, init_params=start)
    want = fit(data.astype(float), error=error, init_params=start)
    assert_array_equal(got['flux_fit'], want['flux_fit'])


def test_forced_photometry_is_the_linear_solution(grid, rng):
    x, y, flux = isolated(rng, 6)
    data, error = draw(grid, x, y, flux)
    psf = grid.copy()
    psf.x_0.fixed = psf.y_0.fixed = True
    start = QTable({'x': x, 'y': y, 'flux': np.zeros(6)})
    theirs, ours = both(psf, data, call={'error': error,
                                         'init_params': start})
    check_same(theirs, ours)
    assert_array_equal(ours['x_fit'], x)
    assert np.isnan(ours['x_err']).all()


def test_bounds_hold_and_are_flagged(grid, rng):
    x, y, flux = isolated(rng, 6)
    data, error = draw(grid, x, y, flux)
    start = QTable({'x': x + 0.4, 'y': y, 'flux': flux})
    theirs, ours = both(grid, data, xy_bounds=0.2,
                        call={'error': error, 'init_params': start})
    assert_allclose(ours['x_fit'], start['x'] - 0.2, atol=1e-9)
    assert_allclose(ours['x_fit'], theirs['x_fit'], atol=1e-3)
    assert_array_equal(ours['flags'], theirs['flags'])
    assert_array_equal(ours['flags'], 32)


def test_another_fitter_is_left_to_photutils(grid, rng):
    from astropy.modeling.fitting import LMLSQFitter
    x, y, flux = isolated(rng, 3)
    data, error = draw(grid, x, y, flux)
    call = {'error': error, 'init_params': guess(x, y, flux, rng)}
    theirs, ours = both(grid, data, call=call, fitter=LMLSQFitter())
    assert_array_equal(ours['x_fit'], theirs['x_fit'])


def test_a_free_shape_is_left_to_photutils(rng):
    psf = MultiGaussianPSFModel(GaussianMixture(
        [1], [[0, 0]], [[[1, 0], [0, 1.2]]]))
    psf.x_stddev_1.fixed = False
    data = 1e4 * psf.mixture.render(SHAPE, 50.2, 60.1)
    start = QTable({'x': [50.], 'y': [60.], 'flux': [9e3],
                    'x_stddev_1': [1.2]})
    with pytest.warns(UserWarning, match='x_stddev_1.fixed = True'):
        table = MixturePSFPhotometry(psf, 9)(data, init_params=start)
    assert_allclose(table['x_stddev_1_fit'], 1, rtol=1e-6)
    assert_allclose(table['x_fit'], 50.2, rtol=1e-8)


def test_covariances_and_messages_come_with_each_star(grid, rng):
    x, y, flux = isolated(rng, 5)
    data, error = draw(grid, x, y, flux)
    x[2] = np.nan
    fit = MixturePSFPhotometry(grid, 9, xy_cov=True)
    start = guess(x, y, flux, rng)
    start['id'] = [5, 4, 3, 2, 1]
    table = fit(data, error=error, init_params=start)
    assert fit.fit_info[2] == {}
    assert len(fit.fit_info) == 5
    for i in (0, 1, 3, 4):
        info = fit.fit_info[i]
        assert info['status'] in (1, 2, 3, 4)
        errors = np.sqrt(np.diag(info['param_cov']))
        assert_allclose(errors, [table[f'{name}_err'][i]
                                 for name in ('flux', 'x', 'y')])
        assert_allclose(info['param_cov'][1, 2], table['xy_cov'][i])


def test_what_photutils_does_with_results_still_works(grid, rng):
    x, y, flux = isolated(rng, 5)
    data, error = draw(grid, x, y, flux)
    fit = MixturePSFPhotometry(grid, 9)
    fit(data, error=error, init_params=guess(x, y, flux, rng))
    residual = fit.make_residual_image(data)
    assert np.std(residual / error) < 1.1
    again = fit(data, error=error, init_params=fit.results_to_init_params())
    assert_allclose(again['x_fit'], again['x_init'], atol=1e-6)
    assert len(fit.decode_flags()) == 5
    assert 'MixturePSFPhotometry' in repr(fit)
    assert fit.results.meta['psf_class'] == 'MixturePSFPhotometry'


@pytest.mark.parametrize('value', [0, -1, np.nan, np.inf])
def test_an_error_that_is_not_positive_under_a_star_is_refused(
        grid, rng, value):
    x, y, flux = isolated(rng, 2)
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    error[-1, -1] = value
    fit = MixturePSFPhotometry(grid, 9)
    assert len(fit(data, error=error, init_params=start)) == 2
    error[int(y[1]), int(x[1])] = value
    with pytest.raises(ValueError, match='error must be positive'):
        fit(data, error=error, init_params=start)


def test_the_sky_is_fitted_on_request(grid, rng):
    x, y, flux = isolated(rng)
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    start['local_bkg'] = 5.0
    fit = MixturePSFPhotometry(grid, 15, fit_sky=True)
    table = fit(data + 12, error=error, init_params=start)
    pulls = (table['sky'] - 7) / table['sky_err']
    assert abs(pulls.mean()) < 0.5
    assert 0.7 < pulls.std() < 1.3
    pulls = (table['x_fit'] - x) / table['x_err']
    assert 0.7 < pulls.std() < 1.3


def test_one_star_is_not_troubled_by_another(grid, rng):
    x, y, flux = isolated(rng, 5)
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    fit = MixturePSFPhotometry(grid, 9)
    alone = fit(data, error=error, init_params=start)
    for bad in ({'x': 1e300}, {'x': -np.inf}, {'flux': np.nan},
                {'flux': 0.0}, {'flux': -1e9}, {'local_bkg': np.inf}):
        more = start.copy()
        more['local_bkg'] = 0.0
        row = {'x': 75.3, 'y': 70.2, 'flux': 10., 'local_bkg': 0., **bad}
        more.add_row([row[name] for name in more.colnames])
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            table = fit(data, error=error, init_params=more)
        assert_array_equal(table['x_fit'][:5], alone['x_fit'])
        assert_array_equal(table['flags'][:5], alone['flags'])


def test_images_one_pixel_wide_are_fitted_or_flagged(grid):
    start = QTable({'x': [10.], 'y': [0.], 'flux': [10.]})
    row = grid.render([10.], [0.], [100.], (1, 21))[0]
    table = MixturePSFPhotometry(grid, (1, 9))(row, init_params=start)
    assert_allclose(table['flux_fit'], 100, rtol=1e-3)


def test_no_stars_is_a_clear_error(grid):
    start = QTable({'x': [], 'y': [], 'flux': []}, dtype=[float] * 3)
    with pytest.raises(ValueError, match='at least one row'):
        MixturePSFPhotometry(grid, 9)(np.zeros(SHAPE), init_params=start)


def test_aperture_corrections_complete_the_flux(grid, rng):
    x, y, flux = isolated(rng, 4)
    data, error = draw(grid, x, y, flux)
    fit = MixturePSFPhotometry(grid, 9, aperture_radius_correction=3)
    table = fit(data, error=error, init_params=guess(x, y, flux, rng))
    want = [1 / grid.mixture_at(a, b).encircled_energy(3)
            for a, b in zip(table['x_fit'], table['y_fit'], strict=True)]
    assert_allclose(table['aperture_correction'], want, rtol=1e-8)


def test_the_fitter_serves_photutils_in_groups(grid, rng):
    x, y, flux = isolated(rng, 6)
    x = np.concatenate([x, x + 2.5])
    y = np.concatenate([y, y + 1.5])
    flux = np.concatenate([flux, flux])
    data, error = draw(grid, x, y, flux)
    start = guess(x, y, flux, rng)
    kwargs = {'grouper': SourceGrouper(6)}
    call = {'error': error, 'init_params': start}
    theirs = PSFPhotometry(grid, (9, 9), **kwargs)(data, **call)
    ours = PSFPhotometry(grid, (9, 9), fitter=MixtureFitter(),
                         **kwargs)(data, **call)
    check_same(theirs, ours, grouped=True)


@pytest.mark.parametrize('photometry', [
    MixturePSFPhotometry,
    partial(PSFPhotometry, fitter=MixtureFitter())])
def test_faint_stars_converge_too(grid, rng, photometry):
    # At a signal to noise of four the curvature of the residuals is as large
    # as that of the model, and undamped steps overshoot.
    x, y, _ = isolated(rng)
    flux = np.full(x.size, 180.0)
    data, error = draw(grid, x, y, flux)
    start = QTable({'x': x, 'y': y, 'flux': flux})
    table = photometry(grid, (9, 9))(data, error=error, init_params=start)
    assert 3 < np.median(table['flux_fit'] / table['flux_err']) < 6
    assert not (table['flags'] & 8).any()


@pytest.mark.parametrize('weighted', [False, True])
def test_the_fitter_does_not_mind_the_unit_of_flux_or_the_origin(
        rng, weighted):
    psf = mixture(0.3)
    y, x = np.mgrid[:11, :11]
    noise = 0.001 * rng.standard_normal(x.shape)
    data = psf.render(11, 5.3, 4.8) + noise
    found = []
    for flux, origin in ((1, 0), (1e-9, 0), (1e9, 0), (1, 2**14)):
        model = MultiGaussianPSFModel(psf, flux=0.8 * flux, x_0=5 + origin,
                                      y_0=5 + origin)
        weights = np.full(x.shape, 1e3 / flux) if weighted else None
        fitter = MixtureFitter()
        fit = fitter(model, x + origin, y + origin, flux * data,
                     weights=weights)
        assert fitter.fit_info['status'] == 3
        found.append([fit.flux.value / flux, fit.x_0.value - origin,
                      fit.y_0.value - origin])
    assert_allclose(found, [found[0]] * 4, rtol=0, atol=1e-8)
    step = np.array(found[0]) - [1, 5.3, 4.8]
    assert (abs(step) < [0.03, 0.03, 0.03]).all()


def test_the_fitter_takes_units_as_fitters_of_astropy_do():
    y, x = np.mgrid[:11, :11]
    model = MultiGaussianPSFModel(mixture(0.3), flux=0.8 * u.nJy,
                                  x_0=5 * u.pix, y_0=5 * u.pix)
    data = mixture(0.3).render(11, 5.3, 4.8) * u.nJy
    call = model, x * u.pix, y * u.pix, data
    ours, theirs = (fitter(*call) for fitter in (MixtureFitter(),
                                                 TRFLSQFitter()))
    for name in ('flux', 'x_0', 'y_0'):
        got, want = (getattr(fit, name).quantity for fit in (ours, theirs))
        assert got.unit == want.unit
        assert_allclose(got.value, want.value, atol=1e-6)


def test_the_fitter_refuses_masked_pixels_and_takes_an_empty_mask():
    y, x = np.mgrid[:11, :11]
    data = np.ma.array(mixture(0.3).render(11, 5.3, 4.8), mask=False)
    model = MultiGaussianPSFModel(mixture(0.3), x_0=5, y_0=5)
    assert_allclose(MixtureFitter()(model, x, y, data).x_0, 5.3, atol=1e-6)
    data[3, 3] = np.ma.masked
    with pytest.raises(ValueError, match='z must not have masked values, '
                                         'got 1'):
        MixtureFitter()(model, x, y, data)


def test_any_executor_gives_the_same_table(grid, rng):
    from concurrent.futures import ThreadPoolExecutor
    x, y, flux = isolated(rng)
    data, error = draw(grid, x, y, flux)
    call = {'error': error, 'init_params': guess(x, y, flux, rng)}
    want = MixturePSFPhotometry(grid, 9)(data, **call)
    with ThreadPoolExecutor(3) as pool:
        got = MixturePSFPhotometry(grid, 9, executor=pool)(data, **call)
    for name in want.colnames:
        assert_array_equal(got[name], want[name])
