"""What ``mgauss info`` says of files, and what dry runs leave undone."""
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

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


def test_info_says_that_a_text_is_none_of_the_files(folder, capsys):
    (folder / 'notes.md').write_text('# Stars\n\nSome *words*.\n')
    assert main(['info', 'notes.md']) == 1
    assert capsys.readouterr().err.strip() == (
        'mgauss: notes.md: must be a table that astropy can read, got a file '
        'of none of the kinds that it recognises; images and PSFs are FITS '
        'or ASDF files')


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
