"""PSF files of any kind to a grid of mixtures, and grids to files."""
import json
from io import BytesIO
from pathlib import Path

from astropy.io import fits

from photutils_mgauss.files.epsfs import psf_kind
from photutils_mgauss.files.fits_files import open_fits
from photutils_mgauss.files.image_layers import is_asdf, read_asdf_tree
from photutils_mgauss.psf.gridded import GriddedMixturePSF

__all__ = ['psf_kind', 'psf_record', 'read_psf', 'write_psf']


def read_psf(path, **kwargs):
    """
    Read a PSF file as one grid of mixtures.

    Parameters
    ----------
    path : str or path-like
        The file.
    **kwargs
        As of `GriddedMixturePSF.from_file`.

    Returns
    -------
    GriddedMixturePSF

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, holds no PSF, or several of which none
        was chosen.
    """
    if 'all' in (kwargs.get('ext'), kwargs.get('detector')):
        msg = f'{path}: --ext and --detector must name one PSF, got all'
        raise ValueError(msg)
    return GriddedMixturePSF.from_file(path, **kwargs)


def write_psf(psf, path, record):
    """
    Write a grid with the record of the run that made it.

    Parameters
    ----------
    psf : GriddedMixturePSF
        The grid.
    path : `~pathlib.Path`
        A free name that ends with ``.fits`` or ``.asdf``.
    record : dict
        What JSON can hold.
    """
    if path.suffix == '.asdf':
        import asdf

        from photutils_mgauss.files.asdf_extension import enabled
        with enabled():
            asdf.AsdfFile({'psf': psf, 'mgauss': record}).write_to(path)
        return
    plain = BytesIO()
    psf.write(plain, format='fits')
    with fits.open(BytesIO(plain.getvalue())) as hdus:
        hdus[0].header['MGRUN'] = json.dumps(record)
        hdus.writeto(path, checksum=True)


def psf_record(path):
    """Return the record of the run that made a PSF file, or {}."""
    path = Path(path)
    if is_asdf(path):
        record = dict(read_asdf_tree(path).get('mgauss', {}))
    else:
        with open_fits(path, 'an undamaged PSF file') as hdus:
            record = json.loads(hdus[0].header.get('MGRUN', '{}'))
    return json.loads(json.dumps(record))
