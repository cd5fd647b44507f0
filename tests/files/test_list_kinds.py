"""Star lists are known by what is in them."""
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_array_equal

from helpers import star_list_files as files
from photutils_mgauss.files.list_kinds import program_of_list
from photutils_mgauss.files.tables import read_table

# Those whose names, or whose neighbours, have to say it.
NAMED = ('image_flc.xymq', 'phot')


@pytest.mark.parametrize('name', files.FILES)
def test_lists_are_known_by_their_content(tmp_path, name):
    program, write = files.FILES[name]
    path = tmp_path / (name if name in NAMED else 'table.txt')
    write(path)
    assert program_of_list(path) == program
    table, record = read_table(path)
    expected = QTable.read(path, format=f'mgauss.{program}')
    assert record == {}
    assert_array_equal(table['x_fit'], expected['x_fit'])
    assert table.meta == expected.meta


@pytest.mark.parametrize(('name', 'text'), [
    ('a.txt', ''), ('a.txt', '\n\n'), ('a.txt', 'Some words.\n'),
    ('a.csv', 'x,y\n1,2\n'), ('a.ecsv', '# %ECSV 1.0\n# ---\n'),
    ('a.txt', '1 2 3\n'), ('a.txt', '# x y m\n1 2 3\n'),
    ('a.xymq', '1 2 3\n'), ('a.txt', 'star 1 2 3 4 5 6 7 8\n')])
def test_other_texts_are_not_taken_for_lists(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    assert program_of_list(path) is None


@pytest.mark.parametrize(('name', 'columns', 'known'), [
    ('LDAC_OBJECTS', ['X_IMAGE'], True),
    ('OBJECTS', ['XWIN_IMAGE', 'YWIN_IMAGE'], True),
    ('OBJECTS', ['x_fit', 'y_fit'], False)])
def test_catalogues_in_fits_are_known_by_their_columns(tmp_path, name,
                                                       columns, known):
    hdu = fits.BinTableHDU.from_columns(
        [fits.Column(one, 'D', array=[1.0]) for one in columns], name=name)
    hdu.writeto(tmp_path / 'a.fits')
    assert (program_of_list(tmp_path / 'a.fits') == 'sextractor') is known


def test_a_list_without_its_head_is_named_by_its_ending(tmp_path):
    path = tmp_path / 'a.als'
    path.write_text('1 2 3 4\n')
    with pytest.raises(ValueError, match='must begin with the line NL'):
        read_table(path)


def test_long_lists_are_known_by_their_start(tmp_path, rng):
    path = tmp_path / 'a.txt'
    x, y = rng.uniform(1, 2000, (2, 3000))
    path.write_text(files.HEAD.format(1) + ''.join(
        f'{n} {x[n]:.3f} {y[n]:.3f} 14.0 0.01 100 4 1 0\n'
        for n in range(3000)))
    table, _ = read_table(path)
    assert len(table) == 3000
    assert np.abs(table['x_fit'].value - x + 1).max() < 1e-3
