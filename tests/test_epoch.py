"""Epochs: what is read from tables, WCS and times, and what is refused."""
import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy import coordinates as coord
from astropy.coordinates import (
    CartesianRepresentation,
    SkyCoord,
    get_body_barycentric,
)
from astropy.modeling.models import (
    AffineTransformation2D,
    Pix2Sky_TAN,
    RotateNative2Celestial,
    Shift,
)
from astropy.table import MaskedColumn, QTable, Table
from astropy.time import Time
from astropy.wcs import WCS
from gwcs import WCS as GWCS
from gwcs import coordinate_frames
from motion_scenes import tan_wcs
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, barycentric_observer, invert_wcs
from photutils_mgauss.motions.epoch import read_epoch, sky_vectors
from photutils_mgauss.sky.observers import (
    add_aberration,
    observer_position,
    remove_aberration,
)
from photutils_mgauss.sky.tangent_plane import (
    TangentPlane,
    directions,
    unit_vectors,
)
from photutils_mgauss.sky.wcs import pixel_jacobian, pixel_to_vectors


def table(**columns):
    values = {'x_fit': [10.0, 20.0], 'y_fit': [30.0, 5.0],
              'x_err': [0.01, 0.02], 'y_err': [0.02, 0.01]}
    return Table({**values, **columns})


def make_gwcs(ra, dec, *, rotation=0.0, frame=None, box=None):
    """Return a gwcs with tangent plane at (ra, dec), 0.1 arcsec pixels."""
    c, s = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    matrix = 0.1 / 3600 * np.array([[-c, s], [s, c]])
    transform = ((Shift(-500) & Shift(-400))
                 | AffineTransformation2D(matrix) | Pix2Sky_TAN()
                 | RotateNative2Celestial(ra, dec, 180))
    detector = coordinate_frames.Frame2D(name='detector',
                                         unit=(u.pix, u.pix))
    # A frame without data is falsy: "frame or ICRS()" would ignore it.
    frame = coord.ICRS() if frame is None else frame
    sky = coordinate_frames.CelestialFrame(reference_frame=frame,
                                           name='world')
    wcs = GWCS([(detector, transform), (sky, None)])
    if box is not None:
        wcs.bounding_box = box
    return wcs


# The tangent plane

@pytest.mark.parametrize('dec', [0.0, 27.0, 89.9, 90.0, -90.0])
@pytest.mark.parametrize('ra', [0.0, 192.0, 359.999])
def test_projecting_and_back_is_the_identity(ra, dec, rng):
    plane = TangentPlane(ra, dec)
    points = rng.uniform(-1e6, 1e6, (2, 50))
    vectors = plane.deproject(points)
    assert_allclose(np.sum(vectors**2, axis=0), 1, rtol=1e-14)
    assert_allclose(plane.project(vectors), points, atol=1e-6)


def test_the_plane_agrees_with_astropy(rng):
    plane = TangentPlane(30.0, 60.0)
    sky = SkyCoord(rng.uniform(29.9, 30.1, 20), rng.uniform(59.9, 60.1, 20),
                   unit='deg')
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval = 30.0, 60.0
    # The reference pixel of an empty header is 0 by FITS counting, -1 here.
    degrees = np.stack(wcs.world_to_pixel(sky)) + 1
    points = plane.project(unit_vectors(sky.ra.deg, sky.dec.deg))
    assert_allclose(points, degrees * 3.6e6, atol=1e-4)


@pytest.mark.parametrize('dec', [0.0, 80.0, 89.99])
def test_local_jacobian_is_the_central_difference(dec, rng):
    plane = TangentPlane(10.0, dec)
    points = rng.uniform(-3e5, 3e5, (2, 20))
    jacobian = plane.local_jacobian(points)
    ra, dec = directions(plane.deproject(points))
    h = 1e-6
    up = plane.project(unit_vectors(ra, dec + h))
    down = plane.project(unit_vectors(ra, dec - h))
    assert_allclose(jacobian[:, 1], (up - down) / (2 * h * 3.6e6), atol=1e-6)


def test_parallax_is_the_displacement_seen_from_the_observer(rng):
    plane = TangentPlane(200.0, 40.0)
    points = rng.uniform(-3e5, 3e5, (2, 20))
    place = rng.normal(size=(3, 1))
    factors = plane.parallax_factors(points, place)
    parallax = np.radians(10 / 3.6e6)
    moved = plane.project(plane.deproject(points) - parallax * place)
    assert_allclose((moved - points) / 10, factors, atol=1e-4)


# Observers

def test_the_earth_is_where_erfa_has_it():
    years = np.array([2015.3, 2024.9, 2028.5])
    time = Time(years, format='jyear', scale='tdb')
    _, bary = erfa.epv00(time.jd1, time.jd2)
    assert_allclose(observer_position('earth', years).T, bary['p'],
                    atol=1e-12)


def test_l2_is_a_hundredth_of_an_orbit_further_out():
    sun = get_body_barycentric('sun', Time(2026.0, format='jyear',
                                           scale='tdb'), ephemeris='builtin')
    earth, l2 = (observer_position(name, 2026.0) for name in ('earth', 'l2'))
    away = earth - sun.xyz.to_value(u.au)
    assert_allclose((l2 - earth) / away, 0.01, rtol=0.01)


def test_aberration_is_that_of_erfa(rng):
    vectors = rng.normal(size=(3, 30))
    vectors /= np.linalg.norm(vectors, axis=0)
    beta = np.array([0.5, -0.7, 0.2]) * 1e-4
    seen = add_aberration(vectors, beta)
    # The Sun infinitely far away: no part of light deflection.
    expected = erfa.ab(vectors.T, beta, 1e12, np.sqrt(1 - beta @ beta)).T
    assert_allclose(seen, expected, atol=1e-15)
    assert_allclose(remove_aberration(seen, beta), vectors, atol=1e-15)


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


def test_times_may_come_with_the_rows():
    years = Epoch(table(time=[2020.0, 2020.5])).years
    assert_allclose(years, [2020.0, 2020.5])


@pytest.mark.parametrize(('make', 'error', 'words'), [
    (lambda: Epoch([1, 2], time=2020.0), TypeError, 'table must be'),
    (lambda: Epoch(Table({'x': [1.0]}), time=2020.0), ValueError,
     "column 'y_fit' or 'y'"),
    (lambda: Epoch(table()), ValueError, 'time must be given'),
    (lambda: Epoch(table(), time=np.nan), ValueError, 'time must be finite'),
    (lambda: Epoch(table(), time='soon'), TypeError, 'time must be a Time'),
    (lambda: Epoch(table(), time=[1.0, 2.0, 3.0]), ValueError,
     'one per row'),
    (lambda: Epoch(table(), time=59215.0), ValueError,
     r'time must be a Time or Julian years below 10000, got 59215\.0'),
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


# The inverse

@pytest.mark.parametrize('dec', [0.0, 27.0, 80.0, 89.9, 90.0])
@pytest.mark.parametrize('rotation', [0.0, 20.0, 90.0])
def test_the_inverse_undoes_any_wcs(dec, rotation, rng):
    x, y = rng.uniform(0, 1000, (2, 40))
    for wcs in (make_gwcs(0.0, dec, rotation=rotation),
                make_gwcs(0.0, dec, rotation=rotation,
                          box=((0, 1000), (0, 1000))),
                tan_wcs(0.0, dec, rotation=rotation, mirrored=False)):
        ra, dec_ = directions(pixel_to_vectors(wcs, x, y))
        back = invert_wcs(wcs, SkyCoord(ra, dec_, unit='deg'))
        assert_allclose(back, (x, y), atol=1e-7)


def test_the_inverse_of_real_instruments(realdata, rng):
    asdf = pytest.importorskip('asdf')
    for name in ('nircamwcs.asdf', 'miriwcs.asdf'):
        with asdf.open(realdata('nircam_wcs') / name) as tree:
            wcs = tree['wcs']
        x, y = rng.uniform(20, 1000, (2, 50))
        ra, dec = directions(pixel_to_vectors(wcs, x, y))
        back = invert_wcs(wcs, SkyCoord(ra, dec, unit='deg'))
        assert_allclose(back, (x, y), atol=1e-6)


def test_the_inverse_of_a_place_behind_the_sky_is_nan():
    x, y = invert_wcs(make_gwcs(0.0, 0.0), SkyCoord(180.0, 0.0, unit='deg'))
    assert np.isnan(x)
    assert np.isnan(y)


def test_an_observer_given_as_a_place_is_used(rng):
    place = CartesianRepresentation([1.0, 2.0, 3.0] * u.au)
    assert_allclose(observer_position(place, np.array([2020.0, 2021.0])),
                    [[1, 1], [2, 2], [3, 3]])
