r"""
Finding stars in the evidence of all images of a tile together.

Image k says of a star at a point that half of -chi2 has the gradient
:math:`g_k` by its flux and how much it knows of that, :math:`i_k`. For a star
whose fluxes are as the scales :math:`c_k` of the images,

.. math:: S = \sum_k c_k g_k \Big/ \sqrt{\sum_k c_k^2 i_k} .

Each image is asked at the point itself: nothing is resampled.
"""
import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.search import (
    FREE,
    LEAST,
    REACH,
    SEPARATION,
    apart,
    bright_enough,
    peaks,
    weakest,
)

# What the freedom of stars can add to the evidence for another is bounded.
_FREEDOM = 0.3


def find(tile, threshold, found_in):
    """Add the maxima of significance in all images."""
    every = _evidence(tile, threshold)
    light = sum(c * one.gradient for c, one in zip(
        tile.job.scales, every, strict=True))
    known = sum(c**2 * one.information for c, one in zip(
        tile.job.scales, every, strict=True))
    safe = np.where(known > 0, known, 1)
    light[known <= 0] = 0
    y, x, found = peaks(light / np.sqrt(safe), light / safe, threshold,
                        found_in, tile.scale)
    good = apart(found, tile.stars, tile.rejected, tile.scale) & _told(
        tile, found)
    fluxes = []
    for c, one in zip(tile.job.scales, every, strict=True):
        own = one.information[y, x]
        fluxes.append(np.divide(one.gradient[y, x], own, where=own > 0,
                                out=c * found.flux)[good])
    tile.admit(found.chosen(good), np.array(fluxes))


def _told(tile, found):
    """Tell which stars are bright enough in an image, if any shows them."""
    told, seen = np.zeros((2, len(found)), bool)
    for c, one, least in zip(tile.job.scales, tile.job.maps, tile.least,
                             strict=True):
        x, y = one(found.x, found.y)
        ny, nx = least.shape
        inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
        told |= inside & bright_enough(
            found.replaced(x=x, y=y, flux=c * found.flux), least)
        seen |= inside
    return told | ~seen


def _evidence(tile, threshold):
    """Return the `~kernels.Evidence` of each image."""
    every, bare = [], np.zeros((2, *tile.shape))
    scratch = np.empty((2, *tile.shape))
    # PSFs of one camera are wrong in the same way: what each image makes of
    # that does not average out.
    error = tile.options.psf_error * np.sqrt(len(tile.models))
    planes = [_planes(model, error) for model in tile.models]
    for k, (c, plane) in enumerate(zip(tile.job.scales, planes,
                                       strict=True)):
        one = kernels.Evidence(*np.empty((2, *tile.shape)), *scratch)
        kernels.evidence(tile.points[k], tile.phases[k], plane[0],
                         tile.models[k].residual, one)
        bare += [c * one.bare_gradient, c**2 * one.bare]
        every.append(one)
    if len(tile.stars):
        wanted = bare[0] > threshold * np.sqrt(_FREEDOM * LEAST * bare[1])
        for k, one in enumerate(every):
            _ask_beside(tile, k, planes[k][1], wanted, one)
    return every


def _planes(model, psf_error):
    """Return weights that know of errors of the PSF, and its light."""
    light = model.doubtful_light(psf_error)
    return np.divide(model.weight, 1 + model.weight * light**2), light


def _ask_beside(tile, k, light, wanted, out):
    model = tile.models[k]
    fit = kernels.Fit(model.stars.sources, model.stamps,
                      tile.neighbours.pairs, tile.equations.each[k].stars)
    reach = model.psf.scale * REACH
    side = int(np.ceil(reach * tile.pixels[k])) + 1
    kernels.evidence_beside(
        tile.stars.x, tile.stars.y, fit, tile.points[k], tile.phases[k],
        model.planes(light), kernels.Limits(
            reach, model.psf.scale * FREE, LEAST, 0.0), side, wanted,
        kernels.BesideScratch.empty(), out)


def leave_out(tile, threshold):
    """
    Remove the weakest of each clump of insignificant stars.

    Returns their places (n, 2).
    """
    least = np.full(len(tile.stars), threshold)
    if threshold >= tile.options.keep and tile.stars.rate.shape[1]:
        least[_beside(tile, REACH)] = tile.options.threshold
    weak = weakest(tile.stars, tile.neighbours, strengths(tile), least,
                   tile.shape, tile.scale)
    # Two stars at a place share its light, and seem to move apart.
    weak |= _beside(tile, SEPARATION) & ~tile.stars.listed
    places = np.column_stack([tile.stars.x[weak], tile.stars.y[weak]])
    tile.dismiss(weak)
    return places


def _beside(tile, reach):
    """
    Tell which stars are within reach of a brighter one [pix].

    Of wide PSFs it is longer. What a PSF that is a little wrong leaves there
    looks like a weak star, and with it the brighter one is free to move, if
    stars have motions.
    """
    s, pairs = tile.stars, tile.neighbours
    near = np.hypot(s.x[pairs.owner] - s.x[pairs.neighbour],
                    s.y[pairs.owner] - s.y[pairs.neighbour]) < (
                        tile.scale * reach)
    fainter = s.flux[pairs.neighbour] < s.flux[pairs.owner]
    out = np.zeros(len(s), bool)
    out[pairs.neighbour[near & fainter]] = True
    return out


def strengths(tile):
    """Return the signal-to-noise ratios (n,) of all images together."""
    _, variance, _ = tile.equations.covariances()
    return strength_of(tile, variance)[0]


def strength_of(tile, variance):
    """
    Return what fluxes of some variances (E, n) say together.

    Returns
    -------
    (n,), (n,) `~numpy.ndarray`
        The signal-to-noise ratio, and the flux in an image of scale 1; NaN
        where no image tells.
    """
    known = np.divide(1, variance, where=variance > 0,
                      out=np.zeros(variance.shape))
    light, total = tile.equations.summed(tile.fluxes, known)
    total = np.where(total > 0, total, np.nan)
    return light / np.sqrt(total), light / total


def image_scales(parts, points, phases):
    """
    Return the relative throughput (E,) of images, from their brightest stars.

    Parameters
    ----------
    parts : list of TileJob
    points : list of kernels.Points
    phases : list of kernels.Phases
    """
    maps = []
    for part, point, phase in zip(parts, points, phases, strict=True):
        one = kernels.Evidence(*np.empty((4, *point.x.shape)))
        good = part.variance > 0
        level = np.median(part.data[good]) if good.any() else 0.0
        weight = np.divide(1, part.variance, where=good,
                           out=np.zeros(good.shape))
        kernels.evidence(point, phase, weight, part.data - level, one)
        maps.append((one.gradient, one.information))
    return _ratios(maps)


# Stars from this significance on tell how images compare, at most so many.
_BRIGHT, _MOST, _FEW = 15.0, 300, 3


def _ratios(maps):
    light, known = (sum(one) for one in zip(*maps, strict=True))
    total = light / np.sqrt(np.where(known > 0, known, np.inf))
    y, x, found = peaks(total, total, _BRIGHT, 0)
    best = np.argsort(-found.significance, kind='stable')[:_MOST]
    at = y[best], x[best]
    out = np.ones(len(maps))
    first, own = (one[at] for one in maps[0])
    for k, (gradient, information) in enumerate(maps):
        both = (own > 0) & (information[at] > 0) & (first > 0)
        if both.sum() >= _FEW:
            flux = gradient[at][both] / information[at][both]
            out[k] = np.median(flux / (first[both] / own[both]))
    # Where nothing bright is in common fluxes are taken to be the same.
    return np.where(out > 0, out, 1.0)
