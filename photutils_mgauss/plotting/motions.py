"""Figures of epochs and proper motions."""
import numpy as np

from photutils_mgauss.plotting.style import BLUE, ORANGE, current_axes

__all__ = [
    'plot_errors_by_epochs',
    'plot_motion_errors',
    'plot_proper_motions',
    'plot_residual_vectors',
]


def plot_residual_vectors(solution, epoch, *, scale=None, ax=None):
    """
    Draw the residuals of one epoch's references and stars as arrows.

    Parameters
    ----------
    solution : `~photutils_mgauss.MotionSolution`
        Whose residuals.
    epoch : int
        Number of the epoch, from 0.
    scale : float, optional
        Residual [mas] as long as a tenth of the field; the default is three
        times the median residual.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; rejected detections are orange.
    """
    ax = current_axes(ax)
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


def plot_proper_motions(stars, *, ax=None):
    """
    Plot the proper-motion diagram of a table of stars.

    Parameters
    ----------
    stars : `~astropy.table.QTable`
        As `~photutils_mgauss.MotionSolution.stars`.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`
        Its Axes; reference objects are orange.
    """
    ax = current_axes(ax)
    reference = _is_reference(stars)
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


def _is_reference(stars):
    # A file gives the empty words of stars back as missing ones.
    return np.ma.filled(stars['reference'], '') != ''


def plot_motion_errors(stars, magnitude, *, ax=None):
    """
    Plot errors of motions against magnitude (as Fig. 12 of Nie et al.).

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
        Its Axes. Reference objects, whose errors a catalogue gave, are left
        out.
    """
    ax = current_axes(ax)
    free = ~_is_reference(stars)
    for name, colour in (('pmra', ORANGE), ('pmdec', BLUE)):
        ax.plot(np.asarray(magnitude)[free],
                stars[f'{name}_error'][free].value, '.', color=colour,
                markersize=3, label=name)
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
