"""The origin of a PSF: the centre of its core, or the flux centroid."""
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose
from photutils.background import Background2D

from photutils_mgauss import (
    EmpiricalPSF,
    GaussianMixture,
    GriddedMixturePSF,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
    select_psf_stars,
)
from photutils_mgauss.psf.centre import centres

SHAPE = (200, 210)
# An eighth of the light in a wing that lies beside the core.
PSF = GaussianMixture.from_stddevs(
    [0.6, 0.275, 0.125], [[0, 0], [0.15, -0.1], [0.5, 0.4]],
    [[0.8, 0.75], [1.4, 1.5], [4, 4.4]], [0.1, -0.1, 0.2])


def weighted_moment(mixture, stddev, centre=(0, 0)):
    """Integrate r - c under the weight by sums over a fine lattice."""
    x = np.arange(-40, 40.1, 0.25)
    y = x[:, None]
    light = mixture.evaluate(x, y) * np.exp(
        -((x - centre[0])**2 + (y - centre[1])**2) / (2 * stddev**2))
    return np.array([(light * (x - centre[0])).sum(),
                     (light * (y - centre[1])).sum()]) / light.sum()


def image(seed, n_side=8, photons=6e4):
    """Return data, error and stars of a field with noise."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[20:195:24, 20:195:24].reshape(2, -1)
    x, y = grid + np.random.default_rng(1).uniform(-2, 2, grid.shape)
    clean = sum(PSF.render(SHAPE, *place, flux=photons)
                for place in zip(x, y, strict=True))
    error = np.sqrt(clean + 100)
    return (clean + rng.normal(0, error), error,
            Table({'x': x, 'y': y, 'flux': np.full(x.size, photons)}))


@pytest.fixture(scope='module')
def fields():
    """Return the fields of two exposures for both centres."""
    return {centre: [fit_mixture_field(
        data, stars, error=error, n_components=3, degree=1, radius=8,
        centre=centre) for data, error, stars in map(image, (5, 6))]
        for centre in ('core', 'flux')}


@pytest.mark.parametrize('stddev', [0.3, 1.0, 2.0, 10.0])
def test_the_first_moment_about_the_centre_vanishes(stddev):
    found = centres(PSF.weights[None], PSF.means[None],
                    PSF.covariances[None], stddev)[0]
    assert_allclose(weighted_moment(PSF, stddev, found), 0, atol=1e-9)


def test_an_infinite_weight_gives_the_flux_centroid():
    found = centres(PSF.weights[None], PSF.means[None],
                    PSF.covariances[None], np.inf)[0]
    assert_allclose(found, PSF.moments().mean, atol=1e-15)


def test_the_centre_is_found_from_far_away():
    # The flux centroid lies between a core and a distant companion.
    pair = GaussianMixture([0.7, 0.3], [[0, 0], [30, 10]],
                           [np.eye(2), np.eye(2)])
    found = centres(pair.weights[None], pair.means[None],
                    pair.covariances[None], 2.0)[0]
    assert_allclose(found, 0, atol=1e-6)


def test_the_core_of_a_field_is_at_the_origin_everywhere(fields):
    field = fields['core'][0]
    assert field.centre == 'core'
    # The weight is wider than the core, whose FWHM is some 2.3 px, but only
    # as far as the stamp, of 8 px, shows the light.
    assert_allclose(field.centre_stddev, 0.36 * 8)
    grid = field.to_grid((2, 2))
    for x, y in [(0, 0), (120, 90), (209, 10)]:
        for psf in (field, grid):
            assert_allclose(weighted_moment(
                psf.mixture_at(x, y), field.centre_stddev), 0, atol=1e-7)


def test_only_the_origin_depends_on_the_centre(fields):
    core, flux = fields['core'][0], fields['flux'][0]
    assert flux.centre == 'flux'
    assert_allclose(core.residual_stars, flux.residual_stars)
    shift = [core.stars[name][3] - flux.stars[name][3]
             for name in ('x_fit', 'y_fit')]
    assert np.hypot(*shift) > 0.05
    place = [flux.stars[name][3] for name in ('x', 'y')]
    assert_allclose(flux.mixture_at(*place).shift(-np.array(shift)).evaluate(
        1.3, -0.4), core.mixture_at(*place).evaluate(1.3, -0.4), rtol=1e-9)


def test_exposures_agree_better_about_the_core(fields):
    scatter = {}
    for centre, (one, two) in fields.items():
        psfs = [[field.mixture_at(x, y) for x, y in zip(
            field.stars['x'], field.stars['y'], strict=True)]
            for field in (one, two)]
        # Where the same star is found with either PSF: the first PSF's
        # profile fitted by the second one.
        scatter[centre] = np.std([_offset(a, b) for a, b in
                                  zip(*psfs, strict=True)])
    assert scatter['core'] < 0.5 * scatter['flux']


def _offset(one, two):
    """Return by how much one PSF fitted with another is displaced."""
    x = np.arange(-4, 4.1)
    y = x[:, None]
    slope = two.gradient(x + 0 * y, y + 0 * x)
    design = np.column_stack([two.evaluate(x, y).ravel(),
                              -slope.reshape(-1, 2)])
    flux, *moved = np.linalg.lstsq(design, one.evaluate(x, y).ravel())[0]
    return np.array(moved) / flux


@pytest.mark.parametrize('name', ['field.fits', 'field.asdf'])
def test_files_keep_the_centre(fields, tmp_path, name):
    field = fields['core'][0]
    field.write(tmp_path / name)
    again = MixtureField.read(tmp_path / name)
    assert again.centre_stddev == field.centre_stddev
    assert_allclose(again.mixture_at(30, 40).means,
                    field.mixture_at(30, 40).means, rtol=1e-12)


def test_a_tuned_psf_keeps_the_centre_of_the_known_one():
    data, error, stars = image(7)
    known = PSF.shift([0.3, -0.2])
    tuned = fit_mixture_field(
        data, stars, error=error, degree=0, radius=8,
        start=GriddedMixturePSF([known], [(0, 0)]))
    assert tuned.centre == 'core'
    means = [centres(one.weights[None], one.means[None],
                     one.covariances[None], tuned.centre_stddev)[0]
             for one in (known, tuned.mixture_at(50, 60))]
    assert_allclose(*means, atol=1e-9)
    assert_allclose(np.mean(tuned.stars['x_fit'] - stars['x']), -0.3,
                    atol=0.004)


def test_the_core_of_an_empirical_psf_is_in_the_middle():
    data, error, stars = image(8)
    empirical = EmpiricalPSF.from_stars(data, stars, error=error, degree=0,
                                        radius=8, n_components=2)
    fine = empirical.image_at(100, 100, oversampling=4)
    half = len(fine) // 2
    steps = np.arange(-half, half + 1) / 4
    light = fine * np.exp(-(steps**2 + steps[:, None]**2)
                          / (2 * empirical.field.centre_stddev**2))
    moment = [(light * steps).sum(), (light * steps[:, None]).sum()]
    assert_allclose(moment / light.sum(), 0, atol=2e-4)


def test_another_word_for_the_centre_is_refused():
    data, error, stars = image(5)
    with pytest.raises(ValueError, match="centre must be one of 'core'"):
        fit_mixture_field(data, stars, error=error, centre='peak')


@pytest.mark.long
def test_two_halves_of_a_real_image_have_one_centre(realdata):
    path = realdata('spitzer_glimpse') / 'spitzer_example_image.fits'
    data = fits.getdata(path).astype(float)
    mask = ~np.isfinite(data)
    sky = Background2D(data, 32, mask=mask)
    data = data - sky.background
    error = np.sqrt(sky.background_rms_median**2
                    + 0.05 * np.maximum(np.nan_to_num(data), 0))
    stars = select_psf_stars(data, error=error, mask=mask, radius=5)
    bright = stars[stars['selected']]['x', 'y', 'flux']
    found = []
    for half in (stars['x'] < 512, stars['x'] >= 512):
        some = stars.copy()
        some['selected'] &= half
        field = fit_mixture_field(data, some, error=error, mask=mask,
                                  n_components=3, degree=0, radius=5,
                                  local_bkg=True, brighter_fatter=False)
        table = MixturePSFPhotometry(field, 5, correlated_noise=False)(
            data, error=error, mask=mask, init_params=bright)
        found.append(np.column_stack([table['x_fit'], table['y_fit']]))
    assert np.abs(np.nanmedian(found[1] - found[0], axis=0)).max() < 0.05
