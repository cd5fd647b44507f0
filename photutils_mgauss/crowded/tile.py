r"""
One tile of a crowded image: every star and the background, together.

The image is modelled as stars of unknown positions and fluxes on a bilinear
background,

.. math::

    M(\mathbf{r}) = b(\mathbf{r}) + \sum_i f_i\,
    P(\mathbf{r} - \mathbf{r}_i\,|\,\mathbf{r}_i),

and Gauss-Newton steps for all of its parameters at once come from their joint
normal equations, sparse because a star overlaps only its neighbours.
Positions here are tile pixels.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.background import Mesh
from photutils_mgauss.crowded.stars import Neighbours, Stars
from photutils_mgauss.psf.local import MAX_WING

# Fit stamps are 7 or 9 pixels wide, 13 for bright stars: almost all of the
# information on a position lies in the core.
_MIN_HALF, _MAX_HALF, _BRIGHT_HALF = 3, 4, 6
# In units of noise over the PSF's peak.
_BRIGHT_FLUX = 300
# A star is drawn out to where its surface brightness falls below this
# fraction of the noise.
_WING_NOISE = 0.2
# Of a star drawn afresh, Gaussians are left out where they fall below this
# fraction of the noise.
_FAINTEST = 1e-3
# A step of Gauss-Newton moves a star no further than this [pix].
_MAX_MOVE = 0.4
# Nor does it change a flux by more than these factors.
_LEAST_CHANGE, _MOST_CHANGE = 0.2, 2.5
# Joint equations are solved until the residual is this fraction of what it
# was: what is left over would depend on what else is on the tile.
_TOLERANCE = 1e-6
_CG_STEPS = 400
# The PSF of a cell of this many pixels of the image serves for finding; a
# tile begins where a cell does.
CELL = 32
_TEMPLATE_HALF = 3
# Polishing moves no star further than this [pix]: blends that cannot be
# resolved would run away.
_ROAM = 0.5
# A step smaller than this, in pixels and in standard errors, is not taken.
REST = 2e-5
# What is known beforehand moves no flux by more standard errors than this.
_STRONGEST_PULL = 0.5
# Pixels further than this from the model take no part in the background.
_BACKGROUND_CLIP = 4.0
# What is known of each star's stamp.
_FRAME = ('wing', 'width', 'left', 'bottom', 'offset')


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

    @property
    def faintest(self):
        """The significance from which stars are fitted, reported or not."""
        return min(self.depth, self.threshold)


@dataclass(frozen=True)
class TileJob:
    """
    A piece of an image, with its margin.

    ``origin`` (y, x) is where its first pixel is in the image, ``core``
    (y_low, y_high, x_low, x_high) the part, in image pixels, whose stars
    this tile is to report.
    """

    data: np.ndarray
    variance: np.ndarray
    psf: object
    options: TileOptions
    origin: tuple
    core: tuple
    given: np.ndarray | None = None

    @property
    def is_empty(self):
        """Whether there is nothing to fit."""
        return not (self.variance > 0).any() or (
            self.given is not None and self.given.size == 0)


class Tile:
    """The state of a tile while it is being solved."""

    def __init__(self, job):
        self.data = job.data
        self.variance = job.variance
        self.good = job.variance > 0
        self.psf = job.psf
        self.options = job.options
        self.origin = job.origin
        self.stars = Stars([], [], [], n_rows=self.psf.n_rows)
        self.graves = np.empty((0, 2))
        # Entries of the list (number, number of the star, x, y) that mean
        # the star of another.
        self.repeats = []
        self.weight = np.divide(1, self.variance, where=self.good,
                                out=np.zeros(self.data.shape))
        self.noise = job.options.noise
        self.profile, self.area = self.psf.profile, self.psf.area
        self.widths = np.empty(0)
        self._make_mesh()
        self._make_templates()

    def _make_mesh(self):
        size = self.options.background_size
        self.mesh = Mesh(self.data.shape, self.origin,
                         size or max(self.data.shape))
        # Stars hide the sky.
        self.level = (self.mesh.faint_level(self.data, self.good) if size
                      else np.zeros(self.mesh.size))
        self.limits = (self.mesh.limits(self.data, self.good, self.noise)
                       if size else (-np.inf, np.inf))

    def _make_templates(self):
        ny, nx = self.data.shape
        rows, columns = range(0, ny, CELL), range(0, nx, CELL)
        self.templates = np.array([[
            self.psf.stamp((x + min(x + CELL, nx)) // 2,
                           (y + min(y + CELL, ny)) // 2, _TEMPLATE_HALF)
            for x in columns] for y in rows])

    # The model.

    def lay_out(self):
        """Choose stamps and wings, list neighbours."""
        self.wing, self.width, self.left, self.bottom = self._frames(
            np.arange(len(self.stars)))
        self.offset, total = _offsets(self.width, 0)
        self.jets = np.empty((3, total))
        self.pairs = Neighbours.of(self.stars.x, self.stars.y)

    def _frames(self, chosen):
        """Return the wings, widths and corners of the chosen stars."""
        s = self.stars
        flux = np.maximum(s.flux[chosen], 1e-300)
        wing = np.clip(
            np.searchsorted(-self.profile, -_WING_NOISE * self.noise / flux),
            _MIN_HALF, MAX_WING)
        bright = flux * self.profile[0] > _BRIGHT_FLUX * self.noise
        half = np.clip(wing, _MIN_HALF, np.where(
            bright, _BRIGHT_HALF, _MAX_HALF))
        half[s.seeded[chosen]] = _BRIGHT_HALF + 2
        return (np.maximum(wing, half).astype(np.int64), 2 * half + 1,
                np.rint(s.x[chosen]).astype(np.int64) - half,
                np.rint(s.y[chosen]).astype(np.int64) - half)

    def admit(self, found):
        """Add stars; the others stay as they are."""
        new = np.arange(len(self.stars), len(self.stars) + len(found))
        self.stars.append(found)
        frames = self._frames(new)
        offset, total = _offsets(frames[1], self.jets.shape[1])
        for name, values in zip(_FRAME, (*frames, offset), strict=True):
            setattr(self, name, np.concatenate([getattr(self, name),
                                                values]))
        self.jets = np.concatenate(
            [self.jets, np.empty((3, total - self.jets.shape[1]))], axis=1)
        self._localise_psf()
        self._draw_stamps(new)
        self._add_stars(new, -1.0)
        self._reconnect()

    def dismiss(self, gone):
        """Take stars away; the others stay as they are."""
        self._add_stars(np.flatnonzero(gone), 1.0)
        for name in _FRAME:
            setattr(self, name, getattr(self, name)[~gone])
        self.stars.select(~gone)
        self._reconnect()

    def _reconnect(self):
        self._weigh()
        self.pairs = Neighbours.of(self.stars.x, self.stars.y)
        self.form_equations()

    def _place(self):
        return self.left, self.bottom, self.width, self.offset

    def draw(self):
        """Evaluate all stamps, the residual and the weights."""
        everyone = np.arange(len(self.stars))
        self._localise_psf()
        self._draw_stamps(everyone)
        self.residual = self.data - self.background()
        self._add_stars(everyone, -1.0)
        self._weigh()

    def redraw(self, changed, change):
        """Let a function change some stars, and the level; stay up to date."""
        self._add_stars(changed, 1.0)
        before = self.background()
        change()
        self._draw_stamps(changed)
        self.residual += before - self.background()
        self._add_stars(changed, -1.0)
        self._weigh()

    def _draw_stamps(self, chosen):
        s = self.stars
        kernels.star_stamps(chosen, s.x, s.y, *self._place(), s.rows,
                            s.paces, s.count, self.psf.integrated, self.jets)

    def _add_stars(self, chosen, sign):
        s = self.stars
        kernels.add_stars(chosen, sign, s.x, s.y, s.flux, *self._place(),
                          self.wing, self.jets, s.rows, s.count,
                          self.psf.integrated, _FAINTEST * self.noise,
                          self.residual)

    def background(self):
        """Return the image of the background."""
        return self.mesh.image(self.level)

    def _weigh(self):
        if self.options.gain is not None:
            # The photon noise of the model, not that of the data.
            variance = self.variance - self.residual / self.options.gain
            variance = np.maximum(variance, self.options.floor)
            np.divide(1, variance, where=self.good, out=self.weight)

    def _localise_psf(self):
        """Find the PSF of stars that have none yet."""
        s = self.stars
        new = s.count == 0
        if new.any():
            s.rows[new], s.count[new] = self.psf.rows_at(s.x[new], s.y[new])
            s.paces[new] = self.psf.paces(s.rows[new])

    def star_light(self):
        """Return the image of the stars alone."""
        return self.data - self.residual - self.background()

    # The joint fit.

    def form_equations(self):
        """Form the joint normal equations of stars and background."""
        s, p = self.stars, self.pairs
        n = len(s)
        self.matrix = np.empty((n, 3, 3))
        self.gradient, self.reach = np.empty((n, 3)), np.empty((n, 3))
        self.blocks = np.empty((p.neighbour.size, 3, 3))
        place = (*self._place(), self.jets)
        kernels.own_equations(s.flux, *place, self.weight, self.residual,
                              self.matrix, self.gradient, self.reach)
        kernels.pair_blocks(p.indptr, p.neighbour, p.twin, s.flux, *place,
                            self.weight, self.blocks)
        self._hold()
        self._expect()
        self._form_background_equations()

    def _hold(self):
        """Add what is known of the places of some stars."""
        s = self.stars
        self.matrix[:, [1, 2], [1, 2]] += s.hold[:, None]
        self.gradient[:, 1] += s.hold * (s.x_init - s.x)
        self.gradient[:, 2] += s.hold * (s.y_init - s.y)

    def _expect(self):
        """Add what is known of the fluxes of found stars."""
        s = self.stars
        # The logarithm of flux**-slope; less than half a standard error, lest
        # it drive out what may be real.
        pull = np.minimum(
            self.options.count_slope / np.maximum(s.flux, 1e-300),
            _STRONGEST_PULL * np.sqrt(np.maximum(self.matrix[:, 0, 0], 0)))
        self.gradient[:, 0] -= np.where(s.hold > 0, 0, pull)

    def _form_background_equations(self):
        """Form the matrix of the nodes' levels, and the gradient."""
        if self.options.background_size:
            # All pixels count for the information: stars are coupled through
            # all of theirs. Those far from the model say nothing of the sky.
            information, seen, total = self.mesh.sums(
                self.weight, self.residual, self.background(),
                _BACKGROUND_CLIP)
            gradient = total - seen * self.level
        else:
            self.reach[:] = 0
            information = gradient = np.zeros(self.level.size)
        # Nodes without pixels follow their neighbours.
        self.tie = self.mesh.tie / self.noise**2
        self.mesh_diagonal = information + self.tie * self.mesh.n_ties()
        self.mesh_gradient = gradient - self.tie * self.mesh.steepness(
            self.level)

    def refresh(self):
        """Bring everything up to date with the stars."""
        self.lay_out()
        self.draw()
        self.form_equations()

    def _solve(self, damping):
        """Return the Gauss-Newton step of the stars and of the level."""
        s, p = self.stars, self.pairs
        step = np.empty((len(s), 3))
        level_step = np.empty(self.level.size)
        matrix = self.matrix * (1 + damping * np.eye(3))
        kernels.solve_joint(
            matrix, self.gradient, p.indptr, p.neighbour, self.blocks,
            *self._own_node(), self.reach, self.mesh_diagonal, self.tie,
            self.mesh.shape[1], self.mesh_gradient, _TOLERANCE, _CG_STEPS,
            step, level_step)
        for k, gone in ((1, s.x - s.x_init), (2, s.y - s.y_init)):
            move = np.clip(step[:, k], -_MAX_MOVE, _MAX_MOVE)
            step[:, k] = np.where(np.isfinite(s.bound), np.clip(
                move, -s.bound - gone, s.bound - gone), move)
        step[:, 0] = np.clip(step[:, 0], (_LEAST_CHANGE - 1) * s.flux,
                             (_MOST_CHANGE - 1) * s.flux)
        return step, level_step

    def _take(self, step, level_step):
        s = self.stars
        s.flux = s.flux + step[:, 0]
        s.x = s.x + step[:, 1]
        s.y = s.y + step[:, 2]
        # A PSF that is much too wide would have the sky run away.
        self.level = np.clip(self.level + level_step, *self.limits)

    def step(self, damping=0.0, moving=slice(None)):
        """Take one Gauss-Newton step, of all stars or only some."""
        step, level_step = self._solve(damping)
        taken = np.zeros_like(step)
        taken[moving] = step[moving]
        self._take(taken, level_step)
        self.refresh()

    def polish(self, damping):
        """
        Take a step without a new layout; return how far each star moved.

        Stamps stay where they are, so that steps converge; stars that are
        at rest stay as they are.
        """
        step, level_step = self._solve(damping)
        moved = np.abs(step[:, 1:]).max(axis=1, initial=0)
        self._rein(step)
        restless = moved > REST
        restless |= (np.abs(step[:, 0]) * np.sqrt(self.matrix[:, 0, 0])
                     > REST)
        step[~restless] = 0
        self.redraw(np.flatnonzero(restless),
                    lambda: self._take(step, level_step))
        self.form_equations()
        return moved

    def start_polishing(self):
        """Remember where the stars are."""
        self.refresh()
        s = self.stars
        self.anchor = np.column_stack([s.flux, s.x, s.y])

    def _rein(self, step):
        """Keep the stars within limits of where polishing started."""
        s = self.stars
        now = np.column_stack([s.flux, s.x, s.y])
        flux = self.anchor[:, :1]
        low = self.anchor - np.hstack([flux / 2, flux * 0 + _ROAM,
                                       flux * 0 + _ROAM])
        high = self.anchor + np.hstack([flux, flux * 0 + _ROAM,
                                        flux * 0 + _ROAM])
        step[:] = np.clip(now + step, low, high) - now

    def _own_node(self):
        """Return the shares of a background that is constant in cells."""
        # Only such a one makes, with each node's own mean, a matrix that is
        # positive definite; where steps end does not depend on it.
        node, share = self.mesh.shares(self.stars.x, self.stars.y)
        own = np.zeros(share.shape)
        own[np.arange(len(own)), share.argmax(axis=1)] = 1
        return node, own

    def covariances(self):
        """Return covariances with neighbours free, and correlations."""
        p = self.pairs
        covariance = np.empty((len(self.stars), 3, 3))
        correlation = np.empty(len(self.stars))
        kernels.joint_covariances(self.matrix, p.indptr, p.neighbour,
                                  self.blocks, p.nearest, covariance,
                                  correlation)
        return covariance, correlation


def _offsets(width, start):
    """Return where stamps of these widths begin, and where they end."""
    ends = start + np.cumsum(width**2)
    return (np.concatenate([[start], ends])[:-1].astype(np.int64),
            int(ends[-1]) if len(ends) else start)
