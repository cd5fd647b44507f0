"""
A PSF field over a detector made of mixtures, without any optics.

The numbers are chosen to look like the CSST survey camera: a stellar image of
0.144 arcsec FWHM in g with its pixels of 0.074 arcsec, faint wings, and a
size, an ellipticity and a coma that change smoothly over the detector.
"""
import numpy as np

from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.simulation.instrument import CSST_BANDS, Band
from photutils_mgauss.utils.validation import (
    as_instance,
    as_integer,
    as_real,
    as_rng,
    as_shape,
)

# The PSF in g before the pixel: weights and standard deviations [pix].
_WEIGHTS = np.array([0.60, 0.28, 0.09, 0.03])
_STDDEVS = np.array([0.71, 1.03, 2.1, 5.0])
# How far each Gaussian follows the coma.
_COMA = np.array([0.0, 1.0, 2.0, 0.0])
# Typical changes over the detector: size, two ellipticities, coma [pix].
_VARIATIONS = np.array([0.03, 0.03, 0.03, 0.04, 0.04])


def csst_psf(shape=(9232, 9216), band='g', *, n_nodes=5, variation=1.0,
             rng=24):
    """
    Make a PSF field that resembles the CSST survey camera.

    The mixtures describe the optics, so the model integrates them over
    pixels. Their flux centroids are at the star. Size, ellipticity and coma
    are cubic polynomials of the position with random coefficients.

    Parameters
    ----------
    shape : int or (ny, nx) tuple of int, optional
        The pixels of the detector. A small detector has the whole range of
        shapes of a large one.
    band : str or Band, optional
        The filter: 'g', 'r', 'i' or another `Band`. Red stars are wider.
    n_nodes : int, optional
        The number of nodes along each axis, at least 2; between them the PSF
        is the blend of four.
    variation : float, optional
        The size of the changes over the detector, 0 for none.
    rng : int or `~numpy.random.Generator`, optional
        The seed of the coefficients; another one is another detector.

    Returns
    -------
    GriddedMixturePSF
        With ``pixel_integrated=True``.

    Raises
    ------
    ValueError
        If a value is out of range.

    Examples
    --------
    >>> from photutils_mgauss.simulation import csst_psf
    >>> psf = csst_psf((512, 512), 'g')
    >>> psf.grid_shape, psf.n_components, psf.pixel_integrated
    ((5, 5), 4, True)
    """
    ny, nx = as_shape(shape, 'shape')
    n = as_integer(n_nodes, 'n_nodes', minimum=2)
    variation = as_real(variation, 'variation', minimum=0)
    coefficients = _coefficients(as_rng(rng)) * variation
    width = _width(band_of(band))
    u, v = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, n)] * 2))
    changes = np.polynomial.polynomial.polyval2d(
        u, v, np.moveaxis(coefficients, 0, -1)).T
    positions = np.column_stack([(u + 1) / 2 * (nx - 1),
                                 (v + 1) / 2 * (ny - 1)])
    return GriddedMixturePSF([_mixture(width, *change) for change in changes],
                             positions, pixel_integrated=True)


def band_of(band):
    """Return a band from itself or from the name of one of the CSST's."""
    if not isinstance(band, str):
        return as_instance(band, Band, 'band')
    if band not in CSST_BANDS:
        words = ', '.join(map(repr, CSST_BANDS))
        msg = f'band must be a Band or one of {words}, got {band!r}'
        raise ValueError(msg)
    return CSST_BANDS[band]


def _coefficients(rng):
    """Return cubic polynomials (5, 4, 4) of random, falling coefficients."""
    i, j = np.indices((4, 4))
    order = i + j
    damping = np.where(order <= 3, 1 / (1.0 + order), 0)
    return (rng.standard_normal((5, 4, 4)) * damping
            * _VARIATIONS[:, None, None])


def _width(band):
    """Return the scale of the PSF: part diffraction, part everything else."""
    return np.sqrt(0.85 + 0.15 * (band.pivot / CSST_BANDS['g'].pivot)**2)


def _mixture(width, size, e_1, e_2, coma_x, coma_y):
    stretch = width * (1 + size) * np.array([[1 + e_1, e_2],
                                             [e_2, 1 - e_1]])
    covariances = _STDDEVS[:, None, None]**2 * (stretch @ stretch.T)
    means = np.outer(_COMA, [coma_x, coma_y])
    means -= _WEIGHTS @ means
    return GaussianMixture(_WEIGHTS, means, covariances)
