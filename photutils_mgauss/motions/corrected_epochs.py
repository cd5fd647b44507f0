"""Epochs whose WCS contain the maps that were found for them."""
from dataclasses import replace
from functools import partial

import numpy as np

from photutils_mgauss.motions.chips import rows_of_chips
from photutils_mgauss.motions.columns import numbers, pixels
from photutils_mgauss.sky.corrected_wcs import (
    Region,
    corrected_header,
    corrected_wcs,
)
from photutils_mgauss.sky.correction import Correction
from photutils_mgauss.sky.observers import observer_velocity
from photutils_mgauss.sky.wcs import pixel_to_vectors


def correct_epochs(result):
    """
    Return epochs with corrected WCS, and the residuals of those [mas].

    Epochs without a place in the sky, those that were left out, and all if
    no maps were fitted, stay as they are and have NaN as residual.
    ``result`` is the `Fit`.
    """
    sightings, transform = result.setup.sightings, result.setup.transform
    if sightings.plane is None or transform.kind == 'none':
        return list(sightings.epochs), [np.nan] * len(sightings.epochs)
    # A wild place, which the fit left out, is no part of the image.
    sound = result.state.used & ~result.state.untied
    pairs = []
    for e, epoch in enumerate(sightings.epochs):
        if sightings.left_out[e]:
            pairs.append((epoch, np.nan))
            continue
        turn, rows = sightings.turns[e], sightings.matches.rows[e, sound[e]]
        correction = Correction(sightings.plane, transform,
                                result.state.maps[e], _velocity(epoch, turn),
                                turn)
        if epoch.chips is None:
            pairs.append(correct_epoch(epoch, correction,
                                       sightings.ties.maps[e], rows))
        else:
            pairs.append(_correct_chips(epoch, correction, result, rows))
    return tuple(list(some) for some in zip(*pairs, strict=True))


def _velocity(epoch, turn):
    """Return the velocity of an epoch's observer in the turned axes."""
    velocity = observer_velocity(epoch.observer)
    return velocity if velocity is None or turn is None else turn @ velocity


def correct_epoch(epoch, correction, tie, rows):
    """
    Return an epoch with a corrected WCS, and the WCS's residual [mas].

    ``tie`` is the map (2, 3) of an epoch without WCS onto the common plane,
    or None, and ``rows`` (k,) are the rows of its table that were used.
    Epochs without pixels stay as they are.
    """
    if epoch.wcs is None and (tie is None or epoch.pixel_size is None):
        return epoch, np.nan
    pixel_map = None
    if epoch.wcs is None:
        pixel_map = np.column_stack([tie[:, 0],
                                     tie[:, 1:] * epoch.pixel_size])
    region = Region.of(epoch.wcs, *_stars_pixels(epoch, rows))
    wcs, residual = corrected_wcs(epoch.wcs, correction, region, pixel_map)
    return replace(epoch, wcs=wcs, pixel_scale=None), residual


def _correct_chips(epoch, correction, result, rows):
    """Return an epoch with corrected WCS of its chips, and their residual."""
    used = np.zeros(len(epoch.table), dtype=bool)
    used[rows] = True
    x, y = pixels(epoch.table)
    chips, residuals = {}, []
    for wcs, own, name in rows_of_chips(epoch):
        seen = own[used[own]]
        if not len(seen):  # Nothing was seen of it: its frame's map is known.
            seen = np.zeros(1, dtype=int)
        region = Region.of(wcs, x[seen], y[seen])
        chips[name], residual = corrected_header(wcs, partial(
            _through_chip, wcs, name, correction, result), region)
        residuals.append(residual)
    return replace(epoch, chips=chips), max(residuals)


def _through_chip(wcs, name, correction, result, x, y):
    """Return corrected directions (3, n) of pixels of a chip."""
    distortion = result.setup.distortion
    if distortion is not None and distortion.has_maps:
        x, y = distortion.pixels(result.state.distortion, name, x, y)
    return correction(pixel_to_vectors(wcs, x, y, bounded=False))


def _stars_pixels(epoch, rows):
    if not epoch.is_pixels or not len(rows):
        return np.array([0.0]), np.array([0.0])
    return tuple(numbers(epoch.table, key)[rows] for key in 'xy')
