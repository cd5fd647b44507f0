"""Fits of many images that are kept in a folder once they are done."""
import numpy as np

from photutils_mgauss.fitting.image import FitStatus, MixtureFit, fit_mixture
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.checkpoint import digest_of

_MIXTURE = ('weights', 'means', 'covariances')
_NUMBERS = ('flux', 'chi2', 'bic', 'enclosed_flux')
_IMAGES = ('residual', 'covariance', 'used')


def fit_or_recall(checkpoint, images, mask, options, executor):
    """
    Return the fits of a stack of images, kept ones if there are any.

    Parameters
    ----------
    checkpoint : `~photutils_mgauss.utils.checkpoint.Checkpoint`
    images, mask : (n, ny, nx) `~numpy.ndarray`
    options : dict
        Further keywords of `fit_mixture`.
    executor : `~concurrent.futures.Executor` or None

    Returns
    -------
    list of MixtureFit
    """
    if not checkpoint:
        return fit_mixture(images, mask=mask, executor=executor, **options)
    key = digest_of(images, mask, options)
    kept = checkpoint.load(key)
    if kept is not None:
        return [_from_arrays(kept, i) for i in range(len(images))]
    fits = fit_mixture(images, mask=mask, executor=executor, **options)
    checkpoint.save(key, {name: array for i, fit in enumerate(fits)
                          for name, array in _to_arrays(fit, i).items()})
    return fits


def _to_arrays(fit, i):
    """Return a fit as named arrays."""
    arrays = {f'{i}/{name}': getattr(fit, name)
              for name in (*_NUMBERS, *_IMAGES)}
    arrays[f'{i}/message'] = np.array(fit.message)
    arrays[f'{i}/status'] = np.array(int(fit.status))
    if fit.mixture is not None:
        arrays |= {f'{i}/{name}': getattr(fit.mixture, name)
                   for name in _MIXTURE}
    return arrays


def _from_arrays(arrays, i):
    """Return what `_to_arrays` was given."""
    mixture = None
    if f'{i}/weights' in arrays:
        mixture = GaussianMixture(*(arrays[f'{i}/{name}']
                                    for name in _MIXTURE))
    numbers = {name: float(arrays[f'{i}/{name}']) for name in _NUMBERS}
    images = {name: arrays[f'{i}/{name}'] for name in _IMAGES}
    return MixtureFit(mixture=mixture,
                      status=FitStatus(int(arrays[f'{i}/status'])),
                      message=str(arrays[f'{i}/message']), **numbers,
                      **images)
