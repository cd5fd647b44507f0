"""
How the loops are compiled and kept: the only module that names numba.

A function that Python calls is a `kernel`: it gets a wrapper for Python and is
kept on disk with all that it calls. A function that only kernels call is
`inner`: its code goes into the kernels that call it and is optimised there,
once, together with theirs; it has no wrapper, no file and no machine code of
its own. A `loop` is an inner function that is optimised by itself first.
"""
import gc
import logging
import pickle
import sys
import threading
import time
import warnings
from functools import cache, partial
from hashlib import sha256
from pathlib import Path

from numba import njit, types
from numba.core.caching import FunctionCache, NullCache
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import NopythonTypeInference
from numba.extending import intrinsic

_LOG = logging.getLogger('photutils_mgauss')
_OPTIONS = {'nogil': True, 'error_model': 'numpy', 'no_cfunc_wrapper': True}

# Compiling that takes longer than this is told to whoever waits [s].
_PATIENCE = 1.0

# Looking for garbage among all objects takes a tenth of the time of compiling,
# which makes many objects and little garbage: a threshold that is not reached.
_SELDOM = 1_000_000

# What reading a damaged file of compiled code may raise.
_UNREADABLE = (OSError, EOFError, ValueError, TypeError, AttributeError,
               ImportError, LookupError, pickle.UnpicklingError, RuntimeError)

# Name -> the compiled function, of all kernels.
KERNELS = {}


# A function that makes no arrays needs no counts of who holds them. Without
# them it is compiled in two thirds of the time; numba refuses what needs them.

def kernel(function=None, *, allocates=False):
    """Compile a function that Python calls, when it is first called."""
    if function is None:
        return partial(kernel, allocates=allocates)
    dispatcher = njit(**_OPTIONS, _nrt=allocates)(function)
    if dispatcher is not function:  # it is where numba is switched off
        dispatcher._cache = _keep(function)
        KERNELS[function.__name__] = dispatcher
    return dispatcher


def inner(function=None, *, allocates=False, pipeline=None, fastmath=False):
    """Compile a function into the kernels that call it."""
    if function is None:
        return partial(inner, allocates=allocates, pipeline=pipeline,
                       fastmath=fastmath)
    return njit(**_OPTIONS, _nrt=allocates, no_cpython_wrapper=True,
                fastmath=fastmath,
                pipeline_class=pipeline or _InnerCompiler)(function)


def loop(function):
    """
    Compile an inner function by itself before it goes into kernels.

    For the innermost loops: within the code of a large kernel the compiler no
    longer sees that it can work on several pixels at once.
    """
    return inner(function, pipeline=_LoopCompiler)


def sums(function):
    """
    Compile a loop that adds up numbers, in any order.

    Only then can the compiler work on several of them at once.
    """
    return inner(function, pipeline=_LoopCompiler,
                 fastmath={'reassoc', 'contract', 'nsz'})


def folder():
    """Return where compiled code is kept, or None where it cannot be."""
    return next((dispatcher._cache.cache_path
                 for dispatcher in KERNELS.values()), None)


# Compiled code on disk.

@cache
def _sources():
    """
    Return a digest of the source of all kernels.

    numba notices that the file of a function has changed, not that of a
    function it calls.
    """
    digest = sha256()
    for path in sorted(Path(__file__).parent.glob('*.py')):
        digest.update(path.read_bytes())
    return digest.hexdigest()


class _Announced:
    """A cache that tells when compiling takes long."""

    def load_overload(self, sig, target_context):
        """Return compiled code; None says that it is compiled now."""
        found = super().load_overload(sig, target_context)
        if found is None:
            _WAIT.begin()
        return found

    def save_overload(self, sig, data):
        """Keep what has been compiled."""
        _WAIT.end()
        super().save_overload(sig, data)


class _Kept(_Announced, FunctionCache):
    """Compiled code in files that know the source of all kernels."""

    def _index_key(self, sig, codegen):
        return (*super()._index_key(sig, codegen), _sources())

    def _load_overload(self, sig, target_context):
        try:
            return super()._load_overload(sig, target_context)
        except _UNREADABLE as error:
            _tell_once(f'it cannot be read: {error}')
            self.disable()
            return None

    def _save_overload(self, sig, data):
        try:
            super()._save_overload(sig, data)
        except (OSError, pickle.PicklingError) as error:
            _tell_once(f'it cannot be written: {error}')
            self.disable()


class _NotKept(_Announced, NullCache):
    """No files at all."""


def _keep(function):
    """Return the cache of a kernel; one without files where none can be."""
    private = ('_index_key', '_load_overload', '_save_overload')
    if not all(hasattr(FunctionCache, name) for name in private):
        _tell_once('this version of numba keeps it in another way')
        return _NotKept()
    try:
        return _Kept(function)
    except (RuntimeError, OSError) as error:
        _tell_once(str(error))
        return _NotKept()


_TOLD = []


def _tell_once(reason):
    if not _TOLD:
        _TOLD.append(reason)
        warnings.warn(
            'Compiled code is not kept, so that each process spends up to '
            f'half a minute on compiling ({reason}). Set NUMBA_CACHE_DIR to a '
            'folder that can be written.', UserWarning, stacklevel=2)


# Who waits is told.

class _Wait:
    """Says that code is compiled once that has taken a while."""

    def __init__(self):
        self._depth = 0
        self._seconds = 0.0
        self._start = None
        self._timer = None
        self._thresholds = gc.get_threshold()

    def begin(self):
        """Compiling starts, of a kernel or of one that it calls."""
        self._depth += 1
        if self._depth == 1:
            self._thresholds = gc.get_threshold()
            gc.set_threshold(*self._thresholds[:2], _SELDOM)
        if self._depth == 1 and self._seconds < _PATIENCE:
            self._start = time.monotonic()
            self._timer = threading.Timer(_PATIENCE - self._seconds, _say)
            self._timer.daemon = True
            self._timer.start()

    def end(self):
        """Compiling has ended."""
        self._depth = max(self._depth - 1, 0)
        if self._depth == 0:
            gc.set_threshold(*self._thresholds)
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._seconds += time.monotonic() - self._start


_WAIT = _Wait()


def _say():
    words = ('compiling (once per installation) ...' if folder()
             else 'compiling (its result cannot be kept) ...')
    if sys.stderr is not None and sys.stderr.isatty():
        sys.stderr.write(f'photutils_mgauss: {words}\n')
        sys.stderr.flush()
    else:
        _LOG.info(words)


# Inner functions. Without the following everything works as well, but each
# function is optimised again in every function that calls it.

class _Lender:
    """The code generator of a library that only lends its code."""

    def __init__(self, codegen):
        self._codegen = codegen

    def __getattr__(self, name):
        return getattr(self._codegen, name)

    def _add_module(self, module):
        """Make no machine code."""

    def set_env(self, name, env):
        """Give no environment to code that is not there."""


@register_pass(mutates_CFG=False, analysis_only=True)
class _LendCode(AnalysisPass):
    """Leave machine code to the kernels that call."""

    _name = 'lend_code'

    def __init__(self):
        AnalysisPass.__init__(self)

    def run_pass(self, state):
        """Prepare the library that the function is put into."""
        if state.library is None:
            codegen = state.targetctx.codegen()
            library = codegen.create_library(state.func_id.func_qualname)
            library.enable_object_caching()
            state.library = library
        self.prepare(state.library)
        return False

    def prepare(self, library):
        """Keep the library out of the running program."""
        if hasattr(library, '_codegen'):
            library._codegen = _Lender(library._codegen)


@register_pass(mutates_CFG=False, analysis_only=True)
class _LendRawCode(_LendCode):
    """Leave optimisation and machine code to the kernels that call."""

    _name = 'lend_raw_code'

    def prepare(self, library):
        """Keep the library as it is, and out of the running program."""
        super().prepare(library)
        library._optimize_final_module = lambda: None


class _LoopCompiler(CompilerBase):
    """numba's own pipeline with such a pass in it."""

    lend = _LendCode

    def define_pipelines(self):
        """Return the passes."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(self.lend, NopythonTypeInference)
        passes.finalize()
        return [passes]


class _InnerCompiler(_LoopCompiler):
    """The same for code that is not optimised."""

    lend = _LendRawCode


# The bits of a number, for exponentials.

@intrinsic
def float_of_bits(context, bits):
    """Return the number with the bits of an integer."""
    def generate(context, builder, signature, args):
        return builder.bitcast(args[0],
                               context.get_value_type(types.float64))
    return types.float64(types.int64), generate


@intrinsic
def bits_of_float(context, number):
    """Return the bits of a number as an integer."""
    def generate(context, builder, signature, args):
        return builder.bitcast(args[0], context.get_value_type(types.int64))
    return types.int64(types.float64), generate
