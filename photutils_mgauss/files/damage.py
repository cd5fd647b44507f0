"""One kind of error for all that can be wrong with a file."""
from contextlib import contextmanager

__all__ = ['UnusableFileError', 'undamaged']


class UnusableFileError(ValueError):
    """A file is not what it must be; the message begins with its name."""


@contextmanager
def undamaged(path, what='undamaged'):
    """
    Turn whatever goes wrong with a file into a `UnusableFileError`.

    The libraries that read files raise almost anything for damaged ones.
    Errors that name the file already stay what they are.

    Parameters
    ----------
    path : str or path-like
        The name of the file, for the message.
    what : str, optional
        What the file must be.

    Raises
    ------
    UnusableFileError
        For every error but those of a file that cannot be opened.
    """
    try:
        yield
    except Exception as error:
        if _names_the_file(error, path):
            raise
        words = ' '.join(str(error).split()) or type(error).__name__
        msg = f'{path}: must be {what}, got {words:.300}'
        raise UnusableFileError(msg) from error


def _names_the_file(error, path):
    if isinstance(error, OSError):
        return error.filename is not None
    return isinstance(error, UnusableFileError) or (
        isinstance(error, ValueError) and str(path) in str(error))
