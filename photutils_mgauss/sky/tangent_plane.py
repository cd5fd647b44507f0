"""
The tangent plane all epochs share: gnomonic projection by unit vectors.

Plane coordinates are (xi, eta), towards east and north at the centre, in
milliarcseconds. Nothing here divides by the cosine of a declination, so any
centre will do, the poles and RA 0 included. Arrays of vectors have shape
(3, ...), of plane coordinates (2, ...).
"""
from dataclasses import dataclass
from functools import cached_property

import numpy as np

MAS = np.degrees(1) * 3.6e6  # milliarcseconds in one radian


def unit_vectors(ra, dec):
    """Return the (3, ...) unit vectors of directions given in degrees."""
    ra, dec = np.radians(ra), np.radians(dec)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra),
                     np.sin(dec) + np.zeros_like(ra)])


def directions(vectors):
    """Return right ascension in [0, 360) and declination [deg]."""
    x, y, z = vectors
    ra = np.degrees(np.arctan2(y, x)) % 360
    return ra, np.degrees(np.arctan2(z, np.hypot(x, y)))


def local_axes(vectors):
    """Return the unit vectors towards east and north at each direction."""
    ra, dec = np.radians(directions(vectors))
    zero = np.zeros_like(ra)
    east = np.stack([-np.sin(ra), np.cos(ra), zero])
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra),
                      np.cos(dec)])
    return east, north


@dataclass(frozen=True)
class TangentPlane:
    """
    The gnomonic projection about one direction.

    Parameters
    ----------
    ra, dec : float
        ICRS coordinates of the centre [deg].
    """

    ra: float
    dec: float

    @classmethod
    def around(cls, vectors):
        """Return the plane touching the sky at the mean of directions."""
        vectors = vectors.reshape(3, -1)
        if not np.isfinite(vectors).any():
            return cls(0.0, 0.0)  # there is nothing to be near to
        mean = np.nanmean(vectors, axis=1)
        return cls(*(float(angle) for angle in directions(mean)))

    @cached_property
    def axes(self):
        """The (3, 3) rows: centre, east, north."""
        centre = unit_vectors(self.ra, self.dec)
        return np.stack([centre, *local_axes(centre)])

    def project(self, vectors):
        """Return (xi, eta) [mas]; NaN for 89 degrees off and beyond."""
        depth, east, north = np.tensordot(self.axes, vectors, axes=1)
        depth = np.where(depth > np.cos(np.radians(89)), depth, np.nan)
        return np.stack([east, north]) * (MAS / depth)

    def deproject(self, plane):
        """Return the (3, ...) unit vectors of plane coordinates [mas]."""
        centre, east, north = self.axes
        xi, eta = np.asarray(plane) / MAS
        vectors = (np.multiply.outer(centre, np.ones_like(xi))
                   + np.multiply.outer(east, xi)
                   + np.multiply.outer(north, eta))
        return vectors / np.sqrt(1 + xi**2 + eta**2)

    def local_jacobian(self, plane):
        r"""
        Return the (2, 2, ...) matrix from local to plane displacements.

        Its columns are the displacements :math:`\partial(\xi, \eta)` for one
        unit along local :math:`\alpha^*` and :math:`\delta`.
        """
        axes = local_axes(self.deproject(plane))
        return np.stack([self.displacement(plane, tangent)
                         for tangent in axes], axis=1)

    def local_inverse(self, plane):
        """Return the (2, 2, ...) matrix from plane to local displacements."""
        (a, b), (c, d) = self.local_jacobian(plane)
        return np.stack([np.stack([d, -b]),
                         np.stack([-c, a])]) / (a * d - b * c)

    def displacement(self, plane, shift):
        r"""
        Return the plane displacement for a small ``shift`` of the vectors.

        For a unit vector :math:`u` with plane coordinates :math:`\xi` that
        moves by :math:`s`, and the axes :math:`c` (centre) and :math:`e`,

        .. math:: d\xi = \frac{s \cdot e - \xi\,(s \cdot c)}{u \cdot c}.
        """
        depth, east, north = np.tensordot(self.axes, shift, axes=1)
        xi, eta = np.asarray(plane) / MAS
        stretch = np.sqrt(1 + xi**2 + eta**2)
        return np.stack([(east - xi * depth) * stretch,
                         (north - eta * depth) * stretch])

    def parallax_factors(self, plane, observer):
        """
        Return the displacement (2, ...) for one unit of parallax.

        ``observer`` is the barycentric position (3, ...) [au].
        """
        return -self.displacement(plane, observer)
