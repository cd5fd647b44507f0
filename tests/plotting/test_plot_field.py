"""Figures of PSF fields hold what they should."""
import numpy as np
import pytest
from astropy.table import Table
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, fit_mixture_field

SHAPE = (80, 120)


@pytest.fixture(scope='module')
def field():
    rng = np.random.default_rng(2)
    stars = Table({'x': rng.uniform(9, 110, 12), 'y': rng.uniform(9, 70, 12)})
    data = sum(GaussianMixture([1], [[0, 0]], [[[2 + x / 60, 0], [0, 2]]])
               .render(SHAPE, x, y, flux=3000)
               for x, y in stars.iterrows())
    data += rng.normal(0, 1, SHAPE)
    return fit_mixture_field(data, stars, error=np.ones(SHAPE), degree=1,
                             n_components=1, radius=7)


@pytest.fixture
def ax():
    return Figure().add_subplot()


def test_the_map_of_sizes_grows_with_the_psf(field, ax):
    values = field.plot(n=6, ax=ax).collections[0].get_array()
    assert values.shape == (4, 6)
    # R^2 is the trace of the covariance, 4 + x / 60.
    assert_allclose(values[:, 0], 4 + 9.5 / 60, atol=0.3)
    assert_allclose(values[:, -1], 4 + 109.5 / 60, atol=0.3)


def test_stars_that_are_used_are_marked(field, ax):
    field.plot(ax=ax)
    used, dropped = ax.collections[1:]
    assert len(used.get_offsets()) == field.stars['used'].sum()
    assert len(dropped.get_offsets()) == (~field.stars['used']).sum()


def test_whiskers_lie_along_the_major_axis(field, ax):
    whiskers = field.plot('ellipticity', n=6, ax=ax).collections[0]
    assert np.all(np.abs(whiskers.V[-3:]) < 0.2 * np.abs(whiskers.U[-3:]))


def test_the_mean_residual_of_a_good_field_is_noise(field, ax):
    image = field.plot('residual', ax=ax).images[0].get_array()
    assert image.shape == (15, 15)
    assert np.nanmax(np.abs(image)) < 2e-3


def test_an_unknown_quantity_is_an_error(field, ax):
    with pytest.raises(ValueError, match='quantity must be'):
        field.plot('colour', ax=ax)
