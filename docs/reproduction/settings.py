"""What is simulated, and how much of it: three sizes of a run."""
from dataclasses import dataclass
from importlib.util import find_spec

from photutils_mgauss import DetectorEffects

# The paper's stamp, 1.1 arcsec across, in pixels of 0.074 arcsec (Sec. 2.2).
PIXEL = 0.074
STAMP_RADIUS = 0.55 / PIXEL

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
    size, sky_size, crowded_size : int
        Sides of the images of Figs. 1 to 7, 8 to 12, and 13 to 14 [pix].
    spacing : int
        One star falls on so many pixels along each axis of the exposures
        that PSFs are made of [pix].
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
    size: int
    sky_size: int
    crowded_size: int
    spacing: int
    grid: int
    degree: int
    psf_stars: int
    sources: tuple
    references: int
    resamplings: int
    draws: int
    optics: tuple


QUICK = Settings(
    name='quick', detectors=(8, 12), size=384, sky_size=384,
    crowded_size=160, spacing=40, grid=4, degree=1, psf_stars=60,
    sources=(60, 60), references=30, resamplings=500, draws=100,
    optics=(2, 2))

HALF = Settings(
    name='half', detectors=(6, 7, 8, 9, 11, 12, 14, 22, 23, 24),
    size=512, sky_size=512,
    crowded_size=256, spacing=36, grid=8, degree=2, psf_stars=150,
    sources=(160, 150), references=60, resamplings=2000, draws=300,
    optics=(3, 3))

# 58 x 58 stars on a detector are those of the paper's 135 pointings.
FULL = Settings(
    name='full', detectors=tuple(BANDS), size=9216, sky_size=9216,
    crowded_size=2304, spacing=158, grid=30, degree=3, psf_stars=1500,
    sources=(614, 590), references=100, resamplings=10000, draws=1000,
    optics=(8, 15))

SIZES = {one.name: one for one in (QUICK, HALF, FULL)}


def optics():
    """Return how the true PSF is made: 'galsim' where it is installed."""
    return 'galsim' if find_spec('galsim') else 'mixtures'


def effects():
    """Return what all detectors do; charge repels where galsim is there."""
    return DetectorEffects(**vars(DetectorEffects.typical()) | {
        'brighter_fatter': float(find_spec('galsim') is not None)})
