"""
Stars of known radial velocity: their motion and parallax change with time.

While a fit iterates, what they move beyond a straight line is taken from
their detections, with the motions and parallaxes found so far.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.motions.references import carried
from photutils_mgauss.sky.space_motion import beyond_straight


@dataclass(frozen=True, eq=False)
class Nearing:
    """
    The k stars whose approach or recession is known.

    ``stars`` (k,) are their numbers, ``velocity`` (k,) their radial
    velocities [km/s], ``parallax`` (k,) what is known of their parallaxes
    beforehand [mas], 0 where that is nothing.
    """

    stars: np.ndarray
    velocity: np.ndarray
    parallax: np.ndarray

    @classmethod
    def none(cls):
        """Return no stars at all."""
        return cls(np.empty(0, dtype=int), np.empty(0), np.empty(0))


def nearing_stars(sightings, options):
    """
    Return the `Nearing` stars, and a sentence on those that are left out.

    Without a parallax a radial velocity says nothing about a motion, and
    the recipe of the paper knows of neither.
    """
    known = np.isfinite(sightings.radial_velocity)
    if options.recipe == 'paper' or sightings.unit != 'mas':
        return Nearing.none(), ()
    parallax = np.full(len(known), np.nan)
    parallax[sightings.references] = sightings.catalogue.values[4]
    use = known & (np.isfinite(parallax) | bool(options.parallax))
    left, notes = np.sum(known & ~use), ()
    if left:
        notes = (f'The radial velocity of {left} '
                 f'{"star is" if left == 1 else "stars are"} not used, '
                 'because the parallax is not known: give references with '
                 'parallaxes, or fit them.',)
    stars = np.flatnonzero(use)
    return Nearing(stars, sightings.radial_velocity[stars],
                   np.nan_to_num(parallax[stars])), notes


def first_values(nearing, sightings, origin, working_year):
    """
    Return position, motion and parallax (5, k) of nearing stars.

    Those of the catalogue at the working epoch; stars that it does not know
    stand still at first.
    """
    values = np.zeros((5, len(nearing.stars)))
    values[:2], values[4] = origin[:, nearing.stars], nearing.parallax
    catalogue = carried(sightings.catalogue, working_year)
    place = {star: k for k, star in enumerate(sightings.references)}
    for i, star in enumerate(nearing.stars):
        if star in place:
            known = catalogue.values[:, place[star]]
            if np.isfinite(known).all():
                values[:, i] = known
    return values


def drift(setup, values):
    """
    Return the displacements (2, E, k) of nearing stars beyond the model.

    ``values`` (5, k) are their positions, motions and parallaxes at the
    working epoch. The model has constant motions, and the parallax factors
    of the places in the middle.
    """
    stars, plane = setup.nearing.stars, setup.sightings.plane
    dt = setup.dt if setup.dt.shape[1] == 1 else setup.dt[:, stars]
    values = values[:, None]
    extra = beyond_straight(values, setup.nearing.velocity, dt)
    out = extra[:2]
    if plane is not None:
        observer = setup.sightings.observer
        if observer.shape[2] > 1:
            observer = observer[..., stars]
        place = values[:2] + values[2:4] * dt + extra[:2]
        out = (out + (values[4] + extra[4])
               * plane.parallax_factors(place, observer)
               - values[4] * plane.parallax_factors(
                   setup.origin[:, None, stars], observer))
    return out


def refined(setup, values, found):
    """
    Return values (5, k) of nearing stars from estimates (p, k) of theirs.

    Parallaxes that are not fitted, and stars that have no solution, stay as
    they are.
    """
    stars = setup.nearing.stars
    size = 5 if setup.options.parallax else 4
    new = values.copy()
    new[:size] = found[:size]
    new[:2] += setup.origin[:, stars]
    return np.where(np.isfinite(found).all(axis=0), new, values)
