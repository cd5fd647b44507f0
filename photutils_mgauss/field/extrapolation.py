"""Whether a PSF is believable far from all stars."""
import numpy as np

from photutils_mgauss.psf.shapes import adaptive_moments

# Where widths are looked at, and by how much more than at any star they may
# differ there: polynomials of a high degree do anything beyond the stars.
_NODES = 12
WILD = 3.0


def widths_beyond(field):
    """
    Compare the widths of a PSF all over the detector with those at stars.

    Parameters
    ----------
    field : MixtureField

    Returns
    -------
    narrow, wide : float
        The smallest full width at half maximum in units of the smallest at a
        star, and the largest in units of the largest.
    """
    used = field.stars[field.stars['used']]
    at_stars, anywhere = (_widths(mixtures) for mixtures in (
        [field.mixture_at(x, y) for x, y in zip(used['x'], used['y'],
                                                strict=True)],
        field.to_grid(_NODES).mixtures))
    return anywhere[0] / at_stars[0], anywhere[1] / at_stars[1]


def is_wild(narrow, wide):
    """Tell whether widths differ by more than stars can tell."""
    return not (narrow > 1 / WILD and wide < WILD)


def _widths(mixtures):
    fwhm = adaptive_moments(mixtures).fwhm
    # What has no width is as wide as one likes.
    fwhm = np.where(np.isfinite(fwhm), fwhm, np.inf)
    return np.min(fwhm), np.max(fwhm)
