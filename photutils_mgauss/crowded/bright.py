"""Bright stars of a tile: saturated ones, and the size of the PSF."""
import numpy as np
from scipy.ndimage import distance_transform_edt, find_objects, label

from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.psf.wings import place_behind, reach_of_wings

# Groups of bad pixels of up to this many may hide a saturated star.
_SATURATED_PIXELS = (2, 2000)
# Within this distance of what a saturated star hides [pix], of wide PSFs it is
# more, whatever is fainter than this part of it is what the PSF leaves of it.
BESIDE, DOUBTFUL = 2.3, 0.01


def saturated_stars(model):
    """Return a star for each clump of bad pixels that has a star's wings."""
    clumps, n = label(~model.good, np.ones((3, 3)))
    size = np.bincount(clumps.ravel(), minlength=n + 1)[1:]
    low, high = _SATURATED_PIXELS
    data = model.data - model.background()
    found = [_wing_star(model, data, box, clumps[box] == k + 1)
             for k, box in enumerate(find_objects(clumps))
             if low <= size[k] <= high]
    found = [star for star in found if star is not None]
    return Stars.joined([Stars([], [], []), *found])


def _wing_star(model, data, box, clump):
    x, y, core, wings = place_behind(model.psf, data, model.weight, box,
                                     clump)
    if wings is None:
        return None
    column, row = round(x), round(y)
    half = core + reach_of_wings(model.psf)
    ny, nx = model.data.shape
    part = (slice(max(0, row - half), min(ny, row + half + 1)),
            slice(max(0, column - half), min(nx, column + half + 1)))
    stamp = model.psf.stamp(column, row, half)[
        part[0].start - row + half:part[0].stop - row + half,
        part[1].start - column + half:part[1].stop - column + half]
    w = model.weight[part]
    info = (w * stamp**2).sum()
    if info == 0:
        return None
    # The faintest wing pixels say how bright the star can be: others may
    # hold neighbours.
    seen = (w > 0) & (stamp > 0.002 * stamp.max())
    if seen.sum() < 8:
        return None
    ratio = data[part][seen] / stamp[seen]
    flux = np.median(ratio)
    significance = flux * np.sqrt(info)
    if significance < 10 * model.options.threshold:
        return None
    return Stars([x], [y], [flux], significance=significance, seeded=True,
                 core=core)


def least_fluxes(model):
    """
    Return which flux (ny, nx) a new star has at least, 0 for any.

    A companion beside the hidden middle of a star and that star trade light,
    and both go away from where they are.
    """
    s, flux = model.stars, np.zeros(model.data.shape)
    for i in np.flatnonzero(s.seeded):
        # A clump may also be a trail or a bad column, which reach further than
        # the star is hidden; a square has its corners this far away.
        reach = np.sqrt(2) * s.core[i] + 0.5
        part, distance = _around(s.x[i], s.y[i], reach, flux.shape)
        hidden = ~model.good[part] & (distance <= reach)
        flux[part][hidden] = np.maximum(flux[part][hidden], s.flux[i])
    if not flux.any():
        return flux
    distance, nearest = distance_transform_edt(flux == 0, return_indices=True)
    return np.where(distance <= model.psf.scale * BESIDE,
                    DOUBTFUL * flux[tuple(nearest)], 0)


def _around(x, y, reach, shape):
    """Return a square (slice, slice) around a place, and distances in it."""
    part = tuple(slice(max(0, int(np.floor(place - reach))),
                       max(0, int(np.ceil(place + reach)) + 1))
                 for place in (y, x))
    row, column = (np.arange(one.start, min(one.stop, n))
                   for one, n in zip(part, shape, strict=True))
    return part, np.hypot(row[:, None] - y, column - x)


def size_differences(model):
    """
    Return by how much the PSF's variance is too small at bright stars.

    The Laplacian of a PSF is its derivative by the variance of a Gaussian it
    is convolved with; its amplitude in the residual is fitted, with star and
    Laplacian together: a star that is too wide is too bright, too.
    """
    s, stamps, out = model.stars, model.stamps, []
    bright = np.flatnonzero(
        (s.flux * model.psf.profile[0] > 50 * model.noise) & ~s.seeded)
    ny, nx = model.data.shape
    for i in bright[np.argsort(-s.flux[bright])][:200]:
        w, y, x = stamps.width[i], stamps.bottom[i], stamps.left[i]
        if x < 0 or y < 0 or x + w > nx or y + w > ny:
            continue
        window = slice(y, y + w), slice(x, x + w)
        first = stamps.offset[i]
        stamp = stamps.derivatives[0, first:first + w * w]
        out.append(_size_difference(stamp.reshape(w, w), s.flux[i],
                                    model.weight[window],
                                    model.residual[window],
                                    model.psf.scale))
    return np.array([value for value in out if np.isfinite(value)])


def _size_difference(stamp, flux, weight, residual, scale):
    # A bright star's PSF error is in proportion to its light, whatever the
    # photon noise: all pixels of the stamp count alike.
    good = (weight > 0).astype(float)
    slope = sum(np.gradient(np.gradient(stamp, axis=a), axis=a)
                for a in (0, 1)) / 2
    data = residual / flux
    a = (good * slope * slope).sum()
    b = (good * slope * stamp).sum()
    c = (good * stamp * stamp).sum()
    det = a * c - b * b
    if not det > 0:
        return np.nan
    change = (c * (good * slope * data).sum()
              - b * (good * stamp * data).sum()) / det
    j, k = np.indices(stamp.shape) - len(stamp) // 2
    core = (j**2 + k**2) <= 9 * scale**2
    size = (stamp * core * (j**2 + k**2)).sum() / (2 * (stamp * core).sum())
    return change / size
