"""
Reference objects: what is known of some stars before anything is measured.

Classes, one per object: 'qso' (or 'galaxy': motion and parallax zero),
'star' (a catalogue's motion, and position and parallax where it has them),
'position' (a position without a motion: unknown, never zero).
"""
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from photutils_mgauss.motions.columns import (
    names_of,
    numbers,
    table_vectors,
)
from photutils_mgauss.motions.stacked import apply
from photutils_mgauss.sky.observers import julian_years
from photutils_mgauss.sky.space_motion import carried
from photutils_mgauss.utils.star_columns import find_column
from photutils_mgauss.utils.validation import shown

CLASSES = ('qso', 'galaxy', 'star', 'position')
FIXED = ('qso', 'galaxy')  # neither move nor have a parallax
GAIA = ('ra', 'dec', 'parallax', 'pmra', 'pmdec')
UNKNOWN = 1e30  # variance of what is not known
ORDER = [0, 1, 3, 4, 2]  # Gaia's order to ours: position, motion, parallax


@dataclass(frozen=True, eq=False)
class Catalogue:
    """
    Reference objects as plain arrays; NaN where nothing is known.

    ``values`` (5, k) and ``covariance`` (5, 5, k) are position, motion and
    parallax on the plane [unit, unit/yr], at Julian years ``year`` (k,).
    ``velocity_error`` (k,) is that of the ``radial_velocity`` [km/s].
    ``rows`` (k,) are those of the user's table, -1 without one, and
    ``source_ids`` (k,) what it calls the objects, if it does.
    """

    ids: np.ndarray | None
    kinds: np.ndarray
    values: np.ndarray
    covariance: np.ndarray
    year: np.ndarray
    radial_velocity: np.ndarray
    velocity_error: np.ndarray
    rows: np.ndarray
    source_ids: np.ndarray | None

    def motion(self):
        """Return motions (2, k) as far as they are known."""
        motion = self.values[2:4].copy()
        motion[:, self.fixed] = 0
        return motion

    @property
    def fixed(self):
        """Which objects neither move nor have a parallax, (k,)."""
        return np.isin(self.kinds, FIXED)

    def at(self, year):
        """
        Return the objects with all motions in space carried to a year.

        Only stars of known motion, parallax and radial velocity do not move
        along straight lines; all others stay as they are.
        """
        values, covariance, years = carried(
            self.values, self.covariance, self.radial_velocity, self.year,
            year)
        return replace(self, values=values, covariance=covariance, year=years)

    def places(self):
        """Return the objects as positions whose motions are not known."""
        return replace(self, kinds=np.full(len(self.kinds), 'position'))

    def select(self, which):
        """Return some of the objects, without their identifiers."""
        return replace(
            self, ids=None, kinds=self.kinds[which],
            values=self.values[:, which],
            covariance=self.covariance[..., which], year=self.year[which],
            radial_velocity=self.radial_velocity[which],
            velocity_error=self.velocity_error[which],
            rows=self.rows[which],
            source_ids=(None if self.source_ids is None
                        else self.source_ids[which]))


def quasars(n):
    """Return the `Catalogue` of n quasars at places nobody knows."""
    nothing = np.full(n, np.nan)
    return Catalogue(None, np.full(n, 'qso'), np.full((5, n), np.nan),
                     np.repeat(UNKNOWN * np.eye(5)[..., None], n, axis=2),
                     nothing, nothing, nothing, np.full(n, -1), None)


def read_catalogue(table, plane, unit):
    """Return the `Catalogue` of a table of references."""
    n = len(table)
    _check_findable(table, plane)
    kinds = _kinds(table)
    years = _years(table, kinds)
    values = np.full((5, n), np.nan)
    per_year = _unit(unit) / u.yr
    for k, name in ((2, 'pmra'), (3, 'pmdec')):
        values[k] = numbers(table, name, per_year)
    values[4] = numbers(table, 'parallax', _unit(unit))
    _check_motions(kinds, values)
    velocity = numbers(table, 'radial_velocity', u.km / u.s)
    ids = np.asarray(table['id']) if 'id' in table.colnames else None
    covariance = _covariance(table, unit)
    values[:2] = _positions(table, plane, unit)
    if plane is not None and np.isfinite(values[:2]).any():
        turn = np.zeros((5, 5, n))
        local = plane.local_jacobian(values[:2])
        # A star of unknown place keeps its motion.
        turn[:2, :2] = turn[2:4, 2:4] = np.where(
            np.isfinite(local), local, np.eye(2)[..., None])
        turn[4, 4] = 1
        values[2:4] = apply(turn[2:4, 2:4], values[2:4])
        covariance = np.einsum('ijn,jkn,lkn->iln', turn, covariance, turn)
    names = (np.asarray(table['source_id'])
             if 'source_id' in table.colnames else None)
    return Catalogue(ids, kinds, values, covariance, years, velocity,
                     numbers(table, 'radial_velocity_error', u.km / u.s),
                     np.arange(n), names)


def _check_findable(table, plane):
    x = ('ra',) if plane is not None else names_of('x')
    if 'id' not in table.colnames and find_column(table, x) is None:
        msg = ("references must have a column 'id' or positions to be found "
               'among the stars')
        raise ValueError(msg)


def _unit(unit):
    return u.Unit('pix' if unit == 'pix' else 'mas')


def _kinds(table):
    if 'class' in table.colnames:
        kinds = np.char.lower(np.asarray(table['class']).astype(str))
        bad = ~np.isin(kinds, CLASSES)
        if bad.any():
            words = ', '.join(repr(kind) for kind in CLASSES)
            msg = (f"the column 'class' of references must hold {words}, "
                   f'got {shown(kinds[bad][0])}')
            raise ValueError(msg)
        return kinds
    known = np.isfinite(numbers(table, 'pmra') + numbers(table, 'pmdec'))
    return np.where(known, 'star', 'position')


def _positions(table, plane, unit):
    if plane is not None:
        return plane.project(table_vectors(table))
    return np.stack([numbers(table, key, _unit(unit)) for key in 'xy'])


def _covariance(table, unit):
    """Return (5, 5, k) in our order; NaN rows where there is no error."""
    angle = _unit(unit)
    units = (angle, angle, angle, angle / u.yr, angle / u.yr)
    first = ('ra_err', 'dec_err')
    if find_column(table, names_of('ra_err')) is None:
        first = ('x_err', 'y_err')
    keys = (*first, *(f'{name}_error' for name in GAIA[2:]))
    errors = []
    for key, one in zip(keys, units, strict=True):
        error = numbers(table, key, one)
        errors.append(np.where(error > 0, error, np.nan))
    out = np.empty((5, 5, len(table)))
    for i, a in enumerate(GAIA):
        for j, b in enumerate(GAIA):
            name = f'{a}_{b}_corr' if i < j else f'{b}_{a}_corr'
            rho = 1.0 if i == j else np.nan_to_num(numbers(table, name))
            out[i, j] = rho * errors[i] * errors[j]
    return _without_nan(out)[ORDER][:, ORDER]


def _without_nan(covariance):
    # Finite, so that rotating an unknown position does not make the known
    # motion unknown.
    size = len(covariance)
    out = np.nan_to_num(covariance, nan=0.0)
    for k in range(size):
        out[k, k] = np.where(np.isnan(covariance[k, k]), UNKNOWN, out[k, k])
    return out


def _years(table, kinds):
    if 'ref_epoch' not in table.colnames:
        if (kinds == 'star').any() or (kinds == 'position').any():
            msg = ("references must have a column 'ref_epoch' with the time "
                   f'of their positions, got {table.colnames}')
            raise ValueError(msg)
        return np.full(len(table), np.nan)
    return np.broadcast_to(julian_years(table['ref_epoch'], 'ref_epoch'),
                           len(table)).copy()


def _check_motions(kinds, values):
    bad = (kinds == 'star') & ~np.isfinite(values[2:4]).all(axis=0)
    if bad.any():
        msg = ("references of class 'star' must have pmra and pmdec, got "
               f"none in row {np.flatnonzero(bad)[0]}; class 'position' is "
               'for stars of unknown motion')
        raise ValueError(msg)
