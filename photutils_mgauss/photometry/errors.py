r"""
Errors of stars beyond those of independent pixels.

What a star's fit makes of an error of its PSF, :math:`f\,\delta P_r`, is
:math:`f (J^T W J)^{-1} J^T W\, \delta P_r`; the sum of the squares over the
directions r is the PSF's part of the star's covariance. Where the noise of
pixels is correlated, with the matrix R of correlations, the covariance is

.. math::

    (J^T W J)^{-1}\, J^T W^{1/2} R\, W^{1/2} J\, (J^T W J)^{-1} .

Each star is taken by itself, also where it was fitted with others.
"""
from contextlib import nullcontext
from dataclasses import replace
from functools import partial

import numpy as np

from photutils_mgauss.photometry.correlation import pixel_correlation
from photutils_mgauss.psf.errors import PSFErrors, responses
from photutils_mgauss.utils.parallel import Threads, map_parallel

# The PSF is drawn at so many places along a pixel.
_PHASES = 4
# Numbers in memory at a time, and in one part of the work.
_CHUNK = 2_000_000


def psf_errors_of(model):
    """Return the errors that a PSF model knows of, or None."""
    return getattr(model, 'errors', None)


def with_all_errors(result, image, model, fit_shape, *, psf_errors=True,
                    correlation=None, fit_sky=False, executor=None,
                    n_threads=None):
    """
    Return results with the errors of the PSF and of correlated noise.

    Parameters
    ----------
    result : FitResult
    image : `~photutils_mgauss.kernels.Image`
    model : GriddedMixturePSF or MultiGaussianPSFModel
    fit_shape : (int, int)
    psf_errors : bool, optional
        Whether to add what the PSF may be off, where that is known.
    correlation : NoiseCorrelation, optional
    fit_sky, executor, n_threads : optional
        As of the fit.

    Returns
    -------
    result : FitResult
    psf : (n, 3, 3) `~numpy.ndarray` or None
        The part of the covariances that is due to the PSF.
    """
    errors = psf_errors_of(model) if psf_errors else None
    if errors is None and correlation is None:
        return result, None
    rows = np.flatnonzero(np.isfinite(result.values).all(axis=1)
                          & result.has_covariance)
    pixels = StarPixels(
        image, _exact(model) if errors is None else errors,
        result.values[rows], fit_shape, free=result.free, fit_sky=fit_sky,
        integrated=model.pixel_integrated)
    pool = (nullcontext(executor) if n_threads is None
            or executor is not None else Threads(n_threads))
    with pool as executor:
        psf, growth = pixels.covariances(
            executor, None if correlation is None else correlation.matrix)
    free = np.ix_(np.arange(rows.size), *[np.flatnonzero(result.free)] * 2)
    grown = growth[free] @ result.covariances[rows][free] @ growth[
        free].transpose(0, 2, 1)
    covariances = result.covariances.copy()
    where = (rows[:, None, None], *free[1:])
    if errors is None:
        covariances[where] = grown
        return replace(result, covariances=covariances), None
    part = np.full(covariances.shape, np.nan)
    part[rows] = psf
    covariances[where] = grown + psf[free]
    return replace(result, covariances=covariances), part


def _exact(model):
    """Return the PSF of a model as one without errors."""
    grid = model.grid
    return PSFErrors(grid, np.zeros((len(grid.weights), 0,
                                     grid.weights.shape[1], 6)))


class StarPixels:
    """
    The pixels of n stars as their fits see them.

    Parameters
    ----------
    image : `~photutils_mgauss.kernels.Image`
    psf : PSFErrors
        The PSF at a few places, and its errors there.
    values : (n, 3) `~numpy.ndarray`
        Flux, x and y; finite.
    fit_shape : (int, int)
    free : (3,) `~numpy.ndarray` of bool
        Which of flux, x and y are fitted.
    fit_sky, integrated : bool
        Whether a level of the sky is fitted, and the PSF integrated over
        pixels.
    """

    def __init__(self, image, psf, values, fit_shape, *, free=(True,) * 3,
                 fit_sky=False, integrated=False):
        self.image, self.psf, self.values = image, psf, values
        self.fit_shape = tuple(fit_shape)
        self.free = np.flatnonzero(free)
        self.fit_sky, self.integrated = bool(fit_sky), integrated

    def covariances(self, executor=None, correlation=None):
        """
        Return what the PSF and the correlation of noise do to stars.

        Parameters
        ----------
        executor : `~concurrent.futures.Executor`, optional
        correlation : (2 m + 1, 2 m + 1) `~numpy.ndarray`, optional
            The correlation of two pixels at each distance.

        Returns
        -------
        psf, noise : (n, 3, 3) `~numpy.ndarray`
            The covariance of flux, x and y due to the PSF, and the matrix G
            that turns the covariance C of independent pixels into G C G^T.
            NaN for what is not fitted.
        """
        n_pixels = int(np.prod(self.fit_shape))
        node, phase, key = self._templates()
        order = np.argsort(key, kind='stable')
        size = max(1, _CHUNK // (n_pixels * (3 + self.psf.changes.shape[1])))
        parts = [order[i:i + size] for i in range(0, order.size, size)]
        matrix = (None if correlation is None
                  else pixel_correlation(correlation, self.fit_shape))
        work = partial(self._part, node, phase, key, matrix)
        psf = np.full((order.size, 3, 3), np.nan)
        noise = np.full((order.size, 3, 3), np.nan)
        for part, (one, other) in zip(parts, map_parallel(
                work, parts, executor=executor, long=len(parts) > 1),
                strict=True):
            psf[part], noise[part] = one, other
        return psf, noise

    def _templates(self):
        """Return node, phases and the number of both for each star."""
        _, x, y = self.values.T
        node = self.psf.nearest(x, y)
        steps = [np.clip(np.floor((place - np.rint(place) + 0.5) * _PHASES),
                         0, _PHASES - 1) for place in (x, y)]
        phase = [(step + 0.5) / _PHASES - 0.5 for step in steps]
        key = (node * _PHASES + steps[0]) * _PHASES + steps[1]
        return node, phase, key

    def _part(self, node, phase, key, matrix, rows):
        _, first, which = np.unique(key[rows], return_index=True,
                                    return_inverse=True)
        some = rows[first]
        images = self.psf.images(
            node[some], phase[0][some], phase[1][some], self.fit_shape,
            integrated=self.integrated)[which]
        flux = self.values[rows, 0]
        weight = self._weights(rows, np.maximum(flux[:, None] * images[:, 0],
                                                0))
        design = images[:, self.free]
        if self.fit_sky:
            design = np.concatenate([design, np.ones_like(design[:, :1])], 1)
        # Fluxes in units of the flux: x and y then answer in pixels.
        shifts, inverse = responses(design, weight, images[:, 3:])
        n_free = self.free.size
        shifts = shifts[:, :n_free]
        psf = shifts @ shifts.transpose(0, 2, 1)
        if self.psf.accuracy:
            psf += _sandwich(design, inverse, weight * self.psf.accuracy
                             * np.maximum(images[:, 0], 0))[:, :n_free,
                                                            :n_free]
        units = np.where(self.free == 0, flux[:, None], 1.0)
        psf *= units[:, :, None] * units[:, None]
        if matrix is None:
            return self._full(psf), np.broadcast_to(np.eye(3), (
                len(rows), 3, 3))
        growth = _growth(design, inverse, np.sqrt(weight), matrix, n_free)
        return self._full(psf), self._full(
            growth * units[:, :, None] / units[:, None])

    def _full(self, matrices):
        out = np.full((len(matrices), 3, 3), np.nan)
        out[:, self.free[:, None], self.free] = matrices
        return out

    def _weights(self, rows, light):
        """Return one over the variances of the stars' pixels."""
        image = self.image
        ny, nx = self.fit_shape
        _, x, y = self.values[rows].T
        row = np.rint(y).astype(int)[:, None] - (ny - 1) // 2 + np.arange(ny)
        column = (np.rint(x).astype(int)[:, None] - (nx - 1) // 2
                  + np.arange(nx))
        height, width = image.data.shape
        inside = (((row >= 0) & (row < height))[:, :, None]
                  & ((column >= 0) & (column < width))[:, None])
        at = (np.clip(row, 0, height - 1)[:, :, None],
              np.clip(column, 0, width - 1)[:, None])
        if image.mask.size:
            inside &= ~image.mask[at]
        variance = (np.square(image.error[at]) if image.error.size
                    else np.ones(inside.shape))
        variance = variance.reshape(light.shape)
        if image.gain:
            variance = variance + light / image.gain
        return np.where(inside.reshape(light.shape), 1 / variance, 0)


def _sandwich(design, inverse, deviation):
    """Return the covariances due to independent deviations of pixels."""
    moved = (inverse @ design) * deviation[:, None]
    return moved @ moved.transpose(0, 2, 1)


def _growth(design, inverse, root, matrix, n_free):
    """
    Return the matrices G of covariances G C G^T for correlated noise.

    What would make an error smaller is left out: the errors of pixels may
    have been those of independent ones before the image was resampled.
    """
    usable = np.isfinite(inverse).all(axis=(1, 2))
    inverse = np.where(usable[:, None, None], inverse,
                       np.eye(inverse.shape[1]))
    white = np.linalg.cholesky(inverse).transpose(0, 2, 1) @ (
        design * root[:, None])
    # The covariance in axes in which that of independent noise is 1.
    values, vectors = np.linalg.eigh((white @ matrix)
                                     @ white.transpose(0, 2, 1))
    axes = np.linalg.cholesky(inverse) @ vectors
    both = (axes * np.maximum(values, 1)[:, None]) @ axes.transpose(0, 2, 1)
    new, old = (np.linalg.cholesky(each[:, :n_free, :n_free])
                for each in (both, inverse))
    growth = new @ np.linalg.inv(old)
    growth[~usable] = np.eye(n_free)
    return growth
