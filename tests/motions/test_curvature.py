"""Accelerations and jerks of stars, beside polynomials fitted by NumPy."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.wcs import tan_wcs
from photutils_mgauss import Epoch, ProperMotionFitter

YEARS = np.array([2010.0, 2011.1, 2012.4, 2014.0, 2015.2, 2016.9, 2018.3,
                  2020.0])
ERROR = 0.01


def epochs_of(rng, n=300, acceleration=0.0, jerk=0.0):
    """Return epochs of n stars; the first three do not move straight."""
    place, motion = rng.uniform(0, 900, (2, n)), rng.normal(0, 0.02, (2, n))
    epochs = []
    for year in YEARS:
        t = year - YEARS.mean()
        at = place + motion * t + rng.normal(0, [[ERROR], [2 * ERROR]],
                                             (2, n))
        at[0, :3] += acceleration * t**2 / 2 + jerk * t**3 / 6
        epochs.append(Epoch(Table({
            'id': np.arange(n), 'x_fit': at[0], 'y_fit': at[1],
            'x_err': np.full(n, ERROR), 'y_err': np.full(n, 2 * ERROR)}),
            time=year))
    return epochs


def accelerations(epochs, **options):
    n = len(epochs[0].table)
    return ProperMotionFitter(references=range(n // 2, n), clip=None,
                              systematic=None,
                              **options).fit(epochs).accelerations()


def test_without_frames_they_are_those_of_polynomials(rng):
    epochs = epochs_of(rng, 20, 0.003, 0.001)
    table = accelerations(epochs, transform=None)
    years = np.array([epoch.mean_year for epoch in epochs])
    for axis, name, error in (('x', 'ra', ERROR), ('y', 'dec', 2 * ERROR)):
        places = np.array([epoch.table[f'{axis}_fit'] for epoch in epochs])
        for degree, what, unit in ((2, 'acc', u.pix / u.yr**2),
                                   (3, 'jerk', u.pix / u.yr**3)):
            found, covariance = np.polyfit(
                years - years.mean(), places, degree, cov='unscaled',
                w=np.full(len(years), 1 / error))
            factor = (2, 6)[degree - 2]
            column = table[f'{what}{name}']
            assert column.unit == unit
            # Those of degree 3 are of another time of the acceleration.
            assert_allclose(column.value, factor * found[0], rtol=1e-6,
                            atol=1e-9)
            assert_allclose(table[f'{what}{name}_error'].value,
                            factor * np.sqrt(np.ravel(covariance[0, 0])[0]),
                            rtol=1e-6)
    for what in ('acc', 'jerk'):
        pulls = [table[f'{what}{axis}'].value
                 / table[f'{what}{axis}_error'].value
                 for axis in ('ra', 'dec')]
        assert_allclose(table[f'{what}_significance'], np.hypot(*pulls),
                        rtol=1e-6)


def test_without_any_the_significance_is_that_of_chance(rng):
    table = accelerations(epochs_of(rng, 3000), transform='shift')
    for what in ('acc', 'jerk'):
        chance = table[f'{what}_significance']**2
        for limit in (1.0, 4.0, 9.0):
            expected = np.exp(-limit / 2)
            assert_allclose(np.mean(chance > limit), expected,
                            atol=4 * np.sqrt(expected / 3000))


def test_a_jerk_is_told_from_an_acceleration(rng):
    bent = accelerations(epochs_of(rng, acceleration=0.02))
    assert (bent['acc_significance'][:3] > 20).all()
    assert (bent['jerk_significance'][:3] < 4).all()
    jerked = accelerations(epochs_of(rng, jerk=0.03))
    assert (jerked['jerk_significance'][:3] > 10).all()
    assert_allclose(jerked['jerkra'][:3].value, 0.03, atol=0.005)


def test_few_detections_have_none(rng):
    epochs = epochs_of(rng, 40)
    for epoch in epochs[3:]:
        epoch.table['x_err'][0] = np.nan
    for epoch in epochs[:5]:
        epoch.table['x_err'][1] = np.nan
    table = accelerations(epochs, transform=None)
    assert np.isfinite(table['acc_significance'][2:]).all()
    assert np.isnan(table['jerk_significance'][:2]).all()


def test_on_the_sky_they_are_towards_east_and_north(rng):
    ra, dec = 40 + rng.uniform(0, 0.01, 30), 88 + rng.uniform(0, 0.01, 30)
    epochs = []
    for year in YEARS:
        t = year - YEARS.mean()
        north = np.where(np.arange(30) == 4, 0.5 * t**2 / 2, 0.0)  # mas
        epochs.append(Epoch(Table({
            'id': np.arange(30), 'ra': ra, 'dec': dec + north / 3.6e6,
            'ra_error': np.full(30, 0.1), 'dec_error': np.full(30, 0.1)}),
            time=year))
    table = accelerations(epochs, transform=None)
    assert table['accdec'].unit == u.mas / u.yr**2
    assert_allclose(table['accdec'][4].value, 0.5, atol=1e-3)
    assert_allclose(table['accra'][4].value, 0, atol=1e-3)


def on_the_sky(rng, n_epochs, n=60):
    """Return the epochs of stars that stand still, one each year."""
    place = rng.uniform(0, 9000, (2, n))
    epochs = []
    for year in 2018.0 + np.arange(n_epochs):
        x, y = place + rng.normal(0, ERROR, (2, n))
        epochs.append(Epoch(Table({
            'id': np.arange(n), 'x_fit': x, 'y_fit': y,
            'x_err': np.full(n, ERROR), 'y_err': np.full(n, ERROR)}),
            tan_wcs(100, 20), year))
    return epochs


@pytest.mark.parametrize('parallax', [False, True])
def test_accelerations_take_as_many_epochs_as_the_pages_say(rng, parallax):
    for n_epochs in (3, 4, 5):
        fitter = ProperMotionFitter(parallax=parallax)
        table = fitter.fit(on_the_sky(rng, n_epochs)).accelerations()
        for name, enough in (('acc', 3), ('jerk', 4)):
            known = np.isfinite(table[f'{name}_significance'])
            assert (known == (n_epochs >= enough + parallax)).all()


def test_a_warning_and_a_note_say_why_no_star_has_a_motion(rng):
    with pytest.warns(UserWarning, match='No star has a motion'):
        solution = ProperMotionFitter(parallax=True).fit(on_the_sky(rng, 2))
    assert solution.notes[0].startswith(
        'No star has a motion: position, motion and parallax take good '
        'detections at 3 times or more')
    assert (solution.stars['flags'] & 1 == 1).all()
