"""One Gaussian at one point, and mixtures at many."""
from decimal import Decimal
from math import ceil, erf, exp, factorial, sqrt

import numpy as np
from scipy.special import erfcx

from photutils_mgauss.kernels.jit import (
    bits_of_float,
    float_of_bits,
    inner,
    kernel,
)

# Nodes and weights of 8-point Gauss-Legendre quadrature on (-1/2, 1/2);
# numpy.polynomial.legendre.leggauss(8), halved.
NODES = np.polynomial.legendre.leggauss(8)[0] / 2
NODE_WEIGHTS = np.polynomial.legendre.leggauss(8)[1] / 2

# Below this fraction of its peak a Gaussian is left out of a row: the numbers
# that follow are subnormal, a hundred times slower and 280 orders of
# magnitude below anything visible, so the cut makes no step in value or slope.
NOTHING = 1e-290
LOG_NOTHING = -2 * np.log(NOTHING)
HALF_PI_ROOT = sqrt(np.pi / 2)

# The exponential function, in a form that the compiler turns into vector
# instructions: four to five times as fast in a loop over pixels as the one of
# the C library, and as accurate.

# 1.5 * 2^52: adding it rounds to an integer, which then is in the low bits.
_ROUND = 1.5 * 2.0**52
_LOG2_E = 1 / np.log(2)

# log(2) in two parts; 32 bits times an exponent of 11 bits make no error.
_LOG2_HIGH = np.floor(np.log(2) * 2.0**32) / 2.0**32
_LOG2_LOW = float(Decimal(2).ln() - Decimal(_LOG2_HIGH))

# Taylor's series; |r| < log(2) / 2 leaves 4e-18 after 13 terms.
_TERMS = tuple(1 / factorial(n) for n in range(13, -1, -1))


@inner(fastmath={'contract'})
def fast_exp(x):
    """Return exp(x) for x <= 0, and 0 where that is below 1e-299."""
    shifted = x * _LOG2_E + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LOG2_HIGH) - n * _LOG2_LOW
    series = _TERMS[0]
    for term in _TERMS[1:]:
        series = series * r + term
    power = float_of_bits((bits_of_float(shifted) + 1023) << 52)
    return 0.0 if x < -688 else series * power


# erfc(x) exp(x^2) (1 + 2 x) for x >= 0 is a polynomial of (x - c) / (x + c):
# that of degree 20 leaves 4e-15. As with `fast_exp`, loops become vectors.
_ERF_MIDDLE = 3.75


def _scaled_erfc(t):
    x = _ERF_MIDDLE * (1 + t) / (1 - t)
    return (1 + 2 * x) * erfcx(x)


_ERF_TERMS = tuple(np.polynomial.chebyshev.cheb2poly(
    np.polynomial.chebyshev.chebinterpolate(_scaled_erfc, 20))[::-1])


@inner
def erfc_over_exp(x):
    """Return erfc(x) exp(x^2) for x >= 0."""
    below, factor = x + _ERF_MIDDLE, 1 + 2 * x
    inverse = 1 / (below * factor)
    t = (x - _ERF_MIDDLE) * factor * inverse
    # In two halves: the compiler does not unroll a longer loop.
    square = t * t
    even = _ERF_TERMS[0]
    for term in _ERF_TERMS[2::2]:
        even = even * square + term
    odd = _ERF_TERMS[1]
    for term in _ERF_TERMS[3::2]:
        odd = odd * square + term
    return (even + t * odd) * below * inverse


# One Gaussian at one point. (dx, dy) is the offset from the centre.

@inner
def _gaussian(dx, dy, p, s, q):
    """Return a Gaussian of unit peak."""
    u = dx - s * dy
    return exp(-0.5 * (p * u * u + q * dy * dy))


@inner
def _slice_integral(lower, upper, p):
    """Integrate exp(-p t^2 / 2) from lower to upper."""
    root = sqrt(0.5 * p)
    return HALF_PI_ROOT / sqrt(p) * (erf(root * upper) - erf(root * lower))


@inner
def pixel_panels(dy, p, s, q):
    """
    Return how a pixel at dy is divided along y for quadrature.

    The lower edge of the first panel, the height of all, and their number, 0
    where nothing is there. Beyond the Gaussian itself there are none, however
    small it is.
    """
    low, high = dy - 0.5, dy + 0.5
    far = max(-low, high)
    if q * far * far > LOG_NOTHING:
        reach = sqrt(LOG_NOTHING / q)
        low, high = max(low, -reach), min(high, reach)
        if not low < high:
            return low, 0.0, 0
    # At fixed x the Gaussian has the precision q + s^2 p along y. Eight
    # points over two standard deviations leave less than 1e-11 of the peak.
    n = max(1, ceil(0.5 * (high - low) * sqrt(q + s * s * p)))
    return low, (high - low) / n, n


@inner
def _pixel_integral(dx, dy, p, s, q):
    """Integrate a Gaussian of unit peak over the unit pixel at (dx, dy)."""
    low, height, n = pixel_panels(dy, p, s, q)
    total = 0.0
    for panel in range(n):
        middle = low + (panel + 0.5) * height
        for node in range(NODES.size):
            t = middle + NODES[node] * height
            shift = dx - s * t
            total += (NODE_WEIGHTS[node] * exp(-0.5 * q * t * t)
                      * _slice_integral(shift - 0.5, shift + 0.5, p))
    return total * height


@inner
def point_value(dx, dy, p, s, q, integrated):
    """Return a Gaussian of unit peak, or its integral over a pixel."""
    if integrated is not None and integrated:
        return _pixel_integral(dx, dy, p, s, q)
    return _gaussian(dx, dy, p, s, q)


@inner
def _edge(dx, dy, p, s, q):
    """
    Integrate g and dg/dx over y in dy +- 1/2 on the line x = dx.

    Both are closed forms: at fixed x, g is a Gaussian in y of mean m and
    precision r.
    """
    r = q + s * s * p
    m = s * p * dx / r
    low, high = dy - 0.5 - m, dy + 0.5 - m
    ridge = exp(-0.5 * (p * q / r) * dx * dx)
    value = ridge * _slice_integral(low, high, r)
    # Integral of (y - m) g.
    first = ridge * (exp(-0.5 * r * low * low)
                     - exp(-0.5 * r * high * high)) / r
    slope = -p * ((dx - s * m) * value - s * first)
    return value, slope


@inner
def point_gradient(dx, dy, p, s, q, integrated):
    """Return dg/dx and dg/dy, of the value or of the pixel integral."""
    if integrated is None or not integrated:
        g = _gaussian(dx, dy, p, s, q)
        a = p * (dx - s * dy)
        return -a * g, -(q * dy - s * a) * g
    # The derivative of an integral over a pixel is the difference between
    # its two sides.
    right, _ = _edge(dx + 0.5, dy, p, s, q)
    left, _ = _edge(dx - 0.5, dy, p, s, q)
    pt, st, qt = _transposed(p, s, q)
    top, _ = _edge(dy + 0.5, dx, pt, st, qt)
    bottom, _ = _edge(dy - 0.5, dx, pt, st, qt)
    return right - left, top - bottom


@inner
def _transposed(p, s, q):
    """Return the factors of the same Gaussian with x and y exchanged."""
    r = q + s * s * p
    return r, s * p / r, p * q / r


@inner
def point_hessian(dx, dy, p, s, q, integrated):
    """Return d2g/dx2, d2g/dxdy, d2g/dy2, of value or pixel integral."""
    if not integrated:
        g = _gaussian(dx, dy, p, s, q)
        a = p * (dx - s * dy)
        b = q * dy - s * a
        return ((a * a - p) * g, (a * b + s * p) * g,
                (b * b - q - s * s * p) * g)
    _, right = _edge(dx + 0.5, dy, p, s, q)
    _, left = _edge(dx - 0.5, dy, p, s, q)
    pt, st, qt = _transposed(p, s, q)
    _, top = _edge(dy + 0.5, dx, pt, st, qt)
    _, bottom = _edge(dy - 0.5, dx, pt, st, qt)
    corners = (_gaussian(dx + 0.5, dy + 0.5, p, s, q)
               - _gaussian(dx - 0.5, dy + 0.5, p, s, q)
               - _gaussian(dx + 0.5, dy - 0.5, p, s, q)
               + _gaussian(dx - 0.5, dy - 0.5, p, s, q))
    return right - left, corners, top - bottom


# Mixtures at arbitrary points. rows is (K, 6); x and y are (n,).

@inner
def add_values(x, y, x_0, y_0, row, scale, integrated, out):
    """Add a Gaussian, centred on (x_0, y_0) plus its mean, to out (n,)."""
    a, mx, my, p, s, q = row
    peak = scale * a
    left, bottom = x_0 + mx, y_0 + my
    if integrated:
        for i in range(x.size):
            out[i] += peak * _pixel_integral(x[i] - left, y[i] - bottom, p, s,
                                             q)
        return
    for i in range(x.size):
        dy = y[i] - bottom
        u = x[i] - left - s * dy
        out[i] += peak * fast_exp(-0.5 * (p * u * u + q * dy * dy))


@inner
def add_derivatives(x, y, x_0, y_0, row, scales, integrated, out):
    """
    Add value, slope by x_0 and slope by y_0 of a Gaussian to out (3, n).

    scales (3,) is what multiplies it, and the slopes of that.
    """
    a, mx, my, p, s, q = row
    value, by_x, by_y = a * scales[0], a * scales[1], a * scales[2]
    left, bottom = x_0 + mx, y_0 + my
    if integrated:
        for i in range(x.size):
            dx, dy = x[i] - left, y[i] - bottom
            g = _pixel_integral(dx, dy, p, s, q)
            gx, gy = point_gradient(dx, dy, p, s, q, True)
            out[0, i] += value * g
            out[1, i] += by_x * g - value * gx
            out[2, i] += by_y * g - value * gy
        return
    for i in range(x.size):
        dy = y[i] - bottom
        u = x[i] - left - s * dy
        g = fast_exp(-0.5 * (p * u * u + q * dy * dy))
        slope = p * u
        out[0, i] += value * g
        out[1, i] += (by_x + value * slope) * g
        out[2, i] += (by_y + value * (q * dy - s * slope)) * g


@kernel
def evaluate(x, y, rows, integrated, out):
    """Put the mixture at the points into out (n,)."""
    out[:] = 0.0
    for k in range(rows.shape[0]):
        add_values(x, y, 0.0, 0.0, rows[k], 1.0, integrated, out)


@kernel
def evaluate_slopes(x, y, rows, integrated, out):
    """Put the mixture and its slopes by its own place into out (3, n)."""
    out[:] = 0.0
    scales = (1.0, 0.0, 0.0)
    for k in range(rows.shape[0]):
        add_derivatives(x, y, 0.0, 0.0, rows[k], scales, integrated, out)


@kernel
def derivatives(x, y, rows, integrated, out):
    """
    Put each Gaussian and its five derivatives into out (K, 6, n).

    In order g, g_x, g_y, g_xx, g_xy, g_yy. They are all that any parameter
    of a Gaussian needs, because a Gaussian obeys the heat equation:
    dg/dSigma_xx = g_xx / 2, dg/dSigma_xy = g_xy, dg/dSigma_yy = g_yy / 2.
    """
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        for i in range(x.size):
            dx, dy = x[i] - mx, y[i] - my
            gx, gy = point_gradient(dx, dy, p, s, q, integrated)
            gxx, gxy, gyy = point_hessian(dx, dy, p, s, q, integrated)
            out[k, 0, i] = a * point_value(dx, dy, p, s, q, integrated)
            out[k, 1, i] = a * gx
            out[k, 2, i] = a * gy
            out[k, 3, i] = a * gxx
            out[k, 4, i] = a * gxy
            out[k, 5, i] = a * gyy


# The shape parameters of an astropy model, (6 K - 1,): K - 1 stick-breaking
# fractions, then x, y, stddev_x, stddev_y, rho of each Gaussian.

@kernel
def model_rows(values, min_stddev, max_rho, rows):
    """Put the mixture of any parameters, valid or not, into rows (K, 6)."""
    n = rows.shape[0]
    rest = 1.0
    for k in range(n):
        fraction = values[k] if k < n - 1 else 1.0
        first = n - 1 + 5 * k
        sx = max(abs(values[first + 2]), min_stddev)
        sy = max(abs(values[first + 3]), min_stddev)
        rho = min(max(values[first + 4], -max_rho), max_rho)
        p = 1 / (sx * sx * (1 - rho) * (1 + rho))
        q = 1 / (sy * sy)
        rows[k, 0] = rest * fraction * sqrt(p * q) / (2 * np.pi)
        rows[k, 1] = values[first]
        rows[k, 2] = values[first + 1]
        rows[k, 3] = p
        rows[k, 4] = rho * sx / sy
        rows[k, 5] = q
        rest *= 1 - fraction
