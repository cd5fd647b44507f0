"""What is simulated, and how much of it: three sizes of a run."""
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from photutils_mgauss import DetectorEffects

# The paper's stamp, 1.1 arcsec across, in pixels of 0.074 arcsec (Sec. 2.2).
PIXEL = 0.074
STAMP_RADIUS = 0.55 / PIXEL

# The pixels of a detector (Sec. 5).
DETECTOR = (9232, 9216)

# The point sources of all pointings on one detector, from 1523 in 2.17 square
# degrees seen in 135 pointings, and the share of stars (Sec. 2.1.2 and 4.1).
POINT_SOURCES = round(1523 / 2.17 * 135 * DETECTOR[0] * DETECTOR[1]
                      * (PIXEL / 3600)**2)
STARS = 614 / (614 + 590)

# The bands of the imaging detectors. Table 2 prints those of 7, 8, 9, 22, 23
# and 24. The others are those of the survey camera of the CSST as its
# simulation software numbers them: four in NUV and y, two in each other band.
BANDS = {6: 'y', 7: 'i', 8: 'g', 9: 'r', 11: 'z', 12: 'NUV', 13: 'NUV',
         14: 'u', 15: 'y', 16: 'y', 17: 'u', 18: 'NUV', 19: 'NUV', 20: 'z',
         22: 'r', 23: 'g', 24: 'i', 25: 'y'}
TABLE_2_DETECTORS = (7, 8, 9, 22, 23, 24)

# Which exposures of Table 2 make a campaign of 2 to 7 observations: those
# that are nearest to equal intervals of time (Sec. 4.3).
CAMPAIGNS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 1, 3, 6), 5: (0, 1, 3, 5, 6),
             6: (0, 1, 2, 3, 5, 6), 7: (0, 1, 2, 3, 4, 5, 6)}


def place_of(number):
    """
    Return the row and column of a detector on the focal plane.

    The survey camera has five rows and six columns of detectors, numbered
    down the columns from the last one to the first.
    """
    return (number - 1) % 5, 5 - (number - 1) // 5


@dataclass(frozen=True)
class Settings:
    """
    The sizes of a run.

    Attributes
    ----------
    name : str
        'quick', 'half' or 'full'.
    detectors : tuple of int
        The detectors of Figs. 4 to 7.
    shape, sky_shape, crowded_shape : (ny, nx) tuple of int
        Of the images of Figs. 1 to 7, 8 to 12, and 13 to 14 [pix].
    spacing : int or None
        One star falls on so many pixels along each axis of the exposures
        that PSFs are made of [pix]; None for the point sources of the paper,
        of all its pointings, at random places.
    grid : int
        Places along each side of a detector in Figs. 4 to 7.
    degree : int
        Of the polynomials of the PSF.
    psf_stars : int
        At most so many stars make a PSF.
    sources : (int, int)
        Stars and quasars of Figs. 8 to 12.
    references : int
        How many of the quasars tie the epochs.
    resamplings : int
        Of the bootstraps.
    draws : int
        Of each of two chains, after as many steps of tuning.
    optics : (int, int)
        Places along each side that GalSim draws, and nodes of the true PSF.
    """

    name: str
    detectors: tuple
    shape: tuple
    sky_shape: tuple
    crowded_shape: tuple
    spacing: int | None
    grid: int
    degree: int
    psf_stars: int
    sources: tuple
    references: int
    resamplings: int
    draws: int
    optics: tuple

    def of(self, step):
        """Return what a step is told, in words that are the same again."""
        told = ', '.join(f'{key}={getattr(self, key)!r}'
                         for key in TOLD[step])
        return f'size {self.name}: {told}'

    @property
    def psf_sources(self):
        """The stars on an exposure that PSFs are made of."""
        if self.spacing is None:
            return POINT_SOURCES
        return int(np.prod([n // self.spacing for n in self.shape]))


# What the steps are told. A table is measured again where one of these is
# another.
_PSF = ('spacing', 'degree', 'psf_stars', 'optics')
TOLD = {
    'none': (), 'tables': (), 'psf': ('shape', *_PSF),
    'posterior': ('shape', *_PSF, 'draws'),
    'maps': ('shape', *_PSF, 'grid', 'detectors'),
    'sky': ('sky_shape', *_PSF, 'grid', 'sources', 'references',
            'resamplings'),
    'crowded': ('crowded_shape', 'sky_shape', *_PSF, 'grid')}

QUICK = Settings(
    name='quick', detectors=(8, 12), shape=(384, 384), sky_shape=(384, 384),
    crowded_shape=(160, 160), spacing=40, grid=4, degree=1, psf_stars=60,
    sources=(60, 60), references=30, resamplings=500, draws=100,
    optics=(2, 2))

HALF = Settings(
    name='half', detectors=(6, 7, 8, 9, 11, 12, 14, 22, 23, 24),
    shape=(512, 512), sky_shape=(512, 512),
    crowded_shape=(256, 256), spacing=36, grid=8, degree=2, psf_stars=150,
    sources=(160, 150), references=60, resamplings=2000, draws=300,
    optics=(3, 3))

FULL = Settings(
    name='full', detectors=tuple(BANDS), shape=DETECTOR, sky_shape=DETECTOR,
    crowded_shape=(2308, 2304), spacing=None, grid=30, degree=3,
    psf_stars=1500, sources=(614, 590), references=100, resamplings=10000,
    draws=1000, optics=(8, 11))

SIZES = {one.name: one for one in (QUICK, HALF, FULL)}


def optics():
    """Return how the true PSF is made: 'galsim' where it is installed."""
    return 'galsim' if find_spec('galsim') else 'mixtures'


def effects():
    """Return what all detectors do; charge repels where galsim is there."""
    return DetectorEffects(**vars(DetectorEffects.typical()) | {
        'brighter_fatter': float(find_spec('galsim') is not None)})
