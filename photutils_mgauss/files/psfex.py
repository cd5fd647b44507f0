r"""
PSF models written by other programs, as plain arrays.

A PSFEx model (``.psf``) is a stack of images, one for each term of a
polynomial of the place on the chip,

.. math::

    P(x, y) = \sum_t I_t \prod_g \prod_{v \in g}
    \left(\frac{c_v - z_v}{s_v}\right)^{n_{tv}},

where the context :math:`c_v` is a position or any other measurement, with its
zero point :math:`z_v` and its scale :math:`s_v`. The contexts are divided into
groups :math:`g`; the powers of one group add up to its degree at most, and
every term of one group is multiplied by every term of the others.
"""
import re
from dataclasses import dataclass
from math import comb, prod

import numpy as np

from photutils_mgauss.files.damage import UnusableFileError
from photutils_mgauss.files.fits_files import (
    name_of,
    open_fits,
    read_chosen,
)
from photutils_mgauss.files.keywords import Keywords
from photutils_mgauss.utils.validation import as_real

__all__ = ['PSFExModel', 'read_psfex']

# No model has more images.
_MOST_TERMS = 10_000

_UNDAMAGED = 'an undamaged PSFEx model'

_POSITION = re.compile(r'([XY])(WIN|PSF|PEAK|MODEL)?_IMAGE(_DBL)?$')


@dataclass(frozen=True, eq=False)
class PSFExModel:
    r"""
    A PSF model of PSFEx, as in its file.

    Attributes
    ----------
    planes : (T, ny, nx) `~numpy.ndarray`
        An image for each polynomial term; not normalised. They include the
        pixel: sample the PSF, do not integrate it again.
    exponents : (T, V) `~numpy.ndarray` of int
        The power of each context in each term.
    contexts : tuple of V str
        The contexts' names, such as ``'X_IMAGE'``.
    zeros, scales : (V,) `~numpy.ndarray`
        Zero points and scales of the contexts; positions count from 1, as
        in the file.
    sampling : float
        The distance between two samples [pix], not an integer in general.

    See Also
    --------
    read_psfex

    Notes
    -----
    The image at the contexts :math:`c_v` is a polynomial of the T planes
    :math:`P_t`, with the exponents :math:`n_{tv}`, zeros :math:`z_v` and
    scales :math:`s_v`:

    .. math::

        I = \sum_t P_t \prod_v \left(\frac{c_v - z_v}{s_v}\right)^{n_{tv}}

    Examples
    --------
    A model whose second plane grows along x:

    >>> import numpy as np
    >>> from photutils_mgauss import PSFExModel
    >>> planes = np.zeros((2, 3, 3))
    >>> planes[:, 1, 1] = 1, 0.5
    >>> model = PSFExModel(planes, np.array([[0], [1]]), ('X_IMAGE',),
    ...                    np.array([101.0]), np.array([200.0]), 0.5)
    >>> model.image_at(200, 0)[1]
    array([0.  , 1.25, 0.  ])
    """

    planes: np.ndarray
    exponents: np.ndarray
    contexts: tuple
    zeros: np.ndarray
    scales: np.ndarray
    sampling: float

    @property
    def origin(self):
        """The place (x, y) of the star on a plane [samples]."""
        ny, nx = self.planes.shape[1:]
        return nx // 2, ny // 2

    @property
    def position_range(self):
        """
        The limits ((x_min, x_max), (y_min, y_max)) of the stars [pix].

        From 0. ``None`` stands for a direction the model does not depend on.
        """
        limits = {'X': None, 'Y': None}
        for name, zero, scale in zip(self.contexts, self.zeros, self.scales,
                                     strict=True):
            axis = _position_axis(name)
            if axis:
                half = abs(scale) / 2
                limits[axis] = (zero - 1 - half, zero - 1 + half)
        return limits['X'], limits['Y']

    def image_at(self, x, y, **contexts):
        """
        Evaluate the model at a place on the chip.

        Parameters
        ----------
        x, y : float
            The position [pix]; the first pixel is (0, 0).
        **contexts : float
            The values of all contexts that are not positions.

        Returns
        -------
        (ny, nx) `~numpy.ndarray`
            The PSF, sampled every ``sampling`` pixels around ``origin``;
            each value is the flux per sample, not normalised.

        Raises
        ------
        ValueError
            If the value of a context is missing.
        TypeError
            If the model has no context of a name given.
        """
        positions = {'X': as_real(x, 'x') + 1, 'Y': as_real(y, 'y') + 1}
        unknown = set(contexts) - set(self.contexts)
        if unknown:
            msg = (f'contexts must be among {self.contexts}, got '
                   f'{sorted(unknown)}')
            raise TypeError(msg)
        values = np.array([self._value(name, positions, contexts)
                           for name in self.contexts])
        powers = ((values - self.zeros) / self.scales) ** self.exponents
        return np.tensordot(powers.prod(axis=1), self.planes, 1)

    @staticmethod
    def _value(name, positions, contexts):
        if name in contexts:
            return as_real(contexts[name], name)
        axis = _position_axis(name)
        if axis is None:
            msg = (f'contexts must hold a value of {name!r}, on which this '
                   'model depends, got none')
            raise ValueError(msg)
        return positions[axis]


def _position_axis(name):
    """Return 'X' or 'Y' for the name of a pixel position, else None."""
    match = _POSITION.match(name)
    return match and match.group(1)


def read_psfex(path, *, ext=None):
    """
    Read a PSF model made by PSFEx.

    Parameters
    ----------
    path : str, path-like or file-like
        A ``.psf`` file, which may be compressed: any polynomial degree, any
        number of contexts and context groups.
    ext : int, str or (str, int) tuple, optional
        Which model to read from a file that has one for each chip of a
        mosaic: the number of the extension, its name, or name and version
        (``'PSF_DATA,2'``). ``'all'`` reads all of them.

    Returns
    -------
    PSFExModel or dict of them
        With ``ext='all'`` a dict, whose keys ``ext`` would take.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If the file is not a PSFEx model, is damaged, or depends on a
        keyword of the image's header, whose value it does not contain; or
        if it has several models and ``ext`` does not choose one.

    Examples
    --------
    >>> from photutils_mgauss import read_psfex
    >>> model = read_psfex('chip_12.psf')  # doctest: +SKIP
    >>> model.image_at(1023, 512).shape  # doctest: +SKIP
    (25, 25)
    >>> chips = read_psfex('mosaic.psf', ext='all')  # doctest: +SKIP
    >>> list(chips)  # doctest: +SKIP
    [1, 2]
    """
    name = name_of(path)
    with open_fits(path, _UNDAMAGED) as hdus:
        tables = [hdu for hdu in hdus if 'PSF_SAMP' in hdu.header]
        if not tables:
            msg = (f'{name}: must be a PSFEx model, but no table has the '
                   'keyword PSF_SAMP')
            raise UnusableFileError(msg)
        return read_chosen(name, hdus, tables, ext,
                           lambda hdu: _model_in(hdu, name))


def _model_in(hdu, name):
    """Return the model of an extension."""
    data = np.array(hdu.data['PSF_MASK'], dtype=float)
    header = Keywords(hdu.header, name, _UNDAMAGED)
    sampling = header.number('PSF_SAMP')
    if not sampling > 0:
        header.fail(f'PSF_SAMP must be positive, got {sampling}')
    names, zeros, scales, exponents = _polynomial(header)
    planes = _planes(header, data, len(exponents))
    return PSFExModel(planes, exponents, names, zeros, scales, sampling)


def _polynomial(header):
    """Return names, zero points, scales and exponents of the contexts."""
    # A constant model has no contexts, and PSFEx may leave out all keywords.
    numbers = range(1, header.count('POLNAXIS', 0) + 1)
    names = tuple(header.text(f'POLNAME{v}') for v in numbers)
    for name in names:
        if name.startswith(':'):
            header.fail(f'it depends on {name!r}, a keyword of the image '
                        'header; models of pixel positions and measured '
                        'columns can be read')
    groups = [header.count(f'POLGRP{v}') for v in numbers]
    n_groups = header.count('POLNGRP', 0) if names else 0
    if any(not 1 <= group <= n_groups for group in groups):
        header.fail(f'POLGRP must be 1 to POLNGRP = {n_groups}, got {groups}')
    degrees = [header.count(f'POLDEG{g}') for g in range(1, n_groups + 1)]
    zeros = np.array([header.number(f'POLZERO{v}') for v in numbers])
    scales = np.array([header.number(f'POLSCAL{v}') for v in numbers])
    if (scales == 0).any():
        header.fail('POLSCAL must not be 0')
    n_terms = prod(comb(groups.count(group) + degree, degree)
                   for group, degree in enumerate(degrees, 1))
    if n_terms > _MOST_TERMS:
        header.fail(f'POLDEG must be smaller, got {degrees} for {n_terms} '
                    'images')
    return names, zeros, scales, _exponents(groups, degrees)


def _exponents(groups, degrees):
    """
    Return the powers (T, V) of V contexts in the order PSFEx writes them.

    Within a group the first context runs fastest, and the terms of the first
    group run faster than those of the next.
    """
    table = np.zeros((1, len(groups)), int)
    for group, degree in enumerate(degrees, 1):
        members = [v for v, g in enumerate(groups) if g == group]
        terms = np.zeros((1, len(groups)), int)
        for v in members:
            steps = np.arange(degree + 1)
            raised = [np.where(np.arange(len(groups)) == v, n, terms)
                      for n in steps]
            terms = np.concatenate(raised)
            terms = terms[terms.sum(axis=1) <= degree]
        table = (terms[:, None] + table).reshape(-1, len(groups))
    return table


def _planes(header, data, n_terms):
    """Return the images (T, ny, nx) if all numbers in the file agree."""
    n_axes = header.count('PSFNAXIS')
    shape = [header.count(f'PSFAXIS{i}') for i in range(n_axes, 0, -1)]
    shape = [1] * (3 - n_axes) + shape
    if len(shape) != 3 or shape[0] != n_terms:
        header.fail(f'its polynomial has {n_terms} terms, but PSFAXIS tells '
                    f'of {shape[0]} images')
    if data.size != prod(shape):
        header.fail(f'PSFAXIS tells of {prod(shape)} values, but the table '
                    f'holds {data.size}')
    if not np.isfinite(data).all():
        header.fail('some of its pixels are not finite')
    return data.reshape(shape)
