r"""
What a PSF depends on beside the place of a star: its colour, its flux.

A grid knows the PSF at its nodes for a usual value of each context, and for a
few others, between which images are blended linearly. With the shares
:math:`s_l` of the values l that are known, a star with contexts c has the PSF

.. math::

    P(\mathbf c) = P + \sum_c \sum_l \left[s_l(c) - s_l(\bar c)\right] P_{cl} .
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.psf.blending import blend
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.utils.validation import as_real

# What a place or a measurement is called is no name of a context.
NOT_CONTEXTS = ('id', 'x', 'y', 'exposure', 'flux')


@dataclass(frozen=True, eq=False)
class PSFContext:
    """
    The PSF of a grid for several values of a context.

    Attributes
    ----------
    name : str
        Of the column of a table of stars; 'flux' is what is fitted.
    values : (L,) `~numpy.ndarray`
        Ascending.
    usual : float
        That of the grid itself, and of stars for which it is unknown.
    layers : tuple of L GriddedMixturePSF
    """

    name: str
    values: np.ndarray
    usual: float
    layers: tuple

    def shares(self, values):
        """
        Return how much of each layer to add for values (n,), (n, L).

        Beyond the first and the last layer stars are like those.
        """
        known = np.where(np.isfinite(values), values, self.usual)
        return self.blend(known) - self.blend(np.array([self.usual]))

    def blend(self, values):
        """Return the share of each layer in the PSF, (n, L)."""
        rows = np.eye(self.values.size)
        return np.column_stack([np.interp(values, self.values, row)
                                for row in rows])

    def convolved(self, kernel):
        """Return the context of a PSF convolved as mixtures are."""
        return PSFContext(self.name, self.values, self.usual, tuple(
            layer.convolve(kernel) for layer in self.layers))


def change_of_light(contexts, columns, stars, faintest, shape):
    """
    Draw what the contexts of stars add to the light of the usual PSF.

    Parameters
    ----------
    contexts : sequence of PSFContext
    columns : dict of str to (n,) `~numpy.ndarray`
        The values for each star; contexts that are missing are usual.
    stars : (3, n) `~numpy.ndarray`
        x, y and flux.
    faintest : float
        The faintest light that is drawn.
    shape : (int, int)
        Of the image.

    Returns
    -------
    (ny, nx) `~numpy.ndarray`
    """
    image = np.zeros(shape)
    finite = np.isfinite(stars).all(axis=0)
    for context in contexts:
        if context.name not in columns:
            continue
        shares = context.shares(columns[context.name])
        for layer, share in zip(context.layers, shares.T, strict=True):
            seen = finite & (share != 0)
            if seen.any():
                x, y, flux = stars[:, seen]
                MixtureRenderer(layer).add((x, y, flux * share[seen]),
                                           faintest, 0, 0, image)
    return image


def known_contexts(values, names):
    """Return values of contexts as numbers if all are among the names."""
    for name in values:
        if name not in names:
            msg = (f'a context must be one of {", ".join(names) or "none"}, '
                   f'got {name!r}')
            raise ValueError(msg)
    return {name: as_real(value, name) for name, value in values.items()}


def at_values(mixtures, contexts, values):
    """
    Return the mixtures of nodes for values of contexts.

    Parameters
    ----------
    mixtures : list of M GaussianMixture
        For usual stars.
    contexts : sequence of PSFContext
    values : dict of str to float

    Returns
    -------
    list of M GaussianMixture
        Blends of those that are known.
    """
    given = [one for one in contexts if one.name in values]
    for context in given:
        value = np.array([values[context.name]])
        # One of the layers is the usual PSF, which the first one replaces.
        shares = (np.append(0, context.blend(value)) if context is given[0]
                  else np.append(1, context.shares(value)))
        kept = np.flatnonzero(shares)
        nodes = zip(mixtures, *(layer.mixtures for layer in context.layers),
                    strict=True)
        mixtures = [blend([node[i] for i in kept], shares[kept])
                    for node in nodes]
    return mixtures


def to_columns(contexts):
    """Return what a file holds of contexts, a row for each layer."""
    rows = [(context, value, layer.grid) for context in contexts
            for value, layer in zip(context.values, context.layers,
                                    strict=True)]
    return {'name': np.array([context.name for context, *_ in rows]),
            'usual': np.array([context.usual for context, *_ in rows]),
            'value': np.array([value for _, value, _ in rows]),
            **{name: np.array([getattr(grid, f'{name}s') for *_, grid in rows])
               for name in ('scale', 'weight', 'mean', 'covariance')}}


def from_columns(columns, make):
    """
    Return the contexts of a file, none where there are no columns.

    ``make`` makes a layer of scales, weights, means and covariances.
    """
    if not columns:
        return ()
    names = columns['name'].astype(str)
    found = []
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(names == name)
        found.append(PSFContext(
            str(name), np.array(columns['value'][rows]),
            float(columns['usual'][rows[0]]),
            tuple(make(*(columns[one][row] for one in (
                'scale', 'weight', 'mean', 'covariance'))) for row in rows)))
    return tuple(found)
