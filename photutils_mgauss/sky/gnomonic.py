r"""
WCS that are gnomonic, as matrices: no trigonometry for any star.

Once the distortions of a pixel (x, y) are removed, its direction is that of

.. math:: h = M\,(x, y, 1)^T,

so that places on a tangent plane are ratios of linear functions, and their
derivatives are exact.
"""
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS

from photutils_mgauss.sky.tangent_plane import MAS, local_axes, unit_vectors

CTYPES = [['RA---TAN', 'DEC--TAN'], ['RA---TAN-SIP', 'DEC--TAN-SIP']]
NEAREST = np.cos(np.radians(89))  # to the horizon of a plane
SAMPLE = 9  # pixels at which the WCS itself is asked
AGREE = 1e-13  # radians, less than the rounding of an angle in degrees
STEP = 0.5  # pixels either side for derivatives of distortions


@dataclass(frozen=True, eq=False)
class Gnomonic:
    """
    The map of a WCS as a matrix.

    Parameters
    ----------
    matrix : (3, 3) `~numpy.ndarray`
        From (x, y, 1) to ICRS directions of any length.
    wcs : `~astropy.wcs.WCS` or None
        What removes distortions of pixels, None where there are none.
    """

    matrix: np.ndarray
    wcs: WCS | None

    @classmethod
    def of(cls, wcs, x, y):
        """
        Return the map of a WCS for pixels (n,), None if it is none such.

        The WCS itself is asked at some of them.
        """
        found = cls._thought(wcs)
        return found if found and found._holds(wcs, x, y) else None

    @classmethod
    def inverted(cls, wcs, vectors):
        """
        Return the pixels x and y (n,) of unit vectors (3, n), NaN behind.

        None for a WCS that is none such or has distortions.
        """
        found = cls._thought(wcs)
        if found is None or found.wcs is not None:
            return None
        x, y, depth = np.tensordot(np.linalg.inv(found.matrix), vectors,
                                   axes=1)
        depth = np.where(depth > 0, depth, np.nan)
        x, y = x / depth, y / depth
        return (x, y) if found._holds(wcs, x, y) else None

    @classmethod
    def _thought(cls, wcs):
        """Return the map that the keywords of an ICRS WCS speak of."""
        if type(wcs) is not WCS or list(wcs.wcs.ctype) not in CTYPES or (
                wcs.pixel_bounds is not None or wcs.wcs.get_pv()):
            return None
        if wcs.wcs.radesys != 'ICRS' and (
                wcs.wcs.radesys or np.isfinite(wcs.wcs.equinox)):
            return None
        return cls(_matrix(wcs), wcs if wcs.has_distortion else None)

    def _holds(self, wcs, x, y):
        """Return whether a WCS says the same of some pixels."""
        x, y = np.ravel(x), np.ravel(y)
        some = np.flatnonzero(np.isfinite(x + y))
        some = some[::max(1, len(some) // SAMPLE)]
        asked = unit_vectors(*wcs.all_pix2world(x[some], y[some], 0))
        away = np.abs(self.vectors(x[some], y[some]) - asked)
        return bool((away < AGREE).all())

    def vectors(self, x, y):
        """Return the unit vectors (3, n) of pixels."""
        out = _linear(self.matrix, *self._undistorted(x, y))
        out /= np.sqrt((out * out).sum(axis=0))
        return out

    def jacobian(self, plane, x, y, turn=None):
        """Return d(plane)/d(pixel), see `pixel_jacobian`."""
        matrix = self.matrix if turn is None else turn @ self.matrix
        matrix = plane.axes @ matrix
        depth, *place = _linear(matrix, *self._undistorted(x, y))
        length = np.sqrt(depth * depth + place[0]**2 + place[1]**2)
        depth[~(depth > NEAREST * length)] = np.nan
        out = np.empty((2, 2, *np.shape(x)))
        for row, side, slope in zip(out, place, matrix[1:], strict=True):
            along = side / depth
            for k in (0, 1):
                row[k] = (slope[k] - matrix[0, k] * along) * (MAS / depth)
        if self.wcs is None:
            return out
        return np.einsum('ij...,jk...->ik...', out, self._bending(x, y))

    def _undistorted(self, x, y):
        return (x, y) if self.wcs is None else self.wcs.pix2foc(x, y, 0)

    def _bending(self, x, y):
        """Return d(undistorted)/d(pixel), (2, 2, n)."""
        columns = []
        for dx, dy in ((STEP, 0), (0, STEP)):
            after, before = (np.stack(self._undistorted(
                x + sign * dx, y + sign * dy)) for sign in (1, -1))
            columns.append((after - before) / (2 * STEP))
        return np.stack(columns, axis=1)


def _linear(matrix, x, y):
    """Return M (x, y, 1), (3, n)."""
    return np.stack([row[0] * x + row[1] * y + row[2] for row in matrix])


def _matrix(wcs):
    """Return the matrix of a WCS."""
    wcs.wcs.set()  # Units and the pole are what they will be from now on.
    centre = unit_vectors(*wcs.wcs.crval)
    turn = np.radians(wcs.wcs.lonpole - 180)
    sine, cosine = np.sin(turn), np.cos(turn)
    steps = np.array([[cosine, sine], [-sine, cosine]]) @ np.radians(
        wcs.pixel_scale_matrix)
    columns = np.stack(local_axes(centre), axis=1) @ steps
    return np.column_stack([columns, centre - columns @ (
        wcs.wcs.crpix - 1)])
