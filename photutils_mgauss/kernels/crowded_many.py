"""The evidence for stars in many images, and what their fit leaves open."""
from math import floor, sqrt
from typing import NamedTuple

import numpy as np

from photutils_mgauss.kernels.crowded_fit import (
    apply_joint,
    joint_matrix,
    members_of,
    scale_matrix,
)
from photutils_mgauss.kernels.crowded_search import (
    isolated,
    score_pixel,
    squared,
    stars_around,
    template_products,
)
from photutils_mgauss.kernels.jit import inner, kernel
from photutils_mgauss.kernels.linear import cholesky, solve_factored

# The covariance of a star is that with so many stars free, itself included.
MOST_TOGETHER = 9


class Phases(NamedTuple):
    """
    Stamps (cells along y, along x, phases of y, of x, 2h + 1, 2h + 1).

    A star stands in the middle of its part of the central pixel. Each serves
    for cell x cell pixels.
    """

    stamps: np.ndarray
    cell: int


class Points(NamedTuple):
    """Where in an image the points of a grid are, x and y (ny, nx)."""

    x: np.ndarray
    y: np.ndarray


class Evidence(NamedTuple):
    """
    What an image says of a star at each point of a grid (ny, nx).

    The gradient of half of -chi2 by its flux, the information on it, and both
    of a star beside which nothing is free.
    """

    gradient: np.ndarray
    information: np.ndarray
    bare_gradient: np.ndarray
    bare: np.ndarray


@inner
def _phase(value, n):
    """Return the pixel a position is in, and in which of its n parts."""
    pixel = int(np.rint(value))
    return pixel, min(max(int(floor((value - pixel + 0.5) * n)), 0), n - 1)


@kernel
def evidence(points, phases, weight, residual, out):
    """Ask at each point of a grid what an image says of a star there."""
    stamps, cell = phases
    n = stamps.shape[2]
    ny, nx = residual.shape
    for row in range(out.gradient.shape[0]):
        for column in range(out.gradient.shape[1]):
            x, part_x = _phase(points.x[row, column], n)
            y, part_y = _phase(points.y[row, column], n)
            g = info = bare_g = bare = 0.0
            if 0 <= x < nx and 0 <= y < ny:
                template = stamps[y // cell, x // cell, part_y, part_x]
                g, info, bare_g, bare = isolated(
                    x, y, template, squared(template), weight, residual)
            out.gradient[row, column] = g
            out.information[row, column] = info
            out.bare_gradient[row, column] = bare_g
            out.bare[row, column] = bare


@kernel
def evidence_beside(column, row, fit, points, phases, planes, limits, side,
                    wanted, scratch, out):
    r"""
    Ask again at points close to stars, with these free to readjust.

    Stars are near column and row (n,) of the grid. Points that are not wanted
    (ny, nx) get nothing. With what `score_beside` calls g, h, a, N, n and v,

    .. math::

        i = h - a^T N^{-1} a, \quad (g - a^T N^{-1} n) \frac{i}{i + v}, \quad
        \frac{i^2}{i + v}

    are gradient and information; 0 where less than the fraction least of h is
    left. No point within limits.reach of a star is more than side points of
    the grid off.
    """
    members, _, _, sums = scratch
    stamps, cell = phases
    px, py, _ = fit.sources
    weight, residual, light = planes
    ny, nx = residual.shape
    n_rows, n_columns = wanted.shape
    n = stamps.shape[2]
    reach = limits.reach
    for i in range(px.size):
        middle, centre = int(np.rint(row[i])), int(np.rint(column[i]))
        for v in range(max(0, middle - side), min(n_rows, middle + side + 1)):
            for u in range(max(0, centre - side),
                           min(n_columns, centre + side + 1)):
                at_x, at_y = points.x[v, u], points.y[v, u]
                if (px[i] - at_x)**2 + (py[i] - at_y)**2 > reach * reach:
                    continue
                count = stars_around(at_x, at_y, i, px, py, fit.pairs.indptr,
                                     fit.pairs.neighbour, limits.free,
                                     members)
                if count == 0:
                    continue
                out.gradient[v, u] = out.information[v, u] = 0.0
                x, part_x = _phase(at_x, n)
                y, part_y = _phase(at_y, n)
                if not (wanted[v, u] and 0 <= x < nx and 0 <= y < ny):
                    continue
                template = stamps[y // cell, x // cell, part_y, part_x]
                if not template_products(x, y, template, weight, residual,
                                         light, sums):
                    continue
                strength, flux = score_pixel(x, y, count, fit, template,
                                             weight, limits.least, scratch)
                if flux != 0:
                    known = (strength / flux)**2
                    out.gradient[v, u] = flux * known
                    out.information[v, u] = known


# Image k shows a star at the place F_k q: q are the p numbers that all images
# have in common, its column and row and what else moves it, and F_k (2, p),
# the same for all stars, are the factors of the image.

class Together(NamedTuple):
    """
    Stars fitted with up to `MOST_TOGETHER` - 1 of their neighbours.

    Star i is the first of the first count[i] of members (n, m); free (n, p m,
    p m) is the information on what places are made of, and in the end its
    inverse.
    """

    members: np.ndarray
    count: np.ndarray
    free: np.ndarray


class Work(NamedTuple):
    """Scratch: the matrix of some stars, the fluxes' own, and their share."""

    whole: np.ndarray
    light: np.ndarray
    share: np.ndarray
    scale: np.ndarray


@inner
def _divide(i, together, stars, pairs, factors, where, work):
    """
    Put the matrix of a star and its neighbours into work, fluxes apart.

    light becomes the factor of the fluxes' own matrix, with a diagonal of 1
    before, and share (m, p m) that times what couples fluxes to places.
    """
    members, count = together.members[i], together.count[i]
    whole, light, share, scale = work
    p = factors.shape[1]
    joint_matrix(members, count, stars.matrix, stars.blocks, pairs.indptr,
                 pairs.neighbour, where, whole)
    for a in range(count):
        for b in range(count):
            light[a, b] = whole[3 * a, 3 * b]
            for q in range(p):
                share[a, p * b + q] = (
                    whole[3 * a, 3 * b + 1] * factors[0, q]
                    + whole[3 * a, 3 * b + 2] * factors[1, q])
    scale_matrix(light, count, scale)
    cholesky(light, count, 1e-12)
    for a in range(count):
        for b in range(p * count):
            value = scale[a] * share[a, b]
            for c in range(a):
                value -= light[a, c] * share[c, b]
            share[a, b] = value / light[a, a]


class Ties(NamedTuple):
    """
    Which fluxes (E, n) are one unknown, and how images see it.

    The flux of star i in image k is scale[k, i] times number slot[k, i] of
    the unknowns, of which there are ``size``; first[k, i] says whether k is
    the first image with that number.
    """

    slot: np.ndarray
    scale: np.ndarray
    first: np.ndarray
    size: int


class Fluxes(NamedTuple):
    """
    Scratch: the fluxes of some stars in all images as unknowns of their own.

    local (E, m) are their numbers, start (s,) the first that each is coupled
    to, matrix (s, s), share (s, p m) and scale (s,) as in `Work`.
    """

    local: np.ndarray
    start: np.ndarray
    matrix: np.ndarray
    share: np.ndarray
    scale: np.ndarray


@inner
def _number(members, count, ties, local, start):
    """
    Give the fluxes of some stars numbers, and return how many there are.

    Those of one image alone come first, image by image: these are coupled to
    those of their image only.
    """
    n_images, size = local.shape[0], 0
    for k in range(n_images):
        low = size
        for a in range(count):
            i = members[a]
            local[k, a] = -1
            alone = ties.first[k, i]
            for j in range(k + 1, n_images):
                alone = alone and ties.slot[j, i] != ties.slot[k, i]
            if alone:
                local[k, a], start[size] = size, low
                size += 1
    for k in range(n_images):
        for a in range(count):
            i = members[a]
            if local[k, a] >= 0:
                continue
            for j in range(k):
                if ties.slot[j, i] == ties.slot[k, i]:
                    local[k, a] = local[j, a]
            if local[k, a] < 0:
                local[k, a], start[size] = size, 0
                size += 1
    return size


@inner
def _factor(size, fluxes, columns):
    """
    Make the matrix of fluxes its factor, share what that leaves of share.

    Its diagonal becomes 1 before. Nothing is looked at left of start.
    """
    _, start, a, share, scale = fluxes
    for r in range(size):
        scale[r] = 1 / sqrt(a[r, r]) if a[r, r] > 0 else 0.0
    for r in range(size):
        for c in range(start[r], r):
            value = a[r, c] * scale[r] * scale[c]
            for d in range(max(start[r], start[c]), c):
                value -= a[r, d] * a[c, d]
            a[r, c] = value / a[c, c]
        pivot = 1.0
        for d in range(start[r], r):
            pivot -= a[r, d] * a[r, d]
        # A flux that is lost to rounding is taken to be known.
        a[r, r] = sqrt(pivot) if pivot > 1e-12 else 1e15
        for b in range(columns):
            value = scale[r] * share[r, b]
            for d in range(start[r], r):
                value -= a[r, d] * share[d, b]
            share[r, b] = value / a[r, r]


@inner
def _add_image(k, count, factors, scale, members, whole, fluxes, free):
    """Add the matrix of an image to those of fluxes, share and free."""
    p = factors.shape[2]
    local = fluxes.local
    for a in range(count):
        own, row = scale[k, members[a]], local[k, a]
        for b in range(count):
            fluxes.matrix[row, local[k, b]] += (
                own * scale[k, members[b]] * whole[3 * a, 3 * b])
            for q in range(p):
                fluxes.share[row, p * b + q] += own * (
                    whole[3 * a, 3 * b + 1] * factors[k, 0, q]
                    + whole[3 * a, 3 * b + 2] * factors[k, 1, q])
    for a in range(p * count):
        at, q = 3 * (a // p), a % p
        for b in range(a + 1):
            to, r = 3 * (b // p), b % p
            for c in range(2):
                for d in range(2):
                    free[a, b] += (factors[k, c, q] * factors[k, d, r]
                                   * whole[at + 1 + c, to + 1 + d])


@kernel(allocates=True)
def add_places(first, stars, pairs, factors, ties, together):
    """
    Add what all images say of places, fluxes free, to together.free.

    Of stars from the first on; members are made here and stay. The matrix (E,
    n, 3, 3) and the blocks of stars have all images.
    """
    (n_images, _, p), m = factors.shape, together.members.shape[1]
    whole = np.empty((3 * m, 3 * m))
    most = n_images * m
    fluxes = Fluxes(np.empty((n_images, m), np.int64),
                    np.empty(most, np.int64), np.empty((most, most)),
                    np.empty((most, p * m)), np.empty(most))
    where = np.full(stars.matrix.shape[1], -1)
    for i in range(together.count.size):
        members, free = together.members[i], together.free[i]
        count = together.count[i] = members_of(
            first + i, pairs.indptr, pairs.neighbour, members)
        size = _number(members, count, ties, fluxes.local, fluxes.start)
        for r in range(size):
            for c in range(size):
                fluxes.matrix[r, c] = 0.0
            for c in range(p * count):
                fluxes.share[r, c] = 0.0
        for k in range(n_images):
            joint_matrix(members, count, stars.matrix[k], stars.blocks[k],
                         pairs.indptr, pairs.neighbour, where, whole)
            _add_image(k, count, factors, ties.scale, members, whole, fluxes,
                       free)
        _factor(size, fluxes, p * count)
        for a in range(p * count):
            for b in range(a + 1):
                for s in range(size):
                    free[a, b] -= fluxes.share[s, a] * fluxes.share[s, b]
                free[b, a] = free[a, b]


@kernel(allocates=True)
def invert_places(together):
    """
    Overwrite together.free by its inverse, NaN where it has none.

    Stars that cannot be told from all of their neighbours are taken with the
    nearest ones only, the others where they are.
    """
    largest, m = together.free.shape[1], together.members.shape[1]
    p = largest // m
    scale, column = np.empty(largest), np.empty(largest)
    factor = np.empty((largest, largest))
    for i in range(together.count.size):
        free, whole = together.free[i], p * together.count[i]
        count, solved = together.count[i], False
        while count > 0 and not solved:
            size = p * count
            for a in range(size):
                for b in range(size):
                    factor[a, b] = free[a, b]
            scale_matrix(factor, size, scale)
            solved = cholesky(factor, size, 1e-12)
            for a in range(p):
                solved = solved and scale[a] > 0
            if not solved:
                count //= 2
        for a in range(whole):
            for b in range(whole):
                free[a, b] = 0.0 if solved else np.nan
        for a in range(p * count):
            for b in range(p * count):
                column[b] = 1.0 if a == b else 0.0
            solve_factored(factor, p * count, column)
            for b in range(p * count):
                free[a, b] = column[b] * scale[a] * scale[b]


@kernel(allocates=True)
def flux_variances(stars, pairs, factors, together, variance, correlation):
    """
    Put the variances of fluxes in an image into variance (n,).

    together.free is the covariance of places in all images. correlation (n,)
    takes that with the flux of the first neighbour, 0 if there is none.
    """
    m, p = together.members.shape[1], factors.shape[1]
    work = Work(np.empty((3 * m, 3 * m)), np.empty((m, m)),
                np.empty((m, p * m)), np.empty(m))
    where = np.full(stars.matrix.shape[0], -1)
    columns, gains = np.empty((2, m)), np.empty((2, p * m))
    for i in range(together.count.size):
        _divide(i, together, stars, pairs, factors, where, work)
        count = together.count[i]
        products = np.zeros((2, 2))
        for s in range(min(count, 2)):
            _light_column(s, count, work, columns[s])
            for b in range(p * count):
                gains[s, b] = 0.0
                for a in range(count):
                    gains[s, b] += columns[s, a] * work.share[a, b]
        for s in range(min(count, 2)):
            for t in range(s + 1):
                value = 0.0
                for a in range(count):
                    value += columns[s, a] * columns[t, a]
                for a in range(p * count):
                    for b in range(p * count):
                        value += (gains[s, a] * together.free[i, a, b]
                                  * gains[t, b])
                products[s, t] = value * work.scale[s] * work.scale[t]
        known = work.scale[0] > 0
        variance[i] = products[0, 0] if known else np.nan
        correlation[i] = 0.0
        if known and count > 1 and work.scale[1] > 0:
            correlation[i] = products[1, 0] / sqrt(products[0, 0]
                                                   * products[1, 1])


@inner
def _light_column(s, count, work, out):
    """Put column s of the inverse of the factor of fluxes into out."""
    for a in range(count):
        value = 1.0 if a == s else 0.0
        for c in range(s, a):
            value -= work.light[a, c] * out[c]
        out[a] = value / work.light[a, a] if a >= s else 0.0


# The unknowns of the equations of E images with n stars are one flat vector:
# the fluxes, p numbers for the places of each star, then the levels of the
# nodes of each image's background.

@kernel
def apply_shared(k, factors, ties, first, v, stars, pairs, mesh, scratch,
                 out):
    """
    Add the product of the equations of image k with v to out.

    factors (E, 2, p) are those of all images. Its levels begin at first;
    scratch is (2, 3 n + m).
    """
    n, p = stars.matrix.shape[0], factors.shape[2]
    own, product = scratch[0], scratch[1]
    slot, scale, place = ties.slot, ties.scale, ties.size
    for i in range(n):
        own[3 * i] = scale[k, i] * v[slot[k, i]]
        x = y = 0.0
        for q in range(p):
            x += factors[k, 0, q] * v[place + p * i + q]
            y += factors[k, 1, q] * v[place + p * i + q]
        own[3 * i + 1], own[3 * i + 2] = x, y
    m = mesh.diagonal.size
    for i in range(m):
        own[3 * n + i] = v[first + i]
    apply_joint(own, stars, pairs, mesh, product)
    for i in range(n):
        out[slot[k, i]] += scale[k, i] * product[3 * i]
        for q in range(p):
            out[place + p * i + q] += (
                factors[k, 0, q] * product[3 * i + 1]
                + factors[k, 1, q] * product[3 * i + 2])
    for i in range(m):
        out[first + i] += product[3 * n + i]


class Blocks(NamedTuple):
    """
    What the inverses of stars' own blocks, and of nodes, are made of.

    Which fluxes are one, ties, the inverse of the diagonal of each, own (E,
    n), where it comes first, what couples these to places, share (E, n, p),
    the inverse of what is left of the places' blocks, free (n, p, p), and that
    of the nodes' diagonals, level (m,).
    """

    ties: Ties
    own: np.ndarray
    share: np.ndarray
    free: np.ndarray
    level: np.ndarray


@kernel(allocates=True)
def precondition_shared(blocks, r, z):
    """Put the inverse blocks times r into z; return the product of both."""
    ties, own, share, free, level = blocks
    (n_images, n), p = own.shape, free.shape[1]
    place, left = ties.size, np.empty(p)
    product = 0.0
    for i in range(n):
        at = place + p * i
        for q in range(p):
            left[q] = r[at + q]
            for k in range(n_images):
                if ties.first[k, i]:
                    left[q] -= (share[k, i, q] * r[ties.slot[k, i]]
                                * own[k, i])
        for q in range(p):
            z[at + q] = 0.0
            for s in range(p):
                z[at + q] += free[i, q, s] * left[s]
            product += r[at + q] * z[at + q]
        for k in range(n_images):
            if not ties.first[k, i]:
                continue
            slot = ties.slot[k, i]
            light = r[slot]
            for q in range(p):
                light -= share[k, i, q] * z[at + q]
            z[slot] = own[k, i] * light
            product += r[slot] * z[slot]
    first = place + p * n
    for m in range(level.size):
        z[first + m] = r[first + m] * level[m]
        product += r[first + m] * z[first + m]
    return product


@kernel
def advance(length, v, a, step, r):
    """Take a step of conjugate gradients; a is the matrix times v."""
    product = 0.0
    for i in range(v.size):
        product += v[i] * a[i]
    for i in range(v.size):
        step[i] += length / product * v[i]
        r[i] -= length / product * a[i]
