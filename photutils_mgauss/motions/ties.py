"""Planes without WCS, tied to the plane of the other epochs."""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.motions.stacked import sandwich_2x2
from photutils_mgauss.sky.common_points import tie_points


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
    Bring all detections to the common plane, and return the `Ties`.

    Those of planes without a sky are changed where they are, as a copy of
    all that was measured would be the largest of all arrays.

    The common plane is the catalogue's, or that of the epochs with a sky, or
    the first epoch's.

    Parameters
    ----------
    detections : `~photutils_mgauss.motions.detections.Detections`
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
        return Ties(maps, agreed)
    targets = np.full(places[:, 0].shape, np.nan)
    targets[:, stars] = catalogue.values[:2]
    known = np.isfinite(targets[0]).sum() >= 3
    need, usable = transform.n_references, detections.usable
    if not known:
        first = int(np.argmax(usable.sum(axis=1) >= need))
        targets = _mean_places(places[:, on_sky if on_sky.any() else [first]])
    for e in np.flatnonzero(~on_sky):
        if known:
            targets[:, stars] = (catalogue.values[:2] + np.nan_to_num(
                catalogue.motion()) * np.nan_to_num(years[e]
                                                    - catalogue.year))
        common = usable[e] & np.isfinite(targets).all(axis=0)
        if common.sum() < need:
            # Where it is on the common plane nobody knows.
            usable[e], maps[e] = False, np.eye(2, 3, 1)
            continue
        maps[e], far = tie_points(places[:, e], targets,
                                  usable[e], transform, f'epoch {e}')
        agreed &= ~far
        slope = maps[e][:, 1:]
        places[:, e] = maps[e][:, :1] + slope @ places[:, e]
        covariance[:, e] = sandwich_2x2(slope[..., None], covariance[:, e])
        if detections.jacobian is not None:
            detections.jacobian[:, :, e] = np.einsum(
                'ij,jkn->ikn', slope, detections.jacobian[:, :, e])
        if not known:
            targets = np.where(np.isfinite(targets), targets, places[:, e])
    return Ties(maps, agreed)


def _mean_places(places):
    """Return the mean places (2, n) of stars over epochs, NaN if unseen."""
    count = np.isfinite(places).sum(axis=1)
    with np.errstate(invalid='ignore'):
        return np.nansum(places, axis=1) / np.where(count, count, np.nan)
