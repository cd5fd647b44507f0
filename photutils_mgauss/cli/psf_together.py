"""``mgauss psf --together``: one fit for all exposures of a detector."""
import warnings
from functools import cache, partial

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.psf_stars import (
    check_image,
    check_nodes,
    choose,
    fit_options,
    no_stars,
)
from photutils_mgauss.cli.results import Results, file_marks


def add_option(group):
    """Add the option to those of the fit."""
    group.add_argument('--together', action='store_true',
                       help='one fit for the stars of all images, which are '
                            'exposures of one detector; each PSF has its own '
                            'width. All images are in memory')


def run(options):
    """Make the PSFs of all images, from the stars of all."""
    paths = options.inputs
    for name in ('stars', 'start'):
        if getattr(options, name) is not None:
            msg = f'--together must be given without --{name}'
            raise ValueError(msg)
    names = tools.output_names(paths, options.output, '_psf', (), '.fits')
    read = tools.read_images(options, paths)
    results = Results(options)
    results.claim(names, paths)
    with Progress(2 + len(names), options) as step:
        step('look at all files')
        images = [read(i) for i in range(len(paths))]
        for image in images:
            check_image(image)
        if results.only_planned():
            return
        step('fit the stars of all')
        fit = cache(partial(_fit, options, images))
        key = results.key([[file_marks(image.path), image.content]
                           for image in images])
        for i, name in enumerate(names):
            step(f'PSF of {paths[i]}')
            results.obtain(name, f'{key}_{i}', partial(
                _grid, options, fit, i))
        results.deliver()
    tools.say(options, *(f'{name} is written' for name in names))


def _fit(options, images):
    """Return the field, and which images have stars for it."""
    from photutils_mgauss.field.fit import fit_mixture_field
    fit = fit_options(options)
    tables = [choose(image, fit['radius'], options) for image in images]
    used = [bool(table['selected'].any()) for table in tables]
    for image, table, good in zip(images, tables, used, strict=True):
        if not good:
            warnings.warn(f'{no_stars(image, table)}; it gets the mean '
                          'PSF of the others', UserWarning, stacklevel=2)
    some = [k for k, good in enumerate(used) if good]
    if not some:
        raise ValueError(no_stars(images[0], tables[0]))
    gains = {images[k].noise.gain for k in some}
    field = fit_mixture_field(
        [images[k].without_sky for k in some], [tables[k] for k in some],
        error=[images[k].noise.total for k in some],
        mask=[images[k].mask for k in some],
        effective_gain=gains.pop() if len(gains) == 1 else None, **fit)
    tools.say(options, f'{field.n_components} Gaussians, degree '
              f'{field.degree}, from {_told(field.stars)} of {len(some)} '
              'images')
    return field, {k: place for place, k in enumerate(some)}


def _told(stars):
    """Return how many stars were used, and how often they were seen."""
    used = stars[stars['used']]
    n_stars = len(set(used['star'])) if 'star' in used.colnames else len(used)
    words = f'{n_stars} stars'
    return words if n_stars == len(used) else (
        f'{len(used)} detections of {words}')


def _grid(options, fit, i):
    """Return the grid of one image, and what writes it."""
    from photutils_mgauss.cli.psf_files import write_psf
    field, places = fit()
    exposure = places.get(i) if len(places) > 1 else None
    grid = field.to_grid(tuple(options.grid_shape), exposure=exposure)
    check_nodes(options.inputs[i], grid, field.stars[field.stars['used']])
    record = tools.record_of(
        options, input=str(options.inputs[i]), kind='image',
        n_stars=int(field.stars['used'].sum()),
        n_components=field.n_components, degree=field.degree,
        accuracy=float(field.accuracy), exposures=len(places))
    return grid, partial(write_psf, grid, record=record)
