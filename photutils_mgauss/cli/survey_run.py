"""
The tasks of a survey, run somewhere, and never twice.

A task is file names in, files out: images do not travel. Its record has a
digest of its commands, its version and its inputs; while nothing of these
changes, and its outputs are there, it is not run again.
"""
import json
import multiprocessing
import os
import time
import warnings
from collections import deque
from concurrent.futures import (
    FIRST_COMPLETED,
    Future,
    ProcessPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from pathlib import Path
from threading import Thread

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.results import file_marks

# A task whose worker died so often is not tried again.
_TRIES = 4


@dataclass(frozen=True)
class Task:
    """
    Commands that belong together.

    Attributes
    ----------
    name : str
        What it is called, also its record's file.
    commands : tuple of tuple of str
        The words of each command, run one after the other.
    inputs, outputs : tuple of str
        Files that they read and write.
    record : str
        The file of its record.
    kind : str, optional
        What is looked at when it is done, of `survey_results.FIGURES`.
    """

    name: str
    commands: tuple
    inputs: tuple
    outputs: tuple
    record: str
    kind: str = ''


@dataclass(frozen=True)
class Outcome:
    """
    How a task ended.

    ``error`` is a sentence, empty if all went well; ``seconds`` are those of
    the clock, ``cpu`` those of the processor; ``figures`` say how good the
    results are.
    """

    name: str
    error: str = ''
    seconds: float = 0.0
    notes: tuple = ()
    digest: str = ''
    skipped: bool = False
    cpu: float = 0.0
    figures: dict = field(default_factory=dict)


def run_task(task):
    """
    Run a task unless it is done; return its `Outcome`.

    This is what workers do: it takes and returns plain values.
    """
    try:
        digest = _digest(task)
    except OSError as error:
        return Outcome(task.name, tools.sentence_of(error))
    known = kept_outcome(task)
    if known is not None and known.digest == digest:
        return known
    start, cpu = time.perf_counter(), time.process_time()
    error, notes = _run(task)
    try:
        figures = {} if error else _figures(task)
        outcome = Outcome(task.name, error, time.perf_counter() - start,
                          tuple(notes), digest,
                          cpu=time.process_time() - cpu, figures=figures)
        if not error:
            with tools.whole_file(Path(task.record)) as draft:
                draft.write_text(json.dumps(asdict(outcome)),
                                 encoding='utf-8')
    except (OSError, ValueError) as problem:
        return Outcome(task.name, tools.sentence_of(problem))
    return outcome


def _figures(task):
    """Return the figures of merit of what a task made."""
    if not task.kind:
        return {}
    from photutils_mgauss.cli.survey_results import FIGURES
    return FIGURES[task.kind](task)


def kept_outcome(task):
    """Return the outcome in the record of a task that has its outputs."""
    record = Path(task.record)
    if not record.exists() or not all(map(_exists, task.outputs)):
        return None
    try:
        kept = json.loads(record.read_text(encoding='utf-8'))
        return Outcome(**{**kept, 'notes': tuple(kept['notes']),
                          'skipped': True})
    except (ValueError, TypeError, KeyError):
        return None


def _exists(path):
    return Path(path).exists()


def _digest(task):
    """Return what stands for the commands, the version and the inputs."""
    from photutils_mgauss.utils.checkpoint import digest_of
    return digest_of(task.commands, file_marks(*task.inputs))


def _run(task):
    """Run the commands; return what went wrong, and the warnings."""
    from photutils_mgauss.cli.survey_steps import step_parser
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('default')
        for words in task.commands:
            options = step_parser().parse_args([*words, '--quiet'])
            try:
                options.run(options)
            except Exception as error:  # noqa: BLE001 it becomes a sentence
                return tools.sentence_of(error), _notes(caught)
    return '', _notes(caught)


def _notes(caught):
    """Return the warnings that users can do something about."""
    return list(dict.fromkeys(
        tools.one_line(str(one.message)) for one in caught
        if not issubclass(one.category, (ResourceWarning, DeprecationWarning,
                                         PendingDeprecationWarning,
                                         FutureWarning))))


class Inline:
    """An executor that runs a task where it is submitted."""

    def submit(self, function, *arguments):
        """Run it, and return a future that is done."""
        future = Future()
        future.set_result(function(*arguments))
        return future

    def shutdown(self, **_):
        """Do nothing: there is nobody to send home."""


@dataclass
class Workers:
    """
    Where tasks run, step after step.

    Attributes
    ----------
    make : callable
        Returns an executor for one task at a time; called again where one
        broke.
    number : int
        How many of them there are.
    end : callable, optional
        Called when all is done.
    """

    make: object
    number: int
    end: object = lambda: None
    idle: list = field(default_factory=list)

    def lend(self, most):
        """
        Return executors, at most so many.

        Those that have worked come first: a process takes seconds to import
        what it works with.
        """
        number = min(self.number, most)
        lent = [self.idle.pop() for _ in range(min(number, len(self.idle)))]
        return lent + [self.make() for _ in range(number - len(lent))]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for executor in self.idle:
            executor.shutdown(wait=True)
        self.idle.clear()
        self.end()


def local_workers(number):
    """Return so many processes of this machine, or this one for one."""
    if number == 1:
        return Workers(Inline, 1)
    from photutils_mgauss.utils.parallel import available_cores
    context = multiprocessing.get_context('spawn')
    share = max(1, available_cores() // number)
    # A pool for each: where a process dies, its pool dies with it.
    return Workers(lambda: ProcessPoolExecutor(
        1, mp_context=context, initializer=_begin, initargs=(share,)), number)


def _begin(cores):
    """Prepare a process: so many cores, and an end with who started it."""
    from threadpoolctl import threadpool_limits

    from photutils_mgauss.utils.parallel import limit_cores
    limit_cores(cores)
    # Threads of linear algebra too: of what is loaded, and of what will be.
    threadpool_limits(cores, user_api='blas')
    for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ[name] = str(cores)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent():
    multiprocessing.parent_process().join()
    os._exit(1)


def cluster_workers(address):
    """
    Return the workers of a running Dask cluster.

    Parameters
    ----------
    address : str
        That of its scheduler, or the name of its scheduler file.

    Returns
    -------
    Workers

    Raises
    ------
    ValueError
        If Dask is not installed, or has no workers.
    """
    try:
        from dask.distributed import Client
    except ImportError as error:
        msg = ("--cluster needs Dask: pip install 'photutils_mgauss[dask]'")
        raise ValueError(msg) from error
    client = (Client(scheduler_file=address) if Path(address).is_file()
              else Client(address, timeout=30))
    number = sum(client.ncores().values())
    if not number:
        msg = f'--cluster must have workers, got none at {address}'
        raise ValueError(msg)
    # The same task may be asked for again after a failure; two for each
    # worker, so that the next one is there when one is done.
    return Workers(lambda: client.get_executor(pure=False), 2 * number,
                   client.close)


def run_tasks(tasks, workers, tell):
    """
    Run tasks, each by itself.

    Parameters
    ----------
    tasks : sequence of Task
        What to do.
    workers : Workers
        Where.
    tell : callable
        Called with the outcome of each task as it comes.

    Returns
    -------
    dict of str to Outcome
        By the names of the tasks. One that fails harms no other.
    """
    done, deaths = {}, {}
    waiting, running = deque(tasks), {}
    slots = workers.lend(len(tasks))
    free = list(range(len(slots)))
    try:
        while waiting or running:
            while waiting and free:
                slot, task = free.pop(), waiting.popleft()
                running[_submit(slots, slot, workers, task)] = slot, task
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                slot, task = running.pop(future)
                free.append(slot)
                error = future.exception()
                outcome = future.result() if error is None else _after(
                    task, error, deaths)
                if outcome is None:
                    waiting.appendleft(task)
                else:
                    done[task.name] = outcome
                    tell(outcome)
    finally:
        workers.idle.extend(slots)
    return done


def _submit(slots, slot, workers, task):
    """Return the future of a task, in a new process if the old one died."""
    try:
        return slots[slot].submit(run_task, task)
    except BrokenProcessPool:
        slots[slot].shutdown(wait=False)
        slots[slot] = workers.make()
        return slots[slot].submit(run_task, task)


def _after(task, error, deaths):
    """Return the outcome of a task whose worker died, None to try again."""
    deaths[task.name] = deaths.get(task.name, 0) + 1
    if deaths[task.name] < _TRIES:
        return None
    return Outcome(task.name, f'its worker died {_TRIES} times: '
                   f'{tools.sentence_of(error)}')
