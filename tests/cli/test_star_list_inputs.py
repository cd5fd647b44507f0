"""Commands that take tables of stars take the lists of other programs."""
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.testing import assert_array_equal

from helpers import star_list_files as files
from photutils_mgauss import GaussianMixture
from photutils_mgauss.cli import main

SCALE = 50.0  # mas per pixel
YEARS = 2016.5, 2018.5, 2020.5
ERRORS = (0.004, 0.005)


def tangent(year):
    wcs = WCS(naxis=2)
    wcs.wcs.crpix = 256, 256
    wcs.wcs.cdelt = -SCALE / 3.6e6, SCALE / 3.6e6
    wcs.wcs.crval = 83.0, -5.0
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    header = wcs.to_header()
    header['DATE-AVG'] = f'{int(year)}-07-01T00:00:00'
    return header


@pytest.fixture
def stars(rng, tmp_path, monkeypatch):
    """Return places (n, 2) [pix] and motions (n, 2) [pix/yr] of stars."""
    monkeypatch.chdir(tmp_path)
    return rng.uniform(20, 490, (60, 2)), rng.normal(0, 0.1, (60, 2))


def seen(stars, year, rng):
    places, motions = stars
    return (places + motions * (year - YEARS[1])
            + rng.normal(0, ERRORS, places.shape))


def write_als(name, xy):
    Path(name).write_text(files.HEAD.format(1) + ''.join(
        f'{n} {x:.4f} {y:.4f} 15.0 0.0050 100. 4. 1. 0.\n'
        for n, (x, y) in enumerate(xy + 1)))


def write_lis(name, xy, year):
    Path(name).write_text(''.join(
        f's{n} 15.0 {year:.3f} {x:.4f} {y:.4f} 0.004 0.005 200 0.99 8 1000\n'
        for n, (x, y) in enumerate(xy)))


def write_ldac(name, xy, header, flags):
    text = header.tostring(sep='', endcard=True, padding=False)
    cards = np.array([[text[i:i + 80] for i in range(0, len(text), 80)]])
    head = fits.BinTableHDU.from_columns([fits.Column(
        'Field Header Card', f'{cards.size * 80}A',
        dim=f'(80,{cards.size})', array=cards)], name='LDAC_IMHEAD')
    columns = [fits.Column(key, 'D', array=values) for key, values in (
        ('X_IMAGE', xy[:, 0] + 1), ('Y_IMAGE', xy[:, 1] + 1),
        ('ERRX2_IMAGE', np.full(len(xy), ERRORS[0]**2)),
        ('ERRY2_IMAGE', np.full(len(xy), ERRORS[1]**2)))]
    columns.append(fits.Column('FLAGS', 'I', array=flags))
    fits.HDUList([fits.PrimaryHDU(), head, fits.BinTableHDU.from_columns(
        columns, name='LDAC_OBJECTS')]).writeto(name)


def check_motions(folder, stars, sign, scale):
    """Compare with the truth, apart from the motion of them all."""
    table = QTable.read(f'{folder}/motions.ecsv')
    assert len(table) == len(stars[0])
    truth = stars[1] * [sign, 1] * scale
    got = np.stack([table[name].value for name in ('pmra', 'pmdec')], axis=1)
    errors = np.stack([table[f'{name}_error'].value
                       for name in ('pmra', 'pmdec')], axis=1)
    got, truth = got - got.mean(axis=0), truth - truth.mean(axis=0)
    # The rows have an order of their own.
    near = np.abs(got[:, None] - truth).sum(axis=2).argmin(axis=1)
    assert_array_equal(np.sort(near), np.arange(len(truth)))
    assert 0.4 < np.median(np.abs(got - truth[near]) / errors) < 1


def test_motions_of_lists_with_header_need_no_options(stars, rng, capsys):
    for year in YEARS:
        xy, flags = seen(stars, year, rng), np.zeros(len(stars[0]), int)
        # A truncated star beside those with neighbours.
        xy, flags = np.append(xy, [[3, 3 + year % 7]], axis=0), np.append(
            flags, 16)
        flags[:9] = 3
        write_ldac(f'{year}.ldac', xy, tangent(year), flags)
    assert main(['motions', '--transform', 'shift',
                 *(f'{year}.ldac' for year in YEARS)]) == 0
    said = capsys.readouterr().out
    assert '2016.5.ldac: left out 1 of 61 stars, which SExtractor' in said
    assert ('2016.5.ldac: 61 stars, a star list of SExtractor: the centre of '
            'the first pixel is (0, 0); SExtractor calls it (1, 1)') in said
    check_motions('mgauss_motions', stars, -1, SCALE)


def test_motions_of_lists_in_a_plane(stars, rng):
    for year in YEARS:
        write_lis(f'{year}.lis', seen(stars, year, rng), year)
    names = [f'{year}.lis' for year in YEARS]
    assert main(['motions', '--plane', '--output', 'out', '--match-radius',
                 '1.5', '--transform', 'shift', *names]) == 0
    check_motions('out', stars, 1, 1)


def test_motions_of_lists_with_wcs_and_time(stars, rng):
    for year in YEARS:
        write_als(f'{year}.als', seen(stars, year, rng))
    fits.PrimaryHDU(header=tangent(2018.5)).writeto('wcs.fits')
    names = [f'{year}.als' for year in YEARS]
    times = ['--time', *map(str, YEARS)]
    assert main(['motions', *names, *times, '--wcs', 'wcs.fits',
                 '--transform', 'shift']) == 0
    check_motions('mgauss_motions', stars, -1, SCALE)
    assert main(['motions', *names, *times, '--output', 'other']) == 1


def test_what_lists_lack_is_said(stars, rng, capsys):
    write_als('a.als', seen(stars, 2016, rng))
    write_als('b.als', seen(stars, 2018, rng))
    assert main(['motions', 'a.als', 'b.als', '--plane']) == 1
    assert 'a.als: the time must be known' in capsys.readouterr().err
    times = ['--time', '2016', '2018']
    assert main(['motions', 'a.als', 'b.als', '--plane', *times]) == 1
    assert '(--match-radius) must be given' in capsys.readouterr().err
    assert main(['motions', 'a.als', 'b.als', *times]) == 1
    assert 'give --wcs, or --plane' in capsys.readouterr().err


def test_the_psf_stars_may_be_a_list(rng, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mixture = GaussianMixture([1], [[0, 0]], [[[2.0, 0], [0, 2.0]]])
    data = rng.normal(50, 7, (120, 120))
    places = np.round(np.mgrid[20:101:20, 20:101:20].reshape(2, -1).T
                      + rng.uniform(-1, 1, (25, 2)), 3)
    for x, y in places:
        data += mixture.render(data.shape, x, y, flux=5e4)
    fits.writeto('night.fits', data.astype('f4'), fits.Header(
        {'BUNIT': 'electron'}))
    write_als('few.als', places[:16])
    QTable({'x_fit': places[:16, 0], 'y_fit': places[:16, 1]}).write(
        'few.ecsv')
    options = ['psf', 'night.fits', '--n-components', '1', '--degree', '0',
               '--radius', '7', '--grid-shape', '2', '2', '--read-noise', '7']
    psfs = []
    for suffix in ('als', 'ecsv'):
        assert main([*options, '--stars', f'few.{suffix}', '--output',
                     f'{suffix}.fits']) == 0
        psfs.append(fits.getdata(f'{suffix}.fits', 1))
    assert 'few.als: 16 stars, a star list of DAOPHOT' in (
        capsys.readouterr().out)
    assert_array_equal(psfs[0], psfs[1])
