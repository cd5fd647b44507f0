"""
Which program wrote a list of stars, told by what is in the file.

Only StarFinder's plain numbers and files without the head that they should
have are told by the ending of their name.
"""
import re
from contextlib import suppress
from pathlib import Path

from photutils_mgauss.files import hst1pass_lists
from photutils_mgauss.files.fits_files import open_fits

__all__ = ['program_of_list']

# As much of a text is looked at.
_START = 2**16
_ENDINGS = {'.als': 'daophot', '.alf': 'daophot', '.ap': 'daophot',
            '.coo': 'daophot', '.lis': 'starfinder', '.ldac': 'sextractor'}
_ASCII_HEAD = re.compile(r'#\s+1\s+[A-Z][A-Z0-9_]+\b')
_LDAC = ('LDAC_IMHEAD', 'LDAC_OBJECTS')
_POSITION = re.compile(r'[XY](WIN|PSF|MODEL)?_IMAGE$')
_YEARS = 1900, 2100
_NAMED_WIDTHS = 9, 11  # columns of StarFinder's lists with names


def program_of_list(path):
    """
    Return the name of the program that wrote a list of stars.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    str or None
        The name that `photutils_mgauss.files.star_lists.read_star_list`
        takes; None for files of any other kind.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is a damaged FITS file.
    """
    path = Path(path)
    with path.open('rb') as file:
        start = file.read(_START)
    if start.startswith((b'SIMPLE', b'\x1f\x8b')):
        return 'sextractor' if _is_catalogue(path) else None
    if not start.strip() or b'\0' in start:
        return None
    # The last line may be cut, and so may its last letter.
    lines = start.decode('utf-8', 'replace').splitlines()
    lines = lines[:-1] if len(start) == _START else lines
    return _by_content(path, lines) or _ENDINGS.get(path.suffix.lower())


def _is_catalogue(path):
    """Whether a FITS file is a catalogue of SExtractor."""
    with open_fits(path, 'an undamaged FITS file') as hdus:
        names = [name for hdu in hdus if 'TFIELDS' in hdu.header
                 for name in hdu.columns.names]
        return (any(hdu.name in _LDAC for hdu in hdus)
                or sum(bool(_POSITION.match(name)) for name in names) > 1)


def _by_content(path, lines):
    first = next((line for line in lines if line.strip()), '')
    if first.startswith('# %ECSV'):
        return None
    if first.split()[:3] == ['NL', 'NX', 'NY'] or (
            first.startswith('#K ')
            and any(line.startswith('#N ') for line in lines)):
        return 'daophot'
    if _ASCII_HEAD.match(first):
        return 'sextractor'
    rows = [line.split() for line in lines
            if line.strip() and not line.lstrip().startswith('#')]
    if rows and _is_named(rows[0]):
        return 'starfinder'
    if not rows or not all(map(_is_number, rows[0])):
        return None
    if path.with_name(f'{path.name}.columns').is_file():
        return 'dolphot'
    # Letters that stand alone may be the names of anybody's columns.
    sure = [line for line in lines if '=' in line or '.' in line]
    with suppress(ValueError):
        if hst1pass_lists.letters_of(path, sure, len(rows[0])):
            return 'hst1pass'
    return None


def _is_named(words):
    """Whether a row is of StarFinder: a name, a magnitude and a year."""
    if len(words) not in _NAMED_WIDTHS or _is_number(words[0]):
        return False
    return all(map(_is_number, words[1:])) and (
        _YEARS[0] < float(words[2]) < _YEARS[1])


def _is_number(word):
    """Whether a word is a number, or the asterisks of an overflow."""
    try:
        float(word)
    except ValueError:
        return not word.strip('*')
    return True
