r"""
Errors of stars: those of the pixels, and those of the frames on top.

At a low signal the fluxes that weight the images are themselves noisy. The
matrix S of the fit has :math:`\hat f^2` where the slope of the likelihood has
:math:`\hat f^2 - \sigma_f^2` on average, A. The scatter of the minimum is

.. math:: \mathrm{Cov}(v) = A^{-1} S A^{-1},

which is :math:`S^{-1}` for bright stars. For the faintest the likelihood is
not even a Gaussian, and its sampled mean squares stand for these. The search
for the place makes fluxes too large, too, by

.. math:: \frac{\Delta f}{f} = \frac{1}{2 D} \sum_k \mathrm{tr}
    (G_k J_k S^{-1} J_k^T).
"""
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from photutils_mgauss.photometry.joint_pixels import fixed_inverse
from photutils_mgauss.psf.star_errors import StarPixels, known_errors
from photutils_mgauss.sky.tangent_plane import unit_vectors

# The least that A may be of S: below, the fit is no longer near its truth.
_LEAST = 0.3


@dataclass(frozen=True, eq=False)
class Errors:
    """
    Errors of n stars.

    Attributes
    ----------
    covariance : (p, p, n) `~numpy.ndarray`
        Of the parameters; NaN for what was not fitted or is not known.
    flux_error : (n, E) `~numpy.ndarray`
        Of the flux of each image, 1 alone or in common; NaN if not seen.
    flux_bias : (n, E) `~numpy.ndarray`
        The part of each flux that is due to the search for its place.
    plain : (n, p, p) `~numpy.ndarray`
        The inverses of S, 0 for what was not fitted.
    """

    covariance: np.ndarray
    flux_error: np.ndarray
    flux_bias: np.ndarray
    plain: np.ndarray


def errors_of(campaign, solved):
    """Return the `Errors` of a `Solved`."""
    n, p = solved.values.shape
    n_images = campaign.n_images
    covariance = np.full((n, p, p), np.nan)
    plain, variance = np.zeros((n, p, p)), np.full((n, n_images), np.nan)
    bias = np.zeros((n, n_images))
    for group, state in zip(solved.groups, solved.states, strict=True):
        whole, inverses, known = _covariances(
            campaign, solved.slopes[group], state, solved.free[group])
        spread = _flux_variance(state, whole)
        for c in range(group.shape[1]):
            rows, own = group[:, c], slice(c * p, c * p + p)
            unknown = ~known[:, own, None] | ~known[:, None, own]
            sampled = np.isfinite(solved.spread[rows])
            covariance[rows] = np.where(unknown, np.nan, np.where(
                sampled, solved.spread[rows], whole[:, own, own]))
            plain[rows] = inverses[:, own, own]
            variance[rows] = spread[:, campaign.joint.shared, c]
            bias[rows] = _bias(campaign, solved, rows,
                               inverses[:, own, own])
    variance = np.where(solved.weights > 0, variance, np.nan)
    return Errors(np.moveaxis(covariance, 0, -1), np.sqrt(variance), bias,
                  plain)


def _covariances(campaign, slopes, state, free):
    """Return covariances of groups (g, m p, m p), S^-1, and what is known."""
    g, m, _, _, p = slopes.shape
    size = m * p
    noise = state.known[:, campaign.joint.shared]
    turned = np.einsum('geij,geiajb->geiajb', noise, state.curves)
    half = np.einsum('geiajb,gjebq->geiajq', turned, slopes)
    drop = np.einsum('gieap,geiajq->gipjq', slopes, half).reshape(
        g, size, size)
    free = free.reshape(g, size)
    inverses, known = fixed_inverse(state.matrix, free)
    values, vectors = np.linalg.eigh(inverses)
    root = np.einsum('gij,gj,gkj->gik', vectors,
                     np.sqrt(np.maximum(values, 0)), vectors)
    loss, turn = np.linalg.eigh(root @ drop @ root)
    stretch = 1 / np.maximum(1 - loss, _LEAST)
    inner = np.einsum('gij,gj,gkj->gik', turn, stretch**2, turn)
    return root @ inner @ root, inverses, known


def _flux_variance(state, covariance):
    """Return the variances of fluxes (g, C, m)."""
    share = np.einsum('gcpm,gcmi->gcpi', state.cross, state.known)
    return np.einsum('gcmm->gcm', state.known) + np.einsum(
        'gcpi,gpq,gcqi->gci', share, covariance, share, optimize=True)


def _bias(campaign, solved, rows, covariance):
    """Return the relative bias of fluxes (r, E)."""
    slopes, curves = solved.slopes[rows], solved.curves[rows]
    spread = np.einsum('neip,npq,nejq->neij', slopes, covariance, slopes,
                       optimize=True)
    trace = np.einsum('neij,neij->ne', curves, spread)
    out = np.zeros(trace.shape)
    for c in range(campaign.joint.n_fluxes):
        same = campaign.joint.shared == c
        weight = solved.weights[rows][:, same].sum(axis=1)
        bias = 0.5 * trace[:, same].sum(axis=1) / np.where(weight > 0,
                                                           weight, 1)
        out[:, same] = bias[:, None]
    return np.minimum(out, 0.5)


def frame_covariance(known, campaign, solved, plain, refined=None):
    r"""
    Return what the errors of frames add to covariances, (p, p, n).

    A change r of the maps moves a star by :math:`S^{-1} \sum_k J_k^T W_k
    (\partial x / \partial \xi)_k A_k r`, with the basis A of the maps there.

    Parameters
    ----------
    known : `~photutils_mgauss.motions.frame_errors.FrameErrors`
        The frames are those of the WCS of the images.
    campaign, solved, plain
        The images, the stars, and the inverses of their matrices.
    refined : `~photutils_mgauss.pixel_motions.refine.Frames`, optional
        Where the pixels have given frames, what is left are those errors
        that all stars follow, as a map of the plane.
    """
    place = known.plane.project(
        campaign.plane.deproject(solved.values[:, :2].T))
    total = 0.0
    for k, e in enumerate(known.epochs_at(campaign.years)):
        total += _answers(solved, plain, k, np.einsum(
            'nix,nxq->niq', solved.slopes[:, k, :, :2],
            known.moves(e, place)))
    if refined is not None:
        total = refined.smooth(solved, total)
    return np.einsum('npq,nrq->prn', total, total)


def _answers(solved, plain, k, moved):
    """Return what places (n, 2, q) [pix] in image k do to stars (n, p, q)."""
    weight = solved.curves[:, k] * solved.fluxes[:, k, None, None]**2
    return plain @ (solved.slopes[:, k].transpose(0, 2, 1) @ weight @ moved)


def with_psf_errors(campaign, solved, errors, fit_shape, executor):
    """
    Return errors to which those of the PSFs have been added.

    PSFs that do not know their errors count as exact. The errors of one PSF
    are those of all images that have it.

    Parameters
    ----------
    campaign, solved, errors
        The images, the stars, and their `Errors`.
    fit_shape : (int, int)
    executor : `~concurrent.futures.Executor` or None
    """
    owners = {}
    for k, epoch in enumerate(campaign.epochs):
        known = known_errors(epoch.model)
        if known is not None and known.changes.size:
            owners.setdefault(id(known), []).append(k)
    covariance, variance = errors.covariance.copy(), errors.flux_error**2
    for images in owners.values():
        total = 0.0
        for k in images:
            shift = _psf_shifts(campaign, solved, k, fit_shape, executor)
            total += _answers(solved, errors.plain, k, shift[:, 1:])
            variance[:, k] += np.sum(shift[:, 0]**2, axis=1) * (
                solved.fluxes[:, k]**2)
        covariance += np.einsum('npq,nrq->prn', total, total)
    return replace(errors, covariance=covariance, flux_error=np.sqrt(variance))


def _psf_shifts(campaign, solved, k, fit_shape, executor):
    """Return relative fluxes, x and y (n, 3, R) that changes of a PSF give."""
    model = campaign.epochs[k].model
    seen = np.flatnonzero(solved.weights[:, k] > 0)
    values = np.column_stack([solved.fluxes[seen, k], solved.pixels[seen, k]])
    known = known_errors(model)
    out = np.zeros((len(solved.values), 3, known.changes.shape[1]))
    out[seen] = np.nan_to_num(StarPixels(
        campaign.joint.images[k].whole(), known, values, fit_shape,
        fit_sky=campaign.joint.fit_sky,
        integrated=model.pixel_integrated).shifts(executor))
    return out


def add_frame_errors(table, known, years):
    """
    Add errors of frames to the table of stars of a crowded field.

    In what a star's place and motion are made of an image counts as its
    signal-to-noise ratio squared.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Of `CrowdedMixturePhotometry.fit_images` with motions; changed.
    known : `~photutils_mgauss.motions.frame_errors.FrameErrors`
    years : (E,) sequence of float
        When the images were taken.
    """
    place = known.plane.project(unit_vectors(*(
        table[name].to_value(u.deg) for name in ('ra', 'dec'))))
    local = np.moveaxis(known.plane.local_inverse(place), -1, 0)
    weight = np.nan_to_num(np.asarray(table['flux'] / table['flux_err']))**2
    time = np.asarray(years) - table['ref_epoch'][:1].to_value(u.yr)
    shares = _shares(weight, time)
    total = sum(shares[:, :, k, None, None] * (
        local @ known.moves(e, place))[:, None]
        for k, e in enumerate(known.epochs_at(years)))
    for more, names, cross in zip(
            np.einsum('ntxq,ntyq->tnxy', total, total),
            (('ra', 'dec'), ('pmra', 'pmdec')),
            ('radec_cov', 'pmra_pmdec_corr'), strict=True):
        _add_covariance(table, more, names, cross)


def _shares(weight, time):
    """Return what places and motions have (n, 2, E) of places in images."""
    whole = np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    mean = weight @ time[:, None] / whole
    lever = weight * (time - mean)
    known = np.sum(lever * (time - mean), axis=1, keepdims=True)
    motion = np.divide(lever, known, where=known > 0,
                       out=np.zeros(lever.shape))
    return np.stack([weight / whole - mean * motion, motion], axis=1)


def _add_covariance(table, more, names, cross):
    """Add covariances (n, 2, 2) to two errors and what joins them."""
    errors = [table[f'{name}_error'] for name in names]
    before = [one.value.copy() for one in errors]
    for i, one in enumerate(errors):
        one[:] = np.hypot(before[i], np.sqrt(more[:, i, i])) * one.unit
    if cross.endswith('cov'):
        table[cross] += more[:, 0, 1] * table[cross].unit
        return
    table[cross] = (table[cross] * before[0] * before[1] + more[:, 0, 1]) / (
        errors[0].value * errors[1].value)
