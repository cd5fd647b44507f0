"""How figures look: one style file, two widths, colours for all eyes."""
from pathlib import Path

from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

# The colours of Okabe and Ito, and marks that differ as well.
COLOURS = ('#0072B2', '#E69F00', '#009E73', '#CC79A7', '#D55E00', '#56B4E9',
           '#000000', '#999999', '#F0E442')
MARKS = 'os^Dv*Pxh'

STYLE = Path(__file__).with_name('reproduction.mplstyle')

# A column and a page of a journal [inch].
COLUMN, PAGE = 3.5, 7.2


def canvas_of(height, width=PAGE):
    """Return an empty figure of a width and height [inch]."""
    return Figure(figsize=(width, height), layout='constrained')


def canvas_colours(n):
    """Return n steps of a colour map that grows darker."""
    return colormaps['cividis_r'].resampled(n)


def plain_log(ax):
    """Make the y axis logarithmic, with 0.5, 1, 2 and so on as numbers."""
    ax.set_yscale('log')
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    ax.yaxis.set_minor_formatter(NullFormatter())
