r"""
What pixels say of faint stars, whose likelihood is no Gaussian.

Where an image hardly shows a star its noise has peaks as high as the star
itself, and the highest of them is a poor estimate. Parameters of such a star
are the mean of their probability, and its mean squares are their errors. The
probability is the likelihood, integrated over all fluxes (see `Fluxes`), for
all paths on which the star stays within reach of where it is thought to be;
within reach all are thought equally likely.

The integral is a sum over points of two Gaussians: a wide one about the peak
of the likelihood, and the one that the first points show.
"""
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy
from astropy.utils import minversion
from scipy.special import log_ndtr, ndtri
from scipy.stats import qmc

from photutils_mgauss.photometry.joint_pixels import fixed_inverse

# How many points there are of each Gaussian, how much wider both are than
# what they are for, and what part of the first stays in the second.
_POINTS = 128
_WIDE = 2.0, 1.3
_KEPT = 0.05

# SciPy's name for where random numbers come from.
_SOURCE = 'rng' if minversion(scipy, '1.15') else 'seed'
# By what part of a flux the fluxes of a band may scatter.
_SCATTER = 0.0, 0.1, 0.3, 1.0

# Beyond so many standard deviations the data are sure that a star is not
# within reach.
_SURE = 4.0

# Below this part of the largest a mean square is that of a line.
_FLAT = 1e-12


@dataclass(frozen=True, eq=False)
class _Gaussians:
    """Centres (n, p), and axes (n, p, p) of lengths (n, p), 0 for none."""

    centre: np.ndarray
    axes: np.ndarray
    length: np.ndarray

    @classmethod
    def of(cls, centre, covariance, widths):
        """Return those of covariances (n, p, p), so many times wider."""
        values, axes = np.linalg.eigh(covariance)
        flat = values <= _FLAT * values.max(axis=1, keepdims=True)
        return cls(centre, axes, widths * np.sqrt(np.where(flat, 0, values)))

    def draw(self, points):
        """Return places (s, n, p) at points (s, p) of the unit Gaussian."""
        return self.centre + np.einsum(
            'nij,nj,sj->sni', self.axes, self.length, points, optimize=True)

    def density(self, places):
        """Return the logarithm of the density (s, n) at places."""
        there = self.length > 0
        length = np.where(there, self.length, 1)
        z = np.einsum('nij,nj,sni->snj', self.axes, there / length,
                      places - self.centre, optimize=True)
        return -0.5 * np.sum(z**2, axis=2) - np.log(length).sum(axis=1)


def posterior(fit, state, faint, given, reach, alike):
    """
    Return the means of parameters, their mean squares, and of whom.

    Parameters
    ----------
    fit : `~photutils_mgauss.photometry.joint_pixels.JointFit`
        Of n single stars.
    state : `~photutils_mgauss.photometry.joint_pixels.State`
        At the peaks.
    faint : (r,) `~numpy.ndarray` of int
        The stars that are looked at.
    given : (r, 1, p) `~numpy.ndarray`
        What was thought of them.
    reach : (E,) `~numpy.ndarray`
        How far from there they may be seen in each image [pix].
    alike : (C,) `~numpy.ndarray` of int
        The number, from 0, of the band of each flux.

    Returns
    -------
    (r, p), (r, p, p), (r,) `~numpy.ndarray`
        Of stars that are surely not within reach the last is False.
    """
    now = state.take(faint)
    peak, start = now.values[:, 0], given[:, 0]
    paths = fit.views.places(given, faint)
    measure = _Measure(fit, faint, paths, reach,
                       Fluxes.of(now, alike))
    inverses, _ = fixed_inverse(now.matrix, fit.free[faint, 0])
    centre = measure.pulled(start, peak)
    first = _Gaussians.of(centre, inverses, _WIDE[0])
    places = first.draw(_points(peak.shape[1], 1))
    evidence = measure(places)
    mean, square = _moments(places, evidence - first.density(places))
    second = _Gaussians.of(np.where(np.isfinite(mean), mean, centre),
                           np.nan_to_num(square) + _KEPT * inverses, _WIDE[1])
    more = second.draw(_points(peak.shape[1], 2))
    evidence = np.concatenate([evidence, measure(more)])
    places = np.concatenate([places, more])
    mean, square = _moments(places, evidence - np.logaddexp(
        first.density(places), second.density(places)))
    lost = measure.evidence(peak) - evidence.max(axis=0)
    return mean, square, np.isfinite(mean).all(axis=1) & (
        lost < _SURE**2 / 2)


class _Measure:
    """The logarithm of the probability of some stars' parameters."""

    def __init__(self, fit, rows, paths, reach, fluxes):
        self.fit, self.rows, self.paths = fit, rows, paths
        self.fluxes = fluxes
        self.reach = reach[:, None]
        self.seen = fit.boxes[rows][..., 2:].all(axis=-1)

    def away(self, values):
        """Return how far stars are, as a part of what they may, (r,)."""
        shift = self.fit.views.places(values[:, None], self.rows) - self.paths
        away = np.hypot(*np.moveaxis(shift, -1, 0)) / self.reach
        return np.where(self.seen, away, 0).max(axis=(1, 2))

    def pulled(self, start, peak):
        """Return the peaks (r, p), those beyond reach moved half inside."""
        away = self.away(peak)
        part = np.where(away > 1, 0.5 / np.maximum(away, 1), 1)
        return start + (peak - start) * part[:, None]

    def __call__(self, places):
        """Return it for places (s, r, p)."""
        return np.stack([np.where(self.away(one) < 1, self.evidence(one),
                                  -np.inf) for one in places])

    def evidence(self, values):
        """Return it without regard to reach, for values (r, p)."""
        return self.fluxes.evidence(*self.fit.scores(values[:, None],
                                                     self.rows))


@dataclass(frozen=True, eq=False)
class Fluxes:
    r"""
    What is thought of the fluxes of r stars.

    Those of a band scatter about a mean F, of which nothing is known but
    that it is not negative, by a part :math:`\tau` of the star's ``typical``
    flux (r,). Of :math:`\tau` several are thought equally likely, from that
    of constant stars to that of stars that come and go.
    """

    typical: np.ndarray
    alike: np.ndarray

    @classmethod
    def of(cls, state, alike):
        """Return those of stars with a `State` at their peaks."""
        known = state.known[:, :, 0, 0]
        weight = np.where(known > 0, 1 / np.where(known > 0, known, 1), 0)
        total = np.maximum(weight.sum(axis=1), 1e-300)
        typical = np.sum(weight * state.fluxes[:, :, 0], axis=1) / total
        return cls(np.maximum(typical, 1 / np.sqrt(total)), alike)

    def evidence(self, light, weight):
        r"""
        Return the logarithm (r,) of the likelihood, integrated over fluxes.

        Parameters
        ----------
        light, weight : (r, C) `~numpy.ndarray`
            The products n of the PSF with the data, and m with itself.

        Notes
        -----
        A flux n / m of variance :math:`1 / m + \tau^2 = 1 / w` about F has
        the likelihood :math:`\sqrt{w / m}\, \exp[n^2 / 2m
        - w (n / m - F)^2 / 2]`, and all of a band are integrated over F.
        """
        each = [self._evidence(light, weight, (part * self.typical)[:, None])
                for part in _SCATTER]
        return np.logaddexp.reduce(each)

    def _evidence(self, light, weight, scatter):
        seen = weight > 0
        m = np.where(seen, weight, 1)
        flux = light / m
        w = np.where(seen, 1 / (1 / m + scatter**2), 0)
        total = 0.5 * np.sum(np.where(seen, np.log(w / m, where=seen,
                                                   out=np.zeros(m.shape))
                                      + flux * light, 0), axis=1)
        for band in range(self.alike.max() + 1):
            same = self.alike == band
            own = w[:, same].sum(axis=1)
            own = np.where(own > 0, own, 1)
            mean = np.sum((w * flux)[:, same], axis=1) / own
            away = (flux - mean[:, None])[:, same]
            total += (log_ndtr(mean * np.sqrt(own)) - 0.5 * np.log(own)
                      - 0.5 * np.sum(w[:, same] * away**2, axis=1))
        return total


def _moments(places, weight):
    """
    Return means (n, p) and mean squares of places (s, n, p).

    NaN where no place has any weight.
    """
    largest = weight.max(axis=0)
    weight = np.exp(weight - np.where(np.isfinite(largest), largest, 0))
    total = weight.sum(axis=0)
    weight /= np.where(total > 0, total, np.nan)
    mean = np.einsum('sn,sni->ni', weight, places)
    away = places - mean
    return mean, np.einsum('sn,sni,snj->nij', weight, away, away,
                           optimize=True)


@cache
def _points(size, seed):
    """Return evenly spread points (s, size) of a Gaussian."""
    source = {_SOURCE: np.random.default_rng(seed)}
    return ndtri(qmc.Sobol(size, **source).random(_POINTS))
