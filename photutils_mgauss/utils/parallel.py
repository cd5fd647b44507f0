"""
Spreading independent pieces of work over an executor.

What an interrupt (Ctrl-C) has to reach waits here, in a thread that can be
woken, while compiled loops run in `Threads` that nobody waits for.
"""
import os
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar, copy_context
from functools import partial
from itertools import chain
from queue import Empty, SimpleQueue
from threading import Lock, Thread, current_thread, main_thread

from threadpoolctl import threadpool_limits

# Who wants to know how many pieces are done; see `watched`.
_WATCHER = ContextVar('watcher', default=None)


# The cores of which this process takes no more, by order of who started it.
_LIMIT = {}


def available_cores():
    """Return the number of cores this process may use."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        cores = os.cpu_count() or 1
    return min(cores, _LIMIT.get('cores', cores))


def limit_cores(number):
    """Have this process use no more cores, because others work beside it."""
    _LIMIT['cores'] = number


class Threads(Executor):
    """
    A pool of threads for compiled loops.

    The threads of the standard library's pool are waited for when something
    goes wrong, and again when the program ends: a compiled loop would hold up
    an interrupt until it is through. Nobody waits for these. They end with
    the program, and work in the context (`contextvars`) of their caller.

    Parameters
    ----------
    n : int, optional
        The number of threads; by default one for each core.
    """

    def __init__(self, n=None):
        self._tasks = SimpleQueue()
        self._is_open = True
        self._threads = [Thread(target=self._work, daemon=True)
                         for _ in range(n or available_cores())]
        for thread in self._threads:
            thread.start()

    def submit(self, function, /, *args, **kwargs):
        """Have a function called by the next free thread."""
        if not self._is_open:
            msg = 'cannot submit to a pool of threads that has been shut down'
            raise RuntimeError(msg)
        future, context = Future(), copy_context()
        # Pieces of a piece are not what anybody watches.
        context.run(_WATCHER.set, None)
        self._tasks.put((future, partial(context.run, function, *args,
                                         **kwargs)))
        return future

    def _work(self):
        while (task := self._tasks.get()) is not None:
            _fulfil(*task)
            del task  # or it would live until the next one comes

    def shutdown(self, wait=True, *, cancel_futures=False):
        """Take no more work; see `concurrent.futures.Executor.shutdown`."""
        if cancel_futures:
            with suppress(Empty):
                while True:
                    task = self._tasks.get_nowait()
                    if task is not None:
                        task[0].cancel()
        if self._is_open:
            self._is_open = False
            for _ in self._threads:
                self._tasks.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def __exit__(self, kind, error, trace):
        self.shutdown(wait=kind is None, cancel_futures=kind is not None)


class _SingleBlas:
    """
    While somebody is inside, linear algebra starts no threads of its own.

    They would wait for each other in loops, on cores that our threads need.
    The limit is one of the whole process: who comes first sets it, who leaves
    last lifts it.
    """

    def __init__(self):
        self._lock = Lock()
        self._inside = 0
        self._limits = None

    def __enter__(self):
        with self._lock:
            if self._inside == 0:
                self._limits = threadpool_limits(1, user_api='blas')
            self._inside += 1

    def __exit__(self, kind, error, trace):
        with self._lock:
            self._inside -= 1
            if self._inside == 0:
                self._limits.restore_original_limits()


SINGLE_BLAS = _SingleBlas()


def _fulfil(future, call):
    """Make a future come true, unless it has been cancelled."""
    if not future.set_running_or_notify_cancel():
        return
    try:
        result = call()
    except BaseException as error:  # noqa: BLE001 the caller gets it
        future.set_exception(error)
    else:
        future.set_result(result)


@contextmanager
def watched(watcher):
    """
    Let somebody know how the work in this context gets on.

    Parameters
    ----------
    watcher : callable
        Called with the number of pieces done and that of all pieces,
        whenever another one is done, by the thread that waits for them.
    """
    token = _WATCHER.set(watcher)
    try:
        yield
    finally:
        _WATCHER.reset(token)


def is_watched():
    """Whether somebody wants to know how the work in this context gets on."""
    return _WATCHER.get() is not None


def tell(done, total):
    """Tell who watches how many pieces of the work are done."""
    watcher = _WATCHER.get()
    if watcher is not None:
        watcher(done, total)


def told(pieces):
    """Yield pieces of a sequence and tell who watches when each is done."""
    for done, piece in enumerate(pieces, 1):
        yield piece
        tell(done, len(pieces))


def _told(results, total):
    """Yield results and tell who watches about each."""
    for done, result in enumerate(results, 1):
        tell(done, total)
        yield result


def map_parallel(function, *columns, executor=None, long=False):
    """
    Call a function on pieces of work and yield what it returns, in order.

    Parameters
    ----------
    function : callable
        A function of a module, or a partial of one, travels to processes too.
    *columns : iterable
        Its arguments, one of each for every piece.
    executor : `~concurrent.futures.Executor`, optional
        Where to run; None is a pool of threads on all cores, or this thread
        where one core or one piece is all there is. An exception, or closing
        the generator, cancels the pieces that have not begun, and does not
        wait for those that have.
    long : bool, optional
        Whether a single piece may take seconds. It gets a thread, too: the
        main thread cannot be interrupted inside a compiled loop.
    """
    columns = [list(column) for column in columns]
    n = len(columns[0])
    if executor is not None:
        yield from _told(executor.map(function, *columns), n)
        return
    n_threads = min(available_cores(), n)
    waits = long and n > 0 and current_thread() is main_thread()
    if n_threads < 2 and not waits:
        yield from _told(map(function, *columns), n)
        return
    with SINGLE_BLAS, Threads(n_threads) as pool:
        yield from _told(pool.map(function, *columns), n)


def map_chunks(function, arrays, executor, *, chunk_size=None, most=None):
    """
    Call a function on slices of arrays and join the lists it returns.

    Parameters
    ----------
    function : callable
        Takes one slice of each array, returns a list of as many elements.
    arrays : sequence of (n, ...) `~numpy.ndarray`
        What to cut along the first axis.
    executor : `~concurrent.futures.Executor` or None
        Where to run; see `map_parallel`.
    chunk_size : int, optional
        The length of a slice; by default there are four for each core.
    most : int, optional
        The longest slice by default. Short ones end together, on cores that
        are not equally free.

    Returns
    -------
    list
        n elements, in order.
    """
    if executor is not None and not hasattr(executor, 'map'):
        msg = ('executor must be a concurrent.futures.Executor, got '
               f'{executor!r:.80}')
        raise TypeError(msg)
    n, cores = len(arrays[0]), available_cores()
    size = chunk_size or max(1, min(-(-n // (4 * cores)), most or n))
    starts = range(0, n, size)
    chunks = ([array[i:i + size] for i in starts] for array in arrays)
    return list(chain.from_iterable(
        map_parallel(function, *chunks, executor=executor)))
