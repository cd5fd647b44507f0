"""
Figures, drawn on the Axes they are given.

Colours are those of Okabe and Ito, which the colour-blind can tell apart.
"""
import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.shapes import adaptive_moments

__all__ = [
    'plot_comparison',
    'plot_error_curve',
    'plot_errors_by_epochs',
    'plot_motion_errors',
    'plot_node_map',
    'plot_proper_motions',
    'plot_residual_vectors',
    'plot_whiskers',
    'plot_worst_node',
]

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


# Grids of mixtures over a detector or a focal plane.

_NODE_LABELS = {
    'size_error': r'$\delta(R^2)/R^2$',
    'ellipticity_error': r'$\delta\epsilon$',
    'phase_error': 'pixel-phase error [pix]',
    'enclosed_flux': 'enclosed flux',
}


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
    reference = np.asarray(stars['reference']) != ''
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
