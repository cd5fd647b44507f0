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

from photutils_mgauss.field.base import covariance_of
from photutils_mgauss.field.covariance import shape_covariance
from photutils_mgauss.field.noise import derivatives
from photutils_mgauss.field.normal import model_stamps

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
    value, own, by_shapes = derivatives(
        column[inside] - x_0, row[inside] - y_0, shapes, flux,
        integrated=True)
    if problem.fit_sky:
        own = np.vstack([own, np.ones(value.size)])
    root = np.sqrt(problem.weights[i][inside])
    return (residual[inside] * root, flux * value * root, own * root,
            by_shapes * root)


def _sums(residual, light, own, by_shapes, covariance):
    """Return a star's sum, what noise makes of it, and its response."""
    axes, _ = np.linalg.qr(own.T)
    free = by_shapes - (by_shapes @ axes) @ axes.T
    matrix = (np.eye(light.size) - axes @ axes.T
              - free.T @ covariance @ free)
    square = light**2
    # Rows are flux, x, y: what a residual of one does to each of them.
    size = np.linalg.norm(own, axis=1)[:, None]
    size[size == 0] = 1
    moves = (np.linalg.pinv((own / size).T) / size)[1:3]
    weight = (moves**2).sum(axis=0) * square
    return (weight @ residual**2, weight @ np.diag(matrix),
            weight @ matrix**2 @ square)
