"""Pixels that are saturated, and those their charge has run into."""
from dataclasses import replace

import numpy as np
from astropy.stats import mad_std
from scipy.ndimage import (
    binary_dilation,
    binary_propagation,
    find_objects,
    label,
)

from photutils_mgauss.utils.image import read_level
from photutils_mgauss.utils.validation import as_real

# A trail goes on while a pixel has this fraction of the level and is so many
# times as bright as those so far beside it.
_TRAIL_LEVEL, _TRAIL_CONTRAST, _BESIDE = 0.25, 3.0, 3
_SQUARE = np.ones((3, 3), bool)
_ALONG = np.ones((3, 1), bool), np.ones((1, 3), bool)
# A plateau is not flat: next to a full pixel this fraction of the level is
# full, too.
_PLATEAU = 0.9
# Charge runs along an axis if clumps of at least so many rows and columns are
# so many times longer that way than light is.
_LEAST_SIZE, _LONGER = 3, 1.5
# What light is like is seen where unsaturated stars have more than this
# fraction of the level, and are so many times as bright as the noise.
_BRIGHT, _ABOVE_NOISE = 0.1, 5.0
# Of so many pixels sky and noise are known well enough.
_ENOUGH = 100_000


def as_saturation(value):
    """
    Check a level of saturation; None is none, infinity that masks alone tell.

    Raises
    ------
    TypeError, ValueError
        If it is neither positive nor infinite.
    """
    if value is None or (np.isscalar(value) and value == np.inf):
        return value
    return (value if hasattr(value, 'unit')
            else as_real(value, 'saturation', above=0))


def saturated_pixels(pixels, level):
    """
    Tell which pixels are of no use near saturated ones.

    Those at the level or above, those next to them that nearly are, and those
    that their charge has run into along rows or columns, with a pixel beyond
    both ends of these. Charge runs where clumps are much longer along an axis
    than the light of unsaturated stars of a tenth of the level and five times
    the noise or more; without such stars, light counts as round. Where clumps
    are too small to say whether and along which of both charge runs, a pixel
    all around is of no use, too. Other pixels beside saturated ones tell most
    of where a star is, and are left.

    Parameters
    ----------
    pixels : PixelData
        One image.
    level : float, `~astropy.units.Quantity` or inf
        In the unit of the image if it has none; at infinity are pixels that
        are not finite.

    Returns
    -------
    (ny, nx) `~numpy.ndarray` of bool
    """
    if np.isscalar(level) and level == np.inf:
        return ~np.isfinite(pixels.data)
    level = read_level(level, 'saturation', pixels.unit)
    data = np.asarray(pixels.data)
    with np.errstate(invalid='ignore'):
        full = data >= level
    if not full.any():
        return full
    with np.errstate(invalid='ignore'):
        full = binary_propagation(full, _SQUARE, data >= _PLATEAU * level)
    clumps, _ = label(full, _SQUARE)
    trails = [full.copy(), full.copy()]
    for box in find_objects(clumps):
        _mark_trail(data, trails[0], box, level)
        _mark_trail(data.T, trails[1].T, box[::-1], level)
    light = _aspect_of_light(pixels, level, trails[0] | trails[1])
    runs = _axes_of_charge(light, full, trails[0] | trails[1])
    if runs is None:
        return binary_dilation(trails[0] | trails[1], _SQUARE)
    for axis in np.flatnonzero(runs):
        # The profile of a star is as steep as that of a trail is beside it.
        full = full | binary_dilation(trails[axis], _ALONG[axis])
    return full


def _axes_of_charge(light, *masks):
    """Return along which axes charge runs, (2,), or None if unknown."""
    sizes = np.concatenate([_sizes(find_objects(label(mask, _SQUARE)[0]))
                            for mask in masks])
    sizes = sizes[(sizes >= _LEAST_SIZE).all(axis=1)].sum(axis=0)
    if not sizes.any():
        return None
    longer = sizes[0] / (sizes[1] * light)
    return np.array([longer, 1 / longer]) > _LONGER


def _aspect_of_light(pixels, level, taken):
    """Return how many times longer along columns unsaturated stars are."""
    data = np.asarray(pixels.data)
    good = np.isfinite(data)
    if pixels.mask is not None:
        good &= ~pixels.mask
    if not good.any():
        return 1.0
    some = data[good]
    some = some[::max(1, some.size // _ENOUGH)]
    sky = np.median(some)
    least = max(_BRIGHT * (level - sky), _ABOVE_NOISE * mad_std(some))
    with np.errstate(invalid='ignore'):
        bright = good & (data > sky + least)
    clumps, _ = label(bright, _SQUARE)
    saturated = set(clumps[taken])
    sizes = _sizes(box for number, box in enumerate(find_objects(clumps), 1)
                   if number not in saturated)
    # Lines of single pixels are cosmic rays and bad columns.
    sizes = sizes[(sizes >= _LEAST_SIZE).any(axis=1)
                  & (sizes > 1).all(axis=1)]
    # One round star more, because few stars say little.
    steps = np.log(sizes[:, 0] / sizes[:, 1])
    return np.exp(steps.sum() / (len(steps) + 1))


def _sizes(boxes):
    """Return how many rows and columns boxes have, (n, 2)."""
    return np.array([[side.stop - side.start for side in box]
                     for box in boxes], int).reshape(-1, 2)


def without_saturated(pixels, level):
    """Return an image with saturated pixels masked; None is no level."""
    if level is None:
        return pixels
    full = saturated_pixels(pixels, level)
    return replace(pixels, mask=full if pixels.mask is None
                   else pixels.mask | full)


def _mark_trail(data, out, box, level):
    """Mark what is bright beyond both ends of the columns of a clump."""
    rows, columns = box
    nx = data.shape[1]
    beside = [min(max(c, 0), nx - 1) for c in (columns.start - _BESIDE,
                                               columns.stop - 1 + _BESIDE)]
    # Trails of several columns start from the whole clump, those of one from
    # its ends.
    for first, step in ((rows.stop, 1), (rows.start - 1, -1)):
        row = first
        while 0 <= row < data.shape[0]:
            part = np.nan_to_num(data[row, columns])
            least = max(_TRAIL_LEVEL * level,
                        _TRAIL_CONTRAST * np.nanmean(data[row, beside]))
            if not (part > least).any():
                break
            out[row, columns] |= part > least
            row += step
