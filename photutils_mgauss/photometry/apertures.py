"""What makes the fluxes in apertures total."""
import numpy as np


def aperture_correction(psf_model, x, y, radius):
    """
    Return what makes aperture fluxes total, star by star.

    Parameters
    ----------
    psf_model : GriddedMixturePSF or MultiGaussianPSFModel
        The PSF.
    x, y : (n,) array_like
        Positions [pix]; the correction is NaN where they are not finite.
    radius : float
        The radius of the aperture [pix].

    Returns
    -------
    (n,) `~numpy.ndarray`
        One over the encircled energy of the PSF at each position.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel
    >>> from photutils_mgauss.photometry import aperture_correction
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> aperture_correction(MultiGaussianPSFModel(mixture), [10], [10], 2)
    array([1.15651764])
    """
    x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)),
                               np.atleast_1d(np.asarray(y, float)))
    correction = np.full(x.shape, np.nan)
    good = np.isfinite(x) & np.isfinite(y)
    energy = encircled_energy(psf_model, x[good], y[good], radius)
    correction[good] = 1 / energy
    return correction


def encircled_energy(psf_model, x, y, radius):
    """Return the fraction of a star's flux within a radius, (n,)."""
    grid = psf_model.grid
    nodes = np.array([grid.node(m).encircled_energy(radius)
                      for m in range(len(grid.scales))])
    if nodes.size == 1:
        return np.full(x.shape, nodes[0])
    out = np.empty(x.size)
    for i in range(x.size):
        index, share = grid.neighbours(x[i], y[i])
        share = share * grid.scales[index]
        out[i] = share @ nodes[index] / share.sum()
    return out
