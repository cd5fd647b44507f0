r"""
A grid of Gaussian mixtures over a detector (Nie et al., Sec. 3.3).

At a star the images of the four neighbouring nodes are blended with bilinear
weights :math:`w_n`; the PSF is the mixture of their :math:`4K` Gaussians,

.. math::

    P(x, y \,|\, x_0, y_0) = \sum_{n=1}^{4} w_n(x_0, y_0)\,
    s_n\, P_n(x - x_0, y - y_0).

Outside the grid the weights are those of the nearest edge.
"""
import numpy as np
from astropy.table import QTable

from photutils_mgauss import kernels
from photutils_mgauss.files.storage import storable, table_columns
from photutils_mgauss.psf.base import (
    PARAMETER_COLUMNS,
    PSFModel,
    flat_points,
    plain_positions,
    split_flux,
    with_unit,
)
from photutils_mgauss.psf.blending import as_list
from photutils_mgauss.psf.contexts import (
    PSFContext,
    at_values,
    from_columns,
    known_contexts,
    to_columns,
)
from photutils_mgauss.psf.convert import GridConversions
from photutils_mgauss.psf.errors import PSFErrors
from photutils_mgauss.psf.grid import checked_arrays, make_grid, plain_report
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.model import MultiGaussianPSFModel
from photutils_mgauss.utils.notebook import with_picture
from photutils_mgauss.utils.validation import (
    as_choice,
    as_columns,
    as_shape,
    real_array,
)

__all__ = ['GriddedMixturePSF']

_KERNELS = {
    'blend': (kernels.evaluate_grid, kernels.differentiate_grid,
              kernels.render_grid),
    'components': (kernels.evaluate_matched, kernels.differentiate_matched,
                   kernels.render_matched),
}
_OUTSIDE = ('clamp', 'raise', 'nan')


@storable(model=dict.fromkeys(
              ('name', 'pixel_integrated', 'interpolation', 'outside'), ''),
          parameters=PARAMETER_COLUMNS,
          nodes={'x': 'pix', 'y': 'pix', 'scale': '', 'weight': '',
                 'mean': 'pix', 'covariance': 'pix2'})
class GriddedMixturePSF(GridConversions, PSFModel):
    """
    A PSF that varies over a detector: mixtures of Gaussians on a grid.

    Use it wherever photutils takes a PSF model, for example in
    `photutils.psf.PSFPhotometry`, instead of
    `photutils.psf.GriddedPSFModel`. Its parameters are ``flux``, ``x_0``
    and ``y_0``.

    Parameters
    ----------
    mixtures : sequence of N `GaussianMixture`
        The PSF at each node. The numbers of Gaussians may differ. A node
        whose mixture is None is bridged: it gets a blend of its nearest
        neighbours.
    grid_xypos : (N, 2) array_like
        The positions (x, y) of the nodes [pix], in the order of
        ``mixtures``. They form a rectangular grid of any spacing; a single
        node, a row or a column are grids, too.
    flux : float or `~astropy.units.Quantity`, optional
        The total flux.
    x_0, y_0 : float, optional
        The position of the star [pix].
    pixel_integrated : bool, optional
        Whether to integrate the mixtures over each unit pixel. Leave it
        off if they already include the pixel, as those made from ePSFs do.
    scales : (N,) array_like, optional
        The flux on the detector of a star of ``flux`` 1 at each node; 1 by
        default. Grids made from ePSFs keep the scale of the ePSFs, so that
        fluxes agree with those of `~photutils.psf.GriddedPSFModel`.
    interpolation : {'blend', 'components'}, optional
        The interpolation between nodes: ``'blend'`` adds the images of the
        four nearest nodes, with 4 K Gaussians; ``'components'`` matches
        the Gaussians of these nodes and replaces each set by one Gaussian
        with the same flux, centroid and second moments, with K Gaussians.
    outside : {'clamp', 'raise', 'nan'}, optional
        The PSF of a star outside the outermost nodes: that of the nearest
        edge, a ValueError, or NaN. Use ``'clamp'`` for fits, because a fit
        may step outside.
    errors : PSFErrors, optional
        The errors of the PSF, from ``MixtureField.psf_errors``. Photometry
        adds their effect to the errors of stars.
    contexts : sequence of PSFContext, optional
        The change of the PSF with the colour or the flux of a star, from
        ``MixtureField.to_grid``. The grid itself, and its values, are for
        a typical star; `MixturePSFPhotometry` fits each star with its own
        PSF.
    **kwargs
        Keywords of `~astropy.modeling.Model`: ``name``, ``meta``, ``fixed``,
        ``bounds``.

    Raises
    ------
    TypeError
        If ``mixtures`` holds anything but `GaussianMixture` objects.
    ValueError
        If the numbers of mixtures and positions differ, two nodes are at one
        place, the positions do not form a rectangular grid, or weights are
        negative and ``interpolation`` is ``'components'``.

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
                 pixel_integrated=False, scales=None, interpolation='blend',
                 outside='clamp', errors=None, contexts=(), **kwargs):
        mixtures = as_list(mixtures)
        grid, order = make_grid(mixtures, grid_xypos, scales)
        self._set_up(grid, pixel_integrated, interpolation, outside, errors,
                     contexts)
        self._report = plain_report(
            grid.positions, (grid.weights != 0).sum(axis=1), grid.scales)
        self._report['bridged'] = [mixtures[i] is None for i in order]
        super().__init__(flux=flux, x_0=x_0, y_0=y_0, **kwargs)
        self._finish()

    def _set_up(self, grid, pixel_integrated, interpolation, outside,
                errors, contexts):
        self._grid = grid
        self._contexts = tuple(contexts)
        if not all(isinstance(one, PSFContext) for one in self._contexts):
            msg = f'contexts must be PSFContext objects, got {contexts!r:.80}'
            raise TypeError(msg)
        if not (errors is None or isinstance(errors, PSFErrors)):
            msg = f'errors must be PSFErrors or None, got {errors!r:.80}'
            raise TypeError(msg)
        self._errors = errors
        self._pixel_integrated = bool(pixel_integrated)
        self._interpolation = as_choice(interpolation, 'interpolation',
                                        tuple(_KERNELS))
        self._outside = as_choice(outside, 'outside', _OUTSIDE)
        if interpolation == 'components' and (grid.weights < 0).any():
            msg = ("interpolation must be 'blend' where weights are negative, "
                   "got 'components'")
            raise ValueError(msg)

    @classmethod
    def _of_grid(cls, grid, report=None, *, pixel_integrated=False,
                   interpolation='blend', outside='clamp', errors=None,
                   contexts=(), **kwargs):
        """Return a model of a grid that needs no checks."""
        new = cls.__new__(cls)
        new._set_up(grid, pixel_integrated, interpolation, outside, errors,
                    contexts)
        new._report = report if report is not None else plain_report(
            grid.positions, (grid.weights != 0).sum(axis=1), grid.scales)
        PSFModel.__init__(new, **kwargs)
        new._finish()
        return new

    @property
    def report(self):
        """
        How good the mixture of each node is, a `~astropy.table.QTable`.

        Columns: ``id``, ``x``, ``y`` [pix], ``n_components``, ``scale``;
        ``chi2`` of the fit; ``size_error`` and ``ellipticity_error``, the
        dR^2/R^2 and d-epsilon of Eq. 8 by adaptive moments, and ``e1``,
        ``e2`` of the image; ``phase_error``, half the range of the shift
        with pixel phase that the residual causes [pix];
        ``flux_phase_error``, the standard deviation over the pixel phases
        of a flux fitted in 5 x 5 pixels, as a fraction of it, for faint or
        for bright stars, whichever is larger; ``enclosed_flux``;
        ``bridged``, whether the node was filled from its neighbours;
        ``status`` and ``message`` of the fit, -1 for mixtures not fitted.
        """
        return self._report.copy()

    @property
    def grid(self):
        """The mixtures at the nodes as arrays, see ``PSFModel``."""
        return self._grid

    @property
    def grid_xypos(self):
        """The positions (x, y) of the nodes by y, then x, (M, 2) [pix]."""
        return self._grid.positions

    @property
    def grid_shape(self):
        """The number of nodes along y and x."""
        return self._grid.shape

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
    def errors(self):
        """The errors of the PSF, or None if they are not known."""
        return self._errors

    @property
    def contexts(self):
        """The changes of the PSF with colours and fluxes, a tuple."""
        return self._contexts

    @property
    def interpolation(self):
        """The interpolation between nodes, 'blend' or 'components'."""
        return self._interpolation

    @property
    def outside(self):
        """What happens to stars outside the outermost nodes."""
        return self._outside

    @property
    def _state(self):
        return (self._grid.serial, self._pixel_integrated,
                self._interpolation, self._outside)

    def __repr__(self):
        return self._described(f'grid_shape={self.grid_shape}, ')

    def _repr_html_(self):
        return with_picture(repr(self), lambda ax: self.plot(ax=ax))

    def plot(self, quantity='size', *, ax=None):
        """
        Draw the nodes over the detector.

        Parameters
        ----------
        quantity : str, optional
            ``'size'`` maps their widths, ``'ellipticity'`` draws whiskers,
            and the name of a column of ``report`` maps that; see
            `~photutils_mgauss.plotting.plot_width_map`,
            `~photutils_mgauss.plotting.plot_whiskers` and
            `~photutils_mgauss.plotting.plot_node_map`.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; None is pyplot's current Axes.

        Returns
        -------
        `~matplotlib.axes.Axes`

        Raises
        ------
        TypeError, ValueError
            If there is no such quantity.
        """
        from photutils_mgauss import plotting
        numbers = [name for name in self.report.colnames
                   if self.report[name].dtype.kind in 'fiu']
        quantity = as_choice(quantity, 'quantity',
                             ('size', 'ellipticity', *numbers))
        if quantity == 'size':
            return plotting.plot_width_map(self, ax=ax)
        if quantity == 'ellipticity':
            return plotting.plot_whiskers(self, ax=ax)
        return plotting.plot_node_map(self, quantity, ax=ax)

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
        x, y, x_0, y_0 = plain_positions(x, y, x_0, y_0)
        flux, unit = split_flux(flux)
        x_0, y_0 = real_array(x_0, 'x_0'), real_array(y_0, 'y_0')
        if x_0.shape != y_0.shape:
            x_0, y_0 = np.broadcast_arrays(x_0, y_0)
        (x, y, flux, x_0, y_0), shape = flat_points(x, y, flux, x_0, y_0)
        out = np.empty(x.size)
        self._run(0, x, y, flux, x_0, y_0, out=out)
        self._mark_outside(x_0, y_0, out)
        return with_unit(out.reshape(shape), unit)

    def _run(self, which, *arguments, out):
        """Call the kernel of the interpolation, 0 to 2 of its three."""
        grid = self._grid
        nodes = grid.rows if self._interpolation == 'blend' else grid.sums
        _KERNELS[self._interpolation][which](
            *arguments, nodes, grid.x_grid, grid.y_grid,
            self._pixel_integrated, out)

    def _mark_outside(self, x_0, y_0, out):
        """Treat results of stars outside the grid as ``outside`` says."""
        if self._outside == 'clamp':
            return
        outside = self._grid.is_outside(x_0, y_0)
        if not np.any(outside):
            return
        if self._outside == 'raise':
            place = [float(np.atleast_1d(a)[np.atleast_1d(outside)][0])
                     for a in (x_0, y_0)]
            msg = f'x_0, y_0 must be inside the grid of nodes, got {place}'
            raise ValueError(msg)
        out[..., outside if np.size(outside) > 1 else slice(None)] = np.nan

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
            One array of the shape of x for each parameter, with what is tied
            to it.
        """
        flux = float(np.squeeze(split_flux(flux)[0]))
        (x, y), shape = flat_points(x, y)
        x_0, y_0 = float(np.squeeze(x_0)), float(np.squeeze(y_0))
        out = np.empty((3, x.size))
        self._run(1, x, y, x_0, y_0, out=out)
        self._mark_outside(x_0, y_0, out)
        out[1:] *= flux
        columns = list(out.reshape(3, *shape))
        return (self._along_ties(columns, (flux, x_0, y_0))
                if any(one.tied for one in self._all_parameters())
                else columns)

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
            A mixture of unit flux with up to 4 K Gaussians, or K with the
            interpolation 'components'.

        Raises
        ------
        ValueError
            If the position is outside the grid and ``outside`` is not
            ``'clamp'``.
        """
        grid = self._inside(x, y)
        if self._interpolation == 'components':
            return grid.matched_mixture(x, y)
        index, share = grid.neighbours(x, y)
        weights = share[:, None] * (grid.scales[:, None] * grid.weights)[index]
        used = weights != 0
        return GaussianMixture(weights[used] / weights.sum(),
                               grid.means[index][used],
                               grid.covariances[index][used])

    def _inside(self, x, y):
        """Return the grid if a PSF is to be had at this position."""
        if self._outside != 'clamp' and self._grid.is_outside(x, y):
            msg = (f'x, y must be inside the grid of nodes, got '
                   f'{[float(x), float(y)]}')
            raise ValueError(msg)
        return self._grid

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
        index, share = self._inside(x, y).neighbours(x, y)
        return float(share @ self._grid.scales[index])

    def at_context(self, **values):
        """
        Return the grid for stars of one colour, or of another context.

        Parameters
        ----------
        **values : float
            Values by the names of ``contexts``; other contexts stay
            unchanged.

        Returns
        -------
        GriddedMixturePSF
            A grid whose mixtures are blends of those of this one.

        Raises
        ------
        TypeError, ValueError
            If a name is not that of a context, or a value not a number.
        """
        values = known_contexts(values, [one.name for one in self._contexts])
        return GriddedMixturePSF(
            at_values(self.mixtures, self._contexts, values),
            self.grid_xypos, flux=self.flux.value, x_0=self.x_0.value,
            y_0=self.y_0.value, scales=self.scales,
            pixel_integrated=self._pixel_integrated,
            interpolation=self._interpolation, outside=self._outside,
            errors=self._errors, contexts=[
                context for context in self._contexts
                if context.name not in values])

    def local_model(self, x, y):
        """
        Return the PSF at a detector position as a separate model.

        Parameters
        ----------
        x, y : float
            The position [pix].

        Returns
        -------
        MultiGaussianPSFModel
            A model at (x, y), with the flux of a star of flux 1.
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
        mixtures = [mixture.convolve(kernel) for mixture in self.mixtures]
        errors = self._errors and self._errors.convolved(kernel)
        new = GriddedMixturePSF(
            mixtures, self.grid_xypos, flux=self.flux.value,
            x_0=self.x_0.value, y_0=self.y_0.value, scales=self.scales,
            pixel_integrated=self._pixel_integrated,
            interpolation=self._interpolation, outside=self._outside,
            errors=errors, contexts=[one.convolved(kernel)
                                     for one in self._contexts])
        new._report['bridged'] = self._report['bridged']
        return new

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
        x, y, flux = as_columns(x=x, y=y, flux=flux)
        ny, nx = as_shape(shape, 'shape')
        out = np.zeros((x.size, ny, nx))
        self._run(2, x, y, flux, np.rint(x) - (nx - 1) // 2,
                  np.rint(y) - (ny - 1) // 2, out=out)
        self._mark_outside(x, y, np.moveaxis(out, 0, -1))
        return out

    def _to_tables(self):
        grid = self._grid
        x, y = grid.positions.T
        model = {'name': [str(self.name or '')],
                 'pixel_integrated': [self._pixel_integrated],
                 'interpolation': [self._interpolation],
                 'outside': [self._outside]}
        nodes = {'x': x, 'y': y, 'scale': grid.scales, 'weight': grid.weights,
                 'mean': grid.means, 'covariance': grid.covariances}
        tables = {'model': model, 'parameters': self._parameter_table(),
                  'nodes': nodes, 'report': table_columns(self._report)}
        if self._errors is not None:
            tables['psf_errors'] = self._errors.to_columns()
        if self._contexts:
            tables['contexts'] = to_columns(self._contexts)
        return tables

    @classmethod
    def _from_tables(cls, tables):
        model, nodes = tables['model'], tables['nodes']
        n = len(nodes['x'])

        def grid(scales, weights, means, covariances):
            return checked_arrays(
                nodes['x'], nodes['y'], weights.reshape(n, -1),
                means.reshape(n, -1, 2), covariances.reshape(n, -1, 2, 2),
                # FITS has no axes of one element.
                np.reshape(scales, n))
        report = tables.get('report')
        errors = tables.get('psf_errors')
        options = {'pixel_integrated': bool(model['pixel_integrated'][0]),
                   'interpolation': str(model['interpolation'][0]),
                   'outside': str(model['outside'][0])}
        contexts = from_columns(tables.get('contexts'), lambda *arrays:
                                cls._of_grid(grid(*arrays), **options))
        return cls._of_grid(
            grid(*(nodes[name] for name in ('scale', 'weight', 'mean',
                                            'covariance'))),
            QTable(report) if report else None,
            errors=PSFErrors.from_columns(errors) if errors else None,
            contexts=contexts, **options, name=str(model['name'][0]) or None,
            **cls._parameter_keywords(tables['parameters']))

    def _half_size(self):
        """Half the width and height of the bounding box [pix]."""
        grid = self._grid
        stddevs = np.sqrt(grid.covariances[..., [0, 1], [0, 1]])
        reach = np.abs(grid.means) + self.bbox_factor * stddevs
        return reach.max(axis=(0, 1)) + 0.5 * self._pixel_integrated
