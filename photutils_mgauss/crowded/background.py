"""The background of a tile of a crowded field: a mesh of nodes."""
import numpy as np

from photutils_mgauss import kernels

# How strongly neighbouring nodes are tied, in units of a node's information.
_TIE = 1e-3
# So often the start of a sloping sky is looked for in what it leaves over.
_START_ROUNDS = 6
# A plane is fitted to about so many pixels a side, those further from the last
# one than so many times their median left out, so often.
_PLANE_PIXELS, _PLANE_CLIP, _PLANE_ROUNDS = 512, 3.0, 5


class Mesh:
    """
    Nodes of a bilinear background, near multiples of the spacing.

    A node is the mean of the sky over the pixels nearest to a multiple, so
    that it depends on nothing further away, and stands in the middle of
    them: at the edges of the image, too, a plane is one. Levels are flat,
    ordered by y, then x.

    Parameters
    ----------
    shape, origin : (y, x) tuple of int
        The pixels of the tile, and where in the image its first one is.
    spacing : float
        The distance of nodes [pix].
    """

    def __init__(self, shape, origin, spacing):
        (self.y, own_y), (self.x, own_x) = (
            _nodes(_lattice(first, n, spacing) - first, n)
            for first, n in zip(origin, shape, strict=True))
        self.shape = self.y.size, self.x.size
        self._owner = [own_y, own_x]
        self._rows, self._columns = (
            _between(np.arange(float(n)), nodes)
            for n, nodes in zip(shape, (self.y, self.x), strict=True))
        self.tie = _TIE * spacing**2

    def image(self, level):
        """Return the background (ny, nx) of levels (n,)."""
        level = level.reshape(self.shape)
        row, passed = self._rows
        passed = passed[:, None]
        level = (1 - passed) * level[row] + passed * level[row + 1]
        column, passed = self._columns
        return (1 - passed) * level[:, column] + passed * level[:, column + 1]

    @property
    def size(self):
        """The number of nodes."""
        return self.shape[0] * self.shape[1]

    def sums(self, weight, residual, background, clip):
        """Return the sums (3, n) over nodes' pixels of `mesh_sums`."""
        out = np.empty((self.size, 3))
        kernels.mesh_sums(weight, residual, background, *self._owner,
                          self.shape[1], clip, out)
        return out.T.copy()

    def n_ties(self):
        """Return to how many neighbours each node is tied (n,)."""
        ny, nx = self.shape
        j, i = np.indices(self.shape)
        return (4.0 - (j == 0) - (j == ny - 1) - (i == 0)
                - (i == nx - 1)).ravel()

    def steepness(self, level):
        """Return the sum (n,) of what each level is above its neighbours."""
        level = level.reshape(self.shape)
        out = np.zeros(self.shape)
        for axis in (0, 1):
            step = np.diff(level, axis=axis)
            ends = [(0, 0), (0, 0)]
            ends[axis] = (1, 1)
            out -= np.diff(np.pad(step, ends), axis=axis)
        return out.ravel()

    def means(self, weight, image):
        """Return means (n,) of an image over nodes' pixels, and weights."""
        total, seen = (self._per_node(part) for part in (weight * image,
                                                         weight))
        return np.divide(total, seen, where=seen > 0,
                         out=np.zeros(seen.size)), seen

    def _per_node(self, image):
        """Return sums (n,) over the pixels of each node."""
        for axis, owner in enumerate(self._owner):
            n = self.shape[axis]
            first = np.searchsorted(owner, np.arange(n))
            empty = first == np.searchsorted(owner, np.arange(n), 'right')
            image = np.add.reduceat(image, np.minimum(
                first, owner.size - 1), axis=axis)
            image[(empty, slice(None))[::1 - 2 * axis]] = 0
        return image.ravel()

    def faint_level(self, data, good, noise):
        """Return a level (n,) from the faint good pixels of each node."""
        # Where stars leave no sky, the faintest pixels are nearest to it: of
        # noise alone one in a hundred is 2.3 standard deviations below.
        faintest, faint = self._percentiles(data, good, [1, 20])
        level = np.minimum(faint, faintest + 2.3 * noise)
        known = np.isfinite(level)
        return np.where(known, level, np.median(level[known]))

    def start(self, data, good, noise):
        """Return levels (n,) from which a fit of the sky can start."""
        # Where the sky slopes, faint pixels are those down the slope: with or
        # without a plane, all that follows is to be the same.
        a, b, c = _plane(data, good)
        level = (a + b * self.x + c * self.y[:, None]).ravel()
        for _ in range(_START_ROUNDS):
            level += self.faint_level(data - self.image(level), good, noise)
        return level

    def limits(self, data, good, noise):
        """Return two levels (n,) between which the sky has to be."""
        # Where stars hide all of it nothing else tells.
        low, middle = self._percentiles(data, good, [1, 50])
        low, high = (2 * low - middle - 3 * noise,
                     2 * middle - low + 3 * noise)
        return (np.where(np.isfinite(low), low, -np.inf),
                np.where(np.isfinite(high), high, np.inf))

    def medians(self, data, good):
        """Return the medians (n,) of nodes' good pixels, infinite if none."""
        middle, = self._percentiles(data, good, [50])
        return np.where(np.isfinite(middle), middle, np.inf)

    def _percentiles(self, data, good, which):
        """Return percentiles (m, n) of each node's good pixels, or NaN."""
        # The pixels of each node in a row, and what is not there last.
        place = [np.arange(owner.size) - np.searchsorted(owner, owner)
                 for owner in self._owner]
        pixels = np.full((self.shape[0], place[0].max() + 1,
                          self.shape[1], place[1].max() + 1), np.nan)
        pixels[self._owner[0][:, None], place[0][:, None], self._owner[1],
               place[1]] = np.where(good, data, np.nan)
        pixels = np.sort(pixels.transpose(0, 2, 1, 3).reshape(self.size, -1))
        last = np.count_nonzero(~np.isnan(pixels), axis=1) - 1
        rank = np.array(which)[:, None] / 100 * np.maximum(last, 0)
        low = rank.astype(int)
        high = np.minimum(low + 1, np.maximum(last, 0))
        node = np.arange(self.size)
        before, after = pixels[node, low], pixels[node, high]
        return before + (after - before) * (rank - low)

    def shares(self, x, y):
        """Return the four nodes around positions and their shares (n, 4)."""
        n = self.x.size
        column, fx = _between(x, self.x)
        row, fy = _between(y, self.y)
        node = (row * n + column)[:, None] + np.array([0, 1, n, n + 1])
        share = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy,
                          fx * fy], axis=1)
        return node, share

    def at(self, x, y, level):
        """Return the background (n,) of levels at positions."""
        node, share = self.shares(x, y)
        return (level[node] * share).sum(axis=1)

    def owners(self, x, y):
        """Return the node that has the pixel at each position (n,)."""
        row, column = (
            owner[np.clip(np.rint(p).astype(int), 0, owner.size - 1)]
            for p, owner in zip((y, x), self._owner, strict=True))
        return row * self.x.size + column


def _plane(data, good):
    """Return what a plane through most good pixels is at 0, and slopes."""
    # The answer to another plane added to the data is that plane added.
    step = tuple(slice(None, None, max(n // _PLANE_PIXELS, 1))
                 for n in data.shape)
    y, x = np.nonzero(good[step])
    if not x.size:
        return np.zeros(3)
    values = data[step][y, x]
    terms = np.stack([np.ones(x.size), x * step[1].step, y * step[0].step])
    used = np.ones(x.size)
    for _ in range(_PLANE_ROUNDS):
        weighted = used * terms
        plane = np.linalg.lstsq(weighted @ terms.T, weighted @ values,
                                rcond=None)[0]
        far = np.abs(values - plane @ terms)
        used = (far <= _PLANE_CLIP * np.median(far)).astype(float)
    return plane


def _lattice(first, size, spacing):
    """Return the multiples of spacing that are nearest to a pixel."""
    low = np.floor(first / spacing + 0.5)
    high = max(np.floor((first + size - 1) / spacing + 0.5), low + 1)
    return np.arange(low, high + 1) * float(spacing)


def _nodes(multiples, n):
    """Return nodes, and the one that each of n pixels is nearest to."""
    owner = np.searchsorted((multiples[1:] + multiples[:-1]) / 2,
                            np.arange(float(n)), side='right')
    count = np.bincount(owner, minlength=multiples.size)
    total = np.bincount(owner, np.arange(n), minlength=multiples.size)
    # One without pixels stays where it is.
    return np.divide(total, count, where=count > 0,
                     out=multiples.copy()), owner


def _between(positions, nodes):
    """Return the node before each position, and how far it is to the next."""
    i = np.clip(np.searchsorted(nodes, positions, side='right') - 1, 0,
                nodes.size - 2)
    return i, (positions - nodes[i]) / (nodes[i + 1] - nodes[i])
