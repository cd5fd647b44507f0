"""PSFEx models, against an independent reader and against hand-made files."""
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from helpers.psfex_models import MODELS, X, Y, write_model
from photutils_mgauss import read_psfex


@pytest.mark.parametrize('name', MODELS)
def test_images_agree_with_galsims_at_200_places(name, realdata, rng):
    des = pytest.importorskip('galsim.des')
    galsim = pytest.importorskip('galsim')
    path = realdata('decam_psfex') / name
    model, peer = read_psfex(path), des.DES_PSFEx(str(path))
    x, y = rng.uniform(-100, 2200, 200), rng.uniform(-100, 4200, 200)
    for x_0, y_0 in zip(x, y, strict=True):
        image = model.image_at(x_0, y_0)
        expected = peer.getPSFArray(galsim.PositionD(x_0 + 1, y_0 + 1))
        assert_allclose(image, expected, atol=1e-6 * expected.max())


def test_the_file_tells_sampling_origin_and_the_range_of_positions(realdata):
    model = read_psfex(realdata('decam_psfex') / MODELS[0])
    assert_allclose(model.sampling, 0.97556132)
    assert model.origin == (12, 12)
    (x_low, x_high), (y_low, y_high) = model.position_range
    assert_allclose([x_low, x_high, y_low, y_high],
                    [21.748, 2024.877, 21.679, 4072.908], atol=1e-3)


@pytest.mark.parametrize('degree', [0, 1, 3, 5])
def test_any_degree_is_a_polynomial_with_x_fastest(tmp_path, rng, degree):
    powers = [(i, j) for j in range(degree + 1)
              for i in range(degree + 1 - j)]
    planes = rng.normal(size=(len(powers), 4, 6)).astype('f4')
    model = read_psfex(write_model(tmp_path / 'a.psf', planes,
                                   contexts=(X, Y), degrees=(degree,)))
    assert_array_equal(model.exponents, powers)
    assert model.origin == (3, 2)
    u, v = (31 - 100) / 200, (71 - 50) / 80
    expected = sum(u**i * v**j * plane.astype(float)
                   for (i, j), plane in zip(powers, planes, strict=True))
    assert_allclose(model.image_at(30, 70), expected, rtol=1e-6)


def test_the_terms_of_two_groups_are_multiplied(tmp_path, rng):
    planes = rng.normal(size=(6, 3, 3)).astype(np.float32)
    path = write_model(tmp_path / 'a.psf', planes, degrees=(1, 1), contexts=(
        X, Y, ('MAG_AUTO', 2, 20.0, 4.0)))
    model = read_psfex(path)
    u, v, m = (11 - 100) / 200, (21 - 50) / 80, (18 - 20) / 4
    terms = [1, u, v, m, m * u, m * v]
    assert_allclose(model.image_at(10, 20, MAG_AUTO=18),
                    np.tensordot(terms, planes, 1), rtol=1e-6)
    with pytest.raises(ValueError, match="value of 'MAG_AUTO'"):
        model.image_at(10, 20)
    with pytest.raises(TypeError, match=r"among .* got \['MAG'\]"):
        model.image_at(10, 20, MAG_AUTO=18, MAG=3)


@pytest.mark.parametrize('n_axes', [2, 3])
def test_a_constant_model_needs_no_names(tmp_path, rng, n_axes):
    planes = rng.normal(size=(1, 5, 5)[-n_axes:]).astype(np.float32)
    model = read_psfex(write_model(tmp_path / 'a.psf', planes))
    assert_array_equal(model.image_at(3, 4), planes.reshape(5, 5))
    assert model.position_range == (None, None)


def test_windowed_positions_are_positions(tmp_path):
    path = write_model(tmp_path / 'a.psf', np.ones((3, 3, 3)), degrees=(1,),
                       contexts=(('XWIN_IMAGE', 1, 1.0, 10.0),
                                 ('YWIN_IMAGE', 1, 1.0, 10.0)))
    assert_allclose(read_psfex(path).image_at(5, 0), 1.5)


def test_a_damaged_file_of_the_survey_is_refused(realdata):
    path = realdata('decam_psfex') / 'invalid_psfcat.psf'
    with pytest.raises(ValueError, match='6 terms, but PSFAXIS tells of 3'):
        read_psfex(path)


@pytest.mark.parametrize(('cards', 'message'), [
    ({'PSF_SAMP': 0.0}, 'PSF_SAMP must be positive, got 0'),
    ({'PSF_SAMP': 'a'}, "PSF_SAMP must be a number, got 'a'"),
    ({'POLZERO1': None}, 'the keyword POLZERO1 is missing'),
    ({'POLNAME2': None}, 'the keyword POLNAME2 is missing'),
    ({'POLNAME1': ':AIRMASS'}, "depends on ':AIRMASS', a keyword of the"),
    ({'POLSCAL2': 0.0}, 'POLSCAL must not be 0'),
    ({'POLGRP1': 2}, r'POLGRP must be 1 to POLNGRP = 1, got \[2, 1\]'),
    ({'PSFAXIS1': 4}, 'PSFAXIS tells of 36 values, but the table holds 27'),
    ({'POLDEG1': 2}, '6 terms, but PSFAXIS tells of 3 images'),
])
def test_what_is_wrong_with_a_file_is_named(tmp_path, cards, message):
    path = write_model(tmp_path / 'a.psf', np.ones((3, 3, 3)),
                       contexts=(X, Y), degrees=(1,), **cards)
    with pytest.raises(ValueError, match=message):
        read_psfex(path)


def test_pixels_must_be_finite(tmp_path):
    path = write_model(tmp_path / 'a.psf', np.full((1, 3, 3), np.nan))
    with pytest.raises(ValueError, match='pixels are not finite'):
        read_psfex(path)


def test_truncated_and_foreign_files_are_refused(tmp_path):
    path = write_model(tmp_path / 'a.psf', np.ones((1, 51, 51)))
    path.write_bytes(path.read_bytes()[:8000])
    with pytest.raises(ValueError, match='undamaged PSFEx model'):
        read_psfex(path)
    fits.PrimaryHDU(np.ones((3, 3))).writeto(tmp_path / 'b.fits')
    with pytest.raises(ValueError, match='no table has the keyword PSF_SAMP'):
        read_psfex(tmp_path / 'b.fits')
    (tmp_path / 'c.psf').write_text('hello')
    with pytest.raises(ValueError, match='undamaged PSFEx model'):
        read_psfex(tmp_path / 'c.psf')
    with pytest.raises(FileNotFoundError):
        read_psfex(tmp_path / 'missing.psf')
