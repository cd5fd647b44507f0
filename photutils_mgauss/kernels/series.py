r"""
A Gaussian integrated over the pixels of a tile, as a sum of products.

A correlated Gaussian is a series in Hermite functions :math:`\psi_n` of x and
of y (Mehler's formula): with :math:`c^2 = 1 - \rho^2`,
:math:`\lambda = \rho / (1 + c)`, :math:`u = x / (\sigma_x \sqrt c)` and
:math:`v = y / (\sigma_y \sqrt c)`,

.. math::

    \exp\left[-\frac{p\,(x - s y)^2 + q\,y^2}{2}\right] =
    \sqrt{\pi (1 - \lambda^2)} \sum_n \lambda^n \psi_n(u)\, \psi_n(v) .

So its integrals over pixels are sums of products of integrals along the rows
and along the columns of a tile, and so are their derivatives by the position.
Recurrences give all of them from one error function for each edge,

.. math::

    \psi_{n + 1} = \sqrt{\tfrac{2}{n + 1}}\, u\, \psi_n
    - \sqrt{\tfrac{n}{n + 1}}\, \psi_{n - 1} , \quad
    I_{n + 1} = \sqrt{\tfrac{n}{n + 1}}\, I_{n - 1}
    - \sqrt{\tfrac{2}{n + 1}} \left[\psi_n\right] ,

the brackets being differences between the edges of a pixel. As
:math:`|\psi_n| < \pi^{-1/4}`, what is left of the series after N terms is
below :math:`\lambda^N \sqrt{(1 + \lambda) / (1 - \lambda)}` of the peak: that
decides on N, and whether the series is short enough to be used.
"""
from math import ceil, floor, log, sqrt

import numpy as np

from photutils_mgauss.kernels.gaussian import erfc_over_exp, fast_exp
from photutils_mgauss.kernels.jit import inner, loop, sums

# Rows of a tile. Edges are as many, or twice as many, for the compiler works
# on several at once in loops of just this length.
LANES = 16

# What may be left out of a Gaussian, as a share of the peak of the PSF. Fits
# of stars answer with ten times as much at most, in pixels or of the flux.
LEFT_OUT = 3e-8

# Terms of the longest series, and the number that are added at once.
_MOST_TERMS = 64
_AT_ONCE = 4

# Along either axis a term is three runs of numbers, one for each edge or
# pixel: the Hermite function, its integral, and that of its slope.
_RUN = 2 * LANES
_TERM = 3 * _RUN
_AXIS = _TERM * (_MOST_TERMS + 2)
# The numbers of which `add_series` makes use: edges, rows and columns.
SERIES = _RUN + 2 * _AXIS

_UP = np.sqrt(2 / np.arange(1, _MOST_TERMS + 1))
_BACK = np.sqrt(np.arange(_MOST_TERMS) / np.arange(1, _MOST_TERMS + 1))
# Of a smaller lambda the first term is all.
_NO_TILT = 1e-9
_TWO_PI = 2 * np.pi
_ROOT_HALF = sqrt(0.5)
_HEIGHT = np.pi**-0.25
_AREA = np.pi**0.25 * _ROOT_HALF


@inner
def pixel_peak(a, p, q):
    """Return what is in no pixel more than this, for a Gaussian of peak a."""
    return abs(a) * min(1.0, _TWO_PI / sqrt(p * q))


@inner
def series_length(p, s, q, log_left_out):
    """
    Return lambda and how many terms its series has, whole groups of them.

    0 if there would be too many. log_left_out is the logarithm of what may be
    left out, as a share of the Gaussian.
    """
    tilt = s * s * p / q
    c = 1 / sqrt(1 + tilt)
    size = sqrt(tilt) * c / (1 + c)
    if size < _NO_TILT:
        return 0.0, _AT_ONCE
    # Also 0 where p or q are too large for what follows of them.
    if not size < 1:
        return 0.0, 0
    terms = max(1, ceil((log_left_out + 0.5 * log((1 - size) / (1 + size)))
                        / log(size)))
    terms += -terms % _AT_ONCE
    return size if s > 0 else -size, terms if terms <= _MOST_TERMS else 0


@inner
def _window(first, n, half):
    """Return which of n pixels, the first at first, are within half of 0."""
    low = min(max(ceil(-half - 0.5 - first), 0.0), float(n))
    high = min(max(floor(half + 0.5 - first) + 1, 0.0), float(n))
    return int(low), int(high)


@loop
def _begin(first, size, scale, n_lanes, edges, axis):
    """Put places of edges into edges, and the first term into axis."""
    area = scale * size * _AREA
    for lane in range(n_lanes):
        u, value, integral = (edges[lane * LANES:], axis[lane * LANES:],
                              axis[_RUN + lane * LANES:])
        step = 1 / size
        start = (first + lane * LANES) * step
        for j in range(LANES):
            x = start + step * j
            height = fast_exp(-0.5 * x * x)
            beyond = height * erfc_over_exp(_ROOT_HALF * abs(x))
            u[j] = x
            value[j] = scale * _HEIGHT * height
            integral[j] = area * (1 - beyond if x > 0 else beyond - 1)
    integral = axis[_RUN:]
    for j in range(n_lanes * LANES - 1):
        integral[j] = integral[j + 1] - integral[j]


@loop
def _lay_terms(terms, ratio, size, by, n_lanes, edges, axis):
    """
    Put terms into axis, of which there is one that stands for none before.

    Each is ratio times what it would be. size is the unit of Hermite
    functions, by the slope of the share of the Gaussian in a blend.
    """
    for term in range(terms):
        up, back = ratio * _UP[term], ratio * ratio * _BACK[term]
        up_size = up * size
        for lane in range(n_lanes):
            u = edges[lane * LANES:]
            now = axis[term * _TERM + lane * LANES:]
            for j in range(LANES):
                here = now[_TERM + j]
                step = now[_TERM + j + 1] - here
                now[2 * _TERM + j] = up * u[j] * here - back * now[j]
                now[2 * _TERM + _RUN + j] = (back * now[_RUN + j]
                                             - up_size * step)
                now[_TERM + 2 * _RUN + j] = by * now[_TERM + _RUN + j] - step


@sums
def _add_products(terms, n_columns, columns, rows, tile):
    """Add products of the factors along both axes to a tile, four at once."""
    for i in range(n_columns):
        out = tile[3 * LANES * i:]
        for group in range(terms // _AT_ONCE):
            start = (group * _AT_ONCE + 1) * _TERM + _RUN
            x, y = columns[start + i:], rows[start:]
            v0, v1, v2, v3 = x[0], x[_TERM], x[2 * _TERM], x[3 * _TERM]
            x = x[_RUN:]
            s0, s1, s2, s3 = x[0], x[_TERM], x[2 * _TERM], x[3 * _TERM]
            for j in range(LANES):
                y0, y1 = y[j], y[_TERM + j]
                y2, y3 = y[2 * _TERM + j], y[3 * _TERM + j]
                out[j] += v0 * y0 + v1 * y1 + v2 * y2 + v3 * y3
                out[LANES + j] += s0 * y0 + s1 * y1 + s2 * y2 + s3 * y3
                out[2 * LANES + j] += (
                    v0 * y[_RUN + j] + v1 * y[_RUN + _TERM + j]
                    + v2 * y[_RUN + 2 * _TERM + j]
                    + v3 * y[_RUN + 3 * _TERM + j])


@inner
def add_series(a, dx, dy, p, s, q, ratio, terms, reach, by_x, by_y, height,
               width, work, tile):
    """
    Add a Gaussian integrated over pixels, and its slopes, to a tile.

    Its first pixel is at (dx, dy) from the peak a, which changes by the
    shares by_x and by_y; ratio and terms are as of `series_length`, reach is
    how far there is anything [standard deviations], and tile as of
    `tile.add_gaussian`. work (SERIES,) is scratch.
    """
    root = (1 + s * s * p / q) ** 0.25
    x_size, y_size = root / sqrt(p), 1 / (root * sqrt(q))
    left, right = _window(dx, width, reach * x_size * root)
    low, high = _window(dy, height, reach / sqrt(q))
    if left == right or low == high:
        return
    edges, rows, columns = work[:_RUN], work[_RUN:_RUN + _AXIS], work[_RUN
                                                                  + _AXIS:]
    # Of 16 edges there are 15 pixels.
    n = 1 + height // LANES
    _begin(dy - 0.5, y_size, a * sqrt(np.pi * (1 - ratio * ratio)), n, edges,
           rows[_TERM:])
    _lay_terms(terms, ratio, y_size, by_y, n, edges, rows)
    for first in range(left, right, LANES - 1):
        _begin(dx + first - 0.5, x_size, 1.0, 1, edges, columns[_TERM:])
        _lay_terms(terms, 1.0, x_size, by_x, 1, edges, columns)
        _add_products(terms, min(LANES - 1, right - first), columns, rows,
                      tile[3 * LANES * first:])
