"""Figures of the Bayesian fit, on the Axes they are given."""
import numpy as np

from photutils_mgauss.plotting.style import CYCLE

__all__ = [
    'plot_model_graph',
    'plot_posterior',
    'plot_trace',
]


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
    for i, (label, draws) in enumerate(_named_draws(posterior, name)):
        density, edges = np.histogram(draws, bins=40, density=True)
        ax.stairs(density, edges, color=CYCLE[i % len(CYCLE)], label=label)
    ax.set(xlabel=_with_unit(name), ylabel='density')
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
            ax.plot(chain, color=CYCLE[i % len(CYCLE)], linewidth=0.4,
                    alpha=0.7, label=label if c == 0 else None)
    ax.set(xlabel='draw', ylabel=_with_unit(name))
    ax.legend()
    return ax


def _with_unit(name):
    """Return a label of the posterior's quantity: lengths are in pixels."""
    return f'{name} [pix]' if name in ('alpha', 'beta') else name


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
