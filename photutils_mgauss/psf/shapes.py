r"""
Size and ellipticity by adaptive moments (Nie et al., Sec. 3.1, Eqs. 5-8).

The weight of Eq. 7 is the elliptical Gaussian of covariance M that matches
the light it weighs (Hirata & Seljak 2003; Bernstein & Jarvis 2002): its
centre is the weighted centroid, and the weighted covariance is M / 2. The
sizes given here are those of M, as in GalSim, so :math:`R^2` is twice that of
Eq. 7 as printed; the ratios of Eqs. 6 and 8 do not notice.
"""
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm

from photutils_mgauss import kernels
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.image import check_errors, read_stack, with_unit
from photutils_mgauss.utils.parallel import map_chunks
from photutils_mgauss.utils.validation import as_floats, as_shape

__all__ = ['ShapeStatus', 'Shapes', 'adaptive_moments']

_TOLERANCE = 1e-7
_MAX_STEPS = 500


class ShapeStatus(IntEnum):
    """
    How adaptive moments ended; ``sentence`` says it in words.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import ShapeStatus, adaptive_moments
    >>> shapes = adaptive_moments(np.zeros((9, 9)))
    >>> ShapeStatus(shapes.status).name
    'EMPTY'
    >>> ShapeStatus.EMPTY.sentence
    'There is no positive flux under the weight.'
    """

    CONVERGED = 0
    STOPPED = 1
    EMPTY = 2
    DIVERGED = 3
    NOT_FINITE = 4

    @property
    def sentence(self):
        """The status in words."""
        return _SENTENCES[self]


_SENTENCES = {
    ShapeStatus.CONVERGED: 'The moments converged.',
    ShapeStatus.STOPPED: 'The moments still changed at the last step.',
    ShapeStatus.EMPTY: 'There is no positive flux under the weight.',
    ShapeStatus.DIVERGED:
        'No Gaussian matches: the weight shrank to nothing or outgrew the '
        'image.',
    ShapeStatus.NOT_FINITE:
        'Pixels that are not masked are NaN or infinite; mask them.',
}


@dataclass(frozen=True, eq=False)
class Shapes(ComparedByValue):
    """
    Adaptive moments of one image or mixture, or of n.

    Numbers for one, arrays (n,) for several; NaN where ``status`` is not
    0.

    Attributes
    ----------
    r2 : float or (n,) `~numpy.ndarray`
        :math:`R^2 = M_{xx} + M_{yy}` [pix^2], the size of the matching
        Gaussian (Eq. 5).
    e1, e2 : float or (n,) `~numpy.ndarray`
        :math:`(M_{xx} - M_{yy}) / R^2` and :math:`2 M_{xy} / R^2` (Eq. 6).
    x, y : float or (n,) `~numpy.ndarray`
        The centre of the matching Gaussian relative to the origin [pix].
    flux : float or (n,) `~numpy.ndarray`
        The flux of the matching Gaussian, in the unit of the image if it has
        one.
    r2_err, e1_err, e2_err, x_err, y_err : float or (n,) `~numpy.ndarray`
        Standard errors; NaN where no errors of pixels were given.
    status : int or (n,) `~numpy.ndarray`
        Values of `ShapeStatus`.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, adaptive_moments
    >>> psf = GaussianMixture([1], [[0.2, 0]], [[[3, 0.5], [0.5, 2]]])
    >>> shapes = adaptive_moments([psf, psf.affine([[2, 0], [0, 2]])])
    >>> shapes.r2
    array([ 5., 20.])
    >>> shapes.ellipticity
    array([0.28284271, 0.28284271])
    >>> shapes.message[0]
    'The moments converged.'
    """

    r2: np.ndarray
    e1: np.ndarray
    e2: np.ndarray
    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    r2_err: np.ndarray
    e1_err: np.ndarray
    e2_err: np.ndarray
    x_err: np.ndarray
    y_err: np.ndarray
    status: np.ndarray

    @property
    def ellipticity(self):
        """The total ellipticity, the root of e1^2 + e2^2 (Eq. 6)."""
        return (self.e1**2 + self.e2**2) ** 0.5

    @property
    def fwhm(self):
        """The full width at half maximum of the matching Gaussian [pix]."""
        return gaussian_sigma_to_fwhm * (self.r2 / 2) ** 0.5

    @property
    def message(self):
        """The status in words, or a list of them."""
        words = [ShapeStatus(int(s)).sentence for s in np.ravel(self.status)]
        return words if np.ndim(self.status) else words[0]

    def relative_size_error(self, model):
        r"""
        Return :math:`\delta(R^2)/R^2` of a model, these being the truth.

        .. math::

            \frac{\delta R^2}{R^2} = \frac{R^2 - R'^2}{R^2}

        Parameters
        ----------
        model : Shapes
            The R' of Eq. 8.

        Returns
        -------
        float or `~numpy.ndarray`

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture, adaptive_moments
        >>> truth = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
        >>> model = GaussianMixture([1], [[0, 0]], [[[1.1, 0], [0, 1.1]]])
        >>> adaptive_moments(truth).relative_size_error(
        ...     adaptive_moments(model))
        -0.1
        """
        return (self.r2 - model.r2) / self.r2

    def ellipticity_error(self, model):
        r"""
        Return :math:`\delta\epsilon = \epsilon - \epsilon'` of a model.

        Parameters
        ----------
        model : Shapes
            The one with :math:`\epsilon'` of Eq. 8.

        Returns
        -------
        float or `~numpy.ndarray`

        Examples
        --------
        >>> from photutils_mgauss import GaussianMixture, adaptive_moments
        >>> truth = GaussianMixture([1], [[0, 0]], [[[1.2, 0], [0, 0.8]]])
        >>> model = GaussianMixture([1], [[0, 0]], [[[1.1, 0], [0, 0.9]]])
        >>> adaptive_moments(truth).ellipticity_error(adaptive_moments(model))
        0.1
        """
        return self.ellipticity - model.ellipticity


def adaptive_moments(image, *, oversampling=1, origin=None, error=None,
                     mask=None, executor=None):
    r"""
    Measure size and ellipticity of images or mixtures.

    The weight :math:`W = \exp(-\mathbf r^T M^{-1} \mathbf r / 2)` is adapted
    until

    .. math::

        \frac{\sum I W\, \mathbf r}{\sum I W} = 0, \qquad
        \frac{\sum I W\, \mathbf r \mathbf r^T}{\sum I W} = \frac{M}{2} .

    For a mixture the sums are integrals in closed form, without pixels.

    Parameters
    ----------
    image : array_like or NDData, GaussianMixture, or sequence
        One image (ny, nx) or a stack (n, ny, nx); one mixture or several,
        which may differ in their number of Gaussians. The own mask of an
        image counts, its unit comes back: see :ref:`pixels`.
    oversampling : int or (y, x) tuple of int, optional
        Image pixels per native pixel.
    origin : (x, y) array_like, optional
        The image pixel that positions are relative to; None is the middle.
    error : float or array_like, optional
        The standard deviation of the pixels in the unit of ``image``,
        broadcast to it; positive where pixels are not masked. It gives the
        errors of the result and does not change the result.
    mask : array_like of bool, optional
        True for pixels to leave out, broadcast to the image. They are filled
        with the matching Gaussian at each step. Masks of ``image`` and
        ``error`` count, too.
    executor : `~concurrent.futures.Executor`, optional
        Where to measure a stack. None is a pool of threads on all cores.

    Returns
    -------
    Shapes
        In native pixels.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid. An image without a matching Gaussian is
        not an error but a status.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, adaptive_moments
    >>> psf = GaussianMixture([1], [[0.2, 0]], [[[3, 0.5], [0.5, 2]]])
    >>> shapes = adaptive_moments(psf)
    >>> shapes.r2, shapes.e1, shapes.e2
    (5.0, 0.2, 0.2)
    >>> adaptive_moments(psf.render((31, 31), 15, 15)).x
    0.2
    """
    mixtures = _as_mixtures(image)
    if mixtures is not None:
        single = isinstance(image, GaussianMixture)
        rows = _measure_mixtures(mixtures)
        return _shapes(rows, single, np.ones(2), np.zeros(2))
    pixels, single = read_stack(image, error, mask)
    images = pixels.data
    rows = map_chunks(partial(_measure_images, pixels.error is not None),
                      (images, *_used_and_error(pixels)), executor)
    shape = as_shape(oversampling, 'oversampling')
    pitch = np.array(shape[::-1], float)
    if origin is None:
        origin = (np.array(images.shape[:0:-1]) - 1) / 2
    else:
        origin = as_floats(origin, 'origin', shape=(2,))
    shapes = _shapes(np.array(rows), single, pitch, origin)
    return replace(shapes, flux=with_unit(shapes.flux, pixels.unit))


def _as_mixtures(value):
    """Return a list of mixtures, or None if the value is not of them."""
    if isinstance(value, GaussianMixture):
        return [value]
    if isinstance(value, np.ndarray) and value.dtype != object:
        return None
    try:
        items = list(value)
    except TypeError:
        return None
    if items and all(isinstance(item, GaussianMixture) for item in items):
        return items
    return None


def _used_and_error(pixels):
    """Return which pixels are used and their errors, both (n, ny, nx)."""
    used = (np.ones(pixels.shape, bool) if pixels.mask is None
            else ~pixels.mask)
    if pixels.error is None:
        return used, np.broadcast_to(np.nan, pixels.shape)
    check_errors(pixels.error, used)
    return used, pixels.error


def _measure_images(has_error, images, used, error):
    """Return one row for each image, see `_rows`."""
    states = np.array([_first_guess(*pair)
                       for pair in zip(images, used, strict=True)])
    finite = np.where(used, np.isfinite(images), True).all(axis=(1, 2))
    pixels = np.where(used, images, 0.0)
    sums, status = np.empty((len(images), 6)), np.empty(len(images), np.int64)
    largest = float(4 * (images.shape[1]**2 + images.shape[2]**2))
    kernels.adapt_to_images(pixels, used, states, _TOLERANCE, _MAX_STEPS,
                            largest, sums, status)
    status[~finite] = ShapeStatus.NOT_FINITE
    noise = np.full((len(images), 5), np.nan)
    for i in np.flatnonzero((status == 0) & has_error):
        noise[i] = _noise(states[i], sums[i, 0], used[i], error[i])
    return list(np.column_stack([states, sums[:, 0], noise, status]))


def _first_guess(image, used):
    """Return a round state at the brightest pixel, wider than its core."""
    pixels = np.where(used & np.isfinite(image), image, 0.0)
    j, i = np.unravel_index(pixels.argmax(), pixels.shape)
    above = max(np.count_nonzero(pixels > 0.5 * pixels[j, i]), 1)
    # Too wide is safe; too narrow a weight sees one pixel and no width.
    variance = max(1.0, 1.5 * above / np.pi / (2 * np.log(2)))
    return np.array([i, j, variance, 0, variance])


def _noise(state, flux, used, error):
    r"""
    Return the standard errors of x, y, R^2, e1 and e2.

    To first order the centre moves by twice, and M by four times, what noise
    adds to the weighted centroid and covariance (exact for a Gaussian).
    """
    x, y, xx, xy, yy = state
    m = np.array([[xx, xy], [xy, yy]])
    j, i = np.indices(used.shape)
    u, v = i - x, j - y
    p = np.linalg.inv(m)
    weight = np.exp(-0.5 * (p[0, 0] * u**2 + 2 * p[0, 1] * u * v
                            + p[1, 1] * v**2))
    r2 = xx + yy
    e1, e2 = (xx - yy) / r2, 2 * xy / r2
    dxx, dxy, dyy = (4 * (u * u - xx / 2), 4 * (u * v - xy / 2),
                     4 * (v * v - yy / 2))
    size = dxx + dyy
    moves = [2 * u, 2 * v, size, (dxx - dyy - e1 * size) / r2,
             (2 * dxy - e2 * size) / r2]
    noise = np.square(np.where(used, error, 0.0)) * (weight / flux) ** 2
    return [np.sqrt((noise * move**2).sum()) for move in moves]


def _measure_mixtures(mixtures):
    """Return rows (n, 12) as for images, a pixel being 1."""
    rows = np.empty((len(mixtures), 12))
    for row, mixture in zip(rows, mixtures, strict=True):
        moments = mixture.moments()
        c = mixture.covariances
        table = np.column_stack([mixture.weights, mixture.means, c[:, 0, 0],
                                 c[:, 0, 1], c[:, 1, 1]])
        size = np.abs(mixture.weights)
        spread = size @ table[:, 3:] / size.sum()
        state = np.array([[*moments.mean, *spread]])
        sums, status = np.empty((1, 6)), np.empty(1, np.int64)
        kernels.adapt_to_mixtures(table[None], state, _TOLERANCE, _MAX_STEPS,
                                  np.inf, sums, status)
        row[:] = np.concatenate([state[0], sums[0, :1], [np.nan] * 5, status])
    return rows


def _shapes(rows, single, pitch, origin):
    """Turn rows of state, sum, errors and status into Shapes."""
    if single:
        rows = rows[0]
    *rest, status = rows.T
    pitch_x, pitch_y = pitch
    x, y, xx, xy, yy, total, *errors = np.where(status == 0, rest, np.nan)
    xx, xy, yy = xx / pitch_x**2, xy / (pitch_x * pitch_y), yy / pitch_y**2
    r2 = xx + yy
    x_err, y_err, r2_err, e1_err, e2_err = errors
    columns = [r2, (xx - yy) / r2, 2 * xy / r2, (x - origin[0]) / pitch_x,
               (y - origin[1]) / pitch_y, 2 * total / (pitch_x * pitch_y),
               r2_err / pitch_x / pitch_y, e1_err, e2_err,
               x_err / pitch_x, y_err / pitch_y, status.astype(int)]
    return Shapes(*(column.item() if single else column
                    for column in columns))
