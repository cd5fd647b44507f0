r"""
The light of stars beyond the stamps of a crowded image's own PSF.

No star of a crowded image has free pixels around it, but all of them have the
same wings. What a solution leaves is fitted, with the pixels of all stars at
once, by a power law beyond the radius R of the stamps, rings inside it that
hold what the PSF lacks there, and a new sky,

.. math::

    d(\mathbf{r}) = b(\mathbf{r}) + \sum_i f_i \left[
    A\, (r_i / R)^{-\gamma} + \sum_k h_k\, [\rho_k < r_i < \rho_{k+1}]
    \right], \quad r_i = |\mathbf{r} - \mathbf{r}_i| .

The law has no end, or the sky between bright stars would be part of it.
"""
import itertools

import numpy as np
from astropy.stats import mad_std
from scipy.signal import fftconvolve

from photutils_mgauss.crowded.background import Mesh
from photutils_mgauss.field.growth import (
    SLOPES,
    USUAL_SLOPE,
    Wings,
    over_slopes,
)
from photutils_mgauss.psf.renderer import MixtureRenderer

# Rings inside the stamps, from this part of their radius on; wings reach to
# so many radii.
_N_RINGS, _INNERMOST, _REACH = 5, 1 / 6, 8
# Where the PSF is known to this fraction only, the pixels tell less [of the
# light of stars]. Pixels are taken together in blocks of so many a side.
_PSF_ERROR, _BLOCK = 0.02, 4
# Blocks further off than so many standard deviations count for less.
_HUBER, _ROUNDS = 2.0, 4
# Pixels at the edges of rings are divided into so many along an axis.
_FINE = 5
_FAINTEST = 1e-3
_USUAL = int(np.argmin(np.abs(SLOPES - USUAL_SLOPE)))
# Of the largest, for equations that no pixel is in.
_TINY, _LEAST_SCATTER = 1e-9, 1e-75


def far_light(solved, psf, radius):
    """
    Measure what stars have beyond a radius that the PSF has not.

    Parameters
    ----------
    solved : Solved
        The stars of the image, and what they and the sky leave.
    psf : GriddedMixturePSF
        With which it was solved.
    radius : float
        [pix]

    Returns
    -------
    Wings
        Its share of the light includes what the PSF lacks inside.
    """
    edges = np.geomspace(_INNERMOST * radius, radius + 0.5, _N_RINGS + 1)
    stars = np.array([solved.table[f'{name}_fit']
                      for name in ('x', 'y', 'flux')])
    light = MixtureRenderer(psf).image(stars, _FAINTEST * solved.noise,
                                       solved.residual.shape)
    matrix, right = 0, 0
    for window in solved.windows:
        start = np.array([[window[1].start], [window[0].start], [0]])
        one = _equations(solved.residual[window], solved.variance[window],
                         light[window], stars - start, edges, solved.spacing)
        matrix, right = matrix + one[0], right + one[1]
    beyond, error, significance = _beyond(matrix, right)
    area = edges[-1]**2
    return Wings.of(beyond * area, error * area, significance,
                    _inside(matrix, right, edges), radius)


def _beyond(matrix, right):
    """Return the light beyond, see `over_slopes`, of normal equations."""
    matrix, right = _without_last(matrix, right, SLOPES.size)
    precision = np.maximum(matrix.diagonal(), _LEAST_SCATTER)
    return over_slopes(right / precision, precision**-0.5,
                       -right**2 / precision)


def _inside(matrix, right, edges):
    """Return the light inside, in fluxes of the stars, and its error."""
    some = np.append(_USUAL, SLOPES.size + np.arange(_N_RINGS))
    matrix, right = matrix[np.ix_(some, some)], right[some]
    area = np.append(0, np.pi * np.diff(edges**2))
    return (1 + area @ _solve(matrix, right),
            np.sqrt(area @ _solve(matrix, area)))


def _equations(residual, variance, light, stars, edges, spacing):
    """Return the normal equations of a window, its sky eliminated."""
    good = variance > 0
    weight = np.divide(1, variance + (_PSF_ERROR * light)**2, where=good,
                       out=np.zeros(residual.shape))
    total = _blocks(weight)
    seen = total > 0
    points = _as_points(residual.shape, stars)
    images = [*_rings(points, edges), *_sky(residual.shape, spacing), residual]
    *terms, value = (_blocks(weight * image)[seen] / total[seen]
                     for image in images)
    terms = np.array([*(image[seen] for image in _wings(points, edges[-1])),
                      *terms])
    total, scatter = total[seen], 1.0
    _without_units(terms, total)
    share = np.ones(total.size)
    # One of the slopes says as well as all what is far off.
    some = np.append(_USUAL, np.arange(SLOPES.size, len(terms)))
    for _ in range(_ROUNDS if total.size else 1):
        weighted = terms * (total * share)
        matrix, right = weighted @ terms.T, weighted @ value
        off = value - _solve(matrix[np.ix_(some, some)],
                             right[some]) @ terms[some]
        off *= np.sqrt(total)
        # In an image without noise it is 0; its square must not be.
        scatter = max(mad_std(off), _LEAST_SCATTER) if total.size else 1.0
        share = 1 / np.maximum(np.abs(off) / (_HUBER * scatter), 1)
    return _without_last(matrix / scatter**2, right / scatter**2,
                         SLOPES.size + _N_RINGS)


def _without_units(terms, total):
    """Bring the sky to units of the noise of a pixel, in place."""
    # What the pixels do not tell of it must not depend on the unit.
    if total.size:
        terms[SLOPES.size + _N_RINGS:] *= _BLOCK / np.sqrt(np.median(total))


def _solve(matrix, right):
    """Solve normal equations; what pixels do not tell is 0."""
    least = _TINY * max(matrix.diagonal().max(initial=0), _LEAST_SCATTER)
    return np.linalg.solve(matrix + least * np.eye(len(matrix)), right)


def _without_last(matrix, right, n):
    """Return normal equations of the first n unknowns, whatever the others."""
    others = _solve(matrix[n:, n:], np.column_stack([matrix[n:, :n],
                                                     right[n:]]))
    return (matrix[:n, :n] - matrix[:n, n:] @ others[:, :n],
            right[:n] - matrix[:n, n:] @ others[:, n])


def _blocks(image):
    """Return sums over blocks of pixels; those that are not whole are left."""
    ny, nx = (n // _BLOCK for n in image.shape)
    whole = image[:ny * _BLOCK, :nx * _BLOCK]
    return whole.reshape(ny, _BLOCK, nx, _BLOCK).sum(axis=(1, 3))


def _sky(shape, spacing):
    """Return the image of each node of a sky."""
    if not spacing:
        return []
    mesh = Mesh(shape, (0, 0), spacing)
    return [mesh.image(row) for row in np.eye(mesh.size)]


def _rings(points, edges):
    """Yield the image of each ring about stars, 1 for each unit of flux."""
    distance = _distances(edges[-1], 1)
    for low, high in itertools.pairwise(edges):
        yield fftconvolve(points, _coarse((distance > low)
                                          & (distance <= high)), 'same')


def _wings(points, radius):
    """Yield the image of power laws of each slope, in blocks."""
    points = _blocks(points)
    distance = _distances(_REACH * radius, _BLOCK)
    beyond = distance > radius
    for slope in SLOPES:
        law = (np.maximum(distance, radius) / radius)**-slope
        yield fftconvolve(points, _coarse(beyond * law), 'same')


def _distances(reach, step):
    """Return distances from the middle of a square, in parts of its steps."""
    half = int(np.ceil(reach / step)) + 1
    place = step * ((np.arange(_FINE * (2 * half + 1)) + 0.5) / _FINE
                    - half - 0.5)
    return np.hypot(place, place[:, None])


def _coarse(image):
    """Return the means of an image whose pixels are divided."""
    n = len(image) // _FINE
    return image.reshape(n, _FINE, n, _FINE).mean(axis=(1, 3))


def _as_points(shape, stars):
    """Return the flux of stars (3, n) in the four pixels around each."""
    image = np.zeros(np.add(shape, 2))
    x, y, flux = stars[:, _are_in(shape, *stars)] + [[1], [1], [0]]
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    u, v = x - column, y - row
    for i, j in itertools.product((0, 1), (0, 1)):
        np.add.at(image, (row + j, column + i),
                  flux * np.abs(1 - i - u) * np.abs(1 - j - v))
    return image[1:-1, 1:-1]


def _are_in(shape, x, y, flux):
    """Return which stars are in the image."""
    ny, nx = shape
    return (np.isfinite(x + y + flux) & (x > -1) & (x < nx) & (y > -1)
            & (y < ny))
