"""Errors of fitted stars beyond those of independent pixels."""
from contextlib import nullcontext
from dataclasses import replace

import numpy as np

from photutils_mgauss.psf.star_errors import StarPixels, exact, known_errors
from photutils_mgauss.utils.parallel import Threads


def with_all_errors(result, image, model, *, psf_errors=True,
                    correlation=None, fit_sky=False, executor=None,
                    n_threads=None):
    """
    Return results with the errors of the PSF and of correlated noise.

    Parameters
    ----------
    result : FitResult
    image : `~photutils_mgauss.kernels.Image`
    model : GriddedMixturePSF or MultiGaussianPSFModel
    psf_errors : bool, optional
        Whether to add what the PSF may be off, where that is known.
    correlation : NoiseCorrelation, optional
    fit_sky, executor, n_threads : optional
        As of the fit.

    Returns
    -------
    result : FitResult
    psf : (n, 3, 3) `~numpy.ndarray` or None
        The part of the covariances that is due to the PSF.
    """
    errors = known_errors(model) if psf_errors else None
    if errors is None and correlation is None:
        return result, None
    rows = np.flatnonzero(np.isfinite(result.values).all(axis=1)
                          & result.has_covariance)
    pool = (nullcontext(executor) if n_threads is None
            or executor is not None else Threads(n_threads))
    shapes, which = np.unique(result.shapes[rows], axis=0,
                              return_inverse=True)
    psf, growth = np.empty((2, rows.size, 3, 3))
    with pool as executor:
        for k, shape in enumerate(shapes):
            some = which.ravel() == k
            pixels = StarPixels(
                image, exact(model) if errors is None else errors,
                result.values[rows[some]], shape, free=result.free,
                fit_sky=fit_sky, integrated=model.pixel_integrated)
            psf[some], growth[some] = pixels.covariances(
                executor, None if correlation is None
                else correlation.matrix)
    free = np.ix_(np.arange(rows.size), *[np.flatnonzero(result.free)] * 2)
    grown = growth[free] @ result.covariances[rows][free] @ growth[
        free].transpose(0, 2, 1)
    covariances = result.covariances.copy()
    where = (rows[:, None, None], *free[1:])
    if errors is None:
        covariances[where] = grown
        return replace(result, covariances=covariances), None
    part = np.full(covariances.shape, np.nan)
    part[rows] = psf
    covariances[where] = grown + psf[free]
    return replace(result, covariances=covariances), part
