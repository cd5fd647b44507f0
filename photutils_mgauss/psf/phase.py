r"""
How the light that a sampled PSF puts into pixels changes with pixel phase.

The true PSF in pixels, added up over all pixels, is the same wherever in a
pixel the star is. The sum of a mixture sampled at the middles of pixels is, by
Poisson's formula, its Fourier transform at whole cycles per pixel,

.. math::

    \sum_{\mathbf n} P(\mathbf n - \mathbf r) = 1 + 2 \sum_k \omega_k
    \sum_{i = x, y} e^{-2 \pi^2 \Sigma_{k,ii}}
    \cos 2\pi (r_i + \alpha_{k,i}) + \dots,

and fitted fluxes are off by as much.
"""
import numpy as np


def phase_error(mixture):
    """
    Return the rms change of the sum over pixels, as a share of the flux.

    Parameters
    ----------
    mixture : GaussianMixture
        A PSF that is sampled at the middles of pixels.
    """
    variances = np.diagonal(mixture.covariances, axis1=1, axis2=2)
    waves = np.exp(-2 * np.pi**2 * variances + 2j * np.pi * mixture.means)
    # The mean square of 2 |w| cos is 2 |w|^2.
    return float(np.sqrt(2 * np.sum(np.abs(mixture.weights @ waves) ** 2)))
