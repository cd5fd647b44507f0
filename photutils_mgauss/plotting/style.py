"""
The colours of all figures.

Those of Okabe and Ito, which the colour-blind can tell apart.
"""

__all__ = ['BLACK', 'BLUE', 'CYCLE', 'ORANGE', 'VERMILION']

BLACK, BLUE, ORANGE, VERMILION = '#000000', '#0072B2', '#E69F00', '#D55E00'
CYCLE = (BLUE, ORANGE, '#009E73', '#CC79A7', VERMILION, '#56B4E9', '#F0E442')
