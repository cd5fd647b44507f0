"""Gaussians as the kernels want them: the place that derives their rows."""
import numpy as np


def kernel_rows(weights, means, covariances):
    """Return the kernels' rows; leading axes are free, (..., K, 6)."""
    sxx, sxy, syy = (covariances[..., 0, 0], covariances[..., 0, 1],
                     covariances[..., 1, 1])
    slope = sxy / syy
    p = 1 / (sxx - slope * sxy)
    q = 1 / syy
    amplitude = weights * np.sqrt(p * q) / (2 * np.pi)
    return np.stack([amplitude, means[..., 0], means[..., 1], p, slope, q],
                    axis=-1)
