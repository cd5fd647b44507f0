r"""
What a PSF leaves of bright stars, measured on the image itself.

A sum of Gaussians follows neither spikes nor rings far from a star. Divided by
fluxes, what is left of n stars around their places (x, y) is an image that
changes slowly over the detector,

.. math::

    R(\mathbf{d}\,|\,x, y) = R_0(\mathbf{d}) + u R_1(\mathbf{d})
    + v R_2(\mathbf{d}),

with u and v from -1 to 1 across the detector. Its terms are sampled twice a
pixel, as means over the stars, and shrunk ring by ring to what stands out of
noise, so that they end where nothing is known; beyond a radius they fade.

A level of the sky that stars share is told from that by stars of other
fluxes: divided by these it is not the same for all.
"""
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import correlate1d, gaussian_filter, map_coordinates

# Samples for each pixel, and the Gaussian, in samples, that smooths them: a
# PSF that is two pixels wide leaves nothing finer.
_FINE, _SMOOTH = 2, 0.7
# Means are too flat: what is left of the stars is added so often.
_SHARPER = 2


def _remaining_variance():
    """Return by how much smoothing lowers the variance of a sample."""
    one = np.zeros((41, 41))
    one[20, 20] = 1
    out = gaussian_filter(one, _SMOOTH)
    for _ in range(_SHARPER):
        seen = out
        # Pixels are anywhere in the cells between which samples are read.
        for axis in (0, 1):
            seen = correlate1d(seen, [0.125, 0.75, 0.125], axis)
        out = out + gaussian_filter(one - seen, _SMOOTH)
    return (out**2).sum()


_SMOOTHED = _remaining_variance()
# Fewer stars tell nothing, fewer than the second nothing of slopes; more than
# the last are not needed.
FEWEST, _FEW, MOST = 5, 30, 300
# What is not so many standard errors above noise is noise.
_SIGNIFICANT = 4.0
# Pixels further off than so many standard errors hold something else.
_CLIP, _PASSES = 4.0, 3
# The level of the sky is known to this part of a pixel's noise beforehand.
_SKY = 0.1
# Beyond the radius it fades, and ends at so many times that.
_END = 1.25


@dataclass(frozen=True, eq=False)
class PSFResidual:
    """
    What a PSF leaves of a star of unit flux.

    Parameters
    ----------
    terms : (k, w, w) `~numpy.ndarray`
        The constant, and with k = 3 the slopes along x and y, sampled twice a
        pixel around the star.
    spread : (m,) `~numpy.ndarray`
        How much stars differ from that, for each full pixel of distance.
    shape : (ny, nx) tuple
        The pixels of the image.
    sky : float
        The level of the sky that was left around the stars.
    unseen : (m,) `~numpy.ndarray` or 0
        What else may be left, at each distance, without standing out of noise.
    """

    terms: np.ndarray
    spread: np.ndarray
    shape: tuple
    sky: float = 0.0
    unseen: np.ndarray | float = 0.0

    @classmethod
    def of(cls, residual, variance, stars, radius, bright=None):
        """
        Measure what is left of bright stars.

        Parameters
        ----------
        residual, variance : (ny, nx) `~numpy.ndarray`
            The image without its stars; no variance is a pixel of no use.
        stars : (3, n) `~numpy.ndarray`
            The places and fluxes of stars that tell.
        radius : float
            How far from stars to look [pix].
        bright : (variance, stars) tuple, optional
            Stars that tell, too, such as saturated ones, and where.

        Returns
        -------
        PSFResidual or None
            None if there are too few stars.
        """
        stars = stars[:, np.argsort(-stars[2], kind='stable')[:MOST]]
        n = stars.shape[1]
        if n < FEWEST:
            return None
        seen = [(variance, *star) for star in stars.T]
        if bright is not None:
            seen += [(bright[0], *star) for star in bright[1].T]
        samples = _Samples.of(residual, seen, whole_reach(radius),
                              3 if n >= _FEW else 1)
        spread = np.zeros(samples.n_rings)
        good = np.ones(samples.value.size, bool)
        for _ in range(_PASSES):
            more = spread[samples.ring]**2
            weight = good / (samples.mean_variance + more)
            sky = samples.sky(weight)
            here = samples.without(sky)
            terms, unknown = here.terms(weight)
            left = here.value - here.read(terms)
            good = np.abs(left) < _CLIP * np.sqrt(here.variance + more)
            spread = here.spread(left, good)
        return cls(_faded(terms, radius), np.sqrt(spread**2 + unknown[0]),
                   residual.shape, sky, np.sqrt(unknown[1]))

    def stamp(self, x, y, half):
        """
        Return the image and the spread of a star of unit flux.

        On the (2 half + 1, 2 half + 1) pixels around the one nearest to it.
        """
        term = np.tensordot(_slopes(x, y, self.shape)[:len(self.terms)],
                            self.terms, 1)
        place = np.arange(-half, half + 1)
        dx, dy = place - (x - np.rint(x)), place - (y - np.rint(y))
        at = np.meshgrid(_sample(dy, term), _sample(dx, term), indexing='ij')
        ring = _ring(dx[None], dy[:, None])
        return map_coordinates(term, at, order=1), self.spread[
            np.minimum(ring, self.spread.size - 1)]

    def image(self, x, y, flux):
        """
        Return an image of what the PSF leaves of stars.

        Parameters
        ----------
        x, y, flux : (n,) array_like
            The stars [pix].

        Returns
        -------
        (ny, nx) `~numpy.ndarray`
        """
        out = np.zeros(self.shape)
        stars = np.array([x, y, flux], float).reshape(3, -1)
        self.take_off(out, np.zeros(self.shape),
                      stars[:, np.isfinite(stars).all(axis=0)], self.reach)
        return -out

    def cautious(self):
        """Return the same with a spread that has what may be unseen, too."""
        return replace(self, spread=np.hypot(self.spread, self.unseen))

    @property
    def reach(self):
        """How many pixels from a star it ends."""
        return len(self.terms[0]) // (2 * _FINE) - 1

    def take_off(self, data, variance, stars, half):
        """
        Take what is left of some stars (3, n) off an image, in place.

        Their variances grow by what is not known of it.
        """
        for x, y, flux in stars.T:
            image, spread = self.stamp(x, y, half)
            part, own = _overlap(x, y, half, data.shape)
            data[part] -= flux * image[own]
            variance[part] += (flux * spread[own])**2


@dataclass(frozen=True)
class _Samples:
    """
    Pixels around stars: residuals over the flux, and their variances (m,).

    ``level`` is what a unit of the sky would be, one over the flux.

    ``mean_variance`` is that of a star's pixels at a distance: weights by a
    variance that was made from the pixel itself would favour low ones.
    ``x`` and ``y`` are where they are in the image of samples, ``slopes``
    (k, m) what terms are multiplied with, ``ring`` the full pixels of
    distance from the star.
    """

    value: np.ndarray
    variance: np.ndarray
    mean_variance: np.ndarray
    level: np.ndarray
    x: np.ndarray
    y: np.ndarray
    ring: np.ndarray
    slopes: np.ndarray
    half: int

    @classmethod
    def of(cls, residual, stars, half, n_terms):
        columns = []
        for variance, x, y, flux in stars:
            part, _ = _overlap(x, y, half, residual.shape)
            j, i = np.nonzero(variance[part] > 0)
            dx, dy = i + part[1].start - x, j + part[0].start - y
            noise, ring = variance[part][j, i] / flux**2, _ring(dx, dy)
            mean = np.bincount(ring, noise) / np.maximum(np.bincount(ring), 1)
            columns.append(np.stack([
                residual[part][j, i] / flux, noise, mean[ring],
                np.full(j.size, 1 / flux), dx, dy, np.full(j.size, x),
                np.full(j.size, y)]))
        *columns, dx, dy, x, y = np.concatenate(columns, axis=1)
        middle = _FINE * (half + 1)
        return cls(*columns, middle + _FINE * dx, middle + _FINE * dy,
                   _ring(dx, dy), _slopes(x, y, residual.shape)[:n_terms],
                   half)

    def without(self, sky):
        """Return the same samples without a level of the sky."""
        return replace(self, value=self.value - sky * self.level)

    def sky(self, weight):
        """Return the level of the sky that the stars have in common."""
        # Of what a level would look like what terms could be does not count.
        own = self.level - self.read(
            self._fitted(weight, self.level, self._inverse(weight)))
        # Stars of one flux tell nothing of it.
        noise = np.median(np.sqrt(self.variance) / self.level)
        total = (weight * own * self.level).sum() + (_SKY * noise)**-2
        return (weight * own * self.value).sum() / total

    @property
    def n_rings(self):
        """How many full pixels of distance there are."""
        return int(_ring(self.half + 1, self.half + 1)) + 1

    @property
    def _width(self):
        return 2 * _FINE * (self.half + 1) + 1

    def _sums(self, values):
        """Return smooth sums of values (m,) in cells of the samples."""
        cell = (np.rint(self.y).astype(int) * self._width
                + np.rint(self.x).astype(int))
        return gaussian_filter(np.bincount(
            cell, values, self._width**2).reshape((self._width,) * 2),
            _SMOOTH, mode='constant')

    def terms(self, weight):
        """
        Return the terms (k, w, w), as far as they stand out of noise.

        And the variances (2, m) that they have left at each distance, where
        they do and where they do not.
        """
        inverse = self._inverse(weight)
        terms = self._fitted(weight, self.value, inverse)
        noise = _SMOOTHED * np.einsum('jikk->kji', inverse)
        shrunk, unknown = zip(*(_shrunk(*one) for one in zip(
            terms, noise, strict=True)), strict=True)
        # The mean square of a slope's factor is a third.
        return np.array(shrunk), unknown[0] + sum(unknown[1:]) / 3

    def _fitted(self, weight, value, inverse):
        """Return the terms (k, w, w) of what pixels (m,) have."""
        terms = self._means(weight * value, inverse)
        for _ in range(_SHARPER):
            terms += self._means(weight * (value - self.read(terms)), inverse)
        return terms

    def _inverse(self, weight):
        """Return the covariances (w, w, k, k) of terms, 0 for none."""
        q = self.slopes
        matrix = np.array([[self._sums(weight * a * b) for b in q]
                           for a in q]).transpose(2, 3, 0, 1)
        known = matrix[..., :1, :1]
        # Where few stars tell they do not tell of slopes.
        return np.where(known > 0, np.linalg.inv(
            matrix + np.eye(len(q)) * np.where(known > 0, 1e-6 * known, 1)),
            0)

    def _means(self, values, inverse):
        """Return the terms of values (m,) times weights."""
        return np.einsum('jikl,lji->kji', inverse, np.array(
            [self._sums(values * a) for a in self.slopes]))

    def read(self, terms):
        """Return what terms say of each pixel (m,)."""
        return sum(q * map_coordinates(term, [self.y, self.x], order=1)
                   for q, term in zip(self.slopes, terms, strict=True))

    def spread(self, left, good):
        """Return how much stars differ at each distance."""
        weight = good / self.mean_variance**2
        n = self.n_rings
        total, excess = (np.bincount(self.ring, values, n) for values in (
            weight, weight * (left**2 - self.variance)))
        least = _SIGNIFICANT * np.sqrt(2 * total)
        return np.sqrt(np.divide(excess, total, where=excess > least,
                                 out=np.zeros(n)))


def _shrunk(term, noise):
    """
    Return a term where it is more than noise, and variances (2, m) left.

    Where it is, and where it is not and may still be there.
    """
    y, x = (np.indices(term.shape) - term.shape[0] // 2) / _FINE
    ring = _ring(x, y)
    total, noise = (np.bincount(ring.ravel(), values.ravel())
                    for values in (term**2, noise))
    count = np.bincount(ring.ravel())
    least = noise * (1 + _SIGNIFICANT * np.sqrt(2 / _SMOOTHED / count))
    more = np.maximum(total - noise, 0)
    share = np.divide(more, total, where=total > least,
                      out=np.zeros(total.size))
    return term * share[ring], np.stack([
        share * noise, np.where(share > 0, 0, more)]) / count


def whole_reach(radius):
    """Return how many pixels from a star what is left of it ends."""
    return int(np.ceil(_END * radius))


def _faded(terms, radius):
    """Return terms that fade beyond a radius [pix]."""
    y, x = (np.indices(terms.shape[1:]) - terms.shape[1] // 2) / _FINE
    beyond = (np.hypot(x, y) / radius - 1) / (_END - 1)
    return terms * np.cos(np.pi / 2 * np.clip(beyond, 0, 1))**2


def _slopes(x, y, shape):
    """Return what the terms at places are multiplied with (3, ...)."""
    ny, nx = shape
    return np.stack([np.ones_like(x), 2 * x / nx - 1, 2 * y / ny - 1])


def _ring(dx, dy):
    """Return the full pixels of a distance."""
    return np.hypot(dx, dy).astype(int)


def _sample(offset, term):
    """Return where offsets from a star are in the image of samples."""
    return len(term) // 2 + _FINE * offset


def _overlap(x, y, half, shape):
    """Return the pixels around a star, in the image and in its stamp."""
    parts = []
    for place, n in zip((y, x), shape, strict=True):
        first = int(np.rint(place)) - half
        low, high = np.clip([first, first + 2 * half + 1], 0, n)
        parts.append((slice(low, high), slice(low - first, high - first)))
    return tuple(zip(*parts, strict=True))
