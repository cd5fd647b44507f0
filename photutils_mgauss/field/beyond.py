r"""
The degrees that few stars do not tell, as large as they may be.

Left-out stars choose the degree up to which terms can be told. What is beyond
is not nothing: positions would be off by it, the more the farther from the
stars, and their errors would not know. So all terms up to the usual degree
are fitted, those that few stars do not tell with the variances they are
likely to have, which makes them part of the covariance. The terms of degree d
have the variance :math:`4^{1 - d} e^{l + h} S`, with S that of the terms of
degree 1, which becomes :math:`e^l S` itself; h is 0 where coefficients halve
with each degree. Log weights, means along x, means along y, and precisions
have an l and an h each: optics may move the light along one axis only.

With :math:`M, b` the normal equations at coefficients c, :math:`\Lambda` the
precisions of the prior, and :math:`r = b - \Lambda c`, the likelihood L of
all l and h, for any coefficients, is

.. math::

    2 \ln L = - c^T \Lambda c + r^T (M + \Lambda)^{-1} r
    - \ln\det (M + \Lambda) + \ln\det \Lambda .

With m and s the mean and the standard deviation of a coefficient of prior
variance v under all this,

.. math::

    2 \frac{\partial \ln L}{\partial \ln v} = \frac{m^2 + s^2}{v} - 1 .

Few stars leave l and h uncertain, and what they cannot tell may be as large
as the mean of its variances, which is more than the most likely one. About
the most likely sizes :math:`\hat\sigma` their distribution is nearly a
Gaussian of covariance C, and a variance :math:`e^{a^T \sigma}` has the mean

.. math::

    \left\langle e^{a^T \sigma} \right\rangle
    = e^{a^T \hat\sigma + a^T C a / 2} .
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
# Which l and h each of a Gaussian's numbers has.
_KINDS = np.array([0, 1, 2, 3, 3, 3])
_N_KINDS = 4
# What l and h there are in the logs of known and of new variances.
_USES = np.kron([[1, 0], [1, 1]], np.eye(_N_KINDS))
# Standard deviations of l and h. Those h that simulated optics have with
# hundreds of stars scatter by 0.7 about 0; others may differ more. Most of
# the variance is common to means along x and y, whose l and h differ less
# from each other than from 0.
_WIDTHS, _COMMON = (2.0, 1.0), 0.8
_ALIKE = np.eye(_N_KINDS)
_ALIKE[1, 2] = _ALIKE[2, 1] = _COMMON
_PRECISION = np.linalg.inv(np.kron(np.diag(np.square(_WIDTHS)), _ALIKE))
# Of numerical derivatives by l and h.
_STEP = 0.1
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
        wide.prior = sizes.expected()
        stages.advance(wide, workers, tolerance=0.01, max_steps=10)
    return wide


def _raised(prior, terms):
    """Return a prior with further terms, of no precision yet."""
    return replace(prior, **{
        name: stages.raised(getattr(prior, name), terms, prior.n_extra)
        for name in ('mean', 'precision')})


class _Sizes:
    """
    The sizes l and h of a fit's terms, how large these may be.

    Those of a slice are new; ``scale`` (P,) are the variances S.
    """

    def __init__(self, fit, new, scale):
        self.fit = fit
        self.known, self.new = slice(1, new.start), new
        self.precision = fit.prior.precision.copy()
        variance = np.ones(self.precision[0].size)
        # The first three numbers are not fitted.
        variance[3:] = scale
        fall = _FALL ** (stages.term_degrees(new.stop)[new] - 1.0)
        self.precision[new] = 1 / (variance.reshape(self.precision[0].shape)
                                   * fall[:, None, None])

    def expected(self):
        """Return the prior of the variances that are to be expected."""
        found = minimize(self._cost, np.zeros(len(_USES)), jac=True,
                         method='L-BFGS-B',
                         bounds=[_LIMITS] * len(_USES),
                         options={'maxiter': _MOST_STEPS,
                                  'gtol': _TOLERANCE})
        return self.prior(found.x, self._covariance(found.x))

    def _covariance(self, sizes):
        """Return the covariance of the sizes about the most likely ones."""
        here = self._cost(sizes)[1]
        curvature = np.array([self._cost(sizes + step)[1] - here for step in
                              _STEP * np.eye(sizes.size)]) / _STEP
        values, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
        # Far from a maximum it may be anything; the prior knows that much.
        values = np.maximum(values, np.linalg.eigvalsh(_PRECISION)[0])
        return (vectors / values) @ vectors.T

    def prior(self, sizes, covariance=None):
        """
        Return the prior for the l (4,) and then the h (4,) of the kinds.

        With a covariance (8, 8) of theirs, of the means of the variances.
        """
        logs = _USES @ sizes
        if covariance is not None:
            logs = logs + 0.5 * np.diag(_USES @ covariance @ _USES.T)
        known, new = logs.reshape(2, -1)[:, _KINDS]
        precision = self.precision.copy()
        precision[self.known] *= np.exp(-known)
        precision[self.new] *= np.exp(-new)
        return replace(self.fit.prior, precision=precision)

    def _cost(self, sizes):
        """Return less the log likelihood, and its derivatives."""
        value, slopes = evidence(self.fit, self.prior(sizes))
        by_log = [slopes[terms][..., kind == _KINDS].sum()
                  for terms in (self.known, self.new)
                  for kind in range(_N_KINDS)]
        pull = _PRECISION @ sizes
        return 0.5 * sizes @ pull - value, pull - by_log @ _USES


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
