"""
Diffuse light of a tile: galaxies, nebulae, stars that are not resolved.

It is what stars and the background's nodes leave over where it is smooth,
on as small a scale as it can be told from noise and from stars not found:
on an even sky there is none.
"""
import numpy as np
from scipy.ndimage import convolve, gaussian_filter, median_filter

from photutils_mgauss.crowded.background import Mesh

# The light is known in blocks of so many pixels a side.
_BLOCK = 8
# It is looked for on scales of so many blocks (Gaussian, standard deviation),
# and their noise is an average over the first.
_SCALES = (4.0, 2.0, 1.0, 0.5)
# Light of less than so many standard errors is none; of more, it counts for
# what it exceeds that.
_LEAST = 4.0
# Pixels further than this from the light beneath them count for less.
_HUBER = 1.5
_ROUNDS = 3
# The least noise of blocks in units of what information says.
_ROUNDING = 1e-12
_ROUGH = np.outer([1, -2, 1], [1, -2, 1]) / 6


class Diffuse:
    """
    Smooth light as levels of blocks, between which it is bilinear.

    Parameters
    ----------
    shape, origin : (y, x) tuple of int
        The pixels of the tile, and where in the image its first one is.
    scale : float, optional
        By what blocks are wider, for a wide PSF.
    """

    def __init__(self, shape, origin, scale=1.0):
        self.mesh = Mesh(shape, origin, scale * _BLOCK)
        self.level = np.zeros(self.mesh.size)

    def image(self):
        """Return the light (ny, nx)."""
        return self.mesh.image(self.level)

    def begin(self, data, good, noise, mesh):
        """
        Find the light under stars of which none is known yet.

        Returns by how much the levels of a mesh of wider nodes are to rise.
        """
        faint = self.mesh.faint_level(data, good, noise)
        wide = self._take(faint, np.full(faint.size, noise**-2.0), mesh, noise)
        # Stars are under it yet: no more than what stands out is believed.
        self.level = _beyond(self.level, noise)
        return wide

    def bound(self, data, good, noise, mesh, level, lowest):
        """
        Note between what levels light and sky together have to be.

        Stars only add light: there is no more of all else than in the median
        pixel of most blocks around, and no less than the lowest levels of the
        mesh; both, as the data, above levels of the mesh.
        """
        places = tuple(self._places())
        sky = mesh.at(*places, level)
        self._low = sky + lowest[mesh.owners(*places)]
        middle = self.mesh.medians(data, good).reshape(self.mesh.shape)
        self._high = sky + median_filter(middle, 3).ravel() + 3 * noise

    def keep_bounds(self, mesh, level):
        """Make the light keep its bounds above levels of the mesh."""
        sky = mesh.at(*self._places(), level)
        self.level = np.clip(self.level, self._low - sky, self._high - sky)

    def _places(self):
        """Return x and y of the blocks (n,)."""
        return (v.ravel() for v in np.meshgrid(self.mesh.x, self.mesh.y))

    def update(self, residual, weight, mesh, noise):
        """Find the light in what stars and sky have left over; see `begin`."""
        excess = residual + self.image()
        level = self.level
        for _ in range(_ROUNDS):
            rest = excess - self.mesh.image(level)
            far = np.abs(rest) * np.sqrt(weight)
            level, information = self.mesh.means(
                weight / np.maximum(far / _HUBER, 1), excess)
        return self._take(level, information, mesh, noise)

    def _take(self, level, information, mesh, noise):
        """Divide blocks' levels between a mesh of wider nodes and the rest."""
        x, y = self._places()
        wide = _node_means(mesh, x, y, level, information)
        self.level = self._smooth(level - mesh.at(x, y, wide), information)
        # The joint fit finds levels better, but not from far away.
        return _beyond(wide, noise)

    def _smooth(self, level, information):
        """Return what of blocks' levels is smooth, and significantly so."""
        shape = self.mesh.shape
        level, information = level.reshape(shape), information.reshape(shape)
        noise = _noise(level, information)
        light = np.zeros(shape)
        for scale in _SCALES:
            mean, error = _local_mean(level - light, information, noise,
                                      scale)
            light += _beyond(mean, _LEAST * error)
        return light.ravel()


def _beyond(level, least):
    """Return levels, smaller ones the less the nearer to the least of all."""
    return level * np.maximum(
        1 - (least / np.maximum(np.abs(level), 1e-9 * least))**2, 0)


def _node_means(mesh, x, y, level, information):
    """Return the mean over each node of a mesh of levels at positions."""
    owner = mesh.owners(x, y)
    total, seen = (np.bincount(owner, part, mesh.size)
                   for part in (information * level, information))
    return np.divide(total, seen, where=seen > 0, out=np.zeros(mesh.size))


def _noise(level, information):
    """Return the noise of blocks in units of what information says."""
    # Of curved light this leaves nothing, of noise all.
    square = information * convolve(level, _ROUGH)**2
    known = (information > 0).astype(float)
    return gaussian_filter(square, _SCALES[0]) / np.maximum(
        gaussian_filter(known, _SCALES[0]), 1e-3)


def _local_mean(level, information, noise, scale):
    """Return the mean around each block, and its standard error."""
    total = np.maximum(gaussian_filter(information, scale),
                       1e-6 * information.max())
    mean = gaussian_filter(information * level, scale) / total
    # Of white noise a Gaussian of this size leaves so much.
    n_blocks = max(4 * np.pi * scale**2, 1)
    # Of an image without noise rounding is left.
    return mean, np.sqrt((noise + _ROUNDING) / (total * n_blocks))
