"""``mgauss photometry --crowded --together``: one list for many images."""
from functools import partial
from pathlib import Path

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.results import Results, file_marks

_SUFFIXES = ('.ecsv', '.fits')
_NAME = 'together_cat.ecsv'


def add_option(group):
    """Add the option to those of the measurement."""
    group.add_argument('--together', action='store_true',
                       help='with --crowded: one list of stars for all '
                            'images, found in all of them together, with a '
                            'flux in each (default file: ' + _NAME + ')')


def run(options, read_psf):
    """Measure all images together; ``read_psf`` reads a file once."""
    paths, name = options.inputs, _check(options)
    owners = tools.one_each(options.psf, len(paths), 'psf')
    read = tools.read_images(options, paths)
    results = Results(options)
    results.claim([name], [*paths, *options.psf])
    with Progress(len(paths) + 1, options) as step:
        images, marks = [], []
        for i, path in enumerate(paths):
            step(f'read {path}')
            image = read(i)
            images.append(_entry(image, owners[i] and read_psf(owners[i])))
            marks.append([file_marks(path, owners[i], image.reading.wcs),
                          image.content])
            tools.say(options, image.describe())
        if results.only_planned():
            return
        step('find and fit stars')
        results.obtain(name, results.key(marks), partial(_make, options,
                                                         images))
        results.deliver()
    tools.say(options, f'{name} is written')


def _check(options):
    """Return the name of the table, or raise."""
    if not options.crowded:
        msg = '--together must be given with --crowded'
        raise ValueError(msg)
    if options.magnitudes:
        msg = '--together must be given without --magnitudes'
        raise ValueError(msg)
    if options.residual_radius is not None:
        msg = '--together must be given without --residual-radius'
        raise ValueError(msg)
    name = Path(options.output or _NAME)
    if name.suffix not in _SUFFIXES:
        msg = (f'--output must be a file {" or ".join(_SUFFIXES)} with '
               f'--together, got {name}')
        raise ValueError(msg)
    return name


def _entry(image, psf):
    """Return an image as `CrowdedMixturePhotometry.fit_images` takes it."""
    from astropy.nddata import NDData, StdDevUncertainty
    with tools.about(image.path):
        if image.wcs is None:
            msg = 'must have a WCS, got none; give --wcs'
            raise ValueError(msg)
    data = NDData(image.data, StdDevUncertainty(image.noise.total),
                  mask=image.useless, unit=image.unit)
    return data, psf, image.wcs


def _make(options, images):
    """Return the table, and what writes it."""
    from photutils_mgauss.crowded.photometry import CrowdedMixturePhotometry
    table = CrowdedMixturePhotometry(
        None, threshold=options.threshold or 4.5,
        checkpoint=options.checkpoint).fit_images(images)
    if len(table) == 0:
        msg = 'images must show a star, got none; try --threshold'
        raise ValueError(msg)
    tools.say(options, f'{len(table)} stars in {len(images)} images')
    return table, partial(tools.write_table, table,
                          record=tools.record_of(options))
