r"""
Uniform motion in space, as a plane sees it.

A star that comes nearer moves ever faster over the sky: its place and motion
on a tangent plane after t years, and its parallax, are

.. math::
    x(t) = x + \frac{\dot x t}{1 + q t}, \quad
    \dot x(t) = \frac{\dot x}{(1 + q t)^2}, \quad
    \varpi(t) = \frac{\varpi}{1 + \zeta t},

with :math:`\zeta = \varpi v_r / A` its motion away from us in units of its
distance, and :math:`q = \zeta - x \cdot \dot x / (1 + x^2)` (x in radians),
because stars off the centre of a plane change their distance from it too.
Stars are the last axis of arrays of five rows: x, y, their motions, parallax.
"""
import numpy as np

from photutils_mgauss.sky.tangent_plane import MAS

# km/s of one au in a year, for parallaxes in radians.
PER_DISTANCE = 1 / (4.740470446 * MAS)


def moved(values, velocity, dt):
    """
    Return values (5, ..., n) of stars after ``dt`` (..., n) years.

    Parameters
    ----------
    values : (5, ..., n) `~numpy.ndarray`
        Now [mas, mas/yr, mas].
    velocity : (n,) `~numpy.ndarray`
        Radial velocities [km/s], positive for stars that recede.
    dt : float or array_like
        Julian years.
    """
    place, motion, parallax = values[:2], values[2:4], values[4]
    approach, rate = _rates(values, velocity)
    stretch = 1 + rate * dt
    return np.stack([*(place + motion * dt / stretch),
                     *(motion / stretch**2), parallax / (1 + approach * dt)])


def beyond_straight(values, velocity, dt):
    """Return what `moved` has more than a constant motion, (5, ..., n)."""
    straight = np.array(np.broadcast_arrays(*values, dt)[:5])
    straight[:2] += straight[2:4] * dt
    return moved(values, velocity, dt) - straight


def jacobian(values, velocity, dt):
    """Return the derivatives (5, 5, n) of `moved` by values (5, n)."""
    motion = values[2:4]
    approach, rate = _rates(values, velocity)
    stretch = 1 + rate * dt
    by_parallax = PER_DISTANCE * velocity
    out = np.zeros((5, 5, values.shape[1]))
    out[0, 0] = out[1, 1] = 1.0
    out[0, 2] = out[1, 3] = dt / stretch
    out[2, 2] = out[3, 3] = 1 / stretch**2
    out[:2, 4] = -motion * (dt / stretch)**2 * by_parallax
    out[2:4, 4] = -2 * motion * dt / stretch**3 * by_parallax
    out[4, 4] = 1 / (1 + approach * dt)**2
    return out


def _rates(values, velocity):
    """Return the zeta and q of the equations above [1/yr]."""
    place, motion = values[:2] / MAS, values[2:4] / MAS
    approach = PER_DISTANCE * values[4] * velocity
    tilt = np.sum(place * motion, axis=0) / (1 + np.sum(place**2, axis=0))
    return approach, approach - tilt
