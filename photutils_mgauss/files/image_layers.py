"""
Image files to arrays: values, errors, flags, and the WCS they carry.

FITS with one or several extensions, the SCI, ERR and DQ of JWST and HST, the
ASDF of Roman, and files beside an image as CSST has them.
"""
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from astropy.nddata.bitmask import bitfield_to_boolean_mask
from astropy.time import Time
from astropy.utils.exceptions import AstropyUserWarning
from astropy.wcs import WCS

from photutils_mgauss.files.asdf_files import is_asdf, open_asdf
from photutils_mgauss.files.damage import UnusableFileError, undamaged
from photutils_mgauss.files.fits_files import chosen_hdu, label_of, open_fits
from photutils_mgauss.files.image_header import Cards

_IMAGE = 'an undamaged FITS or ASDF image'

# Names of extensions with the noise, and what is in them.
_NOISE = {'ERR': 'error', 'ERROR': 'error', 'UNCERT': 'error',
          'STDDEV': 'error', 'SIGMA': 'error', 'RMS': 'error',
          'VAR': 'variance', 'VARIANCE': 'variance',
          'IVAR': 'weight', 'INVVAR': 'weight', 'WEIGHT': 'weight'}
_FLAGS = ('DQ', 'FLAG', 'FLAGS', 'MASK')

# Axes of an image, and the largest numbers of few bits, by BITPIX.
_DIMENSIONS = 2
_LARGEST = {8: 255, 16: 32767}

# Endings of the names of files beside an image, and what is in them.
_BESIDE = {'err': 'error', 'rms': 'error', 'sigma': 'error',
           'var': 'variance', 'wht': 'weight', 'weight': 'weight',
           'ivar': 'weight', 'flg': 'flags', 'flag': 'flags',
           'flags': 'flags', 'dq': 'flags', 'mask': 'flags'}
_PACKED = ('.gz', '.fz', '.bz2', '.xz', '.zip')
_OWN_ENDINGS = ('_img', '_sci', '-img', '-sci')

# Bits that do not make a pixel bad, as astropy.nddata.bitmask takes them. Of
# JWST and Roman only the first bit means "do not use"; HST marks what it
# has corrected: 32 and 64 (charge transfer, warm), 1024 (sink pixels).
_HARMLESS = {'JWST': '~1', 'ROMAN': '~1', 'HST': 32 + 64 + 1024}

_NOISE_OF = {'error': np.asarray, 'variance': np.sqrt,
             'weight': lambda weight: 1 / np.sqrt(weight)}


@dataclass(frozen=True, eq=False)
class Layers:
    """
    What the files of an image hold, as arrays of one shape.

    ``error`` and ``flags`` may be None, ``wcs`` too; ``sources`` names where
    each of them was found. ``bits`` are those of a pixel in the file and
    ``largest`` is the value above which they hold none, if they are few
    enough to be filled.
    """

    data: np.ndarray
    error: np.ndarray | None
    flags: np.ndarray | None
    covered: np.ndarray | None
    cards: Cards
    wcs: object
    sources: dict
    bits: int | None = None
    largest: float | None = None

    def mask(self, good_bits):
        """Return True where a pixel must not be used."""
        bad = ~np.isfinite(self.data)
        if self.flags is not None:
            flags = self.flags
            if flags.dtype.kind not in 'iu':
                flags = np.nan_to_num(flags, nan=1).astype(np.int64)
            if good_bits is None:
                good_bits = _HARMLESS.get(self.cards.telescope, 0)
            bad |= bitfield_to_boolean_mask(flags, ignore_flags=good_bits,
                                            good_mask_value=False,
                                            dtype=bool)
        if self.error is not None:
            with np.errstate(invalid='ignore'):
                bad |= ~(np.isfinite(self.error) & (self.error > 0))
        if self.covered is not None:
            bad |= ~self.covered
        return bad


def read_layers(path, *, ext=None, error_ext=None, flags_ext=None,
                beside=None):
    """
    Read an image and what belongs to it.

    Parameters
    ----------
    path : str or path-like
        A FITS or ASDF file.
    ext : str, optional
        The extension with the image: a number, a name, or 'name,version'.
    error_ext, flags_ext : str, optional
        Those with the errors (weights or variances if their names say so)
        and with the flags, where their names do not tell. FITS only.
    beside : dict, optional
        Files with 'error', 'weight' (inverse variance) or 'flags'. What
        neither they nor the image's own file hold is looked for in files
        whose names differ by their endings, such as ``_wht`` and ``_flg``.

    Returns
    -------
    Layers

    Raises
    ------
    OSError, ValueError
        If a file cannot be read or has no such image.
    """
    path = Path(path)
    named = {'error': error_ext, 'flags': flags_ext}
    with undamaged(path, _IMAGE):
        layers = (_read_asdf_alone(path, named) if is_asdf(path)
                  else _read_fits(path, ext, named))
    given = {kind: Path(file) for kind, file in (beside or {}).items()
             if file}
    return with_all_errors(path, _with_companions(path, layers, given))


def with_all_errors(path, layers):
    """
    Give pixels an error that have none only because they are negative.

    Errors made from the pixels themselves are often 0 where a pixel is below
    0. Without those pixels, all that is left of the noise is above 0.
    """
    if layers.error is None:
        return layers
    with np.errstate(invalid='ignore'):
        lacking = (layers.error == 0) & (layers.data < 0)
        known = np.isfinite(layers.error) & (layers.error > 0)
        faint = known & (layers.data <= np.nanmedian(layers.data))
    if not lacking.any() or not faint.any():
        return layers
    error = np.median(layers.error[faint])
    warnings.warn(
        f'{path}: {lacking.sum()} of {lacking.size} pixels are negative and '
        f'have the error 0; they get {error:.4g}, the median error of the '
        'faint pixels', AstropyUserWarning, stacklevel=3)
    return replace(layers, error=np.where(lacking, error, layers.error))


def _read_fits(path, ext, named):
    with open_fits(path, _IMAGE) as hdus:
        hdu = _science(path, hdus, ext)
        bits, largest = _range(hdu.header)
        data = _plane(path, hdu)
        sources = {'image': label_of(hdus, hdu)}
        error = (_named(path, hdus, named, sources, 'error')
                 or _first(path, hdus, hdu, _NOISE, sources, 'error'))
        if error is not None:
            kind = _NOISE.get(error.name, 'error')
            error = to_error(_plane(path, error), kind)
        flags = (_named(path, hdus, named, sources, 'flags')
                 or _first(path, hdus, hdu, _FLAGS, sources, 'flags'))
        flags = None if flags is None else _flat(flags.data)
        weight = _first(path, hdus, hdu, ('WHT',), {}, 'weight')
        covered = None if weight is None else _plane(path, weight) > 0
        cards = Cards(hdu.header, hdus[0].header)
        cards.check()
        wcs, problem = None, None
        try:
            wcs = _fits_wcs(hdus, hdu)
        except _WCSError as wcs_error:
            problem = str(wcs_error)
    if problem:
        # Stars can be measured without it.
        warnings.warn(f'{path}: has {problem}; it is left out',
                      AstropyUserWarning, stacklevel=2)
    layers = Layers(data, error, flags, covered, cards, wcs, sources, bits,
                    largest)
    for name in ('error', 'flags', 'covered'):
        _check_shape(path, getattr(layers, name), layers, name)
    return layers


def science_images(path):
    """
    Return what the images of a file are called that show the sky.

    Parameters
    ----------
    path : str or path-like
        A FITS or ASDF file.

    Returns
    -------
    list of str
        What `read_layers` takes as ``ext``; none for ASDF, which has one.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read.
    """
    with undamaged(path, _IMAGE):
        if is_asdf(path):
            return []
        with open_fits(path, _IMAGE) as hdus:
            return [label_of(hdus, hdu) for hdu in _all_science(hdus)]


def _all_science(hdus):
    """Return the images that are not errors or flags of others."""
    images = [hdu for hdu in hdus if _is_image(hdu)]
    science = [hdu for hdu in images if hdu.name in ('SCI', 'SCIENCE')]
    return science or [hdu for hdu in images if hdu.name not in
                       (*_NOISE, *_FLAGS, 'WHT', 'CTX', 'CON')]


def _science(path, hdus, ext):
    if ext is not None:
        images = [hdu for hdu in hdus if _is_image(hdu)]
        return _chosen(path, hdus, images, ext)
    found = _all_science(hdus)
    if len(found) == 1:
        return found[0]
    if not found:
        msg = (f'{path}: must hold an image of 2 dimensions, got '
               f'{_other_arrays(hdus)}')
        raise ValueError(msg)
    names = ', '.join(label_of(hdus, hdu) for hdu in found)
    msg = (f'{path}: --ext must say which image to take, for there are '
           f'{len(found)}: {names}')
    raise ValueError(msg)


def _other_arrays(hdus):
    """Say what arrays there are that are no images."""
    sizes = [' x '.join(map(str, _axes(hdu))) for hdu in hdus
             if hdu.is_image and _axes(hdu)]
    return f'one of {", ".join(sizes)} pixels' if sizes else 'none'


def _axes(hdu):
    """Return the lengths of the axes of an array."""
    return [hdu.header.get(f'NAXIS{k}')
            for k in range(1, hdu.header.get('NAXIS', 0) + 1)]


def _is_image(hdu):
    """Tell whether it has two axes, besides those of length 1."""
    if not hdu.is_image or hdu.header.get('NAXIS', 0) < _DIMENSIONS:
        return False
    return all(n == 1 for n in _axes(hdu)[_DIMENSIONS:])


def _range(header):
    """Return the bits of a pixel, and its largest value if they are few."""
    bits = header.get('BITPIX')
    if bits not in _LARGEST:
        return bits, None
    scale, zero = map(Cards(header).number, ('BSCALE', 'BZERO'))
    scale = 1.0 if scale is None else scale
    return bits, scale * _LARGEST[bits] + (zero or 0) if scale > 0 else None


def _chosen(path, hdus, images, ext, option='--ext'):
    hdu = chosen_hdu(hdus, images, ext)
    if hdu is None:
        names = ', '.join(label_of(hdus, image) for image in images)
        msg = (f'{path}: {option} must name an image of 2 dimensions '
               f'({names or "there is none"}), got {ext}')
        raise ValueError(msg)
    return hdu


def _plane(path, hdu):
    data = hdu.data
    if (data is None or data.ndim < _DIMENSIONS
            or data.dtype.kind not in 'iuf'):
        msg = f'{path}: must hold an image of 2 dimensions, got {data!r:.80}'
        raise ValueError(msg)
    return _flat(data).astype(float)


def _flat(data):
    """Return an array without its axes of length 1 before the last two."""
    return np.array(data).reshape(data.shape[-_DIMENSIONS:])


def _first(path, hdus, science, names, sources, what):
    """Return the first extension of these names beside the science one."""
    for hdu in hdus:
        if (hdu.name in names and hdu.ver == science.ver
                and hdu is not science and _is_image(hdu)):
            sources[what] = label_of(hdus, hdu)
            return hdu
    return None


def _named(path, hdus, named, sources, what):
    """Return the extension that the user names for errors or flags."""
    if named[what] is None:
        return None
    images = [hdu for hdu in hdus if _is_image(hdu)]
    hdu = _chosen(path, hdus, images, named[what], f'--{what}-ext')
    sources[what] = label_of(hdus, hdu)
    return hdu


def to_error(values, kind):
    """Return standard deviations from 'error', 'variance' or 'weight'."""
    with np.errstate(all='ignore'):
        return _NOISE_OF[kind](np.asarray(values, float))


def _check_shape(path, array, layers, what):
    if array is not None and array.shape != layers.data.shape:
        msg = (f'{path}: {what} must have the shape of the image, '
               f'{layers.data.shape}, got {array.shape}')
        raise ValueError(msg)


def _fits_wcs(hdus, hdu):
    wcs = _gwcs_inside(hdus)
    if wcs is not None:
        return wcs
    # The lists of HDUs have the tables of distortions.
    return wcs_of_header(hdu.header, hdus)


def wcs_of_header(header, hdus=None):
    """
    Return the celestial WCS of a header, None if it has none.

    Raises
    ------
    ValueError
        If its keywords contradict each other.
    """
    try:
        return _celestial(WCS(header, hdus))
    except Exception as error:
        # wcslib has errors of many kinds.
        words = ' '.join(str(error).split()) or type(error).__name__
        msg = f'a WCS that cannot be used: {words}'
        raise _WCSError(msg) from error


def _celestial(wcs):
    """Return the celestial part of a WCS, None if it has none."""
    if not wcs.has_celestial:
        return None
    wcs = wcs if wcs.naxis == 2 else wcs.celestial
    wcs.wcs.set()
    matrix = wcs.pixel_scale_matrix
    if np.linalg.matrix_rank(matrix) < 2:
        msg = f'its matrix must not be singular, got {matrix.tolist()}'
        raise ValueError(msg)
    if not np.isfinite(wcs.all_pix2world([wcs.wcs.crpix], 1)).all():
        msg = 'the reference pixel has no place on the sky'
        raise ValueError(msg)
    return wcs


class _WCSError(ValueError):
    """The keywords of a WCS contradict each other."""


def _gwcs_inside(hdus):
    """Return the gwcs of an ASDF extension, as JWST's files have it."""
    for hdu in hdus:
        if hdu.name == 'ASDF':
            tree = _asdf_tree(BytesIO(hdu.data.tobytes()))
            return find_gwcs(tree)
    return None


def _asdf_tree(file):
    """Return the whole tree of an ASDF file; unknown tags stay plain."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        with open_asdf(file, lazy_load=False, memmap=False) as opened:
            return opened.tree


def find_gwcs(tree):
    """Return the first gwcs in a tree of mappings, or None."""
    from gwcs import WCS as GWCS
    for value in tree.values():
        found = (value if isinstance(value, GWCS)
                 else find_gwcs(value) if isinstance(value, Mapping)
                 else None)
        if found is not None:
            return found
    return None


def read_wcs(path):
    """
    Read the WCS of a file: a gwcs in ASDF, or a FITS header.

    Raises
    ------
    OSError, ValueError
        If there is none.
    """
    path = Path(path)
    if is_asdf(path):
        wcs = find_gwcs(read_asdf_tree(path))
    else:
        with open_fits(path, _IMAGE) as hdus:
            wcs = _first_wcs(hdus)
    if wcs is None:
        msg = f'{path}: must hold a WCS with celestial axes, got none'
        raise ValueError(msg)
    return wcs


def wcs_alone(path):
    """Return the WCS of a file that has no image, None for all others."""
    if is_asdf(path):
        tree = read_asdf_tree(path)
        return None if _branch_with_data(tree) else find_gwcs(tree)
    with open_fits(path, _IMAGE) as hdus:
        alone = not any(hdu.header.get('NAXIS', 0) for hdu in hdus)
        return _first_wcs(hdus) if alone else None


def _first_wcs(hdus):
    found = (_fits_wcs(hdus, hdu) for hdu in hdus if hdu.is_image)
    return next((one for one in found if one is not None), None)


def read_asdf_tree(path):
    """Return the tree of an ASDF file; damage becomes a ValueError."""
    with undamaged(path, 'an undamaged ASDF file'):
        return _asdf_tree(path)


def _read_asdf_alone(path, named):
    """Read an ASDF image, which has no extensions that could be named."""
    if any(named.values()):
        msg = (f'{path}: must be FITS to have the extensions of --error-ext '
               'and --flags-ext, got ASDF')
        raise UnusableFileError(msg)
    return _read_asdf(path)


def _read_asdf(path):
    """Read a file like Roman's: data, err and dq side by side."""
    tree = read_asdf_tree(path)
    branch = _branch_with_data(tree)
    if branch is None:
        msg = f"{path}: must hold an array of 2 dimensions called 'data'"
        raise ValueError(msg)
    sources = {'image': 'data'}
    data, error, flags = (branch.get(name) for name in ('data', 'err', 'dq'))
    for name, value in (('error', error), ('flags', flags)):
        if value is not None:
            sources[name] = {'error': 'err', 'flags': 'dq'}[name]
    meta = branch.get('meta', {})
    layers = Layers(_values(data), None if error is None else _values(error),
                    None if flags is None else np.asarray(flags), None,
                    Cards(_roman_cards(data, meta)), find_gwcs(branch),
                    sources)
    for name in ('error', 'flags'):
        _check_shape(path, getattr(layers, name), layers, name)
    return layers


def _branch_with_data(tree):
    if np.ndim(getattr(tree.get('data'), 'value', tree.get('data'))) == 2:
        return tree
    for value in tree.values():
        found = (_branch_with_data(value) if isinstance(value, Mapping)
                 else None)
        if found is not None:
            return found
    return None


def _values(data):
    return np.array(getattr(data, 'value', data), dtype=float)


def _roman_cards(data, meta):
    """Return the keywords that the metadata of Roman stand for."""
    exposure = meta.get('exposure', {})
    cards = {'TELESCOP': meta.get('telescope'),
             'EXPTIME': exposure.get('exposure_time'),
             'DATE-AVG': _isot(exposure.get('mid_time')),
             'DATE-BEG': _isot(exposure.get('start_time')),
             'DATE-END': _isot(exposure.get('end_time'))}
    unit = getattr(data, 'unit', None) or meta.get('bunit')
    if unit is None and str(cards['TELESCOP']).upper() == 'ROMAN':
        unit = 'DN / s'
    cards['BUNIT'] = None if unit is None else str(unit)
    return cards


def _isot(time):
    return time.utc.isot if isinstance(time, Time) else time


def _with_companions(path, layers, given):
    """Add errors and flags from files of their own."""
    have = {'error' if layers.error is not None else None,
            'flags' if layers.flags is not None else None}
    found = dict(given)
    for kind, file in _companions(path).items():
        role = 'flags' if kind == 'flags' else 'error'
        taken = {_role(other) for other in found}
        if role not in have and role not in taken:
            found[kind] = file
    for kind, file in found.items():
        layers = _add_companion(layers, kind, file)
    return layers


def _role(kind):
    return 'flags' if kind == 'flags' else 'error'


def _companions(path):
    """Return the files beside an image that say by name what they are."""
    stem, suffix = path.name, ''.join(path.suffixes[-2:])
    suffix = suffix if suffix.endswith(_PACKED) else path.suffix
    stem = stem.removesuffix(suffix)
    for own in _OWN_ENDINGS:
        stem = stem.removesuffix(own)
    found = {}
    for ending, kind in _BESIDE.items():
        file = path.with_name(f'{stem}_{ending}{suffix}')
        if kind not in found and file != path and file.exists():
            found[kind] = file
    return found


def _add_companion(layers, kind, file):
    with open_fits(file, _IMAGE) as hdus:
        images = [hdu for hdu in hdus if _is_image(hdu)]
        if len(images) != 1:
            msg = f'{file}: must hold one image, got {len(images)}'
            raise ValueError(msg)
        values = (_flat(images[0].data) if kind == 'flags'
                  else _plane(file, images[0]))
    _check_shape(file, values, layers, kind)
    sources = {**layers.sources, _role(kind): file.name}
    if kind == 'flags':
        return replace(layers, flags=values, sources=sources)
    return replace(layers, error=to_error(values, kind), sources=sources)
