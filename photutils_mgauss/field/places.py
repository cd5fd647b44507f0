"""
Which detections of several exposures are of one star, or at one place.

Exposures that are shifted a little show the same stars again. Twenty
detections of a star have the noise of twenty, but know the PSF at one place
only, and all of them hold the light of the same faint neighbours. What is
chosen by how many stars there are counts places.
"""
import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

# How far a star may be off where it is expected [pix], the brightest stars
# that are compared, and how often so many may agree by chance.
_REACH, _BRIGHTEST, _CHANCE = 2.0, 150, 1e-4
# Pairs of stars that a map with turn and scale is fitted to.
_REFINEMENTS, _FEWEST_PAIRS = 5, 6
# Of the detector's side: a star that is moved by less is at the same place
# for polynomials of the degree that is usual.
_STEP = 1 / 8


def same_stars(lists):
    """
    Return which stars of several exposures are the same.

    The stars of an exposure are looked for among those of the exposures
    before it, moved by the shift that most of them agree on.

    Parameters
    ----------
    lists : list of Sources
        The stars of each exposure.

    Returns
    -------
    list of (n,) `~numpy.ndarray` of int
        The number of each star; stars of a position that is not finite, and
        those of exposures that share no pattern, have numbers of their own.
    """
    known, count, numbers = np.empty((2, 0)), 0, []
    flux = np.empty(0)
    of_known = np.empty(0, int)
    for one in lists:
        number = np.full(one.x.size, -1)
        rows = np.flatnonzero(np.isfinite(one.x) & np.isfinite(one.y))
        here = np.stack([one.x, one.y])[:, rows]
        matrix = _map(here, known, one.flux[rows], flux)
        if matrix is None:
            # Nothing is known of where these are among the others.
            moved, new = here, np.ones(rows.size, bool)
            matrix = np.eye(2, 3, 1)
        else:
            moved = _moved(matrix, here)
            mine, others = _pairs(moved, known)
            number[rows[mine]] = of_known[others]
            new = number[rows] < 0
        fresh = np.flatnonzero(number < 0)
        number[fresh] = count + np.arange(fresh.size)
        count += fresh.size
        known = np.hstack([known, moved[:, new]])
        flux = np.append(flux, one.flux[rows[new]])
        of_known = np.append(of_known, number[rows[new]])
        numbers.append(number)
    return numbers


def places(star, x, y, shape):
    """
    Return the number of the place of each detection, (n,).

    Parameters
    ----------
    star : (n,) `~numpy.ndarray` of int
        The star that each is of.
    x, y : (n,) `~numpy.ndarray`
        On the detector [pix].
    shape : (int, int)
        Of the detector.

    Returns
    -------
    (n,) `~numpy.ndarray` of int
        A star has another place once it is far from those before.
    """
    size = np.array(shape[::-1]) * _STEP
    scaled = np.column_stack([x, y]) / size
    place, count = np.empty(len(star), int), 0
    order = np.argsort(star, kind='stable')
    edges = np.flatnonzero(np.diff(star[order])) + 1
    for rows in np.split(order, edges):
        seen = np.empty((0, 2))
        for row in rows:
            distance = np.hypot(*(seen - scaled[row]).T)
            if not distance.size or distance.min() > 1:
                seen = np.vstack([seen, scaled[row]])
                distance = np.append(distance, 0)
            place[row] = count + np.argmin(distance)
        count += len(seen)
    return place


def in_turn(place, brightness):
    """
    Return the order of detections (n,): bright ones first, places in turn.

    The brightest detection of every place comes before the second of any.
    """
    order = np.lexsort((-brightness, place))
    first = np.flatnonzero(np.diff(place[order], prepend=-1))
    turn = np.empty(len(place), int)
    turn[order] = np.arange(len(place)) - np.repeat(
        first, np.diff(first, append=len(place)))
    return np.lexsort((-brightness, turn))


def _map(points, targets, flux, target_flux):
    """Return the matrix (2, 3) of points to targets, None if unknown."""
    if not points.size or not targets.size:
        return None
    some = points[:, _brightest(flux)]
    others = targets[:, _brightest(target_flux)]
    shifts = (others[:, None] - some[..., None]).reshape(2, -1)
    tree = cKDTree(shifts.T)
    counts = tree.query_ball_point(shifts.T, _REACH, return_length=True)
    best = int(np.argmax(counts))
    area = np.prod(np.ptp(points, axis=1) + np.ptp(targets, axis=1)
                   + 2 * _REACH)
    by_chance = shifts.shape[1] * np.pi * _REACH**2 / area
    if pdtrc(counts[best] - 2, by_chance) * shifts.shape[1] > _CHANCE:
        return None
    near = tree.query_ball_point(shifts[:, best], _REACH)
    matrix = np.eye(2, 3, 1)
    matrix[:, 0] = np.median(shifts[:, near], axis=1)
    return _refined(matrix, points, targets)


def _brightest(flux):
    return np.argsort(-np.where(np.isfinite(flux), flux, -np.inf),
                      kind='stable')[:_BRIGHTEST]


def _refined(matrix, points, targets):
    """Return the map fitted to the pairs it makes, turn and scale too."""
    for _ in range(_REFINEMENTS):
        mine, others = _pairs(_moved(matrix, points), targets)
        if mine.size < _FEWEST_PAIRS:
            break
        design = np.vstack([np.ones(mine.size), points[:, mine]])
        matrix = np.linalg.lstsq(design.T, targets[:, others].T,
                                 rcond=None)[0].T
    return matrix


def _moved(matrix, points):
    return matrix[:, :1] + matrix[:, 1:] @ points


def _pairs(points, targets):
    """Return which points and targets are each other's nearest, and near."""
    distance, near = cKDTree(targets.T).query(points.T)
    back = cKDTree(points.T).query(targets.T)[1]
    mine = np.flatnonzero((distance < _REACH)
                          & (back[near] == np.arange(near.size)))
    return mine, near[mine]
