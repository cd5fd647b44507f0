"""
WCS that contain a correction of the directions they give.

A gwcs gets one more step after the sky: onto the common tangent plane, the
map, and back. Anything else becomes a FITS header, TAN with a SIP polynomial
fitted to the corrected positions. The WCS given is never touched.
"""
from copy import deepcopy
from dataclasses import dataclass

import gwcs
import numpy as np
from astropy.coordinates import ICRS, SkyCoord
from astropy.io.fits import Header
from astropy.wcs import WCS

from photutils_mgauss.sky.correction import DEGREE, sky_model
from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.transforms import exponents, monomials
from photutils_mgauss.sky.wcs import celestial_frame, pixel_to_vectors

GRID = 25       # points on a side of what polynomials are fitted to
SIP_LIMIT = 9   # largest order of a SIP polynomial
GOOD = 1e-4     # mas: residual of a fitted polynomial that is good enough


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels, and the pixel_shape it came from, if any."""

    x: tuple
    y: tuple
    shape: tuple | None

    @classmethod
    def of(cls, wcs, x, y):
        """Return the pixels a WCS is for, or else those of the stars."""
        shape = None if wcs is None else wcs.pixel_shape
        bounds = None if wcs is None else getattr(wcs, 'pixel_bounds', None)
        if bounds is not None and None not in bounds:
            (x0, x1), (y0, y1) = bounds
        elif shape is not None:
            (x0, x1), (y0, y1) = ((-0.5, n - 0.5) for n in shape)
        else:
            x0, x1 = np.nanmin(x) - 1, np.nanmax(x) + 1
            y0, y1 = np.nanmin(y) - 1, np.nanmax(y) + 1
        return cls((float(x0), float(x1)), (float(y0), float(y1)), shape)

    def grid(self, n=GRID):
        """Return x and y of points over the rectangle, denser outside."""
        # Chebyshev nodes keep fitted polynomials from swinging at the edge.
        node = -np.cos(np.pi * np.arange(n) / (n - 1))
        x, y = ((low + high) / 2 + (high - low) / 2 * node
                for low, high in (self.x, self.y))
        return (axis.ravel() for axis in np.meshgrid(x, y))

    @property
    def middle(self):
        """The middle pixel."""
        return sum(self.x) / 2, sum(self.y) / 2


def corrected_wcs(wcs, correction, region, pixel_map=None):
    """
    Return a WCS that gives corrected directions, and its residual [mas].

    Parameters
    ----------
    wcs : APE 14 WCS or None
    correction : `~photutils_mgauss.sky.correction.Correction`
    region : `Region`
        The pixels it is for.
    pixel_map : (2, 3) `~numpy.ndarray`, optional
        Without a WCS: the map of pixels onto the plane of the correction.
    """
    if isinstance(wcs, gwcs.WCS):
        return corrected_gwcs(wcs, correction, region)

    def directions_of(x, y):
        if wcs is not None:
            return correction(pixel_to_vectors(wcs, x, y, bounded=False))
        return correction(correction.plane.deproject(
            pixel_map[:, :1] + pixel_map[:, 1:] @ np.stack([x, y])))
    return corrected_header(wcs, directions_of, region)


def corrected_gwcs(wcs, correction, region):
    """
    Return a gwcs with the correction as its last step.

    Returns
    -------
    wcs : `~gwcs.WCS`
    residual : float
        Largest difference from the correction [mas]; that of the inverse
        is smaller than the fit of a polynomial can make it.
    """
    vectors = pixel_to_vectors(wcs, *region.grid(), bounded=False)
    whole = correction.with_aberration(vectors)
    model = sky_model(wcs, whole, vectors)
    wcs = deepcopy(wcs)
    shape, box = wcs.pixel_shape, wcs.bounding_box
    steps = [(step.frame, step.transform) for step in wcs.pipeline]
    last = steps[-1][0]
    inner = deepcopy(last)
    _rename(inner, last.name, [step[0].name for step in steps])
    out = gwcs.WCS([*steps[:-1], (inner, model), (last, None)],
                   name=wcs.name)
    out.pixel_shape = shape
    if out.bounding_box is None and box is not None:
        out.bounding_box = box
    x, y = region.grid(2 * GRID)
    expected = correction(pixel_to_vectors(wcs, x, y, bounded=False))
    got = pixel_to_vectors(out, x, y, bounded=False)
    return out, _largest_angle(got, expected)


def _rename(frame, name, taken):
    """Give a copied frame a name no other step of the pipeline has."""
    new, k = f'{name}_unaligned', 1
    while new in taken:
        k += 1
        new = f'{name}_unaligned{k}'
    frame._name = new


def _largest_angle(one, other):
    return float(np.nanmax(np.sqrt(np.sum((one - other)**2, axis=0)))
                 * np.degrees(1) * DEGREE)


def corrected_header(wcs, function, region):
    """
    Return a TAN-SIP WCS fitted to corrected directions.

    Parameters
    ----------
    wcs : APE 14 WCS or None
        Gives the celestial frame and the reference pixel, if it has one.
    function : callable
        Takes pixels x, y and returns the corrected directions (3, n).
    region : `Region`

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
    residual : float
        Largest difference on a finer grid [mas].
    """
    frame = ICRS() if wcs is None else celestial_frame(wcs)
    pixel = _reference_pixel(wcs, region)
    plane = _native_plane(frame, function, pixel)
    start = _old_order(wcs)
    for order in range(start, SIP_LIMIT + 1):
        fitted = _fit_sip(plane, pixel, region, function, frame, order)
        new = _build(wcs, frame, plane, pixel, fitted, region.shape)
        residual = _header_residual(new, function, region)
        if residual < GOOD:
            break
    return new, residual


def _reference_pixel(wcs, region):
    """Return the reference pixel, 0-based, if it lies in the region."""
    middle = region.middle
    if not isinstance(wcs, WCS):
        return middle
    x, y = wcs.wcs.crpix - 1
    inside = (region.x[0] <= x <= region.x[1]
              and region.y[0] <= y <= region.y[1])
    return (float(x), float(y)) if inside else middle


def _old_order(wcs):
    sip = getattr(wcs, 'sip', None)
    return 2 if sip is None else max(sip.a_order, sip.b_order, 2)


def _in_frame(frame, vectors):
    """Return directions (3, n) in another frame."""
    if frame.name == 'icrs':
        return vectors
    sky = SkyCoord(*directions(vectors), unit='deg', frame=ICRS())
    return sky.transform_to(frame).cartesian.xyz.value


def _native_plane(frame, function, pixel):
    centre = _in_frame(frame, function(*(np.array([value])
                                         for value in pixel)))
    return TangentPlane(*(float(angle[0]) for angle in directions(centre)))


def _fit_sip(plane, pixel, region, function, frame, order):
    """Return CD (2, 2) [deg/pix] and the SIP coefficients (2, terms)."""
    x, y = region.grid()
    size = max(region.x[1] - region.x[0], region.y[1] - region.y[0]) / 2
    offsets = np.stack([x - pixel[0], y - pixel[1]]) / size
    points = plane.project(_in_frame(frame, function(x, y))) / DEGREE
    good = np.isfinite(points).all(axis=0)
    # No constant: the reference pixel is at the reference value.
    basis = monomials(offsets, order)[1:]
    values = np.linalg.lstsq(basis[:, good].T, points[:, good].T,
                             rcond=None)[0].T
    powers = exponents(order)[1:].sum(axis=1)
    values = values / size**powers
    matrix = values[:, :2]
    return matrix, np.linalg.solve(matrix, values[:, 2:]), order


def _build(wcs, frame, plane, pixel, fitted, shape):
    matrix, distortion, order = fitted
    header = _frame_cards(wcs, frame)
    lon, lat = (1, 2) if not _latitude_first(wcs) else (2, 1)
    names = _axis_names(wcs, frame)
    for axis, name, value, row in ((lon, names[0], plane.ra, matrix[0]),
                                   (lat, names[1], plane.dec, matrix[1])):
        header[f'CTYPE{axis}'] = name.ljust(4, '-') + '-TAN-SIP'
        header[f'CUNIT{axis}'] = 'deg'
        header[f'CRVAL{axis}'] = value
        header[f'CRPIX{axis}'] = pixel[axis - 1] + 1
        for k in (1, 2):
            header[f'CD{axis}_{k}'] = float(row[k - 1])
    for letter, row in zip('AB', distortion, strict=True):
        header[f'{letter}_ORDER'] = order
        for (i, j), value in zip(exponents(order)[3:], row, strict=True):
            header[f'{letter}_{i}_{j}'] = float(value)
    new = WCS(header)
    new.pixel_shape = shape
    return new


def _latitude_first(wcs):
    return isinstance(wcs, WCS) and wcs.wcs.lat == 0


def _axis_names(wcs, frame):
    if isinstance(wcs, WCS):
        kinds = [str(name)[:4].rstrip('-') for name in wcs.wcs.ctype]
        return kinds[::-1] if _latitude_first(wcs) else kinds
    return ('GLON', 'GLAT') if frame.name == 'galactic' else ('RA', 'DEC')


def _frame_cards(wcs, frame):
    """Return a header that says what frame the world axes are in."""
    header = Header()
    header['WCSAXES'] = 2
    if isinstance(wcs, WCS):
        for key in ('RADESYS', 'EQUINOX'):
            value = getattr(wcs.wcs, key.lower())
            if value and not (key == 'EQUINOX' and np.isnan(value)):
                header[key] = value
        return header
    if frame.name in ('icrs', 'fk5', 'fk4'):
        header['RADESYS'] = frame.name.upper()
    if frame.name in ('fk5', 'fk4'):
        header['EQUINOX'] = frame.equinox.jyear
    return header


def _header_residual(wcs, function, region):
    x, y = region.grid(2 * GRID)
    return _largest_angle(pixel_to_vectors(wcs, x, y), function(x, y))
