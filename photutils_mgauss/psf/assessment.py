r"""
How good a PSF model is over the detector (Nie et al., Sec. 3, Eqs. 5-8).

Size and ellipticity are those of adaptive moments; the errors are

.. math::

    \frac{\delta R^2}{R^2} = \frac{R^2 - R'^2}{R^2}, \qquad
    \delta\epsilon = \epsilon - \epsilon' ,

the truth being unprimed and the model primed.
"""
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.equality import ComparedByValue
from photutils_mgauss.utils.validation import as_choice, as_shape
from photutils_mgauss.utils.waiting import waiting

__all__ = ['PSFAssessment', 'assess_psf']

# Images of pixel-integrated PSFs: samples per pixel, half the width [pix].
_FINE, _REACH = 4, 8


@dataclass(frozen=True, eq=False, repr=False)
class PSFAssessment(ComparedByValue):
    r"""
    Errors of a PSF model at places on a detector.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        ``x``, ``y`` [pix], ``r2`` of the truth [pix^2], ``size_error``
        (:math:`\delta R^2/R^2`), ``ellipticity_error``
        (:math:`\delta\epsilon`), and ``e1_error``, ``e2_error`` of the two
        components. NaN where a shape could not be measured.
    grid_shape : (int, int)
        The number of places along y and x.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, assess_psf
    >>> def truth(x, y):
    ...     return GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> def model(x, y):
    ...     return GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2 + x / 1e4]]])
    >>> report = assess_psf(model, truth, (2, 3), shape=(100, 101))
    >>> report.map('size_error').round(4)
    array([[ 0.    , -0.0012, -0.0025],
           [ 0.    , -0.0012, -0.0025]])
    >>> round(report.median('ellipticity_error'), 4)
    -0.0012
    """

    table: QTable
    grid_shape: tuple

    def __repr__(self):
        return (f'<PSFAssessment at {len(self.table)} places: size '
                f'{self.median("size_error"):+.4f} +- '
                f'{self.scatter("size_error"):.4f}, ellipticity '
                f'{self.median("ellipticity_error"):+.4f} +- '
                f'{self.scatter("ellipticity_error"):.4f}>')

    def _column(self, name):
        as_choice(name, 'name', self.table.colnames)
        return np.asarray(self.table[name])

    def map(self, name):
        """
        Return a column of the table as a map.

        Parameters
        ----------
        name : str
            The column.

        Returns
        -------
        (ny, nx) `~numpy.ndarray`

        Raises
        ------
        ValueError
            If the table has no such column.
        """
        return self._column(name).reshape(self.grid_shape)

    def median(self, name):
        """
        Return the median of a column.

        Parameters
        ----------
        name : str
            The column.

        Returns
        -------
        float
        """
        return float(np.nanmedian(self._column(name)))

    def scatter(self, name):
        """
        Return the standard deviation of a column.

        Parameters
        ----------
        name : str
            The column.

        Returns
        -------
        float
        """
        return float(np.nanstd(self._column(name)))


def assess_psf(model, truth, grid=(30, 30), *, shape=None, oversampling=1,
               mid_cell=False):
    """
    Compare the shapes of a PSF model with the truth over the detector.

    Parameters
    ----------
    model, truth : MixtureField, GriddedMixturePSF or callable
        Anything with a method ``mixture_at(x, y)``, or a function of x and y
        that returns a mixture or an image of the PSF, sampled ``oversampling``
        times a pixel with the star in its middle. All contain the pixel: a
        grid that is ``pixel_integrated`` is integrated.
    grid : (int, int), optional
        The number of places along y and x, from the first pixel to the last.
    shape : (int, int), optional
        The detector's shape (ny, nx). By default that of ``model`` or
        ``truth``, if they know it.
    oversampling : int, optional
        Of images.
    mid_cell : bool, optional
        Compare in the middle of the cells between those places instead, where
        a grid of that shape is a blend of four neighbours.

    Returns
    -------
    PSFAssessment

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, assess_psf
    >>> def truth(x, y):
    ...     return GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> def model(x, y):
    ...     return GaussianMixture([1], [[0, 0]], [[[2.02, 0], [0, 2.02]]])
    >>> assess_psf(model, truth, (3, 3), shape=(100, 100))
    <PSFAssessment at 9 places: size -0.0100 +- 0.0000, ellipticity
     +0.0000 +- 0.0000>
    """
    rows, columns = as_shape(grid, 'grid', minimum=2 if mid_cell else 1)
    x, y = _places(rows, columns, _detector(model, truth, shape), mid_cell)
    if mid_cell:
        rows, columns = rows - 1, columns - 1
    with waiting('assess_psf'):
        real, mine = (_moments(*_profiles(psf, name, oversampling), x, y)
                      for psf, name in ((truth, 'truth'), (model, 'model')))
    table = QTable({'x': x, 'y': y, 'r2': real.r2,
                    'size_error': real.relative_size_error(mine),
                    'ellipticity_error': real.ellipticity_error(mine),
                    'e1_error': real.e1 - mine.e1,
                    'e2_error': real.e2 - mine.e2})
    return PSFAssessment(table, (rows, columns))


def _places(rows, columns, shape, mid_cell):
    ny, nx = shape
    y, x = np.linspace(0, ny - 1, rows), np.linspace(0, nx - 1, columns)
    if mid_cell:
        y, x = (y[1:] + y[:-1]) / 2, (x[1:] + x[:-1]) / 2
    return (grid.ravel() for grid in np.meshgrid(x, y))


def _detector(model, truth, shape):
    if shape is not None:
        return as_shape(shape, 'shape')
    for psf in (model, truth):
        if hasattr(psf, 'grid_xypos'):
            return tuple(int(n) + 1 for n in psf.grid_xypos.max(axis=0)[::-1])
        if hasattr(psf, 'mixture_at') and hasattr(psf, 'shape'):
            return psf.shape
    msg = 'shape must be given if neither PSF knows its detector, got None'
    raise ValueError(msg)


def _profiles(psf, name, oversampling):
    """Return what makes a mixture or image of a position, its sampling."""
    if isinstance(psf, GaussianMixture):
        def profile(*_):
            return psf
    else:
        profile = getattr(psf, 'mixture_at', psf)
    if not callable(profile):
        msg = (f'{name} must have a method mixture_at or be callable, got '
               f'{psf!r:.80}')
        raise TypeError(msg)
    if getattr(psf, 'pixel_integrated', False):
        return _pixel_images(profile), _FINE
    return profile, oversampling


def _pixel_images(profile):
    """Return what makes an image, with the pixel in it, of a position."""
    steps = np.arange(-_REACH * _FINE, _REACH * _FINE + 1) / _FINE

    def image(x, y):
        return profile(x, y).evaluate(steps, steps[:, None],
                                      pixel_integrated=True)
    return image


def _moments(profile, oversampling, x, y):
    found = [profile(*place) for place in zip(x, y, strict=True)]
    if all(isinstance(one, GaussianMixture) for one in found):
        return adaptive_moments(found)
    return adaptive_moments(found, oversampling=oversampling)
