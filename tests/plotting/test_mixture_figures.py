"""Figures of mixtures contain what they say."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    MixtureFit,
    compare_n_components,
    fit_mixture,
)
from photutils_mgauss.fitting.posterior import MixturePosterior

pytest.importorskip('matplotlib')

from matplotlib.figure import Figure

from photutils_mgauss import plotting

TRUTH = GaussianMixture.from_stddevs(
    [0.7, 0.3], [[0.1, 0], [-0.2, 0.4]], [[2, 2.2], [4, 5]], [0.1, -0.2])
IMAGE = TRUTH.render((31, 35), 17, 15, flux=40)


@pytest.fixture
def ax():
    return Figure().subplots()


@pytest.fixture
def fit():
    return fit_mixture(IMAGE, 2, oversampling=2)


@pytest.mark.parametrize('axis', ['x', 'y'])
def test_the_projected_mixture_passes_through_the_pixels(ax, fit, axis):
    plotting.plot_projection(fit, IMAGE, axis=axis, oversampling=2, ax=ax)
    lines = {line.get_label(): line for line in ax.lines}
    assert set(lines) == {'70.0%', '30.0%', 'mixture', 'image'}
    data, model = lines['image'].get_data(), lines['mixture'].get_data()
    # The rows at the edge miss the light beyond it.
    assert_allclose(np.interp(data[0], *model), data[1],
                    atol=0.01 * data[1].max())


def test_the_profile_is_the_brightest_row(ax, fit):
    plotting.plot_profile(fit, IMAGE, ax=ax)
    assert_allclose(ax.lines[0].get_ydata(), IMAGE[15] / IMAGE.max())
    assert ax.get_yscale() == 'log'


def test_the_legend_of_the_profile_covers_none_of_it(fit):
    figure = Figure(figsize=(3.3, 2.2), layout='constrained')
    ax = figure.subplots()
    plotting.plot_profile(fit, IMAGE, ax=ax)
    figure.draw_without_rendering()
    bottom = ax.get_legend().get_window_extent().y0
    for line in ax.lines:
        y = ax.transData.transform(line.get_xydata())[:, 1]
        assert np.nanmax(y) < bottom


def test_the_power_of_ten_of_a_colour_bar_is_not_beside_the_title():
    figure = Figure(figsize=(3.3, 2.5), layout='constrained')
    ax = plotting.plot_shape_map([0, 1], [0, 1], [-0.01, 0.02], label='size',
                                 ax=figure.subplots())
    figure.draw_without_rendering()
    bar, = ax.child_axes
    power = bar.yaxis.get_offset_text()
    assert power.get_text()
    assert power.get_window_extent().x0 > bar.get_window_extent().x0


def test_residuals_of_several_numbers_share_their_colours():
    axes = Figure().subplots(1, 3)
    table = compare_n_components(IMAGE, (1, 2))
    plotting.plot_comparison_of_numbers(IMAGE, table, axes=axes)
    shown = axes[1].images[0]
    assert_allclose(shown.get_array(),
                    table.meta['fits'][0].residual / IMAGE.max())
    assert shown.get_clim() == axes[2].images[0].get_clim()
    assert axes[2].get_title().startswith('K = 2, ')
    with pytest.raises(ValueError, match='axes must be one more'):
        plotting.plot_comparison_of_numbers(IMAGE, table, axes=axes[:2])


def test_ellipses_lie_at_one_sigma(ax):
    plotting.plot_ellipses(TRUTH, ax=ax)
    offset = np.array(ax.lines[0].get_data()) - TRUTH.means[0][:, None]
    precision = np.linalg.inv(TRUTH.covariances[0])
    assert_allclose(np.einsum('in,ij,jn->n', offset, precision, offset), 1)


@pytest.fixture
def posterior(rng):
    shape = (2, 50)
    return MixturePosterior(
        rng.dirichlet([5, 5], shape), rng.normal(0, 1, (*shape, 2, 2)),
        rng.uniform(1, 2, (*shape, 2, 2)), rng.uniform(-0.5, 0.5, (*shape, 2)),
        rng.normal(1, 0.1, shape), rng.normal(1, 0.1, shape),
        MixtureFit(TRUTH, 0, '', 1, 0, 0, 1, IMAGE, None, None), None)


def test_posteriors_and_traces_show_every_number(posterior):
    for name, n in (('means', 4), ('weights', 2), ('sigma', 1),
                    ('x_mean_2', 1)):
        ax = plotting.plot_posterior(posterior, name, ax=Figure().subplots())
        assert len(ax.patches) == n
        ax = plotting.plot_trace(posterior, name, ax=Figure().subplots())
        assert len(ax.lines) == 2 * n
    with pytest.raises(ValueError, match="name must be one of 'weights'"):
        plotting.plot_trace(posterior, 'delta', ax=Figure().subplots())


def test_the_model_graph_names_all_parameters(ax):
    plotting.plot_model_graph(3, (30, 30), ax=ax)
    words = ' '.join(text.get_text() for text in ax.texts)
    for word in ('sigma', 'omega', 'alpha', 'beta', 'gamma', '30 x 30'):
        assert word in words


def test_a_map_states_mean_and_scatter(ax):
    plotting.plot_shape_map([0, 1, 2], [0, 1, 2], [0.1, 0.3, np.nan],
                            label='size', ax=ax)
    assert 'size: +2.00e-01' in ax.get_title()
