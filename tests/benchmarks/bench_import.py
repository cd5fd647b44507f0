"""
Time to import the package, beside `photutils.psf`, its heaviest dependency.

Run as ``python tests/benchmarks/bench_import.py``. Each import runs in a fresh
interpreter, the statements in turn, so that a change of the machine's load
meets all of them. Printed are medians and the extra cost over photutils.psf.
"""
import argparse
import statistics
import subprocess
import sys

STATEMENTS = (
    'import photutils.psf',
    'import photutils_mgauss',
    'import photutils.psf, photutils_mgauss',
    'from photutils_mgauss import *',
)
CODE = """
import time
wall, cpu = time.perf_counter(), time.process_time()
{statement}
print(time.perf_counter() - wall, time.process_time() - cpu)
"""


def time_import(statement):
    """Return wall-clock and CPU seconds of one import."""
    result = subprocess.run(
        [sys.executable, '-c', CODE.format(statement=statement)], check=True,
        capture_output=True, text=True)
    return [float(word) for word in result.stdout.split()]


def measure(repeats):
    """Return the median seconds (wall, CPU) of each statement."""
    times = {statement: [] for statement in STATEMENTS}
    for _ in range(repeats + 1):
        for statement in STATEMENTS:
            times[statement].append(time_import(statement))
    # The first round may have compiled bytecode and filled disk caches.
    return {statement: [statistics.median(column)
                        for column in zip(*rows[1:], strict=True)]
            for statement, rows in times.items()}


def main():
    """Measure and print one row for each statement."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--repeats', type=int, default=9)
    medians = measure(parser.parse_args().repeats)
    peer = medians[STATEMENTS[0]]
    print(f'{"statement":42} {"wall s":>7} {"CPU s":>7} {"more (CPU)":>11}')
    for statement, (wall, cpu) in medians.items():
        print(f'{statement:42} {wall:7.2f} {cpu:7.2f} {cpu - peer[1]:+11.2f}')


if __name__ == '__main__':
    main()
