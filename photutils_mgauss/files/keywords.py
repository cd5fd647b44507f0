"""Keywords of a header, of which missing and wrong ones are errors."""
import numpy as np

from photutils_mgauss.files.damage import UnusableFileError

__all__ = ['Keywords']

# No PSF has larger images, or more of them.
_LARGEST = 100_000


class Keywords:
    """
    A header whose missing and wrong cards are errors that name the file.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        The keywords and values.
    path : str or path-like
        The file.
    what : str
        What the file must be.
    """

    def __init__(self, header, path, what):
        self._header = header
        self._path = path
        self._what = what

    def __contains__(self, key):
        return key in self._header

    def __iter__(self):
        return iter(self._header)

    def fail(self, problem):
        """Raise an error."""
        msg = f'{self._path}: must be {self._what}, got: {problem}'
        raise UnusableFileError(msg)

    def number(self, key, default=None):
        """Return a finite number."""
        value = self._header.get(key, default)
        if value is None:
            self.fail(f'the keyword {key} is missing')
        if (not isinstance(value, (int, float)) or isinstance(value, bool)
                or not np.isfinite(value)):
            self.fail(f'{key} must be a number, got {value!r}')
        return value

    def count(self, key, default=None, *, lowest=0):
        """Return a whole number that is not absurd."""
        value = self.number(key, default)
        if value != int(value) or not lowest <= value <= _LARGEST:
            self.fail(f'{key} must be a whole number from {lowest} to '
                      f'{_LARGEST}, got {value}')
        return int(value)

    def text(self, key):
        """Return a string."""
        value = self._header.get(key)
        if not isinstance(value, str):
            self.fail(f'the keyword {key} is missing')
        return value.strip()
