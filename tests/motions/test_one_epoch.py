"""One exposure, or many of one night, and a catalogue with places."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.motion_scenes import rms
from helpers.one_epoch import (
    YEAR,
    gaia_table,
    make_sky,
    observe_once,
    pulls,
)
from photutils_mgauss import Epoch, ProperMotionFitter, decode_motion_flags


@pytest.fixture
def scene(rng):
    """Return the sky, its catalogue, and an exposure 12 years before."""
    sky = make_sky(rng)
    return sky, gaia_table(sky, rng), observe_once(sky, rng)


def test_the_pulls_of_one_epoch_and_a_catalogue(scene):
    sky, gaia, epoch = scene
    solution = ProperMotionFitter(references=gaia).fit([epoch])
    for which in (sky.bright, ~sky.bright):
        pull = pulls(solution.stars, sky, which)
        assert pull.shape[1] > 0.98 * which.sum()
        assert abs(rms(pull) - 1) < 0.05 + 1 / np.sqrt(2 * pull.size)
    assert solution.notes == ()


@pytest.mark.parametrize('max_motion', [50, 500])
def test_a_deeper_list_makes_no_wrong_pairs(rng, max_motion):
    # The catalogue has half of the stars, the exposure nine in ten of all.
    sky = make_sky(rng, n=3000, half_width=60)
    stars = np.arange(3000)
    known = stars < 1500
    seen = rng.uniform(size=3000) < 0.9
    epoch = observe_once(sky, rng, which=seen)
    solution = ProperMotionFitter(
        references=gaia_table(sky, rng)[known],
        max_motion=max_motion * u.mas / u.yr).fit([epoch])
    table = solution.stars
    rows = solution._fit.setup.sightings.matches.rows[0]
    true = np.where(rows >= 0, epoch.table['number'][rows], -1)
    row = np.asarray(table['reference_row'])
    both = (row >= 0) & (rows >= 0)
    wrong = both & (row != true)
    with_motion = sky.bright & (stars < 1500)
    # Of the stars with a motion in the catalogue none, flagged or not.
    assert not wrong[with_motion[row]].any()
    assert not (wrong & (table['flags'] & 16 == 0)).any()
    assert both.sum() > 0.99 * (known & seen).sum()
    for which in (with_motion, known & ~sky.bright):
        pull = pulls(table, sky, which)
        assert abs(rms(pull) - 1) < 0.05 + 1 / np.sqrt(2 * pull.size)


def test_it_equals_two_epochs_of_which_the_catalogue_is_one(scene):
    sky, gaia, epoch = scene
    keywords = {'systematic': None, 'clip': None, 'ref_epoch': YEAR}
    one = ProperMotionFitter(references=gaia, **keywords).fit([epoch]).stars
    motions = gaia[sky.bright]
    motions.remove_columns(['ra_error', 'dec_error'])
    catalogue = gaia['ra', 'dec', 'ra_error', 'dec_error']
    two = ProperMotionFitter(references=motions, **keywords).fit(
        [epoch, Epoch(catalogue, time=YEAR)]).stars
    two = two[two['n_good_obs'] == 2]
    assert len(two) == len(sky.ra)
    by_place = np.argmin(np.hypot(
        one['ra'].value[:, None] - two['ra'].value,
        one['dec'].value[:, None] - two['dec'].value), axis=1)
    other = two[by_place]
    for name in ('pmra', 'pmdec'):
        error = one[f'{name}_error'].value
        assert_allclose(error, other[f'{name}_error'].value, rtol=1e-5)
        away = one[name].value - other[name].value
        assert np.abs(away / error).max() < 5e-3


def test_chips_of_one_night(rng):
    sky = make_sky(rng, n=2000)
    gaia = gaia_table(sky, rng)
    known = np.arange(2000) < 1800
    epochs = [observe_once(sky, rng, year=2004.0 + 1e-5 * k, shape=1500,
                           centre=(80 + east, -30 + north))
              for k, (east, north) in enumerate(
                  [(-0.016, -0.014), (0.016, -0.014),
                   (-0.016, 0.014), (0.016, 0.014)])]
    solution = ProperMotionFitter(references=gaia[known]).fit(epochs)
    stars = solution.stars
    pull = pulls(stars, sky, np.ones(2000, dtype=bool))
    assert pull.shape[1] > 1200
    assert abs(rms(pull) - 1) < 0.05
    # Two chips see some stars that the catalogue has not, minutes apart.
    alone = stars['reference_row'] < 0
    assert (stars['n_obs'][alone] > 1).any()
    assert np.isnan(stars['pmra'][alone]).all()
    assert (stars['flags'][alone] & 1 == 1).all()
    assert solution.notes == ()


def test_a_wrong_motion_is_not_that_of_the_two_places(scene):
    sky, gaia, epoch = scene
    wrong = int(np.flatnonzero(sky.bright)[3])
    gaia['pmra'][wrong] += 20 * gaia['pmra'].unit
    stars = ProperMotionFitter(references=gaia).fit([epoch]).stars
    star = stars[stars['reference_row'] == wrong][0]
    assert any(words.startswith('reference_rejected')
               for words in decode_motion_flags(star['flags']))
    assert abs(star['pmra'].value - sky.pm[0, wrong]) < (
        5 * star['pmra_error'].value)
    assert np.sum(stars['flags'] & 32 > 0) < 5


def test_references_held_out_are_measured(scene):
    sky, gaia, epoch = scene
    solution = ProperMotionFitter(references=gaia, hold_out=0.2,
                                  rng=1).fit([epoch])
    table = solution.validation()
    table = table[np.isfinite(table['chi2'])]
    assert len(table) > 0.7 * 0.2 * len(sky.ra)
    assert abs(np.mean(table['chi2']) / 2 - 1) < 0.15


def test_the_leak_of_a_parallax_is_that_of_one_epoch(scene):
    _, gaia, epoch = scene
    solution = ProperMotionFitter(references=gaia).fit([epoch])
    faint = np.flatnonzero(solution.stars['reference'] == 'position')
    leak = solution.stars['pmra_per_parallax'][faint].value
    # The factor of the exposure over the years, catalogues having none.
    setup = solution._fit.setup
    factors = setup.sightings.plane.parallax_factors(
        setup.origin[:, faint], setup.sightings.observer[:, 0])
    assert_allclose(leak, factors[0] / (2004.0 - YEAR), rtol=1e-3, atol=1e-5)


def test_one_epoch_without_a_baseline_raises(scene):
    _, gaia, epoch = scene
    for name in ('ra_error', 'ref_epoch'):
        bad = gaia.copy()
        bad.remove_column(name)
        if name == 'ref_epoch':
            bad['class'] = np.full(len(bad), 'qso')
        with pytest.raises(ValueError, match='positions with errors'):
            ProperMotionFitter(references=bad).fit([epoch])
    same = gaia.copy()
    same['ref_epoch'] = epoch.mean_year * same['ref_epoch'].unit
    with pytest.raises(ValueError, match='positions with errors'):
        ProperMotionFitter(references=same).fit([epoch])
    with pytest.raises(ValueError, match='epochs must be at least 2'):
        ProperMotionFitter().fit([epoch])


def test_one_epoch_and_a_catalogue_without_motions_raises(scene):
    _, gaia, epoch = scene
    gaia.remove_columns(['pmra', 'pmdec'])
    with pytest.raises(ValueError, match='objects of known motion'):
        ProperMotionFitter(references=gaia).fit([epoch])


def test_one_epoch_and_a_catalogue_elsewhere_raises(scene):
    _, gaia, epoch = scene
    gaia['dec'] = gaia['dec'] + 1 * gaia['dec'].unit
    with pytest.raises(ValueError, match='in common with the references'):
        ProperMotionFitter(references=gaia).fit([epoch])


def test_few_references_of_a_field_are_said(scene):
    _, gaia, epoch = scene
    few = Epoch(epoch.table[::3], epoch.wcs, epoch.time)
    solution = ProperMotionFitter(references=gaia).fit([few])
    assert any('reference objects in the field' in note
               for note in solution.notes)


def test_the_recipe_of_the_paper_needs_two_epochs(scene):
    _, gaia, epoch = scene
    with pytest.raises(ValueError, match='recipe must be'):
        ProperMotionFitter(references=gaia, recipe='paper').fit([epoch])


def test_identifiers_tie_one_epoch_to_a_catalogue(rng):
    n = 60
    place, motion = rng.uniform(0, 1000, (2, n)), rng.normal(0, 1, (2, n))
    error = np.full(n, 0.01)
    x, y = place + 5 * motion
    table = Table({'id': np.arange(n), 'x_fit': x, 'y_fit': y,
                   'x_err': error, 'y_err': error})
    known = Table({'id': np.arange(n), 'x': place[0], 'y': place[1],
                   'x_error': error, 'y_error': error,
                   'pmra': motion[0], 'pmdec': motion[1],
                   'pmra_error': error, 'pmdec_error': error,
                   'ref_epoch': np.full(n, 2010.0)})
    known['pmra'][40:] = np.nan
    stars = ProperMotionFitter(references=known, match_by='id').fit(
        [Epoch(table, time=2015.0)]).stars
    assert_allclose(stars['pmra'].value, motion[0], atol=0.02)
