"""Standard deviations that outliers do not change."""
import numpy as np
from scipy.special import ndtri


def std_about_zero(values, axis=None):
    """
    Return the standard deviation of normal errors, from their median size.

    As `~astropy.stats.mad_std`, but about zero instead of about the median;
    NaN are left out.
    """
    return np.nanmedian(np.abs(values), axis=axis) / ndtri(0.75)
