"""From epochs and references to arrays: matched, and on one plane."""
from dataclasses import dataclass
from functools import partial

import numpy as np
from astropy.table import Table
from astropy.time import Time

from photutils_mgauss.motions.baseline import (
    check_baseline,
    check_common,
    few_in_common,
    few_references,
    period,
    whole_baseline,
)
from photutils_mgauss.motions.epoch import (
    brightness,
    check_epochs,
    read_epochs,
)
from photutils_mgauss.motions.matching import (
    Matches,
    find_references,
    match_epochs,
    named_references,
)
from photutils_mgauss.motions.orientation import find_maps, find_turns
from photutils_mgauss.motions.references import (
    Catalogue,
    quasars,
    read_catalogue,
)
from photutils_mgauss.motions.ties import Ties, tie_planes
from photutils_mgauss.sky.observers import observer_positions, tdb
from photutils_mgauss.sky.tangent_plane import TangentPlane


@dataclass(frozen=True, eq=False)
class Sightings:
    """
    All detections of n stars at E epochs, on one plane.

    Parameters
    ----------
    epochs : list of `~photutils_mgauss.motions.epoch.Epoch`
        Where they are from; nothing else of those is needed any more but the
        WCS, to be corrected.
    plane : `TangentPlane` or None
        None where nothing is known about the sky.
    unit : {'mas', 'pix'}
    names : (n,) `~numpy.ndarray`
        Identifiers of the stars.
    matches : `~photutils_mgauss.motions.matching.Matches`
    places : (2, E, n) `~numpy.ndarray`
        Measured positions, NaN where there are none.
    covariance : (3, E, n) `~numpy.ndarray`
    years : (E, 1) or (E, n) `~numpy.ndarray`
        Julian years (TDB).
    epoch_years : (E,) `~numpy.ndarray`
        Mean Julian year of each epoch.
    times : `~astropy.time.Time`
        The same as times.
    observer : (3, E, 1) or (3, E, n) `~numpy.ndarray` or None
        Barycentric places of the observers [au], None without a plane.
    usable : (E, n) bool `~numpy.ndarray`
        Detections with finite positions and good errors.
    flux : (n,) `~numpy.ndarray`
        Mean flux of each star.
    ties : `~photutils_mgauss.motions.ties.Ties`
        What took the planes without WCS to the common one.
    catalogue : `Catalogue`
        The reference objects that were seen; motions in space are those of
        the mean time of the epochs.
    references : (k,) int `~numpy.ndarray`
        The star that each of them is.
    radial_velocity : (n,) `~numpy.ndarray`
        Of the stars [km/s], NaN where it is not known.
    doubts : tuple of str
        What shows that the references are not those of these stars.
    notes : tuple of str
        Epochs that have few stars in common with the others, in sentences.
    baseline : float
        Years from the first to the last detection or place of a reference.
    turns : list of (3, 3) `~numpy.ndarray` or None
        The rotations of the sphere that corrected pointings.
    """

    epochs: list
    plane: TangentPlane | None
    unit: str
    names: np.ndarray
    matches: Matches
    places: np.ndarray
    covariance: np.ndarray
    years: np.ndarray
    epoch_years: np.ndarray
    times: Time
    observer: np.ndarray | None
    usable: np.ndarray
    flux: np.ndarray
    ties: Ties
    catalogue: Catalogue
    references: np.ndarray
    radial_velocity: np.ndarray
    doubts: tuple
    notes: tuple
    baseline: float
    turns: list

    @property
    def single(self):
        """Whether all epochs are of one time, but not the references."""
        own = np.nanmax(self.years) - np.nanmin(self.years)
        return bool(own <= period(self.baseline))


def assemble(epochs, references, how, transform):
    """
    Return the `Sightings` of epochs.

    ``references`` is what the fitter was given, ``how`` the way to match
    (`~photutils_mgauss.motions.matching.HowToMatch`), and ``transform`` the
    kind of map between planes.
    """
    epochs = check_epochs(epochs)
    table = references if isinstance(references, Table) else None
    turns, turned = [None] * len(epochs), ()
    if how.by == 'pattern':
        turns, turned = find_turns(epochs, table)
    detections, plane, unit = read_epochs(epochs, table, turns=turns)
    catalogue = None if table is None else read_catalogue(table, plane, unit)
    check_baseline(epochs, catalogue)
    on_sky = np.array([epoch.is_sky for epoch in epochs])
    orient = partial(find_maps, epochs, detections, catalogue,
                     None if table is None else brightness(table))
    every, matches, known, mapped = match_epochs(
        detections, on_sky.all(), catalogue, how, unit, orient)
    years = (every.years[:, 0] if every.years.shape[1] == 1
             else np.nanmean(every.years, axis=1))
    del detections, orient  # as large as all that was measured
    if references is None:
        known = np.empty(0, dtype=int)
    elif catalogue is None:
        known = named_references(references, every.ids, matches.rows, epochs)
    elif known is None:
        known = find_references(catalogue, every, years, how.tolerance(unit))
    seen = known >= 0
    stars, notes = known[seen], (*turned, *mapped)
    if len(epochs) == 1 and len(stars):
        notes += few_references(every.plane[:, 0], known, catalogue)
    catalogue = (quasars(len(stars)) if catalogue is None
                 else catalogue.select(seen))
    check_common(every.found, stars, catalogue)
    notes += few_in_common(matches.seen, stars, catalogue)
    places, covariance, ties = tie_planes(every, years, catalogue, stars,
                                          on_sky, transform)
    if unit == 'mas':
        catalogue = catalogue.at(float(np.nanmean(years)))
    velocity = every.radial_velocity.copy()
    velocity[stars] = np.where(np.isfinite(catalogue.radial_velocity),
                               catalogue.radial_velocity, velocity[stars])
    observer = None if plane is None else observer_positions(
        [epoch.observer for epoch in epochs], every.years)
    return Sightings(epochs, plane, unit, every.ids, matches, places,
                     covariance, every.years, years, tdb(years), observer,
                     every.usable, every.flux, ties, catalogue, stars,
                     velocity, _not_there(references, stars), notes,
                     whole_baseline(every.years, catalogue), turns)


def _not_there(references, stars):
    """Return a sentence if references were given and no star is one."""
    if references is None or len(stars):
        return ()
    if isinstance(references, str):
        what = f'The column {references!r} marks no star'
    else:
        what = (f'None of the {len(references)} reference objects is among '
                'the stars')
    sentence = (f'{what}, so nothing ties the motions to references: do they '
                'have the identifiers of the epochs, or places in this '
                'field?')
    return (sentence,)

