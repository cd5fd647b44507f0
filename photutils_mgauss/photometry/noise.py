r"""
The noise of pixels, and the best that any measurement can do with it.

Eq. 10 of Nie et al. gives the variance of a pixel in electrons,

.. math::

    \sigma_i^2 = f_i + \sigma_\mathrm{RD}^2 + \sigma_\mathrm{sky}^2 ,

with the light :math:`f_i` of the star. In the unit of an image that holds
electrons times :math:`1 / c`, where c is the gain, the exposure time or their
product, the same variance is
:math:`f_i / c + (\sigma_\mathrm{RD}^2 + \sigma_\mathrm{sky}^2) / c^2`.
"""
from dataclasses import dataclass

import numpy as np
from photutils.utils import calc_total_error

from photutils_mgauss import kernels
from photutils_mgauss.photometry.engine import (
    as_model,
    cut_boxes,
    psf_arrays,
)
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.model import MultiGaussianPSFModel
from photutils_mgauss.utils.image import (
    read_level,
    read_quantity,
    read_values,
    with_unit,
)
from photutils_mgauss.utils.validation import (
    as_columns,
    as_floats,
    as_real,
    as_shape,
)

__all__ = ['CramerRao', 'cramer_rao', 'pixel_error']

# Pixels are counted with 32 bits.
_FARTHEST = 1e9


def _electrons(gain, exposure_time):
    """Return the electrons in one unit of the image."""
    gain = as_real(gain, 'gain', above=0)
    if exposure_time is None:
        return gain
    return gain * as_real(exposure_time, 'exposure_time', above=0)


def background_error(*, sky=0, read_noise=0, gain=1, exposure_time=None):
    """
    Return the error of a pixel without stars, in the unit of the image.

    Parameters
    ----------
    sky : float or array_like, optional
        The level of the sky, in the unit of the image.
    read_noise : float, optional
        The noise of the readout [electron].
    gain : float, optional
        Electrons in a count; 1 for images in electrons.
    exposure_time : float, optional
        If given, the image is a rate and this is its exposure time [s].

    Returns
    -------
    float or `~numpy.ndarray`
        The standard deviation.

    Examples
    --------
    >>> from photutils_mgauss.photometry import background_error
    >>> float(background_error(sky=96, read_noise=2))
    10.0
    """
    electrons = _electrons(gain, exposure_time)
    read_noise = as_real(read_noise, 'read_noise', minimum=0)
    sky = as_floats(sky, 'sky')
    if (sky < 0).any():
        msg = f'sky must not be negative, got {sky.min()}'
        raise ValueError(msg)
    return np.sqrt(sky / electrons + (read_noise / electrons) ** 2)[()]


def pixel_error(light, *, sky=0, read_noise=0, gain=1, exposure_time=None):
    """
    Return the errors of the pixels of an image (Eq. 10 of Nie et al.).

    Parameters
    ----------
    light : (ny, nx) array_like or NDData
        The light above the sky: the image itself, as in the paper, or a model
        of it. Errors from the image are too small where noise made a pixel
        faint, and weighted fluxes come out low; with a model they do not.
        Negative light counts as none. The error of a masked pixel is NaN, a
        unit comes back: see :ref:`pixels`.
    sky, read_noise, gain, exposure_time : optional
        As for ``background_error``; ``sky`` may be an image.

    Returns
    -------
    (ny, nx) `~numpy.ndarray` or `~astropy.units.Quantity`
        Standard deviations in the unit of the image, by
        `photutils.utils.calc_total_error`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not a number, or out of range.

    Examples
    --------
    >>> from photutils_mgauss import pixel_error
    >>> pixel_error([[0.0, 300.0]], sky=96, read_noise=2)
    array([[10., 20.]])
    >>> pixel_error([[0.0, 3.0]], sky=0.96, read_noise=2, exposure_time=100)
    array([[0.1, 0.2]])
    """
    light, unit = read_quantity(light, 'light')
    sky = read_values(sky, 'sky', unit)
    background = background_error(sky=sky, read_noise=read_noise, gain=gain,
                                  exposure_time=exposure_time)
    if np.shape(background) not in ((), light.shape):
        msg = (f'sky must be a number or have the shape {light.shape} of '
               f'light, got {np.shape(background)}')
        raise ValueError(msg)
    background = np.broadcast_to(background, light.shape)
    return with_unit(calc_total_error(light, background,
                                      _electrons(gain, exposure_time)), unit)


@dataclass(frozen=True, eq=False)
class CramerRao:
    """
    The smallest errors that an unbiased measurement of stars can have.

    Attributes
    ----------
    covariance : (n, 3, 3) `~numpy.ndarray`
        Of flux, x and y of each star.
    unit : `~astropy.units.UnitBase` or None
        Of the flux.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, cramer_rao
    >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 4]]])
    >>> bound = cramer_rao(psf, 1e4, fit_shape=31)
    >>> bound.flux_err, bound.x_err, bound.y_err
    (array([100.]), array([0.01]), array([0.02]))
    >>> bound.covariance.shape
    (1, 3, 3)
    """

    covariance: np.ndarray
    unit: object = None

    def __repr__(self):
        n = len(self.covariance)
        flux, x, y = (np.median(one) for one in (self.flux_err, self.x_err,
                                                 self.y_err))
        return (f'<CramerRao of {n} star{"s" * (n != 1)}, median errors: '
                f'flux {flux:.3g}, x {x:.2g} pix, y {y:.2g} pix>')

    @property
    def flux_err(self):
        """The errors of the fluxes, (n,)."""
        return with_unit(np.sqrt(self.covariance[:, 0, 0]), self.unit)

    @property
    def x_err(self):
        """The errors of x, (n,) [pix]."""
        return np.sqrt(self.covariance[:, 1, 1])

    @property
    def y_err(self):
        """The errors of y, (n,) [pix]."""
        return np.sqrt(self.covariance[:, 2, 2])


def cramer_rao(psf, flux, sky=0, *, x=0, y=0, read_noise=0, gain=1,
               exposure_time=None, fit_shape=15, free_sky=False,
               jointly=False):
    r"""
    Forecast the errors of positions and fluxes.

    The Cramer-Rao bound is the inverse of the Fisher matrix

    .. math::

        I_{ab} = \sum_i \frac{1}{\sigma_i^2}
        \frac{\partial m_i}{\partial a} \frac{\partial m_i}{\partial b}

    with the variance of Eq. 10 of Nie et al. at the true model m.

    Parameters
    ----------
    psf : GaussianMixture, GriddedMixturePSF or MultiGaussianPSFModel
        The PSF. A mixture is taken to contain the pixel.
    flux : (n,) array_like
        The total fluxes, in the unit of the image. A unit comes back.
    sky : float, optional
        The level of the sky, in the unit of the image.
    x, y : (n,) array_like, optional
        The positions [pix].
    read_noise, gain, exposure_time : float, optional
        As for ``background_error``.
    fit_shape : int or (ny, nx) tuple of int, optional
        The pixels used of each star.
    free_sky : bool, optional
        Whether the sky of each star (of all, if ``jointly``) is fitted, too.
    jointly : bool, optional
        Whether all stars are in one image and fitted together, each pixel
        used once: the bound with neighbours. By default each is alone.

    Returns
    -------
    CramerRao

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, cramer_rao
    >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> bound = cramer_rao(psf, [1e4, 1e6])
    >>> bound.x_err
    array([0.01 , 0.001])
    """
    flux, unit = read_quantity(flux, 'flux')
    flux, x, y = as_columns(flux=flux, x=x, y=y)
    if not flux.size:
        msg = 'flux, x and y must hold at least one star, got none'
        raise ValueError(msg)
    sky = as_real(read_level(sky, 'sky', unit), 'sky', minimum=0)
    level = background_error(sky=sky,
                             read_noise=read_noise, gain=gain,
                             exposure_time=exposure_time)
    noise = level**2, _electrons(gain, exposure_time)
    stars = _StarDerivatives(psf, x, y, as_shape(fit_shape, 'fit_shape'))
    if jointly:
        return CramerRao(_joint_bound(stars, flux, noise, free_sky), unit)
    return CramerRao(np.array([
        _bound(stars.own(i), flux[i], noise, free_sky)
        for i in range(x.size)]), unit)


class _StarDerivatives:
    """The PSF and its derivatives by position in the pixels of each star."""

    def __init__(self, psf, x, y, fit_shape):
        far = np.abs([x, y]) > _FARTHEST
        if far.any():
            msg = (f'x and y must be within {_FARTHEST:g} pixels of the '
                   f'origin, got {np.array([x, y])[far][0]:g}')
            raise ValueError(msg)
        self.x, self.y = x, y
        self.psf = _kernel_arrays(psf)
        huge = (np.iinfo(np.int32).max, np.iinfo(np.int32).max)
        self.corner = np.floor([x.min(), y.min()]) - max(fit_shape)
        self.boxes = cut_boxes(x - self.corner[0], y - self.corner[1],
                               fit_shape, huge)
        self.boxes[:, 0] += int(self.corner[1])
        self.boxes[:, 1] += int(self.corner[0])

    def star(self, i, box):
        """Return the derivatives (3, pixels) of star i in a box."""
        out = np.empty((3, box[2] * box[3]))
        kernels.star_derivatives(self.x[i], self.y[i], box, self.psf,
                                 kernels.Tiling.empty(box[3]), out)
        return out

    def own(self, i):
        return self.star(i, self.boxes[i])


def _kernel_arrays(psf):
    if isinstance(psf, GaussianMixture):
        psf = MultiGaussianPSFModel(psf)
    return psf_arrays(as_model(psf, 'psf'))


def _bound(derivatives, flux, noise, free_sky):
    """Return the covariance (3, 3) of one star by itself."""
    columns = [derivatives[0], flux * derivatives[1], flux * derivatives[2]]
    if free_sky:
        columns.append(np.ones(derivatives.shape[1]))
    columns = np.array(columns)
    variance = noise[0] + np.maximum(flux * derivatives[0], 0) / noise[1]
    return _inverse_blocks((columns / variance) @ columns.T, 1)[0]


def _joint_bound(stars, flux, noise, free_sky):
    """Return the covariances (n, 3, 3) of stars that share pixels."""
    n = flux.size
    size = 3 * n + bool(free_sky)
    fisher = np.zeros((size, size))
    seen = set()
    for box in stars.boxes:
        pixels = [(row, column)
                  for column in range(box[1], box[1] + box[3])
                  for row in range(box[0], box[0] + box[2])]
        new = np.array([pixel not in seen for pixel in pixels])
        seen.update(pixels)
        if not new.any():
            continue
        derivatives = np.array([stars.star(i, box)[:, new]
                                for i in range(n)])
        derivatives[:, 1:] *= flux[:, None, None]
        variance = noise[0] + np.maximum(
            flux @ derivatives[:, 0], 0) / noise[1]
        columns = derivatives.reshape(3 * n, -1)
        if free_sky:
            columns = np.vstack([columns, np.ones(columns.shape[1])])
        fisher += (columns / variance) @ columns.T
    return _inverse_blocks(fisher, n)


def _inverse_blocks(fisher, n):
    """Return the first n diagonal (3, 3) blocks of the inverse matrix."""
    scale = np.sqrt(np.diag(fisher))
    # The position of a star without flux is not bound by the data.
    known = scale > 0
    inverse = np.diag(np.where(known, 0, np.inf))
    scale = np.outer(scale[known], scale[known])
    inverse[np.ix_(known, known)] = np.linalg.inv(
        fisher[np.ix_(known, known)] / scale) / scale
    return np.array([inverse[3 * i:3 * i + 3, 3 * i:3 * i + 3]
                     for i in range(n)])
