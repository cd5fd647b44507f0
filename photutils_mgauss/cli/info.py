"""``mgauss info``: what a file is, and how it would be read."""

from photutils_mgauss.cli import info_psf, tools
from photutils_mgauss.cli.catalogues import is_table
from photutils_mgauss.cli.running import complain

# What names of columns mean to the other commands.
_COLUMNS = {
    'positions in pixels': ('x_fit', 'y_fit', 'x', 'y', 'x_err', 'y_err',
                            'xy_cov'),
    'positions on the sky': ('ra', 'dec', 'ra_error', 'dec_error', 'ra_err',
                             'dec_err'),
    'fluxes': ('flux_fit', 'flux_err', 'flux', 'mag', 'mag_err', 'snr'),
    'motions': ('pmra', 'pmdec', 'pmra_error', 'pmdec_error', 'parallax',
                'parallax_error', 'ref_epoch'),
    'identities': ('id', 'source_id'),
    'quality': ('flags', 'cfit', 'qfit', 'reduced_chi2'),
    'times': ('time',)}
_KINDS = {'mixtures': 'a PSF of this package', 'psfex': 'a PSF of PSFEx',
          'stdpsf': 'a grid of ePSFs in the format STDPSF',
          'stpsf': 'a grid of PSFs of STPSF (GriddedPSFModel)',
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
    if kind != 'image':
        return _of_psf(options, kind, path)
    if is_table(path):
        return _of_table(path)
    return _of_wcs_alone(path) or _of_image(path, read())


def _of_psf(options, kind, path):
    """Return what a PSF file holds, and what reads it."""
    lines = [f'{path}: {_KINDS[kind]}']
    if kind == 'mixtures':
        from photutils_mgauss.cli.psf_files import psf_record
        return lines + info_psf.of_mixtures(path) + _of_record(
            psf_record(path))
    lines += info_psf.of_other(kind, path, ext=options.ext,
                               detector=options.detector)
    lines.append('  mgauss psf makes mixtures of it; photometry does so each '
                 'time')
    return lines


def _of_record(record):
    """Return a line on the run that made a file, if one is known."""
    if not record:
        return []
    return [(f'  made by mgauss {record.get("command")} on '
            f'{record.get("date")}, version {record.get("version")}')]


def _of_wcs_alone(path):
    """Return what a WCS without an image is, None for all other files."""
    import numpy as np

    from photutils_mgauss.files.image_layers import wcs_alone
    wcs = wcs_alone(path)
    if wcs is None:
        return None
    kind = 'a gwcs' if hasattr(wcs, 'available_frames') else 'a FITS WCS'
    ny, nx = wcs.array_shape or (None, None)
    size = 'of unknown size' if nx is None else f'{nx} x {ny} pixels'
    x, y = (0, 0) if nx is None else ((nx - 1) / 2, (ny - 1) / 2)
    place = wcs.pixel_to_world(x, y).icrs
    at = (f'at ra {place.ra.deg:.6f}, dec {place.dec.deg:.6f} deg'
          if np.isfinite(place.ra.deg) else 'outside of its bounding box')
    where = f'  {kind} of an image {size}; pixel ({x:g}, {y:g}) is {at}'
    return [f'{path}: a WCS without an image', where,
            '  psf, photometry and motions take it with --wcs']


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
    program = table.meta.get('program')
    lines = [f'{path}: a table of {len(table)} rows' if program is None
             else f'{path}: a star list of {program}, {len(table)} stars']
    for meaning, names in _COLUMNS.items():
        found = [name for name in names if name in table.colnames]
        if found:
            lines.append(f'  {meaning}: {", ".join(found)}')
    known = sum(_COLUMNS.values(), ())
    others = [name for name in table.colnames if name not in known]
    if others:
        lines.append(f'  {len(others)} other columns: {", ".join(others)}')
    if program is not None:
        lines += [f'  {table.meta["pixel_origin"]}', *_of_list(path, table)]
    exposure = record.get('exposure', {})
    if exposure:
        lines.append('  measured on '
                     f'{exposure.get("image", "an unknown image")}')
    return lines + _of_record(record)


def _of_list(path, table):
    """Return what a star list says of its errors, and what it lacks."""
    from photutils_mgauss.files.ldac_headers import read_ldac_header
    inside = (read_ldac_header(path)
              if table.meta['program'] == 'SExtractor' else None)
    lines = ([f'  errors of positions: {table.meta["position_errors"]}']
             if 'position_errors' in table.meta else [])
    needed = []
    if inside is None or inside.wcs is None:
        needed.append('--wcs or --plane')
    if 'time' not in table.colnames and (inside is None
                                         or inside.time is None):
        needed.append('--time')
    if inside is not None:
        lines.append(f'  of its image: {"a" if inside.wcs else "no"} WCS, '
                     f'time {inside.time.isot if inside.time else "unknown"}')
    words = f'with {" and ".join(needed)}' if needed else 'as it is'
    lines.append(f'  mgauss motions takes it {words}, mgauss psf with --stars')
    return lines
