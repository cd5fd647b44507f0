"""Who waits at a terminal is told, and nobody else."""
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from io import StringIO
from typing import ClassVar

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

import photutils_mgauss as mg
from photutils_mgauss.utils import waiting as module
from photutils_mgauss.utils.parallel import map_parallel, tell, watched
from photutils_mgauss.utils.waiting import patient, progress, waiting


class Terminal(StringIO):
    """What is written to a terminal."""

    def isatty(self):
        return True


def terminal(monkeypatch):
    """Be at a terminal, where little patience is shown; return it."""
    monkeypatch.setattr(sys, 'stderr', Terminal())
    monkeypatch.setattr(module, '_PATIENCE', 0.05)
    monkeypatch.setattr(module, '_TICK', 0.01)
    return sys.stderr


def work(seen=None):
    """Wait until something is seen, or a moment where nothing should be."""
    with waiting('measure'):
        tell(1, 3)
        look(seen)


def look(seen=None):
    end = time.monotonic() + (60 if seen else 0.2)
    while time.monotonic() < end and (
            seen is None or seen not in sys.stderr.getvalue()):
        time.sleep(0.01)


def test_a_long_call_shows_its_name_a_clock_and_its_parts(monkeypatch):
    screen = terminal(monkeypatch)
    work(', part 1 of 3]')
    text = screen.getvalue()
    assert re.search(r'measure \[00:\d\d, part 1 of 3]', text)
    # Nothing is left of it.
    assert text.split('\r')[-2].strip() == text.split('\r')[-1] == ''


def test_a_short_call_shows_nothing(monkeypatch):
    screen = terminal(monkeypatch)
    with waiting('measure'):
        pass
    assert screen.getvalue() == ''


def test_the_line_goes_before_an_error_is_shown(monkeypatch):
    screen = terminal(monkeypatch)
    def fail():
        with waiting('measure'):
            work('measure')
            int('no number')

    with pytest.raises(ValueError, match='no number'):
        fail()
    assert screen.getvalue().endswith('\r')


def test_only_the_outermost_call_is_shown(monkeypatch):
    screen = terminal(monkeypatch)
    with waiting('outer'):
        work(', part 1 of 3]')
    text = screen.getvalue()
    assert re.search(r'outer \[00:\d\d, part 1 of 3]', text)
    assert 'measure' not in text


def in_a_thread():
    with ThreadPoolExecutor(1) as pool:
        pool.submit(work).result()


def in_pieces():
    list(map_parallel(lambda _: work(), range(2)))


def told_already():
    with watched(lambda _done, _total: None):
        work()


@pytest.mark.parametrize('call', [in_a_thread, in_pieces,
                                  told_already])
def test_nothing_is_shown_where_others_show_it_or_nobody_looks(
        monkeypatch, call):
    screen = terminal(monkeypatch)
    call()
    assert screen.getvalue() == ''


def test_files_get_neither_line_nor_bar(capsys, monkeypatch):
    monkeypatch.setattr(module, '_PATIENCE', 0.01)
    work()
    with waiting('outer', progress_bar=True):
        list(progress([1, 2], desc='pieces'))
        work()
    assert capsys.readouterr().err == ''


def test_the_clock_of_a_bar_goes_on_within_a_step(monkeypatch):
    screen = terminal(monkeypatch)
    with waiting('outer', progress_bar=True), progress(total=1) as bar:
        # Half a minute has passed since it was drawn.
        bar.start_t -= 30
        look('[00:3')
    assert 'outer' not in screen.getvalue()


def test_the_line_is_shown_before_and_after_a_bar(monkeypatch):
    screen = terminal(monkeypatch)
    with waiting('outer', progress_bar=True):
        look('outer')
        with progress(total=1, desc='pieces') as bar:
            before = screen.getvalue()
            # The line has gone when the bar is there.
            assert before.rindex('pieces') > before.rindex('outer')
            work()
            bar.update()
        assert 'outer' not in screen.getvalue()[len(before):]
        screen.truncate(0)
        look('outer')
    assert 'measure' not in screen.getvalue()


def test_a_bar_is_as_wide_as_a_terminal_that_does_not_know_its_width(
        monkeypatch):
    terminal(monkeypatch)
    for known, eighty in ((0, True), (70, False)):
        monkeypatch.setattr(module, 'get_terminal_size',
                            lambda _, known=known: os.terminal_size(
                                (known, 24)))
        with progress(total=1) as bar:
            assert (bar.ncols == 80) == eighty


class Photometry:
    """Has a call that takes long."""

    progress_bar = False

    @patient
    def draw(self, seen, *, again=False):
        """Draw stars."""
        look(seen)
        return seen, again


def test_methods_of_other_packages_show_their_name(monkeypatch):
    screen = terminal(monkeypatch)
    assert Photometry().draw('Photometry.draw [', again=True)[1]
    assert Photometry.draw.__doc__ == 'Draw stars.'
    assert 'Photometry.draw [' in screen.getvalue()


class Named:
    """A line that only takes down its words."""

    seen: ClassVar = []

    def __init__(self, words):
        self.seen.append(words)

    def count(self, done, total):
        """No matter."""

    def close(self):
        """No matter."""


def named(monkeypatch, call):
    """Return what a call would show at a terminal while it lasts."""
    terminal(monkeypatch)
    monkeypatch.setattr(module, '_Line', Named)
    monkeypatch.setattr(Named, 'seen', [])
    call()
    return Named.seen


@pytest.mark.parametrize('call', [
    lambda: mg.sky_field(5, 0, size=1.0),
    lambda: mg.crowded_field((20, 20)),
    lambda: mg.paper_scene('bulge', (40, 40))],
    ids=['sky_field', 'crowded_field', 'paper_scene'])
def test_simulations_show_their_name(monkeypatch, request, call):
    assert named(monkeypatch, call) == [request.node.callspec.id]


def test_reading_and_writing_shows_its_name(monkeypatch, tmp_path):
    path, stars = tmp_path / 'grid.fits', tmp_path / 'stars.als'
    grid = mg.GriddedMixturePSF([mg.GaussianMixture.from_stddevs(
        [1], [(0, 0)], [(1, 1)], [0])], [(0, 0)])
    stars.write_text('NL\n1\n\n1 2.0 3.0 15.0 0.1 9.0 4.0 1.0 0.1\n')
    scene = mg.simulate(mg.crowded_field((20, 20), rng=1), psf=grid, rng=1,
                        instrument=mg.Instrument(shape=(20, 20)))
    for name, call in {
            'GriddedMixturePSF.write': lambda: grid.write(path),
            'GriddedMixturePSF.read': lambda: grid.read(path),
            'GriddedMixturePSF.from_file': lambda: grid.from_file(path),
            'Table.read of daophot': lambda: QTable.read(
                stars, format='mgauss.daophot', fwhm=2.0),
            'Scene.write': lambda: scene.write(tmp_path / 'scene.fits'),
            }.items():
        assert named(monkeypatch, call)[0] == name


def test_what_is_asked_of_motions_shows_its_name(monkeypatch):
    rng, n = np.random.default_rng(1), 30
    x, y, *motions = rng.uniform(0, 1000, (4, n))
    solution = mg.ProperMotionFitter(references=list(range(10))).fit([
        mg.Epoch(QTable({
            'id': np.arange(n), 'y_fit': y, 'y_err': np.full(n, 0.01),
            'x_fit': x + (np.arange(n) >= 10) * motions[0] * years / 1e4,
            'x_err': np.full(n, 0.01)}), time=2015.0 + years,
            pixel_scale=0.1 * u.arcsec) for years in (0, 2, 5)])
    for ask in ('accelerations', 'measured', 'mean', 'bootstrap'):
        names = named(monkeypatch, getattr(solution, ask))
        assert names == [f'MotionSolution.{ask}']
    at = named(monkeypatch, lambda: solution.at(2030.0))
    assert at == ['MotionSolution.at']


NO_SIZE = """
import time
from photutils_mgauss.utils import waiting
waiting._PATIENCE = 0.02
with waiting.waiting('measure'):
    time.sleep(20)
"""


@pytest.mark.skipif(sys.platform == 'win32', reason='has no such terminals')
def test_the_line_is_shown_on_a_terminal_that_does_not_know_its_size():
    ours, theirs = os.openpty()
    environment = {name: value for name, value in os.environ.items()
                   if name not in ('COLUMNS', 'LINES')}
    with subprocess.Popen(
            [sys.executable, '-c', NO_SIZE],
            stdin=theirs, stdout=theirs, stderr=theirs,
            env=environment) as process:
        os.close(theirs)
        seen = b''
        while b'measure [' not in seen:
            seen += os.read(ours, 1000)
        process.kill()
    os.close(ours)
