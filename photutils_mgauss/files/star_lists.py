"""
Lists of stars of other programs, by name through `astropy.table.Table.read`.

Each program has its own columns, units and counting of pixels. What comes
back has those of this package: ``x_fit``, ``y_fit`` [pix], 0 at the centre of
the first pixel, ``x_err``, ``y_err``, and, as far as the file tells,
``xy_cov``, ``flux_fit``, ``flux_err``, ``mag``, ``mag_err``, ``snr``. All
other columns keep the program's names.
"""
from contextlib import suppress
from importlib import import_module
from inspect import signature
from pathlib import Path

import numpy as np
from astropy.table import QTable

from photutils_mgauss.files.damage import undamaged
from photutils_mgauss.utils.star_columns import plain_values
from photutils_mgauss.utils.validation import as_real
from photutils_mgauss.utils.waiting import waiting

__all__ = ['finished', 'lines_of', 'number_rows', 'read_star_list']

_FWHM = 2.0  # pixels, where neither the file nor the user tells
_SIGMAS = 2 * np.sqrt(2 * np.log(2))  # in a full width at half maximum
_MAG = 2.5 / np.log(10)  # magnitudes in a relative error of one

_COLUMNS = ('x_fit', 'y_fit', 'x_err', 'y_err', 'xy_cov', 'flux_fit',
            'flux_err', 'mag', 'mag_err', 'snr')
_UNITS = {'x_fit': 'pix', 'y_fit': 'pix', 'x_err': 'pix', 'y_err': 'pix',
          'xy_cov': 'pix2'}


def read_star_list(file, program, **options):
    """
    Read the list of stars of a program.

    Parameters
    ----------
    file : str or path-like
    program : str
        The name after ``'mgauss.'``.
    **options
        Those of the program's reader: ``fwhm`` [pix] of all, from which
        errors of positions are estimated where the file has none.

    Returns
    -------
    `~astropy.table.QTable`

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is not such a list, or is damaged.
    TypeError
        If the program's reader has no such option.
    """
    read = import_module(f'photutils_mgauss.files.{program}_lists').read
    signature(read).bind(file, **options)
    if options.get('fwhm') is not None:
        options['fwhm'] = as_real(options['fwhm'], 'fwhm', above=0)
    with waiting(f'Table.read of {program}'), undamaged(
            file, f'a star list of {program}'):
        return read(file, **options)


def finished(stars, others, *, origin, fwhm=None, program):
    """
    Return the table of a program's stars.

    Parameters
    ----------
    stars : dict
        Columns by the names of this package, positions and their errors as
        the program has them.
    others : `~astropy.table.Table`
        All that keeps its name.
    origin : float
        What the program calls the centre of the first pixel.
    fwhm : float, optional
        Of a star [pix].
    program : str

    Returns
    -------
    `~astropy.table.QTable`
        With the origin and what errors are in its ``meta``.
    """
    stars = {name: plain_values(values) for name, values in stars.items()}
    for axis in ('x_fit', 'y_fit'):
        stars[axis] = stars[axis] - origin
    meta = {'program': program,
            'pixel_origin': 'the centre of the first pixel is (0, 0); '
            f'{program} calls it ({origin:g}, {origin:g})'}
    _add_signal_to_noise(stars)
    if 'x_err' not in stars:
        meta['position_errors'] = _estimate_errors(stars, fwhm)
    table = QTable({name: stars[name] for name in _COLUMNS if name in stars},
                   units={name: unit for name, unit in _UNITS.items()
                          if name in stars}, meta=meta)
    for name in others.colnames:
        table[name if name not in table.colnames else f'{name}_file'] = (
            others[name])
    return table


def _add_signal_to_noise(stars):
    """Add the ratio of flux and error, or what magnitudes tell of it."""
    if 'snr' in stars:
        return
    with np.errstate(divide='ignore', invalid='ignore'):
        if 'flux_err' in stars:
            stars['snr'] = stars['flux_fit'] / stars['flux_err']
        elif 'mag_err' in stars:
            stars['snr'] = _MAG / stars['mag_err']


def _estimate_errors(stars, fwhm):
    """
    Add the errors that photon noise gives to positions; return the words.

    A Gaussian of the same width whose flux is known to one part in the
    signal-to-noise ratio has its centre known to its standard deviation
    divided by that ratio.
    """
    width = _FWHM if fwhm is None else fwhm
    noise = stars.get('snr')
    if noise is None:
        noise = np.full(len(stars['x_fit']), np.nan)
    with np.errstate(divide='ignore', invalid='ignore'):
        error = width / _SIGMAS / noise
    error = np.where((noise > 0) & np.isfinite(error), error, np.nan)
    stars['x_err'], stars['y_err'] = error, error.copy()
    return ('estimated, the file has none: photon noise of a star whose FWHM '
            f'is {width:g} pix')


def number_rows(lines, name, start=1):
    """
    Return rows of numbers (n, m) of lines of text, all of one length.

    ``start`` is the number of the first line in the file, for messages.
    """
    # One by one takes ten times as long, but tells what is wrong where.
    with suppress(ValueError):
        if any(map(str.strip, lines)):
            return np.loadtxt(lines, comments=None, ndmin=2)
    rows = [(number, line.split())
            for number, line in enumerate(lines, start) if line.strip()]
    if not rows:
        msg = f'{name}: must hold stars, got none'
        raise ValueError(msg)
    width = len(rows[0][1])
    for number, words in rows:
        if len(words) != width:
            msg = (f'{name}: must have {width} columns in line {number} as '
                   f'before, got {len(words)}')
            raise ValueError(msg)
    return np.array([[_number(word, number, name) for word in words]
                     for number, words in rows])


def _number(word, number, name):
    """Return a word as a float, NaN for the asterisks of an overflow."""
    if not word.strip('*'):
        return np.nan
    try:
        return float(word)
    except ValueError:
        msg = f'{name}: must have numbers in line {number}, got {word!r:.40}'
        raise ValueError(msg) from None


def lines_of(file):
    """Return the lines of a file of plain text."""
    return Path(file).read_text(encoding='utf-8').splitlines()
