r"""
Uniform motion in space, as a plane and local axes see it.

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

from photutils_mgauss.sky.tangent_plane import MAS, directions

# km/s of one au in a year, for parallaxes in radians.
PER_DISTANCE = 1 / (4.740470446 * MAS)
NO_ERROR = 1e27  # mas^2: a variance that says that nothing is known


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


def swerve(values, velocity, dt, origin, plane, observer):
    """
    Return what stars move beyond a model without radial velocities.

    That model has constant motions and parallaxes, and the parallax factors
    of one place of the star.

    Parameters
    ----------
    values : (5, n) `~numpy.ndarray`
        Of the stars, when ``dt`` is 0.
    velocity : (n,) `~numpy.ndarray`
        Radial velocities [km/s].
    dt : (E, 1) or (E, n) `~numpy.ndarray`
        Julian years.
    origin : (2, n) `~numpy.ndarray`
        The places of the stars that the parallax factors are for.
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane` or None
        None without parallaxes.
    observer : (3, E, 1) or (3, E, n) `~numpy.ndarray` or None
        Barycentric places of the observer [au].

    Returns
    -------
    (2, E, n) `~numpy.ndarray`
    """
    now = values[:, None]
    extra = beyond_straight(now, velocity, dt)
    if plane is None:
        return extra[:2]
    place = now[:2] + now[2:4] * dt + extra[:2]
    return (extra[:2]
            + (now[4] + extra[4]) * plane.parallax_factors(place, observer)
            - now[4] * plane.parallax_factors(origin[:, None], observer))


def carried(values, covariance, velocity, years, year):
    """
    Return values (5, n), covariances and years of stars at one ``year``.

    Stars of which anything is unknown (NaN) stay as they are; a variance
    above `NO_ERROR` of a parallax says that its error is not known.
    """
    space = np.isfinite(values).all(axis=0) & np.isfinite(velocity + years)
    if not space.any():
        return values, covariance, years
    old, speed = values[:, space], velocity[space]
    dt = year - years[space]
    turn = jacobian(old, speed, dt)
    values, covariance, years = values.copy(), covariance.copy(), years.copy()
    # A parallax without an error is taken as it is.
    turn[:4, 4] *= covariance[4, 4, space] < NO_ERROR
    values[:, space], years[space] = moved(old, speed, dt), year
    covariance[..., space] = np.einsum(
        'ijn,jkn,lkn->iln', turn, covariance[..., space], turn)
    return values, covariance, years


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


def turned(plane, values, covariance):
    """
    Return values and covariances in local axes instead of the plane's.

    The position becomes right ascension and declination [deg], its
    covariance turns.
    """
    turn = turns(plane, values[:2], len(values))
    moved = np.einsum('ijn,jn->in', turn, values)
    moved[:2] = directions(plane.deproject(values[:2]))
    half = np.einsum('ijn,jkn->ikn', turn, covariance)
    return moved, np.einsum('ijn,kjn->ikn', half, turn)


def turns(plane, places, size):
    """Return the matrices (p, p, n) from the plane's axes to local ones."""
    inverse = plane.local_inverse(places)
    turn = np.zeros((size, size, places.shape[1]))
    turn[np.arange(size), np.arange(size)] = 1.0
    for k in [0, 2] + [size - 2] * (size > 5):
        turn[k:k + 2, k:k + 2] = inverse
    return turn
