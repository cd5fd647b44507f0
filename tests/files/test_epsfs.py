"""PSF files of other programs, against what their keywords say."""
import bz2
import gzip
import lzma
import warnings

import numpy as np
import photutils
import pytest
from astropy.io import fits
from astropy.utils import minversion
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GriddedPSFModel, STDPSFGrid
from scipy.special import erf

from photutils_mgauss import GriddedMixturePSF, read_psfex
from photutils_mgauss.files.epsfs import (
    psf_kind,
    read_image_psf,
    read_stdpsf,
    read_stpsf,
)

STEPS = np.arange(-20, 21) / 4


def gaussian(sigma, steps=STEPS):
    """Return the density of a round Gaussian at samples."""
    profile = np.exp(-(steps**2) / 2 / sigma**2)
    return np.outer(profile, profile) / (2 * np.pi * sigma**2)


def write_stpsf(path, places, *, key='DET_YX{}', planes=None, **cards):
    """Write a grid of ePSFs of which image n has the width n + 1."""
    planes = ([gaussian(1 + 0.1 * n) for n in range(len(places))]
              if planes is None else planes)
    hdu = fits.PrimaryHDU(np.array(planes))
    hdu.header['OVERSAMP'] = 4
    # STPSF writes them in order; a reader must not rely on that.
    for n in reversed(range(len(places))):
        hdu.header[key.format(n)] = str(tuple(places[n]))
    hdu.header.update(cards)
    hdu.writeto(path)
    return path


def widths(grid):
    """Return which image stands at which place, as width by (x, y)."""
    peaks = grid.data.max(axis=(1, 2))
    sigmas = np.sqrt(1 / (2 * np.pi * peaks))
    return {tuple(xy): round(float(sigma), 6) for xy, sigma
            in zip(grid.grid_xypos.tolist(), sigmas, strict=True)}


@pytest.mark.parametrize(('key', 'order'), [('DET_YX{}', 1),
                                            ('DET_XY{}', -1)])
def test_the_keyword_of_stpsf_says_which_number_is_y(tmp_path, key, order):
    yx = [(y, x) for y in (0.0, 500.0, 1000.0) for x in (0.0, 70.0, 90.0,
                                                         2000.0)]
    path = write_stpsf(tmp_path / 'a.fits', [pair[::order] for pair in yx],
                       key=key)
    assert psf_kind(path) == 'stpsf'
    grid = read_stpsf(path)
    assert grid.oversampling == 4
    assert widths(grid) == {(x, y): round(1 + 0.1 * n, 6)
                            for n, (y, x) in enumerate(yx)}


@pytest.mark.parametrize('yx', [
    [(y, x) for y in (0.0, 100.0) for x in (0.0, 70.0, 90.0)],
    [(y, x) for x in (0.0, 100.0) for y in (0.0, 100.0)]])
def test_a_grid_of_stpsf_that_photutils_read_stands_right(tmp_path, yx):
    planes = [gaussian(1 + y / 200) for y, _ in yx]
    path = write_stpsf(tmp_path / 'a.fits', yx, planes=planes)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        grid = GriddedPSFModel.read(path, format='webbpsf')
        psf = GriddedMixturePSF.from_gridded_psf(grid, 1)
    said = [str(warning.message) for warning in caught
            if 'exchanges x and y' in str(warning.message)]
    assert len(said) == (0 if minversion(photutils, '3.1') else 1)
    for y, x in yx:
        assert_allclose(psf.mixture_at(x, y).covariances[0, 0, 0],
                        (1 + y / 200)**2, rtol=1e-3)


def test_one_psf_of_stpsf_is_a_grid_of_one_node(tmp_path):
    path = write_stpsf(tmp_path / 'a.fits', [(3.5, 7.0)])
    with fits.open(path, mode='update') as hdus:
        hdus[0].data = hdus[0].data[0]
    grid = read_stpsf(path)
    assert grid.grid_xypos.tolist() == [[7.0, 3.5]]
    assert grid.data.shape == (1, 41, 41)


def test_images_whose_samples_add_up_to_1_have_the_same_flux(tmp_path):
    places = [(0, 0), (0, 9)]
    one = read_stpsf(write_stpsf(tmp_path / 'a.fits', places))
    planes = [gaussian(1 + 0.1 * n) / 16 for n in range(2)]
    two = read_stpsf(write_stpsf(tmp_path / 'b.fits', places, planes=planes))
    assert_allclose(two.data, one.data)


@pytest.mark.parametrize(('cards', 'words'), [
    ({'OVERSAMP': 2.5}, 'OVERSAMP must be a whole number'),
    ({'DET_YX1': '(1, 2, 3)'}, 'DET_YX1 must be a pair of numbers'),
    ({'DET_YX1': '(1, x)'}, 'DET_YX1 must be numbers'),
    ({'DET_YX1': '(1, nan)'}, 'DET_YX1 must be finite'),
    ({'DET_YX1': '(0, 0)'}, 'two PSFs at one place'),
    ({'DET_YX4': '(0, 7)'}, r'numbered from 0, got \[0, 1, 4\]'),
    ({'DET_YX2': '(0, 7)'}, 'tell of 3 images, but the array has the shape'),
    ({'FOVPIXEL': 41}, 'tell of 164 samples, but the images have 41'),
])
def test_keywords_of_stpsf_that_contradict_the_images(tmp_path, cards, words):
    path = write_stpsf(tmp_path / 'a.fits', [(0, 0), (0, 9)], **cards)
    with pytest.raises(ValueError, match=r'a\.fits: must be .*' + words):
        read_stpsf(path)


def pixel_flux(at, sigma, width=1.0):
    """Return the flux of a Gaussian star in squares at places along axes."""
    edges = [erf((at + side * width / 2) / sigma / np.sqrt(2)) / 2
             for side in (-1, 1)]
    profile = edges[1] - edges[0]
    return np.outer(profile, profile)


def write_calc_psf(path, sampling, names=('OVERSAMP', 'DET_SAMP'), side=31):
    """Write a star of sigma 0.5, and of 0.8 where distortion is in."""
    hdus = [fits.PrimaryHDU()]
    for name in names:
        each = sampling if name.startswith('OVER') else 1
        at = (np.arange(side * each) - (side * each - 1) / 2) / each
        sigma = 0.8 if name.endswith('DIST') else 0.5
        hdu = fits.ImageHDU(pixel_flux(at, sigma, 1 / each), name=name)
        hdu.header['OVERSAMP'] = hdu.header['DET_SAMP'] = each
        hdus.append(hdu)
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize('sampling', [1, 2, 3, 4])
@pytest.mark.parametrize(('names', 'sigma'), [
    (('OVERSAMP', 'DET_SAMP'), 0.5),
    (('OVERSAMP', 'DET_SAMP', 'OVERDIST', 'DET_DIST'), 0.8)])
def test_optical_samples_are_added_up_over_pixels(tmp_path, sampling, names,
                                                  sigma):
    path = write_calc_psf(tmp_path / 'a.fits', sampling, names)
    assert psf_kind(path) == 'optical'
    psf = read_image_psf(path)
    ny, _ = psf.data.shape
    at = (np.arange(ny) - psf.origin[0]) / sampling
    assert_allclose(psf.data, pixel_flux(at, sigma), atol=1e-12)
    assert psf.oversampling.tolist() == [sampling, sampling]


def test_any_image_of_calc_psf_can_be_chosen(tmp_path):
    names = ('OVERSAMP', 'DET_SAMP', 'OVERDIST', 'DET_DIST')
    path = write_calc_psf(tmp_path / 'a.fits', 4, names)
    psfs = read_image_psf(path, ext='all')
    assert tuple(psfs) == names
    assert [int(psf.oversampling[0]) for psf in psfs.values()] == [4, 1, 4, 1]
    at = np.arange(31) - 15.0
    assert_allclose(psfs['DET_DIST'].data, pixel_flux(at, 0.8), atol=1e-12)
    for ext in ('OVERSAMP', 'oversamp', 1, '1'):
        assert_array_equal(read_image_psf(path, ext=ext).data,
                           psfs['OVERSAMP'].data)
    with pytest.raises(ValueError, match='tell of 4 samples to a pixel, not '
                       'of the 2 that are given'):
        read_image_psf(path, oversampling=2)


def test_a_star_of_calc_psf_has_the_flux_that_pixels_get(tmp_path):
    path = write_calc_psf(tmp_path / 'a.fits.gz', 4)
    psf = GriddedMixturePSF.from_file(path, 4)
    at = np.arange(-3, 4)
    expected = pixel_flux(at + 0.3, 0.5)
    found = psf.evaluate(at, at[:, None], 1, -0.3, -0.3)
    assert_allclose(found, expected, atol=0.005 * expected.max())


def write_stdpsf(path, x, y, *, text=False, **cards):
    """Write a grid of which image n has the width 1 + n / 100."""
    n = len(x) * len(y)
    hdu = fits.PrimaryHDU(np.array([gaussian(1 + i / 100) for i in range(n)]))
    hdu.header.update(NXPSFS=len(x), NYPSFS=len(y))
    for axis, prefix in ((x, 'IPSFX'), (y, 'JPSFY')):
        if text:
            for letter, part in zip('AB', np.array_split(axis, 2),
                                    strict=True):
                hdu.header[f'{prefix}{letter}5'] = ' '.join(map(str, part))
        else:
            for i, value in enumerate(axis, 1):
                hdu.header[f'{prefix}{i:02d}'] = int(value)
            hdu.header[f'{prefix}{len(axis) + 1:02d}'] = 9999
    hdu.header.update(cards)
    hdu.writeto(path)
    return path


@pytest.mark.parametrize('text', [False, True])
def test_a_stdpsf_grid_counts_pixels_from_1(tmp_path, text):
    path = write_stdpsf(tmp_path / 'a.fits', [0, 500, 1014], [0, 1014],
                        text=text)
    assert psf_kind(path) == 'stdpsf'
    for detector in (None, 1, '1'):
        grid = read_stdpsf(path, detector)
        assert grid.oversampling == 4
        assert widths(grid) == {(-1, -1): 1, (499, -1): 1.01, (1013, -1): 1.02,
                                (-1, 1013): 1.03, (499, 1013): 1.04,
                                (1013, 1013): 1.05}


def test_two_chips_are_one_detector_each(tmp_path):
    path = write_stdpsf(tmp_path / 'a.fits', [0, 4096],
                        [0, 2048, 2048, 4096])
    with pytest.raises(ValueError, match=r'a\.fits: detector .* one of the 2 '
                       r'detectors .* 1 \(x 0 to 4096, y 0 to 2048\), 2 \(x 0 '
                       r"to 4096, y 2048 to 4096\), or 'all', got None"):
        read_stdpsf(path)
    with pytest.raises(ValueError, match='got 3'):
        read_stdpsf(path, 3)
    chips = read_stdpsf(path, 'all')
    assert list(chips) == [1, 2]
    assert widths(chips[1]) == {(-1, -1): 1, (4095, -1): 1.01,
                                (-1, 2047): 1.02, (4095, 2047): 1.03}
    # The upper chip counts its own pixels.
    assert widths(chips[2]) == {(-1, -1): 1.04, (4095, -1): 1.05,
                                (-1, 2047): 1.06, (4095, 2047): 1.07}
    assert_array_equal(read_stdpsf(path, 2).data, chips[2].data)


@pytest.mark.parametrize('y', [[0, 1000, 0, 1000], [0, 1000, 1001, 2001]])
def test_chips_may_begin_anew_or_one_pixel_further(tmp_path, y):
    path = write_stdpsf(tmp_path / 'a.fits', [0, 9], y)
    chips = read_stdpsf(path, 'all')
    assert [len(chip.data) for chip in chips.values()] == [4, 4]
    assert chips[2].grid_xypos[-1].tolist() == [8, 1000 - (y[2] == 0)]


def test_a_plain_grid_of_36_nodes_is_one_detector(tmp_path):
    nodes = [0, 200, 400, 600, 800, 1000]
    grid = read_stdpsf(write_stdpsf(tmp_path / 'a.fits', nodes, nodes))
    assert len(grid.data) == 36


CAMERAS = {
    'WFPC2': ([0, 400, 800, 800, 1200, 1600], [0, 400, 800, 800, 1200, 1600],
              {1: 'PC', 2: 'WF2', 3: 'WF3', 4: 'WF4'}),
    'NIRCam': (np.add.outer(2048 * np.arange(4), np.arange(5) * 512).ravel(),
               np.add.outer(2048 * np.arange(2), np.arange(5) * 512).ravel(),
               dict(enumerate(('A1', 'A2', 'A3', 'A4', 'B1', 'B2', 'B3',
                               'B4'), 1))),
    'UVIS': ([0, 682, 1365, 2048, 2731, 3413, 4096],
             [0, 682, 1365, 2048, 2048, 2731, 3413, 4096],
             {1: '1', 2: '2'}),
}


@pytest.mark.parametrize('camera', CAMERAS)
def test_detectors_are_numbered_as_photutils_does(tmp_path, camera):
    x, y, names = CAMERAS[camera]
    path = write_stdpsf(tmp_path / 'a.fits', x, y, text=camera == 'NIRCam')
    if camera == 'NIRCam':
        # Photutils knows the names of the keywords of that file alone.
        with fits.open(path, mode='update') as hdus:
            header = hdus[0].header
            words = f'{header["IPSFXA5"]} {header["IPSFXB5"]}'.split()
            for i, letter in enumerate('ABCD'):
                header[f'IPSFX{letter}5'] = ' '.join(words[5 * i:5 * i + 5])
    chips = read_stdpsf(path, 'all')
    assert list(chips) == list(names)
    for number, name in names.items():
        peer = GriddedPSFModel.read(path, format='stdpsf',
                                    detector_id=number)
        ours = chips[number]
        order = np.lexsort(ours.grid_xypos.T)
        assert_array_equal(ours.grid_xypos[order], peer.grid_xypos)
        assert_array_equal(ours.data[order], peer.data)
        assert_array_equal(read_stdpsf(path, name).data, ours.data)


@pytest.mark.filterwarnings('ignore')  # photutils' reader has several
def test_the_library_of_a_real_camera_is_that_of_photutils(realdata):
    path = realdata('hst_wfc3uvis_f814w') / 'PSFSTD_WFC3UV_F814W.fits'
    for number, chip in read_stdpsf(path, 'all').items():
        peer = GriddedPSFModel.read(path, format='stdpsf',
                                    detector_id=number)
        order = np.lexsort(chip.grid_xypos.T)
        assert_array_equal(chip.grid_xypos[order], peer.grid_xypos)
        assert_array_equal(chip.data[order], peer.data)
    path = realdata('hst_wfc3ir_f110w') / 'PSFSTD_WFC3IR_F110W.fits'
    grid, peer = read_stdpsf(path), STDPSFGrid(path)
    assert_array_equal(grid.data, peer.data)
    assert_array_equal(grid.grid_xypos, peer.grid_xypos)


@pytest.mark.parametrize(('cards', 'words'), [
    ({'NXPSFS': 3}, 'tell of 6 images'),
    ({'NXPSFS': 10**9}, 'NXPSFS must be a whole number from 1 to'),
    ({'NXPSFS': 'two'}, "NXPSFS must be a number, got 'two'"),
    ({'IPSFX02': 'x'}, 'IPSFX02 must be a number'),
])
def test_keywords_of_stdpsf_that_contradict_the_images(tmp_path, cards,
                                                       words):
    path = write_stdpsf(tmp_path / 'a.fits', [0, 9], [0, 9], **cards)
    with pytest.raises(ValueError, match=r'a\.fits: must be .*' + words):
        read_stdpsf(path)


def write_thirds(path, **cards):
    """Write three ePSFs of a detector, with their errors."""
    hdus = [fits.PrimaryHDU()]
    for i in range(3):
        hdus.append(fits.ImageHDU(gaussian(1 + i / 2), name=f'EPSF{i}'))
        hdus.append(fits.ImageHDU(np.ones((41, 41)), name='ERR'))
    hdus[0].header.update(cards)
    fits.HDUList(hdus).writeto(path)
    return path


def test_one_of_several_epsfs_is_chosen(tmp_path):
    path = write_thirds(tmp_path / 'a.fits', OVERSAMP=4)
    with pytest.raises(ValueError, match=r'a\.fits: ext .* one of the 3 PSFs '
                       r"in this file, EPSF0, EPSF1, EPSF2, or 'all', got "
                       'None'):
        GriddedMixturePSF.from_file(path, 1)
    with pytest.raises(ValueError, match=r'EPSF0, EPSF1, EPSF2, .* got ERR'):
        GriddedMixturePSF.from_file(path, 1, ext='ERR')
    psfs = GriddedMixturePSF.from_file(path, 1, ext='all')
    assert list(psfs) == ['EPSF0', 'EPSF1', 'EPSF2']
    found = [psf.mixtures[0].covariances[0, 0, 0] for psf in psfs.values()]
    assert_allclose(found, [1, 2.25, 4], rtol=1e-3)
    for ext in ('EPSF2', 'epsf2', 5, ('EPSF2', 1), 'EPSF2,1'):
        psf = GriddedMixturePSF.from_file(path, 1, ext=ext)
        assert_allclose(psf.mixtures[0].covariances[0, 0, 0], 4, rtol=1e-3)


def write_chips(path, names=('PSF_DATA', 'PSF_DATA'), versions=(None, None)):
    """Write two constant PSFEx models, one twice the other."""
    hdus = [fits.PrimaryHDU()]
    for i, (name, version) in enumerate(zip(names, versions, strict=True), 1):
        column = fits.Column('PSF_MASK', '25E', dim='(5,5,1)',
                             array=np.full((1, 1, 5, 5), i, 'f4'))
        hdu = fits.BinTableHDU.from_columns([column], name=name, ver=version)
        hdu.header.update(POLNAXIS=0, POLNGRP=0, PSF_SAMP=1.0, PSFNAXIS=3,
                          PSFAXIS1=5, PSFAXIS2=5, PSFAXIS3=1)
        hdus.append(hdu)
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize(('names', 'versions', 'keys'), [
    (('PSF_DATA', 'PSF_DATA'), (None, None), [1, 2]),
    (('PSF_DATA', 'PSF_DATA'), (1, 2), ['PSF_DATA,1', 'PSF_DATA,2']),
    (('CCD_A', 'CCD_B'), (None, None), ['CCD_A', 'CCD_B'])])
def test_one_of_several_psfex_models_is_chosen(tmp_path, names, versions,
                                               keys):
    path = write_chips(tmp_path / 'a.psf', names, versions)
    words = ', '.join(f'{key} (PSF_DATA)' if isinstance(key, int) else key
                      for key in keys)
    for ext in (None, 'PSF_DATA', 3):
        with pytest.raises(ValueError, match='must be one of the 2 PSFs') as e:
            read_psfex(path, ext=ext)
        assert f'{words}, or' in str(e.value)
    models = read_psfex(path, ext='all')
    assert list(models) == keys
    for number, (key, model) in enumerate(models.items(), 1):
        assert model.planes[0, 0, 0] == number
        assert read_psfex(path, ext=key).planes[0, 0, 0] == number
        assert read_psfex(path, ext=number).planes[0, 0, 0] == number


def test_grids_of_all_psfex_models_in_a_file(tmp_path):
    path = tmp_path / 'a.psf'
    hdus = [fits.PrimaryHDU()]
    for sigma in (1, 2):
        image = gaussian(sigma, np.arange(-20, 21.0))
        hdu = fits.BinTableHDU.from_columns([fits.Column(
            'PSF_MASK', '1681E', dim='(41,41,1)', array=image[None, None])])
        hdu.header.update(POLNAXIS=0, PSF_SAMP=1.0, PSFNAXIS=2, PSFAXIS1=41,
                          PSFAXIS2=41)
        hdus.append(hdu)
    fits.HDUList(hdus).writeto(path)
    psfs = GriddedMixturePSF.from_psfex(path, 1, ext='all')
    assert list(psfs) == [1, 2]
    for sigma, psf in psfs.items():
        again = GriddedMixturePSF.from_file(path, 1, ext=sigma)
        for one in (psf, again):
            assert_allclose(one.mixtures[0].covariances[0, 0, 0], sigma**2,
                            rtol=1e-5)


@pytest.mark.parametrize(('pack', 'suffix'), [
    (gzip.compress, '.gz'), (bz2.compress, '.bz2'), (lzma.compress, '.xz')])
def test_compressed_files_are_read_as_plain_ones(tmp_path, pack, suffix):
    paths = {'psfex': write_chips(tmp_path / 'a.psf'),
             'stdpsf': write_stdpsf(tmp_path / 'b.fits', [0, 9], [0, 9]),
             'stpsf': write_stpsf(tmp_path / 'c.fits', [(0, 0), (0, 9)]),
             'epsf': write_thirds(tmp_path / 'd.fits', OVERSAMP=4)}
    for kind, path in paths.items():
        packed = path.with_name(path.name + suffix)
        packed.write_bytes(pack(path.read_bytes()))
        assert psf_kind(path) == psf_kind(packed) == kind
    assert_array_equal(
        read_psfex(tmp_path / f'a.psf{suffix}', ext=2).planes,
        read_psfex(tmp_path / 'a.psf', ext=2).planes)
    assert_array_equal(read_stdpsf(tmp_path / f'b.fits{suffix}').data,
                       read_stdpsf(tmp_path / 'b.fits').data)


def test_what_is_no_psf_and_choices_that_there_are_not(tmp_path):
    image = tmp_path / 'image.fits'
    fits.PrimaryHDU(np.ones((9, 9))).writeto(image)
    with pytest.raises(ValueError, match=r'image\.fits: must hold a PSF.*'
                       '--oversampling'):
        GriddedMixturePSF.from_file(image)
    (tmp_path / 'a.txt').write_text('hello')
    with pytest.raises(ValueError, match=r'a\.txt: must hold a PSF'):
        GriddedMixturePSF.from_file(tmp_path / 'a.txt')
    with pytest.raises(OSError, match='missing'):
        GriddedMixturePSF.from_file(tmp_path / 'missing.fits')
    chips = write_chips(tmp_path / 'a.psf')
    with pytest.raises(ValueError, match=r'detector .* must not be given'):
        GriddedMixturePSF.from_file(chips, detector=1)
    grid = write_stdpsf(tmp_path / 'b.fits', [0, 9], [0, 9])
    with pytest.raises(ValueError, match=r'ext .* must not be given'):
        GriddedMixturePSF.from_file(grid, ext=1)


@pytest.mark.parametrize('name', ['a.fits', 'a.asdf', 'a.fits.gz'])
def test_files_of_this_package_are_grids_too(tmp_path, name):
    path = write_thirds(tmp_path / 'b.fits', OVERSAMP=4)
    psf = GriddedMixturePSF.from_file(path, 1, ext=1)
    psf.write(tmp_path / name)
    again = GriddedMixturePSF.from_file(tmp_path / name)
    assert_array_equal(again.grid.covariances, psf.grid.covariances)
    psf.mixtures[0].write(tmp_path / f'mixture_{name}')
    again = GriddedMixturePSF.from_file(tmp_path / f'mixture_{name}')
    assert_array_equal(again.grid.covariances, psf.grid.covariances)
