"""Crowded scenes with other light than that of stars spread evenly."""
import sys
from dataclasses import dataclass, replace

import numpy as np
from astropy.nddata import NDData
from astropy.table import Table
from crowded_scores import Scene
from photutils.psf import GriddedPSFModel
from scipy.ndimage import binary_dilation
from scipy.special import gammaincinv

from photutils_mgauss import GriddedMixturePSF
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.simulation import crowded_field, csst_psf

ZERO, SKY, READ_NOISE, FULL_WELL = 31.24, 20.2, 5.0, 9e4


@dataclass(frozen=True)
class Optics:
    """What draws stars, and the PSF that is given to the solver."""

    psf: GriddedMixturePSF

    @classmethod
    def of(cls, size, seed):
        """Return those of a mock camera, drawn with their mixtures."""
        optics = csst_psf((size, size), n_nodes=4, rng=seed)
        return cls(GriddedMixturePSF.from_gridded_psf(
            optics.to_gridded_psf(2, radius=20), 5))

    def draw(self, truth, shape):
        """Return the light of stars without noise."""
        stars = np.array([truth[name] for name in ('x', 'y', 'flux')], float)
        return MixtureRenderer(self.psf).image(stars, 1e-3, shape)


@dataclass(frozen=True)
class HarnessOptics(Optics):
    """Optics of another simulator; the solver gets mixtures fitted to them."""

    table: object
    origin = (512, 512)

    @classmethod
    def of(cls, size, harness, file):
        """Return those of a file of the simulator in a folder."""
        sys.path.insert(0, str(harness))
        from csst_psf import TruePSF
        table = TruePSF(file)
        nodes = np.linspace(0, size - 1, 7)
        places = [(x, y) for y in nodes for x in nodes]
        data = np.array([table.epsf(*np.add(place, cls.origin), 2, 61)
                         for place in places])
        return cls(GriddedMixturePSF.from_gridded_psf(GriddedPSFModel(NDData(
            data, meta={'grid_xypos': places, 'oversampling': 2})), 6,
            radius=14), table)

    def draw(self, truth, shape, reach=None):
        """Return the light of stars without noise, as far as the table."""
        from csst_scene import stamp_radius
        image = np.zeros(shape)
        x, y, flux = (np.array(truth[name], float)
                      for name in ('x', 'y', 'flux'))
        if reach is None:
            reach = stamp_radius(ZERO - 2.5 * np.log10(flux))
        self.table.render(image, x, y, flux, reach, self.origin)
        return image


def expose(light, truth, seed):
    """Return a scene: light and sky with the noise of photons and read-out."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(light + SKY).astype(float)
    full = electrons >= FULL_WELL
    data = np.minimum(electrons, FULL_WELL) + rng.normal(0, READ_NOISE,
                                                         light.shape)
    n = len(light)
    inside = np.all([(truth[c] > -0.5) & (truth[c] < n - 0.5)
                     for c in 'xy'], axis=0)
    truth = truth[inside]
    near = binary_dilation(full, iterations=2)
    truth['sat'] = near[tuple(np.rint(truth[c]).astype(int) for c in 'yx')]
    return Scene({'sci': data, 'mask': full,
                  'err': np.sqrt(np.maximum(data, 0) + READ_NOISE**2),
                  'vartrue': light + SKY + READ_NOISE**2}, truth, (0, 0), ZERO)


def _table(x, y, mag):
    mag = np.asarray(mag, float)
    return Table({'x': np.asarray(x, float), 'y': np.asarray(y, float),
                  'mag': mag, 'flux': 10**(-0.4 * (mag - ZERO))})


def even_stars(size, seed, density=1 / 16):
    """Return stars spread evenly."""
    field = crowded_field((size, size), density=density, rng=seed)
    return _table(field['x'].value, field['y'].value, field['mag'].value)


def king_density(x, y, size, centre=0.5, core=60.0):
    """Return the stars per pixel of a cluster at positions."""
    radius = np.hypot(x - size / 2, y - size / 2)
    return centre / (1 + (radius / core)**2)


def cluster_stars(size, seed, centre=0.5):
    """Return the stars of a cluster in the middle of the image."""
    stars = even_stars(size, seed, centre)
    rng = np.random.default_rng(seed + 1)
    share = king_density(stars['x'], stars['y'], size, centre) / centre
    return stars[rng.uniform(size=len(stars)) < share]


def sersic(size, *, mag=15.0, radius=60.0, index=4.0, axis_ratio=0.7):
    """Return the light of a galaxy in the middle of the image."""
    b = gammaincinv(2 * index, 0.5)
    # Pixels near the middle are the means of parts of them.
    fine = 8
    step = (np.arange(size * fine) + 0.5) / fine - 0.5 - size / 2

    def profile(x, y):
        r = np.hypot(x, y / axis_ratio) / radius
        return np.exp(-b * r**(1 / index))
    coarse = np.arange(size) - size / 2
    image = profile(coarse[None], coarse[:, None])
    low, high = size // 2 - 16, size // 2 + 17
    part = step[low * fine:high * fine]
    image[low:high, low:high] = profile(part[None], part[:, None]).reshape(
        high - low, fine, high - low, fine).mean(axis=(1, 3))
    # The flux out to infinity, of which the image holds most.
    t = np.linspace(0, 60, 200001)[1:]
    total = 2 * np.pi * axis_ratio * radius**2 * np.trapezoid(
        t * np.exp(-b * t**(1 / index)), t)
    return image * 10**(-0.4 * (mag - ZERO)) / total


def without_core(scene, radius, kind):
    """Return a scene without its middle: masked, or NaN."""
    y, x = np.indices(scene.images['sci'].shape)
    core = np.hypot(x - scene.size / 2, y - scene.size / 2) < radius
    images = dict(scene.images)
    if kind == 'masked':
        images['mask'] = images['mask'] | core
    else:
        images['sci'] = np.where(core | images['mask'], np.nan,
                                 images['sci'])
        images['mask'] = np.zeros(core.shape, bool)
    truth = scene.truth.copy()
    near = binary_dilation(core, iterations=2)
    truth['sat'] |= near[tuple(np.rint(truth[c]).astype(int) for c in 'yx')]
    return replace(scene, images=images, truth=truth)
