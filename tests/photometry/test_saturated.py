"""Saturated stars in PSF photometry: masked, and fitted to their wings."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from photutils.detection import DAOStarFinder

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    MixturePSFPhotometry,
    decode_psf_flags,
)

MIXTURE = GaussianMixture([0.7, 0.3], [(0, 0), (0, 0)],
                          [[[0.9, 0.1], [0.1, 0.8]], [[4, 0], [0, 4]]])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])
SKY, FULL = 50.0, 2e4
PEAK = MIXTURE.render((15, 15), 7, 7).max()


def scene(seed=1, bright=2.0):
    """Return data, errors, stars (n, 3) and which of them saturate."""
    rng = np.random.default_rng(seed)
    y, x = (v.ravel() for v in np.mgrid[20:160:35, 20:160:35])
    stars = np.column_stack([x, y, np.zeros(x.size)]) + np.append(
        rng.uniform(-0.5, 0.5, (x.size, 2)), np.zeros((x.size, 1)), axis=1)
    saturated = np.arange(x.size) % 2 == 0
    stars[:, 2] = FULL / PEAK * np.where(saturated, 10**(0.4 * bright), 0.3)
    light = sum(MIXTURE.render((170, 170), a, b, flux=f)
                for a, b, f in stars)
    data = rng.normal(light + SKY, np.sqrt(light + SKY))
    for a, b, _ in stars[saturated]:
        # Charge runs along columns.
        data[round(b) - 6:round(b) + 7, round(a)] = 2 * FULL
    return np.minimum(data, FULL) - SKY, light, stars, saturated


def measured(saturation, data, light, **given):
    phot = MixturePSFPhotometry(PSF, 9, saturation=saturation,
                                finder=DAOStarFinder(500.0, 2.3),
                                aperture_radius=3)
    return phot(data, error=np.sqrt(light + SKY), **given)


@pytest.fixture(scope='module')
def sky_scene():
    return scene()


@pytest.mark.parametrize('how', ['list', 'finder'])
def test_stars_are_where_their_wings_say(sky_scene, how):
    data, light, stars, saturated = sky_scene
    rng = np.random.default_rng(2)
    init = QTable({'x': stars[:, 0] + rng.normal(0, 0.4, len(stars)),
                   'y': stars[:, 1] + rng.normal(0, 0.4, len(stars))})
    table = measured(FULL - SKY - 100, data, light,
                     **({'init_params': init} if how == 'list' else {}))
    assert len(table) == len(stars)
    order = [np.argmin(np.hypot(table['x_fit'] - a, table['y_fit'] - b))
             for a, b, _ in stars]
    table = table[order]
    pull = np.concatenate([
        (table[f'{name}_fit'] - stars[:, k]) / table[f'{name}_err']
        for k, name in enumerate(('x', 'y', 'flux'))])
    assert 0.75 < np.sqrt(np.mean(pull**2)) < 1.25
    error = np.hypot(table['x_fit'] - stars[:, 0],
                     table['y_fit'] - stars[:, 1])
    assert np.sqrt(np.mean(error[saturated]**2 / 2)) < 0.003
    np.testing.assert_array_equal(table['flags'] & 65536 > 0, saturated)
    assert 'mostly_masked' in decode_psf_flags(
        int(table['flags'][saturated][0]))


def test_without_a_level_they_are_wrong(sky_scene):
    data, light, stars, saturated = sky_scene
    init = QTable({'x': stars[:, 0], 'y': stars[:, 1]})
    table = measured(None, data, light, init_params=init)
    assert (np.abs(table['flux_fit'] / stars[:, 2] - 1)[saturated]
            > 0.2).all()
    assert not (table['flags'] & 65536).any()


def test_other_stars_do_not_change(sky_scene):
    data, light, stars, saturated = sky_scene
    init = QTable({'x': stars[:, 0], 'y': stars[:, 1]})
    with_level, without = (measured(level, data, light, init_params=init)
                           for level in (FULL - SKY - 100, None))
    for name in ('x_fit', 'y_fit', 'flux_fit', 'x_err'):
        np.testing.assert_allclose(with_level[name][~saturated],
                                   without[name][~saturated], rtol=1e-12)


def test_masks_and_nan_tell_if_the_level_is_infinite(sky_scene):
    data, light, stars, saturated = sky_scene
    full = data >= FULL - SKY - 100
    init = QTable({'x': stars[:, 0], 'y': stars[:, 1]})
    by_nan = measured(np.inf, np.where(full, np.nan, data), light,
                      init_params=init)
    by_mask = measured(np.inf, data, light, mask=full, init_params=init)
    np.testing.assert_array_equal(by_nan['flags'] & 65536 > 0, saturated)
    np.testing.assert_allclose(by_nan['x_fit'], by_mask['x_fit'])


def test_units_come_back(sky_scene):
    data, light, stars, _ = sky_scene
    init = QTable({'x': stars[:, 0], 'y': stars[:, 1]})
    phot = MixturePSFPhotometry(PSF, 9, saturation=(FULL - SKY - 100) * u.Jy,
                                aperture_radius=3)
    table = phot(data * u.Jy, error=np.sqrt(light + SKY) * u.Jy,
                 init_params=init)
    plain = measured(FULL - SKY - 100, data, light, init_params=init)
    assert table['flux_fit'].unit == u.Jy
    np.testing.assert_allclose(table['flux_fit'].value, plain['flux_fit'])


def test_fixed_positions_stay(sky_scene):
    data, light, stars, saturated = sky_scene
    model = PSF.copy()
    model.x_0.fixed = model.y_0.fixed = True
    phot = MixturePSFPhotometry(model, 9, saturation=FULL - SKY - 100,
                                aperture_radius=3)
    table = phot(data, error=np.sqrt(light + SKY),
                 init_params=QTable({'x': stars[:, 0], 'y': stars[:, 1]}))
    np.testing.assert_array_equal(table['x_fit'], stars[:, 0])
    np.testing.assert_allclose(table['flux_fit'][saturated],
                               stars[saturated, 2], rtol=0.01)


def test_the_crowded_solver_masks_and_fits_them_too(sky_scene):
    data, light, stars, saturated = sky_scene
    table = CrowdedMixturePhotometry(PSF, saturation=FULL - 100)(
        data + SKY, error=np.sqrt(light + SKY))
    for k in np.flatnonzero(saturated):
        distance = np.hypot(table['x_fit'] - stars[k, 0],
                            table['y_fit'] - stars[k, 1])
        best = distance.argmin()
        assert distance[best] < 0.04
        assert table['flags'][best] & 65536
        assert table['flux_fit'][best] == pytest.approx(stars[k, 2],
                                                        rel=0.02)


def test_wings_are_measured_on_the_image_where_the_psf_is_wrong():
    rng = np.random.default_rng(11)
    ghost = GaussianMixture([0.69, 0.295, 0.015],
                            [(0, 0), (0, 0), (5.5, 1)],
                            [*MIXTURE.covariances, [[1.2, 0], [0, 1.2]]])
    y, x = (v.ravel() + rng.uniform(-0.5, 0.5, v.size)
            for v in np.mgrid[20:300:28, 20:300:28])
    saturated = np.arange(x.size) % 7 == 3
    flux = FULL / PEAK * np.where(saturated, 6.0,
                                  rng.uniform(0.2, 0.8, x.size))
    light = sum(ghost.render((310, 310), *star, flux=f)
                for *star, f in zip(x, y, flux, strict=True))
    data = np.minimum(rng.normal(light, np.sqrt(light + SKY)), FULL)
    phot = MixturePSFPhotometry(PSF, 9, saturation=FULL - 100)
    table = phot(data, error=np.sqrt(light + SKY),
                 init_params=QTable({'x': x, 'y': y, 'flux': flux}))
    error = np.array([table['x_fit'] - x, table['y_fit'] - y])[:, saturated]
    # By the PSF alone they are off by 0.18 pixels in x, up to 9 % in flux.
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert (np.abs(table['flux_fit'] / flux - 1)[saturated] < 0.04).all()
    pull = np.concatenate([error[0] / table['x_err'][saturated],
                           error[1] / table['y_err'][saturated]])
    assert np.sqrt(np.mean(pull**2)) < 1.5
