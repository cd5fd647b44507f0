"""
FITS files of any origin, opened with their structure checked.

astropy believes what headers say: it loops over a billion axes, allocates
what is announced, and only warns of what is missing. So the sizes of all
extensions are read here first and compared with the length of the file.
"""
import bz2
import gzip
import lzma
import re
import warnings
import zipfile
from contextlib import contextmanager
from io import BytesIO
from math import ceil, prod
from os import PathLike
from pathlib import Path

from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from photutils_mgauss.files.damage import UnusableFileError, undamaged

__all__ = ['chosen_hdu', 'label_of', 'name_of', 'open_fits', 'read_chosen']

_BLOCK = 2880
_MOST_FIELDS = _MOST_AXES = 999
_MOST_EXTENSIONS = 100_000

# A compressed image of one number shrinks by about this; more is damage.
_LARGEST_GAIN = 10_000

_BYTES = {'L': 1, 'B': 1, 'A': 1, 'I': 2, 'J': 4, 'E': 4, 'K': 8, 'D': 8,
          'C': 8, 'M': 16, 'P': 8, 'Q': 16}
_TFORM = re.compile(r"'\s*(\d*)([LXBIJKAEDCMPQ])")
_INTEGER = re.compile(r'\s*([+-]?\d+)(?:\.0*)?\s*(/|$)')

# The largest order of the polynomials of a distortion, and number of axes of
# a WCS, that are believed: astropy loops over them.
_LIMITS = {'WCSAXES': 20, 'A_ORDER': 20, 'B_ORDER': 20, 'AP_ORDER': 20,
           'BP_ORDER': 20}


@contextmanager
def open_fits(file, what='an undamaged FITS file', *, checksum=False):
    """
    Open a FITS file whose structure is sound.

    Whatever goes wrong in the body of the ``with`` statement is an error
    that names the file, see `undamaged`.

    Parameters
    ----------
    file : str, path-like or file-like
        The file, which may be compressed.
    what : str, optional
        What the file must be, for the message.
    checksum : bool, optional
        Whether wrong checksums are errors.

    Yields
    ------
    `~astropy.io.fits.HDUList`
        All headers are read. Bytes after the last extension are left out.
    """
    with undamaged(name_of(file), what), warnings.catch_warnings():
        # Of what is unusual in headers astropy warns at length.
        warnings.simplefilter('ignore', AstropyWarning)
        if checksum:
            warnings.filterwarnings('error', '(?i).*(checksum|datasum)')
        with _opened(file) as stream, fits.open(
                _checked(stream), memmap=False, checksum=checksum) as hdus:
            len(hdus)  # reads all headers
            yield hdus


def name_of(file):
    """Return the name of a file, open or not."""
    if hasattr(file, 'read'):
        file = getattr(file, 'name', 'file')
    return file if isinstance(file, str | PathLike) else 'file'


@contextmanager
def _opened(file):
    """Give the content of a file, out of its compression, as a stream."""
    if hasattr(file, 'read'):
        with _unpacked(BytesIO(file.read())) as stream:
            yield stream
        return
    with Path(file).open('rb') as stream, _unpacked(stream) as plain:
        yield plain


@contextmanager
def _unpacked(stream):
    start = stream.read(4)
    stream.seek(0)
    for mark, unpack in ((b'\x1f\x8b', gzip.open), (b'BZh', bz2.open),
                         (b'\xfd7zX', lzma.open), (b'PK\x03\x04', _zipped)):
        if start.startswith(mark):
            with unpack(stream) as packed:
                yield BytesIO(packed.read())
            return
    yield stream


def _zipped(stream):
    archive = zipfile.ZipFile(stream)
    return archive.open(archive.namelist()[0])


def _checked(stream):
    """Return the stream, or as much of it as belongs to extensions."""
    size = stream.seek(0, 2)
    end = where = 0
    for number in range(_MOST_EXTENSIONS):
        stream.seek(where)
        block = stream.read(_BLOCK)
        if number and not block.startswith(b'XTENSION'):
            _check_rest(block)
            break
        header = _Cards(stream, block)
        end = stream.tell() + header.data_size(number)
        if end > size:
            msg = (f'a file that is truncated: extension {number} ends at '
                   f'byte {end}, the file at {size}')
            raise OSError(msg)
        where = ceil(end / _BLOCK) * _BLOCK
    stream.seek(0)
    return stream if where >= size else BytesIO(stream.read(where))


def _check_rest(block):
    """Raise if what follows the last extension was an extension."""
    if b'BITPIX' in block and b'NAXIS' in block:
        msg = 'an extension whose header does not begin with XTENSION'
        raise OSError(msg)


class _Cards:
    """The numbers in a header that tell how long its extension is."""

    def __init__(self, stream, block):
        if not block.startswith((b'SIMPLE  =', b'XTENSION=')):
            msg = 'a file that does not begin as FITS files do'
            raise OSError(msg)
        self._values = {}
        while not self._take(block):
            block = stream.read(_BLOCK)
            if len(block) < 80:
                msg = 'a header without END'
                raise OSError(msg)

    def _take(self, block):
        """Note down the cards of a block; tell whether END was there."""
        text = block.decode('latin-1')
        for at in range(0, len(text), 80):
            card = text[at:at + 80]
            key = card[:8].strip().upper()
            if key == 'END':
                return True
            if card[8:9] == '=':
                self._values.setdefault(key, card[9:])
        return False

    def number(self, key, lowest, highest, default=None):
        """Return a whole number within limits."""
        text = self._values.get(key, default)
        match = _INTEGER.match(str(text))
        if match is None or not lowest <= int(match.group(1)) <= highest:
            shown = 'nothing' if text is None else str(text).strip()[:30]
            msg = (f'{key} = {shown}, which must be a number from {lowest} '
                   f'to {highest}')
            raise OSError(msg)
        return int(match.group(1))

    def _text(self, key):
        return self._values.get(key, '').strip()

    def data_size(self, number):
        """Return the bytes of the data [byte]."""
        most = 2**63
        n_axes = self.number('NAXIS', 0, _MOST_AXES)
        shape = [self.number(f'NAXIS{i}', 0, most)
                 for i in range(1, n_axes + 1)]
        width = self._width()
        for key, limit in _LIMITS.items():
            self.number(key, 0, limit, default=0)
        parameters = self.number('PCOUNT', 0, most, default=0)
        groups = self.number('GCOUNT', 1, most, default=1)
        if shape and shape[0] == 0 and self._text('GROUPS')[:1] == 'T':
            shape = shape[1:]
        elif not number:
            parameters, groups = 0, 1
        size = width * groups * (parameters + prod(shape) * (n_axes > 0))
        if self._text('XTENSION')[1:9] == 'BINTABLE':
            self._check_table(shape, size)
        elif self._text('XTENSION')[1:6] == 'TABLE':
            self.number('TFIELDS', 0, _MOST_FIELDS)
        return size

    def _width(self):
        """Return the bytes of a number."""
        bits = self.number('BITPIX', -64, 64)
        if bits not in (8, 16, 32, 64, -32, -64):
            msg = f'BITPIX = {bits}, which must be 8, 16, 32, 64, -32 or -64'
            raise OSError(msg)
        return abs(bits) // 8

    def _check_table(self, shape, size):
        """Raise unless the columns of a table make up its rows."""
        n_fields = self.number('TFIELDS', 0, _MOST_FIELDS)
        columns = [self._column(f'TFORM{i}') for i in range(1, n_fields + 1)]
        if len(shape) != 2 or sum(columns) != shape[0]:
            msg = (f'a table whose columns have {sum(columns)} bytes, but '
                   f'NAXIS1 = {shape[:1]}')
            raise OSError(msg)
        if self._text('ZIMAGE')[:1] == 'T':
            self._check_image(size)

    def _column(self, key):
        match = _TFORM.match(self._text(key))
        if match is None:
            msg = f'{key} = {self._text(key)[:30]}, which is no format'
            raise OSError(msg)
        repeat, letter = match.groups()
        count = int(repeat or 1)
        return (count + 7) // 8 if letter == 'X' else count * _BYTES[letter]

    def _check_image(self, size):
        """Raise if a compressed image would be too large to be true."""
        n_axes = self.number('ZNAXIS', 1, _MOST_AXES)
        shape = [self.number(f'ZNAXIS{i}', 0, 2**63)
                 for i in range(1, n_axes + 1)]
        if prod(shape) > _LARGEST_GAIN * max(size, _BLOCK):
            msg = f'a compressed image of {shape} pixels in {size} bytes'
            raise OSError(msg)


def label_of(hdus, hdu):
    """Return what to call an extension: a name, 'name,version' or number."""
    alike = [other for other in hdus if other.name == hdu.name]
    if not hdu.name or hdu.name == 'PRIMARY':
        return str(hdus.index(hdu))
    if len(alike) == 1:
        return hdu.name
    if sum(other.ver == hdu.ver for other in alike) == 1:
        return f'{hdu.name},{hdu.ver}'
    return str(hdus.index(hdu))


def chosen_hdu(hdus, candidates, ext):
    """
    Return the candidate that a user's words mean, None unless it is one.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        All extensions.
    candidates : list of HDU
        Those that can be chosen.
    ext : int, str or (str, int) tuple
        A number, a name, 'name,version', or name and version.
    """
    if isinstance(ext, tuple):
        ext = ','.join(map(str, ext))
    name, _, version = str(ext).strip().upper().partition(',')
    found = [one for one in candidates
             if (str(hdus.index(one)) if name.isdigit()
                 else one.name.upper()) == name
             and version in ('', str(one.ver))]
    return found[0] if len(found) == 1 else None


def read_chosen(name, hdus, candidates, ext, read):
    """
    Read the one of several extensions that the user chose.

    Parameters
    ----------
    name : str or path-like
        The name of the file.
    hdus : `~astropy.io.fits.HDUList`
        All extensions.
    candidates : list of HDU
        Those that can be read, at least one.
    ext : int, str, (str, int) tuple or None
        The user's choice; ``'all'`` for all of them, and None where there is
        one only.
    read : callable
        From an extension to what is in it.

    Returns
    -------
    object or dict of them
        A dict by what ``ext`` takes, for ``'all'``.

    Raises
    ------
    UnusableFileError
        If the choice is not made, or means none of them.
    """
    if isinstance(ext, str) and ext.lower() == 'all':
        return {_key_of(hdus, hdu): read(hdu) for hdu in candidates}
    if ext is None and len(candidates) == 1:
        return read(candidates[0])
    hdu = None if ext is None else chosen_hdu(hdus, candidates, ext)
    if hdu is None:
        labels = ', '.join(_described(hdus, one) for one in candidates)
        msg = (f'{name}: ext (--ext) must be one of the {len(candidates)} '
               f"PSFs in this file, {labels}, or 'all', got {ext}")
        raise UnusableFileError(msg)
    return read(hdu)


def _key_of(hdus, hdu):
    label = label_of(hdus, hdu)
    return int(label) if label.isdigit() else label


def _described(hdus, hdu):
    """Return what to call an extension, with its name where there is one."""
    label = label_of(hdus, hdu)
    return f'{label} ({hdu.name})' if label.isdigit() and hdu.name else label
