"""Errors that are wrong in different ways at different magnitudes."""
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, ProperMotionFitter
from photutils_mgauss.motions.error_scale import fit_error_scale

YEARS = (2010.0, 2012.0, 2013.5, 2015.0, 2018.0, 2020.0)


def wrong_factor(magnitude):
    """Return by how much stated errors are to be multiplied."""
    return np.exp(0.7 * np.sin((magnitude - 18) / 1.5))


def seen(rng, n=500, factor=wrong_factor, floor=0.0, outliers=0.0):
    """Return the epochs of stars, and their motions [pix / yr]."""
    magnitude = rng.uniform(15, 22, n)
    stated = 0.002 * 10**(0.2 * (magnitude - 15))
    place, motion = rng.uniform(0, 2000, (2, n)), rng.normal(0, 0.05, (2, n))
    epochs = []
    for year in YEARS:
        error = np.hypot(stated * factor(magnitude), floor)
        bad = rng.uniform(size=n) < outliers
        error = np.where(bad, 20 * error, error)
        x, y = (place + motion * (year - 2015)
                + error * rng.standard_normal((2, n)))
        epochs.append(Epoch(Table({
            'id': np.arange(n), 'x_fit': x, 'y_fit': y, 'x_err': stated,
            'y_err': stated, 'flux_fit': 10**(-0.4 * (magnitude - 25))}),
            time=year))
    return epochs, motion, magnitude


def solved(epochs, motion, systematic):
    """Return away / error, error (2, n) and the solution of free stars."""
    known = Table({'id': np.arange(0, len(motion[0]), 5)})
    known['ref_epoch'] = 2015.0
    for name, values in zip(('pmra', 'pmdec'), motion[:, ::5], strict=True):
        known[name] = values
        known[f'{name}_error'] = 1e-5
    fitter = ProperMotionFitter(systematic=systematic, references=known)
    solution = fitter.fit(epochs)
    stars = solution.stars
    free = np.asarray(stars['id']) % 5 > 0
    away, error = (np.stack([stars[f'{name}{what}'].value[free]
                             for name in ('pmra', 'pmdec')])
                   for what in ('', '_error'))
    away = away - motion[:, np.asarray(stars['id'])[free]]
    return away / error, error, solution


@pytest.mark.parametrize(('floor', 'outliers'), [(0.0, 0.0), (0.006, 0.01)])
def test_pulls_are_one_at_every_magnitude(rng, floor, outliers):
    epochs, motion, magnitude = seen(rng, floor=floor, outliers=outliers)
    own, _, solution = solved(epochs, motion, 'magnitude')
    ids = np.asarray(solution.stars['id'])
    mag = magnitude[ids[ids % 5 > 0]]
    for low in range(15, 22):
        here = (mag >= low) & (mag < low + 1)
        n = 2 * here.sum()
        size = np.sqrt(np.mean(own[:, here]**2))
        assert abs(size - 1) < 0.06 + 2 / np.sqrt(2 * n)
    n = own.size
    assert_allclose(np.sqrt(np.mean(own**2)), 1, atol=3 / np.sqrt(2 * n))


def test_motions_are_better_than_with_one_floor(rng):
    epochs, motion, _ = seen(rng)
    rms = {}
    for systematic in ('fit', 'magnitude'):
        own, error, _ = solved(epochs, motion, systematic)
        rms[systematic] = np.median(np.abs(own * error))
    assert rms['magnitude'] < rms['fit']


def test_right_errors_stay_as_they_are(rng):
    epochs, motion, _ = seen(rng, factor=np.ones_like)
    errors, away = {}, {}
    for systematic in (None, 'magnitude'):
        own, errors[systematic], _ = solved(epochs, motion, systematic)
        away[systematic] = own * errors[systematic]
    ratio = errors['magnitude'] / errors[None]
    assert_allclose(np.median(ratio), 1, atol=0.02)
    rms = [np.sqrt(np.mean((one / errors[None])**2))
           for one in away.values()]
    assert rms[1] < 1.01 * rms[0]


def test_the_table_of_epochs_says_what_was_found(rng):
    epochs, _, _ = seen(rng)
    table = ProperMotionFitter(systematic='magnitude').fit(epochs).alignment
    assert table['error_factor'].shape == (6, 9)
    # Epochs have magnitudes of zero point 0 here: flux 1 is 25 mag.
    there = table['error_magnitude'] + 25
    inside = (there > 15.5) & (there < 21.5)
    assert_allclose(np.log(table['error_factor'])[inside],
                    np.log(wrong_factor(there))[inside], atol=0.25)


def test_lists_without_magnitudes_are_refused_in_words(rng):
    epochs, _, _ = seen(rng, n=30)
    bare = [Epoch(one.table['id', 'x_fit', 'y_fit', 'x_err', 'y_err'],
                  time=one.time) for one in epochs]
    with pytest.raises(ValueError, match=r'mag or flux_fit'):
        ProperMotionFitter(systematic='magnitude').fit(bare)


def test_scale_and_floor_of_known_residuals(rng):
    n = 4000
    magnitude = rng.uniform(15, 20, n)
    variance = 10**rng.uniform(-2, 1, n)
    truth = 4 * variance + 0.5
    residuals = np.sqrt(truth) * rng.standard_normal((2, n))
    stated = np.stack([variance, np.zeros(n), variance])
    found = fit_error_scale(magnitude, residuals, stated, np.full(n, 2.0))
    assert_allclose(found.at(np.array([15.5, 17.0, np.nan])), 4, rtol=0.1)
    assert_allclose(found.floor, 0.5, rtol=0.1)
    half = fit_error_scale(magnitude, residuals / np.sqrt(2), stated,
                           np.full(n, 1.0))  # half of it was fitted away
    assert_allclose(half.floor, 0.5, rtol=0.1)


def test_renormalised_errors_are_one_at_every_magnitude(rng):
    epochs, _, magnitude = seen(rng)
    stars = ProperMotionFitter(systematic=None, clip=None).fit(epochs).stars
    mag = magnitude[np.asarray(stars['id'])]
    bright, faint = mag < 16.5, mag > 20.5
    assert np.median(stars['uwe'][bright]) < 0.8
    for some in (bright, faint, (mag > 18) & (mag < 19)):
        assert_allclose(np.median(stars['ruwe'][some]), 1, atol=0.12)


def test_an_acceleration_has_the_significance_of_its_chi_square(rng):
    epochs, _, _ = seen(rng, n=40, factor=np.ones_like)
    for epoch in epochs:
        epoch.table['x_fit'][3] += 0.02 * (epoch.mean_year - 2015)**2
    stars = ProperMotionFitter(acceleration=True, clip=None,
                               transform='shift').fit(epochs).stars
    row = stars[3]
    alone = np.hypot(row['accra'] / row['accra_error'],
                     row['accdec'] / row['accdec_error'])
    assert_allclose(row['acc_significance'], alone, rtol=0.01)
    assert row['acc_significance'] > 10
    assert np.median(stars['acc_significance']) < 3
