"""
The fit of all stars, each with the neighbours it cannot be told from.

Stars close to each other are one group, fitted together. Light of all other
stars is subtracted from the images with the values of the last round, until
nothing moves any more.
"""
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from photutils_mgauss.photometry.joint_pixels import (
    JointFit,
    State,
    Views,
    boxes_around,
    fixed_inverse,
)
from photutils_mgauss.pixel_motions.posterior import posterior
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.utils.parallel import map_parallel
from photutils_mgauss.utils.waiting import progress

# Neighbours nearer than this are fitted together, in units of the PSF's FWHM,
# and at most so many: a group of more costs more than it brings.
_LINK = 1.5
_MOST = 6

# How often the light of others is subtracted anew, and what change of a place,
# in standard errors, is small.
_ROUNDS = 8
_SETTLED = 0.03

# What chi2 a last step may be worth: a thousandth of a standard error.
_LEAST_GAIN = 1e-6

# The WCS counts as a linear map as far as this [pix].
_LINEAR = 0.5

# Stars whose place in an image is less sure than this, in units of the PSF's
# FWHM, are means of their probability.
_UNSURE = 0.06

# Where a Gaussian of a subtracted star ends, in units of the noise.
_FAINTEST = 1e-3


@dataclass(frozen=True, eq=False)
class Solved:
    """
    What the fit found for n stars in E images.

    Attributes
    ----------
    values : (n, p) `~numpy.ndarray`
    pixels : (n, E, 2) `~numpy.ndarray`
        Where the stars are seen.
    slopes : (n, E, 2, p) `~numpy.ndarray`
        Their derivatives by the parameters.
    fluxes : (n, E) `~numpy.ndarray`
        In units of the fit.
    sky : (n, E) `~numpy.ndarray`
    curves : (n, E, 2, 2) `~numpy.ndarray`
        Products of the PSF's derivatives, a flux of 1.
    pulls : (n, E, 2) `~numpy.ndarray`
        Half the slopes of -chi2 by the places.
    weights : (n, E) `~numpy.ndarray`
        Inverse variances of fluxes at fixed places, one image alone.
    excess : (n, E) `~numpy.ndarray`
        Products of the PSF with what is left of the data.
    spread : (n, p, p) `~numpy.ndarray`
        Mean squares of the probability of faint stars; NaN for the others.
    groups, states : list
        The stars (g, m) of groups of each size, and their
        `~photutils_mgauss.photometry.joint_pixels.State`.
    given : (n, E, 2) `~numpy.ndarray`
        Where stars of the values given would be seen.
    """

    values: np.ndarray
    pixels: np.ndarray
    slopes: np.ndarray
    free: np.ndarray
    enough: np.ndarray
    converged: np.ndarray
    chi2: np.ndarray
    n_pixels: np.ndarray
    fluxes: np.ndarray
    sky: np.ndarray
    curves: np.ndarray
    pulls: np.ndarray
    weights: np.ndarray
    excess: np.ndarray
    spread: np.ndarray
    groups: list
    states: list
    given: np.ndarray


def solve(campaign, values, fit_shape, *, reach, forced, executor,
          progress_bar):
    """
    Fit stars (n, p) to all images; return their `Solved`.

    Faint ones stay within ``reach``, in units of the PSF's FWHM; None leaves
    all at the peaks of their likelihood. Stars whose place is not finite, or
    that no image shows, are left out of the fit and get no pixels.
    """
    views = campaign.views(values[:, None])
    pixels = views.pixels[:, :, 0]
    groups = _groups(campaign, pixels)
    near = _has_neighbours(pixels, campaign, fit_shape)
    fit_all = partial(_fit_all, groups=groups, fit_shape=fit_shape,
                      forced=forced, given=pixels, spread_over=partial(
                          _spread_over, executor, progress_bar))
    region = (None if forced or reach is None else
              _Region.of(campaign, values, reach))
    if not near:
        return fit_all(campaign, values, views=views, own=None,
                       region=region)
    own, moved = None, np.inf
    for _ in range(_ROUNDS):
        state = fit_all(campaign, values, views=views, own=own)
        views = None
        moved = _moved(state, values)
        values = state.values
        if own is not None and moved < _SETTLED:
            break
        campaign, own = _subtract(campaign, state)
    return fit_all(campaign, values, own=own, region=region)


@dataclass(frozen=True, eq=False)
class _Region:
    """
    Where faint stars are thought to be.

    Within ``reach`` (E,) [pix] of the places of given values (n, m, p), in
    images of PSFs of some FWHM (E,). Fluxes of the same number in ``alike``
    (C,) are those of one band.
    """

    given: np.ndarray
    reach: np.ndarray
    widths: np.ndarray
    alike: np.ndarray

    @classmethod
    def of(cls, campaign, values, reach):
        widths = np.array([fwhm(epoch) for epoch in campaign.epochs])
        return cls(values, reach * widths, widths, campaign.bands)

    def take(self, rows):
        return replace(self, given=self.given[rows])


def _groups(campaign, pixels):
    """Return lists of stars to be fitted together, arrays of one size each."""
    radius = _LINK * max(map(fwhm, campaign.epochs))
    pairs = {}
    for k in range(campaign.n_images):
        seen = np.flatnonzero(np.isfinite(pixels[:, k]).all(axis=1))
        if not seen.size:
            continue
        tree = cKDTree(pixels[seen, k])
        for a, b in tree.query_pairs(radius, output_type='ndarray'):
            pair = int(seen[a]), int(seen[b])
            away = float(np.hypot(*(pixels[pair[0], k] - pixels[pair[1], k])))
            pairs[pair] = min(away, pairs.get(pair, np.inf))
    return _joined(len(pixels), sorted(pairs, key=pairs.get))


def _joined(n, pairs):
    """Return arrays (g, m) of the members of groups, for each size m."""
    home = np.arange(n)
    members = {k: [k] for k in range(n)}
    for a, b in pairs:
        first, second = home[a], home[b]
        if first == second or (len(members[first]) + len(members[second])
                               > _MOST):
            continue
        for star in members[second]:
            home[star] = first
        members[first] += members.pop(second)
    sizes = {len(group) for group in members.values()}
    return [np.array([group for group in members.values()
                      if len(group) == size]) for size in sorted(sizes)]


def fwhm(epoch):
    """Return the FWHM of a Gaussian as wide as the PSF's core [pix]."""
    ny, nx = epoch.pixels.shape
    stamp = np.zeros((41, 41))
    MixtureRenderer(epoch.model).add(
        np.array([[(nx - 1) / 2], [(ny - 1) / 2], [1.0]]), 1e-6,
        np.rint((nx - 1) / 2) - 20, np.rint((ny - 1) / 2) - 20, stamp)
    return np.sqrt(8 * np.log(2) / (4 * np.pi * np.sum(stamp**2)))


def _has_neighbours(pixels, campaign, fit_shape):
    """Return whether light of a star falls into the box of another."""
    reach = max(fit_shape) + 2 * max(map(fwhm, campaign.epochs))
    for k in range(campaign.n_images):
        seen = np.isfinite(pixels[:, k]).all(axis=1)
        if seen.sum() > 1:
            away, _ = cKDTree(pixels[seen, k]).query(pixels[seen, k], k=2)
            if (away[:, 1] < reach).any():
                return True
    return False


def _fit_all(campaign, values, *, groups, fit_shape, forced, given, own,
             spread_over, views=None, region=None):
    """
    Fit all groups once, the WCS taken anew where stars have moved.

    ``views`` are those of all stars, one by one, if they are at hand.
    """
    parts = []
    every = campaign.views(values[:, None]) if views is None else views
    for group in groups:
        views = _joined_views(every, group)
        moving = np.arange(len(group))
        done = None
        for _ in range(3):
            fit = _fit_of(campaign, views, fit_shape, forced,
                          None if own is None else
                          own[group[moving]].transpose(0, 2, 1, 3))
            got = _minimize(fit, spread_over, None if region is None else
                            region.take(group[moving]))
            done = got if done is None else _replaced(done, moving, got)
            at = np.flatnonzero(_shift(got) > _LINEAR)
            if forced or not at.size:
                break
            moving = moving[at]
            views = campaign.views(got.state.values[at])
        parts.append((group, done))
    return _collect(campaign, values, parts, given)


def _joined_views(every, group):
    """Return the views of groups (g, m) from those of single stars."""
    pixels, slopes = (np.swapaxes(one[:, :, 0][group], 1, 2)
                      for one in (every.pixels, every.slopes))
    return Views(every.values[:, 0][group], pixels, slopes)


@dataclass(frozen=True, eq=False)
class _Part:
    """A fit that has come to its end, group by group."""

    state: State
    converged: np.ndarray
    spread: np.ndarray
    pixels: np.ndarray
    start: np.ndarray
    slopes: np.ndarray
    free: np.ndarray
    enough: np.ndarray


def _fit_of(campaign, views, fit_shape, forced, own):
    """Return the `JointFit` of groups and whether all can be fitted."""
    n, n_images, m, _ = views.pixels.shape
    boxes = boxes_around(views.pixels, fit_shape, campaign.shapes)
    seen = boxes[..., 2:].all(axis=-1).transpose(0, 2, 1)
    free, enough = campaign.free(seen.reshape(n * m, n_images),
                                 campaign.years)
    free = np.zeros_like(free) if forced else free
    return (JointFit(campaign.joint, views, boxes, free.reshape(n, m, -1),
                     own, least_gain=_LEAST_GAIN), enough.reshape(n, m))


def _minimize(fit, spread_over, region):
    """Return the `_Part` of a fit, in pieces spread over threads."""
    fit, enough = fit
    parts = fit.parts()
    ends = np.cumsum([len(part.free) for part in parts])
    regions = [None if region is None else
               region.take(slice(end - len(part.free), end))
               for part, end in zip(parts, ends, strict=True)]
    results = spread_over(_run, parts, regions)
    state = State.joined([one for one, *_ in results])
    done, spread = (np.concatenate([one[i] for one in results])
                    for i in (1, 2))
    return _Part(state, done, spread,
                 fit.views.places(state.values, np.arange(len(fit.free))),
                 fit.views.pixels, fit.views.slopes, fit.free, enough)


def _spread_over(executor, progress_bar, work, fits, regions):
    """Return what work makes of all fits and regions."""
    results = map_parallel(work, fits, regions, executor=executor, long=True)
    return list(progress(results, desc='Fitting stars', total=len(fits),
                         shown=progress_bar))


def _run(fit, region):
    """Return the state of a fit, who converged, and the spread."""
    fit = replace(fit)  # the pixels it takes out go with it
    state, done = fit.minimize()
    n, m, p = state.values.shape
    spread = np.full((n, p, p), np.nan)
    faint = np.flatnonzero([] if region is None or m > 1 else
                           _are_faint(fit, state, region.widths))
    if faint.size:
        mean, square, good = posterior(fit, state, faint, region.given[faint],
                                       region.reach, region.alike)
        there = fit.evaluate(np.nan_to_num(mean)[:, None], faint)
        state.put(faint, there, good)
        spread[faint[good]] = square[good]
    return state, done, spread


def _are_faint(fit, state, widths):
    """Return whether the places of single stars (g,) are unsure somewhere."""
    inverses, known = fixed_inverse(state.matrix, fit.free[:, 0])
    slopes = fit.views.slopes[:, :, 0]
    variance = np.einsum('neip,npq,neiq->ne', slopes, inverses, slopes,
                         optimize=True) / 2
    unsure = (state.n_pixels > 0) & (variance > (_UNSURE * widths)**2)
    return known.any(axis=1) & unsure.any(axis=1)


def _shift(part):
    """Return by how many pixels (g,) groups moved from where they started."""
    seen = part.state.n_pixels[:, :, None, None] > 0
    return np.where(seen, np.nan_to_num(np.abs(part.pixels - part.start)),
                    0).max(axis=(1, 2, 3))


def _replaced(part, rows, other):
    """Return a part with the results of another in some rows."""
    out = []
    for f in fields(_Part):
        old, new = getattr(part, f.name), getattr(other, f.name)
        if isinstance(old, State):
            old.put(rows, new, np.ones(len(rows), bool))
        else:
            old[rows] = new
        out.append(old)
    return _Part(*out)


def _collect(campaign, values, parts, given):
    """Return the `Solved` of all stars, from groups of all sizes."""
    n, n_images, p = len(values), campaign.n_images, values.shape[1]
    shared = campaign.joint.shared
    out = Solved(
        values.copy(), np.full((n, n_images, 2), np.nan),
        np.zeros((n, n_images, 2, p)), np.zeros((n, p), bool),
        np.zeros(n, bool), np.zeros(n, bool), np.zeros(n),
        np.zeros((n, n_images), int), np.zeros((n, n_images)),
        np.zeros((n, n_images)), np.zeros((n, n_images, 2, 2)),
        np.zeros((n, n_images, 2)), np.zeros((n, n_images)),
        np.zeros((n, n_images)), np.full((n, p, p), np.nan),
        [group for group, _ in parts], [part.state for _, part in parts],
        given)
    for group, part in parts:
        state = part.state
        for c in range(group.shape[1]):
            rows = group[:, c]
            out.values[rows] = state.values[:, c]
            out.pixels[rows] = part.pixels[:, :, c]
            out.slopes[rows] = part.slopes[:, :, c]
            out.free[rows], out.enough[rows] = (part.free[:, c],
                                                part.enough[:, c])
            out.converged[rows], out.chi2[rows] = part.converged, state.chi2
            out.n_pixels[rows], out.sky[rows] = state.n_pixels, state.sky
            out.fluxes[rows] = state.fluxes[:, shared, c]
            out.curves[rows] = state.curves[:, :, c, :, c]
            out.pulls[rows] = state.slopes[:, :, c]
            out.weights[rows] = state.weights[:, :, c]
            out.excess[rows] = state.excess[:, :, c]
        if group.shape[1] == 1:
            out.spread[group[:, 0]] = part.spread
    return out


def _moved(state, values):
    """Return the largest change of a star's place in standard errors."""
    change = state.values - values
    shift = np.einsum('neip,np->nei', state.slopes, change)
    curve = np.einsum('neij,ne->neij', state.curves, state.fluxes**2)
    length = np.einsum('nei,neij,nej->n', shift, curve, shift)
    return float(np.sqrt(length.max(initial=0.0)))


def _subtract(campaign, state):
    """Return the campaign without the light of all stars, and that light."""
    own = np.concatenate([state.fluxes[..., None], state.pixels], axis=2)
    own[~np.isfinite(own).all(axis=2) | (state.n_pixels == 0)] = 0
    lights = []
    for k, epoch in enumerate(campaign.epochs):
        there = own[:, k, 0] != 0
        flux, x, y = own[there, k].T
        lights.append(MixtureRenderer(epoch.model).image(
            np.stack([x, y, flux]), _FAINTEST, campaign.shapes[k]))
    return campaign.without(lights), own
