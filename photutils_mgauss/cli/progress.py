"""How far a command has got: a bar on a terminal, lines in a log file."""
import sys
from threading import Event, Thread

from tqdm import tqdm

from photutils_mgauss.cli.tools import LOG
from photutils_mgauss.utils.parallel import watched

# How often the clock of the bar moves on [s].
_TICK = 0.5


class Progress:
    """
    A bar that moves on with each step of a command.

    There is none where nobody looks at it: with ``--quiet``, and where the
    standard error is no terminal. Within a step its clock goes on, and it
    counts the parts that work is split into.

    Parameters
    ----------
    total : int
        The number of steps.
    options : `argparse.Namespace`
        Those of the command.
    """

    def __init__(self, total, options):
        hidden = options.quiet or not sys.stderr.isatty()
        self._total = total
        self._step = 0
        self._bar = tqdm(total=total, disable=hidden, bar_format=' ')
        self._end = Event()
        self._clock = Thread(target=self._tick, daemon=True)
        self._watching = watched(self._part)

    def __enter__(self):
        self._watching.__enter__()
        if not self._bar.disable:
            self._clock.start()
        return self

    def __exit__(self, kind, error, trace):
        self._end.set()
        if self._clock.is_alive():
            self._clock.join()
        if kind is None:
            self._show(self._total)
        self._bar.close()
        self._watching.__exit__(kind, error, trace)

    def __call__(self, words):
        """Say what is done next; what was begun before is finished."""
        LOG.info('%s', words)
        self._bar.set_description_str(f'{words:40.40} ', refresh=False)
        self._show(self._step)
        self._step += 1

    def _part(self, done, total):
        """Count the parts of a step that are done."""
        if total > 1:
            self._show(self._bar.n, f', part {done} of {total}')

    def _show(self, n, more=''):
        self._bar.n = n
        self._bar.bar_format = ('{desc}{bar:20} '
                                f'{n}/{self._total} [{{elapsed}}{more}]')
        self._bar.refresh()

    def _tick(self):
        while not self._end.wait(_TICK):
            self._bar.refresh()
