r"""
The joint normal equations of the stars and skies of many images.

The unknowns are the fluxes and skies of each image and what all have in
common, the place of each star and, if stars move, its motion: p numbers q,
which image k sees at :math:`F_k q`. Stars whose motions are fitted have one
flux for all images of a band, times the scale of each: with noisy fluxes of
their own, blends would seem to move. In the equations of one image
(`Equations`), whose derivatives are by the common coordinates, only the
blocks of places are shared: for all images these add up. They are solved by
conjugate gradients; each star's own
block, with as many fluxes as there are images, is the preconditioner.
"""
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.equations import (
    CG_STEPS,
    MAX_MOVE,
    MOST_CHANGE,
    STRONGEST_PULL,
    TOLERANCE,
    Equations,
)

# Fluxes fall by no more than this fraction at a time.
_LARGEST_FALL = 0.8
# Before anything is known a star is taken to move by so much, in the image
# that sees it move the farthest [pix]: no matter for stars that are seen.
FARTHEST = 3.0
# An inverse variance with which places stay where they are [1 / pix^2].
_HELD = 1e30
# What is left of residuals that are but noise: fluxes are as sure as that.
_ENOUGH = 1e-3
# Stars whose covariances are made at a time.
_AT_ONCE = 4096


@dataclass(frozen=True)
class ManyEquations:
    """
    The normal equations of all images as they were when they were formed.

    ``each`` are those of single images; ``pull`` (E, n) is what is known of
    fluxes before, ``hold`` (n, p) the inverse variances with which places and
    motions are held to where they were, ``drift`` (n, p) away; ``scales`` (E,
    1), ``factors`` (E, 2, p), ``ties`` which fluxes are one.
    """

    each: list
    neighbours: object
    factors: np.ndarray
    hold: np.ndarray
    drift: np.ndarray
    pull: np.ndarray
    scales: np.ndarray
    ties: kernels.Ties

    @classmethod
    def of(cls, tile):
        """Form the equations of a `ManyTile`."""
        each = [Equations.of(model) for model in tile.models]
        stars, factors = tile.stars, tile.job.factors
        hold = np.zeros((len(stars), factors.shape[2]))
        hold[:, :2] = stars.hold[:, None]
        hold[:, 2:] = tile.usual[1]**-2
        bare = cls(each, tile.neighbours, factors, hold, np.column_stack(
            [stars.drift.T, stars.rate - tile.usual[0]]), None, tile.scales,
            tile.ties())
        return replace(bare, pull=bare._expect(
            tile.fluxes, tile.options.count_slope, stars.hold > 0))

    def _own(self):
        """Return the information on each flux alone (E, n)."""
        return np.array([np.maximum(one.stars.matrix[:, 0, 0], 0)
                         for one in self.each])

    def residual_fluxes(self):
        """Return what residuals say of fluxes (E, n), nothing else free."""
        light = gathered(self.ties, np.array(
            [one.stars.gradient[:, 0] for one in self.each]))
        own = gathered(self.ties, self.ties.scale * self._own())
        return self.ties.scale * np.divide(
            light, own, where=own > 0, out=np.zeros(own.shape))[self.ties.slot]

    def each_flux(self):
        """Return steps of fluxes (E, n), each free, at places that stay."""
        n_images, n = self.pull.shape
        alone = kernels.Ties(np.arange(n_images * n).reshape(n_images, n),
                             np.ones((n_images, n)),
                             np.ones((n_images, n), bool), n_images * n)
        free = replace(self, ties=alone, drift=np.zeros(self.drift.shape),
                       hold=np.full(self.hold.shape, _HELD))
        system = _System.of(free, 0.0)
        return system.parts(system.solve(_ENOUGH))[0]

    def flux_errors(self, *, alone=False):
        """
        Return standard errors (E, n) of fluxes, nothing else free.

        ``alone`` asks what each image tells of its own flux.
        """
        scale, own = self.ties.scale, self._own()
        if not alone:
            own = gathered(self.ties, scale * own)[self.ties.slot] / scale**2
        return np.divide(1, np.sqrt(own), where=own > 0,
                         out=np.zeros(own.shape))

    def motion_errors(self):
        """Return standard errors (n, p - 2) of motions, nothing else free."""
        known = sum(np.einsum('xq,nxy,yq->nq', factor[:, 2:],
                              one.stars.matrix[:, 1:, 1:], factor[:, 2:])
                    for one, factor in zip(self.each, self.factors,
                                           strict=True))
        return np.divide(1, np.sqrt(np.maximum(known, 0)), where=known > 0,
                         out=np.full(known.shape, np.inf))

    def summed(self, fluxes, information=None):
        """
        Return what fluxes (E, n) say of one flux, and how well (n,).

        The quotient is the flux in an image of scale 1, the first over the
        root of the second its signal-to-noise ratio.
        """
        if information is None:
            information = self._own()
        return ((self.scales * information * fluxes).sum(axis=0),
                (self.scales**2 * information).sum(axis=0))

    def _expect(self, fluxes, slope, known_places):
        """Return the pulls (E, n) of a prior that falls with the flux."""
        own = self._own()
        light, known = self.summed(fluxes)
        pull = np.minimum(
            slope * np.divide(known, np.maximum(light, 1e-300),
                              where=known > 0, out=np.zeros(known.size)),
            STRONGEST_PULL * np.sqrt(known))
        share = np.divide(self.scales * own, known, where=known > 0,
                          out=np.zeros(own.shape))
        return np.where(known_places, 0, pull) * share

    def solve(self, damping):
        """Return steps of fluxes (E, n), places (n, p) and levels."""
        system = _System.of(self, damping)
        light, place, levels = system.parts(system.solve())
        return light, place, levels

    def limited(self, light, place, tile):
        """Return steps no longer than stars may go at once."""
        flux = np.maximum(tile.fluxes, 0)
        error = self.flux_errors()
        light = np.clip(light, -np.maximum(_LARGEST_FALL * flux, error),
                        np.maximum((MOST_CHANGE - 1) * flux, error))
        most = tile.scale * MAX_MOVE / reach_of(self.factors)
        move = np.clip(place, -most, most)
        bound, drift = tile.stars.bound[:, None], self.drift[:, :2]
        move[:, :2] = np.where(np.isfinite(bound), np.clip(
            move[:, :2], -bound - drift, bound - drift), move[:, :2])
        return light, move

    def covariances(self):
        """
        Return what is known of the stars with their neighbours free.

        Returns
        -------
        (n, p, p), (E, n), (E, n) `~numpy.ndarray`
            The covariances of places, the variances of fluxes, and their
            correlations with that of the nearest neighbour.
        """
        (n, p), n_images = self.hold.shape, len(self.each)
        place = np.empty((n, p, p))
        variance, correlation = np.empty((2, n_images, n))
        for first in range(0, n, _AT_ONCE):
            part = slice(first, min(first + _AT_ONCE, n))
            together = self._together(part)
            place[part] = together.free[:, :p, :p]
            for k, one in enumerate(self.each):
                kernels.flux_variances(
                    one.stars, self.neighbours.pairs, self.factors[k],
                    together, variance[k, part], correlation[k, part])
        return place, variance, correlation

    @cached_property
    def _every(self):
        """The equations of stars, those of all images in one array each."""
        return kernels.StarEquations(*map(np.array, zip(*(
            one.stars for one in self.each), strict=True)))

    def _together(self, part):
        """Return stars with neighbours, and what is known of their places."""
        n, m = part.stop - part.start, kernels.MOST_TOGETHER
        p = self.hold.shape[1]
        together = kernels.Together(
            np.zeros((n, m), np.int64), np.zeros(n, np.int64),
            np.zeros((n, p * m, p * m)))
        kernels.add_places(part.start, self._every, self.neighbours.pairs,
                           self.factors, self.ties, together)
        at = np.arange(p * m)
        together.free[:, at, at] += self.hold[together.members].reshape(
            n, p * m)
        kernels.invert_places(together)
        return together


@dataclass(frozen=True)
class _System:
    """Equations of one flat vector: fluxes, places, levels of each image."""

    stars: list
    meshes: list
    pairs: object
    factors: np.ndarray
    hold: np.ndarray
    ties: kernels.Ties
    right: np.ndarray
    blocks: kernels.Blocks

    @classmethod
    def of(cls, equations, damping):
        each = equations.each
        stars = [one.stars._replace(
            matrix=one.stars.matrix * (1 + damping * np.eye(3)))
            for one in each]
        meshes = [one.mesh._replace(
            diagonal=one.mesh.diagonal * (1 + one.level_damping))
            for one in each]
        hold, factors, ties = (equations.hold, equations.factors,
                               equations.ties)
        light = np.array([one.stars.gradient[:, 0] for one in each])
        place = sum(one.stars.gradient[:, 1:] @ factor for one, factor in zip(
            each, factors, strict=True))
        right = [gathered(ties, light - equations.pull),
                 (place - hold * equations.drift).ravel(),
                 *(one.mesh.gradient for one in each)]
        return cls(stars, meshes, equations.neighbours.pairs, factors, hold,
                   ties, np.concatenate(right), _blocks(
                       stars, meshes, factors, hold, ties))

    @property
    def _ends(self):
        """Where places end and the levels of each image."""
        sizes = [mesh.gradient.size for mesh in self.meshes]
        return np.cumsum([self.ties.size + self.hold.size, *sizes])

    def _places(self, v):
        """Return the part (n, p) of a vector that is places."""
        size = self.ties.size
        return v[size:size + self.hold.size].reshape(self.hold.shape)

    def parts(self, v):
        """Return the parts of a vector: fluxes (E, n), places, levels."""
        return (self.ties.scale * v[self.ties.slot], self._places(v),
                [v[a:b] for a, b in pairwise(self._ends)])

    def _apply(self, v, scratch, out):
        """Put the product with a vector into out."""
        out[:] = 0
        self._places(out)[:] = self.hold * self._places(v)
        for k, first in enumerate(self._ends[:-1]):
            kernels.apply_shared(k, self.factors, self.ties, first, v,
                                 self.stars[k], self.pairs, self.meshes[k],
                                 scratch, out)

    def solve(self, tolerance=TOLERANCE):
        """Return the solution by preconditioned conjugate gradients."""
        r = self.right.copy()
        step, z, a = np.zeros((3, r.size))
        largest = max(mesh.gradient.size for mesh in self.meshes)
        scratch = np.empty((2, 3 * len(self.hold) + largest))
        rz = kernels.precondition_shared(self.blocks, r, z)
        v, goal = z.copy(), tolerance**2 * rz
        for _ in range(CG_STEPS):
            if not rz > goal:
                break
            self._apply(v, scratch, a)
            kernels.advance(rz, v, a, step, r)
            before = rz
            rz = kernels.precondition_shared(self.blocks, r, z)
            v *= rz / before
            v += z
        return step


def reach_of(factors):
    """Return how far (p,) images see stars move by a change of one [pix]."""
    return np.maximum(np.abs(factors).max(axis=(0, 1)), 1e-300)


def gathered(ties, values):
    """Return the sums (size,) of values (E, n) of what is one flux."""
    return np.bincount(ties.slot.ravel(), (ties.scale * values).ravel(),
                       minlength=ties.size)


def _blocks(stars, meshes, factors, hold, ties):
    """Return what the inverse of each star's own block is made of."""
    diagonal = gathered(ties, ties.scale * np.array(
        [one.matrix[:, 0, 0] for one in stars]))
    own = np.divide(1, diagonal, where=diagonal > 0,
                    out=np.zeros(diagonal.shape))[ties.slot]
    n, p = hold.shape
    cross = np.array([one.matrix[:, 0, 1:] @ factor for one, factor in zip(
        stars, factors, strict=True)])
    share = np.stack([gathered(ties, cross[:, :, q])[ties.slot]
                      for q in range(p)], axis=-1)
    left = np.zeros((n, p, p))
    left[:, np.arange(p), np.arange(p)] = hold
    for k, (one, factor) in enumerate(zip(stars, factors, strict=True)):
        left += factor.T @ one.matrix[:, 1:, 1:] @ factor - (
            (ties.first[k] * own[k])[:, None, None]
            * share[k][:, :, None] * share[k][:, None, :])
    return kernels.Blocks(ties, own, share, _inverses(left), 1 /
                          np.concatenate([mesh.diagonal for mesh in meshes]))


def _inverses(matrices):
    """Return inverses (n, p, p), 0 where there is none."""
    diagonal = np.einsum('nii->ni', matrices)
    good = (diagonal > 0).all(axis=1)
    scale = np.where(good[:, None], diagonal, 1)**-0.5
    scaled = matrices * scale[:, :, None] * scale[:, None, :]
    # Of stars that are nowhere seen nothing moves.
    good &= np.linalg.det(np.where(good[:, None, None], scaled, 0)) > 1e-12
    scaled[~good] = np.eye(matrices.shape[1])
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    inverse[~good] = 0
    return inverse
