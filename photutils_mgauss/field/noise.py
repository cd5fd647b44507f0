r"""
What noise does to the coefficients of a field under any weights.

The inverse of the normal equations is the covariance of the coefficients if
weights are one over the variances of independent pixels. Where weights w
contain what Gaussians may lack, or pixels are correlated, with the matrix R,
it is

.. math::

    M^{-1} \left[\Lambda + \sum_s \left(F_s\, w^{1/2} \sigma\, R\, \sigma
    w^{1/2} F_s^T\right) \otimes B_s B_s^T\right] M^{-1} ,

with :math:`F_s` the derivatives of the pixels of star s by its shapes, over
the square roots of the weights and its own numbers eliminated,
:math:`\Lambda` the prior and M the equations with it. In smooth noise the
many faint pixels of wings know less of fluxes than the few of a core know of
positions, so that no one factor for all variances will do.
"""
import numpy as np
from scipy.ndimage import correlate

from photutils_mgauss import kernels
from photutils_mgauss.field.base import covariance_of
from photutils_mgauss.field.normal import model_stamps, to_vector
from photutils_mgauss.psf.rows import kernel_rows_of_logs


def noise_covariance(fit, correlations=None, growth=None):
    """
    Return the covariance of coefficients that noise makes.

    What Gaussians may lack is part of the weights but no noise where pixels
    are integrated; else it is as much noise as the rest.

    Parameters
    ----------
    fit : FieldFit
        Its accuracy that of the light in pixels.
    correlations : list of NoiseCorrelation or None, optional
        For each exposure what the noise of its pixels has in common; by
        default nothing.
    growth : (E,) array_like, optional
        By how much the variances of each exposure have been enlarged for it.

    Returns
    -------
    (N, N) `~numpy.ndarray`
    """
    problem = fit.problem
    noise, misfit = _variances(fit)
    n = problem.exposure.max() + 1
    correlations = [None] * n if correlations is None else correlations
    growth = np.ones(n) if growth is None else growth
    slopes, shares = _Slopes(fit), problem.shares()
    total = np.diag(to_vector(fit.prior.precision))
    for star in np.flatnonzero(problem.used):
        exposure = problem.exposure[star]
        free, inside = slopes.of_star(star)
        gradient = _gradient_covariance(
            free, inside, noise[star] / growth[exposure], misfit[star],
            correlations[exposure])
        total += np.kron(shares[star] ** 2 * gradient, np.outer(
            problem.basis[star], problem.basis[star]))
    covariance = covariance_of(fit)
    return covariance @ total @ covariance


def _variances(fit):
    """Return those (n, s, s) of noise, and of light in the wrong pixels."""
    problem = fit.problem
    light = model_stamps(problem, fit.coefficients) - problem.sky[:, None,
                                                                  None]
    light = np.maximum(light, 0)
    noise = problem.stamps.base + problem.stamps.slope * light
    if problem.pixel_integrated:
        return noise, (fit.accuracy * light) ** 2
    weights = problem.weights
    assumed = np.divide(1, weights, where=weights > 0,
                        out=np.zeros_like(weights))
    return noise, np.maximum(assumed - noise, 0)


class _Slopes:
    """The derivatives of the pixels of stars by the numbers of a field."""

    def __init__(self, fit):
        self.problem = problem = fit.problem
        given = fit.coefficients, problem.basis, problem.local
        self.shapes, sign = problem.form.shapes(*given)
        self.sign = np.broadcast_to(sign, self.shapes.shape[:-1])
        self.jacobians = problem.form.jacobians(*given)

    def of_star(self, star):
        """
        Return the derivatives by the shapes, and of which pixels they are.

        Times the weights, the star's own numbers eliminated: (P, pixels) and
        (s, s).
        """
        problem = self.problem
        inside = problem.weights[star] > 0
        row, column = np.nonzero(inside)
        x, y, flux = problem.sources[star, 0]
        left, bottom = problem.stamps.corners[star]
        _, own, by_shapes = derivatives(
            left + column - x, bottom + row - y, self.shapes[star], flux,
            self.sign[star], integrated=problem.pixel_integrated)
        if self.jacobians.size:
            by_shapes = self.jacobians[star].T @ by_shapes
        if problem.fit_sky:
            own = np.vstack([own, np.ones(row.size)])
        root = np.sqrt(problem.weights[star][inside])
        axes, _ = np.linalg.qr((own * root).T)
        free = by_shapes * root
        return (free - (free @ axes) @ axes.T) * root, inside


def _gradient_covariance(free, inside, noise, misfit, correlation):
    """Return the covariance (P, P) of the gradient of a star's shapes."""
    noisy = free * np.sqrt(noise[inside])
    if correlation is None:
        spread = noisy
    else:
        images = np.zeros((len(free), *inside.shape))
        images[:, inside] = noisy
        spread = correlate(images, correlation.matrix[None],
                           mode='constant')[:, inside]
    gradient = noisy @ spread.T + (free * misfit[inside]) @ free.T
    return (gradient + gradient.T) / 2


def derivatives(x, y, shapes, flux, sign=1.0, *, integrated):
    """
    Return the PSF in pixels, and derivatives of a star of some flux.

    Parameters
    ----------
    x, y : (n,) `~numpy.ndarray`
        Offsets of the pixels from the star.
    shapes : (K, 6) `~numpy.ndarray`
    flux : float
    sign : (K,) array_like, optional
        Of the weights.
    integrated : bool
        Whether the shapes are integrated over pixels.

    Returns
    -------
    (n,), (3, n), (6 K - 3, n) `~numpy.ndarray`
        The PSF; the derivatives by flux, x and y, and by the shapes.
    """
    parts = np.empty((len(shapes), 6, x.size))
    kernels.derivatives(x, y, kernel_rows_of_logs(shapes, sign), integrated,
                        parts)
    g, gx, gy, gxx, gxy, gyy = parts.transpose(1, 0, 2)
    s = shapes[:, 4, None]
    across, along = (np.exp(-2 * shapes[:, i, None]) for i in (3, 5))
    # Gaussians obey the heat equation, see `kernels.derivatives`.
    by_shapes = flux * np.stack([
        g, -gx, -gy, -across * gxx, along * (s * gxx + gxy),
        -along * (gyy + s * s * gxx + 2 * s * gxy)], axis=1)
    value = g.sum(axis=0)
    own = np.stack([value, -flux * gx.sum(axis=0), -flux * gy.sum(axis=0)])
    return value, own, by_shapes.reshape(-1, x.size)[3:]
