"""
ASDF files of any origin, opened with their structure checked.

asdf allocates what the headers of blocks announce, so their sizes are
compared with the length of the file first.
"""
import mmap
import struct
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

__all__ = ['is_asdf', 'open_asdf']

_START = b'#ASDF'
_BLOCK = b'\xd3BLK'
_STREAMED = 1

# Of a block's header: its own length, then flags, compression, and the sizes
# allocated, used, and of the data out of its compression [byte].
_LENGTH = struct.Struct('>H')
_SIZES = struct.Struct('>I4sQQQ')

# Data that shrink by more when they are compressed are damage.
_LARGEST_GAIN = 10_000


def is_asdf(path):
    """Whether a file says that it is an ASDF file."""
    with Path(path).open('rb') as file:
        return file.read(len(_START)) == _START


@contextmanager
def open_asdf(file, **kwargs):
    """
    Open an ASDF file whose blocks have the sizes they say.

    Parameters
    ----------
    file : str, path-like or file-like
        The file.
    **kwargs
        Of ``asdf.open``.

    Yields
    ------
    ``asdf.AsdfFile``

    Raises
    ------
    OSError
        If the file cannot be opened, or a block is longer than the file.
    """
    import asdf
    if hasattr(file, 'read'):
        # asdf bypasses the buffer of files that others have looked into.
        content = file.read()
        _check_blocks(content)
        file = BytesIO(content)
    else:
        with Path(file).open('rb') as stream, mmap.mmap(
                stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
            _check_blocks(content)
    with asdf.open(file, validate_checksums=True, **kwargs) as opened:
        yield opened


def _check_blocks(content):
    """Raise unless all blocks end within the file."""
    where = content.find(_BLOCK)
    while where >= 0 and content[where:where + len(_BLOCK)] == _BLOCK:
        where += len(_BLOCK)
        if where + _LENGTH.size + _SIZES.size > len(content):
            msg = 'a block that is truncated'
            raise OSError(msg)
        length, = _LENGTH.unpack_from(content, where)
        where += _LENGTH.size
        flags, packed, allocated, used, size = _SIZES.unpack_from(content,
                                                                  where)
        if flags & _STREAMED:
            return
        where += length + allocated
        most = (used if packed == bytes(4)
                else _LARGEST_GAIN * max(used, 1000))
        if used > allocated or where > len(content) or size > most:
            msg = (f'a block of {size} bytes of data, {used} of '
                   f'{allocated} used, in a file of {len(content)}')
            raise OSError(msg)
