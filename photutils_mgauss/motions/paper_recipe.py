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

import numpy as np

from photutils_mgauss.motions.frames import MOTIONS, POSITIONS, Frames
from photutils_mgauss.motions.joint import Priors, solve_all
from photutils_mgauss.motions.loop import Fit, build_problem
from photutils_mgauss.motions.references import FIXED
from photutils_mgauss.sky.transforms import Transform


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


def paper_scene(scene):
    """Return a scene whose maps are shifts and whose stars have no priors."""
    transform = Transform('shift').fitted_to(scene.origin)
    return replace(scene, transform=transform, priors=Priors.none(4),
                   drift=None)


def displacements(scene, state):
    """Return the `Displacements` of the reference objects."""
    first = int(np.argmin(scene.sightings.epoch_years))
    places = np.where(state.used & scene.anchors, scene.sightings.places,
                      np.nan)
    moved = places - places[:, first][:, None]
    count = np.isfinite(moved[0]).sum(axis=1)
    if (count == 0).any():
        e = int(np.argmin(count))
        msg = (f'epoch {e} must have reference objects in common with the '
               f'first epoch for the recipe of the paper, got none')
        raise ValueError(msg)
    mean = np.nanmean(moved, axis=2)
    scatter = np.nansum((moved - mean[..., None])**2, axis=2)
    error = np.sqrt(scatter / np.maximum(count - 1, 1) / count)
    return Displacements(mean, error, _mean_motion(scene))


def _mean_motion(scene):
    """Return the mean catalogue motion (2,) of the references in use."""
    catalogue, references = (scene.sightings.catalogue,
                             scene.sightings.references)
    if catalogue is None or scene.relative:
        return np.zeros(2)
    seen = np.flatnonzero(references >= 0)
    use = seen[scene.anchors[references[seen]]]
    motion = np.where(np.isin(catalogue.kinds[use], FIXED), 0.0,
                      catalogue.values[2:4, use])
    return motion.mean(axis=1)


def frame_error(found, dt, eps_t):
    r"""Return :math:`\varepsilon_t` of each axis and epoch, (2, E)."""
    if eps_t == 'corrected':
        return found.error
    return np.abs(found.mean - np.multiply.outer(found.motion, dt))


def fit_paper(scene, state, eps_t):
    """Return the `Fit` of the paper's recipe."""
    scene = paper_scene(scene)
    found = displacements(scene, state)
    dt = scene.sightings.epoch_years - scene.sightings.epoch_years.min()
    # Moving the frames along with the references' own mean motion makes the
    # slope a + mean(mu_r) at once.
    shift = np.multiply.outer(found.motion, dt) - found.mean
    maps = np.repeat(scene.transform.identity()[None], len(dt), axis=0)
    maps[..., 0] += shift.T
    state = replace(state, maps=maps,
                    floor=frame_error(found, dt, eps_t).T**2)
    problem = build_problem(scene, state)
    # Eq. 11 takes each coordinate by itself.
    weights = problem.weights.copy()
    weights[1] = 0.0
    problem = replace(problem, weights=weights)
    empty = np.zeros((maps.size, 0))
    notes = (POSITIONS, MOTIONS.format(field=''))
    frames = Frames(np.zeros_like(maps), empty,
                    notes if scene.relative else notes[:1])
    estimates = solve_all(problem, frames.correction, empty,
                          scene.options.executor, residuals=True)
    return Fit(scene, state, problem, frames, estimates)
