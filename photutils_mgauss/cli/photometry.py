"""``mgauss photometry``: images and PSFs to catalogues."""
import os
import warnings
from functools import cache, partial
from pathlib import Path

from photutils_mgauss.cli import given_stars, together, tools
from photutils_mgauss.cli.progress import Progress
from photutils_mgauss.cli.psf_stars import check_image
from photutils_mgauss.cli.results import (
    Results,
    add_checkpoint,
    add_dry_run,
    file_marks,
)

_SUFFIXES = ('.ecsv', '.fits')

# Stars of a larger signal-to-noise ratio should not have, in the median, a
# larger reduced chi2.
_BRIGHT = 100.0
_BAD_CHI2 = 5.0

# Columns in the unit of the image.
_FLUXES = ('flux_init', 'flux_fit', 'flux_err', 'local_bkg', 'sky',
           'sky_err')


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'photometry', 'positions and fluxes of the stars in images',
        'Find the stars of each image and fit their positions and fluxes. '
        "The catalogue has photutils' columns and, if the image has a WCS, "
        'places on the sky with covariances.',
        'mgauss photometry night1.fits --psf night1_psf.fits', run)
    tools.add_inputs(parser, 'IMAGE', 'images')
    parser.add_argument('--psf', nargs='+', default=[], metavar='FILE',
                        help='PSF of all images, or one for each: a file of '
                             'mgauss psf, or any PSF file that it reads '
                             '(default with --crowded: made from the stars '
                             'of each image)')
    parser.add_argument('--output', metavar='NAME',
                        help='folder, or for a single image a file: .ecsv or '
                             '.fits (default: IMAGE_cat.ecsv)')
    group = add_measuring(parser)
    given_stars.add_options(group)
    together.add_option(group)
    tools.add_times(parser)
    tools.add_reading(parser)
    add_checkpoint(parser)
    add_dry_run(parser)
    tools.add_overwrite(parser)


def add_measuring(parser):
    """Add the options of the measurement; return their group."""
    group = parser.add_argument_group('the measurement')
    group.add_argument('--crowded', action='store_true',
                       help='find and fit all stars and the sky together')
    group.add_argument('--threshold', type=tools.positive, metavar='SIGMA',
                       help='significance of the faintest stars (default: 5, '
                            'or 4.5 with --crowded)')
    group.add_argument('--fit-shape', type=tools.odd, default=11,
                       metavar='PIXELS', help='side of the fitted region, '
                       'odd (default: %(default)s)')
    group.add_argument('--residual-radius', type=tools.positive,
                       metavar='PIXELS', help='measure the residual of '
                       'bright stars, such as spikes, out to this distance, '
                       'and subtract it from them')
    group.add_argument('--magnitudes', action='store_true',
                       help='add AB magnitudes; for images in MJy/sr or a '
                            'unit of flux density')
    return group


def run(options):
    """Measure the images."""
    paths = options.inputs
    if not options.psf and not options.crowded:
        options.parser.error(
            '--psf must be given, got none; without it, mgauss psf makes '
            'one of an image, and --crowded one of the stars of each image')
    tools.check_inputs([*paths, *options.psf, options.stars])
    given_stars.check(options)
    tools.check_different(paths)
    if options.together:
        together.run(options, cache(partial(
            _read_psf, checkpoint=options.checkpoint)))
        return
    names = tools.output_names(paths, options.output, '_cat', _SUFFIXES,
                               '.ecsv')
    owners = tools.one_each(options.psf, len(paths), 'psf')
    read = tools.read_images(options, paths)
    results = Results(options)
    given = [] if options.stars is None else [options.stars]
    results.claim(names, [*paths, *options.psf, *given])
    with Progress(1 + len(names), options) as step:
        step('look at all files')
        psfs = {path: _read_psf(path, options.checkpoint)
                for path in dict.fromkeys(options.psf)}
        for i in range(len(paths)):
            check_image(read(i))
        stars = (given_stars.StarList(options.stars, options) if given
                 else None)
        if results.only_planned():
            return
        for i, name in enumerate(names):
            step(f'measure {paths[i]}')
            image = read(i)
            key = results.key(file_marks(paths[i], owners[i], options.stars,
                                         image.reading.wcs), image.content)
            results.obtain(name, key, partial(
                make, options, image, psfs.get(owners[i]), name,
                stars, psf=owners[i] and str(owners[i])))
            results.deliver()
            tools.say(options, f'{name} is written')


def _read_psf(path, checkpoint):
    from photutils_mgauss.cli.psf_files import read_psf
    with tools.about(path):
        return read_psf(path, checkpoint=checkpoint)


def make(options, image, model, name, stars=None, **more):
    """
    Return the catalogue of an image, and what writes it.

    With a `StarList` it is that of its stars.
    """
    tools.say(options, image.describe())
    if image.saturation is not None:
        tools.say(options, f'{image.path}: {image.say_saturation()}')
    table = measure(image, model, options, stars)
    tools.say(options, f'{image.path}: {len(table)} stars'
                       f'{_saturated(table)}')
    return table, partial(tools.write_table, table, record=tools.record_of(
        options, exposure=exposure(image, name),
        reading=image.layers.sources, **more))


def _saturated(table):
    from photutils_mgauss.utils.flags import SATURATED
    n = int(((table['flags'] & SATURATED) > 0).sum())
    return f', {n} of them saturated or masked, from their wings' if n else ''


def measure(image, psf, options, stars=None):
    """Return the catalogue of an image, or of a `StarList` in it."""
    with tools.about(image.path):
        given = None if stars is None else stars.in_image(image)
        table = (_crowded if options.crowded else _sparse)(
            image, psf, options, given)
        if table is None or len(table) == 0:
            msg = 'must show a star, got none; try --threshold'
            raise ValueError(msg)
        if given is not None:
            table['id'] = given['id']
        _check_fits(image, table)
        table = _with_flux_density(_with_unit(table, image.unit), image,
                                   options)
        return _with_sky(table, image)


def _check_fits(image, table):
    """Warn if the PSF does not describe the bright stars."""
    import numpy as np
    if 'reduced_chi2' not in table.colnames:
        return
    signal = table['flux_fit'] / table['flux_err']
    chi2 = np.asarray(table['reduced_chi2'])[
        (signal > _BRIGHT) & np.isfinite(table['reduced_chi2'])]
    if chi2.size and np.median(chi2) > _BAD_CHI2:
        warnings.warn(
            f'{image.path}: the PSF does not describe the {chi2.size} '
            f'brightest stars (median reduced chi2 {np.median(chi2):.3g}); '
            'their errors are too small', UserWarning,
            stacklevel=2)


def _sparse(image, psf, options, given):
    from photutils.detection import DAOStarFinder

    from photutils_mgauss.photometry.psf_photometry import MixturePSFPhotometry
    fwhm = _fwhm(psf, image.data.shape)
    threshold = options.threshold or 5.0
    finder = DAOStarFinder(threshold * float(
        image.sky.background_rms_median), fwhm)
    noise = image.noise
    if given is not None and options.fixed:
        psf = psf.copy()
        psf.x_0.fixed = psf.y_0.fixed = True
    photometry = MixturePSFPhotometry(
        psf, options.fit_shape, finder=finder,
        aperture_radius=max(2.0, 1.5 * fwhm), effective_gain=noise.gain,
        xy_cov=True, saturation=image.saturation_without_sky,
        residual_radius=options.residual_radius)
    return photometry(image.without_sky, error=noise.background,
                      mask=image.mask, init_params=given)


def _crowded(image, psf, options, given):
    from photutils_mgauss.crowded.photometry import CrowdedMixturePhotometry
    if psf is None:
        psf = own_psf(image, options)
    photometry = CrowdedMixturePhotometry(
        psf, threshold=options.threshold or 4.5,
        effective_gain=image.noise.gain, checkpoint=options.checkpoint,
        saturation=image.saturation,
        residual_radius=options.residual_radius)
    return photometry(image.data, error=image.noise.total, mask=image.mask,
                      init_params=given)


def own_psf(image, options):
    """Return the PSF of the stars of a crowded image."""
    from photutils_mgauss.crowded.own_psf import fit_crowded_psf
    from photutils_mgauss.crowded.psf_loop import grid_of
    field = fit_crowded_psf(
        image.data, error=image.noise.total, mask=image.mask,
        saturation=image.saturation, effective_gain=image.noise.gain,
        checkpoint=options.checkpoint)
    tools.say(options, f'{image.path}: PSF from '
                       f'{int(field.stars["used"].sum())} of its stars, '
                       f'degree {field.degree}')
    return grid_of(field)


def _fwhm(psf, shape):
    """Return the width of the PSF in the middle of the image [pix]."""
    from photutils_mgauss.field.stages import PIXEL_VARIANCE
    from photutils_mgauss.psf.shapes import adaptive_moments
    ny, nx = shape
    mixture = psf.mixture_at(nx / 2, ny / 2)
    if psf.pixel_integrated:
        # Images show the optics and the pixel.
        mixture = mixture.convolve([[PIXEL_VARIANCE, 0],
                                    [0, PIXEL_VARIANCE]])
    return float(adaptive_moments(mixture).fwhm)


def _with_unit(table, unit):
    if unit is not None:
        for name in _FLUXES:
            if name in table.colnames:
                table[name] = table[name] * unit
    return table


def _with_flux_density(table, image, options):
    """Return the table with fluxes in Jy, where the image knows of it."""
    from photutils_mgauss.files.image_header import is_surface_brightness
    from photutils_mgauss.photometry.many_images import to_flux_densities
    area, bright = (image.layers.cards.pixel_area,
                    is_surface_brightness(image.unit))
    known = area is not None or image.wcs is not None
    if bright and not known:
        tools.say(options, f'{image.path}: fluxes are in {image.unit} times '
                           'a pixel, as there is neither PIXAR_SR nor a WCS')
    if not options.magnitudes and not (bright and known):
        return table
    return to_flux_densities(table, pixel_area=area, wcs=image.wcs,
                             magnitudes=options.magnitudes)


def _with_sky(table, image):
    if image.wcs is None:
        return table
    from photutils_mgauss.photometry.many_images import add_sky_positions
    return add_sky_positions(table, image.wcs)


def exposure(image, name):
    """Return where and when: what motions needs of an image."""
    time, reading = image.time, image.reading
    folder = name.resolve().parent
    wcs = reading.wcs and os.path.relpath(Path(reading.wcs).resolve(), folder)
    return {'image': os.path.relpath(image.path.resolve(), folder),
            'ext': reading.ext, 'wcs': wcs,
            'time': None if time is None else _jyear(time)}


def _jyear(time):
    from photutils_mgauss.sky.observers import julian_years
    return float(julian_years(time))
