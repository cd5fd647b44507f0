r"""
The recipe of Nie et al., Section 4.2, as printed, and with one correction.

Positions of epoch i are moved by the mean displacement of the reference
objects since the first epoch, :math:`x'_i = x_i - \Delta x_i` (Eq. 12), and a
straight line is fitted to each coordinate of each star (Eq. 11) with errors

.. math::
    \varepsilon_i = \sqrt{\varepsilon_c^2 + \varepsilon_t^2}, \quad
    \varepsilon_t = |\Delta x_r - \bar\mu_r \Delta t|

(Eqs. 13-14); the motion is :math:`\mu_m = \bar\mu_r + a` (Eq. 15). As printed,
:math:`\varepsilon_t` is the offset between the pointings, which
:math:`x'` has removed already; the correction puts in its place the standard
error of the mean displacement.
"""
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from photutils_mgauss.motions.frames import MOTIONS, POSITIONS, Frames
from photutils_mgauss.motions.loop import finished, last_estimates
from photutils_mgauss.motions.posing import pose
from photutils_mgauss.motions.priors import Priors


@dataclass(frozen=True, eq=False)
class Displacements:
    """
    Mean displacements of the references since the first epoch.

    ``mean`` and ``error`` (2, E): the mean displacement and its standard
    error; ``motion`` (2,) the mean catalogue motion of the references.
    """

    mean: np.ndarray
    error: np.ndarray
    motion: np.ndarray


def paper_setup(setup):
    """Return a setup whose maps are shifts and whose stars have no priors."""
    transform = replace(setup.transform, kind='shift', degree=1)
    return replace(setup, transform=transform, priors=Priors.none(4),
                   drift=None)


def displacements(setup, state):
    """Return the `Displacements` of the reference objects."""
    kept = setup.sightings.kept
    first = int(np.argmin(np.where(kept, setup.sightings.epoch_years,
                                   np.inf)))
    places = np.where(state.used & setup.anchors, setup.sightings.places,
                      np.nan)
    moved = places - places[:, first][:, None]
    count = np.isfinite(moved[0]).sum(axis=1)
    if (kept & (count == 0)).any():
        e = int(np.argmin(np.where(kept, count, np.inf)))
        msg = (f'epoch {e} must have reference objects in common with the '
               f'first epoch for the recipe of the paper, got none')
        raise ValueError(msg)
    count = np.maximum(count, 1)  # None in epochs that are left out.
    mean = np.nansum(moved, axis=2) / count
    scatter = np.nansum((moved - mean[..., None])**2, axis=2)
    error = np.sqrt(scatter / np.maximum(count - 1, 1) / count)
    return Displacements(mean, error, _mean_motion(setup))


def _mean_motion(setup):
    """Return the mean catalogue motion (2,) of the references in use."""
    use = setup.anchors[setup.sightings.references]
    if setup.relative:
        return np.zeros(2)
    return setup.sightings.catalogue.motion()[:, use].mean(axis=1)


def frame_error(found, dt, eps_t):
    r"""Return :math:`\varepsilon_t` of each axis and epoch, (2, E)."""
    if eps_t == 'corrected':
        return found.error
    return np.abs(found.mean - np.multiply.outer(found.motion, dt))


def fit_paper(setup, state):
    """Return the `Fit` of the paper's recipe."""
    setup = paper_setup(setup)
    found = displacements(setup, state)
    years = setup.sightings.epoch_years
    dt = years - years[setup.sightings.kept].min()
    # Moving the frames along with the references' own mean motion makes the
    # slope a + mean(mu_r) at once.
    shift = np.multiply.outer(found.motion, dt) - found.mean
    maps = np.repeat(setup.transform.identity()[None], len(dt), axis=0)
    maps[..., 0] += shift.T
    errors = frame_error(found, dt, setup.options.eps_t)
    state = replace(state, maps=maps, floor=errors.T**2)
    problem = _pose(setup, state)
    empty = np.zeros((maps.size, 0))
    notes = (POSITIONS, MOTIONS.format(field=''))
    frames = Frames(np.zeros_like(maps), empty,
                    notes if setup.relative else notes[:1])
    estimates = last_estimates(setup, state, problem, frames)
    return finished(setup, state, problem, frames, estimates,
                    partial(_pose, setup, state))


def _pose(setup, state):
    problem = pose(setup, state)
    # Eq. 11 takes each coordinate by itself.
    weights = problem.weights.copy()
    weights[1] = 0.0
    return replace(problem, weights=weights)
