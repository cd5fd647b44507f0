"""
Stars that move farther than their neighbours are away.

In a crowded field the row nearest to where a fast star was is another star.
Its rows are found when the rows of all others have been paired: three or more
of those that are left lie on a line at constant speed, which unrelated ones
hardly ever do.
"""
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

CROWDED = 0.1  # other stars within reach from which on fast ones are linked
N_SIGMA = 5.0
CHANCE = 0.01  # lines of unrelated rows that may be expected
MOST_PAIRS = 2_000_000  # of rows that are tried


def calm_motion(places, years, max_motion):
    """
    Return the largest motion [unit / yr] that hardly leads to a neighbour.

    It is ``max_motion`` where that is less, or where there are too few times
    for anything else.

    Parameters
    ----------
    places : list of (2, n_e) `~numpy.ndarray`
    years : (E,) `~numpy.ndarray`
    max_motion : float
    """
    times = np.unique(years)
    if len(times) < 3:
        return max_motion
    density = 0.0
    for each in places:
        good = each[:, np.isfinite(each).all(axis=0)]
        if good.shape[1] > 1:
            density = max(density, good.shape[1] / max(
                np.prod(np.ptp(good, axis=1)), 1e-300))
    if density == 0:
        return max_motion
    reach = np.sqrt(CROWDED / (np.pi * density))
    return min(max_motion, reach / np.diff(times).max())


def lines_of(position, sigma, year, max_motion, slack):
    """
    Return groups of rows that lie on lines at constant speed.

    Parameters
    ----------
    position : (2, n) `~numpy.ndarray`
        Where rows without a star are, in the frame of all.
    sigma, year : (n,) `~numpy.ndarray`
        Their errors and Julian years.
    max_motion : float
        The largest motion [unit / yr].
    slack : float
        By how much frames may be off.

    Returns
    -------
    lines : list of (k,) int `~numpy.ndarray`
        Three rows or more each, of different times; no row is in two.
    couples : list of (2,) int `~numpy.ndarray`
        Two rows that have no other row of another time within reach.
    """
    first, second = pairs = _pairs(position, year, max_motion)
    taken, lines = np.zeros(len(year), dtype=bool), []
    if not len(first):
        return [], []
    members, away, chance = _on_lines(position, sigma, year, pairs, slack)
    count = (members >= 0).sum(axis=0)
    # How many lines of so many rows unrelated ones would make.
    expected = len(first) * chance ** np.maximum(count - 2, 0)
    good = np.flatnonzero((count >= 3) & (expected < CHANCE))
    for pair in good[np.lexsort([away[good], -count[good]])]:
        group = members[members[:, pair] >= 0, pair]
        if not taken[group].any():
            taken[group] = True
            lines.append(group)
    free = ~taken[first] & ~taken[second]
    first, second = first[free], second[free]
    within = np.bincount(np.append(first, second), minlength=len(year))
    only = (within[first] == 1) & (within[second] == 1)
    return lines, list(np.stack([first[only], second[only]], axis=1))


def _on_lines(position, sigma, year, pairs, slack):
    """
    Return the rows (T, p) of T times on the lines through p pairs, or -1.

    Also the sum (p,) of their squared distances, in units of what they may
    be, and how many unrelated rows (p,) are to be expected there.
    """
    first, second = pairs
    times, span = np.unique(year), year[second] - year[first]
    motion = (position[:, second] - position[:, first]) / span
    area = max(np.prod(np.ptp(position, axis=1)), 1e-300)
    members = np.full((len(times), len(first)), -1)
    away, chance = np.zeros((2, len(first)))
    for t, time in enumerate(times):
        rows, part = np.flatnonzero(year == time), (time - year[first]) / span
        expected = position[:, first] + motion * (time - year[first])
        distance, near = cKDTree(position[:, rows].T).query(expected.T)
        reach = slack + N_SIGMA * np.sqrt(
            ((1 - part) * sigma[first])**2 + (part * sigma[second])**2
            + sigma[rows[near]]**2)
        own = (part == 0) | (part == 1)
        members[t] = np.where(own, np.where(part == 0, first, second),
                              np.where(distance <= reach, rows[near], -1))
        found = ~own & (members[t] >= 0)
        away[found] += (distance[found] / reach[found])**2
        chance[~own] += np.pi * reach[~own]**2 * len(rows) / area
    return members, away, chance


def _pairs(position, year, max_motion):
    """
    Return the earlier and the later rows of pairs within reach.

    None where there are too many to be tried.
    """
    times, total = np.unique(year), 0
    first, second = [np.empty(0, dtype=int)], [np.empty(0, dtype=int)]
    rows = [np.flatnonzero(year == time) for time in times]
    trees = [cKDTree(position[:, some].T) for some in rows]
    for i, j in combinations(range(len(times)), 2):
        reach = max_motion * (times[j] - times[i])
        total += trees[i].count_neighbors(trees[j], reach)
        if total > MOST_PAIRS:
            return first[0], second[0]
        found = trees[i].query_ball_tree(trees[j], reach)
        first.append(np.repeat(rows[i], [len(some) for some in found]))
        second += [rows[j][some] for some in found if some]
    return np.concatenate(first), np.concatenate(second)
