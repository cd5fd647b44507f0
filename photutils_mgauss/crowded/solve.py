"""The stars of a tile found and fitted, from first to last."""
from photutils_mgauss.crowded.bright import (
    least_fluxes,
    saturated_stars,
    size_differences,
)
from photutils_mgauss.crowded.bright_wings import left_of_bright
from photutils_mgauss.crowded.given import associate, warm_up
from photutils_mgauss.crowded.search import find, leave_out
from photutils_mgauss.crowded.tile import Tile

# Finding starts with the brightest stars.
_FALLING = (80, 25, 10)
_FIRST_STEPS, _FINAL_STEPS = 3, 5
_DAMPING = 0.02


def solve_tile(job):
    """
    Find and fit the stars of a tile.

    Parameters
    ----------
    job : TileJob

    Returns
    -------
    Tile
        Solved, its equations those of the solution.
    """
    tile = Tile(job)
    if job.given is not None and not job.options.find_neighbors:
        warm_up(tile, job.given)
    else:
        tile.start(saturated_stars(tile.model))
        tile.note_least(least_fluxes)
        find_all(tile, find, leave_out,
                 lambda tile: tile.take_off_wings(left_of_bright))
        if job.given is not None:
            associate(tile, job.given, leave_out)
    settle(tile, leave_out)
    return tile


# What is done does not depend on how many stars there are or move: what
# happens around a star has to be the same on every tile it is on.

def find_all(tile, find, leave_out, take_off=None):
    """Find and fit stars, the brightest first, with the searches given."""
    options = tile.options
    for number, threshold in enumerate(_FALLING):
        if threshold > options.faintest:
            find(tile, threshold, number)
            tile.step(0.05)
            if number == 0:
                # Later, errors of the PSF are hidden by false companions.
                tile.step(0.05)
                tile.note_widths(size_differences)
            leave_out(tile, 1.0)
            tile.update_diffuse()
    if take_off is not None:
        take_off(tile)
    for number in range(options.max_rounds):
        find(tile, options.faintest, len(_FALLING) + number)
        tile.step(0.05)
        if number < 2:
            leave_out(tile, 0.7 * options.keep)
        else:
            tile.step(0.05)
            tile.reject(leave_out(tile, options.keep))
        tile.update_diffuse()


def settle(tile, leave_out):
    """Let all stars come to rest."""
    tile.polish(_DAMPING, _FIRST_STEPS)
    # Some have faded, or become one with another.
    leave_out(tile, tile.options.keep)
    tile.polish(_DAMPING, _FINAL_STEPS)
    # Some may have moved out of the middle of their stamps.
    tile.refresh()
