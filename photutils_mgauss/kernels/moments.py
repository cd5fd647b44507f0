"""Adaptive moments of images and mixtures."""
from math import exp, sqrt

import numpy as np

from photutils_mgauss.kernels.gaussian import LOG_NOTHING
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.rows import add_row

# Adaptive moments: the elliptical Gaussian weight W that matches what it
# weighs, centroid to centroid and covariance M to twice the weighted one. The
# state is x, y, M_xx, M_xy, M_yy; sums are of W times 1, u, v, uu, uv, vv over
# the light, with (u, v) the offset from x, y.

MOMENTS_CONVERGED, MOMENTS_STOPPED, MOMENTS_EMPTY, MOMENTS_DIVERGED = range(4)


@inner
def _row_of(state, row):
    """Put the Gaussian of unit peak that a state describes into row (6,)."""
    x, y, xx, xy, yy = state
    row[0], row[1], row[2] = 1.0, x, y
    row[4] = xy / yy
    row[3] = 1 / (xx - row[4] * xy)
    row[5] = 1 / yy


@inner
def _image_sums(image, used, fill, row, line, sums):
    """
    Sum an image under the weight of a row; unused pixels hold fill * W.

    line (nx,) is scratch.
    """
    _, x, y, p, s, q = row
    sums[:] = 0.0
    for j in range(image.shape[0]):
        v = j - y
        if q * v * v > LOG_NOTHING:
            continue
        line[:] = 0.0
        add_row(exp(-0.5 * q * v * v), -x - s * v, p, line)
        s0, s1, s2 = 0.0, 0.0, 0.0
        for i in range(line.size):
            value = image[j, i] if used[j, i] else fill * line[i]
            h = value * line[i]
            u = i - x
            s0 += h
            s1 += h * u
            s2 += h * u * u
        sums[0] += s0
        sums[1] += s1
        sums[2] += v * s0
        sums[3] += s2
        sums[4] += v * s1
        sums[5] += v * v * s0


@inner
def _mixture_sums(mixture, state, sums):
    """Integrate a mixture (K, 6: weight, x, y, xx, xy, yy) under a state."""
    x, y, xx, xy, yy = state
    sums[:] = 0.0
    norm = sqrt(xx * yy - xy * xy)
    for k in range(mixture.shape[0]):
        weight, mx, my, sxx, sxy, syy = mixture[k]
        a, b, c = xx + sxx, xy + sxy, yy + syy
        determinant = a * c - b * b
        dx, dy = mx - x, my - y
        # (M + S)^-1 d, then M times it: the mean of the product.
        ex = (c * dx - b * dy) / determinant
        ey = (a * dy - b * dx) / determinant
        h = (weight * norm / sqrt(determinant)
             * exp(-0.5 * (dx * ex + dy * ey)))
        u, v = xx * ex + xy * ey, xy * ex + yy * ey
        # M (M + S)^-1 S: the covariance of the product.
        tx, ty = (c * sxx - b * sxy) / determinant, (
            a * sxy - b * sxx) / determinant
        wx, wy = (c * sxy - b * syy) / determinant, (
            a * syy - b * sxy) / determinant
        sums[0] += h
        sums[1] += h * u
        sums[2] += h * v
        sums[3] += h * (xx * tx + xy * ty + u * u)
        sums[4] += h * (xx * wx + xy * wy + u * v)
        sums[5] += h * (xy * wx + yy * wy + v * v)


@inner
def _adapt(state, sums, largest):
    """
    Move the state towards the match; return its relative change.

    If the light is a Gaussian of covariance S the weighted covariance C
    obeys C^-1 = M^-1 + S^-1 and the centroid moves by C S^-1 of the way, so
    S and the centre follow in one step. A negative value is a failure.
    """
    if not sums[0] > 0:
        return -1.0
    xx, xy, yy = state[2:]
    u, v = sums[1] / sums[0], sums[2] / sums[0]
    cxx = sums[3] / sums[0] - u * u
    cxy = sums[4] / sums[0] - u * v
    cyy = sums[5] / sums[0] - v * v
    determinant = cxx * cyy - cxy * cxy
    if not (cxx > 0 and determinant > 0):
        return -2.0
    area = xx * yy - xy * xy
    pxx = cyy / determinant - yy / area
    pxy = -cxy / determinant + xy / area
    pyy = cxx / determinant - xx / area
    precision = pxx * pyy - pxy * pxy
    if pxx > 0 and precision > 0.05 / area:
        nxx, nxy, nyy = pyy / precision, -pxy / precision, pxx / precision
    else:
        # No Gaussian of finite size would look like this; grow carefully.
        nxx, nxy, nyy = 4 * cxx, 4 * cxy, 4 * cyy
    if not nxx + nyy < largest:
        return -2.0
    # How far the centre is: (1 + S M^-1) times the weighted offset.
    gx = u + (nxx * (yy * u - xy * v) + nxy * (xx * v - xy * u)) / area
    gy = v + (nxy * (yy * u - xy * v) + nyy * (xx * v - xy * u)) / area
    size = xx + yy
    change = max(abs(nxx - xx), abs(nxy - xy), abs(nyy - yy)) / size
    step = sqrt((gx * gx + gy * gy) / size)
    change = max(change, step)
    shrink = min(1.0, 2 / step) if step > 0 else 1.0
    state[0] += shrink * gx
    state[1] += shrink * gy
    state[2], state[3], state[4] = nxx, nxy, nyy
    return change


@inner
def _ending(change):
    if change == -1.0:
        return MOMENTS_EMPTY
    if change == -2.0:
        return MOMENTS_DIVERGED
    return MOMENTS_CONVERGED


@kernel(allocates=True)
def adapt_to_images(images, used, states, tolerance, max_steps, largest,
                    sums, status):
    """
    Bring the states (n, 5) to the adaptive moments of images (n, ny, nx).

    used tells which pixels count; the others are filled with the matching
    Gaussian. sums (n, 6) receives the last sums, status (n,) how it ended.
    """
    row = np.empty(6)
    line = np.empty(images.shape[2])
    for i in range(images.shape[0]):
        state = states[i]
        fill = 0.0
        status[i] = MOMENTS_STOPPED
        for _ in range(max_steps):
            _row_of(state, row)
            _image_sums(images[i], used[i], fill, row, line, sums[i])
            area = state[2] * state[4] - state[3] * state[3]
            fill = sums[i, 0] / (np.pi * sqrt(area))
            change = _adapt(state, sums[i], largest)
            if change < tolerance:
                status[i] = _ending(change)
                break


@kernel
def adapt_to_mixtures(mixtures, states, tolerance, max_steps, largest, sums,
                      status):
    """Bring the states (n, 5) to the moments of mixtures (n, K, 6)."""
    for i in range(mixtures.shape[0]):
        status[i] = MOMENTS_STOPPED
        for _ in range(max_steps):
            _mixture_sums(mixtures[i], states[i], sums[i])
            change = _adapt(states[i], sums[i], largest)
            if change < tolerance:
                status[i] = _ending(change)
                break
