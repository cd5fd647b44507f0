"""
Stars of a crowded field that are given by a list.

Whatever else is on the image is found as without a list; then each entry
takes the star it means, and entries that mean none get one of their own.
"""
import numpy as np
from scipy.spatial import cKDTree

# A star further from its entry has to be this much brighter to be the one: a
# factor of exp(d^2 / 2) at d times this distance [pix].
_ENTRY_DISTANCE = 0.3
# Entries with less distance to another's star than this fraction of the
# root of the PSF's area cannot be told from it.
_SAME = 0.25
# Damping of the steps in which stars without fluxes find theirs.
WARM_UP = (1.0, 0.3, 0.1, 0.03)


def warm_up(tile, listed):
    """Start with the stars of a list alone, perhaps without fluxes."""
    model = tile.model
    ny, nx = model.data.shape
    x = np.clip(np.rint(listed.x), 0, nx - 1).astype(int)
    y = np.clip(np.rint(listed.y), 0, ny - 1).astype(int)
    peak = np.maximum(model.data[y, x] - model.level.min(), model.noise)
    tile.start(listed.replaced(flux=np.where(
        listed.flux > 0, listed.flux, peak / model.psf.profile[0])))
    for damping in WARM_UP:
        tile.step(damping)


def associate(tile, listed, leave_out):
    """Give stars of a tile to the entries of a list; add what it lacks."""
    same = _SAME * np.sqrt(tile.area)
    bound = tile.options.xy_bounds
    # Without bounds, whatever is near enough to be seen as one will do.
    radius = max(same, bound) if np.isfinite(bound) else 4 * same
    entry, star = pair_up(listed, tile.stars, radius)
    tile.bind(star, listed.chosen(entry))
    left = np.setdiff1d(np.arange(len(listed)), entry)
    # What is hardly seen is taken to be where the list says it is.
    spread = min(tile.options.xy_bounds, 1.0) / 2
    tile.admit_listed(_without_repeats(tile, listed.chosen(left), same),
                      spread)
    tile.step(0.05, _beside_added(tile))
    leave_out(tile, tile.options.keep)
    tile.step(0.05, _beside_added(tile))


def pair_up(entries, stars, radius):
    """
    Match entries and stars one to one, the nearest and brightest first.

    Returns
    -------
    entry, star : (n,) `~numpy.ndarray` of int
    """
    if not len(entries) or not len(stars):
        return np.empty(0, int), np.empty(0, int)
    close = _tree(entries).sparse_distance_matrix(
        _tree(stars), radius, output_type='coo_matrix')
    cost = ((close.data / _ENTRY_DISTANCE)**2
            - 2 * np.log(np.maximum(stars.flux[close.col], 1e-300)))
    pairs, used, taken = [], set(), set()
    for k in np.lexsort((close.col, close.row, cost)):
        i, j = int(close.row[k]), int(close.col[k])
        if i not in used and j not in taken:
            used.add(i)
            taken.add(j)
            pairs.append((i, j))
    return tuple(np.array(pairs, int).reshape(-1, 2).T)


def _tree(stars):
    return cKDTree(np.column_stack([stars.x, stars.y]))


def _without_repeats(tile, entries, same):
    """Note which entries mean the star of another; return the others."""
    named = tile.stars.chosen(tile.stars.listed)
    if len(named) and len(entries):
        gap, at = _tree(named).query(np.column_stack([entries.x, entries.y]))
        near = gap < same
        tile.note_repeats(entries.chosen(near), named.number[at[near]])
        entries = entries.chosen(~near)
    if not len(entries):
        return entries
    keep = np.ones(len(entries), bool)
    for first, second in sorted(_tree(entries).query_pairs(same)):
        if keep[first] and keep[second]:
            keep[second] = False
            tile.note_repeats(entries.chosen([second]),
                              entries.number[[first]])
    return entries.chosen(keep)


def _beside_added(tile):
    """Tell which stars are entries without a star, or near one of them."""
    # All others are what they are without a list.
    added, near = tile.stars.hold > 0, tile.neighbours
    beside = added.copy()
    beside[near.owner[added[near.neighbour]]] = True
    return beside
