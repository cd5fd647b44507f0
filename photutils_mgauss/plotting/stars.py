"""Figures of measured stars."""
import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.plotting.style import (
    BLACK,
    BLUE,
    CYCLE,
    ORANGE,
    VERMILION,
    colour_bar,
    current_axes,
)

__all__ = [
    'plot_comparison',
    'plot_detections',
    'plot_error_curve',
    'plot_pulls',
    'plot_residual_image',
    'plot_stated_errors',
]

# Larger pulls are counted at the ends.
_MOST_PULL = 5.0

def plot_pulls(pulls, *, ax=None):
    """
    Show how numbers in their errors are distributed.

    Parameters
    ----------
    pulls : (n,) array_like
        Differences divided by their errors; NaN is left out.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes, with the normal distribution that right errors would give.
        Those beyond five errors are counted at the ends.

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> pulls = np.random.default_rng(1).normal(0, 1, 500)
    >>> ax = plotting.plot_pulls(pulls, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_legend_handles_labels()[1]
    ('residual / error', ['500, rms 0.91', 'right errors'])
    """
    ax = current_axes(ax)
    pulls = np.asarray(pulls, float)
    pulls = pulls[np.isfinite(pulls)]
    edges = np.linspace(-_MOST_PULL, _MOST_PULL, 41)
    rms = np.sqrt(np.mean(pulls**2)) if pulls.size else np.nan
    ax.hist(np.clip(pulls, -_MOST_PULL, _MOST_PULL), edges, color=BLUE,
            alpha=0.6, label=f'{len(pulls)}, rms {rms:.2f}')
    x = np.linspace(-_MOST_PULL, _MOST_PULL, 201)
    ax.plot(x, len(pulls) * (edges[1] - edges[0]) * np.exp(-x**2 / 2)
            / np.sqrt(2 * np.pi), color=BLACK, label='right errors')
    ax.set(xlabel='residual / error', ylabel='number')
    ax.legend()
    return ax


def plot_detections(x, y, flux, *, data=None, ax=None):
    """
    Map the stars of a catalogue, brighter ones larger.

    Parameters
    ----------
    x, y, flux : (n,) array_like
        Positions [pix] and fluxes.
    data : (ny, nx) array_like, optional
        The image, to be shown below circles about the stars.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> x, y, flux = rng.uniform(0, 100, (3, 30))
    >>> ax = plotting.plot_detections(x, y, flux, ax=Figure().add_subplot())
    >>> ax.get_title()
    '30 stars'
    """
    ax = current_axes(ax)
    flux = np.maximum(np.nan_to_num(flux), 1e-300)
    size = np.clip(np.log10(flux / np.percentile(flux, 5)), 0.1, 3)
    if data is None:
        ax.scatter(x, y, s=4 * size**2, color=BLACK, linewidths=0, alpha=0.7)
    else:
        _show_image(ax, np.asarray(data, float))
        ax.scatter(x, y, s=20 + 10 * size**2, facecolors='none',
                   edgecolors=VERMILION, linewidths=0.6)
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal',
           title=f'{len(flux)} stars')
    return ax


def _show_image(ax, data):
    """Show an image so that faint and bright stars are seen."""
    middle, spread = np.nanmedian(data), mad_std(data, ignore_nan=True)
    shown = np.arcsinh((data - middle) / max(3 * spread, 1e-300))
    ax.imshow(shown, origin='lower', cmap='gray_r', interpolation='nearest')


def plot_residual_image(residual, error, *, limit=5, ax=None):
    """
    Show what a model of the stars leaves of an image, in standard errors.

    Parameters
    ----------
    residual : (ny, nx) array_like
        Image minus model and sky; NaN is left out.
    error : (ny, nx) array_like
        The standard deviation of the pixels, in the unit of ``residual``.
    limit : float, optional
        The number of standard errors at the ends of the colours.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes, with a colour bar beside them.

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> residual, error = rng.normal(0, 2, (40, 50)), 2.0
    >>> ax = plotting.plot_residual_image(residual, error,
    ...                                   ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'y [pix]')
    """
    ax = current_axes(ax)
    shown = ax.imshow(np.asarray(residual) / np.asarray(error),
                      origin='lower', cmap='RdBu_r', vmin=-limit, vmax=limit,
                      interpolation='nearest')
    colour_bar(ax, shown, 'residual / error')
    ax.set(xlabel='x [pix]', ylabel='y [pix]')
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

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> magnitude = rng.uniform(18, 24, 50)
    >>> errors = {'x_err': 0.002 * 10**(0.2 * (magnitude - 18))}
    >>> ax = plotting.plot_stated_errors(magnitude, errors, unit='pix',
    ...                                  ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('magnitude [mag]', 'stated error [pix]')
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

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> magnitude = rng.uniform(18, 24, 500)
    >>> errors = 0.002 * 10**(0.2 * (magnitude - 18))
    >>> ax = plotting.plot_error_curve(
    ...     magnitude, rng.normal(0, errors), errors, unit='pix',
    ...     ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('magnitude [mag]', 'error [pix]')
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

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> true, errors = rng.normal(0, 5, 50), np.full(50, 0.3)
    >>> ax = plotting.plot_comparison(true, rng.normal(true, errors), errors,
    ...                               label='pmra', unit='mas / yr',
    ...                               ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('true pmra [mas / yr]', 'measured pmra [mas / yr]')
    """
    ax = current_axes(ax)
    ax.errorbar(true, measured, errors, fmt='.', color=BLUE, ecolor=BLUE,
                alpha=0.5, elinewidth=0.7)
    limits = np.nanmin(true), np.nanmax(true)
    ax.plot(limits, limits, '-', color=BLACK, linewidth=0.8)
    ax.set(xlabel=f'true {label} [{unit}]',
           ylabel=f'measured {label} [{unit}]')
    return ax
