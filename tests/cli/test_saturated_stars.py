"""The level of saturation on the command line and in headers."""
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main
from photutils_mgauss.cli.psf_stars import choose
from photutils_mgauss.cli.star_image import Reading, read_image

MIXTURE = GaussianMixture([0.7, 0.3], [(0, 0), (0, 0)],
                          [[[0.9, 0.1], [0.1, 0.8]], [[4, 0], [0, 4]]])
X, Y, FULL = 40.3, 51.8, 2e4


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('saturated')
    GriddedMixturePSF([MIXTURE], [(0, 0)]).write(folder / 'psf.fits')
    rng = np.random.default_rng(1)
    light = 50 + sum(MIXTURE.render((100, 100), x, y, flux=flux)
                     for x, y, flux in [(X, Y, 1e6), (70, 20, 3e4),
                                        (20, 80, 2e4)])
    data = np.minimum(rng.poisson(light), FULL)
    header = fits.Header({'SATURATE': FULL, 'GAIN': 1.0})
    fits.writeto(folder / 'header.fits', data, header)
    del header['SATURATE']
    fits.writeto(folder / 'plain.fits', data, header)
    # As 16-bit cameras write it, brighter than its median at the star.
    slope = 400 * (abs(np.arange(100) - 47) < 20)[:, None] * np.ones(100)
    shown = np.minimum(rng.poisson(light[::-1] + slope), 65535)
    fits.writeto(folder / 'slope.fits', shown.astype('u2'), header)
    return folder


@pytest.mark.parametrize(('image', 'options', 'source'), [
    ('header', [], 'the header'),
    ('plain', ['--saturation', '20000'], '--saturation'),
    ('header', ['--crowded'], 'the header')])
def test_a_saturated_star_is_measured_and_said(folder, capsys, image,
                                               options, source):
    name = f'{image}_{len(options)}_{"--crowded" in options}.ecsv'
    output = folder / name
    main(['photometry', str(folder / f'{image}.fits'), '--psf',
          str(folder / 'psf.fits'), '--output', str(output), *options])
    said = capsys.readouterr()
    assert f'pixels from 20000 on are saturated, as {source} says' in (
        said.out + said.err)
    assert 'from their wings' in said.out + said.err
    table = QTable.read(output)
    near = np.hypot(table['x_fit'] - X, table['y_fit'] - Y) < 8
    assert near.sum() == 1 or options == ['--crowded']
    star = table[near][np.argmax(table['flux_fit'][near])]
    assert np.hypot(star['x_fit'] - X, star['y_fit'] - Y) < 0.05
    assert star['flags'] & 65536


def test_a_sky_that_varies_hides_no_full_pixels(folder, capsys):
    image = read_image(folder / 'slope.fits', Reading(sky_box=10))
    full = image.data == 65535
    assert full.sum() >= 4
    assert np.all(image.sky.background[full]
                  > 200 + image.sky.background_median)
    assert np.all(image.without_sky[full] >= image.saturation_without_sky)
    output = folder / 'slope.ecsv'
    main(['photometry', str(folder / 'slope.fits'), '--psf',
          str(folder / 'psf.fits'), '--sky-box', '10', '--output',
          str(output)])
    table = QTable.read(output)
    y = 99 - Y
    star, = table[np.hypot(table['x_fit'] - X, table['y_fit'] - y) < 8]
    assert star['flags'] & 65536
    assert np.hypot(star['x_fit'] - X, star['y_fit'] - y) < 0.05
    assert abs(star['flux_fit'] / 1e6 - 1) < 0.02


def test_saturated_stars_beneath_a_bright_sky_are_not_for_the_psf(folder):
    image = read_image(folder / 'slope.fits', Reading(sky_box=10))
    options = SimpleNamespace(stars=None, min_snr=50, max_stars=100)
    stars = choose(image, 8, options)
    star, = stars[np.hypot(stars['x'] - X, stars['y'] - 99 + Y) < 3]
    assert star['reason'] == 'saturated'


@pytest.mark.parametrize('how', [[], ['--crowded']])
def test_few_stars_leave_no_residual_to_measure(folder, capsys, how):
    output = folder / f'few_{len(how)}.ecsv'
    main(['photometry', str(folder / 'header.fits'), '--psf',
          str(folder / 'psf.fits'), '--output', str(output),
          '--residual-radius', '10', *how])
    said = capsys.readouterr()
    assert 'what the PSF leaves of bright stars was not measured' in (
        said.out + said.err)
    assert output.exists()


def test_images_together_have_no_residual(folder, capsys):
    code = main(['photometry', str(folder / 'header.fits'), '--psf',
                 str(folder / 'psf.fits'), '--crowded', '--together',
                 '--residual-radius', '10', '--output',
                 str(folder / 'together.ecsv')])
    assert code == 1
    assert 'must be given without --residual-radius' in (
        capsys.readouterr().err)
