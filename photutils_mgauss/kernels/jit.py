"""How the loops are compiled: the only module that names numba."""
from numba import njit

kernel = njit(cache=True, nogil=True, error_model='numpy')
