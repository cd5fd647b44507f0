"""
Stars of a crowded field that are given by a list.

Whatever else is on the image is found as without a list; then each entry
takes the star it means, and entries that mean none get one of their own.
"""
import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss.crowded.search import leave_out
from photutils_mgauss.crowded.stars import Stars

# A star further from its entry has to be this much brighter to be meant: a
# factor of exp(d^2 / 2) at d times this distance [pix].
_MEANT = 0.3
# Entries with less distance to another's star than this fraction of the
# root of the PSF's area cannot be told from it.
_SAME = 0.25
# Damping of the steps in which stars without fluxes find theirs.
_WARM_UP = (1.0, 0.3, 0.1, 0.03)


def warm_up(tile, given):
    """Start with the given stars alone, perhaps without fluxes."""
    x, y, flux, number = given
    s = Stars(x, y, flux, number=number.astype(int),
              bound=tile.options.xy_bounds, n_rows=tile.psf.n_rows)
    ny, nx = tile.data.shape
    unknown = ~(s.flux > 0)
    x = np.clip(np.rint(s.x), 0, nx - 1).astype(int)
    y = np.clip(np.rint(s.y), 0, ny - 1).astype(int)
    peak = np.maximum(tile.data[y, x] - tile.level.min(), tile.noise)
    s.flux = np.where(unknown, peak / tile.profile[0], s.flux)
    tile.stars = s
    tile.refresh()
    for damping in _WARM_UP:
        tile.step(damping)


def take_up(tile, given):
    """Tell which stars of a tile are meant by a list; add what it lacks."""
    x, y, _, number = given
    places, number = np.column_stack([x, y]), number.astype(int)
    bound = tile.options.xy_bounds
    same = _SAME * np.sqrt(tile.area)
    # Without bounds, whatever is near enough to be seen as one is meant.
    radius = max(same, bound) if np.isfinite(bound) else 4 * same
    entry, star = meant(places, tile.stars, radius)
    _name(tile, star, number[entry], places[entry])
    left = np.setdiff1d(np.arange(number.size), entry)
    left = _tell_repeats(tile, places, number, left, same)
    _add(tile, places[left], number[left])
    tile.step(0.05, _beside_added(tile))
    leave_out(tile, tile.options.keep)
    tile.step(0.05, _beside_added(tile))


def meant(places, stars, radius):
    """
    Match entries and stars one to one, the nearest and brightest first.

    Returns
    -------
    entry, star : (n,) `~numpy.ndarray` of int
    """
    if not len(places) or not len(stars):
        return np.empty(0, int), np.empty(0, int)
    close = cKDTree(places).sparse_distance_matrix(
        cKDTree(np.column_stack([stars.x, stars.y])), radius,
        output_type='coo_matrix')
    cost = ((close.data / _MEANT)**2
            - 2 * np.log(np.maximum(stars.flux[close.col], 1e-300)))
    pairs, entries, taken = [], set(), set()
    for k in np.lexsort((close.col, close.row, cost)):
        i, j = int(close.row[k]), int(close.col[k])
        if i not in entries and j not in taken:
            entries.add(i)
            taken.add(j)
            pairs.append((i, j))
    return tuple(np.array(pairs, int).reshape(-1, 2).T)


def _name(tile, star, number, places):
    """Give stars the numbers and places of their entries."""
    s, bound = tile.stars, tile.options.xy_bounds
    s.number[star], s.bound[star] = number, bound
    s.x_init[star], s.y_init[star] = places.T
    s.x[star] = s.x_init[star] + np.clip(
        s.x[star] - s.x_init[star], -bound, bound)
    s.y[star] = s.y_init[star] + np.clip(
        s.y[star] - s.y_init[star], -bound, bound)
    tile.refresh()


def _tell_repeats(tile, places, number, left, same):
    """Note which entries mean the star of another; return the others."""
    s = tile.stars
    named = np.flatnonzero(s.listed)
    if named.size and left.size:
        gap, at = cKDTree(np.column_stack([s.x, s.y])[named]).query(
            places[left])
        near = gap < same
        _note(tile, places, number, left[near], s.number[named[at[near]]])
        left = left[~near]
    if left.size == 0:
        return left
    keep = np.ones(left.size, bool)
    for first, second in sorted(cKDTree(places[left]).query_pairs(same)):
        if keep[first] and keep[second]:
            keep[second] = False
            _note(tile, places, number, left[[second]], number[left[[first]]])
    return left[keep]


def _note(tile, places, number, entry, host):
    tile.repeats += zip(number[entry], host, *places[entry].T, strict=True)


def _beside_added(tile):
    """Tell which stars are entries without a star, or near one of them."""
    # All others are what they are without a list.
    added = tile.stars.hold > 0
    beside = added.copy()
    beside[tile.pairs.owner[added[tile.pairs.neighbour]]] = True
    return beside


def _add(tile, places, number):
    """Add entries without a star, as bright as the residual allows."""
    n = len(tile.stars)
    least = 0.1 * tile.noise / tile.profile[0]
    # What is hardly seen is taken to be where the list says it is.
    spread = min(tile.options.xy_bounds, 1.0) / 2
    tile.admit(Stars(*places.T, np.full(len(places), least), number=number,
                     bound=tile.options.xy_bounds, hold=spread**-2,
                     n_rows=tile.psf.n_rows))
    s, information = tile.stars, tile.matrix[n:, 0, 0]
    more = np.divide(tile.gradient[n:, 0], information,
                     where=information > 0, out=np.zeros(len(places)))
    s.flux[n:] += np.maximum(more, 0)
    s.flux_init[n:] = s.flux[n:]
    tile.refresh()
