"""
Catalogues of SExtractor: ASCII_HEAD, FITS_1.0 and FITS_LDAC.

Positions count from 1. Of those that the catalogue has the best is taken, and
its errors with it: windowed (``XWIN_IMAGE``), of a fitted PSF or model, or
the barycentre (``X_IMAGE``).
"""
from pathlib import Path

import numpy as np
from astropy.table import Table, vstack

from photutils_mgauss.files.fits_files import open_fits
from photutils_mgauss.files.star_lists import finished, lines_of
from photutils_mgauss.utils.star_columns import plain_values

__all__ = ['read']

# Which kinds of position there are, the best first.
_KINDS = ('WIN', 'PSF', 'MODEL', '')
_FLUXES = ('PSF', 'AUTO', 'MODEL', 'BEST', 'ISOCOR', 'ISO', 'APER')
_OBJECTS = 'LDAC_OBJECTS'
_START = (b'SIMPLE', b'\x1f\x8b', b'BZh', b'PK\x03\x04', b'\xfd7zX')


def read(file, *, ext=None, fwhm=None):
    """
    Read a catalogue of SExtractor.

    Parameters
    ----------
    file : str or path-like
    ext : int, optional
        Which of the chips of a FITS catalogue is read, from 0; by default
        all, with a column ``chip``, if there are several.
    fwhm : float, optional
        Of a star [pix], if there are no errors of positions; by default the
        median of ``FWHM_IMAGE``, or of twice ``FLUX_RADIUS``.

    Returns
    -------
    `~astropy.table.QTable`
    """
    with Path(file).open('rb') as stream:
        start = stream.read(6)
    table = (_read_fits(file, ext) if start.startswith(_START)
             else _read_text(file))
    stars, used = _stars(file, table)
    fwhm = _width(table) if fwhm is None else fwhm
    others = table[[name for name in table.colnames if name not in used]]
    if 'NUMBER' in others.colnames:
        others.rename_column('NUMBER', 'number')
    others.meta.clear()
    return finished(stars, others, origin=1.0, fwhm=fwhm,
                    program='SExtractor')


def _read_text(file):
    lines = lines_of(file)
    stars = [line for line in lines
             if line.strip() and not line.startswith('#')]
    if len(stars) == len(lines):
        msg = (f'{file}: must begin with lines # 1 NUMBER ... as catalogues '
               'of the type ASCII_HEAD')
        raise ValueError(msg)
    if not stars:
        msg = f'{file}: must hold stars, got none'
        raise ValueError(msg)
    width = len(stars[0].split())
    for line in lines:
        word = line.lstrip('# ').partition(' ')[0]
        # Columns are counted up to this number when the file is read.
        if line.startswith('#') and word.isdigit() and int(word) > width:
            msg = (f'{file}: must have {word:.20} columns, as its head says, '
                   f'got {width}')
            raise ValueError(msg)
    return Table.read(lines, format='ascii.sextractor')


def _read_fits(file, ext):
    """Return the objects of one chip, or of all."""
    with open_fits(file, 'a catalogue of SExtractor') as hdus:
        tables = [hdu for hdu in hdus if hdu.name == _OBJECTS] or [
            hdu for hdu in hdus if 'TFIELDS' in hdu.header]
        if not tables or (ext is not None and not (
                isinstance(ext, int) and 0 <= ext < len(tables))):
            msg = (f'{file}: must have the chip ext = {ext or 0}, got '
                   f'{len(tables)} tables of objects')
            raise ValueError(msg)
        if ext is not None:
            return _plain(tables[ext], None)
        several = len(tables) > 1
        return vstack([_plain(hdu, chip if several else None)
                       for chip, hdu in enumerate(tables)],
                      metadata_conflicts='silent')


def _plain(hdu, chip):
    """Return the columns of a table of objects, its images left out."""
    table = Table(hdu.data)
    for name in table.colnames:
        if name.startswith('VIGNET'):
            table.remove_column(name)
    if chip is not None:
        table['chip'] = np.full(len(table), chip)
    return table


def _stars(file, table):
    """Return the columns of the package, and the names used up."""
    kind = next((one for one in _KINDS
                 if {f'X{one}_IMAGE', f'Y{one}_IMAGE'}
                 <= set(table.colnames)), None)
    if kind is None:
        msg = (f'{file}: must have columns X_IMAGE and Y_IMAGE, or XWIN_IMAGE '
               f'and YWIN_IMAGE, got {", ".join(table.colnames)[:200]}')
        raise ValueError(msg)
    used = [f'X{kind}_IMAGE', f'Y{kind}_IMAGE']
    stars = {'x_fit': table[used[0]], 'y_fit': table[used[1]]}
    stars |= _errors(table, kind)
    for flux in _FLUXES:
        if f'FLUX_{flux}' in table.colnames and 'flux_fit' not in stars:
            stars |= _of_kind(table, 'flux', flux)
        if f'MAG_{flux}' in table.colnames and 'mag' not in stars:
            stars |= _of_kind(table, 'mag', flux)
    return stars, used


def _width(table):
    """Return the median width of the objects [pix], None if not known."""
    for name, times in (('FWHM_IMAGE', 1), ('FLUX_RADIUS', 2)):
        if name in table.colnames:
            width = plain_values(table[name])
            width = width[(width > 0) & np.isfinite(width)]
            if width.size:
                return times * float(np.median(width))
    return None


def _of_kind(table, what, kind):
    """Return flux or magnitude and its error, of the first aperture."""
    name = 'flux_fit' if what == 'flux' else 'mag'
    out = {name: _first(table[f'{what.upper()}_{kind}'])}
    error = f'{what.upper()}ERR_{kind}'
    if error in table.colnames:
        out[f'{what}_err'] = _first(table[error])
    if what == 'mag':  # 99 says that there is none.
        out = {key: np.where(out['mag'] < 90, one, np.nan)
               for key, one in out.items()}
    return out


def _first(column):
    values = plain_values(column)
    return values.reshape(len(values), -1)[:, 0] if len(values) else values


def _errors(table, kind):
    """Return the errors of positions, from variances or an ellipse."""
    def get(name):
        full = f'ERR{name}{kind}_IMAGE'
        return plain_values(table[full]) if full in table.colnames else None
    xx, yy, xy = get('X2'), get('Y2'), get('XY')
    if xx is None or yy is None:
        a, b, theta = get('A'), get('B'), get('THETA')
        if a is None or b is None:
            return {}
        angle = np.radians(0.0 if theta is None else theta)
        cosine, sine = np.cos(angle), np.sin(angle)
        xx = (a * cosine)**2 + (b * sine)**2
        yy = (a * sine)**2 + (b * cosine)**2
        xy = (a**2 - b**2) * cosine * sine
    with np.errstate(invalid='ignore'):
        out = {'x_err': np.sqrt(xx), 'y_err': np.sqrt(yy)}
    return out if xy is None else out | {'xy_cov': xy}
