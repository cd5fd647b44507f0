r"""
How far the light of stars reaches, beyond the pixels a field is fitted to.

In rings about stars of flux F beyond the stamps' radius R the mean of the
pixels is

.. math::

    \langle d \rangle_r = b + A F\, (r / R)^{-\gamma} ,

the profile a power law, as diffraction and seeing make it, and b what does
not depend on the star: an error of the background, and faint sources. The
light beyond R is :math:`2 \pi A R^2 / (\gamma - 2)` of the flux.
"""
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from astropy.stats import mad_std, sigma_clip
from scipy.spatial import KDTree

from photutils_mgauss.field.stamps import cut_stamps
from photutils_mgauss.utils.star_columns import plain_values

# The radius of the stamps if it is not given: so many full widths at half
# maximum, but between these [pix].
FIRST_RADIUS = 10
_WIDTHS, _LARGEST = 4, 20
# Rings from the radius of the stamps to so many times that.
_N_RINGS, _REACH = 10, 3.0
# The slopes of power laws that are looked for: a flatter one has no end.
SLOPES = np.linspace(2.5, 6.0, 36)
# What is expected of them: diffraction's, within a Cauchy distribution of this
# width, whose tails let stars say otherwise, as those of seeing do.
USUAL_SLOPE, _SLOPE_WIDTH = 3.0, 0.25
_CLIP, _LEAST_SCATTER = 4.0, 1e-75
_FEWEST_STARS = 5
# Light that is seen beyond doubt [standard deviations].
_SEEN = 5.0
# The size of the Gaussian that carries the light, in radii of the stamps: wide
# enough to change nothing inside.
_SIZE = 2.0


@dataclass(frozen=True)
class Wings:
    """
    The light beyond the stamps, as a wide Gaussian.

    Attributes
    ----------
    share, error : float
        Its share of the PSF's flux, and the error of that.
    stddev : float
        Its size [pix].
    significance : float
        Of the light in the rings [standard deviations].
    """

    share: float
    error: float
    stddev: float
    significance: float

    @classmethod
    def of(cls, light, error, significance, inside, radius):
        """
        Return the Gaussian of light beyond the stamps.

        ``light`` and its error are in fluxes of the stars, as the light
        ``inside`` and the error of that.
        """
        total = inside[0] + max(light, 0)
        return cls(float(max(1 - 1 / total, 0)),
                   float(np.hypot(error, inside[1]) / total**2),
                   _SIZE * radius, float(significance))

    @property
    def is_seen(self):
        """Whether the rings show light beyond doubt."""
        return self.share > 0 and self.significance > _SEEN


def own_radius(stamps):
    """Return the radius that fits the width of the stars [pix]."""
    width = 2 * _half_radius(stamps)
    return float(np.clip(np.ceil(_WIDTHS * width), FIRST_RADIUS, _LARGEST))


def _half_radius(stamps):
    """Return where the mean star falls to half of its peak [pix]."""
    distance = stamps.offsets()
    inner = distance <= 2.5
    light = np.where(stamps.good, stamps.data, 0)[:, inner].sum(axis=1)
    shares = np.where(stamps.good, stamps.data, np.nan)[light > 0]
    shares = shares / light[light > 0, None, None]
    steps = np.arange(0, stamps.radius)
    rings = [shares[:, np.abs(distance - step) <= 0.5] for step in steps]
    profile = np.array([np.nanmedian(ring) if np.isfinite(ring).any()
                        else 0.0 for ring in rings])
    below = np.flatnonzero(profile < profile[0] / 2)
    if below.size == 0:
        return float(stamps.radius)
    last = below[0]
    high, low = profile[last - 1:last + 1] / profile[0]
    return last - 1 + (high - 0.5) / (high - low)


def stars_of_exposures(field, n):
    """
    Return x, y, flux and number (n, 4) of the stars used of each exposure.

    The number of a star is the same in all exposures.
    """
    table = field.stars[field.stars['used']]
    several = 'exposure' in table.colnames
    exposure = np.asarray(table['exposure']) if several else np.zeros(
        len(table))
    number = table['star'] if several else np.arange(len(table))
    stars = np.column_stack([table['x_fit'], table['y_fit'],
                             plain_values(table['flux_fit']), number])
    return [stars[exposure == i] for i in range(n)]


def light_inside(field, x, y):
    """
    Return the light inside the stamps, in fluxes of the stars, and its error.

    It is that of the Gaussians at a place and what they leave of the stars;
    the error is that of their mean, as they scatter.
    """
    left, error = left_over(field, field.radius)
    return field.enclosed_flux(x, y) + left, error


def left_over(field, radius):
    """
    Return the light that a field leaves inside a radius, over the flux.

    Returns
    -------
    mean, error : float
        Of the stars, the brighter the more.
    """
    used = np.asarray(field.stars['used'])
    residual = field.residual_stars[used]
    half = residual.shape[1] // 2
    steps = np.arange(-half, half + 1)
    inside = (np.hypot(steps, steps[:, None]) <= radius + 0.5) & np.isfinite(
        residual).any(axis=0)
    flux = plain_values(field.stars['flux_fit'])[used]
    # Deviant pixels count as what they would be without.
    light = np.nanmean(residual[:, inside], axis=1) * np.count_nonzero(inside)
    share, weight = light / flux, flux**2 / np.sum(flux**2)
    mean = weight @ share
    n = max(flux.size - 1, 1)
    error = np.sqrt(weight**2 @ (share - mean) ** 2 * flux.size / n)
    return float(mean), float(error)


def measure_wings(exposures, catalogues, stars, inside, radius):
    """
    Measure the light beyond the stamps of a field.

    Parameters
    ----------
    exposures : iterable of PixelData
    catalogues : list of Sources
        All sources of each exposure; pixels near others are left out.
    stars : list of (n, 4) `~numpy.ndarray`
        x, y, flux and number of the stars of each exposure that are used.
    inside : (float, float)
        The light inside the stamps, in fluxes of the stars, and its error.
    radius : float
        Of the stamps [pix].

    Returns
    -------
    Wings or None
        None if too few stars have free pixels around.
    why_not : str
        What there would have to be.
    """
    edges = np.geomspace(radius + 0.5, _REACH * radius, _N_RINGS + 1)
    parts = [_ring_means(*one, edges) for one in zip(
        exposures, catalogues, stars, strict=True)]
    flux, number = np.concatenate(stars)[:, 2:].T
    means, counts = (np.concatenate(one) for one in zip(*parts, strict=True))
    enough = np.unique(number[counts.any(axis=1)]).size
    if enough < _FEWEST_STARS:
        return None, (f'needs at least {_FEWEST_STARS} stars with free pixels '
                      f'up to {_REACH:.0f} radii around, got {enough}')
    middle = np.sqrt(edges[1:] * edges[:-1]) / edges[0]
    light, error, significance = _light_beyond(flux, means, counts, middle)
    return Wings.of(light * edges[0] ** 2, error * edges[0] ** 2,
                    significance, inside, radius), ''


def _ring_means(pixels, catalogue, stars, edges):
    """Return clipped means and numbers of pixels (n, rings)."""
    reach = edges[-1]
    stamps = cut_stamps(pixels, stars[:, 0], stars[:, 1], reach)
    known = np.isfinite(catalogue.x) & np.isfinite(catalogue.y)
    others = np.column_stack([catalogue.x, catalogue.y])[known]
    tree = KDTree(others) if len(others) else None
    steps = np.arange(stamps.data.shape[1])
    means = np.zeros((len(stars), len(edges) - 1))
    counts = np.zeros(means.shape)
    for i, star in enumerate(stars):
        x = stamps.corners[i, 0] + steps
        y = (stamps.corners[i, 1] + steps)[:, None]
        distance = np.hypot(x - star[0], y - star[1])
        good = stamps.good[i].copy()
        for near in tree.query_ball_point(star[:2], reach + edges[0]):
            other = others[near]
            if np.hypot(*(other - star[:2])) > 2:
                good &= np.hypot(x - other[0], y - other[1]) > edges[0]
        for ring in range(means.shape[1]):
            inside = good & (distance > edges[ring])
            inside &= distance <= edges[ring + 1]
            counts[i, ring] = np.count_nonzero(inside)
            if counts[i, ring]:
                means[i, ring] = np.mean(sigma_clip(
                    stamps.data[i][inside], _CLIP, maxiters=3,
                    masked=False))
    return means, counts


def _light_beyond(flux, means, counts, middle):
    """
    Return light beyond the first edge over its square, and the error.

    The third number is the significance of the light in the rings.
    """
    kept = counts > 0
    for _ in range(4):
        fits = [_height(flux[:, None] * middle**-slope, means, counts * kept)
                for slope in SLOPES]
        best = min(fits, key=lambda fit: fit.chi2)
        pulls = best.residual * np.sqrt(counts)
        # In an image without noise it is 0; its square must not be.
        scatter = max(mad_std(pulls[kept]), _LEAST_SCATTER)
        kept = (counts > 0) & (np.abs(pulls) < _CLIP * scatter)
    heights, errors, chi2 = (np.array([getattr(fit, name) for fit in fits])
                             for name in ('height', 'error', 'chi2'))
    # What is beside a star spoils several of its rings: they count as one.
    scatter *= np.sqrt(len(middle))
    return over_slopes(heights, errors * scatter, chi2 / scatter**2)


def over_slopes(heights, errors, chi2):
    """
    Return the light beyond a radius, over its square, and the error.

    Parameters
    ----------
    heights, errors, chi2 : (n,) `~numpy.ndarray`
        For each of ``SLOPES``, the surface brightness at the radius in units
        of flux, its error, and how well it fits.

    Returns
    -------
    light, error : float
    significance : float
        Of the most likely height.
    """
    cost = chi2 + 2 * np.log1p(((SLOPES - USUAL_SLOPE) / _SLOPE_WIDTH) ** 2)
    likely = np.exp(-0.5 * (cost - cost.min()))
    likely /= likely.sum()
    factor = 2 * np.pi / (SLOPES - 2)
    mean = likely @ (heights * factor)
    variance = likely @ ((heights * factor - mean) ** 2
                         + (errors * factor) ** 2)
    peak = np.argmax(likely)
    return mean, np.sqrt(variance), heights[peak] / errors[peak]


class _Fit(NamedTuple):
    height: float
    error: float
    chi2: float
    residual: np.ndarray


def _height(shape, means, counts):
    """Fit means (n, rings) by a height times a shape, and a constant."""
    total = counts.sum()
    about = shape - (counts * shape).sum() / total
    middle = (counts * means).sum() / total
    precision = (counts * about**2).sum()
    height = (counts * about * means).sum() / precision
    residual = means - middle - height * about
    return _Fit(height, precision**-0.5, (counts * residual**2).sum(),
                residual)
