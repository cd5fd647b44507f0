"""
One tile of a crowded field while it is being solved in many images.

Each image has a `SharedModel` of its own, with the stars of all: star i is
the same in every one of them. Where a star is, is said once, in columns and
rows of a grid on the sky; the fluxes are those of the images.
"""
from dataclasses import dataclass

import numpy as np
from astropy.stats import mad_std
from scipy.stats import chi2

from photutils_mgauss import kernels
from photutils_mgauss.crowded.many_equations import (
    FARTHEST,
    ManyEquations,
    reach_of,
)
from photutils_mgauss.crowded.model import Model
from photutils_mgauss.crowded.stars import Neighbours, Stars, reach_of_pairs
from photutils_mgauss.crowded.tile import (
    CELL,
    REST,
    ROAM,
    Searched,
    TileOptions,
)

# Templates are drawn for so many parts of a pixel along each axis.
_PHASES = 4
_TEMPLATE_HALF = 3
# Stars this far outside of an image are not in it [pix].
_OUTSIDE = 3.0
# Fluxes may always change by so many standard errors: they may be negative.
_FREE = 3.0
# A star of this signal-to-noise ratio in one image has a flux of its own in
# each: scales are not better known. So has one whose fluxes would be as
# different by a smaller chance than this.
_SURE, _CONSTANT = 100.0, 1e-5
# How stars of a field move is learnt from the part of them whose motions are
# best known, if these are so many; others may be so many times as fast.
_BEST, _FEW, _WIDER = 0.25, 20, 2.0


@dataclass(frozen=True)
class TileMap:
    """
    From columns and rows of a tile's grid to pixels of a tile's image.

    ``whole`` and ``inverse`` are the maps of whole images, ``grid`` (u, v)
    and ``image`` (x, y) where in them the tile begins.
    """

    whole: object
    inverse: object
    grid: tuple
    image: tuple

    def __call__(self, u, v):
        """Return x and y (2, n)."""
        return self.whole(u + self.grid[0], v + self.grid[1]) - np.array(
            self.image)[:, None]

    def back(self, x, y):
        """Return u and v (2, n)."""
        return self.inverse(x + self.image[0], y + self.image[1]) - np.array(
            self.grid)[:, None]

    def slopes(self, u, v):
        """Return the derivatives (n, 2, 2)."""
        return self.whole.slopes(u + self.grid[0], v + self.grid[1])

    def points(self, shape):
        """Return where all points (rows, columns) of the grid are."""
        v, u = (np.arange(n) + first for n, first in zip(
            shape, self.grid[::-1], strict=True))
        x, y = self.whole.on_grid(u, v)
        return kernels.Points(x - self.image[0], y - self.image[1])


@dataclass(frozen=True)
class ManyJob:
    """
    A piece of the sky with its margin, and the pieces of images that show it.

    ``parts`` are the `TileJob` of those images, ``images`` their numbers and
    ``scales`` their relative throughput, ``factors`` (E, 2, p) how they see
    what places are made of: column and row, and what moves stars. Images of
    the same number in ``bands`` (E,) may have fluxes in common. ``shape``
    and ``origin`` (rows first) are those of the piece on the grid, ``core``
    (v_low, v_high, u_low, u_high) what of it is reported; ``n_images`` is the
    number of all images, ``given`` are the stars of a list, in columns and
    rows of the piece.
    """

    parts: list
    maps: list
    images: np.ndarray
    scales: np.ndarray
    factors: np.ndarray
    bands: np.ndarray
    options: TileOptions
    shape: tuple
    origin: tuple
    core: tuple
    n_images: int
    given: Stars | None = None

    @property
    def is_empty(self):
        """Whether there is nothing to fit."""
        return not any((part.variance > 0).any() for part in self.parts) or (
            self.given is not None and len(self.given) == 0)


class SharedModel(Model):
    """A `Model` whose stars and neighbours are those of many images."""

    def __init__(self, job):
        self.slopes = np.empty((0, 2, 2))
        super().__init__(job)
        self.neighbours = Neighbours.of(np.empty(0), np.empty(0), 0.0)

    def _connect(self):
        """Leave the list of neighbours as the tile has made it."""

    def _draw_stamps(self, chosen):
        super()._draw_stamps(chosen)
        kernels.turn_stamps(chosen, self.stamps, self.slopes)


class ManyTile(Searched):
    """
    The models of all images of a `ManyJob`, their equations, and the stars.

    Attributes
    ----------
    models : list of SharedModel
    stars : Stars
        In columns and rows of the grid; fluxes are those of an image of scale
        one, made of all images. More columns: ``rate`` (n, p - 2) is what
        moves them, ``constant`` whether images of a band may have one flux,
        ``tied`` whether they have.
    equations : ManyEquations
    points : list of kernels.Points
    phases : list of kernels.Phases
    usual : (2, p - 2) `~numpy.ndarray`
        How stars are thought to move before they are measured: the mean and
        the standard deviation.
    measured : (E, n) `~numpy.ndarray`
        Fluxes of all images, each free.
    widths, moved, least
        As of `Tile`; ``widths`` and ``least`` are those of each image.
    """

    def __init__(self, job):
        super().__init__()
        self.job, self.options = job, job.options
        self.origin, self.shape = job.origin, job.shape
        self.scales = job.scales[:, None]
        self.models = [SharedModel(part) for part in job.parts]
        self.points = [one.points(job.shape) for one in job.maps]
        self.phases = [phases(part.psf, part.data.shape)
                       for part in job.parts]
        self.widths = [np.empty(0)] * len(job.parts)
        self.least = [np.zeros(model.data.shape) for model in self.models]
        self.moved = np.empty(0)
        far = FARTHEST / reach_of(job.factors)[2:]
        self.usual = np.stack([np.zeros(far.shape), far])
        self.stars = self._at_rest(Stars([], [], []))
        # Pixels of the grid may be smaller than those of some images.
        middle = [np.array([n / 2]) for n in job.shape[::-1]]
        self.pixels = [float(np.linalg.norm(np.linalg.inv(
            one.slopes(*middle)[0]), 2)) for one in job.maps]

    @property
    def fluxes(self):
        """The fluxes (E, n)."""
        return np.array([model.stars.flux for model in self.models])

    @property
    def area(self):
        """The area of the sharpest PSF in pixels of the grid."""
        return min(model.psf.area * size**2 for model, size in zip(
            self.models, self.pixels, strict=True))

    @property
    def scale(self):
        """By what lengths on the grid exceed those of narrow PSFs."""
        return max(1.0, min(model.psf.scale * size for model, size in zip(
            self.models, self.pixels, strict=True)))

    def ties(self):
        """Return the `~kernels.Ties` of fluxes."""
        tied, bands = self.stars.tied, self.job.bands
        each = np.arange(bands.size)[:, None]
        leader = np.where(tied, np.argmax(bands == bands[:, None],
                                          axis=1)[:, None], each)
        first = leader == each
        number = np.cumsum(first).reshape(first.shape) - 1
        return kernels.Ties(
            number[leader, np.arange(tied.size)],
            np.where(tied, self.scales, 1.0), first, int(first.sum()))

    def _at_rest(self, stars):
        """Return stars with columns for what moves and what ties them."""
        n, bands = len(stars), self.job.bands
        alike = np.full(n, np.unique(bands).size < bands.size)
        return stars.replaced(
            rate=np.zeros((n, self.job.factors.shape[2] - 2)),
            constant=alike, tied=alike.copy())

    def _places(self):
        """Return what places are made of (n, p)."""
        return np.column_stack([self.stars.x, self.stars.y, self.stars.rate])

    # What follows keeps models and equations up to date with the stars.

    def _form_equations(self):
        self.equations = ManyEquations.of(self)
        light, known = self.equations.summed(self.fluxes)
        self.stars.flux = np.divide(light, known, where=known > 0,
                                    out=np.zeros(known.size))

    def _tie(self):
        """Choose which stars have one flux in all images of a band."""
        stars = self.stars
        error = self.equations.flux_errors(alone=True)
        sure = (error > 0) & (self.fluxes > _SURE * error)
        tied = stars.constant & ~sure.any(axis=0)
        new = tied & ~stars.tied
        stars.tied = tied
        for scale, model in zip(self.job.scales, self.models, strict=True):
            model.stars.flux[new] = scale * stars.flux[new]

    def _find_variable(self):
        """Look for stars that one flux for a band does not explain."""
        gradient, own = (np.array(part) for part in zip(*(
            (one.stars.gradient[:, 0], one.stars.matrix[:, 0, 0])
            for one in self.equations.each), strict=True))
        bands, seen = self.job.bands, own > 0
        square = np.divide(gradient**2, own, where=seen,
                           out=np.zeros(own.shape)).sum(axis=0)
        free = seen.sum(axis=0) - sum(
            seen[bands == one].any(axis=0) for one in np.unique(bands))
        self.stars.constant &= square < chi2.isf(_CONSTANT,
                                                 np.maximum(free, 1))

    def learn_motions(self):
        """Learn from the best known motions how stars usually move."""
        rate, error = self.stars.rate, self.equations.motion_errors()
        n = int(_BEST * len(rate))
        if rate.shape[1] == 0 or n < _FEW:
            return
        best = np.argsort(error.max(axis=1), kind='stable')[:n]
        middle = np.median(rate[best], axis=0)
        spread = np.maximum(mad_std(rate[best], axis=0), error[best].max())
        far = FARTHEST / reach_of(self.job.factors)[2:]
        self.usual = np.stack([middle, np.minimum(_WIDER * spread, far)])
        self._form_equations()

    def measure(self):
        """Find the fluxes of all images at the places that there are."""
        self.measured = self.fluxes
        if self.stars.tied.any():
            self.measured = self.fluxes + self.equations.each_flux()

    def _connect(self, stars, slopes):
        """Take over stars of slopes (E, n, 2, 2); find who is beside whom."""
        self.stars = stars
        self.neighbours = Neighbours.of(stars.x, stars.y, max(
            size * reach_of_pairs(model.psf.area)
            for model, size in zip(self.models, self.pixels, strict=True)))
        for model, own in zip(self.models, slopes, strict=True):
            model.neighbours = self.neighbours
            model.slopes = own

    def _slopes(self, stars):
        """Return how places in images change with those of stars."""
        return [one.slopes(stars.x, stars.y) for one in self.job.maps]

    def _seen(self, stars, fluxes):
        """Return stars as each image has them."""
        out = []
        for model, one, factor, flux in zip(
                self.models, self.job.maps, self.job.factors, fluxes,
                strict=True):
            shift = stars.rate @ factor[:, 2:].T
            x, y = one(stars.x + shift[:, 0], stars.y + shift[:, 1])
            ny, nx = model.data.shape
            away = np.maximum(np.maximum(-x, x - nx + 1),
                              np.maximum(-y, y - ny + 1)) > (
                                  model.psf.scale * _OUTSIDE)
            out.append(Stars(x, y, np.where(away, 0, flux),
                             seeded=stars.seeded & ~away,
                             core=stars.core))
        return out

    def start(self, stars, fluxes):
        """Put stars, of fluxes (E, n), in place of all others."""
        stars = self._at_rest(stars)
        self._connect(stars, self._slopes(stars))
        for model, own in zip(self.models, self._seen(stars, fluxes),
                              strict=True):
            model.start(own)
        self._form_equations()

    def refresh(self):
        """Bring everything up to date with the stars."""
        self._tie()
        own = self._seen(self.stars, self.fluxes)
        self._connect(self.stars, self._slopes(self.stars))
        for model, stars in zip(self.models, own, strict=True):
            model.stars.x, model.stars.y = stars.x, stars.y
            model.refresh()
        self._form_equations()

    def admit(self, found, fluxes):
        """Add stars of fluxes (E, n); the others stay as they are."""
        found = self._at_rest(found)
        fluxes = np.where(found.tied, self.scales * found.flux, fluxes)
        self._connect(Stars.joined([self.stars, found]), [
            np.concatenate([model.slopes, new]) for model, new in zip(
                self.models, self._slopes(found), strict=True)])
        for model, own in zip(self.models, self._seen(found, fluxes),
                              strict=True):
            model.admit(own)
        self._form_equations()

    def admit_listed(self, entries, spread):
        """
        Add entries without a star, with what the residuals say of fluxes.

        They are held to their places, with a standard deviation ``spread``.
        """
        n = len(self.stars)
        self.admit(entries.replaced(hold=np.full(len(entries), spread**-2)),
                   np.zeros((len(self.models), len(entries))))
        self.brighten(n)

    def brighten(self, first):
        """Give stars from the first on the fluxes that residuals hold."""
        light = self.equations.residual_fluxes()[:, first:]
        for model, more in zip(self.models, light, strict=True):
            model.stars.flux[first:] += more
        self.refresh()

    def bind(self, which, entries):
        """Give some stars to entries of a list, within their bounds."""
        self.stars.bind(which, entries)
        self.refresh()

    def dismiss(self, gone):
        """Take stars away; the others stay as they are."""
        for model in self.models:
            model.dismiss(gone)
        self._connect(self.stars.chosen(~gone),
                      [model.slopes[~gone] for model in self.models])
        self._form_equations()

    def update_diffuse(self):
        """Find the diffuse light of each image again."""
        for model in self.models:
            model.update_diffuse()
        self._form_equations()

    def step(self, damping=0.0, moving=slice(None)):
        """Take one Gauss-Newton step, of all stars or only some."""
        light, place, levels = self.equations.solve(damping)
        light, place = self.equations.limited(light, place, self)
        kept_light, kept_place = np.zeros_like(light), np.zeros_like(place)
        kept_light[:, moving], kept_place[moving] = (light[:, moving],
                                                     place[moving])
        self._move(kept_place)
        for model, flux, level in zip(self.models, kept_light, levels,
                                      strict=True):
            model.take(_step(flux, np.zeros((flux.size, 2))), level)
        self.refresh()

    def _move(self, place):
        self.stars.x = self.stars.x + place[:, 0]
        self.stars.y = self.stars.y + place[:, 1]
        self.stars.rate = self.stars.rate + place[:, 2:]

    def polish(self, damping, n_steps):
        """Take steps without a new layout, until all stars are at rest."""
        self.refresh()
        region = self._trust_region()
        self.moved = np.zeros(len(self.stars))
        for _ in range(n_steps):
            self._polish_once(damping, region)
            if not (self.moved > REST).any():
                break
        self._find_variable()

    def _trust_region(self):
        """Return limits (2, E, n) of fluxes and (2, n, p) of places."""
        flux = self.fluxes
        roam = _FREE * self.equations.flux_errors()
        place = self._places()
        reach = np.minimum(self.scale * ROAM, self.stars.bound)[
            :, None] / reach_of(self.job.factors)
        return (np.stack([np.minimum(flux / 2, flux - roam),
                          np.maximum(2 * flux, flux + roam)]),
                np.stack([place - reach, place + reach]))

    def _polish_once(self, damping, region):
        light, place, levels = self.equations.solve(damping)
        self.moved = np.abs(place * reach_of(self.job.factors)).max(
            axis=1, initial=0)
        flux, here = self.fluxes, self._places()
        light = np.clip(flux + light, *region[0]) - flux
        place = np.clip(here + place, *region[1]) - here
        place[self.moved <= REST] = 0
        self._move(place)
        restless = (np.abs(light) > REST * self.equations.flux_errors()) | (
            self.moved > REST)
        for k, model in enumerate(self.models):
            shift = np.einsum('nij,nj->ni', model.slopes,
                              place @ self.job.factors[k].T)
            step = _step(np.where(restless[k], light[k], 0), shift)
            model.take_in_place(step, levels[k], np.flatnonzero(restless[k]))
        self._form_equations()

    def note_least(self, measure):
        """Remember which flux a new star has at least in each image."""
        self.least = [measure(model) for model in self.models]

    def note_widths(self, measure):
        """Remember by how much each image's PSF is too narrow."""
        self.widths = [measure(model) for model in self.models]


def _step(flux, shift):
    return np.column_stack([flux, shift])


def phases(psf, shape):
    """Draw a star for each cell and each part of a pixel."""
    y, x = (np.arange(0, n, CELL) for n in shape)
    y, x = ((low + np.minimum(low + CELL, n)) // 2
            for low, n in zip((y, x), shape, strict=True))
    parts = (np.arange(_PHASES) + 0.5) / _PHASES - 0.5
    at = np.meshgrid(x, y)
    stamps = psf.stamps(*(one.ravel().astype(float) for one in at),
                        round(psf.scale * _TEMPLATE_HALF),
                        [(dx, dy) for dy in parts for dx in parts])
    return kernels.Phases(stamps.reshape(
        y.size, x.size, _PHASES, _PHASES, *stamps.shape[2:]), CELL)
