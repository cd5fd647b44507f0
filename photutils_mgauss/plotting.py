"""
Figures, drawn on the Axes they are given.

Colours are those of Okabe and Ito, which the colour-blind can tell apart.
"""
import numpy as np
from astropy.stats import mad_std

from photutils_mgauss._plot_field import plot_field
from photutils_mgauss.shapes import adaptive_moments

__all__ = [
    'plot_comparison',
    'plot_comparison_of_numbers',
    'plot_detections',
    'plot_ellipses',
    'plot_error_curve',
    'plot_errors_by_epochs',
    'plot_field',
    'plot_model_graph',
    'plot_motion_errors',
    'plot_node_map',
    'plot_posterior',
    'plot_profile',
    'plot_projection',
    'plot_proper_motions',
    'plot_psf_image',
    'plot_residual',
    'plot_residual_vectors',
    'plot_shape_map',
    'plot_stated_errors',
    'plot_trace',
    'plot_whiskers',
    'plot_width_map',
    'plot_worst_node',
]

BLUE, ORANGE, GREEN, BLACK = '#0072B2', '#E69F00', '#009E73', '#000000'
_CYCLE = (BLUE, ORANGE, GREEN, '#CC79A7', '#D55E00', '#56B4E9', '#F0E442')
_NODE_LABELS = {
    'size_error': r'$\delta(R^2)/R^2$',
    'ellipticity_error': r'$\delta\epsilon$',
    'phase_error': 'pixel-phase error [pix]',
    'enclosed_flux': 'enclosed flux',
}


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


def plot_node_map(ax, psf, column='size_error', *, layout=None):
    r"""
    Map a column of the nodes' report (as Figs. 4-7 of Nie et al.).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    psf : GriddedMixturePSF or a dict of them
        One detector, or several by name.
    column : str, optional
        A numeric column of ``report``, such as ``'size_error'``,
        :math:`\delta(R^2)/R^2`, or ``'ellipticity_error'``,
        :math:`\delta\epsilon`.
    layout : dict of (x, y), optional
        Where the pixel (0, 0) of each detector is in the focal plane [pix];
        by default the detectors stand side by side.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same; its title tells median and scatter (1.4826 MAD) of the
        nodes that are not bridged.

    Raises
    ------
    ValueError
        If ``layout`` has no place for a detector.
    """
    psfs, places = _laid_out(psf, layout)
    reports = {name: one.report for name, one in psfs.items()}
    values = np.concatenate([np.where(report['bridged'], np.nan,
                                      report[column])
                             for report in reports.values()])
    good = values[np.isfinite(values)]
    limits = np.percentile(good, [2, 98]) if good.size else (0, 1)
    x, y = np.concatenate([
        [report['x'] + places[name][0], report['y'] + places[name][1]]
        for name, report in reports.items()], axis=1)
    points = ax.scatter(x, y, c=values, s=9, marker='s', cmap='cividis',
                        vmin=limits[0], vmax=limits[1], plotnonfinite=False)
    label = _NODE_LABELS.get(column, column)
    ax.figure.colorbar(points, ax=ax, label=label)
    if good.size:
        ax.set_title(f'{label}: median {np.median(good):.2g}, '
                     f'scatter {mad_std(good):.2g}')
    return _focal_plane(ax, psfs, places)


def plot_whiskers(ax, psf, *, layout=None, scale=None):
    """
    Plot the ellipticity of the nodes as whiskers along the long axis.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    psf : GriddedMixturePSF or a dict of them
        One detector, or several by name.
    layout : dict of (x, y), optional
        As in `plot_node_map`.
    scale : float, optional
        The length of a whisker of ellipticity 1 [pix]; by default the largest
        whisker is as long as half the distance of two nodes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    psfs, places = _laid_out(psf, layout)
    segments = []
    for name, one in psfs.items():
        shapes = adaptive_moments(one.mixtures)
        angle = 0.5 * np.arctan2(shapes.e2, shapes.e1)
        half = 0.5 * shapes.ellipticity[:, None] * np.column_stack(
            [np.cos(angle), np.sin(angle)])
        middle = one.grid_xypos + places[name]
        segments.append((middle, half))
    middle, half = (np.concatenate(part) for part in zip(*segments,
                                                         strict=True))
    if scale is None:
        scale = 0.25 * _node_distance(psfs) / max(np.hypot(*half.T).max(),
                                                  1e-12)
    ends = np.stack([middle - scale * half, middle + scale * half])
    ax.plot(*np.moveaxis(ends, -1, 0), color=BLUE, linewidth=1)
    return _focal_plane(ax, psfs, places)


def plot_worst_node(ax, psf, source, column='size_error'):
    """
    Show the residual of the node with the largest error.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    psf : GriddedMixturePSF
        The grid of mixtures.
    source : `~photutils.psf.GriddedPSFModel`
        The ePSFs it was made of.
    column : str, optional
        The column of ``report`` that is the error.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same, with ePSF minus mixture in per cent of the ePSF's peak.
    """
    report = psf.report
    error = np.where(report['bridged'], 0, np.abs(report[column]))
    worst = int(np.nanargmax(error))
    distance = np.hypot(*(np.array(source.grid_xypos, float)
                          - psf.grid_xypos[worst]).T)
    image = np.asarray(source.data[distance.argmin()], float)
    oversampling = np.broadcast_to(source.oversampling, 2)
    y, x = ((np.arange(n) - (n - 1) / 2) / step
            for n, step in zip(image.shape, oversampling, strict=True))
    model = psf.scales[worst] * psf.mixtures[worst].evaluate(x, y[:, None])
    residual = 100 * (image - model) / image.max()
    limit = np.abs(residual[2:-2, 2:-2]).max()
    picture = ax.imshow(residual, origin='lower', cmap='RdBu_r', vmin=-limit,
                        vmax=limit, extent=(x[0], x[-1], y[0], y[-1]))
    ax.figure.colorbar(picture, ax=ax, label='residual [% of the peak]')
    place = psf.grid_xypos[worst]
    ax.set(xlabel='x [pix]', ylabel='y [pix]', title=(
        f'node ({place[0]:.0f}, {place[1]:.0f}), '
        f'{_NODE_LABELS.get(column, column)} = {report[column][worst]:.2g}'))
    return ax


def _laid_out(psf, layout):
    """Return dicts of grids and of their places in the focal plane."""
    psfs = dict(psf) if hasattr(psf, 'items') else {'': psf}
    if layout is None:
        widths = [np.ptp(one.grid_xypos[:, 0]) + 2 * _node_distance({'': one})
                  for one in psfs.values()]
        left = np.cumsum([0, *widths[:-1]])
        return psfs, {name: (x, 0) for name, x in zip(psfs, left,
                                                      strict=True)}
    missing = [name for name in psfs if name not in layout]
    if missing:
        words = ', '.join(map(repr, missing))
        msg = ('layout must have a place for every detector, got none for '
               f'{words}')
        raise ValueError(msg)
    return psfs, layout


def _node_distance(psfs):
    """Return the smallest distance of two lines of nodes [pix]."""
    steps = [np.diff(np.unique(one.grid_xypos[:, axis]))
             for one in psfs.values() for axis in (0, 1)]
    steps = np.concatenate(steps)
    return steps[steps > 1].min(initial=1e9) if (steps > 1).any() else 1.0


def _focal_plane(ax, psfs, places):
    """Outline the detectors and label the axes."""
    for name, one in psfs.items():
        low, high = (getattr(one.grid_xypos + places[name], side)(axis=0)
                     for side in ('min', 'max'))
        ax.plot([low[0], high[0], high[0], low[0], low[0]],
                [low[1], low[1], high[1], high[1], low[1]], color=BLACK,
                linewidth=0.5)
        if name:
            ax.annotate(name, (low + high) / 2, ha='center', va='center')
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal')
    return ax


def plot_projection(ax, fit, image, *, axis='x', oversampling=1):
    """
    Plot an image, its fit and each Gaussian summed along one axis (Fig. 3a).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    fit : MixtureFit
        The fit.
    image : (ny, nx) array_like
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
    image = np.asarray(image, float)
    step = np.broadcast_to(oversampling, 2)[::-1][0 if axis == 'x' else 1]
    along = 0 if axis == 'x' else 1
    data = image.sum(axis=along)
    position = (np.arange(data.size) - (data.size - 1) / 2) / step
    fine = np.linspace(position[0], position[-1], 10 * data.size)
    across = np.broadcast_to(oversampling, 2)[::-1][1 if axis == 'x' else 0]
    i = 0 if axis == 'x' else 1
    total = np.zeros_like(fine)
    mixture = fit.mixture
    for k in range(mixture.n_components):
        stddev = mixture.stddevs[k, i]
        curve = (fit.flux * across * mixture.weights[k]
                 / (np.sqrt(2 * np.pi) * stddev)
                 * np.exp(-0.5 * ((fine - mixture.means[k, i]) / stddev)**2))
        total += curve
        ax.plot(fine, curve, color=_CYCLE[k % len(_CYCLE)],
                label=f'{mixture.weights[k]:.1%}')
    ax.plot(fine, total, color=_CYCLE[4], linewidth=2.5, alpha=0.6,
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
    image : (ny, nx) array_like
        The image that was fitted.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    image = np.asarray(image, float)
    row, _ = np.unravel_index(np.nanargmax(np.where(fit.used, image, -np.inf)),
                              image.shape)
    peak = image[row].max()
    lines = {'image': (image[row], BLACK, '.'),
             'mixture': ((image - fit.residual)[row], _CYCLE[4], '-'),
             'residual, absolute': (np.abs(fit.residual[row]), BLUE, ':')}
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

    One panel of the figure in Appendix B; `compare_n_components` gives the
    fits and their times.

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
    values = np.where(fit.used, fit.residual, np.nan) / peak
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
    image : (ny, nx) array_like
        The image.
    table : `~astropy.table.QTable`
        From `compare_n_components`.

    Returns
    -------
    sequence of `~matplotlib.axes.Axes`
        The same.
    """
    image = np.asarray(image, float)
    axes = np.ravel(axes)
    if len(axes) != len(table) + 1:
        msg = (f'axes must be one more than the {len(table)} rows of the '
               f'table, got {len(axes)}')
        raise ValueError(msg)
    axes[0].imshow(image, origin='lower', cmap='viridis')
    axes[0].set(xticks=[], yticks=[], title='image')
    limit = max(table['max_residual'])
    for ax, row, fit in zip(axes[1:], table, table.meta['fits'], strict=True):
        plot_residual(ax, fit, peak=image.max(), limit=limit,
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
        colour = _CYCLE[k % len(_CYCLE)]
        ax.plot(x, y, color=colour, label=f'{mixture.weights[k]:.1%}')
        ax.plot(*mixture.means[k], '+', color=colour)
    ax.set(aspect='equal', xlabel='x [pix]', ylabel='y [pix]')
    ax.legend()
    return ax


def plot_posterior(ax, posterior, name):
    """
    Plot the histogram of one quantity's draws (Appendix A, left).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    posterior : MixturePosterior
        The draws.
    name : str
        ``'omega'``, ``'alpha'``, ``'beta'``, ``'gamma'``, ``'flux'`` or
        ``'sigma'``; every number in it has a curve.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    for label, draws in _named_draws(posterior, name):
        density, edges = np.histogram(draws, bins=40, density=True)
        ax.stairs(density, edges, label=label)
    ax.set(xlabel=name, ylabel='density')
    ax.legend()
    return ax


def plot_trace(ax, posterior, name):
    """
    Plot the draws of one quantity one after the other (Appendix A, right).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    posterior : MixturePosterior
        The draws.
    name : str
        See `plot_posterior`. Chains are drawn over each other.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    for i, (label, draws) in enumerate(_named_draws(posterior, name)):
        for c, chain in enumerate(draws):
            ax.plot(chain, color=_CYCLE[i % len(_CYCLE)], linewidth=0.4,
                    alpha=0.7, label=label if c == 0 else None)
    ax.set(xlabel='draw', ylabel=name)
    ax.legend()
    return ax


def _named_draws(posterior, name):
    """Return (label, draws) of all parameters that a name covers."""
    chosen = [(label, draws) for label, draws in
              posterior.parameters().items()
              if label == name or label.startswith(f'{name}_')]
    if not chosen:
        msg = ("name must be one of 'omega', 'alpha', 'beta', 'gamma', "
               f"'flux', 'sigma', got {name!r}")
        raise ValueError(msg)
    return chosen


def plot_model_graph(ax, n_components, shape):
    """
    Draw the graph of the Bayesian model (Fig. 2).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    n_components : int
        The number K of Gaussians.
    shape : (ny, nx) tuple of int
        The shape of the image.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    k = n_components
    nodes = {'sigma': ('HalfNormal', '1'), 'omega': ('Dirichlet', f'{k}'),
             'alpha': ('Normal', f'{k} x 2'),
             'beta': ('HalfNormal', f'{k} x 2'),
             'gamma': ('TruncatedNormal', f'{k}')}
    ellipse = {'boxstyle': 'round,pad=0.6', 'facecolor': 'white'}
    end = (0.5, 0.15)
    for i, (name, (prior, size)) in enumerate(nodes.items()):
        x = 0.1 + 0.2 * i
        ax.annotate('', end, (x, 0.75), arrowprops={
            'arrowstyle': '->', 'shrinkA': 22, 'shrinkB': 22})
        ax.text(x, 0.75, f'{name}\n{prior}\n{size}', ha='center',
                va='center', bbox=ellipse)
    ax.text(*end, f'image\nNormal\n{shape[0]} x {shape[1]}', ha='center',
            va='center', bbox={**ellipse, 'facecolor': '0.85'})
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.set_axis_off()
    return ax


def plot_shape_map(ax, x, y, values, *, label):
    """
    Show a quantity at points of the detector, its mean and scatter on top.

    As Figs. 4 to 7, for the deviations that
    `Shapes.relative_size_error` and `Shapes.ellipticity_error` return.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    x, y : (n,) array_like
        Positions on the detector [pix].
    values : (n,) array_like
        The deviations; NaN is left out.
    label : str
        What they are.

    Returns
    -------
    `~matplotlib.collections.PathCollection`
        To make a colour bar from.
    """
    values = np.asarray(values, float)
    limit = np.nanmax(np.abs(values))
    shown = ax.scatter(x, y, c=values, cmap='RdBu_r', vmin=-limit, vmax=limit,
                       marker='s')
    ax.set(aspect='equal', xlabel='x [pix]', ylabel='y [pix]')
    ax.set_title(f'{label}: {np.nanmean(values):+.2e} '
                 f'$\\pm$ {np.nanstd(values):.1e}')
    return shown


# Epochs and proper motions.

def plot_residual_vectors(ax, solution, epoch, *, scale=None):
    """
    Draw the residuals of one epoch's references and stars as arrows.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    solution : `~photutils_mgauss.MotionSolution`
        Whose residuals.
    epoch : int
        Number of the epoch, from 0.
    scale : float, optional
        Residual [mas] as long as a tenth of the field; the default is three
        times the median residual.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same; rejected detections are orange.
    """
    rows = solution.residuals[solution.residuals['epoch'] == epoch]
    x, y = _field_coordinates(rows)
    u, v = rows['dra'].value, rows['ddec'].value
    good = np.isfinite(x + y + u + v)
    if scale is None:
        scale = 3 * np.median(np.hypot(u[good], v[good]))
    width = np.ptp(x[good]) / 10
    used = np.asarray(rows['used'])
    for which, colour in ((good & used, BLUE), (good & ~used, ORANGE)):
        ax.quiver(x[which], y[which], u[which], v[which], color=colour,
                  angles='xy', scale_units='xy', scale=scale / width)
    ax.set(xlabel='east [arcsec]', ylabel='north [arcsec]', aspect='equal',
           title=f'epoch {epoch}: a tenth of the field is {scale:.2g} '
                 f'{rows["dra"].unit}')
    ax.invert_xaxis()
    return ax


def _field_coordinates(rows):
    """Return positions relative to their middle, east and north."""
    if 'x' in rows.colnames:
        return rows['x'].value, rows['y'].value
    ra, dec = rows['ra'].value, rows['dec'].value
    middle = np.nanmedian(dec)
    # Wrapped about one of the stars: right ascension has a seam.
    start = ra[np.flatnonzero(np.isfinite(ra))[0]]
    away = (ra - start + 180) % 360 - 180
    away -= np.nanmedian(away)
    return (3600 * away * np.cos(np.radians(middle)),
            3600 * (dec - middle))


def plot_proper_motions(ax, stars):
    """
    Plot the proper-motion diagram of a table of stars.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    stars : `~astropy.table.QTable`
        As `~photutils_mgauss.MotionSolution.stars`.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same; reference objects are orange.
    """
    # A file gives the empty words of stars back as missing ones.
    reference = np.ma.filled(stars['reference'], '') != ''
    for which, colour, label in ((~reference, BLUE, 'stars'),
                                 (reference, ORANGE, 'references')):
        some = stars[which]
        ax.errorbar(some['pmra'].value, some['pmdec'].value,
                    some['pmdec_error'].value, some['pmra_error'].value,
                    fmt='.', color=colour, alpha=0.5, elinewidth=0.5,
                    markersize=3, label=label)
    unit = stars['pmra'].unit
    ax.set(xlabel=rf'$\mu_{{\alpha*}}$ [{unit}]',
           ylabel=rf'$\mu_\delta$ [{unit}]', aspect='equal')
    ax.invert_xaxis()
    ax.legend()
    return ax


def plot_motion_errors(ax, stars, magnitude):
    """
    Plot errors of motions against magnitude (as Fig. 12 of Nie et al.).

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    stars : `~astropy.table.QTable`
        As `~photutils_mgauss.MotionSolution.stars`.
    magnitude : (n,) array_like
        A magnitude for each.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        ax.plot(magnitude, stars[f'{name}_error'].value, '.', color=colour,
                markersize=3, label=name)
    ax.set(yscale='log', xlabel='magnitude [mag]',
           ylabel=f'error [{stars["pmra"].unit}]')
    ax.legend()
    return ax


def plot_errors_by_epochs(ax, solutions):
    """
    Plot the median error of motions against the number of epochs.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    solutions : sequence of `~photutils_mgauss.MotionSolution`
        Fits to different numbers of epochs (as Fig. 11 of Nie et al.).

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    counts = [len(solution.epochs) for solution in solutions]
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        medians = [np.nanmedian(solution.stars[f'{name}_error'].value)
                   for solution in solutions]
        ax.plot(counts, medians, 'o-', color=colour, label=name)
    unit = solutions[0].stars['pmra'].unit
    ax.set(xlabel='number of epochs', ylabel=f'median error [{unit}]')
    ax.legend()
    return ax


# What a run of the command line made.

def plot_psf_image(ax, psf, x, y, *, radius=8, decades=4):
    """
    Show the PSF at a place, in logarithms.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    psf : GriddedMixturePSF
        The PSF.
    x, y : float
        The place on the detector [pix].
    radius : float, optional
        Half the width of the image [pix].
    decades : float, optional
        How many powers of ten below the peak are shown.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    points = np.linspace(-radius, radius, 161)
    image = psf.mixture_at(x, y).evaluate(
        points, points[:, None], pixel_integrated=psf.pixel_integrated)
    peak = image.max()
    shown = ax.imshow(
        np.log10(np.maximum(image / peak, 10.0 ** -decades)), origin='lower',
        cmap='cividis', extent=(-radius, radius, -radius, radius))
    ax.figure.colorbar(shown, ax=ax, label='log of value / peak')
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal',
           title=f'the PSF at ({x:.0f}, {y:.0f})')
    return ax


def plot_width_map(ax, psf, *, stars=None):
    r"""
    Map the width of the nodes' PSFs, :math:`2.35 \sqrt{R^2 / 2}`.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    psf : GriddedMixturePSF
        The PSF.
    stars : (n, 2) array_like, optional
        Positions of the stars it was made of, to be marked [pix].

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    fwhm = 2.3548 * np.sqrt(adaptive_moments(psf.mixtures).r2 / 2)
    x, y = psf.grid_xypos.T
    points = ax.scatter(x, y, c=fwhm, s=12, marker='s', cmap='cividis')
    ax.figure.colorbar(points, ax=ax, label='FWHM [pix]')
    if stars is not None and len(stars):
        ax.plot(*np.transpose(stars), 'o', color=ORANGE, fillstyle='none',
                markersize=6)
    ax.set_title(f'FWHM: median {np.median(fwhm):.3f}, '
                 f'range {np.ptp(fwhm):.2g} pix')
    return _focal_plane(ax, {'': psf}, {'': (0, 0)})


def plot_detections(ax, x, y, flux):
    """
    Map the stars of a catalogue, brighter ones larger.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    x, y, flux : (n,) array_like
        Positions [pix] and fluxes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    flux = np.maximum(np.nan_to_num(flux), 1e-300)
    size = np.clip(np.log10(flux / np.percentile(flux, 5)), 0.1, 3)
    ax.scatter(x, y, s=4 * size**2, color=BLACK, linewidths=0, alpha=0.7)
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal',
           title=f'{len(flux)} stars')
    return ax


def plot_stated_errors(ax, magnitude, errors, *, unit, label=None):
    """
    Plot the stated errors of stars against their magnitudes.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Where to draw.
    magnitude : (n,) array_like
        Magnitudes [mag].
    errors : dict of (n,) array_like
        One or several errors by name.
    unit : str
        Their unit.
    label : str, optional
        What the magnitudes are.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same.
    """
    for (name, values), colour in zip(errors.items(), _CYCLE, strict=False):
        ax.plot(magnitude, values, '.', color=colour, markersize=3,
                label=name)
    ax.set(yscale='log', xlabel=label or 'magnitude [mag]',
           ylabel=f'stated error [{unit}]')
    ax.legend()
    return ax
