"""What the PSF leaves of the bright stars of a crowded image, taken off."""
from dataclasses import replace

import numpy as np
from astropy.stats import mad_std
from scipy.spatial import cKDTree

from photutils_mgauss.crowded.bright_wings import (
    DOUBTFUL,
    pixels_beside,
    pixels_elsewhere,
)
from photutils_mgauss.crowded.table import BLEND_CORRELATION, positions
from photutils_mgauss.photometry.bright_residual import (
    BRIGHT,
    warn_of_few,
    without_surroundings,
)
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.psf.residual import MOST, PSFResidual
from photutils_mgauss.utils.flags import NOT_A_STAR, REPEATED, SATURATED
from photutils_mgauss.utils.star_columns import column_values

# Stars are drawn down to this part of the noise.
_FAINTEST = 0.02


def without_residual(image, model, table, radius):
    """
    Return an image without what the PSF leaves of its bright stars.

    Parameters
    ----------
    image : PixelData
        With errors.
    model : GriddedMixturePSF or MultiGaussianPSFModel
    table : `~astropy.table.QTable`
        Its stars, as fitted with that PSF.
    radius : float
        How far from stars to look [pix].

    Returns
    -------
    PixelData, PSFResidual or None
        None if too few stars tell.
    """
    bright, saturated, telling = _kinds(table)
    stars = np.array(positions(table))
    data, variance = image.part()
    known = None
    if telling.any():
        typical = np.median(np.sort(stars[2, telling])[-MOST:])
        faint = (stars[2] < DOUBTFUL * typical) & (
            (table['flags'] & REPEATED) == 0)
        left = _left_over(data, variance, model, table, ~faint)
        beside = pixels_beside(stars[:, telling | saturated], data.shape,
                               radius)
        left -= _mean_light(stars[:, faint], pixels_elsewhere(
            variance > 0, beside))
        # Stars that were not found are noise, too.
        variance = np.where(variance > 0, np.maximum(
            variance, mad_std(left[variance > 0])**2), 0)
        known = PSFResidual.of(
            left, without_surroundings(variance, stars[:, saturated], radius),
            stars[:, telling], radius)
    if known is None:
        warn_of_few(int(telling.sum()), 'that are no blends')
        return image, None
    # How bright stars differ is not known here: stars that are doubtful are
    # most of that.
    data = image.data - known.image(*stars[:, bright])
    return replace(image, data=data), known


def _mean_light(stars, where):
    """Return the mean light of stars (3, n) in pixels (ny, nx)."""
    ny, nx = where.shape
    column, row = np.rint(stars[:2]).astype(int)
    inside = (column >= 0) & (column < nx) & (row >= 0) & (row < ny)
    inside[inside] = where[row[inside], column[inside]]
    return stars[2, inside].sum() / max(np.count_nonzero(where), 1)


def _kinds(table):
    """Return which stars are bright, which saturated, and which tell."""
    flags = np.asarray(table['flags'])
    saturated = (flags & SATURATED) > 0
    star = (flags & (NOT_A_STAR | REPEATED)) == 0
    for values in positions(table):
        star &= np.isfinite(values)
    bright = star & (column_values(table, 'significance') > BRIGHT)
    alone = np.abs(column_values(table, 'neighbor_correlation')) < (
        BLEND_CORRELATION)
    single = ~np.isfinite(column_values(table, 'neighbor_distance'))
    return bright, saturated & star, bright & ~saturated & (alone | single)


def _left_over(data, variance, model, table, drawn):
    """Return an image without its stars and its background."""
    stars = np.array(positions(table))
    drawn = drawn & np.isfinite(stars).all(axis=0) & (
        (table['flags'] & REPEATED) == 0)
    noise = np.sqrt(np.median(variance[variance > 0]))
    return data - nearest_background(table, data.shape) - MixtureRenderer(
        model).image(stars[:, drawn], _FAINTEST * noise, data.shape)


def nearest_background(table, shape):
    """Return the background (ny, nx) as it is at the nearest star."""
    level = column_values(table, 'local_bkg')
    good = np.isfinite(level) & np.isfinite(table['x_fit'])
    tree = cKDTree(np.column_stack([table['x_fit'][good],
                                    table['y_fit'][good]]))
    y, x = np.indices(shape)
    nearest = tree.query(np.column_stack([x.ravel(), y.ravel()]))[1]
    return level[good][nearest].reshape(shape)
