"""Exposures of several chips: one map, and one distortion for each chip."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from astropy.wcs import WCS

from helpers.camera import (
    ERROR,
    chip_wcs,
    expose,
    known_stars,
    make_field,
)
from helpers.motion_scenes import rms
from helpers.wcs import SCALE, make_gwcs, tan_wcs
from photutils_mgauss import Epoch, ProperMotionFitter

YEARS = (2010.0, 2013.0, 2016.5, 2020.0)


def solve(field, seed, **keywords):
    rng = np.random.default_rng(seed)
    epochs = [expose(field, rng, year) for year in YEARS]
    references = known_stars(field, rng, 60)
    fitter = ProperMotionFitter(references=references, match_by='id',
                                **keywords)
    return fitter.fit(epochs)


def errors(solution, field):
    """Return errors (2, k) and pulls of stars that are no references."""
    stars = solution.stars
    number = np.asarray(stars['id'])
    use = (number >= 60) & (stars['n_good_obs'] == len(YEARS))
    away = np.stack([stars[name].value[use] - field.pm[k, number[use]]
                     for k, name in enumerate(('pmra', 'pmdec'))])
    stated = np.stack([stars[f'{name}_error'].value[use]
                       for name in ('pmra', 'pmdec')])
    return away, away / stated


def test_unknown_distortions_cost_nothing():
    # Enough stars that the errors of the polynomials themselves are small.
    field = make_field(np.random.default_rng(1), per_chip=250)
    flat = make_field(np.random.default_rng(1), per_chip=250, size=0.0)
    away, pull = errors(solve(field, 2, distortion='poly-3'), field)
    best, _ = errors(solve(flat, 2, distortion=None), flat)
    assert rms(away) < 1.05 * rms(best)
    assert abs(rms(pull) - 1) < 0.08


def test_what_comes_back_are_the_wcs_of_the_chips():
    field = make_field(np.random.default_rng(1))
    solution = solve(field, 2, distortion='poly-3')
    assert (solution.alignment['systematic'] == 0).all()
    assert (solution.alignment['wcs_residual'] < 0.01 * u.mas).all()
    rows = solution.residuals
    epoch = solution.epochs[1]
    rows = rows[rows['epoch'] == 1]
    table = epoch.table[rows['row']]
    for name, wcs in epoch.chips.items():
        own = np.asarray(table['chip']) == name
        sky = wcs.pixel_to_world(table['x_fit'][own], table['y_fit'][own])
        ra, dec = rows['ra'][own], rows['dec'][own]
        away = np.hypot((sky.ra - ra).to_value(u.mas),
                        (sky.dec - dec).to_value(u.mas))
        assert away.max() < 0.05


def test_chips_that_are_right_need_no_distortion():
    flat = make_field(np.random.default_rng(3), size=0.0)
    moved, _ = errors(solve(flat, 4), flat)
    fixed, _ = errors(solve(flat, 4, distortion=None), flat)
    assert rms(moved) < 1.02 * rms(fixed)


def test_one_chip_is_the_epoch_it_is(rng):
    # A camera of one chip without distortion is a plain epoch.
    field = make_field(rng, columns=1, rows=1, per_chip=100, size=0.0)
    many = [expose(field, np.random.default_rng(k), year)
            for k, year in enumerate(YEARS)]
    plain = [Epoch(one.table, one.chips[0], one.time) for one in many]
    references = known_stars(field, rng, 40)
    one, other = (ProperMotionFitter(references=references, match_by='id',
                                     distortion=None).fit(epochs).stars
                  for epochs in (many, plain))
    for name in ('ra', 'pmra', 'pmdec_error'):
        np.testing.assert_allclose(one[name].value, other[name].value,
                                   rtol=1e-9)


def test_chips_without_references_are_relative(rng):
    field = make_field(rng)
    epochs = [expose(field, rng, year) for year in YEARS]
    solution = ProperMotionFitter(match_by='id',
                                  distortion='poly-3').fit(epochs)
    assert np.isfinite(solution.stars['pmra']).sum() > 300


def test_the_chips_of_one_epoch_and_a_catalogue(rng):
    field = make_field(rng)
    epoch = expose(field, rng, 2004.0)
    references = known_stars(field, rng, 300)
    for name in ('pmra', 'pmdec', 'pmra_error', 'pmdec_error'):
        references[name][200:] = np.nan
    stars = ProperMotionFitter(references=references, match_by='id',
                               distortion='poly-3').fit([epoch]).stars
    free = stars['reference'] == 'position'
    assert np.isfinite(stars['pmra'][free]).all()
    assert free.sum() > 50


def test_gwcs_of_chips_become_headers(rng):
    table = Table({'id': np.arange(40), 'x_fit': rng.uniform(0, 900, 40),
                   'y_fit': rng.uniform(0, 900, 40),
                   'x_err': np.full(40, ERROR), 'y_err': np.full(40, ERROR)})
    epochs = [Epoch.of_chips([(table, make_gwcs(10, 20))], year)
              for year in YEARS]
    solution = ProperMotionFitter(match_by='id').fit(epochs)
    assert isinstance(solution.epochs[0].chips[0], WCS)


@pytest.mark.parametrize(('change', 'words'), [
    ({'names': ['a', 'a']}, 'names must be different'),
    ({'names': ['a']}, 'names must be different for each of the 2'),
])
def test_names_of_chips_are_checked(rng, change, words):
    field = make_field(rng, columns=2, rows=1)
    table = expose(field, rng, 2010.0).table
    pairs = [(table, chip_wcs(field, k, 150, 0, 0)) for k in range(2)]
    with pytest.raises(ValueError, match=words):
        Epoch.of_chips(pairs, 2010.0, **change)


def test_pairs_of_chips_are_checked(rng):
    with pytest.raises(ValueError, match='pairs must be'):
        Epoch.of_chips([], 2010.0)
    with pytest.raises(TypeError, match='wcs of chip 0 must be'):
        Epoch.of_chips([(Table({'x': [1.0]}), None)], 2010.0)
    wcs = tan_wcs(0, 0)
    table = Table({'x': [1.0], 'y': [1.0], 'x_err': [0.1], 'y_err': [0.1],
                   'chip': ['b']})
    with pytest.raises(ValueError, match="names of chips, got 'b'"):
        Epoch(table, time=2010.0, chips={'a': wcs})
    with pytest.raises(ValueError, match='wcs must be None'):
        Epoch(table, wcs, 2010.0, chips={'b': wcs})
    with pytest.raises(ValueError, match='distortion must be'):
        ProperMotionFitter(distortion='rigid')


def test_chips_are_matched_by_position(rng):
    field = make_field(rng, size=0.6 / SCALE)
    epochs = [expose(field, rng, year, with_ids=False) for year in YEARS]
    references = known_stars(field, rng, len(field.ra))
    solution = ProperMotionFitter(references=references,
                                  distortion='poly-3').fit(epochs)
    stars = solution.stars
    assert np.sum(stars['n_good_obs'] == len(YEARS)) > 350
    known = stars['reference_row'] >= 0
    assert known.sum() > 0.95 * len(stars)


def test_residuals_in_pixels_show_what_no_map_takes_up():
    # The distortion is left to the residuals, in pixels of each chip.
    field = make_field(np.random.default_rng(1), columns=2, rows=1,
                       per_chip=200, size=1.0)
    solution = solve(field, 2, distortion=None, clip=None, systematic=None)
    table = solution.detector_residuals()
    rows = solution.residuals
    assert len(table) == len(rows)
    assert set(table['chip']) == {'0', '1'}
    # The same residuals by way of the WCS that came back.
    epoch = solution.epochs[2]
    own = np.flatnonzero((rows['epoch'] == 2) & (table['chip'] == '1'))
    wcs = epoch.chips[1]
    ra, dec = rows['ra'][own], rows['dec'][own]
    moved = (ra + rows['dra'][own] / np.cos(dec), dec + rows['ddec'][own])
    before, after = (np.stack(wcs.all_world2pix(
        at[0].to_value(u.deg), at[1].to_value(u.deg), 0, tolerance=1e-9))
        for at in ((ra, dec), moved))
    found = np.stack([table[name][own].value for name in ('dx_pix',
                                                          'dy_pix')])
    assert np.abs(found - (after - before)).max() < 1e-3 * np.abs(found).max()
    assert np.abs(found).max() > 0.1


def test_residuals_of_places_on_the_sky_are_in_no_pixels(rng):
    sky = [Epoch(Table({'id': np.arange(20),
                        'ra': 10 + rng.uniform(0, 0.01, 20),
                        'dec': rng.uniform(0, 0.01, 20),
                        'ra_error': np.ones(20), 'dec_error': np.ones(20)}),
                 time=year) for year in (2010.0, 2015.0, 2020.0)]
    for epoch in sky[1:]:
        epoch.table['ra'] = sky[0].table['ra'] + rng.normal(0, 1, 20) / 3.6e6
        epoch.table['dec'] = (sky[0].table['dec']
                              + rng.normal(0, 1, 20) / 3.6e6)
    table = ProperMotionFitter().fit(sky).detector_residuals()
    assert len(table) == 60
    assert np.isnan(table['dx_pix']).all()
