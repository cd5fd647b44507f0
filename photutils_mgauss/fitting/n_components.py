"""How many Gaussians an image needs (Nie et al., Appendix B)."""
import time

import numpy as np
from astropy.table import QTable

from photutils_mgauss.fitting.image import fit_mixture, fit_with_unit
from photutils_mgauss.fitting.phases import phase_error, phase_rows
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.image import read_pixels
from photutils_mgauss.utils.parallel import told
from photutils_mgauss.utils.validation import as_integer, as_real, as_shape
from photutils_mgauss.utils.waiting import waiting

__all__ = ['compare_n_components', 'select_n_components']

_CRITERIA = ('r2_error', 'ellipticity_error', 'rms_residual', 'max_residual',
             'phase_error')


def compare_n_components(image, n_components=(1, 2, 3, 4, 5), **kwargs):
    """
    Fit an image with several numbers of Gaussians and compare the fits.

    Parameters
    ----------
    image : (ny, nx) array_like or NDData
        See `fit_mixture`.
    n_components : sequence of int, optional
        The numbers K to try.
    **kwargs
        The keywords of `fit_mixture`.

    Returns
    -------
    `~astropy.table.QTable`
        One row for each K: ``n_components``, ``time`` [s], ``chi2``,
        ``bic``, ``r2_error`` and ``ellipticity_error`` (Eq. 8 of model
        against image, by adaptive moments), ``rms_residual`` and
        ``max_residual`` as fractions of the image's peak, ``phase_error``
        [native pix], the root mean square pixel-phase error of a bright star
        fitted in 5 x 5 pixels (NaN unless the oversampling is 2 or more), and
        ``message``. The fits themselves are the list ``meta['fits']``.

    Raises
    ------
    TypeError, ValueError
        As by `fit_mixture`; also for a stack of images.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, compare_n_components
    >>> truth = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
    ...                         [[[1, 0.1], [0.1, 1]], [[4, 0], [0, 5]]])
    >>> table = compare_n_components(truth.render(21, 10, 10), (1, 2))
    >>> table['max_residual'].round(3)
    array([0.022, 0.   ])
    """
    pixels = read_pixels(image, kwargs.pop('error', None),
                         kwargs.pop('mask', None), name='image',
                         broadcast=True)
    image = pixels.data
    kwargs |= {'error': pixels.error, 'mask': pixels.mask}
    numbers = _as_numbers(n_components)
    fits, rows = [], []
    with waiting('compare_n_components'):
        fit_mixture(image, 1, **kwargs)  # compiled before the clock starts
        for k in told(numbers):
            start = time.perf_counter()
            fits.append(fit_mixture(image, k, **kwargs))
            seconds = time.perf_counter() - start
            rows.append((k, seconds, *_measure(image, fits[-1], kwargs),
                         fits[-1].message))
    return QTable(rows=rows, names=('n_components', 'time', 'chi2', 'bic',
                                    *_CRITERIA, 'message'),
                  meta={'fits': [fit_with_unit(fit, pixels.unit)
                                 for fit in fits]})


def _as_numbers(n_components):
    numbers = [as_integer(k, 'n_components', minimum=1)
               for k in np.atleast_1d(np.asarray(n_components, object))]
    if not numbers:
        msg = 'n_components must name at least one number, got none'
        raise ValueError(msg)
    return numbers


def _measure(image, fit, options):
    """Return the numbers of one row, from chi2 to phase_error."""
    image = np.where(fit.used, np.asarray(image, float), 0.0)
    left = fit.residual[fit.used]
    truth, model = (adaptive_moments(picture, mask=~fit.used) for picture in
                    (image, image - np.where(fit.used, fit.residual, 0)))
    peak = image.max()
    return (fit.chi2, fit.bic, truth.relative_size_error(model),
            truth.ellipticity_error(model), left.std() / peak,
            np.abs(left).max() / peak, _phase_error(fit, options))


def _phase_error(fit, options):
    oversampling = as_shape(options.get('oversampling', 1), 'oversampling')
    if min(oversampling) < 2:
        return np.nan
    origin = options.get('origin')
    if origin is None:
        origin = (np.array(fit.used.shape[::-1]) - 1) / 2
    rows = phase_rows(fit.mixture, fit.flux, fit.used.shape,
                      np.array(oversampling[::-1], float),
                      np.asarray(origin, float), fit.used, sizes=(5,))
    return float(phase_error(rows, fit.residual)[0])


def select_n_components(image, n_components=(1, 2, 3, 4, 5), *,
                        r2_error=None, ellipticity_error=None,
                        rms_residual=None, max_residual=None,
                        phase_error=None, **kwargs):
    """
    Return the number of Gaussians that an image needs.

    This is the smallest number that meets the given thresholds; without
    thresholds, the number with the smallest Bayesian information
    criterion.

    Parameters
    ----------
    image : (ny, nx) array_like or NDData
        See `fit_mixture`.
    n_components : sequence of int, optional
        The numbers K to try.
    r2_error, ellipticity_error, rms_residual, max_residual, phase_error : \
float, optional
        Upper limits of the absolute values of these columns of
        `compare_n_components`.
    **kwargs
        The keywords of `fit_mixture`.

    Returns
    -------
    int
        The number K.

    Raises
    ------
    ValueError
        If none of the numbers meets all thresholds.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import GaussianMixture, select_n_components
    >>> truth = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
    ...                         [[[1, 0.1], [0.1, 1]], [[4, 0], [0, 5]]])
    >>> image = truth.render(21, 10, 10)
    >>> select_n_components(image, max_residual=0.01)
    2
    >>> noise = 1e-4 * np.random.default_rng(1).standard_normal(image.shape)
    >>> select_n_components(image + noise, error=1e-4)
    2
    """
    given = (r2_error, ellipticity_error, rms_residual, max_residual,
             phase_error)
    limits = {name: as_real(value, name, minimum=0)
              for name, value in zip(_CRITERIA, given, strict=True)
              if value is not None}
    if not limits:
        table = compare_n_components(image, n_components, **kwargs)
        return int(table['n_components'][np.argmin(table['bic'])])
    with waiting('select_n_components'):
        for k in told(sorted(_as_numbers(n_components))):
            row = compare_n_components(image, [k], **kwargs)[0]
            if all(abs(row[name]) <= limit for name, limit in limits.items()):
                return k
    found = ', '.join(f'{name} = {abs(row[name]):.3g}' for name in limits)
    msg = (f'n_components must reach further than {k} to meet the '
           f'thresholds; it gave {found}')
    raise ValueError(msg)
