"""
Frames tied to one another: the maps, what fixes them, what leaves them open.

A frame is one epoch's map onto the common plane. Given the stars' reduced
equations (see ``joint``) this module finds the maps, says in words which
combinations of them nothing determines, and judges each detection.
"""
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtr

from photutils_mgauss.motions.stacked import invert_2x2
from photutils_mgauss.sky.transforms import Transform, fit_map

SIGNIFICANT = 2.0  # standard deviations that call for a floor
NULL = 1e-10  # relative to the information before stars are eliminated


@dataclass(frozen=True, eq=False)
class Frames:
    """
    Corrections of all maps, and how well they are known.

    Parameters
    ----------
    correction : (E, 2, b) `~numpy.ndarray`
        Changes of the maps' coefficients.
    factor : (M, q) `~numpy.ndarray`
        Their covariance is ``factor @ factor.T``, M = 2 E b.
    undetermined : tuple of str
        A sentence for each family of corrections the data cannot tell.
    """

    correction: np.ndarray
    factor: np.ndarray
    undetermined: tuple

    def covariance(self, epoch):
        """Return the covariance (2 b, 2 b) of one map's coefficients."""
        n_epochs, _, b = self.correction.shape
        rows = self.factor.reshape(n_epochs, 2 * b,
                                   self.factor.shape[1])[epoch]
        return rows @ rows.T


POSITIONS = ('Positions are relative: no reference object has a known '
             'position, so they are in the mean frame of the epochs given.')
MOTIONS = ('Motions are relative: no reference object has a known motion, so '
           'the mean motion of the stars is set to zero{field}.')
PARALLAXES = ('Parallaxes are relative: no reference object has a known '
              'parallax, so the mean parallax of the stars is set to zero.')
OTHERS = ('{n} combinations of the maps are undetermined: some epochs share '
          'too few stars with the others; their maps change least.')


@dataclass(frozen=True, eq=False)
class Gauge:
    """
    The corrections of all frames together that stars can absorb.

    Each family is an (M, k) array of corrections: the same one in every
    epoch (positions), one growing with time (motions), and one following
    the parallax factors.
    """

    positions: np.ndarray
    motions: np.ndarray
    parallaxes: np.ndarray

    @classmethod
    def of(cls, transform, dt, parallax_factors=None, acceleration=False):
        """
        Return the gauge of E frames at times ``dt`` (E,).

        ``parallax_factors`` (2, E) are those at the centre of the field.
        """
        generators = transform.generators
        ones = np.ones_like(dt)
        motions = [np.kron(dt[:, None], generators)]
        if acceleration:
            motions.append(np.kron(dt[:, None]**2 / 2, generators))
        parallaxes = np.empty((len(dt) * len(generators), 0))
        if parallax_factors is not None:
            parallaxes = _parallax_family(transform, parallax_factors)
        return cls(np.kron(ones[:, None], generators), np.hstack(motions),
                   parallaxes)


def _parallax_family(transform, factors):
    """Corrections like parallaxes that vary over the field as the basis."""
    b = transform.n_terms
    family = np.concatenate([np.kron(factors[:, e, None], np.eye(b))
                             for e in range(factors.shape[1])])
    blocks = np.kron(np.eye(factors.shape[1]), transform.generators)
    inside = blocks @ (np.linalg.pinv(blocks) @ family)
    allowed = np.abs(inside - family).max(axis=0) < 1e-9
    return family[:, allowed]


def solve_frames(reduced, transform, gauge, *, relative=False):
    """
    Return the `Frames` of reduced equations.

    What the data do not determine stays as it is. With ``relative=True`` the
    stars themselves are the reference: common motions and parallaxes are
    left alone even where rows of different times seem to determine them.
    """
    n_epochs, size, _ = reduced.direct.shape
    shape = (n_epochs, 2, size // 2)
    if transform.n_parameters == 0:
        return Frames(np.zeros(shape), np.zeros((n_epochs * size, 0)), ())
    free = np.kron(np.eye(n_epochs), transform.generators)
    matrix, rhs = free.T @ reduced.matrix @ free, free.T @ reduced.rhs
    information = np.einsum('ij,ij->j', free,
                            _blocks_times(reduced.direct, free))
    scale = 1 / np.sqrt(np.where(information > 0, information, 1))
    matrix = matrix * np.outer(scale, scale)
    basis, null = _split(matrix, information, _forced(
        gauge, free, scale) if relative else None)
    inner = np.linalg.cholesky(basis.T @ matrix @ basis)
    factor = scale[:, None] * np.linalg.solve(inner, basis.T).T
    correction = free @ (factor @ (factor.T @ rhs))
    return Frames(correction.reshape(shape), free @ factor,
                  _sentences(null, gauge, free, scale, transform))


def _blocks_times(blocks, columns):
    n, size, _ = blocks.shape
    return np.einsum('eij,ejk->eik', blocks,
                     columns.reshape(n, size, -1)).reshape(columns.shape)


def _forced(gauge, free, scale):
    """Return an orthonormal basis of the gauge, in scaled unknowns."""
    families = np.hstack([gauge.positions, gauge.motions, gauge.parallaxes])
    return _orthonormal(_in_scaled(families, free, scale))


def _in_scaled(families, free, scale):
    return np.linalg.lstsq(free, families, rcond=None)[0] / scale[:, None]


def _orthonormal(columns):
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-10 * singular.max(initial=1e-300)]


def _split(matrix, information, forced):
    """Return bases of the determined and the undetermined unknowns."""
    size = len(matrix)
    null = np.eye(size)[:, information <= 0]
    if forced is not None:
        null = _orthonormal(np.hstack([null, forced]))
    basis = _complement(null, size)
    values, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
    weak = values < NULL
    return basis @ vectors[:, ~weak], np.hstack([null,
                                                 basis @ vectors[:, weak]])


def _complement(null, size):
    if null.shape[1] == 0:
        return np.eye(size)
    full = np.linalg.qr(null, mode='complete')[0]
    return full[:, null.shape[1]:]


def _sentences(null, gauge, free, scale, transform):
    """Say which families of corrections the undetermined ones contain."""
    if null.shape[1] == 0:
        return ()
    said, explained = [], 0
    field = ('' if transform.kind == 'shift' else
             ', and so is the part of their motions the maps can take up')
    for family, sentence in ((gauge.positions, POSITIONS),
                             (gauge.motions, MOTIONS.format(field=field)),
                             (gauge.parallaxes, PARALLAXES)):
        if family.shape[1] == 0:
            continue
        unit = _orthonormal(_in_scaled(family, free, scale))
        overlap = np.linalg.svd(null.T @ unit, compute_uv=False)
        count = int(np.sum(overlap > 0.99))
        explained += count
        if count:
            said.append(sentence)
    if null.shape[1] > explained:
        said.append(OTHERS.format(n=null.shape[1] - explained))
    return tuple(said)


def tie_plane(points, targets, weights, kind):
    """
    Return the map (2, 3) of a plane without WCS onto the common one.

    ``kind`` is the `Transform`; polynomials start from an affine map.
    """
    if kind.kind == 'polynomial':
        kind = Transform('affine')
    kind = kind.fitted_to(points)
    coefficients = fit_map(kind, points, targets, weights)
    slope = coefficients[:, 1:3] / kind.scale
    start = coefficients[:, 0] - slope @ np.array(kind.centre)
    return np.column_stack([start, slope])


def chi2_limit(clip, dof):
    """Return the chi-square as rare as a deviation by ``clip`` sigma."""
    return chdtri(dof, 2 * ndtr(-clip))


def worst_outliers(chi2, used, spare, clip):
    """
    Return which detections to reject now, (E, n): each star's worst.

    Only one of a star's goes at a time, because a bad one spoils the
    residuals of the good; and only where ``spare`` (n,) says the star has
    detections enough to tell the bad one.
    """
    limit = chi2_limit(clip, 2)
    chi2 = np.where(used, np.nan_to_num(chi2, nan=0.0), 0.0)
    worst = chi2.argmax(axis=0)
    out = np.zeros(used.shape, dtype=bool)
    stars = np.arange(used.shape[1])
    out[worst, stars] = (chi2[worst, stars] > limit) & spare
    return out


def floor_variance(residuals, covariance, expected, floor, *,
                   robust=False):
    r"""
    Return the variance per axis that makes one epoch's chi-square expected.

    Parameters
    ----------
    residuals : (2, n) `~numpy.ndarray`
    covariance : (3, n) `~numpy.ndarray`
        Covariances of the measurements without the floor.
    expected : (n,) `~numpy.ndarray`
        Expected chi-square of each, 2 minus its leverage.
    floor : float
        The present variance.
    robust : bool, optional
        Make the median of the chi-squares the expected one instead of their
        sum, for data with outliers.

    Notes
    -----
    Solves :math:`\sum r^T (\Sigma + s I)^{-1} r = \sum (2 - h)` for s by
    bisection in a safe bracket; 0 where the errors explain the residuals.
    """
    good = np.isfinite(residuals).all(axis=0) & np.isfinite(expected)
    good &= expected > 0.1
    residuals, covariance = residuals[:, good], covariance[:, good]
    expected = expected[good]
    if expected.sum() < 4:
        return 0.0

    def excess(variance):
        xx, xy, yy = covariance
        a, b, c = invert_2x2(xx + variance, xy, yy + variance)
        x, y = residuals
        chi2 = a * x * x + 2 * b * x * y + c * y * y
        if robust:
            return np.median(chi2 / expected) - np.log(2)
        return chi2.sum() - expected.sum()
    # An excess that good errors alone would show every twentieth time is
    # not worth a floor, which would only make all errors too large.
    noise = (1 / np.sqrt(len(expected)) if robust
             else np.sqrt(2 * expected.sum()))
    low, high = 0.0, max(floor, np.max(residuals**2), 1e-30)
    if excess(0.0) <= SIGNIFICANT * noise:
        return 0.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return (low + high) / 2
