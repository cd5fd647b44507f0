"""Stars that are named by words."""
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_array_equal
from photutils.psf import SourceGrouper

from helpers.star_images import PSF
from photutils_mgauss import MixturePSFPhotometry


@pytest.fixture
def scene(rng):
    """Return an image, its error, and a table with numbers."""
    stars = QTable({'id': [2, 1, 4, 3], 'x': [12.3, 40.1, 25.2, 29.0],
                    'y': [20.1, 41.7, 9.5, 10.2],
                    'flux': [5e3, 4e3, 6e3, 3e3]})
    y, x = np.mgrid[:55, :55]
    model, data = PSF.copy(), rng.normal(0, 1, (55, 55))
    for star in stars:
        model.flux, model.x_0, model.y_0 = star['flux'], star['x'], star['y']
        data += model(x, y)
    return data, np.ones(data.shape), stars


@pytest.mark.parametrize('grouper', [None, SourceGrouper(8)])
@pytest.mark.parametrize('kind', [str, bytes, object])
def test_words_name_stars_as_numbers_do(scene, grouper, kind):
    data, error, stars = scene
    numbered = MixturePSFPhotometry(PSF, 9, grouper=grouper)(
        data, error=error, init_params=stars)
    named = stars.copy()
    named['id'] = np.array([f'star {number}' for number in stars['id']],
                           dtype={str: 'U6', bytes: 'S6'}.get(kind, object))
    table = MixturePSFPhotometry(PSF, 9, grouper=grouper)(
        data, error=error, init_params=named)
    assert [str(name)[-2:].strip("'")[-1] for name in table['id']] == [
        '1', '2', '3', '4']
    for name in ('x_fit', 'y_fit', 'flux_fit', 'group_size'):
        assert_array_equal(table[name], numbered[name])


def test_a_name_given_twice_is_an_error(scene):
    data, error, stars = scene
    stars['id'] = ['a', 'b', 'a', 'c']
    with pytest.raises(ValueError, match='unique values of id, got a 2 times'):
        MixturePSFPhotometry(PSF, 9)(data, error=error, init_params=stars)
