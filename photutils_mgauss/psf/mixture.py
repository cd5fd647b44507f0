r"""
Mixtures of correlated two-dimensional Gaussians (Nie et al., Eqs. 2-3).

Positions are (x, y) in pixels relative to the star. In the paper's symbols
``weights`` are :math:`\omega`, ``means`` :math:`\alpha`, ``stddevs``
:math:`\beta` and ``rho`` :math:`\gamma`.
"""
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.files.storage import storable
from photutils_mgauss.psf.integrals import half_maximum_width, polar_integral
from photutils_mgauss.psf.rows import kernel_rows, matrices
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.notebook import with_picture
from photutils_mgauss.utils.validation import (
    as_floats,
    as_real,
    as_shape,
    in_pixels,
    real_array,
)

__all__ = ['GaussianMixture', 'Moments']


class Moments(NamedTuple):
    """The flux centroid (2,) [pix] and covariance (2, 2) [pix^2]."""

    mean: np.ndarray
    covariance: np.ndarray


@storable(components={'weight': '', 'mean': 'pix', 'covariance': 'pix2'})
@dataclass(frozen=True, eq=False, repr=False)
class GaussianMixture(ComparedByValue):
    r"""
    A unit-flux sum of K correlated Gaussians, centred on the star.

    .. math::

        P(x, y) = \sum_k \omega_k\, \frac{1}{2\pi\sqrt{\det\Sigma_k}}
        \exp\left[-\tfrac12 (\mathbf{r} - \boldsymbol\alpha_k)^T
        \Sigma_k^{-1} (\mathbf{r} - \boldsymbol\alpha_k)\right],
        \quad \mathbf{r} = (x, y)

    which is Eqs. 2-3 of Nie et al. with :math:`\Sigma_{xx} = \beta_x^2`,
    :math:`\Sigma_{xy} = \gamma \beta_x \beta_y`,
    :math:`\Sigma_{yy} = \beta_y^2`.

    The mixture copies its input and never changes: a new PSF is a new object.
    Two mixtures are equal if all their numbers are, in the same order.

    Parameters
    ----------
    weights : (K,) array_like
        The fraction of the flux in each Gaussian. They sum to 1 within 1e-10
        (weights of lower precision than float64 are normalised). Negative
        weights are allowed.
    means : (K, 2) array_like
        The centres (x, y) relative to the star [pix].
    covariances : (K, 2, 2) array_like
        The covariance matrices [pix^2], symmetric and positive definite.

    Raises
    ------
    TypeError
        If an argument is not an array of numbers.
    ValueError
        If a shape is wrong, a value is not finite, the weights do not sum to
        1, or a covariance matrix is not symmetric and positive definite.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture
    >>> psf = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
    ...                       [[[1, 0.1], [0.1, 1]], [[4, 0], [0, 5]]])
    >>> float(psf.evaluate(0, 0))
    0.1350741229949339
    >>> float(psf.render((15, 15), 7.2, 6.9).sum())
    0.9998186131897795
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray

    def __post_init__(self):
        weights = _unit_sum(self.weights)
        k = weights.size
        means = as_floats(self.means, 'means', shape=(k, 2))
        covariances = as_floats(self.covariances, 'covariances',
                                shape=(k, 2, 2))
        _check_covariances(covariances, 'covariances')
        for name, array in (('weights', weights), ('means', means),
                            ('covariances', covariances)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __reduce__(self):
        # Rebuilding keeps the arrays read-only, which copying them does not.
        return type(self), (self.weights, self.means, self.covariances)

    def __repr__(self):
        return (f'<GaussianMixture of {self.n_components}, weights '
                f'{np.array2string(self.weights, precision=3)}>')

    def _repr_html_(self):
        return with_picture(repr(self), lambda ax: self.plot(ax=ax))

    def plot(self, *, radius=None, pixel_integrated=False, ax=None):
        """
        Show the mixture on a logarithmic scale of four decades.

        Parameters
        ----------
        radius : float, optional
            Half the width of the image [pix]; None follows the size of the
            mixture.
        pixel_integrated : bool, optional
            Whether to integrate the mixture over pixels.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting.fit import plot_mixture
        return plot_mixture(self, radius=radius, ax=ax,
                            pixel_integrated=pixel_integrated)

    def _to_tables(self):
        return {'components': {'weight': self.weights, 'mean': self.means,
                               'covariance': self.covariances}}

    @classmethod
    def _from_tables(cls, tables):
        columns = tables['components']
        n = len(columns['weight'])
        return cls(columns['weight'], columns['mean'].reshape(n, 2),
                   columns['covariance'].reshape(n, 2, 2))

    @classmethod
    def from_stddevs(cls, weights, means, stddevs, rho=0):
        """
        Make a mixture from standard deviations and correlations.

        Parameters
        ----------
        weights : (K,) array_like
            The fraction of the flux in each Gaussian.
        means : (K, 2) array_like
            The centres (x, y) relative to the star [pix].
        stddevs : (K, 2) array_like
            The standard deviations along x and y [pix], positive.
        rho : float or (K,) array_like, optional
            The correlation coefficients, in (-1, 1); one number stands for
            all.

        Returns
        -------
        GaussianMixture

        Raises
        ------
        ValueError
            As for `GaussianMixture`, or if a standard deviation is not
            positive or a correlation not inside (-1, 1).

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture.from_stddevs([1], [[0, 0]], [[1, 2]], [0.5])
        >>> psf.covariances[0]
        array([[1., 1.],
               [1., 4.]])
        """
        stddevs = as_floats(stddevs, 'stddevs', shape=(None, 2))
        rho = as_floats(rho, 'rho', finite=False)
        rho = as_floats(np.full(len(stddevs), rho) if rho.ndim == 0 else rho,
                        'rho', shape=(len(stddevs),))
        if not (stddevs > 0).all():
            msg = f'stddevs must be positive, got {stddevs.min()}'
            raise ValueError(msg)
        if not (np.abs(rho) < 1).all():
            msg = (f'rho must be inside (-1, 1), got '
                   f'{rho[np.abs(rho).argmax()]}')
            raise ValueError(msg)
        cross = rho * stddevs[:, 0] * stddevs[:, 1]
        xx, yy = stddevs.T**2
        return cls(weights, means, matrices(xx, cross, yy))

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self.weights.size

    @property
    def stddevs(self):
        """The standard deviations along x and y, (K, 2) [pix]."""
        return np.sqrt(self.covariances[:, [0, 1], [0, 1]])

    @property
    def rho(self):
        """The correlation coefficients, (K,)."""
        return self.covariances[:, 0, 1] / self.stddevs.prod(axis=1)

    @cached_property
    def fwhm(self):
        """
        The full width at half maximum [pix], sampled, not integrated.

        The diameter of the circle with the area inside the contour at half of
        the peak.
        """
        return half_maximum_width(self)

    @cached_property
    def rows(self):
        """The (K, 6) rows *amplitude, x, y, p, s, q* that kernels sum."""
        return kernel_rows(self.weights, self.means, self.covariances)

    def evaluate(self, x, y, *, pixel_integrated=False):
        """
        Evaluate the mixture.

        Parameters
        ----------
        x, y : array_like
            Positions relative to the star [pix]; they broadcast.
        pixel_integrated : bool, optional
            Whether to integrate over the unit pixel centred on each position
            instead of sampling there.

        Returns
        -------
        float or `~numpy.ndarray`
            The flux density [1 / pix^2], or the flux in each pixel.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[0.25, 0], [0, 0.25]]])
        >>> psf.evaluate([0, 1], 0)
        array([0.63661977, 0.08615711])
        >>> psf.evaluate([0, 1], 0, pixel_integrated=True)
        array([0.46606494, 0.10739071])
        """
        x, y, shape = _points(x, y)
        out = np.empty(x.size)
        kernels.evaluate(x, y, self.rows, bool(pixel_integrated), out)
        return out.reshape(shape)[()]

    def gradient(self, x, y, *, pixel_integrated=False):
        """
        Evaluate the derivatives of the mixture by x and y.

        Parameters
        ----------
        x, y, pixel_integrated
            As for `evaluate`, whose result is differentiated.

        Returns
        -------
        (..., 2) `~numpy.ndarray`
            d/dx and d/dy at each position.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> psf.gradient(1, 0)
        array([-0.09653235, -0.        ])
        """
        x, y, shape = _points(x, y)
        out = np.empty((3, x.size))
        kernels.evaluate_slopes(x, y, self.rows, bool(pixel_integrated), out)
        return np.moveaxis(-out[1:].reshape(2, *shape), 0, -1)

    def render(self, shape, x_0, y_0, *, flux=1, pixel_integrated=False):
        """
        Draw a star on a pixel lattice.

        Parameters
        ----------
        shape : int or (ny, nx) tuple of int
            The shape of the image.
        x_0, y_0 : float
            The position of the star; the first pixel's centre is (0, 0).
        flux : float, optional
            The total flux.
        pixel_integrated : bool, optional
            Whether to integrate over pixels instead of sampling their
            centres.

        Returns
        -------
        (ny, nx) `~numpy.ndarray`
            The image, in the unit of ``flux``.

        Raises
        ------
        TypeError, ValueError
            If the shape or a number is not valid.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> float(psf.render((9, 9), 4, 4, flux=100).sum())
        99.99940394918846
        """
        out = np.zeros(as_shape(shape, 'shape'))
        kernels.render(self.rows, as_real(x_0, 'x_0'), as_real(y_0, 'y_0'),
                       as_real(flux, 'flux'), bool(pixel_integrated) or None,
                       out)
        return out

    def moments(self):
        r"""
        Return the centroid and the covariance of the light.

        .. math::

            \bar{\mathbf r} = \sum_k \omega_k \boldsymbol\alpha_k, \qquad
            C = \sum_k \omega_k \left[\Sigma_k +
            (\boldsymbol\alpha_k - \bar{\mathbf r})
            (\boldsymbol\alpha_k - \bar{\mathbf r})^T\right]

        Returns
        -------
        Moments
            ``mean`` (2,) [pix] and ``covariance`` (2, 2) [pix^2]. The
            covariance need not be positive definite if weights are negative.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([0.5, 0.5], [[-1, 0], [1, 0]],
        ...                       [[[1, 0], [0, 1]], [[1, 0], [0, 1]]])
        >>> psf.moments().covariance
        array([[2., 0.],
               [0., 1.]])
        """
        mean = self.weights @ self.means
        offsets = self.means - mean
        spread = self.covariances + offsets[:, :, None] * offsets[:, None, :]
        return Moments(mean, (self.weights @ spread.reshape(-1, 4)
                              ).reshape(2, 2))

    def encircled_energy(self, radius):
        r"""
        Return the flux within a radius of the star.

        In polar coordinates the integral over radius is a closed form; the
        one over angle is periodic and summed with equal steps, whose
        number grows until the result changes by less than 1e-10.

        Parameters
        ----------
        radius : array_like
            Radii about the origin [pix], not negative; infinity is allowed.

        Returns
        -------
        float or `~numpy.ndarray`
            The fraction of the flux inside each radius.

        Raises
        ------
        ValueError
            If a radius is negative or NaN.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> psf.encircled_energy([1, 2, 3])
        array([0.39346934, 0.86466472, 0.988891  ])
        """
        radius = as_floats(radius, 'radius', finite=False)
        if not (radius >= 0).all():
            msg = f'radius must not be negative or NaN, got {radius.min()}'
            raise ValueError(msg)
        finite = np.where(np.isfinite(radius), radius, 0).ravel()
        energy = polar_integral(self, finite, 64)
        for n_angles in 2 ** np.arange(7, 18):
            coarse, energy = energy, polar_integral(self, finite, n_angles)
            if np.abs(energy - coarse).max(initial=0) < 1e-10:
                break
        energy = energy.reshape(radius.shape)
        return np.where(np.isfinite(radius), energy, 1.0)[()]

    def convolve(self, kernel):
        """
        Convolve the mixture with a Gaussian or with another mixture.

        Parameters
        ----------
        kernel : (2, 2) array_like or GaussianMixture
            The covariance of a centred Gaussian [pix^2], positive
            semidefinite; or a mixture of L Gaussians.

        Returns
        -------
        GaussianMixture
            Of K Gaussians, or of K L.

        Raises
        ------
        ValueError
            If the covariance is not symmetric and positive semidefinite.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> psf.convolve([[0.5, 0], [0, 0]]).covariances[0]
        array([[1.5, 0. ],
               [0. , 1. ]])
        """
        if isinstance(kernel, GaussianMixture):
            pairs = np.einsum('k,l->kl', self.weights, kernel.weights)
            means = self.means[:, None] + kernel.means
            covariances = self.covariances[:, None] + kernel.covariances
            return GaussianMixture(pairs.ravel(), means.reshape(-1, 2),
                                   covariances.reshape(-1, 2, 2))
        covariance = _kernel_covariance(kernel)
        return GaussianMixture(self.weights, self.means,
                               self.covariances + covariance)

    def deconvolve(self, covariance):
        """
        Undo a convolution with a Gaussian.

        Parameters
        ----------
        covariance : (2, 2) array_like
            The covariance of the Gaussian to remove [pix^2].

        Returns
        -------
        GaussianMixture

        Raises
        ------
        ValueError
            If a component is narrower than the Gaussian, so that the rest
            is not positive definite.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 1]]])
        >>> psf.deconvolve([[0.5, 0], [0, 0.5]]).covariances[0]
        array([[1.5, 0. ],
               [0. , 0.5]])
        """
        left = self.covariances - _kernel_covariance(covariance)
        smallest = np.linalg.eigvalsh(left)[:, 0]
        if not (smallest > 0).all():
            k = int(smallest.argmin())
            msg = ('covariance must be smaller than that of every component; '
                   f'removing it leaves component {k} with the eigenvalue '
                   f'{smallest[k]:.3g}')
            raise ValueError(msg)
        return GaussianMixture(self.weights, self.means, left)

    def affine(self, matrix):
        r"""
        Map the mixture through :math:`\mathbf{r} \to M \mathbf{r}`.

        Flux is conserved: means become :math:`M\boldsymbol\alpha` and
        covariances :math:`M \Sigma M^T`.

        Parameters
        ----------
        matrix : (2, 2) array_like
            The matrix M, not singular.

        Returns
        -------
        GaussianMixture

        Raises
        ------
        ValueError
            If the matrix is singular or has another shape.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[1, 0]], [[[2, 0], [0, 1]]])
        >>> psf.affine([[0, -1], [1, 0]]).means
        array([[0., 1.]])
        """
        matrix = as_floats(matrix, 'matrix', shape=(2, 2))
        if np.linalg.matrix_rank(matrix) < 2:
            msg = f'matrix must not be singular, got {matrix.tolist()}'
            raise ValueError(msg)
        covariances = matrix @ self.covariances @ matrix.T
        covariances = (covariances + covariances.transpose(0, 2, 1)) / 2
        return GaussianMixture(self.weights, self.means @ matrix.T,
                               covariances)

    def shift(self, offset):
        """
        Move every Gaussian by an offset.

        Parameters
        ----------
        offset : (2,) array_like
            The shift (x, y) [pix]; minus the centroid of `moments` puts the
            flux centroid at the origin.

        Returns
        -------
        GaussianMixture

        Raises
        ------
        ValueError
            If the offset is not two finite numbers.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture
        >>> psf = GaussianMixture([1], [[1, 0]], [[[2, 0], [0, 1]]])
        >>> psf.shift(-psf.moments().mean).means
        array([[0., 0.]])
        """
        offset = as_floats(offset, 'offset', shape=(2,))
        return GaussianMixture(self.weights, self.means + offset,
                               self.covariances)


def _points(x, y):
    """Return flat float64 positions and the shape they broadcast to."""
    x, y = np.broadcast_arrays(*(real_array(in_pixels(value, name), name)
                                 for value, name in ((x, 'x'), (y, 'y'))))
    return x.ravel(), y.ravel(), x.shape


def _unit_sum(weights):
    precision = getattr(np.asarray(weights), 'dtype', np.dtype(float))
    weights = as_floats(weights, 'weights', shape=(None,))
    if weights.size == 0:
        msg = 'weights must have at least one element, got none'
        raise ValueError(msg)
    coarse = precision.kind == 'f' and precision.itemsize < 8
    tolerance = 16 * np.finfo(precision).eps if coarse else 1e-10
    if abs(weights.sum() - 1) > tolerance:
        msg = f'weights must sum to 1, got {weights.sum():.12g}'
        raise ValueError(msg)
    return weights / weights.sum() if coarse else weights


def _check_covariances(covariances, name):
    """Raise unless all (K, 2, 2) matrices are symmetric and definite."""
    sxx, sxy, syx, syy = covariances.reshape(-1, 4).T
    scale = np.sqrt(np.abs(sxx * syy))
    bad = ~(np.abs(sxy - syx) <= 1e-6 * scale)
    if bad.any():
        msg = (f'{name} must be symmetric, got '
               f'{covariances[bad.argmax()].tolist()}')
        raise ValueError(msg)
    covariances[:, 0, 1] = covariances[:, 1, 0] = (sxy + syx) / 2
    bad = ~((sxx > 0) & (syy > 0) & (sxx * syy > covariances[:, 0, 1] ** 2))
    if bad.any():
        msg = (f'{name} must be positive definite, got '
               f'{covariances[bad.argmax()].tolist()}')
        raise ValueError(msg)


def _kernel_covariance(covariance):
    covariance = as_floats(covariance, 'covariance', shape=(2, 2))
    size = np.abs(covariance).max()
    if abs(covariance[0, 1] - covariance[1, 0]) > 1e-6 * size:
        msg = f'covariance must be symmetric, got {covariance.tolist()}'
        raise ValueError(msg)
    covariance = (covariance + covariance.T) / 2
    if np.linalg.eigvalsh(covariance)[0] < -1e-12 * size:
        msg = ('covariance must be positive semidefinite, got '
               f'{covariance.tolist()}')
        raise ValueError(msg)
    return covariance
