"""
One grid of pixels for images that lie on each other in any way.

The grid has the axes and the scale of the first image and covers all. Between
nodes the maps to the images' own pixels are cubic splines, so that a WCS is
asked once, and not again for every star.
"""
import warnings
from dataclasses import dataclass

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.utils.exceptions import AstropyUserWarning
from scipy.interpolate import RectBivariateSpline

from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.wcs import (
    invert_wcs,
    pixel_jacobian,
    pixel_to_vectors,
)

# Distance of the nodes [pix], and how far they go beyond what they serve for.
_SPACING = 32
_BEYOND = 2
# Between nodes a map may be off by this much before it is said [pix].
_SMOOTH = 1e-3
# The grid may not grow beyond this many times the largest image.
_GROWTH = 9


@dataclass(frozen=True, eq=False)
class PixelMap:
    """
    From columns u and rows v of one lattice of pixels to x and y of another.

    ``splines`` are those of x and y, as functions of v and u.
    """

    splines: tuple

    @classmethod
    def of(cls, shape, function):
        """Return the map that a function (2, n) -> (2, n) is on a shape."""
        v, u = (_nodes(n) for n in shape)
        place = np.stack([part.ravel() for part in np.meshgrid(u, v)])
        value = function(place).reshape(2, v.size, u.size)
        return cls(tuple(RectBivariateSpline(v, u, one) for one in value))

    def __call__(self, u, v):
        """Return x and y at positions (n,)."""
        return np.stack([spline.ev(v, u) for spline in self.splines])

    def slopes(self, u, v):
        """Return the derivatives (n, 2, 2) of x and y by u and v."""
        return np.stack([np.stack([spline.ev(v, u, dy=1),
                                   spline.ev(v, u, dx=1)], axis=-1)
                         for spline in self.splines], axis=-2)

    def on_grid(self, u, v):
        """Return x and y (2, rows, columns) for all pairs, both rising."""
        return np.stack([spline(v, u) for spline in self.splines])


@dataclass(frozen=True, eq=False)
class PixelGrid:
    """
    Points of a plane, a pixel apart, and where they are in E images.

    Attributes
    ----------
    plane : TangentPlane
    origin : (2,) `~numpy.ndarray`
    matrix : (2, 2) `~numpy.ndarray`
        They make places of the plane [mas] of columns and rows.
    shape : (rows, columns) tuple of int
    to_image, to_grid : list of PixelMap
        From the grid to the pixels of each image, and back.
    """

    plane: TangentPlane
    origin: np.ndarray
    matrix: np.ndarray
    shape: tuple
    to_image: list
    to_grid: list

    @classmethod
    def of(cls, frames, shapes):
        """
        Return the grid of images.

        Parameters
        ----------
        frames : (E,) sequence of APE 14 WCS
        shapes : (E,) sequence of (ny, nx) tuple of int

        Raises
        ------
        ValueError
            If a WCS does not know its corners, or images lie far apart.

        Warns
        -----
        AstropyUserWarning
            If a WCS is not smooth.
        """
        corners = [pixel_to_vectors(wcs, *_corners(shape), bounded=False)
                   for wcs, shape in zip(frames, shapes, strict=True)]
        for k, one in enumerate(corners):
            if not np.isfinite(one).all():
                msg = ('images must have a WCS that knows their corners, got '
                       f'none that does in image {k}')
                raise ValueError(msg)
        plane = TangentPlane.around(np.concatenate(corners, axis=1))
        ny, nx = shapes[0]
        matrix = pixel_jacobian(frames[0], plane, np.array([(nx - 1) / 2]),
                                np.array([(ny - 1) / 2]))[..., 0]
        inside = np.linalg.inv(matrix) @ plane.project(
            np.concatenate(corners, axis=1))
        low, high = np.floor(inside.min(axis=1)), inside.max(axis=1)
        shape = tuple(int(n) for n in np.ceil(high - low)[::-1] + 1)
        if not np.prod(shape, dtype=float) < _GROWTH * max(
                map(np.prod, shapes)):
            middles = np.array([plane.project(one).mean(axis=1)
                                for one in corners])
            away = np.hypot(*(middles - np.median(middles, axis=0)).T)
            msg = ('images must lie on each other to be fitted together, got '
                   f'fields that need {shape[1]} x {shape[0]} pixels; image '
                   f'{np.argmax(away)} is the farthest from the others')
            raise ValueError(msg)
        return cls(plane, matrix @ low, matrix, shape, [], [])._mapped(
            frames, shapes)

    def _mapped(self, frames, shapes):
        for k, (wcs, shape) in enumerate(zip(frames, shapes, strict=True)):
            there, back = _into(self, wcs, k), _out_of(self, wcs)
            self.to_image.append(PixelMap.of(self.shape, there))
            self.to_grid.append(PixelMap.of(shape, back))
            _check_smooth(self.to_grid[-1], back, shape, k)
        return self

    def vectors(self, u, v):
        """Return the directions (3, n) of positions."""
        return self.plane.deproject(self.origin[:, None]
                                    + self.matrix @ np.stack([u, v]))

    def positions(self, vectors):
        """Return columns and rows (2, n) of directions."""
        return np.linalg.inv(self.matrix) @ (
            self.plane.project(vectors) - self.origin[:, None])


def _corners(shape):
    ny, nx = shape
    return (np.array([0.0, nx - 1, 0, nx - 1]),
            np.array([0.0, 0, ny - 1, ny - 1]))


def _nodes(size):
    n = max(-(-size // _SPACING), 1) + 2 * _BEYOND + 1
    return (np.arange(n) - _BEYOND) * float(_SPACING)


def _into(grid, wcs, k):
    """Return the function from the grid to pixels of a WCS."""
    def pixels(place):
        x, y = invert_wcs(wcs, SkyCoord(*directions(grid.vectors(*place)),
                                        unit='deg'))
        if not (np.isfinite(x) & np.isfinite(y)).all():
            msg = ('images must have a WCS that can be inverted over all '
                   f'fields, got one that cannot in image {k}')
            raise ValueError(msg)
        return np.stack([x, y])
    return pixels


def _out_of(grid, wcs):
    """Return the function from pixels of a WCS to the grid."""
    return lambda place: grid.positions(pixel_to_vectors(wcs, *place,
                                                         bounded=False))


def _check_smooth(spline_map, function, shape, k):
    """Warn if a map is not what the WCS says between nodes."""
    v, u = (_nodes(n)[_BEYOND:-_BEYOND - 1] + _SPACING / 2 for n in shape)
    place = np.stack([part.ravel() for part in np.meshgrid(u, v)])
    off = np.abs(spline_map(*place) - function(place)).max()
    if not off < _SMOOTH:
        warnings.warn(
            f'The WCS of image {k} is not smooth over {_SPACING} pixels: '
            f'positions of its stars are off by up to {off:.2g} pixels.',
            AstropyUserWarning, stacklevel=2)
