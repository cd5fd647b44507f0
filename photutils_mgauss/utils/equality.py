"""Equality of results that hold values and cannot be changed."""
from dataclasses import fields

import astropy.units as u
import numpy as np
from astropy.table import Table


class ComparedByValue:
    """
    A base of frozen data classes: equal if all their fields are.

    Arrays are equal if shapes, numbers and units are; NaN equals NaN, as it
    stands for what could not be measured.
    """

    def __eq__(self, other):
        if type(other) is not type(self):
            return NotImplemented
        return self is other or all(
            _same(getattr(self, one.name), getattr(other, one.name))
            for one in fields(self))

    def __hash__(self):
        return hash((type(self).__name__, *(
            _key(getattr(self, one.name)) for one in fields(self))))


def _same(one, other):
    """Return whether two values of a field are equal."""
    if isinstance(one, Table):
        return (isinstance(other, Table) and one.colnames == other.colnames
                and all(_same(one[name], other[name])
                        for name in one.colnames))
    if isinstance(one, (list, tuple)):
        return (type(one) is type(other) and len(one) == len(other)
                and all(map(_same, one, other)))
    if isinstance(one, (np.ndarray, np.generic, float)):
        return _same_numbers(one, other)
    return one is other or bool(one == other)


def _same_numbers(one, other):
    units = [getattr(value, 'unit', None) for value in (one, other)]
    if units[0] != units[1] or other is None:
        return False
    masks = [np.ma.getmaskarray(value) if isinstance(
        value, np.ma.MaskedArray) else False for value in (one, other)]
    if not np.array_equal(*masks):
        return False
    one, other = (np.where(masks[0], 0, np.ma.getdata(_plain(value)))
                  if np.any(masks[0]) else np.asarray(_plain(value))
                  for value in (one, other))
    real = one.dtype.kind == other.dtype.kind == 'f'
    return bool(np.array_equal(one, other, equal_nan=real))


def _plain(value):
    return value.value if isinstance(value, u.Quantity) else value


def _key(value):
    """Return something to hash that is the same for equal values."""
    if isinstance(value, np.ndarray) and value.dtype.kind == 'f':
        # Adding 0 makes -0 the 0 that it equals.
        return (np.asarray(_plain(value)) + 0.0).tobytes()
    return None
