"""
Who waits at a terminal sees that something happens.

A call that takes long shows its name, a clock and the parts of its work that
are done, in a line that is gone when the call ends. Where it shows a bar, the
clock of the bar goes on instead. Nothing is written into files, and no line
is shown where the caller shows how far it is, in threads and other processes.
"""
import sys
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from multiprocessing import parent_process
from shutil import get_terminal_size
from threading import Event, Lock, Thread, current_thread, main_thread
from time import time

from photutils_mgauss.utils.parallel import is_watched, watched

# What ends sooner says nothing, and how often the clock goes on [s].
_PATIENCE, _TICK = 2.0, 0.5

# Whose line is on the screen, and who may change that.
_SHOWN, _SCREEN = [], Lock()


@contextmanager
def waiting(words, progress_bar=False):
    """
    Show on a terminal that a call is at work, once it has taken long.

    Parameters
    ----------
    words : str
        What is done.
    progress_bar : bool, optional
        Whether the call is going to show a bar of its own. Its clock goes on
        between its steps, and the line is shown before and after it only.
    """
    if is_watched() or not (progress_bar or _somebody_looks()):
        yield
        return
    if not _somebody_looks():
        with watched(_nobody):
            yield
        return
    line = _Line(words)
    try:
        with watched(_nobody if progress_bar else line.count):
            yield
    finally:
        line.close()


def patient(method):
    """Return a method that shows on a terminal that it is at work."""
    @wraps(method)
    def call(self, *args, **kwargs):
        with waiting(f'{type(self).__name__}.{method.__name__}',
                     self.progress_bar):
            return method(self, *args, **kwargs)
    return call


def progress(iterable=None, *, shown=True, **options):
    """
    Return a bar that is shown on terminals and in notebooks, not in files.

    Parameters
    ----------
    iterable : iterable, optional
        What to go through.
    shown : bool, optional
        Whether a bar is wanted.
    **options
        Keywords of `tqdm.tqdm`.

    Returns
    -------
    `tqdm.tqdm`
    """
    from tqdm.auto import tqdm
    if not (shown and has_screen()):
        return tqdm(iterable, disable=True, **options)
    with _SCREEN:
        for line in _SHOWN:
            line.take_away()
        return tqdm(iterable, **_size(), **options)


def has_screen():
    """Whether what is written to the standard error is looked at."""
    shell = sys.modules.get('IPython')
    in_notebook = shell is not None and hasattr(shell.get_ipython(), 'kernel')
    return in_notebook or (sys.stderr is not None and sys.stderr.isatty())


def _nobody(_done, _total):
    """Tell nobody of parts, because a bar shows them."""


def _somebody_looks():
    """Whether this is what somebody has started at a terminal."""
    return (sys.stderr is not None and sys.stderr.isatty()
            and current_thread() is main_thread()
            and parent_process() is None)


def _size():
    """Return width and height of a terminal that does not know them."""
    # Only those get the fallback; bars are hidden where there are no rows.
    if get_terminal_size((0, 0)).columns == 0:
        return {'ncols': 80, 'nrows': 24}
    return {}


class _Line:
    """A line with a clock, drawn by a thread of its own."""

    def __init__(self, words):
        self._words = words
        self._parts = ''
        self._bar = None
        self._start = time()
        self._end = Event()
        self._thread = Thread(target=self._draw, daemon=True)
        self._thread.start()

    def count(self, done, total):
        """Take note of how many parts of the work are done."""
        # Nobody knows how long what follows the last part will take.
        self._parts = f', part {done} of {total}' if done < total else ''

    def close(self):
        """Take the line away for good."""
        self._end.set()
        self._thread.join()

    def take_away(self):
        """Take the line away until it is drawn again."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _draw(self):
        if self._end.wait(_PATIENCE / 2):
            return
        # Loading this takes a while on a busy machine: not when it is needed.
        import_module('tqdm')
        left = self._start + _PATIENCE - time()
        if left > 0 and self._end.wait(left):
            return
        _SHOWN.append(self)
        try:
            while True:
                with _SCREEN:
                    self._go_on()
                if self._end.wait(_TICK):
                    return
        finally:
            _SHOWN.remove(self)
            self.take_away()

    def _go_on(self):
        """Let the clocks of all bars go on, or that of the line."""
        from tqdm import tqdm
        with tqdm.get_lock():
            bars = [bar for bar in tqdm._instances if bar is not self._bar]
        if bars:
            self.take_away()
            for bar in bars:
                bar.refresh()
            return
        if self._bar is None:
            self._bar = tqdm(bar_format=' ', leave=False, **_size())
            self._bar.start_t = self._start
        self._bar.bar_format = f'{self._words} [{{elapsed}}{self._parts}]'
        self._bar.refresh()
