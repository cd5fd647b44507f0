"""
What the PSF leaves of the brightest stars of an image, taken off them.

It is measured on bright stars that are not saturated and, further out, where
these tell little, on saturated ones: their wings are fitted to what the
others say first. Both are fitted again without it.
"""
import warnings

import numpy as np
from astropy.stats import mad_std
from astropy.utils.exceptions import AstropyUserWarning
from scipy.spatial import cKDTree

from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.psf.residual import FEWEST, PSFResidual, whole_reach

# Stars of so many standard errors tell what the PSF leaves of bright ones;
# all are drawn down to this part of the noise.
BRIGHT = 50.0
_FAINTEST = 0.02
# What is fainter than this part of a bright star near it may be a piece of its
# spikes that was taken for a star.
_DOUBTFUL = 0.01
# Stars may be so many pixels beside the middle of their boxes.
_BESIDE = 3
# The second time saturated stars tell, too.
_ROUNDS = 2


def without_residual(result, image, model, radius, refit, groups):
    """
    Return results of bright stars without what the PSF leaves of them.

    Parameters
    ----------
    result : FitResult
    image : `~photutils_mgauss.kernels.Image`
    model : GriddedMixturePSF or MultiGaussianPSFModel
    radius : float or None
        How far from all bright stars to look [pix]. With None it is only
        taken off saturated ones, where these are fitted.
    refit : callable
        Returns the FitResult of an image, and which rows it has. With None
        in place of rows all are fitted.
    groups : (n,) `~numpy.ndarray`
        Who is fitted with whom.

    Returns
    -------
    FitResult, `~photutils_mgauss.kernels.Image`, PSFResidual or None
        None if nothing was measured.
    """
    known, cleaned = None, image
    for repeated in range(_ROUNDS):
        saturated = saturated_rows(result)
        if radius is None and not saturated.size:
            break
        telling = _telling(result)
        reach = (radius if radius is not None
                 else int(result.shapes[saturated].max()) // 2)
        stars = result.values[:, [1, 2, 0]].T
        drawn = np.isfinite(stars).all(axis=0)
        if radius is not None:
            drawn &= ~doubtful(stars, np.union1d(telling, saturated), radius)
        found = _measured(image, model, (stars, drawn), telling, saturated,
                          reach, repeated)
        if found is None:
            _tell_of_few(radius, telling.size)
            break
        known = found
        rows = saturated if radius is None else np.union1d(
            saturated, _bright(result))
        cleaned = _cleaned(image, known, stars[:, rows], reach)
        if radius is None:
            cleaned = _without_others(cleaned, model, result,
                                      np.isin(groups, groups[rows]))
        result = result.updated(*refit(cleaned, rows if radius is None
                                       else None))
    return result, cleaned, known


def _without_others(image, model, result, fitted):
    """
    Return an image for the fit of some stars (n,), others taken off.

    Of those fitted, too, what is outside of their own pixels: wings of
    saturated stars reach far.
    """
    stars = result.values[:, [1, 2, 0]].T
    left, _ = _left_over(image, model, stars[:, np.isfinite(stars).all(
        axis=0)])
    own = np.zeros(image.data.shape)
    shapes, which = np.unique(result.shapes, axis=0, return_inverse=True)
    # Smaller light than this is lost by rounding beside the brightest star.
    faintest = np.finfo(float).eps * np.abs(stars[2, fitted]).max(
        initial=0, where=np.isfinite(stars[2, fitted]))
    for k, shape in enumerate(shapes if faintest > 0 else ()):
        # Where fits started stars may have been pixels away.
        own += MixtureRenderer(model).image(
            stars[:, fitted & (which.ravel() == k)], faintest, own.shape,
            shape + 2 * _BESIDE)
    data = left + own
    if not (image.gain and image.error.size):
        return image._replace(data=data)
    light = np.maximum(image.data - data, 0) / image.gain
    return image._replace(data=data, error=np.sqrt(image.error**2 + light))


def left_of_saturated(result, image, model, known):
    """Return an image (ny, nx) without stars and all that is known of them."""
    stars = result.values[:, [1, 2, 0]].T
    left, _ = _left_over(image, model, stars[:, np.isfinite(stars).all(
        axis=0)])
    known.take_off(left, np.zeros(left.shape),
                   stars[:, saturated_rows(result)], known.reach)
    return left


def _measured(image, model, stars, telling, saturated, reach, repeated):
    """
    Return the PSFResidual of stars, or None if too few tell.

    ``stars`` are all (3, n), and which of them are drawn.
    """
    stars, drawn = stars
    left, variance = _left_over(image, model, stars[:, drawn])
    variance = np.where(image.mask if image.mask.size else False, 0, variance)
    clean = without_surroundings(variance, stars[:, saturated], reach)
    return PSFResidual.of(
        left, clean, stars[:, telling], reach,
        bright=(variance, stars[:, saturated]) if repeated else None)


def _tell_of_few(radius, n):
    if radius is None:
        return
    warn_of_few(n, 'with all of their pixels good')


def warn_of_few(n, which):
    """Warn that too few stars tell what the PSF leaves."""
    warnings.warn(
        f'what the PSF leaves of bright stars was not measured: {n} stars of '
        f'{BRIGHT:g} standard errors {which} are too few, {FEWEST} are '
        'needed; leave residual_radius out, or measure an image with more '
        'stars', AstropyUserWarning, stacklevel=6)


def doubtful(stars, bright, radius):
    """
    Tell which stars may be pieces of spikes of bright ones (n,).

    Parameters
    ----------
    stars : (3, n) `~numpy.ndarray`
        Places and fluxes.
    bright : (m,) `~numpy.ndarray` of int
        Which of them are bright.
    radius : float
        How far spikes reach [pix].

    Returns
    -------
    (n,) `~numpy.ndarray` of bool
    """
    out = np.zeros(stars.shape[1], bool)
    finite = np.flatnonzero(np.isfinite(stars).all(axis=0))
    if not bright.size:
        return out
    tree = cKDTree(stars[:2, finite].T)
    for host, near in zip(bright, tree.query_ball_point(
            stars[:2, bright].T, radius), strict=True):
        rows = finite[near]
        out[rows[stars[2, rows] < _DOUBTFUL * stars[2, host]]] = True
    return out


def _cleaned(image, known, stars, radius):
    """Return an image without what the PSF leaves of some stars."""
    data, more = image.data.copy(), np.zeros(image.data.shape)
    known.cautious().take_off(data, more, stars, whole_reach(radius))
    if not image.error.size:
        return image._replace(data=data)
    return image._replace(data=data, error=np.sqrt(image.error**2 + more))


def _left_over(image, model, stars):
    """Return an image without its stars, and the variances of its pixels."""
    variance = (image.error**2 if image.error.size
                else np.zeros(image.data.shape))
    if image.gain:
        variance = variance + np.maximum(image.data, 0) / image.gain
    noise = np.sqrt(np.nanmedian(variance))
    if not noise > 0:
        # Without errors what stars do not cover tells.
        noise = mad_std(image.data, ignore_nan=True)
        variance = np.full(image.data.shape, noise**2)
    return image.data - MixtureRenderer(model).image(
        stars, _FAINTEST * noise, image.data.shape), variance


def without_surroundings(variance, stars, radius):
    """Return variances, 0 in the squares around some stars (3, n)."""
    out = variance.copy()
    half = int(np.ceil(radius))
    for x, y, _ in stars.T:
        row, column = int(np.rint(y)), int(np.rint(x))
        out[max(row - half, 0):max(row + half + 1, 0),
            max(column - half, 0):max(column + half + 1, 0)] = 0
    return out


def saturated_rows(result):
    """Return the rows of saturated stars that could be fitted."""
    rows = result.saturated[result.saturated >= 0]
    return rows[np.isfinite(result.values[rows]).all(axis=1)]


def _bright(result):
    """Return the rows of bright stars whose fits are good."""
    with np.errstate(invalid='ignore', divide='ignore'):
        bright = result.values[:, 0] > BRIGHT * result.errors[:, 0]
    return np.flatnonzero(bright & result.valid & result.converged
                          & np.isfinite(result.values).all(axis=1))


def _telling(result):
    """Return the rows of bright stars of which all pixels are seen."""
    rows = np.setdiff1d(_bright(result), saturated_rows(result))
    return rows[result.n_pixels[rows] == result.shapes[rows].prod(axis=1)]
