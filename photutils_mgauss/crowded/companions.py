"""
What companions behind the masked middles of saturated stars do to them.

A star in the middle or the inner wings of a saturated one is not seen, and
the fit takes its light for that of the saturated star. With A, the answer of
the star's fit to light in its pixels, one of flux g at a distance **d** moves
flux, x and y by g A P(**d**), where P is the PSF. How many there are the
stars of the tile tell. The law of the errors is that of
`~photutils_mgauss.crowded.confusion`, whose width is that of what holds
68.27 % of it: of the few stars that have a bright companion no width tells.
"""
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.special import ndtr

from photutils_mgauss.crowded.bright import BESIDE, DOUBTFUL
from photutils_mgauss.crowded.bright_errors import pixels_of
from photutils_mgauss.crowded.confusion import square_of_one
from photutils_mgauss.crowded.search import LEAST, SEPARATION
from photutils_mgauss.utils.matrices import with_unit_diagonal

# Companions are looked at so far outside of what is masked [pix].
_OUTSIDE = 4
# The fluxes of stars of so many standard errors are counted, in so many steps.
_COUNTED, _STEPS = 5.0, 40


def with_companions(confusion, model, covariances):
    """
    Return what hidden stars do, with companions of saturated stars.

    Parameters
    ----------
    confusion : Confusion
        That of stars whose pixels are seen.
    model : Model
        Solved.
    covariances : (n, 3, 3) `~numpy.ndarray`
        Of flux, x and y, without hidden stars.

    Returns
    -------
    Confusion
    """
    s = model.stars
    errors = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
    seeded = np.flatnonzero(s.seeded & np.isfinite(errors).all(axis=1)
                            & (errors > 0).all(axis=1))
    flux, number = _counts(s, errors[:, 0], np.count_nonzero(model.good))
    if not seeded.size or not flux.size:
        return confusion
    doubt = model.doubtful_light(model.options.psf_error)
    parts = {name: part.copy() for name, part in vars(confusion).items()}
    for star in seeded:
        moves, hidden = _moves(model, star, doubt, flux)
        square, *places = (
            square_of_one(move[:, None] * flux / error, hidden * number)
            for move, error in zip(moves, errors[star], strict=True))
        parts['flux'][star] = np.sqrt(square)
        parts['position'][star] = np.sqrt(np.mean(places))
    return replace(confusion, **parts)


def _counts(s, error, area):
    """Return fluxes, and how many stars of each there are for a pixel."""
    # Saturated stars are not hidden by another.
    flux = s.flux[(s.flux > _COUNTED * error) & ~s.seeded]
    if not flux.size:
        return flux, flux
    edges = np.geomspace(flux.min(), 1.001 * flux.max(), _STEPS + 1)
    number, _ = np.histogram(flux, edges)
    return np.sqrt(edges[1:] * edges[:-1]), number / area


def _moves(model, star, doubt, flux):
    """
    Return what companions of unit flux do to flux, x and y (3, d).

    And the chances (d, g) that one of a flux (g,) is not found.
    """
    s = model.stars
    row, column, design, variance, half = pixels_of(model, star)
    weighed = design / variance
    matrix, scale = with_unit_diagonal(weighed @ design.T)
    covariance = (np.linalg.pinv(matrix, hermitian=True) / scale
                  / scale[:, None])
    y, x = (int(np.rint(at[star])) for at in (s.y, s.x))
    reach = min(int(s.core[star]) + _OUTSIDE, half)
    dy, dx = (at.ravel() for at in np.indices((2 * reach + 1,) * 2) - reach)
    psf = model.psf.stamp(s.x[star], s.y[star], half + reach)
    middle = half + reach
    others = psf[row - y + middle - dy[:, None],
                 column - x + middle - dx[:, None]].T
    common = weighed @ others
    moves = covariance @ common
    own = (others**2 / variance[:, None]).sum(axis=0)
    left = 1 - (common * moves).sum(axis=0) / np.maximum(own, 1e-300)
    # Where the PSF is doubted, stars are looked for with less weight.
    seen = (others**2 / (variance + doubt[row, column]**2)[:, None]).sum(
        axis=0) * np.maximum(left, LEAST)
    hidden = ndtr(model.options.faintest - flux * np.sqrt(seen)[:, None])
    hidden[(left < LEAST)
           | (np.hypot(dx, dy) < model.psf.scale * SEPARATION)] = 1
    beside = _beside(model, x, y, reach)[dy + reach, dx + reach]
    hidden[np.ix_(beside, flux < DOUBTFUL * s.flux[star])] = 1
    # What is brighter than the star would be the saturated one itself.
    hidden[:, flux > s.flux[star]] = 0
    return moves, hidden


def _beside(model, x, y, reach):
    """Tell which pixels around a place are masked or next to such (w, w)."""
    far = model.psf.scale * BESIDE
    more = reach + int(np.ceil(far))
    good = np.ones((2 * more + 1,) * 2, bool)
    ny, nx = model.good.shape
    rows, columns = (np.arange(at - more, at + more + 1) for at in (y, x))
    r, c = ((at >= 0) & (at < n) for at, n in ((rows, ny), (columns, nx)))
    good[np.ix_(r, c)] = model.good[np.ix_(rows[r], columns[c])]
    inner = slice(more - reach, more + reach + 1)
    return (distance_transform_edt(np.pad(good, 1))[1:-1, 1:-1] <= far)[
        inner, inner]
