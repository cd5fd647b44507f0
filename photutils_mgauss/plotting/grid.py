"""Figures of a PSF over a detector."""
import numpy as np
from astropy.stats import mad_std

from photutils_mgauss.plotting.fit import plot_mixture
from photutils_mgauss.plotting.style import (
    BLACK,
    BLUE,
    ORANGE,
    colour_bar,
    current_axes,
    round_length,
)
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.validation import as_choice

__all__ = [
    'plot_node_map',
    'plot_psf_image',
    'plot_radial_profile',
    'plot_shape_map',
    'plot_whiskers',
    'plot_width_map',
    'plot_worst_node',
]

_NODE_LABELS = {
    'size_error': r'$\delta(R^2)/R^2$',
    'ellipticity_error': r'$\delta\epsilon$',
    'phase_error': 'pixel-phase error [pix]',
    'enclosed_flux': 'enclosed flux',
}


def plot_node_map(psf, column='size_error', *, layout=None, ax=None):
    r"""
    Map a column of the nodes' report (as Figs. 4-7 of Nie et al.).

    Parameters
    ----------
    psf : GriddedMixturePSF or a dict of them
        One detector, or several by name.
    column : str, optional
        A numeric column of ``report``, such as ``'size_error'``,
        :math:`\delta(R^2)/R^2`, or ``'ellipticity_error'``,
        :math:`\delta\epsilon`.
    layout : dict of (x, y), optional
        Where the pixel (0, 0) of each detector is in the focal plane [pix];
        by default the detectors stand side by side.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; its title tells median and scatter
        (`~astropy.stats.mad_std`) of the nodes that are not bridged.

    Raises
    ------
    ValueError
        If ``layout`` has no place for a detector.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.nddata import NDData
    >>> from matplotlib.figure import Figure
    >>> from photutils.psf import GriddedPSFModel
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> wide = GaussianMixture([1], [[0, 0]], [[[6, 0.8], [0.8, 7]]])
    >>> library = GriddedPSFModel(NDData(
    ...     np.array([4 * wide.render((25, 25), 12, 12)] * 4),
    ...     meta={'grid_xypos': [(0, 0), (99, 0), (0, 99), (99, 99)],
    ...           'oversampling': 2}))
    >>> psf = GriddedMixturePSF.from_gridded_psf(library, n_components=1)
    >>> ax = plotting.plot_node_map(psf, 'size_error',
    ...                             ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'y [pix]')
    """
    psfs, places = _laid_out(psf, layout)
    for one in psfs.values():
        _check_column(one.report, column)
    ax = current_axes(ax)
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
    colour_bar(ax, points, label)
    if good.size:
        ax.set_title(f'{label}: median {np.median(good):.2g}, '
                     f'scatter {mad_std(good):.2g}')
    return _focal_plane(ax, psfs, places)


def _check_column(report, column):
    as_choice(column, 'column', tuple(
        name for name in report.colnames if report[name].dtype.kind in 'fi'))


def plot_whiskers(psf, *, layout=None, scale=None, ax=None):
    """
    Plot the ellipticity of the nodes as whiskers along the long axis.

    Parameters
    ----------
    psf : GriddedMixturePSF or a dict of them
        One detector, or several by name.
    layout : dict of (x, y), optional
        As in `plot_node_map`.
    scale : float, optional
        The length of a whisker of ellipticity 1 [pix]; by default the largest
        whisker is as long as half the distance of two nodes.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> mixtures = [GaussianMixture([1], [[0, 0]], [[[v, 0.3], [0.3, 1.5]]])
    ...             for v in (1.4, 1.6, 1.8, 2.0)]
    >>> psf = GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])
    >>> ax = plotting.plot_whiskers(psf, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'y [pix]')
    """
    ax = current_axes(ax)
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
    _draw_key(ax, scale, np.hypot(*half.T).max() * 2)
    return _focal_plane(ax, psfs, places)


def _draw_key(ax, scale, largest):
    """Draw a whisker of a round ellipticity above the Axes."""
    key = round_length(largest)
    # Across, in data; upwards, in fractions of the Axes.
    across = ax.get_xaxis_transform()
    left = ax.dataLim.x0
    ax.plot([left, left + scale * key], [1.06, 1.06], color=BLUE,
            transform=across, clip_on=False)
    ax.annotate(f'  ellipticity {key:g}', (left + scale * key, 1.06),
                xycoords=across, va='center', annotation_clip=False)


def plot_worst_node(psf, source, column='size_error', *, ax=None):
    """
    Show the residual of the node with the largest error.

    Parameters
    ----------
    psf : GriddedMixturePSF
        The grid of mixtures.
    source : `~photutils.psf.GriddedPSFModel`
        The ePSFs it was made of.
    column : str, optional
        The column of ``report`` that is the error.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        The same, with ePSF minus mixture in per cent of the ePSF's peak.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.nddata import NDData
    >>> from matplotlib.figure import Figure
    >>> from photutils.psf import GriddedPSFModel
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> wide = GaussianMixture([1], [[0, 0]], [[[6, 0.8], [0.8, 7]]])
    >>> library = GriddedPSFModel(NDData(
    ...     np.array([4 * wide.render((25, 25), 12, 12)] * 4),
    ...     meta={'grid_xypos': [(0, 0), (99, 0), (0, 99), (99, 99)],
    ...           'oversampling': 2}))
    >>> psf = GriddedMixturePSF.from_gridded_psf(library, n_components=1)
    >>> ax = plotting.plot_worst_node(psf, library, ax=Figure().add_subplot())
    >>> ax.get_title().partition(', $')[0]
    'node (0, 0)'
    """
    report = psf.report
    _check_column(report, column)
    ax = current_axes(ax)
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
    colour_bar(ax, picture, 'residual [% of the peak]')
    place = psf.grid_xypos[worst]
    ax.set(xlabel='x [pix]', ylabel='y [pix]', title=(
        f'node ({place[0]:.0f}, {place[1]:.0f}), '
        f'{_NODE_LABELS.get(column, column)} = {report[column][worst]:.2g}'))
    return ax


def plot_width_map(psf, *, stars=None, ax=None):
    r"""
    Map the width of the nodes' PSFs, :math:`2.35 \sqrt{R^2 / 2}`.

    Parameters
    ----------
    psf : GriddedMixturePSF
        The PSF.
    stars : (n, 2) array_like, optional
        Positions of the stars it was made of, to be marked [pix].
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> mixtures = [GaussianMixture([1], [[0, 0]], [[[v, 0.3], [0.3, 1.5]]])
    ...             for v in (1.4, 1.6, 1.8, 2.0)]
    >>> psf = GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])
    >>> ax = plotting.plot_width_map(psf, ax=Figure().add_subplot())
    >>> ax.get_title()
    'FWHM: median 2.978, range 0.28 pix'
    """
    ax = current_axes(ax)
    fwhm = np.atleast_1d(adaptive_moments(psf.mixtures).fwhm)
    x, y = psf.grid_xypos.T
    points = ax.scatter(x, y, c=fwhm, s=12, marker='s', cmap='cividis')
    colour_bar(ax, points, 'FWHM [pix]')
    if stars is not None and len(stars):
        ax.plot(*np.transpose(stars), 'o', color=ORANGE, fillstyle='none',
                markersize=6)
    ax.set_title(f'FWHM: median {np.median(fwhm):.3f}, '
                 f'range {np.ptp(fwhm):.2g} pix')
    return _focal_plane(ax, {'': psf}, {'': (0, 0)})


def plot_psf_image(psf, x, y, *, radius=8, decades=4, ax=None):
    """
    Show the PSF at a place, in logarithms.

    Parameters
    ----------
    psf : GriddedMixturePSF
        The PSF.
    x, y : float
        The place on the detector [pix].
    radius : float, optional
        Half the width of the image [pix].
    decades : float, optional
        How many powers of ten below the peak are shown.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> mixtures = [GaussianMixture([1], [[0, 0]], [[[v, 0.3], [0.3, 1.5]]])
    ...             for v in (1.4, 1.6, 1.8, 2.0)]
    >>> psf = GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])
    >>> ax = plotting.plot_psf_image(psf, 30, 40, ax=Figure().add_subplot())
    >>> ax.get_title()
    'the PSF at (30, 40)'
    """
    ax = plot_mixture(psf.mixture_at(x, y), radius=radius, decades=decades,
                      pixel_integrated=psf.pixel_integrated, ax=ax)
    ax.set_title(f'the PSF at ({x:.0f}, {y:.0f})')
    return ax


def plot_radial_profile(psf, x, y, *, radius=8, ax=None):
    """
    Plot the PSF at a place against the distance from its centre.

    The line is the mean over all directions, the band goes from the least to
    the most.

    Parameters
    ----------
    psf : GriddedMixturePSF
        The PSF.
    x, y : float
        The place on the detector [pix].
    radius : float, optional
        Out to where [pix].
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, GriddedMixturePSF, plotting)
    >>> mixtures = [GaussianMixture([1], [[0, 0]], [[[v, 0.3], [0.3, 1.5]]])
    ...             for v in (1.4, 1.6, 1.8, 2.0)]
    >>> psf = GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])
    >>> ax = plotting.plot_radial_profile(psf, 30, 40,
    ...                                   ax=Figure().add_subplot())
    >>> ax.get_ylabel()
    'flux in a pixel / flux of the star'
    """
    ax = current_axes(ax)
    distance = np.linspace(0, radius, 200)
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)[:, None]
    values = psf.mixture_at(x, y).evaluate(
        distance * np.cos(angle), distance * np.sin(angle),
        pixel_integrated=psf.pixel_integrated)
    ax.fill_between(distance, np.maximum(values.min(axis=0), 1e-300),
                    values.max(axis=0), color=BLUE, alpha=0.25, linewidth=0)
    ax.plot(distance, values.mean(axis=0), color=BLUE)
    peak = values.max()
    ax.set(yscale='log', ylim=(peak * 1e-5, peak * 1.5), xlim=(0, radius),
           xlabel='distance from the centre [pix]',
           ylabel='flux in a pixel / flux of the star')
    return ax


def plot_shape_map(x, y, values, *, label, ax=None):
    """
    Show a quantity at points of the detector, its mean and scatter on top.

    As Figs. 4 to 7, for the deviations that
    `~photutils_mgauss.Shapes.relative_size_error` and
    `~photutils_mgauss.Shapes.ellipticity_error` return.

    Parameters
    ----------
    x, y : (n,) array_like
        Positions on the detector [pix].
    values : (n,) array_like
        The deviations; NaN is left out.
    label : str
        What they are.
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
    >>> x, y = rng.uniform(0, 100, (2, 30))
    >>> ax = plotting.plot_shape_map(x, y, rng.normal(0, 0.01, 30),
    ...                              label='size error',
    ...                              ax=Figure().add_subplot())
    >>> ax.get_title().partition(':')[0]
    'size error'
    """
    ax = current_axes(ax)
    values = np.asarray(values, float)
    limit = np.nanmax(np.abs(values))
    shown = ax.scatter(x, y, c=values, cmap='RdBu_r', vmin=-limit, vmax=limit,
                       marker='s')
    ax.set(aspect='equal', xlabel='x [pix]', ylabel='y [pix]')
    ax.set_title(f'{label}: {np.nanmean(values):+.2e} '
                 f'$\\pm$ {np.nanstd(values):.1e}')
    colour_bar(ax, shown, label)
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
