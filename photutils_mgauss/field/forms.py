r"""
What the PSF of each star is made of.

Each form turns numbers that are polynomials of detector position into the
shapes of K Gaussians at n stars. Shapes (n, K, 6) are the log rows of
`photutils_mgauss.psf.rows`, so that any values are a valid mixture.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.psf.centre import centres, flux_centroids
from photutils_mgauss.psf.rows import covariances_of_logs

# Steps of numerical derivatives.
_STEP = 1e-5


def mixture_arrays(shapes, stddev=np.inf):
    """
    Return weights, means, covariances and shifts for (n, K, 6).

    The centre under a weight of size ``stddev`` [pix] is shifted to 0.
    """
    log_weights = shapes[..., 0] - shapes[..., 0].max(axis=-1, keepdims=True)
    weights = np.exp(log_weights)
    weights /= weights.sum(axis=-1, keepdims=True)
    covariances = covariances_of_logs(shapes)
    shift = centres(weights, shapes[..., 1:3], covariances, stddev)
    return weights, shapes[..., 1:3] - shift[:, None], covariances, shift


def convolved(shapes, blur):
    r"""
    Return shapes (n, K, 6) convolved with a Gaussian of covariance blur.

    blur (n, 3) holds xx, xy and yy [pix^2]. It may be negative, which is a
    deconvolution; where it would leave less than half of a Gaussian's
    variance along some direction, the rest goes to zero smoothly instead of
    below it.

    With :math:`\Sigma^{-1} = W^T W` the new covariance is
    :math:`W^{-1} f(W C W^T)\, W^{-T}` and :math:`f(\lambda) = 1 + \lambda`.
    """
    xx, xy, yy = (blur[:, None, i] for i in range(3))
    s = shapes[..., 4]
    root_p, root_q = np.exp(shapes[..., 3]), np.exp(shapes[..., 5])
    a = root_p**2 * (xx - 2 * s * xy + s**2 * yy)
    b = root_p * root_q * (xy - s * yy)
    c = root_q**2 * yy
    middle, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    high, low = _variance_factor(middle + half), _variance_factor(middle
                                                                  - half)
    slope = np.where(half > 1e-9, (high - low) / np.maximum(2 * half, 1e-9),
                     np.exp(np.minimum(2 * middle + 1, 0)))
    f_yy = (high + low) / 2 + slope * (c - middle)
    out = shapes.copy()
    out[..., 3] += 0.5 * np.log(f_yy / (high * low))
    out[..., 4] += slope * b / f_yy * root_q / root_p
    out[..., 5] -= 0.5 * np.log(f_yy)
    return out


def _variance_factor(change):
    return np.where(change > -0.5, 1 + change,
                    0.5 * np.exp(np.minimum(2 * change + 1, 0)))


@dataclass(frozen=True)
class FreeShapes:
    """
    Shapes that are polynomials themselves.

    The coefficients are (T, K, 6). Those of log weight and mean of the first
    Gaussian are not fitted: they would repeat flux and position of the stars.
    ``local`` (n, 3) is what each star's exposure adds to all covariances.
    """

    # Log weight, means and precisions vary by different amounts.
    kinds = np.array([0, 1, 1, 2, 2, 2])

    @staticmethod
    def shifts(shapes, sign, local, stddev):
        """Return what moves the centre of shapes to 0, (n, 2)."""
        return -mixture_arrays(shapes, stddev)[3]

    def shapes(self, coefficients, basis, local):
        """Return the shapes at the stars, and the signs of the weights."""
        shapes = np.einsum('nt,tki->nki', basis, coefficients)
        return convolved(shapes, local) if local.any() else shapes, 1.0

    def jacobians(self, coefficients, basis, local):
        """Return the derivatives of the shapes, empty for the identity."""
        if not local.any():
            return np.zeros((0, 0, 0))
        n, k = len(basis), coefficients.shape[1]
        shapes = np.einsum('nt,tki->nki', basis, coefficients)
        out = np.tile(np.eye(6 * k), (n, 1, 1)).reshape(n, k, 6, k, 6)
        each = np.arange(k)
        for i in (3, 4, 5):
            change = np.zeros(6)
            change[i] = _STEP
            slope = (convolved(shapes + change, local)
                     - convolved(shapes - change, local)) / (2 * _STEP)
            # numpy puts the axis of the pairs (k, k) first.
            out[:, each, 3:, each, i] = np.moveaxis(slope[..., 3:], 1, 0)
        return np.ascontiguousarray(
            out.reshape(n, 6 * k, 6 * k)[:, 3:, 3:])


@dataclass(frozen=True)
class TunedShapes:
    r"""
    Shapes of a PSF that is known, changed in a few ways.

    The coefficients are (T, N) with N = 3 or 6 numbers: the covariance
    xx, xy, yy of a Gaussian that the PSF is convolved with [pix^2]; the
    change of log weight and of mean x and y [pix] for each factor e in the
    size of a Gaussian. The flux centroid stays where it is.
    ``local`` (n, K, 8) holds the shapes of the known PSF at each star, the
    signs of the weights, and the log of the sizes about their mean.
    """

    kinds = np.array([0, 0, 0, 1, 2, 2])

    @staticmethod
    def local(shapes, sign):
        """Return ``local`` for known shapes (n, K, 6)."""
        sign = np.broadcast_to(sign, shapes.shape[:-1])
        size = -0.5 * (shapes[..., 3] + shapes[..., 5])
        weight = np.exp(shapes[..., 0])
        size = size - ((weight * size).sum(axis=-1, keepdims=True)
                       / weight.sum(axis=-1, keepdims=True))
        return np.concatenate([shapes, sign[..., None], size[..., None]], -1)

    @staticmethod
    def shifts(shapes, sign, local, stddev):
        """Return what moves the centre of shapes to the known one's."""
        known, changed = (centres(sign * np.exp(each[..., 0]),
                                  each[..., 1:3], covariances_of_logs(each),
                                  stddev)
                          for each in (local[..., :6], shapes))
        return known - changed

    def shapes(self, coefficients, basis, local):
        """Return the shapes at the stars, and the signs of the weights."""
        return self._changed(basis @ coefficients, local), local[..., 6]

    def _changed(self, numbers, local):
        shapes, sign, size = local[..., :6], local[..., 6], local[..., 7]
        before = flux_centroids(sign * np.exp(shapes[..., 0]),
                                shapes[..., 1:3])
        shapes = convolved(shapes, numbers[:, :3])
        if numbers.shape[1] == 3:
            return shapes
        shapes[..., 0] += numbers[:, None, 3] * size
        shapes[..., 1:3] += numbers[:, None, 4:6] * size[..., None]
        total = np.sum(sign * np.exp(shapes[..., 0]), axis=1, keepdims=True)
        shapes[..., 0] -= np.log(np.maximum(total, 1e-300))
        after = flux_centroids(sign * np.exp(shapes[..., 0]),
                               shapes[..., 1:3])
        shapes[..., 1:3] += (before - after)[:, None]
        return shapes

    def jacobians(self, coefficients, basis, local):
        """Return the derivatives of the shapes (n, 6 K - 3, N)."""
        numbers = basis @ coefficients
        out = []
        for i in range(numbers.shape[1]):
            change = np.zeros(numbers.shape[1])
            change[i] = _STEP
            slope = (self._changed(numbers + change, local)
                     - self._changed(numbers - change, local)) / (2 * _STEP)
            # Flux and position of the star follow those of the first one.
            slope[..., :3] -= slope[:, :1, :3]
            out.append(slope.reshape(len(slope), -1)[:, 3:])
        return np.ascontiguousarray(np.stack(out, axis=-1))

