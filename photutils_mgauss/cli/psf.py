"""``mgauss psf``: images or PSF files to grids of mixtures."""
from functools import partial

from photutils_mgauss.cli import psf_together, tools
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.psf_stars import (
    check_image,
    check_nodes,
    check_stars,
    check_start,
    choose,
    fit_options,
    no_stars,
)
from photutils_mgauss.cli.results import (
    Results,
    add_checkpoint,
    add_dry_run,
    file_marks,
)

_SUFFIXES = ('.fits', '.asdf')


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'psf', "make a PSF of an image's own stars, or of a PSF "
        'file', 'Make a PSF, a grid of Gaussian mixtures, for each input. Of '
                'an '
        "image, it is made of the image's own stars; PSFEx models, STDPSF "
        'and STPSF grids and ePSFs (images with the keyword OVERSAMP) are '
        'fitted.', 'mgauss psf night1.fits night2.fits --output psfs',
        run)
    tools.add_inputs(parser, 'FILE', 'images or PSF files')
    parser.add_argument('--output', metavar='NAME',
                        help='folder, or for a single input a file: .fits or '
                             '.asdf (default: INPUT_psf.fits)')
    parser.add_argument('--grid-shape', nargs=2, type=tools.count,
                        default=[30, 30], metavar=('NY', 'NX'),
                        help='number of nodes (default: 30 30)')
    psf_together.add_option(add_fit(parser))
    _add_files(parser)
    tools.add_reading(parser)
    add_checkpoint(parser)
    add_dry_run(parser)
    tools.add_overwrite(parser)


def add_fit(parser):
    """Add the options of the fit to an image's own stars; return them."""
    group = parser.add_argument_group('the fit')
    group.add_argument('--n-components', type=tools.count_or_auto,
                       metavar='K', help='number of Gaussians, or auto to '
                       'choose it (default: 6 for images, auto with 8 to 59 '
                       'stars; 3 for PSF files)')
    group.add_argument('--degree', type=tools.number_or_auto, metavar='D',
                       help='degree of the polynomials over the detector, or '
                            'auto (default: 4, auto with 8 to 59 stars)')
    group.add_argument('--radius', type=tools.positive, metavar='PIXELS',
                       help='radius of the stamps (default: 10 for images)')
    group.add_argument('--pixel-integrated', action='store_true',
                       default=None, help='describe the optics alone, '
                       'integrated over pixels (default: if stars are '
                       'narrower than 1.6 pixels)')
    group.add_argument('--min-snr', type=tools.positive, default=50,
                       metavar='SNR', help='smallest signal-to-noise ratio '
                       'of the stars (default: %(default)s)')
    group.add_argument('--max-stars', type=tools.count, default=400,
                       metavar='N', help='largest number of stars (default: '
                       '%(default)s)')
    group.add_argument('--stars', metavar='TABLE',
                       help='table with x, y or ra, dec of the stars to '
                            'consider, instead of detection')
    group.add_argument('--start', metavar='PSF',
                       help='a known PSF, for example from an archive, to '
                            'adjust to the stars; fifteen stars are enough '
                            '(default degree: 1)')
    return group


def _add_files(parser):
    group = parser.add_argument_group('PSF files')
    group.add_argument('--detector', metavar='NUMBER',
                       help='detector in an STDPSF file with several; for '
                            'other files with several PSFs use --ext')
    group.add_argument('--oversampling', type=tools.count, metavar='N',
                       help='samples per pixel of an ePSF image without '
                            'OVERSAMP')


def run(options):
    """Make the PSFs."""
    paths = options.inputs
    tools.check_inputs([*paths, options.stars, options.start])
    check_start(options)
    check_stars(options)
    tools.check_different(paths)
    if options.together:
        psf_together.run(options)
        return
    names = tools.output_names(paths, options.output, '_psf', _SUFFIXES,
                               '.fits')
    read = tools.read_images(options, paths)
    results = Results(options)
    results.claim(names, paths)
    with Progress(1 + len(names), options) as step:
        step('look at all files')
        kinds = [_kind(options, path, lambda i=i: read(i))
                 for i, path in enumerate(paths)]
        if results.only_planned():
            return
        for i, (path, name) in enumerate(zip(paths, names, strict=True)):
            step(f'PSF of {path}')
            image = read(i) if kinds[i] == 'image' else None
            key = results.key(file_marks(path, options.stars,
                                         options.start),
                              image and image.content)
            results.obtain(name, key, partial(_make, options, path, image,
                                              kinds[i]))
            results.deliver()
            tools.say(options, f'{name} is written')


def _kind(options, path, read):
    """Return what an input is; raise if it is nothing to make a PSF of."""
    from photutils_mgauss.cli.psf_files import psf_kind
    with tools.about(path):
        kind = psf_kind(path)
    if kind != 'image':
        if options.n_components == 'auto':
            msg = f'{path}: --n-components must be a number for PSF files'
            raise ValueError(msg)
        if options.start is not None:
            msg = (f'{path}: must be an image of stars for --start, but is a '
                   'PSF')
            raise ValueError(msg)
        return kind
    if options.oversampling is not None:
        return 'epsf'
    check_image(read())
    return kind


def _make(options, path, image, kind):
    """Return the grid of one input, and what writes it."""
    if image is not None:
        tools.say(options, image.describe())
        return make(options, image)
    return _with_writer(options, path, from_file(path, options),
                        {'kind': kind})


def read(path):
    """Read a PSF that was written before."""
    from photutils_mgauss.cli.psf_files import read_psf
    with tools.about(path):
        return read_psf(path)


def make(options, image):
    """Return the PSF of an image's own stars, and what writes it."""
    return _with_writer(options, image.path, *from_stars(image, options))


def _with_writer(options, path, psf, found):
    from photutils_mgauss.cli.psf_files import write_psf
    tools.say(options, f'{path}: {_describe(psf, found)}')
    return psf, partial(write_psf, psf, record=tools.record_of(
        options, input=str(path), **found))


def from_file(path, options):
    """Return the grid a PSF file becomes."""
    from photutils_mgauss.cli.psf_files import read_psf
    number = options.n_components
    if number == 'auto':
        msg = f'{path}: --n-components must be a number for PSF files'
        raise ValueError(msg)
    with tools.about(path):
        return read_psf(path, n_components=number,
                        grid_shape=tuple(options.grid_shape),
                        radius=options.radius, ext=options.ext,
                        detector=options.detector,
                        oversampling=options.oversampling,
                        checkpoint=options.checkpoint)


def from_stars(image, options):
    """Return the grid of an image's own stars, and facts about it."""
    with tools.about(image.path):
        return _from_stars(image, options)


def _from_stars(image, options):
    from photutils_mgauss.field.fit import fit_mixture_field
    fit = fit_options(options)
    stars = choose(image, fit['radius'], options)
    if not stars['selected'].any():
        raise ValueError(no_stars(image, stars))
    field = fit_mixture_field(
        image.without_sky, stars, error=image.noise.total, mask=image.mask,
        effective_gain=image.noise.gain, **fit)
    used = field.stars[field.stars['used']]
    grid = field.to_grid(tuple(options.grid_shape))
    check_nodes(image.path, grid, used)
    found = {'kind': 'image', 'n_stars': len(used),
             'n_components': grid.n_components, 'degree': field.degree,
             'accuracy': float(field.accuracy),
             'reading': image.layers.sources,
             'stars': [[round(float(x), 2), round(float(y), 2)]
                       for x, y in zip(used['x'], used['y'], strict=True)]}
    return grid, found


def _describe(psf, found):
    ny, nx = psf.grid_shape
    words = f'{nx} x {ny} nodes of {psf.n_components} Gaussians'
    if 'n_stars' in found:
        words += (f' from {found["n_stars"]} stars, degree '
                  f'{found["degree"]}')
    return words
