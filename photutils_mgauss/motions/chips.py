"""
The chips of a camera: one WCS each in an exposure, one distortion for all.

An exposure has one map onto the common plane. What is left of each chip, its
place in the camera and the distortion in it, is a polynomial in its pixels
that is the same in all exposures.
"""
from dataclasses import dataclass

import numpy as np
from astropy.table import vstack

from photutils_mgauss.sky.transforms import Transform
from photutils_mgauss.sky.wcs import (
    check_celestial,
    pixel_jacobian,
    pixel_to_vectors,
)


def joined_chips(pairs, names):
    """
    Return one table of all chips, with a column ``chip``, and their WCS.

    ``pairs`` are tables and WCS, ``names`` what chips are called, by default
    numbers from 0.
    """
    pairs = [tuple(pair) for pair in pairs]
    names = list(range(len(pairs))) if names is None else list(names)
    if not pairs or any(len(pair) != 2 for pair in pairs):
        msg = 'pairs must be a sequence of (table, wcs), one for each chip'
        raise ValueError(msg)
    if len(names) != len(pairs) or len(set(names)) < len(names):
        msg = (f'names must be different for each of the {len(pairs)} chips, '
               f'got {names}')
        raise ValueError(msg)
    tables = []
    for name, (table, wcs) in zip(names, pairs, strict=True):
        check_celestial(wcs, f'the wcs of chip {name}')
        tables.append(table.copy(copy_data=False))
        tables[-1]['chip'] = np.full(len(table), name)
    return (vstack(tables, metadata_conflicts='silent'),
            dict(zip(names, (wcs for _, wcs in pairs), strict=True)))


def rows_of_chips(epoch):
    """Yield the WCS and the rows of each chip of an epoch, and its name."""
    chip = np.asarray(epoch.table['chip'])
    for name, wcs in epoch.chips.items():
        yield wcs, np.flatnonzero(chip == name), name


def chip_vectors(epoch, x, y):
    """Return ICRS unit vectors (3, n) of the pixels of an epoch's chips."""
    out = np.full((3, len(x)), np.nan)
    for wcs, rows, _ in rows_of_chips(epoch):
        out[:, rows] = pixel_to_vectors(wcs, x[rows], y[rows])
    return out


def chip_jacobian(epoch, plane, x, y, turn=None):
    """Return d(plane)/d(pixel), (2, 2, n), of an epoch's chips."""
    out = np.full((2, 2, len(x)), np.nan)
    for wcs, rows, _ in rows_of_chips(epoch):
        out[..., rows] = pixel_jacobian(wcs, plane, x[rows], y[rows], turn)
    return out


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


def distortion_of(sightings, xy, kind, sigma):
    """
    Return the `Distortion` of the epochs of chips, None without chips.

    Parameters
    ----------
    sightings : `~photutils_mgauss.motions.assemble.Sightings`
    xy : callable
        Returns the pixels of an epoch.
    kind : `~photutils_mgauss.sky.transforms.Transform`
        Of which the degree counts.
    sigma : float
        Of a coefficient [mas].
    """
    epochs = sightings.epochs
    names = list(dict.fromkeys(name for epoch in epochs if epoch.chips
                               for name in epoch.chips))
    if not names or kind.kind == 'none':
        return None
    numbers, points, jacobians = [], [], []
    for epoch, turn in zip(epochs, sightings.turns, strict=True):
        n = len(epoch.table)
        if not epoch.chips:
            numbers.append(np.full(n, -1))
            points.append(np.full((2, n), np.nan))
            jacobians.append(np.zeros((2, 2, n)))
            continue
        place = {name: k for k, name in enumerate(names)}
        numbers.append(np.array([place[name] for name in np.asarray(
            epoch.table['chip']).tolist()], dtype=int))
        points.append(np.stack(xy(epoch)))
        jacobians.append(chip_jacobian(epoch, sightings.plane, *points[-1],
                                       turn))
    take = sightings.matches.take
    number, points = take(numbers, -1), take(points)
    number[~np.isfinite(points).all(axis=0)] = -1
    transforms = [_coordinates(kind, points[:, number == k])
                  for k in range(len(names))]
    basis = np.zeros((kind.n_terms, *number.shape))
    for k, transform in enumerate(transforms):
        basis[:, number == k] = transform.basis(points[:, number == k])
    jacobian = np.where(number >= 0, np.nan_to_num(take(jacobians, 0.0)), 0.0)
    scale = np.sqrt(np.median(np.abs(np.linalg.det(np.moveaxis(
        jacobian[..., number >= 0], 2, 0)))))
    return Distortion(names, number, basis, jacobian, transforms,
                      sigma / scale)


def _coordinates(kind, points):
    """Return a polynomial whose coordinates suit the pixels of a chip."""
    kind = Transform('polynomial', kind.degree)
    return kind.fitted_to(points) if points.size else kind
