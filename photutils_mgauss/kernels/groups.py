"""What the pixels of one image know about groups of stars: their moments."""
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.jit import apart, inner, kernel
from photutils_mgauss.kernels.star_normal import (
    Pixels,
    find_reach,
    normal_equations,
)
from photutils_mgauss.kernels.tile import fill_derivatives

# The light of a group is a sum of basis images: of each of its m stars the PSF
# of flux 1 and its derivatives by x and y, and last, where it is asked for, a
# constant. Their weighted products with one another and with the data say all
# about the group that chi2 needs, whatever the fluxes are.


class GroupPixels(NamedTuple):
    """
    The pixels of g groups of m boxes, in one image.

    boxes (g, m, 4), their data and weights (g, m, area), column after column;
    the sums of weighted squares of the data and the numbers of pixels that
    count (g,), which `weigh_groups` finds.
    """

    boxes: np.ndarray
    data: np.ndarray
    weights: np.ndarray
    squares: np.ndarray
    n_pixels: np.ndarray


class GroupMoments(NamedTuple):
    """
    Moments of g groups in e images, of k = 3 m basis images, less the sky.

    Products of the basis images (g, e, k, k), of these with the data
    (g, e, k), of the data with themselves (g, e), and the numbers of pixels
    (g, e). sky (g, e, 2 + k) has the weight of a constant, its product with
    the data and with the basis images; it is 0 without one.
    """

    products: np.ndarray
    data: np.ndarray
    squares: np.ndarray
    n_pixels: np.ndarray
    sky: np.ndarray


@inner
def _leave_repeats(boxes, c, weight):
    """Leave the pixels of box c out that an earlier box has, too."""
    row, column, height, width = boxes[c]
    for e in range(c):
        top, left = boxes[e, 0], boxes[e, 1]
        bottom, right = top + boxes[e, 2], left + boxes[e, 3]
        for i in range(width):
            for j in range(height):
                y, x = row + j, column + i
                if top <= y < bottom and left <= x < right:
                    weight[i * height + j] = 0.0


@inner
def _add_own(boxes, own, psf, scratch, data):
    """Add light of stars (m, 3: flux, x, y) that the image is without."""
    for c in range(boxes.shape[0]):
        area = boxes[c, 2] * boxes[c, 3]
        derivatives = scratch.derivatives[0]
        for s in range(own.shape[0]):
            if own[s, 0] == 0.0:
                continue
            fill_derivatives(own[s, 1], own[s, 2], boxes[c], psf,
                             scratch.tiling, derivatives)
            for k in range(area):
                data[c, k] += own[s, 0] * derivatives[0, k]


@inner
def _weigh_box(data, weights, light, unit):
    """Scale the pixels of a box and weigh them."""
    for k in range(data.size):
        if not (abs(data[k]) < np.inf and 0 < weights[k] < np.inf):
            data[k] = 0.0
            weights[k] = 0.0
            continue
        data[k] /= unit
        if light.size:
            data[k] -= light[k]
        weights[k] = (unit / weights[k]) ** 2


@kernel
def weigh_groups(pixels, light, unit, own, psf, scratch):
    """
    Turn pixels as they are in an image into those of a fit.

    The data of pixels are in the unit of the image, infinite or NaN where
    they do not count, and the weights are errors, positive and finite where
    they count. Both are put into a unit of light that is 1 there. light (g,
    m, area), or (0, 0, 0) for none, is what is to be subtracted then, and own
    (g, m, 3), or (0, m, 3), light of stars (flux, x, y) to add. Pixels that
    boxes of a group share count once. scratch is a Scratch.
    """
    nothing = light[:0, 0, 0]
    for g in range(pixels.boxes.shape[0]):
        boxes = pixels.boxes[g]
        squares = 0.0
        n = 0
        for c in range(boxes.shape[0]):
            used = boxes[c, 2] * boxes[c, 3]
            _weigh_box(
                pixels.data[g, c, :used], pixels.weights[g, c, :used],
                light[g, c, :used] if light.size else nothing, unit)
        if own.shape[0]:
            _add_own(boxes, own[g], psf, scratch, pixels.data[g])
        for c in range(boxes.shape[0]):
            data, weights = pixels.data[g, c], pixels.weights[g, c]
            _leave_repeats(boxes, c, weights)
            for k in range(boxes[c, 2] * boxes[c, 3]):
                squares += weights[k] * data[k] ** 2
                n += weights[k] > 0
        pixels.squares[g] = squares
        pixels.n_pixels[g] = n


@inner
def _put_sky(equations, m, products, data, sky):
    """Eliminate the sky; return what the data lose of their squares."""
    size = 3 * m
    row = equations.matrix[size]
    weight, light = row[size], equations.gradient[size]
    for s in range(m):
        light += row[3 * s]
    sky[0], sky[1] = weight, light
    if not weight > 0:
        return 0.0
    for a in range(size):
        sky[2 + a] = row[a]
        share = row[a] / weight
        data[a] -= share * light
        for b in range(size):
            products[a, b] -= share * row[b]
    return light * light / weight


@inner
def _put(equations, m, products, data):
    """Put the moments of a group, from equations at fluxes of 1."""
    matrix = equations.matrix
    for a in range(3 * m):
        for b in range(a + 1):
            products[a, b] = matrix[a, b]
            products[b, a] = matrix[a, b]
        data[a] = equations.gradient[a]
    for a in range(3 * m):
        for s in range(m):
            data[a] += products[a, 3 * s]


@kernel
def group_moments(pixels, rows, places, psf, fit_sky, image, parameters,
                  scratch, out):
    """
    Find the moments of some groups of m stars in one image.

    The groups are those of the GroupPixels in rows (g,), the PSFs are at
    places (g, m, 2), and image is where in out, which is all 0, they go.
    Worked on are parameters (3 m + 1,), all 0, and a BoxScratch.
    """
    m = pixels.boxes.shape[1]
    _, _, new, around, chi2 = scratch
    if m > 1:  # a single star is always looked at
        find_reach(psf, around.sight)
    for g in range(rows.size):
        r = rows[g]
        out.n_pixels[g, image] = pixels.n_pixels[r]
        if pixels.n_pixels[r] == 0:
            continue
        for s in range(m):
            parameters[3 * s] = 1.0
            parameters[3 * s + 1] = places[g, s, 0]
            parameters[3 * s + 2] = places[g, s, 1]
        group = Pixels(pixels.boxes[r], pixels.data[r], pixels.weights[r],
                       0.0)
        normal_equations(parameters, m, fit_sky, group, psf, around, new, new,
                         chi2)
        products, data = out.products[g, image], out.data[g, image]
        _put(new, m, products, data)
        out.squares[g, image] = pixels.squares[r]
        if fit_sky:
            out.squares[g, image] -= _put_sky(new, m, products, data,
                                              out.sky[g, image])


@apart
def _add_score(profile, data, weights, fit_sky, light, weight, at):
    """Add products of a PSF with data and itself at one place of both."""
    own = 0.0
    seen = 0.0
    cross = 0.0
    sky = 0.0
    total = 0.0
    for k in range(weights.size):
        w = weights[k]
        own += w * profile[k] * profile[k]
        seen += w * profile[k] * data[k]
        cross += w * profile[k]
        sky += w * data[k]
        total += w
    if fit_sky and total > 0:
        own -= cross * cross / total
        seen -= cross * sky / total
    light[at] += seen
    weight[at] += own


@kernel
def star_scores(pixels, rows, places, psf, fit_sky, number, scratch, light,
                weight):
    """
    Add what `group_moments` finds of the PSF alone, for groups of one star.

    The products with the data and with itself go into column number of light
    and weight (g, c). scratch is a Scratch.
    """
    derivatives = scratch.derivatives[0]
    for g in range(rows.size):
        r = rows[g]
        if pixels.n_pixels[r] == 0:
            continue
        box = pixels.boxes[r, 0]
        used = box[2] * box[3]
        fill_derivatives(places[g, 0, 0], places[g, 0, 1], box, psf,
                         scratch.tiling, derivatives)
        _add_score(derivatives[0], pixels.data[r, 0, :used],
                   pixels.weights[r, 0, :used], fit_sky, light[g], weight[g],
                   number)
