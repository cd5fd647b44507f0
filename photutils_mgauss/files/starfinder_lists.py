"""
Star lists of StarFinder, ``.lis``, as they are written at Keck and elsewhere.

A line is name, magnitude, year, x, y, ``[x_err, y_err,]`` signal-to-noise,
correlation, frames, flux; or the plain numbers of the program itself, x, y,
flux, their errors and the correlation. The first pixel is (0, 0), as here.
"""
import numpy as np
from astropy.table import Table

from photutils_mgauss.files.star_lists import (
    finished,
    lines_of,
    number_rows,
)

__all__ = ['read']

_NAMED = ('mag', 'time', 'x_fit', 'y_fit', 'snr', 'corr', 'n_frames',
          'flux_fit')
_WITH_ERRORS = ('mag', 'time', 'x_fit', 'y_fit', 'x_err', 'y_err', 'snr',
                'corr', 'n_frames', 'flux_fit')
_PLAIN = ('x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err', 'flux_err',
          'corr')
_KEPT = ('time', 'corr', 'n_frames')


def read(file, *, fwhm=None):
    """
    Read a list of StarFinder.

    Parameters
    ----------
    file : str or path-like
    fwhm : float, optional
        Of a star [pix].

    Returns
    -------
    `~astropy.table.QTable`
        With the columns ``name`` and ``time`` [yr], where the file has them:
        an epoch takes the time of each row from it.
    """
    lines = [line if not line.lstrip().startswith('#') else ''
             for line in lines_of(file)]
    width = next((len(line.split()) for line in lines if line.strip()), 0)
    kinds = {len(_NAMED) + 1: _NAMED, len(_WITH_ERRORS) + 1: _WITH_ERRORS,
             len(_PLAIN): _PLAIN}
    if width not in kinds:
        msg = (f'{file}: must have 7, 9 or 11 columns as star lists of '
               f'StarFinder, got {width}')
        raise ValueError(msg)
    names, words = kinds[width], []
    if names is not _PLAIN:
        words = [line.split(None, 1)[0] for line in lines if line.strip()]
        lines = [' '.join(line.split(None, 1)[1:]) for line in lines]
    rows = number_rows(lines, file)
    if rows.shape != (len(words) or len(rows), len(names)):
        msg = (f'{file}: must have {width} columns in every line')
        raise ValueError(msg)
    values = dict(zip(names, rows.T, strict=True))
    others = Table({'name': words} if words else None)
    for name in _KEPT:
        if name in values:
            others[name] = values.pop(name)
    if 'n_frames' in others.colnames and np.isfinite(
            others['n_frames']).all():
        others['n_frames'] = others['n_frames'].astype(int)
    return finished(values, others, origin=0.0, fwhm=fwhm,
                    program='StarFinder')
