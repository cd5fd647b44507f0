"""Images of a few stars, starting values beside them, and their truth."""
import numpy as np
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, MultiGaussianPSFModel

MIXTURE = GaussianMixture.from_stddevs(
    [0.7, 0.3], [[0, 0], [0.1, 0]], [[0.9, 0.85], [1.9, 2.1]], [0.1, 0])
PSF = MultiGaussianPSFModel(MIXTURE)


def narrow_mixture(k):
    """Return K concentric Gaussians of 1.2 pixels and more."""
    sizes = 1.2 * 1.5 ** np.arange(k)
    weights = 0.5 ** np.arange(k)
    return GaussianMixture.from_stddevs(
        weights / weights.sum(), np.zeros((k, 2)),
        np.column_stack([sizes, 1.1 * sizes]), np.full(k, 0.1))


def draw(psf, stars, shape=(60, 55)):
    """Draw the stars, each over the whole image."""
    y, x = np.mgrid[:shape[0], :shape[1]]
    image = np.zeros(shape)
    for star in stars:
        model = psf.copy()
        model.x_0, model.y_0, model.flux = (star[c]
                                            for c in ('x', 'y', 'flux'))
        image += model(x, y)
    return image


def nearby(stars):
    """Return starting values a little off the stars."""
    start = stars.copy()
    start['x'] += 0.2
    start['y'] -= 0.1
    start['flux'] *= 0.9
    return start


def check(result, stars, **tolerance):
    """Compare a result table with the truth."""
    tolerance = tolerance or {'rtol': 0, 'atol': 2e-4}
    result.sort('id')
    assert_allclose(result['x_fit'], stars['x'], **tolerance)
    assert_allclose(result['y_fit'], stars['y'], **tolerance)
    assert_allclose(result['flux_fit'], stars['flux'], rtol=1e-3)
