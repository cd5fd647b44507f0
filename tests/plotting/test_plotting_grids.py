"""Figures of grids: what they contain."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.psf_grids import epsf_grid, make_grid
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    plotting,
)

pytest.importorskip('matplotlib')


@pytest.fixture
def ax():
    from matplotlib.figure import Figure
    return Figure().add_subplot()


def test_maps_hold_every_node_and_name_median_and_scatter(ax):
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid(), 1)
    assert plotting.plot_node_map(psf, 'ellipticity_error', ax=ax) is ax
    points = ax.collections[0]
    assert_allclose(points.get_offsets(), psf.grid_xypos)
    assert_allclose(points.get_array(), psf.report['ellipticity_error'])
    median = np.median(psf.report['ellipticity_error'])
    assert f'median {median:.2g}, scatter' in ax.get_title()


def test_a_column_that_is_no_number_of_the_report_is_named():
    psf = make_grid()
    for draw in (plotting.plot_node_map,
                 lambda *a: plotting.plot_worst_node(a[0], None, a[1])):
        for column in ('sizes', 'bridged'):
            with pytest.raises(ValueError, match="column must be one of '.*'"
                               f'scale.* got {column!r}'):
                draw(psf, column)


def test_detectors_are_laid_out_like_the_focal_plane(ax):
    psfs = {'A': make_grid(), 'B': make_grid(seed=4)}
    plotting.plot_node_map(psfs, 'scale',
                           layout={'A': (0, 0), 'B': (-500, 300)}, ax=ax)
    offsets = ax.collections[0].get_offsets()
    assert_allclose(offsets[6:] - offsets[:6], np.tile([-500, 300], (6, 1)))
    assert {text.get_text() for text in ax.texts} == {'A', 'B'}
    with pytest.raises(ValueError, match="got none for 'B'"):
        plotting.plot_node_map(psfs, layout={'A': (0, 0)}, ax=ax)


def test_without_a_layout_detectors_do_not_overlap(ax):
    plotting.plot_node_map({'A': make_grid(), 'B': make_grid()}, 'scale',
                           ax=ax)
    offsets = ax.collections[0].get_offsets()
    assert offsets[6:, 0].min() > offsets[:6, 0].max()


def test_bridged_nodes_are_left_out_of_maps(ax):
    psf = GriddedMixturePSF.from_gridded_psf(
        epsf_grid(lambda data: data[4].fill(0)), 1)
    plotting.plot_node_map(psf, ax=ax)
    assert np.ma.getmaskarray(ax.collections[0].get_array()).sum() + np.isnan(
        ax.collections[0].get_array().filled(0)).sum() == 1


def test_whiskers_point_along_the_long_axis(ax):
    tilted = GaussianMixture([1], [[0, 0]], [[[2, 1], [1, 2]]])
    psf = GriddedMixturePSF([tilted] * 4, [(0, 0), (9, 0), (0, 9), (9, 9)])
    plotting.plot_whiskers(psf, scale=10, ax=ax)
    ends = np.array([line.get_xydata() for line in ax.lines[:4]])
    # Ellipticity 1/2 at 45 degrees.
    assert_allclose(ends[:, 1] - ends[:, 0],
                    np.tile([5, 5], (4, 1)) / np.sqrt(2))
    assert_allclose(ends.mean(axis=1), psf.grid_xypos)


@pytest.mark.filterwarnings('ignore:positions measured with these mixtures')
@pytest.mark.filterwarnings('ignore:fluxes measured with these mixtures')
def test_the_worst_node_is_shown_in_per_cent(ax):
    def spoil(data):
        data[5, 36, 36] *= 1.5
    source = epsf_grid(spoil)
    psf = GriddedMixturePSF.from_gridded_psf(source, 2)
    plotting.plot_worst_node(psf, source, 'chi2', ax=ax)
    assert 'node (80, 40)' in ax.get_title()
    residual = ax.images[0].get_array()
    assert 20 < residual[36, 36] < 50


def test_maps_of_a_run_show_what_they_were_given():
    rng = np.random.default_rng(5)
    mixtures = [GaussianMixture([1], [[0, 0]], [[[s**2, 0], [0, s**2]]])
                for s in (1.0, 1.5, 1.0, 1.5)]
    psf = GriddedMixturePSF(mixtures, [(0, 0), (90, 0), (0, 90), (90, 90)])
    from matplotlib.figure import Figure
    axes = Figure().subplots(2, 2).ravel()
    plotting.plot_width_map(psf, stars=[(10, 20), (30, 40)], ax=axes[0])
    width = axes[0].collections[0].get_array()
    assert_allclose(width, 2.3548 * np.array([1, 1.5, 1, 1.5]), rtol=1e-5)
    assert any(len(line.get_xdata()) == 2 and line.get_marker() == 'o'
               for line in axes[0].lines)
    plotting.plot_psf_image(psf, 0, 0, radius=4, ax=axes[1])
    image = axes[1].images[0].get_array()
    assert_allclose(image.max(), 0, atol=1e-12)
    # At 2 px from a Gaussian of 1 px: log10 exp(-2).
    assert_allclose(image[80, 120], -2 / np.log(10), rtol=1e-6)
    x, y = rng.uniform(0, 90, (2, 7))
    plotting.plot_detections(x, y, np.geomspace(1, 100, 7), ax=axes[2])
    sizes = axes[2].collections[0].get_sizes()
    assert np.all(np.diff(sizes) >= 0)
    plotting.plot_stated_errors(np.arange(3), {
        'x_err': [1, 2, 3], 'y_err': [2, 3, 4]}, unit='pix', ax=axes[3])
    assert [line.get_label() for line in axes[3].lines] == ['x_err', 'y_err']
    assert axes[3].get_ylabel() == 'stated error [pix]'


def test_a_radial_profile_is_the_mixture_along_a_ray(ax):
    psf = make_grid()
    plotting.plot_radial_profile(psf, 0, 0, radius=5, ax=ax)
    distance, mean = ax.lines[0].get_data()
    mixture = psf.mixture_at(0, 0)
    along = [mixture.evaluate(distance * np.cos(t), distance * np.sin(t))
             for t in np.linspace(0, 2 * np.pi, 72, endpoint=False)]
    assert_allclose(mean, np.mean(along, axis=0))


def test_a_residual_image_is_in_standard_errors(ax):
    residual = np.arange(12.0).reshape(3, 4)
    plotting.plot_residual_image(residual, np.full((3, 4), 2.0), ax=ax)
    assert_allclose(ax.images[0].get_array(), residual / 2)


def test_pulls_are_counted_beside_those_of_right_errors(ax, rng):
    pulls = np.append(2 * rng.standard_normal(2000), [40.0, np.nan])
    plotting.plot_pulls(pulls, ax=ax)
    counts = np.array([bar.get_height() for bar in ax.patches])
    # Those far off are at the end, not lost.
    assert counts.sum() == 2001
    width = ax.patches[0].get_width()
    y = ax.lines[0].get_ydata()
    assert_allclose(y.max(), 2001 * width / np.sqrt(2 * np.pi))
    right = ax.get_legend_handles_labels()[1]
    assert right[0].startswith('2001, rms 2.')
