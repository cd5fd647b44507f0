"""WCS as matrices: the WCS itself, and its differences, are the oracle."""
import numpy as np
import pytest
from astropy.wcs import WCS, Sip
from numpy.testing import assert_allclose

from helpers.wcs import make_gwcs, tan_wcs
from photutils_mgauss.sky.gnomonic import Gnomonic
from photutils_mgauss.sky.tangent_plane import TangentPlane, unit_vectors
from photutils_mgauss.sky.wcs import pixel_jacobian, pixel_to_vectors


def with_sip(wcs):
    """Return a WCS with a distortion of 20 pixels."""
    a, b = np.zeros((2, 4, 4))
    a[2, 0], a[1, 2], b[0, 2], b[1, 1] = 1e-6, 1e-10, -5e-7, 2e-7
    wcs.wcs.ctype = 'RA---TAN-SIP', 'DEC--TAN-SIP'
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    return wcs


def with_scales(wcs):
    """Return a WCS with a matrix and scales in arcsec, not degrees."""
    out = WCS(naxis=2)
    out.wcs.ctype, out.wcs.crpix = wcs.wcs.ctype, wcs.wcs.crpix
    out.wcs.cunit = 'arcsec', 'arcsec'
    out.wcs.crval = wcs.wcs.crval * 3600
    out.wcs.pc, out.wcs.cdelt = [[1, 0.1], [0.1, -1]], [0.2, 0.3]
    return out


def with_pole(wcs):
    """Return a WCS whose plane is turned by 30 degrees."""
    wcs.wcs.lonpole = 150.0
    return wcs


@pytest.fixture
def pixels(rng):
    """Places all over a chip of 9000 pixels, one of them unknown."""
    x, y = rng.uniform(0, 9000, (2, 200))
    x[7] = y[7] = np.nan
    return x, y


WCSS = [tan_wcs(192.86, 27.13), tan_wcs(0.0, -60.0, rotation=130.0),
        tan_wcs(10.0, 90.0, mirrored=False), tan_wcs(77.0, -89.99),
        with_sip(tan_wcs(30.0, 40.0, rotation=20.0)),
        with_pole(tan_wcs(50.0, 30.0)), with_scales(tan_wcs(100.0, -20.0))]


@pytest.mark.parametrize('wcs', WCSS)
def test_directions_are_those_of_the_wcs(wcs, pixels):
    assert Gnomonic.of(wcs, *pixels) is not None
    angles = np.array(wcs.pixel_to_world_values(*pixels)) * (
        wcs.wcs.cunit[0].to('deg'))
    assert_allclose(pixel_to_vectors(wcs, *pixels), unit_vectors(*angles),
                    rtol=0, atol=3e-15)


@pytest.mark.parametrize('turned', [False, True])
@pytest.mark.parametrize('wcs', WCSS)
def test_derivatives_are_differences_of_places(wcs, turned, pixels):
    x, y = pixels
    centre = pixel_to_vectors(wcs, np.array([4000.0]), np.array([5000.0]))
    plane, turn = TangentPlane.around(centre), np.eye(3)
    if turned:
        c, s = np.cos(0.001), np.sin(0.001)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def place(dx, dy):
        return plane.project(turn @ pixel_to_vectors(wcs, x + dx, y + dy))
    expected = np.stack([place(0.5, 0) - place(-0.5, 0),
                         place(0, 0.5) - place(0, -0.5)], axis=1)
    got = pixel_jacobian(wcs, plane, x, y, turn if turned else None)
    assert np.isnan(got[..., 7]).all()
    # Places of 1e6 mas round to 1e-9 parts of a pixel.
    assert_allclose(got, expected, rtol=0, atol=1e-8 * np.nanmax(expected))


@pytest.mark.parametrize('wcs', WCSS)
def test_the_inverse_is_exact_or_left_to_newton(wcs, pixels):
    vectors = pixel_to_vectors(wcs, *pixels)
    found = Gnomonic.inverted(wcs, np.column_stack([vectors, -vectors[:, 0]]))
    if wcs.has_distortion:
        assert found is None
        return
    x, y = found
    assert np.isnan([x[-1], y[-1]]).all()
    assert_allclose([x[:-1], y[:-1]], pixels, rtol=0, atol=1e-8)


def test_places_behind_the_horizon_of_a_plane_are_nan():
    wcs, plane = tan_wcs(10.0, 20.0), TangentPlane(190.0, 0.0)
    assert np.isnan(pixel_jacobian(wcs, plane, np.zeros(3), np.zeros(3))
                    ).all()


def test_what_no_matrix_describes_is_left_to_the_wcs(pixels):
    bounded, other = (tan_wcs(50.0, 30.0) for _ in range(2))
    bounded.pixel_bounds = (0, 4000), (0, 4000)
    other.wcs.ctype = 'RA---STG', 'DEC--STG'
    galactic = tan_wcs(50.0, 30.0)
    galactic.wcs.ctype = 'GLON-TAN', 'GLAT-TAN'
    for wcs in (bounded, other, galactic, make_gwcs(50.0, 30.0)):
        assert Gnomonic.of(wcs, *pixels) is None
    outside = pixels[0] > 4001
    assert np.isnan(pixel_to_vectors(bounded, *pixels)[0, outside]).all()


def test_other_equinoxes_are_turned_to_icrs(pixels):
    wcs = tan_wcs(50.0, 30.0)
    wcs.wcs.radesys, wcs.wcs.equinox = 'FK5', 1975.0
    sky = wcs.pixel_to_world(*pixels).icrs
    assert_allclose(pixel_to_vectors(wcs, *pixels),
                    unit_vectors(sky.ra.deg, sky.dec.deg), atol=1e-12)
