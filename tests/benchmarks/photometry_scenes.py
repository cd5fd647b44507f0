"""Images of stars with known positions, to time and test photometry on."""
import numpy as np
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, GriddedMixturePSF

STEP = 13  # between stars of the lattice, pixels


def make_psf(size):
    """Return a 4 x 4 grid of mixtures of three Gaussians, FWHM 2 pixels."""
    nodes = np.linspace(0, size, 4)
    xy = [(x, y) for y in nodes for x in nodes]
    return GriddedMixturePSF([_mixture(x / size, y / size) for x, y in xy],
                             xy)


def _mixture(u, v):
    return GaussianMixture.from_stddevs(
        [0.6, 0.3, 0.1], [[0, 0], [0.05 * u, 0.02], [-0.1, 0.1 * v]],
        [[0.8 + 0.05 * u, 0.85], [1.4, 1.3 + 0.1 * v], [2.6, 2.9]],
        [0.1 * v, -0.05, 0.02])


def make_scene(n, rng):
    """Return PSF, image, errors and a table of initial values."""
    side = int(np.ceil(np.sqrt(n)))
    size = STEP * side + 20
    x, y = np.meshgrid(*[np.arange(side) * STEP + 15.0] * 2)
    x = x.ravel()[:n] + rng.uniform(-0.5, 0.5, n)
    y = y.ravel()[:n] + rng.uniform(-0.5, 0.5, n)
    flux = 10 ** rng.uniform(3, 5, n)
    psf = make_psf(size)
    image = np.zeros((size, size))
    add_stars(image, psf, x, y, flux)
    error = np.sqrt(image + 100)
    image += error * rng.standard_normal(image.shape)
    start = QTable({'x': x + rng.normal(0, 0.15, n),
                    'y': y + rng.normal(0, 0.15, n),
                    'flux': flux * rng.uniform(0.8, 1.2, n)})
    return psf, image, error, start


def add_stars(image, psf, x, y, flux):
    """Add stars to an image, on stamps of 21 pixels."""
    padded = np.pad(image, 11)
    for first in range(0, x.size, 10000):
        part = slice(first, first + 10000)
        stamps = psf.render(x[part], y[part], flux[part], 21)
        left = np.rint(x[part]).astype(int) + 1
        low = np.rint(y[part]).astype(int) + 1
        for stamp, i, j in zip(stamps, left, low, strict=True):
            padded[j:j + 21, i:i + 21] += stamp
    image[:] = padded[11:-11, 11:-11]


def make_group(psf, n, rng):
    """
    Return the image of a group of n stars and a table of initial values.

    One star in 3 x 3 pixels or so, none closer to another than 1 pixel; the
    noise is 5 everywhere.
    """
    across = int(np.ceil(np.sqrt(n)))
    side = 3 * across + 12
    x, y = np.divmod(np.arange(n), across) * np.array([[3], [3]]) + 7.0
    x, y = x + rng.uniform(-1, 1, n), y + rng.uniform(-1, 1, n)
    flux = 10 ** rng.uniform(3.5, 4.5, n)
    image = rng.normal(0, 5, (side, side))
    for a, b, f in zip(x, y, flux, strict=True):
        image += psf.mixture.render(image.shape, a, b, flux=f)
    start = QTable({'x': x + rng.normal(0, 0.05, n),
                    'y': y + rng.normal(0, 0.05, n), 'flux': flux,
                    'group_id': np.ones(n, int)})
    return image, start
