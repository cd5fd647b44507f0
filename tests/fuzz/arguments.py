"""
Odd arguments: every public function gives a value or a clean error.

Each argument of the calls of `public_calls` in turn is replaced by something
a person may hand over by mistake. A clean error is a TypeError, ValueError,
OSError or UnitsError with a sentence, raised by this package, photutils or
astropy and not below them. A call longer than `LONGEST` is a hang. ::

    python tests/fuzz/arguments.py [NAME ...]
"""
import signal
import sys
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import Table
from astropy.time import Time

# Seconds of the processor: on a busy machine a call of ten seconds takes a
# minute, and an example that fails only then is no example. What waits for
# ever takes no such time, but ten times as long by the clock.
LONGEST = 60
SPEAKING = ('photutils_mgauss', 'photutils', 'astropy')
CLEAN = (TypeError, ValueError, OSError, u.UnitsError)

# Made anew for each call, as some can be used up.
ODD_VALUES = {
    'None': lambda: None,
    'text': lambda: 'what',
    'empty text': lambda: '',
    'bytes': lambda: b'abc',
    'nan': lambda: np.nan,
    'inf': lambda: np.inf,
    '-1': lambda: -1,
    '0': lambda: 0,
    '0.5': lambda: 0.5,
    '1e300': lambda: 1e300,
    '10**30': lambda: 10**30,
    'True': lambda: True,
    'complex': lambda: 1 + 2j,
    'object': object,
    'function': lambda: len,
    'dictionary': lambda: {'a': 1},
    'set': lambda: {1, 2},
    'generator': lambda: iter((1, 2)),
    'empty list': list,
    'list': lambda: [1.0, 2.0, 3.0],
    'negative list': lambda: [-1.0, -2.0],
    'list of text': lambda: ['a', 'b'],
    '1d array': lambda: np.arange(5.0),
    '3d array': lambda: np.ones((2, 2, 2)),
    'array of text': lambda: np.array([['a', 'b'], ['c', 'd']]),
    'empty image': lambda: np.zeros((0, 0)),
    'flat image': lambda: np.ones((1, 64)),
    'image of zeros': lambda: np.zeros((64, 64)),
    'image of NaN': lambda: np.full((64, 64), np.nan),
    'masked': lambda: np.ma.masked,
    'length': lambda: 3 * u.m,
    'angles': lambda: [1.0, 2.0] * u.arcsec,
    'time': lambda: Time('2020-01-01'),
    'date': lambda: np.datetime64('2020-01-01'),
    'table': lambda: Table({'a': [1, 2]}),
    'empty table': Table,
}


class HangError(Exception):
    """A call takes too long."""


@contextmanager
def time_limit(seconds):
    def stop(*_):
        raise HangError

    limits = ((signal.ITIMER_PROF, signal.SIGPROF, seconds),
              (signal.ITIMER_REAL, signal.SIGALRM, 10 * seconds))
    before = {sent: signal.signal(sent, stop) for _, sent, _ in limits}
    for timer, _, length in limits:
        signal.setitimer(timer, length)
    try:
        yield
    finally:
        for timer, _, _ in limits:
            signal.setitimer(timer, 0)
        for sent, handler in before.items():
            signal.signal(sent, handler)


def outcome(function, arguments):
    """Return 'value', 'clean error' or what is wrong, and a sentence."""
    try:
        with time_limit(LONGEST), warnings.catch_warnings():
            warnings.simplefilter('ignore')
            function(**arguments)
    except HangError:
        return 'hang', f'more than {LONGEST} s'
    except Exception as error:  # noqa: BLE001
        return _judged(error)
    return 'value', ''


def _judged(error):
    last = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    words = f'{type(error).__name__}: {error} ({last.name})'
    clean = (isinstance(error, CLEAN) and str(error)
             and not isinstance(error, np.linalg.LinAlgError)
             and set(SPEAKING) & set(last.parts))
    return ('clean error' if clean else 'unclean'), words


def main(names):
    from fuzz.public_calls import all_calls

    counts = Counter()
    for name, (function, valid) in all_calls().items():
        if names and name not in names:
            continue
        for argument in valid:
            for label, make in ODD_VALUES.items():
                found, words = outcome(function, {**valid, argument: make()})
                counts[found] += 1
                if found in ('unclean', 'hang'):
                    sys.stdout.write(f'{name}({argument}={label}): {found}, '
                                     f'{words:.160}\n')
    sys.stdout.write(', '.join(f'{n} {found}' for found, n
                               in counts.most_common()) + '\n')


if __name__ == '__main__':
    sys.path.insert(0, str(Path(__file__).parents[1]))
    main(sys.argv[1:])
