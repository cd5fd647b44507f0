"""
Figures, drawn on the Axes they are given.

Colours are those of Okabe and Ito, which the colour-blind can tell apart.
"""
import numpy as np
from astropy.stats import mad_std

__all__ = ['plot_comparison', 'plot_error_curve']

BLUE, ORANGE, GREEN, BLACK = '#0072B2', '#E69F00', '#009E73', '#000000'


def plot_error_curve(ax, magnitude, residuals, errors, *, unit, n_bins=6):
    """
    Plot errors against magnitude (as Figs. 9-10 of Nie et al.).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    magnitude : (n,) array_like
        Magnitudes [mag].
    residuals, errors : (n,) or (n, 2) array_like
        Differences from the truth and their stated standard errors.
    unit : str
        Their unit, for the label.
    n_bins : int, optional
        The number of magnitude bins.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
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


def plot_comparison(ax, true, measured, errors, *, label, unit):
    """
    Plot measured values against true ones, with error bars.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    true, measured, errors : (n,) array_like
        Values and standard errors.
    label, unit : str
        What they are, for the labels.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    ax.errorbar(true, measured, errors, fmt='.', color=BLUE, ecolor=BLUE,
                alpha=0.5, elinewidth=0.7)
    limits = np.nanmin(true), np.nanmax(true)
    ax.plot(limits, limits, '-', color=BLACK, linewidth=0.8)
    ax.set(xlabel=f'true {label} [{unit}]',
           ylabel=f'measured {label} [{unit}]')
    return ax
