"""Artificial stars: completeness and errors as functions of flux."""
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from astropy.table import QTable
from scipy.spatial import cKDTree

from photutils_mgauss.utils.robust import std_about_zero


@dataclass(frozen=True)
class InjectionResult:
    """
    What became of artificial stars.

    Attributes
    ----------
    stars : `~astropy.table.QTable`
        One row for each artificial star: ``x_true``, ``y_true``,
        ``flux_true``, whether it was ``recovered``, and ``x_fit``,
        ``y_fit``, ``flux_fit``, ``x_err``, ``y_err``, ``flux_err`` and
        ``flags`` of its counterpart, NaN where there is none.
    curves : `~astropy.table.QTable`
        One row for each bin of true flux: ``flux_min``, ``flux_max``,
        ``n_injected``, ``completeness``, and of the stars recovered the
        robust scatter of position ``position_scatter`` [pix], of relative
        flux ``flux_scatter``, its median ``flux_bias``, and the scatter of
        position errors over the reported ones, ``position_pull``.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import (CrowdedMixturePhotometry,
    ...                               GaussianMixture, GriddedMixturePSF,
    ...                               inject_and_recover)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[0.7, 0], [0, 0.8]]])
    >>> phot = CrowdedMixturePhotometry(GriddedMixturePSF([mixture],
    ...                                                   [(0, 0)]))
    >>> data = np.random.default_rng(1).normal(100, 10, (60, 60))
    >>> result = inject_and_recover(phot, data, (3000, 9000), rng=2,
    ...                             error=np.full((60, 60), 10.0))
    >>> result.curves.colnames[:4]
    ['flux_min', 'flux_max', 'n_injected', 'completeness']
    >>> lost = result.stars[~result.stars['recovered']]
    >>> len(lost)
    0
    """

    stars: QTable
    curves: QTable


def place_stars(shape, mask, n, separation, rng):
    """
    Return n positions on good pixels, no two closer than the separation.

    They are drawn on a jittered lattice, so that artificial stars never
    crowd one another.
    """
    ny, nx = shape
    rows, columns = max(1, int(ny // separation)), max(1, int(
        nx // separation))
    cells = rng.permutation(rows * columns)
    step_y, step_x = ny / rows, nx / columns
    # In the middle part of a cell, neighbours stay half a cell apart.
    u, v = rng.uniform(0.25, 0.75, (2, cells.size))
    x = (cells % columns + u) * step_x - 0.5
    y = (cells // columns + v) * step_y - 0.5
    seen = ~mask[np.rint(y).astype(int).clip(0, ny - 1),
                 np.rint(x).astype(int).clip(0, nx - 1)]
    return x[seen][:n], y[seen][:n]


def match(true, fitted, known, radius, flux_ratio):
    """
    Return the row of the counterpart of each true star, -1 for none.

    ``true`` and ``fitted`` are (x, y, flux). A counterpart is the nearest
    star within the radius whose flux is within the ratio and that was not
    there before: ``known``, as (x, y, flux), are the stars of the image
    without artificial ones; one as close to the place and within the ratio
    of the fitted flux was.
    """
    x, y, flux = true
    row = np.full(x.size, -1)
    if not fitted[0].size:
        return row
    tree = cKDTree(np.column_stack(fitted[:2]))
    distance, near = tree.query(np.column_stack([x, y]),
                                distance_upper_bound=radius)
    close = np.flatnonzero(np.isfinite(distance))
    ratio = fitted[2][near[close]] / flux[close]
    close = close[(ratio < flux_ratio) & (ratio > 1 / flux_ratio)]
    row[close] = near[close]
    if known[0].size and close.size:
        before = cKDTree(np.column_stack(known[:2]))
        at = np.column_stack([v[row[close]] for v in fitted[:2]])
        distance, old = before.query(at, distance_upper_bound=radius)
        there = np.isfinite(distance)
        same = np.zeros(close.size, bool)
        same[there] = (np.abs(np.log(known[2][old[there]]
                                     / fitted[2][row[close[there]]]))
                       < 0.5 * np.log(flux_ratio))
        row[close[same]] = -1
    return row


def curves(stars, edges):
    """Return completeness and errors per bin of true flux."""
    flux = np.asarray(stars['flux_true'])
    out = []
    for low, high in pairwise(edges):
        here = (flux >= low) & (flux < high)
        good = here & stars['recovered']
        dx = np.concatenate([(stars[f'{c}_fit'] - stars[f'{c}_true'])[good]
                             for c in 'xy'])
        error = np.concatenate([stars[f'{c}_err'][good] for c in 'xy'])
        relative = stars['flux_fit'][good] / flux[good] - 1
        n = int(here.sum())
        bias = _median(relative)
        out.append((low, high, n, good.sum() / n if n else np.nan,
                    _scatter(dx), _scatter(relative - bias), bias,
                    _scatter(dx / error)))
    return QTable(rows=out, names=(
        'flux_min', 'flux_max', 'n_injected', 'completeness',
        'position_scatter', 'flux_scatter', 'flux_bias', 'position_pull'))


def _median(values):
    return float(np.median(values)) if values.size else np.nan


def _scatter(values):
    """Return the standard deviation about zero, from the median size."""
    values = values[np.isfinite(values)]
    return float(std_about_zero(values)) if values.size else np.nan
