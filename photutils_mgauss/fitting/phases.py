r"""
The pixel-phase error of a PSF model, linear in its residual image.

A noise-free star that falls on the detector with its centre at some phase of
the pixels, fitted with a model that misses the truth by r, comes out wrong by
:math:`(J^T J)^{-1} J^T r`, with J the derivatives of the model by x, y and
flux in the pixels fitted.
"""
import numpy as np

SIZES = (5, 7)
_MIN_PHASES = 4
# A stamp with less of the star's light than this fraction tells nothing.
_LEAST_LIGHT = 1e-3
# Fluxes that change more than this with the pixel phase are said [rms].
FLUX_LIMIT = 0.003
# So are positions [pix]: the brightest stars are measured better.
SHIFT_LIMIT = 0.002
# Fluxes are those in stamps of so many native pixels. The variance of a
# bright star's pixels has a floor of this share of its peak.
_FLUX_SIZE = 5
_FLOOR = 0.01
# Between the samples of an image, too, the flux is looked at.
_FLUX_PHASES = 8


def phase_rows(mixture, flux, shape, pitch, origin, used, sizes=SIZES):
    """
    Return the map from residual images to centroid errors.

    Parameters
    ----------
    mixture : GaussianMixture
        The model.
    flux : float
        Its flux, in the unit of the image, in native pixels.
    shape : (ny, nx) tuple of int
        The shape of the image.
    pitch : (2,) `~numpy.ndarray` of int
        Image pixels per native pixel along (x, y).
    origin : (2,) `~numpy.ndarray`
        The image pixel that is the origin of the mixture.
    used : (ny, nx) `~numpy.ndarray` of bool
        Pixels whose residual counts; of the others it is taken as zero.
    sizes : sequence of int, optional
        The widths of the square star stamps, in native pixels.

    Returns
    -------
    (len(sizes), n, 2, ny, nx) `~numpy.ndarray`
        For n phases the errors of x and y [native pix] as sums over the
        residual.
    """
    return used * np.array([
        _rows_of_size(mixture, flux, shape, pitch, origin, size)[:, :2]
        for size in sizes])


def flux_rows(mixture, flux, shape, pitch, origin, used,
              least_phases=_MIN_PHASES):
    """
    Return the map from residual images to relative errors of the flux.

    Parameters
    ----------
    mixture, flux, shape, pitch, origin, used
        See `phase_rows`.
    least_phases : int, optional
        The least number of phases along each axis.

    Returns
    -------
    (2, n, ny, nx) `~numpy.ndarray`
        For a faint star and a bright one at n phases the errors as sums over
        the residual.
    """
    return used * np.array([
        _rows_of_size(mixture, flux, shape, pitch, origin, _FLUX_SIZE,
                      least_phases, bright)[:, 2] / flux
        for bright in (False, True)])


def flux_phase_error(mixture, image, pitch, origin):
    """
    Return how much the flux of a star changes with its pixel phase.

    The fit of a model to itself gives its flux exactly, so that the fit of
    the image itself, without a model subtracted that may hide between the
    samples, gives the error.

    Parameters
    ----------
    mixture, pitch, origin
        See `phase_rows`.
    image : (ny, nx) `~numpy.ndarray`
        The PSF, with the model in pixels that do not count.

    Returns
    -------
    float
        The standard deviation over the phases, as a fraction of the flux; of
        faint and bright stars the greater.
    """
    rows = flux_rows(mixture, 1.0, image.shape, pitch, origin, 1.0,
                     least_phases=_FLUX_PHASES)
    fluxes = np.tensordot(rows, image, 2)
    return float((fluxes.std(axis=1) / fluxes.mean(axis=1)).max())


def _phases_along(pitch, least):
    """Return phases within a native pixel, in image pixels (m,)."""
    whole = max(int(pitch), 1)
    n = whole * max(1, -(-least // whole))
    return np.arange(n) * pitch / n


def _rows_of_size(mixture, flux, shape, pitch, origin, size,
                  least_phases=_MIN_PHASES, bright=False):
    """Return rows (n, 3, ny, nx) of x, y and flux for n phases."""
    x, y = (_phases_along(p, least_phases) for p in pitch)
    peak = origin + mixture.moments().mean * pitch
    columns = _positions(peak[0], pitch[0], x, size)
    lines = _positions(peak[1], pitch[1], y, size)
    u = (columns - origin[0])[None, :, None, :] / pitch[0]
    v = (lines - origin[1])[:, None, :, None] / pitch[1]
    slope, value = mixture.gradient(u, v), mixture.evaluate(u, v)
    jacobian = np.stack([-flux * slope[..., 0], -flux * slope[..., 1], value],
                        axis=-1).reshape(len(y), len(x), size**2, 3)
    jacobian[value.sum(axis=(-2, -1)) < _LEAST_LIGHT] = 0
    if bright:
        root = _root_of_weights(value).reshape(len(y), len(x), size**2)
        errors = np.linalg.pinv(jacobian * root[..., None])
        errors *= root[:, :, None]
    else:
        errors = np.linalg.pinv(jacobian)
    errors = errors.reshape(len(y), len(x), 3, size, size)
    across = _interpolation(columns, shape[1])[None, :, None]
    down = _interpolation(lines, shape[0])[:, None, None]
    rows = np.swapaxes(down, -1, -2) @ (errors @ across)
    return rows.reshape(-1, 3, *shape)


def _root_of_weights(value):
    """Return the root of the weights of pixels where the light is noise."""
    floor = _FLOOR * value.max()
    return 1 / np.sqrt(np.maximum(value, 0) + floor)


def _positions(peak, pitch, phases, size):
    """Return where stamps' native pixels are, in image pixels (m, size)."""
    nearest = np.rint((peak - phases) / pitch)
    offsets = nearest[:, None] + np.arange(size) - size // 2
    return phases[:, None] + pitch * offsets


def _interpolation(positions, n):
    """
    Return the matrix (..., n) that interpolates n pixels at positions (...).

    Lagrange's polynomial through the six nearest pixels; beyond the edge
    the image is zero.
    """
    first = np.floor(positions).astype(int) - 2
    nodes = np.arange(6)
    apart = nodes[:, None] - nodes
    away = (positions - first)[..., None] - nodes
    # For each node the product over the five others.
    factors = away[..., None, :] / np.where(apart == 0, 1, apart)
    weights = np.where(apart == 0, 1.0, factors).prod(axis=-1)
    matrix = np.zeros((*positions.shape, n + 12))
    places = np.clip(first[..., None] + 6, 0, n + 6) + nodes
    np.put_along_axis(matrix, places, weights, axis=-1)
    return matrix[..., 6:n + 6]


def phase_error(rows, residual):
    """
    Return the root mean square centroid error over phases and axes.

    A shift common to all phases is a matter of where the centre is and not
    an error.

    Parameters
    ----------
    rows : (s, n, 2, ny, nx) `~numpy.ndarray`
        From `phase_rows`.
    residual : (ny, nx) `~numpy.ndarray`
        Image minus model.

    Returns
    -------
    (s,) `~numpy.ndarray`
        For each stamp size [native pix].
    """
    errors = np.tensordot(rows, np.where(np.isfinite(residual), residual, 0),
                          2)
    return np.sqrt(errors.var(axis=1).mean(axis=1))
