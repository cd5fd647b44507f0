"""Laws of fields fitted to star pixels, and comparisons with the truth."""
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import (
    EmpiricalPSF,
    GaussianMixture,
    GriddedMixturePSF,
    fit_mixture_field,
)
from photutils_mgauss.field import normal
from photutils_mgauss.field.forms import FreeShapes
from photutils_mgauss.field.normal import (
    FieldProblem,
    Workers,
    equations,
    to_coefficients,
)
from photutils_mgauss.field.stamps import Stamps

SHAPE = (200, 240)


def true_psf(x, y):
    """Two Gaussians, the shapes of which are linear in position."""
    u, v = x / 120 - 1, y / 100 - 1
    return GaussianMixture.from_stddevs(
        [0.75, 0.25], [[0, 0], [0.3 + 0.2 * u, 0.1 * v]],
        [[1.1 + 0.1 * u, 1.2 + 0.1 * v], [2.4, 2.2 + 0.2 * u]],
        [0.1 * v, 0.1])


def true_shift(x, y):
    return true_psf(x, y).moments().mean


@pytest.fixture(scope='module')
def stars():
    rng = np.random.default_rng(3)
    grid = np.mgrid[12:230:24, 12:190:22].reshape(2, -1)
    x, y = grid + rng.uniform(-3, 3, grid.shape)
    return Table({'x': x, 'y': y, 'flux': rng.uniform(5e3, 5e4, x.size)})


@pytest.fixture(scope='module')
def clean(stars):
    return draw(stars)


def draw(stars):
    return sum(true_psf(x, y).render(SHAPE, x, y, flux=flux)
               for x, y, flux in stars.iterrows('x', 'y', 'flux'))


def noisy(clean, rng, sky=30.0):
    """Return data, their error made from the data, and the true one."""
    counts = rng.poisson(clean + sky)
    return counts - sky, np.sqrt(np.maximum(counts, 1)), np.sqrt(clean + sky)


@pytest.fixture(scope='module')
def field(stars, clean):
    data, error, _ = noisy(clean, np.random.default_rng(5))
    return fit_mixture_field(data, stars, error=error, n_components=2,
                             degree=1, radius=8, centre='flux')


def profile_error(field, x, y):
    """Return the largest error of the PSF, relative to its peak."""
    steps = np.arange(-6, 6.1, 0.5)
    truth = true_psf(x, y)
    truth = truth.shift(-truth.moments().mean).evaluate(steps,
                                                        steps[:, None])
    model = field.mixture_at(x, y).evaluate(steps, steps[:, None])
    return np.abs(model - truth).max() / truth.max()


def test_without_noise_the_field_is_the_truth(stars, clean):
    field = fit_mixture_field(clean, stars, error=np.full(SHAPE, 10.0),
                              n_components=2, degree=2, radius=8,
                              centre='flux')
    for x, y in [(20, 20), (120, 100), (220, 180), (200, 30)]:
        assert profile_error(field, x, y) < 3e-3


def test_with_noise_the_field_is_near_the_truth(field):
    for x, y in [(20, 20), (120, 100), (220, 180)]:
        assert profile_error(field, x, y) < 0.015


def test_the_flux_centroid_is_the_origin_everywhere(field):
    for x, y in [(0, 0), (239, 0), (100, 150)]:
        mixture = field.mixture_at(x, y)
        assert_allclose(mixture.moments().mean, 0, atol=1e-12)
        assert_allclose(mixture.weights.sum(), 1, rtol=1e-12)


def test_positions_and_fluxes_of_the_stars_are_unbiased(field, stars):
    shift = np.array([true_shift(x, y) for x, y in
                      stars.iterrows('x', 'y')])
    offset = np.column_stack([field.stars['x_fit'] - stars['x'],
                              field.stars['y_fit'] - stars['y']]) - shift
    flux = np.array(field.stars['flux_fit'] / stars['flux'])
    # Errors: 0.007 px and 0.8 % a star for some 80 stars.
    assert_allclose(np.median(offset, axis=0), 0, atol=0.003)
    assert_allclose(np.median(flux), 1, atol=0.004)
    assert_allclose(np.median(field.stars['reduced_chi2']), 1, atol=0.05)


def test_every_star_is_used_if_none_is_deviant(field, stars):
    assert len(field.stars) == len(stars)
    assert field.stars['used'].all()
    assert not field.stars['reason'].astype(bool).any()


def test_error_made_from_data_gives_the_result_of_the_true_error(stars,
                                                                 clean):
    data, error, true_error = noisy(clean, np.random.default_rng(8))
    from_data, from_truth = (
        fit_mixture_field(data, stars, error=e, n_components=2, degree=1,
                          radius=8).stars['flux_fit']
        for e in (error, true_error))
    # Weights 1 / data would lose some 0.2 % of the flux.
    assert abs(np.mean(from_data / from_truth) - 1) < 3e-4


def test_a_grid_is_the_field_at_its_nodes(field):
    grid = field.to_grid((3, 4))
    assert grid.grid_shape == (3, 4)
    assert_allclose(grid.grid_xypos[-1], [239, 199])
    node = grid.mixture_at(239, 0)
    mixture = field.mixture_at(239, 0)
    assert_allclose(np.sort(node.weights), np.sort(mixture.weights))


def test_a_grid_that_no_memory_holds_is_refused_at_once(field):
    with pytest.raises(ValueError, match=(
            'grid_shape must have at most 100000 nodes, got 20000 x 20000')):
        field.to_grid(20000)


@pytest.mark.parametrize('blur', [0, 0.4, -0.15])
def test_the_slope_of_chi2_is_the_right_side_of_the_equations(rng, blur):
    problem = small_problem(rng, np.full((4, 3), blur) * [1, 0.3, 0.8])
    coefficients = rng.normal(0, 0.1, (3, 2, 6))
    coefficients[:, 0, :3] = 0
    coefficients[0, 1, 3:] -= 0.5
    with Workers() as workers:
        def chi2(vector):
            change = to_coefficients(vector, coefficients)
            now = problem.subset(np.arange(4))
            for _ in range(8):
                state = equations(now, coefficients + change, workers)
                now.sources, now.sky = state.sources, state.sky
            return state.chi2.sum(), state.right

        zero = np.zeros(27)
        right = chi2(zero)[1]
        for i in range(27):
            step = zero.copy()
            step[i] = 1e-4
            slope = (chi2(step)[0] - chi2(-step)[0]) / 2e-4
            assert_allclose(-2 * right[i], slope, rtol=1e-3, atol=0.05)


def small_problem(rng, local):
    """Four stars, the first with a neighbour, on a local sky."""
    y, x = np.mgrid[:17, :17] - 8.0
    psf = np.exp(-0.5 * (x**2 + y**2) / 2.2)
    data = 200 * psf + rng.normal(0, 1, (4, 17, 17))
    data[0] += 80 * np.exp(-0.5 * ((x - 5) ** 2 + (y - 2) ** 2) / 2.2)
    good = np.ones(data.shape, bool)
    stamps = Stamps(data, np.ones(data.shape), good, np.zeros((4, 2)),
                    np.zeros((4, 1, 1)))
    sources = np.zeros((4, 2, 3))
    sources[:, 0] = 8.1, 7.9, 3000
    sources[0, 1] = 13, 10, 900
    hold = np.full(sources.shape, 0.01)
    basis = np.column_stack([np.ones(4), [-1, 1, 0.3, 0], [0.5, 0, -1, 1]])
    return FieldProblem(
        stamps, good / 1.0, basis, sources, sources.copy(), hold,
        np.array([2, 1, 1, 1]), np.zeros(4), True, np.ones(4, bool),
        np.zeros(4, int), FreeShapes(), local)


def test_one_absurdly_bright_blend_is_dropped(stars, clean):
    blend = Table(stars[:1])
    blend['x'], blend['y'] = 101.0, 100.0
    data = clean.copy()
    for dx, dy in ((0, 0), (3.1, 1), (-1, 2.5)):
        data += true_psf(100, 100).render(SHAPE, 101 + dx, 100 + dy,
                                          flux=3e6)
    data, error, _ = noisy(data, np.random.default_rng(5))
    near = np.hypot(stars['x'] - 101, stars['y'] - 100) < 16
    stars = stars[~near]
    stars.add_row((101.0, 100.0, 3e6))
    field = fit_mixture_field(data, stars, error=error, n_components=2,
                              degree=1, radius=8)
    assert not field.stars['used'][-1]
    assert field.stars['reason'][-1] == 'deviant'
    assert field.stars['used'].sum() > 0.9 * len(stars)
    assert profile_error(field, 60, 60) < 0.015


@pytest.mark.parametrize('error', [None, 25.0])
def test_a_sky_that_was_not_subtracted_is_warned_of(stars, clean, rng, error):
    data, some = 500 + clean + rng.normal(0, 25, SHAPE), stars[::6]
    given = {'error': error, 'n_components': 2, 'degree': 0, 'radius': 10}
    # Warnings are errors here, and the first one ends the fit.
    with pytest.raises(AstropyUserWarning, match=r'the image has a background '
                       r'of 50\d\.?\d*, which .* local_bkg=True$'):
        fit_mixture_field(data, some, **given)
    fit_mixture_field(data, some, local_bkg=True, **given)
    fit_mixture_field(data - 500, some, **given)


def test_cosmic_rays_are_left_out(stars, clean):
    rng = np.random.default_rng(5)
    data, error, _ = noisy(clean, rng)
    hit = rng.random(SHAPE) < 0.003
    data[hit] += 2000
    error[hit] = np.sqrt(error[hit] ** 2 + 2000)
    field = fit_mixture_field(data, stars, error=error, n_components=2,
                              degree=1, radius=8, centre='flux')
    y, x = np.nonzero(hit)
    near = [np.hypot(x - x_0, y - y_0) <= 8.5 for x_0, y_0 in
            np.rint([stars['x'], stars['y']]).T]
    n_hit = np.sum(near, axis=1)
    assert n_hit.sum() > 40
    assert np.mean(field.stars['n_pixels_rejected'] >= n_hit) > 0.95
    assert profile_error(field, 120, 100) < 0.015


def test_bad_pixels_are_left_out_whatever_marks_them(stars, clean):
    data, error, _ = noisy(clean, np.random.default_rng(5))
    mask = np.zeros(SHAPE, bool)
    x, y = np.rint(stars['x'][:4]).astype(int), np.rint(stars['y'][:4])
    y = y.astype(int)
    data[y[0] + 3, x[0]] = np.nan
    error[y[1] + 3, x[1]] = -1
    error[y[2] + 3, x[2]] = 0
    mask[y[3] + 3, x[3]] = True
    field = fit_mixture_field(data, stars, error=error, mask=mask,
                              n_components=1, degree=0, radius=5)
    full = field.stars['n_pixels_fit'][10] + \
        field.stars['n_pixels_rejected'][10]
    assert np.all(field.stars['n_pixels_fit'][:4] < full)
    assert np.isnan(field.residual_stars[0, 8, 5])


def test_stars_that_cannot_be_used_are_named_not_fatal(stars, clean):
    more = stars.copy()
    more.add_row((-50.0, 20.0, 100.0))
    more.add_row((np.nan, 20.0, 100.0))
    field = fit_mixture_field(clean, more, error=np.ones(SHAPE),
                              n_components=1, degree=0)
    reasons = dict(zip(field.dropped['id'], field.dropped['reason'],
                       strict=True))
    assert reasons[len(stars) + 1] == 'outside'
    assert reasons[len(stars) + 2] == 'outside'


def test_too_few_stars_lower_the_degree_with_a_warning(stars, clean):
    with pytest.warns(AstropyUserWarning, match='needs 19; degree 1 is'):
        field = fit_mixture_field(clean, stars[:6], error=np.ones(SHAPE),
                                  n_components=1, degree=3)
    assert field.degree == 1


def test_no_usable_star_is_an_error_that_says_how_many(stars, clean):
    mask = np.ones(SHAPE, bool)
    mask[0, 0] = False
    with pytest.raises(ValueError, match='at least 1 star'):
        fit_mixture_field(clean, stars, mask=mask)


def test_negative_stars_and_noise_are_not_fitted(stars, clean, rng):
    noise = rng.normal(size=SHAPE)
    for start in (None, GriddedMixturePSF([GaussianMixture(
            [1], [[0, 0]], [np.eye(2)])], [(0, 0)])):
        with pytest.raises(ValueError, match='negate the image'):
            fit_mixture_field(noise - clean, stars, start=start)
        with pytest.raises(ValueError, match='no more than noise'):
            fit_mixture_field(noise, stars, start=start)
    with pytest.raises(ValueError, match='negate the image'):
        EmpiricalPSF.from_stars(noise - clean, stars)


@pytest.mark.parametrize(('arguments', 'text'), [
    ({'n_components': 0}, 'n_components must be at least 1, got 0'),
    ({'degree': -1}, 'degree must be at least 0, got -1'),
    ({'radius': 1}, 'radius must be at least 2'),
    ({'error': np.ones((3, 3))}, r'error must have the shape .*\(3, 3\)'),
    ({'regularization': 0}, 'regularization must be greater than 0'),
])
def test_errors_name_argument_and_value(stars, clean, arguments, text):
    with pytest.raises(ValueError, match=text):
        fit_mixture_field(clean, stars, **arguments)


def test_neighbours_are_fitted_along(rng):
    x = np.array([30.0, 35.1, 80.2, 84.0, 130.4, 170.9])
    y = np.array([30.3, 33.0, 60.1, 63.9, 100.2, 150.8])
    stars = Table({'x': np.rint(x), 'y': np.rint(y)})
    flux = np.array([2e4, 1e4, 2e4, 2e4, 3e4, 3e4])
    psf = true_psf(120, 100)
    clean = sum(psf.render(SHAPE, *one, flux=f)
                for *one, f in zip(x, y, flux, strict=True))
    data, error, _ = noisy(clean, rng)
    field = fit_mixture_field(data, stars, error=error, n_components=2,
                              degree=0, radius=8)
    offset = np.array([field.stars['x_fit'] - x, field.stars['y_fit'] - y])
    assert_allclose(offset - psf.moments().mean[:, None], 0, atol=0.04)
    assert_allclose(field.stars['flux_fit'] / flux, 1, atol=0.04)


@pytest.mark.long
def test_the_executor_does_not_change_the_result(stars, clean):
    arguments = {'error': np.full(SHAPE, 5.0), 'n_components': 1, 'degree': 1}
    with ThreadPoolExecutor(1) as executor:
        one = fit_mixture_field(clean, stars, executor=executor, **arguments)
    two = fit_mixture_field(clean, stars, **arguments)
    assert_allclose(one.coefficients, two.coefficients, atol=1e-8)


def test_the_nine_stars_of_daophots_image_are_found(realdata):
    from astropy.io import fits
    data = fits.getdata(realdata('daophot_test') / 'fits3.fits').astype(float)
    x, y = np.array([(41, 4), (8, 23), (31, 25), (29, 34), (36, 42), (23, 7),
                     (18, 8), (36, 22), (26, 22)]).T - 1.0
    stars = Table({'x': x, 'y': y})
    field = fit_mixture_field(data - np.median(data), stars, degree=0,
                              n_components=2, radius=8, local_bkg=True)
    dx, dy = field.stars['x_fit'] - x, field.stars['y_fit'] - y
    for offset in (dx, dy):
        assert np.sqrt(np.mean((offset - np.mean(offset)) ** 2)) < 0.04


@pytest.mark.long
def test_left_out_stars_choose_degree_and_number_of_gaussians(stars, clean):
    data, error, _ = noisy(clean, np.random.default_rng(5))
    field = fit_mixture_field(data, stars[::2], error=error,
                              n_components='auto', degree='auto', radius=6)
    # The truth: two Gaussians, linear in position.
    assert field.n_components in (2, 3)
    scores = field.choice['reduced_chi2']
    assert field.choice['degree'][scores.argmin()] in (1, 2)
    assert scores[field.choice['degree'] == 0].min() > scores.min()
    # The field has higher terms, which are next to nothing.
    sizes_of_terms = np.abs(field.coefficients).max(axis=(1, 2))
    assert sizes_of_terms[6:].max() < 0.1 * sizes_of_terms[1:3].max()


def test_no_gaussian_is_as_flat_as_the_sky(stars, clean, monkeypatch):
    data, _, error = noisy(clean, np.random.default_rng(6))
    # The sky was taken too low.
    fit = partial(fit_mixture_field, data + 12, stars, error=error,
                  n_components=3, degree=1, radius=8)
    widest = 8 / np.sqrt(2)
    assert sizes(fit()).max() < 1.15 * widest
    monkeypatch.setattr(normal, '_WALL', 0.0)
    assert sizes(fit()).max() > 1.5 * widest


def sizes(field):
    """Return the standard deviations along the axes (K, 2) of Gaussians."""
    values = np.linalg.eigvalsh(field.mixture_at(120, 100).covariances)
    return np.sqrt(values)


def test_a_list_of_which_many_places_hold_no_star_is_said(rng):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(20.0, 230, 30),
                                           np.arange(20.0, 190, 30)))
    x, y = x + rng.uniform(-4, 4, x.size), y + rng.uniform(-4, 4, y.size)
    light = sum(true_psf(120, 100).render(SHAPE, *place, flux=2e4)
                for place in zip(x, y, strict=True))
    error = np.sqrt(light + 25)
    data = rng.normal(light, error)
    how = {'error': error, 'n_components': 1, 'degree': 0, 'radius': 8}
    exchanged = Table({'x': np.append(y, x[:20]), 'y': np.append(x, y[:20])})
    with pytest.warns(AstropyUserWarning,
                      match=r'62 stars given are not used \(.*outside'):
        field = fit_mixture_field(data, exchanged, **how)
    assert len(field.dropped) > 20
    fit_mixture_field(data, Table({'x': x, 'y': y}), **how)
