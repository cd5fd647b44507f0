"""The command that repeats the paper: what it accepts, stores and says."""
import os
import subprocess
import sys
from pathlib import Path

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


def make_run(store, folder, **options):
    return store.Run('small', 'mixtures', folder, **options)


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
    settings = 'small' if options else 'large'
    run = store.Run(settings, 'mixtures', tmp_path, **options)
    assert run.table('one', lambda: table_of(2.0))['value'][0] == 2


def test_only_a_number_within_the_printed_one_is_called_reached(store):
    below = store.Comparison.below
    assert below('error', 0.86, 0.5, why='noise').verdict == 'reached'
    assert below('error', 0.86, 0.9, why='noise').verdict == 'worse: noise'
    assert below('error', 0.86, np.nan, why='noise').verdict.startswith(
        'worse')


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
