r"""
A grid of Gaussian mixtures over a detector (Nie et al., Sec. 3.3).

At a star the images of the four neighbouring nodes are blended with bilinear
weights :math:`w_n`; the PSF is the mixture of their :math:`4K` Gaussians,

.. math::

    P(x, y \,|\, x_0, y_0) = \sum_{n=1}^{4} w_n(x_0, y_0)\,
    s_n\, P_n(x - x_0, y - y_0).

Outside the grid the weights are those of the nearest edge.
"""
from dataclasses import dataclass, field
from itertools import count

import numpy as np
from photutils.psf import GriddedPSFModel

from photutils_mgauss import _kernels
from photutils_mgauss._psf_model import (
    PSFModel,
    flat_points,
    split_flux,
    strip_units,
    with_unit,
)
from photutils_mgauss._validation import as_floats, as_shape
from photutils_mgauss.mixture import GaussianMixture, _rows
from photutils_mgauss.model import MultiGaussianPSFModel

__all__ = ['GriddedMixturePSF']

_serial = count()


@dataclass(frozen=True, eq=False)
class _Grid:
    """
    The mixtures at M = ny * nx nodes, ordered by y, then x; never changed.

    Attributes
    ----------
    x_grid, y_grid : (nx,), (ny,) `~numpy.ndarray`
        The node positions along each axis, ascending [pix].
    weights, means, covariances : (M, K, ...) `~numpy.ndarray`
        The mixtures; those of fewer Gaussians are padded with weight zero.
    scales : (M,) `~numpy.ndarray`
        The flux on the detector of a star of flux 1.
    """

    x_grid: np.ndarray
    y_grid: np.ndarray
    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray
    scales: np.ndarray
    rows: np.ndarray = field(init=False)
    serial: int = field(init=False)

    def __post_init__(self):
        rows = _rows(self.weights * self.scales[:, None], self.means,
                     self.covariances)
        object.__setattr__(self, 'rows', np.ascontiguousarray(rows))
        object.__setattr__(self, 'serial', next(_serial))
        for array in self.arrays:
            array.flags.writeable = False

    @property
    def arrays(self):
        return (self.x_grid, self.y_grid, self.weights, self.means,
                self.covariances, self.scales)

    def __reduce__(self):
        return _Grid, self.arrays

    def node(self, m):
        """Return the mixture of node m without its padding."""
        used = self.weights[m] != 0
        return GaussianMixture(self.weights[m, used], self.means[m, used],
                               self.covariances[m, used])

    def neighbours(self, x, y):
        """Return the indices and bilinear weights (4,) at a position."""
        index, weights = np.empty(4, np.int64), np.empty((3, 4))
        _kernels.blend_weights(float(x), float(y), self.x_grid, self.y_grid,
                               index, weights)
        used = weights[0] > 0
        return index[used], weights[0, used]


class GriddedMixturePSF(PSFModel):
    """
    A PSF that varies over a detector: mixtures of Gaussians on a grid.

    Used wherever photutils takes a PSF model, such as
    `photutils.psf.PSFPhotometry`, in place of
    `photutils.psf.GriddedPSFModel`. Its parameters are ``flux``, ``x_0`` and
    ``y_0``.

    Parameters
    ----------
    mixtures : sequence of N `GaussianMixture`
        The PSF at each node. The numbers of Gaussians may differ.
    grid_xypos : (N, 2) array_like
        The positions (x, y) of the nodes [pix], in the order of
        ``mixtures``. They form a rectangular grid of any spacing; a single
        node, a row or a column are grids, too.
    flux : float or `~astropy.units.Quantity`, optional
        The total flux.
    x_0, y_0 : float, optional
        The position of the star [pix].
    pixel_integrated : bool, optional
        Whether to integrate the mixtures over each unit pixel. Leave it off
        if they already contain the pixel, as those made from ePSFs do.
    scales : (N,) array_like, optional
        The flux on the detector of a star of ``flux`` 1 at each node; 1 by
        default. Grids made from ePSFs keep the scale of those, so that
        fluxes agree with the ones `~photutils.psf.GriddedPSFModel` gives.
    **kwargs
        Keywords of `~astropy.modeling.Model`: ``name``, ``meta``, ``fixed``,
        ``bounds``.

    Raises
    ------
    TypeError
        If ``mixtures`` holds anything but `GaussianMixture` objects.
    ValueError
        If the numbers of mixtures and positions differ, two nodes are at one
        place, or the positions do not form a rectangular grid.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, GriddedMixturePSF
    >>> mixtures = [GaussianMixture([1], [[0, 0]], [[[s, 0], [0, s]]])
    ...             for s in (1, 2, 3, 4)]
    >>> psf = GriddedMixturePSF(mixtures,
    ...                         [(0, 0), (100, 0), (0, 100), (100, 100)],
    ...                         flux=10, x_0=50, y_0=20)
    >>> psf
    <GriddedMixturePSF(flux=10, x_0=50, y_0=20, grid_shape=(2, 2), \
n_components=1)>
    >>> float(psf(50, 20))
    1.0477700420216443
    >>> psf.mixture_at(50, 20).weights
    array([0.4, 0.4, 0.1, 0.1])
    """

    def __init__(self, mixtures, grid_xypos, *, flux=1, x_0=0, y_0=0,
                 pixel_integrated=False, scales=None, **kwargs):
        self._grid = _make_grid(list(mixtures), grid_xypos, scales)
        self._pixel_integrated = bool(pixel_integrated)
        super().__init__(flux=flux, x_0=x_0, y_0=y_0, **kwargs)
        self._finish()

    @classmethod
    def from_gridded_psf(cls, psf, n_components=3, *, radius=None,
                         executor=None, **kwargs):
        """
        Fit mixtures to the ePSFs of a photutils grid.

        Parameters
        ----------
        psf : `~photutils.psf.GriddedPSFModel` or `~photutils.psf.STDPSFGrid`
            The grid of ePSFs.
        n_components : int, optional
            The number K of Gaussians.
        radius : float, optional
            Only ePSF pixels within this distance of the star are fitted
            [native pix]. By default the largest circle that keeps two
            oversampled pixels away from the edge of the stamp, where some
            libraries carry rows of fill values.
        executor : `~concurrent.futures.Executor`, optional
            Where the nodes are fitted; by default in a pool of threads.
        **kwargs
            Further keywords of `fit_mixture`.

        Returns
        -------
        GriddedMixturePSF
            In the flux convention of ``psf``. It contains the pixel, as
            ePSFs do.

        Raises
        ------
        ValueError
            If a node cannot be fitted.
        """
        from photutils_mgauss.fitting import fit_mixture
        oversampling = np.atleast_1d(psf.oversampling) * np.ones(2, int)
        data = np.asarray(psf.data, dtype=float)
        if radius is None:
            edge = (np.array(data.shape[1:]) - 1) / 2 - 2
            radius = (edge / oversampling).min()
        fits = fit_mixture(data, n_components, radius=radius,
                           oversampling=tuple(oversampling.tolist()),
                           executor=executor, **kwargs)
        failed = [i for i, fit in enumerate(fits) if fit.mixture is None]
        if failed:
            msg = (f'psf must have an ePSF that can be fitted at every node; '
                   f'node {failed[0]} failed: {fits[failed[0]].message}')
            raise ValueError(msg)
        return cls([fit.mixture for fit in fits], psf.grid_xypos,
                   scales=[fit.flux for fit in fits])

    @property
    def grid_xypos(self):
        """The positions (x, y) of the nodes by y, then x, (M, 2) [pix]."""
        x, y = np.meshgrid(self._grid.x_grid, self._grid.y_grid)
        return np.column_stack([x.ravel(), y.ravel()])

    @property
    def grid_shape(self):
        """The number of nodes along y and x."""
        return self._grid.y_grid.size, self._grid.x_grid.size

    @property
    def mixtures(self):
        """The mixtures of the nodes, in the order of ``grid_xypos``."""
        return [self._grid.node(m) for m in range(len(self._grid.scales))]

    @property
    def scales(self):
        """The flux on the detector of a star of flux 1 at each node, (M,)."""
        return self._grid.scales

    @property
    def n_components(self):
        """The largest number K of Gaussians of a node."""
        return self._grid.weights.shape[1]

    @property
    def pixel_integrated(self):
        """Whether mixtures are integrated over pixels, not sampled."""
        return self._pixel_integrated

    @property
    def _state(self):
        return self._grid.serial, self._pixel_integrated

    def __repr__(self):
        pixel = ', pixel_integrated=True' if self._pixel_integrated else ''
        return (f'<GriddedMixturePSF(flux={self.flux.value:g}, '
                f'x_0={self.x_0.value:g}, y_0={self.y_0.value:g}, '
                f'grid_shape={self.grid_shape}, '
                f'n_components={self.n_components}{pixel})>')

    def evaluate(self, x, y, flux, x_0, y_0):
        """
        Evaluate the PSF.

        Parameters
        ----------
        x, y : array_like
            Pixel positions.
        flux, x_0, y_0 : float or array_like
            Flux and position of the star, or of one star for each pixel;
            they broadcast with x and y.

        Returns
        -------
        `~numpy.ndarray`
            The PSF, in the unit of ``flux``.
        """
        x, y, x_0, y_0 = strip_units([x, y, x_0, y_0])
        flux, unit = split_flux(flux)
        x_0, y_0 = np.broadcast_arrays(np.asarray(x_0, float),
                                       np.asarray(y_0, float))
        (x, y, flux, x_0, y_0), shape = flat_points(x, y, flux, x_0, y_0)
        out = np.empty(x.size)
        grid = self._grid
        _kernels.evaluate_grid(x, y, flux, x_0, y_0, grid.rows, grid.x_grid,
                               grid.y_grid, self._pixel_integrated, out)
        return with_unit(out.reshape(shape), unit)

    def fit_deriv(self, x, y, flux, x_0, y_0):
        """
        Evaluate the derivatives by flux, x_0 and y_0.

        The change of the blend with position is included.

        Parameters
        ----------
        x, y : array_like
            Pixel positions.
        flux, x_0, y_0 : float
            Flux and position of the star.

        Returns
        -------
        list of `~numpy.ndarray`
            One array of the shape of x for each parameter.
        """
        flux = float(np.squeeze(split_flux(flux)[0]))
        (x, y), shape = flat_points(x, y)
        out = np.empty((3, x.size))
        grid = self._grid
        _kernels.differentiate_grid(
            x, y, float(np.squeeze(x_0)), float(np.squeeze(y_0)), grid.rows,
            grid.x_grid, grid.y_grid, self._pixel_integrated, out)
        out[1:] *= flux
        return list(out.reshape(3, *shape))

    def mixture_at(self, x, y):
        """
        Return the PSF at a detector position as one mixture.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        GaussianMixture
            Of unit flux and up to 4 K Gaussians.
        """
        grid = self._grid
        index, share = grid.neighbours(x, y)
        weights = share[:, None] * (grid.scales[:, None] * grid.weights)[index]
        used = weights != 0
        return GaussianMixture(weights[used] / weights.sum(),
                               grid.means[index][used],
                               grid.covariances[index][used])

    def scale_at(self, x, y):
        """
        Return the flux on the detector of a star of flux 1.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        float
        """
        index, share = self._grid.neighbours(x, y)
        return float(share @ self._grid.scales[index])

    def local_model(self, x, y):
        """
        Return the PSF at a detector position as a model of its own.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        MultiGaussianPSFModel
            At (x, y), its flux that of a star of flux 1.
        """
        return MultiGaussianPSFModel(
            self.mixture_at(x, y), flux=self.scale_at(x, y), x_0=x, y_0=y,
            pixel_integrated=self._pixel_integrated)

    def convolve(self, kernel):
        """
        Return the grid with every mixture convolved.

        Parameters
        ----------
        kernel : (2, 2) array_like or GaussianMixture
            See `GaussianMixture.convolve`.

        Returns
        -------
        GriddedMixturePSF
        """
        return type(self)._from_grid_like(
            self, [mixture.convolve(kernel) for mixture in self.mixtures])

    @classmethod
    def _from_grid_like(cls, other, mixtures):
        return GriddedMixturePSF(
            mixtures, other.grid_xypos, flux=other.flux.value,
            x_0=other.x_0.value, y_0=other.y_0.value, scales=other.scales,
            pixel_integrated=other.pixel_integrated)

    def render(self, x, y, flux, shape):
        """
        Draw stamps of many stars in one call.

        Parameters
        ----------
        x, y, flux : (n,) array_like
            Positions [pix] and fluxes; numbers stand for all stars.
        shape : int or (ny, nx) tuple of int
            The shape of a stamp. Its middle pixel, ``(shape - 1) // 2``, is
            the pixel nearest to the star.

        Returns
        -------
        (n, ny, nx) `~numpy.ndarray`
            The stamps.

        Raises
        ------
        ValueError
            If positions or fluxes are not finite or do not broadcast.

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture, GriddedMixturePSF
        >>> mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> psf = GriddedMixturePSF([mixture], [(0, 0)])
        >>> psf.render([3.2, 8.1], [4, 5], 100, 11).sum(axis=(1, 2))
        array([99.99999732, 99.99999832])
        """
        stars = np.broadcast_arrays(*(as_floats(value, name) for value, name
                                      in ((x, 'x'), (y, 'y'), (flux, 'flux'))))
        x, y, flux = (np.atleast_1d(np.ascontiguousarray(a)) for a in stars)
        ny, nx = as_shape(shape, 'shape')
        out = np.zeros((x.size, ny, nx))
        grid = self._grid
        _kernels.render_grid(
            x, y, flux, np.rint(x) - (nx - 1) // 2, np.rint(y) - (ny - 1) // 2,
            grid.rows, grid.x_grid, grid.y_grid, self._pixel_integrated, out)
        return out

    def to_gridded_psf(self, oversampling=4, *, radius=None):
        """
        Return the grid as ePSF images, in photutils' own class.

        Parameters
        ----------
        oversampling : int, optional
            ePSF pixels per detector pixel.
        radius : float, optional
            Half the width of the stamps [pix]; by default that of the
            bounding box.

        Returns
        -------
        `~photutils.psf.GriddedPSFModel`

        Raises
        ------
        ValueError
            If photutils cannot hold a grid of this shape: it needs one node
            or at least two along each axis.
        """
        from astropy.nddata import NDData
        radius = self._half_size().max() if radius is None else radius
        steps = np.arange(-np.ceil(radius * oversampling),
                          np.ceil(radius * oversampling) + 1) / oversampling
        data = [scale * mixture.evaluate(
                    steps, steps[:, None],
                    pixel_integrated=self._pixel_integrated)
                for mixture, scale in zip(self.mixtures, self.scales,
                                          strict=True)]
        meta = {'grid_xypos': [tuple(xy) for xy in self.grid_xypos.tolist()],
                'oversampling': oversampling}
        return GriddedPSFModel(NDData(np.array(data), meta=meta),
                               flux=self.flux.value, x_0=self.x_0.value,
                               y_0=self.y_0.value)

    def _half_size(self):
        grid = self._grid
        stddevs = np.sqrt(grid.covariances[..., [0, 1], [0, 1]])
        reach = np.abs(grid.means) + self.bbox_factor * stddevs
        return reach.max(axis=(0, 1)) + 0.5 * self._pixel_integrated


def _make_grid(mixtures, grid_xypos, scales):
    for mixture in mixtures:
        if not isinstance(mixture, GaussianMixture):
            msg = (f'mixtures must be GaussianMixture objects, got '
                   f'{mixture!r:.80}')
            raise TypeError(msg)
    n = len(mixtures)
    if n == 0:
        msg = 'mixtures must have at least one element, got none'
        raise ValueError(msg)
    positions = as_floats(grid_xypos, 'grid_xypos', shape=(n, 2))
    order, x_grid, y_grid = _lattice(positions)
    scales = (np.ones(n) if scales is None
              else as_floats(scales, 'scales', shape=(n,)))
    if not (scales > 0).all():
        msg = f'scales must be positive, got {scales.min()}'
        raise ValueError(msg)
    weights, means, covariances = _stack([mixtures[i] for i in order])
    return _Grid(x_grid, y_grid, weights, means, covariances, scales[order])


def _lattice(positions):
    """Return the order of positions by y, then x, and the two axes."""
    x_grid, y_grid = np.unique(positions[:, 0]), np.unique(positions[:, 1])
    order = np.lexsort((positions[:, 0], positions[:, 1]))
    doubled = (np.diff(positions[order], axis=0) == 0).all(axis=1)
    if doubled.any():
        where = positions[order][doubled.argmax()].tolist()
        msg = f'grid_xypos must not have two nodes at one place, got {where}'
        raise ValueError(msg)
    if x_grid.size * y_grid.size != len(positions):
        msg = (f'grid_xypos must form a rectangular grid, got '
               f'{len(positions)} positions with {x_grid.size} different x '
               f'and {y_grid.size} different y')
        raise ValueError(msg)
    return order, x_grid, y_grid


def _stack(mixtures):
    """Return stacked arrays, padded with round Gaussians of weight zero."""
    k = max(mixture.n_components for mixture in mixtures)
    weights = np.zeros((len(mixtures), k))
    means = np.zeros((len(mixtures), k, 2))
    covariances = np.tile(np.eye(2), (len(mixtures), k, 1, 1))
    for m, mixture in enumerate(mixtures):
        used = slice(mixture.n_components)
        weights[m, used] = mixture.weights
        means[m, used] = mixture.means
        covariances[m, used] = mixture.covariances
    return weights, means, covariances
