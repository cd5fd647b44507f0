"""A kind of warning is shown once for each file."""
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from astropy.io import fits

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main, photometry, tools
from photutils_mgauss.cli.warned import Warned, kind_of


@pytest.fixture
def said():
    """Return what is shown, what is kept, and what decides on it."""
    shown, kept = [], []
    return shown, kept, Warned(shown.append, kept.append)


def test_numbers_make_no_other_kind():
    assert kind_of('off by +71% (3 of 1.2e-4), [2] left. See 5') == (
        kind_of('off by -3% (44 of 7), [31] left. Try 9'))
    assert kind_of('R2 is 3') != kind_of('R3 is 3')
    assert kind_of('night1.fits: 3') != kind_of('night2.fits: 3')
    assert kind_of('/2016/a.fits: 3') != kind_of('/2017/a.fits: 3')


def test_a_kind_is_shown_once_for_each_file(said):
    shown, kept, warned = said
    for path in (Path('a1.fits'), Path('a2.fits')):
        with tools.about(path):
            for number in (3, 4, 3, 5):
                warned.show(f'by {number} pixels. Then more words')
            warned.show(f'{path}: has no time')
    warned.show('by 3 pixels')
    warned.show('other words')
    assert shown == ['a1.fits: by 3 pixels. Then more words',
                     'a1.fits: has no time',
                     'a2.fits: by 3 pixels. Then more words',
                     'a2.fits: has no time', 'by 3 pixels', 'other words']
    assert kept == [f'a{k}.fits: by {n} pixels. Then more words'
                    for k in (1, 2) for n in (4, 5)]
    warned.end()
    assert shown[-1].startswith('4 more warnings like these')


def test_nothing_is_said_of_what_was_not_left_out(said):
    shown, _, warned = said
    warned.show('the same')
    warned.show('the same')
    warned.end()
    assert shown == ['the same']


def test_commands_name_the_file_of_a_warning_and_count_the_rest(
        tmp_path, monkeypatch, capsys, rng):
    monkeypatch.chdir(tmp_path)
    mixture = GaussianMixture([1], [[0, 0]], [[[2.0, 0], [0, 2.0]]])
    GriddedMixturePSF([mixture], [(0, 0)]).write('psf.fits')
    for name in ('a.fits', 'b.fits'):
        fits.writeto(name, rng.normal(50, 7, (40, 40)).astype('f4'),
                     fits.Header({'BUNIT': 'electron'}))

    def measure(image, psf, options, stars):
        for _ in range(2):
            for number in (1, 2):
                warnings.warn(f'off by {number}', UserWarning, stacklevel=1)
    monkeypatch.setattr(photometry, '_sparse', measure)
    command = ['photometry', '--psf', 'psf.fits', '--quiet', '--log-file',
               'log']
    assert main([*command, 'a.fits']) == 1
    assert main([*command, 'b.fits']) == 1
    more = ('mgauss: warning: 1 more warning like these, with other numbers, '
            'not shown; --log-file keeps them')
    none = 'must show a star, got none; try --threshold'
    assert capsys.readouterr().err.splitlines() == [
        line for name in 'ab' for line in (
            f'mgauss: warning: {name}.fits: off by 1', more,
            f'mgauss: {name}.fits: {none}')]
    kept = Path('log').read_text()
    assert kept.count('off by 2') == 2


def test_a_log_that_cannot_be_opened_is_one_line(tmp_path):
    # In a process of its own: pytest catches what logging prints.
    run = subprocess.run(
        [sys.executable, '-m', 'photutils_mgauss', 'info', __file__,
         '--log-file', 'no/log'], cwd=tmp_path, capture_output=True,
        text=True, check=False)
    assert run.returncode == 1
    assert run.stderr.splitlines() == [
        f'mgauss: {tmp_path}/no/log: No such file or directory']
