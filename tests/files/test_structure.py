"""FITS and ASDF files whose structure is not what it says."""
import time

import asdf
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_array_equal

from helpers.psf_grids import make_grid
from photutils_mgauss import GriddedMixturePSF, read_psfex
from photutils_mgauss.files.epsfs import psf_kind
from photutils_mgauss.files.fits_files import label_of, open_fits
from photutils_mgauss.files.image_layers import (
    read_asdf_tree,
    read_layers,
    read_wcs,
)
from photutils_mgauss.files.tables import read_table

READERS = {
    'grid': GriddedMixturePSF.read, 'psfex': read_psfex, 'kind': psf_kind,
    'from_file': GriddedMixturePSF.from_file, 'image': read_layers,
    'wcs': read_wcs, 'table': read_table}

DATA = np.arange(12.0).reshape(3, 4)


def card(key, value):
    return f'{key:8}= {value:>20}'.ljust(80).encode()


def header(*cards, end=True):
    text = b''.join(card(*one) for one in cards) + b'END'.ljust(80) * end
    return text.ljust(-(-len(text) // 2880) * 2880)


IMAGE = (('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 0))
TABLE = (('XTENSION', "'BINTABLE'"), ('BITPIX', 8), ('NAXIS', 2))
ABSURD = {
    'axes': header(('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 10**9)),
    'size': header(('SIMPLE', 'T'), ('BITPIX', -64), ('NAXIS', 2),
                   ('NAXIS1', 10**9), ('NAXIS2', 10**9)),
    'negative': header(('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 1),
                       ('NAXIS1', -5)),
    'bits': header(('SIMPLE', 'T'), ('BITPIX', 77), ('NAXIS', 0)),
    'fields': header(*IMAGE) + header(*TABLE, ('NAXIS1', 0), ('NAXIS2', 0),
                                      ('TFIELDS', 10**9)),
    'rows': header(*IMAGE) + header(
        *TABLE, ('NAXIS1', 8), ('NAXIS2', 10**12), ('TFIELDS', 1),
        ('TFORM1', "'D       '")),
    'heap': header(*IMAGE) + header(
        *TABLE, ('NAXIS1', 8), ('NAXIS2', 0), ('PCOUNT', 10**15),
        ('TFIELDS', 1), ('TFORM1', "'D       '")),
    'width': header(*IMAGE) + header(
        *TABLE, ('NAXIS1', 8), ('NAXIS2', 0), ('TFIELDS', 1),
        ('TFORM1', "'1000000000D'")),
    'format': header(*IMAGE) + header(
        *TABLE, ('NAXIS1', 8), ('NAXIS2', 0), ('TFIELDS', 1),
        ('TFORM1', "'8Y      '")),
    'compressed': header(*IMAGE) + header(
        *TABLE, ('NAXIS1', 8), ('NAXIS2', 0), ('TFIELDS', 1),
        ('TFORM1', "'1PB(1)  '"), ('ZIMAGE', 'T'), ('ZNAXIS', 2),
        ('ZNAXIS1', 10**9), ('ZNAXIS2', 10**9)),
    'order': header(('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 0),
                    ('A_ORDER', 10**9)),
    'wcs axes': header(('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 0),
                       ('WCSAXES', 10**9)),
    'no end': header(*IMAGE, end=False),
    'no number': header(('SIMPLE', 'T'), ('BITPIX', 8), ('NAXIS', 'two')),
    'no extension': header(*IMAGE) + header(('XTENSIOM', "'IMAGE'"),
                                            ('BITPIX', 8), ('NAXIS', 0)),
}


@pytest.mark.parametrize('what', ABSURD)
@pytest.mark.parametrize('reader', READERS)
def test_absurd_sizes_are_refused_at_once(tmp_path, reader, what):
    path = tmp_path / 'absurd.fits'
    path.write_bytes(ABSURD[what])
    began = time.perf_counter()
    with pytest.raises(ValueError, match=r'absurd\.fits: must be'):
        READERS[reader](path)
    assert time.perf_counter() - began < 2


@pytest.mark.parametrize('reader', READERS)
def test_a_folder_and_a_missing_file_are_errors_of_the_system(tmp_path,
                                                              reader):
    (tmp_path / 'folder.fits').mkdir()
    with pytest.raises(IsADirectoryError, match='folder'):
        READERS[reader](tmp_path / 'folder.fits')
    with pytest.raises(FileNotFoundError, match='missing'):
        READERS[reader](tmp_path / 'missing.fits')


def test_bytes_after_the_last_extension_are_left_out(tmp_path):
    path = tmp_path / 'a.fits'
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(DATA)]).writeto(path)
    path.write_bytes(path.read_bytes() + b'\xbd\xcd' * 2000)
    with open_fits(path) as hdus:
        assert len(hdus) == 2
        assert_array_equal(hdus[1].data, DATA)


def test_padding_may_be_missing_but_not_data(tmp_path):
    path = tmp_path / 'a.fits'
    fits.PrimaryHDU(DATA).writeto(path)
    content = path.read_bytes()
    path.write_bytes(content[:2880 + DATA.nbytes])
    with open_fits(path) as hdus:
        assert_array_equal(hdus[0].data, DATA)
    path.write_bytes(content[:2880 + DATA.nbytes - 1])
    with pytest.raises(ValueError, match='truncated: extension 0 ends at'), \
            open_fits(path):
        raise AssertionError


def test_all_that_goes_wrong_while_a_file_is_open_names_it(tmp_path):
    path = tmp_path / 'a.fits'
    fits.PrimaryHDU(DATA).writeto(path)
    for error in (KeyError('x'), AssertionError(), MemoryError('2 EiB')):
        with pytest.raises(ValueError, match=r'a\.fits: must be'), \
                open_fits(path):
            raise error
    with pytest.raises(KeyboardInterrupt), open_fits(path):
        raise KeyboardInterrupt


@pytest.mark.parametrize(('names', 'versions', 'labels'), [
    (('A', 'B', ''), (1, 1, 1), ['A', 'B', '3']),
    (('A', 'A', 'B'), (1, 2, 1), ['A,1', 'A,2', 'B']),
    (('A', 'A', 'A'), (1, 1, 2), ['1', '2', 'A,2'])])
def test_every_extension_has_a_name_that_finds_it(tmp_path, names, versions,
                                                  labels):
    hdus = [fits.ImageHDU(DATA + i, name=name, ver=version)
            for i, (name, version) in enumerate(zip(names, versions,
                                                    strict=True))]
    path = tmp_path / 'a.fits'
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)
    with open_fits(path) as hdus:
        assert [label_of(hdus, hdu) for hdu in hdus[1:]] == labels
    for i, label in enumerate(labels):
        assert_array_equal(read_layers(path, ext=label).data, DATA + i)


def test_two_extensions_of_one_name_are_not_chosen_by_it(tmp_path):
    path = tmp_path / 'a.fits'
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(DATA, name='SCI', ver=1),
                  fits.ImageHDU(DATA, name='SCI', ver=2)]).writeto(path)
    with pytest.raises(ValueError, match='SCI,1, SCI,2'):
        read_layers(path, ext='SCI')


@pytest.mark.parametrize('cards', [
    {'CTYPE1': 'GLON-TAN', 'CTYPE2': 'DEC--TAN'},
    {'CD1_2': -1e-5, 'CD2_1': 1e-5},
    {'CRVAL1': 1e999},
    {'CRPIX2': 1e999}])
def test_a_wcs_that_cannot_be_used_is_left_out_with_a_word(tmp_path, cards):
    hdu = fits.PrimaryHDU(DATA)
    hdu.header.update({'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN',
                       'CRVAL1': 10.0, 'CRVAL2': 2.0, 'CRPIX1': 1.0,
                       'CRPIX2': 2.0, 'CD1_1': -1e-5, 'CD2_2': 1e-5,
                       'CD1_2': 0.0, 'CD2_1': 0.0})
    path = tmp_path / 'a.fits'
    hdu.writeto(path)
    assert read_layers(path).wcs is not None
    content = path.read_bytes()
    for key, value in cards.items():
        text = '1E999' if value == np.inf else f"'{value}'" if isinstance(
            value, str) else str(value)
        at = content.index(f'{key:8}='.encode())
        content = content[:at] + card(key, text) + content[at + 80:]
    path.write_bytes(content)
    with pytest.warns(UserWarning, match=r'a\.fits: has a WCS that cannot'):
        layers = read_layers(path)
    assert layers.wcs is None
    assert_array_equal(layers.data, DATA)
    with pytest.raises(ValueError, match=r'a\.fits: must be'):
        read_wcs(path)


@pytest.mark.parametrize('field', [8, 16, 24])
def test_blocks_of_asdf_files_end_in_the_file(tmp_path, field):
    path = tmp_path / 'a.asdf'
    asdf.AsdfFile({'data': DATA}).write_to(path)
    assert_array_equal(read_asdf_tree(path)['data'], DATA)
    content = bytearray(path.read_bytes())
    at = content.index(b'\xd3BLK') + 6 + field
    content[at:at + 8] = (2**40).to_bytes(8, 'big')
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r'a\.asdf: must be .* a block of'):
        read_asdf_tree(path)


def test_a_changed_byte_in_asdf_is_noticed(tmp_path):
    make_grid().write(tmp_path / 'a.asdf')
    content = bytearray((tmp_path / 'a.asdf').read_bytes())
    content[content.index(b'\xd3BLK') + 60] ^= 1
    (tmp_path / 'a.asdf').write_bytes(content)
    with pytest.raises(ValueError, match=r'(?i)undamaged, got .*checksum'):
        GriddedMixturePSF.read(tmp_path / 'a.asdf')


def test_an_absurd_time_is_no_time(tmp_path):
    hdu = fits.PrimaryHDU(DATA)
    hdu.header['MJD-OBS'] = 1e19
    hdu.header['EXPTIME'] = 10**30
    hdu.writeto(tmp_path / 'a.fits')
    assert read_layers(tmp_path / 'a.fits').cards.time is None


@pytest.mark.parametrize('key', ['BUNIT', 'EXPTIME', 'DATE-OBS', 'GAIN'])
def test_a_keyword_that_cannot_be_read_is_named(tmp_path, key):
    hdu = fits.PrimaryHDU(DATA)
    hdu.header[key] = 1.0
    hdu.header['OTHER'] = 1.0
    path = tmp_path / 'a.fits'
    hdu.writeto(path)
    content = path.read_bytes()
    for name, is_read in (('OTHER', True), (key, False)):
        at = content.index(f'{name:8}='.encode())
        bad = f"{name:8}= 'no end of the text".ljust(80).encode()
        path.write_bytes(content[:at] + bad + content[at + 80:])
        if is_read:
            assert_array_equal(read_layers(path).data, DATA)
        else:
            with pytest.raises(ValueError, match=rf'a\.fits: .*{key}'):
                read_layers(path)
