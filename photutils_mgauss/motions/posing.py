"""
The problem that a state poses, and what of it the next state has in common.

A step changes maps, and with them offsets alone; a rejected detection changes
one star of many. Weights and the frames' equations are kept, but for what has
changed.
"""
from dataclasses import dataclass
from functools import partial

import numpy as np

from photutils_mgauss.motions.joint import reduce_all
from photutils_mgauss.motions.problem import CHUNK, MotionProblem
from photutils_mgauss.motions.stacked import invert_2x2
from photutils_mgauss.utils.parallel import map_parallel

SLICE = 16 * CHUNK  # stars at a time, of loops that do little with each
PART = 0.5  # of the weight of an epoch that may be taken away again


@dataclass(frozen=True, eq=False)
class Kept:
    """
    What a problem leaves for the next.

    Parameters
    ----------
    weights : (3, E, n) `~numpy.ndarray`
        Inverse covariances of the detections.
    reduced : `~photutils_mgauss.motions.joint.Reduced` or None
        The equations of the frames, of all stars but those ``changed``.
    changed : (k,) int `~numpy.ndarray` or empty tuple
        Stars whose weights and equations are not what they were.
    """

    weights: np.ndarray
    reduced: object
    changed: np.ndarray | tuple = ()

    def without_changes(self, problem, state, after):
        """
        Return what still holds ``after`` a state, None where nothing does.

        The ``problem`` is that of the state.
        """
        if self.reduced is None or not _equal_errors(state, after):
            return None
        changed = _changed_stars(state, after)
        if not len(changed):
            return self
        gone = reduce_all(problem.select(changed))
        # Digits are lost where a large part is taken away.
        if (_diagonals(gone) > PART * _diagonals(self.reduced)).any():
            return None
        return Kept(self.weights, self.reduced - gone, changed)


def _equal_errors(state, after):
    """Whether detections have the same covariances in both states."""
    return after.scales is state.scales and np.array_equal(after.floor,
                                                           state.floor)


def _changed_stars(state, after):
    """Return the numbers (k,) of the stars that count for something else."""
    changed = after.untied != state.untied
    for now, before in zip(after.used, state.used, strict=True):
        changed |= now != before
    changed[np.setxor1d(after.dropped, state.dropped)] = True
    return np.flatnonzero(changed)


def _diagonals(reduced):
    """Return the diagonals (E, 2 b) of the frames' own blocks."""
    return np.einsum('ekk->ek', reduced.direct)


def pose(setup, state, kept=None):
    """
    Return the `MotionProblem` of the present maps, masks and floors.

    What was `Kept` of the problem before is used again: its weights, too,
    are changed in place.
    """
    sightings = setup.sightings
    ties = _ties(setup, state)
    priors = setup.priors.without(state.dropped).with_others(
        setup.places.of(state.dropped))
    if kept is None:
        weights = np.empty_like(sightings.covariance)
        _in_slices(partial(_set_weights, setup, state, weights),
                   len(ties))
    else:
        weights = kept.weights
        if len(kept.changed):
            _set_weights(setup, state, weights, kept.changed)
    offsets = np.empty_like(sightings.places)
    _in_slices(partial(_set_offsets, setup, state.maps,
                       setup.undistorted(state), offsets), len(ties))
    if setup.drift is not None:
        stars, parallactic = setup.drift
        offsets[..., stars] -= parallactic
    if len(setup.nearing.stars):
        offsets[..., setup.nearing.stars] -= state.swerve
    _in_slices(partial(_clear_missing, offsets), len(ties))
    return MotionProblem(
        offsets, weights, setup.origin, setup.dt,
        sightings.observer if setup.options.parallax else None,
        sightings.plane, setup.transform, priors, setup.options.acceleration,
        ties)


def _in_slices(function, n):
    """Call a function with slices of n stars, in threads if these are many."""
    slices = [slice(start, min(start + SLICE, n))
              for start in range(0, n, SLICE)]
    for _ in map_parallel(function, slices):
        pass


def _set_offsets(setup, maps, places, offsets, stars):
    """Put what maps make of places, relative to the origin, into offsets."""
    origin = setup.origin[:, stars]
    for e, coefficients in enumerate(maps):
        offsets[:, e, stars] = setup.transform.apply(
            coefficients, places[:, e, stars]) - origin


def _clear_missing(offsets, stars):
    np.nan_to_num(offsets[..., stars], copy=False)


def _set_weights(setup, state, weights, stars):
    """Put inverse covariances of detections into weights, 0 where unused."""
    for e, used in enumerate(state.used):
        weights[:, e, stars] = np.where(
            used[stars], invert_2x2(*measured(setup, state, e, stars)), 0.0)


def measured(setup, state, e, stars=slice(None)):
    """Return the covariances (3, n) of an epoch with its floor."""
    floor = np.broadcast_to(state.floor.T, (2, len(state.maps)))[:, e]
    xx, xy, yy = setup.sightings.covariance[:, e, stars]
    if state.scales is not None:
        xx, xy, yy = state.factor[e, stars] * np.stack([xx, xy, yy])
        floor = state.added[[e, e]][:, stars]
    return np.stack([xx + floor[0], xy, yy + floor[1]])


def _ties(setup, state):
    """Return which stars take part in finding the frames."""
    if setup.options.recipe == 'joint' or setup.relative:
        return ~state.untied
    ties = setup.anchors & ~state.untied
    ties[state.dropped] = False
    return ties


def reduce_again(problem, kept, executor=None):
    """
    Return the `~photutils_mgauss.motions.joint.Reduced` equations.

    Of what was `Kept`, the matrices are those of stars that have not changed.
    """
    if kept is None:
        return reduce_all(problem, executor)
    like = kept.reduced
    if len(kept.changed):
        like = like + reduce_all(problem.select(kept.changed))
    return reduce_all(problem, executor, like=like)
