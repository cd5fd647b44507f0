"""Figures of epochs and proper motions."""
import numpy as np

from photutils_mgauss.plotting.style import (
    BLACK,
    BLUE,
    GREY,
    ORANGE,
    arrow_key,
    colour_bar,
    current_axes,
    one_each,
)

__all__ = [
    'plot_cutouts',
    'plot_errors_by_epochs',
    'plot_motion_errors',
    'plot_motions_by_magnitude',
    'plot_proper_motions',
    'plot_reference_differences',
    'plot_residual_map',
    'plot_residual_vectors',
]

# Detections in a cell of a map of residuals, at least.
_ENOUGH = 5


def plot_residual_vectors(solution, epoch, *, scale=None, title=None,
                          ax=None):
    """
    Draw the residuals of one epoch's references and stars as arrows.

    Parameters
    ----------
    solution : `~photutils_mgauss.MotionSolution`
        Whose residuals.
    epoch : int
        Number of the epoch, from 0.
    scale : float, optional
        Residual [mas] as long as a tenth of the field, which the key shows;
        the default is three times the median residual.
    title : str, optional
        What the epoch is called; the default is its number.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; rejected detections are orange.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> ax = plotting.plot_residual_vectors(solution, 0,
    ...                                     ax=Figure().add_subplot())
    >>> ax.get_title(loc='left')
    'epoch 0'
    """
    ax = current_axes(ax)
    rows = solution.residuals[solution.residuals['epoch'] == epoch]
    x, y = _field_coordinates(rows)
    u, v = rows['dra'].value, rows['ddec'].value
    good = np.isfinite(x + y + u + v)
    if scale is None:
        scale = 3 * np.median(np.hypot(u[good], v[good]))
    unit = scale / (np.ptp(x[good]) / 10)
    used = np.asarray(rows['used'])
    for which, colour in ((good & used, BLUE), (good & ~used, ORANGE)):
        arrows = ax.quiver(x[which], y[which], u[which], v[which],
                           color=colour, angles='xy', scale_units='xy',
                           scale=unit)
    # The frame holds the tips, too.
    ax.update_datalim(np.column_stack([x + u / unit, y + v / unit])[good])
    ax.autoscale_view()
    if 'x' in rows.colnames:  # a plane of its own, not the sky
        unit = rows['x'].unit
        ax.set(xlabel=f'x [{unit}]', ylabel=f'y [{unit}]', aspect='equal')
    else:
        ax.set(xlabel='east [arcsec]', ylabel='north [arcsec]', aspect='equal')
        ax.invert_xaxis()
    arrow_key(ax, arrows, scale, rows['dra'].unit,
              f'epoch {epoch}' if title is None else title)
    return ax


def plot_residual_map(residuals, chip='', *, n_cells=6, scale=None, ax=None):
    """
    Draw the mean residuals in the cells of a detector as arrows.

    What is the same in all exposures, such as a distortion that no WCS has,
    stands out against the noise of single detections.

    Parameters
    ----------
    residuals : `~astropy.table.QTable`
        What `~photutils_mgauss.MotionSolution.detector_residuals` gives.
    chip : str, optional
        Name of the chip.
    n_cells : int, optional
        Cells along the longer side.
    scale : float, optional
        Residual [pix] as long as a cell, which the key shows; the default
        is twice the median of the cells.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; arrows shorter than twice their error are grey.

    Raises
    ------
    ValueError
        If there are no residuals on such a chip.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 1000, (2, 2000)) * u.pix
    >>> table = QTable({'x_pix': x, 'y_pix': y, 'dx_pix': 1e-5 * (y - x),
    ...                 'dy_pix': rng.normal(0, 0.01, 2000) * u.pix})
    >>> table['chip'] = ''  # as detector_residuals() has them
    >>> ax = plotting.plot_residual_map(table, ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('x [pix]', 'y [pix]')
    """
    ax = current_axes(ax)
    places, mean, error, size = _cells(residuals, chip, n_cells)
    length = np.hypot(*mean)
    if scale is None:
        scale = 2 * np.median(length)
    clear = length > 2 * error
    for which, colour in ((~clear, GREY), (clear, BLUE)):
        arrows = ax.quiver(*places[:, which], *mean[:, which], color=colour,
                           angles='xy', scale_units='xy', pivot='middle',
                           scale=scale / size, width=0.004)
    ax.set(xlabel='x [pix]', ylabel='y [pix]', aspect='equal')
    ax.update_datalim(np.concatenate([(places - size / 2).T,
                                      (places + size / 2).T]))
    ax.autoscale_view()
    arrow_key(ax, arrows, scale, 'pix', f'chip {chip}' if chip else '')
    return ax


def _cells(residuals, chip, n_cells):
    """Return places, means (2, c), errors (c,) and the size of the cells."""
    names = ('x_pix', 'y_pix', 'dx_pix', 'dy_pix')
    own = residuals[np.ma.filled(residuals['chip'], '') == chip]
    x, y, dx, dy = (np.asarray(own[name].value) for name in names)
    good = np.isfinite(x + y + dx + dy)
    if not good.any():
        msg = f'residuals must have some on chip {chip!r}, got none'
        raise ValueError(msg)
    x, y, dx, dy = (values[good] for values in (x, y, dx, dy))
    size = max(np.ptp(x), np.ptp(y), 1e-6) / n_cells * 1.0001
    column, row = ((values - values.min()) // size for values in (x, y))
    _, cell, count = np.unique(column + n_cells * row, return_inverse=True,
                               return_counts=True)
    kept = count >= _ENOUGH

    def mean(values):
        return (np.bincount(cell, values) / count)[kept]

    scatter = np.hypot(*(np.sqrt(np.maximum(
        mean(values**2) - mean(values)**2, 0)) for values in (dx, dy)))
    places = np.stack([values.min() + (mean(index) + 0.5) * size
                       for values, index in ((x, column), (y, row))])
    return (places, np.stack([mean(dx), mean(dy)]),
            scatter / np.sqrt(count[kept] - 1), size)


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


def plot_proper_motions(stars, *, membership=None, ax=None):
    """
    Plot the proper-motion diagram of a table of stars.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        As `~photutils_mgauss.MotionSolution.stars`.
    membership : (n,) array_like, optional
        The probability of each to be a member of a cluster, which gives
        stars their colour.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; reference objects are orange.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> ax = plotting.plot_proper_motions(solution.stars,
    ...                                   ax=Figure().add_subplot())
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['stars', 'references']
    """
    ax = current_axes(ax)
    reference = _is_reference(stars)
    if membership is not None:
        free = ~reference & np.isfinite(np.asarray(membership))
        shown = ax.scatter(
            stars['pmra'][free].value, stars['pmdec'][free].value, 9,
            np.asarray(membership)[free], cmap='viridis', vmin=0, vmax=1,
            zorder=3)
        colour_bar(ax, shown, 'membership')
    # References stand on few places, where many stars are: on top of these.
    for which, style, label in (
            (~reference, {'color': BLUE, 'alpha': 0.5, 'markersize': 3},
             'stars'),
            (reference, {'color': ORANGE, 'markersize': 5, 'zorder': 4},
             'references')):
        some = stars[which]
        ax.errorbar(some['pmra'].value, some['pmdec'].value,
                    some['pmdec_error'].value, some['pmra_error'].value,
                    fmt='.', elinewidth=0.5, **style,
                    label=label if len(some) else None)
    unit = stars['pmra'].unit
    if 'ra' in stars.colnames:
        ax.set(xlabel=rf'$\mu_{{\alpha*}}$ [{unit}]',
               ylabel=rf'$\mu_\delta$ [{unit}]', aspect='equal')
        ax.invert_xaxis()
    else:
        ax.set(xlabel=f'motion along x [{unit}]',
               ylabel=f'motion along y [{unit}]', aspect='equal')
    ax.legend()
    return ax


def _is_reference(stars):
    # A file gives the empty words of stars back as missing ones.
    return np.ma.filled(stars['reference'], '') != ''


def plot_reference_differences(table, *, ax=None):
    """
    Plot the motions measured of references less those of their catalogue.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        What `~photutils_mgauss.MotionSolution.reference_differences` or
        ``validation`` gives; rows with NaN are left out.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes. If catalogue and errors are right, two thirds of the bars
        of each direction reach the cross at zero.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> table = solution.reference_differences()
    >>> ax = plotting.plot_reference_differences(table,
    ...                                          ax=Figure().add_subplot())
    >>> ax.get_title(loc='left')
    'measured minus catalogue'
    """
    ax = current_axes(ax)
    for draw in (ax.axhline, ax.axvline):
        draw(0, color=BLACK, linewidth=0.8)
    names = ('dpmra', 'dpmdec', 'dpmdec_error', 'dpmra_error')
    ax.errorbar(*(table[name].value for name in names), fmt='.',
                color=ORANGE, alpha=0.5, elinewidth=0.5, markersize=3)
    unit = table['dpmra'].unit
    ax.set(xlabel=rf'$\Delta\mu_{{\alpha*}}$ [{unit}]',
           ylabel=rf'$\Delta\mu_\delta$ [{unit}]', aspect='equal')
    ax.set_title('measured minus catalogue', loc='left')
    ax.invert_xaxis()
    return ax


def plot_motions_by_magnitude(stars, magnitude, *, ax=None):
    """
    Plot both proper motions against magnitude.

    A trend is a systematic error; see ``terms`` of
    `~photutils_mgauss.ProperMotionFitter`.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        As for `plot_proper_motions`.
    magnitude : (n,) array_like
        A magnitude for each.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> ax = plotting.plot_motions_by_magnitude(
    ...     solution.stars, rng.uniform(18, 22, 60), ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('magnitude [mag]', 'motion [pix / yr]')
    """
    magnitude = one_each(magnitude, len(stars), 'magnitude')
    ax = current_axes(ax)
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        ax.errorbar(magnitude, stars[name].value,
                    stars[f'{name}_error'].value, fmt='.', color=colour,
                    alpha=0.5, elinewidth=0.5, markersize=3, label=name)
    ax.set(xlabel='magnitude [mag]', ylabel=f'motion [{stars["pmra"].unit}]')
    ax.legend()
    return ax


def plot_motion_errors(stars, magnitude, *, bound=None, ax=None):
    """
    Plot errors of motions against magnitude (as Fig. 12 of Nie et al.).

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        As for `plot_proper_motions`.
    magnitude : (n,) array_like
        A magnitude for each.
    bound : (n,) array_like, optional
        The smallest error that is possible, in the same unit.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes. Reference objects, whose errors a catalogue gave, are left
        out.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> ax = plotting.plot_motion_errors(
    ...     solution.stars, rng.uniform(18, 22, 60), ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('magnitude [mag]', 'error [pix / yr]')
    """
    magnitude = one_each(magnitude, len(stars), 'magnitude')
    ax = current_axes(ax)
    free = ~_is_reference(stars)
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        ax.plot(magnitude[free],
                stars[f'{name}_error'][free].value, '.', color=colour,
                markersize=3, label=name)
    if bound is not None:
        bound = one_each(bound, len(stars), 'bound')
        order = np.argsort(magnitude[free])
        ax.plot(magnitude[free][order], bound[free][order], color='black',
                label='bound')
    ax.set(yscale='log', xlabel='magnitude [mag]',
           ylabel=f'error [{stars["pmra"].unit}]')
    ax.legend()
    return ax


def plot_errors_by_epochs(solutions, *, ax=None):
    """
    Plot the median error of motions against the number of epochs.

    Parameters
    ----------
    solutions : sequence of `~photutils_mgauss.MotionSolution`
        Fits to different numbers of epochs (as Fig. 11 of Nie et al.).
        Their reference objects do not count.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import Epoch, ProperMotionFitter, plotting
    >>> rng = np.random.default_rng(1)
    >>> place, motion = rng.uniform(0, 900, (2, 60)), rng.normal(0, 1, (2, 60))
    >>> motion[:, :20] = 0  # quasars
    >>> epochs = []
    >>> for year in (2020.0, 2022.0, 2025.0):
    ...     x, y = (place + motion * (year - 2022)
    ...             + rng.normal(0, 0.02, (2, 60)))
    ...     epochs.append(Epoch(Table({
    ...         'id': np.arange(60), 'x_fit': x, 'y_fit': y,
    ...         'x_err': np.full(60, 0.02), 'y_err': np.full(60, 0.02)}),
    ...         time=year))
    >>> fitter = ProperMotionFitter(references=range(20))
    >>> solution = fitter.fit(epochs)
    >>> solutions = [fitter.fit(epochs[:2]), solution]
    >>> ax = plotting.plot_errors_by_epochs(solutions,
    ...                                     ax=Figure().add_subplot())
    >>> ax.get_xlabel()
    'number of epochs'
    """
    ax = current_axes(ax)
    counts = [len(solution.epochs) for solution in solutions]
    measured = [solution.stars[~_is_reference(solution.stars)]
                for solution in solutions]
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        medians = [np.nanmedian(stars[f'{name}_error'].value)
                   for stars in measured]
        ax.plot(counts, medians, 'o-', color=colour, label=name)
    unit = solutions[0].stars['pmra'].unit
    ax.set(xlabel='number of epochs', ylabel=f'median error [{unit}]')
    ax.legend()
    return ax


def plot_cutouts(cutouts, *, ax=None):
    """
    Draw what each image shows of one star: data, model and residual.

    Parameters
    ----------
    cutouts : `~astropy.table.QTable`
        As `~photutils_mgauss.PixelMotionSolution.cutouts` returns it.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes: a column for each image, grey from -2 to 5 times the
        scatter of the residuals in it. Crosses are where the fit has the
        star.

    Raises
    ------
    ValueError
        If the table has no rows.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     ImageEpoch, Instrument, PixelMotionFitter, paper_exposures,
    ...     plotting, simulate_epochs, sky_field)
    >>> sources = sky_field(4, 4, size=0.12, magnitudes=(20, 22),
    ...                     parallaxes=False, separation=1.0, rng=1)
    >>> images = [ImageEpoch(one.image, one.psf, one.wcs, one.time,
    ...                      error=one.error)
    ...           for one in simulate_epochs(
    ...               sources, paper_exposures()[::3], rng=2,
    ...               instrument=Instrument(shape=(200, 200)))]
    >>> solution = PixelMotionFitter().fit(images, sources['ra', 'dec'])
    >>> ax = plotting.plot_cutouts(solution.cutouts(),
    ...                            ax=Figure().add_subplot())
    >>> len(ax.images)
    1
    """
    if not len(cutouts):
        msg = 'cutouts must have at least one row, got none'
        raise ValueError(msg)
    ax = current_axes(ax)
    parts = ('data', 'model', 'residual')
    stamps = np.stack([_plain(cutouts[name]) for name in parts])
    _, n, ny, nx = stamps.shape
    # Images of different depth are shown alike.
    noise = 1.4826 * np.nanmedian(np.abs(stamps[2]), axis=(1, 2))
    stamps = stamps / np.where(noise > 0, noise, 1)[:, None, None]
    picture = np.full((3 * (ny + 1) - 1, n * (nx + 1) - 1), np.nan)
    for i in range(3):
        for k in range(n):
            top, left = (2 - i) * (ny + 1), k * (nx + 1)
            picture[top:top + ny, left:left + nx] = stamps[i, k]
    ax.imshow(picture, origin='lower', cmap='gray_r', vmin=-2, vmax=5,
              interpolation='nearest')
    _mark_star(ax, cutouts, (ny, nx))
    ax.set_xticks((nx + 1) * np.arange(n) + (nx - 1) / 2,
                  [f'{year:.2f}' for year in _plain(cutouts['time'])])
    ax.set_yticks((ny + 1) * np.arange(3) + (ny - 1) / 2, parts[::-1])
    ax.tick_params(length=0)
    ax.set(xlabel='year')
    return ax


def _mark_star(ax, cutouts, shape):
    """Mark the place of the star in all stamps."""
    ny, nx = shape
    x, y = _plain(cutouts['x']), _plain(cutouts['y'])
    columns = (nx + 1) * np.arange(len(x)) + (nx - 1) // 2 + x - np.rint(x)
    for i in range(3):
        ax.plot(columns, (ny + 1) * i + (ny - 1) // 2 + y - np.rint(y), '+',
                color=ORANGE, markersize=4, markeredgewidth=0.7)


def _plain(column):
    return np.asarray(getattr(column, 'value', column), float)
