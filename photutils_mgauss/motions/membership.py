r"""
Stars that move together: the probability of each, and their mean motion.

Motions :math:`w_i` with the covariances :math:`S_i` are drawn from a few
Gaussians, the first of which is the cluster and the others the field,

.. math:: p(w_i) = \sum_j \alpha_j\, N(w_i \mid m_j, V_j + S_i) .

The parameters of highest likelihood are found by expectation maximisation
with the errors of each star taken out (Bovy, Hogg & Roweis 2011). The
probability that a star belongs to the cluster is the first term over the sum.
"""
import warnings
from dataclasses import dataclass

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.motions.joint import eliminate, scaled_rows
from photutils_mgauss.motions.problem import CHUNK
from photutils_mgauss.motions.stacked import invert_2x2
from photutils_mgauss.sky.space_motion import turns

MOST_STEPS = 2000
CLOSE = 1e-7  # of the log-likelihood of a star
FEWEST = 10  # stars with motions
NARROW = 1e-6  # of the field: a cluster's own dispersion is not less


@dataclass(frozen=True, eq=False)
class Groups:
    """
    Gaussians in motion space, the cluster first.

    ``fraction`` (J,), ``mean`` (J, 2), ``covariance`` (J, 2, 2).
    """

    fraction: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def densities(self, motion, covariance):
        """Return the logarithms (J, n) of each term of the sum."""
        (x, y), (xx, xy, yy) = self.seen(motion, covariance)
        chi2 = x * x * xx + 2 * x * y * xy + y * y * yy
        with np.errstate(divide='ignore'):
            return (np.log(self.fraction)[:, None] - np.log(2 * np.pi)
                    - (chi2 - np.log(xx * yy - xy * xy)) / 2)

    def seen(self, motion, covariance):
        """
        Return motions from the means, and the weights of these.

        That is w - m, (2, J, n), and the elements xx, xy, yy of the inverse
        of V + S, (3, J, n).
        """
        whole = self.covariance[:, None] + covariance
        away = motion - self.mean[:, None]
        # numpy's functions take a hundred times as long for each matrix.
        return np.moveaxis(away, -1, 0), invert_2x2(
            whole[..., 0, 0], whole[..., 0, 1], whole[..., 1, 1])


def fit_groups(motion, covariance, n_field):
    """
    Return the `Groups` of motions (n, 2) with covariances (n, 2, 2).

    The cluster begins at the densest place, the field as all stars.
    """
    if len(motion) < FEWEST:
        msg = (f'stars must be at least {FEWEST} with motions to tell '
               f'members, got {len(motion)}')
        raise ValueError(msg)
    groups = _start(motion, covariance, n_field)
    before = -np.inf
    for _ in range(MOST_STEPS):
        terms = groups.densities(motion, covariance)
        total = np.logaddexp.reduce(terms, axis=0)
        now = total.mean()
        if now - before < CLOSE:
            return groups
        before = now
        groups = _better(groups, np.exp(terms - total), motion, covariance)
    warnings.warn(
        f'The Gaussians of cluster and field still change after {MOST_STEPS} '
        'steps; there may be no cluster, or memberships are rough.',
        AstropyUserWarning, stacklevel=4)
    return groups


def _start(motion, covariance, n_field):
    middle = np.median(motion, axis=0)
    spread = 1.4826 * np.median(np.abs(motion - middle), axis=0)
    error = np.sqrt(np.median(np.linalg.eigvalsh(covariance)[:, -1]))
    width = max(error, 0.1 * spread.max())
    some = motion[::1 + len(motion) // 2000]
    near = np.exp(-np.sum((some[:, None] - some) ** 2, axis=2) / 2 / width**2)
    peak = some[near.sum(axis=1).argmax()]
    field = np.diag(np.maximum(spread, width)**2)
    wide = [field * 4.0**k for k in range(n_field)]
    fraction = np.array([0.3] + [0.7 / n_field] * n_field)
    return Groups(fraction, np.stack([peak] + [middle] * n_field),
                  np.stack([np.eye(2) * width**2 / 4, *wide]))


def _better(groups, belongs, motion, covariance):
    """Return the groups after a step of expectation and maximisation."""
    own = groups.covariance
    (x, y), (xx, xy, yy) = groups.seen(motion, covariance)
    true = groups.mean[:, None] + np.stack(
        [xx * x + xy * y, xy * x + yy * y], axis=-1) @ own
    # Of V - V (V + S)^-1 V only the mean of all stars is needed.
    inverse = np.stack([np.sum(belongs * element, axis=1)
                        for element in (xx, xy, xy, yy)], axis=-1)
    left = (belongs.sum(axis=1)[:, None, None] * own
            - own @ inverse.reshape(-1, 2, 2) @ own)
    weight = np.maximum(belongs.sum(axis=1), 1e-12)
    mean = np.einsum('jn,jna->ja', belongs, true) / weight[:, None]
    from_mean = true - mean[:, None]
    spread = np.swapaxes(from_mean * belongs[..., None], 1, 2) @ from_mean
    spread = (spread + left) / weight[:, None, None]
    # A cluster may have no dispersion that can be seen, but not less.
    least = NARROW * np.trace(spread[-1]) / 2
    return Groups(weight / weight.sum(), mean, spread + least * np.eye(2))


def mean_motion(fit, stars, parameters):
    """
    Return the mean motion (2,), its covariance and the dispersion.

    The weights are the stars' own errors and the dispersion; what stars have
    in common, the error of the frames, does not become less by averaging.

    Parameters
    ----------
    fit : `~photutils_mgauss.motions.loop.Fit`
    stars : (k,) int `~numpy.ndarray`
    parameters : (values, covariance)
        Of all stars in local axes.
    """
    values, covariance = parameters
    motion = values[2:4, stars].T
    whole = np.moveaxis(covariance[2:4, 2:4][..., stars], 2, 0)
    frame = _frame_share(fit, stars)
    own = whole - np.einsum('kaq,kbq->kab', frame, frame)
    dispersion = _dispersion(motion, own)
    weight = np.linalg.inv(own + dispersion**2 * np.eye(2))
    inner = np.linalg.inv(weight.sum(axis=0))
    mean = inner @ np.einsum('kab,kb->a', weight, motion)
    common = inner @ np.einsum('kab,kbq->aq', weight, frame)
    return mean, inner + common @ common.T, dispersion


def _frame_share(fit, stars):
    """Return the factor (k, 2, q) of what frames add to motions."""
    parts, plane = [], fit.setup.sightings.plane
    problem = fit.problem
    for start in range(0, len(stars), CHUNK):
        some = stars[start:start + CHUNK]
        left = eliminate(problem.select(some))
        share = np.einsum('kin,knq->niq', left.factor,
                          scaled_rows(left, fit.frames.factor))
        if plane is not None:
            places = fit.estimates.values[:2, some] + (
                fit.setup.origin[:, some])
            turn = turns(plane, places, share.shape[1])
            share = np.moveaxis(turn, 2, 0) @ share
        parts.append(share[:, 2:4])
    return np.concatenate(parts)


def _dispersion(motion, own):
    """Return the dispersion that makes the scatter as large as expected."""
    def excess(size):
        weight = np.linalg.inv(own + size**2 * np.eye(2))
        mean = np.linalg.solve(weight.sum(axis=0), np.einsum(
            'kab,kb->a', weight, motion))
        away = motion - mean
        return np.einsum('ka,kab,kb->', away, weight, away) - (
            2 * len(motion) - 2)
    low, high = 0.0, float(np.sqrt(np.sum(np.var(motion, axis=0)))) + 1e-300
    if len(motion) < 2 or excess(0.0) <= 0:
        return 0.0
    for _ in range(50):
        half = (low + high) / 2
        low, high = (half, high) if excess(half) > 0 else (low, half)
    return (low + high) / 2
