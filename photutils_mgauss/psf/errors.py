r"""
How far a PSF may be off: its covariance, in few directions.

A PSF that was fitted has errors, and what is measured with it inherits
them. Around each of a few places of the detector they are R changes of the
mixture, independent and one standard deviation each,

.. math::

    \delta P_r = \sum_k \left[\delta\omega_k
    + \omega_k\, \delta\alpha_k \cdot \mathbf a
    + \tfrac12 \omega_k \left(\mathbf a^T \delta\Sigma_k\, \mathbf a
    - \mathrm{tr}\, \Sigma_k^{-1} \delta\Sigma_k\right)\right] N_k ,
    \quad \mathbf a = \Sigma_k^{-1} (\mathbf r - \alpha_k) .

A fit of a star with design matrix J and weights W answers a change of the PSF
with the shift :math:`(J^T W J)^{-1} J^T W\, \delta P`. Where pixels are so
coarse that the shapes cannot say what a mixture lacks, the light in each pixel
is off by a share of it besides.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.psf.grid import Grid, checked_arrays
from photutils_mgauss.psf.mixture import GaussianMixture

# Places in a pixel over which pixel-integrated PSFs are averaged.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_NODES, _WEIGHTS = _NODES / 2, _WEIGHTS / 2
# The columns of a file, and their units.
COLUMNS = {'x': 'pix', 'y': 'pix', 'weight': '', 'mean': 'pix',
           'covariance': 'pix2', 'change': '', 'misfit': ''}


@dataclass(frozen=True, eq=False)
class PSFErrors:
    """
    The errors of a PSF at M places of a detector.

    Attributes
    ----------
    grid : Grid
        The PSF at those places.
    changes : (M, R, K, 6) `~numpy.ndarray`
        R independent changes of one standard deviation: of the weight, the
        mean x and y [pix] and the covariance xx, xy and yy [pix^2] of each
        Gaussian.
    misfit : float, optional
        The standard deviation of the light in a pixel, as a share of it, that
        no change of the mixture explains.
    """

    grid: Grid
    changes: np.ndarray
    misfit: float = 0.0

    def __post_init__(self):
        self.changes.flags.writeable = False

    def nearest(self, x, y):
        """Return the node (n,) nearest to each position."""
        columns, rows = (
            np.searchsorted((nodes[1:] + nodes[:-1]) / 2, place)
            for nodes, place in ((self.grid.x_grid, x),
                                 (self.grid.y_grid, y)))
        return rows * self.grid.x_grid.size + columns

    def images(self, node, phase_x, phase_y, shape, *, integrated=False):
        """
        Draw the PSF, its derivatives and its changes.

        Parameters
        ----------
        node : (n,) `~numpy.ndarray` of int
        phase_x, phase_y : (n,) `~numpy.ndarray`
            Where in the middle pixel the star is, 0 for its centre [pix].
        shape : (int, int)
            Of a stamp.
        integrated : bool, optional
            Whether the PSF is to be integrated over pixels.

        Returns
        -------
        (n, 3 + R, pixels) `~numpy.ndarray`
            The PSF of unit flux, its derivatives by the x and y of the star,
            and its changes.
        """
        ny, nx = shape
        y, x = (axis.ravel() for axis in np.mgrid[:ny, :nx])
        x = x - (nx - 1) // 2 - phase_x[:, None]
        y = y - (ny - 1) // 2 - phase_y[:, None]
        if not integrated:
            return self._sampled(node, x, y)
        return sum(_WEIGHTS[i] * _WEIGHTS[j] * self._sampled(
            node, x + _NODES[i], y + _NODES[j])
            for i in range(_NODES.size) for j in range(_NODES.size))

    def _sampled(self, node, x, y):
        grid = self.grid
        offset = (np.stack([x, y])[:, :, None]
                  - np.moveaxis(grid.means[node], -1, 0)[..., None])
        inverse = np.linalg.inv(grid.covariances)[node]
        xx, xy, yy = (inverse[..., i, j, None] for i, j in
                      ((0, 0), (0, 1), (1, 1)))
        a = xx * offset[0] + xy * offset[1]
        b = xy * offset[0] + yy * offset[1]
        unit = (np.exp(-0.5 * (a * offset[0] + b * offset[1]))
                * np.sqrt(xx * yy - xy * xy) / (2 * np.pi))
        light = grid.weights[node][..., None] * unit
        slopes = np.stack([
            unit, light * a, light * b, light * (a * a - xx) / 2,
            light * (a * b - xy), light * (b * b - yy) / 2], axis=2)
        n, k = light.shape[:2]
        out = np.empty((n, 3 + self.changes.shape[1], x.shape[1]))
        out[:, 0] = light.sum(axis=1)
        out[:, 1:3] = slopes[:, :, 1:3].sum(axis=1)
        np.matmul(self.changes[node].reshape(n, -1, 6 * k),
                  slopes.reshape(n, 6 * k, -1), out=out[:, 3:])
        return out

    def convolved(self, kernel):
        """Return the errors of a PSF convolved as mixtures are."""
        grid, m = self.grid, len(self.changes)
        share, shift, added = ((kernel.weights, kernel.means,
                                kernel.covariances)
                               if isinstance(kernel, GaussianMixture)
                               else (np.ones(1), 0, np.asarray(kernel)))
        weights = grid.weights[:, :, None] * share
        means = grid.means[:, :, None] + shift
        covariances = grid.covariances[:, :, None] + added
        changes = np.repeat(self.changes, share.size, axis=2)
        changes[..., 0] *= np.tile(share, grid.weights.shape[1])
        means, covariances = (np.broadcast_to(array, (
            *weights.shape, *array.shape[3:])) for array in (means,
                                                             covariances))
        return PSFErrors(Grid(
            grid.x_grid, grid.y_grid, weights.reshape(m, -1),
            means.reshape(m, -1, 2), covariances.reshape(m, -1, 2, 2),
            grid.scales), changes, self.misfit)

    def to_columns(self):
        """Return what a file holds of the errors, a row for each place."""
        x, y = self.grid.positions.T
        return {'x': x, 'y': y, 'weight': self.grid.weights,
                'mean': self.grid.means, 'covariance': self.grid.covariances,
                'change': self.changes,
                'misfit': np.full(len(x), self.misfit)}

    @classmethod
    def from_columns(cls, columns):
        """
        Return the errors that a file holds.

        Raises
        ------
        ValueError
            If a column is missing, or they are not those of a mixture.
        """
        # Files once knew of no misfit.
        misfit = columns.get('misfit', np.zeros(1))
        missing = [name for name in COLUMNS if name not in columns
                   and name != 'misfit']
        if missing:
            msg = ('errors of a PSF must have the columns '
                   f'{", ".join(COLUMNS)}, got no {missing[0]}')
            raise ValueError(msg)
        n = len(columns['x'])
        weights = columns['weight'].reshape(n, -1)
        k = weights.shape[1]
        grid = checked_arrays(
            columns['x'], columns['y'], weights,
            columns['mean'].reshape(n, k, 2),
            columns['covariance'].reshape(n, k, 2, 2), np.ones(n))
        changes = columns['change'].reshape(n, -1, k, 6)
        if not (np.isfinite(changes).all() and np.isfinite(misfit).all()):
            msg = 'errors of a PSF must be finite, got NaN or infinity'
            raise ValueError(msg)
        return cls(grid, np.array(changes), float(misfit[0]))


def responses(design, weight, changes):
    """
    Return how fits of stars answer changes of their pixels.

    Parameters
    ----------
    design : (n, p, pixels) `~numpy.ndarray`
        The derivatives by what is fitted.
    weight : (n, pixels) `~numpy.ndarray`
        One over the variance, 0 for pixels left out.
    changes : (n, R, pixels) `~numpy.ndarray`

    Returns
    -------
    shifts : (n, p, R) `~numpy.ndarray`
        NaN for stars that cannot be fitted.
    inverse : (n, p, p) `~numpy.ndarray`
        The covariances of the fits.
    """
    weighed = design * weight[:, None]
    inverse = inverses(weighed @ design.transpose(0, 2, 1))
    return inverse @ (weighed @ changes.transpose(0, 2, 1)), inverse


def inverses(matrices):
    """Return the inverses (n, p, p), NaN where there is none."""
    scale = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    scale = scale[:, :, None] * scale[:, None]
    usable = np.isfinite(scale).all(axis=(1, 2)) & (scale > 0).all(
        axis=(1, 2))
    scaled = np.where(usable[:, None, None],
                      matrices / np.where(scale > 0, scale, 1),
                      np.eye(matrices.shape[1]))
    usable &= np.linalg.det(scaled) > 1e-12
    scaled[~usable] = np.eye(matrices.shape[1])
    out = np.linalg.inv(scaled) / np.where(scale > 0, scale, 1)
    out[~usable] = np.nan
    return out
