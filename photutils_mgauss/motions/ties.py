"""Planes without WCS, tied to the plane of the other epochs."""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.motions.stacked import sandwich_2x2
from photutils_mgauss.sky.transforms import fit_linear

TRIALS = 300   # maps through a few stars that are tried for a plane
FAR = 0.01     # of the field: how far a star may be from its place
AGREED = 0.25  # least part of the stars that has to agree with a map


@dataclass(frozen=True, eq=False)
class Ties:
    """
    What took the planes of E epochs to the common one.

    ``maps`` has for each epoch a map (2, 3), or None for a plane that is the
    common one already; ``agreed`` (n,) says which stars lie where the maps
    put them, within a few residuals.
    """

    maps: list
    agreed: np.ndarray


def tie_planes(detections, years, catalogue, stars, on_sky, transform):
    """
    Return positions and covariances on the common plane, and the `Ties`.

    The common plane is the catalogue's, or that of the epochs with a sky, or
    the first epoch's.

    Parameters
    ----------
    detections : `~photutils_mgauss.motions.epoch.Detections`
        Those of all n stars at E epochs.
    years : (E,) `~numpy.ndarray`
    catalogue : `~photutils_mgauss.motions.references.Catalogue`
        Reference objects, which are the stars with the numbers ``stars``.
    on_sky : (E,) bool `~numpy.ndarray`
        Which epochs are on the common plane already.
    transform : `~photutils_mgauss.sky.transforms.Transform`
        The kind of map.
    """
    places, covariance = detections.plane, detections.covariance
    maps = [None] * len(years)
    agreed = np.ones(places.shape[2], dtype=bool)
    if on_sky.all() or transform.kind == 'none':
        return places, covariance, Ties(maps, agreed)
    places, covariance = places.copy(), covariance.copy()
    targets = np.full(places[:, 0].shape, np.nan)
    targets[:, stars] = catalogue.values[:2]
    known = np.isfinite(targets[0]).sum() >= 3
    if not known:
        targets = _mean_places(places[:, on_sky if on_sky.any() else [0]])
    for e in np.flatnonzero(~on_sky):
        if known:
            targets[:, stars] = (catalogue.values[:2] + np.nan_to_num(
                catalogue.motion()) * np.nan_to_num(years[e]
                                                    - catalogue.year))
        maps[e], far = _tie(places[:, e], targets, detections.usable[e],
                            transform, e)
        agreed &= ~far
        slope = maps[e][:, 1:]
        places[:, e] = maps[e][:, :1] + slope @ places[:, e]
        covariance[:, e] = sandwich_2x2(slope[..., None], covariance[:, e])
        if not known:
            targets = np.where(np.isfinite(targets), targets, places[:, e])
    return places, covariance, Ties(maps, agreed)


def _mean_places(places):
    """Return the mean places (2, n) of stars over epochs, NaN if unseen."""
    count = np.isfinite(places).sum(axis=1)
    with np.errstate(invalid='ignore'):
        return np.nansum(places, axis=1) / np.where(count, count, np.nan)


def _tie(points, targets, usable, transform, e):
    """Return the map of a plane onto its targets, and outliers (n,)."""
    common = usable & np.isfinite(targets).all(axis=0)
    good = common
    for k in range(8):
        if good.sum() < transform.n_references:
            msg = (f'epoch {e} must have at least {transform.n_references} '
                   f'stars in common with the others for the transform '
                   f'{transform.kind!r}, got {good.sum()}')
            raise ValueError(msg)
        some = good if k else _most_agreed(points, targets, common, transform)
        tie, away = _fitted(points, targets, some, transform)
        keep = common & (away <= _limit(away[good], k == 0))
        if (keep == good).all():
            break
        good = keep
    # A star may move fast and still be itself: one in the wrong place by a
    # part of the whole field is not.
    extent = FAR * np.max(np.ptp(targets[:, common], axis=1))
    if common.sum() > 3 and np.median(away[good]) > 10 * extent > 0:
        msg = (f'epoch {e} must agree with the others on which star is '
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
    return tie, np.hypot(*(targets - tie[:, :1] - tie[:, 1:] @ points))


def _most_agreed(points, targets, common, transform):
    """
    Return the stars whose map, of many through a few, most agree with.

    Identifiers that are wrong for most of the stars, such as running numbers
    of those without a name, do no harm as long as a quarter is right.
    """
    stars = np.flatnonzero(common)
    extent = FAR * np.max(np.ptp(targets[:, stars], axis=1))
    # Polynomials are tied by affine maps, which three stars make.
    size = min(transform.n_references, 3)
    best, least = stars, np.inf
    for some in _candidates(stars, size + 1):
        _, away = _fitted(points, targets, some, transform)
        if some is stars and (len(stars) < 4 * size
                              or np.quantile(away[stars], 0.9) < extent):
            break
        agreed = np.quantile(away[stars], AGREED)
        if agreed < least:
            best, least = some, agreed
    return best


def _candidates(stars, size):
    """Yield all stars, and then random samples of a few of them."""
    yield stars
    rng = np.random.default_rng(0)
    for _ in range(TRIALS):
        yield stars[rng.choice(len(stars), size, replace=False)]
