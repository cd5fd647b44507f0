"""Gaussians integrated over pixels, and their derivatives."""
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad
from scipy.special import erf

from photutils_mgauss import GaussianMixture, GriddedMixturePSF, kernels
from photutils_mgauss.kernels import series
from photutils_mgauss.kernels.gaussian import erfc_over_exp, fast_exp
from photutils_mgauss.kernels.jit import kernel
from photutils_mgauss.kernels.pixels import N_NODES, shape_integrals
from photutils_mgauss.photometry import engine
from photutils_mgauss.psf.rows import kernel_rows

N_PIXELS = 5
# log_p, s, log_q: wide, as wide as a pixel, thin, and thin and tilted.
SHAPES = [(-0.9, 0.2, -1.1), (0.0, -0.4, 0.1), (1.2, 0.1, 1.4),
          (1.0, 1.5, 0.6)]


@kernel(allocates=True)
def row_of_pixels(dx, dy, p, s, q, out):
    """Put a row and its derivatives into out (6, n)."""
    out[:] = 0.0
    shape_integrals(dx, dy, p, s, q, np.empty((2, N_NODES)),
                    np.empty((6, out.shape[1] + 1)), out)


@kernel
def error_function(x, out):
    """Put erf(x) into out (n,)."""
    for i in range(x.size):
        tail = fast_exp(-x[i] * x[i]) * erfc_over_exp(abs(x[i]))
        out[i] = 1 - tail if x[i] > 0 else tail - 1


def row(place, shape):
    """Return the integrals of a Gaussian of flux 1, and its derivatives."""
    log_p, s, log_q = shape
    out = np.empty((6, N_PIXELS))
    row_of_pixels(*place, np.exp(2 * log_p), s, np.exp(2 * log_q), out)
    return out * np.exp(log_p + log_q) / (2 * np.pi)


@pytest.mark.parametrize('shape', SHAPES)
def test_a_row_is_the_integral_over_its_pixels(shape):
    log_p, s, log_q = shape

    def gaussian(y, x):
        return np.exp(log_p + log_q - 0.5 * (
            np.exp(2 * log_p) * (x - s * y) ** 2
            + np.exp(2 * log_q) * y**2)) / (2 * np.pi)

    place = -2.3, 0.4
    expected = [dblquad(gaussian, place[0] + i - 0.5, place[0] + i + 0.5,
                        place[1] - 0.5, place[1] + 0.5, epsabs=1e-12,
                        epsrel=1e-11)[0] for i in range(N_PIXELS)]
    assert_allclose(row(place, shape)[0], expected, atol=2e-11)


@pytest.mark.parametrize('shape', SHAPES)
def test_derivatives_are_those_of_the_value(shape):
    place = np.array([-2.3, 0.4])
    found = row(place, shape)
    numbers = np.concatenate([place, shape])
    for i in range(5):
        step = np.zeros(5)
        step[i] = 1e-5
        above, below = (row(moved[:2], moved[2:])[0] for moved in
                        (numbers + step, numbers - step))
        slope = (above - below) / 2e-5
        # The Gaussian moves the other way than the pixels.
        assert_allclose(found[1 + i], -slope if i < 2 else slope, atol=3e-9)


def test_nothing_is_in_pixels_far_away():
    assert_allclose(row((-2.0, 80.0), (1.0, 0.0, 1.0)), 0, atol=0)
    assert_allclose(row((400.0, 0.1), (1.0, 0.0, 1.0)), 0, atol=1e-15)


def test_the_error_function_is_that_of_scipy():
    x = np.concatenate([np.linspace(-9, 9, 20001), [-1e5, -40, 40, 1e5]])
    found = np.empty(x.size)
    error_function(x, found)
    assert_allclose(found, erf(x), atol=5e-15)


# Widths along x and y [pix] and correlation.
ANY_SHAPE = [(sx, sy, rho) for sx, sy in (
    (0.1, 0.1), (0.1, 2.5), (0.35, 0.5), (1.1, 0.6), (6.0, 4.0))
    for rho in (0, 1e-8, -0.1, 0.5, 0.9, -0.95, 0.99)]


def star(grid, x, y, box):
    """Return the PSF, d/dx_0 and d/dy_0 in a box, (3, ny, nx)."""
    _, _, ny, nx = box
    out = np.empty((3, ny * nx))
    kernels.star_derivatives(x, y, np.array(box), engine.psf_arrays(grid),
                             kernels.Tiling.empty(nx), out)
    return out.reshape(3, nx, ny).transpose(0, 2, 1)


def quadrature(mixture, x, y, box):
    """Return the same, each pixel by itself."""
    row, column, ny, nx = box
    py, px = np.mgrid[row:row + ny, column:column + nx].reshape(2, -1)
    rows = kernel_rows(mixture.weights, mixture.means, mixture.covariances)
    rows[:, 1:3] += x, y
    parts = np.empty((len(rows), 6, px.size))
    kernels.derivatives(px.astype(float), py.astype(float), rows, True, parts)
    value, by_x, by_y = parts.sum(axis=0)[:3]
    return np.array([value, -by_x, -by_y]).reshape(3, ny, nx)


@pytest.mark.parametrize('shape', ANY_SHAPE)
@pytest.mark.parametrize('size', [(11, 11), (16, 40), (33, 1)])
def test_a_tile_is_the_integral_over_its_pixels(shape, size):
    sx, sy, rho = shape
    mixture = GaussianMixture.from_stddevs([1], [[0, 0]], [[sx, sy]], [rho])
    grid = GriddedMixturePSF([mixture], [(0, 0)], pixel_integrated=True)
    box = (3, 2, *size)
    for x, y in ((2 + size[1] / 2, 3.2 + size[0] / 2), (2.4, 1.9)):
        exact = quadrature(mixture, x, y, box)
        found = star(grid, x, y, box)
        peak = min(1, 1 / (2 * np.pi * sx * sy * np.sqrt(1 - rho**2)))
        width = np.sqrt(np.linalg.eigvalsh(mixture.covariances[0])[0] + 1 / 12)
        assert_allclose(found[0], exact[0], atol=3e-8 * peak)
        assert_allclose(found[1:], exact[1:], atol=2e-7 * peak / width)


@pytest.mark.long
def test_the_slope_of_a_blend_is_right_at_a_node():
    nodes = [GaussianMixture.from_stddevs([1], [[0, 0]], [[sx, 0.5]], [0.2])
             for sx in (0.3, 0.5, 0.4, 0.6)]
    grid = GriddedMixturePSF(nodes, [(0, 0), (40, 0), (0, 40), (40, 40)],
                             pixel_integrated=True)
    box = (0, 0, 9, 9)
    above, below = (star(grid, 1e-4 + x, 0, box)[0] for x in (1e-4, -1e-4))
    assert_allclose(star(grid, 1e-4, 0, box)[1], (above - below) / 2e-4,
                    atol=1e-6)


def test_a_series_stops_where_the_bound_says():
    """What is left of Mehler's formula is less than was allowed."""
    allowed = np.log(1e-6)
    for rho in (0.05, 0.3, 0.8, 0.9):
        s, p = rho, 1 / (1 - rho**2)
        ratio, terms = series.series_length.py_func(p, s, 1.0, allowed)
        assert ratio == pytest.approx(rho / (1 + np.sqrt(1 - rho**2)))
        left = ratio**terms * np.sqrt((1 + ratio) / (1 - ratio))
        assert left <= 1e-6 < left / ratio**series._AT_ONCE
    assert series.series_length.py_func(1e4, 0.99, 1.0, allowed)[1] == 0


@pytest.mark.parametrize('rho', [0.2, -0.6, 0.95])
def test_stars_are_where_the_exact_integral_has_them(rho):
    mixture = GaussianMixture.from_stddevs(
        [0.5, 0.3, 0.2], [[0, 0], [0.1, 0], [0, 0.1]],
        [[0.1, 0.12], [0.4, 0.3], [1.5, 1.4]], [rho, -rho, rho / 2])
    grid = GriddedMixturePSF([mixture], [(0, 0)], pixel_integrated=True)
    rng = np.random.default_rng(2)
    x, y = (10 + 20 * np.mgrid[:5, :6].reshape(2, -1)
            + rng.uniform(-0.5, 0.5, (2, 30)))
    data = np.zeros((125, 125))
    for place in zip(x, y, strict=True):
        data += quadrature(mixture, *place, (0, 0, 125, 125))[0]
    start = np.column_stack([np.full(30, 0.9), x + 0.1, y - 0.1])
    far = np.full((30, 3), np.inf)
    fits = engine.fit_stars(
        engine.kernel_image(data, np.sqrt(data + 0.01)),
        engine.psf_arrays(grid), engine.StarGroups(
            start, engine.cut_boxes(x, y, (11, 11), data.shape),
            np.zeros(30), np.arange(31), -far, far, np.zeros(3, bool)))
    assert_allclose(fits.values, np.column_stack([np.ones(30), x, y]),
                    atol=1e-6)
