"""The stars of a tile of a crowded field, and who is beside whom."""
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

# Stars further apart than this are not solved for together [pix]; they still
# see each other through the residual.
_PAIR_DISTANCE = 5.0


class Stars:
    """The stars of a tile, as parallel arrays."""

    COLUMNS = ('x', 'y', 'flux', 'x_init', 'y_init', 'flux_init',
               'significance', 'round', 'number', 'seeded', 'rows', 'paces',
               'count', 'bound', 'hold')

    def __init__(self, x, y, flux, *, significance=0, found_in=0, number=-1,
                 seeded=False, bound=np.inf, hold=0, n_rows=0):
        n = len(x)
        self.x, self.y, self.flux = (np.array(v, float) for v in (x, y, flux))
        self.x_init, self.y_init = self.x.copy(), self.y.copy()
        self.flux_init = self.flux.copy()
        self.significance = np.zeros(n) + significance
        self.round = np.zeros(n, int) + found_in
        self.number = np.zeros(n, int) + number
        self.seeded = np.zeros(n, bool) | seeded
        # How far from its first place a star may go [pix], and the inverse
        # variance with which it is held there.
        self.bound, self.hold = np.zeros(n) + bound, np.zeros(n) + hold
        # The Gaussians of each star's PSF, filled in when it is drawn.
        self.rows = np.empty((n, n_rows, 6))
        self.paces = np.empty((n, n_rows, 4))
        self.count = np.zeros(n, int)

    def __len__(self):
        return self.x.size

    @property
    def listed(self):
        """Whether each star is one of a given list."""
        return self.number >= 0

    def select(self, chosen):
        """Keep the chosen stars only."""
        for name in self.COLUMNS:
            setattr(self, name, getattr(self, name)[chosen])

    def append(self, other):
        """Add stars."""
        for name in self.COLUMNS:
            setattr(self, name, np.concatenate([getattr(self, name),
                                                getattr(other, name)]))


@dataclass(frozen=True)
class Neighbours:
    """
    Who overlaps whom: rows of a sparse matrix, nearest first.

    Star i's neighbours are neighbour[indptr[i]:indptr[i + 1]], twin is where
    the same pair stands the other way round; owner is i for each of them.
    """

    indptr: np.ndarray
    neighbour: np.ndarray
    twin: np.ndarray
    owner: np.ndarray
    nearest: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, x, y):
        """List the pairs of stars that are solved for together."""
        n = x.size
        pairs = np.empty((0, 2), int)
        if n > 1:
            pairs = cKDTree(np.column_stack([x, y])).query_pairs(
                _PAIR_DISTANCE, output_type='ndarray')
        i = np.concatenate([pairs[:, 0], pairs[:, 1]])
        j = np.concatenate([pairs[:, 1], pairs[:, 0]])
        gap = np.hypot(x[i] - x[j], y[i] - y[j])
        order = np.lexsort((j, gap, i))
        place = np.empty(i.size, np.int64)
        place[order] = np.arange(i.size)
        twin = place[np.roll(np.arange(i.size), len(pairs))][order]
        i, j, gap = i[order], j[order], gap[order]
        indptr = np.searchsorted(i, np.arange(n + 1))
        has = indptr[1:] > indptr[:-1]
        nearest, distance = np.full(n, -1), np.full(n, np.inf)
        nearest[has] = j[indptr[:-1][has]]
        distance[has] = gap[indptr[:-1][has]]
        return cls(indptr.astype(np.int64), j.astype(np.int64), twin, i,
                   nearest, distance)
