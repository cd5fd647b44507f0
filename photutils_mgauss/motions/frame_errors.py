"""What is known of the errors of frames, also as a table to be kept."""
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from photutils_mgauss.sky.tangent_plane import TangentPlane
from photutils_mgauss.sky.transforms import Transform
from photutils_mgauss.utils.star_columns import check_table

# The columns of the table, of which those of all epochs are the same.
_PLANE = 'plane_ra', 'plane_dec'
_BASIS = 'degree', 'centre', 'scale'
# Epochs are told apart by their times to this much [yr].
_SAME_TIME = 1e-5


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """
    The errors of the frames of a `MotionSolution` on the sky.

    Attributes
    ----------
    years : (E,) `~numpy.ndarray`
        The times of the epochs [Julian years].
    factor : (E, 2, b, q) `~numpy.ndarray`
        The covariance of all coefficients of the maps is the product of this
        with itself over the last axis [mas^2].
    plane : TangentPlane
    transform : Transform
        The basis of the maps in the plane.
    relative : bool
        Whether motions are only known relative to one another.
    """

    years: np.ndarray
    factor: np.ndarray
    plane: TangentPlane
    transform: Transform
    relative: bool

    @classmethod
    def of(cls, solution):
        """Return those of a solution, which must be on the sky."""
        fit = solution._fit
        if fit.setup.sightings.plane is None:
            msg = ('references must be a MotionSolution on the sky, got a '
                   'plane')
            raise ValueError(msg)
        factor, n = fit.frames.factor, len(solution.epochs)
        if not factor.shape[1]:  # nothing is free
            factor = np.zeros((len(factor), 1))
        return cls(np.array([epoch.mean_year for epoch in solution.epochs]),
                   factor.reshape(n, 2, -1, factor.shape[1]),
                   fit.setup.sightings.plane, fit.setup.transform,
                   bool(fit.setup.relative))

    def epochs_at(self, years):
        """Return the numbers of the epochs (E,) at which images were taken."""
        found = []
        for k, year in enumerate(years):
            away = np.abs(self.years - year)
            e = int(np.argmin(away))
            if len(self.years) == len(years) and away[k] == away[e]:
                e = k
            if away[e] > _SAME_TIME:
                msg = ('references must be a MotionSolution of the epochs of '
                       f'the images, got none at {year:.6f}, the time of '
                       f'image {k}')
                raise ValueError(msg)
            found.append(e)
        return found

    def moves(self, epoch, place):
        """
        Return how far places in the plane (2, n) move (n, 2, q) [mas].

        By each of the q independent errors of standard deviation 1.
        """
        basis = np.nan_to_num(self.transform.basis(place))
        return np.einsum('xbq,bn->nxq', self.factor[epoch], basis)

    def to_table(self):
        """Return them as a table, one row for each epoch."""
        n, plane, transform = len(self.years), self.plane, self.transform
        table = QTable({'epoch': np.arange(n), 'year': self.years})
        for name, value in zip(
                (*_PLANE, *_BASIS, 'relative'),
                (plane.ra, plane.dec, transform.degree, transform.centre,
                 transform.scale, self.relative), strict=True):
            table[name] = np.array([value] * n)
        table['factor'] = self.factor
        return table

    @classmethod
    def from_table(cls, table):
        """Return those of a table that `to_table` made."""
        check_table(table, 'frame errors', (
            'factor', 'relative', 'year', *_PLANE, *_BASIS))
        ra, dec, degree, centre, scale = (
            np.asarray(table[name])[0] for name in (*_PLANE, *_BASIS))
        # The basis is that of all kinds of maps of a degree.
        return cls(np.asarray(table['year'], float),
                   np.asarray(table['factor'], float),
                   TangentPlane(float(ra), float(dec)),
                   Transform('polynomial', int(degree),
                             tuple(map(float, centre)), float(scale)),
                   bool(np.asarray(table['relative'])[0]))
