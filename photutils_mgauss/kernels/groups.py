"""What the pixels of one image know about groups of stars: their moments."""
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.star_normal import (
    Pixels,
    find_reach,
    gather,
    normal_equations,
)
from photutils_mgauss.kernels.tile import fill_derivatives

# The light of a group is a sum of basis images: of each of its m stars the PSF
# of flux 1 and its derivatives by x and y, and last, where it is asked for, a
# constant. Their weighted products with one another and with the data say all
# about the group that chi2 needs, whatever the fluxes are.


class GroupMoments(NamedTuple):
    """
    Moments of g groups, each of k basis images.

    Products of the basis images (g, k, k), of these with the data (g, k), of
    the data with themselves (g,), and the number of pixels (g,), -1 where an
    error is not positive and finite.
    """

    products: np.ndarray
    data: np.ndarray
    squares: np.ndarray
    n_pixels: np.ndarray


@inner
def _leave_repeats(boxes, c, weight):
    """
    Leave the pixels of box c out that an earlier box has, too.

    Returns the number of pixels left out that had a weight.
    """
    row, column, height, width = boxes[c]
    n = 0
    for e in range(c):
        top, left = boxes[e, 0], boxes[e, 1]
        bottom, right = top + boxes[e, 2], left + boxes[e, 3]
        for i in range(width):
            for j in range(height):
                k = i * height + j
                y, x = row + j, column + i
                if (top <= y < bottom and left <= x < right
                        and weight[k] > 0):
                    weight[k] = 0.0
                    n += 1
    return n


@inner
def _load(image, boxes, data, weights):
    """Fetch the pixels of a group, each once; return how many there are."""
    total = 0
    for c in range(boxes.shape[0]):
        n = gather(image, boxes[c], 0.0, data[c], weights[c])
        if n < 0:
            return -1
        total += n - _leave_repeats(boxes, c, weights[c])
    return total


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
def _put(equations, pixels, m, size, g, out):
    """Put the moments of group g, from equations at fluxes of 1."""
    for a in range(size):
        for b in range(a + 1):
            out.products[g, a, b] = equations.matrix[a, b]
            out.products[g, b, a] = equations.matrix[a, b]
    for a in range(size):
        total = equations.gradient[a]
        for s in range(m):
            total += out.products[g, a, 3 * s]
        out.data[g, a] = total
    squares = 0.0
    for c in range(m):
        for k in range(pixels.boxes[c, 2] * pixels.boxes[c, 3]):
            squares += equations.weights[c, k] * pixels.data[c, k] ** 2
    out.squares[g] = squares


@inner
def _blank(g, out):
    """Give group g the moments of no pixels."""
    for a in range(out.data.shape[1]):
        out.data[g, a] = 0.0
        for b in range(out.data.shape[1]):
            out.products[g, a, b] = 0.0
    out.squares[g] = 0.0


@kernel
def group_moments(image, boxes, places, own, psf, parameters, scratch, out):
    """
    Find the moments of g groups of m stars.

    Pixels are those of the boxes (g, m, 4); the PSFs are at places (g, m, 2).
    own (g, m, 3), or (0, m, 3) for none, is light (flux, x, y) to add to the
    image, from which stars have been subtracted. A sky is there if out has
    room for it. Worked on are parameters (3 m + 1,), all 0, and a BoxScratch.
    """
    m, size = boxes.shape[1], out.data.shape[1]
    data, weights, new, around, chi2 = scratch
    if m > 1:  # a single star is always looked at
        find_reach(psf, around.sight)
    for g in range(boxes.shape[0]):
        n_pixels = _load(image, boxes[g], data, weights)
        out.n_pixels[g] = n_pixels
        if n_pixels <= 0:
            _blank(g, out)
            continue
        if own.shape[0]:
            _add_own(boxes[g], own[g], psf, around, data)
        for s in range(m):
            parameters[3 * s] = 1.0
            parameters[3 * s + 1] = places[g, s, 0]
            parameters[3 * s + 2] = places[g, s, 1]
        pixels = Pixels(boxes[g], data, weights, 0.0)
        normal_equations(parameters, m, size > 3 * m, pixels, psf, around,
                         new, new, chi2)
        _put(new, pixels, m, size, g, out)
