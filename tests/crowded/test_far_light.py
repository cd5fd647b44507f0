"""The light of crowded stars beyond the stamps of their PSF."""
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table
from scipy.signal import fftconvolve

from photutils_mgauss import GaussianMixture, GriddedMixturePSF, render_stars
from photutils_mgauss.crowded.far_light import far_light

N, RADIUS, INNER, SLOPE = 320, 10, 10.5, 3.0
# By so much there is less noise than photons make: of a larger image.
QUIET = 16
CORE = GaussianMixture([1], [[0, 0]], [np.eye(2) * 1.5])
PSF = GriddedMixturePSF([CORE], [(N / 2, N / 2)])


def stars(seed=1, n=3000):
    """Return a star per 34 pixels, a few of them bright."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, N - 1, (2, n))
    return x, y, np.minimum(300 * (rng.pareto(1.1, n) + 1), 3e5)


def wings(x, y, flux, share):
    """Return light beyond INNER pixels, a power law without an end."""
    height = share * (SLOPE - 2) / (2 * np.pi * INNER**2)
    middle = np.hypot(*np.indices((2 * N + 1, 2 * N + 1)) - N)
    law = np.where(middle > INNER, height
                   * (np.maximum(middle, INNER) / INNER)**-SLOPE, 0)
    points = np.zeros((N, N))
    np.add.at(points, (np.rint(y).astype(int), np.rint(x).astype(int)), flux)
    return fftconvolve(points, law, 'same')


def solved(share, *, sky=0.0, known=1.0, spacing=64):
    """Return what is left of stars whose fluxes are that much too large."""
    x, y, flux = stars()
    rng = np.random.default_rng(2)
    light = render_stars(PSF, x, y, flux, (N, N))
    variance = (light + 60) / QUIET
    left = rng.normal(wings(x, y, flux, share) + (1 - known) * light + sky,
                      np.sqrt(variance))
    return SimpleNamespace(
        table=Table({'x_fit': x, 'y_fit': y, 'flux_fit': known * flux}),
        residual=left, variance=variance, noise=np.sqrt(60 / QUIET),
        windows=[(slice(0, N), slice(0, N))], spacing=spacing)


@pytest.mark.parametrize('share', [0.01, 0.03])
def test_all_stars_together_tell_it(share):
    # A sky that took the wings of a dense field for its own, and rose.
    wings = far_light(solved(share, sky=-3.0), PSF, RADIUS)
    assert abs(wings.share / (1 - wings.share) - share) < 0.15 * share
    assert wings.is_seen
    assert wings.stddev == 2 * RADIUS


def test_where_there_is_none_none_is_seen():
    wings = far_light(solved(0.0), PSF, RADIUS)
    assert wings.share < 0.002
    assert not wings.is_seen


def test_light_that_the_psf_lacks_inside_is_not_beyond():
    wings = far_light(solved(0.0, known=0.99), PSF, RADIUS)
    assert not wings.is_seen


def test_windows_tell_it_together_and_bad_pixels_nothing():
    known = solved(0.03, spacing=None)
    known.residual[40:80, 100:200] = 1e6
    known.variance[40:80, 100:200] = 0
    known.windows = [(slice(0, N // 2), slice(0, N)),
                     (slice(N // 2, N), slice(0, N))]
    wings = far_light(known, PSF, RADIUS)
    assert abs(wings.share - 0.03) < 0.006
    assert wings.is_seen
