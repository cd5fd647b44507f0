"""Mixtures on a detector grid, four neighbours blended."""
from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.gaussian import (
    add_derivatives,
    add_values,
    point_gradient,
    point_hessian,
    point_value,
)
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.rows import render

# A grid of mixtures, four neighbours blended. nodes is (M, K, 6), ordered by
# y, then x; x_grid (nx,) and y_grid (ny,) ascend, nx * ny = M.

@inner
def _cell(position, grid):
    """
    Return the cell, its blend fraction and the fraction's slope.

    Outside the grid the fraction is clamped to the edge and does not change.
    """
    if grid.size == 1:
        return 0, 0.0, 0.0
    i, beyond = 0, grid.size - 1
    while beyond - i > 1:
        middle = (i + beyond) // 2
        if grid[middle] <= position:
            i = middle
        else:
            beyond = middle
    width = grid[i + 1] - grid[i]
    fraction = (position - grid[i]) / width
    if fraction < 0:
        return i, 0.0, 0.0
    if fraction > 1:
        return i, 1.0, 0.0
    return i, fraction, 1 / width


@inner
def blend_weights(x_0, y_0, x_grid, y_grid, index, weights):
    """
    Find the four neighbours, for index (4,), and their bilinear weights.

    weights (3, 4) takes the weights and their derivatives by x_0 and y_0.
    """
    i, fx, sx = _cell(x_0, x_grid)
    j, fy, sy = _cell(y_0, y_grid)
    i_next = min(i + 1, x_grid.size - 1)
    j_next = min(j + 1, y_grid.size - 1)
    for corner in range(4):
        right = corner % 2 == 1
        top = corner >= 2
        index[corner] = ((j_next if top else j) * x_grid.size
                         + (i_next if right else i))
        wx = fx if right else 1 - fx
        wy = fy if top else 1 - fy
        weights[0, corner] = wx * wy
        weights[1, corner] = (sx if right else -sx) * wy
        weights[2, corner] = wx * (sy if top else -sy)


@kernel(allocates=True)
def evaluate_grid(x, y, flux, x_0, y_0, nodes, x_grid, y_grid, integrated,
                  out):
    """
    Put the blended PSF at the points into out (n,).

    flux has one element or n; x_0 and y_0 have one element, or n for a star
    of its own at each point.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    per_point = x_0.size > 1
    out[:] = 0.0
    for star in range(x_0.size):
        points = slice(star, star + 1) if per_point else slice(0, x.size)
        blend_weights(x_0[star], y_0[star], x_grid, y_grid, index, weights)
        for corner in range(4):
            w = weights[0, corner]
            if w == 0:
                continue
            for row in nodes[index[corner]]:
                if row[0] != 0:
                    add_values(x[points], y[points], x_0[star], y_0[star],
                               row, w, integrated, out[points])
    for i in range(x.size):
        out[i] *= flux[i if flux.size > 1 else 0]


@kernel(allocates=True)
def differentiate_grid(x, y, x_0, y_0, nodes, x_grid, y_grid, integrated,
                       out):
    """
    Put the unit-flux blended PSF, d/dx_0 and d/dy_0 into out (3, n).

    x_0 and y_0 are numbers. The blend changes with position too: its
    derivative is part of the result.
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    blend_weights(x_0, y_0, x_grid, y_grid, index, weights)
    out[:] = 0.0
    for corner in range(4):
        for row in nodes[index[corner]]:
            if row[0] != 0:
                add_derivatives(x, y, x_0, y_0, row, weights[:, corner],
                                integrated, out)


@inner
def _add_stamp(rows, x_0, y_0, flux, integrated, px, py, out):
    """Add a star to a stamp (ny, nx) whose pixels are at px and py (n,)."""
    if integrated:
        render(rows, x_0, y_0, flux, integrated, out)
        return
    # A stamp has few pixels in a row: taken as one row, it fills vectors.
    for row in rows:
        if row[0] != 0:
            add_values(px, py, x_0, y_0, row, flux, False,
                       out.reshape(px.size))


@inner(allocates=True)
def _pixel_positions(ny, nx):
    px = np.empty(ny * nx)
    py = np.empty(ny * nx)
    for i in range(px.size):
        py[i] = i // nx
        px[i] = i % nx
    return px, py


@kernel(allocates=True)
def render_grid(x, y, flux, left, bottom, nodes, x_grid, y_grid, integrated,
                out):
    """
    Add star i to its stamp out[i], whose first pixel is (left, bottom)[i].

    x, y, flux, left and bottom are (n,), out is (n, ny, nx).
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    px, py = _pixel_positions(out.shape[1], out.shape[2])
    for i in range(x.size):
        blend_weights(x[i], y[i], x_grid, y_grid, index, weights)
        for corner in range(4):
            w = weights[0, corner] * flux[i]
            if w != 0:
                _add_stamp(nodes[index[corner]], x[i] - left[i],
                           y[i] - bottom[i], w, integrated, px, py, out[i])


# A grid of mixtures whose Gaussians are matched, blended one by one: the four
# that belong together are replaced by the one with the flux, centroid and
# second moments of their sum. sums is (M, K, 6) and holds of each Gaussian
# the integrals of 1, x, y, x^2, xy, y^2, which blend linearly.

@inner(allocates=True)
def match_rows(x_0, y_0, sums, x_grid, y_grid, rows, slopes):
    """
    Put the K blended Gaussians at (x_0, y_0) into rows (K, 6).

    slopes (2, K, 6) takes the derivatives by x_0 and y_0 of log flux, mean
    and covariance (xx, xy, yy).
    """
    index = np.empty(4, np.int64)
    weights = np.empty((3, 4))
    blend_weights(x_0, y_0, x_grid, y_grid, index, weights)
    blended = np.empty(6)
    slope = np.empty(6)
    for k in range(rows.shape[0]):
        _blend_sums(index, weights[0], sums, k, blended)
        rows[k] = 0.0
        slopes[:, k] = 0.0
        if blended[0] == 0:
            rows[k, 3] = rows[k, 5] = 1.0
            continue
        f, mx, my, sxx, sxy, syy = _central(blended)
        s = sxy / syy
        p = 1 / (sxx - s * sxy)
        rows[k] = np.array([f * sqrt(p / syy) / (2 * np.pi), mx, my, p, s,
                            1 / syy])
        for axis in range(2):
            _blend_sums(index, weights[1 + axis], sums, k, slope)
            df = slope[0] / f
            dx = slope[1] / f - mx * df
            dy = slope[2] / f - my * df
            slopes[axis, k, 0] = df
            slopes[axis, k, 1] = dx
            slopes[axis, k, 2] = dy
            slopes[axis, k, 3] = (slope[3] / f - (sxx + mx * mx) * df
                                  - 2 * mx * dx)
            slopes[axis, k, 4] = (slope[4] / f - (sxy + mx * my) * df
                                  - mx * dy - my * dx)
            slopes[axis, k, 5] = (slope[5] / f - (syy + my * my) * df
                                  - 2 * my * dy)


@inner
def _blend_sums(index, weights, sums, k, out):
    for j in range(6):
        out[j] = 0.0
        for corner in range(4):
            out[j] += weights[corner] * sums[index[corner], k, j]


class Merged(NamedTuple):
    """A grid of one node of K Gaussians; see `merge_nodes`."""

    nodes: np.ndarray
    falls: np.ndarray
    axis: np.ndarray
    sums: np.ndarray

    @classmethod
    def empty(cls, k):
        """Return memory for K Gaussians."""
        return cls(np.empty((1, k, 6)), np.empty((1, k)), np.zeros(1),
                   np.empty(6))


@inner
def merge_nodes(index, weights, nodes, merged):
    """
    Put one Gaussian for each four of the same number into a grid of one node.

    Each has the flux, centroid and second moments of the four. Returns
    whether there are such Gaussians: there may be none for lights of both
    signs.
    """
    sums = merged.sums
    for k in range(nodes.shape[1]):
        sums[:] = 0.0
        for corner in range(4):
            a, x, y, p, s, q = nodes[index[corner], k]
            f = weights[corner] * a / sqrt(p * q)
            sums[0] += f
            sums[1] += f * x
            sums[2] += f * y
            sums[3] += f * (x * x + s * s / q + 1 / p)
            sums[4] += f * (x * y + s / q)
            sums[5] += f * (y * y + 1 / q)
        if sums[0] == 0:
            merged.nodes[0, k] = 0.0
            continue
        f, x, y, sxx, sxy, syy = _central(sums)
        s = sxy / syy
        narrow = sxx - s * sxy
        if not (syy > 0 and narrow > 0):
            return False
        row = merged.nodes[0, k]
        row[0], row[1], row[2] = f / sqrt(narrow * syy), x, y
        row[3], row[4], row[5] = 1 / narrow, s, 1 / syy
        merged.falls[0, k] = exp(-row[3])
    return True


@inner
def _central(sums):
    """Return flux, mean and covariance of what has these integrals."""
    f = sums[0]
    mx, my = sums[1] / f, sums[2] / f
    return (f, mx, my, sums[3] / f - mx * mx, sums[4] / f - mx * my,
            sums[5] / f - my * my)


@kernel(allocates=True)
def evaluate_matched(x, y, flux, x_0, y_0, sums, x_grid, y_grid, integrated,
                     out):
    """Put the PSF of matched Gaussians into out; as `evaluate_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    per_point = x_0.size > 1
    out[:] = 0.0
    for star in range(x_0.size):
        points = slice(star, star + 1) if per_point else slice(0, x.size)
        match_rows(x_0[star], y_0[star], sums, x_grid, y_grid, rows, slopes)
        for row in rows:
            add_values(x[points], y[points], x_0[star], y_0[star], row, 1.0,
                       integrated, out[points])
    for i in range(x.size):
        out[i] *= flux[i if flux.size > 1 else 0]


@kernel(allocates=True)
def differentiate_matched(x, y, x_0, y_0, sums, x_grid, y_grid, integrated,
                          out):
    """Put value and derivatives into out (3, n); as `differentiate_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    match_rows(x_0, y_0, sums, x_grid, y_grid, rows, slopes)
    out[:] = 0.0
    for k in range(rows.shape[0]):
        a, mx, my, p, s, q = rows[k]
        for i in range(x.size):
            dx, dy = x[i] - x_0 - mx, y[i] - y_0 - my
            g = point_value(dx, dy, p, s, q, integrated)
            gx, gy = point_gradient(dx, dy, p, s, q, integrated)
            gxx, gxy, gyy = point_hessian(dx, dy, p, s, q, integrated)
            out[0, i] += a * g
            for axis in range(2):
                # The heat equation turns slopes of the covariance into
                # second derivatives.
                d = slopes[axis, k]
                out[1 + axis, i] += a * (
                    d[0] * g - d[1] * gx - d[2] * gy + 0.5 * d[3] * gxx
                    + d[4] * gxy + 0.5 * d[5] * gyy)
            out[1, i] -= a * gx
            out[2, i] -= a * gy


@kernel(allocates=True)
def render_matched(x, y, flux, left, bottom, sums, x_grid, y_grid,
                   integrated, out):
    """Add stars of matched Gaussians to stamps; as `render_grid`."""
    rows = np.empty(sums.shape[1:])
    slopes = np.empty((2, sums.shape[1], 6))
    px, py = _pixel_positions(out.shape[1], out.shape[2])
    for i in range(x.size):
        match_rows(x[i], y[i], sums, x_grid, y_grid, rows, slopes)
        _add_stamp(rows, x[i] - left[i], y[i] - bottom[i], flux[i],
                   integrated, px, py, out[i])
