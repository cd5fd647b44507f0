"""
The colours of all figures, and the Axes they are drawn on.

The colours are those of Okabe and Ito, which the colour-blind can tell apart.
"""
import numpy as np

from photutils_mgauss.utils.validation import real_array

__all__ = ['BLACK', 'BLUE', 'CYCLE', 'GREY', 'ORANGE', 'VERMILION',
           'arrow_key', 'colour_bar', 'current_axes', 'one_each',
           'round_length']

BLACK, BLUE, ORANGE, VERMILION = '#000000', '#0072B2', '#E69F00', '#D55E00'
GREY = '#9a9a9a'
CYCLE = (BLUE, ORANGE, '#009E73', '#CC79A7', VERMILION, '#56B4E9', '#F0E442')


def one_each(values, n, name):
    """Return numbers (n,), one for each of n stars, or raise."""
    values = real_array(values, name)
    if values.shape != (n,):
        msg = (f'{name} must have a number for each of the {n} stars, got '
               f'the shape {values.shape}')
        raise ValueError(msg)
    return values


def current_axes(ax):
    """Return the Axes given, or pyplot's current ones for None."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt
    return plt.gca()


def colour_bar(ax, shown, label=''):
    """Draw a colour bar beside Axes, as high as these."""
    beside = ax.inset_axes((1.04, 0, 0.05, 1))
    bar = ax.figure.colorbar(shown, cax=beside, label=label)
    # Numbers of many digits would push the label out of a usual figure.
    beside.ticklabel_format(axis='y', scilimits=(-2, 3), useMathText=True)
    # A power of ten stands above the numbers, not beside the title.
    beside.yaxis.get_offset_text().set_horizontalalignment('left')
    return bar


def round_length(largest):
    """Return the largest of 1, 2 and 5 times a power of ten up to a length."""
    decade = 10.0 ** np.floor(np.log10(max(largest, 1e-12)))
    return max(step * decade for step in (1, 2, 5)
               if step == 1 or step * decade <= largest)


def arrow_key(ax, arrows, scale, unit, title=''):
    """Draw an arrow of a round length above Axes, and a title above it."""
    key = round_length(scale)
    ax.quiverkey(arrows, 0.85, 1.04, key, f'{key:g} {unit}', labelpos='W',
                 color=BLUE)
    # Layouts keep room for titles, blank ones too, but not for keys.
    ax.set_title(title or ' ', loc='left', pad=20)
