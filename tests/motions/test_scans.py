"""Observations that measure a place along one direction only."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import get_body_barycentric
from astropy.table import Table
from astropy.time import Time
from numpy.testing import assert_allclose

from photutils_mgauss import Epoch, ProperMotionFitter, decode_motion_flags

RA, DEC, YEAR = 84.3, -12.0, 1991.25


def scans(rng, n=80, error=0.5, parallax=12.0, motion=(30.0, -55.0)):
    """Return years, angles [rad], abscissae [mas] and their design (n, 5)."""
    years = 1990 + np.sort(rng.uniform(0, 3.2, n))
    angle = rng.uniform(0, 2 * np.pi, n)
    times = Time(years, format='jyear', scale='tdb')
    earth = get_body_barycentric('earth', times,
                                 ephemeris='builtin').xyz.to_value(u.au)
    a, d = np.radians([RA, DEC])
    sine, cosine = np.sin(angle), np.cos(angle)
    factor = (np.array([np.sin(a), -np.cos(a), 0]) @ earth * sine
              + np.array([np.cos(a) * np.sin(d), np.sin(a) * np.sin(d),
                          -np.cos(d)]) @ earth * cosine)
    dt = years - YEAR
    design = np.column_stack([sine, cosine, factor, sine * dt, cosine * dt])
    along = design @ np.array([0, 0, parallax, *motion])
    return years, angle, along + rng.normal(0, error, n), design


def scan_epochs(years, angle, along, error=0.5):
    return [Epoch(Table({'id': [1], 'ra': [RA], 'dec': [DEC], 'along': [w],
                         'along_error': [error],
                         'scan_angle': [np.degrees(t)]}), time=year)
            for year, t, w in zip(years, angle, along, strict=True)]


def fitted(epochs, **keywords):
    return ProperMotionFitter(transform=None, parallax=True, match_by='id',
                              ref_epoch=YEAR, **keywords).fit(epochs)


def test_scans_give_the_least_squares_solution(rng):
    years, angle, along, design = scans(rng)
    star = fitted(scan_epochs(years, angle, along)).stars[0]
    expected, chi2, _, _ = np.linalg.lstsq(design, along, rcond=None)
    covariance = 0.25 * np.linalg.inv(design.T @ design)
    for k, name in enumerate(('parallax', 'pmra', 'pmdec'), 2):
        error = np.sqrt(covariance[k, k])
        assert_allclose(star[f'{name}_error'].value, error, rtol=1e-4)
        assert abs(star[name].value - expected[k]) < 1e-3 * error
    assert star['dof'] == len(along) - 5
    assert_allclose(star['chi2'], chi2[0] / 0.25, rtol=1e-4)


def test_the_systematic_error_of_scans_is_found(rng):
    # Many stars, each scanned at the same times, and 1 mas more than stated.
    parts = [scans(rng, n=30) for _ in range(60)]
    years = parts[0][0]
    angle = parts[0][1]
    epochs = []
    for e, (year, t) in enumerate(zip(years, angle, strict=True)):
        n = len(parts)
        along = np.array([design[e] @ [0, 0, 12, 30, -55]
                          for _, _, _, design in [parts[0]] * n])
        along += rng.normal(0, np.hypot(0.5, 1.0), n)
        epochs.append(Epoch(Table({
            'id': np.arange(n), 'ra': np.full(n, RA), 'dec': np.full(n, DEC),
            'along': along, 'along_error': np.full(n, 0.5),
            'scan_angle': np.full(n, np.degrees(t))}), time=year))
    solution = fitted(epochs)
    assert_allclose(np.median(solution.alignment['systematic'].value), 1.0,
                    atol=0.1)
    assert_allclose(np.mean(solution.stars['uwe']), 1.0, atol=0.05)


def test_a_wrong_scan_is_rejected_at_its_own_limit(rng):
    years, angle, along, _ = scans(rng)
    along[10] += 40 * 0.5
    along[20] += 5.6 * 0.5
    star = fitted(scan_epochs(years, angle, along), systematic=None).stars[0]
    assert star['n_good_obs'] >= len(along) - 2
    assert star['n_good_obs'] < len(along)
    assert 'outlier' in decode_motion_flags(star['flags'])[0]


def test_a_scan_without_an_error_has_no_weight(rng):
    years, angle, along, _ = scans(rng)
    epochs = scan_epochs(years, angle, along)
    epochs[3].table['along_error'][0] = 0.0
    epochs[4].table['scan_angle'][0] = np.nan
    star = fitted(epochs).stars[0]
    assert star['n_good_obs'] == len(along) - 2


def test_a_scan_needs_its_angle_and_its_error():
    table = Table({'ra': [RA], 'dec': [DEC], 'along': [0.0],
                   'along_error': [0.1]})
    with pytest.raises(ValueError, match="a column 'scan_angle'"):
        Epoch(table, time=2000.0)
