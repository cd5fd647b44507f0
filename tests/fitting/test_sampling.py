"""The posterior of a mixture: against least squares and against its prior."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import GaussianMixture, sample_mixture
from photutils_mgauss.fitting.convergence import effective_size, split_r_hat
from photutils_mgauss.fitting.posterior import relabel

TRUTH = GaussianMixture.from_stddevs(
    [0.65, 0.35], [[0.1, 0], [-0.2, 0.1]], [[1, 1.2], [2.4, 2.1]], [0.1, -0.2])

# PyTensor warns at its first compilation that no BLAS is at hand.
pytestmark = pytest.mark.filterwarnings('ignore')


@pytest.fixture(scope='module')
def image():
    noise = np.random.default_rng(3).standard_normal((15, 15))
    return 50 * TRUTH.render((15, 15), 7, 7) + 0.02 * noise


@pytest.fixture(scope='module')
def posterior(image):
    return sample_mixture(image, 2, draws=300, tune=200, chains=2, cores=1,
                          rng=11)


def test_the_chains_agree_and_have_many_independent_draws(posterior):
    table = posterior.summary()
    assert len(table) == 14
    assert (table['r_hat'] < 1.03).all()
    assert (table['ess'] > 100).all()
    assert posterior.weights.shape == (2, 300, 2)
    assert posterior.means.shape == (2, 300, 2, 2)


def test_the_summary_is_shown_whole_on_a_terminal(posterior):
    table = posterior.summary()
    lines = table.pformat(max_width=80, max_lines=-1)
    assert not any('...' in line for line in lines)
    assert lines[0].split() == table.colnames
    assert float(lines[2].split()[1]) == pytest.approx(table['mean'][0],
                                                       rel=1e-3)


def test_the_posterior_is_where_and_as_wide_as_least_squares_says(posterior):
    fit = posterior.fit
    errors = np.sqrt(np.diag(fit.covariance)).reshape(2, 6)
    pairs = [(posterior.weights * posterior.flux[..., None],
              fit.flux * fit.mixture.weights, errors[:, 0]),
             (posterior.means, fit.mixture.means, errors[:, 1:3]),
             (posterior.stddevs, fit.mixture.stddevs, errors[:, 3:5]),
             (posterior.rho, fit.mixture.rho, errors[:, 5])]
    ratios = []
    for draws, value, error in pairs:
        assert (abs(draws.mean(axis=(0, 1)) - value) < error).all()
        ratios.append((draws.std(axis=(0, 1)) / error).ravel())
    assert_allclose(np.median(np.concatenate(ratios)), 1, atol=0.15)
    assert_allclose(posterior.sigma.mean(), 0.02, rtol=0.15)


def test_the_mixture_and_draws_are_near_the_truth(posterior):
    y, x = np.mgrid[-4:5, -4:5]
    peak = TRUTH.evaluate(0, 0)
    for mixture in (posterior.mixture, *posterior.draws(5)):
        assert_allclose(mixture.evaluate(x, y), TRUTH.evaluate(x, y),
                        atol=0.02 * peak)
    with pytest.raises(ValueError, match='n must be at most 600, got 601'):
        posterior.draws(601)


def test_a_seed_makes_the_papers_posterior_repeatable(image):
    one, other = (sample_mixture(
        image, 2, prior='paper', pixel_scale=0.074, draws=40, tune=60,
        chains=1, cores=1, rng=5) for _ in range(2))
    assert (one.stddevs == other.stddevs).all()
    assert_allclose(one.flux, image.sum(), rtol=1e-9)
    assert_allclose(one.weights.sum(axis=-1), 1)
    # In arcsec inside, in pixels outside.
    assert_allclose(one.stddevs.mean(axis=(0, 1)), one.fit.mixture.stddevs,
                    rtol=0.1)


def test_relabelling_undoes_exchanged_labels(rng):
    k = np.array([[0, 1], [1, 0]])[rng.integers(0, 2, (2, 50))]
    arrays = [np.broadcast_to(a, (2, 50, *a.shape)).copy() for a in (
        TRUTH.weights, TRUTH.means, TRUTH.stddevs, TRUTH.rho)]
    mixed = [np.take_along_axis(a, k if a.ndim == 3 else k[..., None], 2)
             for a in arrays]
    for got, want in zip(relabel(*mixed, TRUTH), arrays, strict=True):
        assert (got == want).all()


def test_convergence_measures_know_good_from_bad_chains(rng):
    good = rng.standard_normal((4, 1000))
    assert split_r_hat(good) < 1.01
    assert_allclose(effective_size(good), 4000, rtol=0.15)
    shifted = good + 3 * (np.arange(4) % 2)[:, None]
    assert split_r_hat(shifted) > 1.5
    slow = good.copy()
    for i in range(1, 1000):
        slow[:, i] = 0.9 * slow[:, i - 1] + np.sqrt(0.19) * good[:, i]
    # An autoregression of 0.9 makes 19 draws worth one.
    assert_allclose(effective_size(slow), 4000 / 19, rtol=0.3)


def test_arviz_measures_the_same_convergence(rng):
    arviz = pytest.importorskip('arviz')
    draws = np.cumsum(rng.standard_normal((4, 400)), axis=1) * 0.05
    draws += rng.standard_normal((4, 400))
    assert_allclose(split_r_hat(draws), float(arviz.rhat(draws)), rtol=0.01)
    assert_allclose(effective_size(draws), float(arviz.ess(draws)), rtol=0.1)


@pytest.mark.parametrize(('arguments', 'words'), [
    ({'prior': 'flat'}, "prior must be one of 'scaled', 'paper'"),
    ({'prior': 'paper'}, 'pixel_scale must be given'),
    ({'prior': 'paper', 'pixel_scale': 0}, 'pixel_scale must be greater'),
    ({'sampler': 'advi'}, "sampler must be one of 'pymc'"),
    ({'draws': 1}, 'draws must be at least 4'),
    ({'n_components': 0}, 'n_components must be at least 1'),
])
def test_bad_arguments_are_named(image, arguments, words):
    with pytest.raises(ValueError, match=words):
        sample_mixture(image, **{'n_components': 2, **arguments})


@pytest.mark.long
def test_the_noise_may_be_small(image):
    faint = 50 * TRUTH.render((15, 15), 7, 7)
    faint += 1e-9 * (image - faint)
    found = sample_mixture(faint, 2, draws=100, tune=150, chains=1, cores=1,
                           rng=2)
    assert_allclose(found.sigma.mean(), 2e-11, rtol=0.2)
    # As many steps of the sampler as with any noise: it is scaled.
    assert np.median(found.idata['sample_stats']['n_steps']) <= 15
    errors = np.sqrt(np.diag(found.fit.covariance)).reshape(2, 6)
    assert_allclose(found.means.std(axis=(0, 1)), errors[:, 1:3], rtol=0.5)


@pytest.mark.parametrize('error', [None, 0.02])
def test_an_image_without_noise_is_refused(error):
    with pytest.raises(ValueError, match=r'image must have noise: .* add the'):
        sample_mixture(50 * TRUTH.render((15, 15), 7, 7), 2, error=error)


def test_what_the_posterior_has_no_place_for_is_refused(image):
    with pytest.raises(ValueError, match='image must have the shape'):
        sample_mixture([image, image], 2)
    for keyword in ('signed', 'means', 'weighting', 'executor'):
        with pytest.raises(TypeError, match=f'start, got {keyword}'):
            sample_mixture(image, 2, **{keyword: None})
