r"""
An empirical PSF: pixels, oversampled, that change over the detector.

On top of a mixture field stands a correction of cubic
B-splines on a lattice finer than the pixels, whose coefficients are
polynomials of detector position,

.. math::

    P(\mathbf r\,|\,x, y) = M(\mathbf r\,|\,x, y) +
    \sum_{ij} b(s\,r_x - i)\, b(s\,r_y - j) \sum_t c_{tij} B_t(x, y) ,

with s samples per pixel. It is the paper's route from stars to PSF images
(Nie et al., Sec. 3.1), and a measure of what a mixture leaves out.
"""
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, lsqr

from photutils_mgauss.field import stages
from photutils_mgauss.field.base import lattice
from photutils_mgauss.field.fit import field_of_stars, warn_of_lost
from photutils_mgauss.field.input import normalised, read_sample
from photutils_mgauss.field.mixture_field import MixtureField
from photutils_mgauss.field.options import FieldOptions
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.validation import (
    as_grid_shape,
    as_integer,
    as_real,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['EmpiricalPSF']

# Standard deviation of the corrections, as a share of the PSF's peak, for the
# constant term; each degree has this fraction of the one before.
_PRIOR_STDDEV = 0.03
_PRIOR_FALL = 0.5
# Steps towards the centre of the core: a moment under the weight, narrower
# than the PSF and the weight, is about so much less than the offset.
_CENTRE_STEPS, _CENTRE_GAIN = 4, 1.1


@dataclass(frozen=True, eq=False, repr=False)
class EmpiricalPSF(ComparedByValue):
    """
    PSF images that are polynomials of detector position.

    Made by `from_stars`.

    Attributes
    ----------
    field : MixtureField
        The smooth part.
    coefficients : (T, n, n) `~numpy.ndarray`
        B-spline coefficients of the correction [1 / pix^2] for each
        polynomial term.
    degree : int
        The degree of the polynomials.
    oversampling : int
        Samples per pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from photutils_mgauss import EmpiricalPSF, GaussianMixture
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> stars = Table({'x': [12.3, 40.1], 'y': [14.6, 33.9]})
    >>> data = sum(psf.render((50, 55), x, y, flux=900) for x, y in stars)
    >>> empirical = EmpiricalPSF.from_stars(
    ...     data, stars, error=np.ones((50, 55)), degree=0, radius=8,
    ...     n_components=1)
    >>> empirical
    <EmpiricalPSF(37 x 37 samples, oversampling=2, degree=0)>
    >>> empirical.to_gridded_psf((2, 3)).data.shape
    (6, 73, 73)
    >>> empirical.image_at(20, 20).shape
    (37, 37)
    """

    field: MixtureField
    coefficients: np.ndarray
    degree: int
    oversampling: int

    def __repr__(self):
        n = self.coefficients.shape[1]
        return (f'<EmpiricalPSF({n} x {n} samples, '
                f'oversampling={self.oversampling}, degree={self.degree})>')

    @classmethod
    def from_stars(cls, data, stars, *, error=None, mask=None, degree=3,
                   oversampling=2, radius=10, n_components=5, executor=None):
        """
        Measure the PSF from the stars of one or more exposures.

        The method first fits a mixture field, which gives positions and
        fluxes of the stars and rejects deviant stars and pixels. See the
        example above.

        Parameters
        ----------
        data, stars, error, mask
            See `fit_mixture_field`; lists of them for several exposures.
        degree : int, optional
            The degree of the polynomials, in field and correction.
        oversampling : int, optional
            Samples per pixel.
        radius : float, optional
            The radius of the stamps [pix].
        n_components : int, optional
            The number of Gaussians of the smooth part.
        executor : `~concurrent.futures.Executor`, optional
            The executor that works on stars; by default a pool of threads.

        Returns
        -------
        EmpiricalPSF

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid or no star can be used.
        """
        oversampling = as_integer(oversampling, 'oversampling', minimum=1)
        with waiting('EmpiricalPSF.from_stars'):
            # What its Gaussians miss is fitted next.
            field = field_of_stars(
                data, stars, error, mask, FieldOptions(
                    n_components, degree, radius, normalise='stamps'),
                executor=executor)
            warn_of_lost(field, stacklevel=3)
            problem = _Lattice.of(field, oversampling)
            target, weights = _corrections(field, read_sample(
                data, stars, error, mask, field.radius, None).stamps)
            coefficients = problem.solve(field, target, weights)
        return cls(field, coefficients, field.degree, oversampling)

    def image_at(self, x, y, *, oversampling=None):
        r"""
        Return the PSF at a detector position as an image.

        Parameters
        ----------
        x, y : float
            The position [pix].
        oversampling : int, optional
            Samples per pixel; by default that of the PSF.

        Returns
        -------
        (n, n) `~numpy.ndarray`
            Flux densities [1 / pix^2] with the centre of the core in the
            middle sample; the sum over ``oversampling``\ :sup:`2` is the
            share of the flux in the image.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        x, y = as_real(x, 'x'), as_real(y, 'y')
        fine = (self.oversampling if oversampling is None
                else as_integer(oversampling, 'oversampling', minimum=1))
        half = self.coefficients.shape[1] // 2 * fine // self.oversampling
        steps = np.arange(-half, half + 1) / fine
        return self._sampled(x, y, steps, *self._centre(x, y))

    def _sampled(self, x, y, steps, x_0, y_0):
        """Return the PSF at steps about a point, (n, n)."""
        basis = stages.polynomials(*normalised([x], [y], self.field.shape),
                                   self.degree)[0]
        lattice = np.tensordot(basis, self.coefficients, 1)
        along_x, along_y = (_taps(steps + offset, self.oversampling,
                                  len(lattice)) for offset in (x_0, y_0))
        smooth = self.field.mixture_at(x, y).evaluate(
            steps + x_0, steps[:, None] + y_0)
        return smooth + along_y @ lattice @ along_x.toarray().T

    def _centre(self, x, y):
        """Return where the core is about the field's origin (x, y)."""
        half = self.coefficients.shape[1] // 2 // self.oversampling
        steps = np.arange(-half, half + 1 / 8, 1 / 4)
        weight = np.exp(-steps**2 / (2 * self.field.centre_stddev**2))
        centre = np.zeros(2)
        # The moment falls by about this much with each pixel.
        for _ in range(_CENTRE_STEPS):
            light = (weight * self._sampled(x, y, steps, *centre)
                     * weight[:, None])
            moment = np.array([(light * steps).sum(),
                               (light * steps[:, None]).sum()]) / light.sum()
            centre = centre + _CENTRE_GAIN * moment
        return centre

    def to_gridded_psf(self, grid_shape=(30, 30), *, oversampling=None):
        """
        Return PSF images on a grid, in photutils' own class.

        Parameters
        ----------
        grid_shape : int or (int, int), optional
            The number of nodes along y and x.
        oversampling : int, optional
            Samples per pixel; by default twice that of the PSF, because
            photutils interpolates between them.

        Returns
        -------
        `~photutils.psf.GriddedPSFModel`
            From it `GriddedMixturePSF.from_gridded_psf` makes mixtures.

        Raises
        ------
        TypeError, ValueError
            If an argument is not valid.
        """
        from astropy.nddata import NDData
        from photutils.psf import GriddedPSFModel
        grid = as_grid_shape(grid_shape)
        fine = 2 * self.oversampling if oversampling is None else oversampling
        places = list(zip(*lattice(grid, self.field.shape), strict=True))
        images = [self.image_at(x, y, oversampling=fine) for x, y in places]
        return GriddedPSFModel(NDData(np.array(images), meta={
            'grid_xypos': places, 'oversampling': fine}))


def _corrections(field, stamps):
    """Return what the field leaves of each star, per flux, and weights."""
    table = field.stars
    flux = np.asarray(table['flux_fit'])[:, None, None]
    used = np.isfinite(field.residual_stars) & stamps.good
    used &= np.asarray(table['used'])[:, None, None] & (flux > 0)
    residual = np.where(used, field.residual_stars, 0)
    light = np.maximum(stamps.data - residual, 0)
    weights = np.where(used, flux**2 / (stamps.base + stamps.slope * light),
                       0)
    return np.where(used, residual / flux, 0), weights


@dataclass(frozen=True, eq=False)
class _Lattice:
    """
    The map from corrections to the pixels of n stars, never made dense.

    Attributes
    ----------
    taps : list of (s, N) `~scipy.sparse.csr_array`
        For y and x of each star, the splines at its pixels.
    basis : (n, T) `~numpy.ndarray`
    size : int
        The number N of samples along an axis.
    """

    taps: list
    basis: np.ndarray
    size: int

    @classmethod
    def of(cls, field, oversampling):
        table = field.stars
        half = int(np.ceil(field.radius))
        size = 2 * (half * oversampling + 2) + 1
        steps = np.arange(-half, half + 1)
        taps = []
        for star in table:
            offset = [np.rint(star[name]) - star[f'{name}_fit']
                      for name in ('y', 'x')]
            taps.append([_taps(steps + one, oversampling, size)
                         for one in offset])
        basis = stages.polynomials(*normalised(
            table['x'], table['y'], field.shape), field.degree)
        return cls(taps, basis, size)

    def solve(self, field, target, weights):
        """Return the coefficients (T, N, N) by regularised least squares."""
        n_terms = self.basis.shape[1]
        peak = field.mixture_at(*[n / 2 for n in field.shape[::-1]]).evaluate(
            0, 0)
        orders = np.concatenate([np.full(d + 1, d)
                                 for d in range(field.degree + 1)])
        stddev = peak * _PRIOR_STDDEV * _PRIOR_FALL**orders[:, None, None]
        root = np.sqrt(weights)
        matrix = sparse.block_diag([sparse.kron(a, b) for a, b in self.taps],
                                   format='csr')
        matrix = sparse.diags_array(root.ravel()) @ matrix
        shape = (n_terms, self.size, self.size)

        def forward(vector):
            images = np.tensordot(self.basis, vector.reshape(shape) * stddev,
                                  1)
            return matrix @ images.ravel()

        def backward(vector):
            images = (matrix.T @ vector).reshape(-1, self.size, self.size)
            return (np.tensordot(self.basis.T, images, 1) * stddev).ravel()

        operator = LinearOperator((target.size, int(np.prod(shape))),
                                  matvec=forward, rmatvec=backward)
        found = lsqr(operator, (root * target).ravel(), damp=1.0,
                     iter_lim=100, atol=1e-4, btol=1e-4)[0]
        return found.reshape(shape) * stddev


def _taps(positions, oversampling, size):
    """Return the cubic B-splines of a lattice at positions [pix], sparse."""
    place = np.asarray(positions) * oversampling + size // 2
    first = np.floor(place).astype(int) - 1
    columns = first[:, None] + np.arange(4)
    values = _cubic(place[:, None] - columns)
    rows = np.broadcast_to(np.arange(place.size)[:, None], columns.shape)
    inside = (columns >= 0) & (columns < size)
    return sparse.csr_array(
        (values[inside], (rows[inside], columns[inside])),
        shape=(place.size, size))


def _cubic(t):
    """Return the cubic B-spline, whose integral is 1."""
    t = np.abs(t)
    inner = 2 / 3 - t**2 * (1 - t / 2)
    outer = np.maximum(2 - t, 0) ** 3 / 6
    return np.where(t < 1, inner, outer)
