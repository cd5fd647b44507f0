"""PSFEx models: the names of real ones, and small ones written by hand."""
import numpy as np
from astropy.io import fits

MODELS = ('DECam_00154912_12_psfcat.psf',
          'DECam_00241238_01_psfex_samp0.5_deg2.psf')


def write_model(path, planes, *, contexts=(), degrees=(), **cards):
    """Write a PSFEx model; contexts are (name, group, zero, scale)."""
    planes = np.asarray(planes, np.float32)
    column = fits.Column('PSF_MASK', f'{planes.size}E', dim=str(
        planes.shape[::-1]), array=planes[None])
    table = fits.BinTableHDU.from_columns([column], name='PSF_DATA')
    table.header.update(POLNAXIS=len(contexts), POLNGRP=len(degrees),
                        PSF_SAMP=0.8, PSFNAXIS=planes.ndim)
    for i, n in enumerate(planes.shape[::-1], 1):
        table.header[f'PSFAXIS{i}'] = n
    for v, values in enumerate(contexts, 1):
        for key, value in zip(('NAME', 'GRP', 'ZERO', 'SCAL'), values,
                              strict=True):
            table.header[f'POL{key}{v}'] = value
    for g, degree in enumerate(degrees, 1):
        table.header[f'POLDEG{g}'] = degree
    for key, value in cards.items():
        if value is None:
            table.header.remove(key)
        else:
            table.header[key] = value
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path)
    return path


X = ('X_IMAGE', 1, 100.0, 200.0)
Y = ('Y_IMAGE', 1, 50.0, 80.0)
