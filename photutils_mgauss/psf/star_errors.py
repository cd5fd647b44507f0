r"""
Errors of stars beyond those of independent pixels.

What a star's fit makes of an error of its PSF, :math:`f\,\delta P_r`, is
:math:`f (J^T W J)^{-1} J^T W\, \delta P_r`; the sum of the squares over the
directions r is the PSF's part of the star's covariance, together with what
light in the wrong pixels does. Where the noise of pixels is correlated, with
the matrix R of correlations, the covariance is

.. math::

    (J^T W J)^{-1}\, J^T W^{1/2} R\, W^{1/2} J\, (J^T W J)^{-1} .

Each star is taken by itself, also where it was fitted with others.
"""
from functools import partial

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.psf.errors import PSFErrors, responses
from photutils_mgauss.utils.parallel import map_parallel

# The PSF is drawn at so many places along a pixel.
_PHASES = 4
# Numbers in memory at a time, and in one part of the work.
_CHUNK = 2_000_000


def known_errors(model):
    """Return the errors that a PSF model knows of, or None."""
    return getattr(model, 'errors', None)


def exact(model):
    """Return the PSF of a model as one without errors."""
    grid = model.grid
    m, k = grid.weights.shape
    return PSFErrors(grid, np.zeros((m, 0, k, 6)))


def add_psf_errors(table, pixels, model, *, fit_shape=(11, 11),
                   executor=None):
    """
    Add what the PSF may be off to a table of fitted stars, in place.

    ``x_err``, ``y_err``, ``flux_err`` and, if it is there, ``xy_cov`` grow,
    and the columns ``x_psf_err``, ``y_psf_err`` and ``flux_psf_err`` come.
    Nothing happens if the model does not know its errors.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        With ``x_fit``, ``y_fit`` and ``flux_fit``.
    pixels : PixelData
        The image, its errors and its mask.
    model : GriddedMixturePSF
    fit_shape : (int, int), optional
        The pixels that decide where a star is.
    executor : `~concurrent.futures.Executor`, optional
    """
    errors = known_errors(model)
    if errors is None:
        return
    flux = table['flux_fit']
    unit = getattr(flux, 'unit', None) or 1
    values = np.column_stack([np.asarray(
        getattr(column, 'value', column), float) for column in (
        flux, table['x_fit'], table['y_fit'])])
    rows = np.flatnonzero(np.isfinite(values).all(axis=1))
    part = np.full((len(values), 3, 3), np.nan)
    image = kernels.Image(
        pixels.data, np.broadcast_to(pixels.error, pixels.data.shape),
        np.empty((0, 0), bool) if pixels.mask is None else pixels.mask, 0.0)
    part[rows] = StarPixels(
        image, errors, values[rows], fit_shape,
        integrated=model.pixel_integrated).covariances(executor)[0]
    for i, name in enumerate(('flux', 'x', 'y')):
        error = np.sqrt(part[:, i, i]) * (unit if name == 'flux' else 1)
        known = np.where(np.isfinite(error), error, 0 * error)
        table[f'{name}_err'] = np.hypot(table[f'{name}_err'], known)
        table[f'{name}_psf_err'] = error
    if 'xy_cov' in table.colnames:
        table['xy_cov'] += np.nan_to_num(part[:, 1, 2])


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

    def shifts(self, executor=None):
        """
        Return how the fits of stars answer each change of the PSF.

        Returns
        -------
        (n, 3, R) `~numpy.ndarray`
            Of the flux, as a part of it, and of x and y [pix]; NaN for what
            is not fitted.
        """
        out = np.full((len(self.values), 3, self.psf.changes.shape[1]),
                      np.nan)
        templates = self._templates()
        order = np.argsort(templates[2], kind='stable')
        size = max(1, _CHUNK // (int(np.prod(self.fit_shape))
                                 * (3 + out.shape[2])))
        parts = [order[i:i + size] for i in range(0, order.size, size)]
        work = partial(self._shifts, *templates)
        for part, one in zip(parts, map_parallel(
                work, parts, executor=executor, long=len(parts) > 1),
                strict=True):
            out[np.ix_(part, self.free)] = one[0]
        return out

    def _templates(self):
        """Return node, phases and the number of both for each star."""
        _, x, y = self.values.T
        node = self.psf.nearest(x, y)
        steps = [np.clip(np.floor((place - np.rint(place) + 0.5) * _PHASES),
                         0, _PHASES - 1) for place in (x, y)]
        phase = [(step + 0.5) / _PHASES - 0.5 for step in steps]
        key = (node * _PHASES + steps[0]) * _PHASES + steps[1]
        return node, phase, key

    def _shifts(self, node, phase, key, rows):
        """Return shifts, covariances, derivatives, weights and PSFs."""
        _, first, which = np.unique(key[rows], return_index=True,
                                    return_inverse=True)
        some = rows[first]
        images = self.psf.images(
            node[some], phase[0][some], phase[1][some], self.fit_shape,
            integrated=self.integrated)[which]
        weight = self._weights(rows, np.maximum(
            self.values[rows, :1] * images[:, 0], 0))
        design = images[:, self.free]
        if self.fit_sky:
            design = np.concatenate([design, np.ones_like(design[:, :1])], 1)
        # Fluxes in units of the flux: x and y then answer in pixels.
        shifts, inverse = responses(design, weight, images[:, 3:])
        return (shifts[:, :self.free.size], inverse, design, weight,
                images[:, 0])

    def _part(self, node, phase, key, matrix, rows):
        shifts, inverse, design, weight, light = self._shifts(
            node, phase, key, rows)
        flux, n_free = self.values[rows, 0], self.free.size
        psf = shifts @ shifts.transpose(0, 2, 1)
        if self.psf.misfit:
            psf += self.psf.misfit**2 * _answer(
                design, inverse, weight, light)[:, :n_free, :n_free]
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
        usable = (inside.reshape(light.shape) & (variance > 0)
                  & np.isfinite(variance))
        return np.where(usable, 1 / np.where(usable, variance, 1), 0)


def _answer(design, inverse, weight, light):
    """
    Return the covariances of fits to pixels that are off by their light.

    No light is lost: what is missing in one pixel is in the others.
    """
    moved = inverse @ (design * (weight * light)[:, None])
    total = light.sum(axis=1)[:, None, None]
    moved -= moved.sum(axis=2, keepdims=True) * light[:, None] / total
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


def pixel_correlation(matrix, shape):
    """
    Return the correlation of all pixels of a stamp with each other.

    Parameters
    ----------
    matrix : (2 m + 1, 2 m + 1) `~numpy.ndarray`
        That of two pixels at each distance.
    shape : (int, int)
        Of the stamp.

    Returns
    -------
    (pixels, pixels) `~numpy.ndarray`
    """
    reach = len(matrix) // 2
    y, x = (axis.ravel() for axis in np.mgrid[:shape[0], :shape[1]])
    dy, dx = y[:, None] - y, x[:, None] - x
    near = (np.abs(dy) <= reach) & (np.abs(dx) <= reach)
    out = np.zeros(dy.shape)
    out[near] = matrix[dy[near] + reach, dx[near] + reach]
    return out
