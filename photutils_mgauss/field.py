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
import warnings
from dataclasses import dataclass, field

import numpy as np
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import _field_stages as stages
from photutils_mgauss._field_choice import DEGREES, choose
from photutils_mgauss._field_fit import (
    Problem,
    Workers,
    model_stamps,
    to_vector,
)
from photutils_mgauss._files import storable, table_columns
from photutils_mgauss._star_stamps import cut_stamps, remove_star_noise
from photutils_mgauss._tables import as_image, read_sources
from photutils_mgauss._validation import as_integer, as_real, as_shape
from photutils_mgauss.gridded import GriddedMixturePSF
from photutils_mgauss.mixture import GaussianMixture

__all__ = ['MixtureField', 'fit_mixture_field']

# Neighbours may be this far off their catalogue positions [pix].
_NEIGHBOUR_STDDEV = 0.5
_MAX_NEIGHBOURS = 12
# Stars needed for each term of the polynomials, beyond the first.
_STARS_PER_TERM = 2


@storable(detector={'ny': 'pix', 'nx': 'pix', 'radius': 'pix',
                    'accuracy': ''},
          terms={'coefficient': ''}, errors={'covariance': ''},
          stars={'x': 'pix', 'y': 'pix', 'used': ''}, dropped={'id': ''})
@dataclass(frozen=True, eq=False, repr=False)
class MixtureField:
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
        dropped = _dropped(np.array([], str)) if (
            self.dropped is None) else self.dropped
        return {'detector': {'ny': [ny], 'nx': [nx],
                             'radius': [float(self.radius)],
                             'accuracy': [float(self.accuracy)]},
                'terms': {'coefficient': self.coefficients},
                'errors': {'covariance': self.covariance},
                'stars': stars, 'dropped': table_columns(dropped)}

    @classmethod
    def _from_tables(cls, tables):
        detector, stars = tables['detector'], dict(tables['stars'])
        coefficients = tables['terms']['coefficient']
        covariance = tables['errors']['covariance']
        n_terms, n = len(coefficients), len(covariance)
        residual = stars.pop('residual', None)
        return cls(coefficients.reshape(n_terms, -1, 6),
                   (int(detector['ny'][0]), int(detector['nx'][0])),
                   float(detector['radius'][0]), covariance.reshape(n, n),
                   QTable(stars), residual, float(detector['accuracy'][0]),
                   QTable(tables['dropped']))

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self.coefficients.shape[1]

    @property
    def degree(self):
        """The degree of the polynomials."""
        return int(np.sqrt(2 * len(self.coefficients))) - 1

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
            Of K Gaussians, its flux centroid at the origin. It contains the
            pixel.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        weights, means, covariances, _ = self._mixtures([x], [y])
        return GaussianMixture(weights[0], means[0], covariances[0])

    def _mixtures(self, x, y):
        """Return stacked weights, means, covariances and centroids."""
        basis = stages.polynomials(*_normalised(x, y, self.shape),
                                   self.degree)
        return _mixture_arrays(np.einsum('nt,tki->nki', basis,
                                         self.coefficients))

    def to_grid(self, grid_shape=(30, 30)):
        """
        Return the field sampled on a grid, as a model for photutils.

        Parameters
        ----------
        grid_shape : int or (int, int), optional
            The number of nodes along y and x. They reach from the first
            pixel to the last.

        Returns
        -------
        GriddedMixturePSF
        """
        rows, columns = as_shape(grid_shape, 'grid_shape')
        x, y = (grid.ravel() for grid in np.meshgrid(
            _nodes(columns, self.shape[1]), _nodes(rows, self.shape[0])))
        arrays = self._mixtures(x, y)[:3]
        mixtures = [GaussianMixture(*one) for one in zip(*arrays,
                                                         strict=True)]
        return GriddedMixturePSF(mixtures, np.column_stack([x, y]))

    def enclosed_flux(self, x, y):
        """
        Return the share of the PSF's flux inside the fitted circle.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        float
        """
        return self.mixture_at(x, y).encircled_energy(self.radius)

    def aperture_correction(self, radius, x, y):
        """
        Return the factor from the flux in an aperture to that of the PSF.

        Beyond ``self.radius`` the wings are those of the Gaussians, which no
        pixel has confirmed: to tie fluxes to a larger aperture, compare the
        two with bright stars.

        Parameters
        ----------
        radius : float
            The radius of the aperture [pix].
        x, y : float
            The position [pix].

        Returns
        -------
        float
        """
        radius = as_real(radius, 'radius', above=0)
        return 1 / self.mixture_at(x, y).encircled_energy(radius)


def _nodes(n, size):
    return np.linspace(0, size - 1, n) if n > 1 else np.array([(size - 1) / 2])


def _normalised(x, y, shape):
    """Return positions scaled to [-1, 1] over the detector."""
    ny, nx = shape
    return (2 * np.asarray(x, float) / max(nx - 1, 1) - 1,
            2 * np.asarray(y, float) / max(ny - 1, 1) - 1)


def _mixture_arrays(shapes):
    """Return weights, means, covariances and shifts for (n, K, 6)."""
    log_weights = shapes[..., 0] - shapes[..., :1, 0].max(axis=-1,
                                                          keepdims=True)
    weights = np.exp(log_weights - log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    shift = np.einsum('nk,nki->ni', weights, shapes[..., 1:3])
    means = shapes[..., 1:3] - shift[:, None]
    s = shapes[..., 4]
    syy = np.exp(-2 * shapes[..., 5])
    covariances = np.empty((*s.shape, 2, 2))
    covariances[..., 0, 0] = np.exp(-2 * shapes[..., 3]) + s**2 * syy
    covariances[..., 0, 1] = covariances[..., 1, 0] = s * syy
    covariances[..., 1, 1] = syy
    return weights, means, covariances, shift


def fit_mixture_field(data, stars, *, error=None, mask=None, n_components=6,
                      degree=4, radius=10, local_bkg=False,
                      effective_gain=None, reject=True, regularization=1.0,
                      executor=None):
    """
    Fit a PSF field to the pixels of stars.

    The parameters of ``n_components`` Gaussians, as polynomials of detector
    position, are fitted by maximum likelihood to the pixels of all stars,
    together with the position and flux of each. Neighbours inside a star's
    stamp are fitted along. Deviant stars and pixels are dropped.

    Parameters
    ----------
    data : (ny, nx) array_like
        The image, its background subtracted.
    stars : `~astropy.table.Table`
        The stars: ``x``, ``y`` and, if known, ``flux``; photutils' names with
        ``_fit``, ``_init`` or ``_centroid`` are understood. If it has a
        column ``selected``, as tables of `select_psf_stars` do, the PSF is
        fitted to those stars and the others count as neighbours.
    error : (ny, nx) array_like, optional
        The standard deviation of each pixel. By default it is estimated from
        the scatter of the pixels.
    mask : (ny, nx) array_like of bool, optional
        True for pixels to leave out. Pixels that are not finite, or whose
        error is not positive, are left out, too.
    n_components : int or 'auto', optional
        The number K of Gaussians; 'auto' tries 2 to 7 and keeps the number
        that describes stars left out of the fit best.
    degree : int or 'auto', optional
        The degree of the polynomials, 0 for a PSF that is the same
        everywhere. It is lowered, with a warning, if there are too few stars.
        'auto' tries 0 to 5 in the same way. High terms are shrunk by as much
        as the stars do not ask for them, so that a degree that is too high
        costs time more than accuracy.
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
    executor : `~concurrent.futures.Executor`, optional
        Where stars are worked on; by default a pool of threads.

    Returns
    -------
    MixtureField

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
    degree = _number(degree, 'degree', 0)
    radius = as_real(radius, 'radius', minimum=2)
    strength = as_real(regularization, 'regularization', above=0)
    data, error, mask = _images(data, error, mask)
    sources = read_sources(stars)
    stamps, index, reasons = _usable_stamps(data, error, mask, sources,
                                            radius, effective_gain)
    top = _possible_degree(degree, len(index))
    degree = degree if degree == 'auto' else top
    problem = _problem(stamps, sources, index, data.shape, top, local_bkg)
    with Workers(executor) as workers:
        n_components, degree, choice = choose(problem, n_components, degree,
                                              top, strength, workers)
        problem.basis = np.ascontiguousarray(
            problem.basis[:, :stages.n_terms(degree)])
        fit = stages.run(problem, n_components, degree, workers,
                         strength=strength, reject=reject)
    return _result(fit, sources, index, reasons, data.shape, radius, choice)


def _number(value, name, minimum):
    if isinstance(value, str) and value == 'auto':
        return value
    return as_integer(value, name, minimum=minimum)


def _images(data, error, mask):
    data = as_image(data, 'data')
    if error is not None:
        error = as_image(error, 'error', data.shape)
    if mask is not None:
        mask = as_image(mask, 'mask', data.shape).astype(bool)
    return data, error, mask


def _usable_stamps(data, error, mask, sources, radius, gain):
    """Return stamps of usable stars, their rows, and why others are not."""
    reasons = np.full(sources.x.size, '', dtype='U12')
    ny, nx = data.shape
    with np.errstate(invalid='ignore'):
        inside = ((np.abs(sources.x - (nx - 1) / 2) <= nx / 2)
                  & (np.abs(sources.y - (ny - 1) / 2) <= ny / 2))
    reasons[~inside] = 'outside'
    rows = np.flatnonzero(inside & sources.selected)
    stamps = cut_stamps(data, error, mask, sources.x[rows], sources.y[rows],
                        radius)
    if error is None:
        _estimate_noise(stamps, data)
    usable = stamps.usable()
    reasons[rows[~usable]] = 'masked'
    if not usable.any():
        msg = (f'stars must hold at least 1 star whose pixels can be used, '
               f'got none of {sources.x.size}: they are outside the image, '
               f'masked, or too near the edge')
        raise ValueError(msg)
    for name in ('data', 'base', 'good', 'corners'):
        setattr(stamps, name, getattr(stamps, name)[usable])
    if error is not None:
        remove_star_noise(stamps, gain)
    return stamps, rows[usable], reasons


def _estimate_noise(stamps, data):
    """Set the variance to that of the image away from stars, in place."""
    from astropy.stats import mad_std
    stamps.base[:] = max(mad_std(data, ignore_nan=True) ** 2,
                         np.finfo(float).tiny)


def _possible_degree(degree, n_stars):
    if degree == 'auto':
        # A third of the stars is left out while the degree is chosen.
        return max(d for d in DEGREES
                   if d == 0 or 2 * n_stars // 3 >= _stars_needed(d))
    needed = _stars_needed(degree)
    if n_stars >= needed:
        return degree
    possible = max(d for d in range(degree) if n_stars >= _stars_needed(d))
    warnings.warn(
        f'{n_stars} stars are too few for degree {degree}, which needs '
        f'{needed}; degree {possible} is used', AstropyUserWarning,
        stacklevel=3)
    return possible


def _stars_needed(degree):
    return 1 + _STARS_PER_TERM * (stages.n_terms(degree) - 1)


def _problem(stamps, sources, index, shape, degree, local_bkg):
    position = sources.x[index], sources.y[index]
    basis = stages.polynomials(*_normalised(*position, shape), degree)
    table, count = _with_neighbours(sources, index, stamps)
    hold = np.full(table.shape, _NEIGHBOUR_STDDEV**-2.0)
    hold[..., 2] = 1 / np.maximum(table[..., 2] ** 2, 1e-300)
    n = len(index)
    return Problem(stamps, np.zeros(stamps.data.shape), basis, table,
                   table.copy(), hold, count, np.zeros(n), bool(local_bkg),
                   np.ones(n, bool))


def _with_neighbours(sources, index, stamps):
    """Return x, y, flux of each star and its neighbours, and their number."""
    from scipy.spatial import KDTree
    flux = sources.flux.copy()
    known = np.isfinite(sources.x) & np.isfinite(sources.y)
    inner = stamps.offsets() <= 3.5
    flux[index] = np.where(
        flux[index] > 0, flux[index],
        np.maximum((stamps.data * inner).sum(axis=(1, 2)), 1e-3))
    known &= np.isfinite(flux) & (flux > 0)
    known_rows = np.flatnonzero(known)
    tree = KDTree(np.column_stack([sources.x, sources.y])[known])
    lists = []
    for star in index:
        here = sources.x[star], sources.y[star]
        near = known_rows[tree.query_ball_point(here, stamps.radius + 2)]
        near = near[near != star]
        brightest = near[np.argsort(-flux[near])][:_MAX_NEIGHBOURS]
        lists.append([star, *brightest])
    count = np.array([len(rows) for rows in lists])
    table = np.zeros((len(index), count.max(), 3))
    for i, rows in enumerate(lists):
        table[i, :len(rows)] = np.column_stack(
            [sources.x[rows], sources.y[rows], flux[rows]])
    return table, count


def _result(fit, sources, index, reasons, shape, radius, choice):
    matrix = fit.equations.matrix + np.diag(
        to_vector(fit.prior.precision))
    covariance = np.linalg.inv(matrix)
    residual = fit.problem.stamps.data - model_stamps(
        fit.problem, fit.coefficients)
    residual[fit.problem.weights == 0] = np.nan
    return MixtureField(
        fit.coefficients, shape, radius, covariance,
        _star_table(fit, sources, index, reasons), residual, fit.accuracy,
        _dropped(reasons), choice)


def _dropped(reasons):
    rows = np.flatnonzero(reasons != '')
    return QTable({'id': rows + 1, 'reason': reasons[rows]})


def _star_table(fit, sources, index, reasons):
    problem = fit.problem
    shapes = np.einsum('nt,tki->nki', problem.basis, fit.coefficients)
    shift = _mixture_arrays(shapes)[3]
    own = problem.sources[:, 0].copy()
    # The flux of a star is that of weights that sum to 1.
    own[:, :2] += shift
    own[:, 2] *= np.exp(shapes[..., 0]).sum(axis=1)
    n_pixels = (problem.weights > 0).sum(axis=(1, 2))
    reasons[index[~problem.used]] = 'deviant'
    table = QTable()
    table['id'] = index + 1
    table['x'], table['y'] = sources.x[index], sources.y[index]
    table['x_fit'], table['y_fit'], table['flux_fit'] = own.T
    table['local_bkg'] = problem.sky
    table['reduced_chi2'] = fit.equations.chi2 / np.maximum(n_pixels - 3, 1)
    table['n_pixels_fit'] = n_pixels
    table['n_pixels_rejected'] = fit.deviant_pixels.sum(axis=(1, 2))
    table['used'] = problem.used
    table['reason'] = reasons[index]
    return table
