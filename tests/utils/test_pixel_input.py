"""All calls that take pixels accept the same forms and refuse the same."""
import warnings
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import photutils
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import (
    CCDData,
    InverseVariance,
    NDData,
    StdDevUncertainty,
    UnknownUncertainty,
    VarianceUncertainty,
)
from astropy.table import QTable, Table
from astropy.utils import minversion
from astropy.utils.exceptions import AstropyUserWarning
from astropy.utils.masked import Masked
from astropy.wcs import WCS
from numpy.testing import assert_allclose
from photutils.psf import CircularGaussianPRF

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    EmpiricalPSF,
    GaussianMixture,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
    adaptive_moments,
    assess_psf,
    compare_n_components,
    cramer_rao,
    fit_many,
    fit_mixture,
    fit_mixture_field,
    inject_and_recover,
    pixel_error,
    pixel_phase_error,
    sample_mixture,
    select_n_components,
    select_psf_stars,
)
from photutils_mgauss.fitting import posterior
from photutils_mgauss.utils.image import read_pixels, read_stack

SHAPE = (41, 43)
MIXTURE = GaussianMixture([1], [[0, 0]], [[[1.8, 0.2], [0.2, 1.6]]])
PSF = MultiGaussianPSFModel(MIXTURE)
STARS = Table({'x': [21.0], 'y': [20.0], 'flux': [15000.0]})
PLACES = STARS['x', 'y']
UNIT = u.Jy


def scene():
    """Return data, error and mask: whole numbers that 16 bits can hold."""
    rng = np.random.default_rng(5)
    light = MIXTURE.render(SHAPE, 21.2, 19.7, flux=15000)
    error = np.rint(np.sqrt(light + 30)) + rng.integers(0, 2, SHAPE)
    data = np.rint(light + error * rng.normal(size=SHAPE))
    mask = np.zeros(SHAPE, bool)
    mask[22, 23] = mask[5, 6] = True
    data[mask] = 1900
    return data, error, mask


DATA, ERROR, MASK = scene()


def numbers_of(*columns):
    """Return all numbers of columns, without units and NaN where masked."""
    return np.concatenate([np.ravel(np.ma.filled(np.ma.asarray(
        getattr(column, 'value', column), float), np.nan))
        for column in columns])


def table_numbers(table, *names):
    return numbers_of(*(table[name] for name in names)), table[names[-1]]


# Each call takes data, error and mask; it returns numbers, and the fluxes.

def call_fit_mixture(data, **kwargs):
    fit = fit_mixture(data, 1, **kwargs)
    return numbers_of(fit.mixture.means, fit.chi2, fit.residual), fit.flux


def call_fit_mixture_stack(data, **kwargs):
    fit = fit_mixture([data, data], 1, **kwargs)[1]
    return numbers_of(fit.mixture.means, fit.chi2, fit.residual), fit.flux


def call_compare(data, **kwargs):
    table = compare_n_components(data, [1], **kwargs)
    return (numbers_of(table['chi2'], table['r2_error'],
                       table['max_residual']),
            table.meta['fits'][0].flux)


def call_select_n(data, **kwargs):
    return numbers_of(select_n_components(data, [1, 2], max_residual=0.2,
                                          **kwargs)), None


def call_sample(data, **kwargs):
    found = sample_mixture(data, 1, draws=4, tune=0, chains=1, **kwargs)
    return numbers_of(found.fit.mixture.means, found.idata.pixels,
                      found.idata.errors), found.flux


def call_moments(data, **kwargs):
    found = adaptive_moments(data, **kwargs)
    return numbers_of(found.r2, found.e1, found.x, found.r2_err), found.flux


def call_select_stars(data, **kwargs):
    return table_numbers(select_psf_stars(data, STARS, **kwargs), 'x', 'snr',
                         'selected', 'peak', 'flux')


def call_find_stars(data, **kwargs):
    return table_numbers(select_psf_stars(data, threshold=100, **kwargs),
                         'x', 'snr', 'selected', 'peak', 'flux')


def call_field(data, **kwargs):
    field = fit_mixture_field(data, STARS, n_components=1, degree=0,
                              radius=6, **kwargs)
    return (numbers_of(field.coefficients, field.stars['x_fit']),
            field.stars['flux_fit'])


def call_exposures(data, error=None, mask=None):
    field = fit_mixture_field(
        [data, data], [STARS, STARS], n_components=1, degree=0, radius=6,
        error=[error] * 2, mask=[mask] * 2)
    return (numbers_of(field.coefficients, field.stars['x_fit']),
            field.stars['flux_fit'])


def call_empirical(data, **kwargs):
    found = EmpiricalPSF.from_stars(data, STARS, degree=0, radius=5,
                                    n_components=1, oversampling=1, **kwargs)
    return numbers_of(found.coefficients), None


def call_photometry(data, **kwargs):
    table = MixturePSFPhotometry(PSF, 9, aperture_radius=4)(
        data, init_params=PLACES, **kwargs)
    return table_numbers(table, 'x_fit', 'x_err', 'n_pixels_fit', 'flux_fit')


def call_photutils_engine(data, **kwargs):
    phot = MixturePSFPhotometry(CircularGaussianPRF(fwhm=3), 9,
                                aperture_radius=4)
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', message='Photutils fits the')
        table = phot(data, init_params=PLACES, **kwargs)
    return table_numbers(table, 'x_fit', 'x_err', 'n_pixels_fit', 'flux_fit')


def crowded():
    return CrowdedMixturePhotometry(PSF, background_size=None, maxiters=1,
                                    effective_gain=np.inf)


def call_crowded(data, **kwargs):
    table = crowded()(data, **kwargs)
    return table_numbers(table, 'x_fit', 'x_err', 'flux_fit')


def call_crowded_list(data, **kwargs):
    table = crowded()(data, init_params=STARS, **kwargs)
    return table_numbers(table, 'x_fit', 'x_err', 'flux_fit')


def call_inject(data, **kwargs):
    result = inject_and_recover(crowded(), data, (9000, 9900), rng=3,
                                separation=20, **kwargs)
    return table_numbers(result.stars, 'x_fit', 'recovered', 'flux_fit')


CALLS = {name.removeprefix('call_'): call
         for name, call in list(globals().items())
         if name.startswith('call_')}


@pytest.fixture(autouse=True)
def no_sampling(monkeypatch):
    """Let `sample_mixture` read pixels and look at them, without PyMC."""
    shapes = {'omega': (1, 4, 1), 'alpha': (1, 4, 1, 2), 'gamma': (1, 4, 1),
              'beta': (1, 4, 1, 2), 'flux': (1, 4), 'sigma': (1, 4)}

    class Found(dict):
        pass

    def sample(data, *_, **__):
        found = Found(posterior={
            name: SimpleNamespace(values=np.full(shape, 0.5))
            for name, shape in shapes.items()})
        found.pixels = data.values
        found.errors = [] if data.error is None else data.error
        return found
    monkeypatch.setattr(posterior, 'build_model', lambda data: data)
    monkeypatch.setattr(posterior, 'sample', sample)


# Each form takes plain data, error and mask and returns arguments.

def separate(data=np.asarray, error=None, mask=np.asarray):
    error = data if error is None else error
    return lambda d, e, m: {'data': data(d), 'error': error(e),
                            'mask': mask(m)}


def read_only(array):
    array = array.copy()
    array.flags.writeable = False
    return array


def strided(array):
    return np.repeat(np.repeat(array, 2, axis=0), 3, axis=1)[::2, ::3]


def with_type(name):
    return lambda array: array.astype(name)


def masked_both(d, e, m):
    halves = m & (np.arange(m.shape[1]) < 10), m & (np.arange(m.shape[1])
                                                    >= 10)
    return {'data': np.ma.array(d, mask=halves[0]),
            'error': np.ma.array(e, mask=halves[1])}


def nddata(uncertainty, power, unit=None, kind=NDData):
    def make(d, e, m):
        return {'data': kind(d, uncertainty=uncertainty(e**power), mask=m,
                             unit=unit)}
    return make


PLAIN = {
    'lists': separate(np.ndarray.tolist, mask=np.ndarray.tolist),
    'int16': separate(with_type('i2')),
    'int64': separate(with_type('i8')),
    'float16': separate(with_type('f2')),
    'float32': separate(with_type('f4')),
    'big-endian float': separate(with_type('>f4')),
    'big-endian double': separate(with_type('>f8')),
    'big-endian integer': separate(with_type('>i2')),
    'long double': separate(with_type('g')),
    'read-only': separate(read_only, mask=read_only),
    'Fortran': separate(np.asfortranarray, mask=np.asfortranarray),
    'strided': separate(strided, mask=strided),
    'reversed': separate(lambda a: a[::-1, ::-1].copy()[::-1, ::-1]),
    'mask of integers': separate(mask=with_type('u1')),
    'dimensionless': separate(lambda a: a * u.one),
    'masked data': lambda d, e, m: {'data': np.ma.array(d, mask=m),
                                    'error': e},
    'masked error': lambda d, e, m: {
        'data': d, 'error': np.ma.array(np.where(m, np.nan, e), mask=m)},
    'both masked': masked_both,
    'masked and mask': lambda d, e, m: {
        'data': np.ma.array(d), 'error': np.ma.array(e), 'mask': m},
    'Masked': lambda d, e, m: {'data': Masked(d, m), 'error': e},
    'NDData': nddata(StdDevUncertainty, 1),
    'NDData variance': nddata(VarianceUncertainty, 2),
    'NDData inverse variance': nddata(InverseVariance, -2),
    'NDData beside error': lambda d, e, m: {
        'data': NDData(np.ma.array(d, mask=m)), 'error': e},
}
WITH_UNIT = {
    'Quantity': separate(lambda a: a * UNIT),
    'other unit of error': separate(lambda a: a * UNIT,
                                    lambda e: 1000 * e * u.mJy),
    'Masked Quantity': lambda d, e, m: {'data': Masked(d * UNIT, m),
                                        'error': e * UNIT},
    'NDData unit': nddata(StdDevUncertainty, 1, UNIT),
    'NDData unit variance': nddata(VarianceUncertainty, 2, UNIT),
    'CCDData': nddata(StdDevUncertainty, 1, UNIT, CCDData),
}
FORMS = PLAIN | WITH_UNIT


@pytest.fixture(scope='module')
def expected():
    """Return the results of all calls with plain arrays, made once."""
    known = {}

    def find(name):
        if name not in known:
            known[name] = CALLS[name](DATA.copy(), error=ERROR.copy(),
                                      mask=MASK.copy())
        return known[name]
    return find


def skip_if_photutils_refuses(call, form):
    """From 3.1 on photutils takes no error beside an NDData."""
    if (form == 'NDData beside error' and 'phot' in call
            and minversion(photutils, '3.1')):
        pytest.skip(reason='photutils refuses it')


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('call', CALLS)
def test_every_call_takes_every_form(call, form, expected):
    numbers, flux = expected(call)
    arguments = FORMS[form](DATA.copy(), ERROR.copy(), MASK.copy())
    skip_if_photutils_refuses(call, form)
    before = {name: np.array(getattr(value, 'data', value))
              for name, value in arguments.items()}
    got, got_flux = CALLS[call](**arguments)
    assert_allclose(got, numbers, rtol=1e-5, atol=1e-6)
    if flux is not None:
        unit = UNIT if form in WITH_UNIT else None
        assert getattr(got_flux, 'unit', None) == unit
        assert_allclose(numbers_of(got_flux), numbers_of(flux), rtol=1e-6)
    for name, value in before.items():
        assert np.array_equal(value, np.array(getattr(
            arguments[name], 'data', arguments[name])), equal_nan=True), name


def test_the_masked_pixels_matter(expected):
    for name, call in CALLS.items():
        if name in ('select_n', 'inject', 'find_stars', 'sample'):
            continue
        numbers, _ = call(DATA, error=ERROR)
        assert (numbers.size != expected(name)[0].size
                or not np.allclose(numbers, expected(name)[0])), name


REFUSED = {
    'complex data': (
        {'data': DATA + 1j}, TypeError,
        r'(data|image) must be an array of numbers, got complex'),
    'words': (
        {'data': np.full(SHAPE, 'a')}, TypeError,
        r'(data|image) must be an array of numbers, got <U1'),
    'ragged': (
        {'data': [[1, 2], [3]]}, TypeError,
        r'(data|image) must be an array of numbers, got \[\[1'),
    'an HDU': (
        {'data': fits.ImageHDU(DATA)}, TypeError,
        r'must be an array of numbers, got ImageHDU: give its .data'),
    'objects': (
        {'data': DATA.astype(object)}, TypeError,
        r'(data|image) must be an array of numbers, got object'),
    'a line': (
        {'data': DATA[0]}, ValueError,
        r'(data|image) must have (the )?shape \(ny, nx\).* got \(43,\)'),
    'nothing': (
        {'data': DATA[:0]}, ValueError,
        r'(data|image) must have (the )?shape \(ny, nx\).* got \(0, 43\)'),
    'shape of error': (
        {'error': ERROR[:3, :4]}, ValueError,
        r'error must .* shape .*\(41, 43\).* got \(3, 4\)'),
    'shape of mask': (
        {'mask': MASK[:3, :4]}, ValueError,
        r'mask must .* shape .*\(41, 43\).* got \(3, 4\)'),
    'complex error': (
        {'error': ERROR + 1j}, TypeError,
        'error must be an array of numbers, got complex'),
    'mask of floats': (
        {'mask': MASK.astype(float)}, TypeError,
        'mask must be an array of bool, got dtype float64'),
    'mask of words': (
        {'mask': np.full(SHAPE, 'a')}, TypeError,
        'mask must be an array of bool, got dtype <U1'),
    'unit of data alone': (
        {'data': DATA * UNIT}, ValueError,
        r'error must have a unit, as (data|image) has Jy, got none'),
    'unit of error alone': (
        {'error': ERROR * UNIT}, ValueError,
        r'error must have no unit, as (data|image) has none, got Jy'),
    'unit of another kind': (
        {'data': DATA * UNIT, 'error': ERROR * u.m}, ValueError,
        'error must have a unit like Jy, got m'),
    'shape of its own mask': (
        {'data': NDData(DATA, mask=MASK[:3, :4]), 'error': None,
         'mask': None}, ValueError,
        r'mask must .* shape .*\(41, 43\).* got \(3, 4\)'),
    'unknown uncertainty': (
        {'data': NDData(DATA, uncertainty=UnknownUncertainty(ERROR)),
         'error': None, 'mask': None}, ValueError,
        r'(data|image) must have an uncertainty that .* got UnknownUnc'),
}


@pytest.mark.parametrize('case', REFUSED)
@pytest.mark.parametrize('call', CALLS)
def test_every_call_refuses_the_same_with_the_same_words(call, case):
    change, kind, words = REFUSED[case]
    if call in ('fit_mixture_stack', 'exposures') and case in (
            'a line', 'ragged', 'nothing', 'words'):
        pytest.skip(reason='a list of these is something else')
    arguments = {'data': DATA, 'error': ERROR, 'mask': MASK, **change}
    with pytest.raises(kind, match=words):
        CALLS[call](**arguments)


@pytest.mark.parametrize('call', ['fit_mixture', 'compare', 'moments'])
@pytest.mark.parametrize('bad', [0, -1, np.nan, np.inf])
def test_bad_errors_of_used_pixels_are_refused_where_all_count(call, bad):
    error = ERROR.copy()
    error[3, 3] = bad
    with pytest.raises(ValueError, match='error must be positive and finite'):
        CALLS[call](DATA, error=error, mask=MASK)
    mask = MASK.copy()
    mask[3, 3] = True
    plain = CALLS[call](DATA, error=ERROR, mask=mask)[0]
    assert_allclose(CALLS[call](DATA, error=error, mask=mask)[0], plain)


@pytest.mark.parametrize('call', ['field', 'exposures', 'crowded'])
@pytest.mark.parametrize('bad', [0, -1, np.nan, np.inf])
def test_bad_errors_mark_bad_pixels_in_images_of_stars(call, bad, expected):
    error = np.where(MASK, bad, ERROR)
    assert_allclose(CALLS[call](DATA, error=error)[0], expected(call)[0])


@pytest.mark.parametrize('call', sorted(set(CALLS) - {'exposures'}))
def test_one_number_is_the_error_of_all_pixels(call):
    one, many = (CALLS[call](DATA, mask=MASK, error=error)[0]
                 for error in (7.0, np.full(SHAPE, 7.0)))
    assert_allclose(one, many, rtol=1e-12)


# What takes no error and mask of its own.

@pytest.mark.parametrize('form', FORMS)
def test_fit_many_takes_every_form(form):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crpix, wcs.wcs.cdelt = (22, 21), (-1e-5, 1e-5)
    place = SkyCoord([0], [0], unit='deg')
    plain = fit_many([(NDData(DATA, mask=MASK), PSF, wcs)], place)
    arguments = FORMS[form](DATA.copy(), ERROR.copy(), MASK.copy())
    data = arguments['data']
    if isinstance(data, NDData):
        data.uncertainty = None
    elif not np.any(getattr(data, 'mask', False)):
        unit = UNIT if form in WITH_UNIT else None
        data = NDData(np.asarray(data), mask=MASK, unit=unit)
    if form in ('masked error', 'both masked'):
        pytest.skip(reason='it takes no error')
    table = fit_many([(data, PSF, wcs)], place)
    assert_allclose(numbers_of(table['flux_fit'], table['flux_err']),
                    numbers_of(plain['flux_fit'], plain['flux_err']),
                    rtol=1e-6)
    assert (table['flux_fit'].unit == UNIT) == (form in WITH_UNIT)


def test_images_of_psfs_may_be_masked():
    def truth(x, y):
        return np.ma.array(DATA, mask=MASK)

    def model(x, y):
        return DATA * UNIT

    table = assess_psf(model, truth, (1, 2), shape=(9, 9)).table
    real = adaptive_moments(DATA, mask=MASK)
    assert_allclose(table['r2'], real.r2)
    assert_allclose(table['size_error'],
                    real.relative_size_error(adaptive_moments(DATA)))


def test_errors_of_pixels_have_the_unit_of_the_light():
    light = np.maximum(DATA, 0)
    plain = pixel_error(light, sky=9, read_noise=2)
    for form in (light.astype('>f4'), light.tolist(), light.astype(int)):
        assert_allclose(pixel_error(form, sky=9, read_noise=2), plain)
    got = pixel_error(light * UNIT, sky=9 * UNIT, read_noise=2)
    assert got.unit == UNIT
    assert_allclose(got.value, plain)
    masked = pixel_error(np.ma.array(light, mask=MASK), sky=9, read_noise=2)
    assert_allclose(masked, np.where(MASK, np.nan, plain))
    with pytest.raises(ValueError, match='sky must have a unit like Jy'):
        pixel_error(light * UNIT, sky=9 * u.m)


def test_bounds_have_the_unit_of_the_flux():
    plain = cramer_rao(PSF, [1e4, 2e4], 5)
    bound = cramer_rao(PSF, [1e7, 2e7] * u.mJy, 5 * UNIT)
    assert bound.flux_err.unit == u.mJy
    assert_allclose(plain.x_err, cramer_rao(PSF, [1e4, 2e4] * UNIT,
                                            5 * UNIT).x_err)


def test_positions_may_be_masked_and_in_pixels_only():
    x = np.random.default_rng(3).uniform(0, 9, 50)
    plain = pixel_phase_error(x[:40], x[:40] + 0.1)
    masked = np.ma.array(x, mask=np.arange(50) >= 40)
    assert_allclose(pixel_phase_error(masked, x + 0.1).median, plain.median)
    assert_allclose(pixel_phase_error(x[:40] * u.pix, x[:40] + 0.1).median,
                    plain.median)
    with pytest.raises(ValueError, match='true must have no unit or be in '
                                         'pixels, got arcsec'):
        pixel_phase_error(x * u.arcsec, x)


def test_residuals_of_crowded_images_have_their_unit():
    phot = crowded()
    phot(DATA * UNIT, error=ERROR * UNIT, mask=MASK)
    for image in (DATA * UNIT, NDData(DATA, unit=UNIT)):
        assert phot.make_residual_image(image).unit == UNIT


@pytest.mark.parametrize('level', ['threshold', 'saturation'])
def test_levels_have_the_unit_of_the_image_or_none(level):
    given = {'threshold': 100, 'saturation': 500}
    plain = select_psf_stars(DATA, error=ERROR, mask=MASK, **given)
    given[level] = 1000 * given[level] * u.mJy
    table = select_psf_stars(DATA * UNIT, error=ERROR * UNIT, mask=MASK,
                             **given)
    assert table['reason'].tolist() == plain['reason'].tolist()
    with pytest.raises(ValueError, match=f'{level} must have no unit'):
        select_psf_stars(DATA, **given)


# Tables of stars.

NAMES = ['x y flux', 'x_fit y_fit flux_fit', 'x_init y_init flux_init',
         'x_0 y_0 flux_0', 'x_centroid y_centroid flux',
         'xcentroid ycentroid flux', 'x_peak y_peak flux']


def call_with_table(call, table):
    if call == 'crowded':
        return crowded()(DATA, error=ERROR, mask=MASK, init_params=table)[
            'x_fit']
    if call == 'select':
        return select_psf_stars(DATA, table, mask=MASK)['x']
    return fit_mixture_field(DATA, table, error=ERROR, mask=MASK, radius=6,
                             n_components=1, degree=0).stars['x_fit']


@pytest.mark.parametrize('kind', ['Table', 'QTable', 'masked'])
@pytest.mark.parametrize('names', NAMES)
@pytest.mark.parametrize('call', ['crowded', 'select', 'field'])
def test_tables_of_stars_are_read_alike(call, names, kind):
    values = dict(zip(names.split(), ([21.0, 5], [20.0, 6], [15000.0, 20]),
                      strict=True))
    plain = call_with_table(call, Table(dict(zip('xy', list(
        values.values())[:2], strict=True))))
    table = Table(values, masked=kind == 'masked')
    if kind == 'QTable':
        table = QTable({name: column * u.pix if name[0] in 'xy' else column
                        for name, column in values.items()})
    if kind == 'masked':
        table[names.split()[2]].mask[0] = True
    assert_allclose(call_with_table(call, table), plain, atol=1e-3)


@pytest.mark.parametrize('call', ['crowded', 'select', 'field'])
@pytest.mark.parametrize(('table', 'kind', 'words'), [
    ({'x': [1.0]}, TypeError, 'must be an astropy Table, got dict'),
    (Table({'x': [1.0]}), ValueError, "must have columns x.* got .*'x'"),
    (QTable({'x': [1.0] * u.deg, 'y': [1.0]}), ValueError,
     "column 'x' must have a unit like pix, got deg"),
    (Table({'x': ['a'], 'y': ['b']}), TypeError,
     "column 'x' must hold numbers")])
def test_tables_without_positions_are_refused_alike(call, table, kind, words):
    with pytest.raises(kind, match=words):
        call_with_table(call, table)


@pytest.mark.parametrize(('change', 'words'), [
    ({'data': np.full(SHAPE, np.nan)}, 'data has no pixel.*all are NaN'),
    ({'mask': np.ones(SHAPE, bool)}, 'no pixel.*all are masked'),
    ({'error': np.full(SHAPE, np.nan)}, 'no pixel.*error that is not'),
])
def test_an_image_without_a_pixel_is_said(change, words):
    given = {'data': DATA, 'error': ERROR, 'mask': MASK, **change}
    with pytest.warns(AstropyUserWarning, match=words):
        read_pixels(**given)


@pytest.mark.parametrize('sky', [0.0, 300.0])
@pytest.mark.parametrize('padding', [0, -32768])
def test_a_part_without_data_is_said_if_it_is_not_masked(rng, sky, padding):
    image = sky + rng.normal(0, 17, (120, 130))
    empty = np.add(*np.indices(image.shape)) < 60
    image[empty] = padding
    with pytest.warns(AstropyUserWarning, match=r'11 % of the pixels of data '
                      rf'have exactly the value {padding}.*give a mask'):
        read_pixels(image)
    read_pixels(image, None, empty)
    read_pixels(image, np.where(empty, 0, 1.0))
    # One without noise is no mosaic: it is a simulation.
    read_pixels(MIXTURE.render((200, 220), 90, 100, flux=1e4))
    read_pixels(np.zeros(SHAPE))


def test_padding_of_a_stack_is_said(rng):
    stack = 300 + rng.normal(0, 17, (5, 40, 50))
    stack[3:] = 0
    with pytest.warns(AstropyUserWarning, match='40 % of the pixels of image '
                      'have exactly the value 0'):
        read_stack(stack)
    read_stack(stack, mask=stack == 0)
    # Images of PSFs end in zeros, and have no noise.
    read_stack(np.stack([MIXTURE.render((60, 60), 30, 30)] * 3) *
               (np.hypot(*(np.indices((60, 60)) - 30)) < 20))
