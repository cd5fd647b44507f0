"""Fluxes of images in MJy/sr as flux densities, and magnitudes."""
import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_area
from numpy.testing import assert_allclose

from helpers.star_images import MIXTURE
from photutils_mgauss import to_flux_densities
from photutils_mgauss.cli import main

SURFACE = u.MJy / u.sr


def some_stars(unit=SURFACE):
    return QTable({
        'x_fit': [10.0, 50.0, 90.0], 'y_fit': [20.0, 50.0, 80.0],
        'flux_init': [39.0, 9.0, 1.0] * unit,
        'flux_fit': [40.0, 10.0, -1.0] * unit,
        'flux_err': [0.4, 0.3, 0.3] * unit, 'local_bkg': [1.0, 1, 1] * unit})


def simple_wcs(scale=1.7e-5):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval, wcs.wcs.crpix = (150, 40), (51, 51)
    wcs.wcs.cd = scale * np.array([[-0.8, 0.6], [0.6, 0.8]])
    return wcs


def test_fluxes_are_multiplied_by_the_area_of_a_pixel():
    stars = some_stars()
    out = to_flux_densities(stars, pixel_area=2e-13 * u.sr)
    for name in ('flux_init', 'flux_fit', 'flux_err'):
        assert out[name].unit == u.Jy
        assert_allclose(out[name].value, stars[name].value * 2e-7)
        assert stars[name].unit == SURFACE
    assert out['local_bkg'].unit == SURFACE
    same = to_flux_densities(some_stars(u.kJy / u.arcsec**2),
                             pixel_area=0.01 * u.arcsec**2)
    assert_allclose(same['flux_fit'].value, [400, 100, -10])


def test_the_area_comes_from_the_wcs_where_it_is_not_given():
    wcs = simple_wcs()
    area = proj_plane_pixel_area(wcs) * u.deg**2
    expected = (some_stars()['flux_fit'] * area).to_value(u.Jy)
    out = to_flux_densities(some_stars(), wcs=wcs)
    assert_allclose(out['flux_fit'].value, expected, rtol=1e-6)
    given = to_flux_densities(some_stars(), wcs=wcs, pixel_area=1e-13 * u.sr)
    assert_allclose(given['flux_fit'][0].value, 4e-6)


def test_magnitudes_are_those_of_astropy():
    out = to_flux_densities(some_stars(), pixel_area=2e-13 * u.sr,
                            magnitudes=True)
    good = out[:2]
    assert_allclose(good['mag_ab'].value,
                    good['flux_fit'].to_value(u.ABmag))
    assert_allclose(good['mag_ab_err'].value[0], 2.5 / np.log(10) * 0.01)
    assert np.isnan(out['mag_ab'][2])
    again = to_flux_densities(out[:2]['flux_fit', 'flux_err'],
                              magnitudes=True)
    assert_allclose(again['mag_ab'].value, good['mag_ab'].value)


@pytest.mark.parametrize(('stars', 'area', 'words'), [
    (some_stars(), None, 'need pixel_area'),
    (some_stars(), 3 * u.m, 'must be a solid angle'),
    (some_stars(), -3 * u.sr, 'must be positive'),
    (some_stars(u.electron), 1e-13 * u.sr, 'in a unit like MJy/sr'),
    (some_stars(u.one), 1e-13 * u.sr, 'in a unit like MJy/sr'),
    (QTable({'flux_fit': [1] * u.Jy}), None, 'column flux_err')])
def test_what_is_no_surface_brightness_is_refused(stars, area, words):
    with pytest.raises(ValueError, match=words):
        to_flux_densities(stars, pixel_area=area)


# The command, on an image as the IRAC camera makes it.

GAIN, CONVERSION, SECONDS = 3.8, 0.1469, 23.6
ELECTRONS = GAIN * SECONDS / CONVERSION  # in one MJy/sr
FLUX, SKY = 2e4, 400.0  # electrons


@pytest.fixture
def image(tmp_path, rng):
    """Write an image in MJy/sr and its PSF; return header and writer."""
    x, y = (a.ravel() + rng.uniform(-0.5, 0.5, a.size)
            for a in np.meshgrid(np.arange(25.0, 200, 25),
                                 np.arange(25.0, 200, 25)))
    model = SKY + sum(MIXTURE.render((220, 220), a, b, flux=FLUX)
                      for a, b in zip(x, y, strict=True))
    header = fits.Header({
        'BUNIT': 'MJy/sr', 'GAIN': GAIN, 'FLUXCONV': CONVERSION,
        'EXPTIME': SECONDS, 'DATE-OBS': '2010-01-01T00:00:00'})
    data = (rng.poisson(model) / ELECTRONS).astype('f4')
    MIXTURE.write(tmp_path / 'psf.fits')

    def measure(*options):
        fits.writeto(tmp_path / 'image.fits', data, header, overwrite=True)
        code = main(['photometry', '--quiet', '--psf',
                     str(tmp_path / 'psf.fits'), '--output',
                     str(tmp_path / 'stars.ecsv'), *options,
                     str(tmp_path / 'image.fits')])
        return code or QTable.read(tmp_path / 'stars.ecsv')
    return header, measure


def test_the_noise_follows_from_the_keywords_of_the_camera(image):
    header, measure = image
    header['PIXAR_SR'] = 3e-11
    table = measure('--magnitudes')
    assert table['flux_fit'].unit == u.Jy
    true = FLUX / ELECTRONS * 3e-11 * 1e6
    pull = (table['flux_fit'].value - true) / table['flux_err'].value
    assert len(table) == 49
    assert 0.7 < pull.std() < 1.35
    assert_allclose(np.median(table['mag_ab'].value),
                    (true * u.Jy).to_value(u.ABmag), atol=0.01)


def test_without_them_the_message_says_what_to_give(image, capsys):
    header, measure = image
    del header['FLUXCONV']
    assert measure() != 0
    said = capsys.readouterr().err
    assert 'PHOTMJSR or FLUXCONV' in said
    table = measure('--gain', str(ELECTRONS))
    assert table['flux_fit'].unit == SURFACE
    assert_allclose(np.median(table['flux_fit'].value), FLUX / ELECTRONS,
                    rtol=0.01)
