"""A field of mixtures fitted to the stamps of stars."""
from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.gaussian import LOG_NOTHING
from photutils_mgauss.kernels.jit import inner, kernel, loop
from photutils_mgauss.kernels.linear import back_substitute, clear, eliminate
from photutils_mgauss.kernels.pixels import N_NODES, shape_integrals
from photutils_mgauss.kernels.rows import render

# A field of mixtures fitted to the stamps of n stars.
#
# shapes (K, 6) are the numbers that vary over the detector: log weight, x, y,
# log_p, s, log_q with p = exp(2 log_p), q = exp(2 log_q), so that any values
# are a valid mixture. The first three of the first Gaussian are never fitted:
# they would repeat the flux and the position of the stars.
#
# sources (M, 3) are x, y and flux of a star and of the neighbours in its
# stamp, of which the first n_sources count. In the normal equations of one
# stamp come first the Q numbers of its own, then the 6 K - 3 shapes, then the
# residual, all in one triangle: eliminating the first Q is a Schur complement
# that leaves the equations of the shapes, their right side and chi^2.



class FieldStars(NamedTuple):
    """
    The stamps of n stars and the numbers of their own.

    stamps, weights (n, s, s); corners (n, 2), the pixel (x, y) of each
    stamp's first; sources, anchors, hold (n, M, 3), of which n_sources (n,)
    count: where sources are, where neighbours are expected, and the precision
    of that; sky (n,); used (n,), which stars the PSF is fitted to.
    """

    stamps: np.ndarray
    weights: np.ndarray
    corners: np.ndarray
    sources: np.ndarray
    anchors: np.ndarray
    hold: np.ndarray
    n_sources: np.ndarray
    sky: np.ndarray
    used: np.ndarray


class FieldShapes(NamedTuple):
    """
    The PSF of each of n stars, rows (n, K, 6), and what it depends on.

    jacobians (n, 6 K - 3, P), the derivatives of its shapes by the P numbers
    that are polynomials, or (0, 0, 0) if they are the shapes themselves;
    integrated, whether the rows are integrated over pixels, not sampled.
    """

    rows: np.ndarray
    jacobians: np.ndarray
    integrated: bool


class FieldSums(NamedTuple):
    """
    What n stars say of their P shapes, or of the numbers these depend on.

    equations (n, P (P + 3) / 2) has the upper triangle of the normal
    equations, each line of it followed by its right side; those of stars that
    are not used do not change. chi2 (n,) is that of each star.
    """

    equations: np.ndarray
    chi2: np.ndarray


class _PixelScratch(NamedTuple):
    """
    Memory for the derivatives of pixels.

    block (8, D); for a row of integrated pixels design (s, D), the integrals
    of one Gaussian (6, s), nodes (2, 8) and edges (6, s + 1).
    """

    block: np.ndarray
    design: np.ndarray
    integrals: np.ndarray
    nodes: np.ndarray
    edges: np.ndarray


@inner(allocates=True)
def _scratch(n_columns, side, integrated):
    side = side if integrated else 0
    return _PixelScratch(
        np.empty((8, n_columns)), np.empty((side, n_columns)),
        np.empty((6, side)), np.empty((2, N_NODES)), np.empty((6, side + 1)))


@inner
def _design(x, y, rows, sources, n_sources, first, row):
    """
    Put derivatives of a pixel into row and return the model.

    Those by the shapes are added from index ``first`` on, unless it is
    negative.
    """
    model = 0.0
    for j in range(n_sources):
        flux = sources[j, 2]
        value = 0.0
        gx = 0.0
        gy = 0.0
        for k in range(rows.shape[0]):
            a, mx, my, p, s, q = rows[k]
            dx = x - sources[j, 0] - mx
            dy = y - sources[j, 1] - my
            u = dx - s * dy
            pu = p * u
            qy = q * dy
            exponent = pu * u + qy * dy
            if not exponent < LOG_NOTHING:
                continue
            g = a * exp(-0.5 * exponent)
            by_x = pu * g
            by_y = qy * g - s * by_x
            value += g
            gx += by_x
            gy += by_y
            if first >= 0:
                _add_shape_derivatives(flux, g, by_x, by_y, pu, u, qy, dy,
                                       first + 6 * k - 3, k > 0, row)
        row[3 * j] = flux * gx
        row[3 * j + 1] = flux * gy
        row[3 * j + 2] = value
        model += flux * value
    return model


@inner
def _add_shape_derivatives(flux, g, by_x, by_y, pu, u, qy, dy, at, moves,
                           row):
    fg = flux * g
    if moves:
        row[at] += fg
        row[at + 1] += flux * by_x
        row[at + 2] += flux * by_y
    row[at + 3] += fg * (1 - pu * u)
    row[at + 4] += fg * pu * dy
    row[at + 5] += fg * (1 - qy * dy)


@inner
def _design_row(left, y, rows, sources, n_sources, first, size, scratch):
    """
    Put derivatives of a row of integrated pixels into the scratch's design.

    As `_design` does of one pixel, with the model in the last column.
    """
    design, integrals = scratch.design, scratch.integrals
    for i in range(design.shape[0]):
        clear(design[i], size)
    for j in range(n_sources):
        for k in range(rows.shape[0]):
            a, mx, my, p, s, q = rows[k]
            if not shape_integrals(
                    left - sources[j, 0] - mx, y - sources[j, 1] - my, p, s,
                    q, scratch.nodes, scratch.edges, integrals):
                continue
            for i in range(design.shape[0]):
                _add_integrals(a, sources[j, 2], integrals[:, i], 3 * j,
                               first, k, size, design[i])


@inner
def _add_integrals(a, flux, integrals, own, first, k, size, row):
    """Add Gaussian k in a pixel, its peak a, to the pixel's derivatives."""
    value, by_x, by_y, by_p, by_s, by_q = integrals
    af = a * flux
    row[own] += af * by_x
    row[own + 1] += af * by_y
    row[own + 2] += a * value
    row[size - 1] += af * value
    if first < 0:
        return
    at = first + 6 * k - 3
    if k > 0:
        row[at] += af * value
        row[at + 1] += af * by_x
        row[at + 2] += af * by_y
    row[at + 3] += af * by_p
    row[at + 4] += af * by_s
    row[at + 5] += af * by_q


@inner
def _accumulate(stamp, weight, left, bottom, psf, sources, n_sources, sky,
                fit_sky, with_shapes, scratch, normal):
    """
    Sum the normal equations of a stamp into normal; return their size.

    The size includes the column of the residual. psf are rows and whether
    they are integrated. Eight pixels at a time, those of scratch.block, save
    seven of eight walks through normal.
    """
    rows, integrated = psf
    block = scratch.block
    own = 3 * n_sources + fit_sky
    size = own + 1
    first = -1
    if with_shapes:
        size += 6 * rows.shape[0] - 3
        first = own
    for m in range(size):
        clear(normal[m], size)
    filled = 0
    for j in range(stamp.shape[0]):
        if integrated:
            _design_row(left, bottom + j, rows, sources, n_sources, first,
                        size, scratch)
        for i in range(stamp.shape[1]):
            w = weight[j, i]
            if w <= 0:
                continue
            row = block[filled]
            if integrated:
                for m in range(size):
                    row[m] = scratch.design[i, m]
                model = row[size - 1]
            else:
                clear(row, size)
                model = _design(left + i, bottom + j, rows, sources,
                                n_sources, first, row)
            if fit_sky:
                row[own - 1] = 1.0
            row[size - 1] = stamp[j, i] - sky - model
            root = sqrt(w)
            for m in range(size):
                row[m] *= root
            filled += 1
            if filled == 8:
                _add_products(block, size, normal)
                filled = 0
    for m in range(filled, 8):
        clear(block[m], size)
    _add_products(block, size, normal)
    return size


@loop
def _add_products(block, size, normal):
    """Add the products of the columns of block (8, D), upper triangle."""
    r0, r1, r2, r3 = block[0], block[1], block[2], block[3]
    r4, r5, r6, r7 = block[4], block[5], block[6], block[7]
    for m in range(size):
        out = normal[m]
        c0, c1, c2, c3 = r0[m], r1[m], r2[m], r3[m]
        c4, c5, c6, c7 = r4[m], r5[m], r6[m], r7[m]
        for n in range(m, size):
            out[n] += ((c0 * r0[n] + c1 * r1[n] + c2 * r2[n] + c3 * r3[n])
                       + (c4 * r4[n] + c5 * r5[n] + c6 * r6[n]
                          + c7 * r7[n]))


@inner
def _hold_neighbours(sources, anchors, n_sources, hold, size, normal):
    """Add the prior of the neighbours: anchors with the precisions hold."""
    for j in range(1, n_sources):
        for i in range(3):
            at = 3 * j + i
            offset = anchors[j, i] - sources[j, i]
            normal[at, at] += hold[j, i]
            normal[at, size - 1] += hold[j, i] * offset
            normal[size - 1, size - 1] += hold[j, i] * offset * offset


@inner
def _shift_sources(sources, n_sources, sky, fit_sky, step):
    """Add the step to a stamp's own numbers; return the sky."""
    for j in range(n_sources):
        for i in range(2):
            # A longer step would leave the core, where linear is wrong.
            sources[j, i] += min(max(step[3 * j + i], -0.5), 0.5)
        sources[j, 2] += step[3 * j + 2]
    if fit_sky:
        return sky + step[3 * n_sources]
    return sky


@inner
def _settle(i, stars, psf, fit_sky, with_shapes, scratch, normal, step):
    """Take a Gauss-Newton step of a star's own numbers, the PSF given."""
    left, bottom = stars.corners[i]
    sources, n_sources = stars.sources[i], stars.n_sources[i]
    size = _accumulate(stars.stamps[i], stars.weights[i], left, bottom, psf,
                       sources, n_sources, stars.sky[i], fit_sky, with_shapes,
                       scratch, normal)
    _hold_neighbours(sources, stars.anchors[i], n_sources, stars.hold[i],
                     size, normal)
    own = 3 * n_sources + fit_sky
    eliminate(normal, own, size)
    back_substitute(normal, own, size, step)
    stars.sky[i] = _shift_sources(sources, n_sources, stars.sky[i], fit_sky,
                                  step)
    return size


@kernel(allocates=True)
def field_normal(stars, shapes, fit_sky, n_steps, normal, sums):
    """
    Settle n stars and put the equations of the used ones into sums.

    Each star's own numbers take n_steps Gauss-Newton steps, the PSF given;
    the last one is taken together with the equations of the shapes, so that
    chi2 and gradient are those after it. sources and, with fit_sky, sky of
    the stars change. normal is scratch (D, D) with D = 3 M + 6 K - 1.
    """
    rows, jacobians, integrated = shapes
    equations, chi2 = sums
    scratch = _scratch(normal.shape[0], stars.stamps.shape[2], integrated)
    step = np.empty(normal.shape[0])
    condensed = np.empty((jacobians.shape[2], jacobians.shape[2] + 1))
    for star in range(chi2.size):
        used = stars.used[star]
        own = 3 * stars.n_sources[star] + fit_sky
        for i in range(n_steps):
            size = _settle(star, stars, (rows[star], integrated), fit_sky,
                           used and i == n_steps - 1, scratch, normal, step)
        chi2[star] = normal[size - 1, size - 1]
        if not used:
            continue
        if jacobians.size:
            _condense(normal, own, size, jacobians[star], condensed)
            _pack(condensed, 0, condensed.shape[1], equations[star])
        else:
            _pack(normal, own, size, equations[star])


@inner(allocates=True)
def _condense(normal, own, size, jacobian, out):
    """Put J^T A J and J^T b into out (P, P + 1), upper triangle."""
    n, p = jacobian.shape
    for i in range(p):
        clear(out[i], p + 1)
    line = np.empty(p + 1)
    for i in range(n):
        clear(line, p + 1)
        for j in range(n):
            a = normal[own + min(i, j), own + max(i, j)]
            for m in range(p):
                line[m] += a * jacobian[j, m]
        line[p] = normal[own + i, size - 1]
        for k in range(p):
            share = jacobian[i, k]
            if share != 0:
                for m in range(k, p + 1):
                    out[k, m] += share * line[m]


@inner
def _pack(normal, own, size, out):
    """Put what is left of the upper triangle of normal into out."""
    at = 0
    for p in range(own, size - 1):
        for q in range(p, size):
            out[at] = normal[p, q]
            at += 1


@kernel
def field_model(corners, rows, integrated, sources, n_sources, sky, out):
    """Put model stamps of n stars, neighbours and sky included, into out."""
    for star in range(out.shape[0]):
        left, bottom = corners[star]
        for j in range(out.shape[1]):
            for i in range(out.shape[2]):
                out[star, j, i] = sky[star]
        for j in range(n_sources[star]):
            x, y, flux = sources[star, j]
            render(rows[star], x - left, y - bottom, flux, integrated,
                   out[star])
