"""Finding the stars of a crowded image."""
from math import ceil, sqrt

import numpy as np

from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import _cholesky


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
    h = template.shape[0] // 2
    power = (template**2).sum()
    for y in range(y_low, y_high):
        for x in range(x_low, x_high):
            rs = ws = 0.0
            for j in range(max(0, y - 1), min(ny, y + 2)):
                for i in range(max(0, x - 1), min(nx, x + 2)):
                    rs += weight[j, i] * residual[j, i]
                    ws += weight[j, i]
            if not rs > hint * sqrt(ws):
                continue
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
            info = pp - ps * ps / ws
            if 3 * seen > power and info > 0:
                flux[y, x] = (pr - ps * rs / ws) / info
                significance[y, x] = flux[y, x] * sqrt(info)


@inner
def _template_products(x, y, template, weight, residual, light, out):
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
def _template_overlap(x, y, template, weight, left, bottom, width, jets, flux,
                      out):
    """Put the sums of t w times a star's derivatives into out (3,)."""
    ny, nx = weight.shape
    h = template.shape[0] // 2
    o0 = o1 = o2 = 0.0
    x_low, x_high = max(0, left, x - h), min(nx, left + width, x + h + 1)
    for row in range(max(0, bottom, y - h),
                     min(ny, bottom + width, y + h + 1)):
        first = (row - bottom) * width - left
        for k in range(x_low, x_high):
            tw = template[row - y + h, k - x + h] * weight[row, k]
            o0 += tw * jets[0, first + k]
            o1 += tw * jets[1, first + k]
            o2 += tw * jets[2, first + k]
    out[0] = o0
    out[1] = flux * o1
    out[2] = flux * o2


@kernel
def score_beside(x, y, flux, left, bottom, width, offset, jets, matrix,
                 gradient, indptr, neighbour, blocks, templates, cell, weight,
                 residual, light, reach, least, threshold, significance,
                 found):
    r"""
    Ask how significant a further star would be on pixels close to stars.

    For a pixel within reach of a star, nearest to it, the stars around are
    free to readjust: with the candidate's own information h, gradient g, its
    overlaps a with the stars' parameters and their normal matrix N and
    gradient n,

    .. math:: S = (g - a^T N^{-1} n) / \sqrt{h - a^T N^{-1} a + v},

    where v is the variance of g by errors of the PSF, the sum over pixels of
    :math:`(t w\,\mathrm{light})^2`. Pixels where less than the fraction
    least of h is left cannot be told from the stars and keep 0. templates is
    (cells along y, along x, 2h + 1, 2h + 1), each for cell x cell pixels.
    """
    ny, nx = residual.shape
    most = 4
    members = np.empty(most, np.int64)
    a = np.empty((3 * most, 3 * most))
    rhs = np.empty((3 * most, 2))
    overlap = np.empty(3)
    sums = np.empty(3)
    side = int(ceil(reach))
    for i in range(x.size):
        for row in range(max(0, int(np.rint(y[i])) - side),
                         min(ny, int(np.rint(y[i])) + side + 1)):
            for k in range(max(0, int(np.rint(x[i])) - side),
                           min(nx, int(np.rint(x[i])) + side + 1)):
                gap = (x[i] - k)**2 + (y[i] - row)**2
                if gap > reach * reach:
                    continue
                members[0] = i
                count = 1
                nearest = True
                for pair in range(indptr[i], indptr[i + 1]):
                    j = neighbour[pair]
                    other = (x[j] - k)**2 + (y[j] - row)**2
                    if other < gap:
                        nearest = False
                        break
                    if other < 9 and count < most:
                        members[count] = j
                        count += 1
                if not nearest:
                    continue
                significance[row, k] = 0.0
                template = templates[row // cell, k // cell]
                if not _template_products(k, row, template, weight, residual,
                                          light, sums):
                    continue
                # What the stars' freedom can add is bounded.
                if not sums[0] > threshold * sqrt(0.3 * least * sums[1]):
                    continue
                size = 3 * count
                for m in range(count):
                    star = members[m]
                    _template_overlap(
                        k, row, template, weight, left[star], bottom[star],
                        width[star], jets[:, offset[star]:], flux[star],
                        overlap)
                    for c in range(3):
                        rhs[3 * m + c, 0] = overlap[c]
                        rhs[3 * m + c, 1] = gradient[star, c]
                        for d in range(3):
                            a[3 * m + c, 3 * m + d] = matrix[star, c, d]
                    for n in range(m):
                        for c in range(3):
                            for d in range(3):
                                a[3 * m + c, 3 * n + d] = 0.0
                        for pair in range(indptr[star], indptr[star + 1]):
                            if neighbour[pair] == members[n]:
                                for c in range(3):
                                    for d in range(3):
                                        a[3 * m + c, 3 * n + d] = blocks[
                                            pair, c, d]
                for c in range(size):
                    s = 1 / sqrt(a[c, c]) if a[c, c] > 0 else 0.0
                    rhs[c, 0] *= s
                    rhs[c, 1] *= s
                    for d in range(c + 1):
                        a[c, d] *= s
                    for d in range(c, size):
                        a[d, c] *= s
                    a[c, c] = 1.0 + 1e-9
                if not _cholesky(a, size):
                    continue
                info = sums[1]
                g = sums[0]
                for c in range(size):
                    u, v = rhs[c, 0], rhs[c, 1]
                    for d in range(c):
                        u -= a[c, d] * rhs[d, 0]
                        v -= a[c, d] * rhs[d, 1]
                    rhs[c, 0] = u / a[c, c]
                    rhs[c, 1] = v / a[c, c]
                    info -= rhs[c, 0] * rhs[c, 0]
                    g -= rhs[c, 0] * rhs[c, 1]
                if info < least * sums[1]:
                    continue
                significance[row, k] = g / sqrt(info + sums[2])
                found[row, k] = g / info


@kernel
def star_quality(flux, x, y, left, bottom, width, offset, jets, weight,
                 residual, light, out):
    """
    Put sums over each star's stamp into out (n, 6).

    In order: the number of pixels with weight, chi2, the sum of absolute
    residuals, the residual of the star's central pixel, the star's own share
    of the light of all stars, and the share of its information on the flux
    that pixels with weight hold.
    """
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
                p = jets[0, offset[i] + j * w + k]
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
