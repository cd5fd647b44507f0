"""Crowded images whose noise is correlated: said, and put into errors."""
import warnings

import numpy as np
import pytest
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from astropy.wcs import WCS
from scipy.ndimage import convolve
from scipy.signal import correlate2d
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.utils.correlated_noise import correlation_of, no_pairs

SHAPE = (240, 230)
MIXTURE = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
                          [[[0.7, 0.05], [0.05, 0.6]], [[3, 0], [0, 3]]])
BILINEAR = np.full((2, 2), 0.25)
DROPS = np.array([[0.02, 0.1, 0.02], [0.1, 0.52, 0.1], [0.02, 0.1, 0.02]])
SINGLE = np.ones((1, 1))
WARNING = 'noise of neighbouring pixels is correlated'


def resampled(kernel):
    """Return the PSF of an image resampled with a kernel."""
    size = len(kernel) // 2
    shifts = np.mgrid[:len(kernel), :len(kernel)][::-1].reshape(2, -1).T
    parts = GaussianMixture(kernel.ravel(), shifts - float(size),
                            np.tile(1e-6 * np.eye(2), (len(shifts), 1, 1)))
    return GriddedMixturePSF([MIXTURE.convolve(parts)], [(0, 0)])


@pytest.fixture(scope='module')
def crowd():
    """Return a clean image of a star for every 45 pixels, and the stars."""
    rng = np.random.default_rng(11)
    n = SHAPE[0] * SHAPE[1] // 45
    x, y = rng.uniform(-0.5, SHAPE[1] - 0.5, n), rng.uniform(
        -0.5, SHAPE[0] - 0.5, n)
    flux = 10**rng.uniform(2.9, 5, n)
    clean = np.full(SHAPE, 60.0)
    for star in zip(x, y, flux, strict=True):
        clean += MIXTURE.render(SHAPE, *star[:2], flux=star[2])
    return clean, Table({'x': x, 'y': y, 'flux': flux})


def expose(clean, seed, kernel):
    """Return data and errors, resampled with a kernel."""
    error = np.sqrt(clean + 25)
    data = np.random.default_rng(seed).normal(clean, error)
    return (convolve(data, kernel, mode='nearest'),
            np.sqrt(convolve(error**2, kernel**2, mode='nearest')))


@pytest.mark.parametrize('kernel', [BILINEAR, DROPS])
def test_pulls_scatter_by_one(crowd, kernel):
    clean, stars = crowd
    results = {True: [], False: []}
    for correlated, tables in results.items():
        photometry = CrowdedMixturePhotometry(
            resampled(kernel), find_neighbors=False,
            correlated_noise=correlated)
        for seed in (1, 2):
            data, error = expose(clean, seed, kernel)
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter('always')
                tables.append(photometry(
                    data, error=error, init_params=stars))
            said = [str(one.message) for one in told
                    if WARNING in str(one.message)]
            assert len(said) == correlated
            assert (WARNING in tables[-1].meta[
                'noise_correlation']) == correlated
    # Stars that others do not hide.
    alone = (results[True][0]['flags'] == 0) & (results[True][1]['flags'] == 0)
    assert alone.sum() > 300
    for name in ('x', 'y', 'flux'):
        pulls = {which: np.std([
            ((one[f'{name}_fit'] - other[f'{name}_fit']) / np.hypot(
                one[f'{name}_err'], other[f'{name}_err']))[alone]])
            for which, (one, other) in results.items()}
        assert 0.88 < pulls[True] < 1.15
        assert pulls[False] > 1.1 * pulls[True]


@pytest.mark.long
def test_correlated_noise_is_not_taken_for_stars(crowd):
    clean, stars = crowd
    data, error = expose(clean, 3, BILINEAR)
    photometry = CrowdedMixturePhotometry(resampled(BILINEAR),
                                          tile_shape=128, overlap=40)
    with pytest.warns(AstropyUserWarning, match=WARNING):
        table = photometry(data, error=error)
    photometry.correlated_noise = False
    plain = photometry(data, error=error)
    tree = cKDTree(np.column_stack([stars['x'], stars['y']]))
    false = [np.sum(tree.query(np.column_stack(
        [one['x_fit'], one['y_fit']]))[0] > 1) for one in (table, plain)]
    assert false[0] < 0.25 * false[1]
    assert false[0] < 0.01 * len(stars)
    assert table['significance'].min() >= photometry.threshold
    assert len(table) > 0.96 * len(stars)
    # The search leaves a little less than there is.
    expected = correlate2d(BILINEAR, BILINEAR)[1, 2] / 0.25
    along = table.meta['noise_correlation'].split(' along')
    for part in along[:2]:
        assert abs(float(part.split()[-1]) - expected) < 0.12


def test_independent_noise_is_none(crowd):
    clean, _ = crowd
    data, error = expose(clean, 4, SINGLE)
    photometry = CrowdedMixturePhotometry(GriddedMixturePSF([MIXTURE],
                                                            [(0, 0)]))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        table = photometry(data, error=error)
    assert table.meta['noise_correlation'] == ''


def test_without_errors_nothing_is_looked_for(crowd):
    data, _ = expose(crowd[0], 5, BILINEAR)
    table = CrowdedMixturePhotometry(resampled(BILINEAR))(data)
    assert table.meta['noise_correlation'] == ''


@pytest.mark.long
def test_of_many_images_each_has_its_own(crowd):
    clean, _ = crowd
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.cdelt = -2e-5, 2e-5
    kernels = SINGLE, DROPS
    images = []
    for seed, kernel in enumerate(kernels):
        data, error = expose(clean, 20 + seed, kernel)
        images.append((NDData(data, StdDevUncertainty(error)),
                       resampled(kernel), wcs))
    tables = {}
    for correlated in (True, False):
        photometry = CrowdedMixturePhotometry(
            None, correlated_noise=correlated)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter('always')
            tables[correlated] = photometry.fit_images(images)
        said = [str(one.message) for one in told
                if WARNING in str(one.message)]
        assert len(said) == correlated
        if correlated:
            assert 'image 1' in said[0]
    one, other = tables[True], tables[False]
    assert one.meta['noise_correlation'][0] == ''
    assert WARNING in one.meta['noise_correlation'][1]
    growth = one['flux_err'] / other['flux_err']
    assert np.nanmax(np.abs(growth[:, 0] - 1)) < 1e-12
    assert np.nanmin(growth[:, 1]) > 1.05
    assert np.nanmedian(one['ra_error'] / other['ra_error']) > 1.03


def test_sums_of_no_pixels_say_nothing():
    assert correlation_of(no_pairs()) is None
