"""Normal equations of stars: how chi2 changes with flux, x and y of each."""
from math import log, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.jit import apart, inner, kernel, sums
from photutils_mgauss.kernels.tile import LANES, SCRATCH, fill_derivatives

# A group of n stars is seen on the pixels of its n boxes, (first row, first
# column, height, width) each; a single star is a group of one. Where boxes
# overlap their pixels count once for each box. Parameters are ordered flux, x,
# y of the first star, of the second, ..., and last, where it is fitted, the
# sky level common to the group.

# Where the root of the sum of squares of a star's unit-flux image in a box is
# not above this, the star is left out of its pixels.
_UNSEEN = 1e-18

# Of the peak: where that root is not above this in the box of another, the box
# is left out of what joins the two in the normal matrix.
# The minimum stays where it is, and errors change by the square of this.
_FAINT = 1e-5

# A Gaussian below this is not drawn in the box of another star: no sum of
# light has so many digits.
_DARK = 1e-15

# How far a pixel-integrated Gaussian reaches beyond one that is not [pix].
_PIXEL = 1.0


class Image(NamedTuple):
    """
    An image (ny, nx).

    error may be empty, for 1, and mask, for none. If gain is not 0, the
    variance of a pixel is the square of its error plus its stars' light over
    this.
    """

    data: np.ndarray
    error: np.ndarray
    mask: np.ndarray
    gain: float


class Pixels(NamedTuple):
    """
    The boxes of a group (n, 4), their data and weights (n, area).

    The weights are those without the light of stars.
    """

    boxes: np.ndarray
    data: np.ndarray
    weights: np.ndarray
    gain: float


class Equations(NamedTuple):
    """
    A group's normal equations, and the weighted residuals they came from.

    weights and residuals are (n, area). Of the matrix the lower triangle is
    filled; in each row nothing stands before column first (size,).
    """

    weights: np.ndarray
    residuals: np.ndarray
    matrix: np.ndarray
    gradient: np.ndarray
    first: np.ndarray

    @classmethod
    def empty(cls, n, area, size):
        """Return equations of at most n stars and size parameters."""
        return cls(np.zeros((n, area)), np.empty((n, area)),
                   np.empty((size, size)), np.empty(size),
                   np.empty(size, np.int64))


class Tiling(NamedTuple):
    """What `fill_derivatives` works on."""

    walk: np.ndarray
    tile: np.ndarray
    index: np.ndarray
    weights: np.ndarray

    @classmethod
    def empty(cls, width):
        """Return what derivatives in boxes of at most this width need."""
        return cls(np.zeros(SCRATCH), np.empty(3 * LANES * width),
                   np.empty(4, np.int64), np.empty((3, 4)))


class Scratch(NamedTuple):
    """
    The stars around one box, at most n.

    Their derivatives (n, 3, area), their numbers near (n,), and whether the
    box is in their rows of the matrix, joined (n,). sight (2,) is how far
    from the box stars are looked at [pix] and how bright they are to be
    joined. stop (1,) is True once nobody waits for the result.
    """

    derivatives: np.ndarray
    near: np.ndarray
    joined: np.ndarray
    tiling: Tiling
    sight: np.ndarray
    stop: np.ndarray

    @classmethod
    def empty(cls, n, area, stop):
        """Return scratch for at most n stars and area pixels."""
        # A single star is always looked at.
        return cls(np.empty((n, 3, area)), np.empty(n, np.int64),
                   np.empty(n, bool), Tiling.empty(area), np.zeros(2), stop)


class BoxScratch(NamedTuple):
    """
    The memory in which equations of at most n stars are made.

    data and weights (n, area) of boxes of at most area pixels, the equations,
    the stars around a box, and the sums of squares chi2 (2,).
    """

    data: np.ndarray
    weights: np.ndarray
    equations: Equations
    around: Scratch
    chi2: np.ndarray

    @classmethod
    def empty(cls, n, boxes, stop=None):
        """Return the memory for groups of n stars among those of boxes."""
        area = int(np.max(boxes[:, 2] * boxes[:, 3], initial=1))
        stop = np.zeros(1, bool) if stop is None else stop
        return cls(np.empty((n, area)), np.empty((n, area)),
                   Equations.empty(n, area, 3 * n + 1),
                   Scratch.empty(n, area, stop), np.zeros(2))


@kernel
def count_pixels(mask, boxes, out):
    """Put the number of pixels of each box that mask leaves into out (n,)."""
    for i in range(boxes.shape[0]):
        row, column, height, width = boxes[i]
        n = 0
        for y in range(row, row + height):
            for x in range(column, column + width):
                n += not mask[y, x]
        out[i] = n


@inner
def gather(image, box, sky, data, weight):
    """
    Copy the pixels of a box less its sky, column after column.

    Masked pixels get a weight of 0. Returns the number of pixels, or -1 if an
    error is not positive and finite.
    """
    row, column, height, width = box
    n = 0
    for j in range(height):
        for i in range(width):
            k = i * height + j
            y, x = row + j, column + i
            if image.mask.size and image.mask[y, x]:
                data[k] = 0.0
                weight[k] = 0.0
                continue
            data[k] = image.data[y, x] - sky
            weight[k] = 1.0
            n += 1
            if image.error.size:
                sigma = image.error[y, x]
                if not 0 < sigma < np.inf:
                    return -1
                weight[k] = 1 / (sigma * sigma)
    return n


@sums
def _weigh(data, known, sky, gain, old, residual, weight, chi2):
    """
    Turn the model of the stars in residual into residuals, and weigh them.

    known holds the weights without stars' light, weight takes the new ones;
    chi2 (2,) gets the sums of squares with the old weights and with the new
    ones added. A gain of 0 means that weights do not depend on the model.
    """
    with_old = 0.0
    with_new = 0.0
    light = 1 / gain if gain > 0 else 0.0
    for i in range(data.size):
        model = residual[i]
        w = known[i]
        w /= 1 + w * light * max(model, 0.0)
        r = data[i] - sky - model
        before = old[i]
        weight[i] = w
        residual[i] = r
        with_old += before * r * r
        with_new += w * r * r
    chi2[0] += with_old
    chi2[1] += with_new


@apart
def _add_own(derivatives, i, flux, weight, residual, a, gradient, matrix):
    """Add star i's part of the equations in one box, at a."""
    b0 = 0.0
    b1 = 0.0
    b2 = 0.0
    a00 = 0.0
    a10 = 0.0
    a11 = 0.0
    a20 = 0.0
    a21 = 0.0
    a22 = 0.0
    for k in range(weight.size):
        t0 = derivatives[i, 0, k]
        t1 = derivatives[i, 1, k]
        t2 = derivatives[i, 2, k]
        w0 = weight[k] * t0
        w1 = weight[k] * t1
        w2 = weight[k] * t2
        b0 += residual[k] * w0
        b1 += residual[k] * w1
        b2 += residual[k] * w2
        a00 += w0 * t0
        a10 += w1 * t0
        a11 += w1 * t1
        a20 += w2 * t0
        a21 += w2 * t1
        a22 += w2 * t2
    gradient[a] += b0
    gradient[a + 1] += flux * b1
    gradient[a + 2] += flux * b2
    matrix[a, a] += a00
    matrix[a + 1, a] += flux * a10
    matrix[a + 1, a + 1] += flux * flux * a11
    matrix[a + 2, a] += flux * a20
    matrix[a + 2, a + 1] += flux * flux * a21
    matrix[a + 2, a + 2] += flux * flux * a22


@sums
def _add_block(derivatives, i, flux_1, j, flux_2, weight, a, b, matrix):
    """Add the 3 x 3 block at (a, b) of the matrix, of stars i and j."""
    a00 = 0.0
    a01 = 0.0
    a02 = 0.0
    a10 = 0.0
    a11 = 0.0
    a12 = 0.0
    a20 = 0.0
    a21 = 0.0
    a22 = 0.0
    for k in range(weight.size):
        w0 = weight[k] * derivatives[i, 0, k]
        w1 = weight[k] * derivatives[i, 1, k]
        w2 = weight[k] * derivatives[i, 2, k]
        t0 = derivatives[j, 0, k]
        t1 = derivatives[j, 1, k]
        t2 = derivatives[j, 2, k]
        a00 += w0 * t0
        a01 += w0 * t1
        a02 += w0 * t2
        a10 += w1 * t0
        a11 += w1 * t1
        a12 += w1 * t2
        a20 += w2 * t0
        a21 += w2 * t1
        a22 += w2 * t2
    matrix[a, b] += a00
    matrix[a, b + 1] += flux_2 * a01
    matrix[a, b + 2] += flux_2 * a02
    matrix[a + 1, b] += flux_1 * a10
    matrix[a + 1, b + 1] += flux_1 * flux_2 * a11
    matrix[a + 1, b + 2] += flux_1 * flux_2 * a12
    matrix[a + 2, b] += flux_1 * a20
    matrix[a + 2, b + 1] += flux_1 * flux_2 * a21
    matrix[a + 2, b + 2] += flux_1 * flux_2 * a22


@inner
def _add_sky(derivatives, i, flux, weight, a, row):
    """Add what joins star i and the sky level, in one box, at a."""
    for k in range(weight.size):
        row[a] += weight[k] * derivatives[i, 0, k]
        row[a + 1] += weight[k] * derivatives[i, 1, k] * flux
        row[a + 2] += weight[k] * derivatives[i, 2, k] * flux


# How far stars can be seen.

@inner
def _gaussian_reach(row):
    """Return how far from the star a Gaussian is above _DARK [pix]."""
    a, x, y, p, s, q = row
    if not abs(a) > _DARK:
        return 0.0
    # The smaller eigenvalue of the precision matrix.
    half = 0.5 * (p + q + p * s * s)
    least = p * q / (half + sqrt(max(half * half - p * q, 0.0)))
    return sqrt(x * x + y * y) + sqrt(2 * log(abs(a) / _DARK) / least)


@inner
def find_reach(psf, sight):
    """Put how far stars are seen [pix] and what is too faint to join."""
    nodes, _, _, _, integrated = psf
    _find_reach(nodes, integrated, sight)


@inner
def _find_reach(nodes, integrated, sight):
    reach = 0.0
    peak = 0.0
    for m in range(nodes.shape[0]):
        total = 0.0
        for k in range(nodes.shape[1]):
            reach = max(reach, _gaussian_reach(nodes[m, k]))
            total += abs(nodes[m, k, 0])
        peak = max(peak, total)
    if integrated is not None and integrated:
        reach += _PIXEL
        peak = min(peak, 1.0)
    sight[0] = reach
    sight[1] = _FAINT * peak


@inner
def _is_near(x, y, box, reach):
    """Return whether a star is within reach of the pixels of a box."""
    row, column, height, width = box
    dx = max(column - x, x - (column + width - 1), 0.0)
    dy = max(row - y, y - (row + height - 1), 0.0)
    return not dx * dx + dy * dy > reach * reach


# The equations.

@apart
def _add_star(flux, profile, model):
    """Add a star to a model; return the sum of squares of its profile."""
    squares = 0.0
    for i in range(model.size):
        g = profile[i]
        model[i] += flux * g
        squares += g * g
    return squares


@inner
def _model_stars(parameters, n, own, box, psf, scratch, residual):
    """
    Put the sum of the stars in the box of the star own into residual.

    Lists the stars, ascending, in scratch, and returns their number.
    """
    count = 0
    for i in range(residual.size):
        residual[i] = 0.0
    for s in range(n):
        x, y = parameters[3 * s + 1], parameters[3 * s + 2]
        if s != own and not _is_near(x, y, box, scratch.sight[0]):
            continue
        # Not a slice of it: the compiler would not know that pixels are
        # next to each other.
        derivatives = scratch.derivatives[count]
        fill_derivatives(x, y, box, psf, scratch.tiling, derivatives)
        seen = _add_star(parameters[3 * s], derivatives[0], residual)
        if seen > _UNSEEN * _UNSEEN:
            faint = scratch.sight[1]
            scratch.near[count] = s
            scratch.joined[count] = s == own or seen > faint * faint
            count += 1
    return count


@inner
def _add_sky_row(parameters, scratch, count, sky, weight, residual, new):
    """Add what joins the sky level and the stars in one box."""
    row = new.matrix[sky]
    for i in range(count):
        a = 3 * scratch.near[i]
        _add_sky(scratch.derivatives, i, parameters[a], weight, a, row)
    for i in range(weight.size):
        row[sky] += weight[i]
        new.gradient[sky] += weight[i] * residual[i]


@inner
def _add_equations(parameters, scratch, count, weight, residual, new):
    """Add what the stars in one box contribute to the normal equations."""
    lowest = -1
    for i in range(count):
        a = 3 * scratch.near[i]
        flux = parameters[a]
        _add_own(scratch.derivatives, i, flux, weight, residual, a,
                 new.gradient, new.matrix)
        if not scratch.joined[i]:
            continue
        if lowest < 0:
            lowest = a
        for k in range(a, a + 3):
            new.first[k] = min(new.first[k], lowest)
        for j in range(i):
            if scratch.joined[j]:
                b = 3 * scratch.near[j]
                _add_block(scratch.derivatives, i, flux, j, parameters[b],
                           weight, a, b, new.matrix)


@inner
def _clear(equations, n, size):
    """Empty the equations of n stars."""
    for a in range(size):
        equations.gradient[a] = 0.0
        equations.first[a] = a - a % 3 if a < 3 * n else 0
        row = equations.matrix[a]
        # To the end of the block on the diagonal.
        for b in range(min(a - a % 3 + 3, size)):
            row[b] = 0.0


@inner
def normal_equations(parameters, n, fit_sky, pixels, psf, scratch, old, new,
                     chi2):
    """
    Evaluate a group of n stars.

    old and new are the equations at the last point and at this one; chi2 (2,)
    gets the sums of squares with the weights of either.
    """
    size = 3 * n + fit_sky
    _clear(new, n, size)
    chi2[0] = chi2[1] = 0.0
    sky = parameters[3 * n] if fit_sky else 0.0
    for c in range(n):
        if scratch.stop[0]:
            return
        used = pixels.boxes[c, 2] * pixels.boxes[c, 3]
        residual, weight = new.residuals[c, :used], new.weights[c, :used]
        count = _model_stars(parameters, n, c, pixels.boxes[c], psf, scratch,
                             residual)
        _weigh(pixels.data[c, :used], pixels.weights[c, :used], sky,
               pixels.gain, old.weights[c, :used], residual, weight, chi2)
        _add_equations(parameters, scratch, count, weight, residual, new)
        if fit_sky:
            _add_sky_row(parameters, scratch, count, 3 * n, weight, residual,
                         new)


# Single stars.

@apart
def _model_ahead(data, sky, step, flux, derivatives, residual):
    """Turn residuals into the model of the star after a step (3,)."""
    by_flux, by_x, by_y = step[0], flux * step[1], flux * step[2]
    for k in range(residual.size):
        residual[k] = data[k] - sky - residual[k] + (
            by_flux * derivatives[0, k] + by_x * derivatives[1, k]
            + by_y * derivatives[2, k])


@inner
def step_ahead(parameters, step, fit_sky, pixels, scratch, equations, chi2):
    """
    Find residuals and weights after a small step of a single star.

    The derivatives in scratch must be those at parameters; chi2 is as of
    `normal_equations`. The matrix stays as it is.
    """
    used = pixels.boxes[0, 2] * pixels.boxes[0, 3]
    data, weight = pixels.data[0, :used], equations.weights[0, :used]
    residual = equations.residuals[0, :used]
    sky = parameters[3] if fit_sky else 0.0
    _model_ahead(data, sky, step, parameters[0], scratch.derivatives[0],
                 residual)
    if fit_sky:
        sky += step[3]
    chi2[0] = chi2[1] = 0.0
    _weigh(data, pixels.weights[0, :used], sky, pixels.gain, weight, residual,
           weight, chi2)


@kernel
def star_derivatives(x_0, y_0, box, psf, tiling, out):
    """Put the unit-flux PSF in a box, d/dx_0 and d/dy_0 into out (3, n)."""
    fill_derivatives(x_0, y_0, box, psf, tiling, out)
