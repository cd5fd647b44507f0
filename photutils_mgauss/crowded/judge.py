"""
Is it a star? Each one is judged by the pixels around it.

Light that is spread wider than a star can be fitted by several of them, none
of which leaves a residual. What tells is whether they are needed: together
with what is beside it and no brighter, a star is put back, and a smooth
surface is fitted in the place of all of them. A star makes a peak that no
such surface has.
"""
import numpy as np

# Half the width of the pixels that are looked at, of wide PSFs more.
_HALF = 3
# Neighbours up to so many times as bright are put back, too.
_PUT_BACK = 2.0
# A star without which a smooth surface is worse by less than this fraction of
# what it should be is none.
_NEEDED = 0.5
_AT_ONCE = 4096


def smooth_light(models):
    """Tell which stars (n,) smooth surfaces explain as well in all images."""
    near = models[0].neighbours
    out = np.zeros(near.distance.size, bool)
    # Alone, a star is what its residual says.
    crowded = np.flatnonzero(np.diff(near.indptr) >= 2)
    for first in range(0, crowded.size, _AT_ONCE):
        which = crowded[first:first + _AT_ONCE]
        worse, own = sum(_needed(model, which) for model in models)
        out[which] = worse < _NEEDED * own
    return out


def _needed(model, which):
    """Return how much worse a surface is, and what it should be (2, n)."""
    s, (ny, nx) = model.stars, model.data.shape
    half = round(model.psf.scale * _HALF)
    j, i = (v.ravel() for v in np.indices((2 * half + 1,) * 2) - half)
    y = np.rint(s.y[which]).astype(int)[:, None] + j
    x = np.rint(s.x[which]).astype(int)[:, None] + i
    seen = (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
    at = np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)
    weight = np.where(seen, model.weight[at], 0)
    residual = model.residual[at]
    own = _light(model, which, x, y)
    light = own + _beside(model, which, x, y)
    u, v = i / half, j / half
    terms = np.stack([np.ones(u.size), u, v, u * u, u * v, v * v])
    # What stars have left over may have a slope of its own.
    worse = (_rest(residual + light, weight, terms)
             - _rest(residual, weight, terms))
    return np.stack([worse, _rest(own, weight, terms)])


def _light(model, which, x, y):
    """Return the light of stars in pixels (n, m)."""
    left, bottom, width, offset, derivatives = (
        part[which][:, None] if part.ndim == 1 else part
        for part in model.stamps)
    column, row = x - left, y - bottom
    on = (column >= 0) & (column < width) & (row >= 0) & (row < width)
    at = offset + np.where(on, row * width + column, 0)
    return np.where(on, derivatives[0][at], 0) * model.stars.flux[which][
        :, None]


def _beside(model, which, x, y):
    """Return the light of neighbours that are not much brighter."""
    near, flux = model.neighbours, model.stars.flux
    count = np.diff(near.indptr)[which]
    owner = np.repeat(np.arange(which.size), count)
    pair = (np.arange(owner.size) - np.repeat(np.cumsum(count) - count, count)
            + near.indptr[which][owner])
    other = near.neighbour[pair]
    back = flux[other] <= _PUT_BACK * flux[which][owner]
    owner, other = owner[back], other[back]
    light = np.zeros(x.shape)
    if owner.size:
        first = np.flatnonzero(np.diff(owner, prepend=-1))
        light[owner[first]] = np.add.reduceat(
            _light(model, other, x[owner], y[owner]), first)
    return light


def _rest(image, weight, terms):
    """Return chi2 (n,) of images (n, m) beside a surface of some terms."""
    weighted = weight[:, None] * terms
    matrix = weighted @ terms.T
    right = (weighted @ image[:, :, None])[..., 0]
    matrix += 1e-9 * np.trace(matrix, axis1=1, axis2=2)[
        :, None, None] * np.eye(len(terms)) + 1e-300 * np.eye(len(terms))
    fit = np.linalg.solve(matrix, right[..., None])[..., 0]
    return (weight * image**2).sum(axis=1) - (fit * right).sum(axis=1)
