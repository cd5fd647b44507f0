"""Damaged files, wrong options, interrupts and kills of the command line."""
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_array_equal

from helpers.kills import run_with_kills
from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {'PYTHONPATH': os.pathsep.join(
    [str(ROOT), *filter(None, [os.environ.get('PYTHONPATH')])])}


def start(*arguments, folder, **kwargs):
    """Start the command in a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', 'photutils_mgauss', *map(str, arguments)],
        cwd=folder, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, **kwargs)


def content_of(folder):
    """Return names and contents of all files, and all folders."""
    return {str(path.relative_to(folder)): path.is_file()
            and path.read_bytes() for path in Path(folder).rglob('*')}


def draw(n_stars, size, seed, flux=3e4):
    """Return a mixture, and an image of stars of it with noise."""
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture([1], [[0, 0]], [[[1.44, 0], [0, 1.44]]])
    data = np.full((size, size), 100.0)
    for x, y in rng.uniform(10, size - 10, (n_stars, 2)):
        left, low = int(x) - 8, int(y) - 8
        data[low:low + 18, left:left + 18] += mixture.render(
            (18, 18), x - left, y - low, flux=flux)
    return mixture, rng.poisson(data)


def image_of(data, date='2027-01-01'):
    hdu = fits.PrimaryHDU(data.astype('f4'))
    hdu.header.update({
        'GAIN': 1.0, 'BUNIT': 'adu', 'DATE-OBS': date, 'EXPTIME': 1.0,
        'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN', 'CRVAL1': 150.0,
        'CRVAL2': 2.0, 'CRPIX1': 60.0, 'CRPIX2': 60.0, 'CDELT1': -2e-5,
        'CDELT2': 2e-5})
    return hdu


@pytest.fixture(scope='module')
def good(tmp_path_factory):
    """Make a folder of good files, one of each kind."""
    folder = tmp_path_factory.mktemp('good')
    mixture, data = draw(20, 120, 1)
    for number, year in ((1, 2027), (2, 2028)):
        image_of(data, f'{year}-01-01').writeto(folder / f'{number}.fits')
    psf = GriddedMixturePSF([mixture] * 4, [(0, 0), (119, 0), (0, 119),
                                            (119, 119)])
    psf.write(folder / 'psf.asdf')
    psf.write(folder / 'psf.fits')
    assert main(['photometry', *(str(folder / f'{i}.fits') for i in (1, 2)),
                 '--psf', str(folder / 'psf.asdf'), '--output', str(folder),
                 '--quiet']) == 0
    return folder


@pytest.fixture
def here(good, tmp_path, monkeypatch):
    """Stand in a folder with the good files."""
    for path in good.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fail(capsys, *arguments):
    """Run a command that must fail cleanly; return its sentence."""
    before = content_of('.')
    assert main([*arguments, '--quiet']) == 1
    lines = capsys.readouterr().err.splitlines()
    said = [line for line in lines
            if not line.startswith('mgauss: warning: ')]
    assert len(said) == 1
    assert said[0].startswith('mgauss: ')
    assert content_of('.') == before
    return said[0]


def replaced(old, new):
    return lambda content: content.replace(old, new, 1)


DAMAGE = {
    'a bad byte': lambda content: content[:300] + b'\x8a' + content[301:],
    'nothing': lambda content: b'',
    'half': lambda content: content[:len(content) // 2],
    'the beginning': lambda content: content[:50],
    'noise': lambda content: np.random.default_rng(1).bytes(5000)}
HEADERS = {
    'BITPIX': replaced(b'BITPIX  =                  -32',
                       b'BITPIX  =                   77'),
    'axes': replaced(b'NAXIS1  =', b'NAXIS7  ='),
    'end': replaced(b'END' + b' ' * 77, b'ENX' + b' ' * 77),
    'sky': replaced(b"'RA---TAN'", b"'GLON-TAN'"),
    'value': replaced(b'CRVAL1  =                150.0',
                      b'CRVAL1  =                150.\x1b')}
COMMANDS = {
    'photometry': ['photometry', 'bad.fits', '--psf', 'psf.asdf',
                   '--output', 'new/'],
    'psf': ['psf', 'bad.fits', '--n-components', '1', '--degree', '0',
            '--min-snr', '5', '--output', 'new/'],
    'motions': ['motions', '2.fits', 'bad.fits', '--n-components', '1',
                '--degree', '0', '--output', 'new/motions'],
    'report': ['report', 'bad.fits', '--output', 'new/report.html']}


# astropy leaves files open that it cannot read.
@pytest.mark.filterwarnings('ignore:.*unclosed file',
                            'ignore::pytest.PytestUnraisableExceptionWarning')
@pytest.mark.parametrize('command', COMMANDS)
@pytest.mark.parametrize('damage', [*DAMAGE, *HEADERS])
def test_a_damaged_image_is_named(here, capsys, command, damage):
    content = (here / '1.fits').read_bytes()
    changed = (DAMAGE | HEADERS)[damage](content)
    assert changed != content
    (here / 'bad.fits').write_bytes(changed)
    if damage in ('sky', 'value') and command in ('photometry', 'psf'):
        # Stars can be measured without a WCS.
        code = main([*COMMANDS[command], '--quiet'])
        assert 'bad.fits' in capsys.readouterr().err
        assert code in (0, 1)
        return
    assert 'bad.fits' in fail(capsys, *COMMANDS[command])


@pytest.mark.parametrize('command', [
    ['photometry', '1.fits', '--output', 'new/', '--psf'],
    ['psf', '--output', 'new/'], ['report', '--output', 'new/report.html']],
    ids=lambda command: command[0])
@pytest.mark.parametrize('suffix', ['.asdf', '.fits'])
@pytest.mark.parametrize('damage', DAMAGE)
def test_a_damaged_psf_is_named(here, capsys, command, suffix, damage):
    content = (here / f'psf{suffix}').read_bytes()
    (here / f'bad{suffix}').write_bytes(DAMAGE[damage](content))
    assert 'bad' in fail(capsys, *command, f'bad{suffix}')


@pytest.mark.parametrize('command', [
    ['motions', '--transform', 'shift', '--output', 'new', '2_cat.ecsv'],
    ['report', '--output', 'new/report.html']], ids=lambda words: words[0])
@pytest.mark.parametrize('damage', ['nothing', 'the beginning', 'noise'])
def test_a_damaged_catalogue_is_named(here, capsys, command, damage):
    content = (here / '1_cat.ecsv').read_bytes()
    (here / 'bad.ecsv').write_bytes(DAMAGE[damage](content))
    assert 'bad.ecsv' in fail(capsys, *command, 'bad.ecsv')


def test_errors_of_any_kind_become_a_sentence(here, capsys, monkeypatch):
    from photutils_mgauss.cli import star_image

    def fail_oddly(*_, **__):
        raise KeyError('odd\n  key')  # noqa: EM101
    monkeypatch.setattr(star_image, 'read_layers', fail_oddly)
    assert fail(capsys, 'psf', '1.fits') == 'mgauss: 1.fits: KeyError: odd key'


# Before any work is done.

@pytest.fixture
def no_work(monkeypatch):
    """Fail if anything is measured."""
    from photutils_mgauss.cli import photometry, psf

    def measure(*_, **__):
        pytest.fail('something was measured')
    monkeypatch.setattr(photometry, 'measure', measure)
    monkeypatch.setattr(psf, 'from_stars', measure)
    monkeypatch.setattr(psf, 'from_file', measure)


@pytest.mark.usefixtures('no_work')
@pytest.mark.parametrize(('words', 'said'), [
    ('motions 1.fits 2.fits --references 1.fits', '1.fits: must be a table'),
    ('motions 1.fits 2.fits --references 1_cat.ecsv', 'ref_epoch'),
    ('motions 1_cat.ecsv 1_cat.ecsv', '1_cat.ecsv: must be given only once'),
    ('motions 1.fits 2.fits --time noon', '--time must be a date'),
    ('motions 1.fits 2.fits --wcs a b c', '--wcs must have 1 value or 2'),
    ('photometry 1.fits --psf psf.fits psf.fits', 'must have 1 value, got 2'),
    ('photometry 1.fits --psf psf.fits --stars psf.fits --output n/',
     "psf.fits: must have columns ra and dec, or x and y, got ['NAME'"),
    ('psf 1.fits --stars psf.fits',
     "psf.fits: must have columns ra and dec, or x and y, got ['NAME'"),
    ('motions psf.fits 1_cat.ecsv',
     "psf.fits: must have columns ra and dec, or x and y, got ['NAME'"),
    ('motions 1.fits 2.fits --output 1.fits', 'must be a folder'),
    ('motions 1.fits 2.fits --output 1.fits/a', '1.fits is a file'),
    ('photometry 1.fits ./1.fits --psf psf.fits', 'given only once'),
    ('photometry 1.fits --psf 1.fits --output new/', '1.fits: must hold a'),
    ('photometry 1.fits --psf psf.fits --error no.fits', 'no.fits: must be'),
    ('photometry 1.fits --psf psf.fits --output 1.fits --overwrite',
     '1.fits: --output must not be an input'),
    ('photometry 1.fits --psf psf.fits --output psf.fits --overwrite',
     'psf.fits: --output must not be an input'),
    ('photometry 1.fits --psf psf.fits --checkpoint 1.fits',
     '1.fits: --checkpoint must be a folder'),
    (f'photometry 1.fits --psf psf.fits --output {"a" * 300}.ecsv',
     'File name too long'),
    ('psf 1.fits --stars no.ecsv', 'no.ecsv: must be a file'),
    ('psf 1.fits psf.fits --n-components auto', 'must be a number'),
    ('psf 1.fits --output /proc/psf.fits', '/proc: must be a folder that'),
    ('psf 1.fits --log-file no/log', 'no/log: No such file'),
    ('demo --output 1.fits', '1.fits: must be a folder')])
def test_what_is_wrong_is_found_before_work_starts(here, capsys, words,
                                                   said):
    assert said in fail(capsys, *words.split())


@pytest.mark.usefixtures('no_work')
def test_all_images_are_looked_at_before_one_is_measured(here, capsys):
    (here / 'bad.fits').write_bytes((here / '1.fits').read_bytes()[:9000])
    assert 'bad.fits' in fail(capsys, 'photometry', '2.fits', 'bad.fits',
                              '--psf', 'psf.fits', '--output', 'new/')


def test_a_file_that_cannot_be_written_is_called_by_its_name(tmp_path):
    from photutils_mgauss.cli.tools import whole_file
    name = tmp_path / 'new' / 'folder' / 'a.txt'
    with pytest.raises(OSError, match=r'a\.txt: .*No space') as caught, (  # noqa: PT012
            whole_file(name)) as draft:
        draft.write_text('half')
        raise OSError(28, 'No space left on device', str(draft))
    assert '.a.' not in str(caught.value)
    assert content_of(tmp_path) == {}


@pytest.mark.parametrize(('words', 'said'), [
    ('photometry a.fits --psf b.fits --treshold 3',
     'unrecognized arguments: --treshold 3 (did you mean --threshold?)'),
    ('psf a.fits --n-components three',
     'must be a whole number from 1 or auto, got three'),
    ('psf a.fits --gain much', 'must be a positive number, got much'),
    ('psf a.fits --sky-box 1.5', 'must be a whole number from 1, got 1.5')])
def test_wrong_usage_is_explained_by_the_command(capsys, words, said):
    with pytest.raises(SystemExit):
        main(words.split())
    text = capsys.readouterr().err
    assert said in text
    assert f'usage: mgauss {words.split()[0]}' in text


@pytest.mark.parametrize(('word', 'said'), [
    ('fotometry', r'command: fotometry \(did you mean photometry\?\)'),
    ('phot', r'command: phot \(did you mean photometry\?\)'),
    ('demmo', r'\(did you mean demo\?\)'),
    ('zzz', 'unknown command: zzz; there are psf, photometry, motions')])
def test_a_wrong_command_gets_a_hint(capsys, word, said):
    with pytest.raises(SystemExit) as caught:
        main([word, 'a.fits'])
    assert caught.value.code == 2
    assert re.search(said, capsys.readouterr().err)


def test_help_fits_into_a_terminal(capsys):
    for command in ('psf', 'photometry', 'motions'):
        with pytest.raises(SystemExit):
            main([command, '--help'])
        _, *paragraphs, _ = capsys.readouterr().out.split('\n\n')
        assert max(map(len, '\n'.join(paragraphs).splitlines())) <= 80


# What is said, and where.

@pytest.mark.long
def test_redirected_output_holds_no_bars(here):
    run = start('photometry', '1.fits', '--psf', 'psf.fits', '--output',
                'new/', folder=here)
    out, err = run.communicate()
    assert run.returncode == 0
    assert err == ''
    assert '\r' not in out
    assert re.search(r'^1.fits: \d+ stars$', out, re.MULTILINE)


@pytest.mark.long
def test_a_terminal_shows_how_far_it_got(here):
    terminal, end = pty.openpty()
    termios.tcsetwinsize(end, (24, 80))
    run = subprocess.Popen(
        [sys.executable, '-m', 'photutils_mgauss', 'photometry', '1.fits',
         '--psf', 'psf.fits', '--output', 'new/'], cwd=here, env=ENVIRONMENT,
        stdout=subprocess.DEVNULL, stderr=end)
    os.close(end)
    text = ''
    while run.poll() is None or 'written' not in text:
        try:
            text += os.read(terminal, 1 << 16).decode()
        except OSError:  # the other end is closed
            break
    os.close(terminal)
    assert run.wait() == 0
    assert 'measure 1.fits' in text
    assert ' 2/2 [' in text


def test_a_bar_counts_within_a_step(capsys, monkeypatch):
    from argparse import Namespace

    from photutils_mgauss.cli.progress import Progress
    from photutils_mgauss.utils.parallel import map_parallel
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    with Progress(3, Namespace(quiet=False)) as step:
        step('first')
        step('second')
        list(map_parallel(abs, range(4)))
    text = capsys.readouterr().err
    assert '1/3 [00:00, part 3 of 4]' in text
    assert '3/3 [00:00]' in text


def test_a_log_file_has_all_that_is_said(here, capsys):
    words = ['photometry', '1.fits', '--psf', 'psf.fits', '--quiet',
             '--log-file', 'log.txt', '--output']
    assert main([*words, 'new/a.ecsv']) == 0
    assert capsys.readouterr() == ('', '')
    assert main([*words, 'new/a.ecsv']) == 1
    log = (here / 'log.txt').read_text()
    for said in ('INFO measure 1.fits', ' stars\n',
                 'ERROR new/a.ecsv exists', 'Traceback'):
        assert said in log


@pytest.mark.parametrize('command', ['psf', 'photometry', 'motions', 'report',
                                     'demo', 'compile'])
def test_all_commands_can_be_quiet_and_keep_a_log(command, capsys):
    with pytest.raises(SystemExit):
        main([command, '--help'])
    text = capsys.readouterr().out
    assert '--quiet' in text
    assert '--log-file' in text


@pytest.mark.long
def test_who_stops_reading_does_not_stop_the_work(here):
    run = start('photometry', '1.fits', '--psf', 'psf.fits', '--output',
                'new/', folder=here)
    run.stdout.close()
    with run.stderr:
        assert run.stderr.read() == ''
    assert run.wait() == 0
    assert (here / 'new' / '1_cat.ecsv').exists()


# Interrupts and kills.

@pytest.fixture(scope='module')
def long_work(tmp_path_factory):
    """Make a folder with work that takes much longer than an interrupt."""
    folder = tmp_path_factory.mktemp('long')
    mixture, data = draw(6000, 1000, 2, flux=3e3)
    for number, year in ((1, 2027), (2, 2028)):
        image_of(data + number, f'{year}-01-01').writeto(
            folder / f'{number}.fits')
    GriddedMixturePSF([mixture], [(0, 0)]).write(folder / 'psf.fits')
    return folder


def wait_for(path, words, run):
    """Wait until a log file says something."""
    for _ in range(1200):
        if path.exists() and words in path.read_text():
            return
        assert run.poll() is None, run.stderr.read()
        time.sleep(0.05)
    pytest.fail(f'{words} is not in {path}')


@pytest.mark.long
@pytest.mark.usefixtures('interruptible')
@pytest.mark.parametrize(('signal_sent', 'code', 'said'), [
    (signal.SIGINT, 130, 'interrupted'),
    (signal.SIGTERM, 143, 'terminated')])
@pytest.mark.parametrize('words', [
    'photometry 1.fits --crowded --psf psf.fits --output new/out.ecsv',
    'psf 1.fits --max-stars 3000 --min-snr 5 --degree 6 --output new/a.fits',
    'motions 1.fits 2.fits --max-stars 3000 --min-snr 5 --output new'])
def test_an_interrupt_is_obeyed_at_once(long_work, tmp_path, words,
                                        signal_sent, code, said):
    log = tmp_path / 'log'
    before = content_of(long_work)
    run = start(*words.split(), '--log-file', log, folder=long_work)
    what = 'measure' if 'psf 1' not in words else 'PSF of'
    wait_for(log, f'INFO {what} 1.fits', run)
    time.sleep(0.7)
    begun = time.monotonic()
    run.send_signal(signal_sent)
    _, err = run.communicate(timeout=30)
    assert time.monotonic() - begun < 1.5
    assert run.returncode == code
    assert err.splitlines()[-1] == f'mgauss: {said}'
    assert 'Traceback' not in err
    assert content_of(long_work) == before


def test_an_interrupt_of_main_is_an_exit_code(here, monkeypatch, capsys):
    from photutils_mgauss.cli import photometry

    def interrupt(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(photometry, 'measure', interrupt)
    assert main(['photometry', '1.fits', '--psf', 'psf.fits', '--output',
                 'new/']) == 130
    assert capsys.readouterr().err == 'mgauss: interrupted\n'
    assert not (here / 'new').exists()


def assert_same_tables(folder, other):
    """Compare the tables of two folders, number by number."""
    names = sorted(path.name for path in folder.glob('*.ecsv'))
    assert names == sorted(path.name for path in other.glob('*.ecsv'))
    assert names
    for name in names:
        one, two = (QTable.read(place / name) for place in (folder, other))
        assert one.colnames == two.colnames
        for column in one.colnames:
            assert_array_equal(np.asarray(one[column]),
                               np.asarray(two[column]))


def test_a_killed_run_goes_on_where_it_stopped(here, monkeypatch):
    from photutils_mgauss.cli import photometry
    words = ['photometry', '1.fits', '2.fits', '--psf', 'psf.fits',
             '--crowded', '--quiet', '--output']
    assert main([*words, 'whole/']) == 0
    measure, calls = photometry.measure, []

    def fail_at_the_second(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise RuntimeError('lost')  # noqa: EM101
        return measure(*arguments)
    monkeypatch.setattr(photometry, 'measure', fail_at_the_second)
    words += ['parts/', '--checkpoint', 'kept']
    assert main(words) == 1
    assert [path.name for path in Path('parts').iterdir()] == ['1_cat.ecsv']
    assert main(words) == 0
    assert len(calls) == 3
    assert_same_tables(Path('whole'), Path('parts'))
    assert main(words) == 0
    assert len(calls) == 3
    # What somebody else wrote is not replaced.
    Path('parts/1_cat.ecsv').write_text('other')
    assert main(words) == 1


@pytest.mark.long
def test_motions_of_images_go_on_where_they_stopped(here, monkeypatch):
    from photutils_mgauss.cli import motions
    fit = '--n-components 1 --degree 0 --min-snr 5 --transform shift --quiet'
    words = ['motions', '1.fits', '2.fits', *fit.split(), '--max-motion',
             '1e9', '--output']
    assert main([*words, 'whole']) == 0
    words += ['parts', '--checkpoint', 'kept']

    def fail(*_):
        raise RuntimeError('lost')  # noqa: EM101
    with monkeypatch.context() as patch:
        patch.setattr(motions, '_collect', fail)
        assert main(words) == 1
    assert not Path('parts').exists()
    with monkeypatch.context() as patch:
        patch.setattr(motions.photometry, 'measure', fail)
        patch.setattr(motions.psf_command, 'from_stars', fail)
        assert main(words) == 0
    assert_same_tables(Path('whole'), Path('parts'))
    assert main(words) == 0


@pytest.mark.long
@pytest.mark.parametrize('seed', range(3))
def test_work_that_is_killed_loses_no_result(here, seed):
    words = ['photometry', '1.fits', '2.fits', '--psf', 'psf.fits', '--quiet',
             '--output']
    assert main([*words, 'whole/']) == 0
    run_with_kills([*words, 'parts/', '--checkpoint', 'kept'], here,
                   n_kills=2, seconds=6, seed=seed)
    assert_same_tables(here / 'whole', here / 'parts')
    assert files_of(here / 'parts') == ['1_cat.ecsv', '2_cat.ecsv']


def files_of(folder):
    return sorted(path.name for path in folder.iterdir())
