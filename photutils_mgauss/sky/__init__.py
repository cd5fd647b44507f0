"""The sky as planes, maps and observers.

`tangent_plane` has unit vectors and the plane that touches the sky. `wcs` goes
from pixels to the sky and back through any WCS. `transforms` maps one plane
onto another, by shifts up to polynomials; `common_points` finds such a map
from objects known in both planes, and `patterns` from patterns of objects
without names. `correction` applies a map to directions, and `corrected_wcs`
builds it into a WCS. `space_motion` moves places on a plane, and `observers`
has times, places of observers, and aberration. Angles and times enter as
astropy's Quantity, Time and SkyCoord and leave as plain radians, years and
unit vectors, which the room `motions` computes with. Nothing here knows about
stars.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'barycentric_observer': 'observers',
    'invert_wcs': 'wcs',
})
