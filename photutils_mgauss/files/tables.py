"""Tables of stars, in any format that astropy reads."""
import json
from pathlib import Path

from photutils_mgauss.files.damage import undamaged
from photutils_mgauss.files.fits_files import open_fits

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
        An ECSV, FITS, VOTable or any other file that astropy recognises.

    Returns
    -------
    table : `~astropy.table.QTable`
    record : dict
        Empty for tables of other programs.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is damaged or no table.
    """
    from astropy.io.registry import IORegistryError
    from astropy.table import QTable
    what = 'a table that astropy can read'
    with undamaged(path, what):
        if is_fits(path):
            # Checks the sizes that the headers tell of.
            with open_fits(path, what) as hdus:
                _refuse_ldac(hdus)
                table = QTable.read(path)
        else:
            try:
                table = QTable.read(path)
            except IORegistryError as error:
                # Its own words are followed by all formats there are.
                msg = ('a file of none of the kinds that it recognises; '
                       'images and PSFs are FITS or ASDF files, and lists of '
                       "other programs are read in Python with QTable.read("
                       "file, format='mgauss.daophot'), or the like, and "
                       'written as ECSV')
                raise OSError(msg) from error
        text = table.meta.get('MGRUN')
        record = (table.meta.get('mgauss', {}) if text is None
                  else json.loads(text))
        if not isinstance(record, dict):
            msg = f'{record!r:.40} in place of the record of its run'
            raise TypeError(msg)
    return table, record


def _refuse_ldac(hdus):
    """Raise if the first table is the header of an image, as in LDAC files."""
    if any(hdu.name == 'LDAC_IMHEAD' for hdu in hdus):
        msg = ('a catalogue of SExtractor in the format LDAC, which begins '
               'with the header of the image: in Python, read it with '
               "QTable.read(file, format='mgauss.sextractor'), and write it "
               'as ECSV')
        raise OSError(msg)
