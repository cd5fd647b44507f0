"""DAOPHOT as IRAF has it, run for real where it is installed."""
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from peers import AbsentError, program

# Of so many stars DAOPHOT makes its PSF: with more than a thousand on a whole
# detector it takes more than twenty minutes.
_MOST_STARS = 200
# Stars are found, measured, fitted and subtracted; what is found in the rest
# joins them, and all are fitted again.
_SCRIPT = """\
noao
digiphot
daophot
daophot.verify = no
daophot.update = no
daophot.verbose = no
datapars.epadu = 1
datapars.readnoise = {noise}
datapars.sigma = {sigma}
datapars.fwhmpsf = 1.9
datapars.datamin = -500
datapars.datamax = 85000
centerpars.calgorithm = "none"
fitskypars.salgorithm = "mode"
fitskypars.annulus = 8
fitskypars.dannulus = 6
photpars.apertures = "2.5"
photpars.zmag = 25
findpars.threshold = 4
daopars.function = "auto"
daopars.varorder = {order}
daopars.psfrad = 10
daopars.fitrad = 2.5
daopars.recenter = yes
daopars.fitsky = no
daopars.sannulus = 3
daopars.wsannulus = 8
daopars.proferr = 1
daopars.flaterr = 0.3
phot ("stars.fits", coords="stars.coo", output="stars.mag", interactive=no)
pstselect ("stars.fits", "stars.mag", "stars.pst", {count}, psfrad=10, \\
    interactive=no)
psf ("stars.fits", "stars.mag", "stars.pst", "psf.fits", "psf.pst", \\
    "psf.psg", interactive=no, showplots=no)
datapars.sigma = {crowd_sigma}
daofind ("image.fits", "first.coo", interactive=no)
phot ("image.fits", coords="first.coo", output="first.mag", interactive=no)
allstar ("image.fits", "first.mag", "psf.fits", "first.als", "first.arj", \\
    "rest.fits")
daofind ("rest.fits", "more.coo", interactive=no)
phot ("rest.fits", coords="more.coo", output="more.mag", interactive=no)
pfmerge ("first.als,more.mag", "all.mag")
allstar ("image.fits", "all.mag", "psf.fits", "all.als", "all.arj", "end.fits")
logout
"""


def daophot(scene, sparse, stars, degree):
    """
    Run DAOPHOT: a PSF from one exposure, all stars of another.

    Parameters
    ----------
    scene, sparse : Scene
        The crowded exposure, and that of the PSF.
    stars : `~astropy.table.Table`
        The stars that make the PSF, with ``x`` and ``y`` [pix].
    degree : int
        Of the polynomial of the PSF; above 2 it is 2, the largest there.

    Returns
    -------
    `~astropy.table.Table`
        ``x``, ``y`` [pix], ``flux`` [electron].

    Raises
    ------
    AbsentError
        If it is not installed, or does not end with a list.
    """
    command = program('DAOPHOT', 'irafcl')
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, one in (('image', scene), ('stars', sparse)):
            # Below what it takes for good: DAOPHOT has no masks.
            image = np.where(one.mask, -1e4, one.image).astype('f4')
            fits.writeto(folder / f'{file}.fits', image)
        np.savetxt(folder / 'stars.coo', 1 + np.column_stack(
            [stars['x'], stars['y']]), '%.3f')
        (folder / 'run.cl').write_text(_SCRIPT.format(
            noise=np.sqrt(scene.instrument.readout_variance),
            sigma=np.median(sparse.error), crowd_sigma=np.median(scene.error),
            order=min(degree, 2), count=min(len(stars), _MOST_STARS)))
        done = subprocess.run(
            [command, '-f', 'run.cl'], cwd=folder, text=True, check=False,
            capture_output=True, stdin=subprocess.DEVNULL,
            env=os.environ | {'HOME': name, 'TMPDIR': name, 'TERM': 'vt100'})
        if not (folder / 'all.als').exists():
            said = ' '.join((done.stdout + done.stderr).split())
            msg = f'DAOPHOT ended with: {said[-300:]}'
            raise AbsentError(msg)
        found = Table.read(folder / 'all.als', format='ascii.daophot')
    return Table({'x': np.asarray(found['XCENTER'], float) - 1,
                  'y': np.asarray(found['YCENTER'], float) - 1,
                  'flux': 10**(-0.4 * (np.asarray(found['MAG']) - 25))})
