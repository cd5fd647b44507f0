"""The tasks of a survey: words of commands, and the files they concern."""
from functools import cache

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.survey_run import Task

# Results of a task that is done again are replaced.
_TO = ('--overwrite', '--output')


def catalogue_of(survey, exposure):
    """Return the file of an exposure's stars."""
    return survey.output / 'catalogues' / f'{exposure.name}.ecsv'


def psf_of(survey, exposure):
    """Return the file of an exposure's PSF, or None if it has none."""
    if survey.psf == 'archive':
        return _for_detector(survey.archive, exposure)
    if '--crowded' in survey.options['photometry']:
        return None
    folder = survey.output / 'psfs'
    if survey.psf == 'detector':
        return str(folder / exposure.camera
                   / f'{tools.stem(exposure.path)}_psf.fits')
    return str(folder / f'{exposure.name}.fits')


def _for_detector(files, exposure):
    """Return the file of an exposure's detector, or that of any, or None."""
    return files.get(exposure.detector, files.get(''))


def page_of(survey, name):
    """Return the file of an exposure's page."""
    return survey.output / 'pages' / f'{name}.html'


def _record(survey, name):
    return str(survey.output / 'records' / f'{name}.json')


def _reading(survey, exposure, *, times=True):
    """Return the words by which an exposure is read."""
    words = list(survey.reading)
    if not times and '--time-key' in words:
        at = words.index('--time-key')
        del words[at:at + 2]
    return (*(() if exposure.ext is None else ('--ext', exposure.ext)),
            *words)


def detector_tasks(survey):
    """Return the task of each detector: the PSFs of its exposures."""
    if survey.psf != 'detector':
        return []
    cameras = {}
    for exposure in survey.exposures:
        cameras.setdefault(exposure.camera, []).append(exposure)
    return [_detector_task(survey, name, members)
            for name, members in cameras.items()]


def _detector_task(survey, name, members):
    images = tuple(str(one.path) for one in members)
    words = ('psf', *images, '--together', *_TO,
             str(survey.output / 'psfs' / name) + '/',
             *_reading(survey, members[0], times=False),
             *survey.options['psf'])
    return Task(f'psf of {name}', (words,),
                (*images, *survey.files['psf']),
                tuple(psf_of(survey, one) for one in members),
                _record(survey, f'psf_{name}'))


def exposure_tasks(survey):
    """Return the task of each exposure: its PSF and its catalogue."""
    return [_exposure_task(survey, exposure) for exposure in survey.exposures]


def _exposure_task(survey, exposure):
    image, psf = str(exposure.path), psf_of(survey, exposure)
    catalogue = str(catalogue_of(survey, exposure))
    inputs = [image, *survey.files['photometry']]
    outputs, commands = [catalogue], []
    if survey.psf == 'exposure' and psf is not None:
        start = _for_detector(survey.start, exposure)
        known = () if start is None else ('--start', start)
        commands.append(('psf', image, *_TO, psf, *known,
                         *_reading(survey, exposure, times=False),
                         *survey.options['psf']))
        inputs += (*survey.files['psf'], *known[1:])
        outputs.append(psf)
    elif psf is not None:
        inputs.append(psf)
    given = () if psf is None else ('--psf', psf)
    commands.append(('photometry', image, *_TO, catalogue, *given,
                     *_reading(survey, exposure),
                     *survey.options['photometry']))
    return Task(exposure.name, tuple(commands), tuple(inputs), tuple(outputs),
                _record(survey, exposure.name), 'exposure')


def motions_of(survey, name, what='motions'):
    """Return the file of the motions of a field."""
    return survey.output / what / name / 'motions.ecsv'


def fewest_exposures(survey):
    """Return how many exposures of a field motions take."""
    return 1 if '--references' in survey.options['motions'] else 2


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
    tasks = []
    for name, members in _with_enough(survey, measured,
                                      fewest_exposures(survey)):
        files = tuple(str(catalogue_of(survey, one)) for one in members)
        table = motions_of(survey, name)
        words = ('motions', *files, *_TO, str(table.parent),
                 *survey.options['motions'])
        tasks.append(Task(name, (words,),
                          (*files, *survey.files['motions']), (str(table),),
                          _record(survey, name), 'field'))
    return tasks


def pixel_tasks(survey, measured, solved):
    """
    Return the task of each field whose motions come from its pixels.

    Parameters
    ----------
    survey : Survey
        The plan.
    measured, solved : set of str
        The exposures that have a catalogue, and the fields that have
        motions from catalogues, whose frames the pixels take.

    Returns
    -------
    list of Task
    """
    if not survey.pixels:
        return []
    return [_pixel_task(survey, name, members)
            for name, members in _with_enough(survey, measured, 1)
            if name in solved]


def _pixel_task(survey, name, members):
    images = tuple(str(one.path) for one in members)
    psfs = tuple(psf_of(survey, one) for one in members)
    frames = tuple(str(_frame(survey, name, one)) for one in members)
    table = motions_of(survey, name, 'pixels')
    words = ('motions', *images, *_TO, str(table.parent),
             '--psf', *psfs, '--wcs', *frames,
             '--frames', str(motions_of(survey, name).parent),
             *_reading(survey, members[0]), *survey.options['pixels'])
    return Task(f'{name}_pixels', (words,),
                (*images, *psfs, *frames, *survey.files['pixels']),
                (str(table),), _record(survey, f'{name}_pixels'), 'pixels')


def page_tasks(survey, measured, solved):
    """
    Return the task of each exposure's page, if there are to be any.

    Parameters
    ----------
    survey : Survey
        The plan.
    measured, solved : set of str
        The exposures that have a catalogue, and the fields that have
        motions.

    Returns
    -------
    list of Task
    """
    if not survey.pages:
        return []
    field_of = {i: name for name, members in survey.fields.items()
                for i in members if name in solved}
    is_grid = cache(_is_grid)
    return [_page_task(survey, exposure, field_of.get(i), is_grid)
            for i, exposure in enumerate(survey.exposures)
            if exposure.name in measured]


def _is_grid(psf):
    """Whether a file has a PSF that need not be fitted to be shown."""
    from photutils_mgauss.cli.psf_files import psf_kind
    return psf_kind(psf) == 'mixtures'


def _page_task(survey, exposure, field, is_grid):
    psf, page = psf_of(survey, exposure), page_of(survey, exposure.name)
    files = [str(catalogue_of(survey, exposure))]
    if psf is not None and (survey.psf != 'archive' or is_grid(psf)):
        files.insert(0, psf)
    inputs, among = list(files), ()
    if field is not None:
        folder = motions_of(survey, field).parent
        inputs += [str(folder / f'{name}.ecsv')
                   for name in ('motions', 'residuals', 'alignment')]
        among = ('--field', str(folder))
    words = ('report', *files, *among, '--title', exposure.name, *_TO,
             str(page))
    name = f'{exposure.name}_page'
    return Task(name, (words,), tuple(inputs), (str(page),),
                _record(survey, name))


def _frame(survey, name, exposure):
    """Return the file with the corrected WCS of an exposure."""
    folder = motions_of(survey, name).parent
    found = folder / f'{exposure.name}_wcs.asdf'
    return found if found.exists() else found.with_suffix('.fits')


def _with_enough(survey, measured, least):
    """Yield each field and its measured exposures, if there are enough."""
    for name, members in survey.fields.items():
        found = [survey.exposures[i] for i in members
                 if survey.exposures[i].name in measured]
        if len(found) >= least:
            yield name, found
