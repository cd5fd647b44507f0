r"""
The degrees that few stars do not tell, as large as they may be.

Left-out stars choose the degree up to which terms can be told. What is beyond
is not nothing: positions would be off by it, the more the farther from the
stars, and their errors would not know. So all terms up to the usual degree
are fitted, those that few stars do not tell with the variances they are
likely to have, which makes them part of the covariance. The terms of degree d
have the variance :math:`4^{1 - d} e^{l + h} S`, with S that of the terms of
degree 1, which becomes :math:`e^l S` itself; h is 0 where coefficients halve
with each degree. Log weights, means and precisions have an l and an h each.

With :math:`M, b` the normal equations at coefficients c, :math:`\Lambda` the
precisions of the prior, and :math:`r = b - \Lambda c`, those l and h are
taken under which the stars are most likely, all coefficients together, and
which are themselves not unlikely:

.. math::

    2 \ln L = - c^T \Lambda c + r^T (M + \Lambda)^{-1} r
    - \ln\det (M + \Lambda) + \ln\det \Lambda .

With m and s the mean and the standard deviation of a coefficient of prior
variance v under all this,

.. math::

    2 \frac{\partial \ln L}{\partial \ln v} = \frac{m^2 + s^2}{v} - 1 .
"""
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from photutils_mgauss.field import stages
from photutils_mgauss.field.choice import full_degree
from photutils_mgauss.field.covariance import variation
from photutils_mgauss.field.normal import (
    equations,
    to_coefficients,
    to_vector,
)

# How often the sizes follow the coefficients, and these the sizes.
_ROUNDS = 2
# By how much variances fall with each degree.
_FALL = 0.25
# Standard deviations of l and h. Those h that simulated optics have with
# hundreds of stars scatter by 0.7 about 0; others may differ more.
_WIDTHS = np.repeat([2.0, 1.0], 3)
_LIMITS = (-9.0, 3.0)
_TOLERANCE, _MOST_STEPS = 0.1, 100


def add_degrees(fit, basis, degree, workers, *, reject=True):
    """
    Return a fit with the terms of further degrees.

    Parameters
    ----------
    fit : FieldFit
        Of polynomials of ``degree``.
    basis : (n, T) `~numpy.ndarray`
        The polynomials at the stars, those of further degrees included.
    degree : int
    workers : Workers
    reject : bool, optional
        Whether to drop deviant stars and pixels. Stars that were deviant
        without the new terms are tried again.

    Returns
    -------
    FieldFit
    """
    workers.tell(f'degree {full_degree(degree)}')
    before = fit.problem.used
    if not before.all():
        # A star may have been deviant for want of the new terms.
        wide = _wider(fit, basis, degree, np.ones_like(before), workers,
                      reject)
        if wide.problem.used.sum() > before.sum():
            return wide
    return _wider(fit, basis, degree, before, workers, reject)


def _wider(fit, basis, degree, used, workers, reject):
    """Return a fit of more degrees, from some of the stars."""
    new = slice(stages.n_terms(degree), stages.n_terms(full_degree(degree)))
    problem = fit.problem.subset(np.arange(len(basis)))
    problem.basis = np.ascontiguousarray(
        np.hstack([basis[:, :new.stop], problem.extra]))
    problem.used = used.copy()
    wide = replace(
        fit, problem=problem, prior=_raised(fit.prior, new.stop),
        coefficients=stages.raised(fit.coefficients, new.stop,
                                   problem.n_extra),
        deviant_pixels=fit.deviant_pixels & fit.problem.used[:, None, None])
    sizes = _Sizes(wide, new, variation(fit))
    for i in range(_ROUNDS):
        stages.weigh(wide, reject=reject and i > 0, share=None)
        wide.equations = equations(wide.problem, wide.coefficients, workers)
        wide.prior = sizes.most_likely()
        stages.advance(wide, workers, tolerance=0.01, max_steps=10)
    return wide


def _raised(prior, terms):
    """Return a prior with further terms, of no precision yet."""
    return replace(prior, **{
        name: stages.raised(getattr(prior, name), terms, prior.n_extra)
        for name in ('mean', 'precision')})


class _Sizes:
    """
    The sizes l and h of a fit's terms.

    Those of a slice are new; ``scale`` (P,) are the variances S.
    """

    def __init__(self, fit, new, scale):
        self.fit = fit
        self.known, self.new = slice(1, new.start), new
        self.kinds = fit.problem.form.kinds
        self.precision = fit.prior.precision.copy()
        variance = np.ones(self.precision[0].size)
        # The first three numbers are not fitted.
        variance[3:] = scale
        fall = _FALL ** (stages.term_degrees(new.stop)[new] - 1.0)
        self.precision[new] = 1 / (variance.reshape(self.precision[0].shape)
                                   * fall[:, None, None])

    def most_likely(self):
        """Return the prior under which the stars are most likely."""
        found = minimize(self._cost, np.zeros(_WIDTHS.size), jac=True,
                         method='L-BFGS-B',
                         bounds=[_LIMITS] * _WIDTHS.size,
                         options={'maxiter': _MOST_STEPS,
                                  'gtol': _TOLERANCE})
        return self.prior(found.x)

    def prior(self, sizes):
        """Return the prior for the l and the h (6,) by kind."""
        every, higher = sizes.reshape(2, -1)[:, self.kinds]
        precision = self.precision.copy()
        precision[self.known] *= np.exp(-every)
        precision[self.new] *= np.exp(-every - higher)
        return replace(self.fit.prior, precision=precision)

    def _cost(self, sizes):
        """Return less the log likelihood, and its derivatives."""
        value, slopes = evidence(self.fit, self.prior(sizes))
        known, new = ([slopes[terms][..., self.kinds == kind].sum()
                       for kind in range(3)]
                      for terms in (self.known, self.new))
        slope = np.append(np.add(known, new), new)
        pulls = sizes / _WIDTHS
        return 0.5 * pulls @ pulls - value, pulls / _WIDTHS - slope


def evidence(fit, prior):
    """
    Return the log likelihood of a prior, and its derivatives.

    Up to a constant, and by the logarithms of the prior's variances, in the
    shape of the coefficients, with 0 where one is not fitted.
    """
    diagonal = to_vector(prior.precision)
    factor = cho_factor(fit.equations.matrix + np.diag(diagonal))
    right = fit.equations.right + prior.right(fit.coefficients)
    step = cho_solve(factor, right)
    value = 0.5 * (right @ step + np.log(diagonal).sum()
                   - prior.cost(fit.coefficients)
                   ) - np.log(np.diag(factor[0])).sum()
    mean = to_vector(fit.coefficients - prior.mean) + step
    variance = np.diag(dpotri(*factor)[0])
    slopes = 0.5 * ((mean**2 + variance) * diagonal - 1)
    return value, to_coefficients(slopes, fit.coefficients)
