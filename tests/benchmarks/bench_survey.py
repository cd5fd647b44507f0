"""
Exposures a minute of ``mgauss survey``, and what the machinery costs.

Simulates exposures of several fields, runs the survey with one process and
with two, and prints exposures a minute, the efficiency of two processes,
whether the results are the same to the bit, what an empty task costs, and the
largest memory of the driver.

Run: ``python tests/benchmarks/bench_survey.py [--fields 4] [--epochs 2]``
"""
import argparse
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.table import QTable

from photutils_mgauss import (
    Instrument,
    paper_exposures,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.cli import main
from photutils_mgauss.cli.survey_run import Task, local_workers, run_tasks


def write_images(folder, n_fields, n_epochs, size):
    """Write the exposures of fields that lie apart."""
    for k in range(n_fields):
        ra, dec = 192.8595, 27.0 + 0.1 * k
        sources = sky_field(120, 60, ra=ra, dec=dec, size=size * 0.074 / 60,
                            rng=k, magnitudes=(18, 22), separation=1,
                            parallaxes=False)
        exposures = paper_exposures(ra, dec, offset=0.5)
        chosen = np.linspace(0, 6, n_epochs).round().astype(int)
        scenes = simulate_epochs(sources, [exposures[i] for i in chosen],
                                 instrument=Instrument(shape=(size, size)),
                                 rng=k)
        for number, scene in enumerate(scenes):
            scene.write(folder / f'field{k}_{number}.fits')


def run_survey(folder, name, workers, pattern='*'):
    """Run the survey into a folder of its own; return its seconds."""
    path = folder / f'{name}.toml'
    path.write_text(f'output = "{name}"\n[exposures]\n'
                    f'files = ["raw/{pattern}.fits"]\n')
    start = time.perf_counter()
    code = main(['survey', str(path), '--workers', str(workers), '--quiet'])
    seconds = time.perf_counter() - start
    if code:
        sys.exit(f'the survey {name} failed')
    return seconds


def same(folder, one, other):
    """Return whether two runs gave the same numbers."""
    files = sorted((folder / one / 'motions').glob('*/motions.ecsv'))
    for file in files:
        twin = folder / other / file.relative_to(folder / one)
        tables = [QTable.read(path) for path in (file, twin)]
        if any(not np.array_equal(np.ma.filled(np.ma.asarray(getattr(
                tables[0][name], 'value', tables[0][name])), 0),
                np.ma.filled(np.ma.asarray(getattr(
                    tables[1][name], 'value', tables[1][name])), 0),
                equal_nan=tables[0][name].dtype.kind == 'f')
                for name in tables[0].colnames):
            return False
    return bool(files)


def overhead(folder, n=200):
    """Return the seconds that a task costs which does nothing."""
    source = folder / 'nothing.ecsv'
    QTable({'x': [1.0]}).write(source)
    tasks = [Task(f't{k}', (), (str(source),), (),
                  str(folder / 'records' / f't{k}.json')) for k in range(n)]
    run_tasks(tasks[:4], local_workers(2), lambda _: None)  # processes start
    start = time.perf_counter()
    run_tasks(tasks, local_workers(2), lambda _: None)
    return (time.perf_counter() - start) / n


def run(arguments):
    """Measure, and print the table."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / 'raw').mkdir()
        write_images(folder / 'raw', arguments.fields, arguments.epochs,
                     arguments.size)
        n = arguments.fields * arguments.epochs
        run_survey(folder, 'warm', 1, 'field0_*')
        seconds = {k: run_survey(folder, f'with{k}', k) for k in (1, 2)}
        for k, value in seconds.items():
            print(f'{n} exposures, {k} processes: {60 * n / value:.1f} a '
                  'minute')
        print(f'efficiency of two: {seconds[1] / seconds[2] / 2:.2f}')
        print(f'the same to the bit: {same(folder, "with1", "with2")}')
        print(f'a task that does nothing: {1e3 * overhead(folder):.1f} ms')
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f'largest memory of the driver: {memory:.0f} MB')


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--fields', type=int, default=4)
    parser.add_argument('--epochs', type=int, default=2)
    parser.add_argument('--size', type=int, default=512)
    run(parser.parse_args())
