"""
Exposures a minute of ``mgauss survey``, and what the machinery costs.

Parts, with ``--parts``, all but ``whole`` by default:

``whole``   one run from images to motions by two workers, of 40 fields of 5
            epochs of two detectors, 200 exposures, with PSFs of three
            Gaussians and degree 2: exposures a minute, where the time goes,
            the driver's memory, what is lost. ``--pages`` draws the page of
            each exposure, too.
``speed``   the survey of simulated exposures, each a process of its own, by
            one worker on one core and by two on two: exposures a minute, the
            efficiency of two, the processor's time of workers and driver,
            bytes written, and whether the results are the same to the bit.
``task``    what a task costs that does nothing.
``memory``  the largest memory of a driver of tiny exposures, for some and for
            twice as many.
``kills``   workers (20) and drivers (5) killed at random while tiny exposures
            are measured: what is lost, and what is done twice.

Run: ``python tests/benchmarks/bench_survey.py [--fields 8] [--epochs 2]``;
``--parts whole --fields 40 --epochs 5`` for 200 exposures end to end,
``--parts memory --tiny 200`` for the memory of 200 and of 400.
"""
import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable, vstack
from astropy.wcs import WCS

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    Instrument,
    paper_exposures,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.cli import main, survey_run
from photutils_mgauss.cli.survey_plan import read_survey
from photutils_mgauss.cli.survey_tasks import exposure_tasks

PARTS = ('speed', 'task', 'memory', 'kills', 'whole')
NO_PAGES = 'pages = false\n'
QUICK = '[psf]\nn_components = 3\ndegree = 2\n'
TABLES = ('catalogues', 'motions', 'motions_hats/dataset', 'wcs')


# Images.

def write_images(folder, n_fields, n_epochs, size):
    """
    Write the exposures of fields that lie apart, and all quasars.

    Fields are taken by two detectors in turn.
    """
    quasars = []
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
            path = folder / f'field{k:02d}_{number}.fits'
            scene.write(path)
            fits.setval(path, 'DETECTOR', value=f'CCD{k % 2 + 1}')
        quasars.append(sources[sources['kind'] == 'qso']['ra', 'dec'])
    known = vstack(quasars)
    known['class'] = 'qso'
    known.write(folder.parent / 'quasars.ecsv')


def write_tiny(folder, n, size=64, stars=9):
    """Write tiny exposures, two of each field, and their PSF."""
    mixture = GaussianMixture([1.0], [[0, 0]], [np.eye(2)])
    psf = GriddedMixturePSF([mixture], [[0, 0]])
    psf.write(folder / 'psf.fits')
    (folder / 'raw').mkdir()
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(12, size - 12, 3),
                       np.linspace(12, size - 12, 3))
    model = np.full((size, size), 100.0)
    yy, xx = np.mgrid[:size, :size]
    for x0, y0 in zip(x.ravel()[:stars], y.ravel(), strict=False):
        model += 2e4 * mixture.evaluate(xx - x0, yy - y0)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.cdelt, wcs.wcs.crpix = (-2e-5, 2e-5), (size / 2, size / 2)
    for k in range(n):
        wcs.wcs.crval = 10.0 + 0.01 * (k // 2), 20.0
        header = wcs.to_header()
        header.update({'BUNIT': 'electron',
                       'DATE-AVG': f'20{27 + k % 2}-03-01T00:00:00'})
        fits.writeto(folder / 'raw' / f'e{k:04d}.fits',
                     rng.poisson(model).astype('f4'), header)


# Runs.

def survey_file(folder, name, text='', top=''):
    """Write a survey file; return its name."""
    path = folder / f'{name}.toml'
    path.write_text(f'output = "{name}"\n{top}[exposures]\n'
                    f'files = ["raw/*.fits"]\n{text}', encoding='utf-8')
    return path


def tiny_survey(folder):
    """Return the survey of tiny exposures, of which no pages are drawn."""
    return survey_file(folder, 'out', '[photometry]\npsf = "psf.fits"\n',
                       NO_PAGES)


def run_survey(path, workers, cores):
    """Run a survey in a process of its own; return what it took."""
    cpus = sorted(os.sched_getaffinity(0))[:cores]
    result = subprocess.run(
        [sys.executable, __file__, '--drive', str(path), str(workers)],
        check=False, capture_output=True, text=True,
        preexec_fn=lambda: os.sched_setaffinity(0, cpus))
    if result.returncode:
        sys.exit(f'the survey {path} failed: {result.stdout[-1000:]}'
                 f'{result.stderr[-2000:]}')
    return json.loads(result.stdout.splitlines()[-1])


def drive(path, workers):
    """Run a survey here, and print what it took as JSON."""
    start = time.perf_counter()
    code = main(['survey', path, '--workers', workers, '--quiet'])
    mine, theirs = (resource.getrusage(who) for who in (
        resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(json.dumps({
        'seconds': time.perf_counter() - start,
        'driver': mine.ru_utime + mine.ru_stime,
        'workers': theirs.ru_utime + theirs.ru_stime,
        'memory': mine.ru_maxrss / 1024}))
    return code


def plain(path):
    """Return the columns of a table as plain arrays."""
    if path.suffix == '.parquet':
        from pyarrow import parquet
        table = parquet.read_table(path)
        return {name: table[name].to_numpy() for name in table.column_names}
    if path.suffix != '.ecsv':
        return {'bytes': path.stat().st_size}
    table = QTable.read(path)
    return {name: np.ma.filled(np.ma.asarray(getattr(
        table[name], 'value', table[name])), 0) for name in table.colnames}


def same(one, other):
    """Return the number of files compared, 0 if any differs."""
    files = sorted(path for name in TABLES for path in (one / name).rglob('*')
                   if path.is_file())
    for file in files:
        twin = plain(other / file.relative_to(one))
        for name, values in plain(file).items():
            if not np.array_equal(values, twin[name], equal_nan=np.asarray(
                    values).dtype.kind == 'f'):
                print(f'differs: {file.relative_to(one)} {name}')
                return 0
    return len(files)


def size_of(folder):
    """Return the bytes of all files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob('*')
               if path.is_file())


# Parts.

def speed(folder, options):
    """Print exposures a minute, and whether results are the same."""
    (folder / 'raw').mkdir()
    write_images(folder / 'raw', options.fields, options.epochs, options.size)
    n = options.fields * options.epochs
    warm = survey_file(folder, 'warm', top=NO_PAGES)
    warm.write_text(warm.read_text().replace('raw/*', 'raw/field00*'))
    run_survey(warm, 2, 2)
    took = {k: run_survey(survey_file(folder, f'with{k}', top=NO_PAGES), k,
                          k) for k in (1, 2)}
    for k, one in took.items():
        cpu = one['driver'] + one['workers']
        print(f'{n} exposures of {options.size}^2, {k} worker(s) on {k} '
              f'core(s): {one["seconds"]:.0f} s, '
              f'{60 * n / one["seconds"]:.2f} a minute; '
              f'{cpu / n:.2f} CPU s an exposure, of which the driver '
              f'{one["driver"] / n:.2f}')
    print('efficiency of two: '
          f'{took[1]["seconds"] / took[2]["seconds"] / 2:.3f} by the clock, '
          f'{sum_of(took[1]) / sum_of(took[2]):.3f} by CPU time')
    print('the same to the bit: '
          f'{same(folder / "with1", folder / "with2")} files')
    tasks = exposure_tasks(read_survey(folder / 'with2.toml'))
    import pickle
    sent = [len(pickle.dumps(task)) for task in tasks]
    back = [len(pickle.dumps(survey_run.kept_outcome(task)))
            for task in tasks]
    print(f'to a worker and back: {np.mean(sent):.0f} and '
          f'{np.mean(back):.0f} bytes a task; images of '
          f'{size_of(folder / "raw") / n / 1e6:.2f} MB stay')
    written = folder / 'with2'
    parts = {one.name: size_of(one) for one in sorted(written.iterdir())
             if one.is_dir()}
    print('written, MB an exposure: ' + ', '.join(
        f'{name} {size / n / 1e6:.3f}' for name, size in parts.items()))


def sum_of(took):
    """Return the processor's seconds of a run."""
    return took['driver'] + took['workers']


def whole(folder, options):
    """Print what a survey takes from images to motions."""
    (folder / 'raw').mkdir()
    start = time.perf_counter()
    write_images(folder / 'raw', options.fields, options.epochs, options.size)
    n = options.fields * options.epochs
    print(f'{n} exposures are simulated in {time.perf_counter() - start:.0f}'
          ' s', flush=True)
    path = survey_file(
        folder, 'out', f'detector = "DETECTOR"\n{QUICK}[motions]\n'
        'references = "quasars.ecsv"\n', '' if options.pages else NO_PAGES)
    took = run_survey(path, 2, 2)
    print(f'{n} exposures of {options.size}^2 by 2 workers on 2 cores: '
          f'{took["seconds"]:.0f} s, {60 * n / took["seconds"]:.2f} a '
          f'minute; driver {took["driver"]:.1f} CPU s and '
          f'{took["memory"]:.1f} MB, workers {took["workers"]:.0f} CPU s')
    records = [json.loads(one.read_text()) for one in (
        folder / 'out' / 'records').glob('*.json')]
    kinds = {'exposures': [one for one in records
                           if 'FWHM [pix]' in one['figures']],
             'fields': [one for one in records
                        if 'exposures' in one['figures']],
             'pages': [one for one in records
                       if one['name'].endswith('_page')]}
    for what, some in kinds.items():
        print(f'{len(some)} {what}: '
              f'{sum(one["cpu"] for one in some):.0f} CPU s')
    stars = sum(one['figures']['with motions'] for one in kinds['fields'])
    print(f'{stars} stars with motions; '
          f'{size_of(folder / "out") / n / 1e6:.2f} MB an exposure are '
          'written')


def one_task(folder, _):
    """Print what a task costs that does nothing."""
    n = 200
    source = folder / 'nothing.ecsv'
    QTable({'x': [1.0] * u.pix}).write(source)
    tasks = [survey_run.Task(f't{k}', (), (str(source),), (), str(
        folder / 'records' / f't{k}.json')) for k in range(n)]
    for some in (tasks[:n // 2], tasks):  # the half is done, and skipped
        times = []
        cpu = time.process_time()
        with survey_run.local_workers(2) as workers:
            survey_run.run_tasks(some, workers, lambda _, times=times:
                                 times.append(time.perf_counter()))
        # Until the first one comes back, processes start.
        print(f'{len(some)} tasks that do nothing: '
              f'{1e3 * (times[-1] - times[1]) / (len(some) - 2):.1f} ms each,'
              f' driver {1e3 * (time.process_time() - cpu) / len(some):.1f} '
              'CPU ms')


def memory(folder, options):
    """Print the largest memory of drivers."""
    found = {}
    for n in (options.tiny, 2 * options.tiny):
        place = folder / str(n)
        place.mkdir()
        write_tiny(place, n)
        took = run_survey(tiny_survey(place), 2, 2)
        found[n] = took['memory']
        print(f'{n} tiny exposures: driver {took["memory"]:.1f} MB, '
              f'{took["driver"]:.1f} CPU s; workers '
              f'{took["workers"]:.1f} CPU s')
    few, many = found.values()
    print(f'twice as many take {100 * (many / few - 1):.1f} % more')


def kills(folder, options):
    """Print what is lost and done twice when processes are killed."""
    write_tiny(folder, options.tiny)
    path = tiny_survey(folder)
    rng = np.random.default_rng(options.seed)
    wanted = ['worker'] * 20 + ['driver'] * 5
    rng.shuffle(wanted)
    log = folder / 'log'
    log.touch()
    driver = begin(path)
    step = options.tiny // (len(wanted) + 2)
    for k, what in enumerate(wanted):
        while len(lines(log)) < step * (k + 1):
            time.sleep(0.005)
            if driver.poll() is not None:
                sys.exit('the survey ended before all kills')
        time.sleep(rng.uniform(0, 0.3))
        if what == 'worker':
            os.kill(int(lines(log)[-1].split()[1]), signal.SIGKILL)
        else:
            driver.kill()
            driver.wait()
            driver = begin(path)
    code = driver.wait()
    names = [line.split()[0] for line in lines(log)]
    done = len(list((folder / 'out' / 'records').glob('e*.json')))
    print(f'20 workers and 5 drivers of 2 workers killed: exit code {code}, '
          f'{done} of {options.tiny} exposures have results, '
          f'{len(names) - len(set(names))} were begun again (at most '
          f'{20 + 2 * 5})')


def begin(path):
    """Start a survey whose tasks are noted."""
    return subprocess.Popen([sys.executable, __file__, '--noted', str(path)])


def lines(log):
    """Return the whole lines of a log."""
    return [line for line in log.read_text().splitlines(True)
            if line.endswith('\n')]


def noted(task):
    """Run a task, and note who works on it."""
    if (task.kind == 'exposure'
            and survey_run.kept_outcome(task) is None):
        with (Path(task.record).parents[2] / 'log').open('a') as log:
            log.write(f'{task.name} {os.getpid()}\n')
    return survey_run.run_task(task)


def run(options):
    """Measure, and print."""
    functions = {'speed': speed, 'task': one_task, 'memory': memory,
                 'kills': kills, 'whole': whole}
    for part in options.parts.split(','):
        with tempfile.TemporaryDirectory() as name:
            functions[part](Path(name), options)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--parts', default=','.join(PARTS[:-1]))
    parser.add_argument('--fields', type=int, default=8)
    parser.add_argument('--epochs', type=int, default=2)
    parser.add_argument('--size', type=int, default=512)
    parser.add_argument('--tiny', type=int, default=200)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--pages', action='store_true')
    parser.add_argument('--drive', nargs=2)
    parser.add_argument('--noted')
    arguments = parser.parse_args()
    if arguments.drive:
        sys.exit(drive(*arguments.drive))
    if arguments.noted:
        survey_run.run_task = noted
        sys.exit(main(['survey', arguments.noted, '--workers', '2',
                       '--quiet']))
    run(arguments)
