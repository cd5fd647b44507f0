"""Errors of a PSF model over the detector."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, GriddedMixturePSF, assess_psf


def psf_of_size(size):
    return GaussianMixture([0.7, 0.3], [[0, 0], [0.1, 0]],
                           size * np.array([np.eye(2), 4 * np.eye(2)]))


def varying(x, y):
    return psf_of_size(1.5 + 0.005 * x)


def grid(nodes):
    xy = [(x, y) for y in nodes for x in nodes]
    return GriddedMixturePSF([varying(*one) for one in xy], xy)


def test_a_psf_has_no_error_against_itself():
    report = assess_psf(varying, varying, (4, 5), shape=(80, 100))
    assert len(report.table) == 20
    assert_allclose(report.map('size_error'), np.zeros((4, 5)), atol=1e-12)


def test_a_wider_model_has_a_negative_size_error():
    report = assess_psf(lambda x, y: psf_of_size(1.02 * (1.5 + 0.005 * x)),
                        varying, (3, 3), shape=(100, 100))
    # The means do not scale, hence not exactly 2 %.
    assert_allclose(report.median('size_error'), -0.02, atol=2e-4)
    assert report.scatter('size_error') < 2e-4


def test_a_grid_errs_between_its_nodes_only():
    psf = grid(np.linspace(0, 99, 4))
    nodes = assess_psf(psf, varying, (4, 4))
    assert_allclose(nodes.table['size_error'], 0, atol=1e-10)
    between = assess_psf(psf, varying, (4, 4), mid_cell=True)
    assert between.grid_shape == (3, 3)
    assert 1e-5 < np.abs(between.table['size_error']).max() < 1e-2


def test_images_and_mixtures_agree():
    steps = np.arange(-30, 31) / 2

    def image(x, y):
        return varying(x, y).evaluate(steps, steps[:, None])

    report = assess_psf(image, image, (2, 2), shape=(50, 50), oversampling=2)
    closed = assess_psf(varying, varying, (2, 2), shape=(50, 50))
    assert_allclose(report.table['r2'], closed.table['r2'], rtol=1e-3)


def test_one_mixture_is_a_truth_that_is_the_same_everywhere():
    report = assess_psf(varying, varying(5, 5), (2, 2), shape=(50, 50))
    same = assess_psf(varying, lambda x, y: varying(5, 5), (2, 2),
                      shape=(50, 50))
    assert_allclose(report.table['size_error'], same.table['size_error'])


def test_errors_name_the_argument():
    with pytest.raises(TypeError, match='truth must have a method'):
        assess_psf(varying, 3, shape=(9, 9))
    with pytest.raises(ValueError, match='shape must be given'):
        assess_psf(varying, varying)


def test_a_grid_that_lacks_the_pixel_gets_it():
    mixture = GaussianMixture([1], [[0, 0]], [[[4, 0.3], [0.3, 3]]])
    pixel = mixture.convolve(np.eye(2) / 12)
    corners = [(0, 0), (50, 0), (0, 50), (50, 50)]
    optics = GriddedMixturePSF([mixture] * 4, corners, pixel_integrated=True)
    sampled = GriddedMixturePSF([pixel] * 4, corners)
    report = assess_psf(sampled, optics, (2, 2))
    assert_allclose(report.table['size_error'], 0, atol=3e-4)
    bare = GriddedMixturePSF([mixture] * 4, corners)
    assert report.median('r2') > assess_psf(bare, bare, (2, 2)).median('r2')
