"""
The distortion of the chips of a camera, one for all exposures.

An exposure has one map onto the common plane. What is left of each chip, its
place in the camera and the distortion in it, is a polynomial in its pixels
that is the same in all exposures.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.sky.transforms import Transform


@dataclass(frozen=True, eq=False)
class Distortion:
    """
    How the polynomials of C chips move the n stars at E epochs.

    Parameters
    ----------
    names : list
        Of the chips.
    number : (E, n) int `~numpy.ndarray`
        The chip of each detection, -1 where there is none.
    basis : (b, E, n) `~numpy.ndarray`
        Polynomials at the pixels; 0 where there is no chip.
    jacobian : (2, 2, E, n) `~numpy.ndarray`
        d(plane)/d(pixel); 0 where there is no chip.
    transforms : list of `~photutils_mgauss.sky.transforms.Transform`
        The scaled pixel coordinates of each chip.
    sigma : float or (2, b) `~numpy.ndarray`
        What is expected of a coefficient [pix].
    """

    names: list
    number: np.ndarray
    basis: np.ndarray
    jacobian: np.ndarray
    transforms: list
    sigma: float

    # Whether the map of an exposure can be written as such polynomials.
    has_maps = True

    def none(self):
        """Return the coefficients (C, 2, b) [pix] of no distortion."""
        return np.zeros((len(self.names), 2, len(self.basis)))

    def shift(self, coefficients):
        """Return the displacements (2, E, n) in the plane."""
        out = np.zeros((2, *self.number.shape))
        for e in range(len(self.number)):
            own = coefficients[self.number[e]]
            pixels = np.einsum('ncb,bn->cn', own, self.basis[:, e])
            out[:, e] = np.einsum('xcn,cn->xn', self.jacobian[:, :, e],
                                  pixels)
        return out

    def pixels(self, coefficients, name, x, y):
        """Return corrected pixels of a chip."""
        k = self.names.index(name)
        moved = coefficients[k] @ self.transforms[k].basis(np.stack([x, y]))
        return x + moved[0], y + moved[1]


def distortion_of(sightings, kind, sigma):
    """
    Return the `Distortion` of the epochs of chips, None without chips.

    Parameters
    ----------
    sightings : `~photutils_mgauss.motions.assemble.Sightings`
    kind : `~photutils_mgauss.sky.transforms.Transform`
        Of which the degree counts.
    sigma : float
        Of a coefficient [mas].
    """
    names = sightings.chips
    if not names or kind.kind == 'none':
        return None
    points = sightings.pixels
    number = np.where(np.isfinite(points).all(axis=0), sightings.chip, -1)
    transforms = [_coordinates(kind, points[:, number == k])
                  for k in range(len(names))]
    basis = np.zeros((kind.n_terms, *number.shape))
    for k, transform in enumerate(transforms):
        basis[:, number == k] = transform.basis(points[:, number == k])
    jacobian = np.where(number >= 0, np.nan_to_num(sightings.jacobian), 0.0)
    scale = np.sqrt(np.median(np.abs(np.linalg.det(np.moveaxis(
        jacobian[..., number >= 0], 2, 0)))))
    return Distortion(names, number, basis, jacobian, transforms,
                      sigma / scale)


def _coordinates(kind, points):
    """Return a polynomial whose coordinates suit the pixels of a chip."""
    kind = Transform('polynomial', kind.degree)
    return kind.fitted_to(points) if points.size else kind
