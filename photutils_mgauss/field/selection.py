"""Which stars of an image the PSF can be measured from."""
import warnings

import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from photutils.detection import DAOStarFinder
from photutils.utils.exceptions import NoDetectionsWarning
from scipy.spatial import KDTree

from photutils_mgauss.field.stamps import cut_stamps
from photutils_mgauss.utils.image import read_level, read_pixels, with_unit
from photutils_mgauss.utils.star_columns import read_sources, words_column
from photutils_mgauss.utils.validation import as_integer, as_real
from photutils_mgauss.utils.waiting import waiting

__all__ = ['select_psf_stars']

# A neighbour counts if it has more than this share of the star's light.
_NEIGHBOUR_SHARE = 0.01
# Stars whose light is more or less concentrated than that of most, by this
# many robust standard deviations and this share, are no single stars.
_SHAPE_LIMIT = 5.0
_SHAPE_SHARE = 0.15
# Galaxies and blends have more light in this ring than stars [pix], by this
# share of the light inside it.
_RING = 3.0, 6.0
_RING_SHARE = 0.02
# A star of the catalogue is at most so far off [pix]. The catalogue is
# believed if it leaves this many stars.
_MATCH, _FEWEST_LISTED = 1.5, 8
# Between two sources that are found [pix].
_MIN_SEPARATION = 1.5


def select_psf_stars(data, sources=None, *, error=None, mask=None, fwhm=None,
                     threshold=None, radius=10, isolation=None,
                     saturation=None, min_snr=50, max_stars=None,
                     finder=None, catalogue=None):
    """
    Select bright, isolated, unsaturated stars with complete stamps.

    Parameters
    ----------
    data : (ny, nx) array_like or NDData
        The image, its background subtracted. Its own mask counts, its unit
        comes back: see :ref:`pixels`.
    sources : `~astropy.table.Table`, optional
        A catalogue with ``x``, ``y`` (or ``x_fit``, ``x_centroid``, ...) and
        perhaps ``flux``. By default sources are detected.
    error : float or (ny, nx) array_like, optional
        The standard deviation of each pixel in the unit of ``data``; by
        default the scatter of the image.
    mask : (ny, nx) array_like of bool, optional
        True for pixels that cannot be used. Masks of ``data`` and ``error``
        count, too.
    fwhm : float, optional
        The width of stars [pix] for their detection, 3 by default.
    threshold : float, optional
        The height of a detection in the unit of ``data``; 5 times the
        scatter of the image by default.
    radius : float, optional
        The radius of the stamps [pix]. They must be inside the image.
    isolation : float, optional
        The smallest allowed distance of a neighbour with more than 1 % of
        the star's light [pix]; ``radius`` by default.
    saturation : float, optional
        Stars with a pixel at or above this value are saturated.
    min_snr : float, optional
        The smallest signal-to-noise ratio of the flux within 3 pixels.
    max_stars : int, optional
        The largest number of stars to select, the brightest in each part
        of the detector.
    finder : callable, optional
        A photutils star finder, called as ``finder(data, mask=mask)``;
        by default a `~photutils.detection.DAOStarFinder`.
    catalogue : `~astropy.table.Table`, optional
        Sources that are known to be stars, for example from Gaia, with
        ``x`` and ``y`` [pix]. If at least 8 of them can be used, only
        these are selected.

    Returns
    -------
    `~astropy.table.QTable`
        All sources: ``id``, ``x``, ``y``, ``flux`` (within 3 pixels of the
        star), ``snr``, ``peak``, ``selected`` and, for those that are not,
        the ``reason``: 'outside', 'edge', 'masked', 'saturated', 'faint',
        'neighbor', 'shape', 'unlisted' or 'surplus'. Give the whole table
        to `fit_mixture_field`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid or no source is found.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import GaussianMixture, select_psf_stars
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> data = np.random.default_rng(1).normal(0, 1, (64, 64))
    >>> for x, y in [(20, 30.2), (44.7, 41), (3, 50), (22, 34)]:
    ...     data += psf.render((64, 64), x, y, flux=3000)
    >>> stars = select_psf_stars(data)
    >>> for star in stars:
    ...     print(f"{star['x']:.0f} {star['y']:.0f} {star['reason'] or 'ok'}")
    20 30 neighbor
    22 34 neighbor
    45 41 ok
    3 50 edge
    """
    pixels = read_pixels(data, error, mask)
    radius = as_real(radius, 'radius', minimum=2)
    isolation = (radius if isolation is None
                 else as_real(isolation, 'isolation', minimum=0))
    min_snr = as_real(min_snr, 'min_snr', minimum=0)
    if max_stars is not None:
        max_stars = as_integer(max_stars, 'max_stars', minimum=1)
    with waiting('select_psf_stars'):
        if sources is None:
            sources = _detect(pixels, fwhm, threshold, finder)
        table = _measure(pixels, read_sources(sources, 'sources'), radius)
        saturation = (np.inf if saturation is None else
                      read_level(saturation, 'saturation', pixels.unit))
        _judge(table, isolation, saturation, min_snr)
        if catalogue is not None:
            _prefer(table, read_sources(catalogue, 'catalogue'))
        if max_stars is not None:
            _thin_out(table, max_stars, pixels.shape)
        table['selected'] = np.asarray(table['reason']) == ''
        table.remove_columns([name for name in table.colnames
                              if name.startswith('_')])
        for name in ('flux', 'peak'):
            table[name] = with_unit(table[name], pixels.unit)
    return table


def _detect(pixels, fwhm, threshold, finder):
    bad = ~np.isfinite(pixels.data)
    mask = bad if pixels.mask is None else pixels.mask | bad
    data = np.where(bad, 0, pixels.data)
    if finder is not None:
        data = with_unit(data, pixels.unit)
    else:
        fwhm = 3.0 if fwhm is None else as_real(
            fwhm, 'fwhm', above=0, maximum=max(pixels.shape))
        if threshold is None:
            threshold = 5 * _scatter(data[~mask])
        threshold = read_level(threshold, 'threshold', pixels.unit)
        threshold = as_real(threshold, 'threshold', above=0)
        # Below 1 photutils 3.1 makes a source of every pixel of a star.
        separation = max(0.5 * fwhm, _MIN_SEPARATION)
        # Sharp and flat sources are judged later, with a reason.
        finder = DAOStarFinder(threshold, fwhm, scale_threshold=False,
                               min_separation=separation,
                               sharpness_range=None, roundness_range=None)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', NoDetectionsWarning)
        found = finder(data, mask=mask)
    if found is None or len(found) == 0:
        msg = 'data must show at least 1 source, the finder found none'
        raise ValueError(msg)
    # The finder's flux is not that of the aperture used here.
    return Table({'x': found['x_centroid'], 'y': found['y_centroid']})


def _scatter(values):
    """Return the scatter of pixels; raise if they tell of none."""
    if values.size == 0:
        msg = 'data must have pixels that can be used, got none'
        raise ValueError(msg)
    scatter = mad_std(values)
    if scatter == 0:
        msg = ('data must have noise, got one value in half of the pixels or '
               'more: mask them, or give a threshold')
        raise ValueError(msg)
    return scatter


def _measure(pixels, sources, radius):
    stamps = cut_stamps(pixels, sources.x, sources.y, radius)
    if pixels.error is None:
        stamps.base[:] = mad_std(pixels.data, ignore_nan=True) ** 2
    inner = stamps.good & (stamps.offsets() <= 3)
    light = np.where(inner, stamps.data, 0)
    flux = light.sum(axis=(1, 2))
    noise = np.sqrt(np.where(inner, stamps.base, 0).sum(axis=(1, 2)))
    core = np.where(stamps.offsets() <= 1, light, 0).sum(axis=(1, 2))
    distance = stamps.offsets()
    ring = stamps.good & (distance > _RING[0]) & (
        distance <= min(_RING[1], radius))
    n_circle = np.count_nonzero(stamps.offsets() <= radius + 0.5)
    table = QTable()
    table['id'] = np.arange(1, len(flux) + 1)
    table['x'], table['y'], table['flux'] = sources.x, sources.y, flux
    table['snr'] = flux / np.maximum(noise, 1e-300)
    table['peak'] = light.max(axis=(1, 2))
    positive = np.where(flux > 0, flux, np.inf)
    table['_core'] = core / positive
    table['_ring'] = np.where(ring, stamps.data, 0).sum(axis=(1, 2)) / positive
    table['_ring_noise'] = np.sqrt(np.where(ring, stamps.base, 0).sum(
        axis=(1, 2))) / positive
    table['_good'] = stamps.good.sum(axis=(1, 2)) / n_circle
    half = stamps.radius
    ny, nx = pixels.shape
    with np.errstate(invalid='ignore'):
        table['_margin'] = np.min([sources.x - half, nx - 1 - half
                                   - sources.x, sources.y - half, ny - 1
                                   - half - sources.y], axis=0)
    return table


def _judge(table, isolation, saturation, min_snr):
    """Fill the column of reasons; the first that applies is given."""
    margin = np.nan_to_num(table['_margin'], nan=-np.inf)
    checks = [
        ('outside', table['_good'] == 0),
        ('edge', margin < -0.5),
        ('saturated', table['peak'] >= saturation),
        ('masked', table['_good'] < 1),
        ('faint', table['snr'] < min_snr),
        ('neighbor', _has_neighbour(table, isolation))]
    reason = np.full(len(table), '', dtype='U9')
    for name, applies in checks:
        reason[(reason == '') & np.asarray(applies)] = name
    reason[(reason == '') & _odd_shape(table['_core'], reason == '')] = 'shape'
    reason[(reason == '') & _extended(table, reason == '')] = 'shape'
    table['reason'] = words_column(reason)


def _has_neighbour(table, isolation):
    found = np.zeros(len(table), bool)
    known = np.flatnonzero(np.isfinite(table['x']) & np.isfinite(table['y']))
    if known.size < 2 or isolation == 0:
        return found
    places = np.column_stack([table['x'], table['y']])[known]
    pairs = known[KDTree(places).query_pairs(isolation, output_type='ndarray')]
    flux = np.asarray(table['flux'])
    for a, b in ((0, 1), (1, 0)):
        star, other = pairs[:, a], pairs[:, b]
        found[star[flux[other] > _NEIGHBOUR_SHARE * flux[star]]] = True
    return found


def _odd_shape(core, candidates):
    """Return which stars are sharper or broader than the others."""
    if candidates.sum() < 5:
        return np.zeros(core.size, bool)
    middle = np.median(core[candidates])
    scatter = mad_std(core[candidates])
    limit = max(_SHAPE_LIMIT * scatter, _SHAPE_SHARE * middle)
    return np.abs(core - middle) > limit


def _extended(table, candidates):
    """Return which stars have more light around them than the others."""
    # Of a star with another one in the ring it says nothing.
    alone = candidates & ~_has_neighbour(table, _RING[1] + 2)
    if alone.sum() < 5:
        return np.zeros(alone.size, bool)
    ring, noise = (np.asarray(table[name]) for name in ('_ring',
                                                        '_ring_noise'))
    middle = np.median(ring[alone])
    scatter = mad_std(ring[alone])
    limit = np.maximum(_SHAPE_LIMIT * np.hypot(scatter, noise), _RING_SHARE)
    return alone & (ring - middle > limit)


def _prefer(table, catalogue):
    """Keep only stars of the catalogue if they are enough, in place."""
    known = np.isfinite(catalogue.x) & np.isfinite(catalogue.y)
    usable = np.flatnonzero(np.asarray(table['reason']) == '')
    listed = np.zeros(usable.size, bool)
    if known.any() and usable.size:
        tree = KDTree(np.column_stack([catalogue.x, catalogue.y])[known])
        listed = tree.query(np.column_stack(
            [table['x'], table['y']])[usable])[0] <= _MATCH
    if listed.sum() >= _FEWEST_LISTED:
        table['reason'][usable[~listed]] = 'unlisted'
        return
    warnings.warn(
        f'the catalogue is not used, because {listed.sum()} of its '
        f'{known.sum()} sources are within {_MATCH:g} pix of good stars of '
        f'the image, and at least {_FEWEST_LISTED} must be: check its x and '
        'y, or give more', AstropyUserWarning, stacklevel=3)


def _thin_out(table, max_stars, shape):
    """Keep the brightest of each cell of the detector in turn."""
    rows = np.flatnonzero(np.asarray(table['reason']) == '')
    if rows.size <= max_stars:
        return
    n = max(1, int(np.sqrt(max_stars / 4)))
    ny, nx = shape
    cell = (np.clip(table['x'][rows] / nx * n, 0, n - 1).astype(int)
            + n * np.clip(table['y'][rows] / ny * n, 0, n - 1).astype(int))
    order = np.argsort(-np.asarray(table['flux'][rows]))
    rank = np.empty(rows.size, int)
    for number in np.unique(cell):
        inside = order[cell[order] == number]
        rank[inside] = np.arange(inside.size)
    keep = np.lexsort((-np.asarray(table['flux'][rows]), rank))[:max_stars]
    surplus = np.ones(rows.size, bool)
    surplus[keep] = False
    table['reason'][rows[surplus]] = 'surplus'
