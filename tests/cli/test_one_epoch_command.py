"""The command for motions, with one exposure and a catalogue."""
import numpy as np
from astropy.io import fits
from astropy.table import QTable

from helpers.one_epoch import gaia_table, make_sky, observe_once, pulls
from photutils_mgauss.cli import main


def test_one_catalogue_and_references_make_motions(tmp_path, rng, capsys):
    sky = make_sky(rng, n=200, half_width=60.0)
    gaia_table(sky, rng).write(tmp_path / 'gaia.ecsv')
    epoch = observe_once(sky, rng)
    epoch.table.write(tmp_path / 'night.ecsv')
    fits.PrimaryHDU(header=epoch.wcs.to_header()).writeto(
        tmp_path / 'wcs.fits')
    words = ['motions', str(tmp_path / 'night.ecsv'), '--time', 'J2004.0',
             '--wcs', str(tmp_path / 'wcs.fits'),
             '--output', str(tmp_path / 'out')]
    assert main(words) == 1
    assert 'one is enough with --references' in capsys.readouterr().err
    assert main([*words, '--references', str(tmp_path / 'gaia.ecsv')]) == 0
    stars = QTable.read(tmp_path / 'out' / 'motions.ecsv')
    pull = pulls(stars, sky, np.ones(200, dtype=bool))
    assert pull.shape[1] > 180
    assert np.sqrt(np.mean(pull**2)) < 1.2
