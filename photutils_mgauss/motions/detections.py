"""
All that is asked of epochs, read in one pass, as plain float64 arrays.

What leaves this module is in the units of the plane that is common to all
epochs.
"""
from dataclasses import dataclass

import astropy.units as u
import numpy as np

from photutils_mgauss.motions.chips import (
    chip_numbers,
    jacobian_of_chips,
    vectors_of_chips,
)
from photutils_mgauss.motions.columns import (
    brightness,
    covariances,
    identifiers,
    magnitudes,
    numbers,
    numbers_if_there,
    pixels,
    scan_covariances,
    scan_vectors,
    table_vectors,
)
from photutils_mgauss.motions.orientation import Objects, find_turns
from photutils_mgauss.motions.stacked import (
    is_definite_2x2,
    sandwich_2x2,
    variance_2x2,
)
from photutils_mgauss.sky.observers import observer_velocity, remove_aberration
from photutils_mgauss.sky.tangent_plane import TangentPlane, local_axes


@dataclass(frozen=True, eq=False)
class Detections:
    """
    What an epoch says about each of its n rows, as plain arrays.

    For n stars at E epochs the arrays have an axis of epochs before the
    last, but ``ids`` (n,) are the names of the stars, ``flux`` and
    ``radial_velocity`` (n,) [km/s] their means, and ``velocity_error`` (n,)
    the largest of those of that.

    ``plane`` (2, n) and ``covariance`` (3, n: xx, xy, yy) are in the frame's
    unit, mas or pixels. ``found`` says which positions are finite,
    ``usable`` which errors are good as well. All others are None where
    nobody knows or needs them: ``chip`` (n,) is the number of a chip of a
    camera, -1 for none, ``pixels`` (2, n) a place on the detector and
    ``jacobian`` (2, 2, n) d(plane)/d(pixel) there.
    """

    ids: np.ndarray | None
    plane: np.ndarray
    covariance: np.ndarray
    years: np.ndarray
    found: np.ndarray
    usable: np.ndarray
    flux: np.ndarray | None = None
    radial_velocity: np.ndarray | None = None
    velocity_error: np.ndarray | None = None
    magnitude: np.ndarray | None = None
    colour: np.ndarray | None = None
    chip: np.ndarray | None = None
    pixels: np.ndarray | None = None
    jacobian: np.ndarray | None = None

    @property
    def sigma(self):
        """The standard errors (n,) of positions, the mean of both axes."""
        return np.sqrt(variance_2x2(self.covariance))


@dataclass(frozen=True, eq=False)
class Lists:
    """
    The lists of all epochs on one plane.

    ``plane`` is None where nothing is known about the sky, ``unit`` 'mas' or
    'pix'. ``chips`` are the names of all chips of cameras. ``turns`` are the
    rotations of the sphere that corrected pointings, None for those that
    were right, and ``notes`` sentences on them.
    """

    detections: list
    plane: TangentPlane | None
    unit: str
    chips: list
    turns: list
    notes: tuple


def read_epochs(epochs, references=None, *, by_pattern=False, wanted=()):
    """
    Return the `Lists` of epochs.

    Parameters
    ----------
    epochs : list of `~photutils_mgauss.motions.epoch.Epoch`
    references : `~astropy.table.Table`, optional
        Reference objects, whose unit counts where nothing is on the sky.
    by_pattern : bool, optional
        Whether to look for pointings that are wrong.
    wanted : sequence of {'magnitude', 'colour', 'pixels'}, optional
        What is needed besides places, errors and times.
    """
    vectors = [sky_vectors(epoch) if epoch.is_sky else None
               for epoch in epochs]
    turns, notes = [None] * len(epochs), ()
    if by_pattern:
        turns, notes = _found_turns(epochs, vectors, references)
        vectors = [vector if turn is None else turn @ vector
                   for vector, turn in zip(vectors, turns, strict=True)]
    plane = _common_plane(vectors)
    if plane is None and by_pattern:
        plane = _plane_of_references(references)
    unit = 'mas' if plane else _common_unit(epochs, references)
    chips = list(dict.fromkeys(name for epoch in epochs
                               for name in epoch.chips or ()))
    # Popped, so that a million directions are kept no longer than needed.
    detections = [read_epoch(epoch, plane, vectors.pop(0), turn,
                             wanted=wanted, chips=chips)
                  for epoch, turn in zip(epochs, turns, strict=True)]
    return Lists(detections, plane, unit, chips, turns, notes)


def _found_turns(epochs, vectors, references):
    """Return turns and notes of `find_turns` for epochs and references."""
    lists = [None if places is None
             else Objects.of(places, brightness(epoch.table))
             for places, epoch in zip(vectors, epochs, strict=True)]
    targets = []
    if references is not None and 'ra' in references.colnames:
        targets = [Objects.of(table_vectors(references),
                              brightness(references))]
    return find_turns(lists, targets)


def _common_plane(vectors):
    """Return the plane at the mean direction, None if there is no sky."""
    seen = [vector for vector in vectors if vector is not None]
    if not seen:
        return None
    total = sum(np.nansum(vector, axis=1) for vector in seen)
    if not total.any():
        msg = ('epochs must have finite positions, got none inside the '
               'bounding boxes of their WCS (dec within 90 degrees)')
        raise ValueError(msg)
    return TangentPlane.around(total)


def _plane_of_references(references):
    """Return the plane of references on the sky, None if there are none."""
    if references is None or 'ra' not in references.colnames:
        return None
    total = np.nansum(table_vectors(references), axis=1)
    return TangentPlane.around(total) if total.any() else None


def _common_unit(epochs, references):
    if references is not None and 'x' in references.colnames:
        unit = getattr(references['x'], 'unit', None)
        if unit is not None and unit.physical_type == 'angle':
            return 'mas'
    units = {epoch.plane_unit for epoch in epochs}
    if len(units) > 1:
        msg = ('epochs must all have a scale or none, got columns in '
               'pixels and in angles; give pixel_scale')
        raise ValueError(msg)
    return units.pop()


def sky_vectors(epoch):
    """Return ICRS unit vectors (3, n) of an epoch with sky positions."""
    if epoch.is_pixels:
        vectors = vectors_of_chips(epoch, *pixels(epoch.table))
    elif epoch.is_scan:
        vectors = scan_vectors(epoch.table)
    else:
        vectors = table_vectors(epoch.table)
    velocity = observer_velocity(epoch.observer)
    if velocity is None:
        return vectors
    return remove_aberration(vectors, velocity)


def read_epoch(epoch, plane=None, vectors=None, turn=None, *, wanted=(),
               chips=()):
    """
    Return the `Detections` of an epoch.

    ``plane`` is the common `TangentPlane`, and ``vectors`` the directions
    already computed; both None where nothing is known about the sky.
    ``turn`` is the rotation (3, 3) they had, if any. ``wanted`` is what
    `read_epochs` wants, ``chips`` the names of all chips.
    """
    table, years = epoch.table, np.asarray(epoch.years, dtype=float)
    ids, own = identifiers(table), _own_covariance(epoch)
    xy = pixels(table, epoch.column_unit) if epoch.is_pixels else None
    chip = chip_numbers(epoch, chips) if epoch.chips else None
    if vectors is None:
        scale = 1.0 if epoch.pixel_size is None else epoch.pixel_size
        places, covariance = scale * xy, scale**2 * own
        jacobian = np.broadcast_to(scale * np.eye(2)[..., None],
                                   (2, *xy.shape))
    else:
        places = plane.project(vectors)
        jacobian = _jacobian(epoch, plane, places, xy, turn)
        covariance = sandwich_2x2(jacobian, own)
    found = np.isfinite(places).all(axis=0) & np.isfinite(years)
    speed = u.km / u.s
    on_detector = epoch.is_pixels and ('pixels' in wanted
                                       or chip is not None)
    return Detections(
        ids, np.where(found, places, np.nan), covariance, years, found,
        found & is_definite_2x2(covariance),
        numbers_if_there(table, 'flux'),
        numbers_if_there(table, 'radial_velocity', speed),
        numbers_if_there(table, 'radial_velocity_error', speed),
        magnitudes(table) if 'magnitude' in wanted else None,
        numbers(table, 'colour') if 'colour' in wanted else None,
        chip, pixels(table) if on_detector else None,
        jacobian if on_detector else None)


def _own_covariance(epoch):
    """Return xx, xy, yy as the table has them, of pixels or on the sky."""
    if epoch.is_scan:
        return scan_covariances(epoch.table)
    if not epoch.is_pixels:
        return covariances(epoch.table, ('ra_err', 'dec_err'), u.mas)
    return covariances(epoch.table, ('x_err', 'y_err'),
                       epoch.column_unit)


def _jacobian(epoch, plane, places, xy, turn):
    """Return d(plane)/d(pixel), or by east and north of a table's sky."""
    if epoch.is_pixels:
        return jacobian_of_chips(epoch, plane, *xy, turn)
    if turn is None:
        return plane.local_jacobian(places)
    # The errors are along east and north as the table has them.
    axes = local_axes(turn.T @ plane.deproject(places))
    return np.stack([plane.displacement(
        places, np.tensordot(turn, axis, axes=1)) for axis in axes], axis=1)
