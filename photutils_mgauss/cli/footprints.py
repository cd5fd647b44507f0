"""Where images lie on the sky, and which of them overlap."""
from functools import cached_property

import numpy as np
from astropy.coordinates import SkyCoord
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

# Points along each side of an image by which overlaps are measured, and the
# degree of the polynomials that lead back from the sky to the image.
_POINTS, _DEGREE = 12, 3


class Footprint:
    """
    The sky that an image shows.

    It is small, and knows nothing of the WCS any more: points spread over the
    image, and polynomials that take directions to shares of the image.

    Parameters
    ----------
    wcs : WCS
        That of the image.
    shape : (int, int)
        Its pixels, (ny, nx).

    Raises
    ------
    ValueError
        If the WCS gives no places for the image.
    """

    def __init__(self, wcs, shape):
        ny, nx = shape
        lattice = (np.arange(_POINTS) + 0.5) / _POINTS
        self._shares = np.array(np.meshgrid(lattice, lattice)).reshape(2, -1)
        x, y = self._shares[0] * nx - 0.5, self._shares[1] * ny - 0.5
        places = SkyCoord(wcs.pixel_to_world(x, y)).cartesian
        points = np.stack([places.x.value, places.y.value, places.z.value], 1)
        good = np.isfinite(points).all(axis=1)
        if not good.any():
            msg = 'its WCS must give places on the sky, got none'
            raise ValueError(msg)
        self.points, self._shares = points[good], self._shares[:, good]
        middle = self.points.mean(axis=0)
        self.middle = middle / np.linalg.norm(middle)
        # The distance of the corners from the middle, as a chord.
        self.reach = (np.linalg.norm(self.points - self.middle, axis=1).max()
                      * _POINTS / (_POINTS - 1))

    @cached_property
    def _axes(self):
        """Two directions (2, 3) at right angles to the middle."""
        other = np.eye(3)[np.argmin(np.abs(self.middle))]
        first = np.cross(self.middle, other)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.middle, first)])

    def _terms(self, points):
        """Return the terms (n, terms) of polynomials at directions (n, 3)."""
        u, v = (points @ self._axes.T / (points @ self.middle)[:, None]
                / self.reach).T
        return np.stack([u**i * v**j for i in range(_DEGREE + 1)
                         for j in range(_DEGREE + 1 - i)], axis=1)

    @cached_property
    def _way_back(self):
        return np.linalg.lstsq(self._terms(self.points), self._shares.T,
                               rcond=None)[0]

    def share_inside(self, other):
        """Return the share of this image that another one shows."""
        # Far from the other image its polynomials say nothing.
        near = np.linalg.norm(self.points - other.middle,
                              axis=1) <= other.reach * 1.1
        if not near.any():
            return 0.0
        shares = other._terms(self.points[near]) @ other._way_back
        inside = np.all(np.abs(shares - 0.5) <= 0.5, axis=1)
        return float(inside.sum() / len(self.points))


def overlaps(footprints, groups):
    """
    Return the pairs of images that overlap, and by how much.

    Parameters
    ----------
    footprints : list of Footprint
        Those of the images.
    groups : list
        Only images with equal values are compared.

    Returns
    -------
    (n, 2) `~numpy.ndarray`, (n,) `~numpy.ndarray`
        Numbers of images, and the share of the image that has more in
        common with the other.
    """
    middles = np.array([one.middle for one in footprints])
    reach = np.array([one.reach for one in footprints])
    pairs = KDTree(middles).query_pairs(2.1 * reach.max(),
                                        output_type='ndarray')
    pairs = np.array([pair for pair in pairs
                      if groups[pair[0]] == groups[pair[1]]],
                     dtype=int).reshape(-1, 2)
    share = np.array([max(footprints[i].share_inside(footprints[j]),
                          footprints[j].share_inside(footprints[i]))
                      for i, j in pairs])
    return pairs[share > 0], share[share > 0]


def connected(pairs, n):
    """Return lists of the numbers below n that pairs (m, 2) connect."""
    _, label = connected_components(coo_matrix(
        (np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n)), directed=False)
    return [np.flatnonzero(label == k).tolist()
            for k in range(label.max() + 1)]
