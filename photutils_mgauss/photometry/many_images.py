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
import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from photutils_mgauss import kernels
from photutils_mgauss.photometry.engine import (
    as_model,
    cut_boxes,
    is_fixed_shape,
    kernel_image,
    psf_arrays,
)
from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.wcs import (
    check_celestial,
    invert_wcs,
    pixel_jacobian,
    pixel_to_vectors,
)
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.star_columns import check_table, column_values
from photutils_mgauss.utils.validation import as_shape

__all__ = ['add_sky_positions', 'fit_many', 'to_flux_densities']

_MAX_STEPS = 100

# The flux density of AB magnitude 0 [Jy].
_AB_ZERO = u.ABflux.to(u.Jy)

# Of the next step [pix], as for single images.
_TOLERANCE = 1e-6


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
        A copy with the columns ``ra`` and ``dec`` [deg] (ICRS), ``ra_err``
        (along the parallel, that is, times cos dec), ``dec_err`` [mas] and
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
    >>> sky['ra_err'], sky['dec_err']
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
    table['ra_err'] = np.sqrt(covariance[:, 0, 0]) * u.mas
    table['dec_err'] = np.sqrt(covariance[:, 1, 1]) * u.mas
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
        ``id``, ``ra``, ``dec`` [deg], ``ra_err``, ``dec_err`` [mas],
        ``radec_cov`` [mas^2], ``flux_fit`` and ``flux_err`` ((n, images), or
        (n,) for a common flux; NaN where an image does not show the star),
        ``n_pixels_fit``, ``reduced_chi2`` and ``converged``. Errors are from
        the inverse of the joint matrix; without uncertainties they are scaled
        by the scatter of the residuals.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid, or an error not positive under a star.

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
    scene = _Images(images, coordinates, as_shape(fit_shape, 'fit_shape'),
                    bool(common_flux))
    state = scene.start()
    for _ in range(3):
        # Within a fit the WCS is a linear map: make it anew at the result.
        state, converged = _minimize(scene, state)
        moved = scene.linearize(state)
        if not (moved > _TOLERANCE).any():
            break
    return scene.table(scene.evaluate(state.values), converged)


class _Equations:
    """Values (n, p) and the normal equations there, star by star."""

    def __init__(self, values, chi2, matrix, gradient):
        self.values = values
        self.chi2 = chi2
        self.matrix = matrix
        self.gradient = gradient

    def merge(self, other, where):
        """Return these equations, those of other where it says so."""
        def choose(a, b):
            return np.where(where.reshape(-1, *[1] * (a.ndim - 1)), b, a)
        return _Equations(*(choose(getattr(self, name), getattr(other, name))
                            for name in ('values', 'chi2', 'matrix',
                                         'gradient')))


class _Images:
    """The images, and where the stars are on them."""

    def __init__(self, images, coordinates, fit_shape, common_flux):
        images = list(images)
        if not images:
            msg = 'images must have at least one element, got none'
            raise ValueError(msg)
        if not isinstance(coordinates, SkyCoord):
            msg = f'coordinates must be a SkyCoord, got {coordinates!r:.80}'
            raise TypeError(msg)
        self.images, self.psfs, self.wcs, units = zip(
            *map(_read_image, images), strict=True)
        self.unit = units[0]
        if any(unit != self.unit for unit in units):
            msg = f'images must have one unit, got {units}'
            raise ValueError(msg)
        self.n_fluxes = 1 if common_flux else len(images)
        icrs = coordinates.reshape(-1).icrs
        vectors = np.asarray(icrs.cartesian.xyz.value)
        self.plane = TangentPlane.around(vectors)
        self.origin = self.plane.project(vectors).T
        self._place(self.origin)
        self.boxes = [_boxes(xy, fit_shape, image.data.shape) for xy, image
                      in zip(self.pixels, self.images, strict=True)]

    def _place(self, sky):
        """Find pixels and Jacobians at places (n, 2) in the plane."""
        self.sky = sky.copy()
        self.pixels, self.jacobians = [], []
        place = SkyCoord(*directions(self.plane.deproject(sky.T)), unit='deg')
        for wcs in self.wcs:
            x, y = invert_wcs(wcs, place)
            forward = np.moveaxis(pixel_jacobian(wcs, self.plane, x, y), -1, 0)
            good = np.isfinite(forward).all(axis=(1, 2))
            inverse = np.zeros(forward.shape)
            inverse[good] = np.linalg.inv(forward[good])
            self.pixels.append(np.column_stack([x, y]))
            self.jacobians.append(inverse)

    def linearize(self, state):
        """Map the WCS anew; return by how many pixels stars moved, (n,)."""
        sky = state.values[:, :2]
        before = [self._positions(k, sky) for k in range(len(self.images))]
        self._place(sky)
        return np.max([np.nan_to_num(np.abs(a - b)).max(axis=1) for a, b in
                       zip(before, self.pixels, strict=True)], axis=0)

    def _positions(self, k, sky):
        shift = np.einsum('nij,nj->ni', self.jacobians[k], sky - self.sky)
        return self.pixels[k] + shift

    def _single(self, k, sky, flux):
        """Return the equations of image k alone."""
        n, image = len(sky), self.images[k]
        xy = self._positions(k, sky)
        seen = self.boxes[k][:, 2:].all(axis=1)
        values = np.column_stack([flux, np.where(seen[:, None], xy, 0.0)])
        single = kernels.SingleEquations(
            np.empty(n), np.empty((n, 3, 3)), np.empty((n, 3)),
            np.empty(n, np.int64))
        kernels.star_equations(image, self.boxes[k], values, self.psfs[k],
                               single)
        if (single.n_pixels < 0).any():
            msg = ('images must have positive and finite errors under the '
                   f'stars, got one that is not in image {k}')
            raise ValueError(msg)
        return single

    def start(self):
        """Return the equations at the linear fluxes at the coordinates."""
        n = len(self.origin)
        flux = np.ones((n, self.n_fluxes))
        curve, slope = np.zeros((2, n, self.n_fluxes))
        for k in range(len(self.images)):
            f = k % self.n_fluxes
            single = self._single(k, self.origin, flux[:, f])
            curve[:, f] += single.matrices[:, 0, 0]
            slope[:, f] += single.gradients[:, 0]
        flux += slope / np.where(curve > 0, curve, 1)
        return self.evaluate(np.hstack([self.origin, flux]))

    def evaluate(self, values):
        """Return the joint equations at values (n, 2 + fluxes)."""
        n, size = values.shape
        chi2 = np.zeros(n)
        matrix, gradient = np.zeros((n, size, size)), np.zeros((n, size))
        self.n_pixels = np.zeros(n, np.int64)
        for k in range(len(self.images)):
            f = 2 + k % self.n_fluxes
            single = self._single(k, values[:, :2], values[:, f])
            # From (flux, x, y) of the image to (sky, flux) of the star.
            turn = np.zeros((n, 3, size))
            turn[:, 0, f] = 1
            turn[:, 1:, :2] = self.jacobians[k]
            matrix += np.einsum('nia,nij,njb->nab', turn, single.matrices,
                                turn)
            gradient += np.einsum('nia,ni->na', turn, single.gradients)
            chi2 += single.chi2
            self.n_pixels += single.n_pixels
        return _Equations(values, chi2, matrix, gradient)

    def pixel_length(self, step):
        """Return the length of steps (n, p) in pixels, or relative flux."""
        return np.max([np.abs(np.einsum('nij,nj->ni', jacobian, step[:, :2]))
                       .max(axis=1) for jacobian in self.jacobians], axis=0)

    def table(self, state, converged):
        n, size = state.values.shape
        covariance = np.full((n, size, size), np.nan)
        for i in range(n):
            covariance[i] = _inverse(state.matrix[i])
        with np.errstate(divide='ignore', invalid='ignore'):
            free = np.count_nonzero(np.diagonal(
                state.matrix, axis1=1, axis2=2) > 0, axis=1)
            dof = self.n_pixels - free
            scatter = np.where(dof > 0, state.chi2 / dof, np.nan)
        weighted = all(image.error.size for image in self.images)
        if not weighted:
            covariance *= scatter[:, None, None]
        table = QTable({'id': np.arange(1, n + 1)})
        vectors = self.plane.deproject(state.values[:, :2].T)
        _add_columns(table, vectors, self.plane, covariance[:, :2, :2])
        errors = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, 2:])
        flux = np.where(np.isfinite(errors), state.values[:, 2:], np.nan)
        if self.n_fluxes == 1 and len(self.images) > 1:
            flux, errors = flux[:, 0], errors[:, 0]
        unit = 1 if self.unit is None else self.unit
        table['flux_fit'], table['flux_err'] = flux * unit, errors * unit
        table['n_pixels_fit'] = self.n_pixels
        table['reduced_chi2'] = scatter if weighted else np.nan
        table['converged'] = converged
        return table


def _read_image(entry):
    """Return the image, PSF arrays, WCS and unit of one (data, psf, wcs)."""
    if len(entry) != 3:
        msg = f'images must hold (data, psf, wcs), got {len(entry)} things'
        raise ValueError(msg)
    data, psf, wcs = entry
    check_celestial(wcs)
    psf = as_model(psf)
    if not is_fixed_shape(psf):
        msg = f'images must hold PSFs of fixed shape, got {psf!r:.80}'
        raise TypeError(msg)
    pixels = read_pixels(data, name='data of images')
    image = kernel_image(pixels.data, pixels.error, pixels.mask)
    return image, psf_arrays(psf), wcs, pixels.unit


def _boxes(xy, fit_shape, data_shape):
    near = ((xy > -100) & (xy < np.array(data_shape[::-1]) + 100)).all(axis=1)
    boxes = np.zeros((len(xy), 4), np.int64)
    boxes[near] = cut_boxes(*xy[near].T, fit_shape, data_shape)
    return boxes


def _inverse(matrix):
    """Return the inverse, NaN where nothing is known of a parameter."""
    known = np.diag(matrix) > 0
    out = np.full(matrix.shape, np.nan)
    scale = np.sqrt(np.diag(matrix)[known])
    if known.any():
        scaled = matrix[np.ix_(known, known)] / np.outer(scale, scale)
        if np.linalg.cond(scaled) < 1e14:
            out[np.ix_(known, known)] = (np.linalg.inv(scaled)
                                         / np.outer(scale, scale))
    return out


def _minimize(scene, state):
    """Minimize chi2 of all stars; return the state and who converged."""
    n = len(state.values)
    damping = np.zeros(n)
    done = np.zeros(n, bool)
    for _ in range(_MAX_STEPS):
        step = _steps(state, damping)
        # No star moves farther than a pixel at a time.
        length = scene.pixel_length(step)
        step *= np.minimum(1, 1 / np.maximum(length, 1e-300))[:, None]
        step[done] = 0
        trial = scene.evaluate(state.values + step)
        better = trial.chi2 <= state.chi2 * (1 + 1e-12) + 1e-300
        done |= (length < _TOLERANCE) & (damping < 1)
        gain = _gain(state, trial, step)
        state = state.merge(trial, better & ~done)
        damping = np.where(better, next_dampings(damping, gain),
                           np.maximum(10 * damping, 1e-3))
        if done.all():
            break
    return state, done


def _gain(state, trial, step):
    """Return what steps brought over what the normal equations promised."""
    expected = (2 * np.einsum('ni,ni->n', step, state.gradient)
                - np.einsum('ni,nij,nj->n', step, state.matrix, step))
    # Of a smaller fall nothing is left after rounding: keep the damping.
    known = expected > 1e-9 * state.chi2
    return np.divide(state.chi2 - trial.chi2, expected, where=known,
                     out=np.full(len(step), kernels.POOR_GAIN))


def next_dampings(damping, gain):
    """Return what `kernels.next_damping` does, for many fits (n,) at once."""
    return np.select(
        [gain < kernels.POOR_GAIN, gain < kernels.FAIR_GAIN, damping > 1e-4],
        [np.maximum(4 * damping, 1e-2), damping, damping / 10], 0.0)


def _steps(state, damping):
    """Return the Levenberg-Marquardt steps (n, p) of all stars."""
    diagonal = np.diagonal(state.matrix, axis1=1, axis2=2)
    scale = np.sqrt(np.where(diagonal > 0, diagonal, 1))
    scaled = state.matrix / (scale[:, :, None] * scale[:, None, :])
    scaled += np.einsum('n,ij->nij', damping, np.eye(scale.shape[1]))
    # What no pixel knows of stays where it is.
    scaled += np.where(diagonal > 0, 0, 1)[:, :, None] * np.eye(
        scale.shape[1])
    steps = np.linalg.pinv(scaled, rcond=1e-12, hermitian=True) @ (
        state.gradient / scale)[..., None]
    return steps[..., 0] / scale
