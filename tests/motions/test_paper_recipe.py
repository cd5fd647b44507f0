"""The recipe of Nie et al., Section 4.2, beside a literal transcription."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.motion_scenes import TIMES, make_truth, observe, pulls
from helpers.wcs import SCALE, tan_wcs
from photutils_mgauss import Epoch, ProperMotionFitter


@pytest.fixture(scope='module')
def scene():
    rng = np.random.default_rng(21)
    truth = make_truth(rng, n_stars=60, n_qso=40)
    wcs = tan_wcs(192.8595, 27.1283, mirrored=True)
    return truth, observe(truth, rng, missing=0, offset=0.0, wcs=wcs)


def shifted(epochs, rng, size):
    """Return epochs whose pixels are moved by as many mas."""
    out = []
    for epoch in epochs:
        table = epoch.table.copy()
        for name in ('x_fit', 'y_fit'):
            table[name] += rng.normal(0, size) / (SCALE * 1e3)
        out.append(Epoch(table, epoch.wcs, epoch.time))
    return out


def transcribed(x, t, sigma, reference, mu_r, *, corrected):
    """
    Transcribe Eqs. 11-15 symbol by symbol for one coordinate.

    ``x`` and ``sigma`` (E, n) are x_i and eps_c, ``t`` (E,) the times,
    ``reference`` (n,) marks the reference objects.
    """
    x_first, t_first = x[0], t[0]
    a, eps_m = np.empty(x.shape[1]), np.empty(x.shape[1])
    moved = (x - x_first)[:, reference]
    delta_x = moved.mean(axis=1)                              # Delta x_i
    eps_t = np.abs(delta_x - mu_r * (t - t_first))            # Eq. 14
    if corrected:
        eps_t = moved.std(axis=1, ddof=1) / np.sqrt(moved.shape[1])
    for star in range(x.shape[1]):
        prime = x[:, star] - delta_x                          # Eq. 12
        eps = np.sqrt(sigma[:, star]**2 + eps_t**2)           # Eq. 13
        design = np.column_stack([t - t_first, np.ones_like(t)]) / eps[:, None]
        line, *_ = np.linalg.lstsq(design, (prime - x_first[star]) / eps,
                                   rcond=None)                # Eq. 11
        a[star] = line[0]
        eps_m[star] = np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    return mu_r + a, eps_m                                    # Eq. 15


@pytest.mark.parametrize('eps_t', ['printed', 'corrected'])
def test_the_recipe_is_eqs_11_to_15(scene, rng, eps_t):
    truth, epochs = scene
    epochs = shifted(epochs, rng, 30.0)
    fit = ProperMotionFitter(recipe='paper', eps_t=eps_t,
                             references='qso').fit(epochs)
    # Pixels to the plane of the fit: x runs against right ascension.
    scale = SCALE * 1e3
    t = np.array([epoch.mean_year for epoch in epochs])
    for name, column, sign in (('pmra', 'x_fit', -1), ('pmdec', 'y_fit', 1)):
        x = sign * scale * np.stack([epoch.table[column] for epoch in epochs])
        sigma = scale * np.stack([epoch.table['x_err'] for epoch in epochs])
        mu, eps = transcribed(x, t, sigma, truth.qso, 0.0,
                              corrected=eps_t == 'corrected')
        # The two planes touch the sky half an arcminute apart.
        assert_allclose(fit.stars[name].value, mu, atol=0.01)
        assert_allclose(fit.stars[f'{name}_error'].value, eps, rtol=0.01)


def test_as_printed_pointing_offsets_blow_up_the_errors(scene, rng):
    # Facts of the printed eps_t: far too large errors, worse motions.
    truth, epochs = scene
    epochs = shifted(epochs, rng, 100.0)
    printed, corrected, joint = (
        ProperMotionFitter(references='qso', **keywords).fit(epochs).stars
        for keywords in ({'recipe': 'paper'},
                         {'recipe': 'paper', 'eps_t': 'corrected'}, {}))
    test = ~truth.qso[np.asarray(joint['id'])]
    size = {name: np.sqrt(np.mean(pulls(stars[test], truth)**2))
            for name, stars in (('printed', printed),
                                ('corrected', corrected), ('joint', joint))}
    assert size['printed'] < 0.7
    assert 0.8 < size['joint'] < 1.2
    assert (np.median(printed['pmra_error'][test])
            > 2 * np.median(corrected['pmra_error'][test]))


def test_an_affine_residual_spoils_the_paper_but_not_the_joint_fit():
    """3 mas at the chip's edge: bright stars suffer, as their errors hide."""
    rng = np.random.default_rng(5)
    truth = make_truth(rng, n_stars=614, n_qso=590)
    truth.sigma[:300] = rng.uniform(0.7, 1.5, 300)
    epochs = observe(truth, rng, edge=3.0, times=TIMES)
    bright = (truth.sigma < 1.5) & ~truth.qso
    references = np.flatnonzero(truth.qso)
    error, pull = {}, {}
    for name, keywords in (('paper', {'recipe': 'paper',
                                      'eps_t': 'corrected'}), ('joint', {})):
        stars = ProperMotionFitter(references=references,
                                   **keywords).fit(epochs).stars
        which = np.asarray(stars['id'])
        away = np.stack([stars['pmra'].value - truth.pm[0, which],
                         stars['pmdec'].value - truth.pm[1, which]])
        error[name] = np.sqrt(np.nanmean(away[:, bright[which]]**2))
        pull[name] = np.sqrt(np.nanmean(
            pulls(stars, truth)[:, bright[which]]**2))
    assert error['joint'] < 0.6
    assert error['paper'] > 1.3 * error['joint']
    assert_allclose(pull['joint'], 1, atol=0.1)
    assert pull['paper'] > 1.5


def test_the_mean_motion_of_reference_stars_is_added(scene):
    from astropy.table import Table
    truth, epochs = scene
    stars = np.flatnonzero(~truth.qso)[:40]
    table = Table({'id': stars, 'pmra': truth.pm[0, stars],
                   'pmdec': truth.pm[1, stars],
                   'pmra_error': np.full(40, 0.1),
                   'pmdec_error': np.full(40, 0.1),
                   'ref_epoch': np.full(40, 2016.0)})
    fit = ProperMotionFitter(recipe='paper', eps_t='corrected',
                             references=table).fit(epochs)
    quasars = truth.qso[np.asarray(fit.stars['id'])]
    for name in ('pmra', 'pmdec'):
        mean = np.average(fit.stars[name].value[quasars], weights=1 / (
            fit.stars[f'{name}_error'].value[quasars])**2)
        assert abs(mean) < 0.5


def test_the_recipe_fits_no_parallaxes(scene):
    with pytest.raises(ValueError, match='parallax must be False'):
        ProperMotionFitter(recipe='paper', parallax=True,
                           references='qso').fit(scene[1])
