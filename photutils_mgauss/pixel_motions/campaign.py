"""All images of a fit, read once: pixels in one unit, times, observers."""
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from photutils_mgauss.photometry.joint_pixels import JointImages
from photutils_mgauss.photometry.many_images import joint_images, views_of
from photutils_mgauss.pixel_motions.epoch import ImageEpoch
from photutils_mgauss.sky.observers import observer_positions
from photutils_mgauss.sky.tangent_plane import TangentPlane
from photutils_mgauss.sky.wcs import pixel_to_vectors

ESTIMATED = ('The images {where} came without errors: one number for each '
             'was estimated from its scatter, and the errors of stars are '
             'scaled by their residuals.')
ONE_TIME = ('All images were taken at one time: positions and fluxes are '
            'fitted, motions are not.')
FEW_TIMES = ('Motions with a {what} take images at {wanted} times or more, '
             'got {got}: positions and fluxes are fitted, motions are not.')


@dataclass(frozen=True, eq=False)
class Campaign:
    """
    The images of all epochs, and the tangent plane they have in common.

    Attributes
    ----------
    epochs : list of ImageEpoch
    joint : `~photutils_mgauss.photometry.joint_pixels.JointImages`
    scale : float
        The light that counts as 1 there.
    unit : `~astropy.units.UnitBase` or None
        Of the light of all images.
    plane : `~photutils_mgauss.sky.tangent_plane.TangentPlane`
    working_year : float
        The mean time, at which positions are fitted.
    parallax, acceleration : bool
        What is fitted beside positions and motions.
    estimated : tuple of int
        The images whose errors were estimated.
    """

    epochs: list
    joint: JointImages
    scale: float
    unit: object
    plane: TangentPlane
    working_year: float
    parallax: bool
    acceleration: bool
    estimated: tuple

    @property
    def n_images(self):
        """The number of images."""
        return len(self.epochs)

    @property
    def n_parameters(self):
        """The number of parameters of a star."""
        return 4 + self.parallax + 2 * self.acceleration

    @property
    def years(self):
        """The times (E,) [Julian years, TDB]."""
        return np.array([epoch.year for epoch in self.epochs])

    @property
    def frames(self):
        """The WCS of all images."""
        return [epoch.wcs for epoch in self.epochs]

    @property
    def shapes(self):
        """The shapes of all images."""
        return [epoch.pixels.shape for epoch in self.epochs]

    @property
    def bands(self):
        """The number, from 0, of the band of each flux."""
        bands = [epoch.band or '' for epoch in self.epochs]
        _, first = np.unique(self.joint.shared, return_index=True)
        return np.unique(np.array(bands)[first], return_inverse=True)[1]

    @property
    def notes(self):
        """What is to be said about the images, in sentences."""
        notes = []
        if self.estimated:
            where = ', '.join(str(k) for k in self.estimated)
            notes.append(ESTIMATED.format(where=where))
        if np.ptp(self.years) == 0:
            notes.append(ONE_TIME)
        elif not self.has_times_enough:
            what = ' and '.join(['parallax'] * self.parallax
                                + ['acceleration'] * self.acceleration)
            notes.append(FEW_TIMES.format(
                what=what, wanted=self.n_times, got=self._n_distinct))
        return tuple(notes)

    @property
    def n_times(self):
        """The number of times that all parameters of a star take."""
        return 2 + self.parallax + self.acceleration

    @property
    def has_times_enough(self):
        """Whether a star in all images would have all parameters."""
        return self._n_distinct >= self.n_times

    @property
    def _n_distinct(self):
        """The number of distinct times of the images."""
        every = np.ones((1, len(self.years)), bool)
        return int(_periods(self.years, every)[0])

    def factors(self, places):
        """
        Return how images see the parameters of stars at places (2, n).

        Derivatives of the place in the plane, (2, p, n) for each image.
        """
        observers = [epoch.observer for epoch in self.epochs]
        observer = (observer_positions(observers, self.years)
                    if self.parallax else None)
        return [self._factors(k, places, observer)
                for k in range(self.n_images)]

    def _factors(self, k, places, observer):
        dt = self.epochs[k].year - self.working_year
        out = np.zeros((2, self.n_parameters, places.shape[1]))
        out[0, 0] = out[1, 1] = 1.0
        out[0, 2] = out[1, 3] = dt
        if self.parallax:
            out[:, 4] = self.plane.parallax_factors(
                places, observer[:, k, None])
        if self.acceleration:
            out[0, -2] = out[1, -1] = dt**2 / 2
        return out

    def views(self, values):
        """Return the `Views` of groups of stars at values (g, m, p)."""
        flat = values.reshape(-1, values.shape[2])
        return views_of(self.frames, self.plane, values,
                        self.factors(flat[:, :2].T),
                        [epoch.velocity for epoch in self.epochs])

    def free(self, seen, dt):
        """
        Return which parameters (n, p) images (n, E) suffice for, and where.

        Positions need one time, motions two, parallaxes and accelerations
        one more each. The second array (n,) says where all are fitted.
        """
        periods = _periods(dt, seen)
        enough = periods >= self.n_times
        free = np.zeros((len(seen), self.n_parameters), bool)
        free[:, :2] = (periods > 0)[:, None]
        free[enough] = True
        return free, enough

    def without(self, lights):
        """Return this campaign with other light (ny, nx) subtracted."""
        images = [replace(image, light=light) for image, light in zip(
            self.joint.images, lights, strict=True)]
        return replace(self, joint=replace(self.joint, images=images))


def _periods(years, seen):
    """Return the number of distinct times (n,) among those seen (n, E)."""
    distinct, which = np.unique(np.round(years, 6), return_inverse=True)
    there = np.zeros((len(seen), len(distinct)), bool)
    for k, t in enumerate(which):
        there[:, t] |= seen[:, k]
    return there.sum(axis=1)


def read_campaign(images, *, flux, fit_sky, parallax, acceleration):
    """Return the `Campaign` of a sequence of `ImageEpoch`."""
    epochs = _check(images)
    pixels = [epoch.pixels for epoch in epochs]
    unit = pixels[0].unit
    joint, scale = joint_images(
        [one.with_error() for one in pixels],
        [epoch.model for epoch in epochs], _shared(epochs, flux),
        fit_sky=fit_sky, factors=[_factor(one.unit, unit, k)
                                  for k, one in enumerate(pixels)])
    estimated = tuple(k for k, one in enumerate(pixels) if one.error is None)
    years = np.array([epoch.year for epoch in epochs])
    return Campaign(epochs, joint, scale, unit, _plane(epochs),
                    float(years.mean()), parallax, acceleration, estimated)


def _check(images):
    if isinstance(images, ImageEpoch):
        msg = 'images must be a sequence of ImageEpoch, got a single one'
        raise TypeError(msg)
    epochs = list(images)
    if not epochs:
        msg = 'images must have at least one ImageEpoch, got none'
        raise ValueError(msg)
    for epoch in epochs:
        if not isinstance(epoch, ImageEpoch):
            msg = (f'images must be a sequence of ImageEpoch, got '
                   f'{type(epoch).__name__}')
            raise TypeError(msg)
    return epochs


def _factor(own, unit, k):
    """Return what turns the unit of image k into that of the first image."""
    if own == unit:
        return 1.0
    if own is None or unit is None or not own.is_equivalent(unit):
        msg = ('images must have units that can be converted into that of '
               f'the first, {unit or "none"}, got {own or "none"} in image '
               f'{k}')
        raise ValueError(msg)
    return own.to(unit)


def _shared(epochs, flux):
    """Return the number of the flux of each image."""
    if flux == 'common':
        return np.zeros(len(epochs), int)
    if flux == 'image':
        return np.arange(len(epochs))
    bands = [epoch.band for epoch in epochs]
    if None in bands:
        msg = ("images must have a band for flux='band', got none in image "
               f'{bands.index(None)}')
        raise ValueError(msg)
    return np.unique(bands, return_inverse=True)[1]


def _plane(epochs):
    """Return the plane at the middle of all images."""
    centres = []
    for epoch in epochs:
        ny, nx = epoch.pixels.shape
        centres.append(pixel_to_vectors(
            epoch.wcs, [(nx - 1) / 2], [(ny - 1) / 2], bounded=False))
    centres = np.concatenate(centres, axis=1)
    if not np.isfinite(centres).all():
        k = int(np.flatnonzero(~np.isfinite(centres).all(axis=0))[0])
        msg = (f'images must have a WCS that knows their middle, got none '
               f'that does in image {k}')
        raise ValueError(msg)
    return TangentPlane.around(centres)


def light_unit(campaign):
    """Return the unit of fluxes, 1 if there is none."""
    return u.one if campaign.unit is None else campaign.unit
