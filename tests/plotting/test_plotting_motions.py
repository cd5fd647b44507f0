"""Figures of motions contain what they say."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.motion_scenes import TIMES, make_truth, observe, plane_epochs
from photutils_mgauss import ProperMotionFitter

pytest.importorskip('matplotlib')
from matplotlib.quiver import QuiverKey
from matplotlib.text import Text


@pytest.fixture
def axes():
    from matplotlib.figure import Figure
    return Figure().add_subplot()


@pytest.fixture(scope='module')
def solutions():
    rng = np.random.default_rng(3)
    truth = make_truth(rng, n_stars=80, n_qso=40, ra=0.0)
    epochs = observe(truth, rng, times=TIMES[[0, 3, 6]], missing=0)
    return [ProperMotionFitter(references='qso').fit(some)
            for some in (epochs[::2], epochs)]


def test_every_detection_of_an_epoch_has_an_arrow(axes, solutions):
    solution = solutions[1]
    solution.plot_residuals(1, ax=axes)
    arrows = list(axes.collections)
    assert sum(len(one.get_offsets()) for one in arrows) == 120
    rows = solution.residuals[solution.residuals['epoch'] == 1]
    assert_allclose(np.sort(np.concatenate([one.U for one in arrows])),
                    np.sort(rows['dra'].value))
    # Around right ascension 0 the field is not torn apart.
    assert np.ptp(arrows[0].get_offsets()[:, 0]) < 700


@pytest.fixture(scope='module')
def plane_solution():
    epochs, _ = plane_epochs(np.random.default_rng(4))
    return ProperMotionFitter().fit(epochs)


def test_pixels_are_not_called_east_and_north(axes, plane_solution):
    plane_solution.plot_residuals(1, ax=axes)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ('x [pix]', 'y [pix]')
    assert not axes.xaxis_inverted()
    axes.clear()
    plane_solution.plot(ax=axes)
    assert axes.get_xlabel() == 'motion along x [pix / yr]'
    assert not axes.xaxis_inverted()
    assert [one.get_text() for one in axes.get_legend().get_texts()] == [
        'stars']


@pytest.mark.parametrize('title', ['night_of_a_very_long_name_indeed.fits',
                                   ''])
def test_the_key_is_on_the_figure_and_not_on_the_title(plane_solution, title):
    from matplotlib.figure import Figure

    from photutils_mgauss.plotting import plot_residual_vectors
    figure = Figure(figsize=(5.2, 4.2), layout='constrained')
    axes = figure.add_subplot()
    plot_residual_vectors(plane_solution, 1, ax=axes, title=title)
    figure.draw_without_rendering()
    [key] = axes.findobj(QuiverKey)
    box = key.text.get_window_extent()
    assert figure.bbox.contains(box.x0, box.y0)
    assert figure.bbox.contains(box.x1, box.y1)
    name = axes.get_title(loc='left')
    if name.strip():
        [shown] = [one for one in axes.findobj(Text) if one.get_text() == name]
        assert not shown.get_window_extent().overlaps(box)


def test_the_diagram_shows_stars_and_references(axes, solutions):
    solutions[1].plot(ax=axes)
    shown = [len(line.get_xdata()) for line in axes.lines[:2]]
    assert sorted(shown) == [40, 80]
    assert axes.xaxis_inverted()


def test_a_table_read_from_a_file_is_drawn_like_the_one_written(
        axes, solutions, tmp_path):
    from photutils_mgauss.plotting import plot_proper_motions
    solutions[1].stars.write(tmp_path / 'stars.ecsv')
    plot_proper_motions(QTable.read(tmp_path / 'stars.ecsv'), ax=axes)
    shown = [len(line.get_xdata()) for line in axes.lines[:2]]
    assert sorted(shown) == [40, 80]


def test_errors_against_magnitude_and_epochs_are_those_of_the_table(
        axes, solutions):
    from photutils_mgauss.plotting import (
        plot_errors_by_epochs,
        plot_motion_errors,
    )
    plot_motion_errors(solutions[1].stars, np.arange(120), ax=axes)
    stars = solutions[1].stars
    assert_allclose(axes.lines[0].get_ydata(),
                    stars['pmra_error'][stars['reference'] == ''].value)
    plot_errors_by_epochs(solutions, ax=axes)
    line = axes.lines[2]
    assert_allclose(line.get_xdata(), [2, 3])
    measured = [one.stars['pmra_error'][one.stars['reference'] == '']
                for one in solutions]
    assert_allclose(line.get_ydata(), [np.median(errors.value)
                                       for errors in measured])


def test_magnitudes_of_other_stars_are_refused(axes, solutions):
    from photutils_mgauss.plotting import (
        plot_motion_errors,
        plot_motions_by_magnitude,
    )
    stars = solutions[1].stars
    for draw in (plot_motion_errors, plot_motions_by_magnitude):
        with pytest.raises(ValueError, match='magnitude must have a number '
                           'for each of the 120 stars, got the shape'):
            draw(stars, np.arange(119.0), ax=axes)
        with pytest.raises(TypeError, match='magnitude must be an array'):
            draw(stars, 'mag', ax=axes)


def test_cutouts_show_each_image_three_times(axes, rng):
    from photutils_mgauss.plotting import plot_cutouts
    stamps = rng.normal(0, 2, (3, 2, 5, 5))
    table = QTable({'time': [2024.0, 2026.5], 'x': [10.0, 12.4],
                    'y': [7.0, 7.0], 'data': stamps[0], 'model': stamps[1],
                    'residual': stamps[2]})
    plot_cutouts(table, ax=axes)
    shown = axes.images[0].get_array()
    assert shown.shape == (17, 11)
    scatter = 1.4826 * np.median(np.abs(stamps[2]), axis=(1, 2))
    assert_allclose(shown[12:, :5], stamps[0, 0] / scatter[0])
    assert_allclose(shown[:5, 6:], stamps[2, 1] / scatter[1])
    assert_allclose(axes.lines[0].get_xdata(), [2, 8.4])
    assert [text.get_text() for text in axes.get_xticklabels()] == [
        '2024.00', '2026.50']
    with pytest.raises(ValueError, match='at least one row'):
        plot_cutouts(table[:0], ax=axes)


def test_references_are_shown_as_they_were_measured(axes, solutions):
    from photutils_mgauss.plotting import plot_reference_differences
    table = solutions[1].reference_differences()
    plot_reference_differences(table, ax=axes)
    x, y = max((line.get_data() for line in axes.lines),
               key=lambda data: len(data[0]))
    assert_allclose(x, table['dpmra'].value)
    assert_allclose(y, table['dpmdec'].value)
    assert axes.xaxis_inverted()


def test_cells_of_a_map_are_means_of_their_residuals(axes, rng):
    from photutils_mgauss.plotting import plot_residual_map
    n = 4000
    x, y = rng.uniform(0, 1000, (2, n))
    # A shear, in noise ten times as large as it.
    table = QTable({'chip': np.full(n, '2'), 'x_pix': x * u.pix,
                    'y_pix': y * u.pix,
                    'dx_pix': (1e-5 * (y - 500)
                               + rng.normal(0, 0.02, n)) * u.pix,
                    'dy_pix': rng.normal(0, 0.02, n) * u.pix})
    plot_residual_map(table, '2', n_cells=5, ax=axes)
    arrows = list(axes.collections)
    places = np.concatenate([one.get_offsets() for one in arrows])
    mean = np.concatenate([one.U for one in arrows])
    assert len(places) == 25
    assert_allclose(mean, 1e-5 * (places[:, 1] - 500), atol=5 * 0.02 / 12)
    assert len(arrows[1].U) > 5
    with pytest.raises(ValueError, match="chip '7'"):
        plot_residual_map(table, '7', ax=axes)
