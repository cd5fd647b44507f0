"""Whether the images of one field lie where their WCS say."""
import warnings

import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from photutils.detection import find_peaks
from scipy.spatial import cKDTree
from scipy.stats import theilslopes

from photutils_mgauss.photometry.psf_photometry import MixturePSFPhotometry

# Peaks of so many standard errors are looked at, the brightest of them.
_BRIGHT, _MOST = 30.0, 300
# A peak is the highest of a square of twice the first and a middle pixel, and
# is fitted in one of twice the second [pix], of wide PSFs in larger ones.
_PEAK, _FIT = 3, 2
# Stars of two images are the same within the second of these distances of the
# offset that most pairs have, offsets are searched to the first [pix].
_FARTHEST, _SAME = 10.0, 0.5
# Offsets are told from this size [pix], significance and number of stars on.
_TOLD, _SURE, _FEWEST = 0.1, 6.0, 8


def tell_of_misplaced(field, models, scales, *, motions):
    """
    Warn of images whose bright stars lie beside those of the others.

    Parameters
    ----------
    field : `~photutils_mgauss.photometry.many_images.Field`
    models : (E,) list of GriddedMixturePSF or MultiGaussianPSFModel
    scales : (E,) list of float
        By what lengths exceed those that suit narrow PSFs.
    motions : bool
        Whether stars may move together, at a constant rate.
    """
    places = [_places(pixels, model, scale, field.grid.to_grid[k])
              for k, (pixels, model, scale) in enumerate(
                  zip(field.pixels, models, scales, strict=True))]
    first = int(np.argmax([place.shape[1] for place in places]))
    offsets, errors = (np.array(part) for part in zip(*(
        _offset(places[first], place) for place in places), strict=True))
    known = np.isfinite(offsets).all(axis=1)
    if known.sum() < 2:
        return
    if motions:
        times = field.time_since_mean()
        # A line goes through any three images or fewer.
        if known.sum() < 4:
            return
        offsets = offsets - _lines(times, offsets, known)
    offsets = offsets - np.median(offsets[known], axis=0)
    length, error = np.hypot(*offsets.T), np.hypot(*errors.T)
    pair = np.flatnonzero(known) if known.sum() == 2 else ()
    with np.errstate(invalid='ignore'):
        # Of two images each lies half as far from their mean.
        wrong = np.flatnonzero((length > _TOLD / (1 + len(pair) / 2))
                               & (length > _SURE * error))
    if not wrong.size:
        return
    worst = wrong[np.argmax(length[wrong])]
    x, y = np.ptp(offsets[pair], axis=0) if len(pair) else offsets[worst]
    who = (f'images {pair[0]} and {pair[1]} lie' if len(pair) else
           f'image {worst} lie')
    beside = 'each other' if len(pair) else (
        f'those of the other images{_others(wrong, worst)}')
    warnings.warn(
        f'By the WCS the bright stars of {who} {np.hypot(x, y):.2f} pixels '
        f'({x:+.2f}, {y:+.2f}) beside {beside}. Fluxes are then too low and '
        'stars are found twice: align the WCS with ProperMotionFitter'
        + ('.' if motions else ', or give motions=True if the stars move.'),
        AstropyUserWarning, stacklevel=4)


def _others(wrong, worst):
    others = ', '.join(str(k) for k in wrong if k != worst)
    return f' (and of {others}, too)' if others else ''


def _places(pixels, model, scale, to_grid):
    """Return where bright stars are on the grid of the field (2, n)."""
    data, variance = pixels.part()
    good = variance > 0
    if not good.any():
        return np.zeros((2, 0))
    error = np.sqrt(np.where(good, variance, np.inf))
    sharp = (data - np.median(data[good])) / error
    with warnings.catch_warnings():
        # There may be no peaks; stars may be anything.
        warnings.simplefilter('ignore')
        peaks = find_peaks(sharp, _BRIGHT, n_peaks=_MOST, mask=~good,
                           box_size=2 * round(scale * _PEAK) + 1)
        if peaks is None or len(peaks) < _FEWEST:
            return np.zeros((2, 0))
        table = MixturePSFPhotometry(
            model, 2 * round(scale * _FIT) + 1, fit_sky=True,
            xy_bounds=scale, aperture_radius=scale * (_FIT + 0.5))(
            data, error=np.where(good, error, 1), mask=~good,
            init_params=QTable({'x': peaks['x_peak'], 'y': peaks['y_peak']}))
    x, y = (np.asarray(table[f'{name}_fit']) for name in 'xy')
    sound = (table['flags'] == 0) & np.isfinite(x) & np.isfinite(y)
    return to_grid(x[sound], y[sound])


def _offset(known, place):
    """Return how a list lies beside another (2,), and the errors (2,)."""
    nothing = np.full(2, np.nan), np.full(2, np.nan)
    if min(known.shape[1], place.shape[1]) < _FEWEST:
        return nothing
    near = cKDTree(known.T).query_ball_point(place.T, _FARTHEST)
    steps = np.array([place[:, i] - known[:, j]
                      for i, found in enumerate(near) for j in found])
    if len(steps) < _FEWEST:
        return nothing
    tree = cKDTree(steps)
    together = tree.query_ball_point(steps, _SAME, return_length=True)
    chance = len(steps) * (_SAME / _FARTHEST)**2
    if together.max() < max(_FEWEST, 3 * chance):
        return nothing
    same = steps[tree.query_ball_point(steps[np.argmax(together)], _SAME)]
    return np.median(same, axis=0), 1.25 * mad_std(same, axis=0) / np.sqrt(
        len(same))


def _lines(times, offsets, known):
    """Return offsets (E, 2) that are linear in time, whatever a few are."""
    fits = [theilslopes(offsets[known, axis], times[known])
            for axis in range(2)]
    return np.column_stack([fit.intercept + fit.slope * times
                            for fit in fits])
