"""Spreading independent pieces of work over an executor."""
import os
from concurrent.futures import ThreadPoolExecutor


def available_cores():
    """Return the number of cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def map_chunks(function, arrays, executor, *, chunk_size=None, most=None):
    """
    Call a function on slices of arrays and join the lists it returns.

    Parameters
    ----------
    function : callable
        Takes one slice of each array, returns a list of as many elements. A
        function of a module, or a partial of one, travels to processes too.
    arrays : sequence of (n, ...) `~numpy.ndarray`
        What to cut along the first axis.
    executor : `~concurrent.futures.Executor` or None
        Where to run; None is a pool of threads on all cores, or this thread
        where one slice is all there is.
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
    columns = [[array[i:i + size] for i in starts] for array in arrays]
    if executor is not None:
        parts = list(executor.map(function, *columns))
    elif cores == 1 or len(starts) < 2:
        parts = list(map(function, *columns))
    else:
        with ThreadPoolExecutor(cores) as pool:
            parts = list(pool.map(function, *columns))
    return [item for part in parts for item in part]
