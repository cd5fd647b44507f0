"""Spikes and ghosts of bright stars, measured and taken off on request."""
import numpy as np
import pytest
from astropy.table import QTable
from photutils.psf import GaussianPRF

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    MixturePSFPhotometry,
)

MIXTURE = GaussianMixture([0.8, 0.2], [(0, 0), (0, 0)],
                          [[[0.9, 0], [0, 0.9]], [[3.5, 0], [0, 3.5]]])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])
SIZE, SKY, RADIUS = 420, 40.0, 16


def spikes(dx, dy):
    """Return light that no mixture has: a cross, and a ghost beside it."""
    along = np.exp(-np.abs(dx) / 6) * np.exp(-0.5 * (dy / 0.8)**2)
    ghost = np.exp(-0.5 * ((dx - 9)**2 + (dy + 7)**2) / 1.5**2)
    ends = np.clip(14 - np.hypot(dx, dy), 0, 2) / 2
    return ends * (4e-4 * along + 1.5e-4 * ghost)


def scene(seed, n_bright=36, n_faint=72):
    """Return an image, its errors, and its stars; bright ones come first."""
    rng = np.random.default_rng(seed)
    step = SIZE / round(n_bright**0.5)
    axis = np.arange(step / 2, SIZE, step)
    x, y = (v.ravel() + rng.uniform(-4, 4, v.size)
            for v in np.meshgrid(axis, axis))
    flux = rng.uniform(3e5, 2e6, x.size)
    at, host = rng.uniform(8, 13, n_faint), np.arange(n_faint) % x.size
    # Two beside each of them, one across from the other.
    angle = rng.uniform(0, 6.3, x.size)[host] + np.pi * (
        np.arange(n_faint) // x.size)
    x = np.append(x, x[host] + at * np.cos(angle))
    y = np.append(y, y[host] + at * np.sin(angle))
    flux = np.append(flux, rng.uniform(800, 3000, n_faint))
    image = np.full((SIZE, SIZE), SKY)
    rows, columns = np.indices(image.shape)
    for k, star in enumerate(zip(x, y, flux, strict=True)):
        a, b, f = star
        near = (slice(max(round(b) - 25, 0), round(b) + 26),
                slice(max(round(a) - 25, 0), round(a) + 26))
        dx, dy = columns[near] - a, rows[near] - b
        image[near] += f * MIXTURE.evaluate(dx, dy)
        if k < n_bright:
            image[near] += f * spikes(dx, dy)
    error = np.sqrt(image)
    return rng.normal(image, error), error, QTable(
        {'x': x, 'y': y, 'flux': flux})


@pytest.fixture(scope='module')
def sky_scene():
    return scene(5)


def misses(table, stars, rows):
    """Return below what 90 % of errors are, and should be: in that unit."""
    off = np.asarray(table['flux_fit'] - stars['flux'])[rows]
    return np.percentile(np.abs(off / np.asarray(table['flux_err'])[rows]),
                         90) / 1.645


def test_faint_stars_on_spikes_are_measured(sky_scene):
    data, error, stars = sky_scene
    faint = np.arange(36, len(stars))
    tables = [MixturePSFPhotometry(PSF, 7, residual_radius=radius,
                                   aperture_radius=3)(
        data - SKY, error=error, init_params=stars)
        for radius in (None, RADIUS)]
    without, taken_off = (misses(table, stars, faint) for table in tables)
    assert without > 3
    assert 0.7 < taken_off < 1.4


def test_what_is_measured_is_what_is_there(sky_scene):
    data, error, stars = sky_scene
    phot = MixturePSFPhotometry(PSF, 7, residual_radius=RADIUS,
                                aperture_radius=3)
    phot(data - SKY, error=error, init_params=stars)
    seen = phot.psf_residual.image([200.3], [210.6], [1.0])
    rows, columns = np.indices(seen.shape)
    true = spikes(columns - 200.3, rows - 210.6)
    away = np.hypot(columns - 200.3, rows - 210.6) > 4
    assert np.sqrt(np.sum((seen - true)[away]**2)) < (
        0.25 * np.sqrt(np.sum(true[away]**2)))
    assert not seen[np.hypot(columns - 200, rows - 211) > 1.3 * RADIUS].any()


def test_nothing_is_measured_unless_asked_for(sky_scene):
    data, error, stars = sky_scene
    phot = MixturePSFPhotometry(PSF, 7, aperture_radius=3)
    phot(data - SKY, error=error, init_params=stars)
    assert phot.psf_residual is None


def test_a_right_psf_leaves_nothing():
    rng = np.random.default_rng(2)
    x, y = (v.ravel() + rng.uniform(-2, 2, v.size)
            for v in np.mgrid[25:275:40, 25:275:40])
    sigma = 1.1
    model = GaussianPRF(x_fwhm=2.3548 * sigma, y_fwhm=2.3548 * sigma)
    rows, columns = np.indices((300, 300))
    image = sum(model.evaluate(columns, rows, f, a, b, 2.3548 * sigma,
                               2.3548 * sigma, 0)
                for a, b, f in zip(x, y, rng.uniform(1e5, 3e5, x.size),
                                   strict=True))
    error = np.sqrt(image + SKY)
    psf = GriddedMixturePSF([GaussianMixture(
        [1], [[0, 0]], [[[sigma**2, 0], [0, sigma**2]]])], [(0, 0)],
        pixel_integrated=True)
    stars = QTable({'x': x, 'y': y})
    tables = [MixturePSFPhotometry(psf, 9, residual_radius=radius,
                                   aperture_radius=3)(
        rng.normal(image, error), error=error, init_params=stars)
        for rng, radius in ((np.random.default_rng(3), None),
                            (np.random.default_rng(3), 12))]
    for name in ('x', 'y', 'flux'):
        change = (tables[1][f'{name}_fit'] - tables[0][f'{name}_fit'])
        assert np.sqrt(np.mean((change / tables[0][f'{name}_err'])**2)) < 0.3


def test_few_stars_are_said():
    data, error, stars = scene(5, n_bright=4, n_faint=0)
    with pytest.warns(UserWarning, match='4 stars .* too few, 5 are needed'):
        MixturePSFPhotometry(PSF, 7, residual_radius=RADIUS,
                             aperture_radius=3)(
            data - SKY, error=error, init_params=stars)


@pytest.mark.parametrize('radius', [0, 2.9, -4, np.nan, '7'])
@pytest.mark.parametrize('make', [
    lambda r: MixturePSFPhotometry(PSF, 7, residual_radius=r),
    lambda r: CrowdedMixturePhotometry(PSF, residual_radius=r)])
def test_odd_radii_are_errors(make, radius):
    with pytest.raises((TypeError, ValueError), match='residual_radius'):
        make(radius)


def test_not_with_what_is_left_to_photutils(sky_scene):
    data, error, stars = sky_scene
    phot = MixturePSFPhotometry(GaussianPRF(), 7, residual_radius=RADIUS)
    with (pytest.warns(UserWarning, match='psf_model'),
          pytest.raises(ValueError, match='residual_radius must be None')):
        phot(data, error=error, init_params=stars)


@pytest.mark.long
def test_crowded_photometry_takes_spikes_for_stars_no_more(sky_scene):
    data, error, stars = sky_scene
    false, found = [], []
    for radius in (None, RADIUS):
        phot = CrowdedMixturePhotometry(PSF, residual_radius=radius)
        table = phot(data, error=error)
        good = np.asarray(table['flags']) & (262144 | 65536) == 0
        x, y, flux = (np.asarray(table[f'{name}_fit'])
                      for name in ('x', 'y', 'flux'))
        distance = np.hypot(x[:, None] - stars['x'], y[:, None] - stars['y'])
        false.append(np.sum(good & (distance.min(axis=1) > 1) & (flux > 500)))
        best = distance.argmin(axis=0)
        found.append(np.mean(
            (distance.min(axis=0) < 1)[36:]
            & (np.abs(flux[best] / stars['flux'] - 1) < 0.3)[36:]))
    assert false[0] > 50
    assert false[1] < 0.2 * false[0]
    assert found[1] > found[0] + 0.05
    assert phot.psf_residual is not None


def test_many_images_refuse_it():
    phot = CrowdedMixturePhotometry(PSF, residual_radius=RADIUS)
    with pytest.raises(ValueError, match='residual_radius must be None'):
        phot.fit_images([])
