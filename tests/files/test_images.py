"""Images of every kind are read with their noise, flags, WCS and time."""
from io import BytesIO

import asdf
import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import Instrument, paper_exposures
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.files.image_header import (
    Cards,
    electrons_in_unit,
    parse_unit,
)

SHAPE = (60, 70)


@pytest.fixture
def sky(rng):
    """Return an image of nothing but a sky of 100 electrons."""
    return rng.poisson(100, SHAPE).astype(np.float32)


@pytest.fixture(scope='module')
def gwcs():
    exposure = paper_exposures()[0]
    camera = Instrument(shape=SHAPE)
    return exposure.wcs(camera.shape, camera.pixel_scale)


@pytest.fixture(scope='module')
def tan():
    """Return the cards of a TAN projection."""
    return {'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN', 'CRVAL1': 30.0,
            'CRVAL2': -20.0, 'CRPIX1': 35.0, 'CRPIX2': 30.0,
            'CDELT1': -2e-5, 'CDELT2': 2e-5}


def header(**cards):
    return fits.Header(list(cards.items()))


def write_layers(path, data, primary=None, layers=None, sci=None):
    hdus = [fits.PrimaryHDU(header=header(**(primary or {}))),
            fits.ImageHDU(data, header(**(sci or {})), 'SCI')]
    for name, values in (layers or {}).items():
        hdus.append(fits.ImageHDU(values, name=name))
    fits.HDUList(hdus).writeto(path)
    return path


def test_a_plain_image_gets_its_noise_from_sky_and_gain(tmp_path, sky, tan):
    path = tmp_path / 'plain.fits'
    cards = {**tan, 'BUNIT': 'ADU', 'GAIN': 2.0, 'SATURATE': 6e4,
             'DATE-OBS': '2027-03-14T15:00:00', 'EXPTIME': 600.0}
    fits.PrimaryHDU(sky / 2, header(**cards)).writeto(path)
    image = read_image(path)
    assert image.unit == u.adu
    assert image.saturation == 6e4
    assert image.time.isot == '2027-03-14T15:05:00.000'
    assert image.wcs.wcs.crval[0] == 30
    assert image.noise.gain == 2
    # 100 electrons of sky scatter by 10 electrons, 5 counts.
    assert_allclose(np.median(image.noise.background), 5, rtol=0.1)
    assert np.all(image.noise.total >= image.noise.background)


def test_with_a_read_noise_the_noise_is_that_of_the_paper(tmp_path, sky):
    path = tmp_path / 'plain.fits'
    fits.PrimaryHDU(sky, header(BUNIT='electron', RDNOISE=20.0,
                                GAIN=1.7)).writeto(path)
    noise = read_image(path).noise
    assert_allclose(np.median(noise.background), np.sqrt(100 + 400),
                    rtol=0.01)
    assert noise.gain == 1  # the image is in electrons already
    assert_allclose(np.median(read_image(
        path, Reading(read_noise=1.0)).noise.background), 10, rtol=0.02)


def test_without_gain_the_noise_is_an_error_that_tells_what_to_give(
        tmp_path, sky):
    path = tmp_path / 'plain.fits'
    fits.PrimaryHDU(sky).writeto(path)
    with pytest.raises(ValueError, match=r'plain\.fits.*no unit.*--gain'):
        _ = read_image(path).noise
    assert read_image(path, Reading(gain=1.0)).noise.gain == 1


@pytest.mark.parametrize('gain', ['1.5 e/ADU', -2.0])
def test_a_gain_that_is_no_positive_number_is_named(tmp_path, sky, gain):
    path = tmp_path / 'plain.fits'
    fits.PrimaryHDU(sky, header(GAIN=gain)).writeto(path)
    with pytest.raises(ValueError, match=f'gain is {gain!r}, no positive'):
        _ = read_image(path).noise


def test_a_surface_brightness_takes_the_gain_given(tmp_path, sky):
    path = tmp_path / 'plain.fits'
    fits.PrimaryHDU(sky / 500, header(BUNIT='MJy/sr', GAIN=3.0)).writeto(path)
    with pytest.raises(ValueError, match='the unit MJy / sr'):
        _ = read_image(path).noise
    noise = read_image(path, Reading(gain=500.0)).noise
    assert_allclose(np.median(noise.background), 0.02, rtol=0.1)


def test_extensions_give_errors_and_flags(tmp_path, sky):
    flags = np.zeros(SHAPE, np.int32)
    flags[3, 4], flags[5, 6] = 1, 32
    error = np.full(SHAPE, 7.0, np.float32)
    error[8, 9] = 0
    image = read_image(write_layers(
        tmp_path / 'a.fits', sky, layers={'ERR': error, 'DQ': flags}))
    assert image.noise.gain is None
    assert image.noise.total[0, 0] == 7
    assert set(map(tuple, np.argwhere(image.mask))) == {(3, 4), (5, 6),
                                                        (8, 9)}
    some = read_image(image.path, Reading(good_bits=33))
    assert set(map(tuple, np.argwhere(some.mask))) == {(8, 9)}


@pytest.mark.parametrize(('telescope', 'bad'), [
    ('JWST', [1]), ('HST', [1, 4, 256, 8192]), ('CSST', [
        1, 2, 4, 32, 64, 256, 1024, 8192])])
def test_which_bits_make_a_pixel_bad_is_known_of_telescopes(
        tmp_path, sky, telescope, bad):
    bits = [1, 2, 4, 32, 64, 256, 1024, 8192]
    flags = np.zeros(SHAPE, np.int32)
    flags[0, :len(bits)] = bits
    path = write_layers(tmp_path / 'a.fits', sky, {'TELESCOP': telescope},
                        {'DQ': flags})
    found = [bit for bit, masked in zip(bits, read_image(path).mask[0],
                                        strict=False) if masked]
    known = [bit for bit in bits if bit in bad]
    assert found == (known if telescope != 'HST' else [1, 2, 4, 256, 8192])


def test_variances_and_weights_become_errors(tmp_path, sky):
    for name, values in (('VAR', 49.0), ('IVAR', 1 / 49)):
        path = write_layers(tmp_path / f'{name}.fits', sky,
                            layers={name: np.full(SHAPE, values)})
        assert_allclose(read_image(path).noise.total, 7)


def test_of_several_images_one_must_be_chosen(tmp_path, sky):
    path = tmp_path / 'two.fits'
    hdus = [fits.PrimaryHDU()]
    for version in (1, 2):
        hdus += [fits.ImageHDU(sky + version, name='SCI', ver=version),
                 fits.ImageHDU(np.full(SHAPE, version, np.float32),
                               name='ERR', ver=version)]
    fits.HDUList(hdus).writeto(path)
    with pytest.raises(ValueError, match=r'--ext.*2: SCI,1, SCI,2'):
        read_image(path)
    second = read_image(path, Reading(ext='SCI,2'))
    assert_allclose(second.data, sky + 2)
    assert second.noise.total[0, 0] == 2
    assert_allclose(read_image(path, Reading(ext='1')).data, sky + 1)
    for wrong in ('7', 'SCI,3', 'nonsense', '0'):
        with pytest.raises(ValueError, match=rf'two\.fits.*got {wrong}$'):
            read_image(path, Reading(ext=wrong))


def test_compressed_images_are_read(tmp_path, sky):
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(
        sky, header(GAIN=1.0), compression_type='RICE_1',
        quantize_level=256)])
    hdus.writeto(tmp_path / 'a.fits.fz')
    image = read_image(tmp_path / 'a.fits.fz')
    assert_allclose(image.data, sky, atol=0.1)
    assert image.electrons == 1
    fits.PrimaryHDU(sky).writeto(tmp_path / 'b.fits.gz')
    fits.PrimaryHDU(np.eye(*SHAPE, dtype=np.int16)).writeto(
        tmp_path / 'b_flg.fits.gz')
    assert read_image(tmp_path / 'b.fits.gz').mask.sum() == min(SHAPE)


def test_companions_are_found_by_their_names(tmp_path, sky):
    flags = np.zeros(SHAPE, np.int16)
    flags[1, 2] = 4
    fits.PrimaryHDU(sky, header(BUNIT='electron/s')).writeto(
        tmp_path / 'chip_img.fits')
    fits.PrimaryHDU(flags).writeto(tmp_path / 'chip_flg.fits')
    weight = np.full(SHAPE, 0.25, np.float32)
    weight[3, 4] = 0
    fits.PrimaryHDU(weight).writeto(tmp_path / 'chip_wht.fits')
    image = read_image(tmp_path / 'chip_img.fits')
    assert set(map(tuple, np.argwhere(image.mask))) == {(1, 2), (3, 4)}
    assert image.noise.total[0, 0] == 2
    assert 'chip_wht.fits' in image.describe()
    fits.PrimaryHDU(np.full(SHAPE, 3.0)).writeto(tmp_path / 'other.fits')
    named = read_image(image.path, Reading(error=tmp_path / 'other.fits'))
    assert named.noise.total[0, 0] == 3


def test_a_companion_of_another_shape_is_an_error(tmp_path, sky):
    fits.PrimaryHDU(sky).writeto(tmp_path / 'a.fits')
    fits.PrimaryHDU(np.zeros((3, 3))).writeto(tmp_path / 'a_flg.fits')
    with pytest.raises(ValueError, match=r'a_flg\.fits.*\(60, 70\).*\(3, 3'):
        read_image(tmp_path / 'a.fits')


def test_the_gwcs_of_jwst_is_found_in_its_extension(tmp_path, sky, gwcs, tan):
    tree = BytesIO()
    asdf.AsdfFile({'meta': {'wcs': gwcs}}).write_to(tree)
    column = np.frombuffer(tree.getvalue(), np.uint8)
    table = fits.BinTableHDU.from_columns([fits.Column(
        'ASDF_METADATA', f'{column.size}B', array=column[None])], name='ASDF')
    path = tmp_path / 'jwst.fits'
    fits.HDUList([
        fits.PrimaryHDU(header=header(TELESCOP='JWST', EXPMID=61113.5,
                                      TIMESYS='UTC')),
        fits.ImageHDU(sky, header(BUNIT='MJy/sr', **tan), 'SCI'),
        fits.ImageHDU(np.sqrt(sky), name='ERR'),
        fits.ImageHDU(np.zeros(SHAPE, np.uint32), name='DQ'),
        table]).writeto(path)
    image = read_image(path)
    assert image.unit == u.MJy / u.sr
    assert image.time == Time(61113.5, format='mjd', scale='utc')
    assert_allclose(image.wcs(10, 20), gwcs(10, 20))
    assert 'gwcs WCS' in image.describe()


def test_roman_asdf_is_read(tmp_path, sky, gwcs):
    middle = Time('2027-05-06T07:08:09')
    flags = np.zeros(SHAPE, np.uint32)
    flags[1, 1], flags[2, 2] = 1, 4
    path = tmp_path / 'roman.asdf'
    asdf.AsdfFile({'roman': {
        'data': sky / 100, 'err': np.sqrt(sky) / 100, 'dq': flags,
        'meta': {'telescope': 'ROMAN', 'wcs': gwcs,
                 'exposure': {'mid_time': middle, 'exposure_time': 107.0}},
    }}).write_to(path)
    image = read_image(path)
    assert image.unit == u.DN / u.s
    assert abs(image.time - middle) < 1 * u.s
    assert image.mask[1, 1]
    assert image.mask.sum() == 1
    assert_allclose(image.wcs(10, 20), gwcs(10, 20))


def test_a_wcs_file_wins(tmp_path, sky, gwcs, tan):
    fits.PrimaryHDU(sky, header(**tan)).writeto(tmp_path / 'a.fits')
    asdf.AsdfFile({'wcs': gwcs}).write_to(tmp_path / 'wcs.asdf')
    image = read_image(tmp_path / 'a.fits', Reading(
        wcs=tmp_path / 'wcs.asdf'))
    assert_allclose(image.wcs(1, 2), gwcs(1, 2))
    fits.PrimaryHDU(sky).writeto(tmp_path / 'none.fits')
    assert read_image(tmp_path / 'none.fits').wcs is None
    with pytest.raises(ValueError, match=r'none\.fits.*celestial'):
        _ = read_image(tmp_path / 'a.fits', Reading(
            wcs=tmp_path / 'none.fits')).wcs


@pytest.mark.parametrize(('cards', 'expected'), [
    ({'MJD-AVG': 61000.25, 'TIMESYS': 'TDB'},
     Time(61000.25, format='mjd', scale='tdb')),
    ({'EXPSTART': 61000.0, 'EXPEND': 61000.5},
     Time(61000.25, format='mjd')),
    ({'EXPSTART': 61000.0, 'EXPTIME': 8640.0},
     Time(61000.05, format='mjd')),
    ({'MJD-OBS': 61000.0, 'EXPTIME': 8640.0}, Time(61000.05, format='mjd')),
    ({'DATE-OBS': '2026-01-02', 'TIME-OBS': '03:04:05', 'EXPTIME': 10.0},
     Time('2026-01-02T03:04:10')),
    ({'DATE-BEG': '2026-01-02T00:00:00', 'DATE-END': '2026-01-02T02:00:00'},
     Time('2026-01-02T01:00:00')),
    ({'DATE-OBS': '2026-01-02', 'UT': '03:04:05.0'},
     Time('2026-01-02T03:04:05')),
    ({'DATE-OBS': '2026/01/02', 'UTC': '03:04:05'},
     Time('2026-01-02T03:04:05')),
    # Before 1999 FITS wrote days, months and two digits of the year.
    ({'DATE-OBS': '04/03/96', 'UT': ' 5:06:07', 'EXPTIME': '10.0'},
     Time('1996-03-04T05:06:12')),
    ({'DATE-OBS': '04/03/26'}, None),
    ({'DATE-OBS': 'yesterday'}, None), ({}, None)])
def test_the_middle_of_the_exposure_is_found(cards, expected):
    time = Cards(cards).time
    if expected is None:
        assert time is None
    else:
        assert time.scale == expected.scale
        assert abs(time - expected) < 1 * u.ms


@pytest.mark.parametrize(('cards', 'words'), [
    ({'DATE-OBS': '2026-01-02'}, '2026.003 (a date without time of day)'),
    ({'DATE-OBS': '04/03/96'}, '1996.171 (a date without time of day)'),
    ({'DATE-OBS': '2026-01-02T00:00:00'}, '2026.003'),
    ({'DATE-OBS': '2026-01-02', 'UT': '00:00:00'}, '2026.003'),
    ({'DATE-OBS': '2026-01-02', 'MJD-OBS': 61042.0}, '2026.003')])
def test_a_date_without_time_of_day_is_said(tmp_path, sky, cards, words):
    fits.PrimaryHDU(sky, header(**cards)).writeto(tmp_path / 'a.fits')
    assert read_image(tmp_path / 'a.fits').describe().endswith(f'; {words}')


@pytest.mark.parametrize(('value', 'number'), [
    ('1.7', 1.7), (' 2 ', 2.0), ('1.7 e/ADU', None), ('nan', None),
    ('inf', None), ('-3', None), ('1_0', None)])
def test_a_number_written_as_text_is_a_number(value, number):
    assert Cards({'GAIN': value}).gain == number


def eso(word, *values):
    return {f'ESO DET OUT{n} {word}': value
            for n, value in enumerate(values, start=1)}


@pytest.mark.parametrize(('cards', 'gain', 'read_noise'), [
    ({**eso('CONAD', 2.0), **eso('GAIN', 0.5), **eso('RON', 4.5)}, 2.0, 4.5),
    ({**eso('CONAD', 2.9), **eso('GAIN', 0.34), **eso('RON', 0.0)}, 2.9,
     None),
    (eso('GAIN', 0.5, 0.5), 2.0, None),
    ({**eso('CONAD', 2.0, 2.0), **eso('RON', 4.0, 5.0)}, 2.0, None),
    ({**eso('CONAD', 2.0), 'GAIN': 1.5}, 1.5, None)])
def test_the_outputs_of_eso_have_gains(tmp_path, sky, cards, gain,
                                       read_noise):
    path = tmp_path / 'eso.fits'
    fits.PrimaryHDU(sky, fits.Header({f'HIERARCH {key}' if ' ' in key else
                                      key: value for key, value in
                                      cards.items()})).writeto(path)
    image = read_image(path)
    assert image.noise.gain == gain
    assert image.layers.cards.read_noise == read_noise
    said = (f'gain and a read noise of {read_noise:g} e' if read_noise else
            "gain and the sky's scatter")
    assert said in image.describe()
    assert ('read noises (ESO DET OUTn RON): 4, 5)' in image.describe()) == (
        eso('RON', 4.0, 5.0).items() <= cards.items())


@pytest.mark.parametrize(('cards', 'words'), [
    (eso('CONAD', 2.0, 2.1), r'--gain.*different gains .*: 2, 2\.1$'),
    ({**eso('CONAD', 2.0), **eso('GAIN', 2.0)},
     '--gain.*CONAD and GAIN are not the inverse of each other$')])
def test_outputs_without_one_gain_are_told(tmp_path, sky, cards, words):
    path = tmp_path / 'eso.fits'
    fits.PrimaryHDU(sky, fits.Header({f'HIERARCH {key}': value for key, value
                                      in cards.items()})).writeto(path)
    with pytest.raises(ValueError, match=words):
        _ = read_image(path).noise
    assert read_image(path, Reading(gain=1.5)).noise.gain == 1.5


@pytest.mark.parametrize(('kind', 'level', 'cards'), [
    ('u2', 65535, {}), ('i2', 32767, {}), ('u1', 255, {}),
    ('u2', 65535, {'SATURATE': 70000.0})])
def test_full_pixels_of_short_integers_are_saturated(
        tmp_path, sky, kind, level, cards):
    sky = sky.astype(kind)
    fits.writeto(tmp_path / 'none.fits', sky, header(**cards))
    assert read_image(tmp_path / 'none.fits').saturation == cards.get(
        'SATURATE')
    sky[20:22, 30] = level
    fits.writeto(tmp_path / 'full.fits', sky, header(**cards))
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(
        sky, header(**cards))]).writeto(tmp_path / 'full.fits.fz')
    for name in ('full.fits', 'full.fits.fz'):
        image = read_image(tmp_path / name)
        assert image.saturation == level
        assert image.say_saturation() == (
            f'pixels from {level} on are saturated, as the numbers of '
            f'{8 * sky.itemsize} bits in the file say: 2 of them')
    assert read_image(tmp_path / 'full.fits',
                      Reading(saturation=120.0)).saturation == 120
    # What flags have told already needs no level.
    fits.writeto(tmp_path / 'full_mask.fits', (sky == level).astype('u1'))
    assert read_image(tmp_path / 'full.fits').saturation == cards.get(
        'SATURATE')


def test_scaled_integers_are_full_where_their_numbers_are(tmp_path, sky):
    hdu = fits.PrimaryHDU(sky)
    hdu.data[5, 6] = 500.5
    hdu.scale('int16', bscale=0.01, bzero=172.83)
    hdu.writeto(tmp_path / 'a.fits')
    assert_allclose(read_image(tmp_path / 'a.fits').saturation, 500.5)


def test_flat_tops_without_a_level_are_told(tmp_path, sky):
    sky[20:24, 30:32] = 4000
    sky[50, 8] = 4000
    fits.writeto(tmp_path / 'a.fits', sky)
    with pytest.warns(AstropyUserWarning, match=(
            r'a\.fits: 9 pixels share the highest value, 4000, some side by '
            'side; if they are saturated, give --saturation 4000')):
        read_image(tmp_path / 'a.fits')
    read_image(tmp_path / 'a.fits', Reading(saturation=3999.0))
    fits.writeto(tmp_path / 'b.fits', sky, header(SATURATE=4000.0))
    read_image(tmp_path / 'b.fits')


def test_axes_of_length_one_are_no_axes(tmp_path, sky, tan):
    flags = (sky > 120).astype('u1')
    third = {'CTYPE3': 'WAVE', 'CRVAL3': 5e-7, 'CUNIT3': 'm', 'CRPIX3': 1.0,
             'CDELT3': 1e-8}
    write_layers(tmp_path / 'a.fits', sky[None], None,
                 {'ERR': sky[None, None] / 10, 'DQ': flags[None]},
                 {**tan, **third})
    image = read_image(tmp_path / 'a.fits')
    assert_allclose(image.data, sky)
    assert_allclose(image.noise.total, sky / 10)
    assert np.array_equal(image.mask, flags > 0)
    assert image.wcs.naxis == 2
    fits.writeto(tmp_path / 'b.fits', sky, header(**tan))
    fits.writeto(tmp_path / 'b_mask.fits', flags[None])
    assert np.array_equal(read_image(tmp_path / 'b.fits').mask, flags > 0)


@pytest.mark.parametrize('ending', ['.gz', '.bz2', '.xz'])
def test_companions_of_compressed_images_are_found(tmp_path, sky, ending):
    fits.writeto(tmp_path / f'a.fits{ending}', sky)
    fits.writeto(tmp_path / f'a_mask.fits{ending}', (sky > 120).astype('u1'))
    image = read_image(tmp_path / f'a.fits{ending}')
    assert np.array_equal(image.mask, sky > 120)


@pytest.mark.parametrize(('text', 'unit'), [
    ('ELECTRONS/S', u.electron / u.s), ('e-', u.electron),
    ('e-/sec', u.electron / u.s), ('electron s-1', u.electron / u.s),
    ('COUNTS', u.count), ('DN/s', u.DN / u.s), ('ADU', u.adu),
    ('MJy/sr', u.MJy / u.sr), ('widgets', None)])
def test_units_are_read_as_they_are_spelled(text, unit):
    assert parse_unit(text) == unit


def test_electrons_in_a_unit_follow_from_gain_and_time():
    assert electrons_in_unit(u.electron, 7, 100) == 1
    assert electrons_in_unit(u.electron / u.s, None, 100) == 100
    assert electrons_in_unit(u.adu, 2, None) == 2
    assert electrons_in_unit(u.DN / u.s, 2, 100) == 200
    assert electrons_in_unit(u.DN / u.s, 2, None) is None
    assert electrons_in_unit(None, 2, None) == 2
    assert electrons_in_unit(u.MJy / u.sr, 2, 100) is None
    assert electrons_in_unit(u.MJy / u.sr, 2, None, 0.5) is None
    assert electrons_in_unit(u.MJy / u.sr, 2, 100, 0.5) == 400
    assert_allclose(electrons_in_unit(u.Jy / u.sr, 2, 100, 0.5), 4e-4)


def test_the_sky_of_drizzled_images_is_in_the_noise(tmp_path, rng):
    path = tmp_path / 'drz.fits'
    counts = rng.poisson(100, SHAPE) - 98.0
    weight = np.full(SHAPE, 500.0)
    weight[0, 0] = 0
    write_layers(path, counts.astype(np.float32) / 50,
                 {'TELESCOP': 'HST', 'EXPTIME': 50.0, 'NDRIZIM': 4},
                 {'WHT': weight}, {'BUNIT': 'ELECTRONS/S', 'MDRIZSKY': 1.96})
    image = read_image(path, Reading(read_noise=0.1))
    assert image.mask[0, 0]
    assert_allclose(np.median(image.noise.background), 10 / 50, rtol=0.02)


def test_files_that_are_no_images_are_named(tmp_path, sky):
    (tmp_path / 'text.fits').write_text('no image')
    with pytest.raises(ValueError, match=r'text\.fits: must be an undamaged'):
        read_image(tmp_path / 'text.fits')
    with pytest.raises(FileNotFoundError, match='nothing'):
        read_image(tmp_path / 'nothing.fits')
    fits.PrimaryHDU(np.zeros((2, 3, 4))).writeto(tmp_path / 'cube.fits')
    with pytest.raises(ValueError, match=(
            r'cube\.fits: must hold an image of 2 dimensions, got '
            r'one of 4 x 3 x 2 pixels')):
        read_image(tmp_path / 'cube.fits')
    fits.PrimaryHDU(sky).writeto(tmp_path / 'whole.fits')
    damaged = (tmp_path / 'whole.fits').read_bytes()[:9000]
    (tmp_path / 'half.fits').write_bytes(damaged)
    with pytest.raises(ValueError, match=r'half\.fits'):
        read_image(tmp_path / 'half.fits')
    (tmp_path / 'bad.asdf').write_bytes(b'#ASDF 1.0.0\nrubbish: [')
    with pytest.raises(ValueError, match=r'bad\.asdf'):
        read_image(tmp_path / 'bad.asdf')
    fits.PrimaryHDU(sky * np.nan).writeto(tmp_path / 'nan.fits')
    with pytest.raises(ValueError, match=r'nan\.fits.*not bad'):
        read_image(tmp_path / 'nan.fits')
