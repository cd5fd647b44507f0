"""Epochs: what is read from tables, WCS and times, and what is refused."""
import astropy.units as u
import numpy as np
import pytest
from astropy import coordinates as coord
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.wcs import make_gwcs, tan_wcs
from photutils_mgauss import Epoch, barycentric_observer
from photutils_mgauss.motions.detections import read_epoch, sky_vectors
from photutils_mgauss.sky.tangent_plane import TangentPlane, directions
from photutils_mgauss.sky.wcs import pixel_jacobian, pixel_to_vectors


def table(**columns):
    values = {'x_fit': [10.0, 20.0], 'y_fit': [30.0, 5.0],
              'x_err': [0.01, 0.02], 'y_err': [0.02, 0.01]}
    return Table({**values, **columns})


def test_only_a_velocity_given_removes_aberration():
    wcs = tan_wcs(120.0, 10.0)
    place = barycentric_observer('earth', 2026.0)
    moving = barycentric_observer('earth', 2026.0, velocity=True)
    still, corrected = (sky_vectors(Epoch(table(), wcs, 2026.0, observer=one))
                        for one in (place, moving))
    plain = sky_vectors(Epoch(table(), wcs, 2026.0))
    assert_allclose(still, plain, atol=0)
    away = np.linalg.norm(corrected - plain, axis=0) * 206264.8
    assert ((away > 1) & (away < 21)).all()


# Reading

def test_photutils_and_plain_names_read_the_same():
    plain = Table({'x': [10.0, 20.0], 'y': [30.0, 5.0],
                   'x_error': [0.01, 0.02], 'y_error': [0.02, 0.01]})
    one, two = (read_epoch(Epoch(t, time=2020.0)) for t in (table(), plain))
    assert_allclose(one.plane, two.plane)
    assert_allclose(one.covariance, two.covariance)


def test_units_of_columns_are_used():
    seconds = QTable({'x': [1.0] * u.arcsec, 'y': [2.0] * u.arcsec,
                      'x_err': [10.0] * u.mas, 'y_err': [20.0] * u.mas})
    read = read_epoch(Epoch(seconds, time=2020.0))
    assert_allclose(read.plane[:, 0], [1000, 2000])
    assert_allclose(read.covariance[:, 0], [100, 0, 400])
    scaled = Epoch(table(), time=2020.0, pixel_scale=0.1 * u.arcsec / u.pix)
    assert_allclose(read_epoch(scaled).plane[:, 0], [1000, 3000])
    assert_allclose(read_epoch(scaled).covariance[:, 0], [1, 0, 4])


def test_a_unit_that_does_not_fit_is_an_error():
    wrong = QTable(table())
    wrong['x_err'] = [1, 2] * u.s
    with pytest.raises(ValueError, match="column 'x_err' must have a unit"):
        read_epoch(Epoch(wrong, time=2020.0))


def test_errors_of_pixels_go_through_the_wcs():
    wcs = make_gwcs(50.0, 85.0, rotation=30.0)
    epoch = Epoch(table(xy_cov=[5e-5, 0.0]), wcs, 2020.0)
    vectors = sky_vectors(epoch)
    plane = TangentPlane.around(vectors)
    got = read_epoch(epoch, plane, vectors).covariance[:, 0]
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    matrix = 100 * np.array([[-c, s], [s, c]])
    # The plane touches the sky 50 arcsec from the WCS's own at dec 85.
    turn = np.radians(plane.ra - 50.0) * np.sin(np.radians(85))
    turn = np.array([[np.cos(turn), np.sin(turn)],
                     [-np.sin(turn), np.cos(turn)]])
    inner = np.array([[1e-4, 5e-5], [5e-5, 4e-4]])
    expected = turn @ matrix @ inner @ matrix.T @ turn.T
    assert_allclose(got, expected[[0, 0, 1], [0, 1, 1]], rtol=1e-4)


def test_jacobians_are_those_of_the_wcs_at_the_edge_of_its_box():
    box = ((-0.5, 999.5), (-0.5, 799.5))
    wcs = make_gwcs(0.0, 10.0, box=box)
    plane = TangentPlane(0.0, 10.0)
    x, y = np.array([-0.5, 999.5, 10.0]), np.array([-0.5, 799.5, 10.0])
    jacobian = pixel_jacobian(wcs, plane, x, y)
    assert_allclose(jacobian, np.tile(
        np.array([[-100.0, 0], [0, 100.0]])[..., None], 3), atol=1e-3)
    outside = pixel_to_vectors(wcs, np.array([-3.0]), np.array([5.0]))
    assert np.isnan(outside).all()


@pytest.mark.parametrize('frame', [coord.FK5(), coord.Galactic(),
                                   coord.FK5(equinox='J2020')])
def test_other_frames_are_converted_not_read_as_icrs(frame):
    wcs = make_gwcs(100.0, 20.0, frame=frame)
    sky = wcs.pixel_to_world(10.0, 30.0).icrs
    ra, dec = directions(pixel_to_vectors(wcs, [10.0], [30.0]))
    assert_allclose([ra[0], dec[0]], [sky.ra.deg, sky.dec.deg], atol=1e-12)


def test_masked_and_infinite_positions_are_not_found():
    masked = table()
    masked['x_fit'] = MaskedColumn([1.0, 2.0], mask=[True, False])
    masked['y_fit'] = [1.0, np.inf]
    read = read_epoch(Epoch(masked, time=2020.0))
    assert not read.found.any()
    assert np.isnan(read.plane).all()


@pytest.mark.parametrize('year', [2028.6, 2050.0])
def test_times_beyond_the_leap_seconds_are_quiet(year):
    utc = Time(year, format='jyear', scale='utc')
    assert_allclose(Epoch(table(), time=utc).mean_year, year, atol=1e-5)


def test_dates_beyond_the_leap_seconds_are_quiet():
    assert_allclose(Epoch(table(), time='2050-01-01').mean_year, 2050,
                    atol=1e-5)


def test_times_may_come_with_the_rows():
    years = Epoch(table(time=[2020.0, 2020.5])).years
    assert_allclose(years, [2020.0, 2020.5])


@pytest.mark.parametrize(('make', 'error', 'words'), [
    (lambda: Epoch([1, 2], time=2020.0), TypeError, 'table must be'),
    (lambda: Epoch(table(), fits.Header(), 2020.0), TypeError,
     r'got Header; astropy\.wcs\.WCS\(header\) makes'),
    (lambda: Epoch(Table({'x': [1.0]}), time=2020.0), ValueError,
     "column 'y_fit' or 'y'"),
    (lambda: Epoch(table()), ValueError, 'time must be given'),
    (lambda: Epoch(table(), time=np.nan), ValueError, 'time must be finite'),
    (lambda: Epoch(table(), time='soon'), TypeError, 'time must be a Time'),
    (lambda: Epoch(table(), time=[2021.0, 2022.0, 2023.0]), ValueError,
     'one per row'),
    (lambda: Epoch(table(), time=59215.0), ValueError,
     'time must be a Time or Julian years, got the year 59215, which'),
    (lambda: Epoch(table(), time=59000 * u.day), ValueError,
     r'Julian years, got 59000\.0 d; give a date in days as Time\(..., form'),
    (lambda: Epoch(table(time=[59000, 59001] * u.day)), ValueError,
     r'the column time must be a Time or Julian years, got 59000\.0 d;'),
    (lambda: Epoch(table(), time=Time(59000, format='jd')), ValueError,
     'got the year -4550'),
    (lambda: Epoch(table(), time=16.0), ValueError, 'got the year 16, which'),
    (lambda: Epoch(Table({'X': [1.0]}), time=2020.0), ValueError,
     "column 'x_fit' or 'x' or 'ra', got"),
    (lambda: Epoch(table(), 'wcs', 2020.0), TypeError, 'wcs must be'),
    (lambda: Epoch(table(), WCS(naxis=3), 2020.0), ValueError,
     'wcs must have 2 pixel'),
    (lambda: Epoch(table(), WCS(naxis=2), 2020.0), ValueError,
     'celestial'),
    (lambda: Epoch(table(), time=2020.0, observer='moon'), ValueError,
     'observer must be'),
    (lambda: Epoch(table(), time=2020.0, pixel_scale=3), TypeError,
     'pixel_scale must be a Quantity'),
    (lambda: Epoch(table(), time=2020.0, pixel_scale=-1 * u.mas),
     ValueError, 'positive angle'),
])
def test_an_epoch_says_what_is_wrong_with_it(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_duplicate_identifiers_are_an_error():
    with pytest.raises(ValueError, match="'id' must hold unique values"):
        read_epoch(Epoch(table(id=[3, 3]), time=2020.0))


@pytest.mark.parametrize('date', ['2013-05-01', '2013-05-01T00:00:00',
                                  np.str_('2013-05-01')])
def test_dates_may_be_words(date):
    expected = Time('2013-05-01', scale='utc').tdb.jyear
    assert Epoch(table(), tan_wcs(0, 0), date).mean_year == expected
    rows = table()
    rows['time'] = np.full(len(rows), str(date))
    assert_allclose(Epoch(rows, tan_wcs(0, 0)).years, expected)


def test_years_may_be_quantities():
    assert Epoch(table(), time=2013.5 * u.yr).mean_year == 2013.5


def test_years_may_be_words():
    assert Epoch(table(), time='2013.5').mean_year == 2013.5
