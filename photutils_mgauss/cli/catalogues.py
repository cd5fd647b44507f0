"""Catalogues as inputs: of this package, of others, and star lists."""
from dataclasses import dataclass
from pathlib import Path

from photutils_mgauss.cli import tools

# Bits of SExtractor for stars that have neighbours.
_BLENDED = 3
_TABLE_SUFFIXES = ('.ecsv', '.csv', '.txt', '.dat', '.vot', '.xml', '.votable')


@dataclass(frozen=True, eq=False)
class Catalogue:
    """A catalogue, the record of its run, its WCS and time, or None."""

    table: object
    record: dict
    wcs: object
    time: object


def is_table(path):
    """Whether a file is a table rather than an image."""
    if Path(path).suffix.lower() in _TABLE_SUFFIXES:
        return True
    from photutils_mgauss.files.image_layers import is_asdf, open_fits
    from photutils_mgauss.files.tables import is_fits
    if is_asdf(path):
        return False
    if not is_fits(path) and '.fit' not in Path(path).name.lower():
        return True
    with tools.about(path), open_fits(path) as hdus:
        images = [hdu for hdu in hdus if hdu.is_image
                  and hdu.header.get('NAXIS', 0) >= 2]
        return not images and len(hdus) > 1


def read_catalogue(options, path, i):
    """
    Return the `Catalogue` that is the input of number i.

    Its WCS and time are those of the options, of the record of its run, or
    of the header of the image in a catalogue of the format LDAC.
    """
    from photutils_mgauss.files.tables import read_table
    table, record = read_table(path)
    say_program(options, path, table)
    table = _without_spoilt(options, path, table)
    inside = _image_inside(table, path)
    time = tools.parse_time(tools.one_each(options.time, len(options.inputs),
                                           'time')[i])
    given = tools.one_each(options.wcs, len(options.inputs), 'wcs')[i]
    if given is not None:
        from photutils_mgauss.files.image_layers import read_wcs
        wcs = read_wcs(given)
    else:
        wcs = inside.wcs if inside else _wcs_of(options, i, record)
    if time is None:
        time = (inside.time if inside
                else record.get('exposure', {}).get('time'))
    return Catalogue(table, record, wcs, time)


def say_program(options, path, table):
    """Say which program's star list a file was taken for."""
    program = table.meta.get('program')
    if program is not None:
        tools.say(options, f'{path}: {len(table)} stars, a star list of '
                  f'{program}: {table.meta["pixel_origin"]}')
    if 'position_errors' in table.meta:
        tools.say(options, f'{path}: errors of positions: '
                  f'{table.meta["position_errors"]}')


def _without_spoilt(options, path, table):
    """Leave out stars that SExtractor calls saturated or truncated."""
    if table.meta.get('program') != 'SExtractor' or (
            'FLAGS' not in table.colnames):
        return table
    spoilt = (table['FLAGS'].astype(int) & ~_BLENDED
              & ~options.good_flags) > 0
    if spoilt.any():
        tools.say(options, f'{path}: left out {spoilt.sum()} of '
                  f'{len(table)} stars, which SExtractor flags '
                  'as saturated, truncated or incomplete (FLAGS of 4 and '
                  'more); --good-flags takes them')
    return table[~spoilt]


def _image_inside(table, path):
    """Return what a catalogue in the format LDAC says of its image."""
    from photutils_mgauss.files.ldac_headers import read_ldac_header
    return (read_ldac_header(path)
            if table.meta.get('program') == 'SExtractor' else None)


def _wcs_of(options, i, record):
    """Return the WCS of the image that the record of a run names."""
    from photutils_mgauss.cli.star_image import Reading, read_image
    from photutils_mgauss.files.image_layers import read_wcs
    exposure = record.get('exposure', {})
    name = exposure.get('wcs') or exposure.get('image')
    if name is None:
        return None
    file = Path(options.inputs[i]).resolve().parent / name
    if not file.exists():
        tools.say(options, f'{options.inputs[i]}: {file} is not there, which '
                  'has its WCS; the places on the sky are used as they are')
        return None
    if exposure.get('wcs'):
        return read_wcs(file)
    return read_image(file, Reading(ext=exposure.get('ext'))).wcs
