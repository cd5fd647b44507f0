"""Files that are written whole or not at all."""
import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

__all__ = ['whole_file']


@contextmanager
def whole_file(path, *, overwrite=True):
    """
    Give a name to write to; the file gets its own name once it is whole.

    The draft stands in the same folder and has the same suffixes. Whatever
    goes wrong, nothing is left of it, and an older file stays as it was.

    Parameters
    ----------
    path : str or path-like
        The file to write.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Raises
    ------
    FileExistsError
        If the file exists and ``overwrite`` is not set.
    """
    # The file a link leads to is replaced, not the link.
    path = Path(os.path.realpath(path))
    _check_free(path, overwrite)
    if path.exists() and not path.is_file():
        # A device or a pipe cannot be replaced.
        yield path
        return
    # Not longer than a name may be, but with the suffixes.
    draft = path.with_name(f'.{uuid4().hex}.{path.name[-80:]}')
    try:
        yield draft
        if path.exists():
            _check_free(path, overwrite)
            shutil.copymode(path, draft)
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def _check_free(path, overwrite):
    if path.exists() and not overwrite:
        msg = f'{path} exists; give overwrite=True to replace it'
        raise FileExistsError(msg)
