r"""
The model of one tile of a crowded image: stars on a background.

The image is modelled as stars of unknown positions and fluxes on a bilinear
background,

.. math::

    M(\mathbf{r}) = b(\mathbf{r}) + \sum_i f_i\,
    P(\mathbf{r} - \mathbf{r}_i\,|\,\mathbf{r}_i).

Positions here are tile pixels.
"""
import numpy as np

from photutils_mgauss import kernels
from photutils_mgauss.crowded.background import Mesh
from photutils_mgauss.crowded.diffuse import Diffuse
from photutils_mgauss.crowded.stars import Neighbours, Stars, reach_of_pairs
from photutils_mgauss.psf.wings import reach_of_wings

# Fit stamps are 7 or 9 pixels wide, 13 for bright stars: almost all of the
# information on a position lies in the core. Of wide PSFs they are wider.
_MIN_HALF, _MAX_HALF, _BRIGHT_HALF = 3, 4, 6
# In units of noise over the PSF's peak.
_BRIGHT_FLUX = 300
# A star is drawn out to where its surface brightness falls below this
# fraction of the noise.
_WING_NOISE = 0.2
# Of a star drawn afresh, Gaussians are left out where they fall below this
# fraction of the noise.
_FAINTEST = 1e-3
# Of saturated stars only the wings are seen, where the PSF is less certain:
# their light counts so many times more.
_WING_DOUBT = 5


class Model:
    """
    Stars and background of a tile, up to date with its residual and weights.

    Only the methods here change its attributes.

    Parameters
    ----------
    job : TileJob

    Attributes
    ----------
    stars : Stars
    level : (m,) `~numpy.ndarray`
        The background at the nodes of ``mesh``; ``first_level`` was the first.
    residual, weight : (ny, nx) `~numpy.ndarray`
        What the model leaves of the data, and inverse variances.
    stamps, gaussians : kernels.Stamps, kernels.Gaussians
        Each star's pixels and PSF.
    wing : (n,) `~numpy.ndarray` of int
        How far from its middle pixel each star is drawn [pix].
    neighbours : Neighbours
    """

    def __init__(self, job):
        self.data = job.data
        self.variance = job.variance
        self.wing_variance = None
        self.good = job.variance > 0
        self.psf = job.psf
        self.options = job.options
        self.noise = job.options.noise
        self.weight = np.divide(1, self.variance, where=self.good,
                                out=np.zeros(self.data.shape))
        self._make_mesh(job.origin)
        self._put(Stars([], [], []))

    def _make_mesh(self, origin):
        size = self.options.background_size
        self.mesh = Mesh(self.data.shape, origin,
                         size or max(self.data.shape))
        # Stars hide the sky.
        self.diffuse = Diffuse(self.data.shape, origin, self.psf.scale)
        if not size:
            self.level = self.first_level = np.zeros(self.mesh.size)
            self.limits = -np.inf, np.inf
            return
        start = self.first_level = self.mesh.start(self.data, self.good,
                                                   self.noise)
        # On a slope the faint pixels of a node say where it is low.
        flat = self.data - self.mesh.image(start)
        low, high = self.mesh.limits(flat, self.good, self.noise)
        self.limits = start + low, start + high
        self.level = start + self.diffuse.begin(flat, self.good, self.noise,
                                                self.mesh)
        self.diffuse.bound(flat, self.good, self.noise, self.mesh, start, low)

    def _put(self, stars):
        self.stars = stars
        self.gaussians = self.psf.gaussians_at(np.empty(0), np.empty(0))

    def start(self, stars):
        """Put stars in place of all others."""
        self._put(stars)
        self.refresh()

    def refresh(self):
        """Choose stamps and wings, list neighbours, and draw everything."""
        everyone = np.arange(len(self.stars))
        self.wing, self.stamps = self._frames(everyone, 0)
        self._connect()
        self._localise_psf()
        self._draw_stamps(everyone)
        self.residual = self.data - self.background()
        self._add_stars(everyone, -1.0)
        self._weigh()

    def _frames(self, chosen, start):
        """Return wings and stamps, from start on, of the chosen stars."""
        s = self.stars
        flux = np.maximum(s.flux[chosen], 1e-300)
        profile = self.psf.profile
        least, usual, widest = (round(self.psf.scale * half) for half in (
            _MIN_HALF, _MAX_HALF, _BRIGHT_HALF))
        wing = np.clip(
            np.searchsorted(-profile, -_WING_NOISE * self.noise / flux),
            least, self.psf.max_wing)
        bright = flux * profile[0] > _BRIGHT_FLUX * self.noise
        half = np.clip(wing, least, np.where(bright, widest, usual))
        seeded = s.seeded[chosen]
        half[seeded] = np.maximum(widest + 2, s.core[chosen][seeded]
                                  + reach_of_wings(self.psf))
        width = 2 * half + 1
        ends = np.concatenate([[0], np.cumsum(width**2)]).astype(np.int64)
        return np.maximum(wing, half).astype(np.int64), kernels.Stamps(
            np.rint(s.x[chosen]).astype(np.int64) - half,
            np.rint(s.y[chosen]).astype(np.int64) - half, width,
            start + ends[:-1], np.empty((3, ends[-1])))

    def admit(self, found):
        """Add stars; the others stay as they are."""
        new = np.arange(len(self.stars), len(self.stars) + len(found))
        self.stars = Stars.joined([self.stars, found])
        wing, stamps = self._frames(new, self.stamps.derivatives.shape[1])
        self.wing = np.concatenate([self.wing, wing])
        self.stamps = kernels.Stamps(*(
            np.concatenate(parts, axis=-1)
            for parts in zip(self.stamps, stamps, strict=True)))
        self._localise_psf()
        self._draw_stamps(new)
        self._add_stars(new, -1.0)
        self._reconnect()

    def dismiss(self, gone):
        """Take stars away; the others stay as they are."""
        self._add_stars(np.flatnonzero(gone), 1.0)
        self.stars = self.stars.chosen(~gone)
        self.wing = self.wing[~gone]
        *frame, derivatives = self.stamps
        self.stamps = kernels.Stamps(*(part[~gone] for part in frame),
                                     derivatives)
        *rows, integrated = self.gaussians
        self.gaussians = kernels.Gaussians(*(part[~gone] for part in rows),
                                           integrated)
        self._reconnect()

    def _reconnect(self):
        self._weigh()
        self._connect()

    def _connect(self):
        self.neighbours = Neighbours.of(self.stars.x, self.stars.y,
                                        reach_of_pairs(self.psf.area))

    def take(self, step, level_step):
        """Change the stars by a step (n, 3), and the level; draw nothing."""
        self.stars.take(step)
        # A PSF that is much too wide would have the sky run away.
        self.level = np.clip(self.level + level_step, *self.limits)

    def take_in_place(self, step, level_step, changed):
        """Take a step that changes some stars only; stamps stay in place."""
        self._add_stars(changed, 1.0)
        before = self.level
        self.take(step, level_step)
        self._draw_stamps(changed)
        # The background is linear in its levels.
        self.residual += self.mesh.image(before - self.level)
        self._add_stars(changed, -1.0)
        self._weigh()

    def _draw_stamps(self, chosen):
        widest = self.stamps.width[chosen].max(initial=1)
        kernels.star_stamps(chosen, self.stars.sources, self.stamps,
                            self.gaussians, kernels.Tiling.empty(widest))

    def _add_stars(self, chosen, sign, image=None):
        image = self.residual if image is None else image
        kernels.add_stars(chosen, sign, self.stars.sources, self.stamps,
                          self.wing, self.gaussians, _FAINTEST * self.noise,
                          kernels.WingScratch.empty(image.shape[1]), image)

    def add_light(self, chosen, image):
        """Add the light of chosen stars to an image, in place."""
        self._add_stars(chosen, 1.0, image)

    def take_off(self, image, variance):
        """Take light that is no star's, known to a variance, off the data."""
        self.data = self.data - image
        self.residual -= image
        self.variance = np.where(self.good, self.variance + variance,
                                 self.variance)
        self.wing_variance = variance
        np.divide(1, self.variance, where=self.good, out=self.weight)
        self._weigh()

    def background(self):
        """Return the image of the background, diffuse light included."""
        return self.mesh.image(self.level) + self.diffuse.image()

    def background_at(self, x, y):
        """Return the background at positions (n,)."""
        return (self.mesh.at(x, y, self.level)
                + self.diffuse.mesh.at(x, y, self.diffuse.level))

    def update_diffuse(self):
        """Find again the diffuse light that stars and sky leave over."""
        if self.options.background_size:
            before = self.background()
            self.level = np.clip(self.level + self.diffuse.update(
                self.residual, self.weight, self.mesh, self.noise),
                *self.limits)
            self.diffuse.keep_bounds(self.mesh, self.level)
            self.residual += before - self.background()

    def star_light(self):
        """Return the image of the stars alone."""
        return self.data - self.residual - self.background()

    def doubtful_light(self, psf_error):
        """Return the image of what errors of the PSF make of the stars."""
        light = self.star_light()
        seeded = np.flatnonzero(self.stars.seeded)
        if seeded.size:
            self._add_stars(seeded, float(_WING_DOUBT), light)
        return psf_error * np.maximum(light, 0)

    def _weigh(self):
        if self.options.gain is not None:
            # The photon noise of the model, not that of the data.
            variance = self.variance - self.residual / self.options.gain
            variance = np.maximum(variance, self.options.floor)
            np.divide(1, variance, where=self.good, out=self.weight)

    def _localise_psf(self):
        """Find the PSF of stars that have none yet, the last ones."""
        s, known = self.stars, self.gaussians.count.size
        if known == len(s):
            return
        new = self.psf.gaussians_at(s.x[known:], s.y[known:])
        *parts, integrated = zip(self.gaussians, new, strict=True)
        self.gaussians = kernels.Gaussians(
            *(np.concatenate(part) for part in parts), integrated[0])

    def planes(self, light):
        """Return weights, residual and an image as the kernels take them."""
        return kernels.Planes(self.weight, self.residual, light)
