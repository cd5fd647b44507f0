"""Motions of what cannot be fitted: an error, or a flag for one star."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import Column, Table
from numpy.testing import assert_allclose

from helpers.motion_scenes import (
    changed,
    make_truth,
    observe,
    plane_epochs,
    rms,
)
from helpers.wcs import tan_wcs
from photutils_mgauss import Epoch, ProperMotionFitter, decode_motion_flags


def test_epochs_without_common_stars_raise(rng):
    epochs, _ = plane_epochs(rng)
    epochs = [changed(epoch, id=epoch.table['id'] + 100 * k)
              for k, epoch in enumerate(epochs)]
    with pytest.raises(ValueError, match='epochs must have stars in common'):
        ProperMotionFitter().fit(epochs)


@pytest.mark.parametrize(('column', 'value', 'words'), [
    ('x_err', 0.0, 'epoch 1: none of the 40 errors is positive and finite'),
    ('y_err', np.nan, 'epoch 1: none of the 40 errors is positive and finite'),
    ('y_fit', np.nan, 'epoch 1: none of the 40 positions is finite')])
def test_an_epoch_without_a_usable_row_is_named(rng, column, value, words):
    epochs, _ = plane_epochs(rng, years=(2020.0, 2024.0))
    epochs[1].table[column] = value
    with pytest.raises(ValueError, match=words):
        ProperMotionFitter().fit(epochs)


def test_ra_and_dec_in_the_wrong_order_are_named():
    ones = np.ones(3)
    right = Table({'ra': 120 + ones, 'dec': 10 + ones, 'ra_error': ones,
                   'dec_error': ones})
    wrong = right.copy()
    wrong['ra'], wrong['dec'] = right['dec'], right['ra']
    epochs = [Epoch(table, time=year)
              for year in (2020.0, 2024.0) for table in (right, wrong)]
    words = r'none of the 3 positions is finite \(dec within 90 degrees\)'
    with pytest.raises(ValueError, match=words):
        ProperMotionFitter().fit([epochs[0], epochs[3]])
    with pytest.raises(ValueError, match=r'got none .*\(dec within 90 deg'):
        ProperMotionFitter().fit([epochs[1], epochs[3]])


def test_no_time_baseline_raises(rng):
    epochs, _ = plane_epochs(rng, years=(2020.0, 2020.0))
    with pytest.raises(ValueError, match='time baseline'):
        ProperMotionFitter().fit(epochs)


def test_exposures_of_one_time_are_data(rng):
    epochs, _ = plane_epochs(rng, years=(2020.0, 2020.0, 2024.0, 2024.0))
    fit = ProperMotionFitter(transform='shift', systematic=None).fit(epochs)
    # Two exposures at each end halve the variance of one.
    assert_allclose(np.median(fit.stars['pmra_error'].value), 0.01 / 4,
                    rtol=0.02)
    assert (fit.stars['flags'] & 1 == 0).all()


@pytest.mark.parametrize(('transform', 'n'), [
    ('shift', 0), ('similarity', 1), ('affine', 2), ('poly-2', 5)])
def test_too_few_references_raise(rng, transform, n):
    epochs, _ = plane_epochs(rng)
    marked = [changed(epoch, qso=np.arange(40) < max(n, 1))
              for epoch in epochs]
    if n == 0:
        marked = [changed(one, x_err=np.where(one.table['qso'], np.nan, 0.01))
                  for one in marked]
    with pytest.raises(ValueError, match=f'got {n}$'):
        ProperMotionFitter(transform=transform, references='qso').fit(marked)


@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf])
def test_a_position_that_is_not_finite_is_flagged(rng, value):
    epochs, _ = plane_epochs(rng)
    clean = ProperMotionFitter(systematic=None).fit(epochs)
    epochs[1].table['x_fit'][3] = value
    fit = ProperMotionFitter(systematic=None).fit(epochs)
    assert [words.split(':')[0] for words in decode_motion_flags(
        fit.stars['flags'][3])] == ['bad_position', 'relative']
    assert fit.stars['n_good_obs'][3] == 2
    assert np.isfinite(fit.stars['pmra']).all()
    others = np.arange(40) != 3
    assert_allclose(fit.stars['pmra'][others].value,
                    clean.stars['pmra'][others].value, atol=0.003)


def test_a_masked_position_is_flagged(rng):
    epochs, _ = plane_epochs(rng)
    table = Table(epochs[1].table, masked=True)
    table['y_fit'].mask[5] = True
    epochs[1] = Epoch(table, time=epochs[1].time)
    stars = ProperMotionFitter().fit(epochs).stars
    assert np.flatnonzero(stars['flags'] & 4).tolist() == [5]


@pytest.mark.parametrize('error', [0.0, -1.0, np.nan, np.inf])
def test_an_error_that_is_not_positive_has_no_weight(rng, error):
    epochs, _ = plane_epochs(rng)
    epochs[2].table['y_err'][7] = error
    stars = ProperMotionFitter().fit(epochs).stars
    assert np.flatnonzero(stars['flags'] & 2).tolist() == [7]
    assert stars['n_good_obs'][7] == 2
    assert stars['n_obs'][7] == 3


def test_a_singular_covariance_has_no_weight(rng):
    epochs, _ = plane_epochs(rng)
    epochs = [changed(epoch, xy_cov=np.zeros(40)) for epoch in epochs]
    epochs[0].table['xy_cov'][2] = 0.01**2
    stars = ProperMotionFitter().fit(epochs).stars
    assert np.flatnonzero(stars['flags'] & 2).tolist() == [2]


def test_a_star_seen_once_is_nan_and_flagged(rng):
    epochs, _ = plane_epochs(rng)
    epochs[1] = Epoch(epochs[1].table[1:], time=epochs[1].time)
    epochs[2] = Epoch(epochs[2].table[1:], time=epochs[2].time)
    stars = ProperMotionFitter().fit(epochs).stars
    assert np.flatnonzero(stars['flags'] & 1).tolist() == [0]
    assert np.isnan(stars['pmra'][0])
    assert np.isfinite(stars['pmra'][1:]).all()


def test_two_epochs_give_motions_without_a_chi_square(rng):
    epochs, _ = plane_epochs(rng, years=(2020.0, 2024.0))
    stars = ProperMotionFitter(transform='shift').fit(epochs).stars
    assert np.isfinite(stars['pmra_error']).all()
    for name in ('chi2', 'dof', 'uwe'):
        assert np.isnan(stars[name]).all()


@pytest.mark.parametrize(('keywords', 'words'), [
    ({'transform': 'banana'}, 'transform must be'),
    ({'transform': 'poly-0'}, 'transform must be'),
    ({'distortion': 'soup'}, 'distortion must be'),
    ({'recipe': 'soup'}, 'recipe must be'),
    ({'parallax': 'maybe'}, 'parallax must be'),
    ({'systematic': 'some'}, 'systematic must be'),
    ({'clip': -1}, 'clip must be'),
    ({'match_by': 'eye'}, 'match_by must be'),
    ({'hold_out': 2}, 'hold_out must be'),
])
def test_options_are_checked_when_they_are_given(keywords, words):
    with pytest.raises(ValueError, match=words):
        ProperMotionFitter(**keywords)


@pytest.mark.parametrize(('keywords', 'words'), [
    ({'match_radius': 1.0}, 'match_radius must be a Quantity'),
    ({'systematic': 1.0}, 'systematic must be a Quantity'),
    ({'executor': 3}, 'executor must be'),
])
def test_options_of_a_wrong_type_are_refused(keywords, words):
    with pytest.raises(TypeError, match=words):
        ProperMotionFitter(**keywords)


def test_parallaxes_need_a_sky(rng):
    epochs, _ = plane_epochs(rng)
    with pytest.raises(ValueError, match='parallax must be False'):
        ProperMotionFitter(parallax=True).fit(epochs)


def useless(epoch, kind):
    """Return an epoch of which nothing can be used, of some kind."""
    if kind == 'nowhere':
        nothing = np.full(len(epoch.table), np.nan)
        return changed(epoch, x_fit=nothing)
    return Epoch(epoch.table[:2 if kind == 'few' else 0], epoch.wcs,
                 epoch.time)


@pytest.mark.parametrize('kind', ['nowhere', 'few', 'empty'])
@pytest.mark.parametrize(('references', 'recipe'), [
    ('qso', 'joint'), (None, 'joint'), ('qso', 'paper')])
def test_an_epoch_of_no_use_is_left_out(rng, kind, references, recipe):
    one, two, three = observe(make_truth(rng, n_stars=50, n_qso=50), rng,
                              missing=0.0)[:3]
    fitter = ProperMotionFitter(references=references, recipe=recipe)
    alone = fitter.fit([one, three])
    with pytest.warns(UserWarning, match='Epoch 1 was left out: it must'):
        fit = fitter.fit([one, useless(two, kind), three])
    used = fit.stars[fit.stars['n_good_obs'] > 0]
    for name in ('ra', 'pmra', 'pmdec_error', 'ref_epoch'):
        # The plane touches the sky at the middle of all that was given.
        assert_allclose(used[name].value, alone.stars[name].value,
                        rtol=1e-5, atol=1e-5)
    assert list(fit.alignment['left_out']) == [False, True, False]
    for name in ('shift', 'shift_error', 'matrix', 'rms', 'systematic'):
        assert np.isnan(fit.alignment[name][1]).all()
        assert np.isfinite(fit.alignment[name][::2]).all()
    assert fit.epochs[1].wcs is two.wcs
    rows = fit.residuals[fit.residuals['epoch'] == 1]
    assert not rows['used'].any()
    assert np.isnan(rows['dra'].value).all()


@pytest.mark.parametrize('which', [0, 2])
def test_a_plane_of_no_use_is_left_out(rng, which):
    epochs, _ = plane_epochs(rng)
    alone = ProperMotionFitter().fit(
        [epoch for e, epoch in enumerate(epochs) if e != which])
    epochs[which] = useless(epochs[which], 'nowhere')
    with pytest.warns(UserWarning, match=f'Epoch {which} was left out'):
        fit = ProperMotionFitter().fit(epochs)
    assert_allclose(fit.stars['pmra'].value, alone.stars['pmra'].value)


def test_an_epoch_without_stars_lacks_references(rng):
    epochs = observe(make_truth(rng, n_stars=50, n_qso=50), rng)[:2]
    with pytest.raises(ValueError, match='epoch 1 must have at least 3 '):
        ProperMotionFitter(references='qso').fit(
            [epochs[0], useless(epochs[1], 'few')])


@pytest.mark.parametrize(('keywords', 'kind', 'words'), [
    ({'references': 3}, TypeError, 'references must be a table.*got 3'),
    ({'ref_epoch': np.nan}, ValueError, 'ref_epoch must be finite'),
    ({'ref_epoch': 57388.5}, ValueError, 'ref_epoch must be .*57388.5')])
def test_what_is_found_out_in_the_fit_is_named(rng, keywords, kind, words):
    with pytest.raises(kind, match=words):
        ProperMotionFitter(**keywords).fit(plane_epochs(rng)[0])


def test_a_single_epoch_is_refused(rng):
    epochs, _ = plane_epochs(rng)
    with pytest.raises(ValueError, match='at least 2'):
        ProperMotionFitter().fit(epochs[:1])
    with pytest.raises(TypeError, match='sequence of Epoch'):
        ProperMotionFitter().fit(epochs[0])


def test_identifiers_of_other_stars_stop_the_fit(rng):
    # The same numbers for different stars: nothing agrees.
    epochs, _ = plane_epochs(rng, n=60, years=(2020.0, 2021.0, 2022.0))
    mixed = [changed(epoch, id=rng.permutation(60)) for epoch in epochs]
    with pytest.raises(ValueError, match='must agree with the others'):
        ProperMotionFitter(transform='affine').fit(mixed)


@pytest.mark.parametrize('transform', ['similarity', 'affine', 'poly-2'])
def test_wrong_identifiers_of_half_the_stars_do_no_harm(rng, transform):
    epochs, motion = plane_epochs(rng, n=100, years=(2020.0, 2022.0, 2024.0))
    mixed = []
    for epoch in epochs:
        ids = np.arange(100)
        ids[50:] = 50 + rng.permutation(50)
        mixed.append(changed(epoch, id=ids))
    fit = ProperMotionFitter(transform=transform, systematic=None).fit(mixed)
    stars = fit.stars[fit.stars['id'] < 50]
    design = np.column_stack([np.ones(50), stars['x'].value,
                              stars['y'].value])
    if transform == 'poly-2':
        x, y = design[:, 1:].T
        design = np.column_stack([design, x * x, x * y, y * y])
    away = stars['pmra'].value - motion[0, stars['id']]
    field = np.linalg.lstsq(design, away, rcond=None)[0]
    assert rms(away - design @ field) < 0.01
    wrong = fit.stars[fit.stars['id'] >= 50]
    assert np.mean(wrong['flags'] & 512 > 0) > 0.9


def test_a_radius_in_pixels_is_refused_on_the_sky(rng):
    epochs = observe(make_truth(rng, n_stars=20, n_qso=20), rng)[:2]
    with pytest.raises(ValueError, match=r'match_radius must be in a unit '
                       r'like mas, .* got 1\.0 pix'):
        ProperMotionFitter(match_by='sky', match_radius=1 * u.pix).fit(epochs)


def test_epochs_in_pixels_take_a_radius_and_systematic_errors_in_pixels(rng):
    epochs, motion = plane_epochs(rng)
    for epoch in epochs:
        epoch.table.remove_column('id')
    stars = ProperMotionFitter(
        transform='shift', match_radius=2 * u.pix,
        systematic=0.001 * u.pix).fit(epochs).stars
    assert len(stars) == motion.shape[1]
    assert str(stars['pmra'].unit) == 'pix / yr'


def sky_epochs(rng, kind, n=60):
    """Return epochs with a WCS, or with ra and dec, that have all columns."""
    wcs = tan_wcs(150, 2)
    place, motion = rng.uniform(0, 1000, (2, n)), rng.normal(0, 0.01, (2, n))
    motion[:, 20:40] = 0
    epochs = []
    for year in (2020.0, 2021.0, 2022.5):
        x, y = place + motion * (year - 2020) + rng.normal(0, 0.01, (2, n))
        table = Table({'id': np.arange(n), 'flux_fit': np.ones(n),
                       'time': np.full(n, year)})
        if kind == 'pixels':
            table['x_fit'], table['y_fit'] = x, y
            table['x_err'] = table['y_err'] = 0.01
            table['xy_cov'] = 0.0
        else:
            table['ra'], table['dec'] = wcs.all_pix2world(x, y, 0)
            table['ra_error'] = table['dec_error'] = 0.7
        epochs.append(Epoch(table, wcs if kind == 'pixels' else None))
    return epochs


@pytest.mark.parametrize(('kind', 'column'), [
    ('pixels', 'x_fit'), ('pixels', 'y_err'), ('pixels', 'xy_cov'),
    ('pixels', 'time'), ('pixels', 'flux_fit'), ('sky', 'ra'),
    ('sky', 'dec'), ('sky', 'ra_error'), ('sky', 'time')])
@pytest.mark.parametrize('value', [np.inf, -np.inf, np.nan])
def test_one_bad_number_costs_its_own_detection(rng, kind, column, value):
    epochs = sky_epochs(rng, kind)
    damaged, without = (changed(epochs[1]) for _ in range(2))
    damaged.table[column][3] = value
    if column != 'flux_fit':
        without.table.remove_row(3)
    fitter = ProperMotionFitter(references=list(range(20, 40)))
    got, expected = (fitter.fit([epochs[0], one, epochs[2]]).stars
                     for one in (damaged, without))
    for table in (got, expected):
        table.sort('id')
    for name in ('ra', 'dec', 'pmra', 'pmdec', 'pmra_error', 'flux'):
        assert np.isfinite(got[name]).all()
        assert_allclose(got[name].value if got[name].unit else got[name],
                        expected[name].value if expected[name].unit
                        else expected[name], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(('kind', 'column', 'value'), [
    ('pixels', 'x_fit', 1e20), ('sky', 'dec', 1e6), ('sky', 'ra', 1e20)])
def test_a_wild_place_leaves_the_others_alone(rng, kind, column, value):
    epochs = sky_epochs(rng, kind)
    damaged = changed(epochs[1])
    damaged.table[column][3] = value
    fitter = ProperMotionFitter(references=list(range(20, 40)))
    clean, got = (fitter.fit([epochs[0], one, epochs[2]])
                  for one in (epochs[1], damaged))
    others = clean.stars['id'] != 3
    # It was one of sixty that tied the frames.
    assert_allclose(got.stars['pmra'][others].value,
                    clean.stars['pmra'][others].value, atol=0.02)
    assert got.stars['flags'][3] & (4 | 512)
    assert not got.alignment['wcs_residual'].value.max() > 1e-4


def test_a_wild_place_on_a_plane_leaves_the_others_alone(rng):
    epochs, motion = plane_epochs(rng, 60)
    epochs[1].table['x_fit'][3] = 1e20
    got = ProperMotionFitter().fit(epochs).stars
    away = np.delete(got['pmra'].value - motion[0], 3)
    assert_allclose(away - np.median(away), 0, atol=0.04)


def test_a_reference_of_unknown_place_keeps_its_motion(rng):
    epochs = sky_epochs(rng, 'sky')
    table = epochs[0].table
    references = Table({
        'id': np.arange(20, 40), 'ra': table['ra'][20:40],
        'dec': table['dec'][20:40], 'pmra': np.full(20, 3.0),
        'pmdec': np.full(20, -2.0), 'ref_epoch': np.full(20, 2020.0)})
    for name in ('ra', 'dec', 'pmra', 'pmdec'):
        references[f'{name}_error'] = 0.01
    references['ra'][0] = np.inf
    references['parallax'] = np.where(np.arange(20) == 1, np.inf, 0.1)
    references['parallax_error'] = np.where(np.arange(20) == 2, np.inf, 0.1)
    stars = ProperMotionFitter(references=references, clip=None,
                               systematic=None).fit(epochs).stars
    assert np.isfinite(stars['pmra']).all()
    assert_allclose(stars['pmra'][20:23].value, 3.0, atol=0.05)


def scans(rng, *, orbit=0.0, wild=0, n=300, error=0.1):
    """Return many epochs of a star that moves by 3 mas/yr, and circles."""
    years = 2014 + np.sort(rng.uniform(0, 5, n))
    phase = 2 * np.pi * years / 11.6
    east = 3 * (years - 2017) + orbit * np.cos(phase) + rng.normal(
        0, error, n)
    north = 0.6 * orbit * np.sin(phase) + rng.normal(0, error, n)
    east[rng.choice(n, wild, replace=False)] += rng.normal(0, 1000, wild)
    return [Epoch(Table({
        'id': [1], 'ra': [294.8 + x / 3.6e6 / np.cos(np.radians(14.9))],
        'dec': [14.9 + y / 3.6e6], 'ra_error': [error],
        'dec_error': [error]}), time=year)
        for year, x, y in zip(years, east, north, strict=True)]


@pytest.mark.long
@pytest.mark.parametrize('orbit', [3.0, 25.0])
def test_a_binary_keeps_its_detections_and_is_flagged(rng, orbit):
    epochs = scans(rng, orbit=orbit)
    fits = {clip: ProperMotionFitter(transform=None, clip=clip,
                                     match_by='id').fit(epochs)
            for clip in (None, 5.0)}
    star, plain = (fits[clip].stars[0] for clip in (5.0, None))
    assert [words.split(':')[0] for words in decode_motion_flags(
        star['flags'])] == ['inconsistent']
    assert star['n_good_obs'] == 300
    assert star['pmra'] == plain['pmra']
    assert any('one straight motion' in note for note in fits[5.0].notes)


@pytest.mark.parametrize('wild', [1, 5, 60])
def test_many_wild_detections_of_one_star_are_rejected(rng, wild):
    star = ProperMotionFitter(transform=None, match_by='id').fit(
        scans(rng, wild=wild)).stars[0]
    # A few of the wild ones lie within five standard errors.
    assert 300 - wild <= star['n_good_obs'] <= 300 - 0.9 * wild
    assert abs(star['pmra'].value - 3) < 5 * star['pmra_error'].value
    assert star['uwe'] < 1.2


def test_a_scan_along_one_direction_is_one_measurement(rng):
    n, along, across = 40, 0.5, 5000.0
    years = 1990 + np.sort(rng.uniform(0, 3, n))
    sin, cos = (one(np.linspace(0, 7, n)) for one in (np.sin, np.cos))
    offset = np.array([30.0, -55.0])[:, None] * (years - 1991.5)
    scan = offset[0] * sin + offset[1] * cos + rng.normal(0, along, n)
    rows = np.column_stack([sin, cos, sin * (years - 1991.5),
                            cos * (years - 1991.5)])
    answer, chi2 = np.linalg.lstsq(rows, scan, rcond=None)[:2]
    epochs = []
    for year, value, s, c in zip(years, scan, sin, cos, strict=True):
        covariance = (along**2 * np.outer([s, c], [s, c])
                      + across**2 * np.outer([c, -s], [c, -s]))
        errors = np.sqrt(np.diag(covariance))
        epochs.append(Epoch(Table({
            'id': [1], 'ra': [84 + value * s / 3.6e6 / np.cos(np.radians(12))],
            'dec': [-12 + value * c / 3.6e6], 'ra_error': [errors[0]],
            'dec_error': [errors[1]], 'xy_cov': [covariance[0, 1]]}),
            time=year))
    star = ProperMotionFitter(transform=None, clip=None, match_by='id').fit(
        epochs).stars[0]
    assert_allclose([star['pmra'].value, star['pmdec'].value], answer[2:],
                    atol=0.02)
    assert star['dof'] == n - 4
    assert_allclose(star['uwe'], np.sqrt(chi2[0] / along**2 / (n - 4)),
                    rtol=0.01)


def test_flags_of_a_whole_column_are_put_into_words():
    one = decode_motion_flags(8)
    assert decode_motion_flags(Column([8, 0])) == [one, []]
    with pytest.raises(TypeError, match='flags must be integers'):
        decode_motion_flags([1.5])
