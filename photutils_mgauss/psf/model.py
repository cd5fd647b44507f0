r"""
A sum of correlated Gaussians as an astropy model.

The weights of K Gaussians are held as K - 1 stick-breaking fractions
:math:`f_k`, so that any values make a PSF of unit flux,

.. math::

    \omega_k = f_k \prod_{j<k} (1 - f_j), \qquad f_K = 1 .
"""
import warnings
from functools import partial

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import kernels
from photutils_mgauss.files.storage import storable
from photutils_mgauss.psf.base import (
    PARAMETER_COLUMNS,
    PSFModel,
    PSFParameter,
    flat_points,
    plain_positions,
    split_flux,
    strip_units,
    with_unit,
)
from photutils_mgauss.psf.grid import Grid
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.rows import kernel_rows_of_stddevs
from photutils_mgauss.utils.validation import as_integer

__all__ = ['MultiGaussianPSFModel']

# Fits may step anywhere; beyond these limits shapes stay at the limit. What a
# user sets is refused there.
_MIN_STDDEV = 1e-3
_MAX_RHO = 1 - 1e-9

# Bounds that astropy's fitters respect when shapes are free.
_STDDEV_BOUNDS = (0.05, None)
_RHO_BOUNDS = (-0.9999, 0.9999)
_FRACTION_BOUNDS = (0, 1)


@storable(model={'name': '', 'pixel_integrated': ''},
          parameters=PARAMETER_COLUMNS)
class MultiGaussianPSFModel(PSFModel):
    r"""
    A PSF that is a sum of K correlated Gaussians.

    .. math::

        M(x, y) = F \sum_k \omega_k\, G(x - x_0, y - y_0 \,|\,
        \alpha_k, \beta_k, \gamma_k)

    with G of Eq. 3 of Nie et al. Use it wherever astropy takes a
    `~astropy.modeling.Fittable2DModel` or photutils takes a PSF model.

    The parameters are scalars, in this order: ``flux``, ``x_0``, ``y_0``;
    ``fraction_1`` to ``fraction_{K-1}`` (stick-breaking fractions of the
    weights; any value in (0, 1) is valid); ``x_mean_k``, ``y_mean_k``,
    ``x_stddev_k``, ``y_stddev_k``, ``rho_k`` for k = 1 to K [pix]. By
    default all parameters except the first three are fixed; see
    `free_shape`.

    Parameters
    ----------
    mixture : GaussianMixture, optional
        The shape of the PSF. With ``None`` it is ``n_components``
        concentric round Gaussians, as a start for a fit.
    n_components : int, optional
        The number K of Gaussians if no mixture is given.
    flux : float or `~astropy.units.Quantity`, optional
        The total flux.
    x_0, y_0 : float, optional
        The position of the star, which is the origin of the mixture's means
        [pix].
    pixel_integrated : bool, optional
        Whether the model integrates the mixture over each unit pixel.
        Leave it off if the mixture already includes the pixel, as mixtures
        made from ePSFs, PSFEx models or images of stars do.
    **kwargs
        Values of the shape parameters and the keywords of
        `~astropy.modeling.Model`: ``name``, ``meta``, ``fixed``, ``bounds``.

    Raises
    ------
    TypeError
        If the mixture is not a `GaussianMixture`, or a keyword is unknown.
    ValueError
        If ``n_components`` is less than 1.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel
    >>> mixture = GaussianMixture.from_stddevs(
    ...     [0.8, 0.2], [[0, 0], [0, 0]], [[1, 1.1], [2, 2.2]], [0.1, 0])
    >>> model = MultiGaussianPSFModel(mixture, flux=100, x_0=5, y_0=4)
    >>> model
    <MultiGaussianPSFModel(flux=100, x_0=5, y_0=4, n_components=2)>
    >>> float(model(5, 4))
    12.356648744438267
    """

    def __init__(self, mixture=None, *, n_components=3, flux=1, x_0=0, y_0=0,
                 pixel_integrated=False, **kwargs):
        if mixture is None:
            mixture = _default_mixture(n_components)
        elif not isinstance(mixture, GaussianMixture):
            msg = f'mixture must be a GaussianMixture, got {mixture!r:.80}'
            raise TypeError(msg)
        values = _shape_values(mixture)
        self.param_names = ('flux', 'x_0', 'y_0', *values)
        self._n_components = mixture.n_components
        self._stepped = False
        self._pixel_integrated = bool(pixel_integrated)
        signed = (mixture.weights < 0).any()
        for name, value in values.items():
            parameter = PSFParameter(name, default=value, fixed=True,
                                     bounds=_shape_bounds(name, signed))
            parameter.model = self
            parameter._validator = partial(_check_shape, name, signed)
            self.__dict__[name] = parameter
        super().__init__(flux=flux, x_0=x_0, y_0=y_0, **kwargs)
        self._finish()

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self._n_components

    @property
    def _state(self):
        return self._n_components, self._pixel_integrated

    def __repr__(self):
        return self._described()

    @property
    def _shape_parameters(self):
        return [one.value for one in self._all_parameters()[3:]]

    @property
    def weights(self):
        """The fraction of the flux in each Gaussian, (K,)."""
        return _Shape(self._shape_parameters).weights

    @property
    def mixture(self):
        """The shape of the PSF, a `GaussianMixture`."""
        shape = _Shape(self._shape_parameters)
        return GaussianMixture.from_stddevs(shape.weights, shape.means,
                                            shape.stddevs, shape.rho)

    @property
    def fwhm(self):
        """The full width at half maximum of the mixture [pix]."""
        return self.mixture.fwhm

    @property
    def grid(self):
        """The mixture as a grid of one node, see ``PSFModel``."""
        return Grid.of_mixture(self.mixture)

    def __call__(self, x, y, **kwargs):
        """
        Evaluate the model at pixel positions x and y.

        Parameters
        ----------
        x, y : array_like
            Pixel positions; they broadcast.
        **kwargs
            Keywords of astropy's models, such as ``with_bounding_box``.

        Returns
        -------
        `~numpy.ndarray`
            The model, in the unit of ``flux``.
        """
        # A fit without bounds, or an assignment to all parameters at once,
        # may have left the range that single parameters are held to.
        if self._stepped:
            self._warn_of_range()
        return super().__call__(x, y, **kwargs)

    def _array_to_parameters(self):
        super()._array_to_parameters()
        self._stepped = True

    def _warn_of_range(self):
        """Warn of the first parameter whose value no Gaussian has."""
        self._stepped = False
        signed = self.bounds.get('fraction_1') == (None, None)
        for name in self.param_names[3:]:
            value = getattr(self, name).value
            reason = _fault(name, signed, np.asarray(value))
            if reason:
                warnings.warn(
                    f'{name} is {value:g} and must be {reason}; the nearest '
                    'valid shape is drawn. Give the fit bounds',
                    AstropyUserWarning, stacklevel=3)
                return

    def free_shape(self):
        """
        Return a copy with a free shape, except the first Gaussian's mean.

        This mean stays fixed because a common shift of all means has the
        same effect as ``x_0`` and ``y_0``: a fit of both does not
        converge.

        Returns
        -------
        MultiGaussianPSFModel

        Examples
        --------
        >>> from photutils_mgauss import MultiGaussianPSFModel
        >>> model = MultiGaussianPSFModel(n_components=1).free_shape()
        >>> [name for name, fixed in model.fixed.items() if not fixed]
        ['flux', 'x_0', 'y_0', 'x_stddev_1', 'y_stddev_1', 'rho_1']
        """
        free = self.copy()
        for name in self.param_names[3:]:
            getattr(free, name).fixed = name in ('x_mean_1', 'y_mean_1')
        return free

    def convolve(self, kernel):
        """
        Return the model convolved with a Gaussian.

        Parameters
        ----------
        kernel : (2, 2) array_like or GaussianMixture
            See `GaussianMixture.convolve`.

        Returns
        -------
        MultiGaussianPSFModel
            With the same flux, position and pixel integration; its shape is
            fixed.

        Examples
        --------
        >>> from photutils_mgauss import MultiGaussianPSFModel
        >>> model = MultiGaussianPSFModel(n_components=1)
        >>> float(model.convolve([[3, 0], [0, 0]]).x_stddev_1.value)
        2.0
        """
        return MultiGaussianPSFModel(
            self.mixture.convolve(kernel), flux=self.flux.quantity
            if self.flux.unit else self.flux.value, x_0=self.x_0.value,
            y_0=self.y_0.value, pixel_integrated=self._pixel_integrated)

    def evaluate(self, x, y, flux, x_0, y_0, *shape):
        """
        Evaluate the model.

        Parameters
        ----------
        x, y : array_like
            Pixel positions.
        flux, x_0, y_0 : float or array_like
            Flux and position of the star; they broadcast with x and y.
        *shape : float
            The shape parameters, in the order of ``param_names``.

        Returns
        -------
        `~numpy.ndarray`
            The model, in the unit of ``flux``.
        """
        rows = _rows_of(strip_units([x, *shape])[1:])
        x, y, x_0, y_0 = plain_positions(x, y, x_0, y_0)
        flux, unit = split_flux(flux)
        dx = np.subtract(x, x_0, dtype=float)
        dy = np.subtract(y, y_0, dtype=float)
        (dx, dy), lattice = flat_points(dx, dy)
        out = np.empty(dx.size)
        kernels.evaluate(dx, dy, rows, self._pixel_integrated, out)
        return with_unit(flux * out.reshape(lattice), unit)

    def fit_deriv(self, x, y, flux, x_0, y_0, *shape):
        """
        Evaluate the derivatives by all parameters.

        Parameters
        ----------
        x, y : array_like
            Pixel positions.
        flux, x_0, y_0, *shape : float
            The parameters, in the order of ``param_names``.

        Returns
        -------
        list of `~numpy.ndarray`
            One array of the shape of x for each parameter, with what is
            tied to it. The derivatives by fixed parameters, which no fit
            uses, are set to zero and not computed.
        """
        tied, free = [], []
        for one in self._all_parameters():
            is_tied = bool(one.tied)
            tied.append(is_tied)
            free.append(is_tied or not one.fixed)
        values = flux, x_0, y_0, *shape
        flux = float(np.squeeze(split_flux(flux)[0]))
        dx = np.asarray(x, float) - np.squeeze(x_0)
        dy = np.asarray(y, float) - np.squeeze(y_0)
        (dx, dy), lattice = flat_points(dx, dy)
        if any(free[3:]):
            columns = self._all_derivatives(dx, dy, flux, _Shape(shape), free)
        else:
            columns = self._position_derivatives(dx, dy, flux,
                                                 _rows_of(shape))
        zero = np.zeros(lattice)
        columns = [column.reshape(lattice) if is_free else zero
                   for column, is_free in zip(columns, free, strict=False)]
        columns += [zero] * (len(free) - len(columns))
        return self._along_ties(columns, values) if any(tied) else columns

    def _position_derivatives(self, dx, dy, flux, rows):
        out = np.empty((3, dx.size))
        kernels.evaluate_slopes(dx, dy, rows, self._pixel_integrated, out)
        out[1:] *= flux
        return list(out)

    def _all_derivatives(self, dx, dy, flux, shape, free):
        derivatives = np.empty((self._n_components, 6, dx.size))
        kernels.derivatives(dx, dy, shape.unit_rows, self._pixel_integrated,
                            derivatives)
        value, gx, gy = np.tensordot(shape.weights, derivatives[:, :3], 1)
        columns = [value, -flux * gx, -flux * gy]
        columns += list(flux * shape.weight_slopes() @ derivatives[:, 0])
        for k in range(self._n_components):
            first = len(columns)
            columns += shape.derivatives(k, flux, derivatives[k]) if any(
                free[first:first + 5]) else [value] * 5
        return columns

    def _to_tables(self):
        return {'model': {'name': [str(self.name or '')],
                          'pixel_integrated': [self._pixel_integrated]},
                'parameters': self._parameter_table()}

    @classmethod
    def _from_tables(cls, tables):
        model, parameters = tables['model'], tables['parameters']
        keywords = cls._parameter_keywords(parameters)
        # flux, x_0, y_0, K - 1 fractions and 5 K more.
        return cls(n_components=(len(parameters['name']) - 2) // 6,
                   pixel_integrated=model['pixel_integrated'][0],
                   name=str(model['name'][0]) or None, **keywords)

    def _half_size(self):
        """Half the width and height of the bounding box [pix]."""
        shape = _Shape(self._shape_parameters)
        reach = np.abs(shape.means) + self.bbox_factor * shape.stddevs
        return reach.max(axis=0) + 0.5 * self._pixel_integrated

    def _length_names(self):
        lengths = ('x_mean', 'y_mean', 'x_stddev', 'y_stddev')
        return ['x_0', 'y_0', *(name for name in self.param_names
                                if name.rpartition('_')[0] in lengths)]


class _Shape:
    """The shape parameters of a model as arrays, valid whatever they are."""

    def __init__(self, parameters):
        values = _numbers(parameters)
        n = (values.size + 1) // 6
        self.fractions = values[:n - 1]
        # Left of each break, the length of stick that remains.
        self.rest = np.append(1, np.cumprod(1 - self.fractions))
        self.weights = self.rest * np.append(self.fractions, 1)
        table = values[n - 1:].reshape(n, 5)
        self.means = table[:, :2]
        self.raw_stddevs = table[:, 2:4]
        self.stddevs = np.maximum(np.abs(self.raw_stddevs), _MIN_STDDEV)
        self.rho = np.clip(table[:, 4], -_MAX_RHO, _MAX_RHO)

    @property
    def unit_rows(self):
        """The kernels' rows of Gaussians of unit flux each, (K, 6)."""
        return kernel_rows_of_stddevs(1.0, self.means, self.stddevs, self.rho)

    def weight_slopes(self):
        """Return d weight_j / d fraction_i, (K - 1, K)."""
        n = self.weights.size
        slopes = np.zeros((n - 1, n))
        breaks = np.append(self.fractions, 1)
        for i in range(n - 1):
            slopes[i, i] = self.rest[i]
            left = -self.rest[i]
            for j in range(i + 1, n):
                slopes[i, j] = left * breaks[j]
                left *= 1 - breaks[j]
        return slopes

    def derivatives(self, k, flux, unit):
        """
        Return the columns of the mean, stddevs and rho of Gaussian k.

        The derivatives by the covariance follow from the heat equation.
        """
        _, gx, gy, gxx, gxy, gyy = flux * self.weights[k] * unit
        sx, sy = self.stddevs[k]
        rho = self.rho[k]
        sign_x, sign_y = np.sign(self.raw_stddevs[k])
        return [-gx, -gy, sign_x * (sx * gxx + rho * sy * gxy),
                sign_y * (sy * gyy + rho * sx * gxy), sx * sy * gxy]


def _numbers(parameters):
    """Return scalar parameters, each a number or an array of one, flat."""
    try:
        return np.array(parameters, dtype=float).ravel()
    except ValueError:  # numbers and arrays of one, mixed
        return np.array([float(np.squeeze(p)) for p in parameters])


def _rows_of(parameters):
    """Return the kernels' rows (K, 6) of shape parameters."""
    values = _numbers(parameters)
    rows = np.empty(((values.size + 1) // 6, 6))
    kernels.model_rows(values, _MIN_STDDEV, _MAX_RHO, rows)
    return rows


def _default_mixture(n_components):
    """Return concentric Gaussians, each twice as wide as the one before."""
    n = as_integer(n_components, 'n_components', minimum=1)
    weights = 0.5 ** np.arange(1, n + 1)
    weights[-1] *= 2
    stddevs = np.repeat(2.0 ** np.arange(n), 2).reshape(n, 2)
    return GaussianMixture.from_stddevs(weights, np.zeros((n, 2)), stddevs,
                                        np.zeros(n))


def _shape_values(mixture):
    """Return the shape parameters of a mixture by name, in order."""
    values = {f'fraction_{k}': value
              for k, value in enumerate(_fractions(mixture.weights), 1)}
    table = np.column_stack([mixture.means, mixture.stddevs, mixture.rho])
    names = ('x_mean', 'y_mean', 'x_stddev', 'y_stddev', 'rho')
    for k, row in enumerate(table, 1):
        values |= {f'{name}_{k}': value
                   for name, value in zip(names, row, strict=True)}
    return values


def _fractions(weights):
    """
    Return the K - 1 stick-breaking fractions of the weights.

    Where nothing of the stick is left the fraction does not matter, unless
    negative weights follow: then there are no fractions.
    """
    rest = 1 - np.append(0, np.cumsum(weights[:-1]))[:-1]
    empty = np.abs(rest) < 1e-12
    if (np.abs(weights[:-1][empty]) > 1e-9).any():
        msg = ('mixture must not have weights that sum to 1 before the last '
               f'Gaussian, got {weights.tolist()}; put negative ones first')
        raise ValueError(msg)
    return np.where(empty, 0.5, weights[:-1] / np.where(empty, 1, rest))


def _check_shape(name, signed, _, value):
    """Raise if the parameter of a shape has a value that no Gaussian has."""
    reason = _fault(name, signed, np.asarray(value, float))
    # photutils puts 1 into all parameters, and calls the model, before it has
    # their values; a correlation of 1 is drawn as the largest valid one.
    if reason and not np.all(value == 1):
        msg = f'{name} must be {reason}, got {value}'
        raise ValueError(msg)


def _fault(name, signed, value):
    """Return what a value of the shape should be if it is not, or None."""
    kind = name.rpartition('_')[0]
    if kind == 'rho' and not (np.abs(value) < 1).all():
        return 'a correlation inside (-1, 1)'
    if kind.endswith('stddev') and not ((value > 0)
                                        & np.isfinite(value)).all():
        return 'a standard deviation, positive and finite'
    if kind == 'fraction' and not signed and not ((value >= 0)
                                                  & (value <= 1)).all():
        return ('a fraction in [0, 1] (negative weights come with a mixture '
                'that has them)')
    return None if np.isfinite(value).all() else 'finite'


def _shape_bounds(name, signed):
    kind = name.rpartition('_')[0]
    if kind == 'fraction':
        return (None, None) if signed else _FRACTION_BOUNDS
    if kind.endswith('stddev'):
        return _STDDEV_BOUNDS
    return _RHO_BOUNDS if kind == 'rho' else (None, None)
