"""
Pixels as users give them: data, errors, mask and unit, read once for all.

Every public call that takes pixels reads them here, so that all accept the
same: plain arrays and nested lists of any number type, byte and memory order;
masked arrays, whose mask counts; quantities, whose unit comes back with the
result; `~astropy.nddata.NDData` with its mask, its unit and an uncertainty of
any kind. Nothing that a user gives is changed, and an image is copied only
where the call would have to copy it anyway.
"""
import warnings
from dataclasses import dataclass, replace
from functools import reduce

import astropy.units as u
import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.stats import mad_std
from astropy.utils.exceptions import AstropyUserWarning
from astropy.utils.masked import Masked

from photutils_mgauss.utils.validation import as_real

# Statistics of larger images are those of evenly spaced rows.
_SAMPLE = 1 << 23
_GAIN_SAMPLE = 1 << 18
# A row of this many equal pixels and one more is no accident; if that is so
# for this share of the pixels, something is wrong with the image.
_PADDING_RUN, _PADDING_SHARE, _PADDING_SAMPLE = 15, 0.03, 1 << 18
# In images with noise, more than this share of pixels are peaks or troughs.
_NOISY_TURNS = 0.45
_BLOCK = 1 << 20
# How much the variance may scatter about a line in the data, as a fraction of
# the scatter of an expected variance, to be made from these very data.
_OWN_VARIANCE = 0.3


@dataclass(frozen=True, eq=False)
class PixelData:
    """
    The pixels of one image, or of a stack of n.

    Attributes
    ----------
    data : (ny, nx) or (n, ny, nx) `~numpy.ndarray`
        Real numbers of at most 64 bits, in any byte and memory order; the
        array of the user where that is one.
    error : `~numpy.ndarray` or None
        Of the same shape, in the unit of the data.
    mask : `~numpy.ndarray` of bool or None
        Of the same shape, True for pixels to leave out.
    unit : `~astropy.units.UnitBase` or None
        Of the data.
    estimated : bool
        Whether the error is one number that was made from the data.
    """

    data: np.ndarray
    error: np.ndarray | None
    mask: np.ndarray | None
    unit: object = None
    estimated: bool = False

    @property
    def shape(self):
        """The shape of the data."""
        return self.data.shape

    def with_error(self):
        """Return the image with one estimated error if it has none."""
        if self.error is not None:
            return self
        noise = _estimate_noise(self.data, self.mask)
        return replace(self, error=np.broadcast_to(noise, self.shape),
                       estimated=True)

    def part(self, window=np.s_[:, :]):
        """Return data and variance of a window, both 0 at bad pixels."""
        data, error = (np.array(image[window], float, order='C')
                       for image in (self.data, self.error))
        bad = ~(np.isfinite(data) & np.isfinite(error) & (error > 0))
        if self.mask is not None:
            bad |= self.mask[window]
        data[bad] = error[bad] = 0
        return data, error**2

    def sample(self):
        """Return data and variance of good pixels, of large images some."""
        data, variance = self.part(_spaced(self.shape, _SAMPLE))
        good = variance > 0
        return data[good], variance[good]

    def gain(self):
        """Return the gain the errors were made with, None if with none."""
        slope, _ = photon_slope(*self.part(_spaced(self.shape, _GAIN_SAMPLE)))
        return 1 / slope if slope > 0 else None


def read_pixels(data, error=None, mask=None, *, name='data', broadcast=False):
    """
    Read one image.

    Parameters
    ----------
    data, error, mask
        What the user gives; ``error`` may be one number for all pixels. The
        masks of ``data`` and ``error`` count beside ``mask``; ``error`` goes
        before the uncertainty of an NDData.
    name : str, optional
        What the call calls ``data``, for messages.
    broadcast : bool, optional
        Whether ``error`` and ``mask`` may have any shape that broadcasts to
        that of the image.

    Returns
    -------
    PixelData

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Warns
    -----
    AstropyUserWarning
        If no pixel can be used: all are masked, not finite, or have an error
        that is not positive and finite. If a large part of the image holds
        one value only beside pixels with noise or a sky, as mosaics have it
        where there is no data.
    """
    pixels = _read(data, error, mask, name, (2,), broadcast)
    _warn_of_nothing(pixels, name)
    _warn_of_padding(pixels, name)
    return pixels


def read_stack(data, error=None, mask=None, *, name='image'):
    """
    Read one image or many of one shape; tell if it was one.

    As `read_pixels` with ``broadcast``, but images of PSFs without a pixel
    that can be used are left to their fits. The data are a copy, (n, ny, nx)
    float64, contiguous.

    Returns
    -------
    PixelData
    single : bool
    """
    pixels = _read(data, error, mask, name, (2, 3), broadcast=True)
    shape = (-1, *pixels.shape[-2:])
    # What was a list is an array of our own already.
    convert = np.asarray if isinstance(data, (list, tuple)) else np.array
    images = PixelData(
        convert(pixels.data, np.float64, order='C').reshape(shape),
        *(None if array is None else array.reshape(shape)
          for array in (pixels.error, pixels.mask)),
        pixels.unit)
    _warn_of_padding(PixelData(*(
        None if array is None else array.reshape(-1, shape[-1])
        for array in (images.data, images.error, images.mask))), name)
    return images, pixels.data.ndim == 2


def read_quantity(value, name):
    """
    Return numbers of any shape as float64, NaN where masked, and their unit.

    The unit of plain numbers is None.
    """
    array, mask, unit = _unwrap(_split(value, name)[0], name)
    array = np.array(array, np.float64, order='C')
    if mask is not None:
        array[mask] = np.nan
    return array, unit


def read_values(value, name, unit):
    """
    Return numbers in the unit of an image as float64, NaN where masked.

    Those without a unit of their own are taken to be in that of the image.
    """
    array, own = read_quantity(value, name)
    return array if own is None else array * _factor(own, unit, name,
                                                     'the image')


def read_level(value, name, unit):
    """Return one number in the unit of an image; see `read_values`."""
    if isinstance(value, u.Quantity):
        return as_real(read_values(value, name, unit), name)
    return as_real(value, name)


def with_unit(values, unit):
    """Return values as a quantity, as they are if there is no unit."""
    return values if unit is None else np.asarray(values) << unit


def check_errors(error, used):
    """Check that errors are positive and finite where pixels are used."""
    bad = used & ~((error > 0) & np.isfinite(error))
    if bad.any():
        msg = (f'error must be positive and finite, got {error[bad][0]}; mask '
               'pixels that must not be used')
        raise ValueError(msg)


# What fits mixtures to photutils' models of images.
FITTED_BY = {'GriddedPSFModel': 'from_gridded_psf',
             'ImagePSF': 'from_image_psf'}


# From what a user gives to plain arrays.

def _read(data, error, mask, name, ndims, broadcast):
    data, own_error = _split(data, name)
    values, masked, unit = _unwrap(data, name)
    _check_shape(values, name, ndims)
    shape = values.shape
    masks = [masked, _fit(_read_mask(mask), 'mask', name, shape, broadcast)]
    error = own_error if error is None else error
    if error is not None:
        error, masked, own = _unwrap(error, 'error')
        if own is not None or unit is not None:
            factor = _factor(own, unit, 'error', name)
            error = error if factor == 1 else error * factor
        error = _fit(error, 'error', name, shape, broadcast)
        masks.append(_fit(masked, 'error', name, shape, broadcast))
    masks = [one for one in masks if one is not None]
    mask = reduce(np.logical_or, masks) if masks else None
    return PixelData(values, error, mask, unit)


def _split(data, name):
    """Return data with masks and units, and the errors that come along."""
    if isinstance(data, NDData):
        return _from_nddata(data, name)
    if isinstance(data, (list, tuple)) and any(
            isinstance(one, NDData) for one in data):
        parts = [_split(one, name) for one in data]
        errors = [error for _, error in parts if error is not None]
        if len(errors) not in (0, len(parts)):
            msg = (f'{name} must have an uncertainty in all images or in '
                   f'none, got {len(errors)} in {len(parts)}')
            raise ValueError(msg)
        return [one for one, _ in parts], errors or None
    return data, None


def _from_nddata(nddata, name):
    """Return the data with mask and unit, and the error or None."""
    data = with_unit(nddata.data, nddata.unit)
    if nddata.mask is not None:
        mask = _fit(_read_mask(nddata.mask), 'mask', name, np.shape(data),
                    broadcast=True)
        data = Masked(data, mask)
    if nddata.uncertainty is None:
        return data, None
    error = _standard_deviation(nddata.uncertainty, name)
    return data, with_unit(error.array, error.unit or nddata.unit)


def _standard_deviation(uncertainty, name):
    """Return an uncertainty of any kind as a standard deviation."""
    if isinstance(uncertainty, StdDevUncertainty):
        return uncertainty
    try:
        # A pixel of no weight has an infinite error.
        with np.errstate(divide='ignore'):
            return uncertainty.represent_as(StdDevUncertainty)
    except (TypeError, ValueError) as reason:
        msg = (f'{name} must have an uncertainty that is a standard '
               f'deviation, a variance or its inverse, got '
               f'{type(uncertainty).__name__}')
        raise ValueError(msg) from reason


def _unwrap(value, name):
    """Return the plain numbers, the mask and the unit of an argument."""
    if isinstance(value, (list, tuple)) and any(map(_has_more, value)):
        return _unwrap_list(value, name)
    mask = unit = None
    if isinstance(value, Masked):
        value, mask = value.unmasked, value.mask
    elif isinstance(value, np.ma.MaskedArray):
        mask = None if value.mask is np.ma.nomask else value.mask
        value = value.data
    if isinstance(value, u.Quantity):
        value, unit = value.value, value.unit
        if unit.is_equivalent(u.one):
            scale, unit = unit.to(u.one), None
            value = value if scale == 1 else value * scale
    return _numbers(value, name), mask, unit


def _has_more(value):
    return isinstance(value, (Masked, np.ma.MaskedArray, u.Quantity))


def _unwrap_list(values, name):
    """Unwrap a list of images, of which each may have a mask and a unit."""
    parts = [_unwrap(one, name) for one in values]
    unit = parts[0][2]
    arrays = [array if own is None and unit is None
              else array * _factor(own, unit, name, 'the first of them')
              for array, _, own in parts]
    masks = [np.zeros(array.shape, bool) if mask is None else mask
             for array, mask, _ in parts]
    shapes = {array.shape for array in arrays}
    if len(shapes) > 1:
        msg = f'{name} must hold images of one shape, got {sorted(shapes)}'
        raise ValueError(msg)
    return np.stack(arrays), np.stack(masks), unit


def _numbers(value, name):
    """Return an array of numbers, not copied if it is one."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as reason:
        msg = f'{name} must be an array of numbers, got {value!r:.80}'
        raise TypeError(msg) from reason
    if array.dtype.kind not in 'buif':
        got = array.dtype if array.ndim else f'{value!r:.80}'
        one = value[0] if isinstance(value, (list, tuple)) else value
        kind = type(one).__name__
        if hasattr(one, 'header'):
            got = f'{kind}: give its .data'
        elif kind in FITTED_BY:
            got = (f'{kind}: `GriddedMixturePSF.{FITTED_BY[kind]}` fits '
                   'mixtures to it')
        msg = f'{name} must be an array of numbers, got {got}'
        raise TypeError(msg)
    if array.dtype.kind == 'b':
        return array.view(np.uint8)
    if array.dtype.kind == 'f' and array.dtype.itemsize not in (4, 8):
        # Half precision has too few digits to compute with.
        return array.astype(np.float32 if array.dtype.itemsize < 4
                            else np.float64)
    return array


def _check_shape(array, name, ndims):
    if array.ndim not in ndims or 0 in array.shape:
        want = ('the shape (ny, nx)' if ndims == (2,)
                else 'shape (ny, nx) or (n, ny, nx)')
        msg = f'{name} must have {want} and pixels, got {array.shape}'
        raise ValueError(msg)


def _read_mask(mask):
    """Return a mask as an array of bool, or None."""
    if mask is None or mask is np.ma.nomask:
        return None
    if isinstance(mask, (np.ma.MaskedArray, Masked)):
        mask = mask.filled(True)
    mask = np.asarray(mask)
    if mask.dtype.kind not in 'bui':
        msg = f'mask must be an array of bool, got dtype {mask.dtype}'
        raise TypeError(msg)
    return mask.astype(bool, copy=False)


def _fit(array, name, data_name, shape, broadcast):
    """Return an array in the shape of the data, None if it is None."""
    if array is None or array.shape == shape:
        return array
    if broadcast or (array.ndim == 0 and name == 'error'):
        try:
            return np.broadcast_to(array, shape)
        except ValueError:
            msg = (f'{name} must broadcast to the shape {shape[-2:]} of an '
                   f'image, got {array.shape}')
            raise ValueError(msg) from None
    msg = (f'{name} must have the shape of {data_name}, {shape}, got '
           f'{array.shape}')
    raise ValueError(msg)


def _factor(own, unit, name, data_name):
    """Return what numbers in a unit of their own are in that of the data."""
    if unit is None:
        msg = f'{name} must have no unit, as {data_name} has none, got {own}'
        raise ValueError(msg)
    if own is None:
        msg = f'{name} must have a unit, as {data_name} has {unit}, got none'
        raise ValueError(msg)
    try:
        return own.to(unit)
    except u.UnitConversionError as reason:
        msg = f'{name} must have a unit like {unit}, got {own}'
        raise ValueError(msg) from reason


# Images that cannot be what the user believes.

def _warn_of_nothing(pixels, name):
    """Warn if not a single pixel can be used."""
    step = max(1, _BLOCK // pixels.shape[1])
    for first in range(0, pixels.shape[0], step):
        rows = np.s_[first:first + step]
        good = np.isfinite(pixels.data[rows])
        if pixels.error is not None:
            error = pixels.error[rows]
            good &= np.isfinite(error) & (error > 0)
        if pixels.mask is not None:
            good &= ~pixels.mask[rows]
        if good.any():
            return
    if pixels.mask is not None and pixels.mask.all():
        why = 'all are masked'
    elif not np.isfinite(pixels.data).any():
        why = 'all are NaN or infinite'
    else:
        why = ('all are masked or not finite, or have an error that is not '
               'positive and finite')
    warnings.warn(f'{name} has no pixel that can be used: {why}',
                  AstropyUserWarning, stacklevel=4)


def _warn_of_padding(pixels, name):
    """Warn if much of the image has one value, and not the rest."""
    rows = _spaced(pixels.shape, _PADDING_SAMPLE)
    data = np.array(pixels.data[rows], float)
    if pixels.mask is not None:
        data[pixels.mask[rows]] = np.nan
    if pixels.error is not None:
        error = pixels.error[rows]
        data[~(np.isfinite(error) & (error > 0))] = np.nan
    constant = _in_runs(data)
    share = np.count_nonzero(constant) / data.size
    if share < _PADDING_SHARE:
        return
    value = np.median(data[constant])
    if _is_noisy(data, data != value):
        warnings.warn(
            f'{100 * share:.0f} % of the pixels of {name} have exactly the '
            f'value {value:g}, beside others with noise: give a mask of '
            'pixels without data', AstropyUserWarning, stacklevel=4)


def _in_runs(data):
    """Return which pixels are in long runs of equal pixels along rows."""
    length = _PADDING_RUN
    constant = np.zeros(data.shape, bool)
    if data.shape[1] <= length:
        return constant
    equal = np.diff(data, axis=1) == 0
    # Of most images nothing more has to be known.
    if np.count_nonzero(equal) < length:
        return constant
    same = np.pad(np.cumsum(equal, axis=1), ((0, 0), (1, 0)))
    whole = same[:, length:] - same[:, :-length] == length
    for i in range(length + 1):
        constant[:, i:i + whole.shape[1]] |= whole
    return constant


def _is_noisy(data, chosen):
    """
    Return whether the chosen pixels of an image have noise.

    Along a row noise turns at two pixels of three, clean light of stars at
    few: at its peaks, and between neighbours.
    """
    steps = np.diff(data, axis=1)
    in_a_row = chosen[:, 2:] & chosen[:, 1:-1] & chosen[:, :-2]
    turns = (steps[:, 1:] * steps[:, :-1] < 0)[in_a_row]
    return turns.size > 0 and turns.mean() > _NOISY_TURNS


# What an image says of its noise.

def _spaced(shape, size):
    """Return slices of every so many rows that do not exceed a size."""
    return np.s_[::max(1, -(-shape[0] * shape[1] // size))]


def _estimate_noise(values, mask):
    """Return the scatter of the faint half of the pixels."""
    rows = _spaced(values.shape, _SAMPLE)
    seen = values[rows].astype(float)
    good = np.isfinite(seen)
    if mask is not None:
        good &= ~mask[rows]
    seen = seen[good]
    if seen.size == 0:
        return 1.0
    level = np.median(seen)
    low = seen[seen <= level]
    # Stars only brighten pixels: mirror the faint half.
    noise = mad_std(np.concatenate([low, 2 * level - low]))
    return noise if noise > 0 else seen.std() or 1.0


def photon_slope(data, variance):
    """
    Return how the variance grows with the data, and if it is clipped at 0.

    The slope, one over the gain, is 0 unless the variance was computed from
    these very pixels: an expected variance scatters about any line in the
    data by their noise. Differences of neighbouring pixels keep gradients of
    the sky out of this.

    Parameters
    ----------
    data, variance : (..., n) `~numpy.ndarray`
        Rows of neighbouring pixels; the variance is 0 where they are bad.

    Returns
    -------
    slope : float
    clipped : bool
        Whether negative data count as 0.
    """
    good = variance > 0
    pairs = good[..., 1:] & good[..., :-1]
    best, scatter = (0.0, True), _OWN_VARIANCE
    if not pairs.any():
        return best
    change = np.diff(variance)[pairs]
    noise = np.sqrt(np.median(variance[good]))
    for clipped in (True, False):
        light = np.maximum(data, 0) if clipped else data
        step = np.diff(light)[pairs]
        # Not BLAS: its threads wait for each other on a busy machine.
        power = np.sum(step**2)
        slope = np.sum(step * change) / power if power > 0 else 0.0
        if slope <= 0:
            continue
        rest = change - slope * step
        # A steep sky that is not in the variance is the same in most steps.
        rest = np.median(np.abs(rest - np.median(rest))) / (slope * noise)
        if rest < scatter:
            best, scatter = (slope, clipped), rest
    return best
