"""
A command from its start to its exit code, whatever happens to it.

All commands pass through `run_command`: each error becomes one sentence,
each warning a line, and an interrupt is obeyed at once.
"""
import logging
import os
import signal
import sys
import warnings
from contextlib import contextmanager, suppress
from functools import partial

from tqdm import tqdm

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.warned import Warned
from photutils_mgauss.utils.parallel import Threads

_INTERRUPTED = 130
_TERMINATED = 143


class _TerminatedError(KeyboardInterrupt):
    """The process was asked to end, as by a batch system."""


def run_command(options, words, *, is_process):
    """
    Run a command.

    Parameters
    ----------
    options : `argparse.Namespace`
        With the function ``run``, which is called with them.
    words : sequence of str
        What the options were made of.
    is_process : bool
        Whether the command is all that the process does. It then ends at
        once when it is interrupted, also inside a compiled loop.

    Returns
    -------
    int
        The exit code.
    """
    with _warnings_shown() as warned:
        try:
            with _log_file(options.log_file, words):
                return _run(options, warned, is_process)
        except OSError as error:
            complain(tools.sentence_of(error))
            return 1


@contextmanager
def _warnings_shown():
    """Show each kind of warning as a line, once for each file."""
    from astropy import log
    from astropy.logger import LoggingError
    warned = Warned(_warn, partial(tools.LOG.warning, '%s'))
    # Or astropy would show its own.
    was_logged = log.warnings_logging_enabled()
    with suppress(LoggingError):
        log.disable_warnings_logging()
    try:
        with warnings.catch_warnings():
            if not sys.warnoptions:
                # Python would take those of two files for one.
                warnings.simplefilter('always')
                # What only programmers can do something about.
                for kind in (ResourceWarning, DeprecationWarning,
                             PendingDeprecationWarning, FutureWarning):
                    warnings.simplefilter('ignore', kind)
            warnings.showwarning = warned.show
            yield warned
    finally:
        if was_logged and not log.warnings_logging_enabled():
            log.enable_warnings_logging()


def _run(options, warned, is_process):
    """Return the exit code of a command; say what went wrong with it."""
    try:
        try:
            (_run_apart if is_process else options.run)(options)
        finally:
            warned.end()
    except _TerminatedError:
        complain('terminated')
        return _TERMINATED
    except KeyboardInterrupt:
        complain('interrupted')
        return _INTERRUPTED
    except Exception as error:  # noqa: BLE001 nobody above has words for it
        tools.LOG.debug('what went wrong:', exc_info=error)
        complain(tools.sentence_of(error))
        return 1
    return 0


def _run_apart(options):
    """
    Run a command in a thread while this one waits for it.

    The main thread, which signals are for, is never inside a compiled loop.
    """
    signal.signal(signal.SIGTERM, _terminate)
    work = Threads(1).submit(options.run, options)
    try:
        work.result()
    except KeyboardInterrupt as error:
        if not work.done():
            _leave(error)
        raise


def _terminate(*_):
    raise _TerminatedError


def _leave(error):
    """End the process although a thread is still at work."""
    terminated = isinstance(error, _TerminatedError)
    # Asking twice does not help.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    complain('terminated' if terminated else 'interrupted')
    with suppress(OSError):
        sys.stdout.flush()
    sys.stderr.flush()
    tools.clear_up()
    os._exit(_TERMINATED if terminated else _INTERRUPTED)


@contextmanager
def _log_file(path, words):
    """Write all that is said into a file, too."""
    tools.LOG.setLevel(logging.DEBUG)
    tools.LOG.propagate = False
    handler = (logging.NullHandler() if path is None
               else logging.FileHandler(path, encoding='utf-8'))
    handler.setFormatter(logging.Formatter(
        '%(asctime)s %(levelname)s %(message)s'))
    tools.LOG.addHandler(handler)
    tools.LOG.info('mgauss %s', ' '.join(words))
    try:
        yield
    finally:
        tools.LOG.removeHandler(handler)
        handler.close()


def complain(words):
    """Say what went wrong, as the last line of a command does."""
    tools.LOG.error('%s', words)
    tqdm.write(f'mgauss: {words}', file=sys.stderr)


def _warn(words):
    tools.LOG.warning('%s', words)
    tqdm.write(f'mgauss: warning: {words}', file=sys.stderr)
