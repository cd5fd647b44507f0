"""Errors of position that depend on where in its pixel a star lies."""
from dataclasses import dataclass

import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.utils.validation import as_floats, as_integer

__all__ = ['PixelPhaseError', 'pixel_phase_error']


@dataclass(frozen=True, eq=False)
class PixelPhaseError:
    """
    Position errors against the sub-pixel phase.

    Attributes
    ----------
    phase : (n_bins,) `~numpy.ndarray`
        The middles of the bins, in [-0.5, 0.5): 0 is the middle of a pixel
        [pix].
    median : (n_bins,) `~numpy.ndarray`
        The median of the errors in each bin [pix], NaN where it is empty.
    error : (n_bins,) `~numpy.ndarray`
        The standard error of the median [pix].

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import PixelPhaseError
    >>> phase = PixelPhaseError(np.array([-0.25, 0.25]),
    ...                         np.array([-0.002, 0.004]),
    ...                         np.array([0.001, 0.001]))
    >>> round(phase.half_range, 4)
    0.003
    """

    phase: np.ndarray
    median: np.ndarray
    error: np.ndarray

    @property
    def half_range(self):
        """Half of what lies between the extreme medians [pix]."""
        return float(np.nanmax(self.median) - np.nanmin(self.median)) / 2

    def plot(self, *, ax=None):
        """
        Draw the errors against the phase.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.style import current_axes
        ax = current_axes(ax)
        ax.axhline(0, color='0.7', zorder=0)
        ax.errorbar(self.phase, 1e3 * self.median, 1e3 * self.error, fmt='o-')
        ax.set(xlabel='pixel phase [pix]', ylabel='median error [mpix]',
               xlim=(-0.5, 0.5))
        return ax


def pixel_phase_error(true, measured, *, n_bins=8):
    """
    Measure position errors against the sub-pixel phase.

    Use bright isolated stars, of which each bin should hold many, and pass x
    or y or both, one after the other. A true position is one that is known
    better than the pixels: simulated, or the mean of dithered images.

    Parameters
    ----------
    true, measured : (n,) array_like
        Positions along an axis [pix]. Stars without finite positions are left
        out.
    n_bins : int, optional
        The number of bins of the phase.

    Returns
    -------
    PixelPhaseError

    Raises
    ------
    ValueError
        If the positions differ in number or none are finite.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import pixel_phase_error
    >>> true = np.linspace(0, 10, 1000, endpoint=False)
    >>> measured = true + 0.01 * np.sin(2 * np.pi * true)
    >>> phase = pixel_phase_error(true, measured)
    >>> round(phase.half_range, 4)
    0.0093
    """
    true = as_floats(true, 'true', shape=(None,), finite=False)
    measured = as_floats(measured, 'measured', shape=true.shape, finite=False)
    n_bins = as_integer(n_bins, 'n_bins', minimum=2)
    good = np.isfinite(true) & np.isfinite(measured)
    if not good.any():
        msg = f'true and measured must have finite pairs, got {true.size} not'
        raise ValueError(msg)
    true, off = true[good], (measured - true)[good]
    where = np.floor((true + 0.5) % 1 * n_bins).astype(int) % n_bins
    median, error = np.full((2, n_bins), np.nan)
    for i in np.unique(where):
        own = off[where == i]
        median[i] = np.median(own)
        # The median of normal errors scatters 1.25 times as the mean does.
        error[i] = 1.2533 * mad_std(own) / np.sqrt(own.size)
    phase = (np.arange(n_bins) + 0.5) / n_bins - 0.5
    return PixelPhaseError(phase, median, error)
