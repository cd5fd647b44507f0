r"""
What stars that nobody sees do to those that are seen.

Stars are found down to a limit that is higher beside others. Those below it,
of which the counts of the stars that were found tell the number, leave their
light in the fit: one of flux g at a distance **d** moves a parameter by
z = g a(**d**) standard errors, where a is the response of the fit. Most such
moves are small and some are large, so that their root mean square says little.
With N(g) the number of stars for each pixel and flux, and p(g, **d**) the
chance that one is not found, errors have a compound Poisson law, whose
characteristic function is

.. math::

    \exp\Big[\int d^2 d \int dg\, N\, p\, (e^{i z t} - 1) - t^2 / 2\Big] .

The error of a star is half the width of what holds 68.27 % of this law. Its
median is what hidden stars add to a flux; but the background, too, takes some
of their light, and all fluxes fall by part of their answer to that.
"""
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtr

from photutils_mgauss import kernels
from photutils_mgauss.crowded.search import LEAST

# Numbers of stars are those of blocks of so many pixels a side, of wide PSFs
# more, smoothed by a Gaussian of so many blocks.
_BLOCK, _SMOOTH = 8, 2.5
# Stars of so many standard errors are counted: in a crowd nine in ten of them
# are found, and of fainter ones fewer, which would make counts too flat.
_COUNTED = 10.0
# The errors of fainter ones than this, in standard errors, are those of sky
# and neighbours.
_FAINT = 50.0
# How the numbers of stars fall with flux, a power, is told by those up to so
# many times as bright: counts are curved, and are to be continued downwards.
_NEAR = 30.0
# The power if few stars tell, which counts as so many of them.
_SLOPE, _SLOPE_STARS = 1.5, 10
_SLOPES, _N_SLOPES = (1.1, 2.9), 37
# The steps in distance, in flux of the star, in that of hidden ones, and in
# the number of stars, which may differ by this factor.
_N_DISTANCES, _N_FLUXES, _N_HIDDEN, _N_NUMBERS = 8, 14, 40, 7
_NUMBERS = 100.0
# The errors of a law, in standard errors.
_BIN, _SIZE = 1 / 16, 2048
_ZERO = _SIZE * 3 // 8
_ERRORS = _BIN * (np.arange(_SIZE) - _ZERO)
# No more than this part of a star's flux is taken for that of hidden ones.
_LARGEST_PART = 0.5
# Of what fluxes would answer to the light that the background has taken, this
# is what they do: simulated fields say so. Where the background is too high
# for one star others hide light beside it.
_SHARE = 0.3
_WITHIN_ONE = 0.6826894921370859


@dataclass(frozen=True)
class Confusion:
    """
    What hidden stars do to n stars.

    ``flux`` and ``position`` are the standard errors that they add, in units
    of those of the pixels' noise; ``light`` is what they add to the flux, in
    the median.
    """

    flux: np.ndarray
    position: np.ndarray
    light: np.ndarray

    @classmethod
    def none(cls, n):
        """Return that of n stars beside which nothing is hidden."""
        return cls(np.zeros(n), np.zeros(n), np.zeros(n))

    @classmethod
    def of(cls, model, origin, equations, flux_err, *, flux=None, share=1.0):
        """
        Find what is hidden beside the stars of a tile.

        Parameters
        ----------
        model : Model
            Solved.
        origin : (y, x) tuple
            Where in the image the tile begins.
        equations : Equations
            Of the model.
        flux_err : (n,) `~numpy.ndarray`
            The errors of fluxes due to the noise of pixels.
        flux : (n,) `~numpy.ndarray`, optional
            What is expected of fluxes where these are noise; those of the
            model by default.
        share : float, optional
            The standard error of a star's flux by all images in which stars
            are looked for, as a fraction of that by this one.
        """
        stars = model.stars
        flux = stars.flux if flux is None else flux
        seen = np.isfinite(flux_err) & (flux_err > 0) & (flux > 0)
        counts = Counts.of(model, origin, np.where(seen, flux_err, np.nan))
        if not (counts.number[seen] > 0).any():
            return cls.none(len(stars))
        variance = _variance_beneath(model)
        scaled = np.maximum(flux, 1e-300) / np.sqrt(variance)
        number = counts.number * variance**((1 - counts.slope) / 2)
        law = Law.of(model, counts, np.median(variance[seen]), number, share)
        squares, medians = law.at(scaled, number)
        answers = _SHARE * equations.answers_to_light()
        light = medians * flux_err - answers * law.hidden.light(counts)
        largest = _LARGEST_PART * flux
        return cls(*np.where(seen, np.sqrt(squares), 0),
                   np.where(seen, np.clip(light, -largest, largest), 0))


def _variance_beneath(model):
    """Return the variance of a pixel under each star without its light."""
    s, (ny, nx) = model.stars, model.data.shape
    at = (np.clip(np.rint(s.y).astype(int), 0, ny - 1),
          np.clip(np.rint(s.x).astype(int), 0, nx - 1))
    weight = model.weight[at]
    variance = np.divide(1, weight, where=weight > 0,
                         out=np.full(len(s), model.noise**2))
    if model.options.gain is not None:
        variance -= s.flux * model.psf.profile[0] / model.options.gain
    return np.maximum(variance, model.options.floor)


@dataclass(frozen=True)
class Counts:
    """
    How many stars there are: ``number`` (n,) times flux**-``slope``.

    For each pixel and unit of flux, around each of n stars and without it.
    ``error`` (n,) is that of the flux of a faint star there.
    """

    number: np.ndarray
    slope: float
    error: np.ndarray

    @classmethod
    def of(cls, model, origin, flux_err):
        """Count the stars of a tile that all are found; NaN is no error."""
        blocks = _Blocks(model, origin)
        error = blocks.typical_error(model, flux_err)
        limit = _COUNTED * error
        flux = model.stars.flux
        near = (flux > limit) & (flux < _NEAR * limit)
        slope = power_of_counts(flux[near], limit[near])
        steep = slope - 1
        worth = np.where(near, steep / (limit**-steep
                                        - (_NEAR * limit)**-steep), 0)
        return cls(blocks.density(worth), slope, error)


def power_of_counts(flux, limit):
    """
    Return the power by which the numbers of stars fall with flux.

    Of fluxes (n,) above limits (n,) and near these. The likelihood is that of
    stars between two ends, the upper one the brightest star if that is
    nearer: counts that end would seem steeper without.
    """
    end = np.minimum(_NEAR * limit, flux.max(initial=0))
    near = flux < end
    flux, limit, end = flux[near], limit[near], end[near]
    reach = np.log(end / limit)
    excess = np.log(flux / limit).sum() + _SLOPE_STARS / (_SLOPE - 1)
    # Where a slope explains less than all of it the counts are flatter.
    slopes = np.linspace(*_SLOPES, _N_SLOPES)
    explained = [(1 / a - reach / np.expm1(a * reach)).sum()
                 + _SLOPE_STARS / a for a in slopes - 1]
    return float(np.interp(-excess, np.negative(explained), slopes))


class _Blocks:
    """Sums over the stars around each star."""

    def __init__(self, model, origin):
        self.side = side = round(model.psf.scale * _BLOCK)
        self.shape = tuple(
            (first + n - 1) // side - first // side + 1
            for first, n in zip(origin, model.data.shape, strict=True))
        s, (ny, nx) = model.stars, model.data.shape
        y, x = np.nonzero(model.good)
        self.area = self._smooth(self._sum(self._block(origin, y, x)))
        self.block = self._block(
            origin, np.clip(np.rint(s.y).astype(int), 0, ny - 1),
            np.clip(np.rint(s.x).astype(int), 0, nx - 1))
        one = np.zeros((31, 31))
        one[15, 15] = 1
        self.own = gaussian_filter(one, _SMOOTH)[15, 15]

    def _block(self, origin, y, x):
        return (tuple((first % self.side + place) // self.side
                      for first, place in zip(origin, (y, x), strict=True)))

    def _sum(self, block, worth=None):
        flat = np.ravel_multi_index(block, self.shape)
        return np.bincount(flat, worth, np.prod(self.shape)).reshape(
            self.shape).astype(float)

    @staticmethod
    def _smooth(image):
        return gaussian_filter(image, _SMOOTH, mode='constant')

    def density(self, worth):
        """Return the sum of what stars are worth, for each pixel (n,)."""
        total = self._smooth(self._sum(self.block, worth))[self.block]
        return np.maximum(total - self.own * worth, 0) / np.maximum(
            self.area[self.block], self.own)

    def typical_error(self, model, flux_err):
        """Return the errors of faint stars around each star (n,)."""
        faint = model.stars.flux < _FAINT * flux_err
        log = np.where(faint, np.log(np.where(faint, flux_err, 1)), 0)
        n = self._smooth(self._sum(self.block, faint.astype(float)))
        total = self._smooth(self._sum(self.block, log))
        # Where there are none it is that of the sky.
        blank = np.log(model.noise * np.sqrt(model.psf.area))
        return np.exp((total + self.own * blank) / (n + self.own))[self.block]


class Law:
    """
    The law of errors beside hidden stars, for one PSF and sky.

    Fluxes are in units of the noise of a pixel of the sky.

    Parameters
    ----------
    hidden : Hidden
    flux : (m,) `~numpy.ndarray`
        Fluxes of the star, evenly spaced in the logarithm.
    number : (w,) `~numpy.ndarray`
        How many stars of unit flux there are for each pixel, from none on.
    squares : (2, m, w) `~numpy.ndarray`
        By what the squares of the widths of flux and position exceed 1.
    medians : (m, w) `~numpy.ndarray`
        Of fluxes.
    """

    def __init__(self, hidden, flux, number, squares, medians):
        self.hidden, self.flux, self.number = hidden, flux, number
        self.squares, self.medians = squares, medians

    @classmethod
    def of(cls, model, counts, variance, numbers, share=1.0):
        """Tabulate the law in the middle of a tile for numbers (n,)."""
        ny, nx = model.data.shape
        beside = _Beside(model.psf, nx / 2, ny / 2)
        limit = model.options.faintest / beside.at_centres
        # Counts are not continued further than to what one image can show.
        faint = limit * np.sqrt(model.psf.area)
        hidden = Hidden(limit, counts.slope, faint * np.sqrt(variance), share)
        top = max(model.stars.flux.max() / np.sqrt(variance), 100 * faint)
        fluxes = np.geomspace(faint, top, _N_FLUXES)
        numbers = np.concatenate([[0], np.geomspace(
            numbers.max() / _NUMBERS, numbers.max(), _N_NUMBERS)])
        gain = model.options.gain
        photons = 0.0 if gain is None else 1 / (gain * np.sqrt(variance))
        parts = [beside.law(flux, flux * photons, faint, hidden, numbers)
                 for flux in fluxes]
        squares, medians = zip(*parts, strict=True)
        return cls(hidden, fluxes, numbers, np.stack(squares, axis=1),
                   np.stack(medians))

    def at(self, flux, number):
        """
        Return squares (2, n) of flux and position, and medians (n,).

        Of stars of a flux (n,) among so many others (n,).
        """
        row = np.log(flux / self.flux[0]) / np.log(
            self.flux[1] / self.flux[0])
        column = np.interp(number, self.number, np.arange(self.number.size))
        squares, medians = self.squares, self.medians
        return np.stack([_read(table, row, column)
                         for table in squares]), _read(medians, row, column)


def _read(table, row, column):
    return map_coordinates(table, [row, column], order=1, mode='nearest')


@dataclass(frozen=True)
class Hidden:
    """
    The stars that are hidden.

    ``limit`` is the significance at which every second star is found,
    ``slope`` the power of their numbers, and ``faintest`` the flux of the
    faintest: of those that can be seen where no star is. Even fainter ones
    are everywhere, and noise of the sky. Where stars are looked for in many
    images, errors by all are ``share`` of those by this one.
    """

    limit: float
    slope: float
    faintest: float
    share: float = 1.0

    def chance(self, flux, error):
        """Return the chance that a star is not found, of errors here."""
        return ndtr(self.limit - flux / (self.share * error))

    def fluxes(self, low, high):
        """Return fluxes, and numbers about them for a density of 1."""
        edges = np.geomspace(low, max(high, 1.01 * low), _N_HIDDEN + 1)
        steep = self.slope - 1
        return np.sqrt(edges[1:] * edges[:-1]), (
            edges[:-1]**-steep - edges[1:]**-steep) / steep

    def light(self, counts):
        """Return the light a pixel has of them around stars (n,)."""
        error = counts.error
        flux, density = self.fluxes(
            self.faintest, (self.limit + 4) * self.share * max(error.max(),
                                                                self.faintest))
        return counts.number * sum(
            f * n * self.chance(f, error)
            for f, n in zip(flux, density, strict=True))


class _Beside:
    """Stars drawn beside the middle of a stamp, at all distances d."""

    def __init__(self, psf, x, y):
        self._rows, count = psf.rows_at(np.array([x]), np.array([y]))
        self._rows = self._rows[0, :count[0]]
        self._integrated = psf.integrated
        reach = 1.2 * np.sqrt(psf.area)
        self.half = int(np.ceil(reach)) + 2
        self.step = reach / _N_DISTANCES
        axis = self.step * np.arange(-_N_DISTANCES, _N_DISTANCES + 1)
        places = [(dx, dy) for dx in axis for dy in axis
                  if np.hypot(dx, dy) < reach + self.step / 2]
        self.others = np.stack([self._draw(*d) for d in places], axis=1)
        e = 1e-3
        self.star = self._draw(0, 0)
        self.slopes = [(self._draw(*d) - self._draw(*np.negative(d)))
                       / (2 * e) for d in ((e, 0), (0, e))]
        # Stars are looked for in the middle of pixels.
        thirds = (-1 / 3, 0, 1 / 3)
        self.at_centres = np.mean([
            self.star @ other / np.sqrt((self.star @ self.star)
                                        * (other @ other))
            for other in (self._draw(dx, dy)
                          for dx in thirds for dy in thirds)])

    def _draw(self, dx, dy):
        out = np.zeros((2 * self.half + 1,) * 2)
        # As floats: for integers the kernel would be compiled once more.
        kernels.render(self._rows, self.half + float(dx),
                       self.half + float(dy), 1.0, self._integrated, out)
        return out.ravel()

    def law(self, flux, photons, faint, hidden, numbers):
        """
        Return squares (2, w) and medians (w,) of `Law` for one flux.

        ``photons`` is the variance of the star's light over that of the sky,
        times the PSF.
        """
        z, merged, error = self._responses(flux, photons)
        g, density = hidden.fluxes(faint, flux)
        chance = hidden.chance(g, error[:, None])
        # What is too close to be told apart is not found however bright.
        chance[merged] = 1
        rate = density * chance * self.step**2
        # All images see a place together.
        units = 1, hidden.share, hidden.share
        flux_law, *place_laws = (
            _laws(part[:, None] * g / unit, rate, numbers)
            for part, unit in zip(z, units, strict=True))
        medians = np.array([_quantile(law, 0.5) for law in flux_law])
        return np.stack([
            _squares(flux_law, medians),
            np.mean([_squares(law, 0 * medians) for law in place_laws],
                    axis=0)]), medians

    def _responses(self, flux, photons):
        """
        Return what others of unit flux do to a star.

        z (3, d) in standard errors of flux, x and y, which others cannot be
        told from it, and the errors of the fluxes of others (d,).
        """
        design = np.stack([self.star, *(flux * slope
                                        for slope in self.slopes)])
        weighted = design / (1 + photons * self.star)
        covariance = np.linalg.inv(weighted @ design.T)
        common = weighted @ self.others
        answer = covariance @ common
        own = (self.others**2 / (1 + photons * self.star)[:, None]).sum(0)
        left = 1 - (common * answer).sum(axis=0) / own
        z = answer / np.sqrt(np.diagonal(covariance))[:, None]
        return z, left < LEAST, 1 / np.sqrt(own * np.maximum(left, LEAST))


def _laws(moves, rate, numbers):
    """
    Return distributions (w, z) of the errors for numbers of hidden stars.

    ``moves`` are what hidden stars do, in standard errors, and ``rate`` how
    often each of them is there, for a number of 1.
    """
    place = np.clip(np.rint(moves / _BIN).astype(int), -_SIZE // 4,
                    _SIZE // 2) % _SIZE
    often = np.bincount(place.ravel(), rate.ravel(), _SIZE)
    move = np.fft.rfft(often) - often.sum()
    t = 2 * np.pi * np.fft.rfftfreq(_SIZE, _BIN)
    chance = np.fft.irfft(np.exp(numbers[:, None] * move - t**2 / 2), _SIZE)
    return np.cumsum(np.roll(chance, _ZERO, axis=1), axis=1)


def square_of_one(moves, rate):
    """
    Return what hidden stars do to one number of a star.

    By what the square of the width of its errors about 0 exceeds 1, of moves
    and rates as `_laws` has them.
    """
    return _squares(_laws(moves, rate, np.ones(1)), [0.0])[0]


def _quantile(law, share):
    """Return below which error a share of the law is."""
    # Half of what is in a bin is below its middle.
    middle = law - np.diff(law, prepend=0) / 2
    return np.interp(share, middle, _ERRORS)


def _squares(laws, centres):
    """Return (w,) by what squares of the widths about centres exceed 1."""
    out = []
    for law, centre in zip(laws, centres, strict=True):
        middle = law - np.diff(law, prepend=0) / 2
        reach = np.arange(0, _ERRORS[-1] / 2, _BIN / 2)
        within = (np.interp(centre + reach, _ERRORS, middle)
                  - np.interp(centre - reach, _ERRORS, middle))
        out.append(np.interp(_WITHIN_ONE, within, reach)**2 - 1)
    return np.maximum(out, 0)
