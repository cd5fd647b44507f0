"""Real images through the command line, compared with what was published."""
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose
from photutils.centroids import centroid_quadratic
from scipy.spatial import cKDTree

from photutils_mgauss import GriddedMixturePSF
from photutils_mgauss.cli import main

# Gaia DR3; the parallax [mas] is what is to be found.
PROXIMA = {'id': 'Proxima', 'ra': 217.39232147201, 'dec': -62.67607511683,
           'pmra': -3781.741, 'pmdec': 769.465, 'ra_error': 0.024,
           'dec_error': 0.034, 'pmra_error': 0.031, 'pmdec_error': 0.051,
           'ref_epoch': 2016.0}
PARALLAX = 768.07
# Where New Horizons was at JD 2458960.9214392 and a day later each [au].
PLACES = [(13.54424386977341, -42.00783711062694, -16.45274689344834),
          (13.54738349901722, -42.01476547758523, -16.45543302590108),
          (13.55052308985352, -42.02169372542808, -16.45811911170188),
          (13.55366264229301, -42.02862185419665, -16.46080516086695)]


def run(*words):
    assert main([*map(str, words), '--quiet']) == 0


@pytest.fixture
def lorri(realdata, tmp_path, monkeypatch, capsys):
    """Measure six images of Proxima from beyond Pluto; return their rows."""
    assert capsys.readouterr().err == ''
    folder = realdata('lorri_proxima')
    monkeypatch.chdir(tmp_path)
    images = sorted(folder.glob('*.fits'))
    reading = ['--ext', 0, '--error-ext', 'LORRI Error image', '--flags-ext',
               'LORRI Quality flag image']
    run('psf', *images, *reading, '--min-snr', 15, '--radius', 5,
        '--n-components', 3, '--degree', 0, '--output', 'psf/')
    run('photometry', *images, *reading, '--time-key', 'SPCUTCJD', '--psf',
        *sorted(Path('psf').iterdir()), '--fit-shape', 5, '--output', 'cat/')
    return QTable.read(folder / 'positions.ecsv')


@pytest.mark.long
def test_proxima_is_where_it_was_published_and_as_far_away(lorri, capsys):
    said = capsys.readouterr().err
    assert said.count('pixels are negative and have the error 0') == 12
    # Undersampled: optics integrated over pixels describe the stars.
    assert 'the PSF does not describe' not in said
    psf = GriddedMixturePSF.read(next(Path('psf').iterdir()))
    assert psf.pixel_integrated
    away = []
    for row in lorri:
        table = QTable.read(f'cat/{str(row["file"])[:-5]}_cat.ecsv')
        time = table.meta['mgauss']['exposure']['time']
        assert_allclose(time, 2000 + (row['jd_tdb'] - 2451545) / 365.25,
                        atol=1e-5)
        dx, dy = ((table[f'{axis}_fit'] - row[axis].value) for axis in 'xy')
        star = np.argmin(np.hypot(dx, dy))
        away += [dx[star] / row['x_err'].value, dy[star] / row['y_err'].value]
    assert np.sqrt(np.mean(np.square(away))) < 1.3
    Table({'jd_tdb': 2458960.9214392 + np.arange(4),
           **dict(zip('xyz', np.transpose(PLACES), strict=True))}).write(
        'observer.ecsv')
    Table([PROXIMA | {'parallax': 750.0}]).write('proxima.ecsv')
    words = ['motions', *sorted(Path('cat').iterdir()), '--parallax-of',
             'proxima.ecsv', '--observer', 'observer.ecsv', '--output']
    run(*words, 'plain')
    assert capsys.readouterr().err == ''
    star, = QTable.read('plain/motions.ecsv')
    error = star['parallax_error'].to_value(u.mas)
    assert error < 2
    assert abs(star['parallax'].to_value(u.mas) - PARALLAX) < 3 * error
    # The published errors of the positions, 0.10 pixels.
    run(*words, 'motions', '--systematic', 408)
    assert capsys.readouterr().err == ''
    star, = QTable.read('motions/motions.ecsv')
    assert star['id'] == 'Proxima'
    error = star['parallax_error'].to_value(u.mas)
    assert 3 < error < 6
    assert abs(star['parallax'].to_value(u.mas) - PARALLAX) < 1.5 * error


@pytest.mark.long
def test_a_crowded_infrared_image_becomes_a_catalogue(realdata, tmp_path,
                                                      monkeypatch):
    folder = realdata('spitzer_glimpse')
    monkeypatch.chdir(tmp_path)
    image = folder / 'spitzer_example_image.fits'
    # Its noise is found from EXPTIME, GAIN and FLUXCONV.
    reading = ['--sky-box', 32]
    run('psf', image, *reading, '--radius', 5, '--n-components', 3,
        '--degree', 0, '--output', 'psf.fits')
    run('photometry', image, *reading, '--psf', 'psf.fits', '--fit-shape', 5,
        '--output', 'stars.ecsv')
    with fits.open(image) as hdus:
        data, wcs = hdus[0].data.astype(float), WCS(hdus[0].header)
    stars = QTable.read('stars.ecsv')
    stars = stars[np.isfinite(stars['x_fit']) & (stars['flux_fit'] > 0)]
    flux = np.asarray(stars['flux_fit'].value)
    found = np.column_stack([stars['x_fit'], stars['y_fit']])
    known = Table.read(folder / 'spitzer_example_catalog.xml')
    away, row = cKDTree(found).query(np.column_stack(
        wcs.wcs_world2pix(known['l'], known['b'], 0)))
    near = away < 2
    assert near.sum() > 0.9 * len(known)
    offset = (found[row] - np.column_stack(wcs.wcs_world2pix(
        known['l'], known['b'], 0)))[near]
    # photutils has 0.13 and 0.30 pixels.
    assert (offset.std(axis=0) < [0.08, 0.1]).all()
    seen = (flux[row] * u.MJy / u.sr * (1.2 * u.arcsec)**2).to_value(u.mJy)
    ratio = np.log(seen / np.asarray(known['f4_5']))[near]
    assert 1.4826 * np.median(np.abs(ratio - np.median(ratio))) < 0.06
    assert_steady(data, flux, found)


def assert_steady(data, flux, found):
    """Compare isolated bright stars with centroids of their own pixels."""
    distance = cKDTree(found).query(found, k=2)[0][:, 1]
    inside = (np.abs(found - [512, 256]) < [500, 245]).all(axis=1)
    use = (distance > 6) & (flux > np.percentile(flux, 90)) & inside
    away = []
    for x, y in found[use]:
        i, j = round(x), round(y)
        sky = np.nanmedian(data[j - 7:j + 8, i - 7:i + 8])
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of peaks beside the middle
            centre = centroid_quadratic(data[j - 2:j + 3, i - 2:i + 3] - sky)
        away.append((x - (i - 2) - centre[0], y - (j - 2) - centre[1]))
    strips = found[use, 0] // 256
    medians = [np.nanmedian(np.array(away)[strips == n], axis=0)
               for n in range(4)]
    assert np.ptp(medians, axis=0).max() < 0.12
