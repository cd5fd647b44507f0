"""
WCS that contain the map found for their epoch.

A gwcs gets one more step after the sky: onto the common tangent plane, the
map, and back. Anything else becomes a FITS header, TAN with a SIP polynomial
fitted to the corrected positions. The WCS given is never touched.
"""
from copy import deepcopy
from dataclasses import dataclass, replace

import astropy.units as u
import gwcs
import numpy as np
from astropy.coordinates import ICRS, SkyCoord
from astropy.io.fits import Header
from astropy.modeling.models import (
    AffineTransformation2D,
    Mapping,
    Pix2Sky_TAN,
    Polynomial2D,
    RotateCelestial2Native,
    RotateNative2Celestial,
    Scale,
    Sky2Pix_TAN,
)
from astropy.wcs import WCS

from photutils_mgauss.motions.epoch import numbers, pixel_size
from photutils_mgauss.sky.observers import remove_aberration
from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.transforms import exponents, monomials
from photutils_mgauss.sky.wcs import celestial_frame, pixel_to_vectors

DEGREE = 3.6e6  # milliarcseconds
GRID = 25       # points on a side of what polynomials are fitted to
SIP_LIMIT = 9   # largest order of a SIP polynomial
GOOD = 1e-4     # mas: residual of a fitted polynomial that is good enough


@dataclass(frozen=True, eq=False)
class Correction:
    """
    What an epoch's map does to directions.

    Parameters
    ----------
    plane : `TangentPlane`
    transform : `~photutils_mgauss.sky.transforms.Transform`
    coefficients : (2, b) `~numpy.ndarray`
    velocity : (3,) `~numpy.ndarray` or None
        Velocity of the observer, whose aberration is removed first.
    """

    plane: TangentPlane
    transform: object
    coefficients: np.ndarray
    velocity: np.ndarray | None = None

    def __call__(self, vectors):
        """Return the corrected directions of directions (3, n)."""
        if self.velocity is not None:
            vectors = remove_aberration(vectors, self.velocity)
        return self.plane.deproject(self.transform.apply(
            self.coefficients, self.plane.project(vectors)))

    def with_aberration(self, vectors):
        """
        Return a correction of the plane alone that removes aberration too.

        The aberration over a field is a quartic to far below 1e-4 mas;
        it is fitted at the directions (3, n) given.
        """
        if self.velocity is None:
            return self
        points = self.plane.project(vectors)
        degree = max(self.transform.degree, 4)
        kind = type(self.transform)('polynomial', degree).fitted_to(points)
        targets = self.plane.project(self(vectors))
        coefficients = np.linalg.lstsq(kind.basis(points).T, targets.T,
                                       rcond=None)[0].T
        return Correction(self.plane, kind, coefficients)


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
    model = _sky_model(celestial_frame(wcs), wcs,
                       correction.with_aberration(vectors), vectors)
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


def _sky_model(frame, wcs, correction, vectors):
    """Return the model from sky to sky in the frame and units of a WCS."""
    centre, turn = _plane_in(frame, correction.plane)
    there = RotateCelestial2Native(*centre, 180) | Sky2Pix_TAN()
    back = Pix2Sky_TAN() | RotateNative2Celestial(*centre, 180)
    middle = _plane_model(correction, turn, vectors)
    model = there | middle | back
    units = [u.Unit(unit) for unit in wcs.world_axis_units]
    latitude_first = 'lat' in wcs.world_axis_physical_types[0] or (
        wcs.world_axis_physical_types[0].endswith('.dec'))
    if latitude_first:
        units.reverse()
    factors = [unit.to(u.deg) for unit in units]
    if factors != [1.0, 1.0]:
        scale = Scale(factors[0]) & Scale(factors[1])
        model = scale | model | scale.inverse
    if latitude_first:
        model = Mapping((1, 0)) | model | Mapping((1, 0))
    return model


def _plane_in(frame, plane):
    """
    Return the centre (lon, lat) [deg] in a frame, and the turn to its axes.

    Frames of the sky are rotated against one another, and so are planes
    that touch the sphere at one point.
    """
    axes = SkyCoord(*directions(plane.axes.T), unit='deg',
                    frame=ICRS()).transform_to(frame).cartesian.xyz.value.T
    centre = directions(axes[0])
    own = TangentPlane(*centre).axes
    turn = own[1:] @ axes[1:].T
    left, _, right = np.linalg.svd(turn)
    return [float(angle) for angle in centre], left @ right


def _plane_model(correction, turn, vectors):
    """Return the model of the map in degrees, with an inverse."""
    transform, coefficients = correction.transform, correction.coefficients
    if transform.degree == 1:
        slope = coefficients[:, 1:3] / transform.scale
        shift = coefficients[:, 0] - slope @ np.array(transform.centre)
        return AffineTransformation2D(turn @ slope @ turn.T,
                                      turn @ shift / DEGREE)
    points = correction.plane.project(vectors)
    model = _polynomial_model(transform, coefficients, turn)
    mapped = transform.apply(coefficients, points)
    # The map is close to the identity, and so its inverse a polynomial.
    kind = type(transform)('polynomial',
                           min(transform.degree + 3, 9)).fitted_to(mapped)
    inverse = np.linalg.lstsq(kind.basis(mapped).T, points.T,
                              rcond=None)[0].T
    model.inverse = _polynomial_model(kind, inverse, turn)
    return model


def _polynomial_model(transform, coefficients, turn):
    scale = DEGREE / transform.scale
    into = AffineTransformation2D(
        turn.T * scale, -np.array(transform.centre) / transform.scale)
    axes = [Polynomial2D(transform.degree, **{
        f'c{i}_{j}': value for (i, j), value in zip(
            exponents(transform.degree), row / DEGREE, strict=True)})
        for row in coefficients]
    return (into | Mapping((0, 1, 0, 1)) | axes[0] & axes[1]
            | AffineTransformation2D(turn, [0.0, 0.0]))


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


def correct_epoch(epoch, correction, tie):
    """
    Return an epoch with a corrected WCS, and the WCS's residual [mas].

    ``tie`` is the map (2, 3) of an epoch without WCS onto the common plane,
    or None. Epochs without pixels stay as they are.
    """
    pixels = _stars_pixels(epoch)
    if isinstance(epoch.wcs, gwcs.WCS):
        region = Region.of(epoch.wcs, *pixels)
        wcs, residual = corrected_gwcs(epoch.wcs, correction, region)
        return epoch.with_wcs(wcs), residual
    directions_of = _pixel_directions(epoch, correction, tie)
    if directions_of is None:
        return epoch, np.nan
    wcs, residual = corrected_header(epoch.wcs, directions_of,
                                     Region.of(epoch.wcs, *pixels))
    return replace(epoch, wcs=wcs, pixel_scale=None), residual


def _stars_pixels(epoch):
    if not epoch.is_pixels:
        return np.array([0.0]), np.array([0.0])
    return tuple(numbers(epoch.table, key) for key in 'xy')


def _pixel_directions(epoch, correction, tie):
    """Return the function from pixels to corrected directions, or None."""
    if epoch.wcs is not None:
        return lambda x, y: correction(
            pixel_to_vectors(epoch.wcs, x, y, bounded=False))
    if tie is None or pixel_size(epoch) is None:
        return None
    slope = tie[:, 1:] * pixel_size(epoch)
    return lambda x, y: correction(correction.plane.deproject(
        tie[:, :1] + slope @ np.stack([x, y])))
