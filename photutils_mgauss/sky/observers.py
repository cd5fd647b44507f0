"""
Times and observers: Julian years in TDB, barycentric places, aberration.

Everything works offline, from the analytical ephemeris that comes with
astropy.
"""
import warnings

import astropy.units as u
import erfa
import numpy as np
from astropy.coordinates import (
    CartesianDifferential,
    CartesianRepresentation,
    get_body_barycentric,
    get_body_barycentric_posvel,
)
from astropy.time import Time

LIGHT = 173.1446326846693  # speed of light [au / day]
# The Sun-Earth L2 point lies this fraction of an Earth orbit further out:
# the cube root of a third of the Earth-Moon to Sun mass ratio.
L2_FRACTION = (3.0404e-6 / 3) ** (1 / 3)
# Between these years something was observed; other numbers are days, such as
# a Julian date, or years since something.
OBSERVED = (1800, 2200)
ANY_YEAR = (-10_000, 10_000)
OBSERVERS = ('earth', 'leo', 'l2')


def julian_years(time, name='time', *, within=OBSERVED):
    """
    Return times as Julian years in TDB.

    Plain numbers are taken to be Julian years already (not decimal years:
    the two differ by up to 0.4 days, and their rates by 2e-4). Words are
    dates in UTC, such as '2013-05-01T12:00:00'. Times not ``within`` two
    years are an error, as are quantities that are no years: a length of
    time, such as 59000 days, is no date.
    """
    with warnings.catch_warnings():
        # UTC after the last announced leap second is uncertain by a second,
        # which no proper motion can notice.
        warnings.simplefilter('ignore', erfa.ErfaWarning)
        time = _read_dates(time)
        years = (np.ma.filled(time.tdb.jyear, np.nan)
                 if isinstance(time, Time) else _plain_years(time, name))
    years = np.asarray(years, dtype=float)
    # Infinite years are unknown ones, too.
    years = np.where(np.isfinite(years), years, np.nan)
    beyond = (years < within[0]) | (years > within[1])
    if beyond.any():
        _refuse_time(name, f'the year {years[beyond][0]:.10g}, which is not '
                     f'between {within[0]} and {within[1]}')
    return years


def _refuse_time(name, got):
    msg = (f'{name} must be a Time or Julian years, got {got}; give a date '
           f"in days as Time(..., format='mjd') or format='jd'")
    raise ValueError(msg)


def _read_dates(time):
    """Return the Time of words that are dates; leave all else alone."""
    if np.asarray(time).dtype.kind not in 'US':
        return time
    words = np.asarray(time).astype(str)
    try:
        return words.astype(float)
    except ValueError:
        pass
    try:
        return Time(words, scale='utc')
    except ValueError:
        return time


def _plain_years(time, name):
    unit = getattr(time, 'unit', None)
    if unit is not None:
        if unit not in ('', u.yr):
            first = np.ravel(np.ma.getdata(getattr(time, 'value', time)))[:1]
            _refuse_time(name, ' '.join([*map(str, first), str(unit)]))
        time = np.ma.filled(time, np.nan) if unit == '' else (
            u.Quantity(time).value)
    try:
        return np.ma.filled(np.ma.asarray(time, dtype=float), np.nan)
    except (TypeError, ValueError) as error:
        msg = f'{name} must be a Time or Julian years, got {time!r:.80}'
        raise TypeError(msg) from error


def tdb(years):
    """Return a Time from Julian years in TDB."""
    return Time(years, format='jyear', scale='tdb')


def barycentric_observer(name, time, *, velocity=False):
    """
    Return where an observer is, from the solar system's barycentre.

    Parameters
    ----------
    name : {'earth', 'leo', 'l2'}
        The geocentre, which also stands for a low orbit (0.005 per cent of
        the parallax away), or the Sun-Earth L2 point.
    time : `~astropy.time.Time` or float
        The time, or Julian years (TDB).
    velocity : bool, optional
        Attach the velocity too. An `Epoch` whose observer has a velocity
        has its positions corrected for aberration; leave it out for
        positions that are corrected already. A low orbit moves with
        7.5 km/s around the geocentre, which this function does not know.

    Returns
    -------
    `~astropy.coordinates.CartesianRepresentation`
        ICRS place [au], with a `~astropy.coordinates.CartesianDifferential`
        where a velocity was asked for.

    Raises
    ------
    ValueError
        If the name is not known, or the velocity of a low orbit is asked
        for.

    Examples
    --------
    >>> from photutils_mgauss import barycentric_observer
    >>> barycentric_observer('earth', 2026.0).norm()
    <Quantity 0.97843297 AU>
    """
    name = _known_observer(name)
    if name == 'leo' and velocity:
        msg = ("velocity must be False for the observer 'leo', whose orbit "
               'is not known; give a CartesianRepresentation')
        raise ValueError(msg)
    moment = tdb(julian_years(time))
    place, speed = get_body_barycentric_posvel('earth', moment,
                                               ephemeris='builtin')
    if name == 'l2':
        sun, sun_speed = get_body_barycentric_posvel('sun', moment,
                                                     ephemeris='builtin')
        place = place + (place - sun) * L2_FRACTION
        speed = speed + (speed - sun_speed) * L2_FRACTION
    place = CartesianRepresentation(place.xyz.to(u.au))
    if not velocity:
        return place
    return place.with_differentials(CartesianDifferential(speed.xyz))


def _known_observer(name):
    if not isinstance(name, str) or name.lower() not in OBSERVERS:
        words = ', '.join(repr(choice) for choice in OBSERVERS)
        msg = (f'observer must be one of {words}, a '
               f'CartesianRepresentation, or None, got {name!r:.80}')
        raise ValueError(msg)
    return name.lower()


def observer_position(observer, years):
    """
    Return barycentric positions (3, ...) [au] at Julian years ``years``.

    ``observer`` is one of the names above, None (the Earth), or a
    `~astropy.coordinates.CartesianRepresentation`.
    """
    years = np.asarray(years, dtype=float)
    if isinstance(observer, CartesianRepresentation):
        xyz = observer.xyz.to_value(u.au)
        extra = years.ndim - (xyz.ndim - 1)
        return np.broadcast_to(xyz.reshape(xyz.shape + (1,) * extra),
                               (3, *years.shape))
    name = _known_observer('earth' if observer is None else observer)
    # Rows of one exposure share few distinct times.
    times, where = np.unique(years, return_inverse=True)
    moments = tdb(times)
    xyz = get_body_barycentric('earth', moments,
                               ephemeris='builtin').xyz.to_value(u.au)
    if name == 'l2':
        sun = get_body_barycentric('sun', moments, ephemeris='builtin')
        xyz = xyz + (xyz - sun.xyz.to_value(u.au)) * L2_FRACTION
    return xyz[:, where.reshape(years.shape)]


def observer_positions(observers, years):
    """
    Return barycentric positions (3, E, ...) [au] of E observers.

    ``years`` (E, ...) are Julian years; unknown ones (NaN) count as the mean
    of the others.
    """
    return np.stack([
        observer_position(observer, np.nan_to_num(row, nan=np.nanmean(row)))
        for observer, row in zip(observers, years, strict=True)], axis=1)


def observer_velocity(observer):
    """Return the observer's velocity (3,) in units of light, or None."""
    if (not isinstance(observer, CartesianRepresentation)
            or 's' not in observer.differentials):
        return None
    xyz = observer.differentials['s'].d_xyz.to_value(u.au / u.day)
    return xyz.reshape(3, -1).mean(axis=1) / LIGHT


def add_aberration(vectors, velocity):
    """
    Return directions (3, ...) seen by an observer who moves.

    ``velocity`` (3,) is in units of light. Light is not bent by the Sun on
    its way: catalogues have removed that.
    """
    velocity = np.asarray(velocity)
    rest = np.sqrt(1 - np.sum(np.square(velocity)))
    seen = erfa.ab(np.moveaxis(vectors, 0, -1), velocity, np.inf, rest)
    seen = np.moveaxis(seen, -1, 0)
    return seen / np.sqrt(np.sum(seen**2, axis=0))


def remove_aberration(vectors, velocity):
    """Return the directions seen by an observer at rest (the inverse)."""
    return add_aberration(vectors, -np.asarray(velocity))
