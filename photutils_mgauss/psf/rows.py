r"""
Gaussians as arrays of numbers: the one place that derives them.

Leading axes are free in everything here, as (..., K). Three forms beside
weights, means and covariances:

* *rows* (..., K, 6), *amplitude, x, y, p, s, q*, are what kernels sum, see
  `photutils_mgauss.kernels`;
* *log rows* (..., K, 6) are log weight, x, y, :math:`\tfrac12\ln p`, s and
  :math:`\tfrac12\ln q`: any six numbers are a Gaussian, so fits step in them;
* *integrals* (..., K, 6) of :math:`1, x, y, x^2, xy, y^2` over the Gaussian
  are linear in the light, so Gaussians are blended in them.
"""
import numpy as np

_TWO_PI = 2 * np.pi


def kernel_rows(weights, means, covariances):
    """Return the rows of Gaussians of covariances (..., K, 2, 2)."""
    narrow, slope, syy = _conditioned(covariances)
    return _rows(weights, means, 1 / narrow, slope, 1 / syy)


def kernel_rows_of_stddevs(weights, means, stddevs, rho):
    """Return the rows of Gaussians of stddevs (..., K, 2) and rho."""
    sx, sy = stddevs[..., 0], stddevs[..., 1]
    # As a product, 1 - rho^2 keeps its digits next to 1.
    p = 1 / (sx**2 * (1 - rho) * (1 + rho))
    return _rows(weights, means, p, rho * sx / sy, sy**-2)


def kernel_rows_of_logs(logs, sign=1.0):
    """Return the rows of log rows, whose weights have the signs."""
    rows = np.array(logs)
    log_weight, log_p, log_q = (logs[..., i] for i in (0, 3, 5))
    rows[..., 0] = sign * np.exp(log_weight + log_p + log_q) / _TWO_PI
    rows[..., 3], rows[..., 5] = np.exp(2 * log_p), np.exp(2 * log_q)
    return rows


def falls(rows):
    """
    Return by what factor the quotient of columns falls, (..., K).

    The quotient is that of a Gaussian in a column and in the one before.
    """
    return np.exp(-rows[..., 3])


def log_rows(weights, means, covariances):
    """Return the log rows of Gaussians; the signs of weights are lost."""
    narrow, slope, syy = _conditioned(covariances)
    return np.stack([
        np.log(np.abs(weights)), means[..., 0], means[..., 1],
        -0.5 * np.log(narrow), slope, -0.5 * np.log(syy)], axis=-1)


def covariances_of_logs(logs):
    """Return the covariance matrices (..., K, 2, 2) of log rows."""
    s = logs[..., 4]
    syy = np.exp(-2 * logs[..., 5])
    return matrices(np.exp(-2 * logs[..., 3]) + s**2 * syy, s * syy, syy)


def integrals(weights, means, covariances):
    """Return the integrals of Gaussians."""
    x, y = means[..., 0], means[..., 1]
    moments = [np.ones_like(x), x, y, covariances[..., 0, 0] + x * x,
               covariances[..., 0, 1] + x * y, covariances[..., 1, 1] + y * y]
    return weights[..., None] * np.stack(moments, axis=-1)


def of_integrals(sums):
    """Return weights, means and covariances; no weight may be 0."""
    _, x, y, xx, xy, yy = np.moveaxis(sums / sums[..., :1], -1, 0)
    return (sums[..., 0], np.stack([x, y], axis=-1),
            matrices(xx - x * x, xy - x * y, yy - y * y))


def matrices(xx, xy, yy):
    """Return the symmetric matrices (..., 2, 2) of their elements (...)."""
    return np.stack([xx, xy, xy, yy], axis=-1).reshape(*np.shape(xx), 2, 2)


def _conditioned(covariances):
    """Return the variance of x at one y, the slope of x, the variance of y."""
    sxy, syy = covariances[..., 0, 1], covariances[..., 1, 1]
    slope = sxy / syy
    return covariances[..., 0, 0] - slope * sxy, slope, syy


def _rows(weights, means, p, slope, q):
    rows = np.empty((*p.shape, 6))
    rows[..., 0] = weights * np.sqrt(p * q) / _TWO_PI
    rows[..., 1:3] = means
    rows[..., 3], rows[..., 4], rows[..., 5] = p, slope, q
    return rows
