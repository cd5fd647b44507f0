r"""
A PSF that varies over the detector, fitted straight to the pixels of stars.

Every parameter of each Gaussian is a polynomial of detector position,

.. math::

    P(\mathbf{r}\,|\,x, y) = \sum_k \omega_k(x, y)\,
    N\!\left(\mathbf{r} - \boldsymbol\alpha_k(x, y);\,
    \Sigma_k(x, y)\right),

and all stars are fitted together, each with its own position and flux. No
pixel is resampled on the way, and the variance is that of the model.
"""
from dataclasses import dataclass, field, replace

import numpy as np
from astropy.table import QTable

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import Field, lattice
from photutils_mgauss.field.covariance import psf_errors
from photutils_mgauss.field.forms import convolved, mixture_arrays
from photutils_mgauss.field.input import normalised
from photutils_mgauss.files.storage import storable, table_columns
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.validation import as_integer, as_real, as_shape

__all__ = ['MixtureField']


# Of numerical derivatives.
_STEP = 1e-4
_WINGS = 'wing_share', 'wing_error', 'wing_stddev'


@storable(detector={'ny': 'pix', 'nx': 'pix', 'radius': 'pix',
                    'accuracy': ''},
          terms={'coefficient': ''}, errors={'covariance': ''},
          stars={'x': 'pix', 'y': 'pix', 'used': ''}, dropped={'id': ''})
@dataclass(frozen=True, eq=False, repr=False)
class MixtureField(Field):
    r"""
    A mixture of Gaussians whose parameters are polynomials of position.

    Made by `fit_mixture_field`. The centre of the mixture at every position
    is its origin, and its weights sum to 1.

    Parameters
    ----------
    coefficients : (T, K, 6) `~numpy.ndarray`
        The coefficients of the T polynomial terms, products of Legendre
        polynomials :math:`P_i(u) P_j(v)` ordered by i + j, then j. The six
        shapes of each Gaussian are its log weight (up to a common factor),
        its mean x and y up to a common shift [pix], and
        :math:`\tfrac12\ln p, s, \tfrac12\ln q` with
        :math:`q = 1/\Sigma_{yy}`, :math:`s = \Sigma_{xy} q`,
        :math:`p = \Sigma_{yy} / \det\Sigma`.
    shape : (int, int)
        The detector's shape (ny, nx); u and v run from -1 to 1 over it.
    radius : float
        The radius of the stamps [pix].
    covariance : (N, N) `~numpy.ndarray`
        The covariance of the N = (6 K - 3) T fitted coefficients, shape by
        shape and term by term within a shape. The first three shapes of the
        first Gaussian are not fitted. What ``unmodelled`` does to the stars
        that were fitted is in it.
    stars : `~astropy.table.QTable`
        The stars, those that were dropped included: ``x``, ``y``, ``x_fit``,
        ``y_fit``, ``flux_fit``, ``local_bkg``, ``reduced_chi2``,
        ``n_pixels_fit``, ``n_pixels_rejected``, ``used`` and, where not used,
        the ``reason``.
    residual_stars : (n, s, s) `~numpy.ndarray`
        Data minus model of the stars in ``stars``; NaN outside the circle and
        at pixels that were not used.
    accuracy : float
        The relative error of the PSF that the stars' chi^2 asks for.
    dropped : `~astropy.table.QTable`
        ``id`` and ``reason`` of the stars that were not used.
    choice : `~astropy.table.QTable`
        The reduced chi^2 of left-out stars for each ``n_components`` and
        ``degree`` that was tried; empty if none was left to choose.
    exposures : `~astropy.table.QTable`, optional
        If the stars are from several exposures, the covariance that each
        one adds to all Gaussians, ``xx``, ``xy``, ``yy`` [pix^2], about the
        mean of all, and its errors ``xx_err``, ``xy_err``, ``yy_err``.
    centre_stddev : float, optional
        The size w of the Gaussian weight under which the PSF's first moment
        about its origin vanishes [pix]; infinite, the default, where the
        origin is the flux centroid.
    pixel_integrated : bool, optional
        Whether the mixtures are those of the optics, to be integrated over
        pixels. By default they contain the pixel and are sampled.
    unmodelled : (6 K - 3,) `~numpy.ndarray`, optional
        The variances of the shapes about their polynomials, such as stars
        left out of the fit ask for; by default none.
    wing_share, wing_error : float, optional
        The share of the flux that one more Gaussian has, for the light beyond
        the stamps, and its error; 0 unless that was measured.
    wing_stddev : float, optional
        The size of that Gaussian [pix].

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from photutils_mgauss import GaussianMixture, fit_mixture_field
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0.3], [0.3, 1.5]]])
    >>> stars = Table({'x': [12.3, 40.1], 'y': [14.6, 33.9]})
    >>> data = sum(psf.render((50, 55), x, y, flux=1000) for x, y in stars)
    >>> field = fit_mixture_field(data, stars, error=np.ones((50, 55)),
    ...                           n_components=1, degree=0)
    >>> field
    <MixtureField(n_components=1, degree=0, shape=(50, 55), 2 of 2 stars)>
    >>> field.to_grid((3, 4)).grid_shape
    (3, 4)
    >>> bool(abs(field.stars['x_fit'] - stars['x']).max() < 1e-3)
    True
    >>> print(round(field.aperture_correction(2, 20, 20), 2))
    1.46
    """

    coefficients: np.ndarray
    shape: tuple
    radius: float
    covariance: np.ndarray
    stars: QTable
    residual_stars: np.ndarray = field(default=None)
    accuracy: float = 0.0
    dropped: QTable = field(default=None)
    choice: QTable = field(default=None)
    exposures: QTable = field(default=None)
    centre_stddev: float = np.inf
    pixel_integrated: bool = False
    unmodelled: np.ndarray = None
    wing_share: float = 0.0
    wing_error: float = 0.0
    wing_stddev: float = 0.0

    def __repr__(self):
        return self._described(f'n_components={self.n_components}, ')

    def _to_tables(self):
        ny, nx = self.shape
        stars = table_columns(self.stars)
        if self.residual_stars is not None:
            stars['residual'] = self.residual_stars
        dropped = QTable({'id': np.array([], int), 'reason': np.array(
            [], str)}) if self.dropped is None else self.dropped
        tables = {'detector': {'ny': [ny], 'nx': [nx],
                             'radius': [float(self.radius)],
                             'accuracy': [float(self.accuracy)],
                             'centre_stddev': [float(self.centre_stddev)],
                             'pixel_integrated': [self.pixel_integrated],
                             **{name: [float(getattr(self, name))]
                                for name in _WINGS}},
                'terms': {'coefficient': self.coefficients},
                'errors': {'covariance': self.covariance},
                'stars': stars, 'dropped': table_columns(dropped)}
        if self.exposures is not None:
            tables['exposures'] = table_columns(self.exposures)
        if self.unmodelled is not None:
            tables['unmodelled'] = {'variance': self.unmodelled}
        return tables

    @classmethod
    def _from_tables(cls, tables):
        detector, stars = tables['detector'], dict(tables['stars'])
        coefficients = tables['terms']['coefficient']
        covariance = tables['errors']['covariance']
        n_terms, n = len(coefficients), len(covariance)
        residual = stars.pop('residual', None)
        exposures = (QTable(tables['exposures']) if 'exposures' in tables
                     else None)
        # Files once held no PSF of optics, and no centre other than that of
        # the flux.
        integrated = bool(detector.get('pixel_integrated', [False])[0])
        stddev = float(detector.get('centre_stddev', [np.inf])[0])
        return cls(coefficients.reshape(n_terms, -1, 6),
                   (int(detector['ny'][0]), int(detector['nx'][0])),
                   float(detector['radius'][0]), covariance.reshape(n, n),
                   QTable(stars), residual, float(detector['accuracy'][0]),
                   QTable(tables['dropped']), exposures=exposures,
                   centre_stddev=stddev, pixel_integrated=integrated,
                   unmodelled=tables.get('unmodelled', {}).get('variance'),
                   **{name: float(detector.get(name, [0.0])[0])
                      for name in _WINGS})

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self.coefficients.shape[1]

    def mixture_at(self, x, y, *, exposure=None):
        """
        Return the PSF at a detector position.

        Parameters
        ----------
        x, y : float
            The position [pix].
        exposure : int, optional
            The exposure, from 0; by default the mean of all.

        Returns
        -------
        GaussianMixture
            Of K Gaussians, its centre at the origin. It contains the pixel,
            unless the field is ``pixel_integrated``.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        weights, means, covariances, _ = self._mixtures([x], [y], exposure)
        return GaussianMixture(weights[0], means[0], covariances[0])

    def _mixtures(self, x, y, exposure, change=None):
        """Return stacked weights, means, covariances and shifts."""
        shapes = np.einsum('nt,tki->nki', self._basis(x, y),
                           self.coefficients)
        if change is not None:
            shapes.reshape(len(shapes), -1)[:, 3:] += change
        if exposure is not None:
            shapes = convolved(shapes, self._blur(exposure))
        mixtures = mixture_arrays(shapes, self.centre_stddev)
        return self._with_wings(*mixtures) if self.wing_share else mixtures

    def _with_wings(self, weights, means, covariances, shift):
        """Add the Gaussian of the light beyond the stamps."""
        n, share = len(weights), self.wing_share
        wide = np.broadcast_to(self.wing_stddev**2 * np.eye(2), (n, 1, 2, 2))
        return (np.hstack([(1 - share) * weights, np.full((n, 1), share)]),
                np.concatenate([means, np.zeros((n, 1, 2))], axis=1),
                np.concatenate([covariances, wide], axis=1), shift)

    def aperture_correction_error(self, radius, x, y):
        """
        Return the standard deviation of `aperture_correction`.

        It holds the noise of the fitted shapes and, if the light beyond the
        stamps was measured, ``wing_error``.

        Parameters
        ----------
        radius : float
            The radius of the aperture [pix].
        x, y : float
            The position [pix].

        Returns
        -------
        float

        Raises
        ------
        TypeError, ValueError
            If the radius is not a positive number.
        """
        correction = self.aperture_correction(radius, x, y)
        basis = stages.polynomials(*normalised([x], [y], self.shape),
                                   self.degree)[0]
        # All shapes are changed by their constant terms.
        first = (np.arange(len(basis)) == 0)[:, None, None]
        slopes = []
        for shape in range(3, 6 * self.n_components):
            change = np.zeros(6 * self.n_components)
            change[shape] = _STEP
            ends = [replace(self, coefficients=self.coefficients
                            + sign * first * change.reshape(1, -1, 6)
                            ).aperture_correction(radius, x, y)
                    for sign in (1, -1)]
            slopes.append((ends[0] - ends[1]) / (2 * _STEP))
        slope = np.outer(slopes, basis).ravel()
        shapes = slope @ self.covariance @ slope
        return float(np.sqrt(shapes + (correction * self.wing_error) ** 2))

    def _basis(self, x, y):
        return stages.polynomials(*normalised(x, y, self.shape), self.degree)

    def psf_errors(self, *, exposure=None):
        """
        Return how far the PSF may be off, for what is measured with it.

        The errors of the coefficients, and what the shapes do beyond the
        polynomials, around places all over the detector. `to_grid` hands
        them on.

        Parameters
        ----------
        exposure : int, optional
            The exposure, from 0; by default the mean of all.

        Returns
        -------
        PSFErrors
        """
        unmodelled = self.unmodelled
        if unmodelled is None:
            unmodelled = np.zeros(6 * self.n_components - 3)
        return psf_errors(
            lambda x, y, change: (self._basis(x, y), *self._mixtures(
                x, y, exposure, change)[:3]),
            self.covariance, unmodelled, self.degree, self.shape,
            self.pixel_integrated,
            self.accuracy if self.pixel_integrated else 0.0)

    def _blur(self, exposure):
        n = 1 if self.exposures is None else len(self.exposures)
        if not 0 <= as_integer(exposure, 'exposure') < n:
            msg = f'exposure must be below {n}, got {exposure}'
            raise ValueError(msg)
        if self.exposures is None:
            return np.zeros((1, 3))
        row = self.exposures[exposure]
        return np.array([[row[name] for name in ('xx', 'xy', 'yy')]])

    def to_grid(self, grid_shape=(30, 30), *, exposure=None):
        """
        Return the field sampled on a grid, as a model for photutils.

        Parameters
        ----------
        grid_shape : int or (int, int), optional
            The number of nodes along y and x. They reach from the first
            pixel to the last.
        exposure : int, optional
            The exposure, from 0; by default the mean of all.

        Returns
        -------
        GriddedMixturePSF
            It knows the errors of the field.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = lattice(as_shape(grid_shape, 'grid_shape'), self.shape)
        arrays = self._mixtures(x, y, exposure)[:3]
        mixtures = [GaussianMixture(*one) for one in zip(*arrays,
                                                         strict=True)]
        return GriddedMixturePSF(mixtures, np.column_stack([x, y]),
                                 pixel_integrated=self.pixel_integrated,
                                 errors=self.psf_errors(exposure=exposure))
