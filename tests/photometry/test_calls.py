"""What one call of an object leaves behind, and what it says."""
import copy
import pickle
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_array_equal
from photutils.psf import CircularGaussianPRF, SourceGrouper

from helpers.psf_grids import make_grid
from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    MixtureFitter,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
    decode_psf_flags,
)

MIXTURE = GaussianMixture([1], [[0, 0]], [[[1.96, 0], [0, 1.96]]])
SHAPE = (60, 60)


def model():
    return MultiGaussianPSFModel(MIXTURE)


def scene(seed, n=8):
    """Return an image of stars, its errors and where to start."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(6, 54, (2, n))
    data = sum(MIXTURE.render(SHAPE, *place, flux=1e4)
               for place in zip(x, y, strict=True))
    return data + rng.normal(size=SHAPE), np.ones(SHAPE), QTable(
        {'x': x, 'y': y, 'flux': np.full(n, 9e3)})


# Threads.

def measure(photometry, image):
    """Return all that a thread may read after its call, as arrays."""
    data, error, start = image
    table = photometry(data, error=error, init_params=start)
    residual = photometry.make_residual_image(data, psf_shape=9)
    return [np.asarray(table['flux_fit']),
            np.asarray(photometry.results['x_fit']), residual,
            np.array(list(map(len, photometry.decode_flags())))
            if isinstance(photometry, CrowdedMixturePhotometry)
            else photometry.fit_info[0]['param_cov']]


@pytest.fixture
def quick_switches():
    """Let threads take turns very often."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


@pytest.mark.usefixtures('quick_switches')
@pytest.mark.parametrize(('make', 'n_calls'), [
    (partial(MixturePSFPhotometry, model(), 9), 30),
    (partial(MixturePSFPhotometry, model(), 9, grouper=SourceGrouper(9)), 30),
    (partial(MixturePSFPhotometry, CircularGaussianPRF(fwhm=3.3), 9), 4),
    (partial(CrowdedMixturePhotometry, model()), 6)],
    ids=['single', 'grouped', 'by photutils', 'crowded'])
@pytest.mark.filterwarnings('ignore:Photutils fits the stars',
                            'ignore:the PSF is too')
def test_threads_that_share_an_object_get_their_own_results(make, n_calls):
    scenes = [scene(1), scene(2, n=11)]
    alone = [measure(make(), image) for image in scenes]
    shared = make()

    def repeat(number):
        for _ in range(n_calls):
            for got, own in zip(measure(shared, scenes[number]),
                                alone[number], strict=True):
                assert_array_equal(got, own)

    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(repeat, (0, 1))) == [None, None]


@pytest.mark.usefixtures('quick_switches')
def test_threads_that_share_a_fitter_see_their_own_fit():
    fitter = MixtureFitter()
    y, x = np.mgrid[:15, :15]
    stamps = [MIXTURE.render((15, 15), 7.2, 6.9, flux=flux)
              for flux in (100, 1e5)]

    def repeat(number):
        for _ in range(40):
            start = MultiGaussianPSFModel(MIXTURE, flux=90, x_0=7, y_0=7)
            fitted = fitter(start, x, y, stamps[number])
            total = (stamps[number].ravel() + fitter.fit_info['fun']).sum()
            assert abs(total / fitted(x, y).sum() - 1) < 1e-9
        return True

    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(repeat, (0, 1)))


def test_who_has_not_called_an_object_sees_its_last_call():
    data, error, start = scene(1)
    photometry = MixturePSFPhotometry(model(), 9)
    with ThreadPoolExecutor(1) as pool:
        table = pool.submit(photometry, data, error=error,
                            init_params=start).result()
    assert photometry.results is table
    for twin in (copy.copy(photometry), copy.deepcopy(photometry),
                 pickle.loads(pickle.dumps(photometry))):
        assert_array_equal(twin.results['x_fit'], table['x_fit'])
        assert len(twin.fit_info) == len(start)


# One call does not change the next.

def test_groups_given_once_leave_the_grouper_where_it_is():
    data, error, start = scene(3)
    photometry = MixturePSFPhotometry(model(), 9, grouper=SourceGrouper(12))
    expected = photometry(data, error=error, init_params=start)
    grouped = start.copy()
    grouped['group_id'] = np.arange(1, len(start) + 1)
    assert_array_equal(photometry(data, error=error, init_params=grouped)[
        'group_size'], 1)
    assert photometry.grouper is not None
    again = photometry(data, error=error, init_params=start)
    assert_array_equal(again['group_size'], expected['group_size'])
    assert_array_equal(again['flux_fit'], expected['flux_fit'])
    assert max(again['group_size']) > 1


def test_a_call_that_fails_leaves_no_results():
    data, error, start = scene(3)
    photometry = MixturePSFPhotometry(model(), 9)
    photometry(data, error=error, init_params=start)
    with pytest.raises(ValueError, match='shape'):
        photometry(data[0], init_params=start)
    assert photometry.results is None
    assert photometry.fit_info == []


def test_fit_info_is_a_list():
    data, error, start = scene(3)
    photometry = MixturePSFPhotometry(model(), 9)
    assert photometry.fit_info == []
    photometry(data, error=error, init_params=start)
    assert type(photometry.fit_info) is list
    assert photometry.fit_info is photometry.fit_info
    assert all(set(info) == {'param_cov', 'status', 'message', 'nfev'}
               for info in photometry.fit_info)


def test_threads_can_be_counted():
    data, error, start = scene(3)
    plain = MixturePSFPhotometry(model(), 9)(data, error=error,
                                             init_params=start)
    for n in (1, 3):
        table = MixturePSFPhotometry(model(), 9, n_threads=n)(
            data, error=error, init_params=start)
        assert_array_equal(table['x_fit'], plain['x_fit'])
    with pytest.raises(ValueError, match='n_threads'):
        MixturePSFPhotometry(model(), 9, n_threads=0)
    with ThreadPoolExecutor(1) as pool, pytest.raises(
            ValueError, match='n_threads and executor'):
        MixturePSFPhotometry(model(), 9, n_threads=2, executor=pool)


# Fits that photutils does.

def free_model():
    psf = model()
    psf.x_stddev_1.fixed = False
    return psf


@pytest.mark.parametrize(('make', 'words'), [
    (lambda: (make_grid((0, 60), (0, 60)).to_gridded_psf(4, radius=12), None),
     'GriddedMixturePSF.from_gridded_psf'),
    (lambda: (make_grid((0, 60), (0, 60), interpolation='components'), None),
     "interpolation='blend'"),
    (lambda: (CircularGaussianPRF(fwhm=3), None), 'MultiGaussianPSFModel'),
    (lambda: (free_model(), None), r'x_stddev_1.fixed = True'),
    (lambda: (model(), TRFLSQFitter()), 'TRFLSQFitter. .* leave it out')])
def test_that_photutils_fits_is_said_once_with_the_remedy(make, words):
    data, error, start = scene(4, n=1)
    psf, fitter = make()
    photometry = MixturePSFPhotometry(psf, 9, fitter=fitter)
    with pytest.warns(AstropyUserWarning, match=words):
        photometry(data, error=error, init_params=start)
    with warnings.catch_warnings():
        warnings.filterwarnings('error', message='Photutils fits')
        warnings.filterwarnings('ignore', message='One or more')
        photometry(data, error=error, init_params=start)


# Flags.

def test_each_bit_of_a_flag_has_a_name():
    known = 1 | 8 | 128 | 2048
    own = [1 << k for k in range(16, 21)]
    names = decode_psf_flags(known + sum(own))
    assert len(set(names)) == len(names) == 9
    assert names[-3:] == ['not_a_star', 'not_detected', 'repeated_entry']
    assert decode_psf_flags(1 << 30) == ['unknown_bit_1073741824']
    assert decode_psf_flags(np.array([[0, 3], [8, 1 << 17]]),
                            return_bit_values=True) == [
        [[], [1, 2]], [[8], [131072]]]
    for wrong, error in ((2.5, TypeError), ([-1], ValueError)):
        with pytest.raises(error, match='flags'):
            decode_psf_flags(wrong)


def test_flags_of_crowded_tables_come_in_words():
    data, error, start = scene(5)
    mask = np.zeros(SHAPE, bool)
    i, j = round(start['x'][0]), round(start['y'][0])
    mask[j - 2:j + 3, i - 2:i + 3] = True
    start.add_row([start['x'][1] + 0.1, start['y'][1], 9e3])
    photometry = CrowdedMixturePhotometry(model())
    with pytest.raises(ValueError, match='call the object first'):
        photometry.decode_flags()
    table = photometry(data + 50, error=error, mask=mask, init_params=start)
    words = photometry.decode_flags()
    assert words == decode_psf_flags(table['flags'])
    assert 'mostly_masked' in words[0]
    assert 'repeated_entry' in words[1] + words[-1]
    assert list(map(len, words)) == [
        int(flag).bit_count() for flag in table['flags']]
