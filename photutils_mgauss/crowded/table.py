"""What is reported of each star of a crowded field."""
import numpy as np
from astropy.table import QTable

from photutils_mgauss import kernels
from photutils_mgauss.crowded.bright_errors import with_wing_errors
from photutils_mgauss.crowded.companions import with_companions
from photutils_mgauss.crowded.confusion import Confusion
from photutils_mgauss.crowded.judge import smooth_light
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.utils.flags import (
    BLENDED,
    NOT_A_STAR,
    NOT_SEEN,
    REPEATED,
    SATURATED,
)
from photutils_mgauss.utils.star_columns import column_values

# Photutils' own bits.
PARTIAL, OUTSIDE, NO_FLUX, NO_CONVERGENCE, NO_COVARIANCE = 1, 2, 4, 8, 16
AT_BOUND, NO_OVERLAP = 32, 64

# A star that still moved this far in the last step has not converged [pix].
STILL = 0.02
# Correlation with the nearest neighbour's flux from which a star is a blend.
BLEND_CORRELATION = 0.5

# A star is none if what is left in its pixels is many times the noise and no
# small part of its light.
_BAD_CHI2, _BAD_SHARE = 3.0, 0.5


# What hidden stars do, of `Confusion`.
CONFUSION = ('x_confusion_err', 'y_confusion_err', 'flux_confusion_err',
             'flux_confusion')

# The columns of the table beside id and groups, as of `Stars`, and their
# names where these are not photutils'.
_COLUMNS = (
    ('number', int), ('local_bkg', float), ('x_init', float),
    ('y_init', float), ('flux_init', float), ('x', float), ('y', float),
    ('flux', float), ('x_err', float), ('y_err', float),
    ('flux_err', float), ('xy_cov', float), ('n_pixels_fit', int),
    ('qfit', float), ('cfit', float), ('reduced_chi2', float),
    ('flags', int), ('significance', float), ('crowding', float),
    ('neighbor_distance', float), ('neighbor_correlation', float),
    ('found_in', int), *((name, float) for name in CONFUSION))
_NAMES = {'x': 'x_fit', 'y': 'y_fit', 'flux': 'flux_fit',
          'found_in': 'iter_detected'}
_LIGHT = ('local_bkg', 'flux_init', 'flux', 'flux_err', 'flux_confusion_err',
          'flux_confusion')


def no_stars():
    """Return what `tabulate` does of a tile without stars."""
    return Stars.of_columns({name: np.empty(0, dtype)
                             for name, dtype in _COLUMNS})


def tabulate(tile, core):
    """Return the stars of a solved tile that lie in its core."""
    model, near = tile.model, tile.model.neighbours
    s = model.stars
    quality = quality_of(model)
    covariance, correlation = tile.equations.covariances()
    hidden = _hidden(tile, covariance)
    covariance = with_wing_errors(
        model, covariance * misfit(quality)[:, None, None])
    if tile.options.confusion and tile.options.find_neighbors:
        hidden = with_companions(hidden, model, covariance)
    with np.errstate(invalid='ignore'):
        error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    count, chi2, deviation, centre, crowding, _ = quality.T
    flux = np.maximum(s.flux, 1e-300)
    strength = np.divide(s.flux, error[:, 0], where=error[:, 0] > 0,
                         out=np.zeros(len(s)))
    measured = s.replaced(
        local_bkg=model.background_at(s.x, s.y),
        **_with_hidden(s, error, covariance[:, 1, 2], hidden),
        n_pixels_fit=count.astype(int),
        qfit=deviation / flux, cfit=centre / flux,
        reduced_chi2=chi2 / np.maximum(count - 3, 1),
        flags=_flags(tile, quality, error, correlation),
        significance=np.where(s.significance > 0, s.significance, strength),
        crowding=crowding, neighbor_distance=near.distance,
        neighbor_correlation=correlation)
    table = measured.chosen(significant(s, tile.options.threshold, strength))
    table = Stars.of_columns({name: getattr(table, name)
                              for name, _ in _COLUMNS})
    y_0, x_0 = tile.origin
    table = with_repeats(table, tile.repeats).moved(x_0, y_0)
    return table.chosen(inside(table, core))


def significant(s, threshold, strength):
    """Tell which stars are to be reported."""
    # A position that is fitted, too, makes noise two degrees of freedom
    # stronger.
    return (s.listed | s.seeded | (s.significance >= threshold)
            | (strength >= np.sqrt(threshold**2 + 2)))


def inside(stars, core):
    """Tell which stars are reported by the tile of a core."""
    y_low, y_high, x_low, x_high = core
    # A star belongs to the tile whose core its nearest pixel is in, one of a
    # list to that of the place it is given.
    listed = stars.listed
    x = np.rint(np.where(listed, stars.x_init, stars.x))
    y = np.rint(np.where(listed, stars.y_init, stars.y))
    here = (x >= x_low) & (x < x_high) & (y >= y_low) & (y < y_high)
    return here & listed if listed.any() else here


def with_repeats(stars, repeats):
    """Add a row for each entry that means the star of another."""
    if not repeats:
        return stars
    number, host, x, y = np.array(repeats).T
    order = np.argsort(stars.number)
    row = np.searchsorted(stars.number, host, sorter=order)
    more = stars.chosen(order[row])
    return Stars.joined([stars, more.replaced(
        number=number.astype(int), x_init=x, y_init=y,
        flags=more.flags | REPEATED)])


def quality_of(model):
    """Return the sums (n, 6) of `~photutils_mgauss.kernels.star_quality`."""
    out = np.empty((len(model.stars), 6))
    kernels.star_quality(model.stars.sources, model.stamps,
                         model.planes(model.star_light()), out)
    return out


def misfit(quality):
    """
    Return the factor of the variance where the model does not fit.

    What noise alone makes of chi2 once in some 40 stamps is no misfit.
    """
    count, chi2 = quality[:, 0], quality[:, 1]
    # Each star has taken about three degrees of freedom from its stamp.
    free = np.maximum(count - 3, 3)
    return np.maximum(chi2 / (free + np.sqrt(8 * free)), 1.0)


def _hidden(tile, covariance):
    """Return what stars that were not found do to those that were."""
    options, n = tile.options, len(tile.model.stars)
    if not options.confusion or not options.find_neighbors:
        return Confusion.none(n)
    with np.errstate(invalid='ignore'):
        error = np.sqrt(covariance[:, 0, 0])
    return Confusion.of(tile.model, tile.origin, tile.equations, error)


def _with_hidden(stars, error, xy_cov, hidden):
    """Return flux and errors as columns, hidden stars considered."""
    more = hidden.flux, hidden.position, hidden.position
    added = [err * part for err, part in zip(error.T, more, strict=True)]
    total = [np.hypot(err, part)
             for err, part in zip(error.T, added, strict=True)]
    return {'flux': stars.flux - hidden.light, 'flux_err': total[0],
            'x_err': total[1], 'y_err': total[2],
            'xy_cov': xy_cov * (1 + hidden.position**2),
            'flux_confusion_err': added[0], 'x_confusion_err': added[1],
            'y_confusion_err': added[2], 'flux_confusion': hidden.light}


def _flags(tile, quality, error, correlation):
    s = tile.model.stars
    ny, nx = tile.model.data.shape
    flags = np.zeros(len(s), int)
    gone = np.abs(s.drift).max(axis=0)
    for bit, where in (
            (PARTIAL, quality[:, 0] < tile.model.stamps.width**2),
            (OUTSIDE, (s.x < -0.5) | (s.y < -0.5) | (s.x > nx - 0.5)
             | (s.y > ny - 0.5)),
            (NO_FLUX, ~(s.flux > 0)),
            (NO_CONVERGENCE, tile.moved > STILL),
            (AT_BOUND, gone > s.bound - 1e-6),
            (NOT_SEEN, s.listed & ~(s.flux > tile.options.keep
                                    * error[:, 0])),
            (NO_COVARIANCE, ~np.isfinite(error).all(axis=1)),
            (SATURATED, (quality[:, 5] < 0.5) | _is_hidden(tile.model)),
            (NOT_A_STAR, (smooth_light([tile.model])
                          | unlike_a_star(s.flux, quality))),
            (BLENDED, np.abs(correlation) > BLEND_CORRELATION)):
        flags[where] |= bit
    return flags


def _is_hidden(model):
    """Tell which stars started from their wings and have no middle pixel."""
    s, (ny, nx) = model.stars, model.data.shape
    return s.seeded & ~model.good[
        np.clip(np.rint(s.y).astype(int), 0, ny - 1),
        np.clip(np.rint(s.x).astype(int), 0, nx - 1)]


def unlike_a_star(flux, quality):
    """Tell under which stars there is something else."""
    count, chi2, deviation = quality[:, :3].T
    return ((chi2 > _BAD_CHI2 * np.maximum(count - 3, 1))
            & (deviation > _BAD_SHARE * flux))


def as_qtable(stars, unit, meta, *, confusion=True):
    """Return the stars as photutils' table; empties what is given."""
    columns = vars(stars)
    if not confusion:
        for name in CONFUSION:
            del columns[name]
    n = columns.pop('number').size
    out = QTable(meta=meta)
    out['id'] = np.arange(1, n + 1)
    out['group_id'] = np.arange(1, n + 1)
    out['group_size'] = np.ones(n, int)
    for name in list(columns):
        column = columns.pop(name)
        if name in _LIGHT and unit is not None:
            column = column * unit
        out.add_column(column, name=_NAMES.get(name, name), copy=False)
    return out


def positions(table):
    """Return x, y and flux of the stars of a table."""
    return tuple(column_values(table, name)
                 for name in ('x_fit', 'y_fit', 'flux_fit'))


def in_given_order(stars, given):
    """Return one row for each position; NaN where nothing was fitted."""
    n = len(given)
    columns = {}
    for name, column in vars(stars).items():
        fill = np.nan if column.dtype.kind == 'f' else 0
        columns[name] = np.full(n, fill, column.dtype)
        columns[name][stars.number] = column
    missing = np.ones(n, bool)
    missing[stars.number] = False
    columns['flags'][missing] |= NO_COVARIANCE | NO_OVERLAP
    columns['flux_init'] = np.where(np.isfinite(given.flux), given.flux,
                                    columns['flux_init'])
    return Stars.of_columns(columns).replaced(x_init=given.x, y_init=given.y)
