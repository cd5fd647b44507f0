"""Work for the processes of a survey, which import it quickly."""
import os
import sys
import time
from pathlib import Path

from photutils_mgauss.cli import survey_run
from photutils_mgauss.cli.survey_run import (
    Outcome,
    Task,
    kept_outcome,
    run_task,
)


def kill_once(task):
    """Take the process down, the first time."""
    mark = Path(task.record + '.mark')
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), 9)
    return Outcome(task.name, seconds=1.0)


def noted(task):
    """Run a task that takes some time, and note who works on it."""
    if kept_outcome(task) is not None:
        return run_task(task)
    with (Path(task.record).parents[1] / 'log').open('a') as log:
        log.write(f'{task.name} {os.getpid()}\n')
    time.sleep(0.1)
    return run_task(task)


def notes(folder):
    """Return the names and processes of the tasks begun, in order."""
    log = folder / 'log'
    if not log.exists():
        return []
    return [line.split() for line in log.read_text().splitlines(True)
            if line.endswith('\n')]


def tasks_without_work(folder, n):
    """Return tasks that read one file and write nothing but records."""
    source = folder / 'source'
    if not source.exists():
        source.touch()
    return [Task(f't{k:03d}', (), (str(source),), (),
                 str(folder / 'records' / f't{k:03d}.json'))
            for k in range(n)]


def drive(folder, n, workers=2):
    """Be the driver of a survey of n tasks."""
    folder = Path(folder)
    (folder / 'records').mkdir(exist_ok=True)
    survey_run.run_task = noted
    with survey_run.local_workers(workers) as processes:
        survey_run.run_tasks(tasks_without_work(folder, n), processes,
                             lambda _: None)


if __name__ == '__main__':
    drive(sys.argv[1], int(sys.argv[2]))
