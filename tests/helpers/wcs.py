"""WCS of a tangent plane, as FITS headers and as gwcs have them."""
import astropy.units as u
import numpy as np
from astropy import coordinates as coord
from astropy.modeling.models import (
    AffineTransformation2D,
    Pix2Sky_TAN,
    RotateNative2Celestial,
    Shift,
)
from astropy.wcs import WCS
from gwcs import WCS as GWCS
from gwcs import coordinate_frames

SCALE = 0.074  # arcsec per pixel


def tan_wcs(ra, dec, *, rotation=0.0, mirrored=True, size=9000):
    """Return a FITS WCS whose middle pixel is at (ra, dec)."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval = ra, dec
    wcs.wcs.crpix = (size + 1) / 2, (size + 1) / 2
    c, s = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    matrix = np.array([[c, -s], [s, c]])
    if mirrored:
        matrix = np.diag([-1, 1]) @ matrix
    wcs.wcs.cd = matrix * SCALE / 3600
    wcs.pixel_shape = size, size
    return wcs


def make_gwcs(ra, dec, *, rotation=0.0, frame=None, box=None):
    """Return a gwcs with tangent plane at (ra, dec), 0.1 arcsec pixels."""
    c, s = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    matrix = 0.1 / 3600 * np.array([[-c, s], [s, c]])
    transform = ((Shift(-500) & Shift(-400))
                 | AffineTransformation2D(matrix) | Pix2Sky_TAN()
                 | RotateNative2Celestial(ra, dec, 180))
    detector = coordinate_frames.Frame2D(name='detector',
                                         unit=(u.pix, u.pix))
    # A frame without data is falsy: "frame or ICRS()" would ignore it.
    frame = coord.ICRS() if frame is None else frame
    sky = coordinate_frames.CelestialFrame(reference_frame=frame,
                                           name='world')
    wcs = GWCS([(detector, transform), (sky, None)])
    if box is not None:
        wcs.bounding_box = box
    return wcs
