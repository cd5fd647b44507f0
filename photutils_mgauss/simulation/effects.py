"""
What a detector does to an image beyond noise (Nie et al., Sec. 2.1.2).

What belongs to the detector (response, flat field, hot, warm, dead and bad
pixels) is drawn from its number, and is the same in all its exposures; cosmic
rays are drawn with the noise.
"""
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from photutils_mgauss import kernels
from photutils_mgauss.utils.validation import as_integer, as_real

# Bits of the flags of a pixel.
SATURATED, COSMIC_RAY, HOT, DEAD, BAD_COLUMN, WARM = 1, 2, 4, 8, 16, 32

# Which products of Legendre polynomials the large-scale flat has: all that
# vary, up to the fourth order.
_LARGE_SCALE = ((np.add(*np.indices((5, 5))) <= 4)
                & (np.add(*np.indices((5, 5))) >= 1))

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
        by the response that the flat field shows, so that only the noise
        and ``flat_error`` are left of it.
    hot_pixels, dead_pixels : float, optional
        The fractions of such pixels. They are flagged.
    hot_dark : float, optional
        Mean dark current of hot pixels, exponentially distributed
        [electron / s].
    bad_columns : int, optional
        The number of columns that lose most of their light. They are
        flagged.
    cosmic_rays : float, optional
        Particles per million pixels and second. Their pixels are flagged.
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
        galsim and a PSF of mixtures that are integrated over pixels or one
        that ``Optics.to_gridded_psf`` made, and draws every photon of the
        stars on the image that have 2000 electrons or more. Of fainter
        ones it would move less than 1e-4 of the charge.
    large_scale_flat : float, optional
        Standard deviation over the detector of the smooth part of the
        response, a polynomial of the fourth degree in x and y: vignetting,
        filter and coating. The image is divided by it.
    flat_error : float, optional
        Standard deviation of the error of the flat field that images are
        divided by, pixel by pixel: the photon noise of the frames that it
        was made of. It is left in the image, the same in all exposures.
    shutter : float, optional
        How long the shutter takes to cross the detector [s]. It opens from
        the first row to the last and closes on its way back, so that the
        first row is exposed twice this time longer than the last and the
        mean of all rows is the nominal time. Images are divided by the
        exposure of each row; the noise keeps it.
    warm_pixels : float, optional
        The fraction of pixels with a raised dark current. They are flagged.
    warm_dark : float, optional
        Their mean dark current above that of others, exponentially
        distributed [electron / s].

    Raises
    ------
    ValueError
        If a value is negative or a fraction above 1.

    Notes
    -----
    Sizes are chosen: the paper names the effects and does not give their
    numbers. Those of `typical` are common for CCDs in space.

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
    large_scale_flat: float = 0.0
    flat_error: float = 0.0
    shutter: float = 0.0
    warm_pixels: float = 0.0
    warm_dark: float = 0.3

    def __post_init__(self):
        for name in ('prnu', 'hot_pixels', 'dead_pixels', 'nonlinearity',
                     'large_scale_flat', 'flat_error', 'warm_pixels'):
            as_real(getattr(self, name), name, minimum=0, maximum=1)
        for name in ('hot_dark', 'cosmic_rays', 'charge_diffusion',
                     'brighter_fatter', 'shutter', 'warm_dark'):
            as_real(getattr(self, name), name, minimum=0)
        as_integer(self.bad_columns, 'bad_columns', minimum=0)
        bad = self.hot_pixels + self.warm_pixels + self.dead_pixels
        as_real(bad, 'hot_pixels, warm_pixels and dead_pixels together',
                maximum=1)

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
                   bleeding=True, charge_diffusion=0.2,
                   large_scale_flat=0.02, flat_error=0.002, shutter=1.0,
                   warm_pixels=2e-4)


@dataclass(frozen=True, eq=False)
class Pattern:
    """
    What is fixed about a band of rows of a detector.

    ``flat`` is the response that is known, ``response`` the true one,
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
    flags = _bad_pixels(effects, shape, rng)
    flags[:, _columns(effects, detector, width)] |= BAD_COLUMN
    dark = np.zeros(shape)
    for bit, mean in ((HOT, effects.hot_dark), (WARM, effects.warm_dark)):
        here = (flags & bit) != 0
        dark[here] = mean * rng.standard_exponential(here.sum())
    factor = np.where(flags & DEAD, _DEAD_RESPONSE, 1)
    factor = np.where(flags & BAD_COLUMN, _COLUMN_RESPONSE, factor)
    # After all other numbers: those of a seed stay what they are without it.
    known = flat * _flat(effects.flat_error, shape, rng)
    return Pattern(known, flat * factor, dark, flags)


def _bad_pixels(effects, shape, rng):
    """Return the flags (rows, nx) of hot, warm and dead pixels."""
    flags = np.zeros(shape, np.uint8)
    hot, warm, dead = (effects.hot_pixels, effects.warm_pixels,
                       effects.dead_pixels)
    if hot + warm + dead == 0:
        return flags
    kind = rng.random(shape)
    flags[kind < hot] |= HOT
    flags[(kind >= hot) & (kind < hot + warm)] |= WARM
    flags[1 - kind < dead] |= DEAD
    return flags


def illumination(effects, detector, instrument, band):
    """
    Return the light (rows, nx) that a band of rows collects.

    It is relative to that of an even response during the nominal exposure:
    what is smooth in the flat field times the exposure that the shutter
    gives each row.
    """
    ny, nx = instrument.shape
    v, u = (2 * (np.arange(n) + 0.5) / n - 1 for n in (ny, nx))
    v = v[band]
    late = effects.shutter * v / instrument.exposure_time
    light = np.repeat(1 - late[:, None], nx, axis=1)
    if effects.large_scale_flat:
        light *= 1 + effects.large_scale_flat * legendre.leggrid2d(
            v, u, _large_scale(detector))
    return np.maximum(light, 0.1)


def _large_scale(detector):
    """Return coefficients (5, 5) of a smooth field of variance 1."""
    rng = np.random.default_rng([int(detector), 0, 0])
    i, j = np.indices((5, 5))
    coefficients = np.where(
        _LARGE_SCALE, rng.standard_normal((5, 5)) / (1.0 + i + j), 0)
    # The mean square of a Legendre polynomial of degree i is 1 / (2 i + 1).
    variance = (coefficients**2 / ((2 * i + 1) * (2 * j + 1))).sum()
    return coefficients / np.sqrt(variance)


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
