"""``mgauss photometry --stars`` measures the stars of a list."""
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal

from helpers import star_list_files as files
from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main

SHAPE = 90, 100
PSF = GaussianMixture([1], [[0, 0]], [[[2.0, 0.2], [0.2, 1.8]]])
SCALE = 0.1  # arcsec per pixel
YEAR = 2020.5
X = np.array([20.3, 71.8, 45.1, 80.2, 12.6])
Y = np.array([30.7, 22.1, 60.4, 71.3, 75.9])
FLUX = np.array([9000.0, 7000.0, 8000.0, 6000.0, 500.0])
COMMAND = ['photometry', 'a.fits', '--psf', 'psf.fits', '--quiet',
           '--overwrite']


def tangent():
    wcs = WCS(naxis=2)
    wcs.wcs.crpix = 50, 40
    wcs.wcs.cdelt = -SCALE / 3600, SCALE / 3600
    wcs.wcs.crval = 83.0, -35.0
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    return wcs


@pytest.fixture(autouse=True)
def _files(tmp_path, monkeypatch, rng):
    """Write an image of five stars, one of them faint, and its PSF."""
    monkeypatch.chdir(tmp_path)
    data = rng.normal(20, 2, SHAPE)
    for x, y, flux in zip(X, Y, FLUX, strict=True):
        data += PSF.render(SHAPE, x, y, flux=flux)
    header = tangent().to_header()
    header['DATE-AVG'] = '2020-07-01T12:00:00'
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data, header, name='SCI'),
                  fits.ImageHDU(np.full(SHAPE, 2.0), name='ERR')]).writeto(
                      'a.fits')
    GriddedMixturePSF([PSF], [(0, 0)]).write('psf.fits')


def measured(table, *options, code=0):
    Path('list.ecsv').unlink(missing_ok=True)
    table.write('list.ecsv')
    assert main([*COMMAND, '--stars', 'list.ecsv', *options]) == code
    return QTable.read('a_cat.ecsv') if code == 0 else None


def on_sky():
    ra, dec = tangent().pixel_to_world_values(X, Y)
    return QTable({'ra': ra * u.deg, 'dec': dec * u.deg})


@pytest.mark.parametrize('crowded', [(), ('--crowded',)])
def test_the_stars_of_a_list_are_measured_and_no_others(crowded):
    rows = [4, 1, 0]
    found = measured(Table({'x': X[rows] + 0.3, 'y': Y[rows] - 0.2}),
                     *crowded)
    assert_array_equal(found['id'], [1, 2, 3])
    assert_allclose(found['x_fit'][1:], X[rows][1:], atol=0.05)
    assert_allclose(found['flux_fit'], FLUX[rows], atol=80)


def test_a_list_on_the_sky_goes_through_the_wcs(capsys):
    table = on_sky()
    table['x'] = X[::-1]
    table['y'] = Y
    # A star far outside keeps its number, and so do the others.
    table.insert_row(2, {'ra': 83.5 * u.deg, 'dec': -35 * u.deg, 'x': 1.0,
                         'y': 1.0})
    COMMAND.remove('--quiet')
    try:
        found = measured(table)
    finally:
        COMMAND.append('--quiet')
    assert_array_equal(found['id'], [1, 2, 4, 5, 6])
    assert_allclose(found['x_fit'][:4], X[:4], atol=0.05)
    assert ('5 of the 6 stars of list.ecsv are in the image, by their '
            'positions on the sky') in capsys.readouterr().out


def test_stars_of_gaia_are_where_they_have_moved_to():
    table, motion = on_sky(), np.array([40.0, -60.0])  # mas / yr
    passed = YEAR - 2016.0
    start = table.copy()
    start['dec'] -= motion[1] * passed * u.mas
    start['ra'] -= motion[0] * passed * u.mas / np.cos(table['dec'])
    start['pmra'], start['pmdec'] = motion * u.mas / u.yr
    start['ref_epoch'] = 2016.0 * u.yr
    found = measured(start, '--fixed')
    assert_allclose(found['x_fit'], X, atol=0.01)
    assert_allclose(found['y_fit'], Y, atol=0.01)
    # Without a known motion a star stays where it is.
    start['pmra'][0] = start['pmdec'][0] = np.nan
    found = measured(start, '--fixed')
    assert_allclose(found['x_fit'][0] - X[0],
                    motion[0] * passed / 1e3 / SCALE, atol=0.01)


def test_fixed_positions_are_those_of_the_list():
    found = measured(Table({'x_fit': X + 0.5, 'y_fit': Y}), '--fixed')
    assert_array_equal(found['x_fit'], X + 0.5)
    assert (found['flux_fit'][:4] < 0.97 * FLUX[:4]).all()


def test_lists_of_other_programs_are_read():
    Path('a.als').write_text(files.HEAD.format(1) + ''.join(
        f'{n} {x + 1:.4f} {y + 1:.4f} 15.0 0.0050 100. 4. 1. 0.\n'
        for n, (x, y) in enumerate(zip(X, Y, strict=True))))
    assert main([*COMMAND, '--stars', 'a.als', '--fixed']) == 0
    assert_allclose(QTable.read('a_cat.ecsv')['x_fit'], X, atol=1e-4)


@pytest.mark.parametrize(('table', 'options', 'words'), [
    ({'a': X}, (), "must have columns ra and dec, or x and y, got ['a']"),
    ({'x': X + 500, 'y': Y}, (), 'all 5 are outside, by their x and y'),
    ({'x': [], 'y': []}, (), 'must have at least 1 star, got none'),
    ({'x': X, 'y': Y}, ('--crowded', '--fixed'), 'without --crowded'),
    ({'x': X, 'y': Y}, ('--crowded', '--together'), 'without --together'),
    ({'x': X, 'y': Y}, ('--threshold', '4'), 'without --stars'),
])
def test_what_cannot_be_is_said_in_a_sentence(table, options, words, capsys):
    measured(Table(table), *options, code=1)
    assert words in capsys.readouterr().err


def test_positions_on_the_sky_need_a_wcs(capsys):
    with fits.open('a.fits', mode='update') as hdus:
        for name in ('CTYPE1', 'CTYPE2'):
            del hdus['SCI'].header[name]
    measured(on_sky(), code=1)
    assert 'must have a WCS for the ra and dec of list' in (
        capsys.readouterr().err)


def test_fixed_needs_a_list(capsys):
    assert main([*COMMAND, '--fixed']) == 1
    assert '--fixed must be given with --stars' in capsys.readouterr().err


def test_a_psf_takes_its_stars_from_a_list_on_the_sky(rng, capsys):
    stars = np.stack(np.meshgrid([12.0, 32, 52, 72], [15.0, 40, 65]))
    x, y = stars.reshape(2, -1) + rng.uniform(-3, 3, (2, 12))
    with fits.open('a.fits', mode='update') as hdus:
        data = rng.normal(20, 2, SHAPE)
        for place in zip(x, y, strict=True):
            data += PSF.render(SHAPE, *place, flux=9000)
        hdus['SCI'].data = data
    ra, dec = tangent().pixel_to_world_values(x, y)
    QTable({'ra': [*ra, 12.0] * u.deg, 'dec': [*dec, 3.0] * u.deg}).write(
        'list.ecsv')
    assert main(['psf', 'a.fits', '--stars', 'list.ecsv', '--output',
                 'new.fits', '--n-components', '1', '--degree', '0']) == 0
    said = capsys.readouterr().out
    assert '12 of the 13 stars of list.ecsv are in the image' in said
    found = GriddedMixturePSF.read('new.fits').mixture_at(50, 45)
    assert_allclose(found.covariances[0], PSF.covariances[0], atol=0.05)
