"""Gaussians integrated over pixels, and their derivatives."""
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import dblquad
from scipy.special import erf

from photutils_mgauss.kernels.gaussian import erfc_over_exp, fast_exp
from photutils_mgauss.kernels.jit import kernel
from photutils_mgauss.kernels.pixels import N_NODES, shape_integrals

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
