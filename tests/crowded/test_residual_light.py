"""What the PSF leaves of bright stars, told from the faint stars' light."""
import numpy as np
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.crowded.residual import without_residual
from photutils_mgauss.psf.renderer import MixtureRenderer
from photutils_mgauss.utils.image import read_pixels

PSF = GriddedMixturePSF([GaussianMixture.from_stddevs(
    [0.8, 0.2], means=[(0, 0), (0, 0)], stddevs=[(0.95, 0.95), (1.9, 1.9)])],
    [(0, 0)])
SIZE, SKY, RADIUS = 420, 40.0, 16


def test_faint_stars_everywhere_are_no_residual():
    rng = np.random.default_rng(11)
    bright, faint = 36, 5000
    axis = np.arange(35, SIZE, 70)
    x, y = (np.append(grid.ravel() + rng.uniform(-4, 4, bright),
                      rng.uniform(0, SIZE - 1, faint))
            for grid in np.meshgrid(axis, axis))
    flux = np.append(rng.uniform(3e5, 2e6, bright),
                     rng.uniform(800, 3000, faint))
    image = MixtureRenderer(PSF).image(np.array([x, y, flux]), 1e-3,
                                       (SIZE, SIZE)) + SKY
    error = np.sqrt(image)
    zero = np.zeros(len(x))
    table = QTable({
        'x_fit': x, 'y_fit': y, 'flux_fit': flux, 'local_bkg': zero + SKY,
        'significance': flux / 60, 'flags': zero.astype(int),
        'neighbor_distance': zero + np.nan,
        'neighbor_correlation': zero + np.nan})
    pixels = read_pixels(rng.normal(image, error), error=error)
    after, known = without_residual(pixels, PSF, table, RADIUS)
    taken = (pixels.data - after.data).sum() / flux[:bright].sum()
    assert known is not None
    # The number of faint stars within the radius changes by chance.
    near = faint * bright * np.pi * RADIUS**2 / SIZE**2
    chance = np.sqrt(near * np.mean(flux[bright:]**2)) / flux[:bright].sum()
    assert abs(taken) < 3 * chance
