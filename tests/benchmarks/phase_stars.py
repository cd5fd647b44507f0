"""Noise-free stars at all phases of the pixels, and how well they centre."""
import numpy as np
from astropy.table import QTable
from scipy.interpolate import RectBivariateSpline

from photutils_mgauss import (
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
    pixel_phase_error,
)

N_PHASES = 8
PHASE = (np.arange(N_PHASES) + 0.5) / N_PHASES - 0.5
SPACING = 11


def star_positions():
    """Return x and y (64,) of stars at all pairs of phases."""
    x, y = np.meshgrid(PHASE, PHASE)
    j, i = np.indices(x.shape)
    first = SPACING // 2
    return (x + i * SPACING + first).ravel(), (y + j * SPACING
                                               + first).ravel()


def star_image(image, fit, oversampling):
    """
    Return native pixels of stars with the PSF that the image samples.

    Between the samples it is the model plus the residual's quintic spline:
    the residual is small, so its interpolation hardly matters.
    """
    axes = [(np.arange(n) - (n - 1) / 2) / oversampling for n in image.shape]
    residual = RectBivariateSpline(*axes, fit.residual, kx=5, ky=5)
    stars = np.zeros((N_PHASES * SPACING,) * 2)
    offsets = np.arange(SPACING) - SPACING // 2
    for x, y in zip(*star_positions(), strict=True):
        row, column = np.rint([y, x]).astype(int)
        v, u = row + offsets - y, column + offsets - x
        stars[np.ix_(row + offsets, column + offsets)] = residual(
            v, u) + fit.flux * fit.mixture.evaluate(u, v[:, None])
    return stars


def phase_errors(image, fit, oversampling, size):
    """Return the errors (64, 2) of stars fitted in size x size pixels."""
    x, y = star_positions()
    start = QTable({'x': x, 'y': y, 'flux': np.full(x.size, fit.flux)})
    table = MixturePSFPhotometry(MultiGaussianPSFModel(fit.mixture), size)(
        star_image(image, fit, oversampling), init_params=start)
    return np.column_stack([table['x_fit'] - x, table['y_fit'] - y])


def summarise(errors):
    """
    Return measures of errors (nodes, 64, 2), in thousandths of a pixel.

    Of each node the root mean square over phases and axes and half the
    range over the phases (mean of the axes), a shift common to all phases
    taken out; half the range of the medians in bins of the phase, x and y
    together (`pixel_phase_error`); and the last for all nodes' stars at once.
    """
    errors = 1e3 * (errors - errors.mean(axis=1, keepdims=True))
    rms = np.sqrt((errors**2).mean(axis=(1, 2)))
    half = np.ptp(errors, axis=1).mean(axis=1) / 2
    binned = np.array([_half_range(node[None]) for node in errors])
    return rms, half, binned, _half_range(errors)


def _half_range(errors):
    true = np.tile(np.column_stack(star_positions()), (len(errors), 1, 1))
    return pixel_phase_error(true.ravel(), (true + errors).ravel(),
                             n_bins=N_PHASES).half_range
