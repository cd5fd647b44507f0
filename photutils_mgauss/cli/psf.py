"""``mgauss psf``: images or PSF files to grids of mixtures."""
from photutils_mgauss.cli import tools

_SUFFIXES = ('.fits', '.asdf')

_RADIUS = 10.0


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'psf', "make a PSF of an image's own stars, or of a PSF "
        'file', 'Make a grid of Gaussian mixtures for each input. Of an '
        "image, it is made of\nthe image's own stars; PSFEx models, STDPSF "
        'and STPSF grids and ePSFs (images\nwith the keyword OVERSAMP) are '
        'fitted.', 'mgauss psf night1.fits night2.fits --output psfs',
        run)
    tools.add_inputs(parser, 'FILE', 'images or PSF files')
    parser.add_argument('--output', metavar='NAME',
                        help='folder, or for a single input a file: .fits or '
                             '.asdf (default: INPUT_psf.fits)')
    parser.add_argument('--grid-shape', nargs=2, type=tools.count,
                        default=[30, 30], metavar=('NY', 'NX'),
                        help='number of nodes (default: 30 30)')
    add_fit(parser)
    _add_files(parser)
    tools.add_reading(parser)
    tools.add_common(parser)


def add_fit(parser):
    """Add the options of the fit to an image's own stars."""
    group = parser.add_argument_group('the fit')
    group.add_argument('--n-components', type=tools.number_or_auto,
                       metavar='K', help='number of Gaussians, or auto, '
                       'which tries (default: 6 for images, 3 for PSF files)')
    group.add_argument('--degree', type=tools.number_or_auto, metavar='D',
                       help='degree of the polynomials over the detector, or '
                            'auto (default: 4, lowered for few stars)')
    group.add_argument('--radius', type=tools.positive, metavar='PIXELS',
                       help='radius of the stamps (default: 10 for images)')
    group.add_argument('--min-snr', type=tools.positive, default=50,
                       metavar='SNR', help='least signal-to-noise ratio of '
                       'the stars (default: %(default)s)')
    group.add_argument('--max-stars', type=tools.count, default=400,
                       metavar='N', help='largest number of stars (default: '
                       '%(default)s)')
    group.add_argument('--stars', metavar='TABLE',
                       help='table with x, y of the stars to look at, '
                            'instead of detection')


def _add_files(parser):
    group = parser.add_argument_group('PSF files')
    group.add_argument('--detector', metavar='NUMBER',
                       help='detector of an STDPSF file of several; for '
                            'other files with several PSFs use --ext')
    group.add_argument('--oversampling', type=tools.count, metavar='N',
                       help='of an ePSF image without OVERSAMP')


def run(options):
    """Make the PSFs."""
    tools.check_inputs(options.inputs)
    names = tools.output_names(options.inputs, options.output, '_psf',
                               _SUFFIXES, '.fits')
    tools.claim(names, options.overwrite)
    read = tools.read_images(options, options.inputs)
    with tools.Progress(2 * len(names), options.quiet) as step:
        for i, (path, name) in enumerate(zip(options.inputs, names,
                                             strict=True)):
            psf, found = _make(options, path, lambda i=i: read(i), step)
            write(psf, name, tools.record_of(options, input=path, **found))
            tools.say(options, f'{name}: {_describe(psf, found)}')


def _make(options, path, read, step):
    """Return the grid of one input, and what is to be said of it."""
    from photutils_mgauss.cli.psf_files import psf_kind
    step(f'read {path}')
    kind = psf_kind(path)
    if kind == 'image' and options.oversampling is None:
        image = read()
        tools.say(options, image.describe())
        step('PSF from stars')
        return from_stars(image, options)
    step(f'fit {path}')
    return from_file(path, options), {'kind': kind}


def from_file(path, options):
    """Return the grid a PSF file becomes."""
    from photutils_mgauss.cli.psf_files import read_psf
    number = options.n_components
    if number == 'auto':
        msg = f'{path}: --n-components must be a number for PSF files'
        raise ValueError(msg)
    return read_psf(path, n_components=number,
                    grid_shape=tuple(options.grid_shape),
                    radius=options.radius, ext=options.ext,
                    detector=options.detector,
                    oversampling=options.oversampling,
                    progress_bar=not options.quiet)


def from_stars(image, options):
    """Return the grid of an image's own stars, and facts about it."""
    from photutils_mgauss.field.fit import fit_mixture_field
    given = {name: getattr(options, name)
             for name in ('n_components', 'degree', 'radius')}
    fit = {'radius': _RADIUS}
    fit |= {name: value for name, value in given.items() if value is not None}
    stars = _choose(image, fit['radius'], options)
    field = fit_mixture_field(
        image.without_sky, stars, error=image.noise.total, mask=image.mask,
        effective_gain=image.noise.gain, **fit)
    used = field.stars[field.stars['used']]
    found = {'kind': 'image', 'n_stars': len(used),
             'n_components': field.n_components, 'degree': field.degree,
             'accuracy': float(field.accuracy),
             'reading': image.layers.sources,
             'stars': [[round(float(x), 2), round(float(y), 2)]
                       for x, y in zip(used['x'], used['y'], strict=True)]}
    return field.to_grid(tuple(options.grid_shape)), found


def _choose(image, radius, options):
    from photutils_mgauss.field.selection import select_psf_stars
    from photutils_mgauss.files.tables import read_table
    sources = None
    if options.stars is not None:
        sources, _ = read_table(options.stars)
    saturation = image.saturation
    if saturation is not None:
        # The level is that of the image with its sky.
        saturation -= float(image.sky.background_median)
    try:
        stars = select_psf_stars(
            image.without_sky, sources, error=image.noise.total,
            mask=image.mask, radius=radius, saturation=saturation,
            min_snr=options.min_snr, max_stars=options.max_stars)
    except ValueError as error:
        msg = f'{image.path}: {error}'
        raise ValueError(msg) from error
    if not stars['selected'].any():
        raise ValueError(_no_stars(image, stars))
    return stars


def _no_stars(image, stars):
    """Return why no star was good enough."""
    reasons = [str(reason) for reason in stars['reason']]
    counts = ', '.join(f'{reasons.count(reason)} {reason}'
                       for reason in sorted(set(reasons)))
    return (f'{image.path}: must have at least 1 star good for the PSF, got '
            f'none of {len(stars)}: {counts}; try --min-snr or --radius')


def write(psf, name, record):
    """Write a grid, whole or not at all."""
    from photutils_mgauss.cli.psf_files import write_psf
    with tools.whole_file(name) as draft:
        write_psf(psf, draft, record)


def _describe(psf, found):
    ny, nx = psf.grid_shape
    words = f'{nx} x {ny} nodes of {psf.n_components} Gaussians'
    if 'n_stars' in found:
        words += (f' from {found["n_stars"]} stars, degree '
                  f'{found["degree"]}')
    return words
