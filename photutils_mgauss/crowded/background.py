"""The background of a tile of a crowded field: a mesh of nodes."""
import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.psf.local import cells

# How strongly neighbouring nodes are tied, in units of a node's information.
_TIE = 1e-3


class Mesh:
    """
    Nodes of a bilinear background, at multiples of the spacing.

    A node is the mean of the sky over the pixels nearest to it, so that it
    depends on nothing further away. Levels are flat, ordered by y, then x.

    Parameters
    ----------
    shape, origin : (y, x) tuple of int
        The pixels of the tile, and where in the image its first one is.
    spacing : float
        The distance of nodes [pix].
    """

    def __init__(self, shape, origin, spacing):
        self.y, self.x = (_lattice(first, n, spacing) - first
                          for first, n in zip(origin, shape, strict=True))
        self.shape = self.y.size, self.x.size
        pixels = [np.arange(float(n)) for n in shape]
        self._rows, self._columns = (
            cells(p, nodes) for p, nodes in zip(pixels, (self.y, self.x),
                                                strict=True))
        self._owner = [np.searchsorted((nodes[1:] + nodes[:-1]) / 2, p,
                                       side='right')
                       for p, nodes in zip(pixels, (self.y, self.x),
                                           strict=True)]
        self.tie = _TIE * spacing**2

    def image(self, level):
        """Return the background (ny, nx) of levels (n,)."""
        level = level.reshape(self.shape)
        row, passed = self._rows
        passed = passed[:, None]
        level = (1 - passed) * level[row] + passed * level[row + 1]
        column, passed = self._columns
        return (1 - passed) * level[:, column] + passed * level[:, column + 1]

    @property
    def size(self):
        """The number of nodes."""
        return self.shape[0] * self.shape[1]

    def sums(self, weight, residual, background, clip):
        """Return the sums (3, n) over nodes' pixels of `mesh_sums`."""
        out = np.empty((self.size, 3))
        kernels.mesh_sums(weight, residual, background, *self._owner,
                          self.shape[1], clip, out)
        return out.T.copy()

    def n_ties(self):
        """Return to how many neighbours each node is tied (n,)."""
        ny, nx = self.shape
        j, i = np.indices(self.shape)
        return (4.0 - (j == 0) - (j == ny - 1) - (i == 0)
                - (i == nx - 1)).ravel()

    def steepness(self, level):
        """Return the sum (n,) of what each level is above its neighbours."""
        level = level.reshape(self.shape)
        out = np.zeros(self.shape)
        for axis in (0, 1):
            step = np.diff(level, axis=axis)
            ends = [(0, 0), (0, 0)]
            ends[axis] = (1, 1)
            out -= np.diff(np.pad(step, ends), axis=axis)
        return out.ravel()

    def faint_level(self, data, good):
        """Return the faint percentile (n,) of each node's good pixels."""
        level = self._percentiles(data, good, 20)
        known = np.isfinite(level)
        return np.where(known, level, np.median(level[known]))

    def limits(self, data, good, noise):
        """Return two levels (n,) between which the sky has to be."""
        # Where stars hide all of it nothing else tells.
        low, middle = self._percentiles(data, good, [1, 50])
        low, high = (2 * low - middle - 3 * noise,
                     2 * middle - low + 3 * noise)
        return (np.where(np.isfinite(low), low, -np.inf),
                np.where(np.isfinite(high), high, np.inf))

    def _percentiles(self, data, good, which):
        """Return percentiles (..., n) of each node's good pixels, or NaN."""
        out = np.full((*self.shape, *np.shape(which)), np.nan)
        for j, i in np.ndindex(self.shape):
            part = np.ix_(self._owner[0] == j, self._owner[1] == i)
            seen = data[part][good[part]]
            if seen.size:
                out[j, i] = np.percentile(seen, which)
        return out.reshape(self.size, *np.shape(which)).T

    def shares(self, x, y):
        """Return the four nodes around positions and their shares (n, 4)."""
        n = self.x.size
        column, fx = cells(x, self.x)
        row, fy = cells(y, self.y)
        node = (row * n + column)[:, None] + np.array([0, 1, n, n + 1])
        share = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy,
                          fx * fy], axis=1)
        return node, share


def _lattice(first, size, spacing):
    """Return the multiples of spacing that are nearest to a pixel."""
    low = np.floor(first / spacing + 0.5)
    high = max(np.floor((first + size - 1) / spacing + 0.5), low + 1)
    return np.arange(low, high + 1) * float(spacing)
