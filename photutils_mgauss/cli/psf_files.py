"""PSF files of any kind to a grid of mixtures, and grids to files."""
import json
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from photutils.psf import GriddedPSFModel, ImagePSF, STDPSFGrid

from photutils_mgauss.field.mixture_field import MixtureField
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.model import MultiGaussianPSFModel

__all__ = ['psf_kind', 'psf_record', 'read_psf', 'write_psf']

_CLASSES = {cls.__name__: cls for cls in (
    GriddedMixturePSF, MixtureField, GaussianMixture, MultiGaussianPSFModel)}


def psf_kind(path):
    """
    Return what a file holds.

    Returns
    -------
    str
        'mixtures' (a file of this package), 'psfex', 'stdpsf', 'stpsf',
        'epsf' (an oversampled image), or 'image' for anything else.

    Raises
    ------
    OSError
        If there is no such file.
    """
    path = Path(path)
    with path.open('rb') as file:
        start = file.read(6)
    if start[:5] == b'#ASDF':
        return 'mixtures' if _class_in_asdf(path) else 'image'
    if path.suffix == '.psf':
        return 'psfex'
    return _fits_kind(path) if start == b'SIMPLE' else 'image'


def _fits_kind(path):
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', AstropyUserWarning)
        with fits.open(path, ignore_missing_end=True) as hdus:
            headers = [hdu.header.copy() for hdu in hdus]
    first = headers[0]
    marks = (('mixtures', 'MGCLASS' in first),
             ('psfex', any('PSF_SAMP' in header for header in headers)),
             ('stdpsf', 'NXPSFS' in first),
             ('stpsf', 'OVERSAMP' in first and 'DET_YX0' in first),
             ('epsf', 'OVERSAMP' in first))
    return next((kind for kind, applies in marks if applies), 'image')


def _class_in_asdf(path):
    """Return the name of the class of ours that an ASDF file holds."""
    import asdf
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        with asdf.open(path) as opened:
            names = [type(value).__name__ for value in opened.tree.values()]
    return next((name for name in names if name in _CLASSES), None)


def read_psf(path, *, n_components=3, grid_shape=(30, 30), radius=None,
             detector=None, oversampling=None, checkpoint=None):
    """
    Read a PSF file as a grid of mixtures.

    Parameters
    ----------
    path : str or path-like
        A file of this package (a grid, a field, a mixture), a PSFEx model, a
        grid of ePSFs as STDPSF or STPSF write it, or an image of one ePSF.
    n_components : int, optional
        The number of Gaussians fitted to images.
    grid_shape : int or (ny, nx) tuple of int, optional
        The number of nodes for models that are no grid.
    radius : float, optional
        How far ePSFs are fitted [pix].
    detector : int, optional
        Which detector of an STDPSF file.
    oversampling : int, optional
        Of an image of one ePSF, if its header has no OVERSAMP.
    checkpoint : str or path-like, optional
        A folder in which finished fits are kept, and looked for.

    Returns
    -------
    GriddedMixturePSF

    Raises
    ------
    OSError, ValueError
        If the file cannot be read or holds no PSF.
    """
    kind = psf_kind(path)
    if kind == 'image' and oversampling is not None:
        kind = 'epsf'
    fit = {'n_components': n_components, 'radius': radius,
           'checkpoint': checkpoint}
    if kind == 'mixtures':
        return _own(path, grid_shape)
    if kind == 'psfex':
        return GriddedMixturePSF.from_psfex(path, grid_shape=grid_shape,
                                            **fit)
    if kind in ('stdpsf', 'stpsf'):
        return GriddedMixturePSF.from_gridded_psf(
            _epsf_grid(path, kind, detector), **fit)
    if kind == 'epsf':
        return GriddedMixturePSF.from_image_psf(
            _image_psf(path, oversampling), **fit)
    msg = (f'{path}: must hold a PSF: a file of mgauss psf, a PSFEx model, a '
           'grid of ePSFs, or an image with the keyword OVERSAMP')
    raise ValueError(msg)


def _own(path, grid_shape):
    """Return what a file of this package holds, as a grid."""
    name = _class_in_asdf(path) if _is_asdf(path) else (
        fits.getheader(path)['MGCLASS'])
    if name not in _CLASSES:
        msg = f'{path}: must hold a PSF, got a {name}'
        raise ValueError(msg)
    stored = _CLASSES[name].read(path)
    if isinstance(stored, GriddedMixturePSF):
        return stored
    if isinstance(stored, MixtureField):
        return stored.to_grid(grid_shape)
    integrated = getattr(stored, 'pixel_integrated', False)
    mixture = getattr(stored, 'mixture', stored)
    return GriddedMixturePSF([mixture], [(0, 0)], pixel_integrated=integrated)


def _is_asdf(path):
    with Path(path).open('rb') as file:
        return file.read(5) == b'#ASDF'


def _epsf_grid(path, kind, detector):
    if kind == 'stpsf':
        return GriddedPSFModel.read(path, format='webbpsf')
    if detector is None:
        return STDPSFGrid(path)
    try:
        return GriddedPSFModel.read(path, format='stdpsf',
                                    detector_id=detector)
    except ValueError as error:
        msg = f'{path}: --detector must be one of this file: {error}'
        raise ValueError(msg) from error


def _image_psf(path, oversampling):
    """Return an image of an ePSF in the flux convention of photutils."""
    with fits.open(path) as hdus:
        hdu = next((hdu for hdu in hdus if hdu.is_image
                    and hdu.header.get('NAXIS') == 2), None)
        if hdu is None:
            msg = f'{path}: must hold an image of an ePSF, got none'
            raise ValueError(msg)
        data = np.array(hdu.data, dtype=float)
        found = hdu.header.get('OVERSAMP', hdus[0].header.get('OVERSAMP'))
    oversampling = found if oversampling is None else oversampling
    total = data.sum()
    if not (np.isfinite(total) and total > 0):
        msg = f'{path}: the pixels of an ePSF must have a positive sum'
        raise ValueError(msg)
    return ImagePSF(data / total * oversampling**2, oversampling=oversampling)


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
    if not _is_asdf(path):
        return json.loads(fits.getheader(path).get('MGRUN', '{}'))
    import asdf
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        with asdf.open(path) as opened:
            return json.loads(json.dumps(dict(opened.tree.get('mgauss',
                                                              {}))))
