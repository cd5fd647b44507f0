"""
Saturated stars among those of PSF photometry: fitted to their wings.

Their pixels are left out, the fit starts where the wings say the star is, and
sees pixels as far out as it takes to have wings all around.
"""
from dataclasses import dataclass, replace

import numpy as np
from astropy.table import QTable

from photutils_mgauss.photometry.table import fit_quality
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.psf.wings import stars_behind
from photutils_mgauss.utils.flags import SATURATED
from photutils_mgauss.utils.image import read_level
from photutils_mgauss.utils.saturation import without_saturated
from photutils_mgauss.utils.star_columns import read_sources

# A star of a list is a saturated one if it is not this much further from it
# than the edge of what is hidden [pix]; what a finder sees there is no star.
_BESIDE = 2.0


@dataclass(frozen=True)
class SaturatedStars:
    """The saturated stars of an image, of which there may be none."""

    stars: tuple = ()

    @classmethod
    def of(cls, pixels, level, model):
        """
        Find the saturated stars of an image.

        Parameters
        ----------
        pixels : PixelData
            The background subtracted.
        level : float, `~astropy.units.Quantity`, inf or None
            That of saturation; None looks for nothing.
        model : GriddedMixturePSF, MultiGaussianPSFModel or None
            None only masks.

        Returns
        -------
        pixels : PixelData
            With saturated pixels masked.
        SaturatedStars
        """
        if level is None:
            return pixels, cls()
        pixels = without_saturated(pixels, level)
        if model is None:
            return pixels, cls()
        data, variance = pixels.with_error().part()
        weight = np.divide(1, variance, where=variance > 0,
                           out=np.zeros(data.shape))
        least = 0.0
        if not (np.isscalar(level) and level == np.inf):
            least = read_level(level, 'saturation', pixels.unit)
        return pixels, cls(tuple(stars_behind(LocalPSF.of(model), data,
                                              weight, level=least)))

    def __bool__(self):
        return bool(self.stars)

    def finder(self, finder):
        """Return a finder that finds these stars once each."""
        if finder is None or not self:
            return finder
        return _Finder(finder, self)

    def rows(self, x, y):
        """Return which row of a list each star is, -1 if none."""
        out, taken = [], set()
        for star in self.stars:
            distance = np.hypot(x - star.x, y - star.y)
            distance[list(taken)] = np.inf
            distance[~np.isfinite(distance)] = np.inf
            row = int(distance.argmin()) if distance.size else -1
            if row < 0 or distance[row] > star.core + _BESIDE:
                row = -1
            else:
                taken.add(row)
            out.append(row)
        return np.array(out, int)

    def beside(self, x, y):
        """Tell which places are on a clump of bad pixels or next to it."""
        near = np.zeros(x.size, bool)
        for star in self.stars:
            rows, columns = star.clump
            near |= ((y > rows.start - 1 - _BESIDE)
                     & (y < rows.stop + _BESIDE)
                     & (x > columns.start - 1 - _BESIDE)
                     & (x < columns.stop + _BESIDE))
        return near

    def widths(self, x, y, fit_shape):
        """Return how many pixels (ny, nx) of each star are to be fitted."""
        shapes = np.tile(np.asarray(fit_shape), (x.size, 1))
        rows = self.rows(x, y)
        for star, row in zip(self.stars, rows, strict=True):
            if row >= 0:
                shapes[row] = np.maximum(shapes[row], 2 * star.half + 1)
        return shapes, rows

    def starts(self, rows, initial, free):
        """Put flux, x and y of the stars into their rows of (n, 3)."""
        for star, row in zip(self.stars, rows, strict=True):
            if row >= 0:
                start = np.array([star.flux, star.x, star.y])
                initial[row, free] = start[free]


class _Finder:
    """What another finder finds, with saturated stars in its place."""

    def __init__(self, finder, saturated):
        self.finder, self.saturated = finder, saturated

    def __call__(self, data, mask=None):
        found = self.finder(data, mask=mask)
        x, y = np.empty((2, 0))
        if found is not None:
            sources = read_sources(found, 'the table of finder')
            left = ~self.saturated.beside(sources.x, sources.y)
            x, y = sources.x[left], sources.y[left]
        stars = self.saturated.stars
        x = np.concatenate([x, [star.x for star in stars]])
        y = np.concatenate([y, [star.y for star in stars]])
        return QTable({'id': np.arange(1, x.size + 1), 'x_centroid': x,
                       'y_centroid': y})


def flag(flags, rows):
    """Set the bit of saturated stars in their rows."""
    flags[rows[rows >= 0]] |= SATURATED
    return flags


def with_misfit(result, has_error):
    """Return a FitResult with larger errors where wings do not fit."""
    rows = result.saturated[result.saturated >= 0]
    if not rows.size:
        return result
    chi2 = fit_quality(result, np.count_nonzero(result.free), has_error)[2]
    covariances = result.covariances.copy()
    covariances[rows] *= np.fmax(chi2[rows], 1)[:, None, None]
    return replace(result, covariances=covariances)
