r"""
The similarity between two lists of places, from the pattern of bright objects.

A triangle of places a, b, c, written as complex numbers with ab the longest
side and c nearer to a, has the shape

.. math:: w = (c - a) / (b - a),

which no shift, turn or scale changes, and of which a mirror makes the complex
conjugate. Triangles of neighbouring bright objects with the same shape in both
lists each say what the map may be, and the map that most of them agree on is
tried on all objects.
"""
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

# How many of the brightest of both lists are tried in turn: those of lists of
# the same depth, and then of lists whose densities differ.
SIZES = ((40, 40), (120, 120), (40, 120), (120, 40), (400, 400), (120, 400),
         (400, 120), (40, 400), (400, 40), (1200, 1200), (400, 1200),
         (1200, 400), (120, 1200), (1200, 120))
NEIGHBOURS = 6   # of an object, with each two of which it makes a triangle
SHAPE = 0.01     # by which shapes of the same triangle may differ
SAME = 4         # triangles of about the same shape that are looked at
AGREE = 0.03     # of the field: by which votes for the same map may differ
TRIALS = 12      # maps that are tried on all objects
NEAR = 0.14      # of the mean distance of objects: what may be the same one
ENOUGH = 6       # objects that a map has to bring together
LEAST = 5        # or all of them, if a list has no more
RARE = 1e-8      # as often it may do so by chance


class Found(NamedTuple):
    """
    A map (2, 3) that brings objects together.

    How many these are, how many would be so by chance, and how far apart
    they may be.
    """

    matrix: np.ndarray
    together: int
    chance: float
    reach: float

    def apply(self, points):
        """Return mapped points (2, n)."""
        return _moved(self.matrix, points)


@dataclass(frozen=True)
class Pattern:
    """
    What is known of the map between two lists beforehand.

    Parameters
    ----------
    scale : (2,) tuple of float or None
        The least and the largest scale; None for any.
    mirror : bool or None
        Whether it mirrors; None where that is not known.
    """

    scale: tuple | None = None
    mirror: bool | None = None

    def find(self, points, targets, flux, target_flux):
        """
        Return the `Found` map of points onto targets, None if there is none.

        Parameters
        ----------
        points, targets : (2, n), (2, m) `~numpy.ndarray`
            Finite places.
        flux, target_flux : (n,), (m,) `~numpy.ndarray`
            By which the brightest are chosen; where they are not known,
            NaN, all are as good.
        """
        order, target_order = _brightest(flux), _brightest(target_flux)
        enough = max(LEAST, min(ENOUGH, len(flux), len(target_flux)))
        tried = set()
        for sizes in SIZES:
            n = min(sizes[0], points.shape[1])
            m = min(sizes[1], targets.shape[1])
            if (n, m) in tried or min(n, m) < enough:
                continue
            tried.add((n, m))
            found = self._among(points[:, order[:n]],
                                targets[:, target_order[:m]], enough)
            if found is not None:
                return _refined(found, points, targets, enough)
        return None

    def _among(self, points, targets, enough):
        """Return the map that some bright objects agree on, or None."""
        votes = self._votes(points, targets)
        if not votes.size:
            return None
        best, most = None, 0
        for vote in _most_agreed(votes, points):
            found = _refined(_matrix(vote), points, targets, enough)
            # Three objects make an affine map and say nothing about it.
            by_chance = pdtrc(max(found.together - 4, 0), found.chance)
            if (found.together > max(most, enough - 1)
                    and by_chance < RARE):
                best, most = found.matrix, found.together
        return best

    def _votes(self, points, targets):
        """
        Return what pairs of equal triangles say, rows (slope, shift, mirror).

        The map is slope times z plus shift, or with the conjugate of z.
        """
        one, two = _triangles(points), _triangles(targets)
        if not len(one) or not len(two):
            return np.empty((0, 3), dtype=complex)
        tree = cKDTree(_plane(_shapes(two)))
        mirrors = (False, True) if self.mirror is None else (self.mirror,)
        votes = []
        for mirror in mirrors:
            seen = one.conj() if mirror else one
            distance, near = tree.query(_plane(_shapes(seen)), k=SAME,
                                        distance_upper_bound=SHAPE)
            rows, which = np.nonzero(np.isfinite(distance))
            a, b = seen[rows], two[near[rows, which]]
            slope = (b[:, 1] - b[:, 0]) / (a[:, 1] - a[:, 0])
            votes.append(np.column_stack([
                slope, b.mean(axis=1) - slope * a.mean(axis=1),
                np.full(len(slope), mirror)]))
        votes = np.concatenate(votes)
        if self.scale is None:
            return votes
        low, high = self.scale
        size = np.abs(votes[:, 0])
        return votes[(size >= low) & (size <= high)]


def _brightest(flux):
    """Return the order of objects, the brightest first."""
    return np.argsort(-np.where(np.isfinite(flux), flux, -np.inf),
                      kind='stable')


def _complex(points):
    return points[0] + 1j * points[1]


def _plane(values):
    return np.column_stack([values.real, values.imag])


def _triangles(points):
    """
    Return the triangles (k, 3) of objects and their neighbours, complex.

    The first two corners are the ends of the longest side, the first of them
    the one nearer to the third.
    """
    n = points.shape[1]
    k = min(NEIGHBOURS + 1, n)
    _, near = cKDTree(points.T).query(points.T, k=k)
    one, two = np.triu_indices(k - 1, 1)
    corners = np.stack([np.repeat(near[:, :1], len(one), axis=1),
                        near[:, 1 + one], near[:, 1 + two]], axis=-1)
    corners = np.unique(np.sort(corners.reshape(-1, 3), axis=1), axis=0)
    z = _complex(points)[corners]
    opposite = np.abs(z[:, [1, 2, 0]] - z[:, [2, 0, 1]])
    # The corner opposite the longest side is last, the one opposite the
    # shortest, which is farther from it, is the second.
    order = np.argsort(opposite, axis=1)[:, [1, 0, 2]]
    z = np.take_along_axis(z, order, axis=1)
    return z[np.abs(z[:, 1] - z[:, 0]) > 0]


def _shapes(triangles):
    a, b, c = triangles.T
    return (c - a) / (b - a)


def _most_agreed(votes, points):
    """Yield the mean votes of those maps that most votes agree on."""
    z = _complex(points)
    middle = z.mean()
    size = np.sqrt(np.mean(np.abs(z - middle)**2))
    slope, shift, mirror = votes.T
    centre = np.where(mirror.real > 0, np.conj(middle), middle)
    length = np.abs(slope)
    turn = slope / length
    # In units of the field, wherever the map puts it.
    place = (slope * centre + shift) / (np.median(length) * size)
    features = np.column_stack([np.log(length), turn.real, turn.imag,
                                place.real, place.imag, 10 * mirror.real])
    tree = cKDTree(features)
    counts = tree.query_ball_point(features, AGREE, return_length=True)
    for _ in range(TRIALS):
        best = int(np.argmax(counts))
        if counts[best] < 2:
            return
        some = tree.query_ball_point(features[best], AGREE)
        yield np.median(votes[some].real, axis=0) + 1j * np.median(
            votes[some].imag, axis=0)
        counts[tree.query_ball_point(features[best], 2 * AGREE)] = 0


def _matrix(vote):
    """Return the matrix (2, 3) of a vote."""
    slope, shift, mirror = vote
    sign = -1 if mirror.real > 0.5 else 1
    return np.array([[shift.real, slope.real, -sign * slope.imag],
                     [shift.imag, slope.imag, sign * slope.real]])


def _moved(matrix, points):
    return matrix[:, :1] + matrix[:, 1:] @ points


def within(points, targets):
    """Return which points (n,) are in the rectangle that holds targets."""
    low, high = targets.min(axis=1)[:, None], targets.max(axis=1)[:, None]
    return ((points >= low) & (points <= high)).all(axis=0)


def _spacing(targets):
    """Return the mean distance of neighbours of scattered objects."""
    area = np.prod(np.ptp(targets, axis=1))
    return np.sqrt(area / targets.shape[1])


def _refined(matrix, points, targets, enough):
    """Return the `Found` map fitted to all that it brings together."""
    tree, spacing = cKDTree(targets.T), _spacing(targets)
    reach = NEAR * spacing
    for _ in range(10):
        moved = _moved(matrix, points)
        distance, near = tree.query(moved.T)
        good = np.flatnonzero(distance < reach)
        good = good[np.argsort(distance[good], kind='stable')]
        # Of several that claim one object the nearest has it.
        good = good[np.unique(near[good], return_index=True)[1]]
        if len(good) < enough:
            break
        design = np.vstack([np.ones(len(good)), points[:, good]])
        matrix = np.linalg.lstsq(design.T, targets[:, near[good]].T,
                                 rcond=None)[0].T
        reach = min(reach, max(6 * np.median(distance[good]), reach / 3))
    by_chance = np.pi * (reach / spacing)**2 * within(moved, targets).sum()
    return Found(matrix, len(good), by_chance, reach)
