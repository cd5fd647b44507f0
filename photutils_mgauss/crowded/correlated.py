"""
Noise that neighbouring pixels of a crowded image have in common.

Crowded images have no blank sky: the noise is what all stars leave over where
their light is faint.
"""
import numpy as np

from photutils_mgauss.utils.correlated_noise import no_pairs, residual_pairs
from photutils_mgauss.utils.flags import NOT_SEEN, SATURATED

# Where errors of the PSF leave more than this of a star's light, in units of
# the noise, the residual is not taken for noise; they are at least so large,
# as a fraction.
_LEFT, _LEAST_PSF_ERROR = 0.1, 0.003


def noise_pairs(model):
    """Return the sums of `residual_pairs` of a model that is solved."""
    options = model.options
    if not options.correlated_noise:
        return no_pairs()
    scale = np.sqrt(model.weight)
    error = max(options.psf_error, _LEAST_PSF_ERROR)
    faint = np.abs(model.star_light()) * scale < _LEFT / error
    return residual_pairs(model.residual * scale, model.good & faint)


def growths(correlation, psf):
    """Return by how much variances of fluxes and places grow."""
    if correlation is None:
        return 1.0, 1.0
    # Of the Gaussian with the area of the PSF.
    width = np.sqrt(psf.area / (4 * np.pi))
    return correlation.flux_growth(width), correlation.growth(width)


def allow_for_correlation(stars, correlation, psf, options):
    """
    Return stars with errors that allow for correlated noise.

    Parameters
    ----------
    stars : Stars
        As `~photutils_mgauss.crowded.table.tabulate` returns them.
    correlation : NoiseCorrelation or None
    psf : LocalPSF
    options : TileOptions

    Returns
    -------
    Stars
        Only those that are listed or still significant.
    """
    flux, place = growths(correlation, psf)
    if not len(stars) or flux == place == 1:
        return stars
    error = grown(stars.flux_err, stars.flux_confusion_err, flux)
    # Hidden stars have the same share in all terms of the covariance.
    change = {name: grown(getattr(stars, name),
                          getattr(stars, name[0] + '_confusion_err'), place)
              for name in ('x_err', 'y_err')}
    covariance = stars.xy_cov * (change['x_err'] / stars.x_err)**2
    noise = np.sqrt(error**2 - stars.flux_confusion_err**2)
    threshold, least = (limit / options.raised
                        for limit in (options.threshold, options.keep))
    unseen = stars.listed & ~(stars.flux > least * noise)
    stars = stars.replaced(
        flux_err=error, xy_cov=covariance, **change,
        significance=stars.significance / np.sqrt(flux),
        flags=stars.flags | np.where(unseen, NOT_SEEN, 0))
    return stars.chosen(stars.listed | (stars.flags & SATURATED > 0)
                        | (stars.significance >= threshold))


def allow_in_each(stars, correlations, psfs, keep):
    """
    Return stars of E images with errors that allow for correlated noise.

    Parameters
    ----------
    stars : Stars
        As `~photutils_mgauss.crowded.many_table.tabulate` returns them.
    correlations : (E,) list of NoiseCorrelation or None
    psfs : (E,) list of LocalPSF
    keep : float
        How many standard errors make a star of a list significant.

    Returns
    -------
    Stars
    """
    if not len(stars) or not any(correlations):
        return stars
    flux, place = np.transpose([growths(*one) for one in zip(
        correlations, psfs, strict=True)])
    # Each image says the more the brighter the star is there.
    informed = np.nan_to_num((stars.fluxes / stars.flux_err)**2)
    informed /= np.maximum(informed.sum(axis=1, keepdims=True), 1e-300)
    shared = 1 + informed @ (np.stack([flux, place]).T - 1)
    significance = stars.significance / np.sqrt(shared[:, 0])
    unseen = stars.listed & ~(significance > keep)
    return stars.replaced(
        flux_err=grown(stars.flux_err, stars.flux_confusion_err, flux),
        place=stars.place * shared[:, 1, None, None],
        significance=significance,
        flags=stars.flags | np.where(unseen, NOT_SEEN, 0))


def grown(error, hidden, growth):
    """Return errors whose parts other than a hidden one grow."""
    return np.sqrt(growth * (error**2 - hidden**2) + hidden**2)
