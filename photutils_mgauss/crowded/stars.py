"""The stars of a tile of a crowded field, and who is beside whom."""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss import kernels

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
        cell, columns, start = _cells(x, y)
        place = (x, y, _PAIR_DISTANCE, cell, columns, start,
                 np.argsort(cell, kind='stable'))
        count = np.empty(x.size, np.int64)
        kernels.count_near(*place, count)
        indptr = np.concatenate([[0], np.cumsum(count)])
        neighbour, twin = np.empty((2, indptr[-1]), np.int64)
        gap = np.empty(indptr[-1])
        kernels.list_near(*place, indptr, neighbour, gap, twin)
        has = count > 0
        nearest, distance = np.full(x.size, -1), np.full(x.size, np.inf)
        nearest[has] = neighbour[indptr[:-1][has]]
        distance[has] = gap[indptr[:-1][has]]
        return cls(indptr, neighbour, twin,
                   np.repeat(np.arange(x.size), count), nearest, distance)


def _cells(x, y):
    """Return each star's cell, how many are in a row, where each starts."""
    row, column = (
        (np.floor((v - v.min()) / _PAIR_DISTANCE).astype(int) + 1
         if v.size else np.empty(0, int)) for v in (y, x))
    columns = column.max(initial=0) + 2
    cell = row * columns + column
    count = np.bincount(cell, minlength=(row.max(initial=0) + 2) * columns)
    return cell, columns, np.concatenate([[0], np.cumsum(count)])
