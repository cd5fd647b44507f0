"""Errors of a field whose exposures show the same stars again."""
import numpy as np
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.dithers import dithered
from photutils_mgauss import (
    GaussianMixture,
    MixturePSFPhotometry,
    fit_mixture_field,
)
from photutils_mgauss.field import fit as field_fit
from photutils_mgauss.field.base import covariance_of
from photutils_mgauss.field.covariance import plain_covariance
from photutils_mgauss.field.noise import noise_covariance

SIZE, N_SIDE, N_IMAGES, SKY = 170, 4, 6, 30.0
N_STARS = N_SIDE**2
FLUX = 4e4
# Its centre is its origin.
PSF = GaussianMixture.from_stddevs([0.8, 0.2], np.zeros((2, 2)),
                                   [[1.3, 1.4], [2.4, 2.4]], [0.1, 0])


def exposures(seed, neighbour):
    """Return images, tables and errors; each star has a faint neighbour."""
    rng = np.random.default_rng(seed)
    x, y = ((np.mgrid[:N_SIDE, :N_SIDE].reshape(2, -1) + 0.5) * SIZE / N_SIDE
            + rng.uniform(-2, 2, (2, N_STARS)))
    off = rng.uniform(-4, 4, (2, N_STARS))
    return dithered(PSF, SIZE, SKY, (x, y, [FLUX] * N_STARS), (off, neighbour),
                    N_IMAGES, lambda clean: rng.normal(clean, np.sqrt(clean)),
                    rng)


def pulls(seed, neighbour):
    """Return what the PSF moves stars without noise by, over its errors."""
    images, tables, errors = exposures(seed, neighbour)
    field = fit_mixture_field(images, tables, error=errors, radius=6,
                              n_components=2, degree=1,
                              normalise='stamps')
    places = Table({'x': [40.3, 100.1, 129.8], 'y': [50.2, 120.4, 70.6],
                    'flux': np.full(3, FLUX)})
    clean = sum(PSF.render((SIZE, SIZE), x, y, flux=flux)
                for x, y, flux in places.iterrows())
    found = MixturePSFPhotometry(field, 11)(
        clean, error=np.sqrt(clean + SKY), init_params=places)
    return [(found[f'{name}_fit'] - places[name]) / found[f'{name}_psf_err']
            for name in ('x', 'y')]


def test_what_all_detections_share_is_in_the_errors():
    found = np.array([pulls(seed, 0.02) for seed in range(3)])
    assert 0.6 < np.sqrt(np.mean(found**2)) < 1.6


def test_detections_that_count_less_are_no_noisier(monkeypatch):
    kept = []

    def errors(fit, sample):
        kept.append(fit)
        return honest_errors(fit, sample)
    honest_errors = field_fit._errors
    monkeypatch.setattr(field_fit, '_errors', errors)
    pulls(1, 0.0)
    # From pixels, and from the equations.
    assert_allclose(np.diag(noise_covariance(kept[0])),
                    np.diag(plain_covariance(kept[0])), rtol=1e-3)
    assert np.all(np.diag(plain_covariance(kept[0]))
                  < np.diag(covariance_of(kept[0])))
