"""Tables of stars, in any format that astropy reads."""
import json
from pathlib import Path

from photutils_mgauss.files.damage import undamaged
from photutils_mgauss.files.fits_files import open_fits

__all__ = ['read_table']

_FITS_MARKS = (b'SIMPLE', b'\x1f\x8b')


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
    from astropy.table import QTable
    what = 'a table that astropy can read'
    with undamaged(path, what):
        with Path(path).open('rb') as file:
            start = file.read(6)
        if start.startswith(_FITS_MARKS):
            # Checks the sizes that the headers tell of.
            with open_fits(path, what):
                table = QTable.read(path)
        else:
            table = QTable.read(path)
        text = table.meta.get('MGRUN')
        record = (table.meta.get('mgauss', {}) if text is None
                  else json.loads(text))
        if not isinstance(record, dict):
            msg = f'{record!r:.40} in place of the record of its run'
            raise TypeError(msg)
    return table, record
