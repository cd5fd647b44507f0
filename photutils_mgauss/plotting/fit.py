"""Figures of a mixture and of the image it was fitted to."""
import numpy as np

from photutils_mgauss.plotting.style import (
    BLACK,
    BLUE,
    CYCLE,
    VERMILION,
    colour_bar,
    current_axes,
)
from photutils_mgauss.utils.image import read_quantity

__all__ = [
    'plot_comparison_of_numbers',
    'plot_ellipses',
    'plot_mixture',
    'plot_profile',
    'plot_projection',
    'plot_residual',
]


def plot_projection(fit, image, *, axis='x', oversampling=1, ax=None):
    """
    Plot an image, its fit and each Gaussian summed along one axis (Fig. 3a).

    Parameters
    ----------
    fit : MixtureFit
        The fit.
    image : (ny, nx) array_like or NDData
        The image that was fitted.
    axis : {'x', 'y'}, optional
        The axis that stays.
    oversampling : int or (y, x) tuple of int, optional
        Image pixels per native pixel.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, fit_mixture, plotting
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> image = psf.render((15, 15), 7, 7)
    >>> fit = fit_mixture(image, 1)
    >>> ax = plotting.plot_projection(fit, image, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'projected flux density')
    """
    ax = current_axes(ax)
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


def plot_profile(fit, image, *, ax=None):
    """
    Plot the brightest row of image, model and residual in logarithms.

    As Fig. 3b. Pixels that are not positive have no logarithm and are left
    out.

    Parameters
    ----------
    fit : MixtureFit
        The fit.
    image : (ny, nx) array_like or NDData
        The image that was fitted.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, fit_mixture, plotting
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> image = psf.render((15, 15), 7, 7)
    >>> fit = fit_mixture(image, 1)
    >>> ax = plotting.plot_profile(fit, image, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [image pixel]', 'flux density / peak')
    """
    ax = current_axes(ax)
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
    # Above the peak, because the wings take up the sides: the upper third of
    # the decades is for it.
    bottom = min(ax.get_ylim()[0], 0.1)
    ax.set_ylim(bottom, bottom**-0.5)
    ax.legend(loc='upper center', ncols=3, handlelength=1, columnspacing=1)
    return ax


def plot_residual(fit, *, peak=None, limit=None, label=None, ax=None):
    """
    Show the residual image of a fit, as a fraction of the image's peak.

    One panel of the figure in Appendix B;
    `~photutils_mgauss.compare_n_components` gives the fits and their times.

    Parameters
    ----------
    fit : MixtureFit
        The fit.
    peak : float, optional
        The peak of the image; None is the peak of the model.
    limit : float, optional
        The fraction at the ends of the colours; None is the largest residual.
        Give several panels the same.
    label : str, optional
        A title, such as the number of Gaussians and the time.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes, with a colour bar beside them.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, fit_mixture, plotting
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> image = psf.render((15, 15), 7, 7)
    >>> fit = fit_mixture(image, 1)
    >>> ax = plotting.plot_residual(fit, ax=Figure().add_subplot())
    >>> len(ax.images)
    1
    """
    ax = current_axes(ax)
    shown = _draw_residual(ax, fit, peak, limit, label)
    colour_bar(ax, shown, 'residual / peak')
    return ax


def _draw_residual(ax, fit, peak, limit, label):
    """Draw a residual image and return it, without a colour bar."""
    if peak is None:
        peak = np.asarray(fit.flux) * fit.mixture.evaluate(
            *fit.mixture.means.T).max()
    values = np.where(fit.used, fit.residual, np.nan) / np.asarray(peak)
    limit = np.nanmax(np.abs(values)) if limit is None else limit
    ax.set(xticks=[], yticks=[])
    ax.set_title(label or f'K = {fit.mixture.n_components}')
    return ax.imshow(values, origin='lower', cmap='RdBu_r', vmin=-limit,
                     vmax=limit)


def plot_comparison_of_numbers(image, table, *, axes=None):
    """
    Show image and residuals for several numbers of Gaussians (Appendix B).

    Parameters
    ----------
    image : (ny, nx) array_like or NDData
        The image.
    table : `~astropy.table.QTable`
        From `~photutils_mgauss.compare_n_components`.
    axes : sequence of `~matplotlib.axes.Axes`, optional
        One more than the table has rows; None makes a figure for them.

    Returns
    -------
    `~numpy.ndarray` of `~matplotlib.axes.Axes`

    Raises
    ------
    ValueError
        If there are more or fewer Axes than that.

    Examples
    --------
    >>> from photutils_mgauss import (
    ...     GaussianMixture, compare_n_components, plotting)
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> image = psf.render((15, 15), 7, 7)
    >>> table = compare_n_components(image, (1, 2))
    >>> axes = plotting.plot_comparison_of_numbers(image, table)
    >>> axes.shape
    (3,)
    """
    image, _ = read_quantity(image, 'image')
    if axes is None:
        import matplotlib.pyplot as plt
        n = len(table) + 1
        axes = plt.subplots(1, n, figsize=(2.4 * n, 2.6))[1]
    axes = np.ravel(axes)
    if len(axes) != len(table) + 1:
        msg = (f'axes must be one more than the {len(table)} rows of the '
               f'table, got {len(axes)}')
        raise ValueError(msg)
    axes[0].imshow(image, origin='lower', cmap='viridis')
    axes[0].set(xticks=[], yticks=[], title='image')
    limit = max(table['max_residual'])
    for ax, row, fit in zip(axes[1:], table, table.meta['fits'], strict=True):
        shown = _draw_residual(ax, fit, np.nanmax(image), limit,
                               f"K = {row['n_components']}, largest "
                               f"{row['max_residual']:.1%}")
    axes[0].figure.colorbar(shown, ax=list(axes), label='residual / peak')
    return axes


def plot_mixture(mixture, *, radius=None, decades=4, pixel_integrated=False,
                 ax=None):
    """
    Show a mixture on a logarithmic scale.

    Parameters
    ----------
    mixture : GaussianMixture
        The mixture.
    radius : float, optional
        Half the width of the image [pix]; None is four times the root of the
        mean variance of the light.
    decades : float, optional
        How many powers of ten below the peak are shown.
    pixel_integrated : bool, optional
        Whether to integrate the mixture over pixels.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes, with a colour bar beside them.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, plotting
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> ax = plotting.plot_mixture(psf, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'y [pix]')
    """
    ax = current_axes(ax)
    if radius is None:
        radius = 4 * np.sqrt(max(np.trace(mixture.moments().covariance), 0.5)
                             / 2)
    points = np.linspace(-radius, radius, 161)
    image = mixture.evaluate(points, points[:, None],
                             pixel_integrated=pixel_integrated)
    shown = ax.imshow(
        np.log10(np.maximum(image / image.max(), 10.0 ** -decades)),
        origin='lower', cmap='cividis', extent=(-radius, radius) * 2)
    colour_bar(ax, shown, 'log of value / peak')
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal')
    return ax


def plot_ellipses(mixture, *, n_sigma=1, ax=None):
    """
    Draw the contour of each Gaussian of a mixture.

    Parameters
    ----------
    mixture : GaussianMixture
        The mixture.
    n_sigma : float, optional
        How many standard deviations out.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, plotting
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> ax = plotting.plot_ellipses(psf, ax=Figure().add_subplot())
    >>> len(ax.lines)
    2
    """
    ax = current_axes(ax)
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
