"""Fields of optics that are integrated over pixels."""
import sys
import warnings

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
)
from photutils_mgauss.field.base import core_width
from photutils_mgauss.field.forms import FreeShapes
from photutils_mgauss.field.noise import noise_covariance
from photutils_mgauss.field.normal import (
    FieldProblem,
    Prior,
    Workers,
    equations,
    to_coefficients,
    to_vector,
)
from photutils_mgauss.field.stages import FieldFit
from photutils_mgauss.field.stamps import Stamps
from photutils_mgauss.psf.errors import PSFErrors
from photutils_mgauss.psf.grid import Grid
from photutils_mgauss.psf.phase import phase_error

SHAPE = (180, 180)
# 0.9 pixels wide at half maximum, 1.2 with the pixel.
OPTICS = GaussianMixture.from_stddevs(
    [0.8, 0.2], [[0, 0], [0.1, -0.05]], [[0.36, 0.4], [0.9, 0.8]],
    [0.1, -0.2])


def image(optics, seed=3, photons=5e4, misfit=0.0):
    """
    Return data, error and stars of an image of integrated optics.

    The light in each pixel is off by a share of it.
    """
    rng = np.random.default_rng(seed)
    grid = np.mgrid[15:170:17, 15:170:17].reshape(2, -1)
    x, y = grid + rng.uniform(-1, 1, grid.shape)
    clean = sum(optics.render(SHAPE, *place, flux=photons,
                              pixel_integrated=True)
                for place in zip(x, y, strict=True))
    error = np.sqrt(clean + 50)
    data = clean + rng.normal(0, error)
    data += misfit * clean * rng.normal(size=SHAPE)
    return data, error, Table({'x': x, 'y': y})


def fitted(optics=OPTICS, misfit=0.0, **options):
    data, error, stars = image(optics, misfit=misfit)
    return fit_mixture_field(data, stars, error=error, n_components=2,
                             degree=1, radius=6, **options)


@pytest.fixture(scope='module')
def field():
    return fitted()


def phases(psf, optics=OPTICS):
    """Return x, y and flux of stars without noise over all pixel phases."""
    phase = (np.arange(6) + 0.5) / 6 - 0.5
    x, y = (place.ravel() for place in np.meshgrid(
        15 + 30 * np.arange(6) + phase, 15 + 30 * np.arange(6) + phase))
    data = sum(optics.render(SHAPE, *place, flux=1e5, pixel_integrated=True)
               for place in zip(x, y, strict=True))
    start = Table({'x_init': x, 'y_init': y, 'flux_init': np.full(36, 1e5)})
    found = MixturePSFPhotometry(psf, 11)(data, error=np.sqrt(data + 50),
                                          init_params=start)
    return found['x_fit'] - x, found['y_fit'] - y, found['flux_fit'] / 1e5


def test_stars_narrower_than_their_pixels_are_integrated(field):
    assert field.pixel_integrated
    assert repr(field).endswith('pixel_integrated=True)>')
    assert field.to_grid((2, 2)).pixel_integrated


def centred(optics, stddev):
    """Return optics and pixel about the centre under a Gaussian weight."""
    steps = np.linspace(-8, 8, 161)
    grid = np.array(np.meshgrid(steps, steps))
    pixel = optics.evaluate(*grid, pixel_integrated=True)
    centre = np.zeros(2)
    for _ in range(50):
        offset = grid - centre[:, None, None]
        weight = pixel * np.exp(-(offset**2).sum(axis=0) / 2 / stddev**2)
        centre += 2 * (weight * offset).sum(axis=(1, 2)) / weight.sum()
    return optics.shift(-centre)


def test_the_optics_come_back(field):
    steps = np.linspace(-3, 3, 31)
    grid = np.meshgrid(steps, steps)
    truth, found = (mixture.convolve(0.02 * np.eye(2)).evaluate(*grid)
                    for mixture in (centred(OPTICS, field.centre_stddev),
                                    field.mixture_at(90, 90)))
    assert_allclose(found, truth, atol=0.02 * truth.max())


def test_fluxes_and_places_do_not_depend_on_the_place_in_the_pixel(field):
    x, y, flux = phases(field.to_grid((2, 2)))
    assert flux.std() < 5e-4
    assert max(x.std(), y.std()) < 2e-3


def test_a_sampled_psf_says_by_how_much_fluxes_change():
    with pytest.warns(AstropyUserWarning, match=r'changes by \d\.\d%'):
        sampled = fitted(pixel_integrated=False)
    assert not sampled.pixel_integrated
    flux = phases(sampled.to_grid((2, 2)))[2]
    said = phase_error(sampled.mixture_at(90, 90))
    assert 0.5 < flux.std() / said < 2


def test_the_phase_error_is_that_of_the_sum_over_pixels():
    phase = np.arange(10) / 10
    x, y = np.arange(-9, 10), np.arange(-9, 10)[:, None]
    sums = [OPTICS.evaluate(x - dx, y - dy).sum()
            for dx in phase for dy in phase]
    assert_allclose(phase_error(OPTICS), np.std(sums), rtol=0.05)


def test_wide_stars_are_sampled_and_agree_with_integrated_ones():
    # 3 pixels wide at half maximum.
    wide = OPTICS.affine(3.2 * np.eye(2))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        sampled = fitted(wide)
    integrated = fitted(wide, pixel_integrated=True)
    assert not sampled.pixel_integrated
    (x, y, flux), (x_i, y_i, flux_i) = (
        phases(psf.to_grid((2, 2)), wide) for psf in (sampled, integrated))
    assert_allclose(flux, flux_i, rtol=1e-3)
    for one, other in ((x, x_i), (y, y_i)):
        assert_allclose(one - one.mean(), other - other.mean(), atol=5e-4)


@pytest.mark.long
def test_a_ring_of_light_does_not_decide_the_core():
    turn = 2 * np.pi * np.arange(12) / 12
    ring = 2.2 * np.column_stack([np.cos(turn), np.sin(turn)])
    weights = np.r_[0.5, 0.3, np.full(12, 0.2 / 12)]
    means = np.vstack([[[0, 0], [0.25, 0.1]], ring])
    optics = GaussianMixture(weights, means - weights @ means, [
        [[0.1, 0.02], [0.02, 0.14]], [[0.4, 0], [0, 0.3]],
        *12 * [0.12 * np.eye(2)]])
    # Three Gaussians can be the core, or part of it and of the ring.
    data, error, stars = image(optics, photons=1e5)
    psf = fit_mixture_field(
        data, stars, error=error, n_components=3, degree=0, radius=6,
        normalise='stamps', pixel_integrated=True).to_grid(2)
    x, y, _ = phases(psf, optics)
    assert np.hypot(x.std(), y.std()) < 0.02


def test_a_bar_shows_what_is_being_fitted(capsys, monkeypatch):
    fitted()
    assert capsys.readouterr().err == ''
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    fitted(progress_bar=True)
    shown = capsys.readouterr().err
    assert 'PSF field' in shown
    assert 'all stars' in shown


@pytest.mark.long
@pytest.mark.parametrize('share', [0.02, 0.05])
def test_light_in_the_wrong_pixels_is_noticed(share):
    assert fitted(misfit=share).accuracy == pytest.approx(share, rel=0.25)


def test_no_light_is_in_the_wrong_pixels_of_few_gaussians(field):
    assert field.accuracy < 0.003


def test_stars_have_the_errors_that_light_in_the_wrong_pixels_makes():
    rng = np.random.default_rng(5)
    y, x = (7 + 15 * np.mgrid[:12, :12].reshape(2, -1)
            + rng.uniform(-0.5, 0.5, (2, 144)))
    data = np.zeros(SHAPE)
    for place in zip(x, y, strict=True):
        star = OPTICS.render(SHAPE, *place, flux=1e4, pixel_integrated=True)
        moved = 0.03 * star * rng.normal(size=SHAPE)
        data += star + moved - star * moved.sum() / star.sum()
    nodes = Grid(np.array([90.0]), np.array([90.0]), OPTICS.weights[None],
                 OPTICS.means[None], OPTICS.covariances[None], np.ones(1))
    psf = GriddedMixturePSF(
        [OPTICS], [(90, 90)], pixel_integrated=True,
        errors=PSFErrors(nodes, np.zeros((1, 0, 2, 6)), 0.03))
    table = MixturePSFPhotometry(psf, 11)(
        data, error=np.full(SHAPE, 10.0), init_params=Table(
            {'x_init': x, 'y_init': y, 'flux_init': np.full(x.size, 1e4)}))
    for name, true in (('x', x), ('y', y), ('flux', 1e4)):
        off = np.asarray(table[f'{name}_fit']) - true
        assert off.std() == pytest.approx(
            np.sqrt(np.mean(table[f'{name}_psf_err'] ** 2)), rel=0.2)


@pytest.mark.long
def test_files_keep_how_much_light_is_in_the_wrong_pixels(tmp_path):
    psf = fitted(misfit=0.03).to_grid((2, 2))
    psf.write(tmp_path / 'psf.fits')
    kept = GriddedMixturePSF.read(tmp_path / 'psf.fits')
    assert kept.errors.misfit == psf.errors.misfit > 0.02


@pytest.mark.parametrize('ending', ['fits', 'asdf'])
def test_files_keep_whether_pixels_are_integrated(field, tmp_path, ending):
    file = tmp_path / f'field.{ending}'
    field.write(file)
    assert MixtureField.read(file).pixel_integrated
    assert MixtureField.read(file).to_grid((2, 2)).pixel_integrated


def test_a_known_psf_of_optics_is_tuned_as_such():
    data, error, stars = image(OPTICS.convolve([[0.1, 0], [0, 0.02]]))
    archive = GriddedMixturePSF([OPTICS], [(90, 90)], pixel_integrated=True)
    tuned = fit_mixture_field(data, stars, error=error, radius=6, degree=0,
                              start=archive)
    assert tuned.pixel_integrated
    assert tuned.to_grid().pixel_integrated
    assert_allclose(tuned.convolution_at(90, 90),
                    [[0.1, 0], [0, 0.02]], atol=0.01)


def test_optics_cannot_be_made_of_a_psf_that_contains_the_pixel():
    data, error, stars = image(OPTICS)
    known = GriddedMixturePSF([OPTICS], [(90, 90)])
    with pytest.raises(ValueError, match='contain the pixel already'):
        fit_mixture_field(data, stars, error=error, start=known, radius=6,
                          pixel_integrated=True)


@pytest.mark.parametrize('value', ['yes', None, 1])
def test_whether_to_integrate_is_a_choice_of_three(value):
    data, error, stars = image(OPTICS)
    with pytest.raises(ValueError, match="must be 'auto', True or False"):
        fit_mixture_field(data, stars, error=error, pixel_integrated=value)


def test_a_core_without_a_size_has_that_of_half_of_its_light():
    pair = GaussianMixture([0.5, 0.5], [[-15, 0], [15, 0]], [np.eye(2)] * 2)
    with pytest.warns(AstropyUserWarning, match='has no size'):
        width = core_width(pair)
    # Half of the light is within 15 pixels, the HWHM of such a Gaussian.
    assert width == pytest.approx(30, abs=0.2)


def test_the_slope_of_chi2_is_the_right_side_of_the_equations():
    rng = np.random.default_rng(7)
    data = np.array([OPTICS.render((13, 13), 6.1, 5.8, flux=3000,
                                   pixel_integrated=True)
                     + rng.normal(0, 1, (13, 13)) for _ in range(3)])
    data[0] += OPTICS.render((13, 13), 9, 8, flux=900, pixel_integrated=True)
    stamps = Stamps(data, np.ones(data.shape), np.ones(data.shape, bool),
                    np.zeros((3, 2)), np.zeros((3, 1, 1)))
    sources = np.zeros((3, 2, 3))
    sources[:, 0], sources[0, 1] = (6.1, 5.8, 3000), (9, 8, 900)
    basis = np.column_stack([np.ones(3), [-1, 1, 0.3]])
    problem = FieldProblem(
        stamps, np.ones(data.shape), basis, sources, sources.copy(),
        np.full(sources.shape, 0.01), np.array([2, 1, 1]), np.zeros(3), True,
        np.ones(3, bool), np.zeros(3, int), FreeShapes(), np.zeros((3, 3)),
        pixel_integrated=True)
    coefficients = rng.normal(0, 0.1, (2, 2, 6))
    coefficients[:, 0, :3] = 0
    coefficients[0, :, 3::2] += 0.5
    with Workers() as workers:
        def chi2(vector):
            change = to_coefficients(vector, coefficients)
            now = problem.subset(np.arange(3))
            for _ in range(8):
                state = equations(now, coefficients + change, workers)
                now.sources, now.sky = state.sources, state.sky
            return state.chi2.sum(), state.right

        zero = np.zeros(18)
        right = chi2(zero)[1]
        for i in range(18):
            step = zero.copy()
            step[i] = 1e-4
            slope = (chi2(step)[0] - chi2(-step)[0]) / 2e-4
            assert_allclose(-2 * right[i], slope, rtol=2e-3, atol=0.1)


def two_stars(weight):
    """Return a fit of two stars of unit noise whose pixels have a weight."""
    data = np.array([OPTICS.render((13, 13), *place, flux=3000,
                                   pixel_integrated=True)
                     for place in ((6.1, 5.8), (5.7, 6.3))])
    flat = np.ones(data.shape)
    sources = np.array([[[6.1, 5.8, 3000]], [[5.7, 6.3, 3000]]])
    coefficients = np.zeros((2, 2, 6))
    coefficients[0, :, 3::2] = [[0.9, 0.9], [0.2, 0.3]]
    problem = FieldProblem(
        Stamps(data, flat, flat > 0, np.zeros((2, 2)), np.zeros((2, 1, 1))),
        weight * flat, np.column_stack([np.ones(2), [-1, 0.5]]), sources,
        sources.copy(), np.zeros(sources.shape), np.ones(2, int),
        np.zeros(2), True, np.ones(2, bool), np.zeros(2, int), FreeShapes(),
        np.zeros((2, 3)), pixel_integrated=True)
    with Workers() as workers:
        for _ in range(12):
            found = equations(problem, coefficients, workers)
            problem.sources, problem.sky = found.sources, found.sky
    return FieldFit(problem, coefficients,
                    Prior.about(coefficients[0], 2, 1.0), found, 0.0,
                    flat < 0)


@pytest.mark.parametrize('weight', [1.0, 0.25])
def test_softened_weights_are_no_noise(weight):
    fit, plain = two_stars(weight), two_stars(1.0)
    prior = np.diag(to_vector(fit.prior.precision))
    # The noise of the gradient of chi^2 / 2 under any weights.
    noise = weight**2 * plain.equations.matrix + prior
    inverse = np.linalg.inv(weight * plain.equations.matrix + prior)
    assert_allclose(noise_covariance(fit), inverse @ noise @ inverse,
                    rtol=1e-5, atol=1e-9)
