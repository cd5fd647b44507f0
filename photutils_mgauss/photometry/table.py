"""Results, tables and flags of PSF photometry, as photutils makes them."""
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from photutils_mgauss.photometry.engine import CONVERGED
from photutils_mgauss.photometry.fitter import MESSAGES
from photutils_mgauss.utils import compat
from photutils_mgauss.utils.image import with_unit

# Bits of the ``flags`` column, see `decode_psf_flags`.
PARTIAL = 1
OUTSIDE_IMAGE = 2
NON_POSITIVE_FLUX = 4
NO_CONVERGENCE = 8
NO_COVARIANCE = 16
NEAR_BOUND = 32
NO_OVERLAP = 64
FULLY_MASKED = 128
TOO_FEW_PIXELS = 256
NON_FINITE_POSITION = 512
NON_FINITE_FLUX = 1024
NON_FINITE_LOCAL_BKG = 2048
OUTSIDE_FIT_REGION = 4096

# How near a bound is near, in the unit of the parameter.
_BOUND_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class FitResult:
    """
    Inputs and results of n stars, in the order of the input.

    Attributes
    ----------
    initial, lower, upper : (n, 3) `~numpy.ndarray`
        Initial flux, x, y and their bounds.
    local_bkg : (n,) `~numpy.ndarray`
        The subtracted background.
    n_pixels : (n,) `~numpy.ndarray` of int
        How many pixels were fitted.
    reasons : (n,) `~numpy.ndarray` of int
        Flags of the stars that could not be fitted.
    valid : (n,) `~numpy.ndarray` of bool
        Which stars were fitted.
    free : (3,) `~numpy.ndarray` of bool
        Which of flux, x and y were fitted.
    flagged_bounds : (3,) `~numpy.ndarray` of bool
        Whose bounds give rise to a flag.
    values, covariances, sky, sums, outcome : `~numpy.ndarray`
        As in `Fits`; NaN for stars that were not fitted.
    saturated : (m,) `~numpy.ndarray` of int
        The rows of saturated stars, -1 for those that are not listed.
    shapes : (n, 2) `~numpy.ndarray` of int
        How many pixels (ny, nx) of each star are fitted.
    """

    initial: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    local_bkg: np.ndarray
    n_pixels: np.ndarray
    reasons: np.ndarray
    valid: np.ndarray
    free: np.ndarray
    flagged_bounds: np.ndarray
    values: np.ndarray
    covariances: np.ndarray
    sky: np.ndarray
    sums: np.ndarray
    outcome: np.ndarray
    saturated: np.ndarray
    shapes: np.ndarray

    @property
    def converged(self):
        """Whether each fit ended at a minimum."""
        return np.isin(self.outcome[:, 0], CONVERGED)

    @property
    def has_covariance(self):
        """Whether the errors of each fit are known."""
        first = int(np.argmax(self.free))
        return np.isfinite(self.covariances[:, first, first])

    @property
    def errors(self):
        """The standard errors of flux, x and y, (n, 3)."""
        return np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))

    def updated(self, other, rows):
        """Return the results with those of another fit in some rows."""
        changed = {}
        for name in ('values', 'covariances', 'sky', 'sums', 'outcome'):
            changed[name] = getattr(self, name).copy()
            changed[name][rows] = getattr(other, name)
        return replace(self, **changed)


class FitInfo:
    """
    What photutils keeps of each fit, made when it is asked for.

    Parameters
    ----------
    result : FitResult
    rows : (n,) `~numpy.ndarray` of int
        The order of the stars.
    """

    def __init__(self, result, rows):
        self._rows = rows
        self._covariances = result.covariances
        self._has_covariance = result.has_covariance
        self._valid = result.valid
        self._outcome = result.outcome
        self._free = np.flatnonzero(result.free)

    @cached_property
    def entries(self):
        """A list with a dictionary for each star."""
        return [self._entry(row) for row in self._rows]

    def _entry(self, row):
        if not self._valid[row]:
            return {}
        status, evaluations = self._outcome[row].tolist()
        info = {'status': status, 'message': MESSAGES[status],
                'nfev': evaluations}
        if self._has_covariance[row]:
            info['param_cov'] = self._covariances[row][
                np.ix_(self._free, self._free)]
        return info


def define_flags(result, fit_shape, data_shape):
    """
    Return the flags of all stars.

    Parameters
    ----------
    result : FitResult
        Inputs and results, one row for each star.
    fit_shape, data_shape : (ny, nx) tuple
        The shapes of the fitted region and of the image.

    Returns
    -------
    (n,) `~numpy.ndarray` of int
    """
    flags = result.reasons.copy()
    flux, x, y = result.values.T
    height, width = data_shape

    def mark(where, bit):
        flags[where] |= bit

    mark(result.n_pixels < result.shapes.prod(axis=1), PARTIAL)
    mark((x < -0.5) | (y < -0.5) | (x > width - 0.5) | (y > height - 0.5),
         OUTSIDE_IMAGE)
    mark(flux <= 0, NON_POSITIVE_FLUX)
    mark(result.valid & ~result.converged, NO_CONVERGENCE)
    mark(~result.has_covariance, NO_COVARIANCE)
    mark(_near_bound(result), NEAR_BOUND)
    mark(~(np.isfinite(x) & np.isfinite(y)), NON_FINITE_POSITION)
    mark(~np.isfinite(flux), NON_FINITE_FLUX)
    mark(~np.isfinite(result.local_bkg), NON_FINITE_LOCAL_BKG)
    if compat.FLAGS_FIT_REGION:
        mark(_outside_fit_region(result, fit_shape, data_shape),
             OUTSIDE_FIT_REGION)
    return flags


def _near_bound(result):
    near = np.zeros(result.valid.size, bool)
    for bounds in (result.lower, result.upper):
        with np.errstate(invalid='ignore'):
            close = np.abs(bounds - result.values) <= _BOUND_TOLERANCE
        near |= close[:, result.flagged_bounds].any(axis=1)
    return near & result.valid


def _outside_fit_region(result, fit_shape, data_shape):
    outside = np.zeros(result.valid.size, bool)
    for axis, k in ((0, 2), (1, 1)):
        start = np.ceil(result.initial[:, k] - fit_shape[axis] / 2)
        low = np.maximum(start, 0) - 0.5
        high = np.minimum(start + fit_shape[axis], data_shape[axis]) - 0.5
        outside |= (result.values[:, k] < low) | (result.values[:, k] > high)
    return outside


def fit_quality(result, n_free, has_error):
    """
    Return qfit, cfit and reduced_chi2 of all stars.

    The first two are the sum of the absolute residuals and the residual of
    the central pixel over the flux.
    """
    absolute, centre, squares = result.sums.T
    flux = np.where(result.values[:, 0] == 0, np.nan, result.values[:, 0])
    dof = (result.n_pixels - n_free).astype(float)
    chi2 = np.full(flux.size, np.nan)
    if has_error:
        np.divide(squares, dof, out=chi2, where=dof > 0)
    # What rounding leaves of a pixel is nothing, and zero is positive.
    least = np.finfo(float).eps * result.n_pixels
    ratios = [np.where(np.abs(ratio) <= least, 0.0, ratio)
              for ratio in (absolute / flux, centre / flux)]
    return *ratios, chi2


def make_columns(result, quality, flags, unit):
    """Return the columns that photutils puts behind the initial ones."""
    columns = {}
    for name, k in (('x', 1), ('y', 2), ('flux', 0)):
        columns[f'{name}_fit'] = result.values[:, k].copy()
    for name, k in (('x', 1), ('y', 2), ('flux', 0)):
        columns[f'{name}_err'] = result.errors[:, k]
    if unit is not None:
        for name in ('flux_fit', 'flux_err'):
            columns[name] = columns[name] << unit
    columns['n_pixels_fit'] = result.n_pixels
    columns['qfit'], columns['cfit'], columns['reduced_chi2'] = quality
    columns['flags'] = flags
    return columns


def psf_columns(covariances, unit):
    """Return the columns of the PSF's part of the errors, if it is known."""
    if covariances is None:
        return {}
    flux, x, y = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).T
    return {'x_psf_err': x, 'y_psf_err': y,
            'flux_psf_err': with_unit(flux, unit)}


def assemble(init_params, group_size, columns, meta):
    """Return the table of results, sorted by id as photutils does."""
    rows = np.argsort(np.asarray(init_params['id']), kind='stable')
    table = {}
    for name in init_params.colnames:
        table[name] = init_params[name][rows]
        if name == 'group_id':
            table['group_size'] = group_size[rows]
    for name, column in columns.items():
        table[name] = column[rows]
    return compat.results_table(table, meta), rows
