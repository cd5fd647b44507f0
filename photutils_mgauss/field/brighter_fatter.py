r"""
Whether bright stars are wider than faint ones, and by how much.

Charge in a pixel pushes later charge away. To first order a star of flux F is
then the PSF convolved with a Gaussian of covariance :math:`F\, C`, the same C
everywhere. With :math:`A_s` and :math:`b_s` the normal equations of what is
added to the covariances of star s, its own numbers eliminated, and
:math:`d_s` the exposure of the star and its flux, C is found from

.. math::

    \sum_s A_s \otimes d_s d_s^T\; \delta = \sum_s b_s \otimes d_s .

It counts if it is significant both by the noise of pixels and by how much the
stars scatter about it, which a PSF that is not quite right makes larger.
"""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.field.normal import equations, model_stamps
from photutils_mgauss.field.stages import added_shapes

# Of chi^2 with three degrees of freedom, by chance once in 60,000 fields.
_SIGNIFICANT = 25.0
# Fewer stars do not tell scatter from a trend; more tell nothing new.
_FEWEST_STARS, _MOST_STARS = 15, 1000
# Of fluxes, over the largest, without which there is no trend.
_LEAST_SPREAD = 0.05


@dataclass(frozen=True)
class Fattening:
    """
    What each unit of flux adds to the covariances of a PSF.

    Attributes
    ----------
    value : (3,) `~numpy.ndarray`
        Of xx, xy and yy [pix^2].
    covariance : (3, 3) `~numpy.ndarray`
    significance : float
        The chi^2 of ``value`` with three degrees of freedom.
    largest : float
        The flux of the brightest star.
    """

    value: np.ndarray
    covariance: np.ndarray
    significance: float
    largest: float

    @property
    def is_real(self):
        """Whether bright stars are wider, beyond chance."""
        return bool(self.significance > _SIGNIFICANT
                    and self.value[0] + self.value[2] > 0)


def measure_fattening(fit, workers):
    """
    Measure what fluxes add to the covariances of the stars of a fit.

    Returns
    -------
    Fattening or None
        None if there are too few stars or their fluxes are the same.
    """
    used = np.flatnonzero(fit.problem.used)
    flux = fit.fluxes()
    scale = float(max(flux[used].max(), 1e-300))
    n_stars = np.unique(fit.problem.star[used]).size
    if n_stars < _FEWEST_STARS or np.std(flux[used]) < _LEAST_SPREAD * scale:
        return None
    order = used[np.argsort(flux[used])]
    stars = order[np.linspace(0, order.size - 1, min(
        order.size, _MOST_STARS)).astype(int)]
    tuned = replace(added_shapes(fit), weights=_even_weights(
        fit, np.median(flux[used])))
    design = np.column_stack([tuned.basis, flux / scale])[stars]
    # Exposures without a star here say nothing.
    design = design[:, design.any(axis=0)]
    matrices, gradients = _own_equations(
        tuned, fit.blurs[fit.problem.exposure], stars, workers)
    change, errors = _solved(matrices, gradients, design)
    before = np.zeros(3) if fit.fattening is None else fit.fattening
    value = scale * before + change
    chi2 = [value @ np.linalg.solve(error, value) for error in errors]
    wider = errors[int(np.argmin(chi2))]
    return Fattening(value / scale, wider / scale**2, min(chi2), scale)


def _even_weights(fit, flux):
    """
    Return weights (n, s, s) that see the same part of each star.

    The light of bright stars counts as noise out to larger radii than that
    of faint ones, so that what is wrong with a PSF would widen them by
    different amounts. All are weighted as a star of one flux is; what each
    tells in all stays what it is.
    """
    problem = fit.problem
    light = np.maximum(model_stamps(problem, fit.coefficients)
                       - problem.sky[:, None, None], 0)
    share = flux / np.maximum(fit.fluxes(), 1e-300)[:, None, None]
    stamps = problem.stamps
    variance = (stamps.base + stamps.slope * light * share
                + (fit.accuracy * light * share) ** 2)
    even = np.where(problem.weights > 0, 1 / variance, 0)
    told, evenly = (np.sum(weights * light**2, axis=(1, 2))
                    for weights in (problem.weights, even))
    return even * (told / np.maximum(evenly, 1e-300))[:, None, None]


def _own_equations(tuned, added, stars, workers):
    """Return matrices (n, 3, 3) and gradients (n, 3) of single stars."""
    found = []
    for star in stars:
        one = tuned.subset(np.array([star]))
        one.basis = np.ones((1, 1))
        found.append(equations(one, added[star][None], workers))
    return (np.array([one.matrix for one in found]),
            np.array([one.right for one in found]))


def _solved(matrices, gradients, design):
    """
    Return the step (3,) of the last column of design, and its errors.

    The errors (2, 3, 3) are those of the noise and of the stars' scatter.
    """
    n, size = design.shape
    total = np.einsum('spq,st,su->ptqu', matrices, design, design)
    inverse = np.linalg.inv(total.reshape(3 * size, -1))
    right = np.einsum('sp,st->pt', gradients, design).ravel()
    step = inverse @ right
    left = gradients - np.einsum(
        'spq,qt,st->sp', matrices, step.reshape(3, size), design)
    scores = np.einsum('sp,st->spt', left, design).reshape(n, -1)
    scatter = inverse @ (scores.T @ scores) @ inverse * n / (n - size)
    last = np.arange(3) * size + size - 1
    return step[last], np.array([one[np.ix_(last, last)]
                                 for one in (inverse, scatter)])
