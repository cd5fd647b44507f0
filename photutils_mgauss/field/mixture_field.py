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
from photutils_mgauss.field.base import (
    Field,
    covariance_of,
    lattice,
    residual_stars,
    star_table,
)
from photutils_mgauss.field.choice import choose
from photutils_mgauss.field.forms import TunedShapes, convolved, mixture_arrays
from photutils_mgauss.field.input import (
    normalised,
    possible_degree,
    read_sample,
)
from photutils_mgauss.field.normal import Workers
from photutils_mgauss.field.tuned_field import TunedMixtureField, known_shapes
from photutils_mgauss.files.storage import storable, table_columns
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.validation import as_integer, as_real, as_shape

__all__ = ['MixtureField', 'fit_mixture_field']

_DEGREE, _TUNED_DEGREE = 4, 1


@storable(detector={'ny': 'pix', 'nx': 'pix', 'radius': 'pix',
                    'accuracy': ''},
          terms={'coefficient': ''}, errors={'covariance': ''},
          stars={'x': 'pix', 'y': 'pix', 'used': ''}, dropped={'id': ''})
@dataclass(frozen=True, eq=False, repr=False)
class MixtureField(Field):
    r"""
    A mixture of Gaussians whose parameters are polynomials of position.

    Made by `fit_mixture_field`. The flux centroid of the mixture at every
    position is its origin, and its weights sum to 1.

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
        first Gaussian are not fitted.
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

    def __repr__(self):
        used = int(np.count_nonzero(self.stars['used']))
        return (f'<MixtureField(n_components={self.n_components}, '
                f'degree={self.degree}, shape={self.shape}, '
                f'{used} of {len(self.stars)} stars)>')

    def _to_tables(self):
        ny, nx = self.shape
        stars = table_columns(self.stars)
        if self.residual_stars is not None:
            stars['residual'] = self.residual_stars
        dropped = QTable({'id': np.array([], int), 'reason': np.array(
            [], str)}) if self.dropped is None else self.dropped
        tables = {'detector': {'ny': [ny], 'nx': [nx],
                             'radius': [float(self.radius)],
                             'accuracy': [float(self.accuracy)]},
                'terms': {'coefficient': self.coefficients},
                'errors': {'covariance': self.covariance},
                'stars': stars, 'dropped': table_columns(dropped)}
        if self.exposures is not None:
            tables['exposures'] = table_columns(self.exposures)
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
        return cls(coefficients.reshape(n_terms, -1, 6),
                   (int(detector['ny'][0]), int(detector['nx'][0])),
                   float(detector['radius'][0]), covariance.reshape(n, n),
                   QTable(stars), residual, float(detector['accuracy'][0]),
                   QTable(tables['dropped']), exposures=exposures)

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self.coefficients.shape[1]

    @property
    def degree(self):
        """The degree of the polynomials."""
        return int(np.sqrt(2 * len(self.coefficients))) - 1

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
            Of K Gaussians, its flux centroid at the origin. It contains the
            pixel.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        weights, means, covariances, _ = self._mixtures([x], [y], exposure)
        return GaussianMixture(weights[0], means[0], covariances[0])

    def _mixtures(self, x, y, exposure):
        """Return stacked weights, means, covariances and centroids."""
        basis = stages.polynomials(*normalised(x, y, self.shape), self.degree)
        shapes = np.einsum('nt,tki->nki', basis, self.coefficients)
        if exposure is not None:
            shapes = convolved(shapes, self._blur(exposure))
        return mixture_arrays(shapes)

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

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = lattice(as_shape(grid_shape, 'grid_shape'), self.shape)
        arrays = self._mixtures(x, y, exposure)[:3]
        mixtures = [GaussianMixture(*one) for one in zip(*arrays,
                                                         strict=True)]
        return GriddedMixturePSF(mixtures, np.column_stack([x, y]))


def fit_mixture_field(data, stars, *, error=None, mask=None, n_components=6,
                      degree=None, radius=10, local_bkg=False,
                      effective_gain=None, reject=True, regularization=1.0,
                      start=None, executor=None):
    """
    Fit a PSF field to the pixels of stars.

    The parameters of ``n_components`` Gaussians, as polynomials of detector
    position, are fitted by maximum likelihood to the pixels of all stars,
    together with the position and flux of each. Neighbours inside a star's
    stamp are fitted along. Deviant stars and pixels are dropped.

    Several exposures of one detector share a field if lists are given for
    ``data``, ``stars``, ``error`` and ``mask``; the PSF of each exposure is
    the field convolved with a Gaussian of its own.

    Parameters
    ----------
    data : (ny, nx) array_like or NDData, or list of those
        The image, its background subtracted. Its own mask counts, its unit
        comes back: see :ref:`pixels`.
    stars : `~astropy.table.Table` or list of those
        The stars: ``x``, ``y`` and, if known, ``flux``; photutils' names with
        ``_fit``, ``_init`` or ``_centroid`` are understood. If it has a
        column ``selected``, as tables of `select_psf_stars` do, the PSF is
        fitted to those stars and the others count as neighbours.
    error : float or (ny, nx) array_like, or list of those, optional
        The standard deviation of each pixel in the unit of ``data``. By
        default it is estimated from the scatter of the pixels.
    mask : (ny, nx) array_like of bool or list of those, optional
        True for pixels to leave out. Masks of ``data`` and ``error`` count,
        too; pixels that are not finite, or whose error is not positive, are
        left out as well.
    n_components : int or 'auto', optional
        The number K of Gaussians; 'auto' tries 2 to 7 and keeps the number
        that describes stars left out of the fit best.
    degree : int or 'auto', optional
        The degree of the polynomials, 0 for a PSF that is the same
        everywhere; by default 4, or 1 with ``start``. It is lowered, with a
        warning, if there are too few stars. 'auto' tries 0 to 5 in the same
        way. Terms that the stars do not ask for are shrunk, so that a degree
        that is too high costs time more than accuracy.
    radius : float, optional
        The radius of the circle of pixels that is fitted [pix].
    local_bkg : bool, optional
        Whether to fit a constant background to each star's stamp.
    effective_gain : float, optional
        Electrons per unit of ``data``. Where the error of a pixel contains
        the noise of its own light, as `photutils.utils.calc_total_error`
        makes it, that part is replaced by the expected noise of the model,
        which removes a bias of faint fluxes. By default this is found out
        from ``data`` and ``error``; infinity leaves the error as it is.
    reject : bool, optional
        Whether to drop deviant stars and pixels.
    regularization : float, optional
        The strength of the prior on the shapes, 1 for the default. It keeps
        Gaussians apart that the stars cannot tell from each other. How much
        the shapes vary over the field is learnt from the stars.
    start : GriddedMixturePSF, optional
        A PSF that is known already, as from an archive, or anything with a
        method ``mixture_at``. Only what the stars can tell of it is fitted:
        a Gaussian that it is convolved with, and a change of its wings and
        of its asymmetry, polynomials of position; ``n_components`` does not
        count then. Fifteen stars are enough.
    executor : `~concurrent.futures.Executor`, optional
        Where stars are worked on; by default a pool of threads.

    Returns
    -------
    MixtureField
        Or, with ``start``, a `TunedMixtureField`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid, shapes differ, or no star can be used.

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
    >>> field.mixture_at(20, 20).covariances[0].round(3)
    array([[2. , 0.3],
           [0.3, 1.5]])
    """
    n_components = _number(n_components, 'n_components', 1)
    if degree is None:
        degree = _DEGREE if start is None else _TUNED_DEGREE
    degree = _number(degree, 'degree', 0)
    radius = as_real(radius, 'radius', minimum=2)
    options = {'strength': as_real(regularization, 'regularization', above=0),
               'reject': reject}
    sample = read_sample(data, stars, error, mask, radius, effective_gain)
    top = possible_degree(degree, len(sample.row))
    problem = sample.problem(top, local_bkg)
    with Workers(executor) as workers:
        if start is not None:
            fit = stages.tune(_known(problem, sample, start), top, workers,
                              **options)
            return _tuned(fit, sample, start, radius)
        n_components, degree, choice = choose(
            problem, n_components, degree if degree == 'auto' else top, top,
            options['strength'], workers)
        problem.basis = np.ascontiguousarray(
            problem.basis[:, :stages.n_terms(degree)])
        fit = stages.run(problem, n_components, degree, workers, **options)
    return _result(fit, sample, radius, choice)


def _number(value, name, minimum):
    if isinstance(value, str) and value == 'auto':
        return value
    return as_integer(value, name, minimum=minimum)


def _known(problem, sample, start):
    """Return the problem of the changes of a known PSF."""
    if not callable(getattr(start, 'mixture_at', None)):
        msg = (f'start must have a method mixture_at, as GriddedMixturePSF '
               f'has, got {type(start).__name__}')
        raise TypeError(msg)
    local = known_shapes(start, *sample.expected())
    return replace(problem, form=TunedShapes(), local=local)


def _tuned(fit, sample, start, radius):
    stars = star_table(fit, sample)
    return TunedMixtureField(
        start, fit.coefficients, sample.shape, radius, covariance_of(fit),
        stars, residual_stars(fit), fit.accuracy, sample.dropped())


def _result(fit, sample, radius, choice):
    stars = star_table(fit, sample)
    return MixtureField(
        fit.coefficients, sample.shape, radius, covariance_of(fit), stars,
        residual_stars(fit), fit.accuracy, sample.dropped(), choice,
        _exposure_table(fit, len(sample.reasons)))


def _exposure_table(fit, n):
    if fit.blur_matrix is None:
        return None
    # The last exposures may have no star.
    blurs = np.pad(fit.blurs, ((0, n - len(fit.blurs)), (0, 0)))
    errors = np.full((n, 3), np.nan)
    errors[:len(fit.blurs)] = np.sqrt(np.diag(np.linalg.inv(
        fit.blur_matrix))).reshape(3, -1).T
    table = QTable({'exposure': np.arange(n)})
    for name, value, error in zip(('xx', 'xy', 'yy'), blurs.T, errors.T,
                                  strict=True):
        table[name], table[f'{name}_err'] = value, error
    return table
