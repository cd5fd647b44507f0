r"""
Stars measured on the sky: a table's positions and fluxes, and several images.

Where n images show the same star, its one position on the sky and its flux in
each image are fitted to all their pixels together. With the Jacobian
:math:`J_k` of the pixel of image k by the sky, the normal matrices
:math:`A_k` of the single images add up,

.. math::

    A = \sum_k J_k^T A_k J_k ,

so nothing is lost that averaging catalogues would lose, and an image too
shallow to show the star by itself helps, too.
"""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from photutils_mgauss.photometry.box_pixels import ScaledImage
from photutils_mgauss.photometry.engine import (
    as_model,
    is_fixed_shape,
    psf_arrays,
)
from photutils_mgauss.photometry.joint_pixels import (
    TOLERANCE,
    JointFit,
    JointImages,
    Views,
    boxes_around,
    covariances,
    minimize_all,
)
from photutils_mgauss.sky.observers import add_aberration
from photutils_mgauss.sky.pixel_grid import PixelGrid
from photutils_mgauss.sky.tangent_plane import (
    TangentPlane,
    directions,
    unit_vectors,
)
from photutils_mgauss.sky.wcs import (
    check_celestial,
    invert_wcs,
    pixel_jacobian,
    pixel_to_vectors,
)
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.saturation import without_saturated
from photutils_mgauss.utils.star_columns import check_table, column_values
from photutils_mgauss.utils.validation import as_shape, shown
from photutils_mgauss.utils.waiting import waiting

__all__ = ['add_sky_positions', 'fit_many', 'to_flux_densities']

# The flux density of AB magnitude 0 [Jy].
_AB_ZERO = u.ABflux.to(u.Jy)


def add_sky_positions(table, wcs):
    """
    Return a table of photometry with the positions on the sky.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        With ``x_fit``, ``y_fit``, ``x_err``, ``y_err`` [pix] and, if at hand,
        ``xy_cov`` [pix^2], taken as zero otherwise.
    wcs : APE 14 WCS
        A gwcs or `astropy.wcs.WCS` with celestial axes.

    Returns
    -------
    `~astropy.table.QTable`
        A copy with the columns ``ra`` and ``dec`` [deg] (ICRS), ``ra_error``
        (along the parallel, that is, times cos dec), ``dec_error`` [mas] and
        ``radec_cov`` [mas^2].

    Raises
    ------
    TypeError, ValueError
        If ``wcs`` is not celestial, or a column is missing.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from astropy.wcs import WCS
    >>> from photutils_mgauss import add_sky_positions
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    >>> wcs.wcs.cdelt = -1e-5, 1e-5
    >>> stars = QTable({'x_fit': [-1.0], 'y_fit': [-1.0], 'x_err': [0.1],
    ...                 'y_err': [0.2]})
    >>> sky = add_sky_positions(stars, wcs)
    >>> sky['ra_error'], sky['dec_error']
    (<Quantity [3.6] mas>, <Quantity [7.2] mas>)
    """
    check_celestial(wcs)
    check_table(table, 'table', ('x_err', 'x_fit', 'y_err', 'y_fit'))
    x, y = (column_values(table, name, u.pix) for name in ('x_fit', 'y_fit'))
    vectors = pixel_to_vectors(wcs, x, y)
    covariance = np.zeros((len(table), 2, 2))
    for i, name in enumerate(('x_err', 'y_err')):
        covariance[:, i, i] = column_values(table, name, u.pix) ** 2
    if 'xy_cov' in table.colnames:
        cross = column_values(table, 'xy_cov', u.pix**2)
        covariance[:, 0, 1] = covariance[:, 1, 0] = cross
    out = table.copy()
    plane = TangentPlane.around(vectors)
    jacobian = np.moveaxis(pixel_jacobian(wcs, plane, x, y), -1, 0)
    _add_columns(out, vectors, plane, _turn(covariance, jacobian))
    return out


def to_flux_densities(table, *, pixel_area=None, wcs=None, magnitudes=False):
    r"""
    Return a table of photometry with its fluxes in Jy.

    A flux in an image of surface brightness is a sum over pixels, in MJy/sr;
    times the area of a pixel on the sky it is a flux density. AB magnitudes
    are :math:`-2.5 \log_{10}(f_\nu / 3631\,\mathrm{Jy})`.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        With ``flux_fit`` and ``flux_err`` and, if at hand, ``flux_init``, in
        MJy/sr or a unit like it, or flux densities already.
    pixel_area : `~astropy.units.Quantity`, optional
        The area of a pixel, as in the keyword ``PIXAR_SR`` [sr].
    wcs : APE 14 WCS, optional
        Where there is no ``pixel_area``, that at each star is taken from
        this gwcs or `astropy.wcs.WCS`.
    magnitudes : bool, optional
        Whether to add the columns ``mag_ab`` and ``mag_ab_err`` [mag], NaN
        where the flux is not positive.

    Returns
    -------
    `~astropy.table.QTable`
        A copy. Backgrounds stay as they are.

    Raises
    ------
    ValueError
        If a column is missing, or fluxes are of another kind, or of surface
        brightness while the area of a pixel is not known.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from photutils_mgauss import to_flux_densities
    >>> stars = QTable({'flux_fit': [40.0] * u.MJy / u.sr,
    ...                 'flux_err': [0.4] * u.MJy / u.sr})
    >>> stars = to_flux_densities(stars, pixel_area=9.1e-14 * u.sr,
    ...                           magnitudes=True)
    >>> stars['flux_fit']
    <Quantity [3.64e-06] Jy>
    >>> stars['mag_ab'].round(3), stars['mag_ab_err'].round(3)
    (<Quantity [22.497] mag>, <Quantity [0.011] mag>)
    """
    check_table(table, 'table', ('flux_err', 'flux_fit'))
    out = table.copy()
    unit = getattr(table['flux_fit'], 'unit', None) or u.one
    if unit.is_equivalent(u.Jy):
        area = 1.0
    elif unit.is_equivalent(u.Jy / u.sr):
        area = _pixel_areas(table, pixel_area, wcs)
    else:
        msg = ('table must have flux_fit in a unit like MJy/sr or Jy, got '
               f'{unit.to_string() or "no unit"}')
        raise ValueError(msg)
    for name in {'flux_init', 'flux_fit', 'flux_err'} & set(out.colnames):
        out[name] = (u.Quantity(out[name]) * area).to(u.Jy)
    if magnitudes:
        _add_magnitudes(out)
    return out


def _pixel_areas(table, pixel_area, wcs):
    """Return the area of a pixel, of one for all or at each star."""
    if pixel_area is not None:
        try:
            area = u.Quantity(pixel_area, u.sr)
        except (TypeError, u.UnitConversionError) as reason:
            msg = ('pixel_area must be a solid angle, as 9.1e-14 * u.sr, got '
                   f'{pixel_area!r:.80}')
            raise ValueError(msg) from reason
        if not (area > 0).all():
            msg = f'pixel_area must be positive, got {pixel_area}'
            raise ValueError(msg)
        return area
    if wcs is None:
        msg = ('fluxes of surface brightness need pixel_area (the keyword '
               'PIXAR_SR) or wcs, got neither')
        raise ValueError(msg)
    check_celestial(wcs)
    x, y = (column_values(table, name, u.pix) for name in ('x_fit', 'y_fit'))
    plane = TangentPlane.around(pixel_to_vectors(wcs, x, y))
    jacobian = np.moveaxis(pixel_jacobian(wcs, plane, x, y), -1, 0)
    return np.abs(np.linalg.det(jacobian)) * u.mas**2


def _add_magnitudes(table):
    flux, error = (np.asarray(table[name].to_value(u.Jy), float)
                   for name in ('flux_fit', 'flux_err'))
    flux = np.where(flux > 0, flux, np.nan)
    table['mag_ab'] = -2.5 * np.log10(flux / _AB_ZERO) * u.mag
    table['mag_ab_err'] = 2.5 / np.log(10) * error / flux * u.mag


def _turn(covariance, jacobian):
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def _add_columns(table, vectors, plane, covariance):
    """Add positions and their errors, from the covariance in a plane."""
    local = np.moveaxis(plane.local_jacobian(plane.project(vectors)), -1, 0)
    good = np.isfinite(local).all(axis=(1, 2))
    to_local = np.full(local.shape, np.nan)
    to_local[good] = np.linalg.inv(local[good])
    covariance = _turn(covariance, to_local)
    ra, dec = directions(vectors)
    table['ra'], table['dec'] = ra * u.deg, dec * u.deg
    table['ra_error'] = np.sqrt(covariance[:, 0, 0]) * u.mas
    table['dec_error'] = np.sqrt(covariance[:, 1, 1]) * u.mas
    table['radec_cov'] = covariance[:, 0, 1] * u.mas**2


def fit_many(images, coordinates, *, fit_shape=11, common_flux=False):
    """
    Fit each star to the pixels of several images together.

    Stars are taken as isolated and the images as free of background.

    Parameters
    ----------
    images : sequence of (data, psf, wcs)
        ``data`` is a (ny, nx) array_like, or an NDData with its uncertainty;
        its own mask counts, its unit comes back: see :ref:`pixels`. ``psf``
        is a `GriddedMixturePSF`, `MultiGaussianPSFModel` or `MixtureField`;
        ``wcs`` a gwcs or `astropy.wcs.WCS` with celestial axes. The units of
        data, if any, are to be the same.
    coordinates : (n,) `~astropy.coordinates.SkyCoord`
        Where the stars are, to a pixel or so.
    fit_shape : int or (ny, nx) tuple of int, optional
        The pixels of each star in each image.
    common_flux : bool, optional
        Whether a star has the same flux in all images.

    Returns
    -------
    `~astropy.table.QTable`
        ``id``, ``ra``, ``dec`` [deg], ``ra_error``, ``dec_error`` [mas],
        ``radec_cov`` [mas^2], ``flux_fit`` and ``flux_err`` ((n, images), or
        (n,) for a common flux; NaN where an image does not show the star),
        ``n_pixels_fit``, ``reduced_chi2`` and ``converged``. Errors are from
        the inverse of the joint matrix; without uncertainties they are scaled
        by the scatter of the residuals.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.wcs import WCS
    >>> from photutils_mgauss import (GaussianMixture, MultiGaussianPSFModel,
    ...                               fit_many)
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    >>> wcs.wcs.crpix, wcs.wcs.cdelt = (11, 11), (-1e-5, 1e-5)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> data = mixture.render(21, 10, 10, flux=100)
    >>> stars = fit_many([(data, MultiGaussianPSFModel(mixture), wcs)] * 2,
    ...                  SkyCoord([3e-6], [0], unit='deg'))
    >>> round(float(stars['ra'][0].value % 360), 9)
    0.0
    """
    fit_shape = as_shape(fit_shape, 'fit_shape')
    images = list(images)
    if not images:
        msg = 'images must have at least one element, got none'
        raise ValueError(msg)
    if not isinstance(coordinates, SkyCoord):
        msg = f'coordinates must be a SkyCoord, got {coordinates!r:.80}'
        raise TypeError(msg)
    with waiting('fit_many'):
        pixels, psfs, frames, units = zip(*map(_read_image, images),
                                          strict=True)
        if any(unit != units[0] for unit in units):
            msg = f'images must have one unit, got {units}'
            raise ValueError(msg)
        joint, scale = joint_images(
            pixels, psfs, np.zeros(len(images), int) if common_flux else
            np.arange(len(images)), fit_sky=False)
        vectors = np.asarray(coordinates.reshape(-1).icrs.cartesian.xyz.value)
        plane = TangentPlane.around(vectors)
        state, converged = _fit_places(joint, frames, plane,
                                       plane.project(vectors), fit_shape)
        weighted = all(one.error is not None for one in pixels)
        return _table(state, converged, plane, scale, units[0], weighted)


def joint_images(pixels, psfs, shared, *, fit_sky, factors=None):
    """
    Return images as fits of many take them, and the unit of their light.

    Parameters
    ----------
    pixels : sequence of `~photutils_mgauss.utils.image.PixelData`
        They are not copied. Pixels with errors that are not positive and
        finite are not used.
    psfs : sequence of `~photutils_mgauss.psf.base.PSFModel`
        Of fixed shape.
    shared : (E,) `~numpy.ndarray` of int
        The number of the flux of each image.
    fit_sky : bool
        Whether each star has a sky in each image.
    factors : (E,) sequence of float, optional
        What turns the units of the pixels into one; all 1 by default.

    Returns
    -------
    `~photutils_mgauss.photometry.joint_pixels.JointImages`
    float
        The light that counts as 1 there: of the order of the noise, so that
        nothing is lost to rounding whatever the unit is.
    """
    factors = np.ones(len(pixels)) if factors is None else factors
    scale = float(np.median([
        _typical(one.with_error().error) * factor
        for one, factor in zip(pixels, factors, strict=True)]))
    images = [ScaledImage(one, scale / factor)
              for one, factor in zip(pixels, factors, strict=True)]
    return JointImages(images, [psf_arrays(psf) for psf in psfs],
                       np.asarray(shared), fit_sky), scale


def _typical(error):
    """Return the median of errors that are positive and finite, else 1."""
    sample = error[::max(1, len(error) // 100)]
    good = sample[(sample > 0) & np.isfinite(sample)]
    return float(np.median(good)) if good.size else 1.0


def _fit_places(joint, frames, plane, origin, fit_shape):
    """Return the state of all stars at rest, and who converged."""
    n, rest = origin.shape[1], np.eye(2)[:, :, None]
    shapes = [image.pixels.shape for image in joint.images]
    values = np.ascontiguousarray(origin.T)[:, None]
    fit = None
    for _ in range(3):
        # Within a fit the WCS is a linear map: make it anew at the result.
        views = views_of(frames, plane, values, [rest] * len(frames))
        if fit is not None:
            moved = np.abs(views.pixels - fit.views.places(
                values, np.arange(n)))
            if not (np.nan_to_num(moved) > TOLERANCE).any():
                break
        boxes = (boxes_around(views.pixels, fit_shape, shapes)
                 if fit is None else fit.boxes)
        fit = JointFit(joint, views, boxes, np.ones((n, 1, 2), bool))
        state, converged = minimize_all(fit)
        values = state.values
    return state, converged


def views_of(frames, plane, values, factors, velocities=None):
    """
    Return where groups of stars are seen.

    Parameters
    ----------
    frames : (E,) sequence of APE 14 WCS
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane`
    values : (g, m, p) `~numpy.ndarray`
        Parameters of which each image sees a place in the plane.
    factors : (E,) sequence of (2, p, g m) or (2, p, 1) `~numpy.ndarray`
        The derivatives of the place in the plane by the parameters.
    velocities : (E,) sequence of (3,) `~numpy.ndarray` or None, optional
        Of observers whose aberration the images show [c].

    Returns
    -------
    `~photutils_mgauss.photometry.joint_pixels.Views`
    """
    n, m, p = values.shape
    velocities = [None] * len(frames) if velocities is None else velocities
    pixels = np.empty((n, len(frames), m, 2))
    slopes = np.zeros((n, len(frames), m, 2, p))
    flat = values.reshape(n * m, p)
    for k, wcs in enumerate(frames):
        place = np.einsum('apn,np->an', np.broadcast_to(
            factors[k], (2, p, n * m)), flat)
        xy, inverse = _pixels_of(wcs, plane, place, velocities[k])
        pixels[:, k] = xy.reshape(n, m, 2)
        slope = np.einsum('nab,bpn->nap', inverse, np.broadcast_to(
            factors[k], (2, p, n * m)))
        slopes[:, k] = np.nan_to_num(slope).reshape(n, m, 2, p)
    return Views(values, pixels, slopes)


def _pixels_of(wcs, plane, place, velocity):
    """Return pixels (n, 2) and d(pixel)/d(plane) (n, 2, 2); NaN and 0."""
    vectors = plane.deproject(place)
    if velocity is not None:
        vectors = add_aberration(vectors, velocity)
    x, y = invert_wcs(wcs, SkyCoord(*directions(vectors), unit='deg'))
    forward = np.moveaxis(pixel_jacobian(wcs, plane, x, y), -1, 0)
    good = np.isfinite(forward).all(axis=(1, 2))
    inverse = np.zeros(forward.shape)
    inverse[good] = np.linalg.inv(forward[good])
    return np.column_stack([x, y]), inverse


def _table(state, converged, plane, scale, unit, weighted):
    """Return the table of `fit_many`."""
    n, n_fluxes = len(state.values), state.fluxes.shape[1]
    covariance, flux_variance = covariances(state)
    n_pixels = state.n_pixels.sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        dof = (n_pixels - 2 * (np.einsum('nii->ni', state.matrix) > 0).all(
            axis=1) - (state.known[:, :, 0, 0] > 0).sum(axis=1))
        scatter = np.where(dof > 0, state.chi2 / dof, np.nan)
    factor = 1.0 if weighted else scatter[:, None]
    table = QTable({'id': np.arange(1, n + 1)})
    _add_columns(table, plane.deproject(state.values[:, 0].T), plane,
                 covariance * np.reshape(factor, (-1, 1, 1)))
    errors = np.sqrt(flux_variance[:, :, 0] * factor) * scale
    flux = np.where(np.isfinite(errors), state.fluxes[:, :, 0] * scale,
                    np.nan)
    if n_fluxes == 1 and state.n_pixels.shape[1] > 1:
        flux, errors = flux[:, 0], errors[:, 0]
    unit = 1 if unit is None else unit
    table['flux_fit'], table['flux_err'] = flux * unit, errors * unit
    table['n_pixels_fit'] = n_pixels
    table['reduced_chi2'] = scatter if weighted else np.nan
    table['converged'] = converged
    return table


@dataclass(frozen=True, eq=False)
class Field:
    """
    Many images of one field, read.

    ``pixels`` are `PixelData` with errors, ``psfs`` models of fixed shape or
    None, ``grid`` is the `~photutils_mgauss.sky.pixel_grid.PixelGrid` that
    all have in common, ``years`` (E,) are the times, or None where images
    come without, ``bands`` (E,) names of filters, or ''.
    """

    pixels: list
    psfs: list
    unit: object
    grid: PixelGrid
    years: np.ndarray | None
    bands: np.ndarray

    def time_since_mean(self):
        """Return how long after the mean time images were taken (E,) [yr]."""
        if self.years is None or np.ptp(self.years) == 0:
            msg = ('images must be ImageEpoch of two times at least for '
                   'motions=True, got '
                   f'{"no times" if self.years is None else "one time"}')
            raise ValueError(msg)
        return self.years - self.years.mean()


def read_field(images, saturation=None):
    """
    Read images of one field, (data, psf, wcs) or ImageEpoch.

    Pixels from the level ``saturation`` on are masked.

    Returns
    -------
    Field

    Raises
    ------
    TypeError, ValueError
        If something is wrong with them.
    """
    images = list(images)
    if not images:
        msg = 'images must have at least one element, got none'
        raise ValueError(msg)
    pixels, psfs, frames = zip(*map(_read_any, images), strict=True)
    units = [one.unit for one in pixels]
    if any(unit != units[0] for unit in units):
        msg = f'images must have one unit, got {units}'
        raise ValueError(msg)
    grid = PixelGrid.of(frames, [one.shape for one in pixels])
    years = [getattr(one, 'year', None) for one in images]
    return Field([without_saturated(one, saturation).with_error()
                  for one in pixels], list(psfs), units[0],
                 grid, None if None in years else np.array(years),
                 np.array([getattr(one, 'band', None) or ''
                           for one in images]))


def _read_any(entry):
    """Return pixels, PSF or None, and WCS of one image of a field."""
    if hasattr(entry, 'pixels') and hasattr(entry, 'wcs'):
        if entry.velocity is not None:
            msg = ('images must come without observer, got '
                   f'{entry.observer!r:.80}: aberration is not known here')
            raise ValueError(msg)
        return entry.pixels, entry.model, entry.wcs
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        msg = ('images must hold (data, psf, wcs) or ImageEpoch, got '
               f'{shown(entry)}')
        raise TypeError(msg)
    data, psf, wcs = entry
    check_celestial(wcs)
    return (read_pixels(data, name='data of images'),
            None if psf is None else fixed_psf(psf), wcs)


def grid_positions(stars, grid):
    """Return columns and rows (2, n) of a table with ra, dec or SkyCoord."""
    if isinstance(stars, SkyCoord):
        place = stars.reshape(-1).icrs
        ra, dec = place.ra.deg, place.dec.deg
    else:
        check_table(stars, 'stars', ('dec', 'ra'))
        ra, dec = (column_values(stars, name, u.deg)
                   for name in ('ra', 'dec'))
    return grid.positions(unit_vectors(ra, dec))


def add_places(table, grid, columns, rows, covariance):
    """Add positions on a grid (n,), of some covariance (n, 2, 2) [pix^2]."""
    vectors = grid.vectors(columns, rows)
    _add_columns(table, vectors, grid.plane, _turn(covariance[:, :2, :2],
                                                   grid.matrix))


def add_motions(table, grid, columns, rows, covariance, rates, year):
    """
    Add proper motions of stars at positions of a grid.

    ``covariance`` (n, 4, 4) is that of positions and ``rates`` (n, 2)
    [pix / yr]; NaN where these are not known.
    """
    local = np.moveaxis(grid.plane.local_inverse(grid.plane.project(
        grid.vectors(columns, rows))), -1, 0) @ grid.matrix
    motion = np.einsum('nij,nj->ni', local, rates)
    spread = _turn(covariance[:, 2:, 2:], local)
    known = np.isfinite(motion).all(axis=1)
    for i, name in enumerate(('pmra', 'pmdec')):
        table[name] = motion[:, i] * u.mas / u.yr
        table[f'{name}_error'] = np.where(known, np.sqrt(
            spread[:, i, i]), np.nan) * u.mas / u.yr
    table['pmra_pmdec_corr'] = np.where(known, spread[:, 0, 1] / np.sqrt(
        spread[:, 0, 0] * spread[:, 1, 1]), np.nan)
    table['ref_epoch'] = np.full(len(table), year) * u.yr
    table.meta['TIMESYS'] = 'TDB'


def _read_image(entry):
    """Return the pixels, PSF, WCS and unit of one (data, psf, wcs)."""
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        msg = f'images must hold (data, psf, wcs), got {shown(entry)}'
        raise ValueError(msg)
    data, psf, wcs = entry
    check_celestial(wcs)
    pixels = read_pixels(data, name='data of images')
    return pixels, fixed_psf(psf), wcs, pixels.unit


def fixed_psf(psf):
    """Return a PSF as a model of fixed shape, or raise."""
    psf = as_model(psf, 'the PSF of images')
    if not is_fixed_shape(psf):
        msg = f'images must hold PSFs of fixed shape, got {psf!r:.80}'
        raise TypeError(msg)
    return psf
