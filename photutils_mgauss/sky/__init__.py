"""
The sky as planes, maps and observers; it knows no star.

`tangent_plane` has unit vectors and the plane that touches the sky, `wcs`
goes from pixels to the sky and back through any WCS, `transforms` maps one
plane onto another, from shifts to polynomials, `common_points` finds one
from objects on both planes, `patterns` from asterisms of objects nobody has
named, `correction` is what such a map does to
directions, `corrected_wcs` puts it into a WCS, `space_motion` is how places
on a plane move, and `observers` has times, places of observers and
aberration. Angles and times enter as astropy's Quantity, Time and SkyCoord
and leave as plain radians, years and unit vectors, of which all that the
room `motions` does is made.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'barycentric_observer': 'observers',
    'invert_wcs': 'wcs',
})
