r"""
ePSFs that other programs wrote, as arrays.

* STDPSF: a cube of ePSFs on a grid that covers one or several chips. Its
  keywords ``IPSFXnn`` and ``JPSFYnn`` count pixels from 1.
* STPSF grids: a cube whose keywords ``DET_YXn`` are the place (y, x) of the
  image n, and count from 0.
* STPSF's ``calc_psf``: images of the light before and after the detector's
  pixels sample it. With s samples to a pixel, a pixel receives

  .. math::

      P(x, y) = \sum_{i=1}^{s} \sum_{j=1}^{s} I_{ij}(x, y)

  of the optical image I, the sum over the samples that it covers.
* Images of one ePSF each, in one or several extensions.
"""
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from photutils.psf import ImagePSF

from photutils_mgauss.files.damage import UnusableFileError
from photutils_mgauss.files.fits_files import open_fits, read_chosen
from photutils_mgauss.files.keywords import Keywords

__all__ = ['EPSFGrid', 'places_in_meta', 'psf_kind', 'read_image_psf',
           'read_stdpsf', 'read_stpsf']

# What STPSF names the samples of the optical image and those of the pixels;
# the first of each has the distortion of the camera in it.
_OPTICAL = ('OVERDIST', 'OVERSAMP')
_SAMPLED = ('DET_DIST', 'DET_SAMP')

# Extensions beside an image that are no ePSF.
_BESIDE = ('ERR', 'ERROR', 'VAR', 'VARIANCE', 'IVAR', 'WEIGHT', 'WHT', 'DQ',
           'FLAG', 'FLAGS', 'MASK')

_STDPSF = 'an undamaged STDPSF grid'
_STPSF = 'an undamaged PSF of STPSF'
_EPSF = 'an undamaged image of an ePSF'

_PLACE = re.compile(r'DET_(YX|XY)(\d+)$')
_PAIR = re.compile(r'\(?\s*([^,\s()]+)\s*,\s*([^,\s()]+)\s*\)?$')

# STDPSF files have four samples to a pixel, and no keyword that says so.
_STDPSF_SAMPLING = 4

# Cameras of several chips whose numbers do not follow the grid: number and
# name of each chip, row by row from below. They are known by the rows and
# columns of their chips and by their nodes.
_CHIPS = {(2, 2, 36): ((3, 'WF3'), (4, 'WF4'), (2, 'WF2'), (1, 'PC')),
          (2, 4, 200): ((1, 'A1'), (3, 'A3'), (8, 'B4'), (6, 'B2'),
                        (2, 'A2'), (4, 'A4'), (7, 'B3'), (5, 'B1'))}

# The first bytes of FITS files, plain and compressed.
_FITS_MARKS = (b'SIMPLE', b'\x1f\x8b', b'BZh', b'\xfd7zX', b'PK\x03\x04')
_OWN_TAG = b'photutils_mgauss/tags/'


@dataclass(frozen=True, eq=False)
class EPSFGrid:
    """
    ePSFs at N places of a detector, as photutils' grids have them.

    Attributes
    ----------
    data : (N, ny, nx) `~numpy.ndarray`
        Flux in a pixel centred at each sample, of a star of flux 1.
    grid_xypos : (N, 2) `~numpy.ndarray`
        The places (x, y); the centre of the first pixel is (0, 0) [pix].
    oversampling : int
        Samples per pixel.
    """

    data: np.ndarray
    grid_xypos: np.ndarray
    oversampling: int


def psf_kind(path):
    """
    Return what a file holds.

    Returns
    -------
    str
        'mixtures' (a file of this package), 'psfex', 'stdpsf', 'stpsf' (a
        grid), 'optical' (of STPSF's ``calc_psf``), 'epsf' (an oversampled
        image), or 'image' for anything else.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is a damaged FITS file.
    """
    path = Path(path)
    with path.open('rb') as file:
        start = file.read(6)
        if start.startswith(b'#ASDF'):
            tree = (start + file.read(2**20)).partition(b'\n...')[0]
            return 'mixtures' if _OWN_TAG in tree else 'image'
    if path.name.removesuffix('.gz').endswith('.psf'):
        return 'psfex'
    return _fits_kind(path) if start.startswith(_FITS_MARKS) else 'image'


def _fits_kind(path):
    with open_fits(path) as hdus:
        headers = [hdu.header for hdu in hdus]
        optical = any(_is_of_calc_psf(hdu) for hdu in hdus)
    first = headers[0]
    marks = (('mixtures', 'MGCLASS' in first),
             ('psfex', any('PSF_SAMP' in header for header in headers)),
             ('stdpsf', 'NXPSFS' in first),
             ('stpsf', any(_has_places(header) for header in headers)),
             ('optical', optical),
             ('epsf', any('OVERSAMP' in header for header in headers)))
    return next((kind for kind, applies in marks if applies), 'image')


def _has_places(header):
    return any(_PLACE.match(key) for key in header)


def _is_of_calc_psf(hdu):
    return _is_plane(hdu) and (hdu.name in (*_OPTICAL, *_SAMPLED)
                               or 'DET_SAMP' in hdu.header)


def _is_plane(hdu):
    return hdu.is_image and hdu.header.get('NAXIS') == 2


def read_stdpsf(path, detector=None):
    """
    Read a grid of ePSFs in the format STDPSF.

    Parameters
    ----------
    path : str or path-like
        The file.
    detector : int, str or None
        The number of a chip, as photutils counts them, or its name;
        ``'all'`` for a dict of all.

    Returns
    -------
    EPSFGrid or dict of them
        Positions count in the pixels of the chip.

    Raises
    ------
    ValueError
        If the file is damaged, or covers several chips and ``detector`` does
        not say which to read.
    """
    with open_fits(path, _STDPSF) as hdus:
        header = Keywords(hdus[0].header, path, _STDPSF)
        axes = [_nodes_along(header, *keys) for keys in
                (('NYPSFS', 'JPSFY'), ('NXPSFS', 'IPSFX'))]
        data = _cube(hdus[0], header, axes[0].size * axes[1].size)
        sampling = header.count('OVERSAMP', _STDPSF_SAMPLING, lowest=1)
        data = _flux_density(data, sampling)
        chips = _chips(axes, data.reshape(
            axes[0].size, axes[1].size, *data.shape[1:]), sampling)
        return _chosen_chip(path, chips, detector)


def _nodes_along(header, count, prefix):
    """Return the coordinates of the nodes along an axis, from 1 [pix]."""
    n = header.count(count, lowest=1)
    if f'{prefix}01' in header:
        return np.array([header.number(f'{prefix}{i:02d}')
                         for i in range(1, n + 1)], float)
    # Long lists stand in several strings.
    words = [word for key in sorted(set(header))
             if re.fullmatch(prefix + r'[A-Z]\d', key)
             for word in header.text(key).split()]
    nodes = _floats(header, prefix, words)
    if nodes.size != n:
        header.fail(f'{prefix} tells of {nodes.size} nodes, {count} of {n}')
    return nodes


def _floats(header, key, words):
    """Return the numbers that words stand for."""
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        header.fail(f'{key} must be numbers, got {" ".join(words):.40}')
    if not np.isfinite(values).all():
        header.fail(f'{key} must be finite, got {values.tolist()}')
    return values


def _cube(hdu, header, n):
    """Return the images (n, ny, nx) of an extension."""
    data = np.array(hdu.data, dtype=float)
    data = data[None] if data.ndim == 2 else data
    if data.ndim != 3 or len(data) != n or data.size == 0:
        header.fail(f'its keywords tell of {n} images, but the array has the '
                    f'shape {data.shape}')
    return data


def _flux_density(data, sampling):
    """
    Return images whose samples are the flux in a pixel.

    In some files they are the flux in a sample: their sum is 1, not the
    square of the sampling.
    """
    sums = data.sum(axis=(1, 2))
    sums = sums[np.isfinite(sums) & (sums > 0)]
    if sums.size and np.median(sums) < sampling:
        return data * sampling**2
    return data


def _chips(axes, data, sampling):
    """
    Return the grids of all chips by number and name.

    The last line of nodes of one chip lies where the first one of the next
    does, or the coordinates begin anew.
    """
    rows, columns = map(_parts, axes)
    n_nodes = data.shape[0] * data.shape[1]
    places = _CHIPS.get((len(rows), len(columns), n_nodes))
    chips = {}
    for number, (row, column) in enumerate(
            [(row, column) for row in rows for column in columns]):
        (j, y_0), (i, x_0) = row, column
        y, x = axes[0][j], axes[1][i]
        nodes = np.stack(np.meshgrid(x - x_0 - 1, y - y_0 - 1), axis=-1)
        key = places[number] if places else (number + 1, '')
        where = (f'x {x.min():g} to {x.max():g}, y {y.min():g} to '
                 f'{y.max():g}')
        chips[key] = where, EPSFGrid(
            data[j, i].reshape(-1, *data.shape[2:]), nodes.reshape(-1, 2),
            sampling)
    return chips


def _parts(nodes):
    """Return the slice of each chip along an axis, and where it begins."""
    steps = np.diff(nodes)
    ends = (np.flatnonzero(steps <= 1) + 1 if (steps > 0).any()
            else np.array([], int))
    starts = [0, *ends.tolist()]
    begins = [0.0] + [nodes[end - 1] if nodes[end] >= nodes[end - 1] else 0.0
                      for end in ends]
    return [(slice(start, stop), begin) for start, stop, begin in
            zip(starts, [*starts[1:], nodes.size], begins, strict=True)]


def _chosen_chip(path, chips, detector):
    """Return the grid of the chip that the user chose, or of all."""
    if str(detector).lower() == 'all':
        return {number: grid for (number, _), (_, grid)
                in sorted(chips.items())}
    if detector is None and len(chips) == 1:
        return next(iter(chips.values()))[1]
    for (number, name), (_, grid) in chips.items():
        if str(detector).upper() in (str(number), name or None):
            return grid
    words = ', '.join(f'{number} ({name + ": " if name else ""}{where})'
                      for (number, name), (where, _) in sorted(chips.items()))
    msg = (f'{path}: detector (--detector) must be one of the {len(chips)} '
           f"detectors in this file, {words}, or 'all', got {detector}")
    raise UnusableFileError(msg)


def read_stpsf(path, ext=None):
    """
    Read a grid of ePSFs that STPSF or WebbPSF wrote.

    Parameters
    ----------
    path : str or path-like
        The file.
    ext : int or str, optional
        Which extension, where several hold a grid; ``'all'`` for a dict.

    Returns
    -------
    EPSFGrid or dict of them

    Raises
    ------
    ValueError
        If the file is damaged, or two PSFs are at one place.
    """
    with open_fits(path, _STPSF) as hdus:
        grids = [hdu for hdu in hdus if _has_places(hdu.header)]
        return read_chosen(path, hdus, grids, ext,
                           lambda hdu: _stpsf_grid(hdu, path))


def _stpsf_grid(hdu, path):
    header = Keywords(hdu.header, path, _STPSF)
    places = _places(header)
    data = _cube(hdu, header, len(places))
    sampling = _stpsf_sampling(header, data)
    return EPSFGrid(_flux_density(data, sampling), places, sampling)


def _places(header):
    """Return the places (x, y) of all images, by their numbers."""
    found = {}
    for key in header:
        match = _PLACE.match(key)
        if match:
            pair = _PAIR.match(header.text(key))
            if pair is None:
                header.fail(f'{key} must be a pair of numbers, got '
                            f'{header.text(key):.40}')
            values = _floats(header, key, pair.groups())
            order = -1 if match.group(1) == 'YX' else 1
            found[int(match.group(2))] = values[::order]
    if sorted(found) != list(range(len(found))):
        header.fail(f'DET_YX must be numbered from 0, got {sorted(found)}')
    places = np.array([found[n] for n in range(len(found))])
    if len(np.unique(places, axis=0)) < len(places):
        header.fail('two PSFs at one place: one detector at a time can be '
                    'read')
    return places


def places_in_meta(meta):
    """
    Return the places that keywords of STPSF in metadata tell.

    Parameters
    ----------
    meta : dict
        Such as `~photutils.psf.GriddedPSFModel` keeps of the file.

    Returns
    -------
    (N, 2) `~numpy.ndarray` or None
        The places (x, y) by the numbers of the images [pix]; None if there
        are none.
    """
    cards = {str(key).upper(): value for key, value in meta.items()
             if isinstance(value, str)}
    if not _has_places(cards):
        return None
    return _places(Keywords(cards, 'psf.meta', _STPSF))


def _stpsf_sampling(header, data):
    """Return the samples per pixel, if the size of the images agrees."""
    key = 'DET_SAMP' if 'DET_SAMP' in header else 'OVERSAMP'
    sampling = header.count(key, lowest=1)
    if 'FOVPIXEL' in header:
        size = header.number('FOVPIXEL') * sampling
        if data.shape[-1] != round(size):
            header.fail(f'{key} and FOVPIXEL tell of {size:g} samples, but '
                        f'the images have {data.shape[-1]}')
    return sampling


def read_image_psf(path, *, ext=None, oversampling=None):
    """
    Read images of one ePSF each.

    Parameters
    ----------
    path : str or path-like
        The file.
    ext : int or str, optional
        Which image, where there are several; ``'all'`` for a dict. Of a file
        of STPSF's ``calc_psf`` it is the optical image with the distortion,
        or else without, by default.
    oversampling : int, optional
        Samples per pixel, where the header does not have OVERSAMP.

    Returns
    -------
    `~photutils.psf.ImagePSF` or dict of them
        Of flux 1. Optical images are integrated over the pixel.

    Raises
    ------
    ValueError
        If the file is damaged, holds no such image, or several and ``ext``
        does not say which to read.
    """
    with open_fits(path, _EPSF) as hdus:
        images = [hdu for hdu in hdus if _is_plane(hdu)
                  and hdu.name not in _BESIDE]
        if not images:
            msg = f'{path}: must hold an image of an ePSF, got none'
            raise UnusableFileError(msg)
        if ext is None:
            images = _preferred(images)

        def read(hdu):
            header = hdu.header.copy()
            if 'OVERSAMP' not in header and 'OVERSAMP' in hdus[0].header:
                header['OVERSAMP'] = hdus[0].header['OVERSAMP']
            return _image_psf(hdu, Keywords(header, path, _EPSF),
                              oversampling)
        return read_chosen(path, hdus, images, ext, read)


def _preferred(images):
    """Return the image of calc_psf that is best, or else all images."""
    for name in (*_OPTICAL, *_SAMPLED):
        found = [hdu for hdu in images if hdu.name == name]
        if len(found) == 1:
            return found
    return images


def _image_psf(hdu, header, oversampling):
    """Return an image in the flux convention of photutils."""
    data = np.array(hdu.data, dtype=float)
    sampling = oversampling
    if _is_of_calc_psf(hdu):
        sampling = 1 if hdu.name in _SAMPLED else _stpsf_sampling(header,
                                                                  data)
        if oversampling not in (None, sampling):
            header.fail(f'its keywords tell of {sampling} samples to a '
                        f'pixel, not of the {oversampling} that are given')
        data = _over_pixels(data, sampling, header)
    elif sampling is None:
        sampling = header.count('OVERSAMP', lowest=1)
    total = data.sum()
    if not (np.isfinite(total) and total > 0):
        header.fail('pixels whose sum is not positive')
    return ImagePSF(data / total * sampling**2, oversampling=sampling)


def _over_pixels(data, sampling, header):
    """
    Return the sums over all squares of sampling x sampling samples.

    Their centres have the middle of the image in common with the samples,
    whether the sampling is even or odd.
    """
    if min(data.shape) < 3 * sampling:
        header.fail(f'an image of {data.shape} samples, {sampling} to a '
                    'pixel, which is too small')
    squares = sliding_window_view(data, (sampling, sampling))
    return squares.sum(axis=(2, 3))
