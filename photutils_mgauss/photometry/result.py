"""The results of PSF photometry, star by star, before they are a table."""
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.photometry.engine import CONVERGED

_MESSAGES = {
    0: 'The fit stopped at its largest number of iterations.',
    2: 'The sum of squares does not get smaller any more.',
    3: 'The next step is expected to be below the tolerance.',
}


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


class FitInfo(Sequence):
    """
    What photutils keeps of each fit, a dictionary made when asked for.

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

    def __len__(self):
        return len(self._rows)

    def __getitem__(self, index):
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        row = self._rows[index]
        if not self._valid[row]:
            return {}
        status, evaluations = self._outcome[row].tolist()
        info = {'status': status, 'message': _MESSAGES[status],
                'nfev': evaluations}
        if self._has_covariance[row]:
            info['param_cov'] = self._covariances[row][
                np.ix_(self._free, self._free)]
        return info

    def __repr__(self):
        return f'<FitInfo of {len(self)} stars>'
