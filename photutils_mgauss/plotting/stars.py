"""Figures of measured stars."""
import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.plotting.style import (
    BLACK,
    BLUE,
    CYCLE,
    ORANGE,
    current_axes,
)

__all__ = [
    'plot_comparison',
    'plot_detections',
    'plot_error_curve',
    'plot_stated_errors',
]


def plot_detections(x, y, flux, *, ax=None):
    """
    Map the stars of a catalogue, brighter ones larger.

    Parameters
    ----------
    x, y, flux : (n,) array_like
        Positions [pix] and fluxes.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
    """
    ax = current_axes(ax)
    flux = np.maximum(np.nan_to_num(flux), 1e-300)
    size = np.clip(np.log10(flux / np.percentile(flux, 5)), 0.1, 3)
    ax.scatter(x, y, s=4 * size**2, color=BLACK, linewidths=0, alpha=0.7)
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal',
           title=f'{len(flux)} stars')
    return ax


def plot_stated_errors(magnitude, errors, *, unit, label=None, ax=None):
    """
    Plot the stated errors of stars against their magnitudes.

    Parameters
    ----------
    magnitude : (n,) array_like
        Magnitudes [mag].
    errors : dict of (n,) array_like
        One or several errors by name.
    unit : str
        Their unit.
    label : str, optional
        What the magnitudes are.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
    """
    ax = current_axes(ax)
    for (name, values), colour in zip(errors.items(), CYCLE, strict=False):
        ax.plot(magnitude, values, '.', color=colour, markersize=3,
                label=name)
    ax.set(yscale='log', xlabel=label or 'magnitude [mag]',
           ylabel=f'stated error [{unit}]')
    ax.legend()
    return ax


def plot_error_curve(magnitude, residuals, errors, *, unit, n_bins=6, ax=None):
    """
    Plot errors against magnitude (as Figs. 9-10 of Nie et al.).

    Parameters
    ----------
    magnitude : (n,) array_like
        Magnitudes [mag].
    residuals, errors : (n,) or (n, 2) array_like
        Differences from the truth and their stated standard errors.
    unit : str
        Their unit, for the label.
    n_bins : int, optional
        The number of magnitude bins.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
    """
    ax = current_axes(ax)
    magnitude = np.asarray(magnitude, float)
    residuals = np.reshape(residuals, (len(magnitude), -1))
    errors = np.reshape(errors, (len(magnitude), -1))
    for column in residuals.T:
        ax.plot(magnitude, np.abs(column), '.', color=BLUE, alpha=0.25,
                markersize=3)
    edges = np.linspace(magnitude.min(), magnitude.max() + 1e-9, n_bins + 1)
    bins = np.digitize(magnitude, edges) - 1
    used = [i for i in range(n_bins) if (bins == i).sum() > 2]
    middle = [magnitude[bins == i].mean() for i in used]
    ax.plot(middle, [mad_std(residuals[bins == i]) for i in used], 'o-',
            color=ORANGE, label='scatter about the truth')
    ax.plot(middle, [np.median(errors[bins == i]) for i in used], 's--',
            color=BLACK, label='median stated error')
    ax.set(yscale='log', xlabel='magnitude [mag]', ylabel=f'error [{unit}]')
    ax.legend()
    return ax


def plot_comparison(true, measured, errors, *, label, unit, ax=None):
    """
    Plot measured values against true ones, with error bars.

    Parameters
    ----------
    true, measured, errors : (n,) array_like
        Values and standard errors.
    label, unit : str
        What they are, for the labels.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
    """
    ax = current_axes(ax)
    ax.errorbar(true, measured, errors, fmt='.', color=BLUE, ecolor=BLUE,
                alpha=0.5, elinewidth=0.7)
    limits = np.nanmin(true), np.nanmax(true)
    ax.plot(limits, limits, '-', color=BLACK, linewidth=0.8)
    ax.set(xlabel=f'true {label} [{unit}]',
           ylabel=f'measured {label} [{unit}]')
    return ax
