"""
One exposure: its table of stars, WCS, time and observer, and how it is read.

Tables are used under photutils' column names. What leaves this module is a
`Detections`: plain float64 arrays in the units of the frame.
"""
from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.coordinates import CartesianRepresentation
from astropy.table import Table

from photutils_mgauss.motions.chips import (
    chip_jacobian,
    chip_vectors,
    joined_chips,
)
from photutils_mgauss.motions.stacked import is_definite_2x2, sandwich_2x2
from photutils_mgauss.sky.observers import (
    _known_observer,
    julian_years,
    observer_velocity,
    remove_aberration,
)
from photutils_mgauss.sky.tangent_plane import (
    MAS,
    TangentPlane,
    local_axes,
    unit_vectors,
)
from photutils_mgauss.sky.wcs import (
    check_celestial,
    pixel_jacobian,
    pixel_to_vectors,
)
from photutils_mgauss.utils.star_columns import find_column, first_values

# Columns with more names than one, in order of preference.
COLUMNS = {
    'x': ('x_fit', 'x'), 'y': ('y_fit', 'y'),
    'x_err': ('x_err', 'x_error'), 'y_err': ('y_err', 'y_error'),
    'ra_err': ('ra_error', 'ra_err'), 'dec_err': ('dec_error', 'dec_err'),
    'flux': ('flux_fit', 'flux'),
    'magnitude': ('mag', 'phot_g_mean_mag'),
    'along_err': ('along_error', 'along_err'),
}
# What is not measured across a scan, in errors along it: far beyond what
# counts as a measurement, near enough that covariances can be inverted.
ACROSS = 1e5


def names_of(key):
    """Return the names that a column may have, the preferred one first."""
    return COLUMNS.get(key, (key,))


@dataclass(frozen=True, eq=False)
class Epoch:
    """
    One exposure: a table of stars, and where and when they were seen.

    Parameters
    ----------
    table : `~astropy.table.Table`
        One row per star, with positions and their standard errors as

        * pixels, 0 at the centre of the first one: ``x_fit``, ``y_fit``,
          ``x_err``, ``y_err`` as photutils names them (or ``x``, ``y``),
          optionally the covariance ``xy_cov`` [pix^2]; or
        * ICRS positions: ``ra``, ``dec`` [deg], ``ra_error``, ``dec_error``
          [mas], the first with the cosine of the declination in it, as in
          the Gaia catalogue (``ra_err`` and ``dec_err`` will do); or
        * scans that measure one direction: ``along`` [mas], the place along
          the scan from ``ra``, ``dec``, its error ``along_error``, and
          ``scan_angle`` [deg], the direction of the scan from north through
          east. Each is one measurement.

        Optional columns: ``id`` (any type, unique), ``flux_fit``,
        ``radial_velocity`` [km/s], its ``_error``, and ``time`` of each row.
        Columns may have other units. Masked and non-finite positions are
        left out and flagged; errors that are not positive get no weight
        and a flag.
    wcs : APE 14 WCS, optional
        A gwcs or `astropy.wcs.WCS` with celestial axes, of which only the
        forward transform is used. Without one, pixels are coordinates in a
        plane, x in place of right ascension; a column unit of angle or
        ``pixel_scale`` gives them a scale.
    time : `~astropy.time.Time` or float, optional
        Middle of the exposure; numbers are Julian years (TDB). Required
        unless the table has a column ``time``.
    observer : str or `~astropy.coordinates.CartesianRepresentation`, optional
        Where the parallax is seen from: 'earth' (the default), 'leo', 'l2',
        or a barycentric place. Only if that place has a velocity attached
        are positions corrected for aberration; see `barycentric_observer`.
    pixel_scale : `~astropy.units.Quantity`, optional
        Angle of one pixel, for epochs without WCS.
    chips : dict, optional
        In place of ``wcs`` the WCS of each chip of a camera, by the names
        in a column ``chip``; see `Epoch.of_chips`.

    Raises
    ------
    TypeError, ValueError
        If the table lacks a column, or the WCS is not celestial, or there
        is no time.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from photutils_mgauss import Epoch
    >>> table = Table({'x_fit': [10.0], 'y_fit': [20.0],
    ...                'x_err': [0.01], 'y_err': [0.01]})
    >>> Epoch(table, time=2026.5)
    <Epoch: 1 star at 2026.500, no WCS>
    """

    table: Table
    wcs: object = None
    time: object = None
    observer: object = field(default=None, kw_only=True)
    pixel_scale: u.Quantity = field(default=None, kw_only=True)
    chips: dict = field(default=None, kw_only=True)

    @classmethod
    def of_chips(cls, pairs, time=None, *, observer=None, names=None):
        """
        Return one exposure of a camera with several chips.

        It has one map onto the other epochs, whatever their number, and
        chips of the same name have the same distortion in all exposures.

        Parameters
        ----------
        pairs : sequence of (`~astropy.table.Table`, WCS)
            The stars of each chip, in pixels, and its WCS.
        time, observer : optional
            As for an epoch.
        names : sequence, optional
            What the chips are called; the default is their numbers from 0.
            Different cameras need different names.

        Returns
        -------
        Epoch

        Raises
        ------
        TypeError, ValueError
            If a table lacks a column, a WCS is not celestial, or two chips
            have one name.

        Examples
        --------
        >>> from astropy.table import Table
        >>> from astropy.wcs import WCS
        >>> from photutils_mgauss import Epoch
        >>> pairs = []
        >>> for k in range(2):
        ...     table = Table({'x_fit': [10.0], 'y_fit': [20.0],
        ...                    'x_err': [0.01], 'y_err': [0.01]})
        ...     wcs = WCS({'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN',
        ...                'CDELT1': -1e-5, 'CDELT2': 1e-5,
        ...                'CRPIX1': -2048 * k})
        ...     pairs.append((table, wcs))
        >>> Epoch.of_chips(pairs, time=2026.5)
        <Epoch: 2 stars at 2026.500, 2 chips>
        """
        table, chips = joined_chips(pairs, names)
        return cls(table, time=time, observer=observer, chips=chips)

    def __post_init__(self):
        if not isinstance(self.table, Table):
            msg = (f'table must be an astropy Table, got '
                   f'{type(self.table).__name__}')
            raise TypeError(msg)
        if self.wcs is not None:
            check_celestial(self.wcs)
        _check_chips(self)
        _check_observer(self.observer)
        _check_columns(self.table, self.is_pixels, self.is_scan)
        _check_scale(self)
        _check_time(self)

    def __repr__(self):
        n = len(self.table)
        stars = f'{n} star' if n == 1 else f'{n} stars'
        package = type(self.wcs).__module__.split('.')[0]
        wcs = 'no WCS' if self.wcs is None else f'{package} WCS'
        if self.chips is not None:
            wcs = f'{len(self.chips)} chips'
        return f'<Epoch: {stars} at {self.mean_year:.3f}, {wcs}>'

    @property
    def is_pixels(self):
        """Whether positions are x, y, which win over ra, dec."""
        has_xy = find_column(self.table, names_of('x')) is not None
        has_sky = 'ra' in self.table.colnames
        return has_xy and (self._has_wcs or not has_sky)

    @property
    def _has_wcs(self):
        return self.wcs is not None or self.chips is not None

    @property
    def is_scan(self):
        """Whether positions are measured in one direction each."""
        return 'along' in self.table.colnames and not self.is_pixels

    @property
    def is_sky(self):
        """Whether the epoch has places in the sky, by WCS or ra, dec."""
        return self._has_wcs or not self.is_pixels

    @property
    def plane_unit(self):
        """The unit of its plane: 'pix', or 'mas' where angles are known."""
        if self.is_sky or self.pixel_scale is not None:
            return 'mas'
        name = find_column(self.table, names_of('x'))
        unit = getattr(self.table[name], 'unit', None)
        if unit is not None and u.Unit(unit).is_equivalent(u.mas):
            return 'mas'
        return 'pix'

    @property
    def pixel_size(self):
        """Units of its plane in a pixel, None for columns of angles."""
        if self.pixel_scale is not None:
            return _angle_per_pixel(self.pixel_scale)
        return 1.0 if self.plane_unit == 'pix' else None

    @property
    def years(self):
        """Julian years (TDB), a scalar or one per row."""
        if self.time is None:
            return julian_years(self.table['time'], 'the column time')
        return julian_years(self.time)

    @property
    def mean_year(self):
        """Mean Julian year (TDB) of the exposure."""
        return float(np.nanmean(self.years))

    def with_wcs(self, wcs):
        """
        Return this epoch with another WCS.

        Parameters
        ----------
        wcs : APE 14 WCS or None
            The new one.

        Returns
        -------
        Epoch
        """
        return replace(self, wcs=wcs)


def _check_chips(epoch):
    if epoch.chips is None:
        return
    if epoch.wcs is not None:
        msg = 'wcs must be None for an epoch of chips, which have their own'
        raise ValueError(msg)
    if 'chip' not in epoch.table.colnames:
        msg = (f"table must have a column 'chip', got {epoch.table.colnames}")
        raise ValueError(msg)
    known = np.isin(np.asarray(epoch.table['chip']), list(epoch.chips))
    if not known.all():
        unknown = np.asarray(epoch.table['chip'])[~known][0].item()
        msg = (f"the column 'chip' must hold names of chips, got {unknown!r};"
               f' there are {list(epoch.chips)}')
        raise ValueError(msg)


def _check_observer(observer):
    if observer is None or isinstance(observer, CartesianRepresentation):
        return
    _known_observer(observer)


def _check_columns(table, is_pixels, is_scan):
    wanted = ('ra', 'dec', 'ra_err', 'dec_err')
    if is_pixels:
        wanted = ('x', 'y', 'x_err', 'y_err')
    elif is_scan:
        wanted = ('ra', 'dec', 'along', 'along_err', 'scan_angle')
    for key in wanted:
        names = names_of(key)
        if find_column(table, names) is None:
            if key == 'ra':  # The table has no positions of either kind.
                names = (*COLUMNS['x'], *names)
            words = ' or '.join(repr(name) for name in names)
            msg = f'table must have a column {words}, got {table.colnames}'
            raise ValueError(msg)


def _check_scale(epoch):
    scale = epoch.pixel_scale
    if scale is None:
        return
    if epoch.is_sky:
        msg = 'pixel_scale must be None for an epoch with sky positions'
        raise ValueError(msg)
    if not isinstance(scale, u.Quantity):
        msg = f'pixel_scale must be a Quantity, got {scale!r}'
        raise TypeError(msg)
    _angle_per_pixel(scale)


def _angle_per_pixel(scale):
    unit = u.mas / u.pix if u.pix in scale.unit.bases else u.mas
    value = scale.to_value(unit)
    if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0):
        msg = f'pixel_scale must be a positive angle, got {scale}'
        raise ValueError(msg)
    return float(value)


def _check_time(epoch):
    if epoch.time is None and 'time' not in epoch.table.colnames:
        msg = "time must be given, or the table must have a column 'time'"
        raise ValueError(msg)
    years = epoch.years
    if years.shape not in ((), (len(epoch.table),)):
        msg = (f'time must be a scalar or one per row, got shape '
               f'{years.shape}')
        raise ValueError(msg)
    if years.ndim == 0 and not np.isfinite(years):
        msg = f'time must be finite, got {epoch.time}'
        raise ValueError(msg)


@dataclass(frozen=True, eq=False)
class Detections:
    """
    What an epoch says about each of its n rows, as plain arrays.

    For n stars at E epochs the arrays have an axis of epochs before the
    last, but ``ids`` (n,) are the names of the stars, and ``flux`` and
    ``radial_velocity`` (n,) [km/s] their means.

    ``plane`` (2, n) and ``covariance`` (3, n: xx, xy, yy) are in the frame's
    unit, mas or pixels. ``found`` says which positions are finite,
    ``usable`` which errors are good as well.
    """

    ids: np.ndarray | None
    plane: np.ndarray
    covariance: np.ndarray
    years: np.ndarray
    flux: np.ndarray
    radial_velocity: np.ndarray
    found: np.ndarray
    usable: np.ndarray
    chip: np.ndarray | None = None


def numbers(table, key, unit=None):
    """
    Return a column as float64; NaN where masked, infinite or missing.

    A column without unit is taken to be in ``unit``.
    """
    values = first_values(table, names_of(key), unit)
    return np.where(np.isfinite(values), values, np.nan)


def sky_vectors(epoch):
    """Return ICRS unit vectors (3, n) of an epoch with sky positions."""
    if epoch.is_pixels:
        x, y = pixels(epoch)
        vectors = (pixel_to_vectors(epoch.wcs, x, y) if epoch.chips is None
                   else chip_vectors(epoch, x, y))
    else:
        vectors = table_vectors(epoch.table)
    if epoch.is_scan:
        vectors = _along_the_scan(epoch.table, vectors)
    velocity = observer_velocity(epoch.observer)
    if velocity is None:
        return vectors
    return remove_aberration(vectors, velocity)


def _along_the_scan(table, vectors):
    """Return directions (3, n) moved along the scans by what was measured."""
    east, north = local_axes(vectors)
    sine, cosine = _scan_directions(table)
    step = numbers(table, 'along', u.mas) / MAS
    moved = vectors + step * (sine * east + cosine * north)
    return moved / np.sqrt(1 + step**2)


def _scan_directions(table):
    angle = np.radians(numbers(table, 'scan_angle', u.deg))
    return np.sin(angle), np.cos(angle)


def _scan_covariance(table):
    """Return xx, xy, yy of scans, which say nothing across their way."""
    error = numbers(table, 'along_err', u.mas)
    sine, cosine = _scan_directions(table)
    across = (ACROSS * error)**2
    along = error**2 - across
    covariance = np.stack([across + along * sine**2, along * sine * cosine,
                           across + along * cosine**2])
    return np.where((error > 0) & np.isfinite(error + sine), covariance,
                    np.nan)


def table_vectors(table):
    """Return ICRS unit vectors (3, n) of ra and dec, NaN for no places."""
    dec = numbers(table, 'dec', u.deg)
    return unit_vectors(numbers(table, 'ra', u.deg),
                        np.where(np.abs(dec) <= 90, dec, np.nan))


def brightness(table):
    """Return numbers (n,) that grow with the flux, NaN where unknown."""
    for key, sign in (('flux', 1), ('magnitude', -1)):
        values = numbers(table, key)
        if np.isfinite(values).any():
            return sign * values
    return values


def magnitudes(table):
    """Return magnitudes (n,), from fluxes if need be, NaN where unknown."""
    values = brightness(table)
    if find_column(table, names_of('flux')) is None:
        return -values
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.where(values > 0, -2.5 * np.log10(values), np.nan)


def pixels(epoch):
    """Return x and y [pix] of an epoch."""
    return numbers(epoch.table, 'x', u.pix), numbers(epoch.table, 'y', u.pix)


def check_epochs(epochs):
    """Return the epochs as a list, or raise for what are none."""
    if isinstance(epochs, Epoch):
        msg = 'epochs must be a sequence of Epoch, got a single one'
        raise TypeError(msg)
    epochs = list(epochs)
    for epoch in epochs:
        if not isinstance(epoch, Epoch):
            msg = (f'epochs must be a sequence of Epoch, got '
                   f'{type(epoch).__name__}')
            raise TypeError(msg)
    if not epochs:
        msg = 'epochs must be at least 2, got 0'
        raise ValueError(msg)
    return epochs


def read_epochs(epochs, references=None, *, turns=None):
    """
    Return what epochs say, in one plane.

    Parameters
    ----------
    epochs : list of `Epoch`
    references : `~astropy.table.Table`, optional
        Reference objects, whose unit counts where nothing is on the sky.
    turns : list of (3, 3) `~numpy.ndarray` or None, optional
        Rotations of the sphere that correct pointings, None for those that
        are right.

    Returns
    -------
    detections : list of `Detections`
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane` or None
        None where nothing is known about the sky.
    unit : {'mas', 'pix'}
    """
    vectors = [sky_vectors(epoch) if epoch.is_sky else None
               for epoch in epochs]
    if turns is not None:
        vectors = [vector if turn is None else turn @ vector
                   for vector, turn in zip(vectors, turns, strict=True)]
    plane = _common_plane(vectors)
    unit = 'mas' if plane else _common_unit(epochs, references)
    # Popped, so that a million directions are kept no longer than needed.
    turns = [None] * len(epochs) if turns is None else turns
    detections = [read_epoch(epoch, plane, vectors.pop(0), turn)
                  for epoch, turn in zip(epochs, turns, strict=True)]
    return detections, plane, unit


def _common_plane(vectors):
    """Return the plane at the mean direction, None if there is no sky."""
    seen = [vector for vector in vectors if vector is not None]
    if not seen:
        return None
    total = sum(np.nansum(vector, axis=1) for vector in seen)
    if not total.any():
        msg = ('epochs must have finite positions, got none inside the '
               'bounding boxes of their WCS')
        raise ValueError(msg)
    return TangentPlane.around(total)


def _common_unit(epochs, references):
    if references is not None and 'x' in references.colnames:
        unit = getattr(references['x'], 'unit', None)
        if unit is not None and unit.physical_type == 'angle':
            return 'mas'
    units = {epoch.plane_unit for epoch in epochs}
    if len(units) > 1:
        msg = ('epochs must all have a scale or none, got columns in '
               'pixels and in angles; give pixel_scale')
        raise ValueError(msg)
    return units.pop()


def read_epoch(epoch, plane=None, vectors=None, turn=None):
    """
    Return the `Detections` of an epoch.

    ``plane`` is the common `TangentPlane`, and ``vectors`` the directions
    already computed; both None where nothing is known about the sky.
    ``turn`` is the rotation (3, 3) they had, if any.
    """
    years = np.asarray(epoch.years, dtype=float)
    ids, flux = _ids(epoch.table), numbers(epoch.table, 'flux')
    velocity = numbers(epoch.table, 'radial_velocity', u.km / u.s)
    if vectors is None:
        positions, covariance = _read_plane(epoch)
    else:
        positions = plane.project(vectors)
        covariance = _sky_covariance(epoch, plane, positions, turn)
    found = np.isfinite(positions).all(axis=0) & np.isfinite(years)
    return Detections(ids, np.where(found, positions, np.nan), covariance,
                      years, flux, velocity, found,
                      found & is_definite_2x2(covariance),
                      None if epoch.chips is None
                      else np.asarray(epoch.table['chip']))


def _read_plane(epoch):
    size = epoch.pixel_size
    unit, scale = (u.mas, 1.0) if size is None else (u.pix, size)
    x, y, dx, dy = (scale * numbers(epoch.table, key, unit)
                    for key in ('x', 'y', 'x_err', 'y_err'))
    covariance = _covariance(epoch.table, dx, dy, scale**2, unit**2)
    return np.stack([x, y]), covariance


def _covariance(table, dx, dy, scale=1.0, unit=u.pix**2):
    """Return xx, xy, yy; errors that are not positive become NaN."""
    cross = np.zeros_like(dx)
    if 'xy_cov' in table.colnames:
        cross = scale * numbers(table, 'xy_cov', unit)
    good = (dx > 0) & (dy > 0) & np.isfinite(dx) & np.isfinite(dy)
    return np.where(good, np.stack([dx * dx, cross, dy * dy]), np.nan)


def _sky_covariance(epoch, plane, positions, turn):
    """Carry the errors of pixels or sky positions to the plane."""
    keys, unit = (('x_err', 'y_err'), u.pix) if epoch.is_pixels else (
        ('ra_err', 'dec_err'), u.mas)
    if epoch.is_scan:
        covariance = _scan_covariance(epoch.table)
    else:
        errors = (numbers(epoch.table, key, unit) for key in keys)
        covariance = _covariance(epoch.table, *errors, unit=unit**2)
    if epoch.is_pixels:
        x, y = pixels(epoch)
        jacobian = (pixel_jacobian(epoch.wcs, plane, x, y, turn)
                    if epoch.chips is None
                    else chip_jacobian(epoch, plane, x, y, turn))
    elif turn is None:
        jacobian = plane.local_jacobian(positions)
    else:  # The errors are along east and north as the table has them.
        axes = local_axes(turn.T @ plane.deproject(positions))
        jacobian = np.stack([plane.displacement(
            positions, np.tensordot(turn, axis, axes=1)) for axis in axes],
            axis=1)
    return sandwich_2x2(jacobian, covariance)


def _ids(table):
    if 'id' not in table.colnames:
        return None
    if np.any(getattr(table['id'], 'mask', False)):
        msg = "the column 'id' must not have masked values"
        raise ValueError(msg)
    ids = np.asarray(table['id'])
    values, counts = np.unique(ids, return_counts=True)
    if len(values) < len(ids):
        msg = (f"the column 'id' must hold unique values, got "
               f'{values[counts > 1][0]!r} {counts.max()} times')
        raise ValueError(msg)
    return ids

