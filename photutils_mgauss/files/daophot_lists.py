"""
Star lists of DAOPHOT: ``.als``, ``.alf``, ``.coo``, ``.ap`` and their likes.

Both as DAOPHOT II, ALLSTAR and ALLFRAME write them, with a head of three
lines, and as IRAF's tasks do, with ``#K`` and ``#N``. The centre of the first
pixel is (1, 1); magnitudes have the zero point 25.
"""
import numpy as np
from astropy.table import Table

from photutils_mgauss.files.star_lists import (
    finished,
    lines_of,
    number_rows,
)

__all__ = ['read']

_ZERO_POINT = 25.0
_THRESHOLD = 4.0  # of the finding tasks, where the file does not tell
_BAD = 90.0  # magnitudes from here on say that there is none
_PROFILE = ('number', 'x', 'y', 'mag', 'mag_err', 'sky', 'n_iter', 'chi',
            'sharpness')
_FOUND = ('number', 'x', 'y', 'mag', 'sharpness', 'roundness',
          'roundness_y')
_IRAF = {'x_fit': ('XCENTER',), 'y_fit': ('YCENTER',),
         'mag': ('MAG', 'MAG1'), 'mag_err': ('MERR', 'MERR1')}


def read(file, *, fwhm=None):
    """
    Read a list of DAOPHOT, ALLSTAR or ALLFRAME.

    Parameters
    ----------
    file : str or path-like
    fwhm : float, optional
        Of a star [pix]; by default that of the file, if it has one.

    Returns
    -------
    `~astropy.table.QTable`
        The identifiers are in the column ``number``, because those of
        different images are not those of the same stars, or they are, in
        files of ALLFRAME: then rename it to ``id``.
    """
    lines = lines_of(file)
    if any(line.startswith('#N') for line in lines):
        return _read_iraf(file, lines, fwhm)
    if not lines or lines[0].split()[:1] != ['NL']:
        msg = (f'{file}: must begin with the line NL NX NY ... of DAOPHOT, '
               'or the #K and #N of IRAF')
        raise ValueError(msg)
    kind, columns = _head(file, lines)
    values = (_blocks(file, lines) if kind == 2
              else _rows(file, lines, columns))
    stars = {'x_fit': values.pop('x'), 'y_fit': values.pop('y')}
    for name in ('mag', 'mag_err'):
        if name in values:
            stars[name] = values.pop(name)
    values['number'] = _whole(values['number'])
    return _finished(stars, Table(values, copy=False), fwhm)


def _finished(stars, others, fwhm, threshold=None):
    """
    Return the table; what has no magnitude has no flux either.

    Those of the finding tasks are peaks in units of the threshold, which is
    ``threshold`` times the noise.
    """
    if 'mag' in stars:
        mag = np.asarray(np.ma.filled(np.ma.asarray(
            stars['mag'], dtype=float), np.nan))
        stars['mag'] = np.where(mag < _BAD, mag, np.nan)
        with np.errstate(over='ignore'):
            stars['flux_fit'] = 10**(0.4 * (_ZERO_POINT - stars['mag']))
            if 'mag_err' not in stars:
                stars['snr'] = ((threshold or _THRESHOLD)
                                * 10**(-0.4 * stars['mag']))
    return finished(stars, others, origin=1.0, fwhm=fwhm, program='DAOPHOT')


def _head(file, lines):
    """Return the kind of file (the number NL), and how many columns."""
    words = lines[1].split() if len(lines) > 1 else []
    if not words or words[0] not in ('1', '2', '3'):
        msg = (f'{file}: must have the kind of file, NL = 1, 2 or 3, in its '
               f'second line, got {(words or ["nothing"])[0]!r:.20}')
        raise ValueError(msg)
    first = next((line for line in lines[3:] if line.strip()), '')
    return int(words[0]), len(first.split())


def _rows(file, lines, width):
    """Return the columns of files with a line for each star."""
    rows = number_rows(lines[3:], file, 4)
    names = _PROFILE if width >= len(_PROFILE) else _FOUND[:width]
    if width < 4:
        msg = (f'{file}: must have number, x, y and magnitude of each star, '
               f'got {width} columns')
        raise ValueError(msg)
    return {name: rows[:, k].copy() for k, name in enumerate(names)}


def _blocks(file, lines):
    """Return the columns of aperture photometry: two lines a star."""
    there = [line for line in lines[3:] if line.strip()]
    first, second = (number_rows(there[k::2], file, 4) for k in (0, 1))
    n = first.shape[1] - 3
    if len(first) != len(second) or n < 1 or second.shape[1] != 3 + n:
        msg = (f'{file}: must have two lines for each star, magnitudes and '
               'their errors of the same apertures')
        raise ValueError(msg)
    values = dict(zip(('number', 'x', 'y', 'mag'), first.T[:4],
                      strict=True))
    values |= dict(zip(('sky', 'sky_std', 'sky_skewness', 'mag_err'),
                       second.T[:4], strict=True))
    for k in range(1, n):
        values[f'mag_{k + 1}'] = np.where(first[:, 3 + k] < _BAD,
                                          first[:, 3 + k], np.nan)
        values[f'mag_err_{k + 1}'] = second[:, 3 + k]
    return values


def _whole(values):
    whole = np.isfinite(values).all() and (np.abs(values) < 2**53).all()
    return values.astype(int) if whole else values


def _read_iraf(file, lines, fwhm):
    """Read the text database of a task of IRAF."""
    table = Table.read(lines, format='ascii.daophot')
    if fwhm is None:
        fwhm = _keyword(table, 'FWHMPSF')
    stars = {name: table[next(one for one in names if one in table.colnames)]
             for name, names in _IRAF.items()
             if any(one in table.colnames for one in names)}
    if 'x_fit' not in stars or 'y_fit' not in stars:
        msg = (f'{file}: must have columns XCENTER and YCENTER, got '
               f'{", ".join(table.colnames)[:200]}')
        raise ValueError(msg)
    used = [name for names in _IRAF.values() for name in names
            if name in table.colnames]
    others = table[[name for name in table.colnames if name not in used]]
    if 'ID' in others.colnames:
        others.rename_column('ID', 'number')
    others.meta.clear()
    for column in others.itercols():
        column.unit = None  # words of IRAF, such as '##' and 'perrors'
    return _finished(stars, others, fwhm, _keyword(table, 'THRESHOLD'))


def _keyword(table, name):
    """Return a positive number of the head, None if there is none."""
    try:
        value = float(table.meta['keywords'][name]['value'])
    except (KeyError, TypeError, ValueError):
        return None
    return value if np.isfinite(value) and value > 0 else None
