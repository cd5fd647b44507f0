"""An image as users give it: data, errors, masks, units."""
from dataclasses import dataclass

import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.stats import mad_std
from astropy.units import Quantity


@dataclass(frozen=True)
class Image:
    """Data and variance (ny, nx), both 0 at bad pixels, and a unit or None."""

    data: np.ndarray
    variance: np.ndarray
    unit: object

    @classmethod
    def of(cls, data, error, mask):
        """Check and combine what a user gives."""
        if isinstance(data, NDData):
            return cls._of_nddata(data, error, mask)
        unit = data.unit if isinstance(data, Quantity) else None
        if isinstance(error, Quantity):
            error = error.to_value(unit) if unit is not None else error
        values = _plane(getattr(data, 'value', data), 'data')
        good = np.isfinite(values)
        if mask is not None:
            good &= ~_plane(mask, 'mask', values.shape).astype(bool)
        if error is None:
            error = np.full(values.shape, _estimate_noise(values[good]))
        error = _plane(error, 'error', values.shape)
        good &= np.isfinite(error) & (error > 0)
        return cls(np.where(good, values, 0.0),
                   np.where(good, error, 0.0)**2, unit)

    @classmethod
    def _of_nddata(cls, data, error, mask):
        values = data.data if data.unit is None else data.data * data.unit
        if mask is None:
            mask = data.mask
        if error is None and data.uncertainty is not None:
            error = data.uncertainty.represent_as(StdDevUncertainty).array
        return cls.of(values, error, mask)


def _plane(value, name, shape=None):
    value = np.asarray(getattr(value, 'value', value))
    if value.dtype.kind not in 'buif':
        msg = f'{name} must be an array of numbers, got {value.dtype}'
        raise TypeError(msg)
    if value.ndim != 2 or (shape is not None and value.shape != shape):
        want = '(ny, nx)' if shape is None else f'that of data, {shape}'
        msg = f'{name} must have the shape {want}, got {value.shape}'
        raise ValueError(msg)
    return value.astype(float)


def _estimate_noise(values):
    """Return the scatter of the faint half of the pixels."""
    if values.size == 0:
        return 1.0
    level = np.median(values)
    low = values[values <= level]
    # Stars only brighten pixels: mirror the faint half.
    noise = mad_std(np.concatenate([low, 2 * level - low]))
    return noise if noise > 0 else max(values.std(), 1.0)


def find_gain(image):
    """
    Return the gain that ties variance to data, None if nothing does.

    An error map made from the data itself is a straight line over it.
    """
    good = image.variance > 0
    data, variance = image.data[good], image.variance[good]
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
