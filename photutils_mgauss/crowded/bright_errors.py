"""What the PSF's wings are worth to the saturated stars of a tile."""
import numpy as np

from photutils_mgauss.photometry.wing_errors import Wings, covariances_of


def with_wing_errors(model, covariances):
    """
    Return covariances with what wings do to saturated stars.

    Parameters
    ----------
    model : Model
        Solved.
    covariances : (n, 3, 3) `~numpy.ndarray`
        Of flux, x and y, as if each pixel of the wings were off for itself.

    Returns
    -------
    (n, 3, 3) `~numpy.ndarray`
    """
    if model.wing_variance is None:
        return covariances
    every = {row: _wings(model, row)
             for row in np.flatnonzero(model.stars.seeded)}
    every = {row: one for row, one in every.items() if one is not None}
    if not every:
        return covariances
    wings, alone = covariances_of(list(every.values()), model.residual)
    out = covariances.copy()
    out[list(every)] += wings - alone
    return out


def _wings(model, star):
    """Return the Wings of a star, None if nothing is known of its errors."""
    row, column, design, variance, _ = pixels_of(model, star)
    return Wings.of_pixels(
        row, column, design, variance,
        np.sqrt(model.wing_variance[row, column]), np.ones(3, bool))


def pixels_of(model, star):
    """
    Return the good pixels (m,) in the stamp of a star.

    Their rows and columns, the derivatives (3, m) by flux, x and y, their
    variances, and half the width of the stamp.
    """
    stamps = model.stamps
    width = stamps.width[star]
    y, x = np.indices((width, width)).reshape(2, -1)
    row, column = y + stamps.bottom[star], x + stamps.left[star]
    ny, nx = model.weight.shape
    inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
    seen = inside & (model.weight[np.clip(row, 0, ny - 1),
                                  np.clip(column, 0, nx - 1)] > 0)
    row, column = row[seen], column[seen]
    design = model.stamps.derivatives[
        :, stamps.offset[star] + np.flatnonzero(seen)]
    design[1:] *= model.stars.flux[star]
    return row, column, design, 1 / model.weight[row, column], int(width) // 2
