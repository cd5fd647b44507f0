r"""
Mixtures at the nodes of a rectangular grid, as arrays.

Two ways to blend neighbours are prepared here. *Images*: the four mixtures
are added with bilinear weights, whatever the order of their Gaussians.
*Matched Gaussians*: each Gaussian is paired with one of every neighbour, and
the integrals of :math:`1, x, y, x^2, xy, y^2` over it, which are linear in
the light, are blended, so flux, centroid and second moments of the blend are
those of the blended images.
"""
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count

import numpy as np
from astropy.table import QTable
from scipy.optimize import linear_sum_assignment

from photutils_mgauss.psf.mixture import GaussianMixture, _check_covariances
from photutils_mgauss.psf.rows import integrals, kernel_rows, of_integrals
from photutils_mgauss.utils.validation import as_floats

__all__ = ['Grid', 'check_lattice', 'make_grid']

_serial = count()


@dataclass(frozen=True, eq=False)
class Grid:
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
        rows = kernel_rows(self.weights * self.scales[:, None], self.means,
                           self.covariances)
        object.__setattr__(self, 'rows', np.ascontiguousarray(rows))
        object.__setattr__(self, 'serial', next(_serial))
        for array in self.arrays:
            array.flags.writeable = False

    @classmethod
    def of_mixture(cls, mixture):
        """Return the grid of one node."""
        return cls(np.zeros(1), np.zeros(1), mixture.weights[None],
                   mixture.means[None], mixture.covariances[None], np.ones(1))

    @property
    def arrays(self):
        """The six arrays that make the grid."""
        return (self.x_grid, self.y_grid, self.weights, self.means,
                self.covariances, self.scales)

    def __reduce__(self):
        return Grid, self.arrays

    @property
    def shape(self):
        """The number of nodes along y and x."""
        return self.y_grid.size, self.x_grid.size

    @property
    def positions(self):
        """The positions (x, y) of the nodes, (M, 2)."""
        x, y = np.meshgrid(self.x_grid, self.y_grid)
        return np.column_stack([x.ravel(), y.ravel()])

    def node(self, m):
        """Return the mixture of node m without its padding."""
        used = self.weights[m] != 0
        return GaussianMixture(self.weights[m, used], self.means[m, used],
                               self.covariances[m, used])

    def neighbours(self, x, y):
        """Return the indices and bilinear weights (4,) at a position."""
        x, y = (as_floats(value, name, shape=(), finite=False).reshape(1)
                for value, name in ((x, 'x'), (y, 'y')))
        for value, name in ((x, 'x'), (y, 'y')):
            if np.isnan(value).any():
                msg = f'{name} must not be NaN'
                raise ValueError(msg)
        i, fx = cells(x, self.x_grid)
        j, fy = cells(y, self.y_grid)
        columns = np.append(i, np.minimum(i + 1, self.x_grid.size - 1))
        rows = np.append(j, np.minimum(j + 1, self.y_grid.size - 1))
        index = (rows[:, None] * self.x_grid.size + columns).ravel()
        weights = np.outer(np.append(1 - fy, fy),
                           np.append(1 - fx, fx)).ravel()
        used = weights > 0
        return index[used], weights[used]

    def is_outside(self, x, y):
        """Tell which positions are outside the outermost nodes."""
        return ~((x >= self.x_grid[0]) & (x <= self.x_grid[-1])
                 & (y >= self.y_grid[0]) & (y <= self.y_grid[-1]))

    @cached_property
    def sums(self):
        """The matched integrals (M, K, 6) that `match_rows` blends."""
        order = _matched_order(self)
        nodes = np.arange(len(order))[:, None]
        sums = integrals(self.weights[nodes, order], self.means[nodes, order],
                         self.covariances[nodes, order])
        return np.ascontiguousarray(sums * self.scales[:, None, None])

    def matched_mixture(self, x, y):
        """Return the matched blend at a position."""
        index, share = self.neighbours(x, y)
        return from_integrals(np.tensordot(share, self.sums[index], 1))


def from_integrals(sums):
    """Return the mixture of K Gaussians with these integrals (K, 6)."""
    weights, *shapes = of_integrals(sums[sums[:, 0] != 0])
    return GaussianMixture(weights / weights.sum(), *shapes)


def overlap(a, b):
    """
    Return the integrals (K, L) of the products of the Gaussians of a and b.

    Each of a and b is a triple of weights, means and covariances.
    """
    height, dx, dy, p, s, q = np.moveaxis(kernel_rows(
        a[0][:, None] * b[0], a[1][:, None] - b[1], a[2][:, None] + b[2]),
        -1, 0)
    return height * np.exp(-0.5 * (p * (dx - s * dy) ** 2 + q * dy**2))


def match(a, b):
    """
    Return the order of b's Gaussians in which each is nearest to a's.

    Nearest in the sum of the squared differences of the pairs' images.
    """
    own = [np.diagonal(overlap(c, c)) for c in (a, b)]
    cost = own[0][:, None] + own[1] - 2 * overlap(a, b)
    return linear_sum_assignment(cost)[1]


def _matched_order(grid):
    """Return the order (M, K) of each node's Gaussians, from the middle on."""
    ny, nx = grid.shape
    stack = (grid.weights, grid.means, grid.covariances)
    order = np.tile(np.arange(grid.weights.shape[1]), (ny * nx, 1))
    for node, before in _outward(ny, nx):
        done = order[before]
        order[node] = match([a[before][done] for a in stack],
                            [a[node] for a in stack])
    return order


def _outward(ny, nx):
    """Yield each node but the middle one, with a neighbour nearer to it."""
    j_mid, i_mid = ny // 2, nx // 2
    j, i = np.divmod(np.arange(ny * nx), nx)
    distance = np.abs(j - j_mid) + np.abs(i - i_mid)
    for node in np.argsort(distance, kind='stable')[1:]:
        if j[node] != j_mid:
            yield node, node - nx * np.sign(j[node] - j_mid)
        else:
            yield node, node - np.sign(i[node] - i_mid)


def make_grid(mixtures, grid_xypos, scales):
    """
    Check mixtures and positions, and return a `Grid`.

    A mixture that is None is missing, and bridged from its neighbours.

    Returns
    -------
    Grid
    order : (M,) `~numpy.ndarray` of int
        The places of the nodes in ``mixtures``.
    """
    mixtures = _check_mixtures(mixtures)
    n = len(mixtures)
    positions = as_floats(grid_xypos, 'grid_xypos', shape=(n, 2))
    order, x_grid, y_grid = _lattice(positions)
    scales = (np.ones(n) if scales is None
              else as_floats(scales, 'scales', shape=(n,), finite=False))
    missing = np.array([mixture is None for mixture in mixtures])
    if not (np.isfinite(scales) & (scales > 0))[~missing].all():
        msg = ('scales must be positive and finite, got '
               f'{scales[~missing].min()}')
        raise ValueError(msg)
    stack = _stack([mixtures[i] for i in order])
    scales = scales[order]
    missing = missing[order]
    if missing.any():
        shape = y_grid.size, x_grid.size
        for node in np.flatnonzero(missing):
            _bridge(node, missing, shape, stack, scales)
    return Grid(x_grid, y_grid, *stack, scales), order


def _check_mixtures(mixtures):
    for mixture in mixtures:
        if not (mixture is None or isinstance(mixture, GaussianMixture)):
            msg = (f'mixtures must be GaussianMixture objects, or None for '
                   f'missing nodes, got {mixture!r:.80}')
            raise TypeError(msg)
    if all(mixture is None for mixture in mixtures):
        msg = ('mixtures must have at least one element that is not None, '
               'got none')
        raise ValueError(msg)
    return mixtures


def check_lattice(positions):
    """
    Check the places of nodes before anything is fitted.

    Parameters
    ----------
    positions : (M, 2) `~numpy.ndarray`
        The positions (x, y) [pix].

    Raises
    ------
    ValueError
        If two are at one place, or they do not form a rectangular grid.
    """
    _lattice(positions)


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
    k = max(mixture.n_components for mixture in mixtures if mixture)
    weights = np.zeros((len(mixtures), k))
    means = np.zeros((len(mixtures), k, 2))
    covariances = np.tile(np.eye(2), (len(mixtures), k, 1, 1))
    for m, mixture in enumerate(mixtures):
        if mixture is None:
            continue
        used = slice(mixture.n_components)
        weights[m, used] = mixture.weights
        means[m, used] = mixture.means
        covariances[m, used] = mixture.covariances
    return weights, means, covariances


def _bridge(node, missing, shape, stack, scales):
    """Fill a missing node, in place, with a blend of the nearest ones."""
    j, i = np.divmod(np.arange(missing.size), shape[1])
    distance = np.hypot(j - j[node], i - i[node])
    distance[missing] = np.inf
    near = np.flatnonzero(distance < np.sqrt(2) * distance.min() + 1e-9)
    share = distance[near] ** -2.0
    share /= share.sum()
    scales[node] = share @ scales[near]
    for array, value in zip(stack, _blend_matched(near, share, stack),
                            strict=True):
        array[node] = value


def _blend_matched(near, share, stack):
    """Return the blend of nodes, of as many Gaussians as each of them has."""
    nodes = [[array[m] for array in stack] for m in near]
    orders = [match(nodes[0], node) for node in nodes]
    total = sum(s * integrals(*(array[order] for array in node))
                for s, node, order in zip(share, nodes, orders, strict=True))
    if (stack[0][near] < 0).any():
        # A sum of Gaussians of both signs need not have a Gaussian's moments.
        return nodes[0]
    used = total[:, 0] > 0
    mixture = from_integrals(total)
    blended = tuple(array.copy() for array in nodes[0])
    for array, value in zip(blended, (mixture.weights, mixture.means,
                                      mixture.covariances), strict=True):
        array[used] = value
    blended[0][~used] = 0
    return blended


def cells(position, nodes):
    """Return the cell of each position and the fraction of it passed."""
    if nodes.size == 1:
        return np.zeros(position.size, int), np.zeros(position.size)
    cell = np.searchsorted(nodes, position, side='right') - 1
    cell = np.clip(cell, 0, nodes.size - 2)
    passed = (position - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    return cell, np.clip(passed, 0, 1)


def checked_arrays(x, y, weights, means, covariances, scales):
    """
    Return a `Grid` of stacked arrays, as files hold them, without a copy.

    Raises
    ------
    ValueError
        If they are not mixtures on a rectangular grid in order.
    """
    values = (x, y, weights, means, covariances, scales)
    if not all(np.isfinite(value).all() for value in values):
        msg = 'nodes must be finite, got NaN or infinity'
        raise ValueError(msg)
    order, x_grid, y_grid = _lattice(np.column_stack([x, y]))
    if not (order == np.arange(order.size)).all():
        msg = 'nodes must be ordered by y, then x, got another order'
        raise ValueError(msg)
    if not (np.abs(weights.sum(axis=1) - 1) < 1e-9).all():
        msg = 'weights must sum to 1 at every node'
        raise ValueError(msg)
    if not (scales > 0).all():
        msg = f'scales must be positive, got {scales.min()}'
        raise ValueError(msg)
    _check_covariances(covariances.reshape(-1, 2, 2), 'covariances')
    return Grid(x_grid, y_grid, weights, means, covariances, scales)


def plain_report(positions, n_components, scales):
    """Return the table of mixtures that were given, not fitted."""
    n = len(positions)
    nan = np.full(n, np.nan)
    return QTable({
        'id': np.arange(1, n + 1), 'x': positions[:, 0].astype(float),
        'y': positions[:, 1].astype(float),
        'n_components': np.array(n_components, int), 'scale': scales,
        'chi2': nan, 'size_error': nan, 'ellipticity_error': nan, 'e1': nan,
        'e2': nan, 'phase_error': nan, 'flux_phase_error': nan,
        'enclosed_flux': nan,
        'bridged': np.zeros(n, bool), 'status': np.full(n, -1),
        'message': np.full(n, 'The mixture was given, not fitted.')})
