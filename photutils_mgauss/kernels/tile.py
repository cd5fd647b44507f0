"""The PSF of a star and its derivatives on a tile of pixels."""
from math import log, sqrt

from photutils_mgauss.kernels.gaussian import (
    NOTHING,
    fast_exp,
    point_gradient,
    point_value,
)
from photutils_mgauss.kernels.grid import blend_weights
from photutils_mgauss.kernels.jit import apart, inner
from photutils_mgauss.kernels.linear import clear
from photutils_mgauss.kernels.series import (
    LANES,
    LEFT_OUT,
    SERIES,
    add_series,
    pixel_peak,
    series_length,
)

# The PSF of a star and its derivatives by position are summed in a tile, one
# flat array: for each pixel column LANES values of the PSF, as many of its
# derivative by x_0, and as many by y_0. Neighbouring rows are neighbours in
# memory and fixed offsets lie between the parts, so that the compiler works on
# several rows at once; their number is a constant, for a remainder of a few
# rows one by one would take longer than all the others.

# Numbers of which walks over a tile, and series of products, make use.
_WALK = 4 * LANES
# Of this many rows, and no more, only so many are walked over.
_LOW = 12
SCRATCH = _WALK + SERIES

# The smallest share of a Gaussian in a blend, so that the slope of the share
# can be divided by it; lost in rounding where it stands for zero.
_LEAST_SHARE = 1e-30


def _walker(lanes):
    """Return a function that walks over the first rows of a tile."""
    @apart
    def add_walk(a, dx, dy, p, s, q, fall, by_x, by_y, width, walk, tile):
        """
        Add a Gaussian to a tile, two multiplications a pixel.

        walk (4 LANES,) holds for each row the Gaussian in a column, its
        quotient with the next one, fall times that of the column before, and
        the factors of the Gaussian in its derivative by x and, short of s
        times the former, by y.
        """
        by_y += s * by_x
        peak = 0.0
        for j in range(lanes):
            u, v = dx - s * j, dy + j
            g = fast_exp(-0.5 * (p * u * u + q * v * v))
            peak += g
            walk[j] = a * g
            walk[LANES + j] = fast_exp(-p * (u + 0.5))
            walk[2 * LANES + j] = p * u + by_x
            walk[3 * LANES + j] = q * v + by_y
        if peak < NOTHING:
            return
        for i in range(width):
            column = 3 * LANES * i
            pi = p * i
            for j in range(lanes):
                g = walk[j]
                r = walk[LANES + j]
                h = (walk[2 * LANES + j] + pi) * g
                tile[column + j] += g
                tile[column + LANES + j] += h
                tile[column + 2 * LANES + j] += walk[3 * LANES + j] * g - s * h
                walk[j] = g * r
                walk[LANES + j] = r * fall
    return add_walk


_add_walk, _add_low_walk = _walker(LANES), _walker(_LOW)


@inner
def _add_points(a, dx, dy, p, s, q, by_x, by_y, integrated, height, width,
                tile):
    """Add a Gaussian to a tile, each pixel for itself."""
    for i in range(width):
        for j in range(height):
            u, v = dx + i, dy + j
            g = a * point_value(u, v, p, s, q, integrated)
            gx, gy = point_gradient(u, v, p, s, q, integrated)
            k = 3 * LANES * i + j
            tile[k] += g
            tile[k + LANES] += by_x * g - a * gx
            tile[k + 2 * LANES] += by_y * g - a * gy


@inner
def faintest(rows, integrated):
    """Return what may be left out of each Gaussian of rows (K, 6)."""
    if integrated is None or not integrated:
        return 0.0
    peak = 0.0
    for k in range(rows.shape[0]):
        a, _, _, p, _, q = rows[k]
        if a != 0:
            peak += pixel_peak(a, p, q)
    return LEFT_OUT * peak


@inner
def _add_over_pixels(a, dx, dy, p, s, q, by_x, by_y, faint, height, width,
                     work, tile):
    """Add a Gaussian, integrated over each pixel, to a tile."""
    # Next to a node the share of another is nothing, its slope is not.
    most = pixel_peak(a, p, q) * max(1.0, abs(by_x), abs(by_y))
    left_out = log(faint / most)
    if not left_out < 0:
        return
    ratio, terms = series_length(p, s, q, left_out)
    if terms:
        add_series(a, dx, dy, p, s, q, ratio, terms, sqrt(-2 * left_out),
                   by_x, by_y, height, width, work, tile)
    else:
        _add_points(a, dx, dy, p, s, q, by_x, by_y, True, height, width, tile)


@inner
def add_gaussian(a, dx, dy, p, s, q, fall, by_x, by_y, integrated, faint,
                 height, width, walk, tile):
    """
    Add a Gaussian, its first pixel at (dx, dy) from the peak, to a tile.

    a includes its share in the blend, whose relative slopes are by_x and
    by_y. What is less than faint may be left out of an integrated Gaussian.
    fall is as of `psf.rows.falls`. walk (SCRATCH,) begins with zeros.
    """
    if integrated is not None and integrated:
        _add_over_pixels(a, dx, dy, p, s, q, by_x, by_y, faint, height, width,
                         walk[_WALK:], tile)
        return
    left = min(dx - s * dy, dx - s * (dy + height - 1))
    # A walk that begins too far out begins at zero.
    steep = (p > 50 or q > 50 or p * abs(s) * height > 200
             or (left < 0 and p * left * left > 600))
    if steep:
        _add_points(a, dx, dy, p, s, q, by_x, by_y, None, height, width, tile)
    elif height <= _LOW:
        _add_low_walk(a, dx - s * dy, dy, p, s, q, fall, by_x, by_y,
                      width, walk, tile)
    else:
        _add_walk(a, dx - s * dy, dy, p, s, q, fall, by_x, by_y, width,
                  walk, tile)


@inner
def _fill_tile(x_0, y_0, row, column, height, width, psf, tiling):
    """Put the PSF and its derivatives in up to LANES rows into the tile."""
    nodes, falls, _, _, integrated = psf
    walk, tile, index, weights = tiling
    clear(walk, _WALK)
    clear(tile, 3 * LANES * width)
    faint = 0.0
    for corner in range(4):
        faint += weights[0, corner] * faintest(nodes[index[corner]],
                                               integrated)
    for corner in range(4):
        w, wx, wy = weights[0, corner], weights[1, corner], weights[2, corner]
        if w == 0 and wx == 0 and wy == 0:
            continue
        w = max(w, _LEAST_SHARE)
        for k in range(nodes.shape[1]):
            a, mx, my, p, s, q = nodes[index[corner], k]
            if a != 0:
                add_gaussian(w * a, column - x_0 - mx, row - y_0 - my, p, s,
                             q, falls[index[corner], k], wx / w, wy / w,
                             integrated, faint, height, width, walk, tile)


@inner
def fill_derivatives(x_0, y_0, box, psf, tiling, out):
    """
    Put the unit-flux PSF in a box and its derivatives by x_0 and y_0.

    They go into the first width * height numbers of the rows of out (3, n),
    column after column. psf is (nodes, falls, x_grid, y_grid, integrated),
    tiling is scratch (walk, tile, index, weights). The change of the blend
    with position is included.
    """
    _, tile, index, weights = tiling
    blend_weights(x_0, y_0, psf[2], psf[3], index, weights)
    row, column, height, width = box
    for bottom in range(0, height, LANES):
        rows = min(LANES, height - bottom)
        _fill_tile(x_0, y_0, row + bottom, column, rows, width, psf, tiling)
        for part in range(3):
            _copy_part(tile[part * LANES:], bottom, rows, LANES, height,
                       width, out[part])


@apart
def _copy_part(part, bottom, rows, lanes, height, width, out):
    """Copy a part of a tile to the rows from bottom on of all columns."""
    # Of a single tile whole runs of lanes are copied: what they put into the
    # next column is written over there. A number that the compiler does not
    # know keeps it from copying one by one, and slices tell it that no index
    # counts from the end.
    for i in range(width):
        start = i * height + bottom
        many = height <= lanes and start + lanes <= width * height
        source, target = part[3 * LANES * i:], out[start:]
        for j in range(lanes if many else rows):
            target[j] = source[j]
