"""Figures of PSF fields."""
import numpy as np

from photutils_mgauss.plotting.style import (
    VERMILION,
    colour_bar,
    current_axes,
)
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.validation import as_choice, as_integer


def plot_field(field, quantity='size', *, n=20, ax=None):
    """
    Draw how a PSF field varies over the detector, and its stars.

    Parameters
    ----------
    field : MixtureField or TunedMixtureField
    quantity : {'size', 'ellipticity', 'residual'}, optional
        A map of R^2; whiskers along the major axes, as long as the
        ellipticity; or what is left of the stars on average, in shares of
        their flux, which shows what the Gaussians cannot describe.
    n : int, optional
        The number of places along the longer side of the detector.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; maps and images have a colour bar beside them.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import GaussianMixture, fit_mixture_field
    >>> from photutils_mgauss.plotting import plot_field
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> stars = Table({'x': [12.3, 40.1], 'y': [14.6, 33.9]})
    >>> data = sum(psf.render((50, 55), x, y, flux=1000) for x, y in stars)
    >>> field = fit_mixture_field(data, stars, error=np.ones((50, 55)),
    ...                           n_components=1, degree=0)
    >>> ax = plot_field(field, n=5, ax=Figure().add_subplot())
    >>> ax.get_title()
    '$R^2$ [pix$^2$]'
    """
    ax = current_axes(ax)
    quantity = as_choice(quantity, 'quantity',
                         ('size', 'ellipticity', 'residual'))
    if quantity == 'residual':
        return _plot_mean_residual(ax, field)
    n = as_integer(n, 'n', minimum=2)
    ny, nx = field.shape
    step = max(ny, nx) / n
    x, y = (step * (np.arange(max(round(size / step), 1)) + 0.5) - 0.5
            for size in (nx, ny))
    shapes = adaptive_moments([field.mixture_at(a, b) for b in y for a in x])
    draw = _plot_sizes if quantity == 'size' else _plot_whiskers
    draw(ax, x, y, shapes)
    _mark_stars(ax, field.stars)
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal',
           xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5))
    return ax


def _plot_sizes(ax, x, y, shapes):
    ax.set_title('$R^2$ [pix$^2$]')
    shown = ax.pcolormesh(x, y, np.reshape(shapes.r2, (y.size, x.size)),
                          shading='nearest', cmap='viridis')
    colour_bar(ax, shown)


def _plot_whiskers(ax, x, y, shapes):
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    angle = 0.5 * np.arctan2(shapes.e2, shapes.e1)
    length = np.hypot(shapes.e1, shapes.e2)
    ax.set_title(f'ellipticity, at most {length.max():.3f}')
    ax.quiver(x, y, length * np.cos(angle), length * np.sin(angle),
              angles='xy', pivot='mid', headwidth=0, headlength=0,
              headaxislength=0)


def _mark_stars(ax, stars):
    used = np.asarray(stars['used'])
    ax.scatter(stars['x'][used], stars['y'][used], s=12, marker='o',
               facecolors='none', edgecolors='k', linewidths=0.7,
               label='used')
    ax.scatter(stars['x'][~used], stars['y'][~used], s=12, marker='x',
               color=VERMILION, linewidths=0.7, label='dropped')


def _plot_mean_residual(ax, field):
    stars = field.stars
    flux = np.asarray(stars['flux_fit'])[:, None, None]
    used = np.isfinite(field.residual_stars) & np.asarray(
        stars['used'])[:, None, None]
    residual = np.where(used, field.residual_stars, 0).sum(axis=0)
    light = np.where(used, flux, 0).sum(axis=0)
    mean = np.divide(residual, light, where=light > 0,
                     out=np.full(residual.shape, np.nan))
    half = len(mean) // 2
    limit = np.nanmax(np.abs(mean))
    ax.set(title='mean residual [flux / pix]', xlabel='x [pix]',
           ylabel='y [pix]')
    shown = ax.imshow(mean, origin='lower', cmap='RdBu', vmin=-limit,
                      vmax=limit, extent=[-half - 0.5, half + 0.5] * 2)
    colour_bar(ax, shown)
    return ax
