"""Laws of motions fitted to the pixels of all epochs together."""
import warnings
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable
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
    GaussianMixture,
    GriddedMixturePSF,
    MultiGaussianPSFModel,
    PixelMotionFitter,
    ProperMotionFitter,
    decode_motion_flags,
    fit_many,
    fit_mixture_field,
)
from photutils_mgauss.psf.errors import PSFErrors

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


@pytest.mark.long
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


@pytest.mark.long
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


def literal_chances(image, place, axis, flux):
    """Return exp(-chi2 / 2) at offsets (y, x) from a place, and fluxes."""
    x, y = place
    i, j = round(y), round(x)
    data = image.data[i - 5:i + 6, j - 5:j + 6]
    out = np.empty((axis.size, axis.size, flux.size))
    for a, dy in enumerate(axis):
        for b, dx in enumerate(axis):
            psf = MIXTURE.render((11, 11), x + dx - j + 5, y + dy - i + 5)
            left = data - flux[:, None, None] * psf
            left -= left.mean(axis=(1, 2), keepdims=True)
            out[a, b] = -0.5 * np.sum(left**2, axis=(1, 2)) / image.error**2
    return np.exp(out - out.max())


def literal_mean(images, place, reach):
    """Return mean and scatter of a place, of all fluxes from 0 on."""
    axis = np.arange(-reach, reach + 0.01, 0.1)
    flux = np.arange(-80.0, 260, 2.0)
    each = [literal_chances(image, place, axis, flux) for image in images]
    typical = np.mean([flux[np.unravel_index(one.argmax(), one.shape)[2]]
                       for one in each])
    chance = 0
    for part in (0, 0.1, 0.3, 1.0):
        width = max(part * typical, 0.5)
        # The mean flux down, that of an image across.
        scatter = np.exp(-0.5 * ((flux[:, None] - flux) / width)**2) / width
        both = np.prod([one @ scatter for one in each], axis=0)
        chance = chance + both[..., flux >= 0].sum(axis=2)
    dy, dx = np.meshgrid(axis, axis, indexing='ij')
    chance[np.hypot(dx, dy) >= reach] = 0
    chance /= chance.sum()
    mean = np.array([np.sum(chance * d) for d in (dx, dy)])
    return mean, np.sqrt([np.sum(chance * (d - m)**2)
                          for d, m in zip((dx, dy), mean, strict=True)])


def test_a_faint_star_is_the_mean_of_its_probability(rng):
    star = truth(30.2, 29.6)
    images = observe(star, 50.0, [2026.0, 2026.0], rng,
                     frames=[make_wcs(), make_wcs()])
    mean, error = literal_mean(images, (30.2, 29.6), 1.5)
    with pytest.warns(AstropyUserWarning, match='at one time'):
        table = PixelMotionFitter(reach=1.5 / 2.56329).fit(
            images, star['ra', 'dec']).stars
    got = np.array(make_wcs().world_to_pixel(SkyCoord(
        table['ra'], table['dec'])))[:, 0] - (30.2, 29.6)
    assert_allclose(got, mean, rtol=0, atol=0.1 * error.min())
    stated = np.array([table[f'{name}_error'][0].value
                       for name in ('ra', 'dec')]) / SCALE
    assert_allclose(stated, error, rtol=0.1)


@pytest.mark.parametrize('reach', [1e-3, 0.2, 50])
def test_faint_stars_have_numbers_however_far_they_may_be(rng, reach):
    x, y = (a.ravel() for a in np.meshgrid([15, 36.0], [15, 36.0]))
    images = observe(truth(x, y), [0.0, 15, 30, 60], YEARS, rng)
    table = PixelMotionFitter(reach=reach).fit(
        images, truth(x + 2, y - 1)['ra', 'dec']).stars
    assert np.isfinite(errors(table)[:, :4]).all()
    assert (errors(table)[:, :4] > 0).all()


def test_a_star_that_is_surely_beyond_reach_is_where_it_is(rng):
    star, beside = truth(30.2, 29.6), truth(33.0, 29.6)
    images = observe(star, 120.0, YEARS, rng)
    table = PixelMotionFitter().fit(images, beside['ra', 'dec']).stars
    pull = offsets(table, star) / errors(table)
    assert np.abs(pull[0, :4]).max() < 4


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


def literal_covariances(x, y, years, error):
    """Return covariances (n, 4, 4) of stars whose frames are free [mas]."""
    dt = np.asarray(years) - np.mean(years)
    n, n_images = len(x), len(dt)
    basis = np.stack([np.ones(n), x - np.mean(x), y - np.mean(y)]) / 15
    rows = np.zeros((n_images, n, 2, 4 * n + 6 * n_images))
    free = np.zeros((2, 2, 3, 6 * n_images))
    for k in range(n_images):
        for axis in range(2):
            at = 4 * n + 6 * k + 3 * axis
            for i in range(n):
                rows[k, i, axis, 4 * i + axis] = 1
                rows[k, i, axis, 4 * i + 2 + axis] = dt[k]
                rows[k, i, axis, at:at + 3] = basis[:, i]
            for power in range(2):
                free[axis, power, :, at - 4 * n:at - 4 * n + 3] = (
                    np.eye(3) * dt[k]**power)
    rows = rows.reshape(-1, rows.shape[-1]) / error
    free = free.reshape(12, -1)
    matrix = rows.T @ rows
    # Maps that all stars follow are zero.
    matrix[4 * n:, 4 * n:] += 1e4 * free.T @ free
    inverse = np.linalg.inv(matrix)
    return np.stack([inverse[4 * i:4 * i + 4, 4 * i:4 * i + 4]
                     for i in range(n)])


def test_frames_and_bright_stars_are_found_together(rng):
    x, y = (a.ravel() for a in np.meshgrid([12, 24, 36, 48.0],
                                           [12, 24, 36, 48.0]))
    stars = truth(x, y, rng.normal(0, 10, (2, x.size)))
    years = (*YEARS, 2025.5)
    images = observe(stars, 20000.0, years, rng)
    wrong = []
    for image in images:
        wcs = image.wcs.deepcopy()
        wcs.wcs.crpix += rng.normal(0, 0.05, 2)
        wcs.wcs.cd = wcs.wcs.cd @ (np.eye(2) + rng.normal(0, 1e-3, (2, 2)))
        wrong.append(replace(image, wcs=wcs))
    start = stars['id', 'ra', 'dec']
    known = PixelMotionFitter().fit(images, start).stars
    found = PixelMotionFitter(refine_frames=True).fit(wrong, start)
    design = np.stack([np.ones(x.size), x, y], axis=1)
    place = offsets(found.stars, stars)[:, :4]
    place[:, 2:] -= np.column_stack([stars['pmra'].value,
                                     stars['pmdec'].value])
    left = place - design @ np.linalg.lstsq(design, place, rcond=None)[0]
    stated = errors(found.stars)[:, :4]
    assert 0.75 < np.sqrt(np.mean((left / stated)**2)) < 1.25
    # Alone, and with frames of their own, as literal equations have it.
    error = errors(known)[:, 0].mean() * np.sqrt(len(years))
    want = literal_covariances(x, y, years, error)
    assert_allclose(stated, np.sqrt(np.einsum('nii->ni', want)), rtol=0.05)
    for image, wcs in zip(images, found.wcs, strict=True):
        away = wcs.pixel_to_world(x, y).separation(
            image.wcs.pixel_to_world(x, y))
        assert away.max() < 1.5 * u.pix * SCALE * u.mas / u.pix


def test_images_of_too_few_bright_stars_keep_their_wcs(rng):
    star = truth(30.0, 30.0)
    images = observe(star, 5000.0, YEARS, rng)
    with pytest.warns(AstropyUserWarning, match='0, 1, 2, 3 show fewer'):
        solution = PixelMotionFitter(refine_frames=True).fit(
            images, star['ra', 'dec'])
    plain = PixelMotionFitter().fit(images, star['ra', 'dec'])
    assert_allclose(solution.stars['pmra_error'], plain.stars['pmra_error'])
    with pytest.raises(ValueError, match='refine_frames must be False'):
        PixelMotionFitter(refine_frames=True, forced=True)


def unsure_psf(change):
    """Return the PSF, and one that is off by its one change."""
    grid = GriddedMixturePSF([MIXTURE], [(0, 0)]).grid
    known = PSFErrors(grid, change[None, None])
    psf = GriddedMixturePSF._of_grid(grid, errors=known)
    off = GaussianMixture(
        MIXTURE.weights + change[:, 0], MIXTURE.means + change[:, 1:3],
        MIXTURE.covariances + change[:, [3, 4, 4, 5]].reshape(-1, 2, 2))
    return psf, MultiGaussianPSFModel(off)


@pytest.mark.parametrize('same', [False, True])
def test_errors_of_psfs_are_those_of_psfs_that_change(rng, same):
    change = 1e-3 * np.array([[2, 8, -5, 3, 1, -2],
                              [-2, 20, 10, -20, 5, 10.0]])
    star = truth(30.2, 29.6)
    images = observe(star, 5000.0, YEARS, rng)
    one, off = unsure_psf(change)
    unsure = [replace(image, psf=one if same else unsure_psf(change)[0])
              for image in images]
    start = star['id', 'ra', 'dec']
    known, free = (PixelMotionFitter().fit(some, start).stars
                   for some in (images, unsure))
    expected, flux = np.zeros(4), np.zeros(len(images))
    for changed in ([range(len(images))] if same else
                    [[k] for k in range(len(images))]):
        wrong = [replace(image, psf=off) if k in changed else image
                 for k, image in enumerate(images)]
        table = PixelMotionFitter().fit(wrong, start).stars
        expected += (offsets(table, star) - offsets(known, star))[0, :4]**2
        flux[changed] = (table['flux'] - known['flux'])[0, changed]
    added = (errors(free)**2 - errors(known)**2)[0, :4]
    assert_allclose(added, expected, rtol=0.1, atol=0.02 * expected.max())
    more = free['flux_err'][0]**2 - known['flux_err'][0]**2
    assert_allclose(more, flux**2, rtol=0.1)


def test_cutouts_are_the_pixels_around_a_star(rng):
    stars = truth([30.2, 12.0], [29.6, 57.8])
    images = observe(stars, [3000.0, 400.0], YEARS, rng)
    solution = PixelMotionFitter().fit(images, stars['id', 'ra', 'dec'])
    table = solution.cutouts(0, size=(7, 9))
    x, y = np.rint([table['x'].value, table['y'].value]).astype(int)
    sky = solution.fluxes['local_bkg'][:len(images)]
    for k, image in enumerate(images):
        box = slice(y[k] - 3, y[k] + 4), slice(x[k] - 4, x[k] + 5)
        assert_allclose(table['data'][k], image.data[box] - sky[k])
        assert_allclose(table['model'][k], solution.model(k)[box],
                        atol=0.02)
    assert_allclose(table['residual'], table['data'] - table['model'])
    assert abs(table['residual'].std() - 3) < 0.4
    faint = solution.cutouts()
    assert faint.meta['ID'] == 1
    assert np.isnan(faint['data']).any()
    with pytest.raises(ValueError, match='star must be'):
        solution.cutouts(7)


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


def test_the_image_that_is_most_off_is_told_first(rng):
    x, y = (a.ravel() for a in np.meshgrid([12, 30, 48.0], [12, 30, 48.0]))
    stars = truth(x, y)
    images = observe(stars, 3000.0, np.arange(2020, 2026), rng)
    wcs = images[1].wcs.deepcopy()
    wcs.wcs.crpix += [1.0, 1.0]
    images[1] = replace(images[1], wcs=wcs)
    solution, _ = fit_with_notes(images, stars['ra', 'dec'])
    assert solution.notes[0].startswith('Image 1 lies')
    assert all('(perhaps only because of image 1)' in note
               for note in solution.notes[1:])


@pytest.mark.parametrize('error', [0.0, -1.0, np.nan, np.inf])
def test_pixels_without_a_usable_error_are_left_out(rng, error):
    star = truth(30.2, 29.6, (20, 10))
    images = observe(star, 2000.0, YEARS, rng)
    bad = np.zeros((60, 60), bool)
    bad[28, ::2] = bad[33] = True
    masked, marked = ([replace(image, **(
        {'mask': bad} if mask else {'error': np.where(bad, error, 3.0)}))
        for image in images] for mask in (True, False))
    want, table = (PixelMotionFitter().fit(some, star['ra', 'dec']).stars
                   for some in (masked, marked))
    for name in ('pmra', 'pmra_error', 'flux', 'reduced_chi2'):
        assert_allclose(table[name].value, want[name].value, rtol=1e-12)
    want, table = (fit_many(
        [(NDData(image.data, mask=image.mask,
                 uncertainty=StdDevUncertainty(np.broadcast_to(
                     image.error, image.data.shape))), image.psf, image.wcs)
         for image in some], SkyCoord(star['ra'], star['dec']), fit_shape=9)
        for some in (masked, marked))
    assert_allclose(table['flux_fit'].value, want['flux_fit'].value,
                    rtol=1e-12)


def test_many_stars_hit_by_cosmic_rays_are_said(rng):
    x, y = (a.ravel() for a in np.meshgrid([12, 30, 48.0], [12, 30, 48.0]))
    stars = truth(x, y)
    images = observe(stars, 500.0, YEARS, rng)
    assert fit_with_notes(images, stars['ra', 'dec'])[1] == ''
    for image in images:
        row, column = rng.integers(0, 60, (2, 40))
        image.data[row, column] += rng.uniform(200, 5000, 40)
    said = fit_with_notes(images, stars['ra', 'dec'])[1]
    assert 'Mask cosmic rays' in said
    assert 'of 9 stars' in said


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


def test_too_few_times_for_a_parallax_are_said(rng):
    stars = truth([30.0], [30])
    images = observe(stars, 1000.0, (2025.0, 2027.0), rng)
    solution, said = fit_with_notes(images, stars['ra', 'dec'], parallax=True)
    assert said == ('Motions with a parallax take images at 3 times or more, '
                    'got 2: positions and fluxes are fitted, motions are not.')
    assert np.isnan(solution.stars['pmra'].value).all()
    _, said = fit_with_notes(images, stars['ra', 'dec'])
    assert said == ''


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


@pytest.mark.parametrize('level', [0, 5])
def test_images_without_stars_noise_and_errors_have_no_solution(rng, level):
    star = truth(30.2, 29.6, (20, 10))
    images = [replace(image, data=np.full(image.data.shape, float(level)),
                      error=None)
              for image in observe(star, 2000.0, YEARS, rng)]
    # NumPy's warnings are errors here.
    solution, _ = fit_with_notes(images, star['ra', 'dec'])
    assert decode_motion_flags(solution.stars['flags'][0])[0].startswith(
        'no_solution')
    assert np.isnan(solution.stars['pmra_error'].value).all()
    assert np.isnan(solution.fluxes['flux_err'].value).all()


def test_each_image_may_have_another_kind_of_psf(rng):
    star = truth(30.2, 29.6, (20, 10))
    images = observe(star, 2000.0, YEARS, rng)
    grid = GriddedMixturePSF([MIXTURE] * 4, [(0, 0), (59, 0), (0, 59),
                                             (59, 59)])
    noise = rng.normal(0, 0.01, (60, 60))
    x, y = (a.ravel() for a in np.meshgrid([10, 30, 50.0], [10, 30, 50.0]))
    light = sum(MIXTURE.render((60, 60), *place, flux=1000)
                for place in zip(x, y, strict=True))
    field = fit_mixture_field(
        light + noise, QTable({'x': x, 'y': y, 'flux': np.full(9, 1000.0)}),
        error=np.full((60, 60), 0.01), n_components=2, degree=0)
    kinds = [images[0].psf, grid, field, GriddedMixturePSF([MIXTURE],
                                                           [(0, 0)])]
    mixed = [replace(image, psf=psf) for image, psf in zip(images, kinds,
                                                           strict=True)]
    want, got = (PixelMotionFitter().fit(some, star['ra', 'dec']).stars
                 for some in (images, mixed))
    away = offsets(got, star) - offsets(want, star)
    assert (np.abs(away[0, 2:4]) < 0.05 * errors(want)[0, 2:4]).all()
    # The centre of a field is its centroid, 0.03 pixels off the mixture's.
    assert (np.abs(away[0, :2]) < 0.03 * SCALE / 4).all()
    assert_allclose(got['flux'], want['flux'], rtol=5e-3)


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
    ({'reach': 0}, ValueError, 'reach'),
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


def test_near_stars_are_found_if_parallaxes_are_searched(rng):
    # Far apart in time by half a year the parallax is as large as it gets.
    years = 2024.2 + 0.5 * np.arange(6)
    stars = truth([22.0, 48.0], [24.0, 50.0], parallax=200.0)
    flux = 4.0 * 3.0 / np.sqrt(np.sum(MIXTURE.render((21, 21), 10, 10)**2))
    images = observe(stars, flux, years, rng, size=72)
    place = SkyCoord(stars['ra'], stars['dec'])

    def near(table):
        return 0 if not len(table) else int((place.match_to_catalog_sky(
            SkyCoord(table['ra'], table['dec']))[1] < 60 * u.mas).sum())

    fitter = PixelMotionFitter(parallax=True)
    found = fitter.find(images, max_parallax=300 * u.mas)
    assert near(found) == 2
    away = found['parallax'] - 200 * u.mas
    assert (np.abs(away / found['parallax_error']) < 4).sum() >= 2
    assert near(fitter.find(images)) < 2
    with pytest.raises(ValueError, match='parallax=True only'):
        PixelMotionFitter().find(images, max_parallax=300 * u.mas)
    with pytest.raises(TypeError, match='max_parallax must be'):
        fitter.find(images, max_parallax=3 * u.s)
