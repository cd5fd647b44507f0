"""``mgauss survey``: exposures of many fields to motions, in one run."""
import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from tqdm import tqdm

from photutils_mgauss.cli import tools
from photutils_mgauss.utils.parallel import watched
from photutils_mgauss.utils.waiting import waiting

_EXAMPLE = """\
# The settings of mgauss survey. Names are relative to the folder of this file.
output = "survey"
# pages = false            # no page of figures for each exposure

[exposures]
files = {files}
{ext}ext = "{name}"             # of files with several images: all with it
{detector}detector = "DETECTOR"   # keyword that distinguishes detectors
{filter}group_by = ["FILTER"]   # keywords whose values separate fields
# overlap = 0.5           # smallest shared area of images of one field
# gain = 1.5              # and other options for reading images

# The options of mgauss psf, photometry and motions, with _ for -.
[psf]
# n_components = 6
# degree = 3
# start = "archive.fits"  # a PSF to adjust to the stars of each exposure

[photometry]
# psf = "detector"        # one fit for all exposures of a detector, or
# psf = "psf.fits"        # measure with this PSF, and make none
# crowded = true

[motions]
# references = "gaia.ecsv"
# parallax = true
# pixels = true           # then, from the pixels of all images of a field
# together = true         # one solution for all fields that touch
"""
# So many exposures of a field are named in the plan.
_NAMED = 6
# What an exposure takes with the defaults [CPU s], and what each of its pixels
# adds, of two sizes with 180 and 717 stars.
_EACH, _EACH_PIXEL = 11.1, 7e-6
_MOTIONS_TAKE = ('they take two measured exposures of a field, or one and '
                 'references of [motions], which have positions of another '
                 'time')
# Keywords of so many images are looked at for an example.
_LOOKED_AT = 50


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'survey', 'exposures of many fields to motions, in one run',
        'Make the PSF of each exposure, measure its stars, and fit the '
        'motions of each field, that is, of exposures that overlap. A run '
        'that was stopped continues: finished results are not repeated.',
        'mgauss survey --init raw && mgauss survey survey.toml', run)
    parser.add_argument('file', nargs='?', metavar='SURVEY.toml',
                        help='the survey file')
    parser.add_argument('--init', metavar='FOLDER',
                        help='write an example for the images in a folder '
                             '(default: survey.toml)')
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
    if options.file is None and options.init is None:
        options.parser.error('SURVEY.toml or --init must be given')
    if options.init is not None:
        _write_example(options)
        return
    from photutils_mgauss.cli.survey_plan import read_survey
    path = Path(options.file)
    if path.is_dir():
        msg = (f'{path}: must be a SURVEY.toml, but is a folder; mgauss '
               f'survey --init {path} writes one for the images in it')
        raise ValueError(msg)
    tools.check_inputs([path])
    from photutils_mgauss.cli.survey_folder import check_output
    survey = read_survey(path)
    kept = _kept(survey)
    check_output(survey, len(survey.exposures) - len(kept))
    tools.say(options, *_plan(survey, kept))
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
    name = Path(options.file or 'survey.toml')
    if name.exists():
        msg = (f'{name} exists; give the example another name: mgauss survey '
               'NAME.toml --init FOLDER')
        raise FileExistsError(msg)
    tools.claim([name], overwrite=False)
    if not folder.is_absolute():
        folder = Path(os.path.relpath(folder, name.parent))
    endings = sorted({''.join(path.suffixes[-2:]) if path.suffix in
                      ('.gz', '.fz') else path.suffix for path in images})
    files = [f'{folder.as_posix()}/*{ending}' for ending in endings]
    with tools.whole_file(name) as draft:
        draft.write_text(_EXAMPLE.format(
            files=str(files).replace("'", '"'), **_seen_in(images)),
            encoding='utf-8')
    tools.say(options, f'{name} is written, for {len(images)} images')


def _seen_in(images):
    """Return what of an example is no comment, by what images have."""
    from photutils_mgauss.cli.survey_plan import keyword_of
    from photutils_mgauss.files.image_layers import science_images
    some = images[::-(-len(images) // _LOOKED_AT)]
    several = set()
    for path in some:
        labels = science_images(path)
        names = {label.split(',')[0] for label in labels}
        if len(labels) > len(names) == 1:
            several |= names
    values = {key: {keyword_of(path, key) for path in some}
              for key in ('DETECTOR', 'FILTER')}
    return {'name': min(several, default='SCI'),
            'ext': '' if several else '# ',
            **{key.lower(): '' if len(found - {None}) > 1 else '# '
               for key, found in values.items()}}


def _kept(survey):
    """Return the outcomes of exposures that an earlier run has done."""
    from photutils_mgauss.cli.survey_run import kept_outcome
    from photutils_mgauss.cli.survey_tasks import exposure_tasks
    found = map(kept_outcome, exposure_tasks(survey))
    return [outcome for outcome in found if outcome is not None]


def _plan(survey, kept):
    """Return the lines that show what will be done."""
    total = (f'{len(survey.exposures)} exposures in {len(survey.fields)} '
             f'fields, to {survey.output}')
    lines = [total, f'{len(kept)} exposures have results of an earlier run',
             _cost(survey, kept)]
    for name, members in survey.fields.items():
        names = [survey.exposures[i].name for i in members]
        more = ', ...' if len(names) > _NAMED else ''
        lines.append(f'  {name}: {_exposures(survey, members)}: '
                     f'{", ".join(names[:_NAMED])}{more}')
    if not any(_enough(survey, members) for members in survey.fields.values()):
        lines.append(f'no field will have motions: {_MOTIONS_TAKE}')
    return lines


def _exposures(survey, members):
    """Return how many exposures a field has, and of what time."""
    years = [survey.exposures[i].year for i in members]
    n = '1 exposure' if len(members) == 1 else f'{len(members)} exposures'
    few = '' if _enough(survey, members) else ', too few for motions'
    to = f' to {max(years):.2f}' if len(members) > 1 else ''
    return f'{n}{few}, {min(years):.2f}{to}'


def _enough(survey, members):
    from photutils_mgauss.cli.survey_tasks import fewest_exposures
    return len(members) >= fewest_exposures(survey)


def _cost(survey, kept):
    """Return a sentence on what is still to be done."""
    from photutils_mgauss.cli.survey_folder import needed_bytes
    n = len(survey.exposures) - len(kept)
    words = f'{n} to do, about {needed_bytes(survey, n) / 1e6:.0f} MB'
    if not n:
        return words
    if not kept:
        pixels = sum(one.n_pixels for one in survey.exposures)
        hours = (_EACH * n + _EACH_PIXEL * pixels) / 3600
        return (f'{words} and {hours:.1g} core hours with the defaults, '
                'where stars are not crowded')
    hours = n * sum(one.cpu for one in kept) / len(kept) / 3600
    return (f'{words} and {hours:.2g} core hours, if they are like the '
            'others')


def _run(options, survey):
    from photutils_mgauss.cli.survey_folder import mark_output
    from photutils_mgauss.cli.survey_run import cluster_workers, local_workers
    start = time.perf_counter()
    workers = (local_workers(options.workers) if options.cluster is None
               else cluster_workers(options.cluster))
    mark_output(survey)
    with workers:
        steps = _all_steps(options, survey, workers)
    _finish(options, survey, *steps, time.perf_counter() - start)
    if any(outcome.error for some in steps for outcome in some.values()):
        msg = (f'{survey.output / "index.html"} lists what failed; the rest '
               'is finished, and the same command tries again')
        raise RuntimeError(msg)


def _all_steps(options, survey, workers):
    """Return the outcomes of all tasks, step by step."""
    from photutils_mgauss.cli import survey_tasks as tasks
    psfs = _do(options, tasks.detector_tasks(survey), workers, 'detectors')
    done = _do(options, tasks.exposure_tasks(survey), workers, 'exposures')
    fields = _do(options, tasks.field_tasks(survey, _good(done)), workers,
                 'fields')
    pixels = _do(options, tasks.pixel_tasks(survey, _good(done),
                                            _good(fields)), workers, 'pixels')
    pages = _do(options, _pages(options, survey, _good(done), _good(fields)),
                workers, 'pages')
    return psfs, done, fields, pixels, pages


def _pages(options, survey, measured, solved):
    """Return the tasks of pages, if they can be drawn."""
    from photutils_mgauss.cli.survey_tasks import page_tasks
    if survey.pages and find_spec('matplotlib') is None:
        tools.say(options, "exposures have no pages without matplotlib: "
                  "pip install 'photutils_mgauss[plot]'")
        return []
    return page_tasks(survey, measured, solved)


def _good(outcomes):
    return {name for name, outcome in outcomes.items() if not outcome.error}


def _do(options, tasks, workers, what):
    """Run tasks with a bar, and say at once what goes wrong."""
    from photutils_mgauss.cli.survey_run import run_tasks
    if not tasks:
        return {}
    hidden = options.quiet or not sys.stderr.isatty()
    # Within a task nothing is shown beside the bar, whose clock goes on.
    quiet = watched(lambda _done, _total: None)
    with quiet if hidden else waiting(what, progress_bar=True), tqdm(
            total=len(tasks), desc=what, disable=hidden) as bar:
        def tell(outcome):
            bar.update()
            if outcome.error:
                tools.say(options, f'{outcome.name}: {outcome.error}')
        done = run_tasks(tasks, workers, tell)
    # Not in the order in which they came to their end.
    return {task.name: done[task.name] for task in tasks}


def _finish(options, survey, psfs, done, fields, pixels, pages, seconds):
    """Write what people look at."""
    from photutils_mgauss.cli import survey_results as results
    from photutils_mgauss.cli.survey_tasks import motions_of
    rows = results.exposure_rows(survey, done, fields, pages)
    lines = [results.field_row(name, survey.fields[
        name.removesuffix('_pixels')], outcome)
        for name, outcome in (fields | pixels).items()]
    lines += [results.field_row(name, (), outcome)
              for name, outcome in (psfs | pages).items() if outcome.error]
    results_of = [*psfs.values(), *done.values(), *fields.values(),
                  *pixels.values()]
    outcomes = [*results_of, *pages.values()]
    failed = sum(bool(one.error) for one in outcomes)
    old = sum(one.skipped for one in results_of)
    words = (f'{len(done)} exposures, {len(fields)} fields, {failed} failed, '
             f'{old} of an earlier run, {seconds:.0f} s')
    results.write_index(survey.output, rows, lines, words)
    results.write_summary(survey.output, {
        'exposures': len(done), 'fields': len(fields), 'failed': failed,
        'kept': old, 'seconds': seconds,
        'cpu': sum(one.cpu for one in outcomes if not one.skipped)})
    results.collect_wcs([motions_of(survey, name).parent
                         for name in sorted(_good(fields))],
                        survey.output / 'wcs')
    tools.say(options, words, _dataset(survey, fields, pixels),
              f'the results are listed in {survey.output / "index.html"}')


def _dataset(survey, fields, pixels):
    """Write all motions as one dataset; return what is to be said."""
    from photutils_mgauss.cli.survey_results import write_dataset
    from photutils_mgauss.cli.survey_tasks import motions_of
    what, outcomes = (('pixels', pixels) if survey.pixels
                      else ('motions', fields))
    tables = {}
    for task in sorted(_good(outcomes)):
        name = task.removesuffix('_pixels')
        tables[name] = (motions_of(survey, name, what),
                        outcomes[task].figures.get('pixels'))
    if not tables:
        why = 'all attempts failed' if fields else _MOTIONS_TAKE
        return f'no field has motions: {why}'
    folder = survey.output / 'motions_hats'
    try:
        n = write_dataset(folder, tables, 'motions', survey.references)
    except ImportError as error:
        return (f'no Parquet dataset is written ({error}): pip install '
                "'photutils_mgauss[survey]'")
    return f'{n} stars in {folder}'
