"""The command line, from simulated images to proper motions."""
import subprocess
import sys

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from photutils_mgauss import GriddedMixturePSF, __version__, _demo
from photutils_mgauss.cli import main


@pytest.fixture(scope='module')
def demo(tmp_path_factory):
    """Run a small demonstration; return its folder and what it printed."""
    folder = tmp_path_factory.mktemp('demo') / 'out'
    run = subprocess.run(
        [sys.executable, '-W', 'error', '-m', 'photutils_mgauss', 'demo',
         '--size', '512', '--epochs', '3', '--output', str(folder)],
        capture_output=True, text=True, check=True)
    return folder, run


def test_the_demonstration_writes_what_it_made(demo):
    folder, run = demo
    for number in (1, 2, 3):
        psf = GriddedMixturePSF.read(folder / f'psf_{number}.fits')
        assert psf.n_components == 4
        catalogue = QTable.read(folder / f'catalogue_{number}.ecsv')
        assert {'x_fit', 'x_err', 'xy_cov', 'flags'} <= set(catalogue.colnames)
    for name in ('motions', 'alignment'):
        assert len(QTable.read(folder / f'{name}.ecsv')) == len(
            QTable.read(folder / f'{name}.fits'))
    assert (folder / 'motions.png').exists()
    assert (folder / 'positions.png').exists()
    assert '12 files in' in run.stdout
    assert 'simulate' in run.stderr  # the progress bar


def test_the_demonstration_recovers_the_true_motions(demo):
    folder, _ = demo
    stars = QTable.read(folder / 'motions.ecsv')
    stars = stars[np.isfinite(stars['pmra'].value)]
    truth = _demo.Settings(n_epochs=3, size=512, n_stars=88,
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


def test_nothing_is_overwritten_unasked(tmp_path, capsys):
    precious = tmp_path / 'data.txt'
    precious.write_text('precious')
    assert main(['demo', '--output', str(tmp_path), '--quiet']) == 1
    assert '--overwrite' in capsys.readouterr().err
    assert precious.read_text() == 'precious'


def test_an_output_that_is_a_file_is_an_error(tmp_path, capsys):
    (tmp_path / 'file').write_text('')
    assert main(['demo', '--output', str(tmp_path / 'file')]) == 1
    assert 'mgauss: ' in capsys.readouterr().err


@pytest.mark.parametrize('arguments', [
    [], ['nonsense'], ['demo', '--epochs', '1'], ['demo', '--size', 'big']])
def test_wrong_usage_exits_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert 'usage: mgauss' in capsys.readouterr().err


def test_version_and_help_are_there(capsys):
    for arguments, word in ((['--version'], __version__),
                            (['demo', '--help'], 'example: mgauss demo')):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0
        assert word in capsys.readouterr().out
