"""Laws of motions fitted to the pixels of all epochs together."""
import warnings
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from helpers.moving_stars import (
    SCALE,
    make_wcs,
    observe,
    place_at,
    truth,
)
from helpers.star_images import MIXTURE
from photutils_mgauss import (
    Epoch,
    PixelMotionFitter,
    ProperMotionFitter,
    decode_motion_flags,
    fit_many,
)

YEARS = (2024.9, 2026.4, 2026.6, 2028.5)
NAMES = ('ra', 'dec', 'pmra', 'pmdec')


def literal_fit(images, star, n_stars=1, parallax=False, half=5):
    """Fit all pixels of the stars' boxes with scipy; values and errors."""
    years = np.array([image.year for image in images])
    size = 5 if parallax else 4
    boxes = []
    for image in images:
        mask = np.zeros(image.data.shape, bool)
        for x, y in zip(*image.wcs.world_to_pixel(place_at(
                star, image.year - years.mean(), image.year)), strict=True):
            i, j = round(float(y)), round(float(x))
            mask[i - half:i + half + 1, j - half:j + half + 1] = True
        boxes.append(mask)

    def residuals(p):
        moved = star.copy()
        own = p[:size * n_stars].reshape(n_stars, size) - 100
        at = SkyCoord(star['ra'], star['dec']).spherical_offsets_by(
            own[:, 0] * u.mas, own[:, 1] * u.mas)
        moved['ra'], moved['dec'] = at.ra, at.dec
        moved['pmra'], moved['pmdec'] = (own[:, 2:4].T * u.mas / u.yr)
        moved['parallax'] = (own[:, 4] if parallax else 0) * u.mas
        light = p[size * n_stars:].reshape(len(images), n_stars + 1)
        out = []
        for k, image in enumerate(images):
            x, y = image.wcs.world_to_pixel(place_at(
                moved, image.year - years.mean(), image.year))
            model = np.full(image.data.shape, light[k, -1])
            for s in range(n_stars):
                model += MIXTURE.render(model.shape, float(x[s]), float(y[s]),
                                        flux=light[k, s])
            out.append(((image.data - model) / image.error)[boxes[k]])
        return np.concatenate(out)

    # Numbers around 100, for steps of derivatives go with their size.
    start = np.full(size * n_stars + len(images) * (n_stars + 1), 100.0)
    start[2:size * n_stars:size] += star['pmra'].value
    start[3:size * n_stars:size] += star['pmdec'].value
    if parallax:
        start[4] += star['parallax'].value[0]
    fit = least_squares(residuals, start, '3-point', x_scale='jac',
                        diff_step=1e-4, xtol=1e-10)
    fit.x[:size * n_stars] -= 100
    return fit.x, np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))


def offsets(table, star):
    """Return position offsets, motions, and parallaxes (n, 5)."""
    found = SkyCoord(table['ra'], table['dec'])
    east, north = SkyCoord(star['ra'], star['dec']).spherical_offsets_to(
        found)
    return np.column_stack([east.to_value(u.mas), north.to_value(u.mas),
                            table['pmra'].value, table['pmdec'].value,
                            table['parallax'].value])


def errors(table):
    return np.column_stack([table[f'{name}_error'].value for name in
                            (*NAMES, 'parallax')])


@pytest.mark.parametrize('parallax', [False, True])
def test_one_star_is_fitted_as_scipy_fits_all_its_pixels(parallax, rng):
    star = truth(27.3, 31.8, (40, -25), 20.0 if parallax else 0.0)
    years = (*YEARS, 2025.2, 2027.1)
    images = observe(star, 3000.0, years, rng)
    want, error = literal_fit(images, star, parallax=parallax)
    solution = PixelMotionFitter(parallax=parallax).fit(
        images, star['id', 'ra', 'dec'])
    size = 5 if parallax else 4
    got, stated = offsets(solution.stars, star), errors(solution.stars)
    assert_allclose(got[0, :size], want[:size], rtol=0,
                    atol=2e-3 * error[:size].min())
    # The noise of fluxes adds its part to errors, 1 / (S/N)^2.
    assert_allclose(stated[0, :size], error[:size], rtol=2e-3)
    light = want[size:].reshape(-1, 2)
    assert_allclose(solution.stars['flux'][0], light[:, 0], rtol=2e-4)
    assert_allclose(solution.stars['flux_err'][0], error[size::2], rtol=2e-3)
    assert_allclose(solution.fluxes['local_bkg'], light[:, 1], rtol=1e-4)


def test_neighbours_are_fitted_together_as_scipy_does(rng):
    stars = truth([27.3, 29.9], [31.8, 30.9], ([30, -20], [0, 25]))
    images = observe(stars, [3000.0, 1500.0], YEARS, rng)
    want, error = literal_fit(images, stars, n_stars=2)
    table = PixelMotionFitter().fit(images, stars['id', 'ra', 'dec']).stars
    want, error = (a[:8].reshape(2, 4) for a in (want, error))
    assert_allclose(offsets(table, stars)[:, :4], want, rtol=0,
                    atol=0.02 * error.min())
    assert_allclose(errors(table)[:, :4], error, rtol=0.02)


def test_light_of_stars_farther_off_is_subtracted(rng):
    stars = truth([22, 31.0], [30, 30.0])
    images = observe(stars, [20000.0, 1000.0], YEARS, rng, noise=1.0)
    both = PixelMotionFitter().fit(images, stars['id', 'ra', 'dec']).stars
    alone = PixelMotionFitter().fit(images, stars['id', 'ra', 'dec'][1:])
    pull = (offsets(both, stars) / errors(both))[:, :4]
    assert (np.abs(pull) < 4).all()
    assert abs(alone.stars['flux'][0] - 1000).max() > (
        5 * abs(both['flux'][1] - 1000).max())


def test_stars_at_rest_in_one_image_are_those_of_fit_many(rng):
    stars = truth([20, 40.2], [20.4, 38])
    images = observe(stars, 2000.0, [2026.0], rng, sky=0.0)
    with pytest.warns(AstropyUserWarning, match='at one time'):
        table = PixelMotionFitter(fit_sky=False).fit(
            images, stars['ra', 'dec']).stars
    from astropy.nddata import NDData, StdDevUncertainty
    image = images[0]
    want = fit_many([(NDData(image.data, uncertainty=StdDevUncertainty(
        np.full(image.data.shape, image.error))), image.psf, image.wcs)],
        SkyCoord(stars['ra'], stars['dec']))
    for name in ('ra', 'dec'):
        assert_allclose(table[name].value, want[name].value, rtol=0,
                        atol=1e-5 * SCALE / 3.6e6)
    assert_allclose(table['ra_error'].value, want['ra_error'].value, rtol=3e-3)
    assert np.isnan(table['pmra'].value).all()
    assert any('position_only' in sentence for sentence in
               decode_motion_flags(table['flags'][0]))


def test_faint_stars_have_errors_that_are_true(rng):
    # A signal to noise of 4 an epoch, where the likelihood is no Gaussian.
    x, y = (a.ravel() for a in np.meshgrid(np.arange(15, 210, 21.0),
                                           np.arange(15, 210, 21.0)))
    x, y = np.stack([x, y]) + rng.uniform(-0.5, 0.5, (2, x.size))
    motion = rng.normal(0, 8, (2, x.size))
    stars = truth(x, y, motion)
    flux = 4 * 3.0 / np.sqrt(np.sum(MIXTURE.render((21, 21), 10, 10)**2))
    frames = [make_wcs(0.01 * k, size=220) for k in range(6)]
    # The lattice is that of the plain WCS of 60 pixels.
    for wcs in frames:
        wcs.wcs.crpix = 30, 30
    years = (2024.0, 2024.5, 2026.0, 2027.0, 2028.0, 2028.5)
    images = observe(stars, flux, years, rng, size=220, frames=frames)
    table = PixelMotionFitter().fit(images, stars['id', 'ra', 'dec']).stars
    good = (table['flags'] == 0) & (table['significance'] > 5)
    assert good.mean() > 0.95
    pull = ((offsets(table, stars) - np.column_stack(
        [np.zeros((2, x.size)).T, *motion])[:, [0, 1, 2, 3, 3]])
        / errors(table))[good, :4]
    assert abs(pull.std() - 1) < 4 / np.sqrt(2 * pull.size)
    assert abs(np.mean(table['flux'][good]) / flux - 1) < 0.03


def test_forced_fluxes_are_light_curves_at_places_given(rng):
    stars = truth([20.2, 40], [20, 38.7], ([60, 0], [-40, 0]))
    curve = np.array([[500.0, 900.0, 100.0, 0.0], [300.0] * 4])
    images = observe(stars, curve, YEARS, rng)
    solution = PixelMotionFitter(forced=True).fit(images, stars)
    fluxes = solution.fluxes
    pull = (fluxes['flux'] - curve.ravel()) / fluxes['flux_err']
    assert np.abs(pull).max() < 4
    assert_allclose(solution.stars['ra'].value, stars['ra'].value, atol=1e-12)
    assert_allclose(solution.stars['pmra'].value, stars['pmra'].value,
                    atol=1e-6)
    assert np.isnan(solution.stars['pmra_error'].value).all()
    assert_allclose(fluxes['upper_limit'],
                    np.maximum(fluxes['flux'], 0) + 3 * fluxes['flux_err'])


def test_a_variable_star_keeps_its_fluxes_where_they_are_in_common(rng):
    star = truth(30.2, 29.6)
    curve = np.array([[2000.0, 500.0, 1500.0, 800.0]])
    images = observe(star, curve, YEARS, rng)
    solution = PixelMotionFitter(flux='common').fit(images, star['ra', 'dec'])
    pull = (solution.fluxes['flux'] - curve[0]) / solution.fluxes['flux_err']
    assert np.abs(pull).max() < 4
    assert np.ptp(solution.stars['flux'][0]) == 0


def test_errors_of_frames_are_those_of_frames_that_move(rng):
    x, y = (a.ravel() for a in np.meshgrid([15, 30, 45.0], [15, 30, 45.0]))
    stars = truth(x, y)
    images = observe(stars, 3000.0, YEARS, rng)
    epochs = []
    for image in images:
        place = image.wcs.world_to_pixel(SkyCoord(stars['ra'], stars['dec']))
        table = stars['id',].copy()
        for name, values in zip('xy', place, strict=True):
            table[f'{name}_fit'] = values * u.pix
            table[f'{name}_err'] = np.full(x.size, 0.2) * u.pix
        epochs.append(Epoch(table, image.wcs, image.year))
    frames = ProperMotionFitter(transform='shift', systematic=None,
                                references=[0, 1, 2]).fit(epochs)
    images = [replace(image, wcs=epoch.wcs) for image, epoch in zip(
        images, frames.epochs, strict=True)]
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        free, known = (PixelMotionFitter(references=references).fit(
            images, stars['id', 'ra', 'dec']).stars
            for references in (frames, None))
    added = errors(free)[:, :4]**2 - errors(known)[:, :4]**2
    expected = np.zeros(4)
    factor = frames._fit.frames.factor.reshape(len(images), 2, -1)
    shifts = factor.reshape(len(images), 2, 3, -1)[:, :, 0]
    for column in np.moveaxis(shifts, -1, 0):
        moved = []
        for image, shift in zip(images, column, strict=True):
            wcs = image.wcs.deepcopy()
            wcs.wcs.crval = wcs.wcs.crval + 0.1 * shift / 3.6e6 / np.array(
                [np.cos(np.radians(40)), 1])
            moved.append(replace(image, wcs=wcs))
        table = PixelMotionFitter().fit(moved, stars['id', 'ra', 'dec']).stars
        change = offsets(table, stars) - offsets(known, stars)
        expected += 100 * change[4, :4]**2
    # Positions of all frames together are free: nothing is added there.
    assert_allclose(added[4], expected, rtol=0.05, atol=2e-3)


# What goes wrong.

def fit_with_notes(images, stars, **options):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        solution = PixelMotionFitter(**options).fit(images, stars)
    return solution, ' '.join(str(one.message) for one in caught)


def test_an_image_whose_wcs_is_off_by_a_pixel_is_found_and_said(rng):
    x, y = (a.ravel() for a in np.meshgrid([12, 30, 48.0], [12, 30, 48.0]))
    stars = truth(x, y)
    images = observe(stars, 3000.0, (*YEARS, 2025.5), rng)
    wcs = images[2].wcs.deepcopy()
    wcs.wcs.crpix += [1.0, 0.0]
    images[2] = replace(images[2], wcs=wcs)
    solution, said = fit_with_notes(images, stars['ra', 'dec'])
    assert 'Image 2 lies' in said
    away = solution.images['shift'].value
    assert_allclose(away[2], [-1, 0], atol=0.1)


def test_stars_that_no_image_shows_are_not_numbers_and_flagged(rng):
    stars = truth([30.0, 900.0, 30.0], [30, 30, 10])
    stars['ra'][2] = np.nan * u.deg
    images = observe(stars[:1], 1000.0, YEARS, rng)
    table = PixelMotionFitter().fit(images, stars['ra', 'dec']).stars
    assert table['flags'][0] == 0
    for row in table[1:]:
        assert np.isnan(row['ra'].value)
        assert np.isnan(row['flux']).all()
        assert row['n_images'] == 0
        assert row['flags'] & 1
        assert row['flags'] & 4


def test_images_that_do_not_overlap_are_said(rng):
    stars = truth([20.0, 1020.0], [30, 30])
    frames = [make_wcs(), make_wcs(shift=(-1000, 0))]
    images = observe(stars, 1000.0, (2025.0, 2027.0), rng, frames=frames)
    solution, said = fit_with_notes(images, stars['ra', 'dec'])
    assert 'do not overlap' in said
    assert np.isnan(solution.stars['pmra'].value).all()
    assert np.isfinite(solution.stars['ra'].value).all()
    _, said = fit_with_notes(images, truth([5e4], [30])['ra', 'dec'])
    assert 'No image shows' in said


def test_images_without_errors_have_errors_from_their_scatter(rng):
    star = truth(30.2, 29.6, (20, 10))
    images = observe(star, 2000.0, YEARS, rng)
    bare = [replace(image, error=None) for image in images]
    want = PixelMotionFitter().fit(images, star['ra', 'dec']).stars
    solution, said = fit_with_notes(bare, star['ra', 'dec'])
    assert 'without errors' in said
    assert_allclose(errors(solution.stars)[:, :4], errors(want)[:, :4],
                    rtol=0.2)


def test_images_of_other_units_are_converted(rng):
    star = truth(30.2, 29.6)
    images = observe(star, 2000.0, YEARS, rng)
    want = PixelMotionFitter().fit(images, star['ra', 'dec']).stars
    units = [u.electron, 2 * u.electron, u.electron, 0.5 * u.electron]
    mixed = [replace(image, data=(image.data * u.electron).to(unit),
                     error=(image.error * u.electron).to(unit))
             for image, unit in zip(images, units, strict=True)]
    got = PixelMotionFitter().fit(mixed, star['ra', 'dec']).stars
    assert got['flux'].unit == u.electron
    assert_allclose(got['flux'].value, want['flux'].value, rtol=1e-6)
    wrong = [*mixed[:3], replace(images[3], data=images[3].data * u.Jy,
                                  error=images[3].error * u.Jy)]
    with pytest.raises(ValueError, match='in image 3'):
        PixelMotionFitter().fit(wrong, star['ra', 'dec'])


@pytest.mark.parametrize(('options', 'error', 'word'), [
    ({'flux': 'each'}, ValueError, 'flux must be'),
    ({'fit_shape': 0}, ValueError, 'fit_shape'),
    ({'forced': 1}, TypeError, 'forced'),
    ({'references': [1]}, TypeError, 'references'),
    ({'executor': 3}, TypeError, 'executor')])
def test_wrong_options_are_refused(options, error, word):
    with pytest.raises(error, match=word):
        PixelMotionFitter(**options)


def test_wrong_arguments_are_refused(rng):
    star = truth(30.0, 30.0)
    images = observe(star, 1000.0, YEARS[:2], rng)
    fit = PixelMotionFitter().fit
    with pytest.raises(TypeError, match='single one'):
        fit(images[0], star)
    with pytest.raises(ValueError, match='at least one'):
        fit([], star)
    with pytest.raises(TypeError, match='got int'):
        fit([1], star)
    with pytest.raises(TypeError, match='stars must be'):
        fit(images, [1])
    with pytest.raises(ValueError, match="column 'dec'"):
        fit(images, star['id', 'ra'])
    with pytest.raises(ValueError, match="flux='band'"):
        PixelMotionFitter(flux='band').fit(images, star)
    with pytest.raises(ValueError, match='time must be'):
        replace(images[0], time=np.nan)
    with pytest.raises(TypeError, match='band'):
        replace(images[0], band=3)


# The search.

def test_stars_too_faint_for_each_image_are_found_in_all(rng):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(20, 160, 27.0),
                                           np.arange(20, 160, 27.0)))
    stars = truth(x, y, rng.normal(0, 5, (2, x.size)))
    flux = 3.5 * 3.0 / np.sqrt(np.sum(MIXTURE.render((21, 21), 10, 10)**2))
    fluxes = np.where(np.arange(x.size) % 5 == 0, 40 * flux, flux)
    frames = [make_wcs(0.01 * k) for k in range(7)]
    years = np.linspace(2024, 2028, 7)
    images = observe(stars, fluxes, years, rng, size=180, frames=frames)
    found = PixelMotionFitter().find(images)
    nearest, away, _ = SkyCoord(found['ra'], found['dec']
                                ).match_to_catalog_sky(
        SkyCoord(stars['ra'], stars['dec']))
    right = away < 100 * u.mas
    assert (~right).sum() <= 1
    assert len(np.unique(nearest[right])) > 0.9 * x.size
    more = PixelMotionFitter().find(images, stars['ra', 'dec'])
    assert len(more) <= 1
