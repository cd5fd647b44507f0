"""Solutions that look like any other, and are wrong: that must be said."""
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss import Epoch, ProperMotionFitter

N = 80
UNIT = u.mas / u.yr


@pytest.fixture
def scene(rng):
    """Epochs of stars that move, and a catalogue that is right."""
    ra, dec = 150 + rng.uniform(-0.03, 0.03, N), 2 + rng.uniform(
        -0.03, 0.03, N)
    motion = rng.normal(0, 5, (2, N))
    epochs = []
    for year in (2014.0, 2017.0, 2019.0, 2022.0):
        east, north = motion * (year - 2016) + rng.normal(0, 0.3, (2, N))
        epochs.append(Epoch(Table({
            'id': np.arange(N),
            'ra': ra + (east + 20) / 3.6e6 / np.cos(np.radians(dec)),
            'dec': dec + (north - 30) / 3.6e6, 'ra_error': np.full(N, 0.3),
            'dec_error': np.full(N, 0.3)}), time=year))
    catalogue = QTable({
        'id': np.arange(N), 'ra': ra * u.deg, 'dec': dec * u.deg,
        'ra_error': np.full(N, 0.1) * u.mas,
        'dec_error': np.full(N, 0.1) * u.mas,
        'ref_epoch': np.full(N, 2016.0) * u.yr})
    for k, name in enumerate(('pmra', 'pmdec')):
        catalogue[name] = (motion[k] + rng.normal(0, 0.05, N)) * UNIT
        catalogue[f'{name}_error'] = np.full(N, 0.05) * UNIT
    return epochs, catalogue


def fit(epochs, references, **keywords):
    """Return the solution and the sentences of its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        solution = ProperMotionFitter(references=references, **keywords).fit(
            epochs)
    assert all(issubclass(one.category, AstropyUserWarning)
               for one in caught)
    return solution, [str(one.message) for one in caught]


@pytest.mark.parametrize('by_place', [False, True])
def test_a_catalogue_that_is_right_raises_no_doubt(scene, by_place):
    epochs, catalogue = scene
    if by_place:
        catalogue.remove_column('id')
    solution, said = fit(epochs, catalogue)
    assert said == []
    assert solution.notes == ()


def reverse(table, *names):
    for name in names:
        table[name] = table[name][::-1].copy()


def scale(factor, table, *names):
    for name in names:
        table[name] = table[name] * factor


WRONG = {
    'motions of other stars': lambda t: reverse(t, 'pmra', 'pmdec'),
    'places of other stars': lambda t: reverse(t, 'ra', 'dec'),
    'motions in another unit': lambda t: scale(1e-3, t, 'pmra', 'pmdec'),
    'a sign': lambda t: scale(-1, t, 'pmra'),
    'the epoch': lambda t: t.replace_column(
        'ref_epoch', np.full(N, 2000.0) * u.yr),
    'half a year': lambda t: t.replace_column(
        'ref_epoch', np.full(N, 2016.5) * u.yr),
    'stars called quasars': lambda t: t.add_column('qso', name='class'),
}


@pytest.mark.parametrize('what', WRONG)
@pytest.mark.parametrize('by_place', [False, True])
def test_a_catalogue_that_is_wrong_is_warned_of(scene, what, by_place):
    epochs, catalogue = scene
    WRONG[what](catalogue)
    if by_place:
        catalogue.remove_column('id')
    solution, said = fit(epochs, catalogue)
    assert any('contradict' in one for one in said)
    assert set(said) <= set(solution.notes)


def test_errors_in_another_unit_are_warned_of(scene):
    epochs, catalogue = scene
    for epoch in epochs:
        scale(1e-3, epoch.table, 'ra_error', 'dec_error')
    _, said = fit(epochs, catalogue)
    assert 'errors' in said[0]


def test_most_references_rejected_are_warned_of(scene):
    epochs, catalogue = scene
    reverse(catalogue, 'pmra')
    solution, said = fit(epochs, catalogue, systematic=None)
    rejected = int(np.sum(solution.stars['flags'] & 32 > 0))
    assert rejected > N / 4
    assert f'{rejected} of the {N} reference objects were rejected' in said[0]


def test_a_few_references_rejected_are_not(scene):
    epochs, catalogue = scene
    catalogue['pmra'][:5] += 20 * UNIT
    solution, said = fit(epochs, catalogue)
    rejected = set(np.flatnonzero(solution.stars['flags'] & 32))
    assert set(range(5)) <= rejected
    assert len(rejected) <= 10
    assert said == []


def test_residuals_that_nothing_took_up_are_noted(scene):
    epochs, catalogue = scene
    reverse(catalogue, 'pmra')
    solution, _ = fit(epochs, catalogue, systematic=None, clip=None)
    assert any('times more than the errors allow' in note
               for note in solution.notes)


def test_many_detections_rejected_are_noted(scene, rng):
    epochs, catalogue = scene
    for name in ('ra', 'dec'):
        epochs[1].table[name][:30] += rng.normal(0, 30, 30) / 3.6e6
    solution, _ = fit(epochs, catalogue)
    notes = [note for note in solution.notes if 'a quarter' in note]
    assert len(notes) == 1
    assert 'of the 80 detections of epoch 1' in notes[0]


@pytest.mark.parametrize(('references', 'words'), [
    (list(range(1000, 1020)), 'None of the 20 reference objects is among'),
    (QTable({'id': np.arange(1000, 1020), 'class': ['qso'] * 20}),
     'None of the 20 reference objects is among'),
    (QTable({'ra': np.arange(5) * u.arcsec + 10 * u.deg,
             'dec': np.full(5, -60.0) * u.deg, 'class': ['qso'] * 5}),
     'None of the 5 reference objects is among'),
    (QTable({'ra': np.arange(5) * u.arcsec + 151 * u.deg,
             'dec': np.full(5, 2.0) * u.deg, 'class': ['qso'] * 5}),
     'None of the 5 reference objects is among'),
    ([], 'None of the 0 reference objects is among'),
    ('qso', "The column 'qso' marks no star")])
@pytest.mark.parametrize('match_by', ['id', 'sky'])
def test_references_that_are_no_star_are_warned_of(scene, references, words,
                                                   match_by):
    epochs, _ = scene
    for epoch in epochs:
        epoch.table['qso'] = False
    solution, said = fit(epochs, references, match_by=match_by)
    assert words in said[0]
    assert said[0] in solution.notes
    assert (solution.stars['reference'] == '').all()


def test_a_field_of_another_place_is_noted(scene):
    epochs, catalogue = scene
    catalogue['ra'] += 1 * u.deg
    solution, _ = fit(epochs, catalogue)
    assert any('was moved by 3598 arcsec' in note for note in solution.notes)


@pytest.mark.parametrize(('columns', 'words'), [
    (('ra_error', 'dec_error'), 'The positions of the reference objects'),
    (('pmra_error', 'pmdec_error'), 'The motions of the reference objects')])
def test_values_without_errors_are_said_not_to_count(scene, columns, words):
    epochs, catalogue = scene
    catalogue.remove_columns(columns)
    solution, _ = fit(epochs, catalogue)
    assert [note for note in solution.notes if note.startswith(words)]


@pytest.mark.parametrize('value', [np.nan, -0.1, 0.0])
@pytest.mark.parametrize('columns', [('pmra',), ('pmra', 'pmdec')])
def test_motions_without_usable_errors_are_warned_of(scene, columns, value):
    epochs, catalogue = scene
    for name in columns:
        catalogue[f'{name}_error'][:] = value * UNIT
    _, said = fit(epochs, catalogue)
    what = 'motions' if len(columns) == 2 else "values of 'pmra'"
    assert [one for one in said if one.startswith(
        f'The {what} of the reference objects are not used')
        and "'pmra_error'" in one]


def test_a_solution_without_a_motion_is_warned_of(scene):
    epochs, _ = scene
    solution, said = fit(epochs[:2], None, parallax=True)
    assert not np.isfinite(solution.stars['pmra']).any()
    assert said[0].startswith('No star has a motion')
    assert solution.notes.count(said[0]) == 1


def test_the_recipe_of_the_paper_has_no_systematic_errors(scene):
    epochs, catalogue = scene
    _, said = fit(epochs, catalogue, recipe='paper')
    assert said == []


@pytest.mark.parametrize('by_place', [False, True])
def test_a_reference_is_led_back_to_its_row(scene, by_place, tmp_path):
    epochs, catalogue = scene
    catalogue = catalogue[::-1][:40]
    catalogue['source_id'] = 4_000_000_000_000_000_000 + np.asarray(
        catalogue['id'])
    places = catalogue['ra'].value
    if by_place:
        catalogue.remove_column('id')
    solution, _ = fit(epochs, catalogue)
    path = tmp_path / 'motions.ecsv'
    solution.stars.write(path)
    for stars in (solution.stars, QTable.read(path)):
        known = np.asarray(stars['reference_row']) >= 0
        assert known.sum() == 40
        assert (known == (np.asarray(stars['reference']) == 'star')).all()
        rows = np.asarray(stars['reference_row'])[known]
        assert np.abs(places[rows] - stars['ra'].value[known]).max() < 1e-5
        assert (np.asarray(stars['source_id'])[known]
                == catalogue['source_id'][rows]).all()
        assert np.ma.getmaskarray(stars['source_id'])[~known].all()


def test_without_a_table_there_are_no_rows_of_it(scene):
    epochs, _ = scene
    solution, _ = fit(epochs, list(range(10)))
    assert 'reference_row' not in solution.stars.colnames
