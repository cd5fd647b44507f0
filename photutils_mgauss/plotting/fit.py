"""Figures of a mixture and of the image it was fitted to, on given Axes."""
import numpy as np

from photutils_mgauss.plotting.style import BLACK, BLUE, CYCLE, VERMILION
from photutils_mgauss.utils.image import read_quantity

__all__ = [
    'plot_comparison_of_numbers',
    'plot_ellipses',
    'plot_profile',
    'plot_projection',
    'plot_residual',
]


def plot_projection(ax, fit, image, *, axis='x', oversampling=1):
    """
    Plot an image, its fit and each Gaussian summed along one axis (Fig. 3a).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    fit : MixtureFit
        The fit.
    image : (ny, nx) array_like or NDData
        The image that was fitted.
    axis : {'x', 'y'}, optional
        The axis that stays.
    oversampling : int or (y, x) tuple of int, optional
        Image pixels per native pixel.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    image, _ = read_quantity(image, 'image')
    step = np.broadcast_to(oversampling, 2)[::-1][0 if axis == 'x' else 1]
    along = 0 if axis == 'x' else 1
    data = image.sum(axis=along)
    position = (np.arange(data.size) - (data.size - 1) / 2) / step
    fine = np.linspace(position[0], position[-1], 10 * data.size)
    across = np.broadcast_to(oversampling, 2)[::-1][1 if axis == 'x' else 0]
    i = 0 if axis == 'x' else 1
    total = np.zeros_like(fine)
    mixture, flux = fit.mixture, np.asarray(fit.flux)
    for k in range(mixture.n_components):
        stddev = mixture.stddevs[k, i]
        curve = (flux * across * mixture.weights[k]
                 / (np.sqrt(2 * np.pi) * stddev)
                 * np.exp(-0.5 * ((fine - mixture.means[k, i]) / stddev)**2))
        total += curve
        ax.plot(fine, curve, color=CYCLE[k % len(CYCLE)],
                label=f'{mixture.weights[k]:.1%}')
    ax.plot(fine, total, color=VERMILION, linewidth=2.5, alpha=0.6,
            label='mixture')
    ax.plot(position, data, '.', color=BLACK, label='image')
    ax.set(xlabel=f'{axis} [pix]', ylabel='projected flux density')
    ax.legend()
    return ax


def plot_profile(ax, fit, image):
    """
    Plot the brightest row of image, model and residual in logarithms.

    As Fig. 3b. Pixels that are not positive have no logarithm and are left
    out.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    fit : MixtureFit
        The fit.
    image : (ny, nx) array_like or NDData
        The image that was fitted.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    image, _ = read_quantity(image, 'image')
    row, _ = np.unravel_index(np.nanargmax(np.where(fit.used, image, -np.inf)),
                              image.shape)
    peak = np.nanmax(image[row])
    residual = np.asarray(fit.residual)
    lines = {'image': (image[row], BLACK, '.'),
             'mixture': ((image - residual)[row], VERMILION, '-'),
             'residual, absolute': (np.abs(residual[row]), BLUE, ':')}
    for name, (values, colour, style) in lines.items():
        shown = np.where(values > 0, values / peak, np.nan)
        ax.plot(shown, style, color=colour, label=name)
    ax.set(yscale='log', xlabel='x [image pixel]',
           ylabel='flux density / peak')
    ax.legend()
    return ax


def plot_residual(ax, fit, *, peak, limit=None, label=None):
    """
    Show the residual image of a fit, as a fraction of the image's peak.

    One panel of the figure in Appendix B;
    `~photutils_mgauss.compare_n_components` gives the fits and their times.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    fit : MixtureFit
        The fit.
    peak : float
        The peak of the image.
    limit : float, optional
        The fraction at the ends of the colours; None is the largest residual.
        Give several panels the same.
    label : str, optional
        A title, such as the number of Gaussians and the time.

    Returns
    -------
    `~matplotlib.image.AxesImage`
        To make a colour bar from.
    """
    residual, peak = np.asarray(fit.residual), np.asarray(peak)
    values = np.where(fit.used, residual, np.nan) / peak
    limit = np.nanmax(np.abs(values)) if limit is None else limit
    shown = ax.imshow(values, origin='lower', cmap='RdBu_r', vmin=-limit,
                      vmax=limit)
    ax.set(xticks=[], yticks=[])
    ax.set_title(label or f'K = {fit.mixture.n_components}')
    return shown


def plot_comparison_of_numbers(axes, image, table):
    """
    Show image and residuals for several numbers of Gaussians (Appendix B).

    Parameters
    ----------
    axes : sequence of `~matplotlib.axes.Axes`
        One more than the table has rows.
    image : (ny, nx) array_like or NDData
        The image.
    table : `~astropy.table.QTable`
        From `~photutils_mgauss.compare_n_components`.

    Returns
    -------
    sequence of `~matplotlib.axes.Axes`
        The same.
    """
    image, _ = read_quantity(image, 'image')
    axes = np.ravel(axes)
    if len(axes) != len(table) + 1:
        msg = (f'axes must be one more than the {len(table)} rows of the '
               f'table, got {len(axes)}')
        raise ValueError(msg)
    axes[0].imshow(image, origin='lower', cmap='viridis')
    axes[0].set(xticks=[], yticks=[], title='image')
    limit = max(table['max_residual'])
    for ax, row, fit in zip(axes[1:], table, table.meta['fits'], strict=True):
        plot_residual(ax, fit, peak=np.nanmax(image), limit=limit,
                      label=f"K = {row['n_components']}, "
                            f"{1e3 * row['time']:.1f} ms")
    return axes


def plot_ellipses(ax, mixture, *, n_sigma=1):
    """
    Draw the contour of each Gaussian of a mixture.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    mixture : GaussianMixture
        The mixture.
    n_sigma : float, optional
        How many standard deviations out.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    angle = np.linspace(0, 2 * np.pi, 100)
    circle = np.array([np.cos(angle), np.sin(angle)])
    for k in range(mixture.n_components):
        root = np.linalg.cholesky(mixture.covariances[k])
        x, y = mixture.means[k][:, None] + n_sigma * root @ circle
        colour = CYCLE[k % len(CYCLE)]
        ax.plot(x, y, color=colour, label=f'{mixture.weights[k]:.1%}')
        ax.plot(*mixture.means[k], '+', color=colour)
    ax.set(aspect='equal', xlabel='x [pix]', ylabel='y [pix]')
    ax.legend()
    return ax
