"""Stars of a crowded image on stamps and on the image."""
from math import ceil, exp, floor, log, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.gaussian import fast_exp
from photutils_mgauss.kernels.image import ERRORS, add_sampled, add_star
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import clear
from photutils_mgauss.kernels.tile import (
    LANES,
    add_gaussian,
    faintest,
)


class Sources(NamedTuple):
    """Positions and fluxes of stars (n,)."""

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray


class Gaussians(NamedTuple):
    """
    The PSF of each of n stars, as Gaussians.

    Star i's are the first count[i] of rows[i] (n, K, 6); falls (n, K) is as of
    `psf.rows.falls`, integrated whether pixels are integrated over, None if
    not.
    """

    rows: np.ndarray
    falls: np.ndarray
    count: np.ndarray
    integrated: bool | None


class Stamps(NamedTuple):
    """
    The pixels on which stars are fitted.

    Star i has a square of width[i] pixels, odd, whose first pixel is (left,
    bottom)[i]; it may reach over the edges of the image. Its pixels lie in
    derivatives (3, total) from offset[i] on, row by row: the PSF of unit
    flux, and its derivatives by the star's x and y.
    """

    left: np.ndarray
    bottom: np.ndarray
    width: np.ndarray
    offset: np.ndarray
    derivatives: np.ndarray


class WingScratch(NamedTuple):
    """Columns of a Gaussian that is sampled, points of one integrated."""

    lanes: np.ndarray
    points: np.ndarray

    @classmethod
    def empty(cls, nx):
        """Return the memory for an image of rows of nx pixels."""
        return cls(np.empty((4, nx)), np.empty((3, ERRORS.size)))


@kernel
def star_stamps(chosen, sources, stamps, gaussians, tiling):
    """
    Fill the stamps of the chosen stars.

    tiling is the Tiling for the widest stamp.
    """
    x, y, _ = sources
    left, bottom, width, offset, derivatives = stamps
    rows, falls, count, integrated = gaussians
    walk, tile, _, _ = tiling
    for i in chosen:
        w = width[i]
        faint = faintest(rows[i, :count[i]], integrated)
        for first in range(0, w, LANES):
            height = min(LANES, w - first)
            clear(walk, 4 * LANES)
            clear(tile, 3 * LANES * w)
            for k in range(count[i]):
                a, mx, my, p, s, q = rows[i, k]
                add_gaussian(a, left[i] - x[i] - mx,
                             bottom[i] + first - y[i] - my, p, s, q,
                             falls[i, k], 0.0, 0.0, integrated, faint,
                             height, w, walk, tile)
            for j in range(height):
                to = offset[i] + (first + j) * w
                for k in range(w):
                    at = 3 * LANES * k + j
                    derivatives[0, to + k] = tile[at]
                    derivatives[1, to + k] = tile[at + LANES]
                    derivatives[2, to + k] = tile[at + 2 * LANES]


@kernel
def turn_stamps(chosen, stamps, slopes):
    """
    Make derivatives by other coordinates of those by x and y.

    slopes (n, 2, 2) are the derivatives of each star's x and y by them.
    """
    _, _, width, offset, derivatives = stamps
    for i in chosen:
        a, b = slopes[i, 0, 0], slopes[i, 0, 1]
        c, d = slopes[i, 1, 0], slopes[i, 1, 1]
        for at in range(offset[i], offset[i] + width[i] * width[i]):
            by_x, by_y = derivatives[1, at], derivatives[2, at]
            derivatives[1, at] = a * by_x + c * by_y
            derivatives[2, at] = b * by_x + d * by_y


@inner
def _walk_rows(start, end, way, fall, first, g, r, image):
    """Add g (n,) to rows start, start + way, ... end of image, r its fall."""
    for j in range(start, end + way, way):
        row = image[j]
        for i in range(g.size):
            row[first + i] += g[i]
            g[i] *= r[i]
            r[i] *= fall


@inner
def _add_lanes(peak, cx, cy, p, s, q, reach, lanes, image):
    """
    Add a Gaussian, sampled at pixel centres, to a box of the image.

    The box is that of the ellipse where the exponent is -reach / 2. Rows are
    walked outward from the peak, all columns of the box at once; lanes is
    (4, n), n at least the length of a row of the image.
    """
    ny, nx = image.shape
    half_x, half_y = sqrt(reach * (1 / p + s * s / q)), sqrt(reach / q)
    if p * abs(s) * half_x > 300:
        add_sampled(peak, cx, cy, p, s, q, reach, image)
        return
    first = max(0, int(ceil(cx - half_x)))
    n = min(nx - 1, int(floor(cx + half_x))) + 1 - first
    low = max(0, int(ceil(cy - half_y)))
    high = min(ny - 1, int(floor(cy + half_y)))
    if n <= 0 or low > high:
        return
    start = min(max(int(np.rint(cy)), low), high)
    dy = start - cy
    t = q + s * s * p
    fall = exp(-t)
    g, r, h, d = lanes[0, :n], lanes[1, :n], lanes[2, :n], lanes[3, :n]
    for i in range(n):
        u = first + i - cx - s * dy
        g[i] = peak * fast_exp(-0.5 * (p * u * u + q * dy * dy))
        slope = q * dy - p * s * u
        steep = fast_exp(-abs(slope))
        up = steep if slope > 0 else 1 / steep
        r[i] = up
        d[i] = 1 / up
    half = exp(-0.5 * t)
    for i in range(n):
        r[i] *= half
        d[i] *= half
        h[i] = g[i] * d[i]
        d[i] *= fall
    _walk_rows(start, high, 1, fall, first, g, r, image)
    _walk_rows(start - 1, low, -1, fall, first, h, d, image)


@inner
def add_wings(rows, flux, cx, cy, integrated, faintest, scratch, image):
    """Add a star, each Gaussian out to where it falls below faintest."""
    if integrated is not None and integrated:
        add_star(rows, flux, cx, cy, True, faintest, scratch.points, image)
        return
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        peak = flux * a
        ratio = abs(peak) / faintest
        if ratio > 1:
            _add_lanes(peak, cx + mx, cy + my, p, s, q, 2 * log(ratio),
                       scratch.lanes, image)


@inner
def _add_stamp(left, bottom, w, flux, profile, image):
    """Add a star of a profile (w * w,) to the image."""
    ny, nx = image.shape
    for j in range(max(0, -bottom), min(w, ny - bottom)):
        first = j * w - left
        for k in range(max(0, left), min(left + w, nx)):
            image[bottom + j, k] += flux * profile[first + k]


@kernel
def add_stars(chosen, sign, sources, stamps, wing, gaussians, faintest,
              scratch, image):
    """
    Add sign times the chosen stars to the image.

    A star whose wing (half a width, integer) reaches over its stamp is drawn
    afresh, each Gaussian out to where it falls below faintest; others are
    copied from it. scratch is a WingScratch.
    """
    ny, nx = image.shape
    x, y, fluxes = sources
    lefts, bottoms, widths, offset, derivatives = stamps
    rows, _, count, integrated = gaussians
    for i in chosen:
        left, bottom, w = lefts[i], bottoms[i], widths[i]
        flux = sign * fluxes[i]
        grow = wing[i] - w // 2
        if grow <= 0:
            _add_stamp(left, bottom, w, flux,
                       derivatives[0, offset[i]:], image)
            continue
        x_low, x_high = max(0, left - grow), min(nx, left + w + grow)
        y_low, y_high = max(0, bottom - grow), min(ny, bottom + w + grow)
        if x_low < x_high and y_low < y_high:
            add_wings(rows[i, :count[i]], flux,
                      x[i] - x_low, y[i] - y_low,
                      integrated, faintest, scratch,
                      image[y_low:y_high, x_low:x_high])
