"""A detector: its true PSF, a sparse exposure, models of its PSF."""
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from photutils.background import Background2D
from photutils.detection import DAOStarFinder
from scipy.spatial import cKDTree
from settings import BANDS, STAMP_RADIUS
from store import Run, spread

from photutils_mgauss import (
    EmpiricalPSF,
    Exposure,
    GriddedMixturePSF,
    Instrument,
    MixturePSFPhotometry,
    Optics,
    csst_psf,
    fit_mixture_field,
    select_psf_stars,
    simulate,
    sparse_field,
)

RADIUS = 10
FIT_SHAPE = (11, 11)


@dataclass(frozen=True)
class Detector:
    """
    A detector of the focal plane.

    Attributes
    ----------
    run : Run
        The sizes.
    number : int
        Its number, which is also the seed of its aberrations.
    size : int
        Its side [pix].
    """

    run: Run
    number: int
    size: int

    @property
    def band(self):
        """The name of the filter."""
        return BANDS.get(self.number, 'g')

    @property
    def name(self):
        """Number and filter, for labels."""
        return f'#{self.number:02d} {self.band}'

    @cached_property
    def truth(self):
        """The PSF that stars are drawn with."""
        shape = (self.size, self.size)
        if self.run.optics == 'mixtures':
            return csst_psf(shape, self.band, rng=self.number)
        samples, nodes = self.run.settings.optics
        optics = Optics(shape, self.band, rng=self.number, n_wavelengths=2)
        return optics.to_gridded_psf(nodes, n_samples=samples, radius=20)

    def true_image(self, x, y, *, oversampling=2, radius=20):
        """Return the true PSF, its pixel included, around a place."""
        steps = np.arange(-radius * oversampling,
                          radius * oversampling + 1) / oversampling
        return self.truth.evaluate(*np.meshgrid(x + steps, y + steps), 1, x,
                                   y)

    @cached_property
    def sparse(self):
        """An exposure of isolated stars."""
        stars = sparse_field((self.size, self.size), spacing=40,
                             rng=100 + self.number)
        return simulate(stars, Exposure(band=self.band), psf=self.truth,
                        instrument=Instrument(shape=(self.size, self.size)),
                        rng=200 + self.number)

    @cached_property
    def psf_stars(self):
        """The stars that PSFs are made of, as `select_psf_stars` gives."""
        scene = self.sparse
        return select_psf_stars(
            background_free(scene)[0], error=scene.error, mask=scene.mask,
            radius=RADIUS, fwhm=1.8, saturation=7e4,
            max_stars=self.run.settings.psf_stars)

    @cached_property
    def empirical(self):
        """The empirical PSF, polynomials of pixels sampled twice."""
        scene = self.sparse
        return EmpiricalPSF.from_stars(
            background_free(scene)[0], self.psf_stars, error=scene.error,
            mask=scene.mask, degree=self.run.settings.degree, radius=RADIUS)

    @cached_property
    def chain(self):
        """The paper's model: three Gaussians at each node of a grid."""
        grid = self.run.settings.grid
        images = self.empirical.to_gridded_psf((grid, grid), oversampling=2)
        return GriddedMixturePSF.from_gridded_psf(images, 3,
                                                  radius=STAMP_RADIUS)

    @cached_property
    def field(self):
        """The package's model: five Gaussians, fitted to the stars."""
        scene = self.sparse
        return fit_mixture_field(
            background_free(scene)[0], self.psf_stars, error=scene.error,
            mask=scene.mask, n_components=5,
            degree=self.run.settings.degree, radius=RADIUS)

    @cached_property
    def models(self):
        """The PSFs that positions are measured with, by name."""
        return {'paper': self.chain, 'field': self.field.to_grid((20, 20))}


_made = {}


def detector(run, number, size=None):
    """Return a detector, made once for each number and size."""
    key = (run.fingerprint, number, size or run.settings.size)
    if key not in _made:
        _made[key] = Detector(run, number, key[2])
    return _made[key]


def forget(size):
    """Free the memory of the detectors of a size, number 8 excepted."""
    for key in [key for key in _made if key[1] != 8 and key[2] == size]:
        del _made[key]


def background_free(scene):
    """Return the image without its background, and the background's noise."""
    found = Background2D(scene.image, 64, mask=scene.mask)
    return scene.image - found.background, found.background_rms


def find_stars(data, noise, mask, threshold=5.0):
    """Return x, y of the stars that photutils finds, as starting values."""
    found = DAOStarFinder(threshold * float(np.median(noise)), 1.8)(
        data, mask=mask)
    name = 'x_centroid' if 'x_centroid' in found.colnames else 'xcentroid'
    return found[name], found[name.replace('x', 'y', 1)]


def catalogue(scene, psf):
    """Return the measured table of an exposure, from its image alone."""
    data, noise = background_free(scene)
    finder = DAOStarFinder(5 * float(np.median(noise)), 1.8)
    photometry = MixturePSFPhotometry(psf, FIT_SHAPE, finder=finder,
                                      aperture_radius=3, effective_gain=1)
    table = photometry(data, error=noise, mask=scene.mask)
    return table[table['flags'] == 0]


def match(table, truth, limit=1.0):
    """Return rows of a table and of the truth that are the same star."""
    mine = np.column_stack([table['x_fit'], table['y_fit']])
    true = np.column_stack([truth['x'].value, truth['y'].value])
    distance, nearest = cKDTree(true).query(mine)
    back = cKDTree(mine).query(true)[1]
    good = (distance < limit) & (back[nearest] == np.arange(len(mine)))
    return np.flatnonzero(good), nearest[good]


def cubic(x, y, size):
    """Return the terms of a cubic in positions on a detector, (n, 10)."""
    u, v = (2 * np.asarray(a, float) / size - 1 for a in (x, y))
    return np.column_stack([u**i * v**j for i in range(4)
                            for j in range(4 - i)])


def calibration(detector, psf):
    """
    Return the coefficients (10, 2) of a PSF model's distortion.

    A model has its own convention of where the centre of a star is, smooth
    over the detector. It is measured with the bright stars of the sparse
    exposure, whose places a catalogue would tell.
    """
    scene = detector.sparse
    table = catalogue(scene, psf)
    i, j = match(table, scene.truth)
    bright = scene.truth['mag'].value[j] < 21.5
    i, j = i[bright], j[bright]
    shift = np.column_stack([table[f'{c}_fit'][i] - scene.truth[c][j].value
                             for c in 'xy'])
    terms = cubic(table['x_fit'][i], table['y_fit'][i], detector.size)
    return robust_fit(terms, shift)


def robust_fit(terms, values):
    """Return least-squares coefficients, outliers left out."""
    good = np.ones(len(values), bool)
    for _ in range(6):
        found = np.linalg.lstsq(terms[good], values[good], rcond=None)[0]
        rest = values - terms @ found
        limit = 5 * np.array([spread(column[good]) for column in rest.T])
        good = (np.abs(rest) <= limit + 1e-9).all(axis=1)
    return found
