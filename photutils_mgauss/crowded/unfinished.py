"""What is raised when not all of an image could be solved."""


class UnfinishedTilesError(RuntimeError):
    """
    Raised when some tiles of an image could not be solved.

    Parameters
    ----------
    unfinished : list of (y_low, y_high, x_low, x_high) tuple of int
        The parts of the image, in pixels, without a result.
    table : `~astropy.table.QTable`
        The stars of the tiles that were finished.

    Examples
    --------
    Take what there is, and solve the rest again:

    >>> import numpy as np
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> from photutils_mgauss import (CrowdedMixturePhotometry,
    ...                               GaussianMixture, GriddedMixturePSF,
    ...                               UnfinishedTilesError)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[0.7, 0], [0, 0.8]]])
    >>> psf = GriddedMixturePSF([mixture], [(0, 0)])
    >>> pool = ThreadPoolExecutor()
    >>> pool.shutdown()  # all of its workers are gone
    >>> phot = CrowdedMixturePhotometry(psf, executor=pool)
    >>> try:
    ...     table = phot(np.ones((40, 50)), error=np.ones((40, 50)))
    ... except UnfinishedTilesError as error:
    ...     table, left = error.table, error.unfinished
    >>> left
    [(0, 40, 0, 50)]
    >>> len(table)
    0
    """

    def __init__(self, unfinished, table):
        self.unfinished = unfinished
        self.table = table
        super().__init__(unfinished, table)

    def __str__(self):
        n, why = len(self.unfinished), self.__cause__
        what = 'tile was' if n == 1 else 'tiles were'
        first = '' if why is None else (
            f'; the first ended with {type(why).__name__}: {why}')
        return (f'{n} {what} not finished, at (y_low, y_high, x_low, x_high) '
                f'= {self.unfinished}{first}; the stars of the others are in '
                'the attribute table')
