"""Positions, motions and their covariances at any epoch, in local axes."""
import numpy as np

from photutils_mgauss.motions.joint import cross_covariance
from photutils_mgauss.motions.problem import CHUNK
from photutils_mgauss.sky.space_motion import (
    beyond_straight,
    jacobian,
    turned,
    turns,
)

FROM_OURS = [0, 1, 4, 2, 3]  # to Gaia's order: position, parallax, motion


def propagated(fit, year):
    """
    Return parameters (p, n) and covariances of all stars, in local axes.

    At a Julian year, as do all in this module.
    """
    values = np.empty_like(fit.estimates.values)
    covariance = np.empty_like(fit.estimates.covariance)
    for some, *moved in propagated_parts(fit, year):
        values[:, some], covariance[..., some] = moved
    return values, covariance


def propagated_parts(fit, year):
    """
    Yield the same for some stars after others, and which these are.

    The covariances of all are the largest of all arrays of stars.
    """
    plane = fit.setup.sightings.plane
    for start in range(0, fit.n_stars, CHUNK):
        some = slice(start, start + CHUNK)
        moved = at_epoch(fit, year, some)
        yield some, *(moved if plane is None else turned(plane, *moved))


def at_epoch(fit, year, stars):
    """
    Return parameters (p, k) and covariances of stars at a Julian year.

    Positions are plane coordinates, no longer relative to an origin.
    """
    values = fit.estimates.values[:, stars]
    covariance = fit.estimates.covariance[..., stars]
    move = _straight(fit, year)
    moved = move @ values
    half = np.tensordot(move, covariance, axes=1)
    spread = np.einsum('ijn,kj->ikn', half, move)
    numbers = np.arange(fit.n_stars)[stars]
    near = np.flatnonzero(np.isin(numbers, fit.setup.nearing.stars))
    if near.size:
        swerve, change = _in_space(fit, year, numbers[near])
        moved[:len(swerve), near] += swerve
        half = np.einsum('ijn,jkn->ikn', change, covariance[..., near])
        spread[..., near] = np.einsum('ijn,kjn->ikn', half, change)
        by_error = _by_velocity_error(fit, year, numbers[near])
        n = len(by_error)
        spread[:n, :n, near] += by_error[:, None] * by_error
    moved[:2] += fit.setup.origin[:, stars]
    return moved, spread


def _straight(fit, year):
    """Return the matrix from parameters at the working epoch to a year."""
    dt = year - fit.setup.working_year
    move = np.eye(fit.n_parameters)
    move[0, 2] = move[1, 3] = dt
    if fit.setup.options.acceleration:
        move[0, -2] = move[1, -1] = dt**2 / 2
        move[2, -2] = move[3, -1] = dt
    return move


def _in_space(fit, year, stars):
    """
    Return how stars of known radial velocity leave a straight motion.

    What is to be added to their first 4 or 5 parameters (size, k), and the
    matrices (p, p, k) that stand in the place of `_straight`.
    """
    nearing, dt = fit.setup.nearing, year - fit.setup.working_year
    size = 5 if fit.setup.options.parallax else 4
    which = np.searchsorted(nearing.stars, stars)
    velocity = nearing.velocity[which]
    values = nearing.values(which, fit.estimates.values[:size, stars],
                            fit.setup.origin[:, stars])
    change = np.repeat(_straight(fit, year)[..., None], len(stars), axis=2)
    change[:size, :size] = jacobian(values, velocity, dt)[:size, :size]
    return beyond_straight(values, velocity, dt)[:size], change


def _by_velocity_error(fit, year, stars):
    """Return what one error of the radial velocity changes, (size, k)."""
    nearing, dt = fit.setup.nearing, year - fit.setup.working_year
    size = 5 if fit.setup.options.parallax else 4
    which = np.searchsorted(nearing.stars, stars)
    values = nearing.values(which, fit.estimates.values[:size, stars],
                            fit.setup.origin[:, stars])
    velocity, error = nearing.velocity[which], nearing.error[which]
    step = np.maximum(error, 1e-3)
    more, less = (beyond_straight(values, velocity + sign * step, dt)[:size]
                  for sign in (1, -1))
    return (more - less) / 2 * (error / step)


def star_covariance(fit, stars, ref_year):
    """Return covariances (k, p, k, p) in Gaia's order, at an epoch."""
    problem = fit.problem.select(stars)
    covariance = cross_covariance(problem, fit.frames.factor)
    size = problem.n_parameters
    change = np.repeat(_straight(fit, ref_year)[None], len(stars), 0)
    near = np.flatnonzero(np.isin(stars, fit.setup.nearing.stars))
    if near.size:
        change[near] = _in_space(fit, ref_year, stars[near])[1].transpose(
            2, 0, 1)
    own = np.zeros((len(stars), size, size))
    if near.size:
        by_error = _by_velocity_error(fit, ref_year, stars[near]).T
        n = by_error.shape[1]
        own[near, :n, :n] = by_error[:, :, None] * by_error[:, None]
    plane = fit.setup.sightings.plane
    if plane is not None:
        places = at_epoch(fit, ref_year, stars)[0][:2]
        turn = turns(plane, places, size).transpose(2, 0, 1)
        change, own = turn @ change, turn @ own @ np.swapaxes(turn, 1, 2)
    covariance = np.einsum('kij,kjlm,lnm->kiln', change, covariance, change)
    covariance[np.arange(len(stars)), :, np.arange(len(stars))] += own
    order = [k for k in FROM_OURS if k < size] if (
        fit.setup.options.parallax) else [0, 1, 2, 3]
    return covariance[:, order][:, :, :, order]
