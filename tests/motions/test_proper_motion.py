"""ProperMotionFitter beside the truth and other fits."""
from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from numpy.testing import assert_allclose

from helpers.motion_scenes import (
    TIMES,
    changed,
    make_truth,
    observe,
    plane_epochs,
    pulls,
    rms,
    tan_wcs,
)
from photutils_mgauss import (
    Epoch,
    ProperMotionFitter,
    bootstrap_median,
)


@pytest.fixture(scope='module')
def scene():
    rng = np.random.default_rng(11)
    truth = make_truth(rng, n_stars=2000, n_qso=600)
    return truth, observe(truth, rng, edge=3.0)


@pytest.fixture(scope='module')
def quasars(scene):
    truth, _ = scene
    rng = np.random.default_rng(12)
    return rng.choice(np.flatnonzero(truth.qso), 300, replace=False)


@pytest.fixture(scope='module')
def solution(scene, quasars):
    return ProperMotionFitter(references=quasars).fit(scene[1])


# Against the truth

def test_motions_scatter_by_their_errors(scene, quasars, solution):
    truth, _ = scene
    stars = solution.stars[~np.isin(solution.stars['id'], quasars)]
    sigma = truth.sigma[stars['id']]
    for group in (sigma < 2, sigma >= 2):
        assert_allclose(rms(pulls(stars[group], truth)), 1, atol=0.06)


def test_chi_square_is_as_large_as_its_degrees_of_freedom(solution):
    stars = solution.stars
    assert_allclose(np.nansum(stars['chi2']) / np.nansum(stars['dof']), 1,
                    atol=0.03)
    assert_allclose(np.nanmedian(stars['uwe']), 1, atol=0.05)


def test_maps_undo_what_the_wcs_had_wrong(scene, solution):
    # The offsets of the WCS were 100 mas, their stretch 3 mas at the edge.
    assert (solution.alignment['shift_error'] < 1 * u.mas).all()
    moved = solution.alignment['shift'] - solution.alignment['shift'].mean(
        axis=0)
    assert moved.std() > 30 * u.mas
    assert_allclose(solution.alignment['matrix'],
                    np.tile(np.eye(2), (7, 1, 1)), atol=1e-4)


def test_a_joint_solution_is_no_worse_than_two_steps(scene, quasars,
                                                     solution):
    truth, epochs = scene
    two = ProperMotionFitter(references=quasars,
                             recipe='two-step').fit(epochs)
    assert np.nanmedian(solution.stars['pmra_error']) <= (
        1.001 * np.nanmedian(two.stars['pmra_error']))
    test = ~np.isin(solution.stars['id'], quasars)
    errors = [(one.stars['pmra'].value - truth.pm[0, one.stars['id']])[test]
              for one in (solution, two)]
    assert rms(errors[0]) < 1.01 * rms(errors[1])


def test_positions_and_parallaxes_scatter_by_their_errors():
    rng = np.random.default_rng(3)
    truth = make_truth(rng, n_stars=1500, n_qso=500, parallax=2.0)
    epochs = observe(truth, rng)
    gaia = gaia_table(truth, rng, np.flatnonzero(~truth.qso)[:300])
    fit = ProperMotionFitter(references=gaia, parallax=True,
                             ref_epoch=2016.0).fit(epochs)
    stars = fit.stars[~np.isin(fit.stars['id'], gaia['id'])]
    which = np.asarray(stars['id'])
    parallax = ((stars['parallax'].value - truth.parallax[which])
                / stars['parallax_error'].value)
    place = offsets(stars, truth, 2016.0)
    for pull in (parallax, *place, *pulls(stars, truth)):
        assert_allclose(rms(pull), 1, atol=0.06)
    assert fit.notes == ()


def gaia_table(truth, rng, which, error=0.1):
    """Return a catalogue of some stars with Gaia's columns, at 2016.0."""
    sky = SkyCoord(truth.ra[which] * u.deg, truth.dec[which] * u.deg)
    years = 2016.0 - truth.year0
    noise = error * rng.normal(size=(5, len(which)))
    pm = truth.pm[:, which]
    moved = sky.spherical_offsets_by(
        (pm[0] * years + noise[0]) * u.mas, (pm[1] * years + noise[1]) * u.mas)
    errors = {f'{name}_error': np.full(len(which), error)
              for name in ('ra', 'dec', 'parallax', 'pmra', 'pmdec')}
    return Table({'id': which, 'ra': moved.ra.deg, 'dec': moved.dec.deg,
                  'pmra': pm[0] + noise[2], 'pmdec': pm[1] + noise[3],
                  'parallax': truth.parallax[which] + noise[4],
                  'ref_epoch': np.full(len(which), 2016.0), **errors})


def offsets(stars, truth, year):
    """Return (ra, dec - truth) / error at a year, as pulls."""
    which = np.asarray(stars['id'])
    origin = SkyCoord(truth.ra[which] * u.deg, truth.dec[which] * u.deg)
    found = SkyCoord(stars['ra'], stars['dec'])
    away = origin.spherical_offsets_to(found)
    expected = truth.pm[:, which] * (year - truth.year0)
    return [(angle.to_value(u.mas) - expected[k]) / stars[name].to_value(u.mas)
            for k, (angle, name) in enumerate(zip(
                away, ('ra_error', 'dec_error'), strict=True))]


def test_relative_motions_differ_from_the_truth_by_one_field(scene):
    truth, epochs = scene
    fit = ProperMotionFitter().fit(epochs)
    stars = fit.stars
    which = np.asarray(stars['id'])
    design = np.column_stack([np.ones(len(which)), truth.ra[which] - 192.86,
                              truth.dec[which] - 27.13])
    for k, name in enumerate(('pmra', 'pmdec')):
        error = stars[name].value - truth.pm[k, which]
        sigma = stars[f'{name}_error'].value
        good = np.isfinite(error)
        field = np.linalg.lstsq(design[good] / sigma[good, None],
                                error[good] / sigma[good], rcond=None)[0]
        assert_allclose(rms((error - design @ field) / sigma), 1, atol=0.05)
    assert any('Motions are relative' in note for note in fit.notes)
    assert (stars['flags'] & 256 > 0).all()


def test_errors_of_relative_motions_leave_out_their_mean(rng):
    # Of n equal stars, each has 1 - 1/n of the variance left (shifts only).
    n = 5
    epochs, _ = plane_epochs(rng, n=n, years=(2020.0, 2024.0))
    fit = ProperMotionFitter(transform='shift', systematic=None,
                             clip=None).fit(epochs)
    alone = 0.01 * np.sqrt(2) / 4
    assert_allclose(fit.stars['pmra_error'].value, alone * np.sqrt(1 - 1 / n),
                    rtol=1e-6)
    assert_allclose(fit.stars['pmra'].value.mean(), 0, atol=1e-12)


# Against other ways to the same numbers

def whitened_fit(epochs, rows, plane_of, year):
    """Fit one star by lstsq of whitened equations, frames known."""
    design, values = [], []
    for epoch, row in zip(epochs, rows, strict=True):
        if row is None:
            continue
        place, covariance = plane_of(epoch, row)
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        dt = epoch.mean_year - year
        design.append(white @ np.array([[1, 0, dt, 0], [0, 1, 0, dt]]))
        values.append(white @ place)
    design, values = np.vstack(design), np.concatenate(values)
    answer = np.linalg.lstsq(design, values, rcond=None)[0]
    return answer, np.linalg.inv(design.T @ design)


def test_batched_fits_equal_whitened_lstsq_star_by_star(rng):
    n = 60
    epochs, _ = plane_epochs(rng, n=n, years=(2020.0, 2021.0, 2023.5, 2024.0))
    covariances = {}
    for k, epoch in enumerate(epochs):
        errors = rng.uniform(0.002, 0.05, (2, n))
        rho = rng.uniform(-0.9, 0.9, n)
        epochs[k] = changed(epoch, x_err=errors[0], y_err=errors[1],
                            xy_cov=rho * errors[0] * errors[1])
        covariances[k] = errors, rho
    fit = ProperMotionFitter(transform=None, systematic=None, clip=None,
                             ref_epoch=2022.0).fit(epochs)

    def plane_of(epoch, row):
        line = epoch.table[row]
        covariance = [[line['x_err']**2, line['xy_cov']],
                      [line['xy_cov'], line['y_err']**2]]
        return np.array([line['x_fit'], line['y_fit']]), covariance
    for i in range(n):
        answer, covariance = whitened_fit(epochs, [i] * 4, plane_of, 2022.0)
        star = fit.stars[i]
        got = [star[name].value for name in ('x', 'y', 'pmra', 'pmdec')]
        assert_allclose(got, answer, rtol=1e-9)
        errors = [star[f'{name}_error'].value
                  for name in ('ra', 'dec', 'pmra', 'pmdec')]
        assert_allclose(errors, np.sqrt(np.diag(covariance)), rtol=1e-9)
        assert_allclose(star['pmra_pmdec_corr'] * errors[2] * errors[3],
                        covariance[2, 3], rtol=1e-7, atol=1e-12)


def test_a_joint_solution_equals_one_big_least_squares_fit(rng):
    """All unknowns in one dense matrix, quasars' motions left out of it."""
    n, n_qso = 12, 5
    years = np.array([2020.0, 2021.0, 2023.0])
    epochs, _ = plane_epochs(rng, n=n, years=years)
    for k, epoch in enumerate(epochs):
        still = epochs[0].table
        for name in ('x_fit', 'y_fit'):
            epoch.table[name][:n_qso] = (still[name][:n_qso]
                                         + 0.01 * rng.normal(size=n_qso))
        epochs[k] = changed(epoch)
    fit = ProperMotionFitter(transform='shift', systematic=None, clip=None,
                             references=list(range(n_qso))).fit(epochs)
    # One axis alone: x_ie = x_i + mu_i dt_e - s_e, with sum of s_e zero.
    dt = years - years.mean()
    columns = np.zeros((3, n, 2 * n + 3))
    for e in range(3):
        for i in range(n):
            columns[e, i, i] = 1
            columns[e, i, n + i] = dt[e] * (i >= n_qso)
            columns[e, i, 2 * n + e] = -1
    gauge = np.zeros(2 * n + 3)
    gauge[2 * n:] = 1
    keep = [k for k in range(2 * n + 3) if not n <= k < n + n_qso]
    design = np.vstack([columns.reshape(-1, 2 * n + 3) / 0.01, gauge])[:, keep]
    values = np.append(np.concatenate(
        [epoch.table['x_fit'] for epoch in epochs]) / 0.01, 0)
    answer = np.linalg.lstsq(design, values, rcond=None)[0]
    covariance = np.linalg.inv(design.T @ design)
    motions = slice(n, n + n - n_qso)
    assert_allclose(fit.stars['pmra'].value[n_qso:], answer[motions],
                    atol=1e-9)
    assert_allclose(fit.stars['pmra_error'].value[n_qso:],
                    np.sqrt(np.diag(covariance)[motions]), rtol=1e-6)
    shift = fit.alignment['shift'][:, 0].value
    assert_allclose(shift - shift.mean(), answer[-3:], atol=1e-8)


def test_rows_in_another_order_give_the_same_motions(scene, solution,
                                                     quasars, rng):
    _, epochs = scene
    mixed = []
    for epoch in epochs[::-1]:
        order = rng.permutation(len(epoch.table))
        mixed.append(Epoch(epoch.table[order], epoch.wcs, epoch.time))
    again = ProperMotionFitter(references=quasars).fit(mixed).stars
    again = again[np.argsort(again['id'])]
    stars = solution.stars[np.argsort(solution.stars['id'])]
    assert_allclose(again['pmra'].value, stars['pmra'].value, atol=1e-6)


@pytest.mark.parametrize('dec', [0.0, 80.0, 89.9, 90.0, -89.99])
@pytest.mark.parametrize('rotation', [0.0, 20.0, 90.0])
def test_any_declination_and_rotation_gives_the_motions(dec, rotation):
    rng = np.random.default_rng(8)
    truth = make_truth(rng, n_stars=60, n_qso=60, ra=0.0, dec=dec, sigma=1e-3)
    epochs = []
    for time in TIMES[[0, 3, 6]]:
        wcs = tan_wcs(0.0, dec, rotation=rotation, mirrored=rotation != 20)
        # Near the pole a shift of all positions turns the local axes, so
        # the frames here start right.
        epochs += observe(truth, rng, times=[time], offset=0, wcs=wcs,
                          missing=0)
    fit = ProperMotionFitter(references=np.flatnonzero(truth.qso),
                             transform='similarity',
                             ref_epoch=truth.year0).fit(epochs)
    assert np.abs(pulls(fit.stars, truth)).max() < 5
    assert_allclose(fit.stars['pmra'].value, truth.pm[0, fit.stars['id']],
                    atol=0.005)


# What goes wrong

def test_parallaxes_without_coverage_are_nan(scene):
    _, epochs = scene
    fitter = ProperMotionFitter(transform=None, parallax=True,
                                systematic=None)
    with pytest.warns(UserWarning, match='No star has a motion'):
        fit = fitter.fit([epochs[0], epochs[6]])
    for name in ('pmra', 'pmdec', 'parallax', 'ra_error', 'dec_error'):
        assert np.isnan(fit.stars[name]).all()
    assert (fit.stars['flags'] & 1).all()


def test_one_wild_detection_is_rejected_and_the_rest_kept(scene, quasars):
    truth, epochs = scene
    row = int(np.flatnonzero(~epochs[3].table['qso'])[10])
    wild = epochs[3].table.copy()
    wild['x_fit'][row] += 1.0
    star = wild['id'][row]
    bad = [*epochs[:3], Epoch(wild, epochs[3].wcs, epochs[3].time),
           *epochs[4:]]
    fit = ProperMotionFitter(references=quasars).fit(bad)
    line = fit.stars[fit.stars['id'] == star][0]
    assert line['flags'] & 8
    assert np.abs(pulls(fit.stars[fit.stars['id'] == star], truth)).max() < 5
    lost = fit.residuals[~fit.residuals['used']]
    assert (star, 3) in zip(lost['id'], lost['epoch'], strict=True)
    assert len(lost) < 5


def test_a_moving_reference_is_found_out(scene, quasars):
    truth, epochs = scene
    mover = np.flatnonzero((np.abs(truth.pm[0]) > 8) & (truth.sigma < 2))[0]
    fit = ProperMotionFitter(references=[*quasars, mover]).fit(epochs)
    line = fit.stars[fit.stars['id'] == mover]
    assert line['flags'][0] & 32
    assert np.abs(pulls(line, truth)).max() < 5
    assert np.sum(fit.stars['flags'] & 32 > 0) < 3


# The table

def test_the_table_has_the_names_and_units_of_gaia(solution, tmp_path):
    stars = solution.stars
    names = ('ra', 'dec', 'parallax', 'pmra', 'pmdec')
    for i, name in enumerate(names):
        assert f'{name}_error' in stars.colnames
        for other in names[i + 1:]:
            assert f'{name}_{other}_corr' in stars.colnames
    assert stars['pmra'].unit == u.mas / u.yr
    assert stars['ra'].unit == u.deg
    assert stars['ra_error'].unit == u.mas
    for form in ('ecsv', 'fits'):
        path = tmp_path / f'stars.{form}'
        stars.write(path)
        back = QTable.read(path)
        assert_allclose(back['pmra'].value, stars['pmra'].value)
        assert back['pmra'].unit == u.mas / u.yr


def test_residuals_are_those_of_the_aligned_positions(solution):
    table = solution.residuals
    used = table[table['used']]
    stars = solution.stars
    share = np.nansum(stars['dof']) / np.sum(2 * stars['n_good_obs'])
    assert_allclose(rms(used['dra'] / used['dra_error']), np.sqrt(share),
                    atol=0.02)
    assert np.nanmedian(table['chi2']) == pytest.approx(2 * np.log(2),
                                                        rel=0.05)
    bigger = np.abs(used['dra_left_out']) >= np.abs(used['dra']) * 0.999
    assert bigger[np.isfinite(used['dra_left_out'])].mean() > 0.95


# What can be asked of a solution

def test_propagated_positions_and_errors_follow_the_motion(solution):
    later = solution.at(2035.0)
    years = 2035.0 - solution.stars['ref_epoch'][0].value
    start, end = (SkyCoord(one['ra'], one['dec'])
                  for one in (solution.stars, later))
    moved = start.spherical_offsets_to(end)
    for angle, name in zip(moved, ('ra', 'dec'), strict=True):
        assert_allclose(angle.to_value(u.mas), years
                        * solution.stars[f'pm{name}'].value, atol=1e-3)
        # sigma(t)^2 = sigma_x^2 + 2 t cov + t^2 sigma_mu^2
        place, motion = (solution.stars[key].value
                         for key in (f'{name}_error', f'pm{name}_error'))
        rho = solution.stars[f'{name}_pm{name}_corr']
        expected = np.sqrt(place**2 + 2 * years * rho * place * motion
                           + years**2 * motion**2)
        assert_allclose(later[f'{name}_error'].value, expected, rtol=1e-6)


def test_stars_go_into_a_skycoord_with_their_motions(solution):
    sky = solution.sky
    assert_allclose(sky.pm_ra_cosdec.value, solution.stars['pmra'].value)
    assert_allclose(sky.obstime.jyear, solution.stars['ref_epoch'][0].value)


def test_the_mean_of_a_field_scatters_by_the_covariance_between_stars():
    """The frames' error is common: it does not average out over stars."""
    pull, alone = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        truth = make_truth(rng, n_stars=40, n_qso=12, sigma=1.0)
        fit = ProperMotionFitter(references='qso', transform='shift',
                                 systematic=None, clip=None).fit(
            observe(truth, rng, times=TIMES[[0, 3, 6]], missing=0))
        ids = np.flatnonzero(~truth.qso)
        stars = fit.stars[np.isin(fit.stars['id'], ids)]
        stars = stars[np.argsort(stars['id'])]
        for k, name in ((2, 'pmra'), (3, 'pmdec')):
            covariance = fit.covariance(ids)[:, k, :, k]
            away = np.mean(stars[name].value - truth.pm[k - 2, ids])
            pull.append(away / np.sqrt(covariance.mean()))
            alone.append(away / np.sqrt(np.diag(covariance).mean() / 40))
            assert_allclose(np.sqrt(np.diag(covariance)),
                            stars[f'{name}_error'].value, rtol=1e-6)
    assert_allclose(rms(pull), 1, atol=0.3)
    assert rms(alone) > 1.5


def test_covariances_of_unknown_stars_or_relative_motions_raise(solution,
                                                                scene):
    with pytest.raises(ValueError, match='ids must be those of stars'):
        solution.covariance([123456])
    relative = ProperMotionFitter().fit(scene[1])
    with pytest.raises(ValueError, match='references must be given'):
        relative.covariance([1])


def test_references_held_out_agree_with_their_catalogue(scene, quasars):
    fit = ProperMotionFitter(references=quasars, hold_out=0.4,
                             rng=1).fit(scene[1])
    table = fit.validation()
    assert len(table) == 120
    assert_allclose(np.mean(table['chi2']), 2, atol=0.5)
    assert np.sum(fit.stars['flags'] & 64 > 0) == 120
    assert (fit.alignment['n_references'] <= 180).all()


def test_references_in_use_are_compared_without_their_catalogue(scene,
                                                                quasars):
    fit = ProperMotionFitter(references=quasars, hold_out=0.1,
                             rng=1).fit(scene[1])
    table = fit.reference_differences()
    held = set(np.asarray(fit.validation()['id']).tolist())
    assert len(table) == 270
    assert not held & set(np.asarray(table['id']).tolist())
    # The motions of quasars are zero, so that what was measured is left.
    measured = fit.measured()
    rows = [int(np.flatnonzero(measured['id'] == one)[0])
            for one in table['id']]
    assert_allclose(table['dpmra'].value, measured['pmra'][rows].value)
    assert_allclose(np.nanmean(table['chi2']), 2, atol=0.3)
    assert not ProperMotionFitter().fit(scene[1]).reference_differences()


def test_resampled_references_show_the_error_of_the_frames():
    rng = np.random.default_rng(4)
    truth = make_truth(rng, n_stars=100, n_qso=150, sigma=1.0)
    fit = ProperMotionFitter(references='qso', transform='shift',
                             recipe='two-step', systematic=None).fit(
        observe(truth, rng))
    draws = fit.bootstrap(10000, rng=5)
    assert draws.motion.shape == (10000, 2)
    ids = np.flatnonzero(~truth.qso)
    common = fit.covariance(ids)[:, 2, :, 2]
    off = common[~np.eye(len(ids), dtype=bool)].mean()
    assert_allclose(draws.motion[:, 0].std(), np.sqrt(off), rtol=0.2)
    assert_allclose(draws.motion.mean(axis=0), 0, atol=0.1 * np.sqrt(off))


def test_resampled_medians_scatter_like_medians(rng):
    values = rng.normal(size=1000)
    draws = bootstrap_median(values, n_resamples=4000, rng=3)
    assert_allclose(draws.std(), np.sqrt(np.pi / 2 / 1000), rtol=0.15)
    assert_allclose(draws.mean(), np.median(values), atol=0.01)
    again = bootstrap_median(values, n_resamples=4000, rng=3)
    assert_allclose(again, draws)
    with pytest.raises(ValueError, match='at least 2'):
        bootstrap_median([1.0, np.nan])


def test_an_ignored_parallax_biases_the_motion_as_the_table_says():
    rng = np.random.default_rng(6)
    truth = make_truth(rng, n_stars=100, n_qso=100, parallax=10.0, sigma=0.1)
    fit = ProperMotionFitter(references='qso', transform='shift', clip=None,
                             systematic=None).fit(
        observe(truth, rng, missing=0))
    stars = fit.stars[~truth.qso[np.asarray(fit.stars['id'])]]
    for k, name in enumerate(('pmra', 'pmdec')):
        bias = stars[name].value - truth.pm[k, stars['id']]
        expected = stars[f'{name}_per_parallax'].value * 10.0
        assert_allclose(bias, expected, atol=0.3)
    # Bias per mas of parallax with the cadence of Nie et al.
    assert_allclose(np.median(fit.stars['pmra_per_parallax'].value), -0.43,
                    atol=0.06)
    assert (stars['flags'] & 128 > 0).mean() > 0.9


def test_a_parallax_prior_lies_between_none_and_a_free_parallax():
    rng = np.random.default_rng(7)
    truth = make_truth(rng, n_stars=500, n_qso=200,
                       parallax=rng.normal(0.5, 0.5, 700))
    epochs = observe(truth, rng)
    size = {}
    for parallax in (False, 'prior', True):
        fit = ProperMotionFitter(references='qso', parallax=parallax).fit(
            epochs)
        stars = fit.stars[~truth.qso[np.asarray(fit.stars['id'])]]
        size[parallax] = np.nanmedian(stars['pmra_error'].value)
        if parallax:
            assert_allclose(rms(pulls(stars, truth)), 1, atol=0.06)
    assert size[False] < size['prior'] < size[True]


def test_accelerations_are_found(rng):
    years = (2020.0, 2021.0, 2022.0, 2023.0, 2024.0)
    epochs, _ = plane_epochs(rng, years=years, error=1e-4)
    for epoch in epochs:
        dt = epoch.mean_year - 2022.0
        epoch.table['x_fit'][:5] += 0.5 * 0.02 * dt**2
    fit = ProperMotionFitter(transform='shift', references=list(range(20, 40)),
                             acceleration=True, clip=None, systematic=None)
    table = fit.fit([changed(epoch, x_fit=np.where(
        np.arange(40) >= 20, epochs[0].table['x_fit'], epoch.table['x_fit']),
        y_fit=np.where(np.arange(40) >= 20, epochs[0].table['y_fit'],
                       epoch.table['y_fit'])) for epoch in epochs]).stars
    assert_allclose(table['accra'].value[:5], 0.02, atol=5e-4)
    assert_allclose(table['accra'].value[5:20], 0, atol=5e-4)


def test_a_known_perspective_acceleration_is_taken_out():
    """A nearby star that recedes: its motion slows down."""
    from photutils_mgauss.motions.references import read_catalogue
    from photutils_mgauss.sky.space_motion import beyond_straight
    star = Table({'id': [1], 'class': ['star'], 'ra': [269.45],
                  'dec': [4.69], 'pmra': [-801.6], 'pmdec': [10362.4],
                  'parallax': [546.98], 'radial_velocity': [-110.5],
                  'ref_epoch': [2016.0]})
    known = read_catalogue(star, None, 'mas')
    known.values[:2] = 0.0
    rate = beyond_straight(known.values, known.radial_velocity, 1.0)[2:4]
    # Barnard's star gains 1.3 mas / yr^2.
    assert_allclose(np.hypot(*rate[:, 0]), 1.28, atol=0.03)
    assert rate[1, 0] > 0


def test_the_floor_of_an_epoch_is_found(rng):
    truth = make_truth(rng, n_stars=300, n_qso=300, sigma=1.0)
    times = list(TIMES[[0, 2, 3, 4, 6]])
    epochs = observe(truth, rng, times=times, missing=0)
    noisy = epochs[2].table.copy()
    for name in ('x_fit', 'y_fit'):
        noisy[name] += rng.normal(0, 3.0 / 74, len(noisy))
    epochs[2] = Epoch(noisy, epochs[2].wcs, epochs[2].time)
    fit = ProperMotionFitter(references='qso').fit(epochs)
    floor = fit.alignment['systematic'].value
    assert_allclose(floor[2], 3.0, rtol=0.1)
    assert (np.delete(floor, 2, axis=0) < 0.5).all()
    stars = fit.stars[~truth.qso[np.asarray(fit.stars['id'])]]
    assert_allclose(rms(pulls(stars, truth)), 1, atol=0.06)


def test_matching_on_the_sky_gives_what_identifiers_give(scene, solution,
                                                         quasars):
    _, epochs = scene
    fit = ProperMotionFitter(references=quasars, match_by='sky').fit(epochs)
    both, i, j = np.intersect1d(fit.stars['id'], solution.stars['id'],
                                return_indices=True)
    assert len(both) > 2500
    away = fit.stars['pmra'][i] - solution.stars['pmra'][j]
    same = fit.stars['n_obs'][i] == solution.stars['n_obs'][j]
    assert same.mean() > 0.98
    assert np.nanmax(np.abs(away[same].value)) < 0.2


def test_pixels_with_a_unit_give_what_plain_ones_do(rng):
    epochs = observe(make_truth(rng, n_stars=50, n_qso=50), rng)
    units = dict.fromkeys(('x_fit', 'y_fit', 'x_err', 'y_err'), u.pix)
    for epoch in epochs:
        epoch.wcs.pixel_shape = None
    measured = [Epoch(QTable(epoch.table, units=units), epoch.wcs,
                      epoch.time) for epoch in epochs]
    one, two = (ProperMotionFitter(references='qso').fit(some)
                for some in (epochs, measured))
    assert_allclose(two.stars['pmra'], one.stars['pmra'])
    assert_allclose(*(fit.epochs[0].wcs.pixel_to_world_values(10, 20)
                      for fit in (one, two)), rtol=1e-15)


def test_row_numbers_of_photutils_are_not_identifiers(scene):
    _, epochs = scene
    plain = [Epoch(epoch.table['x_fit', 'y_fit', 'x_err', 'y_err', 'qso'],
                   epoch.wcs, epoch.time) for epoch in epochs[:3]]
    numbered = [changed(epoch, id=np.arange(len(epoch.table)) + 1)
                for epoch in plain]
    one, two = (ProperMotionFitter(references='qso').fit(some).stars
                for some in (plain, numbered))
    assert len(one) == len(two)
    assert_allclose(np.sort(one['pmra'].value), np.sort(two['pmra'].value))


def test_identifiers_count_however_wrong_the_pointings_are(rng):
    truth = make_truth(rng, n_stars=200, n_qso=100)
    epochs = observe(truth, rng, offset=10_000.0)
    one, two = (ProperMotionFitter(references='qso', match_by=match_by).fit(
        epochs).stars for match_by in ('auto', 'id'))
    assert len(one) == len(two) == 300
    assert_allclose(one['pmra'].value, two['pmra'].value)


def test_an_epoch_with_few_known_stars_is_named(solution, rng):
    truth = make_truth(rng, n_stars=200, n_qso=100)
    epochs = observe(truth, rng, times=TIMES[[0, 3, 6]], offset=0.0)
    ra, dec = epochs[2].wcs.wcs.crval
    epochs[2] = epochs[2].with_wcs(tan_wcs(ra, dec + 0.01))
    fit = ProperMotionFitter(references='qso', match_by='sky').fit(epochs)
    few = [note for note in fit.notes if note.startswith('Only ')]
    assert len(few) == 1
    assert 'epoch 2' in few[0]
    assert not any(note.startswith('Only ') for note in solution.notes)


def test_threads_and_one_thread_agree_exactly(scene, quasars):
    _, epochs = scene
    with ThreadPoolExecutor(3) as pool:
        one, two = (ProperMotionFitter(references=quasars,
                                       executor=pool_).fit(epochs).stars
                    for pool_ in (pool, None))
    assert_allclose(one['pmra'].value, two['pmra'].value, rtol=0, atol=0)


@pytest.mark.parametrize('match_by', ['id', 'sky', 'auto'])
def test_references_without_identifiers_are_found_by_place(match_by, rng):
    truth = make_truth(rng, n_stars=200, n_qso=150)
    which = np.flatnonzero(truth.qso)
    catalogue = Table({'ra': np.append(truth.ra[which], 10.0),
                       'dec': np.append(truth.dec[which], -5.0),
                       'class': np.full(151, 'qso')})
    fit = ProperMotionFitter(references=catalogue, match_by=match_by).fit(
        observe(truth, rng))
    marked = fit.stars['id'][fit.stars['reference'] == 'qso']
    assert np.isin(marked, which).all()
    assert len(marked) == 150
    # The object far from the field is not one of the stars.
    assert len(fit.stars) == 350
    assert_allclose(rms(pulls(fit.stars, truth)[
        :, ~truth.qso[fit.stars['id']]]), 1, atol=0.12)


def test_a_given_floor_is_added_to_the_errors(rng):
    truth = make_truth(rng, n_stars=100, n_qso=50, sigma=1.0)
    epochs = observe(truth, rng, times=TIMES[[0, 6]], missing=0)
    one, two = (ProperMotionFitter(transform=None, clip=None,
                                   systematic=floor).fit(epochs).stars
                for floor in (None, [np.sqrt(3)] * 2 * u.mas))
    assert_allclose(two['pmra_error'] / one['pmra_error'], 2, rtol=1e-6)


def test_times_of_single_rows_are_used(rng):
    epochs, _ = plane_epochs(rng, error=1e-6)
    fast = []
    for epoch in epochs:
        early = rng.uniform(-0.1, 0.1, 40)
        moved = epoch.table['x_fit'] + 3.0 * early
        table = changed(epoch, x_fit=moved,
                        time=epoch.mean_year + early).table
        fast.append(Epoch(table))
    # All stars move by 3 pixels a year on top of what they did.
    for k, epoch in enumerate(fast):
        epoch.table['x_fit'] += 3.0 * (epochs[k].mean_year - 2020.0)
    given, plain = (ProperMotionFitter(transform=None, clip=None,
                                       systematic=None).fit(some).stars
                    for some in (fast, epochs))
    motion = np.median(given['pmra'].value - plain['pmra'].value)
    assert_allclose(motion, 3.0, atol=0.02)




def test_what_is_no_reference_is_so_after_a_file_too(solution, tmp_path):
    path = tmp_path / 'motions.ecsv'
    some = solution.stars[5:].copy()
    for table in (solution.stars, some):
        table.write(path, overwrite=True)
        again = QTable.read(path)
        assert not np.ma.getmaskarray(again['reference']).any()
        assert (again['reference'] == '').sum() == (
            table['reference'] == '').sum() > 0
        assert list(again['reference']) == list(table['reference'])
