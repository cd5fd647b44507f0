r"""
Whether stars move straight: tests of accelerations and jerks.

In the frames of a fit, each star gets an acceleration a, and then a jerk j as
well,

.. math::
    z = z_0 + \mu t + a t^2 / 2 + j t^3 / 6 ,

beside its parallax if that is fitted. The significance of either is the
length of the vector in its errors, :math:`\sqrt{a^T C^{-1} a}`: its square is
a chi-square of two degrees of freedom where there is none, so that it exceeds
s by chance in :math:`e^{-s^2/2}` of the stars.
"""
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.motions.joint import measured_ranks
from photutils_mgauss.motions.loop import solve
from photutils_mgauss.motions.priors import Priors
from photutils_mgauss.motions.stacked import invert_2x2

# By the number of terms: what the columns are called, and per which power of
# a year they are.
_TERMS = (('acc', 2), ('jerk', 3))


def curvature_table(fit, ids):
    """Return the table of the accelerations and jerks of all stars."""
    unit = u.Unit(fit.setup.sightings.unit)
    table = QTable({'id': ids})
    problem = fit.problem
    for bends, (name, power) in enumerate(_TERMS, 1):
        bent = replace(problem, acceleration=True, jerk=bends > 1)
        bent = replace(bent, priors=Priors.none(bent.n_parameters))
        estimates = solve(fit.setup, bent, fit.frames)
        # Rounding hides that a matrix is singular.
        known = measured_ranks(bent) == bent.n_parameters
        vector = np.where(known, estimates.values[-2:], np.nan)
        covariance = np.where(known, estimates.covariance[-2:, -2:], np.nan)
        significance = _length(vector, covariance)
        vector, covariance = _towards_the_north(fit, vector, covariance)
        for k, axis in enumerate(('ra', 'dec')):
            table[f'{name}{axis}'] = vector[k] * unit / u.yr**power
            table[f'{name}{axis}_error'] = np.sqrt(
                covariance[k, k]) * unit / u.yr**power
        table[f'{name}_significance'] = significance
    return table


def _length(vector, covariance):
    """Return the lengths of vectors (2, n) in their errors."""
    a, b, c = invert_2x2(covariance[0, 0], covariance[0, 1],
                         covariance[1, 1])
    x, y = vector
    return np.sqrt(a * x * x + 2 * b * x * y + c * y * y)


def _towards_the_north(fit, vector, covariance):
    """Return vectors and covariances along right ascension, declination."""
    plane = fit.setup.sightings.plane
    if plane is None:
        return vector, covariance
    turn = plane.local_inverse(fit.setup.origin)
    return (np.einsum('ijn,jn->in', turn, vector),
            np.einsum('ijn,jkn,lkn->iln', turn, covariance, turn))
