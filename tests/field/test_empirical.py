"""The pixel basis describes what a few Gaussians cannot."""
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from photutils_mgauss import EmpiricalPSF, GriddedMixturePSF

SHAPE = (220, 260)


def moffat(dx, dy, width):
    """Return a PSF of unit flux that is no sum of a few Gaussians."""
    return 2 / (np.pi * width**2) * (1 + (dx**2 + dy**2) / width**2) ** -3.0


def width_at(x):
    return 3.0 + x / 500


@pytest.fixture(scope='module')
def empirical():
    rng = np.random.default_rng(4)
    grid = np.mgrid[15:250:23, 15:210:23].reshape(2, -1)
    x, y = grid + rng.uniform(-2, 2, grid.shape)
    j, i = np.mgrid[:SHAPE[0], :SHAPE[1]]
    clean = sum(1e5 * moffat(i - a, j - b, width_at(a))
                for a, b in zip(x, y, strict=True))
    data = rng.poisson(clean + 30) - 30.0
    return EmpiricalPSF.from_stars(
        data, Table({'x': x, 'y': y}), error=np.sqrt(clean + 30), degree=1,
        n_components=2, radius=9)


def profiles(empirical, x, y):
    """Return the image, the truth and the smooth part on its lattice."""
    image = empirical.image_at(x, y)
    steps = (np.arange(len(image)) - len(image) // 2) / 2
    truth = moffat(steps, steps[:, None], width_at(x))
    smooth = empirical.field.mixture_at(x, y).evaluate(steps, steps[:, None])
    inside = np.hypot(steps, steps[:, None]) < 8
    return image[inside], truth[inside], smooth[inside]


@pytest.mark.parametrize(('x', 'y'), [(130, 110), (40, 40), (230, 180)])
def test_the_correction_brings_the_psf_near_the_truth(empirical, x, y):
    image, truth, smooth = profiles(empirical, x, y)
    # The overall flux of the wings is not known; shapes are compared.
    error = np.abs(image / image.sum() - truth / truth.sum()).max()
    before = np.abs(smooth / smooth.sum() - truth / truth.sum()).max()
    assert error < 0.5 * before
    assert error < 0.02 * truth.max() / truth.sum()


def test_images_of_any_sampling_are_the_same_function(empirical):
    two, four = (empirical.image_at(90, 60, oversampling=n) for n in (2, 4))
    assert_allclose(four[::2, ::2], two, atol=1e-12)


@pytest.mark.filterwarnings('ignore:positions measured with these mixtures')
def test_it_becomes_a_photutils_grid_and_mixtures(empirical):
    grid = empirical.to_gridded_psf((2, 2))
    assert_allclose(grid.grid_xypos[-1], [259, 219])
    image = empirical.image_at(0, 219, oversampling=4)
    assert_allclose(grid.data[2], image)
    mixtures = GriddedMixturePSF.from_gridded_psf(grid, 3, radius=8)
    peak = mixtures.mixture_at(0, 0).evaluate(0, 0)
    assert_allclose(peak * mixtures.scale_at(0, 0),
                    empirical.image_at(0, 0).max(), rtol=0.05)
