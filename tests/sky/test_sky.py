"""Planes, observers and WCS: laws, and comparisons with erfa and astropy."""
import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.coordinates import (
    FK5,
    CartesianRepresentation,
    Galactic,
    SkyCoord,
    get_body_barycentric,
)
from astropy.time import Time
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.wcs import make_gwcs, tan_wcs
from photutils_mgauss import invert_wcs
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
from photutils_mgauss.sky.wcs import celestial_frame, pixel_to_vectors

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


def test_an_observer_given_as_a_place_is_used(rng):
    place = CartesianRepresentation([1.0, 2.0, 3.0] * u.au)
    assert_allclose(observer_position(place, np.array([2020.0, 2021.0])),
                    [[1, 1], [2, 2], [3, 3]])


# Frames

def _galactic_wcs():
    wcs = tan_wcs(30.0, 20.0)
    wcs.wcs.ctype = 'GLON-TAN', 'GLAT-TAN'
    return wcs


@pytest.mark.parametrize('wcs', [
    tan_wcs(30.0, 20.0), _galactic_wcs(), make_gwcs(30.0, 20.0),
    make_gwcs(30.0, 20.0, frame=FK5(equinox='J1975')),
    make_gwcs(30.0, 20.0, frame=Galactic())])
def test_the_frame_is_that_of_the_places_of_pixels(wcs):
    frame = celestial_frame(wcs)
    assert frame.is_equivalent_frame(wcs.pixel_to_world(5.0, 7.0).frame)
    assert not frame.has_data


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
