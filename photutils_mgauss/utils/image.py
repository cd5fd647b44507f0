"""An image as users give it: data, errors, masks, units."""
from dataclasses import dataclass

import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.stats import mad_std
from astropy.units import Quantity

from photutils_mgauss.utils.validation import as_image

# Statistics of larger images are those of evenly spaced pixels.
_SAMPLE = 1 << 23


@dataclass(frozen=True)
class Image:
    """
    The arrays that a user gives, not copied, and a unit or None.

    ``data`` and ``error`` are (ny, nx), ``bad`` is (ny, nx) or None.
    """

    data: np.ndarray
    error: np.ndarray
    bad: np.ndarray | None
    unit: object

    @classmethod
    def of(cls, data, error, mask):
        """Check what a user gives."""
        if isinstance(data, NDData):
            return cls._of_nddata(data, error, mask)
        unit = data.unit if isinstance(data, Quantity) else None
        if isinstance(error, Quantity):
            error = error.to_value(unit) if unit is not None else error
        values = as_image(data, 'data')
        bad = None if mask is None else as_image(mask, 'mask', values.shape)
        if np.ma.is_masked(data):
            bad = np.ma.getmaskarray(data) | (False if bad is None
                                              else bad.astype(bool))
        if error is None:
            error = np.broadcast_to(_estimate_noise(values, bad),
                                    values.shape)
        return cls(values, as_image(error, 'error', values.shape), bad, unit)

    @classmethod
    def _of_nddata(cls, data, error, mask):
        values = data.data if data.unit is None else data.data * data.unit
        if mask is None:
            mask = data.mask
        if error is None and data.uncertainty is not None:
            error = data.uncertainty.represent_as(StdDevUncertainty)
            unit = error.unit or data.unit
            error = error.array if unit is None else error.array * unit
        return cls.of(values, error, mask)

    @property
    def shape(self):
        """The number of pixels along y and x."""
        return self.data.shape

    def part(self, window=np.s_[:, :]):
        """Return data and variance of a window, both 0 at bad pixels."""
        data, error = (np.array(image[window], float, order='C')
                       for image in (self.data, self.error))
        bad = ~(np.isfinite(data) & np.isfinite(error) & (error > 0))
        if self.bad is not None:
            bad |= self.bad[window].astype(bool)
        data[bad] = error[bad] = 0
        return data, error**2

    def sample(self):
        """Return data and variance of good pixels, of large images some."""
        data, variance = self.part(_spaced(self.shape))
        good = variance > 0
        return data[good], variance[good]


def _spaced(shape):
    """Return slices of every so many rows that do not exceed a sample."""
    return np.s_[::max(1, -(-shape[0] * shape[1] // _SAMPLE))]


def _estimate_noise(values, bad):
    """Return the scatter of the faint half of the pixels."""
    rows = _spaced(values.shape)
    seen = values[rows].astype(float)
    good = np.isfinite(seen)
    if bad is not None:
        good &= ~bad[rows].astype(bool)
    seen = seen[good]
    if seen.size == 0:
        return 1.0
    level = np.median(seen)
    low = seen[seen <= level]
    # Stars only brighten pixels: mirror the faint half.
    noise = mad_std(np.concatenate([low, 2 * level - low]))
    return noise if noise > 0 else max(seen.std(), 1.0)


def find_gain(data, variance):
    """
    Return the gain that ties variance to data (n,), None if nothing does.

    An error map made from the data itself is a straight line over it.
    """
    step = max(1, data.size // 20000)
    data, variance = data[::step], variance[::step]
    bright = data > np.median(data) if data.size else np.array([], bool)
    data, variance = data[bright], variance[bright]
    if data.size < 50 or np.ptp(data) == 0:
        return None
    slope, start = np.polyfit(data, variance, 1)
    apart = np.abs(variance - start - slope * data)
    if slope <= 0 or np.percentile(apart, 90) > 0.02 * slope * data.std():
        return None
    return 1 / slope
