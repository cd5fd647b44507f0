"""Inner functions of kernels, called from Python."""
from numba import njit


def compiled(function):
    """Return what calls a function that only kernels can call."""
    @njit
    def call(*arguments):
        return function(*arguments)

    return call
