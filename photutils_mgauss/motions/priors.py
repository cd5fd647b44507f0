"""What is known of some stars before anything is measured, as equations."""
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from photutils_mgauss.motions.references import FIXED, UNKNOWN
from photutils_mgauss.motions.stacked import apply

# "Zero" motion and parallax of a quasar, in units of the frame's own: an
# exact zero would make the equations singular.
ZERO = {'mas': 1e-4, 'pix': 1e-6}


@dataclass(frozen=True, eq=False)
class Priors:
    """
    What is known of k of the stars beforehand, as normal equations.

    Parameters
    ----------
    stars : (k,) int `~numpy.ndarray`
        Sorted numbers of the stars.
    precision : (p, p, k) `~numpy.ndarray`
        Inverse covariance of the parameters, 0 where nothing is known.
    moment : (p, k) `~numpy.ndarray`
        The precision times the expected parameters, positions relative to
        the star's origin. (The expected parameters themselves do not exist
        where the precision is singular.)
    constant : (k,) `~numpy.ndarray`
        The chi-square of parameters that are all zero.
    """

    stars: np.ndarray
    precision: np.ndarray
    moment: np.ndarray
    constant: np.ndarray

    @classmethod
    def none(cls, n_parameters):
        """Return priors of no star at all."""
        p = n_parameters
        return cls(np.empty(0, dtype=int), np.empty((p, p, 0)),
                   np.empty((p, 0)), np.empty(0))

    def pick(self, which, stars=None):
        """Return some of the priors, for ``stars`` or the same ones."""
        stars = self.stars[which] if stars is None else stars
        return Priors(stars, self.precision[..., which],
                      self.moment[:, which], self.constant[which])

    def chi2(self, values):
        """Return the chi-square (k,) of parameters (p, n) of all stars."""
        v = values[:, self.stars]
        return (np.sum(v * (apply(self.precision, v) - 2 * self.moment),
                       axis=0) + self.constant)

    @cached_property
    def rank(self):
        """Number of parameters (k,) each prior knows."""
        return np.linalg.matrix_rank(np.moveaxis(self.precision, 2, 0),
                                     hermitian=True)

    def between(self, start, stop):
        """Return the priors of stars start <= i < stop, renumbered."""
        part = slice(*np.searchsorted(self.stars, [start, stop]))
        return self.pick(part, self.stars[part] - start)

    def without(self, stars):
        """Return the priors of all stars but these."""
        return self.pick(~np.isin(self.stars, stars))

    def of(self, stars):
        """Return the priors of these stars alone, as far as there are any."""
        return self.pick(np.isin(self.stars, stars))

    def with_others(self, other):
        """Return these priors and those of other stars."""
        order = np.argsort(np.concatenate([self.stars, other.stars]))
        return Priors(*(np.concatenate(pair, axis=-1)[..., order]
                        for pair in ((self.stars, other.stars),
                                     (self.precision, other.precision),
                                     (self.moment, other.moment),
                                     (self.constant, other.constant))))


def build_priors(catalogue, stars, origin, year, unit, n_parameters):
    """
    Return the `Priors` of references with the numbers ``stars``.

    ``origin`` (2, k) are the places their positions are relative to, and
    ``year`` the working epoch. ``n_parameters`` is 4, 5 (parallax), 6 or 7
    (acceleration, about which catalogues say nothing).
    """
    has_parallax = n_parameters % 2 == 1
    size = 5 if has_parallax else 4
    k = len(stars)
    precision = np.zeros((n_parameters, n_parameters, k))
    moment = np.zeros((n_parameters, k))
    constant = np.zeros(k)
    values, covariance, matrix = _equations(catalogue, origin, year,
                                            ZERO[unit])
    known = np.isfinite(values) & (
        np.einsum('iik->ik', covariance) < 1e-3 * UNKNOWN)
    known = known[:size]
    # References of which the same is known, all at once.
    for pattern in np.unique(known, axis=1).T:
        rows = np.flatnonzero(pattern)
        some = np.flatnonzero((known == pattern[:, None]).all(axis=0))
        own = matrix[np.ix_(some, rows, np.arange(size))]
        inner = np.moveaxis(covariance[np.ix_(rows, rows, some)], 2, 0)
        value = values[np.ix_(rows, some)].T
        weighted = np.linalg.solve(inner, own)
        precision[:size, :size, some] = np.moveaxis(
            np.swapaxes(own, 1, 2) @ weighted, 0, 2)
        moment[:size, some] = np.einsum('kr,krp->pk', value, weighted)
        constant[some] = np.einsum('kr,kr->k', value, np.linalg.solve(
            inner, value[..., None])[..., 0])
    order = np.argsort(stars)
    return Priors(np.asarray(stars), precision, moment,
                  constant).pick(order)


def _equations(catalogue, origin, year, zero):
    """
    Return values (5, k), their covariances and matrices M (k, 5, 5).

    The catalogue's values are M v for the parameters v at the working
    epoch; what is not known is NaN or without an error.
    """
    values, covariance = catalogue.values.copy(), catalogue.covariance.copy()
    matrix = np.repeat(np.eye(5)[None], values.shape[1], axis=0)
    matrix[:, 0, 2] = matrix[:, 1, 3] = np.where(
        np.isfinite(catalogue.year), catalogue.year - year, 0.0)
    values[:2] -= origin
    fixed = np.isin(catalogue.kinds, FIXED)
    values[2:, fixed] = 0
    covariance[2:, :, fixed] = covariance[:, 2:, fixed] = 0
    for k in (2, 3, 4):
        covariance[k, k, fixed] = zero**2
    values[2:, catalogue.kinds == 'position'] = np.nan
    return values, covariance, matrix


def weak_priors(n_stars, n_parameters, sigma):
    """Return `Priors` that know next to nothing: all is 0 +- ``sigma``."""
    precision = np.repeat(np.eye(n_parameters)[..., None] / sigma**2,
                          n_stars, axis=2)
    return Priors(np.arange(n_stars), precision,
                  np.zeros((n_parameters, n_stars)), np.zeros(n_stars))


def add_parallax_prior(priors, n_stars, parallax):
    """Give stars of unknown ``parallax`` its expected mean and sigma."""
    mean, sigma = parallax
    p = len(priors.precision)
    precision, moment = np.zeros((p, p, n_stars)), np.zeros((p, n_stars))
    constant = np.zeros(n_stars)
    precision[..., priors.stars] = priors.precision
    moment[:, priors.stars] = priors.moment
    constant[priors.stars] = priors.constant
    free = precision[4, 4] == 0
    precision[4, 4, free] = sigma**-2
    moment[4, free] = mean / sigma**2
    constant[free] += mean**2 / sigma**2
    return Priors(np.arange(n_stars), precision, moment, constant)
