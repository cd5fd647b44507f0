"""What is wrong with a survey is said before work starts, by name."""
import json
import re
import shutil
from collections import namedtuple

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.cli import main
from photutils_mgauss.cli.footprints import Footprint, connected, overlaps
from photutils_mgauss.cli.survey_plan import read_survey
from photutils_mgauss.cli.survey_tasks import (
    detector_tasks,
    exposure_tasks,
    field_tasks,
    page_tasks,
    pixel_tasks,
)


def make_wcs(ra=10.0, dec=20.0, roll=0.0):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crpix, wcs.wcs.crval = (25.5, 20.5), (ra, dec)
    turn = np.radians(roll)
    wcs.wcs.cd = 1e-4 * np.array([[-np.cos(turn), np.sin(turn)],
                                  [np.sin(turn), np.cos(turn)]])
    wcs.wcs.set()
    return wcs


def write_image(path, wcs, **cards):
    header = fits.Header() if wcs is None else wcs.to_header()
    header.update({'BUNIT': 'electron', 'DATE-AVG': '2027-03-01T00:00:00',
                   **cards})
    noise = np.random.default_rng(1).normal(100, 10, (40, 50))
    fits.writeto(path, noise.astype('f4'), header)


@pytest.fixture
def folder(tmp_path):
    """Write two exposures of each of two detectors, and a PSF."""
    (tmp_path / 'raw').mkdir()
    for k, (detector, ra) in enumerate(((7, 10), (8, 10.004), (7, 10),
                                        (8, 10.004))):
        write_image(tmp_path / 'raw' / f'e{k}.fits', make_wcs(ra),
                    DETECTOR=detector)
    GriddedMixturePSF([GaussianMixture([1.0], [[0, 0]], [np.eye(2)])],
                      [[0, 0]]).write(tmp_path / 'psf.fits')
    return tmp_path


def plan(folder, text, exposures='', top=''):
    path = folder / 'survey.toml'
    path.write_text(f'{top}[exposures]\nfiles = "raw/*.fits"\n{exposures}\n'
                    f'{text}')
    return read_survey(path)


BY_DETECTOR = 'detector = "DETECTOR"'


@pytest.mark.parametrize(('text', 'said'), [
    ('[psf]\ngain = 2', r'gain of \[psf\] must be in \[exposures\]'),
    ('[photometry]\next = "SCI"', r'ext of \[photometry\] must be in'),
    ('[motions]\nn_components = 3', r'n_components .* must be in \[psf\]'),
    ('[motions]\ncrowded = true', r'crowded .* must be in \[photometry\]'),
    ('[psf]\noutput = "x"', r'output of \[psf\] must be left out'),
    ('[photometry]\nerror = "x"', 'is for single images'),
    ('[psf]\ndegree = 1\n[photometry]\npsf = "psf.fits"',
     r'\[psf\] must be left out where .* got degree'),
    ('[photometry]\ncrowded = true\npsf = "detector"',
     'must be left out'),
    ('[psf]\ndegree = 1\n[photometry]\ncrowded = true', 'must be left out'),
    ('[photometry]\ncrowded = true\n[motions]\npixels = true',
     'must have PSFs in files'),
    ('[motions]\npixels = true\nplane = true', 'without plane'),
    ('[motions]\nrefine_frames = true', 'must be given with pixels'),
    ('[photometry]\npsf = "none.fits"', 'got none.fits, which is none'),
    ('[psf]\nstart = "none.fits"', r'start of \[psf\] must be a file, got'),
    ('[psf]\nstart = "raw/e0.fits"', 'must be a PSF, but is an image'),
    ('[psf]\nstart = "psf.fits"\nn_components = 3',
     'must be left out with start'),
    ('[psf]\nstart = "psf.fits"\n[photometry]\npsf = "detector"',
     'must be given without psf = "detector"'),
    ('[motions]\nstart = "psf.fits"', r'start .* must be in \[psf\]'),
    ('[photometry]\npsf = "raw/e0.fits"', 'must be a PSF, but is an image')])
def test_options_that_overlap_are_named(folder, text, said):
    with pytest.raises(ValueError, match=said):
        plan(folder, text)


@pytest.mark.parametrize('text', [
    '[motions]\nreferences = "gaia.ecsv"',
    '[motions]\npixels = true\ntargets = "gaia.ecsv"',
    '[psf]\nstars = "gaia.ecsv"'])
def test_a_file_that_there_is_none_of_is_named(folder, text):
    with pytest.raises(FileNotFoundError, match='must be a file, got gaia'):
        plan(folder, text)


def test_a_psf_to_start_from_is_that_of_the_detector(folder):
    survey = plan(folder, '[psf]\ndegree = 0\nstart = {7 = "psf.fits", 8 = '
                  '"psf.fits"}', BY_DETECTOR)
    task = exposure_tasks(survey)[1]
    psf, photometry = task.commands
    assert psf[psf.index('--start') + 1] == str(folder / 'psf.fits')
    assert '--start' not in photometry
    # A new PSF of that name is a reason to make others of it.
    assert str(folder / 'psf.fits') in task.inputs
    with pytest.raises(ValueError, match=r"start of \[psf\] must name a file "
                                         r"for each detector.*'8' of"):
        plan(folder, '[psf]\nstart = {7 = "psf.fits"}', BY_DETECTOR)


def test_each_measured_exposure_has_a_page(folder):
    survey = plan(folder, '[photometry]\npsf = "psf.fits"')
    tasks = page_tasks(survey, {'e0', 'e2'}, {'field0001'})
    assert [task.name for task in tasks] == ['e0_page', 'e2_page']
    words, = tasks[0].commands
    assert '--field' in words
    assert any(name.endswith('residuals.ecsv') for name in tasks[0].inputs)
    # One without motions shows what there is.
    words, = page_tasks(survey, {'e0'}, set())[0].commands
    assert '--field' not in words
    assert not page_tasks(plan(folder, '', top='pages = false\n'), {'e0'},
                          set())
    with pytest.raises(TypeError, match='pages must be true or false, got 3'):
        plan(folder, '', top='pages = 3\n')


def test_a_table_that_is_none_is_named(folder):
    path = folder / 'survey.toml'
    path.write_text('psf = "detector"\n[exposures]\nfiles = "raw/*.fits"\n')
    with pytest.raises(TypeError, match=r'psf must be a table, \[psf\]'):
        read_survey(path)


def test_a_detector_without_a_psf_is_named(folder):
    with pytest.raises(ValueError, match=r"none for '8' of .*e1.fits"):
        plan(folder, '[photometry]\npsf = {7 = "psf.fits"}', BY_DETECTOR)
    survey = plan(folder, '[photometry]\npsf = {7 = "psf.fits", 8 = '
                  '"psf.fits"}', BY_DETECTOR)
    task = exposure_tasks(survey)[0]
    assert '--psf' in task.commands[0]
    # A new PSF of that name is a reason to measure again.
    assert str(folder / 'psf.fits') in task.inputs
    with pytest.raises(ValueError, match=r'e0.fits: must have the keyword'):
        plan(folder, '', 'detector = "CHIP"')


def test_all_exposures_that_cannot_be_used_are_named(folder):
    for name in ('bad', 'worse'):
        write_image(folder / 'raw' / f'{name}.fits', None)
    with pytest.raises(ValueError, match=r'bad.fits: must have a WCS.*; '
                                         r'.*worse.fits: must have a WCS'):
        plan(folder, '')


def test_how_images_are_read_is_for_all_commands(folder):
    survey = plan(folder, '', 'read_noise = 5.0')
    task = exposure_tasks(survey)[0]
    assert all(words[words.index('--read-noise') + 1] == '5.0'
               for words in task.commands)
    with pytest.raises(ValueError, match=r'\[exposures\]: .*read-noise'):
        plan(folder, '', 'read_noise = -1')


def test_a_folder_of_another_run_is_refused(folder, capsys):
    plan(folder, '')
    path = folder / 'survey.toml'
    (folder / 'survey').mkdir()
    (folder / 'survey' / 'thesis.txt').write_text('precious')
    assert main(['survey', str(path), '--dry-run']) == 1
    assert 'but has thesis.txt' in capsys.readouterr().err
    mark = folder / 'survey' / 'survey.json'
    mark.write_text(json.dumps({'file': '../other.toml'}))
    assert main(['survey', str(path), '--dry-run']) == 1
    assert 'another run, of ../other.toml' in capsys.readouterr().err
    mark.write_text(json.dumps({'file': '../survey.toml'}))
    assert main(['survey', str(path), '--dry-run']) == 0


def test_a_full_disk_is_said_before_work_starts(folder, monkeypatch, capsys):
    plan(folder, '')
    usage = namedtuple('usage', 'total used free')
    monkeypatch.setattr(shutil, 'disk_usage',
                        lambda _: usage(10**9, 10**9, 1000))
    assert main(['survey', str(folder / 'survey.toml')]) == 1
    assert re.search('must have room for 4 exposures, about [0-9]+ MB, got 0',
                     capsys.readouterr().err)
    assert not (folder / 'survey').exists()


def test_a_disk_that_fills_up_is_said_by_the_exposure(folder, monkeypatch):
    from photutils_mgauss.cli.survey_run import Task, run_task
    from photutils_mgauss.files import whole

    def full(*_, **__):
        raise OSError(28, 'No space left on device')
    monkeypatch.setattr(whole, 'whole_file', full)
    outcome = run_task(Task('e0', (), (str(folder / 'psf.fits'),), (),
                            str(folder / 'record.json')))
    assert 'No space left' in outcome.error


def test_a_psf_of_a_detector_is_one_task(folder):
    survey = plan(folder, '[photometry]\npsf = "detector"',
                  BY_DETECTOR + '\ngain = 1.0')
    tasks = detector_tasks(survey)
    assert [task.name for task in tasks] == ['psf of 7', 'psf of 8']
    words = tasks[0].commands[0]
    assert words[0] == 'psf'
    assert [one[-7:] for one in words[1:3]] == ['e0.fits', 'e2.fits']
    assert {'--together', '--gain'} <= set(words)
    psfs = {task.outputs for task in tasks}
    for task, mate in zip(exposure_tasks(survey), (0, 1, 0, 1), strict=True):
        words = task.commands[0]
        psf = words[words.index('--psf') + 1]
        assert psf in tasks[mate].outputs
        assert psf in task.inputs
    assert len(psfs) == 2


def test_fields_that_touch_are_a_region(folder):
    # Detectors 7 and 8 see the same sky by halves and less.
    plain = plan(folder, '', 'overlap = 0.9')
    assert list(plain.fields.values()) == [[0, 2], [1, 3]]
    whole = plan(folder, '[motions]\ntogether = true', 'overlap = 0.9')
    assert whole.fields == {'region0001': [0, 1, 2, 3]}


def test_motions_from_pixels_are_a_step_of_their_own(folder):
    survey = plan(folder, '[photometry]\npsf = "psf.fits"\n[motions]\n'
                  'pixels = true\nparallax = true\nrefine_frames = true\n'
                  'transform = "shift"', 'overlap = 0.9')
    names = {one.name for one in survey.exposures}
    first = field_tasks(survey, names)[0].commands[0]
    assert {'--transform', '--parallax'} <= set(first)
    assert not {'--pixels', '--refine-frames'} & set(first)
    tasks = pixel_tasks(survey, names, {'field0001'})
    assert [task.name for task in tasks] == ['field0001_pixels']
    words = tasks[0].commands[0]
    assert {'--pixels', '--parallax', '--refine-frames', '--psf',
            '--wcs'} <= set(words)
    assert '--transform' not in words


@pytest.mark.parametrize('roll', [0, 30])
def test_footprints_overlap_as_their_pixels_do(roll):
    one = make_wcs()
    other = make_wcs(10.001, 20.0008, roll)
    y, x = np.mgrid[:40, :50]
    ox, oy = other.world_to_pixel(one.pixel_to_world(x, y))
    inside = (ox > -0.5) & (ox < 49.5) & (oy > -0.5) & (oy < 39.5)
    share = Footprint(one, (40, 50)).share_inside(Footprint(other, (40, 50)))
    assert_allclose(share, inside.mean(), atol=0.07)


def test_only_overlaps_of_one_group_connect():
    wcs = [make_wcs(10), make_wcs(10.001), make_wcs(40), make_wcs(10)]
    footprints = [Footprint(one, (40, 50)) for one in wcs]
    pairs, share = overlaps(footprints, ['g', 'g', 'g', 'r'])
    assert pairs.tolist() == [[0, 1]]
    assert 0.5 < share[0] < 0.95
    assert connected(pairs, 4) == [[0, 1], [2], [3]]


def test_a_folder_in_place_of_a_survey_gets_a_hint(folder, capsys):
    assert main(['survey', str(folder / 'raw')]) == 1
    said = capsys.readouterr().err
    assert re.search(r'raw: must be a SURVEY.toml, but is a folder; mgauss '
                     r'survey --init .*raw writes one', said)
