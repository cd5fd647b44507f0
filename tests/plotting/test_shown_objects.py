"""What objects draw of themselves, and how notebooks show them."""
import inspect
from itertools import pairwise

import astropy.units as u
import matplotlib as mpl
import numpy as np
import pytest
from astropy.table import QTable
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    InjectionResult,
    MixturePosterior,
    cramer_rao,
    fit_mixture,
    fit_mixture_field,
    pixel_phase_error,
    plotting,
)

MIXTURE = GaussianMixture.from_stddevs([0.7, 0.3], [[0, 0], [0.1, 0]],
                                       [[1.1, 1.0], [2.2, 2.4]], [0.1, 0])


@pytest.fixture
def pyplot():
    mpl.use('Agg')
    import matplotlib.pyplot as plt
    yield plt
    plt.close('all')


def make_grid():
    return GriddedMixturePSF([MIXTURE] * 4, [(0, 0), (50, 0), (0, 60),
                                             (50, 60)])


def make_fit():
    return fit_mixture(MIXTURE.render((21, 21), 10, 10), 1)


def make_field():
    x, y = np.meshgrid([12.2, 28.1, 44.4], [11.7, 30.2, 48.3])
    stars = QTable({'x': x.ravel(), 'y': y.ravel()})
    data = sum(MIXTURE.render((60, 56), a, b, flux=1e4) for a, b in stars)
    return fit_mixture_field(data, stars, error=np.ones(data.shape),
                             n_components=1, degree=0)


def make_phases():
    true = np.linspace(10, 30, 400)
    return pixel_phase_error(true, true + 0.01 * np.sin(2 * np.pi * true))


def make_posterior():
    rng = np.random.default_rng(1)
    shape = (2, 50)
    return MixturePosterior(
        rng.dirichlet([5, 5], shape), rng.normal(0, 1, (*shape, 2, 2)),
        rng.uniform(1, 2, (*shape, 2, 2)), rng.uniform(-0.5, 0.5, (*shape, 2)),
        rng.normal(1, 0.1, shape), rng.normal(1, 0.1, shape), make_fit(), None)


DRAWN = {'mixture': lambda: MIXTURE, 'grid': make_grid, 'fit': make_fit,
         'field': make_field, 'phases': make_phases}


@pytest.mark.parametrize('name', DRAWN)
def test_an_object_draws_itself_on_pyplots_axes_or_on_those_given(
        name, pyplot):
    thing = DRAWN[name]()
    assert thing.plot() is pyplot.gcf().axes[0]
    ax = Figure().add_subplot()
    assert thing.plot(ax=ax) is ax
    assert ax.has_data()


@pytest.mark.parametrize('name', ['mixture', 'grid', 'fit', 'field'])
def test_a_notebook_shows_the_text_and_a_picture(name):
    thing = DRAWN[name]()
    page = thing._repr_html_()
    assert page.startswith('<p><code>&lt;')
    assert type(thing).__name__ in page
    assert 'src="data:image/png;base64,' in page


def test_a_notebook_shows_the_table_of_a_posterior():
    page = make_posterior()._repr_html_()
    assert 'x_stddev_2' in page
    assert '<table' in page


def test_every_function_takes_the_axes_last_and_by_name():
    for name in plotting.__all__:
        parameters = inspect.signature(getattr(plotting, name)).parameters
        last = list(parameters.values())[-1]
        assert last.name in ('ax', 'axes'), name
        assert last.kind is last.KEYWORD_ONLY
        assert last.default is None


def test_a_grid_draws_columns_of_its_report():
    psf = make_grid()
    with pytest.raises(ValueError, match='quantity must be'):
        psf.plot('colour', ax=Figure().add_subplot())
    assert isinstance(psf.plot('ellipticity', ax=Figure().add_subplot()),
                      Axes)


def test_a_corner_plot_has_a_row_for_each_parameter_that_varies():
    posterior = make_posterior()
    axes = posterior.plot(['stddevs', 'flux'])
    assert axes.shape == (5, 5)
    assert axes[4, 0].get_xlabel() == 'x_stddev_1 [pix]'
    assert axes[4, 0].get_ylabel() == 'flux'
    x, y = axes[1, 0].lines[0].get_data()
    assert_allclose(x, posterior.stddevs[..., 0, 0].ravel())
    assert_allclose(y, posterior.stddevs[..., 0, 1].ravel())
    with pytest.raises(ValueError, match=r'axes must have the shape \(1, 1\)'):
        posterior.plot(['flux'], axes=axes)


def numbers_of(axis):
    """Return the numbers at an axis that are within its limits."""
    low, high = sorted(axis.get_view_interval())
    return [tick.label1 for tick in axis.get_major_ticks()
            if tick.label1.get_visible() and low <= tick.get_loc() <= high]


@pytest.mark.parametrize('n', [2, 3, 7])
def test_a_corner_plot_is_legible_in_a_column(n, pyplot):
    names = ['x_mean_1', 'y_mean_1', 'x_stddev_1', 'y_stddev_1', 'rho_1',
             'flux', 'sigma'][:n]
    axes = make_posterior().plot(names)
    figure = axes[0, 0].figure
    figure.draw_without_rendering()
    column = 3.3 / figure.get_figwidth()
    shown = [text for ax in axes[np.tril_indices(n)]
             for axis in (ax.xaxis, ax.yaxis)
             for text in (axis.label, *numbers_of(axis))
             if text.get_text() and text.get_visible()]
    assert len(shown) > 3 * n
    assert min(text.get_fontsize() for text in shown) * column >= 5.5
    inside = figure.bbox.padded(1)
    for text in shown:
        box = text.get_window_extent()
        assert inside.contains(box.x0, box.y0)
        assert inside.contains(box.x1, box.y1)
    # Names do not lie on the numbers of their own axis or on each other.
    for ax in axes[1:, 0]:
        name = ax.yaxis.label.get_window_extent()
        assert not any(name.overlaps(tick.get_window_extent())
                       for tick in numbers_of(ax.yaxis))
    heights = [ax.yaxis.label.get_window_extent() for ax in axes[1:, 0]]
    assert all(low.y1 < high.y0 for high, low in pairwise(heights))


def test_results_show_what_matters_in_one_line():
    one = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 4]]])
    assert repr(cramer_rao(one, [1e4], fit_shape=31)) == (
        '<CramerRao of 1 star, median errors: flux 100, x 0.01 pix, '
        'y 0.02 pix>')
    assert repr(cramer_rao(one, [1e4] * 3 * u.adu)).startswith(
        '<CramerRao of 3 stars, median errors: flux 1')
    stars = QTable({'recovered': [True, False, True]})
    assert repr(InjectionResult(stars, QTable())) == (
        '<InjectionResult: 2 of 3 artificial stars were recovered>')


def test_without_matplotlib_a_notebook_shows_the_text(monkeypatch):
    import sys
    monkeypatch.setitem(sys.modules, 'matplotlib.figure', None)
    assert MIXTURE._repr_html_() == (
        '<p><code>&lt;GaussianMixture of 2, weights [0.7 0.3]&gt;</code></p>')
