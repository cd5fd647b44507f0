"""Tables of stars, in any format that astropy or this package reads."""
import json
from pathlib import Path

from astropy.io.registry import IORegistryError
from astropy.table import QTable

from photutils_mgauss.files.damage import undamaged
from photutils_mgauss.files.fits_files import open_fits
from photutils_mgauss.files.list_kinds import program_of_list
from photutils_mgauss.files.star_lists import read_star_list

__all__ = ['read_table']

_FITS_MARKS = (b'SIMPLE', b'\x1f\x8b')


def is_fits(path):
    """Whether a file begins as those of FITS do, or is compressed."""
    with Path(path).open('rb') as file:
        return file.read(6).startswith(_FITS_MARKS)


def read_table(path):
    """
    Return a table and the record of the run that made it.

    Parameters
    ----------
    path : str or path-like
        An ECSV, FITS, VOTable or any other file that astropy recognises, or
        a star list of another program, see `program_of_list`.

    Returns
    -------
    table : `~astropy.table.QTable`
    record : dict
        Empty for tables of other programs. What was made of a star list is
        in the ``meta`` of its table.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is damaged or no table.
    """
    program = program_of_list(path)
    if program is not None:
        return read_star_list(path, program), {}
    what = 'a table that astropy can read'
    with undamaged(path, what):
        if is_fits(path):
            # Checks the sizes that the headers tell of.
            with open_fits(path, what):
                table = QTable.read(path)
        else:
            table = _read_text(path)
        text = table.meta.get('MGRUN')
        record = (table.meta.get('mgauss', {}) if text is None
                  else json.loads(text))
        if not isinstance(record, dict):
            msg = f'{record!r:.40} in place of the record of its run'
            raise TypeError(msg)
    return table, record


def _read_text(path):
    try:
        return QTable.read(path)
    except (IORegistryError, ImportError) as error:
        # Its own words are followed by all formats there are, or name a
        # package for pages of HTML.
        msg = ('a file of none of the kinds that it recognises, nor a star '
               'list of DAOPHOT, DOLPHOT, hst1pass, SExtractor or '
               'StarFinder; images and PSFs are FITS or ASDF files, and '
               'other tables are read in Python with QTable.read(file, '
               'format=...) and written as ECSV')
        raise OSError(msg) from error
