"""How many Gaussians: the table, and the choice."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    adaptive_moments,
    compare_n_components,
    select_n_components,
)

TRUTH = GaussianMixture.from_stddevs(
    [0.55, 0.35, 0.1], [[0.1, -0.05], [-0.2, 0.1], [0.3, 0.4]],
    [[1.9, 2.0], [3.2, 3.9], [7.8, 6.2]], [0.1, -0.3, 0.2])
IMAGE = TRUTH.render((61, 61), 30, 30)


def test_more_gaussians_never_fit_worse_and_the_true_number_fits_exactly():
    table = compare_n_components(IMAGE, oversampling=2)
    assert table['n_components'].tolist() == [1, 2, 3, 4, 5]
    assert (np.diff(table['chi2']) < 1e-20).all()
    exact = table[table['n_components'] == 3][0]
    for name in ('r2_error', 'ellipticity_error', 'rms_residual',
                 'max_residual', 'phase_error'):
        assert abs(exact[name]) < 1e-6
    assert (table['time'] > 0).all()


def test_the_information_criterion_finds_the_number_in_noise(rng):
    noisy = IMAGE + 2e-5 * rng.standard_normal(IMAGE.shape)
    table = compare_n_components(noisy, (1, 2, 3, 4), error=2e-5)
    assert table['n_components'][np.argmin(table['bic'])] == 3


def test_rows_are_the_measurements_of_their_fits():
    table = compare_n_components(IMAGE, (1, 2))
    for row, fit in zip(table, table.meta['fits'], strict=True):
        assert row['chi2'] == fit.chi2
        assert_allclose(row['max_residual'],
                        abs(fit.residual).max() / IMAGE.max())
        truth, model = (adaptive_moments(image) for image in
                        (IMAGE, IMAGE - fit.residual))
        assert_allclose(row['r2_error'], 1 - model.r2 / truth.r2)
    assert np.isnan(table['phase_error']).all()


def test_the_smallest_number_that_meets_all_thresholds_is_chosen():
    assert select_n_components(IMAGE, max_residual=0.5) == 1
    assert select_n_components(IMAGE, max_residual=1e-4) == 3
    assert select_n_components(IMAGE, (3, 1), max_residual=0.5) == 1
    assert select_n_components(IMAGE, r2_error=1, rms_residual=1e-5) == 3


def test_without_thresholds_the_smallest_bic_decides(rng):
    noisy = IMAGE + 2e-5 * rng.standard_normal(IMAGE.shape)
    assert select_n_components(noisy, (1, 2, 3, 4), error=2e-5) == 3


def test_thresholds_must_be_met():
    with pytest.raises(ValueError, match='must reach further than 2'):
        select_n_components(IMAGE, (1, 2), max_residual=1e-6)
    with pytest.raises(TypeError, match='n_components must be an integer'):
        compare_n_components(IMAGE, (1.5,))


def test_a_stack_or_no_number_is_refused():
    image = TRUTH.render((15, 15), 7, 7)
    with pytest.raises(ValueError, match='image must have the shape'):
        compare_n_components([image, image], (1, 2))
    with pytest.raises(ValueError, match='at least one number'):
        compare_n_components(image, ())
    with pytest.raises(ValueError, match='at least one number'):
        select_n_components(image, (), max_residual=0.1)
