"""
What a detector does to an image beyond noise (Nie et al., Sec. 2.1.2).

What belongs to the detector (response, hot, dead and bad pixels) is drawn
from its number, and is the same in all its exposures; cosmic rays are drawn
with the noise.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.utils.validation import as_integer, as_real

# Bits of the flags of a pixel.
SATURATED, COSMIC_RAY, HOT, DEAD, BAD_COLUMN = 1, 2, 4, 8, 16

# What a dead pixel and a bad column respond with.
_DEAD_RESPONSE = 0.05
_COLUMN_RESPONSE = 0.4

# Of a charged particle: electrons along a pixel's length of silicon, the
# depth of the detector in pixels, and points of a track per pixel.
_TRACK_CHARGE = 800.0
_DEPTH = 1.5
_TRACK_POINTS = 5


@dataclass(frozen=True)
class DetectorEffects:
    """
    The imperfections of a detector; by default it has none.

    Parameters
    ----------
    prnu : float, optional
        Standard deviation of the response of pixels. The image is divided
        by the true response, so that only the noise feels it.
    hot_pixels, dead_pixels : float, optional
        The fractions of such pixels.
    hot_dark : float, optional
        Mean dark current of hot pixels, exponentially distributed
        [electron / s].
    bad_columns : int, optional
        The number of columns that lose most of their light.
    cosmic_rays : float, optional
        Particles per million pixels and second.
    nonlinearity : float, optional
        The relative loss at the full well, growing linearly with the charge.
        It is left in the image.
    bleeding : bool, optional
        Whether charge above the full well flows along the column.
    charge_diffusion : float, optional
        Standard deviation of the spread of charge in the detector [pix],
        which widens the PSF.
    brighter_fatter : float, optional
        The strength of the repulsion of charge, 1 for a common CCD. It needs
        galsim and a PSF of mixtures that are integrated over pixels, and
        draws every photon; only stars with their centre on the image are
        drawn.

    Raises
    ------
    ValueError
        If a value is negative or a fraction above 1.

    Examples
    --------
    >>> from photutils_mgauss.simulation import DetectorEffects
    >>> DetectorEffects(cosmic_rays=1.5, bleeding=True).prnu
    0.0
    >>> DetectorEffects.typical().prnu
    0.01
    """

    prnu: float = 0.0
    hot_pixels: float = 0.0
    dead_pixels: float = 0.0
    hot_dark: float = 5.0
    bad_columns: int = 0
    cosmic_rays: float = 0.0
    nonlinearity: float = 0.0
    bleeding: bool = False
    charge_diffusion: float = 0.0
    brighter_fatter: float = 0.0

    def __post_init__(self):
        for name in ('prnu', 'hot_pixels', 'dead_pixels', 'nonlinearity'):
            as_real(getattr(self, name), name, minimum=0, maximum=1)
        for name in ('hot_dark', 'cosmic_rays', 'charge_diffusion',
                     'brighter_fatter'):
            as_real(getattr(self, name), name, minimum=0)
        as_integer(self.bad_columns, 'bad_columns', minimum=0)

    @classmethod
    def typical(cls):
        """
        Return the effects of a size common for CCDs in space.

        The brighter-fatter effect is left out, which needs galsim and time.

        Returns
        -------
        DetectorEffects
        """
        return cls(prnu=0.01, hot_pixels=2e-5, dead_pixels=1e-5,
                   bad_columns=1, cosmic_rays=1.5, nonlinearity=0.005,
                   bleeding=True, charge_diffusion=0.2)


@dataclass(frozen=True, eq=False)
class Pattern:
    """
    What is fixed about a band of rows of a detector.

    ``flat`` is the response that is known, ``response`` the whole one,
    ``dark`` the current in excess [electron / s]; all (rows, nx) or numbers.
    """

    flat: np.ndarray
    response: np.ndarray
    dark: np.ndarray
    flags: np.ndarray


def pattern(effects, detector, band, width):
    """Return the `Pattern` of a slice of rows."""
    shape = band.stop - band.start, width
    rng = np.random.default_rng([int(detector), int(band.start)])
    flat = _flat(effects.prnu, shape, rng)
    flags = np.zeros(shape, np.uint8)
    kind = rng.random(shape) if effects.hot_pixels + effects.dead_pixels else 1
    flags[kind < effects.hot_pixels] |= HOT
    flags[1 - kind < effects.dead_pixels] |= DEAD
    flags[:, _columns(effects, detector, width)] |= BAD_COLUMN
    dark = np.zeros(shape)
    hot = (flags & HOT) != 0
    dark[hot] = effects.hot_dark * rng.standard_exponential(hot.sum())
    factor = np.where(flags & DEAD, _DEAD_RESPONSE, 1)
    factor = np.where(flags & BAD_COLUMN, _COLUMN_RESPONSE, factor)
    return Pattern(flat, flat * factor, dark, flags)


def _flat(prnu, shape, rng):
    if prnu == 0:
        return np.ones(shape)
    return np.maximum(1 + prnu * rng.standard_normal(shape), 0.1)


def _columns(effects, detector, width):
    """Return the bad columns of a detector."""
    rng = np.random.default_rng([int(detector), width])
    return rng.choice(width, min(effects.bad_columns, width), replace=False)


def add_cosmic_rays(electrons, flags, effects, exposure_time, rng):
    """Add the tracks of particles to the electrons, and flag them."""
    rate = effects.cosmic_rays * exposure_time * 1e-6
    n = rng.poisson(rate * electrons.size)
    rows, columns, charge = _tracks(n, electrons.shape, rng)
    np.add.at(electrons, (rows, columns), charge.astype(electrons.dtype))
    flags[rows, columns] |= COSMIC_RAY


def _tracks(n, shape, rng):
    """
    Return the rows, columns and charges of the points of n tracks.

    Directions are isotropic, weighted by the area they see: the square of
    the sine of the angle from the normal is uniform.
    """
    sine = np.sqrt(rng.uniform(0, 0.998, n))
    length = _DEPTH * sine / np.sqrt(1 - sine**2)
    path = np.hypot(length, _DEPTH)
    total = _TRACK_CHARGE * path * rng.lognormal(0, 0.4, n)
    points = np.ceil(_TRACK_POINTS * (length + 1)).astype(int)
    which = np.repeat(np.arange(n), points)
    within = np.arange(which.size) - np.repeat(np.cumsum(points) - points,
                                               points)
    along = (length / points)[which] * within
    angle = rng.uniform(0, 2 * np.pi, n)[which]
    start = rng.uniform(0, 1, (2, n)) * np.array(shape)[:, None] - 0.5
    rows = np.rint(start[0, which] + along * np.sin(angle)).astype(int)
    columns = np.rint(start[1, which] + along * np.cos(angle)).astype(int)
    inside = ((rows >= 0) & (columns >= 0) & (rows < shape[0])
              & (columns < shape[1]))
    return rows[inside], columns[inside], (total / points)[which][inside]


def bleed(electrons, full_well):
    """Let charge above the full well flow along the columns, in place."""
    # A few columns at a time, as the rows of a small array.
    overfull = np.flatnonzero((electrons > full_well).any(axis=0))
    for part in np.array_split(overfull, max(1, overfull.size // 256)):
        columns = np.ascontiguousarray(electrons[:, part].T, dtype=float)
        kernels.bleed(columns, float(full_well))
        electrons[:, part] = columns.T


def respond(electrons, effects, full_well):
    """Return the charge that the amplifier reports."""
    return electrons * (1 - effects.nonlinearity * electrons / full_well)
