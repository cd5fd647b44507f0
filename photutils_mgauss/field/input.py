"""Stars of one or more exposures, as the fit of a field wants them."""
import warnings
from dataclasses import dataclass, replace
from numbers import Real

import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.field import stages
from photutils_mgauss.field.choice import DEGREES, full_degree, n_folds
from photutils_mgauss.field.contexts import Contexts, context_terms
from photutils_mgauss.field.forms import FreeShapes
from photutils_mgauss.field.normal import FieldProblem
from photutils_mgauss.field.places import places, same_stars
from photutils_mgauss.field.stamps import Stamps, cut_stamps, remove_star_noise
from photutils_mgauss.utils.correlated_noise import noise_correlation
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.star_columns import (
    check_table,
    column_values,
    read_sources,
)

# Neighbours may be this far off their catalogue positions [pix].
_NEIGHBOUR_STDDEV = 0.5
_MAX_NEIGHBOURS = 12
# What is light and what noise, for one star and for all together [standard
# deviations].
_SEEN, _SEEN_TOGETHER = 3.0, 5.0
# An image has a sky if its median exceeds the scatter of its pixels by this
# factor, and if the sky is more than this share of the light in most stamps.
# The first spares images whose sky was taken away, the second those in which
# noise is low.
_SKY_ABOVE, _SKY_SHARE = 3.0, 0.1
# Pixels whose median is taken: some thousandths of their scatter are enough.
_LOOKED_AT = 1e5
# Stars needed for each term of the polynomials, beyond the first.
_STARS_PER_TERM = 2


@dataclass
class Sample:
    """
    The stars of all exposures that can be used.

    Attributes
    ----------
    stamps : Stamps
    sources : (n, M, 3) `~numpy.ndarray`
        x, y and flux of each star and its neighbours.
    count : (n,) `~numpy.ndarray` of int
        How many of those there are.
    exposure, row : (n,) `~numpy.ndarray` of int
        The exposure of each star, and its row in the table of that.
    reasons : list of `~numpy.ndarray` of str
        For each exposure and row why it is not used, or ''.
    shape : (int, int)
        Of the detector.
    catalogues : list of Sources
        As given.
    unit : `~astropy.units.UnitBase` or None
        Of the pixels.
    correlations : list of NoiseCorrelation or None
        What the noise of neighbouring pixels of each exposure has in common.
    growth : (E,) `~numpy.ndarray`
        By how much the variances in ``stamps`` are larger for it.
    values : (n, C) `~numpy.ndarray`
        The contexts of each star, NaN where unknown.
    contexts : Contexts or None
        Their scales, if there are any.
    star, place : (n,) `~numpy.ndarray` of int
        Which star, and at which place of the detector, each is.
    levels : list of (float, float)
        The median of the good pixels of each exposure, and their scatter.
    """

    stamps: Stamps
    sources: np.ndarray
    count: np.ndarray
    exposure: np.ndarray
    row: np.ndarray
    reasons: list
    shape: tuple
    catalogues: list
    unit: object
    correlations: list
    growth: np.ndarray
    values: np.ndarray
    contexts: Contexts | None
    star: np.ndarray
    place: np.ndarray
    levels: list

    @property
    def n_places(self):
        """At how many places the stars show the PSF."""
        return np.unique(self.place).size

    def expected(self):
        """Return x and y (n,) of the stars in their tables."""
        places = [(self.catalogues[e].x[i], self.catalogues[e].y[i])
                  for e, i in zip(self.exposure, self.row, strict=True)]
        return np.array(places).T

    def problem(self, degree, local_bkg):
        """
        Return the problem of a field with polynomials of a degree.

        Those of higher degrees that few stars get are in its basis.
        """
        places = normalised(*self.expected(), self.shape)
        basis = stages.polynomials(*places, full_degree(degree))
        hold = np.full(self.sources.shape, _NEIGHBOUR_STDDEV**-2.0)
        hold[..., 2] = 1 / np.maximum(self.sources[..., 2] ** 2, 1e-300)
        n = len(basis)
        extra = np.zeros((n, 0)) if self.contexts is None else context_terms(
            self.contexts.scaled(self.values), *places, degree)
        return FieldProblem(
            self.stamps, np.zeros(self.stamps.data.shape), basis, self.sources,
            self.sources.copy(), hold, self.count, np.zeros(n),
            bool(local_bkg), np.ones(n, bool), self.exposure, FreeShapes(),
            np.zeros((n, 3)), extra=extra, star=self.star, place=self.place)

    def without_deviant(self, used):
        """Return the sample in which the stars not used (n,) are deviant."""
        reasons = [one.copy() for one in self.reasons]
        for star in np.flatnonzero(~used):
            reasons[self.exposure[star]][self.row[star]] = 'deviant'
        return replace(self, reasons=reasons)

    def dropped(self):
        """Return the table of what was not used, and why."""
        rows = [np.flatnonzero(one != '') for one in self.reasons]
        table = QTable({'id': np.concatenate(rows) + 1, 'reason':
                        np.concatenate([one[i] for one, i in zip(
                            self.reasons, rows, strict=True)])})
        if len(rows) > 1:
            table['exposure'] = np.repeat(np.arange(len(rows)),
                                          [one.size for one in rows])
        return table


def normalised(x, y, shape):
    """Return positions scaled to [-1, 1] over the detector."""
    ny, nx = shape
    return (2 * np.asarray(x, float) / max(nx - 1, 1) - 1,
            2 * np.asarray(y, float) / max(ny - 1, 1) - 1)


def read_sample(data, stars, error, mask, radius, gain, contexts=()):
    """Check the exposures, cut their stars out, and say who is left out."""
    if gain is not None and not (isinstance(gain, Real) and gain > 0):
        msg = (f'effective_gain must be None or a number greater than 0, got '
               f'{gain!r:.80}')
        raise ValueError(msg)
    exposures = list(read_exposures(data, stars, error, mask))
    parts = [_read_one(pixels, table, radius, gain)
             for pixels, table in exposures]
    values = np.concatenate([
        _context_values(table, contexts)[part[1]]
        for (_, table), part in zip(exposures, parts, strict=True)])
    stamps = Stamps.joined([part[0] for part in parts])
    if not len(stamps.data):
        raise ValueError(_no_star([part[2] for part in parts]))
    _check_light(stamps)
    most = max(part[4].shape[1] for part in parts)
    stars = [number[part[1]] for number, part in zip(
        same_stars([part[2] for part in parts]), parts, strict=True)]
    where = np.concatenate([np.column_stack([part[2].x, part[2].y])[part[1]]
                            for part in parts]).T
    # Numbers without gaps: stars in the order in which they come.
    star = _numbered(np.concatenate(stars))
    return Sample(
        stamps, np.concatenate([
            np.pad(part[4], ((0, 0), (0, most - part[4].shape[1]), (0, 0)))
            for part in parts]),
        np.concatenate([part[5] for part in parts]),
        np.repeat(np.arange(len(parts)), [len(part[1]) for part in parts]),
        np.concatenate([part[1] for part in parts]),
        [part[3] for part in parts], exposures[0][0].shape,
        [part[2] for part in parts], exposures[0][0].unit,
        [_correlation(pixels, part[2], radius)
         for (pixels, _), part in zip(exposures, parts, strict=True)],
        np.ones(len(parts)), values,
        Contexts.of_stars(contexts, values) if contexts else None,
        star, places(star, *where, exposures[0][0].shape),
        [_level(pixels) for pixels, _ in exposures])


def _no_star(sources):
    """Return why none of the sources can be used."""
    n = sum(one.x.size for one in sources)
    if not n:
        return 'stars must hold at least 1 star, got a table without rows'
    if not any(one.selected.any() for one in sources):
        return ("the column 'selected' of stars must be true for at least 1 "
                f'star, got none of {n}')
    return ('stars must hold at least 1 star whose pixels can be used, got '
            f'none of {n}: they are outside the image, masked, or too near '
            'the edge')


def _numbered(values):
    """Return the same numbers without gaps, by first appearance."""
    _, first, inverse = np.unique(values, return_index=True,
                                  return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def _context_values(table, names):
    """Return the columns of contexts (n, C), NaN where unknown."""
    check_table(table, 'stars', names)
    columns = [column_values(table, name) for name in names]
    return np.array(columns).reshape(len(names), len(table)).T


def _correlation(pixels, sources, radius):
    """Return the correlation of the noise of an exposure, or None."""
    error = pixels.error
    if error is None:
        error = mad_std(pixels.data, ignore_nan=True)
    return noise_correlation(
        pixels.data, np.broadcast_to(error, pixels.shape),
        np.empty((0, 0)) if pixels.mask is None else pixels.mask, sources.x,
        sources.y, radius)


def _level(pixels):
    """Return the median of the good pixels of an image and their scatter."""
    step = max(1, int(np.sqrt(np.prod(pixels.shape) / _LOOKED_AT)))
    data = np.asarray(pixels.data)[::step, ::step]
    good = np.isfinite(data)
    if pixels.mask is not None and pixels.mask.size:
        good &= ~pixels.mask[::step, ::step]
    if not good.any():
        return 0.0, 0.0
    return float(np.median(data[good])), float(mad_std(data[good]))


def warn_of_sky(sample):
    """Warn if images have a sky that the PSF would take for its wings."""
    stamps = sample.stamps
    for e, (level, scatter) in enumerate(sample.levels):
        own = sample.exposure == e
        light = np.where(stamps.good[own], stamps.data[own], 0).sum(
            axis=(1, 2))
        sky = level * stamps.good[own].sum(axis=(1, 2))
        if (level > _SKY_ABOVE * scatter
                and (sky > _SKY_SHARE * light).sum() > own.sum() / 2):
            warnings.warn(
                f'the image has a background of {level:.4g}, which is '
                f'{level / scatter if scatter else np.inf:.0f} times the '
                'scatter of its pixels and '
                f'{np.median(sky / light):.0%} of the light in the stamps of '
                'stars, and the PSF would contain it: subtract it, or give '
                'local_bkg=True', AstropyUserWarning, stacklevel=4)


def allow_for_correlation(sample):
    """
    Enlarge the variances of stamps for correlated noise, in place, and warn.

    The stamps then know as much of a PSF as their pixels do, though as
    independent ones: the curvature of chi^2 is that of the errors.
    """
    if not any(sample.correlations):
        return
    width = stages.stacked_width(sample.stamps)
    sample.growth[:] = [1 if one is None else one.growth(width)
                        for one in sample.correlations]
    factor = sample.growth[sample.exposure][:, None, None]
    sample.stamps.base *= factor
    sample.stamps.slope *= factor
    strongest = max(filter(None, sample.correlations),
                    key=lambda one: sum(one.nearest))
    warnings.warn(f'{strongest} The errors of pixels are taken to be '
                  f'{np.sqrt(sample.growth.max()):.2f} times as large.',
                  AstropyUserWarning, stacklevel=4)


def _check_light(stamps):
    """Raise if there is no light at the places of the stars, or negative."""
    pulls = stamps.light_over_noise()
    bright = np.count_nonzero(pulls > _SEEN)
    dark = np.count_nonzero(pulls < -_SEEN)
    if dark > bright:
        msg = (f'data must have positive stars, got {dark} of {pulls.size} '
               'negative ones: negate the image, or do not subtract another '
               'one')
        raise ValueError(msg)
    together = pulls.sum() / np.sqrt(pulls.size)
    if together < _SEEN_TOGETHER:
        msg = (f'data must have light at the places of the {pulls.size} '
               f'stars, got no more than noise ({together:.1f} times its '
               'standard deviation in all): check the positions')
        raise ValueError(msg)


def read_exposures(data, stars, error, mask):
    """Yield the pixels and the table of each exposure."""
    if isinstance(stars, Table) or not isinstance(stars, (list, tuple)):
        yield read_pixels(data, error, mask), stars
        return
    lists = {'data': data, 'error': error, 'mask': mask}
    for name, one in lists.items():
        n_images = len(one) if isinstance(one, (list, tuple)) or getattr(
            one, 'ndim', 0) else 1
        if one is None or (name == 'error' and isinstance(one, Real)):
            lists[name] = [one] * len(stars)
        elif n_images != len(stars):
            msg = (f'{name} must hold an image for each of the {len(stars)} '
                   f'tables in stars, got {n_images}')
            raise ValueError(msg)
    if not stars:
        msg = 'stars must hold at least 1 table, got none'
        raise ValueError(msg)
    first = None
    for *given, table in zip(*lists.values(), stars, strict=True):
        pixels = read_pixels(*given)
        first = pixels if first is None else first
        _check_same(first, pixels)
        yield pixels, table


def _check_same(first, pixels):
    """Raise unless two exposures are of one detector and in one unit."""
    if pixels.shape != first.shape:
        msg = (f'data must be exposures of one detector, got the shapes '
               f'{first.shape} and {pixels.shape}')
        raise ValueError(msg)
    if pixels.unit != first.unit:
        msg = (f'data must be exposures in one unit, got {first.unit} and '
               f'{pixels.unit}')
        raise ValueError(msg)


def _read_one(pixels, table, radius, gain):
    """Return stamps, their rows, sources, reasons, neighbours, counts."""
    sources = read_sources(table, unit=pixels.unit)
    stamps, rows, reasons = _usable_stamps(pixels, sources, radius, gain)
    around, count = _with_neighbours(sources, rows, stamps)
    return stamps, rows, sources, reasons, around, count


def _usable_stamps(pixels, sources, radius, gain):
    """Return stamps of usable stars, their rows, and why others are not."""
    reasons = np.full(sources.x.size, '', dtype='U12')
    ny, nx = pixels.shape
    with np.errstate(invalid='ignore'):
        inside = ((np.abs(sources.x - (nx - 1) / 2) <= nx / 2)
                  & (np.abs(sources.y - (ny - 1) / 2) <= ny / 2))
    reasons[~inside] = 'outside'
    rows = np.flatnonzero(inside & sources.selected)
    stamps = cut_stamps(pixels, sources.x[rows], sources.y[rows], radius)
    if pixels.error is None:
        _estimate_noise(stamps, pixels.data)
    usable = stamps.usable()
    reasons[rows[~usable]] = 'masked'
    stamps = stamps.subset(usable)
    if pixels.error is not None and usable.any():
        remove_star_noise(stamps, gain)
    return stamps, rows[usable], reasons


def _estimate_noise(stamps, data):
    """Set the variance to that of the image away from stars, in place."""
    stamps.base[:] = max(mad_std(data, ignore_nan=True) ** 2,
                         np.finfo(float).tiny)


def _with_neighbours(sources, index, stamps):
    """Return x, y, flux of each star and its neighbours, and their number."""
    from scipy.spatial import KDTree
    flux = sources.flux.copy()
    known = np.isfinite(sources.x) & np.isfinite(sources.y)
    inner = stamps.offsets() <= 3.5
    noise = np.sqrt((stamps.base * inner).sum(axis=(1, 2)))
    flux[index] = np.where(
        flux[index] > 0, flux[index],
        np.maximum((stamps.data * inner).sum(axis=(1, 2)), 1e-3 * noise))
    known &= np.isfinite(flux) & (flux > 0)
    known_rows = np.flatnonzero(known)
    tree = KDTree(np.column_stack([sources.x, sources.y])[known])
    lists = []
    for star in index:
        here = sources.x[star], sources.y[star]
        near = known_rows[tree.query_ball_point(here, stamps.radius + 2)]
        near = near[near != star]
        brightest = near[np.argsort(-flux[near])][:_MAX_NEIGHBOURS]
        lists.append([star, *brightest])
    count = np.array([len(rows) for rows in lists], int)
    table = np.zeros((len(index), count.max(initial=1), 3))
    for i, rows in enumerate(lists):
        table[i, :len(rows)] = np.column_stack(
            [sources.x[rows], sources.y[rows], flux[rows]])
    return table, count


def possible_degree(degree, sample):
    """
    Return the highest degree to try; warn if a lower one must do.

    Of stars that several exposures show at one place, one counts.
    """
    n_stars = sample.n_places
    if degree == 'auto':
        # Some of the stars are left out while the degree is chosen.
        rest = n_stars - n_stars // n_folds(n_stars)
        return max(d for d in DEGREES if d == 0 or rest >= _stars_needed(d))
    needed = _stars_needed(degree)
    if n_stars >= needed:
        return degree
    possible = max(d for d in range(min(degree, n_stars))
                   if n_stars >= _stars_needed(d))
    what = ('stars' if n_stars == len(sample.row) else
            f'places of {len(sample.row)} detections of stars')
    warnings.warn(
        f'{n_stars} {what} are too few for degree {degree}, which needs '
        f'{needed}; degree {possible} is used', AstropyUserWarning,
        stacklevel=4)
    return possible


def _stars_needed(degree):
    return 1 + _STARS_PER_TERM * (stages.n_terms(degree) - 1)
