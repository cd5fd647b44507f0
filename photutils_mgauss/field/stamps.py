"""Stamps of stars cut from an image, and the noise model of their pixels."""
from dataclasses import dataclass, fields

import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.utils.image import photon_slope

# Light is looked for inside this radius, its sky and noise in the ring outside
# this share of the stamp's radius [pix].
_CORE, _RING = 2.5, 0.6
# A stamp is used if its middle 3x3 pixels and this share of the rest are.
_MIN_GOOD = 0.5


@dataclass
class Stamps:
    """
    The pixels around n stars.

    Attributes
    ----------
    data : (n, s, s) `~numpy.ndarray`
        The pixels; 0 where there are none.
    base : (n, s, s) `~numpy.ndarray`
        Their variance without the star's own photons.
    good : (n, s, s) `~numpy.ndarray` of bool
        Which pixels are inside the circle and can be used.
    corners : (n, 2) `~numpy.ndarray`
        The pixel (x, y) of each stamp's first.
    slope : (n, 1, 1) `~numpy.ndarray`
        Variance for each unit of light of a star (one over the gain).
    """

    data: np.ndarray
    base: np.ndarray
    good: np.ndarray
    corners: np.ndarray
    slope: np.ndarray

    @property
    def radius(self):
        """Half the width of a stamp, in whole pixels."""
        return self.data.shape[1] // 2

    def subset(self, index):
        """Return some of the stamps."""
        return Stamps(*(getattr(self, one.name)[index]
                        for one in fields(self)))

    @classmethod
    def joined(cls, parts):
        """Return stamps of one size as one."""
        return cls(*(np.concatenate([getattr(part, one.name)
                                     for part in parts])
                     for one in fields(cls)))

    def offsets(self):
        """Return the distance of each pixel from the middle one, (s, s)."""
        steps = np.arange(-self.radius, self.radius + 1)
        return np.hypot(steps, steps[:, None])

    def light_over_noise(self):
        """
        Return the light at the middle over its own noise, (n,).

        Sky and noise are those of the ring around it, whatever the errors
        say.
        """
        distance = self.offsets()
        core = self.good & (distance <= _CORE)
        ring = self.good & (distance > max(_CORE, _RING * self.radius))
        pulls = np.zeros(len(self.data))
        for i, (data, inner, outer) in enumerate(zip(self.data, core, ring,
                                                     strict=True)):
            around = data[outer] if outer.any() else np.zeros(1)
            n = np.count_nonzero(inner)
            light = data[inner].sum() - n * np.median(around)
            noise = np.sqrt(n * (1 + n / around.size)) * mad_std(around)
            pulls[i] = light / max(noise, 1e-6 * abs(light), 1e-300)
        return pulls

    def usable(self):
        """Return which stamps have enough pixels, the middle ones of all."""
        middle = slice(self.radius - 1, self.radius + 2)
        core = self.good[:, middle, middle].all(axis=(1, 2))
        full = np.count_nonzero(self.offsets() <= self.radius + 0.5)
        return core & (self.good.sum(axis=(1, 2)) >= _MIN_GOOD * full)


def cut_stamps(pixels, x, y, radius):
    """
    Cut stamps of n stars out of an image, a `PixelData`.

    Without its ``error`` the variance is 1.
    """
    data, error, mask = pixels.data, pixels.error, pixels.mask
    half = int(np.ceil(radius))
    # A star without a position is far from the image, too.
    positions = np.nan_to_num(np.column_stack([x, y]), nan=-1e6)
    corners = np.rint(np.clip(positions, -1e6, 1e6)) - half
    size = 2 * half + 1
    shape = (len(corners), size, size)
    stamps, variance = np.zeros(shape), np.ones(shape)
    good = np.zeros(shape, bool)
    for i, corner in enumerate(corners.astype(int)):
        here, there = _overlap(corner, size, data.shape)
        stamps[i][here] = data[there]
        good[i][here] = True if mask is None else ~mask[there]
        if error is not None:
            # The sign is kept: a negative error marks a bad pixel, too.
            sigma = error[there].astype(float)
            variance[i][here] = sigma * np.abs(sigma)
    good &= np.isfinite(stamps) & np.isfinite(variance) & (variance > 0)
    stamps[~good] = 0
    variance[~good] = 1
    new = Stamps(stamps, variance, good, corners,
                 np.zeros((len(corners), 1, 1)))
    new.good &= new.offsets() <= radius + 0.5
    return new


def _overlap(corner, size, shape):
    """Return the slices of a stamp and of an image where they overlap."""
    low = np.clip(corner, 0, shape[::-1])
    high = np.clip(corner + size, 0, shape[::-1])
    high = np.maximum(low, high)
    there = tuple(slice(a, b) for a, b in zip(low[::-1], high[::-1],
                                              strict=True))
    here = tuple(slice(a, b) for a, b in zip((low - corner)[::-1],
                                             (high - corner)[::-1],
                                             strict=True))
    return here, there


def remove_star_noise(stamps, gain):
    """
    Take the photons of the stars out of the variance, in place.

    The error of a pixel is often made from the pixel itself. A fit with such
    weights believes low pixels more than high ones and finds less flux than
    there is. The fit therefore needs the variance without the star, and adds
    that of the model's light.

    Parameters
    ----------
    stamps : Stamps
        With the whole variance in ``base``.
    gain : float or None
        Electrons per unit of data; infinity to leave the variance as it is;
        None to find out whether it was made from the data, and with what
        gain.
    """
    slope, clipped = (1 / gain, True) if gain is not None else photon_slope(
        stamps.data, np.where(stamps.good, stamps.base, 0))
    if slope == 0:
        return
    light = np.maximum(stamps.data, 0) if clipped else stamps.data
    rest = stamps.base - slope * light
    # What is left is sky and read-out noise; no pixel has much less of it
    # than the others.
    floor = max(0.1 * np.median(rest[stamps.good]),
                1e-3 * np.median(stamps.base[stamps.good]))
    stamps.base = np.where(stamps.good, np.maximum(rest, floor), 1.0)
    stamps.slope[:] = slope
