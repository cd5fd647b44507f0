"""Other programs on a crowded scene: lists of x, y, flux, and CPU seconds."""
import os
import resource
import shutil
import subprocess
import sys
import time
import warnings
from functools import cache
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.spatial import cKDTree

SEXTRACTOR = shutil.which('source-extractor') or shutil.which('sex')
PSFEX = shutil.which('psfex')
IRAF = shutil.which('irafcl')
COLUMNS = ('X_IMAGE Y_IMAGE XWIN_IMAGE YWIN_IMAGE FLUX_APER(2) '
           'FLUXERR_APER(2) FLUX_RADIUS SNR_WIN ELONGATION FLAGS')
PSF_COLUMNS = 'XPSF_IMAGE YPSF_IMAGE FLUX_PSF FLUXERR_PSF'
OPTIONS = {
    'CATALOG_TYPE': 'FITS_LDAC', 'PARAMETERS_NAME': 'columns',
    'DETECT_MINAREA': 3, 'DETECT_THRESH': 2, 'ANALYSIS_THRESH': 2,
    'DEBLEND_NTHRESH': 64, 'DEBLEND_MINCONT': 0, 'FILTER': 'N', 'CLEAN': 'N',
    'PHOT_APERTURES': '5,31', 'SATUR_LEVEL': 88000, 'GAIN': 1,
    'PIXEL_SCALE': 1, 'SEEING_FWHM': 1.7, 'BACK_SIZE': 64,
    'MEMORY_OBJSTACK': 60000, 'MEMORY_PIXSTACK': 6000000,
    'MEMORY_BUFSIZE': 4096, 'VERBOSE_TYPE': 'QUIET', 'NTHREADS': 1}


def children_seconds():
    """Return the CPU seconds of finished child processes."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def timed(function, *args, **kwargs):
    """Return what a function gives, and CPU seconds with its children."""
    start = time.process_time() + children_seconds()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        result = function(*args, **kwargs)
    return result, time.process_time() + children_seconds() - start


def run(program, folder, *, timeout=1200, **kwargs):
    """Run a program; its output goes to a file in the folder."""
    with (folder / 'log').open('a') as log:
        subprocess.run(program, cwd=folder, check=True, stdout=log,
                       stderr=log, timeout=timeout, **kwargs)


# SExtractor, with PSFEx.

def _extract(data, folder, columns, **options):
    fits.writeto(folder / 'sci.fits', data.astype('f4'), overwrite=True)
    (folder / 'columns').write_text('\n'.join(columns.split()) + '\n')
    options = {**OPTIONS, **options}
    words = [w for k, v in options.items() for w in (f'-{k}', str(v))]
    (folder / 'empty').write_text('')
    run([SEXTRACTOR, 'sci.fits', '-c', 'empty', '-CATALOG_NAME', 'cat.fits',
         *words], folder)
    return Table(fits.getdata(folder / 'cat.fits', 2))


def psfex_model(scene, folder, shift):
    """
    Make a PSFEx model of a sparse scene, its positions shifted.

    Returns
    -------
    `~pathlib.Path`
    """
    folder.mkdir(parents=True, exist_ok=True)
    _extract(scene.images['sci'], folder, COLUMNS + ' VIGNET(35,35)',
             DETECT_THRESH=5, ANALYSIS_THRESH=5)
    words = {'PSF_SAMPLING': 0.5, 'PSF_SIZE': '65,65', 'PSFVAR_DEGREES': 3,
             'CENTER_KEYS': 'XWIN_IMAGE,YWIN_IMAGE', 'PSF_RECENTER': 'Y',
             'PSFVAR_KEYS': 'X_IMAGE,Y_IMAGE', 'PSFVAR_GROUPS': '1,1',
             'SAMPLE_FWHMRANGE': '1.0,4.0', 'SAMPLE_VARIABILITY': 0.5,
             'SAMPLE_MINSN': 80, 'SAMPLE_MAXELLIP': 0.4,
             'PHOTFLUX_KEY': 'FLUX_APER(2)',
             'PHOTFLUXERR_KEY': 'FLUXERR_APER(2)', 'PSF_ACCURACY': 0.005,
             'CHECKPLOT_DEV': 'NULL', 'CHECKIMAGE_TYPE': 'NONE',
             'WRITE_XML': 'N', 'NTHREADS': 1}
    (folder / 'empty').write_text('')
    run([PSFEX, 'cat.fits', '-c', 'empty',
         *(w for k, v in words.items() for w in (f'-{k}', str(v)))], folder)
    path = folder / 'cat.psf'
    with fits.open(path, mode='update') as model:
        for axis in (1, 2):
            model[1].header[f'POLZERO{axis}'] += float(shift[axis - 1])
    return path


def sextractor(data, folder, model=None):
    """Return the lists of SExtractor by the names of their positions."""
    folder.mkdir(parents=True, exist_ok=True)
    found, seconds = timed(_extract, data, folder, COLUMNS)
    aperture = np.asarray(found['FLUX_APER'])[:, 0].astype(float)
    lists = {f'SExtractor {name}': (
        _plain(found[f'X{key}_IMAGE'] - 1.0, found[f'Y{key}_IMAGE'] - 1.0,
               aperture), seconds)
        for name, key in (('ISO', ''), ('WIN', 'WIN'))}
    if model is not None:
        found, seconds = timed(_extract, data, folder,
                               COLUMNS + ' ' + PSF_COLUMNS,
                               PSF_NAME=Path(model).resolve())
        lists['SExtractor PSF'] = (
            _plain(found['XPSF_IMAGE'] - 1.0, found['YPSF_IMAGE'] - 1.0,
                   found['FLUX_PSF']), seconds)
    return lists


def _plain(x, y, flux, **more):
    table = Table({'x': x, 'y': y, 'flux': flux, **more})
    table = Table({name: np.asarray(table[name], float)
                   for name in table.colnames})
    good = (np.isfinite(table['x']) & np.isfinite(table['y'])
            & (table['flux'] > 0))
    return table[good]


# crowdsource.

def crowdsource(interpreter, scene, psf, folder, sky):
    """Run crowdsource in its own interpreter; seconds are of the fit."""
    folder.mkdir(parents=True, exist_ok=True)
    images = scene.images
    np.savez(folder / 'in.npz', data=images['sci'] - sky,
             error=images['err'], mask=images['mask'],
             weights=[m.weights for m in psf.mixtures],
             means=[m.means for m in psf.mixtures],
             covariances=[m.covariances for m in psf.mixtures],
             grid=psf.grid_xypos)
    home = Path(__file__).resolve().parents[2]
    environment = {**os.environ, 'PYTHONPATH': str(home)}
    run([interpreter, Path(__file__).with_name('run_crowdsource.py'),
         'in.npz', 'out.npz'], folder, env=environment, timeout=3600)
    out = np.load(folder / 'out.npz')
    table = _plain(**{c: out[c] for c in ('x', 'y', 'flux', 'flux_err')})
    return table, float(out['seconds'])


# photutils.

@cache
def _gridded(psf):
    return psf.to_gridded_psf(4, radius=15)


def photutils_list(scene, psf, sky, start):
    """Fit given positions one by one with PSFPhotometry."""
    from photutils.psf import PSFPhotometry
    init = Table({c: start[c] for c in ('x', 'y', 'flux')})
    phot = PSFPhotometry(_gridded(psf), (7, 7), xy_bounds=1.0,
                         aperture_radius=2.5)
    return _fitted(phot(scene.images['sci'] - sky, error=scene.images['err'],
                        mask=scene.images['mask'], init_params=init))


def photutils_iterative(scene, psf, sky):
    """Find and fit with IterativePSFPhotometry."""
    from photutils.detection import DAOStarFinder
    from photutils.psf import IterativePSFPhotometry, SourceGrouper
    noise = np.median(scene.images['err'])
    phot = IterativePSFPhotometry(
        _gridded(psf), (7, 7), finder=DAOStarFinder(4 * noise, 1.75),
        grouper=SourceGrouper(2.0), xy_bounds=1.0, aperture_radius=2.5,
        maxiters=3, mode='new', sub_shape=(31, 31))
    return _fitted(phot(scene.images['sci'] - sky, error=scene.images['err'],
                        mask=scene.images['mask']))


def _fitted(result):
    return _plain(result['x_fit'], result['y_fit'], result['flux_fit'],
                  x_err=result['x_err'], y_err=result['y_err'],
                  flux_err=result['flux_err'])


# DAOPHOT.

SCRIPT = """set imtype = "fits"
noao
digiphot
daophot
datapars.fwhmpsf = 1.75
datapars.sigma = {noise:.3f}
datapars.readnoise = 5
datapars.epadu = 1
datapars.datamin = -100
datapars.datamax = 85000
datapars.noise = "poisson"
centerpars.calgorithm = "none"
fitskypars.salgorithm = "constant"
fitskypars.skyvalue = {sky:.3f}
photpars.apertures = "2.5"
photpars.zmag = 25
daopars.function = "auto"
daopars.varorder = 2
daopars.psfrad = 11
daopars.fitrad = 1.9
daopars.recenter = yes
daopars.fitsky = yes
daopars.groupsky = yes
daopars.sannulus = 4
daopars.wsannulus = 8
daopars.maxgroup = 60
daopars.maxnstar = 50000
phot ("im.fits", coords="all", output="m", interactive=no, verify=no, \
update=no, verbose=no)
phot ("im.fits", coords="psf", output="p", interactive=no, verify=no, \
update=no, verbose=no)
psf ("im.fits", photfile="m", pstfile="p", psfimage="psf.fits", \
opstfile="o", groupfile="g", interactive=no, verify=no, update=no, \
verbose=no, showplots=no, matchbyid=no)
allstar ("im.fits", photfile="m", psfimage="psf.fits", allstarfile="als", \
rejfile="rej", subimage="sub.fits", verify=no, update=no, verbose=no)
txdump ("als", "XCENTER,YCENTER,MAG", "yes", headers=no, > "answer")
logout
"""


def daophot(scene, folder, sky, start, n_psf=80):
    """Measure given positions with ALLSTAR, its PSF from the same image."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    images = scene.images
    fits.writeto(folder / 'im.fits', images['sci'].astype('f4'))
    position = np.column_stack([start['x'], start['y']])
    np.savetxt(folder / 'all', position + 1, fmt='%.4f')
    best = _isolated(images, position, np.asarray(start['flux']))[:n_psf]
    np.savetxt(folder / 'psf', position[best] + 1, fmt='%.4f')
    script = SCRIPT.format(noise=np.median(images['err']), sky=sky)
    environment = {**os.environ, 'USER': os.environ.get('USER', 'user')}
    run([IRAF], folder, input=script.encode(), env=environment, timeout=560)
    rows = [line.split() for line in (folder / 'answer').open()]
    x, y, magnitude = np.array([r for r in rows if 'INDEF' not in r],
                               float).T
    return _plain(x - 1, y - 1, 10**(0.4 * (25 - magnitude)))


def _isolated(images, position, flux):
    """Return the rows of bright stars, those with least company first."""
    n = len(images['sci'])
    row, column = np.rint(position[:, ::-1]).astype(int).clip(0, n - 1).T
    good = ((flux > np.percentile(flux, 60)) & ~images['mask'][row, column]
            & (images['sci'][row, column] < 6e4)
            & (position > 16).all(axis=1) & (position < n - 17).all(axis=1))
    near = cKDTree(position).query_ball_point(position[good], 7)
    alone = np.array([flux[i].sum() for i in near]) / flux[good] - 1
    rank = np.log(flux[good]) - 3 * alone
    return np.flatnonzero(good)[np.argsort(-rank)]


def report_missing(crowdsource_interpreter):
    """Say which programs are not there."""
    for name, program in (('SExtractor', SEXTRACTOR), ('PSFEx', PSFEX),
                          ('IRAF', IRAF),
                          ('crowdsource', crowdsource_interpreter)):
        if not program:
            print(f'{name} is not installed and left out', file=sys.stderr)
