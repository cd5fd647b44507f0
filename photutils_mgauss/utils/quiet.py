"""Warnings of other packages about what is not done with them here."""
import warnings
from contextlib import contextmanager


@contextmanager
def without_warnings(beginning):
    """
    Leave out the warnings that begin with some words.

    Parameters
    ----------
    beginning : str
        The words, as a regular expression.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings('ignore', beginning)
        yield
