"""
Stars whose PSF depends on more than their place.

The compiled fits know one PSF at a place. What that of a star of another
colour, or flux, has beyond it is drawn with the numbers of the last fit and
taken off the image, and the stars are fitted again until nothing changes: the
residuals at the end are those of each star's own PSF.
"""
import numpy as np

from photutils_mgauss.psf.contexts import change_of_light
from photutils_mgauss.utils.star_columns import column_values

# Until positions [pix] and relative fluxes change by less, and how often.
_TOLERANCE, _MOST_STEPS = 1e-6, 10
# The faintest light that is drawn, over the noise of a pixel or, where that
# is not known, the brightest star.
_FAINTEST, _FAINTEST_SHARE = 1e-4, 1e-12


def keep_contexts(model, given, prepared):
    """Copy contexts of stars to the table that photutils made of theirs."""
    names = [one.name for one in model.contexts
             if given is not None and one.name in given.colnames]
    if not names:
        return
    ids = (np.asarray(given['id']) if 'id' in given.colnames
           else np.arange(1, len(given) + 1))
    rows = {name: row for row, name in enumerate(ids.tolist())}
    order = [rows[name] for name in np.asarray(prepared['id']).tolist()]
    for name in names:
        if name != 'flux':
            prepared[name] = given[name][order]


def context_columns(model, table):
    """
    Return the contexts of a model that a table has, and sentences on others.

    Returns
    -------
    columns : dict of str to (n,) `~numpy.ndarray`
        NaN where a value is unknown.
    missing : list of str
        For each context that stars do not have, how many.
    """
    columns, missing = {}, []
    for context in model.contexts:
        if context.name == 'flux':
            continue
        values = (column_values(table, context.name)
                  if context.name in table.colnames
                  else np.full(len(table), np.nan))
        unknown = np.count_nonzero(~np.isfinite(values))
        if unknown:
            missing.append(
                f'{unknown} of {len(values)} stars have no {context.name} in '
                f'init_params: they get the PSF of the mean star, whose '
                f'{context.name} is {context.usual:.4g}')
        columns[context.name] = values
    return columns, missing


def fit_with_contexts(fit, image, model, columns):
    """
    Fit stars, each with the PSF of its own contexts.

    Parameters
    ----------
    fit : callable
        ``fit(image)`` returns a FitResult, and something else.
    image : `~photutils_mgauss.kernels.Image`
    model : GriddedMixturePSF
    columns : dict of str to (n,) `~numpy.ndarray`
        The contexts other than the flux.

    Returns
    -------
    What ``fit`` does, and whether the last fit changed nothing.
    """
    found = fit(image)
    for _ in range(_MOST_STEPS):
        before = found[0].values
        flux, x, y = before.T
        light = change_of_light(
            model.contexts, columns | {'flux': flux}, np.array([x, y, flux]),
            _faintest(image, flux), image.data.shape)
        found = fit(image._replace(data=image.data - light))
        if _largest_change(before, found[0].values) < _TOLERANCE:
            return *found, True
    return *found, False


def _faintest(image, flux):
    positive = image.error[np.isfinite(image.error) & (image.error > 0)]
    if positive.size:
        return _FAINTEST * float(np.median(positive))
    brightest = np.max(np.abs(flux[np.isfinite(flux)]), initial=0.0)
    return max(_FAINTEST_SHARE * brightest, 1e-300)


def _largest_change(before, after):
    change = np.abs(after - before)
    change[:, 0] /= np.maximum(np.abs(after[:, 0]), 1e-300)
    return np.max(change[np.isfinite(change)], initial=0.0)
