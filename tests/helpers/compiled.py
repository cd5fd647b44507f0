"""Inner functions of kernels, called from Python."""
from numba import njit

from photutils_mgauss.kernels import jit


def compiled(function):
    """Return what calls a function that only kernels can call."""
    @njit(pipeline_class=jit._KernelCompiler)
    def call(*arguments):
        return function(*arguments)

    return call
