"""Star lists of other programs, written here as their manuals show them."""
import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

import photutils_mgauss as mg
from helpers import star_list_files as files
from photutils_mgauss.files.star_lists import number_rows

KINDS = ('hst1pass', 'dolphot', 'daophot', 'starfinder', 'sextractor')


def read(path, kind, **options):
    return QTable.read(path, format=f'mgauss.{kind}', **options)


def written(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize('name', files.FILES)
def test_every_list_makes_an_epoch(tmp_path, name):
    kind, write = files.FILES[name]
    write(tmp_path / name)
    table = Table.read(tmp_path / name, format=f'mgauss.{kind}')
    assert table.colnames[:4] == ['x_fit', 'y_fit', 'x_err', 'y_err']
    assert str(table['x_fit'].unit) == str(table['y_err'].unit) == 'pix'
    assert (table['x_err'] > 0).all()
    assert (table['y_err'] > 0).all()
    assert table['flux_fit'][0] > table['flux_fit'][1] > 0
    assert 'id' not in table.colnames  # numbers differ between images
    epoch = mg.Epoch(table, time=2020.5, pixel_scale=40 * u.mas)
    assert len(epoch.table) == 2


def test_the_first_pixel_is_zero(tmp_path):
    """Positions (11, 21) where the first pixel is 1; (10.5, 20.5) at 0.5."""
    for name, (kind, write) in files.FILES.items():
        write(tmp_path / name)
        table = read(tmp_path / name, kind)
        assert_allclose([table['x_fit'][0].value, table['y_fit'][0].value],
                        [10.25, 20.5], atol=1e-9, err_msg=name)
        assert '(0, 0)' in table.meta['pixel_origin']


def test_hst1pass_by_the_letters_of_its_name(tmp_path):
    path = tmp_path / 'j8c0_flc.xymqXYk'
    path.write_text('# 2 stars\n11.25 21.5 -12.5 0.031 12.5 22.5 1\n'
                    '31.0 41.0 -10.0 0.052 32.0 42.0 2\n')
    table = read(path, 'hst1pass')
    assert_allclose(table['mag'], [-12.5, -10])
    assert_allclose(table['flux_fit'], [1e5, 1e4])
    assert_allclose(table['snr'], [np.sqrt(1e5), 100])
    # Photon noise of a Gaussian: its sigma over the square root of photons.
    assert_allclose(table['x_err'].value[1], 2 / 2.35482 / 100, rtol=1e-5)
    assert 'FWHM is 2 pix' in table.meta['position_errors']
    assert list(table['chip']) == [1, 2]
    assert_allclose(table['qfit'], [0.031, 0.052])
    corrected = read(path, 'hst1pass', frame='corrected', fwhm=1.0)
    assert_allclose(corrected['x_fit'].value, [11.5, 31])
    assert_allclose(corrected['x_raw'], [11.25, 31])
    assert_allclose(corrected['x_err'], table['x_err'] / 2)


@pytest.mark.parametrize('comment', [
    '#   ARG0007: OUT=XYmqxyrd', '#  X. Y. m. q. x. y. r. d.'])
def test_hst1pass_by_its_own_words(tmp_path, comment):
    path = written(tmp_path, 'stars.txt', f'{comment}\n'
                   '101.0 102.0 -10 0.02 1.0 2.0 150.1 2.2\n')
    table = read(path, 'hst1pass')
    assert_allclose([table['x_fit'][0].value, table['y_fit'][0].value],
                    [0, 1])
    assert_allclose(table['ra_file'], [150.1])


def test_hst1pass_errors_of_matched_lists(tmp_path):
    path = written(tmp_path, 'MATCHUP.XYMEEE',
                   '101.0 102.0 -10.0 0.010 0.020 0.005\n')
    table = read(path, 'hst1pass')
    assert_allclose([table['x_err'][0].value, table['y_err'][0].value],
                    [0.01, 0.02])
    assert_allclose(table['mag_err'], [0.005])
    assert_allclose(table['snr'], [2.5 / np.log(10) / 0.005])
    assert 'position_errors' not in table.meta


def test_hst1pass_columns_can_be_named(tmp_path):
    path = written(tmp_path, 'stars.dat', '1 2 -10\n')
    with pytest.raises(ValueError, match=r'stars.dat: must end in the let'):
        read(path, 'hst1pass')
    assert read(path, 'hst1pass', columns='xym')['mag'][0] == -10
    with pytest.raises(ValueError, match='must name 3 columns'):
        read(path, 'hst1pass', columns='xymq')
    with pytest.raises(ValueError, match=r"frame 'common', got x, y, m"):
        read(path, 'hst1pass', columns='xym', frame='common')


def test_dolphot_takes_the_filter_asked_for(tmp_path):
    path = tmp_path / 'phot'
    files.write_dolphot(path)
    table = read(path, 'dolphot')
    assert_allclose(table['mag'], [20.1, 23.4])
    assert_allclose(table['mag_err'], [0.011, 0.052])
    assert_allclose(table['snr'], [98.7, 20.4])
    assert_allclose(table['flux_fit'], [55.5, 2.7])
    assert_allclose(table['flux_err'], [0.55, 0.13])
    assert list(table['object_type']) == [1, 1]
    red = read(path, 'dolphot', filter='WFC3_F814W')
    assert_allclose(red['mag'], [19.2, np.nan])  # 99.999: not measured
    assert_allclose(red['instrumental_vegamag_magnitude_WFC3_F606W'],
                    [20.1, 23.4])
    with pytest.raises(ValueError, match='one of WFC3_F606W, WFC3_F814W'):
        read(path, 'dolphot', filter='F814W')


def test_dolphot_needs_its_columns(tmp_path):
    path = tmp_path / 'phot'
    files.write_dolphot(path)
    path.with_name('phot.columns').rename(tmp_path / 'other')
    with pytest.raises(ValueError, match=r'the file phot.columns beside it'):
        read(path, 'dolphot')
    assert len(read(path, 'dolphot', columns=tmp_path / 'other')) == 2


def test_allstar_as_daophot_and_iraf_write_it(tmp_path):
    tables = []
    for name in ('two.als', 'iraf.als'):
        files.FILES[name][1](tmp_path / name)
        tables.append(read(tmp_path / name, 'daophot'))
    for table in tables:
        assert list(table['number']) == [7, 9]
        assert_allclose(table['mag'], [14.25, 15.5])
        assert_allclose(table['mag_err'], [0.01, 0.03])
        assert_allclose(table['flux_fit'], 10**(0.4 * (25 - table['mag'])))
        assert_allclose(table['x_err'].value,
                        2 / 2.35482 * table['mag_err'] * np.log(10) / 2.5,
                        rtol=1e-5)
    assert_allclose(tables[0]['chi'], [0.95, 1.1])


def test_aperture_photometry_has_two_lines_a_star(tmp_path):
    files.FILES['two.ap'][1](tmp_path / 'two.ap')
    table = read(tmp_path / 'two.ap', 'daophot')
    assert_allclose(table['mag'], [15.0, 16.0])
    assert_allclose(table['mag_err'], [0.01, 0.02])
    assert_allclose(table['mag_2'], [14.9, np.nan])
    assert_allclose(table['sky'], [101.5, 102.5])


def test_allstar_of_iraf_is_as_good_as_its_manual_says(realdata):
    table = read(realdata('daophot_test') / 't3.als', 'daophot')
    truth = np.array([(41, 4), (8, 23), (31, 25), (29, 34), (36, 42),
                      (23, 7), (18, 8), (36, 22), (26, 22)]) - 1
    x, y = table['x_fit'].value, table['y_fit'].value
    assert_allclose(x, truth[:, 0], atol=0.12)
    assert_allclose(y, truth[:, 1], atol=0.12)
    away = np.hstack([x - truth[:, 0], y - truth[:, 1]])
    assert_allclose(np.sqrt(np.mean(away**2)), 0.040, atol=0.002)


def test_starfinder_lists_of_keck(realdata):
    path = min(realdata('keck_ob150029').glob('*.lis'))
    table = read(path, 'starfinder')
    assert table['name'][0] == 'ob150029'
    assert_allclose([table['x_fit'][0].value, table['y_err'][0].value],
                    [531.529, 0.008])
    assert mg.Epoch(table).mean_year == pytest.approx(2015.557)


def test_sextractor_errors_are_those_of_the_position_taken(tmp_path):
    files.FILES['stars.cat'][1](tmp_path / 'stars.cat')
    table = read(tmp_path / 'stars.cat', 'sextractor')
    # The ellipse of 0.05 and 0.02 pix, turned by 30 degrees.
    turn = np.array([[np.sqrt(3), -1], [1, np.sqrt(3)]]) / 2
    matrix = turn @ np.diag([0.05**2, 0.02**2]) @ turn.T
    assert_allclose(table['x_err'][0].value**2, matrix[0, 0])
    assert_allclose(table['y_err'][0].value**2, matrix[1, 1])
    assert_allclose(table['xy_cov'][0].value, matrix[0, 1])
    assert_allclose(table['mag'], [-10.5, -9.0])
    assert_allclose(table['flux_err'], [10, 11])


def test_ldac_chips_are_joined_or_chosen(tmp_path):
    path = tmp_path / 'two.ldac'
    files.write_ldac(path, chips=2)
    table = read(path, 'sextractor')
    assert list(table['chip']) == [0, 0, 1, 1]
    assert 'VIGNET' not in table.colnames
    one = read(path, 'sextractor', ext=1)
    assert len(one) == 2
    assert 'chip' not in one.colnames
    assert_allclose(one['x_err'].value, np.sqrt([1e-4, 4e-4]))
    with pytest.raises(ValueError, match='must have the chip ext = 2'):
        read(path, 'sextractor', ext=2)


def test_a_real_catalogue_of_sextractor(realdata):
    path = next(realdata('decam_psfex').glob('*findstars.fits'))
    table = read(path, 'sextractor')
    with fits.open(path) as hdus:
        rows = hdus['LDAC_OBJECTS'].data
        assert_allclose(table['x_fit'].value, rows['XWIN_IMAGE'] - 1)
    assert len(table) == 117
    assert (table['x_err'] > 0).all()


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('content', [b'', b'\x00\xff\x8a' * 50, b'NL\n',
                                     b'# one\n', b'1 2 3\n4 5\n'])
def test_damaged_lists_end_in_one_sentence(tmp_path, kind, content):
    path = tmp_path / 'bad.xym'
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r'bad\.xym.*must ') as info:
        read(path, kind)
    assert '\n' not in str(info.value)


@pytest.mark.parametrize('kind', KINDS)
def test_wrong_options_are_said_at_once(tmp_path, kind):
    path = written(tmp_path, 'a.xym', '1 2 3\n')
    with pytest.raises(TypeError, match='fhwm'):
        read(path, kind, fhwm=3)
    with pytest.raises(ValueError, match='fwhm must be'):
        read(path, kind, fwhm=-1)
    with pytest.raises(OSError, match=r'missing'):
        read(tmp_path / 'missing.xym', kind)


def test_a_word_in_place_of_a_number_is_shown(tmp_path):
    path = written(tmp_path, 'a.xym', '1 2 3\n4 five 6\n')
    with pytest.raises(ValueError, match=r"numbers in line 2, got 'five'"):
        read(path, 'hst1pass')


def test_numbers_are_those_that_python_reads(rng):
    values = rng.normal(size=(50, 4)) * 10.0**rng.integers(-300, 300, (50, 4))
    values[3, 1:] = np.nan, np.inf, -np.inf
    lines = ['', *(' '.join(map(repr, row)) for row in values.tolist()), ' ']
    assert_array_equal(number_rows(lines, 'list'), values)
    # What Fortran puts where a number has no room.
    lines[4] = ' '.join(['****', *map(repr, values[3, 1:].tolist())])
    values[3, 0] = np.nan
    assert_array_equal(number_rows(lines, 'list'), values)
    with pytest.raises(ValueError, match='4 columns in line 9'):
        number_rows([*lines[:8], '1 2 3'], 'list')
