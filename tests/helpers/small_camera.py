"""A small detector and a catalogue of one star for it."""
import astropy.units as u
from astropy.table import QTable

from photutils_mgauss import Instrument

SMALL = Instrument(shape=(200, 300))


def one_star(x, y, flux):
    return QTable({'x': [x] * u.pix, 'y': [y] * u.pix,
                   'flux': [flux] * u.electron})
