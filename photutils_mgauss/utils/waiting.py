"""
Who waits at a terminal sees that something happens.

A call that takes long shows its name, a clock and the parts of its work that
are done, in a line that is gone when the call ends. There is none where its
caller shows how far it is, and none in files, threads and other processes.
"""
import sys
from contextlib import contextmanager
from multiprocessing import parent_process
from threading import Event, Thread, current_thread, main_thread

from photutils_mgauss.utils.parallel import is_watched, watched

# What ends sooner says nothing, and how often the clock goes on [s].
_PATIENCE, _TICK = 2.0, 0.5


@contextmanager
def waiting(words, progress_bar=False):
    """
    Show on a terminal that a call is at work, once it has taken long.

    Parameters
    ----------
    words : str
        What is done.
    progress_bar : bool, optional
        Whether the call shows a bar of its own, so that nothing else should
        be shown.
    """
    if is_watched() or not (progress_bar or _somebody_looks()):
        yield
        return
    if progress_bar:
        with watched(lambda _done, _total: None):
            yield
        return
    line = _Line(words)
    try:
        with watched(line.count):
            yield
    finally:
        line.close()


def _somebody_looks():
    """Whether this is what somebody has started at a terminal."""
    return (sys.stderr is not None and sys.stderr.isatty()
            and current_thread() is main_thread()
            and parent_process() is None)


class _Line:
    """A line with a clock, drawn by a thread of its own."""

    def __init__(self, words):
        self._words = words
        self._parts = ''
        self._end = Event()
        self._thread = Thread(target=self._draw, daemon=True)
        self._thread.start()

    def count(self, done, total):
        """Take note of how many parts of the work are done."""
        if total > 1:
            self._parts = f', part {done} of {total}'

    def close(self):
        """Take the line away."""
        self._end.set()
        self._thread.join()

    def _draw(self):
        if self._end.wait(_PATIENCE):
            return
        from tqdm import tqdm
        with tqdm(bar_format=' ', leave=False) as bar:
            bar.start_t -= _PATIENCE
            while not self._end.wait(_TICK):
                bar.bar_format = f'{self._words} [{{elapsed}}{self._parts}]'
                bar.refresh()
