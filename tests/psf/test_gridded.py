"""Mixtures on a grid: the blend, its derivatives, its nodes and edges."""
import copy
import pickle

import numpy as np
import pytest
from astropy import units as u
from hypothesis import given, settings
from numpy.testing import assert_allclose, assert_array_equal

from helpers.compiled import compiled
from helpers.psf_grids import make_grid, some_mixture
from helpers.strategies import SETTINGS, numbers
from photutils_mgauss import GaussianMixture, GriddedMixturePSF, blend
from photutils_mgauss.kernels.gaussian import fast_exp

Y, X = np.mgrid[:15, :15]


def reference_blend(psf, x_0, y_0):
    """Blend by hand: the four nodes around a place inside the grid."""
    x_grid, y_grid = (np.unique(psf.grid_xypos[:, i]) for i in range(2))
    i = min(max(np.searchsorted(x_grid, x_0) - 1, 0), len(x_grid) - 2)
    j = min(max(np.searchsorted(y_grid, y_0) - 1, 0), len(y_grid) - 2)
    fx = np.clip((x_0 - x_grid[i]) / (x_grid[i + 1] - x_grid[i]), 0, 1)
    fy = np.clip((y_0 - y_grid[j]) / (y_grid[j + 1] - y_grid[j]), 0, 1)
    n = len(x_grid)
    nodes = [psf.mixtures[k] for k in (j * n + i, j * n + i + 1,
                                       j * n + n + i, j * n + n + i + 1)]
    return blend(nodes, [(1 - fx) * (1 - fy), fx * (1 - fy),
                         (1 - fx) * fy, fx * fy])


positions = {'x_0': numbers(-20, 130), 'y_0': numbers(-20, 70)}


@given(**positions)
@settings(**SETTINGS)
def test_the_psf_is_the_blend_of_four_neighbours(x_0, y_0):
    psf = make_grid()
    expected = reference_blend(psf, x_0, y_0)
    x, y = X + x_0 - 7, Y + y_0 - 7
    assert_allclose(psf.evaluate(x, y, 5, x_0, y_0),
                    5 * expected.evaluate(x - x_0, y - y_0), rtol=1e-12)
    assert_allclose(psf.mixture_at(x_0, y_0).evaluate(X - 7, Y - 7),
                    expected.evaluate(X - 7, Y - 7), rtol=1e-12)


@pytest.mark.parametrize(('options', 'rounding', 'error'), [
    ({}, 1e-12, 1e-7),
    ({'interpolation': 'components'}, 1e-9, 1e-6),
    ({'interpolation': 'components', 'pixel_integrated': True}, 1e-9, 1e-6),
])
@given(**positions)
@settings(**SETTINGS)
def test_derivatives_include_the_change_of_the_psf_from_place_to_place(
        options, rounding, error, x_0, y_0):
    psf = make_grid(**options)
    # Differences are off by the square of this.
    h = 2e-5
    on_node = min(np.abs(psf.grid_xypos - (x_0, y_0)).min(axis=0))
    if on_node < 2 * h:
        return
    x, y = X + np.rint(x_0) - 7, Y + np.rint(y_0) - 7
    by_flux, by_x, by_y = psf.fit_deriv(x, y, 50, x_0, y_0)
    assert_allclose(by_flux, psf.evaluate(x, y, 1, x_0, y_0),
                    rtol=rounding)
    for column, dx, dy in ((by_x, h, 0), (by_y, 0, h)):
        expected = (psf.evaluate(x, y, 50, x_0 + dx, y_0 + dy)
                    - psf.evaluate(x, y, 50, x_0 - dx, y_0 - dy)) / (2 * h)
        assert_allclose(column, expected,
                        atol=error * np.abs(expected).max())


def test_the_blend_matters_for_the_derivative():
    # Without the change of the blend the derivative would be this wrong.
    psf = make_grid((0, 5), (0, 5))
    _, by_x, _ = psf.fit_deriv(X, Y, 1, 2.5, 2.5)
    frozen = -psf.mixture_at(2.5, 2.5).gradient(X - 2.5, Y - 2.5)[..., 0]
    assert np.abs(by_x - frozen).max() > 0.05 * np.abs(frozen).max()


@given(y_0=numbers(-20, 70))
@settings(**SETTINGS)
def test_the_psf_is_continuous_across_nodes_and_edges(y_0):
    psf = make_grid()
    for edge in (0, 30, 100):
        left = psf.mixture_at(edge - 1e-9, y_0).evaluate(X - 7, Y - 7)
        right = psf.mixture_at(edge + 1e-9, y_0).evaluate(X - 7, Y - 7)
        assert_allclose(left, right, rtol=0, atol=1e-9 * left.max())


def test_outside_the_grid_the_edge_is_used_and_does_not_change():
    psf = make_grid()
    _, by_x, _ = psf.fit_deriv(X, Y, 1, -40, 25)
    gradient = psf.mixture_at(0, 25).gradient(X + 40, Y - 25)
    assert_allclose(by_x, -gradient[..., 0], atol=1e-300)
    assert_allclose(psf.mixture_at(500, 500).covariances,
                    psf.mixtures[-1].covariances)


def test_nodes_are_ordered_by_y_then_x_whatever_order_they_come_in():
    plain, shuffled = make_grid(), make_grid(shuffle=True)
    assert_array_equal(plain.grid_xypos, [(0, 0), (30, 0), (100, 0), (0, 50),
                                          (30, 50), (100, 50)])
    assert_array_equal(shuffled.grid_xypos, plain.grid_xypos)
    assert_array_equal(shuffled(X, Y), plain(X, Y))
    assert plain.grid_shape == (2, 3)


@pytest.mark.parametrize(('x_grid', 'y_grid'), [
    ((5,), (7,)), ((0, 9), (7,)), ((5,), (0, 3, 11)), ((1, 2), (1, 2))])
def test_small_grids_are_grids(x_grid, y_grid):
    psf = make_grid(x_grid, y_grid)
    assert psf.grid_shape == (len(y_grid), len(x_grid))
    for node, (x, y) in zip(psf.mixtures, psf.grid_xypos, strict=True):
        assert_allclose(psf.mixture_at(x, y).evaluate(X - 7, Y - 7),
                        node.evaluate(X - 7, Y - 7), rtol=1e-12)
    assert all(np.isfinite(column).all()
               for column in psf.fit_deriv(X, Y, 1, 2.2, 3.3))


def test_scales_multiply_the_flux_and_blend_with_the_images():
    mixture = some_mixture(np.random.default_rng(1))
    psf = GriddedMixturePSF([mixture] * 4, [(0, 0), (8, 0), (0, 8), (8, 8)],
                            scales=[1, 1.2, 1, 1.2])
    assert_allclose(psf.scale_at(2, 5), 1.05)
    assert_allclose(psf.evaluate(X, Y, 3, 2, 5),
                    3.15 * mixture.evaluate(X - 2, Y - 5))
    assert_allclose(psf.mixture_at(2, 5).weights.sum(), 1)
    local = psf.local_model(2, 5)
    assert_allclose(local(X, Y), psf.evaluate(X, Y, 1, 2, 5))


@pytest.mark.parametrize('integrated', [False, True])
def test_many_stars_are_drawn_in_one_call(rng, integrated):
    psf = make_grid(pixel_integrated=integrated)
    x, y = rng.uniform(-5, 120, 20), rng.uniform(-5, 60, 20)
    flux = rng.uniform(1, 100, 20)
    stamps = psf.render(x, y, flux, (9, 12))
    assert stamps.shape == (20, 9, 12)
    dy, dx = np.mgrid[-4:5, -5:7]
    for i in range(20):
        assert_allclose(stamps[i], psf.evaluate(
            dx + np.rint(x[i]), dy + np.rint(y[i]), flux[i], x[i], y[i]),
            rtol=1e-9, atol=1e-12 * flux[i])


def test_one_call_evaluates_one_star_per_pixel(rng):
    psf = make_grid()
    x_0, y_0 = rng.uniform(0, 100, 6), rng.uniform(0, 50, 6)
    values = psf.evaluate(x_0 + 0.3, y_0 - 0.2, np.arange(6.0), x_0, y_0)
    expected = [i * psf.mixture_at(x_0[i], y_0[i]).evaluate(0.3, -0.2)
                for i in range(6)]
    assert_allclose(values, expected)


def test_to_gridded_psf_is_the_same_psf_in_photutils_words():
    psf = make_grid((0, 30, 60, 100), (0, 20, 40, 60), flux=10)
    peer = psf.to_gridded_psf(4, radius=9)
    assert_allclose(peer.data[0].sum() / 16, 1, rtol=1e-2)
    for x_0, y_0 in ((3.3, 4.4), (45.1, 31.7), (90, 60)):
        x, y = X + np.rint(x_0) - 7, Y + np.rint(y_0) - 7
        ours = psf.evaluate(x, y, 10, x_0, y_0)
        assert_allclose(peer.evaluate(x, y, 10, x_0, y_0), ours,
                        atol=5e-4 * ours.max())


def test_convolve_convolves_every_node():
    psf = make_grid(flux=2)
    wide = psf.convolve([[1, 0.2], [0.2, 0.5]])
    for narrow, node in zip(psf.mixtures, wide.mixtures, strict=True):
        assert_allclose(node.covariances - narrow.covariances,
                        np.broadcast_to([[1, 0.2], [0.2, 0.5]],
                                        node.covariances.shape))


@pytest.mark.parametrize('duplicate', [
    copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m)),
    GriddedMixturePSF.copy])
def test_duplicates_are_the_same_psf(duplicate):
    psf = make_grid(flux=3, x_0=1, name='star', meta={'a': [1]})
    twin = duplicate(psf)
    twin.flux = 5
    assert psf.flux == 3
    twin.flux = 3
    assert repr(twin) == repr(psf)
    assert twin.name == 'star'
    assert twin.meta == psf.meta
    assert_array_equal(twin(X, Y), psf(X, Y))
    for array in twin._grid.arrays:
        assert not array.flags.writeable


def test_flux_may_be_a_quantity():
    psf = make_grid(flux=3 * u.nJy)
    assert psf(X, Y).unit == u.nJy
    assert_allclose(psf(X, Y).value, 3 * make_grid()(X, Y))


@pytest.mark.parametrize(('places', 'message'), [
    ([(0, 0), (1, 0), (0, 1), (2, 2)], 'must form a rectangular grid, got 4'),
    ([(0, 0), (0, 0), (0, 1), (1, 1)], r'two nodes at one place, got \[0\.0'),
    ([(0, 0), (1, 0), (0, 1)], r'must have shape \(4, 2\), got \(3, 2\)'),
    ([(0, 0), (1, 0), (0, 1), (1, np.nan)], 'grid_xypos must be finite'),
])
def test_bad_positions_are_named(places, message):
    mixtures = [some_mixture(np.random.default_rng(1))] * 4
    with pytest.raises(ValueError, match=message):
        GriddedMixturePSF(mixtures, places)


def test_one_mixture_instead_of_a_list_is_named():
    mixture = some_mixture(np.random.default_rng(1))
    with pytest.raises(TypeError, match='mixtures must be a list of Gauss'):
        GriddedMixturePSF(mixture, [(0, 0)])
    with pytest.raises(TypeError, match='mixtures must be a list of Gauss'):
        blend(mixture, [1])


@pytest.mark.parametrize('interpolation', ['blend', 'components'])
def test_there_is_no_psf_at_nan(interpolation):
    psf = make_grid(interpolation=interpolation)
    for call in (psf.mixture_at, psf.scale_at):
        with pytest.raises(ValueError, match='x must not be NaN'):
            call(np.nan, 3)
        with pytest.raises(ValueError, match='y must not be NaN'):
            call(3, np.nan)


def test_bad_mixtures_and_scales_are_named():
    mixture = some_mixture(np.random.default_rng(1))
    with pytest.raises(TypeError, match='mixtures must be GaussianMixture'):
        GriddedMixturePSF([mixture, 3], [(0, 0), (1, 0)])
    with pytest.raises(ValueError, match='at least one element'):
        GriddedMixturePSF([], np.empty((0, 2)))
    with pytest.raises(ValueError, match='scales must be positive and finite'):
        GriddedMixturePSF([mixture], [(0, 0)], scales=[-1])


@given(**positions)
@settings(**SETTINGS)
def test_matched_gaussians_keep_flux_centroid_and_second_moments(x_0, y_0):
    # Those of the blended images, whatever the order of the Gaussians.
    blended = make_grid(scales=[1, 1.1, 1.2, 1, 0.9, 1])
    matched = make_grid(scales=[1, 1.1, 1.2, 1, 0.9, 1],
                        interpolation='components')
    images = blended.mixture_at(x_0, y_0)
    gaussians = matched.mixture_at(x_0, y_0)
    assert gaussians.n_components <= 3
    assert_allclose(matched.scale_at(x_0, y_0), blended.scale_at(x_0, y_0))
    assert_allclose(gaussians.moments().mean, images.moments().mean,
                    atol=1e-12)
    assert_allclose(gaussians.moments().covariance,
                    images.moments().covariance, rtol=1e-11, atol=1e-12)
    x, y = X + x_0 - 7, Y + y_0 - 7
    assert_allclose(
        matched.evaluate(x, y, 2, x_0, y_0), 2 * matched.scale_at(x_0, y_0)
        * gaussians.evaluate(x - x_0, y - y_0), rtol=1e-10)


def test_matching_undoes_a_shuffle_of_the_gaussians(rng):
    nodes = [GaussianMixture([0.6, 0.3, 0.1], [[0, 0], [0.1, 0], [0, 0.1]],
                             [np.eye(2) * (1 + 0.01 * i) * s
                              for s in (1, 3, 9)]) for i in range(9)]
    places = [(i % 3, i // 3) for i in range(9)]
    shuffled = []
    for node in nodes:
        order = rng.permutation(3)
        shuffled.append(GaussianMixture(node.weights[order], node.means[order],
                                        node.covariances[order]))
    plain, mixed = (GriddedMixturePSF(m, places, interpolation='components')
                    for m in (nodes, shuffled))
    for x_0, y_0 in rng.uniform(0, 2, (10, 2)):
        expected = plain.mixture_at(x_0, y_0)
        assert_allclose(mixed.evaluate(X, Y, 1, x_0, y_0),
                        expected.evaluate(X - x_0, Y - y_0), rtol=1e-9)
        assert_allclose(sorted(expected.weights), [0.1, 0.3, 0.6])


@pytest.mark.long
@pytest.mark.parametrize('interpolation', ['blend', 'components'])
def test_stamps_and_points_of_many_stars_follow_the_interpolation(
        rng, interpolation):
    psf = make_grid(interpolation=interpolation)
    x_0, y_0 = rng.uniform(0, 100, 6), rng.uniform(0, 50, 6)
    stamps = psf.render(x_0, y_0, 3, 9)
    dy, dx = np.mgrid[-4:5, -4:5]
    for i in range(6):
        assert_allclose(stamps[i], psf.evaluate(
            dx + np.rint(x_0[i]), dy + np.rint(y_0[i]), 3, x_0[i], y_0[i]),
            rtol=1e-9)
    points = psf.evaluate(x_0 + 0.3, y_0, 1, x_0, y_0)
    assert_allclose(points, [psf.evaluate(x_0[i] + 0.3, y_0[i], 1, x_0[i],
                                          y_0[i]) for i in range(6)])


def test_negative_weights_cannot_be_matched():
    signed = GaussianMixture([-0.2, 1.2], np.zeros((2, 2)),
                             [np.eye(2), 2 * np.eye(2)])
    with pytest.raises(ValueError, match="must be 'blend' where weights are"):
        GriddedMixturePSF([signed], [(0, 0)], interpolation='components')
    with pytest.raises(ValueError, match='interpolation must be one of'):
        GriddedMixturePSF([signed], [(0, 0)], interpolation='linear')


def test_outside_the_grid_is_an_error_if_wanted():
    psf = make_grid(outside='raise')
    assert np.isfinite(psf.evaluate(X, Y, 1, 100, 50)).all()
    for call in (lambda: psf.evaluate(X, Y, 1, 100.1, 50),
                 lambda: psf.fit_deriv(X, Y, 1, 30, -1),
                 lambda: psf.render([3, 300], [3, 3], 1, 5),
                 lambda: psf.mixture_at(-1, 0), lambda: psf.scale_at(-1, 0)):
        with pytest.raises(ValueError, match='must be inside the grid of no'):
            call()


def test_outside_the_grid_is_nan_if_wanted():
    psf = make_grid(outside='nan')
    assert np.isnan(psf.evaluate(X, Y, 1, 101, 50)).all()
    assert np.isnan(psf.fit_deriv(X, Y, 1, 30, -1)).all()
    values = psf.evaluate([1.0, 2.0], [1.0, 2.0], 1, np.array([1.0, -2.0]),
                          np.array([1.0, 2.0]))
    assert list(np.isnan(values)) == [False, True]
    stamps = psf.render([3, 300, 4], [3, 3, 4], 1, 5)
    assert list(np.isnan(stamps).all(axis=(1, 2))) == [False, True, False]
    assert not np.isnan(stamps[[0, 2]]).any()


def test_missing_nodes_are_bridged_from_their_neighbours():
    positions = [(x, y) for y in range(3) for x in range(3)]
    mixtures = [GaussianMixture([1], [[0.1 * x, 0]], [np.eye(2) * (1 + y)])
                for x, y in positions]
    scales = [1 + x for x, _ in positions]
    mixtures[4] = None
    scales[4] = np.nan
    psf = GriddedMixturePSF(mixtures, positions, scales=scales)
    assert list(np.flatnonzero(psf.report['bridged'])) == [4]
    assert psf.n_components == 1
    # The four nearest nodes are symmetric around it.
    assert_allclose(psf.mixtures[4].moments().mean, [0.1, 0], atol=1e-12)
    assert_allclose(psf.scale_at(1, 1), 2, rtol=1e-12)
    assert np.isfinite(psf(X, Y)).all()
    with pytest.raises(ValueError, match='element that is not None'):
        GriddedMixturePSF([None], [(0, 0)])


def test_a_bridge_over_gaussians_of_both_signs_is_the_nearest_node():
    signed = GaussianMixture([-0.2, 1.2], np.zeros((2, 2)),
                             [np.eye(2), 2 * np.eye(2)])
    psf = GriddedMixturePSF([signed, None], [(0, 0), (9, 0)])
    assert_array_equal(psf.mixtures[1].weights, signed.weights)


def test_galsim_draws_the_same_star():
    pytest.importorskip('galsim')
    psf = make_grid(scales=[1, 1.1, 1.2, 1, 0.9, 1])
    image = psf.to_galsim(40, 20).drawImage(nx=25, ny=25, scale=1,
                                            method='no_pixel', dtype=float)
    expected = psf.scale_at(40, 20) * psf.mixture_at(40, 20).render(
        (25, 25), 12, 12)
    assert_allclose(image.array, expected, atol=1e-7 * expected.max())


def test_a_large_grid_is_small_in_memory(rng):
    n = 900
    mixtures = [some_mixture(rng, 5) for _ in range(n)]
    places = [(i % 30, i // 30) for i in range(n)]
    psf = GriddedMixturePSF(mixtures, places)
    grid = psf._grid
    assert sum(a.nbytes for a in (*grid.arrays, grid.rows)) < 1e6
    assert psf.copy()._grid is grid


def test_the_exponential_function_is_exact_to_the_last_digit(rng):
    x = np.concatenate([-rng.uniform(0, 688, 100_000), [0, -1e-300, -688]])
    exp = compiled(fast_exp)
    assert_allclose([exp(each) for each in x], np.exp(x), rtol=3e-16)
    extremes = np.array([-700, -1e5, -1e300, -np.inf, np.nan])
    assert_array_equal([exp(each) for each in extremes],
                       [0, 0, 0, 0, np.nan])
