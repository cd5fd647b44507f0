r"""
A PSF from an archive, tuned to an image.

When focus drifts, the PSF of an image is the archive's one with a few
changes, which far fewer stars can tell than the whole PSF. At position
:math:`(x, y)` Gaussian k of the archive's mixture becomes

.. math::

    \omega_k' \propto \omega_k e^{a z_k}, \quad
    \boldsymbol\alpha_k' = \boldsymbol\alpha_k + \mathbf d\, z_k, \quad
    \Sigma_k' = \Sigma_k + C,

with :math:`z_k` the logarithm of its size about the mean one, and C, a and
:math:`\mathbf d` polynomials of position.
"""
from dataclasses import dataclass, field

import numpy as np
from astropy.table import QTable

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import Field, lattice
from photutils_mgauss.field.covariance import psf_errors
from photutils_mgauss.field.forms import TunedShapes
from photutils_mgauss.field.input import normalised
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.rows import covariances_of_logs, log_rows
from photutils_mgauss.utils.validation import as_grid_shape, as_real

__all__ = ['TunedMixtureField']


@dataclass(frozen=True, eq=False, repr=False)
class TunedMixtureField(Field):
    """
    A known PSF, adjusted with polynomials of position.

    Made by `fit_mixture_field` with ``start``. The centre of the PSF is
    that of ``start``, so that positions keep the convention of the
    archive.

    Parameters
    ----------
    start : GriddedMixturePSF
        The known PSF.
    coefficients : (T, 6) `~numpy.ndarray`
        The T polynomial terms, as in `MixtureField`, of six changes: the
        covariance xx, xy, yy of the Gaussian it is convolved with [pix^2],
        and the change of log weight and of mean x and y [pix] for each
        factor e in size. A negative covariance makes the PSF sharper.
    shape, radius, stars, residual_stars, accuracy, dropped
        As in `MixtureField`.
    covariance : (6 T, 6 T) `~numpy.ndarray`
        The covariance of the coefficients, ordered by change, then by
        term.
    centre_stddev, pixel_integrated
        As in `MixtureField`.
    unmodelled : (6,) `~numpy.ndarray`, optional
        The variances of the changes about their polynomials, determined
        from stars left out of the fit; by default none.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from photutils_mgauss import (GaussianMixture, GriddedMixturePSF,
    ...                               fit_mixture_field)
    >>> archive = GaussianMixture([0.8, 0.2], np.zeros((2, 2)),
    ...                           [np.eye(2), 5 * np.eye(2)])
    >>> now = archive.convolve([[0.3, 0], [0, 0.1]])
    >>> stars = Table({'x': [12.3, 40.1], 'y': [14.6, 33.9]})
    >>> data = sum(now.render((50, 55), x, y, flux=1000) for x, y in stars)
    >>> tuned = fit_mixture_field(
    ...     data, stars, error=np.ones((50, 55)), degree=0,
    ...     start=GriddedMixturePSF([archive], [(27, 25)]))
    >>> tuned.convolution_at(20, 20).round(2)
    array([[0.3, 0. ],
           [0. , 0.1]])
    """

    start: object
    coefficients: np.ndarray
    shape: tuple
    radius: float
    covariance: np.ndarray
    stars: QTable
    residual_stars: np.ndarray = field(default=None)
    accuracy: float = 0.0
    dropped: QTable = field(default=None)
    centre_stddev: float = np.inf
    pixel_integrated: bool = False
    unmodelled: np.ndarray = None

    def __repr__(self):
        return self._described()

    def changes_at(self, x, y):
        """
        Return the six changes at a detector position.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        (6,) `~numpy.ndarray`
            In the order of ``coefficients``.

        Raises
        ------
        TypeError, ValueError
            If a position is not a finite number.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        return (self._basis([x], [y]) @ self.coefficients)[0]

    def convolution_at(self, x, y):
        """
        Return the covariance of the Gaussian that the PSF is convolved with.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        (2, 2) `~numpy.ndarray`
            [pix^2].
        """
        xx, xy, yy = self.changes_at(x, y)[:3]
        return np.array([[xx, xy], [xy, yy]])

    def _basis(self, x, y):
        return stages.polynomials(*normalised(x, y, self.shape), self.degree)

    def mixture_at(self, x, y):
        """
        Return the PSF at a detector position.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        GaussianMixture
            A mixture with as many Gaussians as ``start`` has there. It
            includes the pixel, unless the field is ``pixel_integrated``.

        Raises
        ------
        TypeError, ValueError
            If a position is not a finite number.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        known = known_shapes(self.start, [x], [y], self.pixel_integrated)
        return GaussianMixture(*(array[0] for array in self._mixtures(
            [x], [y], known)))

    def _mixtures(self, x, y, known, change=0.0):
        """Return stacked weights, means and covariances."""
        numbers = self._basis(x, y) @ self.coefficients + change
        # The numbers are their own coefficients, star by star.
        shapes, sign = TunedShapes().shapes(numbers, np.eye(len(numbers)),
                                            known)
        shift = TunedShapes.shifts(shapes, sign, known, self.centre_stddev)
        return (sign * np.exp(shapes[..., 0]),
                shapes[..., 1:3] + shift[:, None],
                covariances_of_logs(shapes))

    def psf_errors(self):
        """
        Return the errors of the PSF, for the errors of photometry.

        Returns
        -------
        PSFErrors
            The errors of the changes; ``start`` counts as exact.
        """
        known = {}

        def at(x, y, change):
            if not known:
                known['there'] = known_shapes(self.start, x, y,
                                              self.pixel_integrated)
            return (self._basis(x, y), *self._mixtures(
                x, y, known['there'], change))

        unmodelled = self.unmodelled
        if unmodelled is None:
            unmodelled = np.zeros(self.coefficients.shape[1])
        return psf_errors(at, self.covariance, unmodelled, self.degree,
                          self.shape, self.pixel_integrated)

    def to_grid(self, grid_shape=None):
        """
        Return the field sampled on a grid, as a model for photutils.

        Parameters
        ----------
        grid_shape : int or (int, int), optional
            The number of nodes along y and x, from the first pixel to the
            last; by default the nodes of ``start``.

        Returns
        -------
        GriddedMixturePSF

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        if grid_shape is not None or not hasattr(self.start, 'grid_xypos'):
            grid_shape = as_grid_shape(grid_shape or (30, 30))
            places = np.column_stack(list(lattice(grid_shape, self.shape)))
        else:
            places = np.asarray(self.start.grid_xypos, float)
        scale_at = getattr(self.start, 'scale_at', lambda x, y: 1.0)
        return GriddedMixturePSF(
            [self.mixture_at(*place) for place in places], places,
            scales=[float(scale_at(*place)) for place in places],
            pixel_integrated=self.pixel_integrated,
            errors=self.psf_errors())


def known_shapes(start, x, y, integrated):
    """
    Return what `TunedShapes` needs of a PSF at n places, (n, K, 8).

    Optics that are not to be integrated get a Gaussian of the size of a
    pixel. Where there are fewer Gaussians than elsewhere, some have no weight.
    """
    found = [start.mixture_at(*place) for place in zip(x, y, strict=True)]
    if getattr(start, 'pixel_integrated', False) and not integrated:
        pixel = stages.PIXEL_VARIANCE * np.eye(2)
        found = [mixture.convolve(pixel) for mixture in found]
    most = max(mixture.n_components for mixture in found)
    shapes, signs = (np.zeros((len(found), most, 6)),
                     np.ones((len(found), most)))
    for i, mixture in enumerate(found):
        one = log_rows(mixture.weights, mixture.means, mixture.covariances)
        n = len(one)
        shapes[i], signs[i, :n] = (one[np.argmax(one[:, 0])],
                                   np.sign(mixture.weights))
        # Not exactly 0, which has no logarithm.
        shapes[i, n:, 0] = -690
        shapes[i, :n] = one
    return TunedShapes.local(shapes, signs)
