"""Members of a cluster, their mean motion, and tables for others."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose
from scipy.stats import multivariate_normal

from helpers.motion_scenes import TIMES, make_truth, observe
from photutils_mgauss import Epoch, ProperMotionFitter
from photutils_mgauss.motions import membership
from photutils_mgauss.motions.membership import fit_groups

MEAN, FIELD = np.array([2.0, -1.0]), np.array([[9.0, 2.0], [2.0, 6.0]])


def motions(rng, n=3000, part=0.3):
    """Return motions, covariances, and which are of the cluster."""
    member = rng.uniform(size=n) < part
    sigma = rng.uniform(0.1, 1.0, (n, 2))
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = (sigma**2).T
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.3 * sigma.prod(axis=1)
    true = np.where(member[:, None], MEAN + 0.1 * rng.normal(size=(n, 2)),
                    rng.multivariate_normal([0, 0], FIELD, n))
    noise = np.einsum('nij,nj->ni', np.linalg.cholesky(covariance),
                      rng.normal(size=(n, 2)))
    return true + noise, covariance, member


def test_the_mixture_is_found_with_the_errors_taken_out(rng):
    motion, covariance, member = motions(rng)
    groups = fit_groups(motion, covariance, 1)
    assert_allclose(groups.fraction[0], member.mean(), atol=0.03)
    assert_allclose(groups.mean[0], MEAN, atol=0.04)
    assert_allclose(groups.covariance[1], FIELD, atol=0.8)
    assert_allclose(np.sqrt(np.diag(groups.covariance[0])), 0.1, atol=0.06)


def test_a_limit_of_steps_is_told(rng, monkeypatch):
    motion, covariance, _ = motions(rng, 400)
    monkeypatch.setattr(membership, 'MOST_STEPS', 3)
    with pytest.warns(AstropyUserWarning, match='still change after 3 steps'):
        fit_groups(motion, covariance, 1)


def test_probabilities_are_the_terms_over_their_sum(rng):
    motion, covariance, member = motions(rng, 400)
    groups = fit_groups(motion, covariance, 1)
    terms = np.exp(groups.densities(motion, covariance))
    for k in (0, 7, 200):
        each = [f * multivariate_normal(m, v + covariance[k]).pdf(motion[k])
                for f, m, v in zip(groups.fraction, groups.mean,
                                   groups.covariance, strict=True)]
        assert_allclose(terms[:, k], each, rtol=1e-6)
    probability = terms[0] / terms.sum(axis=0)
    # Of the stars with a probability near p the part p are members.
    for low in (0.0, 0.5, 0.8):
        here = (probability >= low) & (probability < low + 0.2)
        if here.sum() > 20:
            assert abs(member[here].mean() - probability[here].mean()) < (
                4 * 0.5 / np.sqrt(here.sum()))


@pytest.fixture(scope='module')
def solution():
    rng = np.random.default_rng(3)
    truth = make_truth(rng, n_stars=80, n_qso=40, ra=0.0)
    epochs = observe(truth, rng, times=TIMES[[0, 3, 6]], missing=0)
    return ProperMotionFitter(references='qso').fit(epochs)


def test_the_mean_has_the_whole_covariance(solution):
    free = solution.stars['id'][solution.stars['reference'] == ''][:40]
    mean = solution.mean(free)
    # The same from the covariances between all stars.
    covariance = solution.covariance(free)[:, -2:, :, -2:]
    size = mean['dispersion'][0].value
    own = np.zeros((40, 2, 2))
    cross = np.delete(np.arange(40), 0)
    frame = np.mean([covariance[0, :, k] for k in cross], axis=0)
    for k in range(40):
        own[k] = covariance[k, :, k] - frame + size**2 * np.eye(2)
    weight = np.linalg.inv(own)
    inner = np.linalg.inv(weight.sum(axis=0))
    shares = inner @ weight
    whole = covariance + np.einsum('kl,ab->kalb', np.eye(40),
                                   size**2 * np.eye(2))
    expected = np.einsum('kab,kbld,lcd->ac', shares, whole, shares)
    assert_allclose(mean['pmra_error'][0].value**2, expected[0, 0], rtol=0.02)
    assert_allclose(mean['pmdec_error'][0].value**2, expected[1, 1],
                    rtol=0.02)
    assert mean['n'][0] == 40
    with pytest.raises(ValueError, match='must be those of stars'):
        solution.mean(['nobody'])


def test_the_mean_of_relative_motions_is_refused():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 100, (2, 30))
    epochs = [Epoch(Table({'id': np.arange(30), 'x_fit': x, 'y_fit': y,
                           'x_err': np.full(30, 0.01),
                           'y_err': np.full(30, 0.01)}), time=year)
              for year in (2010.0, 2015.0)]
    with pytest.raises(ValueError, match='references must be given'):
        ProperMotionFitter().fit(epochs).mean()


def test_membership_is_a_table_beside_the_stars(solution):
    table = solution.membership()
    assert list(table['id']) == list(solution.stars['id'])
    known = np.isfinite(table['membership'])
    assert known.all()
    assert ((table['membership'] >= 0) & (table['membership'] <= 1)).all()
    assert table.meta['unit'] == 'mas / yr'
    with pytest.raises(ValueError, match='n_field'):
        solution.membership(n_field=0)


@pytest.mark.parametrize('name', ['stars.ecsv', 'stars.fits', 'stars.vot'])
def test_tables_are_written_with_what_columns_are(solution, tmp_path, name):
    options = {'format': 'votable'} if name.endswith('vot') else {}
    solution.stars.write(tmp_path / name, **options)
    again = QTable.read(tmp_path / name)
    assert_allclose(again['pmra'].to_value(u.mas / u.yr),
                    solution.stars['pmra'].value)
    assert again['pmra'].info.meta['ucd'] == 'pos.pm;pos.eq.ra'
    assert again['ra_error'].info.meta['ucd'] == 'stat.error;pos.eq.ra'
