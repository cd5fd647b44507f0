"""What ``mgauss info`` says of files, and what dry runs leave undone."""
import sys

import asdf
import gwcs
import numpy as np
import pytest
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling.models import (
    Pix2Sky_TAN,
    RotateNative2Celestial,
    Scale,
    Shift,
)
from astropy.table import QTable
from astropy.wcs import WCS
from gwcs import coordinate_frames

from helpers import star_list_files
from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main

MIXTURE = GaussianMixture([1], [[0, 0]], [[[1.5, 0], [0, 1.5]]])


@pytest.fixture
def folder(tmp_path, monkeypatch, rng):
    """Write an image, a PSF and a catalogue into the current folder."""
    monkeypatch.chdir(tmp_path)
    data = 50 + rng.normal(0, 7, (64, 70))
    for x, y in rng.uniform(10, 54, (12, 2)):
        data += MIXTURE.render((64, 70), x, y, flux=2e4)
    header = fits.Header({'BUNIT': 'electron', 'SATURATE': 60000.0})
    fits.writeto('night.fits', data.astype('f4'), header)
    GriddedMixturePSF([MIXTURE] * 4, [(0, 0), (69, 0), (0, 63),
                                      (69, 63)]).write('psf.fits')
    QTable({'id': ['a'], 'x_fit': [3.2], 'y_fit': [4.5], 'colour': [0.3]}
           ).write('stars.ecsv')
    return tmp_path


def test_info_says_what_each_file_is(folder, capsys):
    assert main(['info', 'night.fits', 'psf.fits', 'stars.ecsv']) == 0
    said = capsys.readouterr().out
    assert 'night.fits: an image\n  70 x 64 pixels' in said
    assert 'unit electron, saturation 60000.0' in said
    assert 'psf.fits: a PSF of this package\n  2 x 2 nodes of 1' in said
    assert 'FWHM 2.88 to 2.88 pix; sampled' in said
    assert 'stars.ecsv: a table of 1 rows' in said
    assert 'positions in pixels: x_fit, y_fit' in said
    assert '1 other columns: colour' in said


def test_info_says_what_keeps_an_image_from_being_measured(folder, capsys):
    fits.writeto('bare.fits', np.ones((40, 40), 'f4'))
    assert main(['info', 'bare.fits']) == 0
    said = capsys.readouterr().out
    assert 'not measurable as it is: the noise must be known' in said
    assert main(['info', 'missing.fits']) == 1


@pytest.mark.parametrize(('name', 'text'), [
    ('notes.md', '# Stars\n\nSome *words*.\n'),
    ('page.html', '<!DOCTYPE html><html><p>Stars</p></html>')])
def test_info_says_that_a_text_is_none_of_the_files(folder, capsys, name,
                                                    text, monkeypatch):
    # The package that astropy reads pages with may not be installed.
    monkeypatch.setitem(sys.modules, 'bs4', None)
    (folder / name).write_text(text)
    assert main(['info', name]) == 1
    assert capsys.readouterr().err.strip() == (
        f'mgauss: {name}: must be a table that astropy can read, got a file '
        'of none of the kinds that it recognises, nor a star list of '
        'DAOPHOT, DOLPHOT, hst1pass, SExtractor or StarFinder; images and '
        'PSFs are FITS or ASDF files, and other tables are read in Python '
        'with QTable.read(file, format=...) and written as ECSV')


def test_info_goes_on_after_files_that_are_none_of_its_kinds(folder, capsys):
    (folder / 'notes.md').write_text('# Stars\n\nSome *words*.\n')
    assert main(['info', 'missing.fits', 'night.fits', 'notes.md',
                 'stars.ecsv']) == 1
    said, wrong = capsys.readouterr()
    assert 'night.fits: an image' in said
    assert 'stars.ecsv: a table of 1 rows' in said
    first, last = wrong.splitlines()
    assert first.startswith('mgauss: missing.fits: must be a file')
    assert last.startswith('mgauss: notes.md: must be a table')


def test_info_says_what_the_files_of_a_folder_are(folder, capsys):
    assert main(['info', str(folder)]) == 0
    said = capsys.readouterr().out
    assert 'night.fits: an image' in said
    assert 'stars.ecsv: a table of 1 rows' in said


def test_info_reads_models_of_psfex_before_it_calls_them_so(folder, capsys):
    hdu = fits.BinTableHDU.from_columns([fits.Column(
        'PSF_MASK', '1875E', dim='(25,25,3)',
        array=np.ones((1, 3, 25, 25)))], name='PSF_DATA')
    hdu.header.update(POLNAXIS=2, POLNGRP=1, POLNAME1='X_IMAGE',
                      POLNAME2='Y_IMAGE', POLGRP1=1, POLGRP2=1, POLZERO1=1.0,
                      POLZERO2=1.0, POLSCAL1=1.0, POLSCAL2=1.0, POLDEG1=1,
                      PSF_SAMP=0.5, PSFNAXIS=3, PSFAXIS1=25, PSFAXIS2=25,
                      PSFAXIS3=3)
    hdu.writeto('good.psf')
    hdu.header['POLDEG1'] = 2
    hdu.writeto('bad.psf')
    assert main(['info', 'good.psf']) == 0
    assert ('25 x 25 samples of 0.5 pix, 3 terms of a polynomial of X_IMAGE '
            'and Y_IMAGE') in capsys.readouterr().out
    assert main(['info', 'bad.psf']) == 1
    assert 'undamaged PSFEx model' in capsys.readouterr().err


def test_info_says_whose_star_list_a_file_is(folder, capsys):
    for name, (_, write) in star_list_files.FILES.items():
        write(folder / name)
    assert main(['info', *star_list_files.FILES]) == 0
    said = capsys.readouterr().out
    for name, program in (('phot', 'DOLPHOT'), ('two.als', 'DAOPHOT'),
                          ('image_flc.xymq', 'hst1pass'),
                          ('keck.lis', 'StarFinder'),
                          ('stars.ldac', 'SExtractor')):
        assert f'{name}: a star list of {program}, 2 stars' in said
    assert 'the centre of the first pixel is (0, 0); DOLPHOT calls it' in said
    assert 'photon noise of a star whose FWHM is 2 pix' in said
    assert said.count('motions takes it with --wcs or --plane and --time') == 8
    assert 'of its image: no WCS, time unknown' in said


def write_grids(cube):
    """Write a STDPSF file of two chips, a grid of STPSF and an ePSF."""
    header = fits.Header({'NXPSFS': 2, 'NYPSFS': 4})
    header.update({f'IPSFX{i + 1:02d}': x for i, x in enumerate((1, 2048))})
    header.update({f'JPSFY{i + 1:02d}': y
                   for i, y in enumerate((1, 2048, 2049, 4096))})
    fits.writeto('std.fits', cube, header)
    header = fits.Header({'OVERSAMP': 5, 'DET_SAMP': 5, 'FOVPIXEL': 5})
    header.update({f'DET_YX{i}': f'({y}, {x})' for i, (x, y) in enumerate(
        ((0, 0), (900, 0), (0, 500), (900, 500)))})
    fits.writeto('st.fits', cube[:4], header)
    fits.writeto('epsf.fits', cube[0], fits.Header({'OVERSAMP': 3}))


def test_info_says_what_is_in_psfs_of_other_programs(folder, capsys):
    write_grids(np.ones((8, 25, 25)))
    assert main(['info', 'std.fits', 'st.fits', 'epsf.fits']) == 0
    said = capsys.readouterr().out
    nodes = '2 x 2 nodes, x 0 to 2047, y 0 to 2047; images of 25 x 25'
    assert f'  detector 1: {nodes} samples, 4 to a pixel\n' in said
    assert f'  detector 2: {nodes} samples, 4 to a pixel\n' in said
    assert '  2 PSFs: choose one with --detector\n' in said
    assert ('  extension 0: 2 x 2 nodes, x 0 to 900, y 0 to 500; images of '
            '25 x 25 samples, 5 to a pixel\n') in said
    assert '  extension 0: an image of 25 x 25 samples, 3 to a pixel' in said
    assert main(['info', 'std.fits', '--detector', '2']) == 0
    assert 'detector 1' not in capsys.readouterr().out
    assert main(['info', 'std.fits', '--detector', '3']) == 1


def test_info_says_what_a_wcs_alone_is(folder, capsys):
    frames = [(coordinate_frames.Frame2D(name='detector'),
               Shift(-10) & Shift(-20) | Scale(1e-5) & Scale(1e-5)
               | Pix2Sky_TAN() | RotateNative2Celestial(83, -5, 180)),
              (coordinate_frames.CelestialFrame(
                  name='sky', reference_frame=ICRS()), None)]
    asdf.AsdfFile({'wcs': gwcs.WCS(frames)}).write_to('wcs.asdf')
    asdf.AsdfFile({'words': 'none'}).write_to('words.asdf')
    plain = WCS(naxis=2)
    plain.wcs.crpix, plain.wcs.crval = (11, 21), (83, -5)
    plain.wcs.cdelt, plain.wcs.ctype = (-1e-5, 1e-5), ('RA---TAN', 'DEC--TAN')
    fits.PrimaryHDU(header=plain.to_header()).writeto('wcs.fits')
    assert main(['info', 'wcs.asdf', 'wcs.fits']) == 0
    said = capsys.readouterr().out
    for name, kind in (('wcs.asdf', 'a gwcs'), ('wcs.fits', 'a FITS WCS')):
        assert (f'{name}: a WCS without an image\n  {kind} of an image of '
                'unknown size; pixel (0, 0) is at ra 8') in said
    bounded = gwcs.WCS(frames)
    bounded.bounding_box = ((5, 95), (5, 95))
    asdf.AsdfFile({'wcs': bounded}).write_to('part.asdf')
    assert main(['info', 'part.asdf']) == 0
    assert ('pixel (0, 0) is outside of its bounding box'
            in capsys.readouterr().out)
    assert main(['info', 'words.asdf']) == 1
    assert "2 dimensions called 'data'" in capsys.readouterr().err


def test_without_a_command_there_is_help(capsys):
    with pytest.raises(SystemExit) as stop:
        main([])
    assert stop.value.code == 2
    assert 'mgauss photometry night1.fits' in capsys.readouterr().err


@pytest.mark.parametrize(('words', 'written'), [
    ('psf night.fits', ['night_psf.fits']),
    ('photometry night.fits --psf psf.fits', ['night_cat.ecsv'])])
def test_a_dry_run_checks_and_writes_nothing(folder, capsys, words, written):
    before = sorted(folder.iterdir())
    assert main([*words.split(), '--dry-run']) == 0
    said = capsys.readouterr().out.splitlines()
    assert said == [f'would write {name}' for name in written]
    assert sorted(folder.iterdir()) == before


def test_a_dry_run_finds_what_is_wrong(folder, capsys):
    (folder / 'night_psf.fits').write_text('of an earlier run')
    assert main(['psf', 'night.fits', '--dry-run']) == 1
    assert 'night_psf.fits exists' in capsys.readouterr().err


def test_a_shell_can_learn_the_words():
    from photutils_mgauss.cli.command import make_parser
    assert 'info' in make_parser().format_help()


@pytest.mark.parametrize('words', [
    'psf night.fits --n-components 0',
    'photometry night.fits --psf psf.fits --fit-shape 4'])
def test_values_that_no_fit_takes_are_wrong_usage(folder, capsys, words):
    with pytest.raises(SystemExit) as stop:
        main([*words.split(), '--dry-run'])
    assert stop.value.code == 2
    assert 'must be' in capsys.readouterr().err.splitlines()[-1]
