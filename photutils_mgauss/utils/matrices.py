"""Matrices whose rows have different units."""
import numpy as np


def with_unit_diagonal(matrix):
    """
    Return a symmetric matrix without its units, and its units.

    What is small beside what depends on the unit of an image where fluxes
    stand beside positions.

    Parameters
    ----------
    matrix : (n, n) `~numpy.ndarray`
        With a diagonal that is not negative.

    Returns
    -------
    scaled : (n, n) `~numpy.ndarray`
        The matrix over the product of the scales of rows and columns.
    scale : (n,) `~numpy.ndarray`
        The square roots of the diagonal, 1 where it is 0.
    """
    root = np.sqrt(np.diagonal(matrix))
    scale = np.where(root > 0, root, 1)
    return matrix / scale / scale[:, None], scale
