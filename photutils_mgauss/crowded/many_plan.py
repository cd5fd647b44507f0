"""A crowded field in many images cut into tiles of the sky."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.crowded.correlated import noise_pairs
from photutils_mgauss.crowded.many_search import image_scales
from photutils_mgauss.crowded.many_solve import solve_many
from photutils_mgauss.crowded.many_table import no_stars, tabulate
from photutils_mgauss.crowded.many_tile import ManyJob, TileMap, phases
from photutils_mgauss.crowded.plan import (
    Outcome,
    Tiles,
    cut,
    given_in,
    reported,
    tile_size,
    window,
)
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.tile import CELL, TileJob, TileOptions
from photutils_mgauss.utils.checkpoint import Checkpoint
from photutils_mgauss.utils.correlated_noise import no_pairs

# From so many images on tiles are smaller, down to the least side [pix].
_IMAGES, _LEAST_SIDE = 4, 1024
# The middle of the field from which scales are taken has this side [pix].
_SAMPLE = 512


def outcome_of(job):
    """Solve a tile."""
    if job.is_empty:
        return Outcome(no_stars(job.n_images, job.factors.shape[2]))
    tile = solve_many(job)
    chi2 = sum(float((one.weight * one.residual**2).sum())
               for one in tile.models)
    pairs = np.stack([no_pairs()] * job.n_images)
    pairs[job.images] = [noise_pairs(model) for model in tile.models]
    return Outcome(tabulate(tile), chi2,
                   int(sum(one.good.sum() for one in tile.models)),
                   np.concatenate(tile.widths), pairs)


@dataclass(frozen=True)
class ManyPlan(Tiles):
    """
    How many images of a field are cut into tiles of their grid.

    ``images`` are `PixelData`, ``psfs`` their `LocalPSF`, ``each`` the
    `TileOptions` of single images and ``options`` those of all; ``grid`` has
    the ``shape`` of the field and the maps ``to_image`` and ``to_grid``,
    ``factors`` and ``bands`` are those of a `ManyJob`.
    """

    solve = staticmethod(outcome_of)

    images: list
    psfs: list
    each: list
    options: TileOptions
    grid: object
    scales: np.ndarray
    factors: np.ndarray
    bands: np.ndarray
    tile_shape: tuple | None
    overlap: int
    given: Stars | None = None
    checkpoint: Checkpoint | None = None

    @property
    def cores(self):
        """The parts (v_low, v_high, u_low, u_high) of the grid."""
        shape = self.grid.shape
        crowd = np.sqrt(max(len(self.images) / _IMAGES, 1))
        side = max(int(tile_size(shape) / crowd), _LEAST_SIDE)
        return cut(shape, self.tile_shape or (side, side))

    def job(self, core):
        """Cut out a tile."""
        v, u = self.grid.shape
        margin = self.options.background_size or 0
        seen = (*window(core[:2], v, self.overlap, margin),
                *window(core[2:], u, self.overlap, margin))
        return self._job(seen, reported(core, (v, u), self.overlap))

    def _job(self, seen, core):
        v_low, v_high, u_low, u_high = seen
        parts = [self._part(k, seen) for k in range(len(self.images))]
        there = np.array([k for k, part in enumerate(parts)
                          if part is not None], int)
        maps = [TileMap(self.grid.to_image[k], self.grid.to_grid[k],
                        (u_low, v_low), parts[k].origin[::-1])
                for k in there]
        return ManyJob([parts[k] for k in there], maps, there,
                       self.scales[there], self.factors[there],
                       self.bands[there], self.options,
                       (v_high - v_low, u_high - u_low), (v_low, u_low),
                       core, len(self.images), given_in(self.given, seen))

    def _part(self, k, seen):
        """Return what image k shows of a part of the grid, or None."""
        box = _box(self.grid.to_image[k], seen, self.images[k].shape)
        if box is None:
            return None
        y_low, y_high, x_low, x_high = box
        data, variance = self.images[k].part(np.s_[y_low:y_high,
                                                   x_low:x_high])
        # Beyond the part, stars are not known and say nothing of the sky.
        u, v = self.grid.to_grid[k].on_grid(
            np.arange(x_low, x_high, dtype=float),
            np.arange(y_low, y_high, dtype=float))
        outside = ((v < seen[0] - 0.5) | (v > seen[1] - 0.5)
                   | (u < seen[2] - 0.5) | (u > seen[3] - 0.5))
        data[outside] = variance[outside] = 0
        if not (variance > 0).any():
            return None
        return TileJob(data, variance, self.psfs[k].moved(x_low, y_low),
                       self.each[k], (y_low, x_low), None)

    def with_scales(self):
        """Return the plan with the scales of its images' bright stars."""
        v, u = self.grid.shape
        middle = [slice_of(n) for n in (v, u)]
        job = self._job((*middle[0], *middle[1]), None)
        points = [one.points(job.shape) for one in job.maps]
        scales = self.scales.copy()
        scales[job.images] = image_scales(
            job.parts, points, [phases(part.psf, part.data.shape)
                                for part in job.parts])
        return replace(self, scales=scales)


def slice_of(n):
    """Return (low, high) of the middle of n pixels, at the most a sample."""
    low = max((n - _SAMPLE) // 2, 0) // CELL * CELL
    return low, min(low + _SAMPLE, n)


def _box(to_image, seen, shape):
    """Return the pixels of an image around a part of the grid, or None."""
    v_low, v_high, u_low, u_high = seen
    v, u = (np.linspace(low, high - 1, 17) for low, high in (
        (v_low, v_high), (u_low, u_high)))
    x, y = to_image.on_grid(u, v)
    out = []
    for part, n in zip((y, x), shape, strict=True):
        low = max(0, int((part.min() - 2) // CELL * CELL))
        high = min(n, int(-(-(part.max() + 3) // CELL) * CELL))
        if low >= high:
            return None
        out += [low, high]
    return out
