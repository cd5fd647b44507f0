"""The stars of a tile found and fitted, from first to last."""
import numpy as np

from photutils_mgauss.crowded.bright import seed_saturated, size_differences
from photutils_mgauss.crowded.given import take_up, warm_up
from photutils_mgauss.crowded.search import find, leave_out
from photutils_mgauss.crowded.tile import REST, Tile

# Finding starts with the brightest stars.
_FALLING = (80, 25, 10)
_FIRST_STEPS, _FINAL_STEPS = 3, 5


def solve_tile(job):
    """
    Find and fit the stars of a tile.

    Parameters
    ----------
    job : TileJob

    Returns
    -------
    Tile
        Solved, its equations those of the solution, with ``moved`` (n,), how
        far each star went in the last step.
    """
    tile = Tile(job)
    if job.given is not None and not job.options.find_neighbors:
        warm_up(tile, job.given)
    else:
        seed_saturated(tile)
        tile.refresh()
        _find_all(tile)
        if job.given is not None:
            take_up(tile, job.given)
    _settle(tile)
    return tile


# What is done does not depend on how many stars there are or move: what
# happens around a star has to be the same on every tile it is on.

def _find_all(tile):
    options = tile.options
    for number, threshold in enumerate(_FALLING):
        if threshold > options.faintest:
            find(tile, threshold, number)
            tile.step(0.05)
            if number == 0:
                # Later, errors of the PSF are hidden by false companions.
                tile.step(0.05)
                tile.widths = size_differences(tile)
            leave_out(tile, 1.0)
    for number in range(options.max_rounds):
        find(tile, options.faintest, len(_FALLING) + number)
        tile.step(0.05)
        if number < 2:
            leave_out(tile, 0.7 * options.keep)
        else:
            tile.step(0.05)
            gone = leave_out(tile, options.keep)
            tile.graves = np.concatenate([tile.graves, gone])


def _settle(tile):
    _polish(tile, _FIRST_STEPS)
    # Some have faded, or become one with another.
    leave_out(tile, tile.options.keep)
    _polish(tile, _FINAL_STEPS)
    # Some may have moved out of the middle of their stamps.
    tile.refresh()


def _polish(tile, n_steps):
    tile.start_polishing()
    tile.moved = np.zeros(len(tile.stars))
    for _ in range(n_steps):
        tile.moved = tile.polish(0.02)
        if not (tile.moved > REST).any():
            break
