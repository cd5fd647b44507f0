"""Work spread over threads, or whatever executor is given."""
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event, Timer

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from photutils_mgauss.utils import parallel
from photutils_mgauss.utils.parallel import (
    Threads,
    map_chunks,
    map_parallel,
    watched,
)


@pytest.fixture(autouse=True)
def four_cores(monkeypatch):
    monkeypatch.setattr(parallel, 'available_cores', lambda: 4)


@pytest.fixture(params=['threads', 'executor'])
def executor(request):
    if request.param == 'threads':
        yield None
        return
    with ThreadPoolExecutor(4) as pool:
        yield pool


def test_results_come_in_the_order_of_the_work(executor):
    second_done = Event()

    def late_first(number):
        if number == 0:
            second_done.wait(10)
        if number == 1:
            second_done.set()
        return number

    assert list(map_parallel(late_first, range(9), executor=executor)) == list(
        range(9))


def test_pieces_run_side_by_side(executor):
    together = Barrier(4, timeout=10)
    list(map_parallel(lambda _: together.wait(), range(4), executor=executor))


def blas_threads():
    return {library['num_threads'] for library in threadpool_info()
            if library['user_api'] == 'blas'}


def test_linear_algebra_in_pieces_has_no_threads_of_its_own():
    def inside(_):
        together.wait()
        return blas_threads()

    together = Barrier(4, timeout=10)
    with threadpool_limits(3, user_api='blas'):
        assert list(map_parallel(inside, range(4))) == 4 * [{1}]
        assert blas_threads() == {3}


def test_the_last_of_several_users_gives_linear_algebra_its_threads_back():
    with threadpool_limits(3, user_api='blas'):
        first, second = (map_parallel(abs, range(4)) for _ in range(2))
        assert next(first) == next(second) == 0
        first.close()
        assert blas_threads() == {1}
        second.close()
        assert blas_threads() == {3}


def test_nothing_begins_after_an_exception(executor):
    begun = []
    hold = Event()

    def fail_first(number):
        begun.append(number)
        if number == 0:
            raise KeyboardInterrupt
        hold.wait(0.2)

    with pytest.raises(KeyboardInterrupt):
        list(map_parallel(fail_first, range(100), executor=executor))
    assert len(begun) < 20


def test_chunks_join_to_what_one_call_gives(executor):
    numbers = np.arange(23)
    assert map_chunks(lambda a, b: list(a + b), (numbers, 2 * numbers),
                      executor, chunk_size=5) == list(3 * numbers)


def test_what_is_no_executor_is_refused():
    with pytest.raises(TypeError, match='executor must be'):
        map_chunks(list, (np.arange(3),), 4)


def test_slices_are_no_longer_than_the_longest_allowed():
    lengths = map_chunks(lambda a: [len(a)] * len(a), (np.arange(1000),),
                         None, most=7)
    assert max(lengths) == 7
    assert len(lengths) == 1000


@pytest.mark.usefixtures('interruptible')
@pytest.mark.parametrize('n', [1, 3])
def test_an_interrupt_waits_for_no_piece(n, monkeypatch):
    monkeypatch.setattr(parallel, 'available_cores', lambda: 2)
    end = Event()
    Timer(0.3, os.kill, [os.getpid(), signal.SIGINT]).start()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(map_parallel(lambda _: end.wait(30), range(n), long=True))
    assert time.monotonic() - start < 5
    end.set()


def test_pieces_work_in_the_context_of_the_caller(four_cores):
    with np.errstate(divide='raise'), pytest.raises(FloatingPointError):
        list(map_parallel(lambda one: np.ones(1) / one, np.zeros((3, 1))))


def test_a_pool_of_threads_that_is_shut_down_cancels_what_has_not_begun():
    begun, hold = Event(), Event()
    pool = Threads(1)
    first = pool.submit(lambda: begun.set() or hold.wait(30))
    second = pool.submit(print)
    begun.wait(10)
    pool.shutdown(wait=False, cancel_futures=True)
    hold.set()
    assert first.result(10) is True
    assert second.cancelled()
    with pytest.raises(RuntimeError, match='shut down'):
        pool.submit(print)


def test_who_watches_is_told_of_each_piece(executor):
    told = []
    with watched(lambda *numbers: told.append(numbers)):
        list(map_parallel(lambda n: list(map_parallel(abs, range(n))),
                          range(3), executor=executor))
    assert told == [(1, 3), (2, 3), (3, 3)]
    list(map_parallel(abs, range(3), executor=executor))
    assert len(told) == 3
