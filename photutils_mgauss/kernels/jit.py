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
from numba.core import ir
from numba.core.analysis import compute_cfg_from_blocks, compute_use_defs
from numba.core.caching import FunctionCache, NullCache
from numba.core.compiler import CompilerBase, DefaultPassBuilder, Flags
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering, NopythonTypeInference
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
    dispatcher = njit(**_OPTIONS, _nrt=allocates,
                      pipeline_class=_KernelCompiler)(function)
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


def apart(function):
    """
    Compile a loop over arrays that share no memory, else like `sums`.

    Then what it changes in one place stays in registers until it is done.
    """
    return inner(function, pipeline=_ApartCompiler,
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


# How numba compiles. Without the following everything works as well, but
# takes twice as long to be ready for the first time.

# What numba's own pipeline does besides, for objects that kernels do without:
# closures, contexts, literal unrolling, parallel loops, and expressions of
# whole arrays. What follows only where an argument is not None stays out of
# code for None: what integrates over pixels where none is integrated.
_NOT_NEEDED = frozenset({
    'WithLifting', 'InlineClosureLikes', 'RewriteDynamicRaises',
    'MakeFunctionToJitFunction', 'InlineInlinables', 'FindLiterallyCalls',
    'LiteralUnroll', 'LiteralPropagationSubPipelinePass', 'InlineOverloads',
    'NopythonRewrites', 'RewriteSemanticConstants',
    'AnnotateTypes', 'DumpParforDiagnostics'})


# (function, types of arguments) -> signature, of calls.
_SIGNATURES = {}

# All sets of options that have been, so that equal ones are the same object.
_KNOWN_FLAGS = []


class _Typing:
    """
    The typing of a compilation, which remembers what calls return.

    numba asks a dozen possible meanings of a plus anew at each plus.
    """

    def __init__(self, context):
        self._context = context

    def __getattr__(self, name):
        return getattr(self._context, name)

    def resolve_function_type(self, function, args, keywords):
        """Return the signature of a call."""
        if isinstance(function, types.Dispatcher):
            # One version for all numbers, not one for each constant.
            args = tuple(map(types.unliteral, args))
        key = function, args
        if not keywords and key in _SIGNATURES:
            return _SIGNATURES[key]
        found = self._context.resolve_function_type(function, args, keywords)
        # Others are written in Python, and compiled as each caller is.
        if (isinstance(function, types.Function) and not keywords and
                function.get_impl_key(found) is function.typing_key):
            _SIGNATURES[key] = found
        return found


class _KnownFlags(Flags):
    """Options that stay as they are; numba compares them very often."""

    __slots__ = ('_all',)

    @classmethod
    def of(cls, flags):
        """Return what equals these options."""
        for known in _KNOWN_FLAGS:
            if known == flags:
                return known
        _KNOWN_FLAGS.append(cls(flags))
        return _KNOWN_FLAGS[-1]

    def __init__(self, flags):
        super().__init__(flags)
        self._all = super().values()

    def __hash__(self):
        return super().__hash__()

    def __eq__(self, other):
        return self is other or super().__eq__(other)

    def values(self):
        """Return a dict of all the options."""
        return self._all

    def copy(self):
        """Return the same."""
        return self


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
class _PrepareCode(AnalysisPass):
    """Optimise code once, all of a kernel together."""

    _name = 'prepare_code'

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
        """Leave functions as they are until all are there."""
        codegen, link = library._codegen, library.add_linking_library

        def lay_out(module):
            module.data_layout = codegen._data_layout

        def optimize():
            # numba 0.61 gives the passes alone.
            passes = codegen._module_pass_manager()
            passes, *rest = passes if isinstance(passes, tuple) else [passes]
            passes.run(library._final_module, *rest)

        def link_all(other):
            # Callers first: what nobody calls yet is not linked.
            link(other)
            for lender in getattr(other, 'lenders', ()):
                link_all(lender)

        library._optimize_functions = lay_out
        library.add_linking_library = link_all
        if hasattr(codegen, '_module_pass_manager'):
            library._optimize_final_module = optimize


@register_pass(mutates_CFG=False, analysis_only=True)
class _LendCode(_PrepareCode):
    """Leave machine code to the kernels that call."""

    _name = 'lend_code'

    def prepare(self, library):
        """Keep the library out of the running program."""
        super().prepare(library)
        library.lenders = []
        if hasattr(library, '_codegen'):
            library._codegen = _Lender(library._codegen)


@register_pass(mutates_CFG=False, analysis_only=True)
class _LendRawCode(_LendCode):
    """Leave optimisation and machine code to the kernels that call."""

    _name = 'lend_raw_code'

    def prepare(self, library):
        """Keep the library as it is, and out of the running program."""
        link = library.add_linking_library
        super().prepare(library)

        def remember(other):
            # A kernel gathers what it needs, which is copied once then.
            if hasattr(other, 'lenders'):
                other._ensure_finalized()
                library.lenders.append(other)
            else:
                link(other)

        library._optimize_final_module = lambda: None
        library.add_linking_library = remember


class _Lower(Lower):
    """
    What writes the code of a function for the compiler.

    numba keeps on the stack what is used in more than one block of code, named
    tuples of arrays too, and puts all of it together again wherever a part is
    used. What is assigned once needs no place there.
    """

    def _find_singly_assigned_variable(self):
        super()._find_singly_assigned_variable()
        if self.context.enable_nrt:
            return  # counts of who holds an array are kept on the stack
        dominators = compute_cfg_from_blocks(self.blocks).dominators()
        uses = compute_use_defs(self.blocks).usemap
        homes = {}
        for offset, block in self.blocks.items():
            for one in block.find_insts(ir.Assign):
                homes.setdefault(one.target.name, []).append(offset)
        self._singly_assigned_vars |= {
            name for name, home in homes.items() if len(home) == 1 and all(
                home[0] < offset and home[0] in dominators[offset]
                for offset, names in uses.items() if name in names)}


@register_pass(mutates_CFG=True, analysis_only=False)
class _LowerCode(NativeLowering):
    """numba's own pass with less on the stack."""

    _name = 'lower_code'
    lowering_class = _Lower


class _KernelCompiler(CompilerBase):
    """numba's own pipeline with one pass more and some less."""

    prepare = _PrepareCode

    def __init__(self, *args):
        super().__init__(*args)
        self.state.flags = _KnownFlags.of(self.state.flags)
        self.state.typingctx = _Typing(self.state.typingctx)

    def define_pipelines(self):
        """Return the passes."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (_LowerCode if one is NativeLowering else one, *rest)
            for one, *rest in passes.passes if one.__name__ not in _NOT_NEEDED]
        passes.add_pass_after(self.prepare, NopythonTypeInference)
        passes.finalize()
        return [passes]


class _LoopCompiler(_KernelCompiler):
    """The same for code that is put into kernels."""

    prepare = _LendCode


class _ApartCompiler(_LoopCompiler):
    """The same for code whose arrays do not overlap."""

    def __init__(self, *args):
        super().__init__(*args)
        flags = Flags(self.state.flags)
        flags.noalias = True
        self.state.flags = _KnownFlags.of(flags)


class _InnerCompiler(_KernelCompiler):
    """The same for code that is not optimised."""

    prepare = _LendRawCode


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
