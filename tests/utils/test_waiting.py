"""Who waits at a terminal is told, and nobody else."""
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from io import StringIO

import pytest

from photutils_mgauss.utils import waiting as module
from photutils_mgauss.utils.parallel import map_parallel, tell, watched
from photutils_mgauss.utils.waiting import waiting


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


def beside_a_bar():
    with waiting('outer', progress_bar=True):
        work()


def told_already():
    with watched(lambda _done, _total: None):
        work()


@pytest.mark.parametrize('call', [in_a_thread, in_pieces, beside_a_bar,
                                  told_already])
def test_nothing_is_shown_where_others_show_it_or_nobody_looks(
        monkeypatch, call):
    screen = terminal(monkeypatch)
    call()
    assert screen.getvalue() == ''


def test_files_get_no_line(capsys, monkeypatch):
    monkeypatch.setattr(module, '_PATIENCE', 0.01)
    work()
    assert capsys.readouterr().err == ''
