"""Figures of the Bayesian fit."""
import numpy as np

from photutils_mgauss.plotting.style import BLUE, CYCLE, current_axes

__all__ = [
    'plot_corner',
    'plot_model_graph',
    'plot_posterior',
    'plot_trace',
]

# What `plot_posterior` and its like can be asked for, and its parameters.
_QUANTITIES = {
    'weights': ('weight_',), 'means': ('x_mean_', 'y_mean_'),
    'stddevs': ('x_stddev_', 'y_stddev_'), 'rho': ('rho_',),
    'flux': ('flux',), 'sigma': ('sigma',)}

# A figure of many parameters is legible when a column of a journal is so wide
# [inch] and its letters are so large [pt].
_COLUMN, _LETTERS = 3.3, 6.0
# Of the figure of a corner plot, and of a panel of it [inch].
_LEAST, _PANEL = 4.0, 1.3
_TEXTS = 'font.size', 'axes.labelsize', 'xtick.labelsize', 'ytick.labelsize'
# With more parameters than these, names are longer than a panel is wide.
_WIDE = 2
# Of more than these, a figure is for a page: in a column the names of so many
# would leave no room.
_MANY = 8


def plot_posterior(posterior, name, *, ax=None):
    """
    Plot the histogram of one quantity's draws (Appendix A, left).

    Parameters
    ----------
    posterior : MixturePosterior
        The draws.
    name : str
        ``'weights'``, ``'means'``, ``'stddevs'``, ``'rho'``, ``'flux'`` or
        ``'sigma'``, every number of which has a curve; or one parameter, such
        as ``'x_stddev_1'``.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, MixturePosterior, fit_mixture, plotting)
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> fit = fit_mixture(psf.render((15, 15), 7, 7), 1)
    >>> noise = 0.01 * np.random.default_rng(1).standard_normal((2, 50, 1))
    >>> posterior = MixturePosterior(  # as sample_mixture returns it
    ...     weights=np.ones((2, 50, 1)),
    ...     means=np.stack([noise, -noise], axis=-1),
    ...     stddevs=np.sqrt(2) + np.stack([noise, noise], axis=-1),
    ...     rho=noise, flux=1 + noise[..., 0],
    ...     sigma=0.1 + 0 * noise[..., 0], fit=fit, idata=None)
    >>> ax = plotting.plot_posterior(posterior, 'stddevs',
    ...                              ax=Figure().add_subplot())
    >>> ax.get_xlabel()
    'stddevs [pix]'
    """
    chosen = _named_draws(posterior, name)
    ax = current_axes(ax)
    for i, (label, draws) in enumerate(chosen):
        density, edges = np.histogram(draws, bins=40, density=True)
        ax.stairs(density, edges, color=CYCLE[i % len(CYCLE)], label=label)
    ax.set(xlabel=_with_unit(name), ylabel='density')
    ax.legend()
    return ax


def plot_trace(posterior, name, *, ax=None):
    """
    Plot the draws of one quantity one after the other (Appendix A, right).

    Parameters
    ----------
    posterior : MixturePosterior
        The draws.
    name : str
        See `plot_posterior`. Chains are drawn over each other.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, MixturePosterior, fit_mixture, plotting)
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> fit = fit_mixture(psf.render((15, 15), 7, 7), 1)
    >>> noise = 0.01 * np.random.default_rng(1).standard_normal((2, 50, 1))
    >>> posterior = MixturePosterior(  # as sample_mixture returns it
    ...     weights=np.ones((2, 50, 1)),
    ...     means=np.stack([noise, -noise], axis=-1),
    ...     stddevs=np.sqrt(2) + np.stack([noise, noise], axis=-1),
    ...     rho=noise, flux=1 + noise[..., 0],
    ...     sigma=0.1 + 0 * noise[..., 0], fit=fit, idata=None)
    >>> ax = plotting.plot_trace(posterior, 'stddevs',
    ...                          ax=Figure().add_subplot())
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('draw', 'stddevs [pix]')
    """
    chosen = _named_draws(posterior, name)
    ax = current_axes(ax)
    for i, (label, draws) in enumerate(chosen):
        for c, chain in enumerate(draws):
            ax.plot(chain, color=CYCLE[i % len(CYCLE)], linewidth=0.4,
                    alpha=0.7, label=label if c == 0 else None)
    ax.set(xlabel='draw', ylabel=_with_unit(name))
    ax.legend()
    return ax


def plot_corner(posterior, names=None, *, axes=None):
    """
    Plot histograms of parameters and the draws of each pair of them.

    Parameters
    ----------
    posterior : MixturePosterior
        The draws.
    names : sequence of str, optional
        Parameters or quantities as in `plot_posterior`; None is all
        parameters that vary.
    axes : (n, n) array_like of `~matplotlib.axes.Axes`, optional
        Where to draw n parameters; None makes a figure for them. That of up
        to eight parameters is legible in a column of a journal.

    Returns
    -------
    (n, n) `~numpy.ndarray` of `~matplotlib.axes.Axes`
        Those above the diagonal are empty.

    Raises
    ------
    ValueError
        If a name is unknown, or ``axes`` has another shape.

    Examples
    --------
    >>> import numpy as np
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import (
    ...     GaussianMixture, MixturePosterior, fit_mixture, plotting)
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> fit = fit_mixture(psf.render((15, 15), 7, 7), 1)
    >>> noise = 0.01 * np.random.default_rng(1).standard_normal((2, 50, 1))
    >>> posterior = MixturePosterior(  # as sample_mixture returns it
    ...     weights=np.ones((2, 50, 1)),
    ...     means=np.stack([noise, -noise], axis=-1),
    ...     stddevs=np.sqrt(2) + np.stack([noise, noise], axis=-1),
    ...     rho=noise, flux=1 + noise[..., 0],
    ...     sigma=0.1 + 0 * noise[..., 0], fit=fit, idata=None)
    >>> axes = plotting.plot_corner(posterior, ['x_mean_1', 'x_stddev_1'])
    >>> axes.shape
    (2, 2)
    """
    names = list(posterior.parameters()) if names is None else list(names)
    draws = {label: np.ravel(values) for name in names
             for label, values in _named_draws(posterior, name)
             if np.ptp(values) > 0}
    axes = _square_of_axes(axes, len(draws))
    for i, (y_name, y) in enumerate(draws.items()):
        for j, (x_name, x) in enumerate(draws.items()):
            ax = axes[i, j]
            if j > i:
                ax.set_axis_off()
                continue
            if i == j:
                ax.stairs(*np.histogram(x, bins=30), color=BLUE)
                ax.set(yticks=[])
            else:
                ax.plot(x, y, ',', color=BLUE, alpha=0.4, rasterized=True)
            ax.locator_params(nbins=2 if len(draws) > _WIDE else 3)
            ax.label_outer()
            if i == len(draws) - 1:
                ax.set_xlabel(_with_unit(x_name))
            if j == 0 < i:
                ax.set_ylabel(_with_unit(y_name))
    if len(draws) > _WIDE:
        _slant(axes)
    return axes


def _slant(axes):
    """Turn names and numbers that are longer than a panel is wide."""
    for ax in axes[-1]:
        ax.xaxis.label.set(rotation=45, ha='right', va='top',
                           rotation_mode='anchor')
        ax.tick_params('x', rotation=90)
    for ax in axes[1:, 0]:
        ax.yaxis.label.set(rotation=0, ha='right', va='center')


def _square_of_axes(axes, n):
    """Return (n, n) Axes, those given or new ones."""
    if axes is None:
        import matplotlib.pyplot as plt
        size = max(_LEAST, _PANEL * n)
        # The same size in print, in a column, whatever the number of panels.
        letters = _LETTERS * _PANEL * min(n, _MANY) / _COLUMN
        letters = max(letters, _LETTERS * _LEAST / _COLUMN)
        with plt.rc_context(dict.fromkeys(_TEXTS, letters)):
            axes = plt.subplots(n, n, figsize=(size, size), squeeze=False,
                                sharex='col', layout='constrained')[1]
    axes = np.atleast_2d(axes)
    if axes.shape != (n, n):
        msg = (f'axes must have the shape ({n}, {n}), one row for each '
               f'parameter that varies, got {axes.shape}')
        raise ValueError(msg)
    return axes


def _with_unit(name):
    """Return a label of a quantity or parameter: lengths are in pixels."""
    lengths = 'means', 'stddevs', 'x_mean', 'y_mean', 'x_stddev', 'y_stddev'
    return f'{name} [pix]' if name.startswith(lengths) else name


def _named_draws(posterior, name):
    """Return (label, draws) of all parameters that a name covers."""
    starts = _QUANTITIES.get(name, ())
    chosen = [(label, draws) for label, draws in
              posterior.parameters().items()
              if label == name or label.startswith(tuple(starts))]
    if not chosen:
        words = ', '.join(map(repr, _QUANTITIES))
        msg = (f'name must be one of {words}, or a parameter such as '
               f"'x_mean_1', got {name!r}")
        raise ValueError(msg)
    return chosen


def plot_model_graph(n_components, shape, *, ax=None):
    """
    Draw the graph of the Bayesian model (Fig. 2).

    The symbols are the paper's: omega the weights, alpha the means, beta the
    standard deviations, gamma the correlations.

    Parameters
    ----------
    n_components : int
        The number K of Gaussians.
    shape : (ny, nx) tuple of int
        The shape of the image.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; None is pyplot's current Axes.

    Returns
    -------
    `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from photutils_mgauss import plotting
    >>> ax = plotting.plot_model_graph(3, (25, 25), ax=Figure().add_subplot())
    >>> [text.get_text().split()[0] for text in ax.texts if text.get_text()]
    ['sigma', 'omega', 'alpha', 'beta', 'gamma', 'image']
    """
    ax = current_axes(ax)
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
