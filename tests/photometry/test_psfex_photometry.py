"""A PSFEx model of a real chip as a grid of mixtures, inside photutils."""
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose
from photutils.psf import PSFPhotometry
from scipy.ndimage import map_coordinates

from photutils_mgauss import GriddedMixturePSF, read_psfex

FLUX = 40000.0


def draw_star(model, x, y, half):
    """Draw a star of PSFEx's pixels at (x, y), interpolated by splines."""
    dy, dx = np.mgrid[-half:half + 1, -half:half + 1]
    dx, dy = dx + np.rint(x) - x, dy + np.rint(y) - y
    plane = model.image_at(x, y)
    place = [model.origin[1] + dy / model.sampling,
             model.origin[0] + dx / model.sampling]
    stamp = map_coordinates(plane, place, order=5)
    return FLUX * stamp / plane.sum() / model.sampling**2


@pytest.mark.filterwarnings('ignore:positions measured with these mixtures')
def test_stars_of_a_psfex_model_are_measured_where_they_are(realdata, rng):
    (path,) = realdata('decam_psfex').glob('DECam_00241238_01_*deg2.psf')
    model = read_psfex(path)
    psf = GriddedMixturePSF.from_psfex(path, 5, grid_shape=(8, 4))
    (x_low, x_high), (y_low, y_high) = model.position_range
    gx, gy = np.meshgrid(np.linspace(x_low + 60, x_high - 60, 5),
                         np.linspace(y_low + 60, y_high - 60, 8))
    x = gx.ravel() + rng.uniform(-0.5, 0.5, gx.size)
    y = gy.ravel() + rng.uniform(-0.5, 0.5, gy.size)
    image = np.zeros((int(y_high) + 40, int(x_high) + 40))
    for star in zip(x, y, strict=True):
        i, j = (int(np.rint(c)) for c in star)
        image[j - 12:j + 13, i - 12:i + 13] += draw_star(model, *star, 12)
    start = QTable({'x': np.rint(x), 'y': np.rint(y),
                    'flux': np.full(x.size, FLUX)})
    result = PSFPhotometry(psf, (13, 13))(image, init_params=start)
    result.sort('id')
    assert (result['flags'] == 0).all()
    # At the noise of S/N 200 a position is good to about 8 mpix here.
    assert_allclose(result['x_fit'], x, atol=0.008)
    assert_allclose(result['y_fit'], y, atol=0.008)
    assert_allclose(result['flux_fit'], FLUX, rtol=0.02)
