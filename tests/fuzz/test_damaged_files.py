"""Readers and damaged files: 500 of the cases of `campaign`."""
import sys

import numpy as np
import pytest

from fuzz import campaign

pytestmark = pytest.mark.skipif(
    sys.platform != 'linux', reason='memory is limited as Linux does')

CHECKED = ('grid.fits', 'grid.fits.gz', 'mixture.fits', 'field.fits')


@pytest.fixture(scope='module')
def result():
    """Return the table and the failures of 500 cases."""
    return campaign.run(500)


def test_every_reader_gives_a_clean_error_or_a_value(result):
    table, failures = result
    assert sum(table.values(), start=campaign.Counter()).total() == 500
    assert not failures, '\n'.join([*failures, campaign.describe(table)])


def test_most_damage_is_noticed(result):
    table, _ = result
    total = sum(table.values(), start=campaign.Counter())
    assert total['clean error'] > 300
    assert total['equal'] > 10


def test_files_with_checksums_are_never_read_wrong(result):
    table, _ = result
    assert [table[name]['different'] for name in CHECKED] == [0, 0, 0, 0]


def test_the_cases_are_the_same_every_time():
    kinds = ['stars.ecsv', 'chips.psf']
    first, again = (campaign.run(40, kinds=kinds)[0] for _ in range(2))
    assert first == again


@pytest.mark.parametrize(('read', 'found'), [
    (lambda path: path.name, 'equal'),
    (lambda path: 3, 'different'),
    (lambda path: {}['a'], 'unclean'),
    (lambda path: int('a'), 'unclean'),
    (lambda path: path.with_name('missing').read_text(), 'clean error'),
    (lambda path: np.zeros(2**28), 'memory'),
    (lambda path: next(i for i in iter(int, 1) if i), 'hang'),
], ids=['value', 'other value', 'KeyError', 'no name', 'OSError', '2 GB',
        'for ever'])
def test_the_campaign_sees_what_is_wrong(read, found, tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, 'LONGEST', 0.3)
    path = tmp_path / 'a.fits'
    assert campaign.outcome(path, read, 'a.fits')[0] == found
