r"""
By how much the light in pixels is not that of the fitted optics.

Where a PSF is hardly wider than a pixel, three numbers of each star and the
shapes make most of what few pixels with light say: what few Gaussians cannot
be is hidden in positions, differently at each place in a pixel, and what is
left in the residuals is small. Let the light of pixel i be off by
:math:`\epsilon L_i`, independently. With J and G the derivatives by a star's
own numbers and by the shapes, and residuals z in units of the errors without
that,

.. math::

    C = P - P G V G^T P , \quad P = 1 - J (J^T J)^{-1} J^T ,

is the covariance of z where all light is right, V being that of the shapes
there, and :math:`C + \epsilon^2\, C D C` is what it is otherwise, D holding
:math:`L_i^2` over the variance. Rings lack more of their light than cores do,
but it is cores that have the places of stars. So the sum of
:math:`h_i z_i^2` of each star says how large :math:`\epsilon` is, where
:math:`h_i` is by how much (:math:`x^2 + y^2`) the star moves if the light of
pixel i alone is off; the most likely :math:`\epsilon` is taken.
"""
import numpy as np
from scipy.optimize import minimize_scalar

from photutils_mgauss import kernels
from photutils_mgauss.field.base import covariance_of
from photutils_mgauss.field.covariance import shape_covariance
from photutils_mgauss.field.normal import model_stamps, to_vector
from photutils_mgauss.psf.rows import kernel_rows_of_logs

# How far from the middle pixel of a star pixels are looked at: there is all
# that a star narrower than two pixels says of its place.
_HALF = 4
# Stars that are looked at, at most.
_MOST_STARS = 300
# Between what epsilon^2 is looked for, and by how much it must make the stars
# more likely, in 2 log(likelihood).
_RANGE = (1e-8, 1e-1)
_GAIN = 1.0
# Independent numbers in a star's sum: few pixels have most of its light.
_FREEDOM = 2.0


def misfit(fit):
    """
    Return the relative error of the light in pixels.

    Parameters
    ----------
    fit : FieldFit
        Of optics that are integrated over pixels, its weights those of the
        noise alone.

    Returns
    -------
    float
    """
    problem = fit.problem
    used = np.flatnonzero(problem.used)
    if used.size == 0:
        return 0.0
    some = used[np.linspace(0, used.size - 1, min(
        used.size, _MOST_STARS)).astype(int)]
    part = problem.subset(some)
    residual = part.stamps.data - model_stamps(part, fit.coefficients)
    shapes = part.shapes(fit.coefficients)
    covariances = shape_covariance(
        covariance_of(fit), np.zeros(shapes[0].size - 3), part.basis)
    sums = np.array([_sums(*_pixels(part, i, residual[i], shapes[i]), each)
                     for i, each in enumerate(covariances)])
    found, expected, response = sums[sums[:, 1] > 0].T
    return _most_likely(found, expected, response)


def softened_covariance(fit):
    """
    Return the covariance of coefficients fitted under softened weights.

    What Gaussians may lack is part of the weights but no noise: the inverse
    of the normal equations counts it as such.

    Parameters
    ----------
    fit : FieldFit
        Its accuracy that of the light in pixels.

    Returns
    -------
    (N, N) `~numpy.ndarray`
    """
    problem = fit.problem
    light = model_stamps(problem, fit.coefficients) - problem.sky[:, None,
                                                                  None]
    light = np.maximum(light, 0)
    variance = (problem.stamps.base + problem.stamps.slope * light
                + (fit.accuracy * light) ** 2)
    shapes = problem.shapes(fit.coefficients)
    noise = np.diag(to_vector(fit.prior.precision))
    for star in np.flatnonzero(problem.used):
        noise += np.kron(
            _gradient_covariance(problem, star, shapes[star], variance[star]),
            np.outer(problem.basis[star], problem.basis[star]))
    covariance = covariance_of(fit)
    return covariance @ noise @ covariance


def _gradient_covariance(problem, star, shapes, variance):
    """Return the covariance (P, P) of the gradient of a star's shapes."""
    inside = problem.weights[star] > 0
    row, column = np.nonzero(inside)
    x, y, flux = problem.sources[star, 0]
    left, bottom = problem.stamps.corners[star]
    _, own, by_shapes = _derivatives(left + column - x, bottom + row - y,
                                     shapes, flux)
    if problem.fit_sky:
        own = np.vstack([own, np.ones(row.size)])
    root = np.sqrt(problem.weights[star][inside])
    axes, _ = np.linalg.qr((own * root).T)
    free = by_shapes * root
    free = (free - (free @ axes) @ axes.T) * root * np.sqrt(variance[inside])
    return free @ free.T


def _most_likely(found, noise, response):
    """Return epsilon from the sums of stars (n,)."""
    def cost(square):
        expected = np.maximum(noise + square * response, 1e-3 * response
                              * _RANGE[0])
        return _FREEDOM * np.sum(np.log(expected) + found / expected)

    best = minimize_scalar(lambda log: cost(np.exp(log)),
                           bounds=np.log(_RANGE), method='bounded',
                           options={'xatol': 0.05})
    return float(np.exp(best.x / 2)) if cost(0.0) - best.fun > _GAIN else 0.0


def _pixels(problem, i, residual, shapes):
    """Return residuals, light and derivatives of a star, over the errors."""
    x, y, flux = problem.sources[i, 0]
    x_0, y_0 = np.array([x, y]) - problem.stamps.corners[i]
    row, column = np.indices(residual.shape)
    inside = ((problem.weights[i] > 0)
              & (np.abs(column - np.rint(x_0)) <= _HALF)
              & (np.abs(row - np.rint(y_0)) <= _HALF))
    value, own, by_shapes = _derivatives(column[inside] - x_0,
                                         row[inside] - y_0, shapes, flux)
    if problem.fit_sky:
        own = np.vstack([own, np.ones(value.size)])
    root = np.sqrt(problem.weights[i][inside])
    return (residual[inside] * root, flux * value * root, own * root,
            by_shapes * root)


def _derivatives(x, y, shapes, flux):
    """
    Return the PSF in pixels, and derivatives of a star of some flux.

    Those by its flux, x and y (3, n), and by its shapes (6 K - 3, n).
    """
    parts = np.empty((len(shapes), 6, x.size))
    kernels.derivatives(x, y, kernel_rows_of_logs(shapes), True, parts)
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


def _sums(residual, light, own, by_shapes, covariance):
    """Return a star's sum, what noise makes of it, and its response."""
    axes, _ = np.linalg.qr(own.T)
    free = by_shapes - (by_shapes @ axes) @ axes.T
    matrix = (np.eye(light.size) - axes @ axes.T
              - free.T @ covariance @ free)
    square = light**2
    # Rows are flux, x, y: what a residual of one does to each of them.
    moves = np.linalg.pinv(own.T)[1:3]
    weight = (moves**2).sum(axis=0) * square
    return (weight @ residual**2, weight @ np.diag(matrix),
            weight @ matrix**2 @ square)
