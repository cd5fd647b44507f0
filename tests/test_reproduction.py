"""The command that repeats the paper: what it accepts, stores and says."""
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / 'docs' / 'reproduction'


@pytest.fixture
def store(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    import store
    return store


@dataclass(frozen=True)
class Sizes:
    """Settings of a name that tell all steps the same."""

    name: str

    def of(self, _):
        return self.name


def make_run(store, folder, **options):
    return store.Run(Sizes('small'), 'mixtures', folder, **options)


def table_of(value):
    return QTable({'value': [value]})


def test_an_unknown_figure_is_refused_with_the_names_of_all():
    result = subprocess.run(
        [sys.executable, FOLDER / 'reproduce.py', '--figures', 'fig99'],
        capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert result.returncode == 2
    assert 'fig14' in result.stderr
    assert 'fig99' in result.stderr


@pytest.mark.usefixtures('store')
def test_every_figure_that_has_a_name_is_in_one_group():
    import reproduce
    keys = [figure.key for group in reproduce.GROUPS
            for figure in group.figures]
    assert sorted(keys) == sorted(reproduce.ORDER)


def test_a_stored_table_is_used_again(store, tmp_path):
    run = make_run(store, tmp_path)
    run.table('one', lambda: table_of(1.0))
    assert run.table('one', lambda: table_of(2.0))['value'][0] == 1


@pytest.mark.parametrize('options', [{'redo': True}, {}])
def test_a_table_is_measured_again_when_it_must_be(store, tmp_path, options):
    make_run(store, tmp_path).table('one', lambda: table_of(1.0))
    settings = Sizes('small' if options else 'large')
    run = store.Run(settings, 'mixtures', tmp_path, **options)
    assert run.table('one', lambda: table_of(2.0))['value'][0] == 2


def test_only_a_number_within_the_printed_one_is_called_reached(store):
    below = store.Comparison.below
    assert below('error', 0.86, 0.5, why='noise',
                 full=True).verdict == 'reached'
    assert below('error', 0.86, 0.9, why='noise',
                 full=True).verdict == 'worse: noise'
    assert below('error', 0.86, np.nan, why='noise').verdict.startswith(
        'worse')


def test_only_the_method_and_the_size_of_the_paper_are_called_reached(store):
    below = store.Comparison.below
    assert below('error', 0.86, 0.5).verdict == 'better, in a smaller field'
    assert below('error', 0.86, 0.5, full=True,
                 method=False).verdict == 'better by another method'


@pytest.mark.usefixtures('store')
def test_detectors_have_the_bands_and_places_that_are_known():
    import settings

    from photutils_mgauss import CSST_BANDS, paper_exposures
    counts = {band: list(settings.BANDS.values()).count(band)
              for band in CSST_BANDS}
    assert counts == {'NUV': 4, 'y': 4, 'u': 2, 'g': 2, 'r': 2, 'i': 2,
                      'z': 2}
    for exposure in paper_exposures():
        assert settings.BANDS[exposure.detector] == exposure.band.name
    places = [settings.place_of(number) for number in settings.BANDS]
    # Eighteen places in four columns of five, the corners are spectrographs'.
    assert len(set(places)) == 18
    assert {row for row, _ in places} == set(range(5))
    assert {column for _, column in places} == {1, 2, 3, 4}
    assert settings.place_of(10)[1] == 4
    assert not {10, 21} & set(settings.BANDS)


@pytest.mark.usefixtures('store')
def test_all_effects_of_the_paper_are_on():
    from settings import effects
    found = effects()
    for name in ('prnu', 'hot_pixels', 'warm_pixels', 'dead_pixels',
                 'bad_columns', 'cosmic_rays', 'nonlinearity', 'bleeding',
                 'charge_diffusion', 'large_scale_flat', 'flat_error',
                 'shutter'):
        assert getattr(found, name) > 0


def test_a_step_that_finds_everything_keeps_its_first_cost(store, tmp_path):
    run = make_run(store, tmp_path)
    with run.step('one'):
        run.table('one', lambda: table_of(sum(range(2_000_000))))
        first = run.cost()
        run.table('one', lambda: table_of(2.0))
        assert run.cost() == first
    assert first[0] > 0


def test_a_table_that_needs_another_does_not_count_its_cost(
        store, tmp_path, monkeypatch):
    run = make_run(store, tmp_path)
    # A clock of its own: on a busy machine writing a table takes seconds.
    clock = [0.0]
    monkeypatch.setattr(store, 'time', SimpleNamespace(
        perf_counter=lambda: clock[0]))

    def inner():
        clock[0] += 0.3
        return table_of(1.0)
    run.table('outer', lambda: run.table('inner', inner, keep=False))
    assert run.cost()[0] == 0.3
    # The cost of what is not kept stays known.
    (tmp_path / 'partial' / 'inner.ecsv').unlink()
    assert run.cost()[0] == 0.3


def test_measuring_again_does_so_once(store, tmp_path):
    run = make_run(store, tmp_path, redo=True)
    run.table('one', lambda: table_of(1.0))
    assert run.table('one', lambda: table_of(2.0))['value'][0] == 1


@pytest.mark.usefixtures('store')
def test_other_settings_of_one_step_do_not_measure_others_again():
    from dataclasses import replace

    from settings import FULL
    other = replace(FULL, crowded_shape=(10, 10))
    assert other.of('sky') == FULL.of('sky')
    assert other.of('crowded') != FULL.of('crowded')


@pytest.mark.usefixtures('store')
def test_every_step_is_told_all_that_it_may_read():
    import reproduce
    from settings import FULL, TOLD
    assert {group.name for group in reproduce.GROUPS} < set(TOLD)
    told = {name for names in TOLD.values() for name in names}
    assert told | {'name'} == set(vars(FULL))


def test_seeds_do_not_share_tables(store, tmp_path):
    make_run(store, tmp_path).table('one', lambda: table_of(1.0))
    other = make_run(store, tmp_path, seed=1)
    assert other.table('one', lambda: table_of(2.0))['value'][0] == 2


@pytest.mark.usefixtures('store')
def test_a_full_run_is_as_much_work_as_a_full_run():
    import reproduce
    import settings
    from summary import full_work
    for group in reproduce.GROUPS:
        assert full_work(group.name, settings.FULL) == pytest.approx(1)
        assert full_work(group.name, settings.HALF) >= 1


@pytest.mark.usefixtures('store')
def test_the_page_puts_the_second_seed_beside_the_first(store):
    from summary import _table
    lines = [store.Comparison('error', '1 mas', '0.5 mas', 'better')]
    again = [store.Comparison('error', '1 mas', '0.6 mas', 'better')]
    text = ' '.join(_table(lines, [again]))
    assert text.index('0.5 mas') < text.index('0.6 mas')


@pytest.mark.usefixtures('store')
def test_sources_are_the_same_only_where_they_are_close_both_ways():
    from astropy.coordinates import SkyCoord
    from sky_measures import _same
    true = SkyCoord([10.0, 10.001], [0.0, 0.0], unit='deg')
    found = SkyCoord(10 + np.array([0.04, 0.1, 3.0, 3.7]) / 3600,
                     np.zeros(4), unit='deg')
    i, j = _same(found, true)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0),
                                                               (3, 1)]


def test_the_spread_of_normal_numbers_is_their_width(store):
    values = np.random.default_rng(1).normal(0, 3, 20000)
    assert store.spread(values) == pytest.approx(3, rel=0.03)


@pytest.mark.usefixtures('store')
def test_a_robust_fit_forgets_outliers():
    from scenes import robust_fit
    rng = np.random.default_rng(2)
    terms = np.column_stack([np.ones(200), rng.uniform(-1, 1, 200)])
    values = terms @ [[1.0, 2.0], [0.5, -1.0]] + rng.normal(0, .01, (200, 2))
    values[::20] += 5
    np.testing.assert_allclose(robust_fit(terms, values),
                               [[1.0, 2.0], [0.5, -1.0]], atol=0.01)


@pytest.mark.usefixtures('store')
def test_a_star_counts_once_however_many_are_listed():
    from crowded_figures import _pairs
    truth = QTable({'x': [10.0, 30.0], 'y': [10.0, 30.0],
                    'mag': [20.0, 20.0]})
    listed = QTable({'x': [10.2, 10.1, 30.0], 'y': [10.0, 10.0, 30.4],
                     'flux': [1.0, 1.0, 1.0]})
    i, j = _pairs(listed, truth, 20.0, 0.5, 1.0)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(1, 0),
                                                               (2, 1)]


def test_positions_keep_all_their_digits_until_they_are_summed_up(store,
                                                                  tmp_path):
    run = make_run(store, tmp_path)
    place = 1234.567890123
    run.table('one', lambda: table_of(place), keep=False)
    again = run.table('one', lambda: table_of(0.0), keep=False)
    assert again['value'][0] == place


@pytest.mark.usefixtures('store')
def test_images_that_went_through_files_are_the_same_but_for_rounding():
    from scenes import through_files

    from photutils_mgauss import (
        DetectorEffects,
        Instrument,
        simulate,
        sparse_field,
    )
    scene = simulate(sparse_field((90, 80), rng=1), rng=2,
                     effects=DetectorEffects.typical(),
                     instrument=Instrument(shape=(90, 80)))
    read = through_files(scene)
    assert scene.mask.any()
    np.testing.assert_array_equal(read.mask, scene.mask)
    np.testing.assert_allclose(read.image, scene.image, rtol=1e-5)
    good = ~scene.mask
    np.testing.assert_allclose(read.error[good], scene.error[good],
                               rtol=1e-5)
    assert np.isfinite(read.error).all()


@pytest.mark.usefixtures('store')
def test_a_program_that_is_not_there_is_said_to_be_absent(monkeypatch):
    from daophot import daophot
    from peers import AbsentError
    monkeypatch.setenv('PATH', '')
    with pytest.raises(AbsentError, match='apt-get install iraf-noao'):
        daophot(None, None, None, 1)


@pytest.mark.usefixtures('store')
def test_daophot_finds_the_stars_where_they_are(monkeypatch):
    from daophot import daophot
    from peers import AbsentError, program
    try:
        program('DAOPHOT', 'irafcl')
    except AbsentError as error:
        pytest.skip(str(error))
    from photutils_mgauss import Instrument, simulate, sparse_field
    scene = simulate(sparse_field((300, 310), spacing=40, rng=1), rng=2,
                     instrument=Instrument(shape=(300, 310)))
    true = scene.truth[scene.truth['inside']]
    true = true[np.argsort(true['mag'])]
    bright = QTable({'x': true['x'].value[:20], 'y': true['y'].value[:20]})
    found = daophot(scene, scene, bright, 0)
    away = np.hypot(
        *(found[c][:, None] - bright[c] for c in 'xy')).min(axis=0)
    # Convention of the first pixel, and the scale of the fluxes.
    assert np.median(away) < 0.05
    nearest = np.hypot(*(found[c][:, None] - bright[c]
                         for c in 'xy')).argmin(axis=0)
    ratio = found['flux'][nearest] / true['flux'].value[:20]
    assert abs(np.median(ratio) - 1) < 0.3


@pytest.mark.usefixtures('store')
@pytest.mark.parametrize(('ours', 'again', 'spread'), [
    ('0.86 mas', '0.76 mas', '0.07'),
    ('-0.0010 +- 0.0325', '+0.0010 +- 0.0325', '0.0014, 0.0000'),
    ('1.31 / 2.21; 2.10 mas (35 stars)', '1.31 / 2.21; 2.10 mas (9 stars)',
     ''),
    ('5.0', '5.0, 6.0', '')])
def test_the_spread_is_what_two_values_say_of_the_scatter(ours, again,
                                                          spread):
    from summary import spread_of
    assert spread_of(ours, again) == spread


@pytest.mark.usefixtures('store')
def test_the_page_says_what_each_seed_costs_and_which_code_ran(store,
                                                               tmp_path):
    import summary
    from settings import QUICK
    runs = [store.Run(QUICK, 'mixtures', tmp_path / f'{seed}', seed=seed)
            for seed in range(2)]
    for run in runs:
        with run.step('sky'):
            run.table('one', lambda: table_of(sum(range(100_000))))
    figure = store.Figure('fig8', 'Fig. 8', 'Words.', None)
    lines = [store.Comparison('error', '1 mas', '0.5 mas', 'better')]
    summary.write(tmp_path, {'sky': runs},
                  {'fig8': ('sky', figure, [lines, lines])},
                  ('fig8', 'fig9'), {'DOLPHOT': 'not there'})
    page = ' '.join((tmp_path / 'summary.rst').read_text().split())
    for words in ('Wall, seed 0 [s]', 'CPU, seed 1 [s]', 'Size *quick*',
                  '--size quick --figures fig8 --seeds 2',
                  store.versions()['photutils_mgauss'],
                  store.provenance()['date'], 'DOLPHOT: not there',
                  'fig9: not measured'):
        assert words in page


def stored(folder, size, name, seed=0):
    """Write tables of a group as if measured; return its name and run."""
    import reproduce
    import settings
    run = reproduce.of_seed(reproduce.Run(settings.SIZES[size], 'galsim',
                                          folder), seed)
    group, = (one for one in reproduce.GROUPS if one.name == name)
    with run.step(name):
        for table in group.tables:
            run.table(table, lambda: table_of(1.0))
    return group


@pytest.mark.usefixtures('store')
def test_a_folder_keeps_what_other_sizes_made_for_other_figures(tmp_path):
    import reproduce
    sky = stored(tmp_path, 'half', 'sky')
    maps = stored(tmp_path, 'full', 'maps')
    stored(tmp_path, 'full', 'maps', seed=1)
    options = reproduce.arguments(['--quick', '--output', str(tmp_path)])
    found = {group.name: [(run.settings.name, run.seed) for run in
                          reproduce.stored(options, group)]
             for group in reproduce.GROUPS}
    assert found[sky.name] == [('half', 0)]
    assert found[maps.name] == [('full', 0), ('full', 1)]
    assert found['crowded'] == []


@pytest.mark.usefixtures('store')
def test_a_group_of_which_tables_are_missing_is_not_on_the_page(tmp_path):
    import reproduce
    group = stored(tmp_path, 'full', 'crowded')
    (tmp_path / 'tables' / f'{group.tables[-1]}.ecsv').unlink()
    options = reproduce.arguments(['--output', str(tmp_path)])
    assert reproduce.stored(options, group) == []


@pytest.mark.usefixtures('store')
def test_a_part_of_the_crowded_chip_does_not_reach_the_paper():
    from dataclasses import replace

    import crowded_figures
    from settings import DETECTOR, FULL
    names = [*crowded_figures.SEXTRACTOR, crowded_figures.PAPER,
             crowded_figures.OURS]
    errors = QTable({
        'method': names, 'mag': np.full(5, 22.5) * u.mag,
        'median_error': [5.0, 5.0, 5.0, 1.0, 1.0] * u.mas,
        'crowded_same_stars': np.ones(5) * u.mas,
        'completeness': np.ones(5)})
    windows = QTable({'mag': [] * u.mag})

    def judged(settings):
        lines = crowded_figures.compare_errors({
            'run': SimpleNamespace(settings=settings),
            'errors': errors, 'windows': windows})
        return lines[0].verdict
    assert judged(FULL) == 'better, in a smaller field'
    assert judged(replace(FULL, crowded_shape=DETECTOR)) == 'reached'


@pytest.mark.usefixtures('store')
def test_a_whole_detector_has_the_point_sources_of_the_paper():
    from scenes import paper_stars
    from settings import DETECTOR, FULL
    stars = paper_stars(DETECTOR, 1)
    # 1523 in 2.17 square degrees, seen in 135 pointings.
    assert len(stars) == pytest.approx(3406, abs=2)
    assert FULL.psf_sources == len(stars)
    assert len(paper_stars((4616, 9216), 1)) == pytest.approx(1703, abs=1)
    assert stars['x'].value.max() > 9200 > 100 > stars['x'].value.min()


@pytest.mark.usefixtures('store')
def test_the_page_of_the_committed_results_is_that_of_its_tables():
    import reproduce
    options = reproduce.arguments(['--output', str(FOLDER / 'results')])
    found = [group for group in reproduce.GROUPS
             if reproduce.stored(options, group)]
    page = (FOLDER / 'results' / 'summary.rst').read_text()
    for group in found:
        for figure in group.figures:
            assert figure.title in page
    assert len(found) == len(reproduce.GROUPS)


@pytest.mark.usefixtures('store')
def test_dates_alone_say_how_little_more_observations_help():
    from sky_figures import dates_alone
    # Two dates that are 3.607 years apart.
    assert dates_alone((0, 6)) == pytest.approx(np.sqrt(2) / 3.607, rel=1e-3)
    assert dates_alone(range(7)) == pytest.approx(0.355, abs=0.001)
