"""Every star that cannot show the PSF is rejected, with its reason."""
from contextlib import nullcontext

import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import (
    GaussianMixture,
    fit_mixture_field,
    select_psf_stars,
)

PSF = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
SHAPE = (160, 200)
GOOD = [(30, 30.2), (70.4, 30), (110, 30), (150.3, 30), (30, 120.4),
        (70, 120.6)]


@pytest.fixture
def data(rng):
    data = rng.normal(0, 1, SHAPE)
    for x, y in GOOD:
        data += PSF.render(SHAPE, x, y, flux=5000)
    return data


def reason_at(table, x, y):
    nearest = np.hypot(table['x'] - x, table['y'] - y).argmin()
    return table['reason'][nearest]


def test_good_stars_are_selected(data):
    table = select_psf_stars(data)
    assert all(reason_at(table, x, y) == '' for x, y in GOOD)
    assert table['selected'].sum() == len(GOOD)


@pytest.mark.parametrize('fwhm', [1.5, 1.8, 3.3])
def test_a_star_is_found_once_whatever_the_width_looked_for(data, fwhm):
    table = select_psf_stars(data, fwhm=fwhm, threshold=20)
    assert len(table) == table['selected'].sum() == len(GOOD)


def test_a_star_at_the_edge_is_rejected(data):
    data += PSF.render(SHAPE, 5, 80, flux=5000)
    assert reason_at(select_psf_stars(data), 5, 80) == 'edge'


def test_a_saturated_star_is_rejected(data):
    data += PSF.render(SHAPE, 110, 80, flux=1e5)
    data = np.minimum(data, 2000)
    table = select_psf_stars(data, saturation=2000)
    assert reason_at(table, 110, 80) == 'saturated'


def test_a_star_with_a_masked_or_nan_pixel_is_rejected(data):
    mask = np.zeros(SHAPE, bool)
    mask[33, 28] = True
    data[28, 69] = np.nan
    table = select_psf_stars(data, mask=mask)
    assert reason_at(table, 30, 30) == 'masked'
    assert reason_at(table, 70, 30) == 'masked'


def test_a_faint_star_is_rejected(data):
    data += PSF.render(SHAPE, 110, 80, flux=150)
    table = select_psf_stars(data, min_snr=50)
    assert reason_at(table, 110, 80) == 'faint'


def test_a_neighbour_counts_only_if_it_is_bright_enough(data):
    data += PSF.render(SHAPE, 116, 30, flux=400)
    data += PSF.render(SHAPE, 36, 30, flux=0)
    table = select_psf_stars(data)
    assert reason_at(table, 110, 30) == 'neighbor'
    assert reason_at(table, 30, 30) == ''
    table = select_psf_stars(data, isolation=4)
    assert reason_at(table, 110, 30) == ''


def test_what_is_no_single_star_is_rejected(data):
    data[80, 110] += 2000
    wide = PSF.convolve([[9, 0], [0, 9]])
    data += wide.render(SHAPE, 150, 80, flux=20000)
    table = select_psf_stars(data)
    assert reason_at(table, 110, 80) == 'shape'
    assert reason_at(table, 150, 80) == 'shape'


def test_surplus_stars_are_the_faintest_of_their_part(data):
    data += PSF.render(SHAPE, 150, 120, flux=9000)
    table = select_psf_stars(data, max_stars=4)
    assert table['selected'].sum() == 4
    assert np.sum(table['reason'] == 'surplus') == 3
    assert reason_at(table, 150, 120) == ''


def test_a_catalogue_keeps_its_positions_and_may_hold_nonsense(data):
    catalogue = Table({'x_fit': [30.1, np.nan, 1e6],
                       'y_fit': [30.0, 5.0, 5.0]})
    table = select_psf_stars(data, catalogue)
    assert table['x'][0] == 30.1
    assert table['reason'].tolist() == ['', 'outside', 'outside']


def test_an_empty_image_is_an_error(rng):
    with pytest.raises(ValueError, match='at least 1 source'):
        select_psf_stars(rng.normal(0, 1, (60, 60)), threshold=50)


def test_selected_stars_have_no_reason_after_a_file_too(data, tmp_path):
    table = select_psf_stars(data)
    table.write(tmp_path / 'stars.ecsv')
    again = Table.read(tmp_path / 'stars.ecsv')
    assert list(again['reason']) == list(table['reason'])
    assert (again['reason'] == '').sum() == table['selected'].sum() > 0


def small_galaxies(rng, n, shape):
    """Return an image of stars and galaxies, and where both are."""
    grid = np.mgrid[25:shape[1] - 20:32, 25:shape[0] - 20:32].reshape(2, -1).T
    places = grid + rng.uniform(-3, 3, grid.shape)
    data = rng.normal(0, 3, shape)
    is_star = np.arange(len(places)) >= n
    star = GaussianMixture([0.8, 0.2], np.zeros((2, 2)),
                           [np.eye(2), 4 * np.eye(2)])
    for place, single in zip(places, is_star, strict=True):
        flux = 10 ** rng.uniform(4, 5)
        size = rng.uniform(0.7, 2.5)
        # An exponential disc, nearly, at some inclination.
        disc = GaussianMixture(
            [0.2, 0.4, 0.4], np.zeros((3, 2)),
            [np.diag([1, rng.uniform(0.3, 1)]) * s * size**2
             for s in (0.1, 0.8, 3)])
        psf = star if single else GaussianMixture(
            np.outer(star.weights, disc.weights).ravel(), np.zeros((6, 2)),
            [a + b for a in star.covariances for b in disc.covariances])
        data += psf.render(shape, *place, flux=flux)
    return data, places, is_star


def test_small_galaxies_stay_out(rng):
    data, places, is_star = small_galaxies(rng, 50, (420, 420))
    table = select_psf_stars(data, error=np.full(data.shape, 3.0))
    reasons = np.array([reason_at(table, *place) for place in places])
    assert np.sum(reasons[~is_star] == '') <= 1
    assert np.mean(reasons[is_star] == '') > 0.95


def test_stars_of_a_catalogue_are_preferred_if_they_are_enough(rng):
    data, places, is_star = small_galaxies(rng, 50, (420, 420))
    for n, reason in ((20, 'unlisted'), (5, '')):
        x, y = places[is_star][:n].T
        with (pytest.warns(AstropyUserWarning, match='5 of its 5 sources')
              if reason == '' else nullcontext()):
            table = select_psf_stars(data, catalogue=Table({'x': x, 'y': y}))
        other = places[is_star][25]
        assert reason_at(table, *other) == reason
        assert reason_at(table, x[0], y[0]) == ''


@pytest.mark.parametrize('catalogue', [
    {'x': [], 'y': []}, {'x': [-50.0, 900.0], 'y': [20.0, 20.0]},
    {'x': [y for _, y in GOOD], 'y': [x for x, _ in GOOD]}])
def test_a_catalogue_of_other_places_is_said(data, catalogue):
    with pytest.warns(AstropyUserWarning, match='check its x and y'):
        table = select_psf_stars(data, catalogue=Table(catalogue))
    assert table['selected'].sum() == len(GOOD)


@pytest.mark.parametrize(('value', 'words'), [
    (1.0, 'must have noise, got one value'),
    (np.nan, 'must have pixels that can be used')])
def test_an_image_of_nothing_is_said_without_a_threshold(value, words):
    with (pytest.warns(AstropyUserWarning, match='no pixel')
          if np.isnan(value) else nullcontext()), \
            pytest.raises(ValueError, match=words):
        select_psf_stars(np.full(SHAPE, value))


def test_a_table_without_a_star_for_the_psf_is_named():
    data = np.zeros((40, 40))
    stars = Table({'x': [20.0], 'y': [20.0], 'selected': [False]})
    with pytest.raises(ValueError, match="column 'selected' of stars must be"):
        fit_mixture_field(data, stars, error=1.0)
    with pytest.raises(ValueError, match='got a table without rows'):
        fit_mixture_field(data, stars[:0], error=1.0)
