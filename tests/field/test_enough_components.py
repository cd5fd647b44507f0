"""More Gaussians where the usual number misses too much of the light."""
import numpy as np
import pytest
from astropy.table import Table

from photutils_mgauss import GaussianMixture, fit_mixture_field

N_SIDE, CELL, FLUX = 8, 24, 1e5


def curl(n):
    """Return a PSF of a core and n Gaussians along a spiral."""
    along = np.linspace(0.4, 2 * np.pi, n)
    means = 0.6 * along[:, None] * np.column_stack([np.cos(along),
                                                     np.sin(along)])
    return GaussianMixture.from_stddevs(
        np.append(0.4, np.full(n, 0.6 / n)), [[0, 0], *means],
        np.full((n + 1, 2), 0.95), np.zeros(n + 1))


def image(psf):
    """Return an image of 64 stars, its error and their table."""
    rng = np.random.default_rng(4)
    x, y = ((np.mgrid[:N_SIDE, :N_SIDE].reshape(2, -1) + 0.5) * CELL
            + rng.uniform(-0.5, 0.5, (2, N_SIDE**2)))
    clean = np.zeros((N_SIDE * CELL,) * 2)
    for place in zip(x, y, strict=True):
        clean += psf.render(clean.shape, *place, flux=FLUX)
    error = np.sqrt(clean + 50)
    return rng.normal(clean, error), error, Table({'x': x, 'y': y})


def fitted(psf, **options):
    data, error, stars = image(psf)
    return fit_mixture_field(data, stars, error=error, degree=0, radius=8,
                             correlated_noise=False, normalise='stamps',
                             **options)


@pytest.mark.long
def test_a_psf_that_six_gaussians_miss_gets_eight(caplog):
    caplog.set_level('INFO', 'photutils_mgauss')
    six, field = (fitted(curl(24), **options)
                  for options in ({'n_components': 6}, {}))
    assert (six.n_components, field.n_components) == (6, 8)
    assert six.accuracy > 0.005
    assert field.accuracy < 0.7 * six.accuracy
    assert 'the field has 8' in caplog.text


def test_a_psf_of_few_gaussians_keeps_six():
    assert fitted(curl(2)).n_components == 6
