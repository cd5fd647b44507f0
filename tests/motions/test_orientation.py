"""Epochs that look elsewhere than they say, by the pattern of their stars."""
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.wcs import WCS

from helpers.motion_scenes import rms
from helpers.wcs import make_gwcs, tan_wcs
from photutils_mgauss import Epoch, ProperMotionFitter

YEARS = (2012.0, 2017.0, 2022.0)
RA, DEC = 150.0, 40.0


def sky_with_motions(rng, n=1500):
    """Return ra, dec [deg], motions (2, n) [mas/yr] and fluxes."""
    ra = RA + rng.uniform(-0.05, 0.05, n) / np.cos(np.radians(DEC))
    dec = DEC + rng.uniform(-0.05, 0.05, n)
    return ra, dec, rng.normal(0, 3, (2, n)), 10 ** rng.uniform(2, 5, n)


def seen_through(true, given, sky, year, rng, size=1600):
    """Return an epoch with a wrong WCS, and the numbers of its stars."""
    ra, dec, motion, flux = sky
    dt = (year - YEARS[1]) / 3.6e6
    x, y = true.world_to_pixel_values(
        ra + motion[0] * dt / np.cos(np.radians(dec)), dec + motion[1] * dt)
    number = np.flatnonzero((x > 0) & (x < size) & (y > 0) & (y < size))
    number = rng.permutation(number)
    error = np.full(len(number), 0.01)
    table = Table({'x_fit': x[number] + rng.normal(0, error),
                   'y_fit': y[number] + rng.normal(0, error),
                   'x_err': error, 'y_err': error,
                   'flux_fit': flux[number], 'number': number})
    return Epoch(table, given, year)


def fits_pair(roll, east, north):
    """Return a true FITS WCS, and one with a wrong pointing and roll."""
    return (tan_wcs(RA, DEC, rotation=10.0, size=1600),
            tan_wcs(RA + east, DEC + north, rotation=10.0 + roll, size=1600))


def gwcs_pair(roll, east, north):
    """Return the same as gwcs."""
    return (make_gwcs(RA, DEC, rotation=10.0),
            make_gwcs(RA + east, DEC + north, rotation=10.0 + roll))


def found_and_true(solution, epochs, sky):
    """Return rows of stars in all epochs, and their true numbers."""
    stars = solution.stars[solution.stars['n_good_obs'] == len(epochs)]
    rows = solution.residuals
    rows = rows[rows['epoch'] == 0]
    number = dict(zip(rows['id'], epochs[0].table['number'][rows['row']],
                      strict=True))
    return stars, np.array([number[name] for name in stars['id']])


@pytest.mark.parametrize('pair', [fits_pair, gwcs_pair])
def test_pointings_and_rolls_are_found(rng, pair):
    sky = sky_with_motions(rng)
    epochs = [seen_through(*pair(*wrong), sky, year, rng)
              for year, wrong in zip(YEARS, (
                  (0, 0, 0), (170.0, 0.02, -0.03), (-77.0, -0.04, 0.01)),
                  strict=True)]
    solution = ProperMotionFitter(match_by='pattern').fit(epochs)
    stars, number = found_and_true(solution, epochs, sky)
    in_all = set(epochs[0].table['number']).intersection(
        epochs[1].table['number'], epochs[2].table['number'])
    assert len(stars) > 0.95 * len(in_all)
    away = stars['pmra'].value - sky[2][0][number]
    # Relative motions lack the part of them that maps can take up.
    field = np.column_stack([np.ones(len(stars)), stars['ra'].value - RA,
                             stars['dec'].value - DEC])
    away -= field @ np.linalg.lstsq(field, away, rcond=None)[0]
    pull = away / stars['pmra_error'].value
    assert abs(rms(pull[np.abs(pull) < 5]) - 1) < 0.15
    assert np.mean(np.abs(pull) < 5) > 0.98
    turned = [note for note in solution.notes if 'pointing' in note]
    assert len(turned) == 2
    assert 'roll by' in turned[0]
    # The WCS that come back are right everywhere, the corners included, up
    # to what the first pointing, which is right, is of the mean frame.
    true = pair(0, 0, 0)[0]
    corners = [100, 1500, 100, 1500.0], [100, 100, 1500, 1500.0]
    right = true.pixel_to_world(*corners)
    for epoch in solution.epochs:
        assert (epoch.wcs.pixel_to_world(*corners).separation(right)
                < 50 * u.mas).all()
    assert (solution.alignment['wcs_residual'] < 0.01 * u.mas).all()


def catalogue_of(sky):
    """Return the table of all stars as references."""
    ra, dec, motion, flux = sky
    references = QTable({
        'ra': ra * u.deg, 'dec': dec * u.deg,
        'pmra': motion[0] * u.mas / u.yr, 'pmdec': motion[1] * u.mas / u.yr,
        'phot_g_mean_mag': 25 - 2.5 * np.log10(flux),
        'ref_epoch': np.full(len(ra), YEARS[1]) * u.yr})
    for name, error in (('ra', u.mas), ('dec', u.mas),
                        ('pmra', u.mas / u.yr), ('pmdec', u.mas / u.yr)):
        references[f'{name}_error'] = np.full(len(ra), 0.1) * error
    return references


def test_pointings_are_found_on_the_references(rng):
    sky = sky_with_motions(rng)
    references, motion = catalogue_of(sky), sky[2]
    [epoch] = [seen_through(*fits_pair(90.0, 0.03, 0.0), sky, 2004.0, rng)]
    # A header whose pointing is that of a parked telescope.
    lost = Epoch(epoch.table, WCS(epoch.wcs.to_header()), epoch.time)
    lost.wcs.wcs.crval = 0.0, -89.0
    for one in (epoch, lost):
        solution = ProperMotionFitter(references=references,
                                      match_by='pattern').fit([one])
        stars = solution.stars
        known = stars['reference_row'] >= 0
        assert known.sum() > 0.97 * len(epoch.table)
        pull = (stars['pmra'].value - motion[0][stars['reference_row']]
                ) / stars['pmra_error'].value
        assert rms(pull[known]) < 1.2


def test_lists_without_wcs_are_found_on_references_in_the_sky(rng):
    sky = sky_with_motions(rng)
    true = fits_pair(0, 0, 0)[0]
    epochs = [seen_through(true, None, sky, year, rng) for year in YEARS[:2]]
    # One epoch and the catalogue's places are enough.
    for some in (epochs, epochs[:1]):
        solution = ProperMotionFitter(references=catalogue_of(sky),
                                      match_by='pattern').fit(some)
        stars = solution.stars
        known = stars['reference_row'] >= 0
        assert known.sum() > 0.97 * len(epochs[0].table)
        pull = (stars['pmra'].value - sky[2][0][stars['reference_row']]
                ) / stars['pmra_error'].value
        assert rms(pull[known]) < 1.2
        corners = [100, 1500, 100, 1500.0], [100, 100, 1500, 1500.0]
        right = true.pixel_to_world(*corners)
        for epoch in solution.epochs:
            away = epoch.wcs.pixel_to_world(*corners).separation(right)
            assert (away < 5 * u.mas).all()


def pixel_lists(rng, changes, n=300):
    """Return epochs in pixels, each through a map of the plane."""
    place, motion = rng.uniform(0, 2000, (2, n)), rng.normal(0, 0.02, (2, n))
    flux, error = 10 ** rng.uniform(2, 5, n), np.full(n, 0.01)
    epochs = []
    for year, change in zip(YEARS, changes, strict=True):
        x, y = change(*(place + motion * (year - YEARS[0])))
        epochs.append(Epoch(QTable({
            'x_fit': x + rng.normal(0, error), 'x_err': error,
            'y_fit': y + rng.normal(0, error), 'y_err': error,
            'flux_fit': flux}), time=year))
    return epochs, motion


def same(x, y):
    return x, y


def test_lists_in_pixels_of_any_scale_are_matched(rng):
    epochs, _ = pixel_lists(rng, (
        same, lambda x, y: (900 - 0.5 * y, 0.5 * x),
        lambda x, y: (2 * x + 30, 4000 - 2 * y)))
    solution = ProperMotionFitter(match_by='pattern').fit(epochs)
    stars = solution.stars
    assert (stars['n_good_obs'] == 3).sum() >= 0.98 * 300
    assert np.isfinite(stars['pmra']).sum() >= 0.98 * 300
    assert any('epoch 2 was mirrored' in note for note in solution.notes)


def test_a_radius_alone_leads_to_the_pattern(rng):
    epochs, _ = pixel_lists(rng, (
        same, lambda x, y: (2000 - x, 2000 - y), same))
    stars = ProperMotionFitter(match_radius=2 * u.pix).fit(epochs).stars
    assert (stars['n_good_obs'] == 3).sum() >= 0.98 * 300


def test_lists_without_a_common_pattern_raise(rng):
    epochs, _ = pixel_lists(rng, (same, same, same))
    others, _ = pixel_lists(rng, (same, same, same))
    with pytest.raises(ValueError, match='epoch 1 must have a pattern'):
        ProperMotionFitter(match_by='pattern').fit([epochs[0], others[1]])


def test_five_objects_are_a_pattern(rng):
    epochs, _ = pixel_lists(rng, (
        same, lambda x, y: (900 - 0.5 * y, 0.5 * x), same), n=5)
    stars = ProperMotionFitter(match_by='pattern').fit(epochs).stars
    assert list(stars['n_good_obs']) == [3] * 5


def test_four_objects_are_no_pattern(rng):
    epochs, _ = pixel_lists(rng, (same, same, same), n=4)
    with pytest.raises(ValueError, match=r'at least 5 objects .* got 4'):
        ProperMotionFitter(match_by='pattern').fit(epochs)
