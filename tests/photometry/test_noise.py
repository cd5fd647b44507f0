"""Laws of pixel errors, of the bound, and of what is measured against it."""
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.star_images import MIXTURE
from photutils_mgauss import (
    GriddedMixturePSF,
    MixturePSFPhotometry,
    cramer_rao,
    pixel_error,
)

SKY, READ_NOISE = 30.0, 5.0


def numerical_fisher(flux, variance, x, y, shape, stars):
    """Return the Fisher matrix of stars by finite differences."""
    def image(p):
        return sum(MIXTURE.render(shape, p[3 * i + 1], p[3 * i + 2],
                                  flux=p[3 * i]) for i in range(stars))
    start = np.ravel(np.column_stack([flux, x, y]))
    columns = []
    for k, value in enumerate(start):
        h = 1e-4 * max(1, value)
        step = np.eye(start.size)[k] * h
        columns.append(((image(start + step) - image(start - step))
                        / (2 * h)).ravel())
    columns = np.array(columns)
    return (columns / variance(image(start)).ravel()) @ columns.T


def test_errors_follow_the_equation_in_any_unit():
    light = np.array([[-20.0, 0, 50, 4000]])
    electrons = pixel_error(light, sky=SKY, read_noise=READ_NOISE)
    assert_allclose(electrons**2,
                    np.maximum(light, 0) + SKY + READ_NOISE**2)
    for gain, time in ((1.1, None), (1.1, 150), (1, 150)):
        unit = gain * (time or 1)
        other = pixel_error(light / unit, sky=SKY / unit, gain=gain,
                            read_noise=READ_NOISE, exposure_time=time)
        assert_allclose(other * unit, electrons)


def test_the_bound_is_the_inverse_of_the_numerical_fisher_matrix():
    flux, x, y = [8000.0], [7.3], [6.8]
    fisher = numerical_fisher(flux, lambda m: m + SKY + READ_NOISE**2, x, y,
                              (15, 15), 1)
    bound = cramer_rao(MIXTURE, flux, SKY, x=x, y=y, read_noise=READ_NOISE,
                       fit_shape=15)
    want = np.linalg.inv(fisher)
    scale = np.sqrt(np.outer(np.diag(want), np.diag(want)))
    assert_allclose(bound.covariance[0] / scale, want / scale, atol=1e-6)


def test_neighbours_raise_the_bound():
    flux, x, y = np.array([8000.0, 5000.0]), [11.0, 13.3], [11.2, 11.9]
    fisher = numerical_fisher(flux, lambda m: m + SKY, x, y, (25, 25), 2)
    joint = cramer_rao(MIXTURE, flux, SKY, x=x, y=y, fit_shape=25,
                       jointly=True)
    # The second box only adds pixels that hold no light.
    assert_allclose(joint.covariance[0], np.linalg.inv(fisher)[:3, :3],
                    rtol=1e-3)
    alone = cramer_rao(MIXTURE, flux, SKY, x=x, y=y, fit_shape=25)
    assert (joint.x_err > alone.x_err).all()


def test_a_free_sky_raises_the_bound():
    fixed = cramer_rao(MIXTURE, 1e3, SKY)
    free = cramer_rao(MIXTURE, 1e3, SKY, free_sky=True)
    assert free.flux_err > fixed.flux_err


@pytest.mark.parametrize('bad', [
    {'flux': np.nan}, {'sky': -1}, {'gain': 0}, {'read_noise': -1},
    {'exposure_time': 0}, {'fit_shape': 0}])
def test_arguments_out_of_range_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        cramer_rao(MIXTURE, **{'flux': 1e3, **bad})


def measure(flux, n, variance, rng, noise=SKY + READ_NOISE**2):
    """Return truth and table of n stars of one flux on a lattice."""
    side = int(np.ceil(np.sqrt(n)))
    x, y = (c.ravel()[:n] * 25 + 12 + rng.uniform(-0.5, 0.5, n)
            for c in np.meshgrid(np.arange(side), np.arange(side)))
    psf = GriddedMixturePSF([MIXTURE], [(0, 0)])
    light = np.zeros((25 * side + 1,) * 2)
    stamps = psf.render(x, y, flux, 25)
    for stamp, i, j in zip(stamps, np.rint(x).astype(int) - 12,
                           np.rint(y).astype(int) - 12, strict=True):
        light[j:j + 25, i:i + 25] += stamp
    data = rng.poisson(light + SKY) - SKY + rng.normal(0, READ_NOISE,
                                                       light.shape)
    start = QTable({'x': x, 'y': y, 'flux': np.full(n, flux)})
    phot = MixturePSFPhotometry(psf, 15, effective_gain=1, variance=variance)
    table = phot(data, error=np.full(data.shape, np.sqrt(noise)),
                 init_params=start)
    return start, table


@pytest.mark.parametrize('flux', [1e6, 3e4, 3e3, 8e2])
def test_pulls_are_one_and_the_scatter_is_the_bound(flux, rng):
    start, table = measure(flux, 2000, 'model', rng)
    bound = cramer_rao(MIXTURE, flux, SKY, read_noise=READ_NOISE,
                       x=start['x'], y=start['y'])
    for name in ('x', 'y', 'flux'):
        off = np.asarray(table[f'{name}_fit'] - start[name])
        pulls = off / table[f'{name}_err']
        # Four standard errors of a standard deviation of 2000 values.
        assert abs(pulls.std() - 1) < 4 / np.sqrt(4000), name
        ratio = off / getattr(bound, f'{name}_err')
        assert abs(ratio.std() - 1) < 4 / np.sqrt(4000), name


def test_fluxes_are_low_with_the_variance_of_the_data_only(rng):
    flux = 8e2
    _, model = measure(flux, 2000, 'model', rng)
    _, data = measure(flux, 2000, 'data', np.random.default_rng(1))
    error = model['flux_err'].mean() / np.sqrt(2000)
    assert abs(model['flux_fit'].mean() - flux) < 4 * error
    assert data['flux_fit'].mean() < flux - 10 * error
