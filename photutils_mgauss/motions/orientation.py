"""
Where epochs look and how they are turned, by the pattern of their stars.

For lists without a WCS, turned by any angle, mirrored or of another scale,
and for WCS whose pointing is off by up to the field of view and whose roll by
any angle. What is found is good enough to match the stars by position.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.motions.columns import brightness
from photutils_mgauss.sky.patterns import LEAST, Pattern, within
from photutils_mgauss.sky.tangent_plane import MAS, TangentPlane, local_axes

ON_THE_SKY = Pattern(scale=(0.95, 1.05), mirror=False)
OF_KNOWN_SCALE = Pattern(scale=(0.8, 1.25))
RIGHT = 2000.0  # mas: what a pointing may be off and is left as it is
TURNED = 0.1    # degrees: what a list may be turned without a word


@dataclass(frozen=True, eq=False)
class Objects:
    """Finite places (2, n) or directions (3, n) of objects, and fluxes."""

    places: np.ndarray
    flux: np.ndarray

    @classmethod
    def of(cls, places, flux):
        """Return those whose places are finite."""
        good = np.isfinite(places).all(axis=0)
        return cls(places[:, good], flux[good])


def find_turns(lists, targets):
    """
    Return the rotations (3, 3) of epochs on the sky, and sentences on them.

    None for epochs whose pointing is right, and for those without a sky.
    Right is what targets say, or else the first epoch.

    Parameters
    ----------
    lists : list of `Objects` or None
        The directions of all epochs, None for those without a sky.
    targets : list of `Objects`
        Directions that are known to be right.
    """
    on_sky = {e: one for e, one in enumerate(lists) if one is not None}
    found = _one_after_another(on_sky, targets, _turn_between, np.matmul)
    turns, notes = [None] * len(lists), []
    for e, turn in sorted(found.items()):
        away = 0.0 if turn is None else _displacement(turn, lists[e].places)
        if np.max(away) > RIGHT:
            turns[e] = turn
            notes.append(_turned_words(e, turn, lists[e].places))
    return turns, tuple(notes)


def _one_after_another(lists, targets, find, apply):
    """
    Return what takes the lists to the targets, by the lists' numbers.

    Lists that were found are targets for the others. Where no target is of
    use, the first list stays where it is, and None stands for that.
    """
    targets, found = list(targets), {}
    # A list of nothing stays where it is.
    pending = {e: one for e, one in lists.items() if one.flux.size}
    while pending:
        e, result = _first_found(pending, targets, find)
        if e is None:
            if found:
                break
            e = next(iter(pending))
        found[e], one = result, pending.pop(e)
        targets.append(one if result is None else Objects(
            apply(result, one.places), one.flux))
    if pending:
        e = min(pending)
        _raise_not_found(e, pending[e].flux.size)
    return found


def _first_found(lists, targets, find):
    """Return the first list that is found in a target, and where."""
    for target in reversed(targets):
        for e, one in lists.items():
            if min(one.flux.size, target.flux.size) < LEAST:
                continue
            result = find(e, one, target)
            if result is not None:
                return e, result
    return None, None


def _raise_not_found(e, n):
    if n < LEAST:
        msg = (f'epoch {e} must have at least {LEAST} objects to be matched '
               f'by their pattern, got {n}')
        raise ValueError(msg)
    msg = (f'epoch {e} must have a pattern of bright stars in common with '
           'the others or the references to be matched by it, got none: is '
           'it of the same field, and are there fluxes by which the '
           'brightest can be told?')
    raise ValueError(msg)


def _turn_between(_, one, other):
    """Return the rotation (3, 3) of some directions onto others, or None."""
    own, common = (TangentPlane.around(some.places) for some in (one, other))
    targets = common.project(other.places)
    found = ON_THE_SKY.find(own.project(one.places), targets, one.flux,
                            other.flux)
    if found is None:
        return None
    moved = found.apply(own.project(one.places))
    inside = within(moved, targets)
    left, _, right = np.linalg.svd(common.deproject(moved[:, inside])
                                   @ one.places[:, inside].T)
    parity = np.linalg.det(left @ right)
    return left @ np.diag([1, 1, parity]) @ right


def _displacement(turn, vectors):
    """Return by how much directions are turned [mas]."""
    chord = np.sqrt(np.sum((turn @ vectors - vectors)**2, axis=0))
    return 2 * np.arcsin(np.minimum(chord / 2, 1)) * MAS


def _turned_words(e, turn, vectors):
    """Say by how much the pointing and the roll of an epoch were off."""
    middle = vectors.mean(axis=1, keepdims=True)
    middle /= np.sqrt(np.sum(middle**2))
    away = _displacement(turn, middle)[0] / 1e3
    north = turn @ local_axes(middle)[1]
    east, up = local_axes(turn @ middle)
    roll = np.degrees(np.arctan2(np.sum(north * east), np.sum(north * up)))
    return (f'The pointing of epoch {e} was off by {away:.0f} arcsec and its '
            f'roll by {roll:.2f} degrees, as the pattern of its stars says.')


def find_maps(epochs, detections, catalogue, flux):
    """
    Return the `Found` maps of planes without a sky onto the common one.

    Parameters
    ----------
    epochs : list of `~photutils_mgauss.motions.epoch.Epoch`
    detections : list of `~photutils_mgauss.motions.detections.Detections`
        Of the epochs.
    catalogue : `~photutils_mgauss.motions.references.Catalogue` or None
        Reference objects, and their ``flux`` (k,).

    Returns
    -------
    maps : list
        None for epochs that stay as they are.
    notes : tuple of str
    """
    every = [Objects.of(one.plane, brightness(epoch.table))
             for epoch, one in zip(epochs, detections, strict=True)]
    planes = {e: every[e] for e, epoch in enumerate(epochs)
              if not epoch.is_sky}
    targets = [one for e, one in enumerate(every) if e not in planes]
    if catalogue is not None:
        targets.append(Objects.of(catalogue.values[:2], flux))

    def find(e, one, other):
        known = epochs[e].plane_unit == 'mas'
        pattern = OF_KNOWN_SCALE if known else Pattern()
        return pattern.find(one.places, other.places, one.flux, other.flux)
    found = _one_after_another(planes, targets, find,
                               lambda one, places: one.apply(places))
    maps = [found.get(e) for e in range(len(epochs))]
    return maps, tuple(words for e, one in enumerate(maps)
                       if one is not None
                       for words in _mapped_words(e, one.matrix))


def _mapped_words(e, matrix):
    """Say how a list without WCS is turned against the others, if it is."""
    slope = matrix[:, 1:]
    mirrored = np.linalg.det(slope) < 0
    if mirrored:
        slope = slope @ np.diag([-1, 1])
    angle = np.degrees(np.arctan2(slope[1, 0] - slope[0, 1],
                                  slope[0, 0] + slope[1, 1]))
    words = 'mirrored in x and then turned' if mirrored else 'turned'
    if mirrored or abs(angle) > TURNED:
        yield (f'The list of epoch {e} was {words} by {angle:.2f} degrees, '
               'as the pattern of its stars says.')
