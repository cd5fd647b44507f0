"""
The PSF at many positions of a tile, as few Gaussians as possible.

Between four nodes of a grid the PSF is a sum of 4 K Gaussians, in four
families of similar ones. Where one Gaussian with the weight, mean and
covariance of its family can stand for it, K Gaussians do.
"""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.psf.base import PSFModel
from photutils_mgauss.psf.grid import cells, match
from photutils_mgauss.psf.rows import falls, kernel_rows

# How far wings are followed [pix], of wide PSFs further.
MAX_WING = 60
# Lengths that suit PSFs of up to this area, of a FWHM of about 3 pixels, are
# larger in proportion for wider ones [pix^2].
_USUAL_AREA = 30.0
# A cell's families are merged if that changes no pixel by more than this
# fraction of the peak.
_MERGE_TOLERANCE = 1e-3


@dataclass(frozen=True)
class LocalPSF:
    """
    A PSF grid in the coordinates of a tile.

    ``weights`` (M, K), ``means`` (M, K, 2) and ``covariances`` (M, K, 2, 2)
    are those of the nodes, weights in units of flux on the detector;
    ``order`` (cells along y, along x, 4, K) says which Gaussians of a cell's
    corners form a family, ``merged`` which cells' families are merged.
    ``profile`` is the brightest pixel at each distance from a star in the
    middle of the grid, ``area`` [pix^2] how large that star is.
    """

    x_grid: np.ndarray
    y_grid: np.ndarray
    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    integrated: bool | None
    order: np.ndarray
    merged: np.ndarray
    profile: np.ndarray | None = None
    area: float | None = None

    @classmethod
    def from_nodes(cls, x_grid, y_grid, weights, means, covariances,
                   integrated):
        """Find families and which of them can be merged."""
        shape = (max(y_grid.size - 1, 1), max(x_grid.size - 1, 1))
        k = weights.shape[1]
        order = np.tile(np.arange(k), (*shape, 4, 1))
        psf = cls(x_grid, y_grid, weights, means, covariances, integrated,
                  order, np.zeros(shape, bool))
        for j, i in np.ndindex(shape):
            psf._join_families(j, i)
        middle = x_grid.mean(), y_grid.mean()
        psf = replace(psf, area=_area(psf.stamp(*middle, MAX_WING)))
        return replace(psf, profile=_profile(psf.stamp(*middle,
                                                       psf.max_wing)))

    @classmethod
    def of(cls, model):
        """Return the PSF of a GriddedMixturePSF or MultiGaussianPSFModel."""
        if not isinstance(model, PSFModel):
            msg = ('psf_model must be a GriddedMixturePSF or a '
                   f'MultiGaussianPSFModel, got {model!r:.80}')
            raise TypeError(msg)
        grid = model.grid
        return cls.from_nodes(
            grid.x_grid, grid.y_grid, grid.weights * grid.scales[:, None],
            grid.means, grid.covariances, model.pixel_integrated or None)

    @property
    def scale(self):
        """By what lengths exceed those that suit narrow PSFs, at least 1."""
        return max(1.0, np.sqrt(self.area / _USUAL_AREA))

    @property
    def max_wing(self):
        """How far wings are followed [pix]."""
        return int(np.ceil(MAX_WING * self.scale))

    @property
    def n_rows(self):
        """The largest number of Gaussians of a star."""
        k = self.weights.shape[1]
        return k if self.merged.all() else 4 * k

    def moved(self, x, y):
        """Return the PSF with the origin of coordinates at (x, y)."""
        return replace(self, x_grid=self.x_grid - x, y_grid=self.y_grid - y)

    def _corners(self, j, i):
        i_next = np.minimum(i + 1, self.x_grid.size - 1)
        j_next = np.minimum(j + 1, self.y_grid.size - 1)
        n = self.x_grid.size
        return np.stack([j * n + i, j * n + i_next, j_next * n + i,
                         j_next * n + i_next], axis=-1)

    def _join_families(self, j, i):
        stack = (self.weights, self.means, self.covariances)
        first, *others = ([array[corner] for array in stack]
                          for corner in self._corners(j, i))
        for c, other in enumerate(others, 1):
            self.order[j, i, c] = match(first, other)
        x, y = self._middle(j, i)
        exact = self._stamp(*self.rows_at(x, y))
        self.merged[j, i] = True
        change = np.abs(self._stamp(*self.rows_at(x, y)) - exact).max()
        self.merged[j, i] = change <= _MERGE_TOLERANCE * exact.max()

    def _middle(self, j, i):
        out = []
        for cell, nodes in ((i, self.x_grid), (j, self.y_grid)):
            after = min(cell + 1, nodes.size - 1)
            out.append(np.array([(nodes[cell] + nodes[after]) / 2]))
        return out

    def _stamp(self, rows, count):
        stamp = np.zeros((17, 17))
        kernels.render(rows[0, :count[0]], 8.0, 8.0, 1.0, self.integrated,
                       stamp)
        return stamp

    def rows_at(self, x, y):
        """
        Return the Gaussians of stars of unit flux at positions (n,).

        Returns
        -------
        rows : (n, n_rows, 6) `~numpy.ndarray`
        count : (n,) `~numpy.ndarray` of int
            How many of the rows are used.
        """
        i, fx = cells(x, self.x_grid)
        j, fy = cells(y, self.y_grid)
        share = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy,
                          fx * fy], axis=1)
        node = self._corners(j, i)[..., None]
        order = self.order[j, i]
        weights = share[..., None] * self.weights[node, order]
        means = self.means[node, order]
        covariances = self.covariances[node, order]
        n, _, k = weights.shape
        merged = self.merged[j, i]
        count = np.where(merged, k, 4 * k)
        rows = np.zeros((n, self.n_rows, 6))
        one = merged
        rows[one, :k] = _merge(weights[one], means[one], covariances[one])
        four = ~merged
        if four.any():
            rows[four] = kernel_rows(weights[four], means[four],
                                     covariances[four]).reshape(-1, 4 * k, 6)
        return rows, count

    def gaussians_at(self, x, y):
        """Return the PSFs of stars at positions (n,) for the kernels."""
        rows, count = self.rows_at(x, y)
        return kernels.Gaussians(rows, falls(rows), count, self.integrated)

    def stamp(self, x, y, half):
        """Draw a star of unit flux in the middle of a stamp."""
        place = (np.array([float(one)]) for one in (x, y))
        return self.stamps(*place, half, [(0, 0)])[0, 0]

    def stamps(self, x, y, half, shifts):
        """
        Draw stars of unit flux at places (n,), in the middle of stamps.

        Each is drawn anew shifted by each of m (x, y) tuples. The outcome is
        (n, m, 2 half + 1, 2 half + 1).
        """
        rows, count = self.rows_at(x, y)
        side = 2 * half + 1
        out = np.zeros((x.size, len(shifts), side, side))
        for i, n in enumerate(count):
            for (dx, dy), stamp in zip(shifts, out[i], strict=True):
                kernels.render(rows[i, :n], half + float(dx),
                               half + float(dy), 1.0, self.integrated, stamp)
        return out


def _area(stamp):
    return stamp.sum()**2 / (stamp**2).sum()


def _profile(stamp):
    """Return the brightest pixel at each distance, never rising."""
    half = len(stamp) // 2
    distance = np.hypot(*np.mgrid[-half:half + 1, -half:half + 1])
    ring = np.rint(distance).astype(int).ravel()
    top = np.zeros(ring.max() + 1)
    np.maximum.at(top, ring, stamp.ravel())
    return np.maximum.accumulate(top[half::-1])[::-1]


def _merge(weights, means, covariances):
    """Return the rows (n, K, 6) of the families along axis 1."""
    total = weights.sum(axis=1)
    safe = np.where(total == 0, 1, total)
    part = weights / safe[:, None]
    # Families of weight zero keep any shape.
    part = np.where(total[:, None] == 0, 0.25, part)
    mean = (part[..., None] * means).sum(axis=1)
    offset = means - mean[:, None]
    spread = covariances + offset[..., :, None] * offset[..., None, :]
    return kernel_rows(total, mean,
                       (part[..., None, None] * spread).sum(axis=1))
