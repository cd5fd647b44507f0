r"""
Where the centre of a PSF is.

The flux centroid is decided by faint wings, which are mostly noise. The
centre of the core is the point about which the first moment under a Gaussian
weight vanishes,

.. math::

    \int P(\mathbf r)\, e^{-|\mathbf r - \mathbf c|^2 / 2 w^2}
    (\mathbf r - \mathbf c)\, d^2 r = 0,

the peak of the PSF convolved with the weight. It is linear in the light: what
is blended from PSFs centred in this way is centred, too, if w is the same.
"""
import numpy as np

# Newton's steps, of which the largest counts [pix].
_MAX_STEPS = 60
_TOLERANCE = 1e-12


def flux_centroids(weights, means):
    """Return the flux centroids (n, 2) of mixtures (n, K) and (n, K, 2)."""
    return (np.einsum('nk,nki->ni', weights, means)
            / weights.sum(axis=-1, keepdims=True))


def centres(weights, means, covariances, stddev):
    """
    Return the centres (n, 2) of mixtures under a weight of a size.

    Parameters
    ----------
    weights, means, covariances : (n, K), (n, K, 2), (n, K, 2, 2)
    stddev : float
        The size w of the weight [pix]; infinite for the flux centroid.
    """
    centre = flux_centroids(weights, means)
    if np.isinf(stddev):
        return centre
    wide = covariances + stddev**2 * np.eye(2)
    inverse = np.linalg.inv(wide)
    factor = weights / np.sqrt(np.linalg.det(wide))
    for _ in range(_MAX_STEPS):
        step = _step(factor, means - centre[:, None], inverse)
        # Far out a step of Newton may go too far.
        longest = np.abs(step).max(axis=-1, keepdims=True)
        centre = centre + step * np.minimum(
            1, stddev / np.maximum(longest, 1e-300))
        if longest.max(initial=0) < _TOLERANCE:
            break
    return centre


def _step(factor, offset, inverse):
    """Return the steps towards the peak of the convolved PSF."""
    pull = np.einsum('nkij,nkj->nki', inverse, offset)
    value = factor * np.exp(-0.5 * np.einsum('nki,nki->nk', pull, offset))
    slope = np.einsum('nk,nki->ni', value, pull)
    narrowing = np.einsum('nk,nkij->nij', value, inverse)
    bend = narrowing - np.einsum('nk,nki,nkj->nij', value, pull, pull)
    # Where it bends upwards, the mean of what the weight sees is nearer.
    peaked = (np.linalg.det(bend) > 0) & (np.trace(bend, axis1=1, axis2=2) > 0)
    curvature = np.where(peaked[:, None, None], bend, narrowing)
    return np.linalg.solve(curvature, slope[..., None])[..., 0]
