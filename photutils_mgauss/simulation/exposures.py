r"""
Where stars are: their motion, and the pointing that puts them on pixels.

At a time :math:`t` a star is in the direction of

.. math::

    \mathbf{s}(t) = \mathbf{r} + (t + \mathbf{r} \cdot \mathbf{b}(t) / c - t_0)
    \,(\mu_{\alpha*}\mathbf{e} + \mu_\delta\mathbf{n}) - \varpi\,\mathbf{b}(t),

with its direction :math:`\mathbf{r}` at the reference epoch, the unit vectors
:math:`\mathbf{e}` and :math:`\mathbf{n}` towards east and north there, and
the barycentric place :math:`\mathbf{b}` of the Earth in au: uniform motion
in space without a radial velocity. Times are Julian years of TDB.
"""
import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.coordinates import ICRS, get_body_barycentric_posvel
from astropy.io import fits
from astropy.modeling.models import (
    AffineTransformation2D,
    Identity,
    Mapping,
    Pix2Sky_TAN,
    Polynomial2D,
    RotateNative2Celestial,
)
from astropy.time import Time
from erfa import ErfaWarning
from gwcs import WCS
from gwcs import coordinate_frames as cf
from numpy.polynomial import chebyshev, polynomial

from photutils_mgauss.simulation.instrument import Band
from photutils_mgauss.simulation.mock_psf import band_of
from photutils_mgauss.sky.observers import add_aberration, julian_years
from photutils_mgauss.sky.tangent_plane import (
    directions,
    local_axes,
    unit_vectors,
)
from photutils_mgauss.utils.validation import (
    as_floats,
    as_real,
    as_rng,
    shown,
)

_LIGHT_SPEED = 299792.458 * u.km / u.s
_LIGHT_YEARS = (u.au / _LIGHT_SPEED).to_value(u.yr)  # in one au
_MAS = np.radians(1 / 3.6e6)

# Table 2 of Nie et al.: when, on which detector, in which band.
_TABLE_2 = (
    ('2024-12-12T08:07:10', 24, 'i'),
    ('2026-05-30T17:27:18', 23, 'g'),
    ('2026-08-11T02:49:27', 8, 'g'),
    ('2026-08-11T05:50:40', 7, 'i'),
    ('2027-08-09T07:50:24', 24, 'i'),
    ('2027-08-09T09:19:18', 22, 'r'),
    ('2028-07-21T20:02:14', 9, 'r'),
)
# Which u^i v^j a cubic has.
_CUBIC = np.add(*np.indices((4, 4))) <= 3

NGP = (192.8595, 27.1283)  # the field of the paper [deg]


def source_vectors(sources, time):
    """Return the geocentric directions (3, n) of sources at a time."""
    radial = unit_vectors(*(_degrees(sources, name) for name in ('ra', 'dec')))
    east, north = local_axes(radial)
    earth = earth_at(time)[0]
    years = (time.tdb.jyear - _positions_year(sources)
             + earth @ radial * _LIGHT_YEARS)
    moved = radial + years * _MAS * (
        east * _column(sources, 'pmra', u.mas / u.yr)
        + north * _column(sources, 'pmdec', u.mas / u.yr))
    moved -= earth[:, None] * _column(sources, 'parallax', u.mas) * _MAS
    return moved / np.linalg.norm(moved, axis=0)


def _positions_year(sources):
    if 'ref_epoch' not in sources.colnames:
        return 2016.0
    return julian_years(sources['ref_epoch'], 'ref_epoch')


def _degrees(sources, name):
    if name not in sources.colnames:
        msg = (f'sources must have a column {name!r}, got '
               f'{sources.colnames}')
        raise ValueError(msg)
    return _column(sources, name, u.deg)


def _column(sources, name, unit, default=0.0):
    """Return a column as floats; plain numbers are in ``unit`` already."""
    if name not in sources.colnames:
        return np.full(len(sources), default)
    return np.asarray(u.Quantity(sources[name], unit).value, float)


def earth_at(time):
    """Return place [au] and velocity [c] of the Earth, barycentric."""
    place, velocity = get_body_barycentric_posvel('earth', time.tdb,
                                                  ephemeris='builtin')
    return (place.xyz.to_value(u.au),
            (velocity.xyz / _LIGHT_SPEED).to_value(u.one))


@dataclass(frozen=True, eq=False)
class Exposure:
    r"""
    When, where and through which filter an image is taken.

    A pixel is first moved by the distortion, cubic polynomials of its offset
    from the centre in units of the half diagonal, then turned and scaled
    onto the plane that touches the sky at the pointing; x grows to the west
    before the rotation.

    Parameters
    ----------
    time : `~astropy.time.Time` or str, optional
        The middle of the exposure; a str is UTC. Kept in TDB.
    band : str or Band, optional
        The filter.
    ra, dec : float, optional
        The ICRS coordinates of the centre of the detector [deg].
    rotation : float, optional
        From the y axis to the north, positive to the east [deg].
    scale : float, optional
        The true pixel scale in units of the nominal one.
    distortion : (2, 4, 4) array_like, optional
        The displacements of x and y [pix]: ``distortion[:, i, j]`` belongs
        to :math:`u^i v^j`. None is no distortion.
    detector : int, optional
        The number of the detector.
    aberration : bool, optional
        Whether stars are displaced by differential aberration. The WCS does
        not know of it.

    Raises
    ------
    ValueError
        If a value is not finite or a shape is wrong.

    Examples
    --------
    >>> from photutils_mgauss.simulation import Exposure
    >>> exposure = Exposure('2026-05-30T17:27:18', 'g', rotation=30)
    >>> wcs = exposure.wcs((512, 512), 0.074)
    >>> [round(float(angle), 4) for angle in wcs(255.5, 255.5)]
    [192.8595, 27.1283]
    """

    time: Time = '2026-05-30T17:27:18'
    band: Band = 'g'
    ra: float = NGP[0]
    dec: float = NGP[1]
    rotation: float = field(default=0.0, kw_only=True)
    scale: float = field(default=1.0, kw_only=True)
    distortion: np.ndarray = field(default=None, kw_only=True)
    detector: int = field(default=1, kw_only=True)
    aberration: bool = field(default=False, kw_only=True)

    def __post_init__(self):
        distortion = (np.zeros((2, 4, 4)) if self.distortion is None
                      else self.distortion)
        for name, value in (
                ('time', _tdb(self.time)), ('band', band_of(self.band)),
                ('distortion', as_floats(distortion, 'distortion',
                                         shape=(2, 4, 4))),
                ('ra', as_real(self.ra, 'ra') % 360),
                ('dec', as_real(self.dec, 'dec', minimum=-90, maximum=90)),
                ('rotation', as_real(self.rotation, 'rotation')),
                ('scale', as_real(self.scale, 'scale', above=0))):
            object.__setattr__(self, name, value)
        if self.distortion[:, ~_CUBIC].any():
            msg = ('distortion must be a cubic: distortion[:, i, j] must be '
                   '0 for i + j > 3')
            raise ValueError(msg)

    def __repr__(self):
        return (f'<Exposure: {self.band.name}, {self.time.utc.isot}, '
                f'ra={self.ra:.5f}, dec={self.dec:.5f}>')

    def wcs(self, shape, pixel_scale):
        """
        Make the WCS.

        Parameters
        ----------
        shape : (ny, nx) tuple of int
            The pixels of the image.
        pixel_scale : float
            The nominal side of a pixel [arcsec].

        Returns
        -------
        `~gwcs.wcs.WCS`
            With a distortion whose inverse is a polynomial fitted to it.
        """
        geometry = _Geometry(self, tuple(shape), pixel_scale)
        detector = cf.Frame2D(name='detector', unit=(u.pix, u.pix),
                              axes_order=(0, 1))
        sky = cf.CelestialFrame(name='icrs', reference_frame=ICRS(),
                                unit=(u.deg, u.deg))
        wcs = WCS([(detector, geometry.transform), (sky, None)])
        ny, nx = shape
        wcs.bounding_box = ((-0.5, nx - 0.5), (-0.5, ny - 0.5))
        wcs.pixel_shape = (nx, ny)
        return wcs

    def fits_header(self, shape, pixel_scale):
        """
        Return the WCS as TAN-SIP, which it is exactly.

        Parameters
        ----------
        shape, pixel_scale : tuple of int, float
            As for `wcs`.

        Returns
        -------
        `~astropy.io.fits.Header`
        """
        return _Geometry(self, tuple(shape), pixel_scale).header

    def pixels(self, sources, shape, pixel_scale):
        """
        Return where sources fall, whatever their distance from the image.

        Parameters
        ----------
        sources : `~astropy.table.QTable`
            With the columns ``ra`` and ``dec`` and optionally ``pmra``,
            ``pmdec``, ``parallax`` and ``ref_epoch`` (2016 by default).
        shape, pixel_scale : tuple of int, float
            As for `wcs`.

        Returns
        -------
        (2, n) `~numpy.ndarray`
            x and y, NaN for sources on the far side of the sky [pix].

        Raises
        ------
        ValueError
            If a column is missing.
        """
        vectors = source_vectors(sources, self.time)
        if self.aberration:
            # The telescope points at the displaced centre, so that only the
            # difference over the field is left.
            beta = earth_at(self.time)[1]
            centre = add_aberration(self._axes[0], beta)
            vectors = _turn(add_aberration(vectors, beta), centre,
                            self._axes[0])
        return _Geometry(self, tuple(shape), pixel_scale).pixels(vectors)

    @property
    def _axes(self):
        """The (3, 3) rows: towards the pointing, east and north."""
        a, d = np.radians([self.ra, self.dec])
        return np.array([
            [np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)],
            [-np.sin(a), np.cos(a), 0],
            [-np.sin(d) * np.cos(a), -np.sin(d) * np.sin(a), np.cos(d)]])


def _tdb(time):
    with warnings.catch_warnings():
        # Leap seconds of the future are not known; one is far below what
        # any motion could show.
        warnings.simplefilter('ignore', ErfaWarning)
        if not isinstance(time, Time):
            time = _read_time(time)
        return time.tdb


def _read_time(time):
    try:
        return Time(time, scale='utc')
    except ValueError as error:
        msg = f'time must be a Time or a date, got {shown(time)}'
        raise ValueError(msg) from error


def _turn(vectors, start, end):
    """Rotate vectors (3, n) by the shortest way that brings start to end."""
    axis = np.cross(start, end)
    cosine = start @ end
    cross = np.cross(axis, vectors, axisb=0, axisc=0)
    along = np.multiply.outer(axis, axis @ vectors)
    return vectors * cosine + cross + along / (1 + cosine)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """The way from pixels to the sky and back, for one image."""

    exposure: Exposure
    shape: tuple
    pixel_scale: float

    @property
    def centre(self):
        """The middle of the image (x, y) [pix]."""
        ny, nx = self.shape
        return np.array([(nx - 1) / 2, (ny - 1) / 2])

    @property
    def radius(self):
        """Half the diagonal, the unit of the distortion [pix]."""
        return np.hypot(*self.shape) / 2

    @property
    def matrix(self):
        """The (2, 2) matrix from pixels to degrees on the plane."""
        angle = np.radians(self.exposure.rotation)
        c, s = np.cos(angle), np.sin(angle)
        side = self.exposure.scale * self.pixel_scale / 3600
        return side * np.array([[-c, s], [s, c]])

    def displacement(self, x, y):
        """Return what the distortion adds to pixel positions, (2, ...)."""
        u_0, v_0 = self.centre
        return np.stack([
            polynomial.polyval2d((x - u_0) / self.radius,
                                 (y - v_0) / self.radius, c)
            for c in self.exposure.distortion])

    def pixels(self, vectors):
        """Return pixel positions (2, n) of directions (3, n)."""
        depth, east, north = self.exposure._axes @ vectors
        depth = np.where(depth > 0, depth, np.nan)
        plane = np.degrees(np.stack([east, north]) / depth)
        target = np.linalg.solve(self.matrix, plane)
        target += self.centre[:, None]
        return self.undistort(target)

    def undistort(self, target):
        """Return the pixels (2, n) that the distortion moves to a target."""
        # The displacement changes by a thousandth from pixel to pixel, so
        # each step gains three digits. Far outside the image the cubic is
        # not one-to-one, and the place does not matter.
        place = target
        for _ in range(8):
            place = target - self.displacement(*place)
        inside = np.abs(target - self.centre[:, None]) < 2 * self.radius
        return np.where(inside.all(axis=0), place, target)

    @cached_property
    def transform(self):
        """The astropy model from pixels to degrees."""
        exposure = self.exposure
        linear = AffineTransformation2D(
            self.matrix, translation=-self.matrix @ self.centre)
        return (self._distortion | linear | Pix2Sky_TAN()
                | RotateNative2Celestial(exposure.ra, exposure.dec, 180))

    @property
    def _distortion(self):
        if not self.exposure.distortion.any():
            return Identity(2)
        forward = self._polynomials(
            3, lambda x, y: np.stack([x, y]) + self.displacement(x, y))
        forward.inverse = self._polynomials(
            9, lambda x, y: self.undistort(np.stack([x, y])))
        return forward

    @property
    def header(self):
        """The WCS in the convention of SIP."""
        exposure = self.exposure
        header = fits.Header({'RADESYS': 'ICRS', 'LONPOLE': 180.0})
        for i, (kind, value, pixel) in enumerate((
                ('RA--', exposure.ra, self.centre[0]),
                ('DEC-', exposure.dec, self.centre[1])), start=1):
            header[f'CTYPE{i}'] = f'{kind}-TAN-SIP'
            header[f'CUNIT{i}'] = 'deg'
            header[f'CRVAL{i}'], header[f'CRPIX{i}'] = value, pixel + 1
            for j in (1, 2):
                header[f'CD{i}_{j}'] = self.matrix[i - 1, j - 1]
        for letter, terms in zip('AB', exposure.distortion, strict=True):
            header[f'{letter}_ORDER'] = 3
            for i, j in np.argwhere(terms):
                header[f'{letter}_{i}_{j}'] = (terms[i, j]
                                               / self.radius ** (i + j))
        return header

    def _polynomials(self, degree, function):
        """Return the model that interpolates a map (x, y) -> (2, n)."""
        nodes = 1.02 * chebyshev.chebpts1(2 * degree + 2)
        a, b = (grid.ravel() for grid in np.meshgrid(nodes, nodes))
        half = np.array(self.shape[::-1]) / 2
        values = function(*(self.centre[:, None]
                            + half[:, None] * np.stack([a, b])))
        domains = {f'{name}_domain': [c - h, c + h] for name, c, h
                   in zip('xy', self.centre, half, strict=True)}
        pair = [_fitted(degree, a, b, value, domains) for value in values]
        return Mapping((0, 1, 0, 1)) | pair[0] & pair[1]


def _fitted(degree, a, b, values, domains):
    """Return the polynomial through values at (a, b) in units of domains."""
    model = Polynomial2D(degree, **domains)
    powers = [tuple(int(n) for n in name[1:].split('_'))
              for name in model.param_names]
    design = np.stack([a**i * b**j for i, j in powers], axis=1)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    model.parameters = solution
    return model


def paper_exposures(ra=NGP[0], dec=NGP[1], *, offset=3.0, rotation=0.05,
                    scale=1e-4, distortion=0.5, aberration=False, rng=2):
    """
    Make the seven exposures of Table 2 of Nie et al.

    Times, bands and detectors are those of the table; pointing, orientation,
    scale and distortion of each exposure are drawn.

    Parameters
    ----------
    ra, dec : float, optional
        The centre of the field [deg]; by default that of the paper.
    offset : float, optional
        Standard deviation of the pointing along each axis [arcsec].
    rotation : float, optional
        Standard deviation of the rotation [deg].
    scale : float, optional
        Standard deviation of the scale, relative.
    distortion : float, optional
        Standard deviation of each quadratic and cubic coefficient [pix].
    aberration : bool, optional
        Whether differential aberration acts on the stars.
    rng : int or `~numpy.random.Generator`, optional
        The seed.

    Returns
    -------
    list of Exposure
        In the order of time; a slice of it is a shorter campaign.

    Raises
    ------
    ValueError
        If the centre is not on the sky.

    Examples
    --------
    >>> from photutils_mgauss.simulation import paper_exposures
    >>> exposures = paper_exposures()
    >>> [exposure.band.name for exposure in exposures]
    ['i', 'g', 'g', 'i', 'i', 'r', 'r']
    """
    rng = as_rng(rng)
    bent = _CUBIC & (np.add(*np.indices((4, 4))) >= 2)
    exposures = []
    for time, detector, band in _TABLE_2:
        east, north = offset * rng.standard_normal(2) / 3600
        centre = Exposure(time, band, ra, dec, detector=detector,
                          aberration=aberration)
        exposures.append(replace(
            _shifted(centre, east, north),
            rotation=rotation * rng.standard_normal(),
            scale=1 + scale * rng.standard_normal(),
            distortion=distortion * rng.standard_normal((2, 4, 4)) * bent))
    return exposures


def _shifted(exposure, east, north):
    """Point an exposure elsewhere; the offsets are on the plane [deg]."""
    vector = exposure._axes.T @ [1, np.radians(east), np.radians(north)]
    ra, dec = directions(vector)
    return replace(exposure, ra=float(ra), dec=float(dec))
