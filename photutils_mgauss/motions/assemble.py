"""From epochs and references to arrays: matched, and on one plane."""
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from astropy.table import Table

from photutils_mgauss.motions.baseline import (
    check_baseline,
    check_common,
    check_rows,
    few_in_common,
    few_references,
    period,
    whole_baseline,
)
from photutils_mgauss.motions.columns import brightness
from photutils_mgauss.motions.detections import read_epochs
from photutils_mgauss.motions.epoch import check_epochs
from photutils_mgauss.motions.matching import (
    Matches,
    find_references,
    match_epochs,
    named_references,
)
from photutils_mgauss.motions.orientation import find_maps
from photutils_mgauss.motions.references import (
    Catalogue,
    quasars,
    read_catalogue,
)
from photutils_mgauss.motions.stacked import variance_2x2
from photutils_mgauss.motions.ties import Ties, tie_planes
from photutils_mgauss.sky.observers import observer_positions, tdb
from photutils_mgauss.sky.tangent_plane import TangentPlane


@dataclass(frozen=True, eq=False, kw_only=True)
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
    usable : (E, n) bool `~numpy.ndarray`
        Detections with finite positions and good errors.
    flux : (n,) `~numpy.ndarray`
        Mean flux of each star.
    radial_velocity, velocity_error : (n,) `~numpy.ndarray`
        Of the stars [km/s], NaN where it is not known.
    ties : `~photutils_mgauss.motions.ties.Ties`
        What took the planes without WCS to the common one.
    catalogue : `Catalogue`
        The reference objects that were seen; motions in space are those of
        the mean time of the epochs.
    references : (k,) int `~numpy.ndarray`
        The star that each of them is.
    turns : list of (3, 3) `~numpy.ndarray` or None
        The rotations of the sphere that corrected pointings.
    doubts : tuple of str
        What shows that the references are not those of these stars.
    notes : tuple of str
        Epochs that have few stars in common with the others, in sentences.
    chips : list
        Names of all chips of cameras.
    chip : (E, n) int `~numpy.ndarray` or None
        The number of the chip of each detection, -1 where there is none.
    pixels, jacobian : (2, E, n) and (2, 2, E, n) `~numpy.ndarray` or None
        Where on the detector stars are, and d(plane)/d(pixel) there; NaN for
        epochs without pixels, None where nothing depends on them.
    magnitude, colour : (E, n) `~numpy.ndarray` or None
        Of the detections, None where nothing depends on them.
    left_out : (E,) bool `~numpy.ndarray`
        Epochs without stars enough for a map, of which nothing is used.
    """

    epochs: list
    plane: TangentPlane | None
    unit: str
    names: np.ndarray
    matches: Matches
    places: np.ndarray
    covariance: np.ndarray
    years: np.ndarray
    usable: np.ndarray
    flux: np.ndarray
    radial_velocity: np.ndarray
    velocity_error: np.ndarray
    ties: Ties
    catalogue: Catalogue
    references: np.ndarray
    turns: list
    doubts: tuple
    notes: tuple
    chips: list
    chip: np.ndarray | None
    pixels: np.ndarray | None
    jacobian: np.ndarray | None
    magnitude: np.ndarray | None
    colour: np.ndarray | None
    left_out: np.ndarray

    def without(self, left_out):
        """Return the same with epochs (E,) left out."""
        return replace(self, left_out=left_out,
                       usable=self.usable & ~left_out[:, None])

    @property
    def kept(self):
        """Which epochs (E,) are not left out."""
        return ~self.left_out

    @cached_property
    def epoch_years(self):
        """Mean Julian year of each epoch, (E,)."""
        return mean_years(self.years)

    @cached_property
    def times(self):
        """The same as a `~astropy.time.Time`."""
        return tdb(self.epoch_years)

    @cached_property
    def observer(self):
        """
        Barycentric places (3, E, 1) or (3, E, n) of the observers [au].

        None without a plane.
        """
        if self.plane is None:
            return None
        return observer_positions([epoch.observer for epoch in self.epochs],
                                  self.years)

    @cached_property
    def baseline(self):
        """Years from the first to the last detection or place known."""
        return whole_baseline(self.years[self.kept], self.catalogue)

    @cached_property
    def typical_variance(self):
        """Median variance of the detections, 1 if there are none."""
        each = np.concatenate([variance_2x2(self.covariance[:, e, usable])
                               for e, usable in enumerate(self.usable)])
        return np.median(each) if each.size else 1.0

    @property
    def single(self):
        """Whether all epochs are of one time, but not the references."""
        years = self.years[self.kept]
        own = np.nanmax(years) - np.nanmin(years)
        return bool(own <= period(self.baseline))


def mean_years(years):
    """Return the mean years (E,) of epochs, from (E, 1) or (E, n)."""
    return years[:, 0] if years.shape[1] == 1 else np.nanmean(years, axis=1)


def assemble(epochs, references, how, transform, wanted=()):
    """
    Return the `Sightings` of epochs.

    ``references`` is what the fitter was given, ``how`` the way to match
    (`~photutils_mgauss.motions.matching.HowToMatch`), ``transform`` the kind
    of map between planes, and ``wanted`` what `read_epochs` reads besides.
    """
    epochs = check_epochs(epochs)
    table = references if isinstance(references, Table) else None
    lists = read_epochs(epochs, table, by_pattern=how.by == 'pattern',
                        wanted=wanted)
    plane, unit = lists.plane, lists.unit
    catalogue = None if table is None else read_catalogue(table, plane, unit)
    check_baseline([epoch.mean_year for epoch in epochs], catalogue)
    idle = check_rows(lists.detections, catalogue)
    on_sky = np.array([epoch.is_sky for epoch in epochs])
    orient = partial(find_maps, epochs, lists.detections, catalogue,
                     None if table is None else brightness(table))
    every, matches, known, mapped = match_epochs(
        lists.detections, on_sky.all(), catalogue, how, unit, orient)
    years = mean_years(every.years)
    if references is None:
        known = np.empty(0, dtype=int)
    elif catalogue is None:
        known = named_references(references, every.ids, matches.rows, epochs)
    elif known is None:
        known = find_references(catalogue, every, years, how.tolerance(unit))
    stars, given = known[known >= 0], catalogue
    catalogue = (quasars(len(stars)) if given is None
                 else given.select(known >= 0))
    notes = (*lists.notes, *mapped, *idle)
    if len(epochs) == 1 and len(stars):
        notes += few_references(every.plane[:, 0], known, given)
    check_common(every.found, stars, catalogue)
    notes += few_in_common(matches.seen, stars, catalogue)
    ties = tie_planes(every, years, catalogue, stars, on_sky, transform)
    if unit == 'mas':
        catalogue = catalogue.at(float(np.nanmean(years)))
    velocity, error = _velocities(every, catalogue, stars)
    return Sightings(
        epochs=epochs, plane=plane, unit=unit, names=every.ids,
        matches=matches, places=every.plane, covariance=every.covariance,
        years=every.years, usable=every.usable, flux=every.flux,
        radial_velocity=velocity, velocity_error=error, ties=ties,
        catalogue=catalogue, references=stars, turns=lists.turns,
        doubts=_not_there(references, stars), notes=notes, chips=lists.chips,
        chip=every.chip, pixels=every.pixels, jacobian=every.jacobian,
        magnitude=every.magnitude, colour=every.colour,
        left_out=np.zeros(len(epochs), dtype=bool))


def _velocities(every, catalogue, stars):
    """Return radial velocities and their errors (n,), a catalogue's first."""
    velocity, error = every.radial_velocity, every.velocity_error
    known = np.isfinite(catalogue.radial_velocity)
    velocity[stars[known]] = catalogue.radial_velocity[known]
    error[stars[known]] = catalogue.velocity_error[known]
    return velocity, error


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

