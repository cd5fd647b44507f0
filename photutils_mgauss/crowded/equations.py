"""
The joint normal equations of the stars and the background of a tile.

Gauss-Newton steps for all parameters at once come from them, sparse because a
star overlaps only its neighbours.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.stars import Neighbours

# A step of Gauss-Newton moves a star no further than this [pix].
MAX_MOVE = 0.4
# Nor does it change a flux by more than these factors.
_LEAST_CHANGE, MOST_CHANGE = 0.2, 2.5
# Joint equations are solved until the residual is this fraction of what it
# was: what is left over would depend on what else is on the tile.
TOLERANCE = 1e-6
CG_STEPS = 400
# Where stars are so many that together they can be a background, its steps
# are to be small: this is added to the information of nodes, as a fraction,
# times the mean square of the pixels' residuals, in standard errors and at
# most so large. Where the stars are not yet the right ones the sky is stiff.
_LEVEL_DAMPING, _LARGEST_SQUARE = 0.1, 100.0
# What is known beforehand moves no flux by more standard errors than this.
STRONGEST_PULL = 0.5
# Pixels further than this from the model take no part in the background.
_BACKGROUND_CLIP = 4.0


@dataclass(frozen=True)
class Equations:
    """
    The normal equations of a model as it was when they were formed.

    Parameters are ordered flux, x, y.
    """

    stars: kernels.StarEquations
    mesh: kernels.MeshEquations
    neighbours: Neighbours
    level_damping: np.ndarray

    @classmethod
    def of(cls, model):
        """Form the equations of a `Model`."""
        stars = _star_equations(model)
        _hold(stars, model.stars)
        _expect(stars, model.stars, model.options.count_slope)
        return cls(stars, _mesh_equations(model, stars), model.neighbours,
                   _level_damping(model))

    def solve(self, damping):
        """Return the Gauss-Newton steps of the stars (n, 3) and the level."""
        stars = self.stars._replace(
            matrix=self.stars.matrix * (1 + damping * np.eye(3)))
        mesh = self.mesh._replace(
            diagonal=self.mesh.diagonal * (1 + self.level_damping))
        n = len(stars.matrix)
        step = np.zeros(3 * n + self.mesh.gradient.size)
        kernels.solve_joint(
            stars, self.neighbours.pairs, mesh, TOLERANCE, CG_STEPS,
            np.empty((n, 3, 3)), np.empty((4, step.size)), step)
        return step[:3 * n].reshape(n, 3), step[3 * n:]

    def answers_to_light(self):
        """Return by how much fluxes (n,) rise if a pixel has 1 more."""
        n = len(self.stars.matrix)
        stars = self.stars._replace(gradient=self.stars.coupling,
                                    coupling=np.zeros((n, 3)))
        mesh = self.mesh._replace(gradient=0 * self.mesh.gradient)
        step = np.zeros(3 * n + mesh.gradient.size)
        kernels.solve_joint(
            stars, self.neighbours.pairs, mesh, TOLERANCE, CG_STEPS,
            np.empty((n, 3, 3)), np.empty((4, step.size)), step)
        return step[:3 * n:3]

    def covariances(self):
        """Return covariances with neighbours free, and correlations."""
        n = len(self.stars.matrix)
        covariance, correlation = np.empty((n, 3, 3)), np.empty(n)
        kernels.joint_covariances(self.stars, self.neighbours.pairs,
                                  self.neighbours.nearest,
                                  kernels.CovarianceScratch.empty(n),
                                  covariance, correlation)
        return covariance, correlation


def _level_damping(model):
    """Return the damping of the nodes (m,), as a fraction."""
    square = np.minimum(model.weight * model.residual**2, _LARGEST_SQUARE)
    mean, _ = model.mesh.means((model.weight > 0).astype(float), square)
    return _LEVEL_DAMPING * np.maximum(mean, 1)


def limited(step, stars, scale=1.0):
    """Return a step (n, 3) no longer than stars may go at once."""
    out = np.empty_like(step)
    out[:, 0] = np.clip(step[:, 0], (_LEAST_CHANGE - 1) * stars.flux,
                        (MOST_CHANGE - 1) * stars.flux)
    for k, drift in enumerate(stars.drift, 1):
        move = np.clip(step[:, k], -scale * MAX_MOVE, scale * MAX_MOVE)
        out[:, k] = np.where(np.isfinite(stars.bound), np.clip(
            move, -stars.bound - drift, stars.bound - drift), move)
    return out


def _star_equations(model):
    n = len(model.stars)
    pairs = model.neighbours.pairs
    equations = kernels.StarEquations(
        np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)),
        np.empty((pairs.neighbour.size, 3, 3)))
    flux = model.stars.flux
    kernels.own_equations(flux, model.stamps, model.weight, model.residual,
                          equations)
    kernels.pair_blocks(flux, model.stamps, pairs, model.weight,
                        equations.blocks)
    return equations


def _hold(equations, stars):
    """Add what is known of the places of some stars."""
    equations.matrix[:, [1, 2], [1, 2]] += stars.hold[:, None]
    equations.gradient[:, 1:] -= (stars.hold * stars.drift).T


def _expect(equations, stars, count_slope):
    """Add what is known of the fluxes of found stars."""
    # The logarithm of flux**-slope; less than half a standard error, lest
    # it drive out what may be real.
    own = np.maximum(equations.matrix[:, 0, 0], 0)
    pull = np.minimum(count_slope / np.maximum(stars.flux, 1e-300),
                      STRONGEST_PULL * np.sqrt(own))
    equations.gradient[:, 0] -= np.where(stars.hold > 0, 0, pull)


def _mesh_equations(model, stars):
    """Form the equations of the nodes' levels."""
    mesh = model.mesh
    if model.options.background_size:
        # All pixels count for the information: stars are coupled through
        # all of theirs. Those far from the model say nothing of the sky.
        # What is left over is to vanish, not to agree with the node: between
        # nodes a peak of the background is lower.
        information, _, gradient = mesh.sums(
            model.weight, model.residual, np.zeros(model.residual.shape),
            _BACKGROUND_CLIP)
    else:
        stars.coupling[:] = 0
        information = gradient = np.zeros(model.level.size)
    # Nodes without pixels follow their neighbours, up and down the slopes
    # there were at first.
    tie = float(mesh.tie / model.noise**2)
    pull = tie * mesh.steepness(model.level - model.first_level)
    return kernels.MeshEquations(
        information + tie * mesh.n_ties(), gradient - pull, tie,
        mesh.shape[1], *_own_node(mesh, model.stars))


def _own_node(mesh, stars):
    """Return the shares of a background that is constant in cells."""
    # Only such a one makes, with each node's own mean, a matrix that is
    # positive definite; where steps end does not depend on it.
    node = np.repeat(mesh.owners(stars.x, stars.y)[:, None], 4, axis=1)
    share = np.zeros(node.shape)
    share[:, 0] = 1
    return node, share
