"""How an exposure compares with the others of its field, and its page."""
import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main
from photutils_mgauss.cli.exposure_quality import FieldOfExposures, judge
from photutils_mgauss.cli.psf_files import psf_record, read_psf
from photutils_mgauss.cli.seen_image import seen_image

SIDE, MISSING, TWICE = 11, 20, 4 * 2 * np.log(2)


@pytest.fixture
def field(tmp_path):
    """
    Write what motions leave of three exposures of a square of stars.

    Exposure b lacks some of them, and its references scatter twice as much
    as they should.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(
        float(SIDE))]))
    ids = np.arange(x.size)
    inside = np.flatnonzero((x > 0) & (x < SIDE - 1) & (y > 0)
                            & (y < SIDE - 1))
    rows = []
    for epoch in range(3):
        seen = np.isin(ids, inside[:MISSING] if epoch == 1 else [],
                       invert=True)
        chi2 = np.full(seen.sum(), TWICE if epoch == 1 else 2 * np.log(2))
        rows.append({'epoch': np.full(seen.sum(), epoch), 'id': ids[seen],
                     'x': x[seen] * u.pix, 'y': y[seen] * u.pix,
                     'chi2': chi2, 'used': chi2 < TWICE,
                     'dra': np.sqrt(chi2 / 2) * u.pix,
                     'ddec': -np.sqrt(chi2 / 2) * u.pix,
                     'dra_error': np.ones(len(chi2)) * u.pix,
                     'ddec_error': np.ones(len(chi2)) * u.pix})
    residuals = QTable({name: np.concatenate([one[name] for one in rows])
                        for name in rows[0]})
    stars = QTable({'id': ids, 'reference': np.where(ids < 40, 'qso', '')})
    alignment = QTable({'epoch': np.arange(3), 'systematic':
                        [[0, 0], [3, 4], [0, 0]] * u.mas})
    for name, table in (('motions', stars), ('residuals', residuals),
                        ('alignment', alignment)):
        table.meta['mgauss'] = {'pieces': {'a': [0, None], 'b': [1, None],
                                           'c': [2, None]}}
        table.write(tmp_path / f'{name}.ecsv')
    return tmp_path


def test_figures_of_exposures_are_what_the_tables_say(field):
    found = FieldOfExposures(field).figures()
    # The four corners are there by definition.
    n = SIDE**2 - 4
    assert_allclose([found[name]['completeness'] for name in 'abc'],
                    [1, (n - MISSING) / n, 1])
    # Half of the chi-squares of two degrees of freedom are below 2 ln 2.
    assert_allclose([found[name]['pulls of references'] for name in 'abc'],
                    [1, 2, 1])
    assert found['b']['references rejected'] == 1
    assert_allclose(found['b']['systematic error'], np.sqrt(12.5))


def test_a_folder_without_motions_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match='tables of mgauss motions'):
        FieldOfExposures(tmp_path)


def test_what_is_unusual_among_exposures_of_a_camera_is_said():
    rows = [{'FWHM [pix]': 2 + 0.01 * k, 'completeness': 0.97}
            for k in range(6)]
    rows[3] = {'FWHM [pix]': 4.0, 'completeness': 0.5}
    wide = [{'FWHM [pix]': 4.0, 'completeness': 0.97} for _ in range(6)]
    found = judge(rows + wide, ['narrow'] * 6 + ['wide'] * 6)
    assert [bool(words) for words, _ in found] == [k == 3 for k in range(12)]
    assert 'FWHM [pix] is 4, usually 2.03' in found[3][0]
    assert 'completeness is 0.5, usually 0.97' in found[3][0]
    # Small PSFs are no fault, and three are too few to compare.
    rows[3] = {'FWHM [pix]': 1.0, 'completeness': 1.0}
    assert not any(words for words, _ in judge(rows, ['narrow'] * 6))
    rows[3] = {'FWHM [pix]': 4.0}
    assert not any(words for words, _ in judge(rows[1:4], ['narrow'] * 3))


ARCHIVE = GaussianMixture([0.8, 0.2], [[0, 0], [0, 0]],
                          [0.9 * np.eye(2), 3.7 * np.eye(2)])
MIXTURE = ARCHIVE.convolve(0.3 * np.eye(2))


def write_image(folder, shape, n, psf=MIXTURE):
    """Write an image of n stars; return where they are, and how bright."""
    rng = np.random.default_rng(1)
    side = int(np.ceil(np.sqrt(n)))
    steps = (np.arange(side) + 0.5) / side
    x, y = (axis.ravel()[:n] * size + rng.uniform(-2, 2, n)
            for axis, size in zip(np.meshgrid(steps, steps), shape[::-1],
                                  strict=True))
    flux = np.full(n, 2e4)
    data = np.full(shape, 100.0)
    yy, xx = np.mgrid[-20:21, -20:21]
    for x0, y0, f0 in zip(x, y, flux, strict=True):
        i, j = round(x0), round(y0)
        cut = (slice(max(j - 20, 0), j + 21), slice(max(i - 20, 0), i + 21))
        rows, columns = (slice(max(20 - k, 0), None) for k in (j, i))
        stamp = f0 * psf.evaluate(xx + i - x0, yy + j - y0)[rows, columns]
        ny, nx = data[cut].shape
        data[cut] += stamp[:ny, :nx]
    header = fits.Header({'BUNIT': 'electron'})
    fits.writeto(folder / 'image.fits', rng.poisson(data).astype('f4'),
                 header)
    return x, y, flux


def test_an_archive_is_tuned_to_the_stars_of_an_image(tmp_path, capsys):
    write_image(tmp_path, (180, 180), 25)
    GriddedMixturePSF([ARCHIVE], [[0, 0]]).write(tmp_path / 'archive.fits')
    image, output = (str(tmp_path / name) for name in ('image.fits',
                                                       'tuned.fits'))
    words = ['psf', image, '--output', output, '--start',
             str(tmp_path / 'archive.fits')]
    assert main([*words, '--n-components', '3']) == 1
    assert '--n-components must be left out' in capsys.readouterr().err
    assert main([*words, '--together']) == 1
    assert 'must be given without --start' in capsys.readouterr().err
    assert main([*words, '--degree', '0', '--grid-shape', '1', '1']) == 0, (
        capsys.readouterr().err)
    tuned = read_psf(output).mixtures[0]
    x, y = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    truth = MIXTURE.evaluate(x, y)
    off, before = (np.abs(one.evaluate(x, y) - truth).max() / truth.max()
                   for one in (tuned, ARCHIVE))
    assert off < 0.02 < 0.1 < before
    assert psf_record(output)['options']['start'].endswith('archive.fits')
    assert main(['psf', str(tmp_path / 'archive.fits'), '--output', output,
                 '--overwrite', '--start',
                 str(tmp_path / 'archive.fits')]) == 1
    assert 'must be an image of stars' in capsys.readouterr().err


def test_of_a_large_image_the_middle_is_shown(tmp_path):
    x, y, flux = write_image(tmp_path, (860, 900), 64)
    nodes = [[0, 0], [899, 0], [0, 859], [899, 859]]
    GriddedMixturePSF([MIXTURE] * 4, nodes).write(tmp_path / 'psf.fits')
    table = QTable({'x_fit': x, 'y_fit': y, 'flux_fit': flux})
    seen = seen_image(tmp_path / 'cat.ecsv', table, {
        'exposure': {'image': 'image.fits'}, 'psf': 'psf.fits'})
    assert not seen.whole
    assert seen.corner == (50, 30)
    assert seen.data.shape == seen.residual.shape == (800, 800)
    assert seen.data.max() > 40 * np.median(seen.error)
    assert_allclose(np.std(seen.residual / seen.error), 1, atol=0.05)


def test_a_page_says_how_an_exposure_fits_into_its_field(field, capsys):
    pytest.importorskip('matplotlib')
    stars = QTable({'id': [1], 'x_fit': [1.0], 'y_fit': [1.0],
                    'x_err': [0.1], 'y_err': [0.1], 'flux_fit': [1.0],
                    'flags': [0]})
    for name in ('b', 'other'):
        stars.write(field / f'{name}.ecsv')
    output = str(field / 'page.html')
    words = ['--field', str(field), '--output', output]
    assert main(['report', str(field / 'other.ecsv'), *words]) == 1
    assert 'of the catalogues given, but its exposures are a, b, c' in (
        capsys.readouterr().err)
    assert main(['report', str(field / 'b.ecsv'), *words]) == 0
    page = (field / 'page.html').read_text()
    assert 'b in its field' in page
    assert 'scatter 2.00 times' in page
    assert '<td>Completeness</td><td>0.829</td>' in page
    assert 'Systematic error [pix]' in page
