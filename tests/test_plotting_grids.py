"""Figures of grids: what they contain."""
import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_gridded import make_grid
from test_gridded_sources import epsf_grid

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
    assert plotting.plot_node_map(ax, psf, 'ellipticity_error') is ax
    points = ax.collections[0]
    assert_allclose(points.get_offsets(), psf.grid_xypos)
    assert_allclose(points.get_array(), psf.report['ellipticity_error'])
    median = np.median(psf.report['ellipticity_error'])
    assert f'median {median:.2g}, scatter' in ax.get_title()


def test_detectors_are_laid_out_like_the_focal_plane(ax):
    psfs = {'A': make_grid(), 'B': make_grid(seed=4)}
    plotting.plot_node_map(ax, psfs, 'scale',
                           layout={'A': (0, 0), 'B': (-500, 300)})
    offsets = ax.collections[0].get_offsets()
    assert_allclose(offsets[6:] - offsets[:6], np.tile([-500, 300], (6, 1)))
    assert {text.get_text() for text in ax.texts} == {'A', 'B'}
    with pytest.raises(ValueError, match="got none for 'B'"):
        plotting.plot_node_map(ax, psfs, layout={'A': (0, 0)})


def test_without_a_layout_detectors_do_not_overlap(ax):
    plotting.plot_node_map(ax, {'A': make_grid(), 'B': make_grid()}, 'scale')
    offsets = ax.collections[0].get_offsets()
    assert offsets[6:, 0].min() > offsets[:6, 0].max()


def test_bridged_nodes_are_left_out_of_maps(ax):
    psf = GriddedMixturePSF.from_gridded_psf(
        epsf_grid(lambda data: data[4].fill(0)), 1)
    plotting.plot_node_map(ax, psf)
    assert np.ma.getmaskarray(ax.collections[0].get_array()).sum() + np.isnan(
        ax.collections[0].get_array().filled(0)).sum() == 1


def test_whiskers_point_along_the_long_axis(ax):
    tilted = GaussianMixture([1], [[0, 0]], [[[2, 1], [1, 2]]])
    psf = GriddedMixturePSF([tilted] * 4, [(0, 0), (9, 0), (0, 9), (9, 9)])
    plotting.plot_whiskers(ax, psf, scale=10)
    ends = np.array([line.get_xydata() for line in ax.lines[:4]])
    # Ellipticity 1/2 at 45 degrees.
    assert_allclose(ends[:, 1] - ends[:, 0],
                    np.tile([5, 5], (4, 1)) / np.sqrt(2))
    assert_allclose(ends.mean(axis=1), psf.grid_xypos)


def test_the_worst_node_is_shown_in_per_cent(ax):
    def spoil(data):
        data[5, 36, 36] *= 1.5
    source = epsf_grid(spoil)
    psf = GriddedMixturePSF.from_gridded_psf(source, 2)
    plotting.plot_worst_node(ax, psf, source, 'chi2')
    assert 'node (80, 40)' in ax.get_title()
    residual = ax.images[0].get_array()
    assert 20 < residual[36, 36] < 50
