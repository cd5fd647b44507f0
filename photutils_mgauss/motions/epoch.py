"""
One exposure: its table of stars, WCS, time and observer.

Tables are used under photutils' column names (`columns`); what they say is
read by `detections`.
"""
from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.coordinates import CartesianRepresentation
from astropy.table import Table

from photutils_mgauss.motions.chips import joined_chips
from photutils_mgauss.motions.columns import COLUMNS, names_of
from photutils_mgauss.sky.observers import _known_observer, julian_years
from photutils_mgauss.sky.wcs import check_celestial
from photutils_mgauss.utils.star_columns import find_column


@dataclass(frozen=True, eq=False)
class Epoch:
    """
    One exposure: a table of stars with its WCS, time and observer.

    Parameters
    ----------
    table : `~astropy.table.Table`
        One row per star, with positions and their standard errors as

        * pixels, 0 at the centre of the first one: ``x_fit``, ``y_fit``,
          ``x_err``, ``y_err`` as photutils names them (or ``x``, ``y``),
          optionally the covariance ``xy_cov`` [pix^2]; or
        * ICRS positions: ``ra``, ``dec`` [deg], ``ra_error``,
          ``dec_error`` [mas], the first including the cosine of the
          declination, as in the Gaia catalogue (``ra_err`` and ``dec_err``
          are accepted); or
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
        Middle of the exposure; numbers are Julian years (TDB) from
        1800 to 2200; a date in days needs a Time. Required unless the
        table has a column ``time``.
    observer : str or `~astropy.coordinates.CartesianRepresentation`, optional
        The place of the observer, for parallaxes: 'earth' (the default),
        'leo', 'l2', or a barycentric position. If this position has a
        velocity attached, positions are also corrected for aberration; see
        `barycentric_observer`.
    pixel_scale : `~astropy.units.Quantity`, optional
        Angle of one pixel, for epochs without WCS.
    chips : dict, optional
        Instead of ``wcs``, the WCS of each chip of a camera, by the names
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

        It has one map to the other epochs for all chips, and chips with
        the same name have the same distortion in all exposures.

        Parameters
        ----------
        pairs : sequence of (`~astropy.table.Table`, WCS)
            The stars of each chip, in pixels, and its WCS.
        time, observer : optional
            As for an epoch.
        names : sequence, optional
            The names of the chips; by default their numbers from 0.
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
        """Whether positions are x, y, which have priority over ra, dec."""
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
        """Whether the epoch has positions on the sky, by WCS or ra, dec."""
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
    def column_unit(self):
        """The unit of columns x, y that have none of their own."""
        is_angle = not self.is_sky and self.pixel_size is None
        return u.mas if is_angle else u.pix

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
