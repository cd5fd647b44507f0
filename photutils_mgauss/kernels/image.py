"""Whole images of many stars."""
from math import ceil, exp, factorial, floor, log, sqrt

import numpy as np

from photutils_mgauss.kernels.grid import blend_weights, match_rows
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.rows import add_integrated_row

# Many stars on one image. A Gaussian is drawn where it exceeds ``faintest``,
# which the caller chooses so low that nobody sees the edge, and anyway down
# to this fraction of its peak. Nothing is fitted with these functions, so
# the step at the edge does no harm.
DEPTH = 1e-3


def _quadrature_tables(most=8):
    """
    Return nodes and weights (most + 1, most) of 0 to 8 points, and errors.

    On a unit interval n points miss a Gaussian of unit peak and precision P
    by less than errors[n] P^n, (n!)^4 (2n - 1)!! / ((2n + 1) (2n)!^3).
    """
    nodes = np.zeros((most + 1, most))
    weights = np.zeros((most + 1, most))
    errors = np.zeros(most + 1)
    for n in range(1, most + 1):
        places, shares = np.polynomial.legendre.leggauss(n)
        nodes[n, :n], weights[n, :n] = places / 2, shares / 2
        twice = float(factorial(2 * n))
        odd = twice / (2**n * factorial(n))
        errors[n] = factorial(n)**4 * odd / ((2 * n + 1) * twice**3)
    return nodes, weights, errors


_POINTS, _SHARES, ERRORS = _quadrature_tables()

# What integrating by points may miss, in units of the brightest Gaussian of
# the star. The error is even about the star, so that it moves nothing.
_QUADRATURE_ERROR = 1e-5


@inner
def _quadrature_order(precision, tolerance):
    """Return the number of points that suffice, or 0 if none does."""
    power = 1.0
    for n in range(1, ERRORS.size):
        power *= precision
        if ERRORS[n] * power <= tolerance:
            return n
    return 0


@inner
def _walk(peak, right, left, fall, start, first, last, row):
    """
    Add a row Gaussian to row[first:last + 1], from its value at start.

    right and left are the first quotients of neighbours, fall their change.
    """
    row[start] += peak
    g = peak
    for i in range(start + 1, last + 1):
        g *= right
        right *= fall
        row[i] += g
    g = peak
    for i in range(start - 1, first - 1, -1):
        g *= left
        left *= fall
        row[i] += g


@inner
def _span(centre, half, nx):
    """Return first and last of nx pixels near a centre, and the nearest."""
    first = max(0, ceil(centre - half))
    last = min(nx - 1, floor(centre + half))
    return first, last, min(max(int(np.rint(centre)), first), last)


@inner
def add_sampled(peak, cx, cy, p, s, q, reach, out):
    """Add a Gaussian, sampled at pixel centres, to out (ny, nx)."""
    half = sqrt(reach / q)
    fall = exp(-p)
    low, high = max(0, ceil(cy - half)), min(out.shape[0] - 1, cy + half)
    for j in range(low, floor(high) + 1):
        dy = j - cy
        centre = cx + s * dy
        width = sqrt(max(0.0, reach - q * dy * dy) / p)
        first, last, start = _span(centre, width, out.shape[1])
        if first > last:
            continue
        u = start - centre
        _walk(peak * exp(-0.5 * (p * u * u + q * dy * dy)),
              exp(-p * (u + 0.5)), exp(-p * (0.5 - u)), fall, start, first,
              last, out[j])


@inner
def _prepare_points(n, p, scratch):
    """
    Put what the points along x share into scratch (3, n).

    A point at the fraction t of a pixel has the value of the pixel's centre
    at u times exp(-p u t) and the first row; the quotients to its neighbours
    are those of u times the second and third.
    """
    for a in range(n):
        t = _POINTS[n, a]
        scratch[0, a] = _SHARES[n, a] * exp(-0.5 * p * t * t)
        scratch[1, a] = exp(-p * (0.5 + t))
        scratch[2, a] = exp(-p * (0.5 - t))


@inner
def _add_integrated(peak, cx, cy, p, s, q, reach, tolerance, scratch, out):
    """Add a Gaussian, integrated over each pixel, to out (ny, nx)."""
    n_x = _quadrature_order(p, tolerance)
    n_y = _quadrature_order(q + s * s * p, tolerance)
    if n_x * n_y == 0:
        _add_thin(peak, cx, cy, p, s, q, reach, out)
        return
    _prepare_points(n_x, p, scratch)
    half = sqrt(reach / q) + 0.5
    fall = exp(-p)
    low, high = max(0, ceil(cy - half)), min(out.shape[0] - 1, cy + half)
    for j in range(low, floor(high) + 1):
        for b in range(n_y):
            dy = j - cy + _POINTS[n_y, b]
            centre = cx + s * dy
            width = sqrt(max(0.0, reach - q * dy * dy) / p) + 0.5
            first, last, start = _span(centre, width, out.shape[1])
            if first > last:
                continue
            u = start - centre
            ridge = (peak * _SHARES[n_y, b]
                     * exp(-0.5 * (p * u * u + q * dy * dy)))
            slope = exp(-p * u)
            for a in range(n_x):
                _walk(ridge * exp(-p * u * _POINTS[n_x, a]) * scratch[0, a],
                      slope * scratch[1, a], scratch[2, a] / slope, fall,
                      start, first, last, out[j])


@inner
def _add_thin(peak, cx, cy, p, s, q, reach, out):
    """Add a Gaussian much thinner than a pixel, integrated over each."""
    half_y = sqrt(reach / q) + 0.5
    half_x = sqrt(reach * (1 / p + s * s / q)) + 0.5
    first = max(0, ceil(cx - half_x))
    last = min(out.shape[1] - 1, floor(cx + half_x))
    low, high = max(0, ceil(cy - half_y)), min(out.shape[0] - 1, cy + half_y)
    if first > last:
        return
    for j in range(low, floor(high) + 1):
        add_integrated_row(peak, first - cx, j - cy, p, s, q,
                           out[j, first:last + 1])


@inner
def add_star(rows, flux, cx, cy, integrated, faintest, scratch, out):
    """Add a star at (cx, cy) of out; rows is (K, 6), scratch (3, 9)."""
    highest = 0.0
    for k in range(rows.shape[0]):
        highest = max(highest, abs(rows[k, 0]))
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        peak = flux * a
        if peak == 0:
            continue
        reach = 2 * log(max(abs(peak) / faintest, 1 / DEPTH))
        if integrated is not None and integrated:
            _add_integrated(peak, cx + mx, cy + my, p, s, q, reach,
                            _QUADRATURE_ERROR * highest / abs(a), scratch,
                            out)
        else:
            add_sampled(peak, cx + mx, cy + my, p, s, q, reach, out)


@kernel(allocates=True)
def render_image(x, y, flux, nodes, x_grid, y_grid, integrated, faintest,
                 left, bottom, out):
    """
    Add stars (n,) in the order given to out.

    The first pixel of out is the detector's (left, bottom). The order of the
    stars alone decides about rounding: a band of rows has the pixels it would
    have in the whole image.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    scratch = np.empty((3, ERRORS.size))
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            add_star(nodes[index[corner]], weights[0, corner] * flux[i],
                     x[i] - left, y[i] - bottom, integrated, faintest,
                     scratch, out)


@kernel(allocates=True)
def render_matched_image(x, y, flux, sums, x_grid, y_grid, integrated,
                         faintest, left, bottom, out):
    """Add stars as `render_image` does, with matched Gaussians blended."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, *sums.shape[1:]))
    scratch = np.empty((3, ERRORS.size))
    for i in range(x.size):
        match_rows(x[i], y[i], sums, x_grid, y_grid, rows, slopes)
        add_star(rows, flux[i], x[i] - left, y[i] - bottom, integrated,
                 faintest, scratch, out)


@kernel(allocates=True)
def bleed(columns, full_well):
    """
    Spread the charge above the full well along each column (n, ny), in place.

    Half of the excess of a pixel goes each way, into the nearest pixels with
    room; what reaches an end is lost.
    """
    ny = columns.shape[1]
    excess = np.empty(ny)
    for column in columns:
        for j in range(ny):
            excess[j] = 0.5 * max(0.0, column[j] - full_well)
            column[j] = min(column[j], full_well)
        for way in range(2):
            carried = 0.0
            for step in range(ny):
                j = step if way == 0 else ny - 1 - step
                carried += excess[j]
                room = full_well - column[j]
                if carried >= room:
                    carried -= room
                    column[j] = full_well
                else:
                    column[j] += carried
                    carried = 0.0


@inner
def _spline_taps(t, taps):
    """Put the cubic B-spline at 1 + t, t, 1 - t and 2 - t into taps (4,)."""
    taps[0] = (1 - t) ** 3 / 6
    taps[1] = (4 + t * t * (3 * t - 6)) / 6
    taps[3] = t ** 3 / 6
    taps[2] = 1 - taps[0] - taps[1] - taps[3]


@inner
def _add_epsf(image, share, x, y, reach, oversampling, wx, wy, out):
    """Add a star at (x, y) of out, from the spline of an ePSF image."""
    low_y = max(0, ceil(y - reach))
    high_y = min(out.shape[0] - 1, floor(y + reach))
    low_x = max(0, ceil(x - reach))
    high_x = min(out.shape[1] - 1, floor(x + reach))
    # All pixels of a star fall on the same fraction of the fine lattice.
    step = int(oversampling)
    v = (low_y - y) * oversampling + 0.5 * (image.shape[0] - 1)
    u = (low_x - x) * oversampling + 0.5 * (image.shape[1] - 1)
    row, column = int(floor(v)), int(floor(u))
    _spline_taps(v - row, wy)
    _spline_taps(u - column, wx)
    for j in range(low_y, high_y + 1):
        m = row - 1 + (j - low_y) * step
        for i in range(low_x, high_x + 1):
            n = column - 1 + (i - low_x) * step
            total = 0.0
            for b in range(4):
                line = (wx[0] * image[m + b, n] + wx[1] * image[m + b, n + 1]
                        + wx[2] * image[m + b, n + 2]
                        + wx[3] * image[m + b, n + 3])
                total += wy[b] * line
            out[j, i] += share * total


@kernel(allocates=True)
def render_epsfs(x, y, flux, reach, images, x_grid, y_grid, oversampling,
                 left, bottom, out):
    """
    Add stars (n,) made of ePSF images to out, in the order given.

    images (M, ny, nx) are coefficients of cubic splines, ordered as nodes of
    `render_image` are; reach (n,) is half the side of the square a star
    fills [pix], at least one pixel less than that of the images.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    wx = np.empty(4)
    wy = np.empty(4)
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            share = weights[0, corner] * flux[i]
            if share != 0:
                _add_epsf(images[index[corner]], share, x[i] - left,
                          y[i] - bottom, reach[i], oversampling, wx, wy, out)
