"""``mgauss info``: what a file is, and how it would be read."""

from photutils_mgauss.cli import tools
from photutils_mgauss.cli.motions import is_table
from photutils_mgauss.cli.running import complain

# What names of columns mean to the other commands.
_COLUMNS = {
    'positions in pixels': ('x_fit', 'y_fit', 'x', 'y', 'x_err', 'y_err'),
    'positions on the sky': ('ra', 'dec', 'ra_error', 'dec_error', 'ra_err',
                             'dec_err'),
    'fluxes': ('flux_fit', 'flux_err', 'flux', 'mag'),
    'motions': ('pmra', 'pmdec', 'pmra_error', 'pmdec_error', 'parallax',
                'parallax_error', 'ref_epoch'),
    'identities': ('id', 'source_id'),
    'quality': ('flags', 'cfit', 'qfit', 'reduced_chi2'),
    'times': ('time',)}
_KINDS = {'mixtures': 'a PSF of this package', 'psfex': 'a PSF of PSFEx',
          'stdpsf': 'a grid of ePSFs in the format STDPSF',
          'stpsf': 'a grid of PSFs of STPSF',
          'optical': 'an image of a PSF from calc_psf of STPSF',
          'epsf': 'an oversampled image of a PSF'}


def add(commands):
    """Add the command to the parser's."""
    parser = tools.command(
        commands, 'info', 'what a file is, and how it would be read',
        'Print for each file whether it is an image, a PSF or a table, and '
        'what the other commands would read from it: noise, bad pixels, WCS '
        'and time of an image, nodes of a PSF, columns of a table.',
        'mgauss info night1.fits night1_psf.fits night1_cat.ecsv', run)
    tools.add_inputs(parser, 'FILE', 'images, PSFs or tables')
    parser.add_argument('--detector', metavar='NUMBER',
                        help='detector of a PSF file that has several')
    tools.add_times(parser)
    tools.add_reading(parser)


def run(options):
    """Say what the files are; those that are none of them do not end it."""
    paths = tools.files_in(options.inputs)
    read = tools.read_images(options, paths)
    wrong = None
    for i, path in enumerate(paths):
        try:
            tools.check_inputs([path])
            with tools.about(path):
                lines = _lines(options, path, lambda i=i: read(i))
        except Exception as error:  # noqa: BLE001 readers raise what they please
            if wrong is not None:
                complain(tools.sentence_of(wrong))
            wrong = error
        else:
            tools.say(options, *lines)
    if wrong is not None:
        raise wrong


def _lines(options, path, read):
    """Return the lines on one file."""
    from photutils_mgauss.files.epsfs import psf_kind
    kind = psf_kind(path)
    if kind == 'image':
        return (_of_table(path) if is_table(path)
                else _of_image(path, read()))
    lines = [f'{path}: {_KINDS[kind]}']
    if kind == 'mixtures':
        return lines + _of_grid(path)
    lines += _of_other_psf(kind, path)
    lines.append('  mgauss psf makes mixtures of it; photometry does so each '
                 'time')
    return lines


def _of_grid(path):
    """Return what a PSF of this package is."""
    import numpy as np

    from photutils_mgauss.cli.psf_files import psf_record, read_psf
    from photutils_mgauss.psf.shapes import adaptive_moments
    psf = read_psf(path)
    ny, nx = psf.grid_shape
    (left, bottom), (right, top) = (getattr(psf.grid_xypos, side)(axis=0)
                                    for side in ('min', 'max'))
    fwhm = np.atleast_1d(adaptive_moments(psf.mixtures).fwhm)
    kind = ('integrated over pixels' if psf.pixel_integrated
            else 'sampled at the middles of pixels')
    nodes = (f'  {nx} x {ny} nodes of {psf.n_components} Gaussians, x '
             f'{left:g} to {right:g}, y {bottom:g} to {top:g}')
    width = (f'  FWHM {np.nanmin(fwhm):.2f} to {np.nanmax(fwhm):.2f} pix; '
             f'{kind}')
    return [nodes, width, *_of_record(psf_record(path))]


def _of_other_psf(kind, path):
    """Return what is in a PSF file that can be read at once."""
    if kind != 'psfex':
        return []
    from photutils_mgauss.files.psfex import read_psfex
    models = read_psfex(path, ext='all')
    return [f'  extension {ext}: {_of_psfex(model)}'
            for ext, model in models.items()]


def _of_psfex(model):
    n, ny, nx = model.planes.shape
    variables = ' and '.join(model.contexts) or 'nothing'
    return (f'{nx} x {ny} samples of {model.sampling:g} pix, {n} terms of a '
            f'polynomial of {variables}')


def _of_record(record):
    """Return a line on the run that made a file, if one is known."""
    if not record:
        return []
    return [(f'  made by mgauss {record.get("command")} on '
            f'{record.get("date")}, version {record.get("version")}')]


def _of_image(path, image):
    """Return what an image holds, and what it lacks."""
    facts = (f'  unit {image.unit or "unknown"}, saturation '
             f'{image.saturation or "unknown"}, electrons in a unit '
             f'{image.electrons or "unknown"}')
    lines = [f'{path}: an image',
             f'  {image.describe().partition(": ")[2]}', facts]
    try:
        image.check()
    except ValueError as error:
        lines.append('  not measurable as it is: '
                     f'{str(error).removeprefix(f"{path}: ")}')
    return lines


def _of_table(path):
    """Return what the columns of a table are taken for."""
    from photutils_mgauss.files.tables import read_table
    table, record = read_table(path)
    lines = [f'{path}: a table of {len(table)} rows']
    for meaning, names in _COLUMNS.items():
        found = [name for name in names if name in table.colnames]
        if found:
            lines.append(f'  {meaning}: {", ".join(found)}')
    known = sum(_COLUMNS.values(), ())
    others = [name for name in table.colnames if name not in known]
    if others:
        lines.append(f'  {len(others)} other columns: {", ".join(others)}')
    exposure = record.get('exposure', {})
    if exposure:
        lines.append('  measured on '
                     f'{exposure.get("image", "an unknown image")}')
    return lines + _of_record(record)
