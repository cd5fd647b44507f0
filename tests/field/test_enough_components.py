"""More Gaussians where the usual number misses too much of the light."""
import re
import warnings

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import (
    EmpiricalPSF,
    GaussianMixture,
    fit_mixture_field,
)

CELL = 24


def curl(n):
    """Return a PSF of a core and n Gaussians along a spiral."""
    along = np.linspace(0.4, 2 * np.pi, n)
    means = 0.6 * along[:, None] * np.column_stack([np.cos(along),
                                                     np.sin(along)])
    return GaussianMixture.from_stddevs(
        np.append(0.4, np.full(n, 0.6 / n)), [[0, 0], *means],
        np.full((n + 1, 2), 0.95), np.zeros(n + 1))


def ring(share):
    """Return a PSF of a core and a ring of 12 Gaussians with some light."""
    angle = np.arange(0, 2 * np.pi, np.pi / 6)
    means = 3.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    return GaussianMixture.from_stddevs(
        np.append(1 - share, np.full(12, share / 12)), [[0, 0], *means],
        np.full((13, 2), 0.95), np.zeros(13))


def image(psf, n_side, faintest):
    """Return an image of n^2 stars, its error and their table."""
    rng = np.random.default_rng(4)
    x, y = ((np.mgrid[:n_side, :n_side].reshape(2, -1) + 0.5) * CELL
            + rng.uniform(-0.5, 0.5, (2, n_side**2)))
    flux = 10 ** rng.uniform(np.log10(faintest), 5, n_side**2)
    clean = np.zeros((n_side * CELL,) * 2)
    for *place, light in zip(x, y, flux, strict=True):
        clean += psf.render(clean.shape, *place, flux=light)
    error = np.sqrt(clean + 50)
    return rng.normal(clean, error), error, Table({'x': x, 'y': y})


def fitted(psf, n_side=8, faintest=1e5, **options):
    data, error, stars = image(psf, n_side, faintest)
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


@pytest.mark.long
@pytest.mark.parametrize(('n_side', 'n_components'), [(8, 6), (18, 8)])
def test_hundreds_of_stars_ask_for_gaussians_that_few_do_not(
        n_side, n_components):
    # What six miss is less than the noise of most stars.
    field = fitted(ring(0.04), n_side, 4e3)
    assert field.n_components == n_components
    assert field.accuracy < 0.005


@pytest.mark.long
def test_hundreds_of_stars_of_three_gaussians_do_not_ask_for_eight():
    psf = GaussianMixture(
        [0.6, 0.3, 0.1], [[0, 0], [0.2, 0.1], [-0.3, 0.3]],
        [[[1, 0.2], [0.2, 1.3]], [[2.5, -0.5], [-0.5, 3]], [[9, 1], [1, 8]]])
    assert fitted(psf, 18).n_components == 6


def test_it_is_said_that_the_number_given_misses_light():
    psf = GaussianMixture.from_stddevs([0.7, 0.3], np.zeros((2, 2)),
                                       [(0.95, 0.95), (2.2, 2.2)])
    with pytest.warns(AstropyUserWarning) as told:
        field = fitted(psf, n_components=1)
    assert field.n_components == 1
    (words,) = [one for one in told if 'misses' in str(one.message)]
    assert words.filename == __file__
    assert re.match(r'n_components=1 misses \d+\.\d% of the light in the '
                    r'pixels of bright stars, n_components=6 0\.\d%',
                    str(words.message))
    data, error, stars = image(psf, 8, 1e5)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        # Two are all there are; pixels add what an empirical PSF misses.
        assert fitted(psf, n_components=2).accuracy < 0.005
        EmpiricalPSF.from_stars(data, stars, error=error, n_components=1,
                                degree=0, radius=8)
