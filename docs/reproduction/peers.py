"""Other programs, run for real where they are installed."""
import importlib.util
import re
import shutil
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table, vstack

from photutils_mgauss import read_psfex

INSTALL = {
    'SExtractor': 'apt-get install source-extractor',
    'PSFEx': 'apt-get install psfex',
    'sep': 'pip install sep',
    'crowdsource': 'pip install crowdsourcephoto, in an environment of its '
                   'own, then --crowdsource-python',
    'photutils': 'pip install photutils',
    'GalSim': 'pip install galsim',
    'DAOPHOT': 'apt-get install iraf-noao',
    'IRAF': 'apt-get install iraf',
    'DOLPHOT': 'in neither Debian nor PyPI',
}

_COLUMNS = ('X_IMAGE', 'Y_IMAGE', 'XWIN_IMAGE', 'YWIN_IMAGE', 'FLUX_AUTO',
            'FLUX_APER(1)', 'FLUXERR_APER(1)', 'FLUX_RADIUS', 'SNR_WIN',
            'ELONGATION', 'FLAGS')
# Of the parts of an image that crowdsource is given, at most, and by how much
# they reach beyond their own stars [pix].
SIDE, OVERLAP = 640, 20
_FILTER = ('CONV NORM\n1 2 1\n2 4 2\n1 2 1\n')


class AbsentError(RuntimeError):
    """A program is not installed, or does not do its work."""


def absent(name):
    """Return the error that says how to install a program."""
    return AbsentError(f'{name} is not installed ({INSTALL[name]})')


def _require(name, found):
    if not found:
        raise absent(name)


def program(name, *commands):
    """Return the path of the first of the commands that is there."""
    for command in commands:
        if path := shutil.which(command):
            return path
    raise absent(name)


def program_versions(crowdsource_python=None):
    """Return the versions of the programs that are installed."""
    found = {}
    for name, commands in (('SExtractor', ('source-extractor', 'sex')),
                           ('PSFEx', ('psfex',)),
                           ('IRAF', ('irafcl',))):
        try:
            path = program(name, *commands)
        except AbsentError:
            continue
        option = '-v' if name == 'IRAF' else '--version'
        result = subprocess.run([path, option], check=False, text=True,
                                capture_output=True)
        number = re.search(r'[vV](?:ersion )?(\d[\d.]*)',
                           result.stdout + result.stderr)
        found[name] = number[1] if number else 'unknown'
    if number := _crowdsource_version(crowdsource_python):
        found['crowdsource'] = number
    return found


def _crowdsource_version(python):
    code = ('from importlib.metadata import version; '
            "print(version('crowdsourcephoto'))")
    result = subprocess.run([python or sys.executable, '-c', code],
                            check=False, text=True, capture_output=True)
    return result.stdout.strip() if result.returncode == 0 else None


def sextractor(scene, *, psf=None, threshold=1.5, vignettes=None,
               contrast=1e-4):
    """
    Run SExtractor on an image, with weights that are 0 where a pixel is bad.

    With ``vignettes``, a path, write what PSFEx reads.

    Returns a table with the columns of SExtractor, pixels counted from 1.
    """
    command = program('SExtractor', 'source-extractor', 'sex')
    columns = list(_COLUMNS)
    if psf is not None:
        columns += ['XPSF_IMAGE', 'YPSF_IMAGE', 'FLUX_PSF']
    if vignettes is not None:
        columns += ['VIGNET(31,31)']
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fits.writeto(folder / 'image.fits', scene.image.astype('f4'))
        # The noise of the sky alone: SExtractor adds that of stars.
        fits.writeto(folder / 'weight.fits', (~scene.mask).astype('f4'))
        (folder / 'columns').write_text('\n'.join(columns) + '\n')
        (folder / 'filter').write_text(_FILTER)
        options = {
            'CATALOG_NAME': 'out.fits', 'CATALOG_TYPE': 'FITS_LDAC',
            'PARAMETERS_NAME': 'columns', 'FILTER_NAME': 'filter',
            'DETECT_MINAREA': 3, 'DETECT_THRESH': threshold,
            'ANALYSIS_THRESH': threshold, 'DEBLEND_NTHRESH': 64,
            'DEBLEND_MINCONT': contrast, 'CLEAN': 'N', 'GAIN': 1.0,
            'WEIGHT_TYPE': 'MAP_WEIGHT', 'WEIGHT_IMAGE': 'weight.fits',
            'PHOT_APERTURES': 20, 'SATUR_LEVEL': 85000,
            'PIXEL_SCALE': 0.074, 'SEEING_FWHM': 0.14, 'BACK_SIZE': 64,
            'MEMORY_OBJSTACK': 60000, 'MEMORY_PIXSTACK': 6000000,
            'VERBOSE_TYPE': 'QUIET', 'NTHREADS': 1}
        if psf is not None:
            options['PSF_NAME'] = psf
        _call(command, folder, 'image.fits', options)
        if vignettes is not None:
            shutil.copy(folder / 'out.fits', vignettes)
        return Table(fits.getdata(folder / 'out.fits', 2))


def _call(command, folder, target, options):
    words = [str(word) for key, value in options.items()
             for word in (f'-{key}', value)]
    # No file of settings but these: the program's own defaults for the rest.
    (folder / 'none').write_text('')
    done = subprocess.run([command, target, '-c', 'none', *words], text=True,
                          cwd=folder, check=False, capture_output=True)
    if done.returncode:
        msg = f'{Path(command).name} ended with: {done.stderr.strip()[-300:]}'
        raise AbsentError(msg)


def psfex(scene, degree, path):
    """Make a PSFEx model, written to a path, from the stars of a scene."""
    command = program('PSFEx', 'psfex')
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sextractor(scene, vignettes=folder / 'stars.cat')
        _call(command, folder, 'stars.cat', {
            'BASIS_TYPE': 'PIXEL', 'PSF_SAMPLING': 0.5, 'PSF_SIZE': '51,51',
            'PSF_RECENTER': 'Y', 'CENTER_KEYS': 'XWIN_IMAGE,YWIN_IMAGE',
            'PHOTFLUX_KEY': 'FLUX_APER(1)',
            'PHOTFLUXERR_KEY': 'FLUXERR_APER(1)',
            'PSFVAR_KEYS': 'X_IMAGE,Y_IMAGE', 'PSFVAR_GROUPS': '1,1',
            'PSFVAR_DEGREES': degree, 'SAMPLE_MINSN': 80,
            'SAMPLE_FWHMRANGE': '1.0,4.0', 'SAMPLE_VARIABILITY': 0.5,
            'SAMPLE_MAXELLIP': 0.4, 'PSF_SUFFIX': '.psf',
            'CHECKPLOT_DEV': 'NULL', 'CHECKIMAGE_TYPE': 'NONE',
            'WRITE_XML': 'N', 'NTHREADS': 1, 'VERBOSE_TYPE': 'QUIET'})
        shutil.copy(folder / 'stars.psf', path)
    return read_psfex(path)


def windowed(data, x, y):
    """Return the windowed positions of sep, from the same stars."""
    _require('sep', importlib.util.find_spec('sep'))
    import sep
    image = np.ascontiguousarray(data, dtype=float)
    x, y = np.asarray(x, float), np.asarray(y, float)
    x, y, _ = sep.winpos(image, x, y, np.full(len(x), 2 / 2.35))
    flux = sep.sum_circle(image, x, y, 2.5)[0]
    return Table({'x': x, 'y': y, 'flux': flux})


def crowdsource(python, data, error, mask, grid):
    """
    Run crowdsource, in another interpreter, with a grid of mixtures.

    Large images are given in parts that overlap: it needs more than 23 GB
    for one of 2308 x 2304 pixels. Of each part the stars count that are
    nearer to its middle than to that of its neighbours.
    """
    _require('crowdsource', _crowdsource_version(python))
    lists = []
    for rows in _spans(data.shape[0]):
        for columns in _spans(data.shape[1]):
            seen = tuple(slice(max(a - OVERLAP, 0), b + OVERLAP)
                         for a, b in (rows, columns))
            found = _crowdsource(python, data[seen], error[seen], mask[seen],
                                 grid, (seen[1].start, seen[0].start))
            # Beyond the edges of the image are stars of the outer parts.
            own = [(found[name] >= (a - 0.5 if a else -np.inf))
                   & (found[name] < (b - 0.5 if b < n else np.inf))
                   for name, (a, b), n in (('y', rows, data.shape[0]),
                                           ('x', columns, data.shape[1]))]
            lists.append(found[own[0] & own[1]])
    return vstack(lists)


def _spans(length):
    """Return first and last pixel, exclusive, of equal parts of an axis."""
    edges = np.linspace(0, length, -(-length // SIDE) + 1).astype(int)
    return list(pairwise(edges.tolist()))


def _crowdsource(python, data, error, mask, grid, origin):
    """Run crowdsource on a part whose first pixel is at origin, x and y."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mixtures = grid.mixtures
        np.savez(folder / 'in.npz', data=data,
                 places=np.subtract(grid.grid_xypos, origin),
                 weight=np.where(mask, 0, 1 / error),
                 weights=[m.weights for m in mixtures],
                 means=[m.means for m in mixtures],
                 covariances=[m.covariances for m in mixtures])
        script = Path(__file__).with_name('run_crowdsource.py')
        subprocess.run([python or sys.executable, script, folder / 'in.npz',
                        folder / 'out.npz'], check=True, capture_output=True)
        with np.load(folder / 'out.npz') as out:
            return Table({'x': out['x'] + origin[0],
                          'y': out['y'] + origin[1], 'flux': out['flux']})
