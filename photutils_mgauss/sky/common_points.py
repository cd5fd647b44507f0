"""
The map between two planes from objects that are on both.

Some of them may be other objects than their names say.
"""
import numpy as np

from photutils_mgauss.sky.transforms import fit_linear

TRIALS = 300   # maps through a few points that are tried
FAR = 0.01     # of the field: how far a point may be from its place
AGREED = 0.25  # least part of the points that has to agree with a map


def tie_points(points, targets, usable, transform, name):
    """
    Return the map (2, 3) of points onto targets, and what it leaves far.

    Parameters
    ----------
    points, targets : (2, n) `~numpy.ndarray`
        Places of the same objects on two planes, NaN where unknown.
    usable : (n,) bool `~numpy.ndarray`
        Which points count.
    transform : `~photutils_mgauss.sky.transforms.Transform`
        The kind of map; polynomials become affine.
    name : str
        What the points are called in messages.

    Returns
    -------
    tie : (2, 3) `~numpy.ndarray`
    far : (n,) bool `~numpy.ndarray`
        Points that lie too far from their targets to be the same object.
    """
    common = usable & np.isfinite(targets).all(axis=0)
    good = common
    for k in range(8):
        if good.sum() < transform.n_references:
            msg = (f'{name} must have at least {transform.n_references} '
                   f'stars in common with the others for the transform '
                   f'{transform.kind!r}, got {good.sum()}')
            raise ValueError(msg)
        tie, away = (_fitted(points, targets, good, transform) if k else
                     _most_agreed(points, targets, common, transform))
        keep = common & (away <= _limit(away[good], k == 0))
        if (keep == good).all():
            break
        good = keep
    # A star may move fast and still be itself: one in the wrong place by a
    # part of the whole field is not.
    extent = FAR * np.max(np.ptp(targets[:, common], axis=1))
    if common.sum() > 3 and np.median(away[good]) > 10 * extent > 0:
        msg = (f'{name} must agree with the others on which star is '
               f'which, got {common.sum()} common stars that no map brings '
               'together: are the identifiers those of the same stars?')
        raise ValueError(msg)
    return tie, common & (away > max(extent, 3 * _limit(away[good], False)))


def _limit(residuals, first):
    """Return how far stars that belong to a tie may lie from it."""
    if first:
        return max(5 * np.quantile(residuals, AGREED), 1e-9)
    return max(5 * np.median(residuals), 1e-9)


def _fitted(points, targets, some, transform):
    """Return the map through some stars, and all distances (n,) from it."""
    tie = fit_linear(transform, points[:, some], targets[:, some])
    # In place, as there may be millions of them.
    away = targets - tie[:, :1]
    away -= tie[:, 1:] @ points
    return tie, np.hypot(*away, out=away[0])


def _most_agreed(points, targets, common, transform):
    """
    Return what most agree with of many maps through a few, and distances.

    Identifiers that are wrong for most of the stars, such as running numbers
    of those without a name, do no harm as long as a quarter is right.
    """
    stars = np.flatnonzero(common)
    extent = FAR * np.max(np.ptp(targets[:, stars], axis=1))
    # Polynomials are tied by affine maps, which three stars make.
    size = min(transform.n_references, 3)
    best, least = None, np.inf
    for some in _candidates(stars, size + 1):
        tie, away = _fitted(points, targets, some, transform)
        if some is stars and (len(stars) < 4 * size
                              or np.quantile(away[stars], 0.9) < extent):
            return tie, away
        agreed = np.quantile(away[stars], AGREED)
        if best is None or agreed < least:
            best, least = (tie, away), agreed
    return best


def _candidates(stars, size):
    """Yield all stars, and then random samples of a few of them."""
    yield stars
    rng = np.random.default_rng(0)
    for _ in range(TRIALS):
        yield stars[rng.choice(len(stars), size, replace=False)]
