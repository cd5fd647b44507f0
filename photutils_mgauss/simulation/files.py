"""
Scenes as files, in the two ways pipelines write them.

``'extensions'`` is one FITS file with the extensions SCI, ERR and DQ
[electron]. ``'csst'`` is three: the image [electron / s], ``_flg`` with the
bits of bad pixels and ``_wht`` with the inverse variance, zero where a pixel
is bad [(electron / s)^-2]. Beside them are the truth (``_truth.ecsv``) and
the WCS (``_wcs.asdf``).
"""
from pathlib import Path

import asdf
import astropy.units as u
import numpy as np
from astropy.io import fits

from photutils_mgauss.files.whole import whole_file
from photutils_mgauss.utils.validation import as_choice


def write_scene(scene, path, layout, overwrite):
    """Write a scene to files that begin with ``path``; return their paths."""
    as_choice(layout, 'layout', ('extensions', 'csst'))
    path = Path(path)
    stem = path.with_suffix('') if path.suffix == '.fits' else path
    images = _extensions(scene) if layout == 'extensions' else _csst(scene)
    paths = [_beside(stem, ending) for ending in
             (*images, '_truth.ecsv', '_wcs.asdf')]
    existing = [str(p) for p in paths if p.exists()]
    if existing and not overwrite:
        msg = (f'path must be free unless overwrite is set, got '
               f'{existing[0]}, which exists')
        raise FileExistsError(msg)
    for file, hdus in zip(paths, images.values(), strict=False):
        with whole_file(file) as draft:
            fits.HDUList(hdus).writeto(draft)
    truth = scene.truth.copy()
    truth['flux'] = truth['flux'].value * u.electron
    with whole_file(paths[-2]) as draft:
        truth.write(draft)
    with whole_file(paths[-1]) as draft:
        asdf.AsdfFile({'wcs': scene.wcs}).write_to(draft)
    return paths


def _beside(stem, ending):
    return stem.with_name(stem.name + ending)


def _extensions(scene):
    header = _header(scene, 'electron')
    return {'.fits': [
        fits.PrimaryHDU(header=header),
        fits.ImageHDU(scene.image, header, 'SCI'),
        fits.ImageHDU(scene.error, header, 'ERR'),
        fits.ImageHDU(scene.flags, _header(scene), 'DQ')]}


def _csst(scene):
    time = np.float32(scene.instrument.exposure_time)
    weight = np.where(scene.mask, 0, (time / scene.error)**2)
    header = _header(scene, 'electron / s', 1 / scene.instrument.exposure_time)
    return {
        '.fits': [fits.PrimaryHDU(scene.image / time, header)],
        '_flg.fits': [fits.PrimaryHDU(scene.flags, _header(scene))],
        '_wht.fits': [fits.PrimaryHDU(weight.astype(np.float32),
                                      _header(scene, 's2 / electron2'))]}


def _header(scene, unit=None, scale=1.0):
    """Return the header, with the WCS as TAN-SIP."""
    camera, exposure = scene.instrument, scene.exposure
    header = exposure.fits_header(camera.shape, camera.pixel_scale)
    if unit is not None:
        header['BUNIT'] = unit
    for key, value, comment in (
            ('FILTER', exposure.band.name, 'band'),
            ('DETECTOR', exposure.detector, 'number of the detector'),
            ('DATE-AVG', scene.time.isot, 'middle of the exposure'),
            ('MJD-AVG', scene.time.mjd, 'middle of the exposure'),
            ('TIMESYS', 'TDB', 'time scale'),
            ('EXPTIME', camera.exposure_time, '[s] exposure time'),
            ('ZEROPNT', exposure.band.zeropoint, 'AB mag of 1 electron/s'),
            ('RDNOISE', camera.read_noise, '[electron] read noise'),
            ('GAIN', camera.gain, '[electron/count] of the raw image'),
            ('SATURATE', camera.full_well * scale, 'full well'),
            ('BACKGRND', scene.background * scale, 'sky in a pixel')):
        header[key] = value, comment
    return header
