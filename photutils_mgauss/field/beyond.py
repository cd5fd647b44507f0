r"""
One degree more than few stars were found to bear, as small as they say.

Left-out stars choose a degree whose terms are all of a size. What is beyond is
not nothing: positions would be off by it, the more the farther from the stars,
and their errors would not know. So terms of one degree more are added, each
with a prior variance of :math:`e^{h}` times that by which its shape varies,
one h for log weights, means and precisions each. With :math:`M, b` the normal
equations at coefficients c, :math:`\Lambda` the precisions of the prior, and
:math:`r = b - \Lambda c`, those h are taken under which the stars are most
likely, all coefficients together:

.. math::

    2 \ln L = - c^T \Lambda c + r^T (M + \Lambda)^{-1} r
    - \ln\det (M + \Lambda) + \ln\det \Lambda .
"""
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from photutils_mgauss.field import stages
from photutils_mgauss.field.choice import is_better
from photutils_mgauss.field.covariance import variation
from photutils_mgauss.field.normal import equations, to_vector

# How often the sizes follow the coefficients, and these the sizes.
_ROUNDS = 2
# Where the logarithms of the variances begin, and their limits.
_FIRST, _LIMITS = -3.0, (-9.0, 2.0)
_TOLERANCE, _MOST_STEPS = 0.1, 200
# By how much the new terms must make the stars more likely, in
# 2 log(likelihood).
_GAIN = 1.0


def add_degree(fit, basis, degree, workers, *, reject=True):
    """
    Return a fit with the terms of one degree more.

    It is the fit as it was if the stars do not ask for them, or those left
    out become no more likely.

    Parameters
    ----------
    fit : FieldFit
        Of polynomials of ``degree``.
    basis : (n, T) `~numpy.ndarray`
        The polynomials at the stars, those of the next degree included.
    degree : int
    workers : Workers
    reject : bool, optional
        Whether to drop deviant stars and pixels. Stars that were deviant
        without the new terms are tried again.

    Returns
    -------
    FieldFit
    """
    workers.tell(f'degree {degree + 1}')
    before = fit.problem.used
    # A star may have been deviant for want of the new terms.
    tries = [np.ones_like(before)] + [before] * (not before.all())
    for used in tries:
        wide = _wider(fit, basis, degree, used, workers, reject)
        if wide is not None and is_better(fit, wide, workers):
            return wide
    return fit


def _wider(fit, basis, degree, used, workers, reject):
    """Return a fit of one degree more, from some stars, if it says more."""
    new = slice(stages.n_terms(degree), stages.n_terms(degree + 1))
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
        wide.prior, gain = sizes.most_likely()
        if gain < _GAIN:
            return None
        stages.advance(wide, workers, tolerance=0.01, max_steps=10)
    return wide


def _raised(prior, terms):
    """Return a prior with further terms, of no precision yet."""
    return replace(prior, **{
        name: stages.raised(getattr(prior, name), terms, prior.n_extra)
        for name in ('mean', 'precision')})


class _Sizes:
    """The prior of new terms, a slice, in units of variances (P,)."""

    def __init__(self, fit, new, scale):
        self.fit, self.new, self.scale = fit, new, scale

    def most_likely(self):
        """Return the prior under which the stars are most likely, and why."""
        found = minimize(
            lambda logs: -evidence(self.fit, self.prior(logs)),
            np.full(3, _FIRST), method='Nelder-Mead', bounds=[_LIMITS] * 3,
            options={'xatol': _TOLERANCE, 'fatol': _TOLERANCE,
                     'maxiter': _MOST_STEPS})
        least = evidence(self.fit, self.prior(np.full(3, _LIMITS[0])))
        return self.prior(found.x), 2 * (-found.fun - least)

    def prior(self, logs):
        """Return the prior whose new terms have log variances by kind."""
        precision = self.fit.prior.precision.copy()
        variance = np.ones(precision[0].size)
        # The first three numbers are not fitted.
        variance[3:] = self.scale
        variance = variance.reshape(precision[0].shape) * np.exp(
            logs[self.fit.problem.form.kinds])
        precision[self.new] = 1 / variance
        return replace(self.fit.prior, precision=precision)


def evidence(fit, prior):
    """Return the log likelihood of a prior, up to a constant."""
    diagonal = to_vector(prior.precision)
    factor = cho_factor(fit.equations.matrix + np.diag(diagonal))
    right = fit.equations.right + prior.right(fit.coefficients)
    return 0.5 * (right @ cho_solve(factor, right) + np.log(diagonal).sum()
                  - prior.cost(fit.coefficients)
                  ) - np.log(np.diag(factor[0])).sum()
