"""The command line, from images in files to proper motions and a page."""
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS

from photutils_mgauss import GriddedMixturePSF, __version__
from photutils_mgauss.cli import demo as demonstration
from photutils_mgauss.cli import main
from photutils_mgauss.files.image_layers import read_wcs

# Where this package is imported from, also from another folder.
SOURCES = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get(
    'PYTHONPATH')])]
WRITING = ('psf', 'photometry', 'motions', 'report', 'demo')
COMMANDS = (*WRITING, 'survey', 'info')


def mgauss(*arguments, folder=None):
    """Run the command in a process of its own; warnings are errors."""
    # Told to warn of everything, pyparsing warns of how matplotlib 3.8 uses
    # it, unless told not to.
    return subprocess.run(
        [sys.executable, '-W', 'error', '-W', 'ignore:::pyparsing', '-m',
         'photutils_mgauss', *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=folder,
        env=os.environ | {'PYTHONPATH': os.pathsep.join(SOURCES)})


def here(*arguments, folder):
    """Run the command in this process, which has loaded what it needs."""
    with (chdir(folder), redirect_stdout(StringIO()) as out,
          redirect_stderr(StringIO()) as err):
        code = main([*map(str, arguments)])
    return SimpleNamespace(returncode=code, stdout=out.getvalue(),
                           stderr=err.getvalue())


def succeed(*arguments, folder=None, how=mgauss):
    run = how(*arguments, folder=folder)
    assert run.returncode == 0, run.stderr
    return run


def files_in(folder):
    return sorted(path.name for path in Path(folder).iterdir())


@pytest.fixture(scope='module')
def demo(tmp_path_factory):
    """Run a small demonstration; return its folder and what it printed."""
    folder = tmp_path_factory.mktemp('demo') / 'out'
    return folder, succeed('demo', '--size', 512, '--epochs', 3, '--output',
                           folder)


def test_the_demonstration_writes_what_it_made(demo):
    folder, run = demo
    for number in (1, 2, 3):
        psf = GriddedMixturePSF.read(folder / f'psf_{number}.fits')
        # Four, and the light beyond the stamps.
        assert psf.n_components == 5
        catalogue = QTable.read(folder / f'catalogue_{number}.ecsv')
        assert {'x_fit', 'x_err', 'xy_cov', 'flags'} <= set(catalogue.colnames)
    for name in ('motions', 'alignment'):
        assert len(QTable.read(folder / f'{name}.ecsv')) == len(
            QTable.read(folder / f'{name}.fits'))
    assert (folder / 'motions.png').exists()
    assert (folder / 'positions.png').exists()
    assert '12 files in' in run.stdout
    assert run.stderr == ''  # no bar where nobody looks at it


def test_the_demonstration_recovers_the_true_motions(demo):
    folder, _ = demo
    stars = QTable.read(folder / 'motions.ecsv')
    stars = stars[np.isfinite(stars['pmra'].value)]
    truth = demonstration.Settings(n_epochs=3, size=512, n_stars=88,
                          n_qsos=30).sources()
    index, distance, _ = SkyCoord(stars['ra'], stars['dec']
                                  ).match_to_catalog_sky(
        SkyCoord(truth['ra'], truth['dec']))
    truth = truth[index]
    use = (distance.arcsec < 0.1) & (truth['kind'] == 'star') & (
        stars['n_good_obs'] == 3)
    assert use.sum() > 60
    for name in ('pmra', 'pmdec'):
        pull = ((stars[name] - truth[name]) / stars[f'{name}_error']).value
        # 1 for perfect PSFs; those of 80 stars leave some tenths of a mas.
        assert 0.7 < np.std(pull[use][np.abs(pull[use]) < 5]) < 1.6


@pytest.fixture(scope='module')
def chain(tmp_path_factory):
    """Do what README.md says; return the folder with all of it."""
    folder = tmp_path_factory.mktemp('chain')
    readme = Path(__file__).parents[2] / 'README.md'
    lines = re.findall(r'^mgauss .*$', readme.read_text(encoding='utf-8'),
                       re.MULTILINE)
    assert [line.split()[1] for line in lines] == [
        'demo', 'psf', 'photometry', 'motions', 'report']
    # The others start in processes of their own elsewhere.
    for line in lines:
        words = shlex.split(line)[1:]
        succeed(*words, folder=folder,
                how=mgauss if words[0] in ('demo', 'report') else here)
    return folder


def truth(folder):
    return QTable.read(folder / 'images' / 'night1_truth.ecsv')


def beside_truth(folder, table):
    """Return the rows of a table and of the truth that belong together."""
    true = truth(folder)
    index, distance, _ = SkyCoord(table['ra'], table['dec']
                                  ).match_to_catalog_sky(
        SkyCoord(true['ra'], true['dec']))
    near = distance.arcsec < 0.1
    return table[near], true[index][near]


def test_images_become_psfs_of_their_own_stars(chain):
    for number in (1, 2):
        path = chain / f'night{number}_psf.fits'
        psf = GriddedMixturePSF.read(path)
        # Six, and the light beyond the stamps.
        assert psf.n_components == 7
        record = json.loads(fits.getheader(path)['MGRUN'])
        assert record['command'] == 'psf'
        assert record['version'] == __version__
        assert record['options']['min_snr'] == 50
        assert record['n_stars'] > 60
        assert record['reading'] == {'image': 'SCI', 'error': 'ERR',
                                     'flags': 'DQ'}


def test_catalogues_have_places_on_the_sky_that_are_true(chain):
    table = QTable.read(chain / 'night1_cat.ecsv')
    assert {'x_fit', 'xy_cov', 'ra_error', 'radec_cov'} <= set(table.colnames)
    assert str(table['flux_fit'].unit) == 'electron'
    record = table.meta['mgauss']
    assert record['options']['fit_shape'] == 11
    assert record['exposure']['image'] == 'images/night1.fits'
    table, true = beside_truth(chain, table[table['flags'] == 0])
    assert len(table) > 120
    away = (table['x_fit'] - true['x'].value) / table['x_err']
    assert 0.7 < 1.48 * np.median(np.abs(away)) < 1.4


def test_catalogues_become_true_motions(chain):
    assert files_in(chain / 'motions') == [
        'alignment.ecsv', 'frame_errors.ecsv', 'motions.ecsv',
        'night1_wcs.fits',
        'night2_wcs.fits', 'residuals.ecsv']
    table = QTable.read(chain / 'motions' / 'motions.ecsv')
    assert table.meta['mgauss']['options']['references'] == (
        'images/quasars.ecsv')
    table = table[np.isfinite(table['pmra'].value)]
    table, true = beside_truth(chain, table)
    stars = true['kind'] == 'star'
    assert stars.sum() > 80
    for name in ('pmra', 'pmdec'):
        pull = ((table[name] - true[name]) / table[f'{name}_error'])[stars]
        assert 0.6 < 1.48 * np.median(np.abs(pull)) < 1.6


def test_the_corrected_wcs_holds_for_the_catalogue(chain):
    catalogue = QTable.read(chain / 'night1_cat.ecsv')
    wcs = read_wcs(chain / 'motions' / 'night1_wcs.fits')
    assert isinstance(wcs, WCS)
    sky = wcs.pixel_to_world(catalogue['x_fit'], catalogue['y_fit'])
    away = sky.separation(SkyCoord(catalogue['ra'], catalogue['dec'])).mas
    assert 0 < np.median(away) < 5
    header = fits.getheader(chain / 'motions' / 'night1_wcs.fits')
    assert header['TIMESYS'] == 'TDB'
    assert json.loads(header['MGRUN'])['command'] == 'motions'


def test_the_page_needs_no_other_file(chain):
    page = (chain / 'report.html').read_text(encoding='utf-8')
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert len(sources) > 10
    assert all(source.startswith(('data:image/png;base64,', '#'))
               for source in sources)
    for words in ('PSF: night1_psf.fits', 'Catalogue: night1_cat.ecsv',
                  'Proper motions: motions/motions.ecsv', 'Alignment',
                  'Residuals'):
        assert f'{words}' in page
    assert page.count('<img alt="') == page.count('<figcaption>')


@pytest.mark.long
def test_images_become_motions_in_one_command(chain):
    run = succeed('motions', 'images/night1.fits', 'images/night2.fits',
                  '--n-components', 3, '--degree', 1, '--output', 'direct',
                  '--format', 'fits', '--fit-shape', 9, '--transform',
                  'similarity',
                  '--wcs', 'images/night1_wcs.asdf', 'images/night2_wcs.asdf',
                  folder=chain)
    assert 'stars have proper motions' in run.stdout
    assert files_in(chain / 'direct') == [
        'alignment.fits', 'frame_errors.fits', 'motions.fits',
        'night1_cat.fits',
        'night1_psf.fits', 'night1_wcs.asdf', 'night2_cat.fits',
        'night2_psf.fits', 'night2_wcs.asdf', 'residuals.fits']
    table = QTable.read(chain / 'direct' / 'motions.fits')
    record = json.loads(table.meta['MGRUN'])
    assert record['options']['fit_shape'] == 9
    assert record['options']['transform'] == 'similarity'
    assert np.isfinite(table['pmra'].value).sum() > 100
    assert hasattr(read_wcs(chain / 'direct' / 'night1_wcs.asdf'),
                   'pipeline')


@pytest.mark.long
def test_a_crowded_measurement_finds_the_same_stars(chain, monkeypatch):
    monkeypatch.chdir(chain)
    assert main(['photometry', 'images/night1.fits', '--psf',
                 'night1_psf.fits', '--crowded', '--output', 'crowded.fits',
                 '--quiet']) == 0
    table = QTable.read(chain / 'crowded.fits')
    assert json.loads(table.meta['MGRUN'])['options']['crowded'] is True
    found, _ = beside_truth(chain, table)
    sparse, _ = beside_truth(chain, QTable.read(chain / 'night1_cat.ecsv'))
    shared = set(found['x_fit'].round(1)) & set(sparse['x_fit'].round(1))
    assert len(shared) > 0.8 * len(sparse)


@pytest.fixture(scope='module')
def corners(chain):
    """Cut a quarter out of the images, and measure that of the first."""
    for number in (1, 2):
        with fits.open(chain / 'images' / f'night{number}.fits') as hdus:
            for hdu in hdus:
                if hdu.is_image and hdu.data is not None:
                    hdu.data = hdu.data[:300, :300]
            hdus.writeto(chain / f'corner{number}.fits')
    assert here('photometry', 'corner1.fits', '--psf', 'night1_psf.fits',
                '--crowded', '--output', 'corner.fits', '--quiet',
                folder=chain).returncode == 0
    return chain, QTable.read(chain / 'corner.fits')


@pytest.mark.long
def test_a_crowded_measurement_makes_the_psf_of_the_image(corners,
                                                          monkeypatch):
    chain, known = corners
    monkeypatch.chdir(chain)
    assert main(['photometry', 'corner1.fits', '--crowded', '--output',
                 'own.fits', '--log-file', 'own.log', '--quiet']) == 0
    assert 'PSF from' in (chain / 'own.log').read_text()
    table = QTable.read(chain / 'own.fits')
    assert json.loads(table.meta['MGRUN'])['psf'] is None
    counts = [np.count_nonzero(one['flux_fit'] > 20 * one['flux_err'])
              for one in (table, known)]
    np.testing.assert_allclose(*counts, rtol=0.1)


@pytest.mark.long
def test_a_catalogue_remembers_the_wcs_it_was_measured_with(chain,
                                                            monkeypatch):
    monkeypatch.chdir(chain)
    for number in (1, 2):
        assert main(['photometry', f'images/night{number}.fits', '--psf',
                     f'night{number}_psf.fits', '--wcs',
                     f'images/night{number}_wcs.asdf', '--output',
                     f'gwcs/night{number}_cat.ecsv', '--quiet']) == 0
    assert main(['motions', 'gwcs/night1_cat.ecsv', 'gwcs/night2_cat.ecsv',
                 '--output', 'gwcs/motions', '--quiet']) == 0
    assert {'night1_wcs.asdf', 'night2_wcs.asdf'} <= set(
        files_in('gwcs/motions'))


def test_without_its_image_a_catalogue_still_has_its_places(chain, tmp_path,
                                                            monkeypatch):
    monkeypatch.chdir(chain)
    names = ['night1_cat.ecsv', 'night2_cat.ecsv']
    moved = [shutil.copy(name, tmp_path) for name in names]
    common = ['--transform', 'similarity', '--quiet', '--output']
    assert main(['motions', *names, *common, str(tmp_path / 'one')]) == 0
    assert main(['motions', *moved, *common, str(tmp_path / 'two')]) == 0
    one, two = (QTable.read(tmp_path / name / 'motions.ecsv')
                for name in ('one', 'two'))
    for column in ('pmra', 'pmdec', 'pmra_error', 'pmra_pmdec_corr'):
        np.testing.assert_allclose(
            np.asarray(one[column]), np.asarray(two[column]), rtol=1e-4,
            atol=1e-4)
    assert files_in(tmp_path / 'two') == [
        'alignment.ecsv', 'frame_errors.ecsv', 'motions.ecsv',
        'residuals.ecsv']


def test_psfs_are_rewritten_and_used_in_the_other_format(chain, capsys):
    assert main(['psf', str(chain / 'night1_psf.fits'), '--output',
                 str(chain / 'same.asdf'), '--quiet']) == 0
    one, two = (GriddedMixturePSF.read(chain / name)
                for name in ('night1_psf.fits', 'same.asdf'))
    np.testing.assert_array_equal(one.scales, two.scales)
    np.testing.assert_array_equal(one.mixtures[3].covariances,
                                  two.mixtures[3].covariances)
    from photutils_mgauss.cli.psf_files import psf_record
    assert psf_record(chain / 'same.asdf')['command'] == 'psf'
    assert capsys.readouterr().out == ''


def test_an_image_of_an_epsf_becomes_a_mixture(tmp_path):
    y, x = np.mgrid[-20:21, -20:21] / 4
    epsf = np.exp(-(x**2 + y**2) / 2 / 1.5**2)
    fits.PrimaryHDU(epsf).writeto(tmp_path / 'epsf.fits')
    arguments = ['psf', str(tmp_path / 'epsf.fits'), '--n-components', '1',
                 '--oversampling', '4', '--output', str(tmp_path), '--quiet']
    assert main(arguments) == 0
    psf = GriddedMixturePSF.read(tmp_path / 'epsf_psf.fits')
    np.testing.assert_allclose(psf.mixtures[0].covariances[0],
                               2.25 * np.eye(2), atol=1e-6)


def test_a_psfex_model_becomes_a_grid(realdata, tmp_path):
    path = (realdata('decam_psfex') / 'DECam_00241238_01_psfex_samp0.5_'
            'deg2.psf')
    assert main(['psf', str(path), '--grid-shape', '2', '3', '--output',
                 str(tmp_path / 'decam.fits'), '--quiet']) == 0
    psf = GriddedMixturePSF.read(tmp_path / 'decam.fits')
    assert psf.grid_shape == (2, 3)


def test_a_stdpsf_file_becomes_a_grid(realdata, tmp_path):
    path = realdata('hst_wfc3uvis_f814w') / 'PSFSTD_WFC3UV_F814W.fits'
    assert main(['psf', str(path), '--detector', '1', '--n-components', '2',
                 '--output', str(tmp_path / 'uvis1.fits'), '--quiet']) == 0
    psf = GriddedMixturePSF.read(tmp_path / 'uvis1.fits')
    assert psf.grid_shape == (4, 7)


# What can go wrong.

@pytest.mark.parametrize('arguments', [
    ['psf', 'missing.fits'],
    ['photometry', 'missing.fits', '--psf', 'missing.fits'],
    ['motions', 'missing.ecsv', 'other.ecsv'],
    ['report', 'missing.fits']], ids=COMMANDS[:4])
def test_a_missing_file_is_named(tmp_path, arguments):
    run = mgauss(*arguments, folder=tmp_path)
    assert run.returncode == 1
    assert re.match(r'mgauss: missing\.\w+: must be a file', run.stderr)
    assert files_in(tmp_path) == []


def test_a_wrong_extension_is_named(chain):
    run = here('psf', 'images/night1.fits', '--ext', 'SCI,7', '--output',
                 'wrong.fits', '--quiet', folder=chain)
    assert run.returncode == 1
    assert 'images/night1.fits: --ext must name an image' in run.stderr
    assert '(SCI, ERR, DQ), got SCI,7' in run.stderr
    assert not (chain / 'wrong.fits').exists()


@pytest.fixture(scope='module')
def without_wcs(chain):
    """Return the name of an image without WCS and without time."""
    with fits.open(chain / 'images' / 'night1.fits') as hdus:
        data = hdus['SCI'].data[:200, :200]
    bare = fits.PrimaryHDU(data)
    bare.header['BUNIT'] = 'electron'
    bare.writeto(chain / 'bare.fits')
    return 'bare.fits'


def test_without_wcs_there_are_no_places_on_the_sky(chain, without_wcs,
                                                    monkeypatch):
    monkeypatch.chdir(chain)
    assert main(['photometry', without_wcs, '--psf', 'night1_psf.fits',
                 '--quiet']) == 0
    table = QTable.read(chain / 'bare_cat.ecsv')
    assert 'ra' not in table.colnames
    run = here('motions', 'bare_cat.ecsv', 'night2_cat.ecsv', '--time',
                 2027.5, '--output', 'none', folder=chain)
    assert run.returncode == 1
    assert 'bare_cat.ecsv: must have a WCS or columns ra and dec' in (
        run.stderr)
    assert not (chain / 'none').exists()


def test_without_time_it_has_to_be_given(chain, without_wcs, capsys):
    assert main(['motions', str(chain / without_wcs), str(chain / 'images'
                 / 'night2.fits'), '--plane', '--output',
                 str(chain / 'none'), '--degree', '0', '--n-components', '1',
                 '--quiet', '--overwrite']) == 1
    assert 'bare.fits: the time must be known' in capsys.readouterr().err


@pytest.mark.parametrize(('command', 'output'), [
    ('psf', 'file/psf.fits'), ('photometry', 'file/cat.ecsv'),
    ('motions', 'file'), ('report', 'file/page.html'), ('demo', 'file')])
def test_an_output_that_cannot_be_written_is_named(chain, command, output):
    (chain / 'file').write_text('no folder')
    inputs = {'psf': ['images/night1.fits'],
              'photometry': ['images/night1.fits', '--psf',
                             'night1_psf.fits'],
              'motions': ['night1_cat.ecsv', 'night2_cat.ecsv'],
              'report': ['night1_cat.ecsv'], 'demo': []}[command]
    run = here(command, *inputs, '--output', output, folder=chain)
    assert run.returncode == 1
    assert re.search(r'^mgauss: .*file', run.stderr, re.MULTILINE)
    assert 'Traceback' not in run.stderr


@pytest.mark.parametrize('command', WRITING)
def test_what_exists_is_replaced_only_when_asked(chain, command):
    inputs = {'psf': ['images/night1.fits'],
              'photometry': ['images/night1.fits', '--psf',
                             'night1_psf.fits'],
              'motions': ['night1_cat.ecsv', 'night2_cat.ecsv', '--output',
                          'motions'],
              'report': ['night1_cat.ecsv', '--output', 'report.html'],
              'demo': ['--output', 'motions']}[command]
    before = {path: path.stat().st_mtime_ns for path in chain.rglob('*')
              if path.is_file()}
    run = here(command, *inputs, folder=chain)
    assert run.returncode == 1
    assert '--overwrite' in run.stderr
    assert before == {path: path.stat().st_mtime_ns
                      for path in chain.rglob('*') if path.is_file()}


def test_with_overwrite_what_exists_is_replaced(chain, monkeypatch):
    monkeypatch.chdir(chain)
    before = Path('report.html').read_text(encoding='utf-8')
    assert main(['report', 'night1_cat.ecsv', '--output', 'report.html',
                 '--title', 'Another', '--overwrite', '--quiet']) == 0
    after = Path('report.html').read_text(encoding='utf-8')
    assert '<h1>Another</h1>' in after
    assert '<h1>Another</h1>' not in before


def test_a_file_that_fails_half_way_leaves_nothing(tmp_path):
    from photutils_mgauss.cli.tools import whole_file
    (tmp_path / 'a.txt').write_text('old')
    with pytest.raises(ValueError, match='half'), whole_file(  # noqa: PT012
            tmp_path / 'a.txt') as draft:
        draft.write_text('new')
        raise ValueError('half')  # noqa: EM101
    assert files_in(tmp_path) == ['a.txt']
    assert (tmp_path / 'a.txt').read_text() == 'old'


def test_several_inputs_need_a_folder(chain, capsys):
    assert main(['psf', str(chain / 'images/night1.fits'),
                 str(chain / 'images/night2.fits'), '--output',
                 str(chain / 'one.fits')]) == 1
    assert '--output must be a folder for 2 inputs' in capsys.readouterr().err


def test_a_report_of_something_else_is_an_error(chain, capsys):
    assert main(['report', str(chain / 'images/night1.fits'), '--output',
                 str(chain / 'other.html'), '--quiet']) == 1
    assert 'night1.fits: must be a PSF, a catalogue' in capsys.readouterr(
        ).err


@pytest.mark.parametrize('arguments', [
    [], ['nonsense'], ['demo', '--epochs', '1'], ['demo', '--size', 'big'],
    ['photometry', 'a.fits'], ['psf', 'a.fits', '--gain', '-1'],
    ['motions'], ['motions', 'a', 'b', '--transform', 'round'],
    ['report', 'a', '--unknown']])
def test_wrong_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert 'usage: mgauss' in capsys.readouterr().err


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_has_help_with_an_example(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, '--help'])
    assert stop.value.code == 0
    assert f'example: mgauss {command} ' in capsys.readouterr().out


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit) as stop:
        main(['--version'])
    assert stop.value.code == 0
    assert __version__ in capsys.readouterr().out


def test_help_comes_without_loading_what_computes():
    code = ('import sys, photutils_mgauss.cli.command as cli\n'
            'cli.make_parser().format_help()\n'
            'print(*sys.modules)')
    loaded = subprocess.run([sys.executable, '-c', code], check=True,
                            capture_output=True, text=True).stdout.split()
    assert not {'numpy', 'astropy', 'photutils', 'numba'} & set(loaded)


@pytest.mark.long
def test_images_of_one_field_are_measured_together(corners, monkeypatch):
    chain, alone = corners
    monkeypatch.chdir(chain)
    assert main(['photometry', 'corner1.fits', 'corner2.fits', '--psf',
                 'night1_psf.fits', 'night2_psf.fits', '--crowded',
                 '--together', '--output', 'both.fits', '--quiet']) == 0
    table = QTable.read(chain / 'both.fits')
    assert json.loads(table.meta['MGRUN'])['options']['together'] is True
    assert table['flux'].shape == (len(table), 2)
    assert len(table) > 0.9 * len(alone)


@pytest.mark.parametrize(('options', 'words'), [
    (['--together'], 'with --crowded'),
    (['--together', '--crowded', '--magnitudes'], 'without --magnitudes'),
    (['--together', '--crowded', '--output', 'folder'], 'must be a file')])
def test_what_does_not_go_together_is_told(chain, monkeypatch, capsys,
                                           options, words):
    monkeypatch.chdir(chain)
    assert main(['photometry', 'images/night1.fits', '--psf',
                 'night1_psf.fits', *options]) != 0
    assert words in capsys.readouterr().err
