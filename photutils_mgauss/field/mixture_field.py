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
from typing import NamedTuple

import numpy as np
from astropy.table import QTable

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import Field, lattice
from photutils_mgauss.field.contexts import Contexts, context_terms
from photutils_mgauss.field.covariance import (
    psf_errors,
    shape_covariance,
    slopes,
)
from photutils_mgauss.field.forms import convolved, mixture_arrays
from photutils_mgauss.field.growth import left_over
from photutils_mgauss.field.input import normalised
from photutils_mgauss.files.storage import storable, table_columns
from photutils_mgauss.psf.contexts import PSFContext, known_contexts
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.validation import (
    as_grid_shape,
    as_integer,
    as_real,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['MixtureField']


_WINGS = 'wing_share', 'wing_error', 'wing_stddev'
_TABLES = 'exposures', 'contexts', 'brighter_fatter'
# Between as many values of each context, to either side of the usual one, a
# grid blends.
_LAYERS = 2


class _Kind(NamedTuple):
    """
    Which stars a PSF is of.

    contexts (C,) are scaled, blur (1, 3) is what exposure and flux add to
    the covariances, or None.
    """

    contexts: np.ndarray
    blur: np.ndarray | None


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
        The covariance of the N = (6 K - 3) (T + C X) fitted coefficients,
        ordered by shape, then by term, with those of contexts last. The
        first three shapes of the first Gaussian are not fitted. The
        covariance includes the effect of ``unmodelled`` on the fitted
        stars.
    stars : `~astropy.table.QTable`
        The stars, including those that were dropped: ``x``, ``y``,
        ``x_fit``, ``y_fit``, ``flux_fit``, ``local_bkg``,
        ``reduced_chi2``, ``n_pixels_fit``, ``n_pixels_rejected``, ``used``
        and, where not used, the ``reason``; of several exposures
        ``exposure``, and ``star``, which is the same for all detections of
        a star.
    residual_stars : (n, s, s) `~numpy.ndarray`
        Data minus model of the stars in ``stars``; NaN outside the circle and
        at pixels that were not used.
    accuracy : float
        The relative error of the PSF, determined from the chi^2 of the
        stars, two standard errors below the median of what they say. 0
        means that these stars show no misfit beyond their noise, not that
        there is none; what the noise of the stars leaves open is in the
        errors of the PSF.
    dropped : `~astropy.table.QTable`
        ``id`` and ``reason`` of the stars that were not used.
    choice : `~astropy.table.QTable`
        The reduced chi^2 of left-out stars for each ``n_components`` and
        ``degree`` that was tried; empty if both were given.
    exposures : `~astropy.table.QTable`, optional
        If the stars are from several exposures, the covariance that each
        one adds to all Gaussians, ``xx``, ``xy``, ``yy`` [pix^2], about the
        mean of all, and its errors ``xx_err``, ``xy_err``, ``yy_err``. That
        of a single one is part of the PSF.
    centre_stddev : float, optional
        The size w of the Gaussian weight under which the PSF's first moment
        about its origin vanishes [pix]; infinite, the default, where the
        origin is the flux centroid.
    pixel_integrated : bool, optional
        Whether the mixtures describe the optics and have to be integrated
        over pixels. By default they include the pixel and are sampled.
    unmodelled : (6 K - 3,) `~numpy.ndarray`, optional
        The variances of the shapes about their polynomials, determined
        from stars left out of the fit; by default none.
    wing_share, wing_error : float, optional
        The share of the flux in one more Gaussian, for the light beyond
        the stamps, and its error; 0 if it was not measured.
    wing_stddev : float, optional
        The size of that Gaussian [pix].
    contexts : `~astropy.table.QTable`, optional
        The quantities on which shapes depend in addition to position:
        ``name`` of the column in a table of stars, and ``mean``,
        ``stddev``, ``low`` and ``high`` of the stars. Stars beyond ``low``
        or ``high`` get the PSF at this limit.
    context_coefficients : (C, X, K, 6) `~numpy.ndarray`, optional
        The change of the shapes for each standard deviation of each of the
        C contexts, times the first X = 1 or 3 terms.
    lateral_shifts : (C, X, 2) `~numpy.ndarray`, optional
        The shift of the light in x and y for it [pix].
    brighter_fatter : `~astropy.table.QTable`, optional
        If bright stars are wider, one row: the covariance that each unit
        of flux adds to all Gaussians, ``xx``, ``xy``, ``yy`` [pix^2],
        their errors ``xx_err``, ``xy_err``, ``yy_err``, the
        ``significance``, a chi^2 with three degrees of freedom, and the
        ``largest`` flux of the stars. The other numbers are then for faint
        stars.

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
    >>> field.stars['x_fit'].round(3).tolist()
    [12.3, 40.1]
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
    contexts: QTable = field(default=None)
    context_coefficients: np.ndarray = None
    lateral_shifts: np.ndarray = None
    brighter_fatter: QTable = field(default=None)

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
        for name in _TABLES:
            if getattr(self, name) is not None:
                tables[name] = table_columns(getattr(self, name))
        if self.contexts is not None:
            tables['contexts'] |= {'coefficient': self.context_coefficients,
                                   'shift': self.lateral_shifts}
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
        # Files once held no PSF of optics, and no centre other than that of
        # the flux.
        integrated = bool(detector.get('pixel_integrated', [False])[0])
        stddev = float(detector.get('centre_stddev', [np.inf])[0])
        found = cls(
            coefficients.reshape(n_terms, -1, 6),
            (int(detector['ny'][0]), int(detector['nx'][0])),
            float(detector['radius'][0]), covariance.reshape(n, n),
            QTable(stars), residual, float(detector['accuracy'][0]),
            QTable(tables['dropped']), centre_stddev=stddev,
            pixel_integrated=integrated,
            unmodelled=tables.get('unmodelled', {}).get('variance'),
            **{name: float(detector.get(name, [0.0])[0]) for name in _WINGS})
        return replace(found, **found._tables_of(tables))

    def _tables_of(self, tables):
        """Return what a file holds of exposures, contexts and fluxes."""
        kept = {name: dict(tables[name]) for name in _TABLES
                if name in tables}
        arrays = {}
        if 'contexts' in kept:
            n = len(kept['contexts']['name'])
            coefficients, shifts = (kept['contexts'].pop(name)
                                    for name in ('coefficient', 'shift'))
            arrays = {'context_coefficients': coefficients.reshape(
                n, -1, self.n_components, 6),
                'lateral_shifts': shifts.reshape(n, -1, 2)}
        return {name: QTable(columns) for name, columns in kept.items()
                } | arrays

    @property
    def n_components(self):
        """The number K of Gaussians."""
        return self.coefficients.shape[1]

    def mixture_at(self, x, y, *, exposure=None, flux=None, **contexts):
        """
        Return the PSF at a detector position.

        Parameters
        ----------
        x, y : float
            The position [pix].
        exposure : int, optional
            The exposure, from 0; by default the mean of all.
        flux : float, optional
            The flux of the star, if bright stars are wider; by default the
            PSF is that of a faint star.
        **contexts : float, optional
            The values of the contexts, such as ``colour=0.7``; by default
            the mean of the fitted stars.

        Returns
        -------
        GaussianMixture
            A mixture of K Gaussians with its centre at the origin. It
            includes the pixel, unless the field is ``pixel_integrated``.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        kind = self._kind(exposure, flux, contexts)
        weights, means, covariances, _ = self._mixtures([x], [y], kind)
        return GaussianMixture(weights[0], means[0], covariances[0])

    def at_exposure(self, exposure):
        """
        Return the field of one exposure.

        Parameters
        ----------
        exposure : int
            Its number, from 0.

        Returns
        -------
        MixtureField
            With the PSF and the stars of that exposure alone.

        Raises
        ------
        TypeError, ValueError
            If there is no such exposure.
        """
        self._blur(exposure)
        if self.exposures is None:
            return self
        rows = np.asarray(self.stars['exposure']) == exposure
        residual = self.residual_stars
        return replace(self, exposures=self.exposures[exposure:exposure + 1],
                       stars=self.stars[rows],
                       residual_stars=residual if residual is None
                       else residual[rows])

    def _kind(self, exposure=None, flux=None, contexts=None):
        """Return the `_Kind` that is asked for."""
        blur = None
        if exposure is not None or (self.exposures is not None
                                    and len(self.exposures) == 1):
            blur = self._blur(exposure or 0)
        if flux is not None:
            fatter = as_real(flux, 'flux') * self._fattening()
            blur = fatter if blur is None else blur + fatter
        names = [] if self.contexts is None else list(self.contexts['name'])
        values = known_contexts(contexts or {}, names)
        return _Kind(self._scaled([values.get(name, np.nan)
                                   for name in names]), blur)

    def _scaled(self, values):
        """Return values (C,) of contexts in standard deviations."""
        if self.contexts is None:
            return np.zeros(0)
        return Contexts.of_table(self.contexts).scaled(np.array(values, float))

    def _fattening(self):
        """Return what a unit of flux adds to the covariances, (1, 3)."""
        if self.brighter_fatter is None:
            return np.zeros((1, 3))
        row = self.brighter_fatter[0]
        return np.array([[row[name] for name in ('xx', 'xy', 'yy')]])

    def _mixtures(self, x, y, kind, change=None):
        """Return stacked weights, means, covariances and shifts."""
        shapes = np.einsum('nt,tki->nki', self._basis(x, y, kind),
                           self._all_coefficients())
        blur = kind.blur
        if change is not None:
            flat = shapes.reshape(len(shapes), -1)[:, 3:]
            flat += change[:flat.shape[1]]
            more = change[flat.shape[1]:]
            blur = blur + more if more.size else blur
        if blur is not None:
            shapes = convolved(shapes, blur)
        weights, means, covariances, shift = mixture_arrays(
            shapes, self.centre_stddev)
        if kind.contexts.any():
            means = means + self._lateral(x, y, kind)[:, None]
        mixtures = weights, means, covariances, shift
        return self._with_wings(*mixtures) if self.wing_share else mixtures

    def _all_coefficients(self):
        if self.contexts is None:
            return self.coefficients
        return np.concatenate([self.coefficients, np.concatenate(
            self.context_coefficients)])

    def _basis(self, x, y, kind):
        """Return the terms of all coefficients, (n, T + C X)."""
        places = normalised(x, y, self.shape)
        basis = stages.polynomials(*places, self.degree)
        if self.contexts is None:
            return basis
        return np.hstack([basis, self._context_terms(places, kind)])

    def _context_terms(self, places, kind):
        degree = 1 if self.lateral_shifts.shape[1] > 1 else 0
        scaled = np.tile(kind.contexts, (len(places[0]), 1))
        return context_terms(scaled, *places, degree)

    def _lateral(self, x, y, kind):
        """Return how far light is moved for its contexts, (n, 2)."""
        terms = self._context_terms(normalised(x, y, self.shape), kind)
        return terms @ np.concatenate(self.lateral_shifts)

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

        It includes the noise of the fitted shapes, their changes beyond
        the polynomials, the residual of the stars inside the radius and,
        if the light beyond the stamps was measured, ``wing_error``.

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
        x, y, kind = [as_real(x, 'x')], [as_real(y, 'y')], self._kind()

        def change_to(change):
            parts = self._mixtures(x, y, kind, change)[:3]
            return 1 / GaussianMixture(*(part[0] for part in parts)
                                       ).encircled_energy(radius)
        slope = slopes(change_to, self._unmodelled().size)
        shapes = slope @ shape_covariance(
            self.covariance, self._unmodelled(), self._basis(x, y, kind)
            )[0] @ slope
        misfit = correction - self._corrected(radius, 1 / correction)
        return float(np.sqrt(shapes + (correction * self.wing_error) ** 2
                             + misfit**2))

    def _corrected(self, radius, inside):
        """Return the aperture correction that the stars' pixels ask for."""
        if self.residual_stars is None:
            return 1 / inside
        left, total = (left_over(self, one)[0] for one in (radius,
                                                           self.radius))
        return (1 + total) / max(inside + left, 1e-3)

    def _unmodelled(self):
        if self.unmodelled is None:
            return np.zeros(6 * self.n_components - 3)
        return self.unmodelled

    def psf_errors(self, *, exposure=None, flux=None, **contexts):
        """
        Return the errors of the PSF, for the errors of photometry.

        They include the errors of the coefficients and the changes of the
        shapes beyond the polynomials, at places all over the detector.
        `to_grid` stores them in its grid.

        Parameters
        ----------
        exposure, flux, **contexts : optional
            Of which PSF, see `mixture_at`.

        Returns
        -------
        PSFErrors
        """
        kind = self._kind(exposure, flux, contexts)
        return psf_errors(
            lambda x, y, change: (self._basis(x, y, kind), *self._mixtures(
                x, y, kind, change)[:3]),
            self.covariance, self._unmodelled(), self.degree, self.shape,
            self.pixel_integrated, self._blur_variance(exposure),
            self.accuracy if self.pixel_integrated else 0.0)

    def _blur_variance(self, exposure):
        """Return the variances (3,) of what an exposure adds, if any."""
        if self.exposures is None or (exposure is None
                                      and len(self.exposures) > 1):
            return []
        row = self.exposures[exposure or 0]
        return np.nan_to_num([row[f'{name}_err']**2
                              for name in ('xx', 'xy', 'yy')])

    def _blur(self, exposure):
        n = 1 if self.exposures is None else len(self.exposures)
        if not 0 <= as_integer(exposure, 'exposure') < n:
            msg = f'exposure must be below {n}, got {exposure}'
            raise ValueError(msg)
        if self.exposures is None:
            return np.zeros((1, 3))
        row = self.exposures[exposure]
        return np.array([[row[name] for name in ('xx', 'xy', 'yy')]])

    def to_grid(self, grid_shape=(30, 30), *, exposure=None, flux=None,
                **contexts):
        """
        Return the field sampled on a grid, as a model for photutils.

        Parameters
        ----------
        grid_shape : int or (int, int), optional
            The number of nodes along y and x. They reach from the first
            pixel to the last.
        exposure, flux, **contexts : optional
            Choose the PSF, see `mixture_at`. For a flux or contexts that
            you do not give, the grid has the dependence on them as its
            ``contexts``, and `MixturePSFPhotometry` uses it.

        Returns
        -------
        GriddedMixturePSF
            The grid, including the errors of the field.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        nodes = list(lattice(as_grid_shape(grid_shape), self.shape))
        given = {'flux': flux, **contexts}

        def grid(kind, **options):
            mixtures = [GaussianMixture(*one) for one in zip(
                *self._mixtures(*nodes, kind)[:3], strict=True)]
            return GriddedMixturePSF(
                mixtures, np.column_stack(nodes),
                pixel_integrated=self.pixel_integrated, **options)

        def context(name, values, usual):
            layers = [grid(self._kind(exposure, **_asked(
                given | {name: value}))) for value in values]
            return PSFContext(name, np.array(values), usual, tuple(layers))
        kind = self._kind(exposure, flux, contexts)
        with waiting('MixtureField.to_grid'):
            return grid(
                kind, errors=self.psf_errors(exposure=exposure, **given),
                contexts=[context(*one) for one in self._free_contexts(
                    contexts, flux)])

    def _free_contexts(self, contexts, flux):
        """Yield name, values and usual value of contexts not given."""
        for name, mean, low, high in (
                () if self.contexts is None else self.contexts.iterrows(
                    'name', 'mean', 'low', 'high')):
            if name not in contexts:
                yield str(name), np.concatenate([
                    np.linspace(low, mean, _LAYERS, endpoint=False), [mean],
                    np.linspace(high, mean, _LAYERS, endpoint=False)[::-1]
                ]), mean
        if self.brighter_fatter is not None and flux is None:
            yield 'flux', [0.0, float(self.brighter_fatter['largest'][0])], 0.0


def _asked(values):
    """Return flux and contexts as arguments of a kind."""
    return {'flux': values['flux'], 'contexts': {
        name: value for name, value in values.items() if name != 'flux'}}
