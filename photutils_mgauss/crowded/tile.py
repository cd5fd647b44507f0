"""One tile of a crowded image while it is being solved."""
from dataclasses import dataclass, replace

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.equations import Equations, limited
from photutils_mgauss.crowded.model import Model
from photutils_mgauss.crowded.stars import Stars

# The PSF of a cell of this many pixels of the image serves for finding; a
# tile begins where a cell does.
CELL = 32
_TEMPLATE_HALF = 3
# Polishing moves no star further than this [pix]: blends that cannot be
# resolved would run away.
ROAM = 0.5
# A step smaller than this, in pixels and in standard errors, is not taken.
REST = 2e-5


@dataclass(frozen=True)
class TileOptions:
    """What all tiles share."""

    threshold: float
    keep: float
    background_size: float | None
    psf_error: float
    gain: float | None
    floor: float
    noise: float
    max_rounds: int
    find_neighbors: bool = True
    xy_bounds: float = np.inf
    depth: float = np.inf
    count_slope: float = 0.0
    confusion: bool = False
    correlated_noise: bool = False
    raised: float = 1.0

    @property
    def faintest(self):
        """The significance from which stars are fitted, reported or not."""
        return min(self.depth, self.threshold)

    def widened(self, scale):
        """Return options for a PSF that is wider by a factor."""
        if self.background_size is None:
            return self
        return replace(self, background_size=scale * self.background_size)

    def less_deep(self, factor):
        """Return options with limits that are raised by a factor."""
        return replace(self, threshold=factor * self.threshold,
                       keep=factor * self.keep, depth=factor * self.depth,
                       raised=factor * self.raised)


@dataclass(frozen=True)
class TileJob:
    """
    A piece of an image, with its margin.

    ``origin`` (y, x) is where its first pixel is in the image, ``core``
    (y_low, y_high, x_low, x_high) the part, in image pixels, whose stars
    this tile is to report. ``given`` are the stars of a list, in tile pixels.
    """

    data: np.ndarray
    variance: np.ndarray
    psf: object
    options: TileOptions
    origin: tuple
    core: tuple
    given: Stars | None = None

    @property
    def is_empty(self):
        """Whether there is nothing to fit."""
        return not (self.variance > 0).any() or (
            self.given is not None and len(self.given) == 0)


class Searched:
    """
    What a search of stars leaves behind on a tile.

    Attributes
    ----------
    rejected : (n, 2) `~numpy.ndarray`
        Where stars have been taken away for good.
    repeats : list of (number, number, x, y) tuple
        The entries of a list that mean the star of another.
    """

    def __init__(self):
        self.rejected = np.empty((0, 2))
        self.repeats = []

    def reject(self, places):
        """Remember places (n, 2) where no star is to be added again."""
        self.rejected = np.concatenate([self.rejected, places])

    def note_repeats(self, entries, host):
        """Remember which numbers' stars the entries of a list mean."""
        self.repeats += zip(entries.number, host, entries.x_init,
                            entries.y_init, strict=True)


class Tile(Searched):
    """
    The model of a `TileJob`, its equations, and what a search has to know.

    Nothing else writes into it.

    Attributes
    ----------
    model : Model
    equations : Equations
        Those of the model as it is.
    widths : (n,) `~numpy.ndarray`
        By how much the PSF is too narrow at bright stars.
    moved : (n,) `~numpy.ndarray`
        How far each star went in the last step [pix].
    least : (ny, nx) `~numpy.ndarray`
        Which flux a new star has at least.
    wings_known : bool
        Whether what the PSF leaves of saturated stars was measured.
    """

    def __init__(self, job):
        super().__init__()
        self.model = Model(job)
        self.options = job.options
        self.origin = job.origin
        self.widths = np.empty(0)
        self.moved = np.empty(0)
        self.wings_known = False
        self.least = np.zeros(job.data.shape)
        self.templates = _templates(job.psf, job.data.shape)

    @property
    def stars(self):
        """The stars of the model."""
        return self.model.stars

    @property
    def neighbours(self):
        """Who is beside whom."""
        return self.model.neighbours

    @property
    def area(self):
        """The area of the PSF [pix^2]."""
        return self.model.psf.area

    # What follows keeps the equations up to date with the model.

    def _form_equations(self):
        self.equations = Equations.of(self.model)

    def start(self, stars):
        """Put stars in place of all others."""
        self.model.start(stars)
        self._form_equations()

    def refresh(self):
        """Bring everything up to date with the stars."""
        self.model.refresh()
        self._form_equations()

    def admit(self, found):
        """Add stars; the others stay as they are."""
        self.model.admit(found)
        self._form_equations()

    def dismiss(self, gone):
        """Take stars away; the others stay as they are."""
        self.model.dismiss(gone)
        self._form_equations()

    def bind(self, which, entries):
        """Give some stars to entries of a list, within their bounds."""
        self.model.stars.bind(which, entries)
        self.refresh()

    def admit_listed(self, entries, spread):
        """
        Add entries without a star, as bright as the residual allows.

        They are held to their places, with a standard deviation ``spread``.
        """
        n, model = len(self.stars), self.model
        least = np.full(len(entries), 0.1 * model.noise
                        / model.psf.profile[0])
        self.admit(entries.replaced(flux=least, flux_init=least.copy(),
                                    hold=np.full(len(entries), spread**-2)))
        information = self.equations.stars.matrix[n:, 0, 0]
        more = np.divide(self.equations.stars.gradient[n:, 0], information,
                         where=information > 0, out=np.zeros(len(entries)))
        model.stars.brighten(np.s_[n:], np.maximum(more, 0))
        self.refresh()

    def _solve(self, damping):
        step, level_step = self.equations.solve(damping)
        return limited(step, self.model.stars,
                       self.model.psf.scale), level_step

    def step(self, damping=0.0, moving=slice(None)):
        """Take one Gauss-Newton step, of all stars or only some."""
        step, level_step = self._solve(damping)
        taken = np.zeros_like(step)
        taken[moving] = step[moving]
        self.model.take(taken, level_step)
        self.refresh()

    def polish(self, damping, n_steps):
        """
        Take steps without a new layout, until all stars are at rest.

        Stamps stay where they are, so that steps converge; stars that are
        at rest stay as they are.
        """
        self.refresh()
        region = _trust_region(self.model.stars, self.model.psf.scale)
        self.moved = np.zeros(len(self.model.stars))
        for _ in range(n_steps):
            self._polish_once(damping, region)
            if not (self.moved > REST).any():
                break

    def _polish_once(self, damping, region):
        step, level_step = self._solve(damping)
        self.moved = np.abs(step[:, 1:]).max(axis=1, initial=0)
        now = _parameters(self.model.stars)
        step = np.clip(now + step, *region) - now
        information = self.equations.stars.matrix[:, 0, 0]
        restless = (self.moved > REST) | (
            np.abs(step[:, 0]) * np.sqrt(information) > REST)
        step[~restless] = 0
        self.model.take_in_place(step, level_step, np.flatnonzero(restless))
        self._form_equations()

    def update_diffuse(self):
        """Find the diffuse light again."""
        self.model.update_diffuse()
        self._form_equations()

    def take_off_wings(self, measure):
        """Take off what the PSF leaves of saturated stars, as measured."""
        known, gone = measure(self)
        self.wings_known = known is not None
        if not self.wings_known:
            return
        self.model.dismiss(gone)
        s = self.stars
        light, variance = np.zeros((2, *self.least.shape))
        known.take_off(light, variance, np.stack(
            [s.x, s.y, s.flux])[:, s.seeded], known.reach)
        self.model.take_off(-light, variance)
        self._form_equations()

    def note_least(self, measure):
        """Remember which flux a new star has at least, as measured."""
        self.least = measure(self.model)

    def note_widths(self, measure):
        """Remember by how much the PSF is too narrow, as measured."""
        self.widths = measure(self.model)


def _templates(psf, shape):
    """Draw a star for each cell."""
    ny, nx = shape
    stamps = [[psf.stamp((x + min(x + CELL, nx)) // 2,
                         (y + min(y + CELL, ny)) // 2,
                         round(psf.scale * _TEMPLATE_HALF))
               for x in range(0, nx, CELL)] for y in range(0, ny, CELL)]
    return kernels.Templates(np.array(stamps), CELL)


def _parameters(stars):
    return np.column_stack([stars.flux, stars.x, stars.y])


def _trust_region(stars, scale):
    """Return the limits (n, 3) of stars that are being polished."""
    now = _parameters(stars)
    roam = np.full_like(now, scale * ROAM)
    low, high = roam.copy(), roam
    low[:, 0], high[:, 0] = stars.flux / 2, stars.flux
    return now - low, now + high
