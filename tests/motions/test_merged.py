"""Stars of several fields, each once."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable, vstack
from numpy.testing import assert_allclose

from photutils_mgauss import (
    Epoch,
    Instrument,
    ProperMotionFitter,
    paper_exposures,
    simulate_catalogues,
    sky_field,
)
from photutils_mgauss.motions.merged import merge_stars
from photutils_mgauss.motions.tables import GAIA

UNITS = (u.mas, u.mas, u.mas, u.mas / u.yr, u.mas / u.yr)


def star(values, covariance, year=2026.0, flags=0, dec=30.0):
    """Return the row of a star, steps [mas] from a place on the sky."""
    error = np.sqrt(np.diag(covariance))
    dec = dec + values[1] / 3600e3
    row = {'id': 1, 'ra': (359.9999999 + values[0] / 3600e3 / np.cos(
        np.radians(dec))) % 360 * u.deg, 'dec': dec * u.deg}
    row |= {name: values[k] * UNITS[k] for k, name in enumerate(GAIA)
            if k > 1}
    row |= {f'{name}_error': error[k] * UNITS[k]
            for k, name in enumerate(GAIA)}
    row |= {f'{GAIA[i]}_{GAIA[j]}_corr':
            covariance[i, j] / error[i] / error[j]
            for i in range(5) for j in range(i + 1, 5)}
    row |= {'ref_epoch': year, 'n_obs': 4, 'n_good_obs': 3, 'chi2': 2.0,
            'dof': 3, 'uwe': 1.5, 'ruwe': 1.0, 'flags': flags,
            'visibility_periods_used': 3}
    return QTable([row])


def covariance_of(rng, scale):
    a = rng.normal(size=(5, 8)) * scale
    return a @ a.T / 8


def test_the_mean_is_that_of_least_squares():
    rng = np.random.default_rng(4)
    truth = np.array([0.0, 0, 1.5, 12, -7])
    matrices = [covariance_of(rng, scale) for scale in (0.4, 0.9)]
    measured = [rng.multivariate_normal(truth, one) for one in matrices]
    left = merge_stars([star(*pair) for pair in zip(measured, matrices,
                                                    strict=True)])
    assert [len(one) for one in left] == [1, 0]
    weights = [np.linalg.inv(one) for one in matrices]
    expected = np.linalg.inv(sum(weights))
    mean = expected @ sum(w @ m for w, m in zip(weights, measured,
                                                strict=True))
    row = left[0][0]
    assert_allclose([row[f'{name}_error'].value for name in GAIA],
                    np.sqrt(np.diag(expected)), rtol=1e-8)
    assert_allclose([row[name].value for name in GAIA[2:]], mean[2:],
                    rtol=1e-7)
    away = (row['ra'].value - 359.9999999 + 180) % 360 - 180
    assert_allclose(away * np.cos(np.radians(30)) * 3600e3, mean[0],
                    atol=1e-5)
    sigma = np.sqrt(np.diag(expected))
    assert_allclose(row['pmra_pmdec_corr'], expected[3, 4] / sigma[3]
                    / sigma[4], rtol=1e-8)
    difference = measured[0] - measured[1]
    assert_allclose(row['merge_chi2'], difference @ np.linalg.solve(
        sum(matrices), difference), rtol=1e-4)
    assert (row['n_fields'], row['n_obs'], row['dof']) == (2, 8, 6)


def test_positions_are_compared_at_one_time():
    matrix = np.diag([0.01, 0.01, 0.01, 0.0001, 0.0001])
    early = star(np.array([0, 0, 0, 80.0, 0]), matrix, year=2020)
    late = star(np.array([800.0, 0, 0, 80.0, 0]), matrix, year=2030)
    other = star(np.array([0, 0, 0, 80.0, 0]), matrix, year=2030)
    assert len(merge_stars([early, late])[1]) == 0
    assert len(merge_stars([early, other])[1]) == 1
    row = merge_stars([early, late])[0][0]
    assert row['ref_epoch'] == 2020
    assert row['merge_chi2'] < 1e-6


def test_what_is_known_twice_of_a_reference_counts_once():
    matrix = np.diag([0.01, 0.01, 0.01, 1e-6, 1e-6])
    tables = [star(np.zeros(5), matrix) for _ in range(2)]
    once = merge_stars(tables, QTable({'ra': [359.9999999] * u.deg,
                                       'dec': [30.0] * u.deg}))[0]
    assert_allclose(once['pmra_error'].value, 1e-3)
    assert once['n_fields'][0] == 2
    twice = merge_stars(tables)[0]
    assert_allclose(twice['pmra_error'].value, 1e-3 / np.sqrt(2))


def test_relative_motions_and_unsolved_stars_stay_apart():
    matrix = np.diag([0.01, 0.01, 0.01, 0.0001, 0.0001])
    tables = [star(np.zeros(5), matrix, flags=256) for _ in range(2)]
    assert [len(one) for one in merge_stars(tables)] == [1, 1]
    tables = [star(np.zeros(5), np.diag([0.01, 0.01, 0.01, np.nan, 0.01]))
              for _ in range(2)]
    assert [len(one) for one in merge_stars(tables)] == [1, 1]
    assert merge_stars([star(np.zeros(5), matrix)])[0]['n_fields'][0] == 1


@pytest.fixture(scope='module')
def fields():
    """Return the sources and two overlapping fields of four exposures."""
    sources = sky_field(160, 120, size=1.0, magnitudes=(19, 23), rng=5,
                        parallaxes=False, separation=0.5)
    epochs = []
    for k, step in enumerate((-0.1, 0.1)):
        exposures = paper_exposures(192.8593 + step / 60 / 0.89, 27.1281,
                                    offset=0.5)[::2]
        catalogues = simulate_catalogues(
            sources, exposures, rng=10 + k,
            instrument=Instrument(shape=(400, 400)))
        epochs.append([Epoch(one.table[[
            name for name in one.table.colnames if name != 'id']], one.wcs,
            one.time) for one in catalogues])
    return sources, epochs


def test_merged_fields_are_as_good_as_one_solution(fields):
    sources, epochs = fields
    quasars = sources[sources['kind'] == 'qso']['ra', 'dec']
    quasars['class'] = 'qso'
    fitter = ProperMotionFitter(references=quasars)
    merged = vstack(merge_stars([fitter.fit(one).stars for one in epochs],
                                quasars))
    whole = fitter.fit(epochs[0] + epochs[1]).stars
    pairs = [table[np.isfinite(table['pmra_error'].value)]
             for table in (merged, whole)]
    places = [SkyCoord(table['ra'], table['dec']) for table in pairs]
    index, away, _ = places[0].match_to_catalog_sky(places[1])
    truth, _, _ = places[0].match_to_catalog_sky(
        SkyCoord(sources['ra'], sources['dec']))
    shared = ((pairs[0]['n_fields'] == 2) & (away.arcsec < 0.01)
              & (sources['kind'][truth] == 'star'))
    assert shared.sum() >= 20
    one, other = pairs[0][shared], pairs[1][index[shared]]
    for name in ('pmra', 'pmdec'):
        error = f'{name}_error'
        difference = ((one[name] - other[name]) / other[error]).value
        # One solution knows the frames better where fields overlap.
        assert np.sqrt(np.mean(difference**2)) < 0.4
        ratio = np.median((one[error] / other[error]).value)
        assert 0.95 < ratio < 1.1
        pulls = ((one[name] - sources[name][truth[shared]])
                 / one[error]).value
        assert 0.6 < np.sqrt(np.mean(pulls**2)) < 1.4
