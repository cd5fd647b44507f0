"""Gaussians drawn on a stamp, and the moments of their products."""
from math import exp

import numpy as np

from photutils_mgauss.kernels.gaussian import (
    LOG_NOTHING,
    NOTHING,
    fast_exp,
)
from photutils_mgauss.kernels.jit import inner
from photutils_mgauss.kernels.linear import clear
from photutils_mgauss.kernels.rows import add_row

_LOG_2PI = float(np.log(2 * np.pi))


@inner
def draw_unit(shapes, cx, cy, lanes, images):
    """
    Put Gaussians of unit flux into images (K, ny, nx).

    lanes (4, nx) is scratch.
    """
    for k in range(shapes.shape[0]):
        if _is_steep(shapes[k], cx, cy, images[k].shape):
            _draw_by_rows(shapes[k], cx, cy, images[k])
        else:
            _draw_by_columns(shapes[k], cx, cy, lanes, images[k])


# Exponents within this keep their exponential, and its inverse, a number.
_STEEP = 600.0


@inner
def _is_steep(shape, cx, cy, size):
    """
    Return whether a walk along columns leaves the range of numbers.

    It starts near the row of the mean, where a thin, tilted Gaussian may be
    0 in columns that it reaches elsewhere, or change too much to the next.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    v = min(max(np.rint(cy + my), 0.0), size[0] - 1.0) - cy - my
    far = length * max(abs(cx + mx), abs(size[1] - 1 - cx - mx)) + abs(t * v)
    slope, square = abs(t) * far + m * m * abs(v), far * far + m * m * v * v
    # So written, what is not a number is steep.
    return not (slope <= _STEEP
                and (abs(t) <= m or square <= 2 * _STEEP))


@inner
def _draw_by_rows(shape, cx, cy, image):
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    peak = exp(log_l + log_m - _LOG_2PI)
    for j in range(image.shape[0]):
        row = image[j]
        clear(row, row.size)
        v = j - cy - my
        q = m * m * v * v
        if q < LOG_NOTHING:
            add_row(peak * exp(-0.5 * q), -cx - mx + t / length * v,
                    length * length, row)


@inner
def _draw_by_columns(shape, cx, cy, lanes, image):
    """
    Draw all columns at once, from the row of the mean up and down.

    The quotient of a pixel and the next of its column changes by the same
    factor each row, so a pixel costs two multiplications.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    peak = exp(log_l + log_m - _LOG_2PI)
    start = min(max(int(np.rint(cy + my)), 0), image.shape[0] - 1)
    v = start - cy - my
    b = m * v
    bend = t * t + m * m
    half, fall = exp(-0.5 * bend), exp(-bend)
    upper, up, lower, down = lanes[0], lanes[1], lanes[2], lanes[3]
    a = t * v - length * (cx + mx)
    for i in range(upper.size):
        square = (length * i + a) * (length * i + a) + b * b
        upper[i] = peak * fast_exp(-0.5 * square)
    turn = exp(-length * t)
    up[0], down[0] = half * exp(-a * t - m * b), half * exp(a * t + m * b)
    for i in range(1, upper.size):
        up[i], down[i] = up[i - 1] * turn, down[i - 1] / turn
    for i in range(upper.size):
        lower[i] = upper[i] * down[i]
        down[i] *= fall
    _walk_columns(start, image.shape[0], 1, fall, upper, up, image)
    _walk_columns(start - 1, -1, -1, fall, lower, down, image)


@inner
def _walk_columns(start, end, way, fall, value, quotient, image):
    """Put value (nx,) into rows start, start + way, ... before end."""
    for j in range(start, end, way):
        row = image[j]
        for i in range(value.size):
            row[i] = value[i]
            following = value[i] * quotient[i]
            value[i] = following if following > NOTHING else 0.0
            quotient[i] *= fall


@inner
def _columns_of_product(a, b, weight, cy, columns):
    """Put sum_y w a b y^m into columns[m, x], m <= 4."""
    ny, nx = a.shape
    for m in range(5):
        clear(columns[m], nx)
    c0, c1, c2 = columns[0], columns[1], columns[2]
    c3, c4 = columns[3], columns[4]
    # Two rows at once: a sum is loaded and stored half as often.
    for j in range(0, ny - 1, 2):
        v, z = j - cy, j + 1 - cy
        for i in range(nx):
            g = weight[j, i] * a[j, i] * b[j, i]
            h = weight[j + 1, i] * a[j + 1, i] * b[j + 1, i]
            c0[i] += g + h
            g, h = g * v, h * z
            c1[i] += g + h
            g, h = g * v, h * z
            c2[i] += g + h
            g, h = g * v, h * z
            c3[i] += g + h
            c4[i] += g * v + h * z
    if ny % 2:
        v = ny - 1 - cy
        for i in range(c0.size):
            g = weight[ny - 1, i] * a[ny - 1, i] * b[ny - 1, i]
            c0[i] += g
            c1[i] += g * v
            c2[i] += g * (v * v)
            c3[i] += g * (v * v * v)
            c4[i] += g * (v * v * v * v)


@inner
def moments_of_product(a, b, weight, cx, cy, columns, out):
    """
    Put sum_pixels w a b x^n y^m into out[n, m], n + m <= 4.

    columns (5, nx) is scratch.
    """
    _columns_of_product(a, b, weight, cy, columns)
    a0, a1, a2, a3, a4 = 0.0, 0.0, 0.0, 0.0, 0.0
    b0, b1, b2, b3 = 0.0, 0.0, 0.0, 0.0
    c0, c1, c2 = 0.0, 0.0, 0.0
    d0, d1, e0 = 0.0, 0.0, 0.0
    for i in range(columns.shape[1]):
        x = i - cx
        xx = x * x
        s0, s1, s2 = columns[0, i], columns[1, i], columns[2, i]
        a0, a1, a2 = a0 + s0, a1 + s1, a2 + s2
        a3, a4 = a3 + columns[3, i], a4 + columns[4, i]
        b0, b1 = b0 + x * s0, b1 + x * s1
        b2, b3 = b2 + x * s2, b3 + x * columns[3, i]
        c0, c1, c2 = c0 + xx * s0, c1 + xx * s1, c2 + xx * s2
        d0, d1 = d0 + xx * x * s0, d1 + xx * x * s1
        e0 += xx * xx * s0
    out[0, 0], out[0, 1], out[0, 2], out[0, 3], out[0, 4] = a0, a1, a2, a3, a4
    out[1, 0], out[1, 1], out[1, 2], out[1, 3] = b0, b1, b2, b3
    out[2, 0], out[2, 1], out[2, 2] = c0, c1, c2
    out[3, 0], out[3, 1], out[4, 0] = d0, d1, e0


@inner
def low_moments(a, b, centre, columns, sums):
    """
    Put sum_pixels a b (1, x, y, xx, xy, yy) into sums (6,).

    columns (at least 3, nx) is scratch.
    """
    c0, c1, c2 = columns[0], columns[1], columns[2]
    for m in range(3):
        clear(columns[m], c0.size)
    for j in range(a.shape[0]):
        v = j - centre[1]
        v2 = v * v
        for i in range(c0.size):
            h = a[j, i] * b[j, i]
            c0[i] += h
            c1[i] += h * v
            c2[i] += h * v2
    s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(c0.size):
        x = i - centre[0]
        s0, s1, s2 = s0 + c0[i], s1 + x * c0[i], s2 + c1[i]
        s3, s4, s5 = s3 + x * x * c0[i], s4 + x * c1[i], s5 + c2[i]
    sums[0], sums[1], sums[2] = s0, s1, s2
    sums[3], sums[4], sums[5] = s3, s4, s5


@inner
def derivative_polynomials(shape, out):
    """
    Put g and its derivatives by the five shape numbers into out (6, 6).

    As multiples of g: the coefficients of 1, x, y, xx, xy, yy.
    """
    mx, my, log_l, t, log_m = shape
    length, m = exp(log_l), exp(log_m)
    # a = length x + t y + a0, b = m y + b0.
    a0 = -length * mx - t * my
    b0 = -m * my
    for i in range(6):
        clear(out[i], 6)
    out[0, 0] = 1.0
    out[1, 0], out[1, 1], out[1, 2] = length * a0, length * length, length * t
    out[2, 0] = t * a0 + m * b0
    out[2, 1] = t * length
    out[2, 2] = t * t + m * m
    # 1 - length u a
    out[3, 0] = 1.0 + length * mx * a0
    out[3, 1] = -length * a0 + length * mx * length
    out[3, 2] = length * mx * t
    out[3, 3] = -length * length
    out[3, 4] = -length * t
    # -v a
    out[4, 0] = my * a0
    out[4, 1] = my * length
    out[4, 2] = my * t - a0
    out[4, 4] = -length
    out[4, 5] = -t
    # 1 - b^2
    out[5, 0] = 1.0 - b0 * b0
    out[5, 2] = -2 * m * b0
    out[5, 5] = -m * m


# The powers of x and y in the monomials 1, x, y, xx, xy, yy.
_POWER_X = np.array([0, 1, 0, 2, 1, 0])
_POWER_Y = np.array([0, 0, 1, 0, 1, 2])


@inner
def contract(left, moments, right, half, out):
    """
    Put the moments of a product, seen by its parameters, into out (6, 6).

    left and right (6, 6) are the polynomials of the two Gaussians; half
    (6, 6) is scratch.
    """
    for i in range(6):
        clear(half[i], 6)
        clear(out[i], 6)
    for a in range(6):
        for c in range(6):
            moment = moments[_POWER_X[a] + _POWER_X[c],
                             _POWER_Y[a] + _POWER_Y[c]]
            for j in range(6):
                half[a, j] += moment * right[j, c]
    for i in range(6):
        for a in range(6):
            for j in range(6):
                out[i, j] += left[i, a] * half[a, j]
