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
        residual, less their mean over the phases: a shift common to all is a
        matter of where the centre is, not an error.
    """
    n_phases = [p * max(1, -(-_MIN_PHASES // p)) for p in pitch.astype(int)]
    steps = [np.arange(n) * p / n for n, p in zip(n_phases, pitch,
                                                  strict=True)]
    peak = origin + mixture.moments().mean * pitch
    rows = np.array([[
        _rows_of_phase(mixture, flux, shape, pitch, origin, peak, size, x, y)
        for y in steps[1] for x in steps[0]] for size in sizes])
    rows *= used
    return rows - rows.mean(axis=1, keepdims=True)


def _rows_of_phase(mixture, flux, shape, pitch, origin, peak, size, x, y):
    """Return the rows (2, ny, nx) of one phase, (x, y) image pixels."""
    columns = _positions(peak[0], pitch[0], x, size)
    lines = _positions(peak[1], pitch[1], y, size)
    u, v = np.meshgrid((columns - origin[0]) / pitch[0],
                       (lines - origin[1]) / pitch[1])
    slope = mixture.gradient(u, v).reshape(-1, 2)
    jacobian = np.column_stack([-flux * slope, mixture.evaluate(u, v).ravel()])
    errors = np.linalg.pinv(jacobian)[:2].reshape(2, size, size)
    across = _interpolation(columns, shape[1])
    down = _interpolation(lines, shape[0])
    return np.einsum('cij,iy,jx->cyx', errors, down, across)


def _positions(peak, pitch, phase, size):
    """Return where a stamp's native pixels are, in image pixels (size,)."""
    nearest = np.rint((peak - phase) / pitch)
    return phase + pitch * (nearest + np.arange(size) - size // 2)


def _interpolation(positions, n):
    """
    Return the matrix (len(positions), n) that interpolates n pixels there.

    Lagrange's polynomial through the six nearest pixels; beyond the edge
    the image is zero.
    """
    matrix = np.zeros((len(positions), n + 12))
    for row, position in zip(matrix, positions, strict=True):
        first = int(np.floor(position)) - 2
        if not -6 <= first <= n:
            continue
        nodes = np.arange(first, first + 6)
        for node in nodes:
            others = nodes[nodes != node]
            row[node + 6] = np.prod((position - others) / (node - others))
    return matrix[:, 6:n + 6]


def phase_error(rows, residual):
    """
    Return the root mean square centroid error over phases and axes.

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
    return np.sqrt((errors**2).mean(axis=(1, 2)))
