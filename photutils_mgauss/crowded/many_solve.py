"""The stars of a tile found and fitted in many images together."""
import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss.crowded.bright import least_fluxes, saturated_stars
from photutils_mgauss.crowded.given import WARM_UP, associate
from photutils_mgauss.crowded.many_search import find, leave_out
from photutils_mgauss.crowded.many_tile import ManyTile
from photutils_mgauss.crowded.solve import find_all, settle
from photutils_mgauss.crowded.stars import Stars

# Saturated stars of two images that are nearer than this are one [pix], of
# wide PSFs it is more.
_SAME = 3.0


def solve_many(job):
    """
    Find and fit the stars of a piece of the sky.

    Parameters
    ----------
    job : ManyJob

    Returns
    -------
    ManyTile
        Solved, its equations those of the solution.
    """
    tile = ManyTile(job)
    if job.given is not None and not job.options.find_neighbors:
        tile.start(job.given, np.zeros((len(job.parts), len(job.given))))
        tile.brighten(0)
        for damping in WARM_UP:
            tile.step(damping)
    else:
        tile.start(*_saturated(tile))
        tile.note_least(least_fluxes)
        find_all(tile, find, leave_out)
        if job.given is not None:
            associate(tile, job.given, leave_out)
    tile.learn_motions()
    settle(tile, leave_out)
    tile.measure()
    return tile


def _saturated(tile):
    """Return stars that are saturated in an image, and their fluxes."""
    parts = [_on_grid(tile, k, saturated_stars(model))
             for k, model in enumerate(tile.models)]
    every = Stars.joined(parts)
    bright = np.argsort(-every.flux, kind='stable')
    every = every.chosen(bright)
    keep = np.ones(len(every), bool)
    if len(every):
        tree = cKDTree(np.column_stack([every.x, every.y]))
        for a, b in sorted(tree.query_pairs(tile.scale * _SAME)):
            if keep[a]:
                keep[b] = False
    every = every.chosen(keep)
    return every, tile.job.scales[:, None] * every.flux


def _on_grid(tile, k, stars):
    """Return stars of an image in columns and rows of the grid."""
    u, v = tile.job.maps[k].back(stars.x, stars.y)
    return stars.replaced(x=u, y=v, x_init=u, y_init=v,
                          flux=stars.flux / tile.job.scales[k])
