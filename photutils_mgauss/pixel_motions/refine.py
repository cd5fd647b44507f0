r"""
Frames and bright stars from the pixels, in one system.

The WCS of image k puts a star at the place :math:`\xi` of the plane; its
frame moves that by :math:`\theta_k b(\xi)`, an affine map. With the matrices
:math:`P_{ik}` of places in the plane, that the pixels of star i in image k
give, and the factors :math:`F_k` of its parameters, the stars can be
eliminated from the joint equations:

.. math::

    N_{kl} = \sum_i \left(\delta_{kl} P_{ik}
    - P_{ik} F_k S_i^{-1} F_l^T P_{il}\right) \otimes b_i b_i^T .

A map that all stars follow, as their places or their motions can, is seen by
no image: such maps are zero here, and only references know them.
"""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.photometry.joint_pixels import fixed_inverse
from photutils_mgauss.pixel_motions.tables import significance
from photutils_mgauss.sky.corrected_wcs import Region, corrected_wcs
from photutils_mgauss.sky.correction import Correction
from photutils_mgauss.sky.transforms import Transform

# Frames follow stars of at least this signal to noise in all images, and
# images with fewer of them keep theirs.
_BRIGHT, _FEW = 25.0, 6

# Frames are found when they move by less than this part of their errors.
_SETTLED, _ROUNDS = 0.1, 5

# Of the largest eigenvalue, what says nothing.
_NOTHING = 1e-8

TOO_FEW = ('The images {where} show fewer than {few} stars of a significance '
           'above {bright:.0f} and keep their WCS; refine_frames needs so '
           'many.')


@dataclass(frozen=True, eq=False)
class Frames:
    """
    What the pixels say of the frames.

    Attributes
    ----------
    transform : `~photutils_mgauss.sky.transforms.Transform`
    maps : (E, 2, 3) `~numpy.ndarray`
        What is added to places of the plane [mas].
    factor : (E, 2, 3, q) `~numpy.ndarray`
        Independent errors of the maps.
    notes : tuple of str
    """

    transform: Transform
    maps: np.ndarray
    factor: np.ndarray
    notes: tuple

    def smooth(self, solved, shifts):
        """Return shifts (n, p, q) of stars as maps of the plane give them."""
        basis = np.nan_to_num(self.transform.basis(_places(solved)))
        there = np.abs(shifts).sum(axis=(1, 2)) > 0
        flat = shifts.reshape(len(shifts), -1)
        maps = np.linalg.lstsq(basis[:, there].T, flat[there], rcond=None)[0]
        return (basis.T @ maps).reshape(shifts.shape)

    def covariance(self, campaign, solved):
        """Return what their errors add to those of stars, (p, p, n)."""
        basis = self.transform.basis(_places(solved))
        matrices, slopes = _matrices(campaign, solved)
        inverses, _ = _stars(matrices, slopes, solved.free)
        moved = np.einsum('kabq,bn->nkaq', self.factor, np.nan_to_num(basis))
        total = inverses @ np.einsum('nkap,nkac,nkcq->npq', slopes, matrices,
                                     moved, optimize=True)
        return np.einsum('npq,nrq->prn', total, total)


def refined(campaign, solve):
    """
    Return a campaign with refined WCS, its stars, and the last `Frames`.

    Parameters
    ----------
    campaign : `~photutils_mgauss.pixel_motions.campaign.Campaign`
    solve : callable
        Returns the `~photutils_mgauss.pixel_motions.solve.Solved` of the
        peaks of all stars of a campaign.
    """
    for _ in range(_ROUNDS):
        solved = solve(campaign)
        frames = find_frames(campaign, solved)
        campaign = replace(campaign, epochs=[
            _moved(campaign, frames, k) for k in range(campaign.n_images)])
        error = np.sqrt(np.sum(frames.factor**2, axis=-1))
        if (np.abs(frames.maps) <= _SETTLED * error).all():
            break
    return campaign, frames


def find_frames(campaign, solved):
    """Return the `Frames` that bright stars give."""
    bright = (solved.converged & solved.enough
              & (significance(solved) > _BRIGHT))
    seen = bright[:, None] & (solved.weights > 0)
    counts = seen.sum(axis=0)
    used = np.flatnonzero(counts >= _FEW)
    where = ', '.join(map(str, np.flatnonzero(counts < _FEW)))
    notes = (TOO_FEW.format(where=where, few=_FEW, bright=_BRIGHT),
             ) if where else ()
    points = _places(solved)
    transform = Transform('affine')
    shape = (campaign.n_images, 2, 3)
    maps, factor = np.zeros(shape), np.zeros((*shape, 0))
    if used.size:
        transform = transform.fitted_to(points[:, bright])
        normal, pull, gauge = _equations(campaign, solved, bright, used,
                                         transform)
        values, vectors = _eigen(normal, gauge)
        factor = np.zeros((*shape, values.size))
        factor[used] = (vectors / np.sqrt(values)).reshape(
            used.size, 2, 3, -1)
        maps[used] = (vectors @ (vectors.T @ pull / values)).reshape(
            used.size, 2, 3)
    return Frames(transform, maps, factor, notes)


def _places(solved):
    return solved.values[:, :2].T


def _matrices(campaign, solved):
    """Return P (n, E, 2, 2) and the factors F (n, E, 2, p)."""
    to_pixels = solved.slopes[..., :2]
    curve = solved.curves * solved.fluxes[..., None, None]**2
    matrices = np.einsum('nkia,nkij,nkjb->nkab', to_pixels, curve, to_pixels,
                         optimize=True)
    factors = np.stack(campaign.factors(np.nan_to_num(_places(solved))))
    return matrices, np.moveaxis(np.broadcast_to(factors, (
        *factors.shape[:3], len(solved.values))), 3, 0)


def _stars(matrices, slopes, free):
    """Return the inverses of the stars' own matrices, and what is known."""
    own = np.einsum('nkap,nkab,nkbq->npq', slopes, matrices, slopes,
                    optimize=True)
    return fixed_inverse(own, free)


def _equations(campaign, solved, bright, used, transform):
    """Return the matrix and the vector of the maps, and free maps."""
    matrices, slopes = _matrices(campaign, solved)
    inverses, known = _stars(matrices, slopes, solved.free)
    rows = np.flatnonzero(bright & known.any(axis=1))
    matrices, slopes = matrices[rows], slopes[rows]
    basis = transform.basis(_places(solved)[:, rows])
    pull = np.einsum('nkia,nki->nka', solved.slopes[rows][..., :2],
                     solved.pulls[rows])
    joins = np.einsum('nkab,nkbp->nkap', matrices, slopes)[:, used]
    n = 6 * used.size
    both = -np.einsum('nkap,npq,nlcq,bn,dn->kablcd', joins, inverses[rows],
                      joins, basis, basis, optimize=True)
    alone = np.einsum('nkac,bn,dn->kabcd', matrices[:, used], basis, basis,
                      optimize=True)
    each = np.arange(used.size)
    both[each, :, :, each] += alone
    vector = -np.einsum('nka,bn->kab', pull[:, used], basis)
    # Maps that stars follow: of each parameter, and each term of the basis.
    middle = slopes.mean(axis=0)[used]
    gauge = np.einsum('kap,bd->kabpd', middle, np.eye(3))
    return (both.reshape(n, n), vector.ravel(), gauge.reshape(n, -1))


def _eigen(normal, gauge):
    """Return eigenvalues (q,) and vectors of what the pixels know."""
    left, sizes, _ = np.linalg.svd(gauge, full_matrices=False)
    free = left[:, sizes > _NOTHING * sizes.max()]
    keep = np.eye(len(normal)) - free @ free.T
    values, vectors = np.linalg.eigh(keep @ normal @ keep)
    sure = values > _NOTHING * max(values.max(), 0)
    return values[sure], vectors[:, sure]


def _moved(campaign, frames, k):
    """Return image k with a WCS that contains its map."""
    epoch, transform = campaign.epochs[k], frames.transform
    if not frames.maps[k].any():
        return epoch
    coefficients = transform.identity() + frames.maps[k]
    ny, nx = epoch.pixels.shape
    region = Region((-0.5, nx - 0.5), (-0.5, ny - 0.5), (nx, ny))
    wcs, _ = corrected_wcs(epoch.wcs, Correction(
        campaign.plane, transform, coefficients), region)
    return replace(epoch, wcs=wcs)
