"""
Many stars fitted at once: arrays in, arrays out.

Flux, x and y of every star, alone or jointly with the others of its group,
by Levenberg-Marquardt in compiled code; what photutils adds around that
(tables, units, flags) is not here.
"""
import itertools
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from os import PathLike

import numpy as np
from astropy.modeling import Model

from photutils_mgauss import kernels
from photutils_mgauss.psf.base import PSFModel
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.rows import falls
from photutils_mgauss.utils.image import FITTED_BY
from photutils_mgauss.utils.parallel import Threads, map_parallel
from photutils_mgauss.utils.validation import shown
from photutils_mgauss.utils.waiting import progress

CONVERGED = (kernels.CONVERGED, kernels.STALLED)
BAD_ERROR = kernels.BAD_ERROR

# Stars (of groups: boxes times stars) handed to a thread at a time: a tenth
# of a second, so that an interrupt is soon seen.
_CHUNK = 4000


def kernel_image(data, error=None, mask=None, gain=None):
    """
    Return an image as the kernels take it.

    Parameters
    ----------
    data : (ny, nx) `~numpy.ndarray`
        What is not finite is masked.
    error, mask : (ny, nx) `~numpy.ndarray`, optional
    gain : float, optional
        If given, the variance of a pixel is the square of its error plus its
        stars' light over this.

    Returns
    -------
    `~photutils_mgauss.kernels.Image`
    """
    data = _as_kernels_take(data, np.float64)
    mask = _as_kernels_take(_full_mask(data, mask), np.bool_)
    error = _as_kernels_take(
        np.empty((0, 0)) if error is None else error, np.float64)
    return kernels.Image(data, error, mask,
                         0.0 if gain is None else float(gain))


def _as_kernels_take(array, dtype):
    """Return the array in the one form for which kernels are compiled."""
    return np.require(array, dtype, ['C', 'A', 'W'])


def _full_mask(data, mask):
    """Return the mask joined with the non-finite pixels, or an empty one."""
    finite = np.isfinite(data)
    if mask is not None:
        return ~finite | np.asarray(mask, dtype=bool)
    return np.empty((0, 0), bool) if finite.all() else ~finite


def as_model(psf, name='psf_model'):
    """
    Return a PSF as a model; fields are sampled on a grid, None stays None.

    Raises
    ------
    TypeError
        If it is no model, such as a mixture, which has neither a position
        nor a flux.
    """
    if hasattr(psf, 'to_grid'):
        return psf.to_grid()
    if not (psf is None or isinstance(psf, Model)):
        msg = (f'{name} must be a model with a position and a flux, got '
               f'{_what_it_is(psf)}')
        raise TypeError(msg)
    return psf


def _what_it_is(psf):
    """Return what was given instead of a model, and what makes one of it."""
    kind = type(psf).__name__
    if isinstance(psf, GaussianMixture):
        return f'a {kind}: give MultiGaussianPSFModel(mixture)'
    if isinstance(getattr(psf, 'mixture', None), GaussianMixture):
        return f'a {kind}: give MultiGaussianPSFModel(fit.mixture)'
    if hasattr(psf, 'grid_xypos'):
        return (f'a {kind}: GriddedMixturePSF.from_gridded_psf makes one of '
                'it')
    if isinstance(psf, str | PathLike):
        return f'{shown(psf)}: GriddedMixturePSF.from_file reads PSF files'
    return shown(psf)


def psf_arrays(model):
    """
    Return the kernels' form of a PSF model.

    Returns
    -------
    nodes, falls, x_grid, y_grid, integrated : tuple
        The mixtures at the nodes (M, K, 6), what the kernels precompute of
        them (M, K), the axes of the grid, and whether they are integrated
        over pixels (None if not: see `kernels.jit`).
    """
    if not isinstance(model, PSFModel):
        msg = ('psf must be a MultiGaussianPSFModel, GriddedMixturePSF or '
               f'MixtureField, got {type(model).__name__}')
        raise TypeError(msg)
    grid = model.grid
    rows, x_grid, y_grid = (_as_kernels_take(a, np.float64)
                            for a in (grid.rows, grid.x_grid, grid.y_grid))
    return (rows, falls(rows), x_grid, y_grid,
            model.pixel_integrated or None)


def is_fixed_shape(model):
    """Return whether the kernels can fit all that is free in a model."""
    return (isinstance(model, PSFModel) and model.has_fixed_shape
            and not model.has_tied
            and (model.interpolation, model.outside) == ('blend', 'clamp'))


def why_not(model):
    """Return why the kernels cannot fit a model, and what to do about it."""
    if not isinstance(model, PSFModel):
        name = type(model).__name__
        instead = (
            f'`GriddedMixturePSF.{FITTED_BY[name]}(psf_model)`'
            if name in FITTED_BY else
            'a `MultiGaussianPSFModel`, whose mixture `fit_mixture` makes of '
            'an image of the PSF')
        return f'psf_model is a {name}', f'use {instead}'
    if not model.has_fixed_shape:
        free = [name for name in model.param_names[3:]
                if not getattr(model, name).fixed]
        return (f'the shape of psf_model is free ({", ".join(free)})',
                f'set `psf_model.{free[0]}.fixed = True` and so on')
    reason = (f'psf_model has interpolation={model.interpolation!r} and '
              f'outside={model.outside!r}')
    return reason, "make it with interpolation='blend' and outside='clamp'"


def cut_boxes(x, y, fit_shape, data_shape):
    """
    Return the boxes of ``fit_shape`` around stars, trimmed to the image.

    Parameters
    ----------
    x, y : (n,) `~numpy.ndarray`
        Finite positions.
    fit_shape : (ny, nx) tuple or (n, 2) `~numpy.ndarray`
    data_shape : (ny, nx) tuple

    Returns
    -------
    (n, 4) `~numpy.ndarray` of int
        First row, first column, height and width; heights and widths are 0
        where a box does not overlap the image.
    """
    boxes = np.empty((x.size, 4), np.int64)
    fit_shape = np.transpose(fit_shape)
    for axis, position in enumerate((y, x)):
        # As astropy.nddata.overlap_slices rounds.
        start = np.ceil(position - fit_shape[axis] / 2)
        stop = np.clip(start + fit_shape[axis], 0, data_shape[axis])
        start = np.clip(start, 0, data_shape[axis])
        boxes[:, axis] = start
        boxes[:, 2 + axis] = stop - start
    return boxes


def count_pixels(image, boxes):
    """Return how many pixels of each box are not masked, (n,)."""
    if image.mask.size == 0:
        return boxes[:, 2] * boxes[:, 3]
    out = np.empty(len(boxes), np.int64)
    kernels.count_pixels(image.mask, boxes, out)
    return out


def sort_groups(group, x, y):
    """
    Put the stars of each group next to each other.

    Within a group they are ordered along its longer side, so that stars that
    share pixels stand close to each other.

    Parameters
    ----------
    group : (n,) `~numpy.ndarray` of int
        The group of each star.
    x, y : (n,) `~numpy.ndarray`
        Finite positions.

    Returns
    -------
    order : (n,) `~numpy.ndarray` of int
    starts : (g + 1,) `~numpy.ndarray` of int
        Where each group starts in that order.
    """
    order = np.argsort(group, kind='stable')
    starts = np.unique(np.concatenate(
        [[0], np.flatnonzero(np.diff(group[order])) + 1, [group.size]]))
    sizes = np.diff(starts)
    if (sizes == 1).all():
        return order, starts
    width, height = (np.maximum.reduceat(axis[order], starts[:-1])
                     - np.minimum.reduceat(axis[order], starts[:-1])
                     for axis in (x, y))
    wide = np.repeat(width >= height, sizes)
    along = np.where(wide, x[order], y[order])
    return order[np.lexsort((along, group[order]))], starts


@dataclass(frozen=True, eq=False)
class StarGroups:
    """
    What is to be fitted: n stars, those of a group next to each other.

    Attributes
    ----------
    initial, lower, upper : (n, 3) `~numpy.ndarray`
        Flux, x and y to start from, and their bounds.
    boxes : (n, 4) `~numpy.ndarray` of int
        The pixels of each, see `cut_boxes`.
    sky : (n,) `~numpy.ndarray`
        The background to subtract.
    starts : (g + 1,) `~numpy.ndarray` of int
        Where each group starts.
    fixed : (3,) `~numpy.ndarray` of bool
        Which of flux, x and y are not fitted.
    """

    initial: np.ndarray
    boxes: np.ndarray
    sky: np.ndarray
    starts: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    fixed: np.ndarray

    @property
    def arrays(self):
        """The arrays of stars, as the kernel takes them."""
        return kernels.Stars(self.starts, self.boxes, self.initial, self.sky,
                             self.lower, self.upper)

    @property
    def take_long(self):
        """
        Whether they are more than a chunk, or one group is.

        They are fitted in other threads then: this one has to see an
        interrupt.
        """
        return np.square(np.diff(self.starts), dtype=float).sum() > _CHUNK

    def chunks(self):
        """Yield runs of whole groups of about equal cost."""
        sizes = np.diff(self.starts)
        cost = np.cumsum(sizes.astype(float) ** 2)
        if cost.size == 0:
            return
        ends = np.searchsorted(cost, np.arange(_CHUNK, cost[-1], _CHUNK))
        edges = np.unique(np.concatenate([[0], ends + 1, [sizes.size]]))
        edges = edges[edges <= sizes.size]
        for first, last in itertools.pairwise(edges):
            yield self._part(first, last)

    def _part(self, first, last):
        starts = self.starts[first:last + 1]
        rows = slice(starts[0], starts[-1])
        return StarGroups(
            self.initial[rows], self.boxes[rows], self.sky[rows],
            starts - starts[0], self.lower[rows], self.upper[rows],
            self.fixed)


@dataclass(frozen=True, eq=False)
class Fits:
    """
    What came out, star by star.

    Attributes
    ----------
    values : (n, 3) `~numpy.ndarray`
        Flux, x and y.
    covariances : (n, 3, 3) `~numpy.ndarray`
        Their covariances, NaN for what was fixed.
    sky : (n, 2) `~numpy.ndarray`
        The fitted level of the sky and its error, NaN if it was not fitted.
    sums : (n, 3) `~numpy.ndarray`
        Sum of absolute residuals, residual of the central pixel, chi2.
    outcome : (n, 2) `~numpy.ndarray` of int
        The status, 1 to 4 for success, and the number of evaluations.
    """

    values: np.ndarray
    covariances: np.ndarray
    sky: np.ndarray
    sums: np.ndarray
    outcome: np.ndarray = field(repr=False)

    @classmethod
    def empty(cls, n):
        """Return results of n stars not fitted yet."""
        return cls(np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan),
                   np.full((n, 2), np.nan), np.full((n, 3), np.nan),
                   np.zeros((n, 2), np.int64))

    @property
    def arrays(self):
        """All arrays, as the kernel fills them."""
        return kernels.StarFits(self.values, self.covariances, self.sky,
                                self.sums, self.outcome)

    @classmethod
    def joined(cls, parts):
        """Return the results of all chunks, in order."""
        if not parts:
            return cls.empty(0)
        return cls(*(np.concatenate(arrays) for arrays in zip(
            *(part.arrays for part in parts), strict=True)))


def _fit_chunk(image, psf, fit_sky, max_iterations, stop, stars):
    fits = Fits.empty(len(stars.initial))
    scratch = kernels.FitScratch.empty(stars, psf[0].shape[1], stop)
    kernels.fit_stars(image, stars.arrays, stars.fixed, bool(fit_sky), psf,
                      max_iterations, scratch, fits.arrays)
    return fits


def fit_stars(image, psf, stars, *, fit_sky=False, max_iterations=100,
              executor=None, n_threads=None, progress_bar=False):
    """
    Fit all stars.

    Parameters
    ----------
    image : `~photutils_mgauss.kernels.Image`
    psf : tuple
        See `psf_arrays`.
    stars : StarGroups
    fit_sky : bool, optional
        Whether to fit a level of the sky to each group, too.
    max_iterations : int, optional
    executor : `~concurrent.futures.Executor`, optional
        Where the chunks are fitted; by default in a pool of threads.
    n_threads : int, optional
        How many threads that pool has; by default as many as there are
        cores.
    progress_bar : bool, optional
        Whether to show how many chunks are done.

    Returns
    -------
    Fits
    """
    stop = np.zeros(1, bool)
    work = partial(_fit_chunk, image, psf, fit_sky, max_iterations, stop)
    chunks = list(stars.chunks())
    watch = partial(progress, desc='Fitting stars', total=len(chunks),
                    shown=progress_bar)
    pool = (nullcontext(executor) if n_threads is None
            or executor is not None else Threads(n_threads))
    with pool as executor, _interruptible(stop), closing(map_parallel(
            work, chunks, executor=executor, long=stars.take_long)) as fits:
        return Fits.joined(list(watch(fits)))


@contextmanager
def _interruptible(stop):
    """Tell the kernels to end if nobody waits for them any more."""
    try:
        yield
    except BaseException:
        stop.fill(True)
        raise
