"""The stars of a crowded field, and who is beside whom."""
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss import kernels

# Stars further apart than this [pix], and than so many times the root of the
# PSF's area, are not solved for together; they still see each other through
# the residual. Where stars that share much light are left out, the equations
# of all have no minimum, and steps throw bright stars away.
_PAIR_DISTANCE, _PAIR_WIDTHS = 5.0, 1.5


class Stars:
    """
    Stars as parallel arrays, from a list or a search over fits to the table.

    Every attribute is a column. Positions are pixels of the tile or of the
    image; ``number`` is the row of the user's list, -1 for stars found.
    ``core`` is how far from the middle of a saturated star pixels are hidden,
    ``bound`` how far from its first place a star may go [pix], ``hold``
    the inverse variance with which it is held there.

    Parameters
    ----------
    x, y, flux : (n,) array_like
        Also what the stars start from, ``x_init`` to ``flux_init``.
    significance, found_in, number, seeded, core, bound, hold : optional
        Columns, or what all stars have in them.
    """

    def __init__(self, x, y, flux, *, significance=0, found_in=0, number=-1,
                 seeded=False, core=0, bound=np.inf, hold=0):
        n = len(x)
        self.x, self.y, self.flux = (np.array(v, float) for v in (x, y, flux))
        self.x_init, self.y_init = self.x.copy(), self.y.copy()
        self.flux_init = self.flux.copy()
        self.significance = np.zeros(n) + significance
        self.found_in = np.zeros(n, int) + found_in
        self.number = np.zeros(n, int) + number
        self.seeded = np.zeros(n, bool) | seeded
        self.core = np.zeros(n, int) + core
        self.bound, self.hold = np.zeros(n) + bound, np.zeros(n) + hold

    @classmethod
    def of_columns(cls, columns):
        """Return stars with these columns, not copied."""
        new = cls.__new__(cls)
        vars(new).update(columns)
        return new

    @classmethod
    def joined(cls, parts):
        """Put stars with the same columns one after the other."""
        return cls.of_columns({
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in vars(parts[0])})

    def __len__(self):
        return self.x.size

    @property
    def listed(self):
        """Whether each star is one of a given list."""
        return self.number >= 0

    @property
    def sources(self):
        """Positions and fluxes as the kernels take them."""
        return kernels.Sources(self.x, self.y, self.flux)

    @property
    def drift(self):
        """How far each star is from where it started (2, n) [pix]."""
        return np.stack([self.x - self.x_init, self.y - self.y_init])

    def chosen(self, which):
        """Return the chosen stars, in that order."""
        return self.of_columns({name: column[which]
                                for name, column in vars(self).items()})

    def replaced(self, **columns):
        """Return the stars with other columns, or with more."""
        return self.of_columns(vars(self) | columns)

    def moved(self, x, y):
        """Return the stars with (x, y) added to their positions."""
        return self.replaced(x=self.x + x, y=self.y + y,
                             x_init=self.x_init + x, y_init=self.y_init + y)

    def sort(self, *keys):
        """Order the stars, column by column to save memory."""
        order = np.lexsort([getattr(self, key) for key in keys[::-1]])
        for name, column in vars(self).items():
            setattr(self, name, column[order])

    def take(self, step):
        """Change flux, x and y by a step (n, 3)."""
        self.flux = self.flux + step[:, 0]
        self.x = self.x + step[:, 1]
        self.y = self.y + step[:, 2]

    def bind(self, which, entries):
        """Make some stars those of entries of a list, within their bounds."""
        for name in ('number', 'bound', 'x_init', 'y_init'):
            getattr(self, name)[which] = getattr(entries, name)
        for place, start in ((self.x, self.x_init), (self.y, self.y_init)):
            place[which] = start[which] + np.clip(
                place[which] - start[which], -entries.bound, entries.bound)

    def brighten(self, which, more):
        """Let some stars start from a higher flux."""
        self.flux[which] += more
        self.flux_init[which] = self.flux[which]


def reach_of_pairs(area):
    """Return how far stars of a PSF [pix^2] are solved for together [pix]."""
    return max(_PAIR_DISTANCE, _PAIR_WIDTHS * np.sqrt(area))


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
    def of(cls, x, y, reach):
        """List the pairs of stars within reach of each other."""
        owner, neighbour, gap, twin = _close_pairs(x, y, reach)
        count = np.bincount(owner, minlength=x.size)
        indptr = np.concatenate([[0], np.cumsum(count)])
        has = count > 0
        nearest, distance = np.full(x.size, -1), np.full(x.size, np.inf)
        nearest[has] = neighbour[indptr[:-1][has]]
        distance[has] = gap[indptr[:-1][has]]
        return cls(indptr, neighbour, twin, owner, nearest, distance)

    @property
    def pairs(self):
        """The pairs as the kernels take them."""
        return kernels.Pairs(self.indptr, self.neighbour, self.twin)


def _close_pairs(x, y, reach):
    """
    Return pairs of points within reach, their distances, and their twins.

    Each pair both ways round, ordered by its first point, nearest first.
    """
    none = np.empty(0, np.int64)
    if x.size < 2:
        return none, none, np.empty(0), none
    pairs = cKDTree(np.column_stack([x, y])).query_pairs(
        reach, output_type='ndarray')
    n = len(pairs)
    owner, neighbour = np.concatenate([pairs, pairs[:, ::-1]]).T
    gap = np.hypot(x[owner] - x[neighbour], y[owner] - y[neighbour])
    order = np.lexsort([neighbour, gap, owner])
    place = np.empty(2 * n, np.int64)
    place[order] = np.arange(2 * n)
    # The other way round a pair stood n places further on.
    twin = place[np.where(order < n, order + n, order - n)]
    return owner[order], neighbour[order], gap[order], twin
