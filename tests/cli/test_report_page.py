"""What the page of a report says first, and shows of the images."""
import json

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, GriddedMixturePSF, render_stars
from photutils_mgauss.cli.page import html_page
from photutils_mgauss.cli.sections import section_of
from photutils_mgauss.cli.seen_image import seen_image

PSF = GriddedMixturePSF(
    [GaussianMixture([1], [[0, 0]], [[[1.5, 0], [0, 1.5]]])] * 4,
    [(0, 0), (69, 0), (0, 63), (69, 63)])


@pytest.fixture
def measured(tmp_path, rng):
    """Write an image, its PSF and its catalogue; return the catalogue."""
    x, y = rng.uniform(10, 54, (2, 12))
    flux = rng.uniform(1e4, 3e4, 12)
    data = render_stars(PSF, x, y, flux, (64, 70)) + 50
    data += rng.normal(0, 7, data.shape)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, name='SCI'),
                  fits.ImageHDU(np.full(data.shape, 7.0), name='ERR')]
                 ).writeto(tmp_path / 'night.fits')
    PSF.write(tmp_path / 'psf.fits')
    table = QTable({'x_fit': x, 'y_fit': y, 'flux_fit': flux,
                    'x_err': np.full(12, 0.01), 'y_err': np.full(12, 0.01),
                    'flags': np.zeros(12, int),
                    'reduced_chi2': rng.normal(1, 0.02, 12)},
                   meta={'mgauss': {'exposure': {'image': 'night.fits'},
                                    'psf': 'psf.fits'}})
    table.write(tmp_path / 'night_cat.ecsv')
    return tmp_path / 'night_cat.ecsv'


def test_the_image_is_found_and_its_stars_taken_away(measured):
    table = QTable.read(measured)
    seen = seen_image(measured, table, table.meta['mgauss'])
    assert seen.data.shape == (64, 70)
    assert np.nanstd(seen.residual / seen.error) == pytest.approx(1, abs=0.1)
    (measured.parent / 'night.fits').unlink()
    assert seen_image(measured, table, table.meta['mgauss']) is None


def test_a_good_catalogue_is_called_good(measured):
    section = section_of(measured)
    assert section.verdict.good
    assert section.verdict.words.startswith('12 of 12 stars without flags')
    assert len(section.panels) == 4


def test_a_catalogue_with_the_wrong_psf_is_not(measured):
    table = QTable.read(measured)
    table['reduced_chi2'] *= 3
    table.write(measured, overwrite=True)
    assert not section_of(measured).verdict.good


def test_a_psf_of_few_stars_is_not_good(tmp_path):
    PSF.write(tmp_path / 'psf.fits')
    with fits.open(tmp_path / 'psf.fits', mode='update') as hdus:
        hdus[0].header['MGRUN'] = json.dumps({'n_stars': 20, 'degree': 4})
    verdict = section_of(tmp_path / 'psf.fits').verdict
    assert not verdict.good
    assert '20 stars for the 15 terms' in verdict.words


@pytest.mark.parametrize(('accuracy', 'good'), [(0.002, True), (0.03, False)])
def test_a_psf_that_misses_much_of_the_light_is_not_good(
        tmp_path, accuracy, good):
    PSF.write(tmp_path / 'psf.fits')
    with fits.open(tmp_path / 'psf.fits', mode='update') as hdus:
        hdus[0].header['MGRUN'] = json.dumps(
            {'n_stars': 11, 'degree': 1, 'accuracy': accuracy})
    verdict = section_of(tmp_path / 'psf.fits').verdict
    assert verdict.good == good
    assert ('it misses 3.0% of the light' in verdict.words) != good


def test_a_misfit_within_the_noise_is_put_into_words(tmp_path):
    PSF.write(tmp_path / 'psf.fits')
    with fits.open(tmp_path / 'psf.fits', mode='update') as hdus:
        hdus[0].header['MGRUN'] = json.dumps(
            {'n_stars': 11, 'degree': 0, 'accuracy': 0.0})
    facts = section_of(tmp_path / 'psf.fits').facts
    assert facts['Relative error left'] == 'none beyond the noise'
    assert facts['Degree over the detector'] == 0


def test_the_page_begins_with_the_verdicts(measured):
    page = html_page('title', [section_of(measured)],
                     {'date': 'today', 'version': '1'})
    first = page[:page.index('<section')]
    assert 'Good: 12 of 12 stars' in first
