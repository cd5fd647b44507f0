"""What is simulated, and how much of it: the quick run and the full one."""
from dataclasses import dataclass
from importlib.util import find_spec

# The paper's stamp, 1.1 arcsec across, in pixels of 0.074 arcsec (Sec. 2.2).
PIXEL = 0.074
STAMP_RADIUS = 0.55 / PIXEL

# The imaging detectors of the focal plane, and the bands that Table 2 tells.
# The paper does not say those of the others: they are simulated in g.
DETECTORS = (6, 7, 8, 9, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 22, 23, 24,
             25)
BANDS = {7: 'i', 8: 'g', 9: 'r', 22: 'r', 23: 'g', 24: 'i'}

# Which exposures of Table 2 make a campaign of 2 to 7 observations: those
# that are nearest to equal intervals of time (Sec. 4.3).
CAMPAIGNS = {2: (0, 6), 3: (0, 3, 6), 4: (0, 1, 3, 6), 5: (0, 1, 3, 5, 6),
             6: (0, 1, 2, 3, 5, 6), 7: (0, 1, 2, 3, 4, 5, 6)}


@dataclass(frozen=True)
class Settings:
    """
    The sizes of a run.

    Attributes
    ----------
    name : str
        'quick' or 'full'.
    detectors : tuple of int
        The detectors of Figs. 4 to 7.
    size, sky_size, crowded_size : int
        Sides of the images of Figs. 1 to 7, 8 to 12, and 13 to 14 [pix].
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
    grid: int
    degree: int
    psf_stars: int
    sources: tuple
    references: int
    resamplings: int
    draws: int
    optics: tuple


QUICK = Settings(
    name='quick', detectors=(7, 8), size=512, sky_size=768, crowded_size=256,
    grid=5, degree=2, psf_stars=120, sources=(150, 140), references=50,
    resamplings=2000, draws=150, optics=(4, 7))

FULL = Settings(
    name='full', detectors=DETECTORS, size=1024, sky_size=1536,
    crowded_size=512, grid=12, degree=3, psf_stars=300, sources=(614, 590),
    references=100, resamplings=10000, draws=500, optics=(6, 13))


def optics():
    """Return how the true PSF is made: 'galsim' where it is installed."""
    return 'galsim' if find_spec('galsim') else 'mixtures'
