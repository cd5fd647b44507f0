"""A detector: its true PSF, a sparse exposure, models of its PSF."""
import tempfile
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable
from peers import psfex
from photutils.background import Background2D
from photutils.detection import DAOStarFinder
from scipy.spatial import cKDTree
from settings import (
    BANDS,
    DETECTOR,
    POINT_SOURCES,
    STAMP_RADIUS,
    STARS,
    TABLE_2_DETECTORS,
    effects,
)
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
    sky_field,
    sparse_field,
)

RADIUS = 10
FIT_SHAPE = (11, 11)
# More pixels than the images of small runs have.
LARGE = 2_000_000


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
    shape : (ny, nx) tuple of int
        Its pixels.
    """

    run: Run
    number: int
    shape: tuple

    @property
    def band(self):
        """The name of the filter."""
        return BANDS[self.number]

    @property
    def name(self):
        """Number and filter, for labels."""
        return f'#{self.number:02d} {self.band}'

    @cached_property
    def light(self):
        """The PSF before the detector spreads the charge."""
        seed = 1000 * self.run.seed + self.number
        if self.run.optics == 'mixtures':
            return csst_psf(self.shape, self.band, rng=seed)
        samples, nodes = self.run.settings.optics
        optics = Optics(self.shape, self.band, rng=seed)
        return optics.to_gridded_psf(nodes, n_samples=samples, radius=24)

    @cached_property
    def truth(self):
        """The PSF of faint stars, the spread of charge included."""
        return self.sparse.psf

    @cached_property
    def true_image(self):
        """What gives the true PSF at x, y, its pixel included."""
        steps = np.arange(-40, 41) / 2

        # Several models are compared with it at the same places.
        @cache
        def image(x, y):
            return self.truth.evaluate(*np.meshgrid(x + steps, y + steps), 1,
                                       x, y)
        return image

    @cached_property
    def sparse(self):
        """The exposure that PSFs are made of, with all effects."""
        seed = 1000 * self.run.seed + self.number
        spacing = self.run.settings.spacing
        if spacing is None:
            stars = paper_stars(self.shape, 100_000 + seed)
        else:
            stars = sparse_field(self.shape, spacing=spacing,
                                 rng=100_000 + seed)
        return through_files(simulate(
            stars, Exposure(band=self.band, detector=self.number),
            psf=self.light, effects=effects(), rng=200_000 + seed,
            instrument=Instrument(shape=self.shape)))

    @cached_property
    def clean(self):
        """The image of that exposure without its background."""
        # Minutes for a whole detector, and three fits need it.
        return self.sparse.image - background_of(self.sparse).background

    def release(self):
        """Free the memory of the exposure, 2.5 GB of a whole one."""
        if self.truth and np.prod(self.shape) > LARGE:
            for name in ('sparse', 'clean'):
                vars(self).pop(name, None)

    @cached_property
    def psf_stars(self):
        """The stars that PSFs are made of, as `select_psf_stars` gives."""
        scene = self.sparse
        return select_psf_stars(
            self.clean, error=scene.error, mask=scene.mask, radius=RADIUS,
            fwhm=1.8, saturation=7e4,
            max_stars=self.run.settings.psf_stars)

    @cached_property
    def empirical(self):
        """The empirical PSF, polynomials of pixels sampled twice."""
        scene = self.sparse
        return EmpiricalPSF.from_stars(
            self.clean, self.psf_stars, error=scene.error, mask=scene.mask,
            degree=self.run.settings.degree, radius=RADIUS)

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
            self.clean, self.psf_stars, error=scene.error, mask=scene.mask,
            n_components=5, degree=self.run.settings.degree, radius=RADIUS)

    @cached_property
    def psfex(self):
        """What PSFEx makes of the exposure, and the file that has it."""
        path = self.run.folder / 'partial' / f'psfex_{self.number:02d}.psf'
        return psfex(self.sparse, self.run.settings.degree, path), path

    @cached_property
    def models(self):
        """The PSFs that positions are measured with, by name."""
        found = {'paper': self.chain, 'field': self.field.to_grid((20, 20))}
        self.release()
        return found


_made = {}


def detector(run, number, shape=None):
    """Return a detector, made once for each number and shape."""
    key = run.settings, run.optics, run.seed, number, (
        shape or run.settings.shape)
    if key not in _made:
        _made[key] = Detector(run, number, key[-1])
    return _made[key]


def forget(one):
    """Free the memory of a detector, unless motions are measured on it."""
    one.release()
    if one.number not in TABLE_2_DETECTORS:
        for key in [key for key, value in _made.items() if value is one]:
            del _made[key]


def paper_stars(shape, seed):
    """
    Return the point sources of the paper's pointings, at random places.

    Their magnitudes are those of `sky_field` in g, in every band.
    """
    rng = np.random.default_rng(seed)
    number = round(POINT_SOURCES * np.prod(shape) / np.prod(DETECTOR))
    stars = round(STARS * number)
    table = sky_field(stars, number - stars, rng=rng)
    ny, nx = shape
    return QTable({'id': table['id'], 'mag': table['mag_g'],
                   'x': rng.uniform(-0.5, nx - 0.5, number) * u.pix,
                   'y': rng.uniform(-0.5, ny - 0.5, number) * u.pix})


def through_files(scene):
    """
    Return a scene as a pipeline delivers it, in three FITS files.

    They are the image [electron / s], its flags (``_flg``) and its inverse
    variance (``_wht``); all that is measured is measured from them.
    """
    time = scene.instrument.exposure_time
    with tempfile.TemporaryDirectory() as folder:
        paths = scene.write(Path(folder) / 'image.fits', layout='csst')
        image, flags, weight = (fits.getdata(path) for path in paths[:3])
    good = weight > 0
    # The error of a bad pixel, which is masked, only has to be a number.
    error = np.full(weight.shape, time / np.sqrt(np.median(weight[good])))
    error[good] = time / np.sqrt(weight[good].astype(float))
    return replace(scene, image=time * image.astype(float), error=error,
                   flags=flags)


def background_of(scene):
    """Return the background of an image, as photutils measures it."""
    # A saturated star may take much of a box.
    return Background2D(scene.image, 64, mask=scene.mask,
                        exclude_percentile=50)


def background_free(scene):
    """Return the image without its background, and the background's noise."""
    found = background_of(scene)
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
    # A few masked pixels in a star's window (flag 1) do not spoil its fit.
    whole = FIT_SHAPE[0] * FIT_SHAPE[1]
    return table[((table['flags'] & ~1) == 0)
                 & (table['n_pixels_fit'] > 0.8 * whole)]


def match(table, truth, limit=1.0):
    """Return rows of a table and of the truth that are the same star."""
    mine = np.column_stack([table['x_fit'], table['y_fit']])
    true = np.column_stack([truth['x'].value, truth['y'].value])
    distance, nearest = cKDTree(true).query(mine)
    back = cKDTree(mine).query(true)[1]
    good = (distance < limit) & (back[nearest] == np.arange(len(mine)))
    return np.flatnonzero(good), nearest[good]


def cubic(x, y, shape):
    """Return the terms of a cubic in positions on a detector, (n, 10)."""
    across, up = (2 * np.asarray(a, float) / n - 1
                  for a, n in zip((x, y), shape[::-1], strict=True))
    return np.column_stack([across**i * up**j for i in range(4)
                            for j in range(4 - i)])


def robust_fit(terms, values):
    """Return least-squares coefficients, outliers left out."""
    good = np.ones(len(values), bool)
    for _ in range(6):
        found = np.linalg.lstsq(terms[good], values[good], rcond=None)[0]
        rest = values - terms @ found
        limit = 5 * np.array([spread(column[good]) for column in rest.T])
        good = (np.abs(rest) <= limit + 1e-9).all(axis=1)
    return found
