"""Nearby stars: their motion changes as they come nearer or recede."""
import warnings

import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.coordinates import (
    CartesianRepresentation,
    SkyCoord,
    get_body_barycentric,
)
from astropy.table import QTable, Table
from astropy.time import Time
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, ProperMotionFitter
from photutils_mgauss.sky.space_motion import beyond_straight, jacobian, moved
from photutils_mgauss.sky.tangent_plane import TangentPlane, unit_vectors

# Barnard's star in the Gaia catalogue.
BARNARD = {'ra': 269.4485 * u.deg, 'dec': 4.73942 * u.deg,
           'pmra': -801.551 * u.mas / u.yr, 'pmdec': 10362.394 * u.mas / u.yr,
           'parallax': 546.976 * u.mas,
           'radial_velocity': -110.47 * u.km / u.s}
YEARS = (2000.1, 2004.4, 2008.7, 2012.2, 2016.1, 2020.5, 2024.3)
UNIT = u.mas / u.yr


def tdb(year):
    return Time(year, format='jyear', scale='tdb')


STAR = SkyCoord(
    BARNARD['ra'], BARNARD['dec'], pm_ra_cosdec=BARNARD['pmra'],
    pm_dec=BARNARD['pmdec'], radial_velocity=BARNARD['radial_velocity'],
    distance=BARNARD['parallax'].to(u.pc, u.parallax()), obstime=tdb(2016))


def rigorous(year):
    """Return the star at another time, by astropy."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', erfa.ErfaWarning)
        return STAR.apply_space_motion(new_obstime=tdb(year))


def seen(year):
    """Return ra and dec [deg] of the star, seen from the Earth."""
    earth = get_body_barycentric('earth', tdb(year), ephemeris='builtin')
    place = SkyCoord(CartesianRepresentation(
        rigorous(year).cartesian.xyz - earth.xyz))
    return place.ra.deg, place.dec.deg


def barnard_epochs(rng, *, n_qso=0, error=0.2, **columns):
    """Return epochs of the star (id 1) and quasars around it."""
    ra, dec = (BARNARD[name].value + rng.uniform(-0.05, 0.05, n_qso)
               for name in ('ra', 'dec'))
    epochs = []
    for year in YEARS:
        one = seen(year)
        noise = rng.normal(0, error, (2, n_qso)) / 3.6e6
        n = n_qso + 1
        table = Table({
            'id': 1 + np.arange(n),
            'ra': np.append(one[0], ra + noise[0] / np.cos(np.radians(dec))),
            'dec': np.append(one[1], dec + noise[1]),
            'ra_error': np.full(n, error), 'dec_error': np.full(n, error),
            'qso': np.arange(n) > 0})
        for name, value in columns.items():
            table[name] = np.where(np.arange(n) > 0, np.nan, value)
        epochs.append(Epoch(table, time=tdb(year)))
    return epochs


def barnard_catalogue(n_qso=0, **errors):
    """Return a table of references, the star first."""
    table = QTable({name: np.append(value.value, np.full(n_qso, np.nan))
                    * value.unit for name, value in BARNARD.items()})
    table['id'] = 1 + np.arange(n_qso + 1)
    table['class'] = ['star', *['qso'] * n_qso]
    table['ref_epoch'] = np.full(n_qso + 1, 2016.0) * u.yr
    for name, error in errors.items():
        table[f'{name}_error'] = (np.full(n_qso + 1, error)
                                  * BARNARD[name].unit)
    return table


def assert_moves_in_space(solution, *, motion=0.1, place=5.0):
    """Check motion at 2016, and place and motion in 2050."""
    row = solution.stars[solution.stars['id'] == 1][0]
    then = rigorous(2050)
    later = solution.at(tdb(2050))
    later = later[later['id'] == 1][0]
    for one, star in ((row, STAR), (later, then)):
        assert abs(one['pmra'] - star.pm_ra_cosdec) < motion * UNIT
        assert abs(one['pmdec'] - star.pm_dec) < motion * UNIT
    assert abs(later['ra'] - then.ra) < place * u.mas
    assert abs(later['dec'] - then.dec) < place * u.mas


@pytest.mark.parametrize('year', [1950.0, 2050.0])
@pytest.mark.parametrize('off', [0.0, 0.4])
def test_motion_in_space_is_that_of_astropy(year, off):
    plane = TangentPlane(BARNARD['ra'].value + off,
                         BARNARD['dec'].value + off)
    place = plane.project(unit_vectors(STAR.ra.deg, STAR.dec.deg))
    motion = plane.local_jacobian(place) @ [STAR.pm_ra_cosdec.value,
                                            STAR.pm_dec.value]
    now = np.array([*place, *motion, 546.976])[:, None]
    then = rigorous(year)
    got = moved(now, -110.47, year - 2016)[:, 0]
    # astropy adds what light's travel time does, a millionth of the way.
    assert_allclose(got[:2], plane.project(unit_vectors(
        then.ra.deg, then.dec.deg)), atol=0.6)
    assert_allclose(got[2:4], plane.local_jacobian(got[:2]) @ [
        then.pm_ra_cosdec.to_value(UNIT), then.pm_dec.to_value(UNIT)],
        atol=0.02)
    assert_allclose(got[4], 1000 / then.distance.pc, atol=0.005)


def test_derivatives_of_motion_in_space_are_differences():
    now = np.array([2e5, -1e5, -801.6, 10362.4, 546.98])[:, None]
    step = np.diag([1e3, 1e3, 1.0, 1.0, 1.0])
    numeric = np.stack([
        (moved(now + one[:, None], -110.5, 34.0)
         - moved(now - one[:, None], -110.5, 34.0))[:, 0] / 2 / one.max()
        for one in step], axis=1)
    assert_allclose(jacobian(now, -110.5, 34.0)[..., 0], numeric, rtol=2e-3,
                    atol=2e-3)


def test_a_receding_star_without_a_plane_slows_down():
    now = np.array([0.0, 0.0, 0.0, 10362.4, 546.98])[:, None]
    extra = beyond_straight(now, np.array([-110.5]), 1.0)
    # Barnard's star gains 1.3 mas/yr in a year.
    assert_allclose(extra[3], 1.28, atol=0.03)
    assert beyond_straight(now, np.array([110.5]), 1.0)[3] < 0


@pytest.mark.parametrize('parallax', [True, False])
def test_motions_are_those_of_the_reference_epoch(parallax, rng):
    solution = ProperMotionFitter(
        transform=None, parallax=parallax, match_by='id', ref_epoch=2016.0,
        references=barnard_catalogue(pmra=50, pmdec=50, parallax=0.05)).fit(
            barnard_epochs(rng))
    assert_moves_in_space(solution)
    if parallax:
        assert abs(solution.stars['parallax'][0] - 546.976 * u.mas) < 0.2 * (
            u.mas)
        assert abs(solution.at(2050.0)['parallax'][0]
                   - 1000 / rigorous(2050).distance.pc * u.mas) < 0.2 * u.mas
    assert solution.stars['flags'][0] & (8 | 32 | 512) == 0
    assert_allclose(solution.stars['radial_velocity'].value, [-110.47])


def test_a_motion_need_not_be_known_beforehand(rng):
    catalogue = barnard_catalogue()
    catalogue['class'] = ['position']
    catalogue.remove_columns(['pmra', 'pmdec', 'parallax'])
    solution = ProperMotionFitter(
        transform=None, parallax=True, match_by='id', ref_epoch=2016.0,
        references=catalogue).fit(barnard_epochs(rng))
    assert_moves_in_space(solution)
    assert solution.stars['flags'][0] & (8 | 32 | 512) == 0


def test_radial_velocities_may_come_with_the_detections(rng):
    epochs = barnard_epochs(rng, n_qso=30, radial_velocity=-110.47)
    solution = ProperMotionFitter(
        parallax=True, match_by='id', ref_epoch=2016.0,
        references='qso').fit(epochs)
    # The frames of 30 quasars are less certain than the star.
    assert_moves_in_space(solution, motion=0.15, place=10.0)
    assert np.isnan(solution.stars['radial_velocity'][1:]).all()


def test_a_precise_catalogue_agrees_with_what_it_foretold(rng):
    catalogue = barnard_catalogue(30, ra=0.05, dec=0.05, pmra=0.03,
                                  pmdec=0.03, parallax=0.03)
    fitter = ProperMotionFitter(parallax=True, match_by='id',
                                ref_epoch=2016.0, references=catalogue)
    solution = fitter.fit(barnard_epochs(rng, n_qso=30))
    assert_moves_in_space(solution)
    assert (solution.stars['flags'] & 32 == 0).all()


def test_a_wrong_catalogue_motion_is_not_used_for_the_acceleration(rng):
    catalogue = barnard_catalogue(30, pmra=0.03, pmdec=0.03, parallax=0.03)
    catalogue['pmdec'][0] = 5000 * UNIT
    solution = ProperMotionFitter(
        parallax=True, match_by='id', ref_epoch=2016.0,
        references=catalogue).fit(barnard_epochs(rng, n_qso=30))
    assert_moves_in_space(solution, motion=0.15, place=10.0)
    assert solution.stars['flags'][0] & 32


def test_a_star_held_out_is_compared_at_one_time(rng):
    catalogue = barnard_catalogue(1, pmra=0.03, pmdec=0.03, parallax=0.03)
    solution = ProperMotionFitter(
        parallax=True, match_by='id', transform=None, ref_epoch=2024.0,
        references=catalogue, hold_out=0.5, rng=1).fit(
            barnard_epochs(rng, n_qso=1))
    table = solution.validation()
    assert table['id'].tolist() == [1]
    assert abs(table['dpmdec'][0]) < 0.1 * UNIT


def test_covariances_between_stars_are_those_of_the_table(rng):
    catalogue = barnard_catalogue(30, pmra=50, pmdec=50, parallax=0.05)
    solution = ProperMotionFitter(
        parallax=True, match_by='id', ref_epoch=2040.0,
        references=catalogue).fit(barnard_epochs(rng, n_qso=30))
    covariance = solution.covariance([2, 1])[1, :, 1]
    errors = [solution.stars[f'{name}_error'][0].value for name in (
        'ra', 'dec', 'parallax', 'pmra', 'pmdec')]
    assert_allclose(np.sqrt(np.diag(covariance)), errors, rtol=1e-8)


def test_the_error_of_the_radial_velocity_is_in_those_of_later(rng):
    """As much as places in 2080 change by a velocity off by its error."""
    seed, sigma = rng.integers(2**30), 2.0
    found = {}
    for name, velocity, error in (('without', -110.47, None),
                                  ('more', -110.47 + sigma, None),
                                  ('with', -110.47, sigma)):
        more = {} if error is None else {'radial_velocity_error': error}
        epochs = barnard_epochs(np.random.default_rng(seed), n_qso=30,
                                radial_velocity=velocity, **more)
        solution = ProperMotionFitter(
            parallax=True, match_by='id', ref_epoch=2080.0,
            references='qso').fit(epochs)
        found[name] = solution
    dec, error = ({name: one.stars[column][0].to_value(u.mas)
                   for name, one in found.items()}
                  for column in ('dec', 'dec_error'))
    added = np.sqrt(error['with']**2 - error['without']**2)
    assert_allclose(added, abs(dec['more'] - dec['without']), rtol=0.1)
    assert_allclose(dec['with'], dec['without'], atol=1e-6)
    covariance = found['with'].covariance([1])[0, :, 0]
    assert_allclose(np.sqrt(covariance[1, 1]), error['with'], rtol=1e-6)


def test_radial_velocities_without_parallaxes_are_said_not_to_count(rng):
    epochs = barnard_epochs(rng, n_qso=30, radial_velocity=-110.47)
    solution = ProperMotionFitter(
        match_by='id', clip=None, references='qso').fit(epochs)
    assert any('radial velocity of one star is not' in note
               for note in solution.notes)
