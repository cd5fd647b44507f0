"""Fixtures shared by all tests: real data that may be absent, and seeds."""
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

# As many processes run tests as there are cores: more threads of linear
# algebra would wait for each other, here and in processes that tests start.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
threadpool_limits(1, user_api='blas')

REALDATA = Path(os.environ.get(
    'MGAUSS_REALDATA',
    Path(__file__).resolve().parents[2] / 'shared' / 'realdata'))


_COMPILING = []


def pytest_sessionstart(session):
    """Compile before processes share the tests: each would, all the same."""
    if getattr(session.config.option, 'numprocesses', None):
        _COMPILING.append(subprocess.Popen([
            sys.executable, '-m', 'photutils_mgauss', 'compile', '--quiet']))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished():
    """Wait until all is compiled: meanwhile the processes look for tests."""
    while _COMPILING:
        assert _COMPILING.pop().wait() == 0, 'mgauss compile failed'


@pytest.fixture
def realdata():
    """Return a function from a folder's name to its path, or skip."""
    def folder(name):
        path = REALDATA / name
        if not path.is_dir():
            pytest.skip(reason=f'real data folder {name} is not here')
        return path
    return folder


@pytest.fixture
def interruptible():
    """Let Ctrl-C interrupt, also where tests run in the background."""
    # A shell starts background jobs with the signal ignored, and they hand
    # that on to what they start.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def rng():
    """Return a seeded random generator, the same for every test."""
    return np.random.default_rng(20260101)
