"""
Finished pieces of long work, kept in a folder until all of it is done.

A piece is known by everything that it depends on, so that nothing is ever
taken for the piece of another image, PSF or setting. What is kept are plain
arrays; nothing is pickled.
"""
import hashlib
import os
import tempfile
import warnings
from contextlib import suppress
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import __version__


def digest_of(*things):
    """
    Return what stands for these things, and for no others.

    Parameters
    ----------
    *things
        Numbers, strings, arrays, and lists, dicts, dataclasses and plain
        objects of them.

    Returns
    -------
    str
    """
    digest = hashlib.blake2b(digest_size=16)
    for thing in (__version__, *things):
        _feed(digest, thing)
    return digest.hexdigest()


def _feed(digest, thing):
    if isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        digest.update(f'{thing.dtype.str}{thing.shape}'.encode())
        digest.update(np.ascontiguousarray(thing).view(np.uint8).data
                      if thing.size else b'')
    elif isinstance(thing, (list, tuple, np.ndarray)):
        digest.update(f'({len(thing)}'.encode())
        for one in thing:
            _feed(digest, one)
    elif isinstance(thing, dict):
        _feed(digest, list(thing.items()))
    elif is_dataclass(thing):
        _feed(digest, [type(thing).__name__,
                       *(getattr(thing, one.name) for one in fields(thing))])
    elif hasattr(thing, '__dict__') and not isinstance(thing, type):
        _feed(digest, [type(thing).__name__, vars(thing)])
    else:
        digest.update(f'{type(thing).__name__} {thing!r};'.encode())


class Checkpoint:
    """
    A folder of finished pieces.

    Parameters
    ----------
    folder : str or path-like or None
        It is made when there is something to keep; with None nothing is
        kept.

    Raises
    ------
    TypeError, ValueError
        If it cannot be a folder.
    """

    def __init__(self, folder):
        if folder is not None and not isinstance(folder, (str, os.PathLike)):
            msg = f'checkpoint must be the name of a folder, got {folder!r}'
            raise TypeError(msg)
        if folder is not None and not os.fspath(folder).strip():
            msg = 'checkpoint must be the name of a folder, got none'
            raise ValueError(msg)
        self.folder = None if folder is None else Path(folder)
        if self.folder and self.folder.exists() and not self.folder.is_dir():
            msg = f'checkpoint must be a folder, but {folder} is a file'
            raise ValueError(msg)

    def __bool__(self):
        return self.folder is not None

    def load(self, key):
        """Return the arrays of a piece, a dict, or None if it is not here."""
        path = self.folder / f'{key}.npz'
        try:
            with (path.open('rb') as file,
                  np.load(file, allow_pickle=False) as kept):
                return dict(kept)
        except FileNotFoundError:
            return None
        except Exception as error:  # noqa: BLE001 zipfile raises anything
            warnings.warn(f'{path} cannot be read and is made again, got: '
                          f'{error}', AstropyUserWarning, stacklevel=2)
            return None

    def save(self, key, arrays):
        """Keep the arrays of a piece; it is there whole or not at all."""
        self.folder.mkdir(parents=True, exist_ok=True)
        handle, draft = tempfile.mkstemp('.draft', f'{key}-', self.folder)
        try:
            with os.fdopen(handle, 'wb') as file:
                np.savez(file, **arrays)
            Path(draft).replace(self.folder / f'{key}.npz')
        finally:
            with suppress(FileNotFoundError):
                Path(draft).unlink()
