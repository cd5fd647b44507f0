"""What is reported of each star of a crowded field seen in many images."""
import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.crowded.confusion import Confusion
from photutils_mgauss.crowded.judge import smooth_light
from photutils_mgauss.crowded.many_search import strength_of
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.table import (
    AT_BOUND,
    BLEND_CORRELATION,
    NO_CONVERGENCE,
    NO_COVARIANCE,
    NO_FLUX,
    STILL,
    inside,
    misfit,
    quality_of,
    significant,
    unlike_a_star,
    with_repeats,
)
from photutils_mgauss.utils.flags import (
    BLENDED,
    MOTIONLESS,
    NOT_A_STAR,
    NOT_SEEN,
    SATURATED,
)

# The columns of a star, and those it has once for each image.
_COLUMNS = ('number', 'x', 'y', 'x_init', 'y_init', 'rate', 'place',
            'significance', 'n_images', 'reduced_chi2', 'flags',
            'neighbor_distance', 'neighbor_correlation', 'found_in')
_WHOLE = ('number', 'n_images', 'flags', 'found_in')
_HIDDEN = 'flux_confusion_err', 'flux_confusion'
_EACH = ('x_image', 'y_image', 'fluxes', 'flux_err', *_HIDDEN, 'local_bkg',
         'n_pixels_fit', 'image_chi2', 'crowding')
_COUNTS = ('n_pixels_fit',)


def no_stars(n_images, p):
    """Return what `tabulate` does of a tile without stars."""
    columns = {name: np.empty(0, int if name in _WHOLE else float)
               for name in _COLUMNS}
    columns['rate'] = np.empty((0, p - 2))
    columns['place'] = np.empty((0, p, p))
    columns.update({name: np.empty((0, n_images), int if name in _COUNTS
                                   else float) for name in _EACH})
    return Stars.of_columns(columns)


def tabulate(tile):
    """Return the stars of a solved `ManyTile` that lie in its core."""
    s, near = tile.stars, tile.neighbours
    quality = [quality_of(model) for model in tile.models]
    place, variance, correlation = tile.equations.covariances()
    s, place = _by_itself(tile, place)
    hidden = _hidden(tile, variance)
    factor = np.array([misfit(one) for one in quality])
    count, chi2 = (np.array([one[:, i] for one in quality]) for i in (0, 1))
    informed = np.nan_to_num(tile.measured**2 / variance)
    place = _widened(place, _mean(factor, informed), _mean(factor * (
        1 + np.array([one.position for one in hidden])**2), informed))
    variance = np.where(count > 0, variance * factor, np.nan)
    strength, _ = strength_of(tile, variance)
    strength = np.nan_to_num(strength)
    shown = count > 0
    best = np.argmax(np.abs(correlation), axis=0), np.arange(len(s))
    table = s.replaced(
        place=place, n_images=shown.sum(axis=0),
        significance=np.where(s.significance > 0, s.significance, strength),
        reduced_chi2=chi2.sum(axis=0) / np.maximum(
            (count - 1).clip(0).sum(axis=0) - 2, 1),
        flags=_flags(tile, quality, place, strength, correlation[best]),
        neighbor_distance=near.distance,
        neighbor_correlation=correlation[best],
        **_each(tile, quality, variance, hidden))
    table = table.chosen(significant(s, tile.options.threshold, strength))
    table = Stars.of_columns({name: getattr(table, name)
                              for name in (*_COLUMNS, *_EACH)})
    v_0, u_0 = tile.origin
    table = with_repeats(table, tile.repeats).moved(u_0, v_0)
    return table.chosen(inside(table, tile.job.core))


def _by_itself(tile, place):
    """
    Return stars and covariances (n, p, p) without what is thought of each.

    What is thought of the motions of its neighbours stays.
    """
    s, p = tile.stars, place.shape[1]
    if p == 2:
        return s, place
    hold = tile.equations.hold.copy()
    hold[:, :2] = 0
    good = np.isfinite(place).all(axis=(1, 2))
    good[good] = _invertible(place[good])
    known = np.linalg.inv(np.where(good[:, None, None], place, np.eye(p)))
    known[:, np.arange(p), np.arange(p)] -= hold
    # Place and motion of a star of one image cannot be told apart.
    good &= _invertible(known)
    known[~good] = np.eye(p)
    own = np.linalg.inv(known)
    shift = np.einsum('nij,nj->ni', own, hold * tile.equations.drift)
    shift[~good] = 0
    alone = place.copy()
    # Of a motion that its pixels do not tell nothing is known.
    alone[:, 2:], alone[:, :, 2:] = np.nan, np.nan
    return s.replaced(
        x=s.x + shift[:, 0], y=s.y + shift[:, 1],
        rate=s.rate + shift[:, 2:]), np.where(good[:, None, None], own, alone)


def _invertible(matrices):
    """Whether symmetric matrices (n, p, p) are positive beyond rounding."""
    values = np.linalg.eigvalsh(matrices)
    rounding = matrices.shape[1] * np.finfo(float).eps
    return values[:, 0] > rounding * values[:, -1]


def no_motion(place):
    """Whether covariances (n, p, p) lack a motion that was asked for, (n,)."""
    return (place.shape[1] > 2) & ~np.isfinite(place[:, -1, -1])


def _hidden(tile, variance):
    """Return what stars that were not found do in each image."""
    options = tile.options
    if not options.confusion or not options.find_neighbors:
        return [Confusion.none(len(tile.stars))] * len(tile.models)
    known = np.where(variance > 0, tile.scales**2 / variance, 0)
    total = known.sum(axis=0)
    out = []
    for k, (model, one) in enumerate(zip(tile.models, tile.equations.each,
                                         strict=True)):
        seen = known[k] > 0
        share = np.sqrt(np.median(known[k][seen] / total[seen])) if (
            seen.any()) else 1.0
        out.append(Confusion.of(
            model, tile.job.parts[k].origin, one, np.sqrt(variance[k]),
            flux=tile.job.scales[k] * tile.stars.flux, share=share))
    return out


def _widened(place, misfit, beside):
    """
    Return covariances (n, p, p) times a misfit (n,), places ``beside`` others.

    What hides beside a star is there in all images: it moves the place, but
    seems not to move.
    """
    factor = np.sqrt(np.stack([beside] * 2 + [misfit] * (
        place.shape[1] - 2), axis=1))
    return place * factor[:, :, None] * factor[:, None, :]


def _mean(values, weights):
    total = weights.sum(axis=0)
    return np.divide((values * weights).sum(axis=0), total,
                     where=total > 0, out=np.ones(total.size))


def _each(tile, quality, variance, hidden):
    """Return the columns (n, E) of all images, NaN where they show nothing."""
    n, job = len(tile.stars), tile.job
    out = {name: np.full((n, job.n_images), np.nan) for name in _EACH}
    out['n_pixels_fit'] = np.zeros((n, job.n_images), int)
    for k, (model, one, unseen) in enumerate(zip(
            tile.models, quality, hidden, strict=True)):
        stars, seen = model.stars, one[:, 0] > 0
        row, column = job.parts[k].origin
        error = np.sqrt(variance[k])
        added = error * unseen.flux
        for name, values in (
                ('x_image', stars.x + column), ('y_image', stars.y + row),
                ('fluxes', tile.measured[k] - unseen.light),
                ('flux_err', np.hypot(error, added)),
                ('flux_confusion_err', added),
                ('flux_confusion', unseen.light),
                ('local_bkg', model.background_at(stars.x, stars.y)),
                ('n_pixels_fit', one[:, 0].astype(int)),
                ('image_chi2', one[:, 1] / np.maximum(one[:, 0] - 3, 1)),
                ('crowding', one[:, 4])):
            out[name][seen, job.images[k]] = values[seen]
    return out


def _flags(tile, quality, place, strength, correlation):
    s = tile.stars
    flags = np.zeros(len(s), int)
    gone = np.abs(s.drift).max(axis=0)
    shown = np.array([one[:, 0] > 0 for one in quality])
    lost = np.array([one[:, 5] < 0.5 for one in quality])
    strange = np.array([
        unlike_a_star(np.maximum(flux, 0), one) for flux, one in zip(
            tile.measured, quality, strict=True)])
    for bit, where in (
            (NO_FLUX, ~(s.flux > 0)),
            (NO_CONVERGENCE, tile.moved > STILL),
            (AT_BOUND, gone > s.bound - 1e-6),
            (NOT_SEEN, s.listed & ~(strength > tile.options.keep)),
            (NO_COVARIANCE, ~np.isfinite(place[:, 0, 0])),
            (MOTIONLESS, no_motion(place)),
            (SATURATED, (lost | ~shown).all(axis=0)),
            # One image cannot tell of a star that is faint there.
            (NOT_A_STAR, smooth_light(tile.models)
             | ((strange | ~shown).all(axis=0) & shown.any(axis=0))),
            (BLENDED, np.abs(correlation) > BLEND_CORRELATION)):
        flags[where] |= bit
    return flags


def as_qtable(stars, unit, meta, *, confusion):
    """Return the stars as a table; empties what is given."""
    columns = vars(stars)
    n = columns['x'].size
    light = 1 if unit is None else unit
    out = QTable({'id': np.arange(1, n + 1)}, meta=meta)
    out['x_fit'] = columns.pop('x_image') * u.pix
    out['y_fit'] = columns.pop('y_image') * u.pix
    out['flux'] = columns.pop('fluxes') * light
    for name in ('flux_err', *(_HIDDEN if confusion else ()), 'local_bkg'):
        out[name] = columns.pop(name) * light
    for name in ('n_images', 'n_pixels_fit', 'significance', 'reduced_chi2',
                 'image_chi2', 'flags', 'crowding', 'neighbor_distance',
                 'neighbor_correlation'):
        out[name] = columns.pop(name)
    out['iter_detected'] = columns.pop('found_in')
    return out
