"""What is to be solved: aligned positions of stars, and the model for them."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss.motions.priors import Priors

CHUNK = 8192  # stars worked on at a time: what fits into a processor's cache


@dataclass(frozen=True, eq=False)
class MotionProblem:
    """
    Aligned positions of n stars at E epochs, and the model for them.

    Parameters
    ----------
    offsets : (2, E, n) `~numpy.ndarray`
        Aligned positions minus ``origin``; 0 where there are none.
    weights : (3, E, n) `~numpy.ndarray`
        Elements xx, xy, yy of the inverse covariances; 0 where unused.
    origin : (2, n) `~numpy.ndarray`
        Mean places of the stars.
    dt : (E, 1) or (E, n) `~numpy.ndarray`
        Times since the working epoch [yr].
    observer : (3, E, 1) or (3, E, n) `~numpy.ndarray` or None
        Barycentric places of the observer [au], None without parallax.
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane` or None
    transform : `~photutils_mgauss.sky.transforms.Transform`
    priors : `Priors`
    acceleration : bool
    ties : (n,) bool `~numpy.ndarray`
        The stars that take part in finding the frames.
    jerk : bool, optional
        Whether accelerations change; only with ``acceleration``.
    """

    offsets: np.ndarray
    weights: np.ndarray
    origin: np.ndarray
    dt: np.ndarray
    observer: np.ndarray | None
    plane: object
    transform: object
    priors: Priors
    acceleration: bool
    ties: np.ndarray
    jerk: bool = False

    @property
    def n_parameters(self):
        """Number of parameters of a star."""
        return (4 + (self.observer is not None) + 2 * self.acceleration
                + 2 * self.jerk)

    @property
    def n_stars(self):
        """Number of stars."""
        return self.origin.shape[1]

    @property
    def n_epochs(self):
        """Number of epochs."""
        return self.offsets.shape[1]

    @property
    def ranks(self):
        """Number of parameters of each star known beforehand, (n,)."""
        out = np.zeros(self.n_stars, dtype=int)
        out[self.priors.stars] = self.priors.rank
        return out

    @property
    def unbound(self):
        """The same, had nothing been known of the stars beforehand."""
        return replace(self, priors=Priors.none(self.n_parameters))

    def part(self, start, stop):
        """Return the problem of stars start <= i < stop alone."""
        return self._of(slice(start, stop), self.priors.between(start, stop))

    def select(self, stars):
        """Return the problem of the given stars alone."""
        stars = np.asarray(stars)
        place = np.full(self.n_stars, -1)
        place[stars] = np.arange(len(stars))
        found = place[self.priors.stars]
        which = np.argsort(found)[np.sum(found < 0):]
        return self._of(stars, self.priors.pick(which, found[which]))

    def _of(self, stars, priors):
        observer = self.observer
        if observer is not None and observer.shape[2] > 1:
            observer = observer[..., stars]
        return replace(
            self, offsets=self.offsets[..., stars],
            weights=self.weights[..., stars], origin=self.origin[:, stars],
            dt=self.dt[:, stars] if self.dt.shape[1] > 1 else self.dt,
            observer=observer, priors=priors, ties=self.ties[stars])

    def columns(self):
        """
        Return the design matrix D as p pairs of its x and y row.

        Each is (E, 1) or (E, n); None stands for zeros.
        """
        one = np.ones((self.n_epochs, 1))
        columns = [(one, None), (None, one), (self.dt, None),
                   (None, self.dt)]
        if self.observer is not None:
            columns.append(tuple(self.plane.parallax_factors(
                self.origin[:, None, :], self.observer)))
        if self.acceleration:
            half = self.dt**2 / 2
            columns += [(half, None), (None, half)]
        if self.jerk:
            sixth = self.dt**3 / 6
            columns += [(sixth, None), (None, sixth)]
        return columns


def parts(problem):
    """Yield a problem in parts that fit into a processor's cache."""
    for start in range(0, problem.n_stars, CHUNK):
        yield problem.part(start, min(start + CHUNK, problem.n_stars))
