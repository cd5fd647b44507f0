"""Files of several chips, and options of the solution, on the command line."""
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.time import Time
from numpy.testing import assert_allclose

from helpers.camera import YEAR, chip_wcs, expose, known_stars, make_field
from photutils_mgauss import GaussianMixture, ProperMotionFitter
from photutils_mgauss.cli import main
from photutils_mgauss.files.image_layers import read_wcs

YEARS = (2010.0, 2016.5, 2020.0)
SIZE = 120


def mef(path, planes, year):
    """Write a file of chips, each (data, error, WCS)."""
    hdus = [fits.PrimaryHDU()]
    hdus[0].header['MJD-AVG'] = Time(year, format='jyear', scale='utc').mjd
    for k, (data, error, wcs) in enumerate(planes, start=1):
        hdus += [fits.ImageHDU(data, wcs.to_header(), name='SCI', ver=k),
                 fits.ImageHDU(error, name='ERR', ver=k)]
    fits.HDUList(hdus).writeto(path)
    return str(path)


@pytest.fixture(scope='module')
def camera(tmp_path_factory):
    """Write catalogues of a camera; return them, references, the field."""
    folder, rng = tmp_path_factory.mktemp('camera'), np.random.default_rng(5)
    field = make_field(rng, columns=2, rows=1, per_chip=150)
    blank, catalogues, epochs = np.ones((8, 8)), [], []
    for number, year in enumerate(YEARS):
        epoch = expose(field, rng, year)
        epochs.append(epoch)
        image = mef(folder / f'night{number}.fits',
                    [(blank, blank, wcs) for wcs in epoch.chips.values()],
                    year)
        for k in epoch.chips:
            table = epoch.table[epoch.table['chip'] == k]
            table.remove_column('chip')
            table.meta['mgauss'] = {'exposure': {
                'image': image, 'ext': f'SCI,{k + 1}', 'wcs': None,
                'time': year}}
            catalogues.append(folder / f'night{number}_{k}_cat.ecsv')
            table.write(catalogues[-1])
    references = known_stars(field, rng, 60)
    references['class'] = 'star'
    references.write(folder / 'known.ecsv')
    return folder, [str(path) for path in catalogues], field, epochs


def test_catalogues_of_one_file_are_one_exposure(camera, capsys):
    folder, catalogues, field, epochs = camera
    assert main(['motions', *catalogues, '--chips', '--distortion', 'poly-3',
                 '--references', str(folder / 'known.ecsv'),
                 '--output', str(folder / 'out')]) == 0
    said = capsys.readouterr().out
    assert said.count('2 chips') == len(YEARS)
    alignment = QTable.read(folder / 'out' / 'alignment.ecsv')
    assert len(alignment) == len(YEARS)
    # The distortions of 5 pixels are gone: nothing systematic is left.
    assert (alignment['systematic'].value == 0).all()
    stars = QTable.read(folder / 'out' / 'motions.ecsv')
    expected = ProperMotionFitter(
        distortion='poly-3', references=known_stars(
            field, np.random.default_rng(0), 60)).fit(epochs).stars
    solved = np.isfinite(stars['pmra'].value)
    assert solved.sum() > 0.9 * np.isfinite(expected['pmra'].value).sum()
    numbers = np.asarray([int(name) for name in _near(stars, field)])
    away = stars['pmra'].value - field.pm[0, numbers]
    pull = (away / stars['pmra_error'].value)[solved]
    assert 0.85 < np.sqrt(np.mean(pull**2)) < 1.15
    assert stars.meta['mgauss']['exposures'] == [
        f'night{number}.fits' for number in range(len(YEARS))]
    for path in catalogues:
        name = path.rpartition('/')[2].removesuffix('_cat.ecsv')
        assert (folder / 'out' / f'{name}_wcs.fits').is_file()


@pytest.mark.long
def test_the_report_shows_each_chip_and_the_references(camera, tmp_path,
                                                       monkeypatch):
    pytest.importorskip('matplotlib')
    folder, catalogues, _, _ = camera
    monkeypatch.chdir(tmp_path)
    assert main(['motions', *catalogues, '--chips', '--distortion', 'poly-3',
                 '--references', str(folder / 'known.ecsv'),
                 '--output', 'out']) == 0
    assert main(['report', 'out', '--output', 'page.html']) == 0
    page = (tmp_path / 'page.html').read_text(encoding='utf-8')
    for chip in ('SCI,1', 'SCI,2'):
        assert f'Mean residuals of all exposures over chip {chip}' in page
    for number in range(len(YEARS)):
        assert f'Residuals of night{number}.fits' in page
    assert 'minus those of the catalogue' in page
    stars = QTable.read('out/motions.ecsv')
    known = np.isfinite(stars['dpmra'].value)
    assert 40 < known.sum() <= 60
    assert (stars['reference'][known] == 'star').all()
    pull = (stars['dpmra'] / stars['dpmra_error'])[known]
    assert 0.7 < np.sqrt(np.mean(pull**2)) < 1.3
    residuals = QTable.read('out/residuals.ecsv')
    assert set(residuals['chip']) == {'SCI,1', 'SCI,2'}
    judged = np.isfinite(residuals['dra'].value)
    assert judged.mean() > 0.9
    assert np.isfinite(residuals['dx_pix'].value[judged]).all()


def _near(stars, field):
    """Return the number of the star of the field at each place."""
    ra, dec = (stars[name].value for name in ('ra', 'dec'))
    known = np.isfinite(ra)
    out = np.zeros(len(stars), int)
    out[known] = [np.argmin(np.hypot(field.ra - one, field.dec - other))
                  for one, other in zip(ra[known], dec[known], strict=True)]
    return out


@pytest.mark.parametrize(('words', 'sentence'), [
    (['--distortion', 'poly-2'], '--distortion must be given with --chips'),
    (['--chips', '--plane'], '--chips must be given without --plane'),
])
def test_options_that_do_not_go_together_are_refused(camera, capsys, words,
                                                     sentence):
    folder, catalogues, _, _ = camera
    assert main(['motions', *catalogues, *words, '--output',
                 str(folder / 'none')]) == 1
    assert sentence in capsys.readouterr().err
    assert not (folder / 'none').exists()


def test_two_catalogues_of_one_chip_are_refused(camera, tmp_path, capsys):
    _, catalogues, _, _ = camera
    table = Table.read(catalogues[0])
    table.write(tmp_path / 'again.ecsv')
    assert main(['motions', *catalogues, str(tmp_path / 'again.ecsv'),
                 '--chips', '--output', str(tmp_path / 'out')]) == 1
    assert 'must be different extensions' in capsys.readouterr().err


def test_catalogues_that_know_no_image_are_refused(camera, tmp_path, capsys):
    _, catalogues, _, _ = camera
    table = Table.read(catalogues[0])
    del table.meta['mgauss']
    table.write(tmp_path / 'bare.ecsv')
    assert main(['motions', *catalogues, str(tmp_path / 'bare.ecsv'),
                 '--time', '2012', '--chips', '--output',
                 str(tmp_path / 'out')]) == 1
    assert 'which knows its image' in capsys.readouterr().err


@pytest.mark.long
def test_images_of_several_chips_become_motions(tmp_path, capsys):
    rng = np.random.default_rng(8)
    field = make_field(rng, columns=2, rows=1, per_chip=1, size=0.0)
    psf = GaussianMixture.from_stddevs([1.0], [(0, 0)], [(1.1, 1.2)])
    places = [np.stack(np.meshgrid([20, 50, 80, 105], [18, 45, 75, 100]))
              .reshape(2, -1) + rng.uniform(-4, 4, (2, 16)) for _ in 'ab']
    motion = rng.normal(0, 0.05, (2, 2, 16))  # pix / yr
    images = []
    for number, year in enumerate(YEARS):
        planes = []
        for k in range(2):
            x, y = places[k] + motion[k] * (year - YEAR)
            light = 100 + sum(psf.render((SIZE, SIZE), *at, flux=4e4)
                              for at in zip(x, y, strict=True))
            planes.append((rng.normal(light, np.sqrt(light)), np.sqrt(light),
                           chip_wcs(field, k, 150.0, 0.0, 0.0)))
        images.append(mef(tmp_path / f'n{number}.fits', planes, year))
    words = ['motions', *images, '--chips', '--n-components', '1', '--degree',
             '0', '--transform', 'shift',
             '--distortion', 'none', '--max-motion', '500',
             '--output', str(tmp_path / 'out')]
    assert main([*words, '--dry-run']) == 0
    planned = capsys.readouterr().out
    assert 'n0_SCI1_cat.ecsv' in planned
    assert '_wcs' not in planned
    assert main(words) == 0
    assert capsys.readouterr().out.count('2 chips') == len(YEARS)
    stars = QTable.read(tmp_path / 'out' / 'motions.ecsv')
    stars = stars[np.isfinite(stars['pmra'].value)]
    assert len(stars) == 32
    wcs = [chip_wcs(field, k, 150.0, 0.0, 0.0) for k in range(2)]
    now, then = (np.concatenate([np.stack(wcs[k].all_pix2world(
        *(places[k] + motion[k] * years), 0)) for k in range(2)], axis=1)
        for years in (1.0, 0.0))
    expected = (now - then) * 3.6e6
    index = [np.argmin(np.hypot(then[0] - star['ra'].value,
                                then[1] - star['dec'].value))
             for star in stars]
    away = np.stack([stars['pmra'].value, stars['pmdec'].value]
                    ) - expected[:, index]
    # Without references motions are relative to the mean of the stars.
    away -= np.mean(away, axis=1, keepdims=True)
    pull = away / np.stack([stars['pmra_error'].value,
                            stars['pmdec_error'].value])
    assert 0.7 < np.sqrt(np.mean(pull**2)) < 1.3
    assert_allclose(read_wcs(tmp_path / 'out' / 'n1_SCI2_wcs.fits')
                    .pixel_to_world_values(60, 60),
                    wcs[1].pixel_to_world_values(60, 60), atol=1e-5)


def test_one_image_of_a_file_is_for_runs_without_chips(tmp_path, capsys):
    rng = np.random.default_rng(8)
    field = make_field(rng, columns=2, rows=1, per_chip=1)
    planes = [(np.ones((8, 8)), np.ones((8, 8)),
               chip_wcs(field, k, 150.0, 0.0, 0.0)) for k in range(2)]
    images = [mef(tmp_path / f'n{k}.fits', planes, year)
              for k, year in enumerate(YEARS)]
    assert main(['motions', *images, '--chips', '--ext', 'SCI,1',
                 '--output', str(tmp_path / 'out')]) == 1
    assert '--ext must be given without --chips' in capsys.readouterr().err


def write_lists(folder, rng, n=400):
    """Write lists with a drag of faint stars and errors that are wrong."""
    place, motion = rng.uniform(0, 2000, (2, n)), rng.normal(0, 0.02, (2, n))
    mag = rng.uniform(15, 20, n)
    true, colour = 0.002 * 10**(0.2 * (mag - 15)), rng.normal(1, 0.3, n)
    known = Table({'x': place[0], 'y': place[1],
                   'pmra': motion[0], 'pmdec': motion[1]})
    known['ref_epoch'] = 2015.0
    for name in ('pmra_error', 'pmdec_error'):
        known[name] = 1e-4
    known[::4].write(folder / 'known.ecsv')
    paths = []
    for year in (2010.0, 2012.0, 2015.0, 2018.0, 2020.0):
        x, y = (place + motion * (year - 2015)
                + true * rng.standard_normal((2, n)))
        if year > 2016:
            y = y - 0.1 * (mag - 17.5) * place[1] / 2000
        paths.append(folder / f'{year:.0f}.ecsv')
        Table({'id': [f's{k}' for k in range(n)], 'x': x, 'y': y,
               'x_err': np.full(n, 0.005), 'y_err': np.full(n, 0.005),
               'mag': mag, 'colour': colour,
               'time': np.full(n, year)}).write(paths[-1])
    return [str(path) for path in paths]


def test_errors_by_magnitude_and_terms_reach_the_solution(tmp_path, rng):
    paths = write_lists(tmp_path, rng)
    assert main(['motions', *paths, '--plane', '--systematic', 'magnitude',
                 '--terms', 'magnitude', 'colour', 'y', '--transform',
                 'shift', '--references', str(tmp_path / 'known.ecsv'),
                 '--output', str(tmp_path / 'out')]) == 0
    alignment = Table.read(tmp_path / 'out' / 'alignment.ecsv')
    assert alignment['error_factor'][0][0] < 0.7
    assert alignment['error_factor'][0][-1] > 2
    terms = Table.read(tmp_path / 'out' / 'terms.ecsv')
    assert set(terms['term']) == {'y'}


@pytest.mark.parametrize(('words', 'sentence'), [
    (['--transform', 'affin'], 'must be none, shift, rigid'),
    (['--systematic', 'colour'], 'must be a positive number or magnitude'),
    (['--terms', 'row'], 'invalid choice'),
])
def test_words_that_are_no_option_are_refused_at_once(capsys, words,
                                                      sentence):
    with pytest.raises(SystemExit) as stop:
        main(['motions', 'a.ecsv', 'b.ecsv', *words])
    assert stop.value.code == 2
    assert sentence in capsys.readouterr().err
