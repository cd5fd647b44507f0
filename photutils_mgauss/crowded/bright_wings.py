"""
What the PSF leaves of saturated stars, measured on bright stars of a tile.

What the PSF lacks in the wings of a saturated star would be taken for faint
stars, and these take light from which the star's place and flux are known.
"""
import numpy as np
from scipy.ndimage import distance_transform_edt

from photutils_mgauss.crowded.table import BLEND_CORRELATION
from photutils_mgauss.photometry.bright_residual import (
    BRIGHT,
    doubtful,
    without_surroundings,
)
from photutils_mgauss.psf.residual import PSFResidual
from photutils_mgauss.psf.wings import reach_of_wings

# Of stars fainter than this part of the faintest saturated one, hidden stars
# beside them are too large a part.
_TELLING = 0.1
# What is fainter than this part of a typical telling star may be a piece of
# what the PSF leaves of it.
DOUBTFUL = 0.01
# Their light elsewhere is measured on so many of the pixels, or on all.
_ENOUGH = 0.05
# Pixels further off than so many standard errors hold stars to be found.
_CLIP, _PASSES = 4.0, 3


def left_of_bright(tile):
    """
    Return what the PSF leaves of bright stars, and who may be part of it.

    Parameters
    ----------
    tile : Tile

    Returns
    -------
    PSFResidual or None
        None if no star is saturated, or too few bright stars tell.
    doubtful : (n,) `~numpy.ndarray` of bool
        Which stars may be pieces of what the PSF leaves of saturated ones.
    """
    s = tile.stars
    own = ~s.listed & ~s.seeded
    if not s.seeded.any():
        return None, ~own
    telling = _telling(tile)
    if not telling.any():
        return None, ~own
    stars = np.stack([s.x, s.y, s.flux])
    reach = int(s.core[s.seeded].max()) + reach_of_wings(tile.model.psf)
    beside = pixels_beside(stars[:, telling | s.seeded], tile.least.shape,
                           reach)
    left = _with_faint(
        tile.model, own & (s.flux < DOUBTFUL * np.median(s.flux[telling])),
        beside)
    weight = tile.model.weight
    variance = np.divide(1, weight, where=weight > 0,
                         out=np.zeros(weight.shape))
    elsewhere = pixels_elsewhere(weight > 0, beside)
    variance[weight > 0] += _beyond_noise(left[elsewhere],
                                          variance[elsewhere])
    known = PSFResidual.of(
        left, without_surroundings(variance, stars[:, s.seeded], reach),
        stars[:, telling], reach)
    if known is None:
        return None, ~own
    return known.cautious(), own & doubtful(
        stars, np.flatnonzero(s.seeded), known.reach)


def _beyond_noise(left, variance):
    """Return the variance that stars not found yet add to noise (m,)."""
    more = 0.0
    for _ in range(_PASSES):
        good = left**2 < _CLIP**2 * (variance + more)
        more = max((left**2 - variance)[good].mean(), 0.0)
    return more


def _telling(tile):
    """Tell which stars are bright, alone, and not saturated (n,)."""
    covariance, correlation = tile.equations.covariances()
    s = tile.stars
    with np.errstate(invalid='ignore', divide='ignore'):
        strength = s.flux / np.sqrt(covariance[:, 0, 0])
    alone = ~(np.abs(correlation) > BLEND_CORRELATION)
    return (strength > BRIGHT) & alone & ~s.seeded & (
        s.flux > _TELLING * s.flux[s.seeded].min())


def _with_faint(model, faint, beside):
    """
    Return what is left of the data, some faint stars (n,) left in.

    All of them, not only those ``beside`` (ny, nx) bright stars: real ones are
    everywhere, and light that is as bright elsewhere is no part of bright
    stars.
    """
    left = model.residual.copy()
    model.add_light(np.flatnonzero(faint), left)
    return left - (left - model.residual)[
        pixels_elsewhere(model.weight > 0, beside)].mean()


def pixels_elsewhere(good, beside):
    """Tell which good pixels (ny, nx) are not beside bright stars."""
    elsewhere = good & ~beside
    return elsewhere if elsewhere.sum() > _ENOUGH * good.sum() else good


def pixels_beside(stars, shape, reach):
    """Tell which pixels (ny, nx) are near stars (3, n)."""
    far = np.ones(shape, bool)
    column, row = np.rint(stars[:2]).astype(int)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (
        row < shape[0])
    far[row[inside], column[inside]] = False
    return distance_transform_edt(far) <= reach
