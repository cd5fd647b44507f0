"""
Pixels to the sky and back through any WCS that speaks APE 14.

Only the forward map is ever asked of a WCS. Directions are ICRS unit vectors
of shape (3, n), whatever frame the WCS has.
"""
import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io.fits import Header

from photutils_mgauss.sky.gnomonic import STEP, Gnomonic
from photutils_mgauss.sky.tangent_plane import local_axes, unit_vectors
from photutils_mgauss.utils.validation import as_integer, as_real


def check_celestial(wcs, name='wcs'):
    """Raise unless ``wcs`` maps two pixel axes to a celestial frame."""
    if not hasattr(wcs, 'pixel_to_world_values'):
        hint = ('; astropy.wcs.WCS(header) makes one of it'
                if isinstance(wcs, Header) else '')
        msg = (f'{name} must be an APE 14 WCS (gwcs or astropy.wcs), got '
               f'{type(wcs).__name__}{hint}')
        raise TypeError(msg)
    physical = tuple(wcs.world_axis_physical_types)
    if wcs.pixel_n_dim != 2 or len(physical) != 2:
        msg = (f'{name} must have 2 pixel and 2 world axes, got '
               f'{wcs.pixel_n_dim} and {len(physical)}')
        raise ValueError(msg)
    celestial_frame(wcs, name)


def celestial_frame(wcs, name='wcs'):
    """Return the celestial frame, without data, of a WCS's world axes."""
    # What a WCS says of its axes takes microseconds; to ask it for a place
    # copies all steps of a gwcs.
    for described in wcs.world_axis_object_classes.values():
        kind, _, keywords = described[:3]
        if kind is SkyCoord and 'frame' in keywords:
            return keywords['frame'].replicate_without_data()
    world = wcs.pixel_to_world(0.0, 0.0)
    if not isinstance(world, SkyCoord):
        msg = (f'{name} must have celestial world axes, got '
               f'{wcs.world_axis_physical_types}')
        raise ValueError(msg)  # noqa: TRY004 the type is a property of wcs
    return world.frame.replicate_without_data()


def _world_values(wcs, x, y, bounded):
    """Return what the WCS gives for pixels, in its order and units."""
    # Only gwcs has bounding boxes, and only its __call__ can ignore them.
    if not bounded and hasattr(wcs, 'bounding_box'):
        return wcs(x, y, with_bounding_box=False)
    return wcs.pixel_to_world_values(x, y)


def pixel_to_vectors(wcs, x, y, *, bounded=True):
    """
    Return ICRS unit vectors (3, n) of pixel positions; NaN outside.

    With ``bounded=False`` a gwcs is continued beyond its bounding box.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    gnomonic = Gnomonic.of(wcs, x, y)
    if gnomonic is not None:
        return gnomonic.vectors(x, y)
    first, second = _world_values(wcs, x, y, bounded)
    values = [np.asarray(first, dtype=float) * u.Unit(
        wcs.world_axis_units[0]), np.asarray(second, dtype=float) * u.Unit(
        wcs.world_axis_units[1])]
    if wcs.world_axis_physical_types[0].endswith('lat') or (
            wcs.world_axis_physical_types[0].endswith('.dec')):
        values.reverse()
    frame = celestial_frame(wcs)
    if frame.name == 'icrs':
        return unit_vectors(*(value.to_value(u.deg) for value in values))
    sky = SkyCoord(*values, frame=frame).icrs
    return np.asarray(sky.cartesian.xyz.value)


def pixel_jacobian(wcs, plane, x, y, turn=None):
    """
    Return d(plane)/d(pixel), shape (2, 2, n) [mas/pix].

    ``turn`` (3, 3) is a rotation of the sphere between the two, if any.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    gnomonic = Gnomonic.of(wcs, x, y)
    if gnomonic is not None:
        return gnomonic.jacobian(plane, x, y, turn)
    columns = []
    for dx, dy in ((STEP, 0), (0, STEP)):
        after, before = (
            pixel_to_vectors(wcs, x + sign * dx, y + sign * dy,
                             bounded=False) for sign in (1, -1))
        if turn is not None:
            after, before = turn @ after, turn @ before
        after, before = plane.project(after), plane.project(before)
        columns.append((after - before) / (2 * STEP))
    return np.stack(columns, axis=1)


def invert_wcs(wcs, coordinates, *, start=None, tolerance=1e-7,
               max_iterations=20):
    r"""
    Return the pixels of sky positions, using only the forward map.

    Linear algebra for a gnomonic WCS without distortions. Else Newton's
    method on the residuals of unit vectors along local east and north, which
    works at the poles and at any rotation, where the numerical
    inverse of a gwcs without an analytic one fails or returns wrong pixels.

    Parameters
    ----------
    wcs : APE 14 WCS
        A gwcs or `astropy.wcs.WCS` with celestial axes.
    coordinates : `~astropy.coordinates.SkyCoord`
        Sky positions, shape (n,) or scalar, in any frame.
    start : (2,) sequence, optional
        A pixel (x, y) to start from. The default is the middle of the
        bounding box or pixel shape, or (0, 0).
    tolerance : float, optional
        Largest last step [pix] of a position that counts as found.
    max_iterations : int, optional
        Largest number of Newton steps.

    Returns
    -------
    x, y : `~numpy.ndarray`
        Pixel positions, 0 at the centre of the first pixel; NaN where the
        iteration did not converge.

    Raises
    ------
    TypeError, ValueError
        If the WCS is not celestial, or a number is out of range.

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.wcs import WCS
    >>> from photutils_mgauss import invert_wcs
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    >>> wcs.wcs.crval = 0, 90
    >>> wcs.wcs.cdelt = -1e-4, 1e-4
    >>> x, y = invert_wcs(wcs, SkyCoord([0, 90], [90, 89.999], unit='deg'))
    >>> wcs.pixel_to_world(x, y).dec.deg
    array([90.   , 89.999])
    """
    check_celestial(wcs)
    if not isinstance(coordinates, SkyCoord):
        msg = ('coordinates must be a SkyCoord, got '
               f'{type(coordinates).__name__}')
        raise TypeError(msg)
    tolerance = as_real(tolerance, 'tolerance', above=0)
    max_iterations = as_integer(max_iterations, 'max_iterations', minimum=1)
    target = np.asarray(coordinates.icrs.cartesian.xyz.value)
    shape = target.shape[1:]
    target = target.reshape(3, -1)
    pixels = Gnomonic.inverted(wcs, target)
    if pixels is not None:
        return tuple(axis.reshape(shape) for axis in pixels)
    x, y = _start(wcs, start, target.shape[1])
    east, north = local_axes(target)
    step = np.full(target.shape[1], np.inf)
    for _ in range(max_iterations):
        dx, dy = _newton_step(wcs, target, east, north, x, y)
        x, y = x + dx, y + dy
        step = np.hypot(dx, dy)
        if not (step > tolerance).any():
            break
    here = pixel_to_vectors(wcs, x, y, bounded=False)
    # Residuals vanish at the antipode as well.
    found = (step <= tolerance) & (np.sum(here * target, axis=0) > 0)
    return (np.where(found, x, np.nan).reshape(shape),
            np.where(found, y, np.nan).reshape(shape))


def _start(wcs, start, n):
    if start is None:
        box = getattr(wcs, 'pixel_bounds', None)
        shape = wcs.pixel_shape
        if box is not None and None not in box:
            start = [np.mean(limits) for limits in box]
        elif shape is not None:
            start = [(length - 1) / 2 for length in shape]
        else:
            start = (0.0, 0.0)
    return np.full(n, float(start[0])), np.full(n, float(start[1]))


def _newton_step(wcs, target, east, north, x, y):
    """Return the step (dx, dy) that a linear map would need."""
    def offset(dx, dy):
        here = pixel_to_vectors(wcs, x + dx, y + dy, bounded=False)
        # Dividing by the cosine of the distance makes a flat map linear, so
        # that distant starts converge; far away the sine alone is safer.
        depth = np.maximum(np.sum(here * target, axis=0), 0.1)
        return (np.sum(here * east, axis=0) / depth,
                np.sum(here * north, axis=0) / depth)
    (e0, n0), (ex, nx), (ey, ny) = (
        offset(0, 0), offset(STEP, 0), offset(0, STEP))
    a, b, c, d = ((value - zero) / STEP for value, zero in (
        (ex, e0), (ey, e0), (nx, n0), (ny, n0)))
    det = a * d - b * c
    with np.errstate(divide='ignore', invalid='ignore'):
        return (b * n0 - d * e0) / det, (c * e0 - a * n0) / det
