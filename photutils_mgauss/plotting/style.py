"""
The colours of all figures, and the Axes they are drawn on.

The colours are those of Okabe and Ito, which the colour-blind can tell apart.
"""

__all__ = ['BLACK', 'BLUE', 'CYCLE', 'GREY', 'ORANGE', 'VERMILION',
           'current_axes']

BLACK, BLUE, ORANGE, VERMILION = '#000000', '#0072B2', '#E69F00', '#D55E00'
GREY = '#9a9a9a'
CYCLE = (BLUE, ORANGE, '#009E73', '#CC79A7', VERMILION, '#56B4E9', '#F0E442')


def current_axes(ax):
    """Return the Axes given, or pyplot's current ones for None."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt
    return plt.gca()
