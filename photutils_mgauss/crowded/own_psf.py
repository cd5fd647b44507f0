"""The PSF of a crowded image, from nothing but the image."""
import numpy as np

from photutils_mgauss.crowded.photometry import CrowdedMixturePhotometry
from photutils_mgauss.crowded.psf_loop import LoopOptions
from photutils_mgauss.crowded.psf_stars import Rules
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.saturation import as_saturation, without_saturated
from photutils_mgauss.utils.star_columns import read_sources
from photutils_mgauss.utils.validation import as_integer, as_real
from photutils_mgauss.utils.waiting import waiting

__all__ = ['fit_crowded_psf']


def fit_crowded_psf(data, *, error=None, mask=None, stars=None,
                    n_components=6, degree='auto', radius=None, max_stars=300,
                    min_snr=50, saturation=None, effective_gain=None,
                    background_size=64, max_passes=20, executor=None,
                    checkpoint=None, progress_bar=False):
    """
    Fit the PSF of a crowded image and its stars in turns.

    The first PSF is round and fitted to the least blended bright stars.
    With it the function finds all bright stars of the image. It subtracts
    all but the best of them, fits a better PSF to these, and finds fainter
    stars. In each pass the search goes deeper and the PSF may vary more
    over the image, until it no longer goes on changing in one direction.
    Light of the stars beyond ``radius`` is measured from all of them
    together; if it is significant, it is added as one wide Gaussian, as
    `fit_mixture_field` does.

    Of images larger than 1536 pixels, five windows of 320 pixels along each
    long axis are used; for PSFs wider than 3 pixels both are larger.

    Parameters
    ----------
    data : (ny, nx) array_like or NDData
        The image, with its background. Its own mask counts, its unit comes
        back: see :ref:`pixels`.
    error : float or (ny, nx) array_like, optional
        The standard deviation of each pixel in the unit of ``data``. By
        default it is estimated, one number for the image.
    mask : (ny, nx) array_like of bool, optional
        True for pixels to leave out, as those of saturated stars.
    stars : `~astropy.table.Table`, optional
        Positions ``x`` and ``y`` of the stars that may be used for the
        PSF; by default all stars. If there is a column ``selected``, only
        the selected stars count.
    n_components : int, optional
        The number K of Gaussians. A warning says if fewer than six miss at
        least 0.5 % more of the light in the pixels of bright stars than six.
    degree : int or 'auto', optional
        The degree of the polynomials of the last pass, 0 for a PSF that is
        the same everywhere. 'auto' is the highest degree with at least
        forty stars for each term, at most 4: 2 with 300 stars, 3 with 400.
        With fewer than 120 stars, too few for any slope by this rule, the
        last fit chooses as `fit_mixture_field` does: it shrinks slopes as
        far as the stars do not show them, and has the rest in its errors.
    radius : float, optional
        The radius of the circle of fitted pixels around each star [pix]; by
        default 15, and more in proportion for PSFs wider than 3 pixels.
    max_stars : int, optional
        The largest number of stars to use for the PSF, spread over the
        image.
    min_snr : float, optional
        The smallest ratio of a star's flux to its error.
    saturation : float, optional
        Pixels at or above this value are left out.
    effective_gain : float, optional
        As for `CrowdedMixturePhotometry`.
    background_size : float or None, optional
        As for `CrowdedMixturePhotometry`.
    max_passes : int, optional
        The largest number of passes. A warning says if the PSF still
        changes after them.
    executor : `~concurrent.futures.Executor`, optional
        The executor that searches for stars; by default a pool of threads.
    checkpoint : str or path-like, optional
        A folder for finished searches. A call with the same image and
        settings uses the searches in it.
    progress_bar : bool, optional
        Whether to show a bar of the passes, with the number of stars and
        the change of the PSF.

    Returns
    -------
    MixtureField
        Its ``stars`` are those used for the PSF; its ``dropped`` lists the
        other bright stars with their ``x``, ``y``, ``flux``, ``snr``,
        ``crowding`` and the ``reason``: 'edge'; 'masked', near bad pixels;
        'faint'; 'extended'; 'blended', more than half of the light in its
        pixels belongs to other stars; 'surplus', there are better stars
        nearby; 'deviant', different from the other stars. Its
        ``wing_share`` is the light beyond ``radius``. ``to_grid``
        converts the field to a PSF for `CrowdedMixturePhotometry`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not valid, or fewer than five stars are suitable
        for a PSF.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import (CrowdedMixturePhotometry,
    ...                               GaussianMixture, fit_crowded_psf)
    >>> psf = GaussianMixture([1], [[0, 0]], [[[1.0, 0.2], [0.2, 0.8]]])
    >>> rng = np.random.default_rng(1)
    >>> x, y = rng.uniform(0, 99, (2, 400))
    >>> flux = 1000 * rng.pareto(1, 400) + 300
    >>> light = sum(psf.render((100, 100), *star, flux=f)
    ...             for *star, f in zip(x, y, flux))
    >>> error = np.sqrt(light + 20)
    >>> data = rng.normal(light + 20, error)
    >>> field = fit_crowded_psf(data, error=error, n_components=1, radius=8)
    >>> field.mixture_at(50, 50).covariances[0].round(1)
    array([[1. , 0.2],
           [0.2, 0.8]])
    """
    image = read_pixels(data, error, mask).with_error()
    given = None
    if stars is not None:
        sources = read_sources(stars, unit=image.unit)
        given = np.column_stack([sources.x, sources.y])[sources.selected]
        given = given[np.isfinite(given).all(axis=1)]
    if saturation is not None:
        image = without_saturated(image, as_saturation(saturation))
    rules = Rules(
        radius=(Rules.radius if radius is None
                else as_real(radius, 'radius', minimum=5)),
        is_fixed=radius is not None,
        max_stars=as_integer(max_stars, 'max_stars', minimum=1),
        min_snr=as_real(min_snr, 'min_snr', above=0), given=given)
    if degree != 'auto':
        degree = as_integer(degree, 'degree', minimum=0)
    options = LoopOptions(
        rules, n_components=as_integer(n_components, 'n_components',
                                       minimum=1),
        degree=degree, max_passes=as_integer(max_passes, 'max_passes',
                                             minimum=1),
        progress_bar=bool(progress_bar))
    photometry = CrowdedMixturePhotometry(
        None, effective_gain=effective_gain, background_size=background_size,
        executor=executor, checkpoint=checkpoint)
    with waiting('fit_crowded_psf', progress_bar):
        return photometry.fit_field(image, options)[0]
