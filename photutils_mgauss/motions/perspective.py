"""
Stars of known radial velocity: their motion and parallax change with time.

While a fit iterates, what such stars move beyond the model of constant
motions is taken from their detections, with the motions and parallaxes found
so far.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.sky.space_motion import swerve


@dataclass(frozen=True, eq=False)
class Nearing:
    """
    The k stars whose approach or recession is known.

    ``stars`` (k,) are their sorted numbers, ``velocity`` (k,) their radial
    velocities [km/s], ``error`` (k,) those of these, 0 where they are not
    given, ``parallax`` (k,) what is known of their parallaxes beforehand
    [mas], 0 where that is nothing.
    """

    stars: np.ndarray
    velocity: np.ndarray
    error: np.ndarray
    parallax: np.ndarray

    def values(self, which, found, origin):
        """
        Return positions, motions and parallaxes (5, k) of some of them.

        Parameters
        ----------
        which : (k,) int `~numpy.ndarray`
            Of the stars here.
        found : (4 or 5, k) `~numpy.ndarray`
            Their fitted parameters; parallaxes that are not fitted are those
            known beforehand.
        origin : (2, k) `~numpy.ndarray`
            What fitted positions are relative to.
        """
        out = np.empty((5, len(which)))
        out[4] = self.parallax[which]
        out[:len(found)] = found
        out[:2] += origin
        return out


def swerved(setup, before, found):
    """
    Return what nearing stars move beyond the model now, (2, E, k).

    ``found`` (p, k) are their latest parameters; stars without a solution
    move as ``before``.
    """
    nearing, stars = setup.nearing, setup.nearing.stars
    dt, observer = setup.dt, setup.sightings.observer
    if dt.shape[1] > 1:
        dt = dt[:, stars]
    if observer is not None and observer.shape[2] > 1:
        observer = observer[..., stars]
    size = 5 if setup.options.parallax else 4
    origin = setup.origin[:, stars]
    values = nearing.values(np.arange(len(stars)), found[:size], origin)
    out = swerve(values, nearing.velocity, dt, origin, setup.sightings.plane,
                 observer)
    return np.where(np.isfinite(out).all(axis=(0, 1)), out, before)
