"""What the map of an epoch's plane does to directions, and as a model."""
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import ICRS, SkyCoord
from astropy.modeling.models import (
    AffineTransformation2D,
    Mapping,
    Pix2Sky_TAN,
    Polynomial2D,
    RotateCelestial2Native,
    RotateNative2Celestial,
    Scale,
    Sky2Pix_TAN,
)

from photutils_mgauss.sky.observers import remove_aberration
from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.transforms import Transform, exponents
from photutils_mgauss.sky.wcs import celestial_frame

DEGREE = 3.6e6  # milliarcseconds


@dataclass(frozen=True, eq=False)
class Correction:
    """
    What an epoch's map does to directions.

    Parameters
    ----------
    plane : `TangentPlane`
    transform : `Transform`
    coefficients : (2, b) `~numpy.ndarray`
    velocity : (3,) `~numpy.ndarray` or None
        Velocity of the observer, whose aberration is removed first.
    turn : (3, 3) `~numpy.ndarray` or None
        A rotation of the sphere before everything else, whose axes the
        velocity is in.
    """

    plane: TangentPlane
    transform: Transform
    coefficients: np.ndarray
    velocity: np.ndarray | None = None
    turn: np.ndarray | None = None

    def turned(self, vectors):
        """Return directions (3, n) after the rotation alone."""
        return vectors if self.turn is None else self.turn @ vectors

    def __call__(self, vectors):
        """Return the corrected directions of directions (3, n)."""
        vectors = self.turned(vectors)
        if self.velocity is not None:
            vectors = remove_aberration(vectors, self.velocity)
        return self.plane.deproject(self.transform.apply(
            self.coefficients, self.plane.project(vectors)))

    def with_aberration(self, vectors):
        """
        Return a correction of the plane alone that removes aberration too.

        The aberration over a field is a quartic to far below 1e-4 mas;
        it is fitted at the directions (3, n) given.
        """
        if self.velocity is None:
            return self
        points = self.plane.project(self.turned(vectors))
        degree = max(self.transform.degree, 4)
        kind = type(self.transform)('polynomial', degree).fitted_to(points)
        targets = self.plane.project(self(vectors))
        coefficients = np.linalg.lstsq(kind.basis(points).T, targets.T,
                                       rcond=None)[0].T
        return Correction(self.plane, kind, coefficients, turn=self.turn)


def sky_model(wcs, correction, vectors):
    """
    Return the model from sky to sky in the frame and units of a WCS.

    The inverse of a polynomial is fitted at the directions (3, n) given.
    """
    frame = celestial_frame(wcs)
    centre, turn = _plane_in(frame, correction.plane)
    there = RotateCelestial2Native(*centre, 180) | Sky2Pix_TAN()
    back = Pix2Sky_TAN() | RotateNative2Celestial(*centre, 180)
    middle = _plane_model(correction, turn, correction.turned(vectors))
    model = there | middle | back
    if correction.turn is not None:
        model = _turn_model(frame, correction) | model
    units = [u.Unit(unit) for unit in wcs.world_axis_units]
    latitude_first = 'lat' in wcs.world_axis_physical_types[0] or (
        wcs.world_axis_physical_types[0].endswith('.dec'))
    if latitude_first:
        units.reverse()
    factors = [unit.to(u.deg) for unit in units]
    if factors != [1.0, 1.0]:
        scale = Scale(factors[0]) & Scale(factors[1])
        model = scale | model | scale.inverse
    if latitude_first:
        model = Mapping((1, 0)) | model | Mapping((1, 0))
    return model


def _turn_model(frame, correction):
    """Return the model of the rotation of the sphere, in a frame."""
    # A rotation takes the place that comes to the plane's centre there, and
    # the directions around it to those around the centre.
    before = TangentPlane(*(float(angle) for angle in directions(
        correction.turn.T @ correction.plane.axes[0])))
    old, old_turn = _plane_in(frame, before)
    new, new_turn = _plane_in(frame, correction.plane)
    # From the old axes of the frame, to ours, turned, and back.
    inner = correction.plane.axes[1:] @ correction.turn @ before.axes[1:].T
    roll = AffineTransformation2D(new_turn @ inner @ old_turn.T, [0.0, 0.0])
    return (RotateCelestial2Native(*old, 180) | Sky2Pix_TAN() | roll
            | Pix2Sky_TAN() | RotateNative2Celestial(*new, 180))


def _plane_in(frame, plane):
    """
    Return the centre (lon, lat) [deg] in a frame, and the turn to its axes.

    Frames of the sky are rotated against one another, and so are planes
    that touch the sphere at one point.
    """
    axes = SkyCoord(*directions(plane.axes.T), unit='deg',
                    frame=ICRS()).transform_to(frame).cartesian.xyz.value.T
    centre = directions(axes[0])
    own = TangentPlane(*centre).axes
    turn = own[1:] @ axes[1:].T
    left, _, right = np.linalg.svd(turn)
    return [float(angle) for angle in centre], left @ right


def _plane_model(correction, turn, vectors):
    """Return the model of the map in degrees, with an inverse."""
    transform, coefficients = correction.transform, correction.coefficients
    if transform.degree == 1:
        slope = coefficients[:, 1:3] / transform.scale
        shift = coefficients[:, 0] - slope @ np.array(transform.centre)
        return AffineTransformation2D(turn @ slope @ turn.T,
                                      turn @ shift / DEGREE)
    points = correction.plane.project(vectors)
    model = _polynomial_model(transform, coefficients, turn)
    mapped = transform.apply(coefficients, points)
    # The map is close to the identity, and so its inverse a polynomial.
    kind = type(transform)('polynomial',
                           min(transform.degree + 3, 9)).fitted_to(mapped)
    inverse = np.linalg.lstsq(kind.basis(mapped).T, points.T,
                              rcond=None)[0].T
    model.inverse = _polynomial_model(kind, inverse, turn)
    return model


def _polynomial_model(transform, coefficients, turn):
    scale = DEGREE / transform.scale
    into = AffineTransformation2D(
        turn.T * scale, -np.array(transform.centre) / transform.scale)
    axes = [Polynomial2D(transform.degree, **{
        f'c{i}_{j}': value for (i, j), value in zip(
            exponents(transform.degree), row / DEGREE, strict=True)})
        for row in coefficients]
    return (into | Mapping((0, 1, 0, 1)) | axes[0] & axes[1]
            | AffineTransformation2D(turn, [0.0, 0.0]))
