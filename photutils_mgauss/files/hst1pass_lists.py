"""
Star lists of the one-pass programs for HST images: hst1pass and its likes.

A column is a letter, and the letters are the ending of the file's name:
``image_flc.xympqk``. ``x``, ``y`` are raw pixels, ``X``, ``Y`` those without
distortion, ``u``, ``v`` those of a common frame; all count from 1. Three
``e`` are the errors of x, y and m, as in ``MATCHUP.XYMEEE``.
"""
import re
from pathlib import Path

import numpy as np
from astropy.table import Table

from photutils_mgauss.files.star_lists import (
    finished,
    lines_of,
    number_rows,
)
from photutils_mgauss.utils.validation import as_choice

__all__ = ['letters_of', 'read']

_FRAMES = {'raw': ('x', 'y'), 'corrected': ('X', 'Y'),
           'common': ('u', 'v')}
_NAMES = {'x': 'x_raw', 'y': 'y_raw', 'X': 'x_corrected',
          'Y': 'y_corrected', 'u': 'x_common', 'v': 'y_common',
          'U': 'x_map', 'V': 'y_map', 'r': 'ra_file', 'd': 'dec_file',
          'p': 'peak', 'q': 'qfit', 's': 'sky', 'k': 'chip',
          'M': 'mag_corrected', 'W': 'mag_map', 'w': 'mag_common'}
_OPTION = re.compile(r'#.*\bOUT(?:PUT)?\s*=\s*([A-Za-z]+)\s*$')
_ENDING = re.compile(r'[._]([A-Za-z]*[xX][yY][A-Za-z]*|[A-Za-z]*uv[A-Za-z]*)'
                     r'(?:\.\w+)?$')


def read(file, *, frame=None, columns=None, fwhm=None):
    """
    Read a list of hst1pass, img2xym or of their like.

    Parameters
    ----------
    file : str or path-like
    frame : {'raw', 'corrected', 'common'}, optional
        Which positions are the table's: the default is the first of those
        that the file has.
    columns : str, optional
        The letters of the columns; by default they are looked for in the
        file's comments and at the end of its name.
    fwhm : float, optional
        Of a star [pix].

    Returns
    -------
    `~astropy.table.QTable`
    """
    lines = lines_of(file)
    rows = number_rows([line if not line.lstrip().startswith('#') else ''
                        for line in lines], file)
    letters = letters_of(file, lines, rows.shape[1], columns)
    values = dict(zip(letters, rows.T, strict=True))
    stars, used = _stars(file, values, frame)
    others = Table({_NAMES.get(letter, letter): column
                    for letter, column in values.items()
                    if letter not in used}, copy=False)
    if 'chip' in others.colnames and np.isfinite(others['chip']).all():
        others['chip'] = others['chip'].astype(int)
    return finished(stars, others, origin=1.0, fwhm=fwhm,
                    program='hst1pass')


def letters_of(file, lines, width, columns=None):
    """Return the name of each column: letters, errors as ex, ey, em."""
    if columns is not None and len(columns) != width:
        msg = (f'{file}: columns must name {width} columns with a letter '
               f'each, got {columns!r}')
        raise ValueError(msg)
    for letters in (columns, *_candidates(file, lines)):
        if letters is not None and len(letters) == width:
            return _distinct(list(letters))
    msg = (f'{file}: must end in the letters of its {width} columns, as in '
           "image.xymq; give columns='xym...', one letter for each")
    raise ValueError(msg)


def _candidates(file, lines):
    """Yield what may be the letters of the columns, the surest first."""
    comments = [line.strip() for line in lines
                if line.lstrip().startswith('#')]
    for line in comments:
        if found := _OPTION.match(line):
            yield found.group(1)
    for line in comments:
        words = line.strip('#').replace('.', ' ').split()
        if len(words) > 2 and all(len(word) == 1 and word.isalpha()
                                  for word in words):
            yield ''.join(words)
    if found := _ENDING.search(Path(file).name):
        yield found.group(1)


def _distinct(letters):
    """Return letters with the three errors told apart, X Y as x y alone."""
    if [one.lower() for one in letters[:3]] == ['x', 'y', 'm'] and (
            [one.lower() for one in letters[3:6]] == ['e', 'e', 'e']):
        letters[:6] = 'x', 'y', 'm', 'ex', 'ey', 'em'
    elif 'x' not in letters and 'm' not in letters and 'M' in letters:
        letters[letters.index('M')] = 'm'
    seen = {}
    for k, letter in enumerate(letters):
        seen[letter] = seen.get(letter, 0) + 1
        if seen[letter] > 1:
            letters[k] = f'{letter}{seen[letter]}'
    return letters


def _stars(file, values, frame):
    """Return the columns of the package, and the letters they are made of."""
    there = [name for name, pair in _FRAMES.items()
             if all(letter in values for letter in pair)]
    if frame is not None:
        as_choice(frame, 'frame', tuple(_FRAMES))
    if not there or (frame is not None and frame not in there):
        msg = (f'{file}: must have columns x and y of the frame '
               f'{frame or "raw"!r}, got {", ".join(values)}')
        raise ValueError(msg)
    x, y = _FRAMES[frame or there[0]]
    stars, used = {'x_fit': values[x], 'y_fit': values[y]}, [x, y]
    for name, letter in (('mag', 'm'), ('x_err', 'ex'), ('y_err', 'ey'),
                         ('mag_err', 'em')):
        if letter in values:
            stars[name] = values[letter]
            used.append(letter)
    if 'mag' in stars:
        # Instrumental magnitudes: those of electrons, without a zero point.
        with np.errstate(over='ignore'):
            stars['flux_fit'] = 10**(-0.4 * stars['mag'])
        if 'mag_err' not in stars:
            stars['snr'] = np.sqrt(stars['flux_fit'])
    return stars, used
