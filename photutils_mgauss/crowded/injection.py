"""Artificial stars: completeness and errors as functions of flux."""
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from astropy.table import QTable, vstack
from scipy.spatial import cKDTree

from photutils_mgauss.crowded.table import positions
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.utils.image import read_pixels, read_values, with_unit
from photutils_mgauss.utils.robust import std_about_zero
from photutils_mgauss.utils.star_columns import column_values
from photutils_mgauss.utils.validation import (
    as_floats,
    as_integer,
    as_range,
    as_real,
    as_rng,
    shown,
)
from photutils_mgauss.utils.waiting import waiting

# Artificial stars are drawn out to where this fraction of the smallest noise
# is left of them.
_FAINTEST = 1e-3
# No generator of Poisson numbers goes beyond.
_MOST_PHOTONS = 1e15


@dataclass(frozen=True)
class InjectionResult:
    """
    The results of a test with artificial stars.

    Attributes
    ----------
    stars : `~astropy.table.QTable`
        One row for each artificial star: ``x_true``, ``y_true``,
        ``flux_true``, whether it was ``recovered``, and ``x_fit``,
        ``y_fit``, ``flux_fit``, ``x_err``, ``y_err``, ``flux_err`` and
        ``flags`` of its counterpart, NaN where there is none.
    curves : `~astropy.table.QTable`
        One row for each bin of true flux: ``flux_min``, ``flux_max``,
        ``n_injected``, ``completeness``, and for the recovered stars the
        robust scatter of positions ``position_scatter`` [pix] and of
        relative fluxes ``flux_scatter``, the median relative error of
        fluxes ``flux_bias``, and the scatter of positions divided by the
        stated errors, ``position_pull``.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from photutils_mgauss import InjectionResult
    >>> stars = QTable({'flux_true': [2e3, 9e3], 'recovered': [False, True]})
    >>> result = InjectionResult(stars, curves=QTable())
    >>> float(result.stars['flux_true'][~result.stars['recovered']][0])
    2000.0
    """

    stars: QTable
    curves: QTable

    def __repr__(self):
        return (f'<InjectionResult: {np.sum(self.stars["recovered"])} of '
                f'{len(self.stars)} artificial stars were recovered>')


def inject_and_recover(photometry, data, flux, *, mask=None, error=None,
                       separation=20, radius=0.7, flux_ratio=2.5,
                       flux_edges=None, effective_gain=1.0, repeats=1,
                       rng=None):
    """
    Add artificial stars to an image and test how well they are measured.

    The function draws the stars with the PSF of ``photometry`` and with
    the noise of their own light, on a jittered lattice that is wide enough
    to keep them apart. Then ``photometry`` measures the image again.

    Parameters
    ----------
    photometry : CrowdedMixturePhotometry
        The photometry to test.
    data : (ny, nx) array_like or NDData
        The image. Its own mask counts, its unit comes back: see
        :ref:`pixels`.
    flux : (n,) array_like or (low, high) tuple of float
        The fluxes of the stars of one repeat, or two limits between which
        the logarithms of the fluxes are drawn evenly, for as many stars as
        there is room for.
    mask, error
        As in `CrowdedMixturePhotometry.__call__`.
    separation : float, optional
        The distance of artificial stars [pix].
    radius : float, optional
        The largest distance at which a star counts as found [pix].
    flux_ratio : float, optional
        The largest factor between true and measured flux.
    flux_edges : (m + 1,) array_like, optional
        The edges of the bins of flux; by default about a magnitude wide.
    effective_gain : float, optional
        Electrons per unit of data, for the noise of the artificial stars.
    repeats : int, optional
        The number of repeats.
    rng : `~numpy.random.Generator` or int, optional
        Randomness, or a seed.

    Returns
    -------
    InjectionResult
        With the tables ``stars`` and ``curves``.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid, or if there are more stars than
        places.

    Examples
    --------
    Stars on a dark sky are all found:

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
    >>> result.curves['completeness']
    <Column name='completeness' dtype='float64' length=1>
    1.0
    """
    rng = as_rng(rng)
    if not hasattr(photometry, 'psf_used'):
        msg = ('photometry must be a CrowdedMixturePhotometry, got '
               f'{shown(photometry)}')
        raise TypeError(msg)
    pixels = read_pixels(data, error, mask).with_error()
    image, variance = pixels.part()
    flux = _true_fluxes(flux, pixels.unit)
    gain = as_real(effective_gain, 'effective_gain', above=0)
    as_real(gain * max(flux), 'effective_gain times flux',
            maximum=_MOST_PHOTONS)
    repeats = as_integer(repeats, 'repeats', minimum=1)
    separation = as_real(separation, 'separation', minimum=5)
    radius = as_real(radius, 'radius', above=0)
    flux_ratio = as_real(flux_ratio, 'flux_ratio', above=1)
    with waiting('inject_and_recover'):
        before = photometry(data, mask=mask, error=error)
        known = positions(before)
        renderer = MixtureRenderer(photometry.psf_used)
        faintest = _FAINTEST * np.sqrt(
            variance[variance > 0].min(initial=np.inf))
        tables = []
        for _ in range(repeats):
            true = _artificial(variance, flux, separation, rng)
            light = renderer.image(np.array(true), faintest, image.shape)
            noisy = rng.poisson(np.maximum(light, 0) * gain) / gain
            table = photometry(image + noisy, mask=variance == 0,
                               error=np.sqrt(variance + light / gain))
            row = match(true, positions(table), known, radius, flux_ratio)
            tables.append(_injected(true, table, row))
        photometry.results = before
    stars = vstack(tables)
    if flux_edges is None:
        flux_edges = _flux_edges(np.asarray(stars['flux_true']))
    else:
        flux_edges = as_floats(
            read_values(flux_edges, 'flux_edges', pixels.unit), 'flux_edges',
            shape=(None,))
    result = InjectionResult(stars, curves(stars, flux_edges))
    _with_units(stars, ('flux_true', 'flux_fit', 'flux_err'), pixels.unit)
    _with_units(result.curves, ('flux_min', 'flux_max'), pixels.unit)
    return result


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


def _true_fluxes(flux, unit):
    """Return the fluxes of artificial stars, or a tuple of limits."""
    values = np.atleast_1d(as_floats(read_values(flux, 'flux', unit),
                                     'flux'))
    if not (values > 0).all():
        msg = f'flux must be positive, got {values.min()}'
        raise ValueError(msg)
    return as_range(values, 'flux') if isinstance(flux, tuple) else values


def _with_units(table, names, unit):
    for name in names:
        table[name] = with_unit(table[name], unit)


def _artificial(variance, flux, separation, rng):
    """Draw x, y and flux of the artificial stars of one repeat."""
    limits = isinstance(flux, tuple)
    flux = np.asarray(flux)
    n = variance.size if limits else flux.size
    x, y = place_stars(variance.shape, variance == 0, n, separation, rng)
    if limits:
        flux = np.exp(rng.uniform(*np.log(flux), x.size))
    elif x.size < flux.size:
        msg = (f'flux must not hold more stars than fit {separation} pixels '
               f'apart, {x.size}, got {flux.size}')
        raise ValueError(msg)
    return x, y, flux


def _injected(true, table, row):
    out = QTable(dict(zip(('x_true', 'y_true', 'flux_true'), true,
                          strict=True)))
    found = row >= 0
    out['recovered'] = found
    for name in ('x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err', 'flux_err'):
        column = np.full(row.size, np.nan)
        column[found] = column_values(table, name)[row[found]]
        out[name] = column
    out['flags'] = np.zeros(row.size, int)
    out['flags'][found] = np.asarray(table['flags'])[row[found]]
    return out


def _flux_edges(flux):
    n = max(1, round(2.5 * np.log10(flux.max() / flux.min())))
    return np.geomspace(flux.min(), flux.max() * (1 + 1e-9), n + 1)
