r"""
What the wings of a PSF are worth to stars that are fitted to them.

How much saturated stars differ, pixel by pixel, from what is known of the
wings is part of the weights of their fits, as if each pixel were off for
itself. But a PSF is wrong over pixels together. With the spread s of pixels,
the matrix R of their correlations and the answer
:math:`A = (J^T W J)^{-1} J^T W` of a star's fit to what is left in its pixels,
the covariance is

.. math:: A\,\mathrm{diag}(s)\, R\, \mathrm{diag}(s)\, A^T .

The stars themselves tell R, by products of what is left in two pixels. What
a fit has taken of that is not there any more: with the design J of a fit and
the covariance V of pixels, noise included, the expected products are those of
:math:`(1 - J A)\, V\, (1 - J A)^T`, to which R is adapted.
"""
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from photutils_mgauss import kernels
from photutils_mgauss.photometry.bright_residual import (
    left_of_saturated,
    saturated_rows,
)
from photutils_mgauss.photometry.engine import cut_boxes, psf_arrays
from photutils_mgauss.utils.matrices import with_unit_diagonal

# Correlations are followed to so many pixels along each axis, and adapted so
# often; more stars than the last are not needed.
_REACH, _ROUNDS, _MOST = 3, 4, 100
_SIDE = 2 * _REACH + 1
# Normal matrices of a larger condition have no inverse.
_SINGULAR = 1e14


@dataclass(frozen=True, eq=False)
class Wings:
    """
    The pixels of a saturated star that were fitted.

    ``row`` and ``column`` (m,) are theirs in the image, ``design`` (3, m) the
    derivatives by flux, x and y, ``shifts`` (3, m) what a unit of light in
    them does to these; ``spread`` and ``noise`` (m,) are standard deviations
    of how stars differ and of the noise.
    """

    row: np.ndarray
    column: np.ndarray
    design: np.ndarray
    shifts: np.ndarray
    spread: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, values, box, free, images, psf):
        """
        Return the wings of a star of flux, x and y (3,) in a box (4,).

        ``images`` are the image as it came, and as it was fitted. None if the
        stars do not differ, or the fit has no errors.
        """
        flux, x, y = values
        row, column, light = _draw(x, y, box, psf)
        image = images[0]
        before, variance = (one.error[row, column]**2 for one in images)
        spread = np.sqrt(np.maximum(variance - before, 0))
        if image.gain:
            variance = variance + np.maximum(flux * light[0], 0) / image.gain
        seen = variance > 0
        if image.mask.size:
            seen &= ~image.mask[row, column]
        light[1:] *= flux
        return cls.of_pixels(row[seen], column[seen], light[:, seen],
                             variance[seen], spread[seen], free)

    @classmethod
    def of_pixels(cls, row, column, design, variance, spread, free):
        """
        Return wings of pixels (m,) with a design (3, m).

        ``variance`` is all of theirs, ``free`` (3,) what was fitted of flux,
        x and y. None if the stars do not differ, or the fit has no errors.
        """
        weighed = design[free] / variance
        matrix, scale = with_unit_diagonal(weighed @ design[free].T)
        if not (spread > 0).any() or not np.linalg.cond(matrix) < _SINGULAR:
            return None
        shifts = np.zeros(design.shape)
        shifts[free] = (np.linalg.solve(matrix, weighed / scale[:, None])
                        / scale[:, None])
        noise = np.sqrt(np.maximum(variance - spread**2, 0))
        return cls(row, column, design, shifts, spread, noise)

    @cached_property
    def pairs(self):
        """Pixels near each other: both, and the number of their distance."""
        y, x = (at - at.min() + _REACH for at in (self.row, self.column))
        number = np.full((y.max() + _SIDE, x.max() + _SIDE), -1)
        number[y, x] = np.arange(y.size)
        dy, dx = np.indices((_SIDE, _SIDE)).reshape(2, -1) - _REACH
        near = number[y[:, None] - dy, x[:, None] - dx]
        one, lag = np.nonzero(near >= 0)
        return one, near[one, lag], lag

    def summed(self, products):
        """Return sums (side, side) of products of pairs, for each distance."""
        one, other, lag = self.pairs
        known = self.spread > 0
        # Where noise is larger pixels count for less.
        worth = np.divide(self.spread, self.spread**2 + self.noise**2,
                          where=known, out=np.zeros(known.size))
        return np.bincount(lag, worth[one] * worth[other] * products,
                           _SIDE**2).reshape(_SIDE, _SIDE)

    def seen(self, left):
        """Return the products of what is left in pairs of pixels."""
        one, other, _ = self.pairs
        left = left[self.row, self.column]
        return left[one] * left[other]

    def matrix(self, correlation):
        """Return the covariances (m, m) of how stars differ, sparse."""
        one, other, lag = self.pairs
        values = (correlation.ravel()[lag] * self.spread[one]
                  * self.spread[other])
        return csr_array((values, (one, other)), (self.row.size,) * 2)

    def expected(self, correlation):
        """Return what the fit takes of the products of pairs."""
        one, other, _ = self.pairs
        moved = (self.shifts @ self.matrix(correlation)
                 + self.shifts * self.noise**2)
        # The symmetric part of what is left once the fit has taken twice.
        moved -= (moved @ self.shifts.T) @ self.design / 2
        taken = np.zeros(one.size)
        for design, more in zip(self.design, moved, strict=True):
            taken += design[one] * more[other] + design[other] * more[one]
        return taken

    def covariance(self, correlation):
        """Return the covariance (3, 3) of flux, x and y."""
        # Correlations that end somewhere may be none of any pixels.
        size = np.sqrt((self.shifts**2) @ self.spread**2)
        shifts = self.shifts / np.where(size > 0, size, 1)[:, None]
        values, vectors = np.linalg.eigh(
            (shifts @ self.matrix(correlation)) @ shifts.T)
        return (vectors * np.maximum(values, 0)) @ vectors.T * (
            size * size[:, None])


def _draw(x, y, box, psf):
    """Return rows and columns (n,) of a box, and the PSF's light (3, n)."""
    bottom, left, height, width = box
    light = np.empty((3, height * width))
    kernels.star_derivatives(x, y, box, psf,
                             kernels.Tiling.empty(height * width), light)
    column, row = (axis.ravel() for axis in np.indices((width, height)))
    return row + bottom, column + left, light


def wing_errors(result, image, cleaned, model, known):
    """
    Return what the PSF's wings do to saturated stars.

    Parameters
    ----------
    result : FitResult
    image, cleaned : `~photutils_mgauss.kernels.Image`
        As it came, and as saturated stars were fitted last: its errors hold
        how much they differ.
    model : GriddedMixturePSF or MultiGaussianPSFModel
    known : PSFResidual or None
        What the PSF leaves of bright stars.

    Returns
    -------
    rows : (m,) `~numpy.ndarray` of int
        The stars of which it is known.
    wings, alone : (m, 3, 3) `~numpy.ndarray`
        Covariances of flux, x and y; and what of them the fit knew, with
        each pixel off for itself.
    """
    rows = saturated_rows(result)
    every = {}
    if known is not None and image.error.size:
        boxes = cut_boxes(*result.initial[rows, 1:].T, result.shapes[rows],
                          image.data.shape)
        psf = psf_arrays(model)
        every = {row: Wings.of(result.values[row], box, result.free,
                                (image, cleaned), psf)
                 for row, box in zip(rows, boxes, strict=True)}
        every = {row: one for row, one in every.items() if one is not None}
    if not every:
        return rows[:0], *np.empty((2, 0, 3, 3))
    return np.array(list(every)), *covariances_of(
        list(every.values()), left_of_saturated(result, image, model, known))


def covariances_of(every, left):
    """
    Return covariances (2, m, 3, 3) that wings make of flux, x and y.

    As what is left of the image (ny, nx) says, and with each pixel off for
    itself.
    """
    correlation = _correlation(every[:_MOST], left)
    alone = np.zeros(correlation.shape)
    alone[_REACH, _REACH] = 1
    return np.array([[one.covariance(matrix) for one in every]
                     for matrix in (correlation, alone)])


def _correlation(every, left):
    """Return the correlation (side, side) of pixels at each distance."""
    known = sum(one.summed(one.spread[one.pairs[0]] * one.spread[
        one.pairs[1]]) for one in every)
    seen = sum(one.summed(one.seen(left)) for one in every)
    out = np.zeros(known.shape)
    for _ in range(_ROUNDS):
        taken = sum(one.summed(one.expected(out)) for one in every)
        out = np.clip(np.divide(seen + taken, known, where=known > 0,
                                out=np.zeros(known.shape)), 0, 1)
        out[_REACH, _REACH] = 1
    return out


def with_wing_errors(result, part, rows, wings, alone):
    """
    Return results whose saturated stars have errors of the PSF's wings.

    Parameters
    ----------
    result : FitResult
        With all other errors.
    part : (n, 3, 3) `~numpy.ndarray` or None
        What of them the PSF has made, as far as it is known to.
    rows, wings, alone
        As of `wing_errors`.
    """
    covariances = result.covariances.copy()
    if part is not None:
        part = part.copy()
        covariances[rows] -= part[rows]
        part[rows] = wings
    covariances[rows] += wings - alone
    return replace(result, covariances=covariances), part
