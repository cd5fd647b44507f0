"""``mgauss survey``: exposures of many fields to motions, in one run."""
import os
import sys
import time
from pathlib import Path

from tqdm import tqdm

from photutils_mgauss.cli import tools

# Results of a task that is done again are replaced.
_TO = ('--overwrite', '--output')
_EXAMPLE = """\
# What mgauss survey does. Names are relative to the folder of this file.
output = "survey"

[exposures]
files = {files}
# ext = "SCI"             # of files with several images: all of this name
# group_by = ["FILTER"]   # keywords whose values keep fields apart
# overlap = 0.5           # share in common from which images are of one field

# The options of mgauss psf, photometry and motions, with _ for -.
[psf]
# n_components = 6
# degree = 3

[photometry]
# psf = "psf.fits"        # measure with this PSF, and make none
# crowded = true

[motions]
# references = "gaia.ecsv"
# parallax = true
"""


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'survey', 'exposures of many fields to motions, in one run',
        'Make the PSF of each exposure, measure its stars, and fit the '
        'motions of each field, that is, of the exposures that overlap. What '
        'is finished is not done again: a run that was stopped goes on.',
        'mgauss survey --init raw && mgauss survey survey.toml', run)
    parser.add_argument('file', nargs='?', metavar='SURVEY.toml',
                        help='what to do')
    parser.add_argument('--init', metavar='FOLDER',
                        help='write an example, survey.toml, for the images '
                             'in a folder')
    parser.add_argument('--dry-run', action='store_true',
                        help='show the plan, and stop')
    parser.add_argument('--workers', type=tools.count, metavar='N',
                        default=os.cpu_count(),
                        help='processes (default: %(default)s)')
    parser.add_argument('--cluster', metavar='ADDRESS',
                        help='scheduler of a Dask cluster, or its scheduler '
                             'file')


def run(options):
    """Run the survey."""
    if (options.file is None) == (options.init is None):
        options.parser.error('either SURVEY.toml or --init must be given')
    if options.init is not None:
        _write_example(options)
        return
    from photutils_mgauss.cli.survey_plan import read_survey
    path = Path(options.file)
    tools.check_inputs([path])
    survey = read_survey(path)
    tools.check_folder(survey.output)
    tools.say(options, *_plan(survey))
    if not options.dry_run:
        _run(options, survey)


def _write_example(options):
    folder = Path(options.init)
    images = sorted(path for pattern in ('*.fits', '*.fits.*')
                    for path in folder.glob(pattern))
    # Beside FITS images ASDF files hold their WCS.
    images = images or sorted(folder.glob('*.asdf'))
    if not images:
        msg = f'{folder}: must have images (*.fits, *.asdf), got none'
        raise ValueError(msg)
    name = Path('survey.toml')
    tools.claim([name], overwrite=False)
    endings = sorted({''.join(path.suffixes[-2:]) if path.suffix in
                      ('.gz', '.fz') else path.suffix for path in images})
    files = [f'{folder.as_posix()}/*{ending}' for ending in endings]
    with tools.whole_file(name) as draft:
        draft.write_text(_EXAMPLE.format(files=str(files).replace("'", '"')),
                         encoding='utf-8')
    tools.say(options, f'{name} is written, for {len(images)} images')


def _plan(survey):
    """Return the lines that show what will be done."""
    tasks = exposure_tasks(survey)
    from photutils_mgauss.cli.survey_run import kept_outcome
    old = sum(kept_outcome(task) is not None for task in tasks)
    total = (f'{len(survey.exposures)} exposures in {len(survey.fields)} '
             f'fields, to {survey.output}')
    lines = [total, f'{old} exposures have results of an earlier run']
    for name, members in survey.fields.items():
        years = [survey.exposures[i].year for i in members]
        names = ', '.join(survey.exposures[i].name for i in members)
        lines.append(f'  {name}: {len(members)} exposures, {min(years):.2f} '
                     f'to {max(years):.2f}: {names}')
    return lines


def exposure_tasks(survey):
    """Return the task of each exposure: its PSF and its catalogue."""
    return [_exposure_task(survey, exposure) for exposure in survey.exposures]


def _exposure_task(survey, exposure):
    from photutils_mgauss.cli.survey_run import Task
    catalogue, psf = _catalogue(survey, exposure), _psf(survey, exposure)
    ext = () if exposure.ext is None else ('--ext', exposure.ext)
    image = str(exposure.path)
    commands, given = [], []
    photometry = survey.options['photometry']
    if psf is not None:
        commands.append(('psf', image, *_TO, str(psf), *ext,
                         *survey.options['psf']))
        given = ['--psf', str(psf)]
    commands.append(('photometry', image, *_TO, str(catalogue), *given,
                     *ext, *photometry))
    outputs = [str(path) for path in (psf, catalogue) if path is not None]
    return Task(exposure.name, tuple(commands), (image,), tuple(outputs),
                str(survey.output / 'records' / f'{exposure.name}.json'))


def _psf(survey, exposure):
    """Return the file of an exposure's own PSF, or None if it has none."""
    words = survey.options['photometry']
    if '--psf' in words or '--crowded' in words:
        return None
    return survey.output / 'psfs' / f'{exposure.name}.fits'


def _catalogue(survey, exposure):
    return survey.output / 'catalogues' / f'{exposure.name}.ecsv'


def field_tasks(survey, measured):
    """
    Return the task of each field that has something to fit.

    Parameters
    ----------
    survey : Survey
        The plan.
    measured : set of str
        The exposures that have a catalogue.

    Returns
    -------
    list of Task
    """
    from photutils_mgauss.cli.survey_run import Task
    tasks = []
    least = 1 if '--references' in survey.options['motions'] else 2
    for name, members in survey.fields.items():
        files = [str(_catalogue(survey, survey.exposures[i]))
                 for i in members if survey.exposures[i].name in measured]
        if len(files) < least:
            continue
        folder = survey.output / 'motions' / name
        tasks.append(Task(
            name, (('motions', *files, *_TO, str(folder),
                    *survey.options['motions']),), tuple(files),
            (str(folder / 'motions.ecsv'),),
            str(survey.output / 'records' / f'{name}.json')))
    return tasks


def _run(options, survey):
    from photutils_mgauss.cli.survey_run import cluster_workers, local_workers
    start = time.perf_counter()
    workers = (local_workers(options.workers) if options.cluster is None
               else cluster_workers(options.cluster))
    done = _do(options, exposure_tasks(survey), workers, 'exposures')
    measured = {name for name, outcome in done.items() if not outcome.error}
    fields = _do(options, field_tasks(survey, measured), workers, 'fields')
    _finish(options, survey, done, fields, time.perf_counter() - start)
    if any(outcome.error for outcome in [*done.values(), *fields.values()]):
        msg = (f'{survey.output / "index.html"} lists what failed; the rest '
               'is finished, and the same command tries again')
        raise RuntimeError(msg)


def _do(options, tasks, workers, what):
    """Run tasks with a bar, and say at once what goes wrong."""
    from photutils_mgauss.cli.survey_run import run_tasks
    hidden = options.quiet or not sys.stderr.isatty()
    with tqdm(total=len(tasks), desc=what, disable=hidden) as bar:
        def tell(outcome):
            bar.update()
            if outcome.error:
                tools.say(options, f'{outcome.name}: {outcome.error}')
        return run_tasks(tasks, workers, tell)


def _finish(options, survey, done, fields, seconds):
    """Write what people look at."""
    from photutils_mgauss.cli import survey_results as results
    rows = [results.exposure_row(exposure, done[exposure.name],
                                 _catalogue(survey, exposure),
                                 _psf(survey, exposure))
            for exposure in survey.exposures]
    tables = {name: survey.output / 'motions' / name / 'motions.ecsv'
              for name in fields}
    lines = [results.field_row(name, survey.fields[name], fields[name],
                               tables[name]) for name in fields]
    failed = sum(bool(one.error) for one in [*done.values(),
                                             *fields.values()])
    old = sum(one.skipped for one in [*done.values(), *fields.values()])
    words = (f'{len(done)} exposures, {len(fields)} fields, {failed} failed, '
             f'{old} of an earlier run, {seconds:.0f} s')
    results.write_index(survey.output, rows, lines, words)
    results.write_summary(survey.output, {
        'exposures': len(done), 'fields': len(fields), 'failed': failed,
        'kept': old, 'seconds': seconds})
    said = _dataset(survey, {name: path for name, path in tables.items()
                             if not fields[name].error})
    tools.say(options, words, said,
              f'the results are listed in {survey.output / "index.html"}')


def _dataset(survey, tables):
    """Write all motions as one dataset; return what is to be said."""
    from photutils_mgauss.cli.survey_results import write_dataset
    from photutils_mgauss.files.tables import read_table
    if not tables:
        return 'no field has motions'
    folder = survey.output / 'motions_hats'
    try:
        n = write_dataset(folder, ((name, read_table(path)[0])
                                   for name, path in tables.items()),
                          'motions')
    except ImportError as error:
        return (f'no Parquet dataset is written ({error}): pip install '
                "'photutils_mgauss[survey]'")
    return f'{n} stars in {folder}'
