"""Finding stars on the residual of a tile, and leaving some out again."""
import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from photutils_mgauss import kernels
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.tile import CELL

# Lengths are those for a PSF of the usual width; of a wider one they are
# wider.

# Pixels where nine together stand out less than this fraction of the
# threshold are not looked at.
_HINT = 0.4
# A further star is looked for within this distance of a known one [pix], with
# the known one free to move; where less than this fraction of the
# information is left, the two cannot be told apart.
REACH = 2.3
LEAST = 0.05
# Those of the known stars within this distance are free [pix].
FREE = 3.0
# No star is added this close to another, or to one that was taken away [pix].
SEPARATION = 0.3
_REJECTED = 0.5
# Stars whose light is on the image may be this far outside [pix].
_OUTSIDE = 3.0


def find(tile, threshold, found_in):
    """Add the maxima of significance on the residual."""
    significance, flux = _scores(tile, threshold)
    scale = tile.model.psf.scale
    found = peaks(significance, flux, threshold, found_in, scale)[2]
    good = apart(found, tile.model.stars, tile.rejected, scale)
    good &= bright_enough(found, tile.least)
    tile.admit(found.chosen(good))


def peaks(significance, flux, threshold, found_in, scale=1.0):
    """Return rows and columns of maxima (n,), and the stars there."""
    peak = (significance > threshold) & (
        significance == maximum_filter(significance, 2 * round(scale) + 1))
    y, x = np.nonzero(peak)
    dx, dy = _vertex(significance, x, y)
    return y, x, Stars(x + dx, y + dy, flux[y, x],
                       significance=significance[y, x], found_in=found_in)


def _scores(tile, threshold):
    model, templates = tile.model, tile.templates
    scale = model.psf.scale
    ny, nx = model.data.shape
    significance = np.zeros((ny, nx))
    flux = np.zeros((ny, nx))
    light = model.doubtful_light(tile.options.psf_error)
    weight = np.divide(model.weight, 1 + model.weight * light**2)
    for j, i in np.ndindex(templates.stamps.shape[:2]):
        kernels.score(
            model.residual, weight, templates.stamps[j, i], i * CELL,
            min((i + 1) * CELL, nx), j * CELL, min((j + 1) * CELL, ny),
            _HINT * threshold, significance, flux)
    fit = kernels.Fit(model.stars.sources, model.stamps,
                      model.neighbours.pairs, tile.equations.stars)
    kernels.score_beside(fit, templates, model.planes(light),
                         kernels.Limits(scale * REACH, scale * FREE, LEAST,
                                        float(threshold)),
                         kernels.BesideScratch.empty(), significance, flux)
    return significance, flux


def apart(found, known, rejected, scale=1.0):
    """Tell which stars are away from those known and places (n, 2)."""
    out = np.ones(len(found), bool)
    positions = np.column_stack([found.x, found.y])
    stars = np.column_stack([known.x, known.y])
    for places, limit in ((stars, SEPARATION), (rejected, _REJECTED)):
        if len(places) and len(found):
            out &= cKDTree(places).query(positions)[0] > scale * limit
    return out


def bright_enough(found, least):
    """Tell which stars have the flux that they are to have where they are."""
    ny, nx = least.shape
    x = np.clip(np.rint(found.x).astype(int), 0, nx - 1)
    y = np.clip(np.rint(found.y).astype(int), 0, ny - 1)
    return found.flux >= least[y, x]


def leave_out(tile, threshold):
    """
    Remove the weakest of each clump of insignificant stars.

    Returns their places (n, 2).
    """
    s = tile.model.stars
    covariance, _ = tile.equations.covariances()
    with np.errstate(invalid='ignore'):
        strength = s.flux / np.sqrt(covariance[:, 0, 0])
    weak = weakest(s, tile.model.neighbours, strength, threshold,
                   tile.model.data.shape, tile.model.psf.scale)
    gone = np.flatnonzero(weak)
    places = np.column_stack([s.x[gone], s.y[gone]])
    tile.dismiss(weak)
    return places


def weakest(s, p, strength, threshold, shape, scale=1.0):
    """
    Tell which stars of a strength (n,) are to go, the weakest first.

    And those that have become one with a star that is seen by its wings.
    """
    weak = ~(strength >= threshold) & ~s.listed
    distance = np.hypot(s.x[p.owner] - s.x[p.neighbour],
                        s.y[p.owner] - s.y[p.neighbour])
    distance /= scale
    fainter = (distance < 2) & (s.flux[p.neighbour] < s.flux[p.owner])
    weak[p.owner[fainter & weak[p.neighbour]]] = False
    # Where equations have no solution it is not the brightest that is extra.
    second = np.zeros(len(s), bool)
    second[p.neighbour[fainter]] = True
    weak &= second | ~np.isnan(strength) | ~(s.flux > 0)
    # By wings alone two stars that come so close cannot be told apart.
    same = np.zeros(len(s), bool)
    same[p.owner[(distance < _REJECTED) & s.seeded[p.neighbour]]] = True
    same &= ~s.seeded
    ny, nx = shape
    return weak | (~s.listed & (same | (np.maximum(
        np.maximum(-s.x, s.x - nx + 1),
        np.maximum(-s.y, s.y - ny + 1)) > _OUTSIDE)))


def _vertex(image, x, y):
    """Return the offsets of the tops of parabolas through three pixels."""
    ny, nx = image.shape
    out = []
    for step_x, step_y in ((1, 0), (0, 1)):
        here = image[y, x]
        after = image[np.minimum(y + step_y, ny - 1),
                      np.minimum(x + step_x, nx - 1)]
        before = image[np.maximum(y - step_y, 0), np.maximum(x - step_x, 0)]
        bend = 2 * here - before - after
        shift = np.divide(0.5 * (after - before), bend, where=bend > 0,
                          out=np.zeros(x.size))
        out.append(np.clip(shift, -0.5, 0.5))
    return out
