"""A survey: its plan, its tasks, and what it leaves."""
import json
import os
import re
import subprocess
import sys
import time
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, vstack
from numpy.testing import assert_array_equal

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    Instrument,
    paper_exposures,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.cli import main
from photutils_mgauss.cli.psf_files import psf_record
from photutils_mgauss.cli.survey_plan import read_survey
from photutils_mgauss.cli.survey_run import (
    Task,
    cluster_workers,
    kept_outcome,
    local_workers,
    run_task,
    run_tasks,
)

OPTIONS = ('[psf]\nn_components = 1\ndegree = 0\ngrid_shape = [1, 1]\n'
           '[motions]\nreferences = "quasars.ecsv"\n')
PLACES = {'north': (192.8595, 27.3283), 'south': (192.8595, 27.1283)}


@pytest.fixture(scope='module')
def images(tmp_path_factory):
    """Write two epochs of two fields, one image of noise, and quasars."""
    folder = tmp_path_factory.mktemp('survey')
    (folder / 'raw').mkdir()
    quasars = []
    for k, (name, (ra, dec)) in enumerate(PLACES.items()):
        sources = sky_field(60, 40, ra=ra, dec=dec, size=0.4, rng=k,
                            magnitudes=(18, 21), separation=1,
                            parallaxes=False)
        exposures = paper_exposures(ra, dec, offset=0.5)
        scenes = simulate_epochs(sources, [exposures[0], exposures[6]],
                                 instrument=Instrument(shape=(260, 250)),
                                 rng=k)
        for number, scene in enumerate(scenes):
            scene.write(folder / 'raw' / f'{name}{number}.fits')
        some = sources[sources['kind'] == 'qso']['ra', 'dec']
        some['class'] = 'qso'
        quasars.append(some)
    vstack(quasars).write(folder / 'quasars.ecsv')
    with fits.open(folder / 'raw' / 'north0.fits') as hdus:
        hdus['SCI'].data[:] = np.random.default_rng(1).normal(
            100, 10, hdus['SCI'].data.shape)
        hdus['SCI'].header['CRVAL2'] += 1
        hdus.writeto(folder / 'raw' / 'noise.fits')
    return folder


@pytest.fixture
def survey(images, tmp_path):
    """Return a survey file of its own, for the same images."""
    path = tmp_path / 'survey.toml'
    path.write_text(f'[exposures]\nfiles = "{images}/raw/*.fits"\n'
                    + OPTIONS.replace('quasars', f'{images}/quasars'))
    return path


def test_exposures_that_overlap_are_a_field(survey):
    plan = read_survey(survey)
    names = [one.name for one in plan.exposures]
    assert names == ['noise', 'north0', 'north1', 'south0', 'south1']
    assert list(plan.fields.values()) == [[0], [1, 2], [3, 4]]
    assert plan.options['psf'][:4] == ('--n-components', '1', '--degree', '0')


def test_the_dry_run_shows_the_plan_and_writes_nothing(survey, capsys):
    assert main(['survey', str(survey), '--dry-run']) == 0
    said = capsys.readouterr().out
    assert '5 exposures in 3 fields' in said
    assert re.search(r'5 to do, about \d+ MB and 0.0\d core hours', said)
    assert re.search(r'field0002: 2 exposures, \d{4}.*north0, north1', said)
    assert sorted(survey.parent.iterdir()) == [survey]


def test_the_plan_tells_fields_of_one_exposure(survey, capsys):
    survey.write_text(re.sub('(?m)^references.*', '', survey.read_text()))
    assert main(['survey', str(survey), '--dry-run']) == 0
    said = capsys.readouterr().out
    assert re.search(r'field0001: 1 exposure, too few for motions, 20\d\d\.'
                     r'\d\d: noise', said)
    assert 'no field will' not in said
    survey.write_text(survey.read_text().replace('*.fits', '*h0.fits'))
    assert main(['survey', str(survey), '--dry-run']) == 0
    assert ('no field will have motions: they take two measured exposures'
            in capsys.readouterr().out)


@pytest.mark.long
def test_a_survey_ends_in_motions_and_runs_only_what_changed(survey, capsys):
    pytest.importorskip('pyarrow')
    folder = survey.parent / 'survey'
    # The image of noise fails, is listed, and stops nothing.
    said = run(survey, capsys)
    assert '5 exposures, 2 fields, 1 failed, 0 of an earlier run' in said
    assert 'noise.fits: data must show at least 1 source' in said
    placed = 0
    for field in ('field0002', 'field0003'):
        table = QTable.read(folder / 'motions' / field / 'motions.ecsv')
        assert np.isfinite(table['pmra_error'].value).sum() > 20
        placed += np.isfinite(table['ra'].value).sum()
    from pyarrow import dataset
    whole = dataset.dataset(folder / 'motions_hats' / 'dataset',
                            format='parquet').to_table()
    assert whole.num_rows == placed
    facts = whole.schema.field('pmra').metadata
    assert facts[b'unit'] == b'mas / yr'
    assert facts[b'ucd'] == b'pos.pm;pos.eq.ra'
    assert whole['_healpix_29'].to_numpy().dtype == np.int64
    page = (folder / 'index.html').read_text()
    assert page.count('<tr') == 2 + 5 + 2
    assert page.index('>noise<') < page.index('>north0<')
    for words in ('completeness', 'pulls of references', 'systematic error',
                  'FWHM [pix]', 'href="pages/north0.html"'):
        assert words in page
    assert 'href="pages/noise.html"' not in page
    own = (folder / 'pages' / 'north0.html').read_text()
    # Its image and its residuals, its PSF, its pulls.
    for words in ('Residuals of the image', 'The PSF in the middle',
                  'north0 in its field', 'of their errors, along both axes'):
        assert words in own
    assert own.count('<h2>north0 in its field') == 1
    # Nothing changed, so nothing is done again but what failed.
    before = stamps(folder)
    assert '1 failed, 6 of an earlier run' in run(survey, capsys)
    assert stamps(folder) == before
    # Stars of an earlier run that are nowhere now would be found twice.
    stale = folder / 'motions_hats/dataset/Norder=5/Dir=0/Npix=7.parquet'
    stale.parent.mkdir(parents=True, exist_ok=True)
    stale.touch()
    # One image changed: it and its field.
    os.utime(read_survey(survey).exposures[1].path)
    assert '1 failed, 4 of an earlier run' in run(survey, capsys)
    assert json.loads((folder / 'summary.json').read_text())['kept'] == 4
    assert not stale.exists()


def run(survey, capsys):
    """Run a survey of which something fails; return what it said."""
    assert main(['survey', str(survey), '--workers', '1']) == 1
    said = capsys.readouterr()
    assert 'lists what failed; the rest is finished' in said.err
    return said.out


def stamps(folder):
    return {path: path.stat().st_mtime_ns
            for name in ('psfs', 'catalogues', 'motions', 'records')
            for path in (folder / name).rglob('*') if path.is_file()}


@pytest.mark.parametrize(('text', 'said'), [
    ('[exposure]\n', 'keys must be among .* got exposure'),
    ('[exposures]\nfiles = ["none/*.fits"]\n', 'must name images, got none'),
    ('[exposures]\nfiels = 1\n', r'did you mean files\?'),
    ('[psf]\ncolour = 3\n', (r'\[psf\] must have options of mgauss psf, got '
     'colour')),
    ('[photometry]\nfit_shape = "x"\n', r'\[photometry\]: .*fit-shape'),
    ('[exposures\n', 'must be a TOML file')])
def test_what_is_wrong_in_the_file_is_named(tmp_path, text, said):
    path = tmp_path / 'survey.toml'
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_survey(path)


def test_two_exposures_of_one_name_are_refused(images, tmp_path):
    (tmp_path / 'more').mkdir()
    copy = tmp_path / 'more' / 'north0.fits'
    copy.write_bytes((images / 'raw' / 'north0.fits').read_bytes())
    path = tmp_path / 'survey.toml'
    path.write_text(f'[exposures]\nfiles = ["{images}/raw/north0.fits", '
                    '"more/*.fits"]\n')
    with pytest.raises(ValueError, match='different names, got north0 for'):
        read_survey(path)


def test_an_image_without_a_wcs_is_named_before_work_starts(tmp_path):
    fits.writeto(tmp_path / 'bare.fits', np.ones((50, 50)),
                 fits.Header({'BUNIT': 'electron'}))
    path = tmp_path / 'survey.toml'
    path.write_text('[exposures]\nfiles = "*.fits"\n')
    with pytest.raises(ValueError, match=r'bare.fits: must have a WCS'):
        read_survey(path)


def test_the_example_knows_files_of_several_images(images, tmp_path,
                                                   monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'raw').mkdir()
    source = min((images / 'raw').glob('*.fits'))
    data, header = fits.getdata(source), fits.getheader(source)
    for name in ('a', 'b'):
        chips = [fits.ImageHDU(data, header, name='SCI', ver=version)
                 for version in (1, 2)]
        fits.HDUList([fits.PrimaryHDU(header=fits.Header(
            {'FILTER': f'F{name}'})), *chips]).writeto(
                tmp_path / 'raw' / f'{name}.fits')
    (tmp_path / 'plans').mkdir()
    assert main(['survey', 'plans/mine.toml', '--init', 'raw']) == 0
    text = (tmp_path / 'plans' / 'mine.toml').read_text()
    assert '\next = "SCI"' in text
    assert '\ngroup_by = ["FILTER"]' in text
    assert '\n# detector' in text
    survey = read_survey(tmp_path / 'plans' / 'mine.toml')
    assert [one.name for one in survey.exposures] == [
        'a_SCI1', 'a_SCI2', 'b_SCI1', 'b_SCI2']
    (tmp_path / 'plans' / 'mine.toml').write_text(
        text.replace('ext = "SCI"', ''))
    assert main(['survey', 'plans/mine.toml', '--dry-run']) == 1
    assert 'a.fits: ext must say which image' in capsys.readouterr().err


def test_the_example_is_for_the_images_of_a_folder(images, tmp_path,
                                                   monkeypatch, capsys):
    monkeypatch.chdir(images)
    assert main(['survey', '--init', 'raw']) == 0
    try:
        assert len(read_survey(images / 'survey.toml').exposures) == 5
        assert main(['survey', '--init', 'raw']) == 1  # it is there already
        assert 'give the example another name' in capsys.readouterr().err
    finally:
        (images / 'survey.toml').unlink()


def make_task(folder, name='info'):
    source = folder / 'stars.ecsv'
    if not source.exists():
        QTable({'x': [1.0]}).write(source)
    return Task(name, (('info', str(source)),), (str(source),), (),
                str(folder / f'{name}.json'))


def test_a_task_runs_once_until_something_it_reads_changes(tmp_path):
    task = make_task(tmp_path)
    assert not run_task(task).skipped
    assert run_task(task).skipped
    os.utime(task.inputs[0])
    assert not run_task(task).skipped
    (tmp_path / 'info.json').write_text('{')
    assert kept_outcome(task) is None
    assert 'no such' in run_task(Task(
        'gone', (), (str(tmp_path / 'gone'),), (), 'x')).error.lower()


@pytest.fixture
def light(monkeypatch):
    """Return the module that processes can import quickly."""
    folder = str(Path(__file__).parent)
    monkeypatch.syspath_prepend(folder)
    return import_module('stand_ins')


def test_a_worker_that_dies_loses_nothing(tmp_path, monkeypatch, light):
    from photutils_mgauss.cli import survey_run
    monkeypatch.setattr(survey_run, 'run_task', light.kill_once)
    tasks = [make_task(tmp_path, f'task{k}') for k in range(3)]
    told = []
    with local_workers(2) as workers:
        done = run_tasks(tasks, workers, told.append)
    assert sorted(done) == ['task0', 'task1', 'task2']
    assert not any(outcome.error for outcome in done.values())
    assert len(told) == 3


def begin(folder, n):
    """Start a driver of n tasks."""
    return subprocess.Popen([sys.executable, str(
        Path(__file__).with_name('stand_ins.py')), str(folder), str(n)])


def wait_until(true, seconds=60):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def is_gone(pid):
    try:
        return 'Z' in Path(f'/proc/{pid}/stat').read_text().split()[2]
    except OSError:
        return True


def test_what_is_killed_repeats_one_task_each(tmp_path, light):
    n, kills = 14, 0
    driver = begin(tmp_path, n)
    # A worker, in the middle of a task: only its own is done again.
    wait_until(lambda: len(light.notes(tmp_path)) >= 3)
    os.kill(int(light.notes(tmp_path)[-1][1]), 9)
    kills += 1
    # The driver: its two workers end with it.
    wait_until(lambda: len(light.notes(tmp_path)) >= 7)
    driver.kill()
    driver.wait()
    kills += 2
    wait_until(lambda: all(is_gone(pid) for _, pid in light.notes(tmp_path)))
    known = list((tmp_path / 'records').glob('t*.json'))
    assert 2 < len(known) < n
    before = {path: path.stat().st_mtime_ns for path in known}
    assert begin(tmp_path, n).wait() == 0
    assert len(list((tmp_path / 'records').glob('t*.json'))) == n
    begun = [name for name, _ in light.notes(tmp_path)]
    assert len(set(begun)) == n
    assert len(begun) <= n + kills
    # What had a record was not done again.
    assert before == {path: path.stat().st_mtime_ns for path in known}


def test_processes_work_on_in_the_next_step(tmp_path, monkeypatch, light):
    from photutils_mgauss.cli import survey_run
    monkeypatch.setattr(survey_run, 'run_task', light.noted)
    (tmp_path / 'records').mkdir()
    tasks = light.tasks_without_work(tmp_path, 8)
    with local_workers(2) as workers:
        for some in (tasks[:4], tasks[4:]):
            assert len(run_tasks(some, workers, lambda _: None)) == 4
    assert len(light.notes(tmp_path)) == 8
    assert len({pid for _, pid in light.notes(tmp_path)}) == 2


def test_processes_share_the_cores(monkeypatch):
    from photutils_mgauss.utils import parallel
    monkeypatch.setattr(parallel, '_LIMIT', {})
    cores = parallel.available_cores()
    parallel.limit_cores(1)
    assert parallel.available_cores() == 1
    parallel.limit_cores(cores + 1)
    assert parallel.available_cores() == cores


@pytest.mark.long
def test_detectors_and_pixels_are_steps_of_a_survey(images, tmp_path, capsys):
    pytest.importorskip('pyarrow')
    path = tmp_path / 'survey.toml'
    path.write_text(
        (f'[exposures]\nfiles = "{images}/raw/north*.fits"\n{OPTIONS}'
         'pixels = true\ntargets = "quasars.ecsv"\n[photometry]\n'
         'psf = "detector"\n').replace('quasars', f'{images}/quasars')
        .replace('n_components = 1', 'n_components = 3'))
    assert main(['survey', str(path), '--workers', '1']) == 0, (
        capsys.readouterr().err)
    folder = tmp_path / 'survey'
    psfs = sorted((folder / 'psfs').rglob('*.fits'))
    assert [one.name for one in psfs] == ['north0_psf.fits',
                                          'north1_psf.fits']
    # One fit, and a width of each exposure.
    records = [psf_record(one) for one in psfs]
    assert [one['exposures'] for one in records] == [2, 2]
    tables = [QTable.read(folder / what / 'field0001' / 'motions.ecsv')
              for what in ('motions', 'pixels')]
    for table in tables:
        assert np.isfinite(table['pmra_error'].value).sum() > 20
    assert tables[1]['significance'].max() > 50
    # The frames of the pixels are those of the catalogues.
    record = tables[1].meta['mgauss']
    assert sorted(Path(one).stem for one in record['options']['wcs']) == [
        'north0_wcs', 'north1_wcs']
    assert record['catalogues']['motions'] > 20
    assert sorted(one.stem for one in (folder / 'wcs').iterdir()) == [
        'north0_wcs', 'north1_wcs']
    assert 'field0001_pixels' in (folder / 'index.html').read_text()
    before = stamps(folder)
    assert main(['survey', str(path), '--workers', '1']) == 0
    assert '0 failed, 5 of an earlier run' in capsys.readouterr().out
    assert stamps(folder) == before


@pytest.mark.long
def test_results_are_the_same_whoever_makes_them(images, tmp_path, capsys):
    pytest.importorskip('pyarrow')
    from pyarrow import dataset
    mixture = GaussianMixture([1.0], [[0, 0]], [np.eye(2)])
    GriddedMixturePSF([mixture], [[0, 0]]).write(tmp_path / 'psf.fits')
    found = []
    for workers in ('1', '2'):
        path = tmp_path / f'{workers}.toml'
        path.write_text(
            f'output = "out{workers}"\npages = false\n[exposures]\n'
            f'files = "{images}/raw/south*.fits"\n[photometry]\n'
            'psf = "psf.fits"\n[motions]\n'
            f'references = "{images}/quasars.ecsv"\n')
        assert main(['survey', str(path), '--workers', workers]) == 0, (
            capsys.readouterr().err)
        found.append(dataset.dataset(
            tmp_path / f'out{workers}' / 'motions_hats' / 'dataset',
            format='parquet').to_table())
    assert found[0].num_rows > 40
    assert found[0].schema.equals(found[1].schema, check_metadata=True)
    for name in found[0].column_names:
        # NaN included.
        assert_array_equal(*(one[name].to_numpy() for one in found), name)


def test_tasks_run_on_a_dask_cluster(tmp_path, light):
    distributed = pytest.importorskip('distributed')
    tasks = light.tasks_without_work(tmp_path, 6)
    told = []
    with (distributed.LocalCluster(n_workers=1, threads_per_worker=1,
                                   processes=False,
                                   dashboard_address=None) as cluster,
          cluster_workers(cluster.scheduler_address) as workers):
        done = run_tasks(tasks, workers, told.append)
        again = run_tasks(tasks, workers, told.append)
    assert workers.number == 2
    assert not any(one.error or one.skipped for one in done.values())
    assert all(one.skipped for one in again.values())
