"""Spreading independent pieces of work over an executor."""
import os
from concurrent.futures import ThreadPoolExecutor
from itertools import chain


def available_cores():
    """Return the number of cores this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def map_parallel(function, *columns, executor=None):
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
        the generator, cancels the pieces that have not begun.
    """
    if executor is not None:
        yield from executor.map(function, *columns)
        return
    columns = [list(column) for column in columns]
    cores = available_cores()
    if cores == 1 or len(columns[0]) < 2:
        yield from map(function, *columns)
        return
    with ThreadPoolExecutor(cores) as pool:
        yield from pool.map(function, *columns)


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
