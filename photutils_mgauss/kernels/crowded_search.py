"""Finding the stars of a crowded image."""
from math import ceil, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.crowded_fit import find_pair, put_block
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import cholesky

# So many stars around a pixel are free to readjust when a further one is
# looked for there.
MOST_BESIDE = 4


class Planes(NamedTuple):
    """Images of a tile: weights, the residual, and the light of stars."""

    weight: np.ndarray
    residual: np.ndarray
    light: np.ndarray


class Templates(NamedTuple):
    """
    Stamps (cells along y, along x, 2h + 1, 2h + 1) of a star.

    Each serves for cell x cell pixels.
    """

    stamps: np.ndarray
    cell: int


class Fit(NamedTuple):
    """The stars that are known, and the equations they were fitted with."""

    sources: tuple
    stamps: tuple
    pairs: tuple
    equations: tuple


class Limits(NamedTuple):
    """
    Where a further star is looked for.

    Within reach of a star [pix], with stars within the distance free to
    readjust [pix], where more than the fraction least of the information is
    left, and if it may reach the significance threshold.
    """

    reach: float
    free: float
    least: float
    threshold: float


class BesideScratch(NamedTuple):
    """Stars around a pixel, their factors, two right sides, and sums."""

    members: np.ndarray
    matrix: np.ndarray
    right: np.ndarray
    sums: np.ndarray

    @classmethod
    def empty(cls):
        """Return the memory for the most stars that are free."""
        size = 3 * MOST_BESIDE
        return cls(np.empty(MOST_BESIDE, np.int64), np.empty((size, size)),
                   np.empty((size, 2)), np.empty(3))


@inner
def squared(template):
    """Return the sum of the squares of a template's pixels."""
    power = 0.0
    for j in range(template.shape[0]):
        for i in range(template.shape[1]):
            power += template[j, i]**2
    return power


@inner
def isolated(x, y, template, power, weight, residual):
    """
    Ask what a star of a template would be on a constant around a pixel.

    Returns the gradient of half of -chi2 by its flux and the information on
    it, both 0 where less than a third of power, that of the template, is left
    by weights of zero; and the same without the constant.
    """
    ny, nx = residual.shape
    h = template.shape[0] // 2
    pr = pp = ps = rs = ws = seen = 0.0
    for j in range(max(-h, -y), min(h + 1, ny - y)):
        for i in range(max(-h, -x), min(h + 1, nx - x)):
            w = weight[y + j, x + i]
            t = template[h + j, h + i]
            r = residual[y + j, x + i]
            wt = w * t
            pr += wt * r
            pp += wt * t
            ps += wt
            rs += w * r
            ws += w
            if w > 0:
                seen += t * t
    if not 3 * seen > power:
        return 0.0, 0.0, 0.0, 0.0
    info = pp - ps * ps / ws
    if not info > 0:
        return 0.0, 0.0, pr, pp
    return pr - ps * rs / ws, info, pr, pp


@kernel
def score(residual, weight, template, x_low, x_high, y_low, y_high, hint,
          significance, flux):
    """
    Ask at each pixel of a window how significant a star there would be.

    A star of the template (2h + 1, 2h + 1) and a constant are fitted together
    around the pixel; flux takes the star's flux, significance its ratio to
    the standard error, 0 where less than a third of the information is left
    by weights of zero. Pixels are passed over unless the nine around them
    together stand out by hint standard errors.
    """
    ny, nx = residual.shape
    power = squared(template)
    for y in range(y_low, y_high):
        for x in range(x_low, x_high):
            rs = ws = 0.0
            for j in range(max(0, y - 1), min(ny, y + 2)):
                for i in range(max(0, x - 1), min(nx, x + 2)):
                    rs += weight[j, i] * residual[j, i]
                    ws += weight[j, i]
            if not rs > hint * sqrt(ws):
                continue
            g, info, _, _ = isolated(x, y, template, power, weight, residual)
            if info > 0:
                flux[y, x] = g / info
                significance[y, x] = flux[y, x] * sqrt(info)


@inner
def template_products(x, y, template, weight, residual, light, out):
    """
    Put the sums of t w r, t^2 w and (t w light)^2 around a pixel into out.

    False where weights of zero leave less than a third of the information.
    """
    ny, nx = residual.shape
    h = template.shape[0] // 2
    tr = tt = tl = seen = power = 0.0
    for j in range(-h, h + 1):
        for i in range(-h, h + 1):
            t = template[h + j, h + i]
            power += t * t
            if not (0 <= y + j < ny and 0 <= x + i < nx):
                continue
            w = weight[y + j, x + i]
            if w == 0:
                continue
            tw = t * w
            seen += t * t
            tr += tw * residual[y + j, x + i]
            tt += tw * t
            tl += (tw * light[y + j, x + i])**2
    out[0] = tr
    out[1] = tt
    out[2] = tl
    return 3 * seen >= power


@inner
def _template_overlap(x, y, template, weight, left, bottom, width, offset,
                      derivatives, out):
    """Put the sums of t w times derivatives of a star into out (3, ...)."""
    ny, nx = weight.shape
    h = template.shape[0] // 2
    o0 = o1 = o2 = 0.0
    x_low, x_high = max(0, left, x - h), min(nx, left + width, x + h + 1)
    for row in range(max(0, bottom, y - h),
                     min(ny, bottom + width, y + h + 1)):
        first = offset + (row - bottom) * width - left
        for k in range(x_low, x_high):
            tw = template[row - y + h, k - x + h] * weight[row, k]
            o0 += tw * derivatives[0, first + k]
            o1 += tw * derivatives[1, first + k]
            o2 += tw * derivatives[2, first + k]
    out[0, 0] = o0
    out[1, 0] = o1
    out[2, 0] = o2


@inner
def stars_around(column, row, i, x, y, indptr, neighbour, free, members):
    """
    Put the stars within a distance of a pixel into members; return how many.

    None if another than star i is nearest to it.
    """
    gap = (x[i] - column)**2 + (y[i] - row)**2
    members[0] = i
    count = 1
    for pair in range(indptr[i], indptr[i + 1]):
        j = neighbour[pair]
        other = (x[j] - column)**2 + (y[j] - row)**2
        if other < gap:
            return 0
        if other < free * free and count < members.size:
            members[count] = j
            count += 1
    return count


@inner
def _gather(count, members, equations, indptr, neighbour, a, right):
    """Put the equations of the stars around a pixel into a and right."""
    matrix, gradient, _, blocks = equations
    for m in range(count):
        star = members[m]
        for c in range(3):
            right[3 * m + c, 1] = gradient[star, c]
        put_block(matrix, star, m, m, a)
        for n in range(m):
            pair = find_pair(star, members[n], indptr, neighbour)
            if pair >= 0:
                put_block(blocks, pair, m, n, a)
                continue
            for c in range(3):
                for d in range(3):
                    a[3 * m + c, 3 * n + d] = 0.0


@inner
def _scale(a, right, size):
    """Make the diagonal of the lower triangle a bit more than 1."""
    for c in range(size):
        s = 1 / sqrt(a[c, c]) if a[c, c] > 0 else 0.0
        right[c, 0] *= s
        right[c, 1] *= s
        for d in range(c + 1):
            a[c, d] *= s
        for d in range(c, size):
            a[d, c] *= s
        a[c, c] = 1.0 + 1e-9


@inner
def _readjust(size, a, right, sums):
    """
    Return information and gradient of a star with the others free.

    From those with the others fixed; the right sides are the others' overlaps
    with it and their gradient.
    """
    g, info = sums[0], sums[1]
    for c in range(size):
        u, v = right[c, 0], right[c, 1]
        for d in range(c):
            u -= a[c, d] * right[d, 0]
            v -= a[c, d] * right[d, 1]
        right[c, 0] = u / a[c, c]
        right[c, 1] = v / a[c, c]
        info -= right[c, 0] * right[c, 0]
        g -= right[c, 0] * right[c, 1]
    return info, g


@inner
def score_pixel(x, y, count, fit, template, weight, least, scratch):
    """Return significance and flux of a star at a pixel, or zeros."""
    members, a, right, sums = scratch
    left, bottom, width, offset, derivatives = fit.stamps
    flux = fit.sources.flux
    for m in range(count):
        star = members[m]
        _template_overlap(x, y, template, weight, left[star], bottom[star],
                          width[star], offset[star], derivatives,
                          right[3 * m:])
        right[3 * m + 1, 0] *= flux[star]
        right[3 * m + 2, 0] *= flux[star]
    _gather(count, members, fit.equations, fit.pairs.indptr,
            fit.pairs.neighbour, a, right)
    _scale(a, right, 3 * count)
    if not cholesky(a, 3 * count, 1e-12):
        return 0.0, 0.0
    info, g = _readjust(3 * count, a, right, sums)
    if info < least * sums[1]:
        return 0.0, 0.0
    return g / sqrt(info + sums[2]), g / info


@kernel
def score_beside(fit, templates, planes, limits, scratch, significance, flux):
    r"""
    Ask how significant a further star would be on pixels close to stars.

    For a pixel within reach of a star, nearest to it, the stars around are
    free to readjust: with the candidate's own information h, gradient g, its
    overlaps a with the stars' parameters and their normal matrix N and
    gradient n,

    .. math:: S = (g - a^T N^{-1} n) / \sqrt{h - a^T N^{-1} a + v},

    where v is the variance of g by errors of the PSF, the sum over pixels of
    :math:`(t w\,\mathrm{light})^2`. Pixels where less than the fraction
    least of h is left cannot be told from the stars and keep 0. Significance
    and flux are (ny, nx).
    """
    ny, nx = significance.shape
    members, _, _, sums = scratch
    px, py, _ = fit.sources
    indptr, neighbour, _ = fit.pairs
    weight, residual, light = planes
    stamps, cell = templates
    reach, free, least, threshold = limits
    side = int(ceil(reach))
    for i in range(px.size):
        row, column = int(np.rint(py[i])), int(np.rint(px[i]))
        for y in range(max(0, row - side), min(ny, row + side + 1)):
            for x in range(max(0, column - side),
                           min(nx, column + side + 1)):
                if (px[i] - x)**2 + (py[i] - y)**2 > reach * reach:
                    continue
                count = stars_around(x, y, i, px, py, indptr, neighbour, free,
                                     members)
                if count == 0:
                    continue
                significance[y, x] = 0.0
                template = stamps[y // cell, x // cell]
                # What the stars' freedom can add is bounded.
                if template_products(
                        x, y, template, weight, residual, light, sums) and (
                        sums[0] > threshold * sqrt(0.3 * least * sums[1])):
                    strength, brightness = score_pixel(
                        x, y, count, fit, template, weight, least, scratch)
                    if brightness != 0:
                        significance[y, x] = strength
                        flux[y, x] = brightness


@kernel
def star_quality(sources, stamps, planes, out):
    """
    Put sums over each star's stamp into out (n, 6).

    In order: the number of pixels with weight, chi2, the sum of absolute
    residuals, the residual of the star's central pixel, the star's own share
    of the light of all stars, and the share of its information on the flux
    that pixels with weight hold.
    """
    x, y, flux = sources
    left, bottom, width, offset, derivatives = stamps
    weight, residual, light = planes
    ny, nx = weight.shape
    for i in range(flux.size):
        w = width[i]
        count = chi2 = deviation = own = total = seen = power = 0.0
        for j in range(w):
            row = bottom[i] + j
            for k in range(w):
                column = left[i] + k
                if not (0 <= row < ny and 0 <= column < nx):
                    continue
                p = derivatives[0, offset[i] + j * w + k]
                power += p * p
                v = weight[row, column]
                if v == 0:
                    continue
                r = residual[row, column]
                count += 1
                chi2 += v * r * r
                deviation += abs(r)
                own += p * flux[i]
                total += max(light[row, column], 0.0)
                seen += p * p
        out[i, 0] = count
        out[i, 1] = chi2
        out[i, 2] = deviation
        row, column = int(np.rint(y[i])), int(np.rint(x[i]))
        out[i, 3] = np.nan
        if 0 <= row < ny and 0 <= column < nx and weight[row, column] > 0:
            out[i, 3] = residual[row, column]
        out[i, 4] = min(own / total, 1.0) if total > 0 else np.nan
        out[i, 5] = seen / power if power > 0 else 0.0
