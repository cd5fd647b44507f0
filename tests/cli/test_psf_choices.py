"""``mgauss psf`` on files with several PSFs."""
import gzip
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main
from photutils_mgauss.cli.psf_stars import check_nodes

STEPS = np.arange(-20, 21) / 4


def gaussian(sigma):
    profile = np.exp(-(STEPS**2) / 2 / sigma**2)
    return np.outer(profile, profile) / (2 * np.pi * sigma**2)


def write_epsfs(path):
    hdus = [fits.ImageHDU(gaussian(sigma), name=f'EPSF{i}')
            for i, sigma in enumerate((1, 2))]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path)


def write_stdpsf(path):
    sigmas = np.repeat([1, 2], 4)
    hdu = fits.PrimaryHDU(np.array([gaussian(sigma) for sigma in sigmas]))
    hdu.header.update(NXPSFS=2, NYPSFS=4, IPSFX01=0, IPSFX02=40, JPSFY01=0,
                      JPSFY02=20, JPSFY03=20, JPSFY04=40)
    hdu.writeto(path)


def write_psfex(path):
    hdus = [fits.PrimaryHDU()]
    for sigma in (1, 2):
        hdu = fits.BinTableHDU.from_columns([fits.Column(
            'PSF_MASK', '1681E', dim='(41,41,1)',
            array=gaussian(sigma)[None, None])], name='PSF_DATA')
        hdu.header.update(POLNAXIS=0, PSF_SAMP=0.25, PSFNAXIS=2, PSFAXIS1=41,
                          PSFAXIS2=41)
        hdus.append(hdu)
    plain = path.with_suffix('')
    fits.HDUList(hdus).writeto(plain)
    path.write_bytes(gzip.compress(plain.read_bytes()))
    plain.unlink()


FILES = {
    'epsfs.fits': (write_epsfs, ['--oversampling', '4'], '--ext', 'EPSF1',
                   'EPSF0, EPSF1'),
    'stdpsf.fits': (write_stdpsf, [], '--detector', '2',
                    'x 0 to 40, y 20 to 40'),
    'chips.psf.gz': (write_psfex, [], '--ext', '2',
                     '1 (PSF_DATA), 2 (PSF_DATA)')}


@pytest.mark.parametrize('name', FILES)
def test_one_psf_of_several_is_chosen(tmp_path, capsys, name):
    write, options, choice, value, words = FILES[name]
    write(tmp_path / name)
    out = tmp_path / 'out.fits'
    command = ['psf', str(tmp_path / name), '--n-components', '1', '--quiet',
               '--output', str(out), *options]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert words in said
    assert choice in said
    assert main([*command, choice, 'all']) == 1
    assert 'must name one PSF, got all' in capsys.readouterr().err
    assert not out.exists()
    assert main([*command, choice, value]) == 0
    psf = GriddedMixturePSF.read(out)
    np.testing.assert_allclose(psf.mixtures[0].covariances[0, 0, 0], 4,
                               rtol=0.01)


def test_a_choice_that_there_is_not_is_refused(tmp_path, capsys):
    write_stdpsf(tmp_path / 'a.fits')
    assert main(['psf', str(tmp_path / 'a.fits'), '--quiet', '--output',
                 str(tmp_path / 'out.fits'), '--detector', '3']) == 1
    assert 'got 3' in capsys.readouterr().err


@pytest.mark.parametrize(('widest', 'warns'), [(2.0, False), (30.0, True)])
def test_nodes_that_no_star_tells_are_warned_of(widest, warns):
    mixtures = [GaussianMixture([1], [[0, 0]], [np.eye(2) * variance])
                for variance in (2.0, 2.0, 2.0, widest)]
    grid = GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])
    stars = QTable({'x': [3.0, 90.0, 7.0], 'y': [5.0, 8.0, 90.0]})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        check_nodes('a.fits', grid, stars)
    assert [str(one.message).partition(' the ')[0] for one in caught] == (
        ['a.fits: in 1 of 4 nodes'] if warns else [])
    if warns:
        assert '1 to 3.9 times as wide' in str(caught[0].message)
