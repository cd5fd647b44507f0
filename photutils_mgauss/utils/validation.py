"""
Checks of arguments, each raising an error that names argument, rule and value.

About errors: a wrong type raises `TypeError`, a wrong value `ValueError`, and
both are raised in the public call, never in a kernel. Trouble that belongs to
one star or stamp of many is not an error: it becomes NaN and a flag.
"""
from collections.abc import Iterable
from numbers import Integral, Real

import astropy.units as u
import numpy as np

# Above it, squares overflow; no counter or length of an array is longer.
_LARGEST = 1e150
_LONGEST = 2**31 - 1
# No image has more pixels along an axis.
_WIDEST = 10**6
# A grid of PSFs of so many nodes takes ten seconds to make; without a limit,
# a slip of the pen takes all memory there is.
_MOST_NODES = 10**5


def shown(value):
    """Return how messages show a value: one line, at most 80 characters."""
    if isinstance(value, np.generic):
        value = value.item()
    return ' '.join(repr(value).split())[:80]


def in_pixels(value, name):
    """
    Return numbers without unit, and masked ones as NaN.

    The scale of pixels is not known, so that units other than powers of a
    pixel are errors.
    """
    if isinstance(value, np.ma.MaskedArray):
        value = np.ma.filled(value.astype(float), np.nan)
    unit = getattr(value, 'unit', None)
    if isinstance(unit, u.UnitBase):
        if set(unit.bases) - {u.pix}:
            msg = f'{name} must have no unit or be in pixels, got {unit}'
            raise ValueError(msg)
        value = u.Quantity(value).value
    return value


def real_array(value, name):
    """
    Return ``value`` as a float64 array, without a copy where it is one.

    Text, lists of different lengths and complex numbers are errors.
    """
    try:
        array = np.asarray(value)
        if array.dtype.kind != 'c':
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError) as error:
        msg = f'{name} must be an array of numbers, got {shown(value)}'
        raise TypeError(msg) from error
    msg = f'{name} must be real, got complex numbers'
    raise TypeError(msg)


def as_floats(value, name, *, shape=None, finite=True):
    """
    Copy ``value`` into a new contiguous native float64 array.

    ``shape`` is checked where given; None in it stands for any length. Units
    are refused, see `in_pixels`; masked numbers are not finite.
    """
    array = np.array(real_array(in_pixels(value, name), name),
                     dtype=np.float64, order='C', copy=True)
    if shape is not None:
        fits = array.ndim == len(shape) and all(
            want in (None, got)
            for want, got in zip(shape, array.shape, strict=True))
        if not fits:
            words = ', '.join('n' if n is None else str(n) for n in shape)
            msg = f'{name} must have shape ({words}), got {array.shape}'
            raise ValueError(msg)
    if finite and not np.isfinite(array).all():
        bad = array[~np.isfinite(array)][0]
        msg = f'{name} must be finite, got {bad}'
        raise ValueError(msg)
    return array


def as_columns(**values):
    """Return arrays of one length (n,); numbers stand for all."""
    arrays = [np.atleast_1d(as_floats(value, name))
              for name, value in values.items()]
    lengths = {array.size for array in arrays if array.shape != (1,)}
    if len(lengths) > 1 or any(array.ndim > 1 for array in arrays):
        shapes = ', '.join(str(array.shape) for array in arrays)
        msg = (f'{", ".join(values)} must have one shape (n,), or be '
               f'numbers, got {shapes}')
        raise ValueError(msg)
    return [array.copy() for array in np.broadcast_arrays(*arrays)]


def as_real(value, name, *, above=None, minimum=None, maximum=None):
    """Return ``value`` as a finite float within the limits given."""
    if isinstance(value, bool) or not isinstance(value, (Real, np.ndarray)):
        msg = f'{name} must be a number, got {shown(value)}'
        raise TypeError(msg)
    value = float(value)
    if not np.isfinite(value):
        msg = f'{name} must be finite, got {value}'
        raise ValueError(msg)
    _check_limits(value, name, above, minimum,
                  _LARGEST if maximum is None else maximum)
    return value


def as_integer(value, name, *, minimum=None, maximum=None):
    """Return ``value`` as an int within the limits given."""
    if isinstance(value, bool) or not isinstance(value, Integral):
        msg = f'{name} must be an integer, got {shown(value)}'
        raise TypeError(msg)
    _check_limits(value, name, None, minimum,
                  _LONGEST if maximum is None else maximum)
    return int(value)


def _check_limits(value, name, above, minimum, maximum):
    if above is not None and not value > above:
        msg = f'{name} must be greater than {above}, got {value}'
        raise ValueError(msg)
    if minimum is not None and value < minimum:
        msg = f'{name} must be at least {minimum}, got {value}'
        raise ValueError(msg)
    if maximum is not None and value > maximum:
        msg = f'{name} must be at most {maximum}, got {value}'
        raise ValueError(msg)


def as_shape(value, name, *, minimum=1):
    """Return ``value``, an int or a pair of ints, as the tuple (ny, nx)."""
    pair = tuple(value) if isinstance(value, Iterable) else (value, value)
    if len(pair) != 2:
        msg = f'{name} must be one integer or two (ny, nx), got {shown(value)}'
        raise ValueError(msg)
    return tuple(as_integer(n, name, minimum=minimum, maximum=_WIDEST)
                 for n in pair)


def as_grid_shape(value, name='grid_shape'):
    """Return the shape (ny, nx) of a grid of PSFs that memory can hold."""
    ny, nx = as_shape(value, name)
    if ny * nx > _MOST_NODES:
        msg = (f'{name} must have at most {_MOST_NODES} nodes, got '
               f'{ny} x {nx}')
        raise ValueError(msg)
    return ny, nx


def check_callables(options, names):
    """Raise if one of the options with these names cannot be called."""
    for name in names:
        value = options.get(name)
        if not (value is None or callable(value)):
            msg = f'{name} must be callable or None, got {shown(value)}'
            raise TypeError(msg)


def as_choice(value, name, choices):
    """Return ``value`` if it is one of ``choices``."""
    if value not in choices:
        words = ', '.join(repr(choice) for choice in choices)
        msg = f'{name} must be one of {words}, got {shown(value)}'
        raise ValueError(msg)
    return value


def as_rng(value, name='rng'):
    """Return a generator of random numbers; `value` may be its seed."""
    try:
        return np.random.default_rng(value)
    except (TypeError, ValueError) as error:
        msg = (f'{name} must be None, a numpy Generator, or a seed of '
               f'non-negative integers, got {shown(value)}')
        raise type(error)(msg) from error


def as_range(value, name):
    """Return two finite numbers, the lower first."""
    low, high = as_floats(value, name, shape=(2,))
    if low > high:
        msg = f'{name} must be (lower, higher), got ({low:g}, {high:g})'
        raise ValueError(msg)
    return low, high


def as_instance(value, kind, name):
    """Return ``value`` if it is an object of the class ``kind``."""
    if not isinstance(value, kind):
        msg = (f'{name} must be of the class {kind.__name__}, got '
               f'{type(value).__name__}')
        raise TypeError(msg)
    return value
