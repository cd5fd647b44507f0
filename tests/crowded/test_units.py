"""Results do not depend on the unit of an image."""
from functools import cache

import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    MixturePSFPhotometry,
    render_stars,
)
from photutils_mgauss.crowded.background import Mesh
from photutils_mgauss.crowded.diffuse import Diffuse
from photutils_mgauss.crowded.far_light import _N_RINGS, _equations

N = 120
UNITS = (2.0**20, 1e-8)
PSF = GriddedMixturePSF([GaussianMixture.from_stddevs(
    [.75, .23, .02], np.zeros((3, 2)), [(.95, .95), (1.6, 1.6), (4, 4)])],
    [(N / 2, N / 2)])
# A logarithm changes by rounding with the unit, and with it when steps end.
EQUAL = {'rtol': 1e-5, 'atol': 1e-7}


@cache
def scene(n_stars, power):
    """Return an image of stars on smooth light, its errors and its stars."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(3, N - 3, (2, n_stars))
    if n_stars <= 49:
        k = np.arange(n_stars)
        x, y = 17.0 * np.array([k % 7, k // 7]) + 9 + np.array([x, y]) % 1
    flux = np.minimum(120 * (rng.pareto(power, n_stars) + 0.3), 3e5)
    j, i = np.indices((N, N))
    light = (render_stars(PSF, x, y, flux, (N, N)) + 50
             + 30 * np.exp(-((i - 40)**2 + (j - 70)**2) / 3200))
    error = np.sqrt(light + 9)
    return rng.normal(light, error), error, x, y, flux


def compare(table, other, unit):
    """Check that the columns of two tables are the same in their units."""
    gap, row = cKDTree(np.column_stack(
        [other['x_fit'], other['y_fit']])).query(np.column_stack(
            [table['x_fit'], table['y_fit']]))
    assert len(table) == len(other)
    assert gap.max() < 1e-4
    for name in table.colnames:
        scale = unit if name.startswith(('flux', 'local_bkg')) else 1
        old = np.asarray(table[name], float)
        assert_allclose(np.asarray(other[name], float)[row] / scale, old,
                        **EQUAL if name != 'id' else {'atol': len(table)},
                        err_msg=name)


@pytest.mark.parametrize('unit', UNITS)
@pytest.mark.parametrize('has_error', [True, False])
def test_a_crowded_image_has_the_same_stars_in_any_unit(unit, has_error):
    data, error = scene(300, 1.1)[:2]
    level = np.percentile(data, 99.7)

    def measured(unit):
        return CrowdedMixturePhotometry(
            PSF, saturation=level * unit, effective_gain=1 / unit)(
                data * unit, error=error * unit if has_error else None)
    first = measured(1)
    assert (first['flags'] & 65536).any()
    compare(first, measured(unit), unit)


@pytest.mark.parametrize('unit', UNITS)
@pytest.mark.parametrize('has_error', [True, False])
def test_saturated_stars_have_the_same_errors_in_any_unit(unit, has_error):
    data, error, x, y, flux = scene(49, 0.5)
    data = data - 50
    stars = Table({'x': x, 'y': y, 'flux': flux})

    def measured(unit):
        listed = stars.copy()
        listed['flux'] *= unit
        return MixturePSFPhotometry(
            PSF, fit_shape=9, saturation=3000 * unit,
            effective_gain=1 / unit)(
                data * unit, init_params=listed,
                error=error * unit if has_error else None)
    compare(measured(1), measured(unit), unit)


@pytest.mark.parametrize('unit', UNITS)
def test_smooth_light_is_the_same_in_any_unit(unit):
    data, error = scene(300, 1.1)[:2]
    good, noise = np.ones((N, N), bool), np.median(error)
    first, second = Diffuse((N, N), (0, 0)), Diffuse((N, N), (0, 0))
    mesh = Mesh((N, N), (0, 0), 64)
    wide = first.begin(data - 50, good, noise, mesh)
    assert_allclose(second.begin(unit * (data - 50), good, unit * noise,
                                 mesh) / unit, wide, rtol=1e-9)
    assert np.abs(first.level).max() > 1
    assert_allclose(second.level / unit, first.level, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('unit', UNITS)
def test_light_beyond_stamps_is_the_same_in_any_unit(unit):
    data, error, x, y, flux = scene(49, 0.5)
    edges = np.geomspace(2, 12, _N_RINGS + 1)

    def equations(unit):
        return _equations(unit * data, (unit * error)**2, 0 * data,
                          np.array([x, y, unit * flux]), edges, 64)
    for one, other in zip(equations(1), equations(unit), strict=True):
        assert_allclose(other, one, rtol=1e-6, atol=1e-6 * np.abs(one).max())
