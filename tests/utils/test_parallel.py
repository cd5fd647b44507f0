"""Work spread over threads, or whatever executor is given."""
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier, Event

import numpy as np
import pytest

from photutils_mgauss.utils import parallel
from photutils_mgauss.utils.parallel import map_chunks, map_parallel


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
