"""Several mixtures mixed into one."""
from collections.abc import Iterable

import numpy as np

from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.validation import as_floats, shown

__all__ = ['blend']


def blend(mixtures, fractions):
    """
    Blend M mixtures into one, as a grid does between its nodes (Sec. 3.3).

    Parameters
    ----------
    mixtures : sequence of M GaussianMixture
        The mixtures; their numbers of Gaussians may differ.
    fractions : (M,) array_like
        The share of each; they sum to 1.

    Returns
    -------
    GaussianMixture
        The image of the blend is the weighted sum of the images.

    Raises
    ------
    ValueError
        If the numbers of mixtures and fractions differ, or the fractions do
        not sum to 1.

    Examples
    --------
    >>> from photutils_mgauss import GaussianMixture, blend
    >>> narrow = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> wide = GaussianMixture([1], [[0, 0]], [[[4, 0], [0, 4]]])
    >>> blend([narrow, wide], [0.75, 0.25]).weights
    array([0.75, 0.25])
    """
    mixtures = as_list(mixtures)
    for mixture in mixtures:
        if not isinstance(mixture, GaussianMixture):
            msg = f'mixtures must be GaussianMixtures, got {shown(mixture)}'
            raise TypeError(msg)
    fractions = as_floats(fractions, 'fractions', shape=(len(mixtures),))
    # Only weights change: averaging shapes would pair components whose order
    # is arbitrary.
    weights = [f * m.weights for f, m in zip(fractions, mixtures, strict=True)]
    return GaussianMixture(np.concatenate(weights),
                           np.concatenate([m.means for m in mixtures]),
                           np.concatenate([m.covariances for m in mixtures]))


def as_list(mixtures):
    """Return mixtures as a list, or raise for what is no sequence of them."""
    if isinstance(mixtures, GaussianMixture) or not isinstance(
            mixtures, Iterable):
        msg = ('mixtures must be a list of GaussianMixture objects, got '
               f'{shown(mixtures)}')
        raise TypeError(msg)
    return list(mixtures)
