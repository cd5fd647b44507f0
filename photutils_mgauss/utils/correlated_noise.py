r"""
The correlation of the noise of neighbouring pixels, from blank sky.

Resampling an image (drizzling, reprojecting, shifting by parts of a pixel)
spreads the noise of each pixel over its neighbours. Pulls d of blank pixels,
data over errors, then have products :math:`\langle d_i d_{i + \Delta}
\rangle` other than zero at short distances. Faint light and an uneven sky have
them as well, but as large at long ones: the mean of those at the longest is
subtracted from all.
"""
from dataclasses import dataclass

import numpy as np
from astropy.stats import mad_std
from scipy.ndimage import (
    binary_dilation,
    maximum_filter,
    minimum_filter,
    uniform_filter,
)

# The largest distance along an axis [pix].
_REACH = 5
# Squares that are looked at: their number and their side [pix]; few at first,
# and more if noise seems to be correlated there.
_FIRST, _ALL = (6, 64), (12, 96)
# With fewer pairs of pixels nothing is said.
_FEWEST_PAIRS = 2000
# Means over squares of these sides [pix] beyond this many standard deviations,
# and pixels around them, are light that nobody has listed.
_SIDES, _LIGHT = (1, 3, 7), 3.5
# A correlation counts if it is beyond so many of its standard errors, and the
# mean one of the nearest pixels is so large. Resampling makes 0.3 and more;
# what is below 0.1, light that nobody has listed may have made.
_SIGNIFICANT, _LEAST = 5.0, 0.1


@dataclass(frozen=True, eq=False)
class NoiseCorrelation:
    """
    The correlation of the noise of pixels.

    Attributes
    ----------
    matrix : (2 m + 1, 2 m + 1) `~numpy.ndarray`
        The correlation of two pixels at each distance (y, x), 1 in the
        middle. Where blank sky scatters less than its errors say, all but
        the middle is smaller by the square of that.
    scatter : float
        The scatter of blank sky in units of its errors.
    """

    matrix: np.ndarray
    scatter: float

    @property
    def nearest(self):
        """The correlations with the next pixel along x and y."""
        return tuple(float(self.matrix[_REACH + dy, _REACH + dx])
                     for dy, dx in ((0, 1), (1, 0)))

    def growth(self, width):
        """
        Return by how much the variance of a star's position grows.

        Parameters
        ----------
        width : float
            The standard deviation of the PSF [pix].

        Returns
        -------
        float
            For a Gaussian among pixels of one error, the sum of the
            correlations times the overlap of the star's derivative with
            itself at each distance.
        """
        square = _squared_distances(width)
        return self._sum((1 - square) * np.exp(-square))

    def flux_growth(self, width):
        """Return by how much the variance of a star's flux grows."""
        return self._sum(np.exp(-_squared_distances(width)))

    def _sum(self, overlap):
        return max(1.0, float((self.matrix * overlap).sum()))

    def __str__(self):
        along_x, along_y = self.nearest
        return ('The noise of neighbouring pixels is correlated, as in '
                f'resampled images: by {along_x:.2f} along x and '
                f'{along_y:.2f} along y, where there is little light.')


def _squared_distances(width):
    """Return those of the matrix in units of twice a width."""
    steps = np.arange(-_REACH, _REACH + 1)
    return (steps**2 + steps[:, None]**2) / (4 * width**2)


def noise_correlation(data, error, mask, x, y, margin):
    """
    Measure the correlation of the noise on blank sky.

    Parameters
    ----------
    data, error : (ny, nx) `~numpy.ndarray`
        Without errors, an empty array, nothing is found.
    mask : (ny, nx) `~numpy.ndarray` of bool
        True for pixels to leave out; may be empty.
    x, y : (n,) `~numpy.ndarray`
        Known stars.
    margin : float
        How far around them pixels are not blank [pix].

    Returns
    -------
    NoiseCorrelation or None
        None if there is none that is significant.
    """
    if not error.size:
        return None
    image = data, error, mask
    finite = np.isfinite(x) & np.isfinite(y)
    x, y = x[finite], y[finite]
    stars = x, y, margin
    if _in_squares(image, stars, *_FIRST) is None:
        return None
    return _in_squares(image, stars, *_ALL)


def _in_squares(image, stars, number, side):
    """Return the correlation in some squares, or None."""
    sums = no_pairs()
    for window in _squares(image[0].shape, number, side):
        sums += _pairs(*_blank(image, *window, *stars))
    return correlation_of(sums)


def no_pairs():
    """Return the sums (2, 2 m + 1, 2 m + 1) of no pixels."""
    return np.zeros((2, 2 * _REACH + 1, 2 * _REACH + 1))


def residual_pairs(pulls, blank):
    """
    Sum the products of pairs of pixels of a residual.

    Parameters
    ----------
    pulls : (ny, nx) `~numpy.ndarray`
        The residual over its errors.
    blank : (ny, nx) `~numpy.ndarray` of bool
        Where it may be taken for noise.

    Returns
    -------
    (2, 2 m + 1, 2 m + 1) `~numpy.ndarray`
        The sums of products at each distance (y, x), and how many there are:
        sums of several images can be added.
    """
    return sum((_pairs(pulls[window], blank[window])
                for window in _squares(pulls.shape, *_ALL)), no_pairs())


def correlation_of(sums):
    """Return the `NoiseCorrelation` of sums of pairs if it is significant."""
    products, pairs = sums
    if pairs.min() < _FEWEST_PAIRS:
        return None
    matrix = np.divide(products, pairs, where=pairs > 0,
                       out=np.zeros_like(products))
    ring = np.ones(matrix.shape, bool)
    ring[1:-1, 1:-1] = False
    matrix -= matrix[ring].mean()
    variance = matrix[_REACH, _REACH]
    if variance <= 0:
        return None
    matrix /= variance
    # Blank sky that scatters less than its errors has them from the time
    # before the image was resampled, and errors are right already.
    matrix *= min(variance, 1)
    matrix[_REACH, _REACH] = 1
    # Pairs are correlated with each other, if pixels are.
    deviation = np.sqrt((matrix**2).sum() / pairs)
    # What scatters more than the errors say may be light that is not listed.
    near = np.mean([matrix[_REACH, _REACH + 1], matrix[_REACH + 1, _REACH]])
    near -= max(1 - 1 / variance, 0)
    if near < max(_LEAST, _SIGNIFICANT * deviation[_REACH, _REACH]):
        return None
    matrix[np.abs(matrix) < _SIGNIFICANT * deviation] = 0
    return NoiseCorrelation(matrix, float(np.sqrt(variance)))


def _squares(shape, number, side):
    """Return slices of squares spread evenly over an image."""
    columns = max(1, round(np.sqrt(number * shape[1] / shape[0])))
    counts = (max(1, round(number / columns)), columns)
    starts = [np.unique(np.linspace(0, max(size - side, 0), min(
        count, -(-size // side))).astype(int))
        for size, count in zip(shape, counts, strict=True)]
    return [(slice(row, row + side), slice(column, column + side))
            for row in starts[0] for column in starts[1]]


def _blank(image, rows, columns, x, y, margin):
    """Return data over errors, and where no known star is."""
    data, error = (array[rows, columns] for array in image[:2])
    with np.errstate(invalid='ignore', divide='ignore'):
        pulls = data / error
    usable = np.isfinite(pulls) & (error > 0)
    if image[2].size:
        usable &= ~image[2][rows, columns]
    # Padding: a value repeated all around is no noise.
    usable &= (maximum_filter(data, 3) != minimum_filter(data, 3))
    height, width = data.shape
    near = ((x > columns.start - margin)
            & (x < columns.start + width + margin)
            & (y > rows.start - margin) & (y < rows.start + height + margin))
    for x_0, y_0 in zip(x[near] - columns.start, y[near] - rows.start,
                        strict=True):
        box = tuple(slice(max(int(np.ceil(at - margin)), 0),
                          max(int(at + margin) + 1, 0)) for at in (y_0, x_0))
        usable[box] = False
    return pulls, usable


def _pairs(pulls, usable):
    """Return the sums of pairs of pixels without light."""
    return _products(_noise_alone(pulls, usable))


def _noise_alone(pulls, usable):
    """Return pulls less their mean, NaN where there is light."""
    pulls = np.where(usable, pulls, 0)
    pulls -= np.median(pulls[usable]) if usable.any() else 0
    for side in _SIDES:
        if not usable.any():
            break
        mean = uniform_filter(pulls, side)
        light = usable & (np.abs(mean) > _LIGHT * mad_std(mean[usable]))
        usable = usable & ~binary_dilation(light, iterations=2 + side // 2)
    pulls[~usable] = np.nan
    return pulls - np.mean(pulls[usable]) if usable.any() else pulls


def _products(pulls):
    """Return the products of all pairs of pixels, and how many there are."""
    products, pairs = sums = no_pairs()
    good = np.isfinite(pulls)
    # Rows one after another, with zeros between them: pixels at the same
    # distance are the same number of steps apart.
    between = ((0, 0), (0, _REACH))
    values = np.pad(np.where(good, pulls, 0), between).ravel()
    good = np.pad(good.astype(float), between).ravel()
    step = pulls.shape[1] + _REACH
    for dy in range(_REACH + 1):
        for dx in range(-_REACH if dy else 0, _REACH + 1):
            apart = min(dy * step + dx, values.size)
            for array, total in ((values, products), (good, pairs)):
                found = np.dot(array[:array.size - apart], array[apart:])
                total[_REACH + dy, _REACH + dx] = found
                total[_REACH - dy, _REACH - dx] = found
    return sums
