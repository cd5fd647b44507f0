"""The algebra of mixtures, as laws and beside independent answers."""
import copy
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import dblquad, quad
from scipy.signal import fftconvolve

from helpers.strategies import SETTINGS, covariances, mixtures, numbers
from photutils_mgauss import GaussianMixture, blend


def equation_3(x, y, alpha_x, alpha_y, beta_x, beta_y, gamma):
    """Transcribe Eq. 3 of Nie et al. symbol by symbol."""
    norm = (2 * np.pi * beta_x * beta_y * np.sqrt(1 - gamma**2)) ** -1
    return norm * np.exp(
        -1 / (2 * (1 - gamma**2))
        * ((x - alpha_x) ** 2 / beta_x**2
           - 2 * gamma * (x - alpha_x) * (y - alpha_y) / (beta_x * beta_y)
           + (y - alpha_y) ** 2 / beta_y**2))


def equation_2(mixture, x, y):
    """Sum Eq. 3 with the weights, Eq. 2."""
    rows = zip(mixture.weights, *mixture.means.T, *mixture.stddevs.T,
               mixture.rho, strict=True)
    return sum(w * equation_3(x, y, *shape) for w, *shape in rows)


def peak(mixture):
    """Bound the peak of the absolute value of a mixture."""
    return np.abs(mixture.rows[:, 0]).sum()


@given(mixtures(signed=True), numbers(-15, 15), numbers(-15, 15))
@settings(**SETTINGS)
def test_evaluate_is_equation_2(mixture, x, y):
    assert_allclose(mixture.evaluate(x, y), equation_2(mixture, x, y),
                    rtol=1e-9, atol=1e-13 * peak(mixture))


@given(mixtures(), numbers(-6, 6), numbers(-6, 6), st.booleans())
@settings(**SETTINGS)
def test_gradient_is_the_central_difference(mixture, x, y, integrated):
    h = 1e-5

    def value(dx, dy):
        return mixture.evaluate(x + dx, y + dy, pixel_integrated=integrated)

    expected = [(value(h, 0) - value(-h, 0)) / (2 * h),
                (value(0, h) - value(0, -h)) / (2 * h)]
    assert_allclose(mixture.gradient(x, y, pixel_integrated=integrated),
                    expected, rtol=1e-6, atol=1e-8 * peak(mixture))


stddev_decades = numbers(np.log(0.2), np.log(50)).map(np.exp)


@given(stddev_decades, stddev_decades, numbers(-0.999, 0.999),
       numbers(-80, 200), numbers(-60, 120))
@example(0.2, 0.2, 0.999, 20.3, 22.7)
@example(50, 0.2, -0.999, 45.5, 10.5)
@example(0.4, 0.4, 0, 44.6, 3.2)
@example(50, 50, 0.999, -70, 100)
@settings(**SETTINGS)
def test_the_walk_along_rows_equals_direct_evaluation(sx, sy, rho, x_0, y_0):
    mixture = GaussianMixture.from_stddevs([1], [[0.1, -0.2]], [[sx, sy]],
                                           [rho])
    y, x = np.mgrid[:50, :120]
    assert_allclose(mixture.render((50, 120), x_0, y_0),
                    mixture.evaluate(x - x_0, y - y_0),
                    rtol=0, atol=1e-12 * peak(mixture))


@given(mixtures(max_components=2, max_stddev=3), numbers(-0.5, 0.5),
       numbers(-3, 3))
@settings(**{**SETTINGS, 'max_examples': 15})
@example(GaussianMixture.from_stddevs([1], [[0, 0]], [[0.4, 0.4]], [0.95]),
         0.3, -0.2)
@example(GaussianMixture.from_stddevs([1], [[0, 0]], [[3, 0.4]], [-0.95]),
         0.1, 1)
def test_pixel_integral_is_the_double_integral(mixture, x, y):
    expected, _ = dblquad(lambda v, u: equation_2(mixture, u, v),
                          x - 0.5, x + 0.5, y - 0.5, y + 0.5,
                          epsabs=1e-10 * peak(mixture))
    assert_allclose(mixture.evaluate(x, y, pixel_integrated=True), expected,
                    rtol=0, atol=1e-7 * peak(mixture))


@given(mixtures(), numbers(-20, 30), numbers(-20, 30))
@settings(**{**SETTINGS, 'max_examples': 20})
def test_rendered_pixel_integrals_equal_evaluated_ones(mixture, x_0, y_0):
    y, x = np.mgrid[:15, :17]
    assert_allclose(
        mixture.render((15, 17), x_0, y_0, pixel_integrated=True),
        mixture.evaluate(x - x_0, y - y_0, pixel_integrated=True),
        rtol=0, atol=1e-12 * peak(mixture))


@given(mixtures(max_stddev=3, signed=True), numbers(0, 1), numbers(0, 1))
@settings(**SETTINGS)
def test_pixels_of_an_integrated_star_sum_to_its_flux(mixture, x, y):
    image = mixture.render((71, 71), 35 + x, 35 + y, flux=7,
                           pixel_integrated=True)
    assert_allclose(image.sum(), 7, rtol=1e-9)


@given(mixtures(), mixtures())
@settings(**SETTINGS)
def test_moments_add_in_a_convolution(first, second):
    both = first.convolve(second).moments()
    assert_allclose(both.mean, first.moments().mean + second.moments().mean,
                    atol=1e-12)
    assert_allclose(both.covariance, first.moments().covariance
                    + second.moments().covariance, rtol=1e-11, atol=1e-11)


@given(mixtures(min_stddev=1, max_stddev=4, max_rho=0.5))
@settings(**{**SETTINGS, 'max_examples': 10})
def test_moments_are_those_of_the_pixels(mixture):
    y, x = np.mgrid[-60:61, -60:61]
    image = mixture.render((121, 121), 60, 60)
    moments = mixture.moments()
    mean = np.array([(image * x).sum(), (image * y).sum()])
    assert_allclose(moments.mean, mean, atol=1e-6)
    dx, dy = x - mean[0], y - mean[1]
    assert_allclose(moments.covariance,
                    [[(image * dx * dx).sum(), (image * dx * dy).sum()],
                     [(image * dx * dy).sum(), (image * dy * dy).sum()]],
                    rtol=1e-5, atol=1e-5)


@given(mixtures(), covariances())
@settings(**SETTINGS)
def test_deconvolution_undoes_convolution(mixture, covariance):
    there = mixture.convolve(covariance)
    back = there.deconvolve(covariance)
    # What a subtraction of nearly equal matrices leaves.
    scale = np.abs(there.covariances).max()
    assert_allclose(back.covariances, mixture.covariances, rtol=0,
                    atol=1e-14 * scale)


def test_convolution_with_a_gaussian_is_that_of_the_images():
    mixture = GaussianMixture.from_stddevs(
        [0.7, 0.3], [[0, 0], [1, -1]], [[2, 2.5], [4, 3]], [0.3, -0.4])
    covariance = np.array([[3.0, 1.0], [1.0, 2.0]])
    kernel = GaussianMixture([1], [[0, 0]], [covariance])
    expected = fftconvolve(mixture.render((101, 101), 50, 50),
                           kernel.render((101, 101), 50, 50), mode='same')
    assert_allclose(mixture.convolve(covariance).render((101, 101), 50, 50),
                    expected, atol=1e-8)


def test_deconvolving_more_than_there_is_says_which_component():
    mixture = GaussianMixture.from_stddevs(
        [0.5, 0.5], [[0, 0], [0, 0]], [[3, 3], [1, 1]], [0, 0])
    with pytest.raises(ValueError, match=r'component 1 .* eigenvalue -0\.5'):
        mixture.deconvolve([[1.5, 0], [0, 1.5]])


@given(mixtures(), numbers(-3, 3), numbers(-3, 3),
       st.tuples(*[numbers(-2, 2)] * 4))
@settings(**SETTINGS)
def test_affine_maps_the_light(mixture, x, y, elements):
    matrix = np.reshape(elements, (2, 2))
    if abs(np.linalg.det(matrix)) < 0.1:
        return
    u, v = matrix @ (x, y)
    expected = mixture.evaluate(x, y) / abs(np.linalg.det(matrix))
    mapped = mixture.affine(matrix)
    assert_allclose(mapped.evaluate(u, v), expected, rtol=1e-6,
                    atol=1e-9 * peak(mapped))


def test_affine_refuses_a_singular_matrix():
    mixture = GaussianMixture([1], [[0, 0]], [np.eye(2)])
    with pytest.raises(ValueError, match='matrix must not be singular'):
        mixture.affine([[1, 2], [2, 4]])


@given(mixtures(max_components=3), numbers(0, 10))
@example(GaussianMixture.from_stddevs([1], [[1.5, 0]], [[8, 0.4]], [0.95]), 3)
@settings(**{**SETTINGS, 'max_examples': 20})
def test_encircled_energy_is_the_integral_over_the_disc(mixture, radius):
    def ring(r):
        angle = 2 * np.pi * np.arange(4096) / 4096
        light = equation_2(mixture, r * np.cos(angle), r * np.sin(angle))
        return 2 * np.pi * r * light.mean()

    expected, _ = quad(ring, 0, radius, epsabs=1e-10, limit=200)
    assert_allclose(mixture.encircled_energy(radius), expected, atol=1e-8)


def test_encircled_energy_ends_at_one_and_keeps_the_shape():
    mixture = GaussianMixture.from_stddevs([1], [[0, 0]], [[1, 1]], [0])
    energy = mixture.encircled_energy([[0, 1], [20, np.inf]])
    assert_allclose(energy, [[0, 1 - np.exp(-0.5)], [1, 1]], atol=1e-12)
    with pytest.raises(ValueError, match='radius must not be negative'):
        mixture.encircled_energy(-1)


@pytest.mark.parametrize('rho', [0, 0.6])
def test_the_width_of_one_gaussian_is_the_closed_form(rho):
    psf = GaussianMixture.from_stddevs([1], [[0.3, -0.2]], [[1.2, 1.7]], rho)
    area = np.pi * 2 * np.log(2) * np.sqrt(np.linalg.det(psf.covariances[0]))
    assert_allclose(psf.fwhm, 2 * np.sqrt(area / np.pi), rtol=1e-6)


def test_the_width_is_that_of_the_light_above_half_of_the_peak():
    psf = GaussianMixture.from_stddevs(
        [0.6, 0.4], [[0.1, 0], [-0.6, 0.4]], [[0.9, 1.1], [2.3, 1.9]],
        [0.2, -0.3])
    points = np.linspace(-4, 4, 1601)
    image = psf.evaluate(points, points[:, None])
    area = (image > image.max() / 2).sum() * (points[1] - points[0])**2
    assert_allclose(psf.fwhm, 2 * np.sqrt(area / np.pi), rtol=1e-3)


@given(st.lists(mixtures(), min_size=4, max_size=4), st.integers(0, 3),
       numbers(-4, 4), numbers(-4, 4))
@settings(**SETTINGS)
def test_a_blend_at_a_node_is_that_node(nodes, i, x, y):
    assert_array_equal(blend(nodes, np.eye(4)[i]).evaluate(x, y),
                       nodes[i].evaluate(x, y))


@given(st.lists(mixtures(), min_size=4, max_size=4),
       st.tuples(numbers(0, 1), numbers(0, 1)), numbers(-4, 4), numbers(-4, 4))
@settings(**SETTINGS)
def test_a_blend_is_the_weighted_sum_of_images(nodes, place, x, y):
    fx, fy = place
    shares = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
    shares[3] += 1 - sum(shares)
    expected = sum(s * n.evaluate(x, y)
                   for s, n in zip(shares, nodes, strict=True))
    assert_allclose(blend(nodes, shares).evaluate(x, y), expected,
                    rtol=1e-13, atol=1e-15)


def test_a_mixture_copies_its_input_and_never_changes():
    weights = np.array([0.4, 0.6])
    means = np.zeros((2, 2))
    mixture = GaussianMixture(weights, means, [np.eye(2), 2 * np.eye(2)])
    weights[0] = 9
    assert mixture.weights[0] == 0.4
    for twin in (mixture, pickle.loads(pickle.dumps(mixture)),
                 copy.deepcopy(mixture), copy.copy(mixture)):
        assert_array_equal(twin.weights, [0.4, 0.6])
        assert_array_equal(twin.rows, mixture.rows)
        with pytest.raises(FrozenInstanceError):
            twin.weights = weights
        with pytest.raises(ValueError, match='read-only'):
            twin.covariances[0] = 0


@pytest.mark.parametrize('dtype', ['<f4', '>f4', '>f8', '<f8', 'f2'])
def test_any_kind_of_float_makes_the_same_mixture(dtype):
    weights = np.array([0.5, 0.25, 0.125, 0.125]).astype(dtype)
    mixture = GaussianMixture(
        weights, np.ones((4, 2), dtype),
        np.broadcast_to(np.eye(2), (4, 2, 2)).astype(dtype))
    assert mixture.weights.dtype == np.dtype(float)
    assert mixture.weights.dtype.isnative
    assert_array_equal(mixture.weights, [0.5, 0.25, 0.125, 0.125])


def test_float32_weights_are_normalised_but_float64_must_be_exact():
    weights = np.array([0.1, 0.2, 0.7])
    shape = np.zeros((3, 2)), [np.eye(2)] * 3
    assert GaussianMixture(weights.astype('f4'), *shape).weights.sum() == 1
    with pytest.raises(ValueError, match=r'weights must sum to 1, got 1\.00'):
        GaussianMixture(weights + 1e-9, *shape)


@pytest.mark.parametrize(('change', 'message'), [
    ({'weights': [0.5, 0.6]}, r'weights must sum to 1, got 1\.1'),
    ({'weights': []}, 'weights must have at least one element'),
    ({'weights': [0.5, np.nan]}, 'weights must be finite, got nan'),
    ({'weights': [[0.5, 0.5]]},
     r'weights must have shape \(n\), got \(1, 2\)'),
    ({'means': [[0, 0]]}, r'means must have shape \(2, 2\), got \(1, 2\)'),
    ({'means': [[0, np.inf], [0, 0]]}, 'means must be finite, got inf'),
    ({'covariances': [np.eye(2)]}, r'covariances must have shape \(2, 2, 2\)'),
    ({'covariances': [np.eye(2), [[1, 1], [1, 1]]]},
     r'covariances must be positive definite, got \[\[1\.0, 1\.0\]'),
    ({'covariances': [np.eye(2), [[1, 0.2], [0.1, 1]]]},
     r'covariances must be symmetric'),
    ({'covariances': [np.eye(2), -np.eye(2)]}, 'must be positive definite'),
])
def test_bad_arguments_are_named_with_rule_and_value(change, message):
    good = {'weights': [0.5, 0.5], 'means': np.zeros((2, 2)),
            'covariances': [np.eye(2), np.eye(2)]}
    with pytest.raises(ValueError, match=message):
        GaussianMixture(**{**good, **change})


def test_words_are_not_weights():
    with pytest.raises(TypeError, match='weights must be an array of numbers'):
        GaussianMixture('heavy', [[0, 0]], [np.eye(2)])


@pytest.mark.parametrize(('stddevs', 'rho', 'message'), [
    ([[1, 0]], [0], r'stddevs must be positive, got 0\.0'),
    ([[1, 1]], [1], r'rho must be inside \(-1, 1\), got 1\.0'),
])
def test_from_stddevs_names_what_is_wrong(stddevs, rho, message):
    with pytest.raises(ValueError, match=message):
        GaussianMixture.from_stddevs([1], [[0, 0]], stddevs, rho)


@pytest.mark.parametrize(('shape', 'message'), [
    (0, 'shape must be at least 1, got 0'),
    ((3, 4, 5), r'shape must be one integer or two \(ny, nx\)'),
])
def test_render_refuses_an_empty_image(shape, message):
    mixture = GaussianMixture([1], [[0, 0]], [np.eye(2)])
    with pytest.raises(ValueError, match=message):
        mixture.render(shape, 0, 0)
    with pytest.raises(TypeError, match='shape must be an integer'):
        mixture.render(2.5, 0, 0)


def test_a_star_far_away_leaves_an_empty_image():
    mixture = GaussianMixture.from_stddevs([1], [[0, 0]], [[0.5, 0.5]], [0])
    for integrated in (False, True):
        image = mixture.render((5, 5), 1e6, -1e6, pixel_integrated=integrated)
        assert_array_equal(image, 0)


def test_equality_is_that_of_the_numbers():
    def make(width=1.1):
        return GaussianMixture.from_stddevs(
            [0.7, 0.3], [(0, 0), (0.2, -0.1)], [(1.0, width), (2.4, 2.0)])
    one = make()
    assert one == make()
    assert hash(one) == hash(make())
    assert one == copy.deepcopy(one) == pickle.loads(pickle.dumps(one))
    assert one != make(1.2)
    assert one != 3
    assert len({one, make(), make(1.2)}) == 2
    negative = GaussianMixture([1], [[-0.0, 0]], [np.eye(2)])
    zero = GaussianMixture([1], [[0.0, 0]], [np.eye(2)])
    assert negative == zero
    assert hash(negative) == hash(zero)


def test_correlations_are_zero_if_not_given():
    mixture = GaussianMixture.from_stddevs([0.5, 0.5], np.zeros((2, 2)),
                                           [[1, 2], [2, 1]])
    assert_array_equal(mixture.rho, 0)
    alike = GaussianMixture.from_stddevs([0.5, 0.5], np.zeros((2, 2)),
                                         [[1, 2], [2, 1]], 0.3)
    assert_allclose(alike.rho, 0.3)
