"""
Photometry files of DOLPHOT, with the file ``.columns`` beside them.

DOLPHOT calls the centre of the first pixel of the reference image (0.5, 0.5).
Positions are those on that image; of their errors it says nothing.
"""
import re
from pathlib import Path

import numpy as np
from astropy.table import Table

from photutils_mgauss.files.damage import undamaged
from photutils_mgauss.files.star_lists import (
    finished,
    lines_of,
    number_rows,
)

__all__ = ['read']

_LINE = re.compile(r'\s*(\d+)\.\s+(.*\S)\s*$')
# What is measured, which may have commas in parentheses, and of what.
_QUANTITY = re.compile(r'((?:[^(,]|\([^)]*\)?)*)(?:,\s*(.*))?')
_NONE = 90.0  # magnitudes from here on say that there is none
_POSITION = 'object {} position'
_IMAGE = re.compile(r'(.*\S)\s*\(\s*([^(),]+),[^()]*sec[^()]*\)$')


def read(file, *, filter=None, columns=None, fwhm=None):  # noqa: A002
    """
    Read a photometry file of DOLPHOT.

    Parameters
    ----------
    file : str or path-like
    filter : str, optional
        Whose magnitude and flux are the table's, such as 'WFC3_F814W'; by
        default the first of the file.
    columns : str or path-like, optional
        The file that describes the columns; by default the one of the same
        name with ``.columns`` at its end.
    fwhm : float, optional
        Of a star [pix].

    Returns
    -------
    `~astropy.table.QTable`
    """
    lines = lines_of(file)
    beside = Path(f'{file}.columns' if columns is None else columns)
    described = _descriptions(file, beside)
    rows = number_rows(lines, file)
    if len(described) != rows.shape[1]:
        msg = (f'{file}: must have the {len(described)} columns that '
               f'{beside.name} describes, got {rows.shape[1]}')
        raise ValueError(msg)
    values = dict(zip(_unique(described), rows.T, strict=True))
    stars, used = _stars(file, beside, values, filter)
    others = Table({_short(name): column for name, column in values.items()
                    if name not in used}, copy=False)
    return finished(stars, others, origin=0.5, fwhm=fwhm, program='DOLPHOT')


def _descriptions(file, path):
    """Return what stands in the .columns file, in order."""
    if not path.is_file():
        msg = (f'{file}: must have the file {path.name} beside it, which '
               'describes its columns, got none; or give columns=')
        raise ValueError(msg)
    with undamaged(path, 'the description of columns of DOLPHOT'):
        lines = lines_of(path)
    found = [_LINE.match(line) for line in lines if line.strip()]
    numbers = [int(one.group(1)) if one else 0 for one in found]
    if not found or numbers != list(range(1, len(found) + 1)):
        msg = (f'{file}: {path.name} must have a line for each column, '
               'numbered from 1')
        raise ValueError(msg)
    return [one.group(2) for one in found]


def _unique(names):
    """Return names with numbers behind those that came before."""
    seen, out = {}, []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f'{name} {seen[name]}')
    return out


def _short(description):
    """Return a name for a column: its words, and its filter or image."""
    quantity, owner = _QUANTITY.match(description).groups()
    quantity = re.sub(r'\s*\(.*?\)', '', quantity).lower()
    quantity = '_'.join(re.findall(r'[a-z0-9]+', quantity))
    if found := _IMAGE.match(owner or ''):
        owner = Path(found.group(1)).name
    return f'{quantity}_{owner}' if owner else quantity


def _stars(file, beside, values, chosen):
    """Return the columns of the package, and the descriptions used."""
    def first(start, end=''):
        return next((name for name in values if name.lower().startswith(
            start) and name.endswith(end)), None)
    used = {'x_fit': first(_POSITION.format('x')),
            'y_fit': first(_POSITION.format('y')),
            'snr': first('signal-to-noise')}
    if used['x_fit'] is None or used['y_fit'] is None:
        msg = (f'{file}: {beside.name} must describe the positions of the '
               'objects, got no such column')
        raise ValueError(msg)
    band = _chosen_filter(file, values, chosen)
    if band is not None:
        used |= {'mag': first('instrumental', f', {band}'),
                 'mag_err': first('magnitude uncertainty', f', {band}'),
                 'flux_fit': first('normalized count rate, ', band),
                 'flux_err': first('normalized count rate unc', f', {band}')}
    used = {name: one for name, one in used.items() if one is not None}
    stars = {name: values[one] for name, one in used.items()}
    if 'mag' in stars:
        there = stars['mag'] < _NONE
        for name in {'mag', 'mag_err', 'flux_err'} & set(stars):
            stars[name] = np.where(there, stars[name], np.nan)
    if 'flux_fit' not in stars:
        stars.pop('flux_err', None)
    return stars, set(used.values())


def _chosen_filter(file, described, chosen):
    """Return the filter, or image, whose magnitude is to be the table's."""
    bands = [one.partition(', ')[2] for one in described
             if one.lower().startswith('instrumental')]
    if chosen is None:
        return bands[0] if bands else None
    if chosen not in bands:
        filters = [band for band in bands if not _IMAGE.match(band)]
        msg = (f'{file}: filter must be one of '
               f'{", ".join(filters or bands) or "none"}, got {chosen!r}')
        raise ValueError(msg)
    return chosen
