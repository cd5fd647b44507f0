"""What is reported of each star of a crowded field."""
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from photutils_mgauss import kernels
from photutils_mgauss.crowded.search import extended

# Photutils' own bits.
PARTIAL, OUTSIDE, NO_FLUX, NO_CONVERGENCE, NO_COVARIANCE = 1, 2, 4, 8, 16
AT_BOUND = 32
# Ours, out of the way of any that photutils may add.
SATURATED, BLENDED, NOT_A_STAR = 1 << 16, 1 << 17, 1 << 18
NOT_SEEN, REPEATED = 1 << 19, 1 << 20

# A star that still moved this far in the last step has not converged [pix].
_STILL = 0.02
# Correlation with the nearest neighbour's flux from which a star is a blend.
_BLEND_CORRELATION = 0.5

# A star is none if what is left in its pixels is many times the noise and no
# small part of its light.
_BAD_CHI2, _BAD_SHARE = 3.0, 0.5


@dataclass(frozen=True)
class StarTable:
    """The stars of a tile's core, as columns in image pixels."""

    columns: dict

    @classmethod
    def empty(cls):
        """Return a table of no stars."""
        return cls({name: np.empty(0, dtype) for name, dtype in COLUMNS})

    @classmethod
    def joined(cls, tables):
        """Put the stars of tiles one after the other."""
        tables = [cls.empty(), *tables]
        return cls({name: np.concatenate([t.columns[name] for t in tables])
                    for name, _ in COLUMNS})

    def __len__(self):
        return self.columns['x_fit'].size

    def select(self, chosen):
        """Return the chosen stars, in that order."""
        return StarTable({name: column[chosen]
                          for name, column in self.columns.items()})

    def sort(self, *keys):
        """Order the stars, column by column to save memory."""
        order = np.lexsort([self.columns[key] for key in keys[::-1]])
        for name in self.columns:
            self.columns[name] = self.columns[name][order]


COLUMNS = (
    ('number', int), ('local_bkg', float), ('x_init', float),
    ('y_init', float), ('flux_init', float), ('x_fit', float),
    ('y_fit', float), ('flux_fit', float), ('x_err', float),
    ('y_err', float), ('flux_err', float), ('xy_cov', float),
    ('n_pixels_fit', int), ('qfit', float), ('cfit', float),
    ('reduced_chi2', float), ('flags', int), ('significance', float),
    ('crowding', float), ('neighbor_distance', float),
    ('neighbor_correlation', float), ('iter_detected', int))


def tabulate(tile, core):
    """Return the stars of a solved tile that lie in its core."""
    s, p = tile.stars, tile.pairs
    y_0, x_0 = tile.origin
    quality = _quality(tile)
    covariance, correlation = tile.covariances()
    covariance = covariance * _confusion(quality)[:, None, None]
    with np.errstate(invalid='ignore'):
        error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    count, chi2, deviation, centre, crowding, _ = quality.T
    node, share = tile.mesh.shares(s.x, s.y)
    flux = np.maximum(s.flux, 1e-300)
    strength = np.divide(s.flux, error[:, 0], where=error[:, 0] > 0,
                         out=np.zeros(len(s)))
    columns = dict(  # noqa: C408
        number=s.number, local_bkg=(tile.level[node] * share).sum(axis=1),
        x_init=s.x_init + x_0, y_init=s.y_init + y_0, flux_init=s.flux_init,
        x_fit=s.x + x_0, y_fit=s.y + y_0, flux_fit=s.flux,
        x_err=error[:, 1], y_err=error[:, 2], flux_err=error[:, 0],
        xy_cov=covariance[:, 1, 2], n_pixels_fit=count.astype(int),
        qfit=deviation / flux, cfit=centre / flux,
        reduced_chi2=chi2 / np.maximum(count - 3, 1),
        flags=_flags(tile, quality, error, correlation),
        significance=np.where(s.significance > 0, s.significance, strength),
        crowding=crowding, neighbor_distance=p.distance,
        neighbor_correlation=correlation, iter_detected=s.round)
    table = StarTable(columns).select(_significant(tile, strength))
    table = _with_repeats(table, tile)
    return table.select(_inside(table.columns, core))


def _significant(tile, strength):
    """Tell which stars are to be reported."""
    s, threshold = tile.stars, tile.options.threshold
    # A position that is fitted, too, makes noise two degrees of freedom
    # stronger.
    return (s.listed | s.seeded | (s.significance >= threshold)
            | (strength >= np.sqrt(threshold**2 + 2)))


def _inside(columns, core):
    """Tell which stars are reported by the tile of a core."""
    y_low, y_high, x_low, x_high = core
    # A star belongs to the tile whose core its nearest pixel is in, one of a
    # list to that of the place it is given.
    listed = columns['number'] >= 0
    x, y = (np.rint(np.where(listed, columns[f'{c}_init'],
                             columns[f'{c}_fit'])) for c in 'xy')
    inside = (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high)
    return inside & listed if listed.any() else inside


def _with_repeats(table, tile):
    """Add a row for each entry that means the star of another."""
    if not tile.repeats:
        return table
    number, host, x, y = np.array(tile.repeats).T
    order = np.argsort(table.columns['number'])
    row = np.searchsorted(table.columns['number'], host, sorter=order)
    more = table.select(order[row])
    more.columns.update(number=number.astype(int),
                        x_init=x + tile.origin[1], y_init=y + tile.origin[0],
                        flags=more.columns['flags'] | REPEATED)
    return StarTable.joined([table, more])


def _quality(tile):
    s = tile.stars
    out = np.empty((len(s), 6))
    kernels.star_quality(s.flux, s.x, s.y, *tile._place(), tile.jets,
                         tile.weight, tile.residual, tile.star_light(), out)
    return out


def _confusion(quality):
    """
    Return the factor of the variance for light that is in no star's model.

    What is left of faint, undetected stars in a stamp raises its chi2.
    """
    count, chi2 = quality[:, 0], quality[:, 1]
    # Each star has taken about three degrees of freedom from its stamp; six
    # pixels' worth of prior keeps small numbers from swinging.
    return np.maximum((chi2 + 6) / np.maximum(count + 3, 6), 1.0)


def _flags(tile, quality, error, correlation):
    s = tile.stars
    ny, nx = tile.data.shape
    flags = np.zeros(len(s), int)
    gone = np.maximum(np.abs(s.x - s.x_init), np.abs(s.y - s.y_init))
    for bit, where in (
            (PARTIAL, quality[:, 0] < tile.width**2),
            (OUTSIDE, (s.x < -0.5) | (s.y < -0.5) | (s.x > nx - 0.5)
             | (s.y > ny - 0.5)),
            (NO_FLUX, ~(s.flux > 0)),
            (NO_CONVERGENCE, tile.moved > _STILL),
            (AT_BOUND, gone > s.bound - 1e-6),
            (NOT_SEEN, s.listed & ~(s.flux > tile.options.keep
                                    * error[:, 0])),
            (NO_COVARIANCE, ~np.isfinite(error).all(axis=1)),
            (SATURATED, (quality[:, 5] < 0.5)),
            (NOT_A_STAR, extended(tile) | _unlike_a_star(tile, quality)),
            (BLENDED, np.abs(correlation) > _BLEND_CORRELATION)):
        flags[where] |= bit
    return flags


def _unlike_a_star(tile, quality):
    """Tell under which stars there is something else."""
    count, chi2, deviation = quality[:, :3].T
    return ((chi2 > _BAD_CHI2 * np.maximum(count - 3, 1))
            & (deviation > _BAD_SHARE * tile.stars.flux))


def as_qtable(table, unit, meta):
    """Return the stars as photutils' table; empties the one given."""
    columns = table.columns
    n = columns.pop('number').size
    out = QTable(meta=meta)
    out['id'] = np.arange(1, n + 1)
    out['group_id'] = np.arange(1, n + 1)
    out['group_size'] = np.ones(n, int)
    for name in list(columns):
        column = columns.pop(name)
        if name in ('local_bkg', 'flux_init', 'flux_fit', 'flux_err') and (
                unit is not None):
            column = column * unit
        out.add_column(column, name=name, copy=False)
    return out
