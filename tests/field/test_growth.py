"""Light beyond the stamps, and the radius of the stamps, from the stars."""
import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, MixtureField, fit_mixture_field

SHAPE = (420, 420)
BETA = 2.5


def moffat(fwhm, slope=BETA):
    """Return a Moffat profile of unit flux, a function of x and y."""
    width = fwhm / 2 / np.sqrt(2 ** (1 / slope) - 1)

    def profile(x, y):
        return ((slope - 1) / np.pi / width**2
                * (1 + (x**2 + y**2) / width**2) ** -slope)
    return profile


def image(profile, seed=3, spacing=65):
    """Return data, error and stars with their fluxes."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[40:400:spacing, 40:400:spacing].reshape(2, -1)
    x, y = grid + rng.uniform(-4, 4, grid.shape)
    flux = 10 ** rng.uniform(4.8, 5.6, x.size)
    rows, columns = np.mgrid[:SHAPE[0], :SHAPE[1]]
    clean = sum(f * profile(columns - a, rows - b)
                for a, b, f in zip(x, y, flux, strict=True))
    error = np.sqrt(clean + 50)
    return (rng.normal(clean, error), error,
            Table({'x': x, 'y': y, 'flux': flux}))


@pytest.fixture(scope='module')
def sharp():
    """Return an image of a PSF with broad wings: 2.5 % beyond 10 pixels."""
    return image(moffat(2.2, 1.5 + 0.25))


@pytest.fixture(scope='module')
def fields(sharp):
    data, error, stars = sharp
    return {name: fit_mixture_field(data, stars, error=error, n_components=4,
                                    degree=0, normalise=name)
            for name in ('stamps', 'curve-of-growth')}


def bias(field, stars):
    return np.median(field.stars['flux_fit'] / stars['flux']) - 1


def test_light_beyond_the_stamps_belongs_to_the_flux(fields, sharp):
    before, after = (bias(fields[name], sharp[2])
                     for name in ('stamps', 'curve-of-growth'))
    assert before < -0.015
    assert abs(after) < 0.3 * abs(before)


def test_the_error_of_the_light_beyond_is_told(fields, sharp):
    field = fields['curve-of-growth']
    assert abs(bias(field, sharp[2])) < 4 * field.wing_error
    assert 0 < field.wing_error < 0.02


def test_the_wings_change_neither_core_nor_positions(fields):
    plain, grown = fields.values()
    assert_allclose(grown.stars['x_fit'], plain.stars['x_fit'])
    one, two = (psf.mixture_at(200, 200) for psf in (plain, grown))
    assert len(two.weights) == len(one.weights) + 1
    assert_allclose(two.weights[-1], grown.wing_share)
    assert_allclose(two.evaluate(0.3, -1) / one.evaluate(0.3, -1),
                    1 - grown.wing_share, rtol=1e-3)


@pytest.mark.parametrize('name', ['field.fits', 'field.asdf'])
def test_files_keep_the_wings(fields, tmp_path, name):
    field = fields['curve-of-growth']
    field.write(tmp_path / name)
    again = MixtureField.read(tmp_path / name)
    assert again.wing_share == field.wing_share
    assert again.mixture_at(9, 9) == field.mixture_at(9, 9)


def test_the_error_of_an_aperture_correction_is_that_of_the_field(fields):
    plain, grown = fields.values()
    small = plain.aperture_correction_error(4, 200, 200)
    assert 0 < small < 0.01
    assert grown.aperture_correction_error(4, 200, 200) > grown.wing_error


@pytest.mark.parametrize(('fwhm', 'radius'), [(2, 10), (3.3, 14), (8, 20)])
def test_the_radius_is_four_widths_of_the_stars(fwhm, radius):
    data, error, stars = image(moffat(fwhm))
    field = fit_mixture_field(data, stars, error=error, n_components=2,
                              degree=0)
    assert abs(field.radius - radius) <= 1


def test_stars_without_wings_get_none():
    psf = GaussianMixture([1], [[0, 0]], [[[1.5, 0], [0, 1.5]]])
    data, error, stars = image(psf.evaluate)
    with pytest.warns(AstropyUserWarning, match='no light beyond'):
        field = fit_mixture_field(data, stars, error=error, n_components=1,
                                  degree=0, normalise='curve-of-growth')
    assert field.wing_share == 0


def test_by_default_light_that_is_seen_is_in_the_flux(fields, sharp, caplog):
    data, error, stars = sharp
    caplog.set_level('INFO', 'photutils_mgauss')
    field = fit_mixture_field(data, stars, error=error, n_components=4,
                              degree=0)
    assert field == fields['curve-of-growth']
    assert 'of the light of stars is beyond their stamps' in caplog.text


def test_by_default_light_that_is_not_seen_is_not_added(caplog):
    psf = GaussianMixture([1], [[0, 0]], [[[1.5, 0], [0, 1.5]]])
    data, error, stars = image(psf.evaluate, seed=4)
    options = {'error': error, 'n_components': 1, 'degree': 0}
    caplog.set_level('INFO', 'photutils_mgauss')
    field = fit_mixture_field(data, stars, **options)
    plain = fit_mixture_field(data, stars, normalise='stamps', **options)
    assert 'stars show no light beyond their stamps' in caplog.text
    assert field.mixture_at(3, 4) == plain.mixture_at(3, 4)
    # What may be there, though it was not seen.
    assert field.wing_error > 0
    caplog.clear()
    few = fit_mixture_field(data, stars[:3], **options)
    assert few.wing_share == 0
    assert 'needs at least 5 stars' in caplog.text


def test_a_psf_that_leaves_light_has_larger_errors(sharp):
    data, error, stars = sharp
    options = {'error': error, 'degree': 0, 'normalise': 'stamps'}
    poor, good = (fit_mixture_field(data, stars, n_components=k, **options)
                  for k in (2, 4))
    inside = [np.abs(field.aperture_correction(5, 200, 200) * moffat_inside(
        5) / moffat_inside(10) - field.aperture_correction(10, 200, 200))
        for field in (poor, good)]
    errors = [field.aperture_correction_error(5, 200, 200)
              for field in (poor, good)]
    assert errors[0] > 10 * errors[1]
    assert 0.2 < errors[0] / inside[0] < 5


def moffat_inside(radius, fwhm=2.2, slope=1.75):
    """Return the share of the light of `sharp` inside a radius."""
    width = fwhm / 2 / np.sqrt(2 ** (1 / slope) - 1)
    return 1 - (1 + radius**2 / width**2) ** (1 - slope)


def test_too_few_stars_for_a_curve_of_growth_are_an_error(sharp):
    data, error, stars = sharp
    with pytest.raises(ValueError, match='needs at least 5 stars'):
        fit_mixture_field(data, stars[:3], error=error, n_components=1,
                          degree=0, normalise='curve-of-growth')


def test_a_known_psf_keeps_its_own_wings(sharp, fields):
    data, error, stars = sharp
    with pytest.raises(ValueError, match='normalise must be'):
        fit_mixture_field(data, stars, error=error,
                          start=fields['stamps'].to_grid((2, 2)),
                          normalise='curve-of-growth')


def test_rings_of_one_value_tell_of_no_light():
    profile = moffat(2.5, 3.0)
    stars = image(profile)[2]
    rows, columns = np.mgrid[:SHAPE[0], :SHAPE[1]]
    clean = sum(f * profile(columns - a, rows - b)
                for a, b, f in stars.iterrows('x', 'y', 'flux'))
    field = fit_mixture_field(np.where(clean > 2000, 1.0, 0.0),
                              stars['x', 'y'], error=1e-3, n_components=1,
                              degree=0, radius=8)
    assert field.wing_share == 0
