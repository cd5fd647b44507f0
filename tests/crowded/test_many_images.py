"""Many images of one crowded field: one list, places in common."""
import re
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    ImageEpoch,
    decode_psf_flags,
)
from photutils_mgauss.crowded.alignment import tell_of_misplaced
from photutils_mgauss.crowded.many_tile import ManyJob, ManyTile, TileMap
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.tile import TileJob, TileOptions
from photutils_mgauss.photometry.many_images import read_field
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.sky.pixel_grid import PixelGrid

SHARP = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
                        [[[0.6, 0.05], [0.05, 0.5]], [[3, 0], [0, 3]]])
BROAD = GaussianMixture([0.7, 0.3], [[0, 0], [0, 0]],
                        [[[1.0, 0.1], [0.1, 0.8]], [[4, 0], [0, 4]]])
OPTIONS = TileOptions(threshold=4.5, keep=2.0, background_size=None,
                      psf_error=0.0, gain=None, floor=1.0, noise=1.0,
                      max_rounds=3)
SKY, READ_NOISE = 20.0, 5.0


def a_wcs(turn=0.0, x=0.0, y=0.0, scale=1.0):
    """Return a WCS, turned, shifted [pix] and with larger pixels."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (210.0, 54.0)
    wcs.wcs.crpix = 50 + x, 50 + y
    c, s = np.cos(turn), np.sin(turn)
    wcs.wcs.cd = 2e-5 * scale * np.array([[-c, s], [s, c]])
    return wcs


# Two sharp exposures of which one is turned, and two of another filter in a
# broader PSF, one of them with larger pixels.
WCS_OF = (a_wcs(), a_wcs(0.3, 1.3, -2.2), a_wcs(0, -3.4, 0.6),
          a_wcs(-0.2, 0.4, 0.7, 1.2))
MIXTURES = (SHARP, SHARP, BROAD, BROAD)
PSFS = [GriddedMixturePSF([one], [(0, 0)]) for one in MIXTURES]


NARROW = [1.0] * 4


def draw(mixture, x, y, flux, shape):
    image = np.zeros(shape)
    for a, b, f in zip(x, y, flux, strict=True):
        image += mixture.render(shape, a, b, flux=f)
    return image


def expose(sky, fluxes, seed, shape=(100, 100)):
    """Return images (data, psf, wcs) of stars of fluxes (E, n)."""
    rng = np.random.default_rng(seed)
    images = []
    for wcs, mixture, psf, flux in zip(WCS_OF, MIXTURES, PSFS, fluxes,
                                       strict=False):
        image = SKY + draw(mixture, *wcs.world_to_pixel(sky), flux, shape)
        data = rng.poisson(image) + rng.normal(0, READ_NOISE, shape)
        error = np.sqrt(np.clip(data, 0, None) + READ_NOISE**2)
        images.append((NDData(data, StdDevUncertainty(error)), psf, wcs))
    return images


@pytest.fixture(scope='module')
def field():
    """Return images of one star for every 30 pixels, places and fluxes."""
    rng = np.random.default_rng(8)
    n = 330
    sky = WCS_OF[0].pixel_to_world(*rng.uniform(-0.5, 99.5, (2, n)))
    flux = 10**rng.uniform(2.3, 4.7, n)
    colour = 10**rng.normal(-0.2, 0.15, n)
    fluxes = np.array([flux, flux, flux * colour, flux * colour])
    return expose(sky, fluxes, 9), sky, fluxes


def shifted(images, k, step):
    """Return the images, the WCS of one shifted by pixels."""
    data, psf, wcs = images[k]
    wcs = wcs.deepcopy()
    wcs.wcs.crpix += step
    return [*images[:k], (data, psf, wcs), *images[k + 1:]]


@pytest.mark.parametrize(('wrong', 'step'), [
    (0, [0.4, 0.3]), (2, [0.4, 0.3]), (1, [-4.0, 3.0])])
def test_an_image_whose_wcs_is_off_is_told(field, wrong, step):
    images = shifted(field[0], wrong, step)
    there = read_field(images)
    length = np.hypot(*step)
    with pytest.warns(UserWarning,
                      match=f'stars of image {wrong} lie') as told:
        tell_of_misplaced(there, there.psfs, NARROW, motions=False)
    found = float(re.search(r'lie (\d\.\d\d) pixels',
                            str(told[0].message))[1])
    assert abs(found - length) < 0.1


def test_two_images_beside_each_other_are_told(field):
    images = shifted(field[0], 1, [0.3, 0.0])[:2]
    with pytest.warns(UserWarning, match='images 0 and 1 lie 0.3'):
        CrowdedMixturePhotometry(None, maxiters=1).fit_images(images)


def test_stars_that_move_together_are_not_images_that_are_off(field):
    images = [ImageEpoch(data, psf, wcs, 2020.0 + k) for k, (
        data, psf, wcs) in enumerate(field[0])]
    for k, image in enumerate(images):
        # The images have other axes and scales: on the sky, not in pixels.
        wcs = image.wcs.deepcopy()
        wcs.wcs.crval += [0.0, 6e-6 * k]
        images[k] = ImageEpoch(image.data, image.psf, wcs, image.time)
    there = read_field(images)
    tell_of_misplaced(there, there.psfs, NARROW, motions=True)
    with pytest.warns(UserWarning, match='motions=True if the stars move'):
        tell_of_misplaced(there, there.psfs, NARROW, motions=False)


def test_right_images_and_images_of_nothing_are_not_told(field):
    there = read_field(field[0])
    tell_of_misplaced(there, there.psfs, NARROW, motions=False)
    noise = np.random.default_rng(1).normal(size=(100, 100))
    there = read_field([(NDData(noise, StdDevUncertainty(np.ones((100, 100)))),
                         PSFS[0], one) for one in WCS_OF])
    tell_of_misplaced(there, there.psfs, NARROW, motions=False)


@pytest.fixture(scope='module')
def fitted(field):
    return CrowdedMixturePhotometry(None).fit_images(field[0])


def pair_up(table, sky, radius=0.6):
    """Return rows of true stars and of the table that are one (n,)."""
    places = [np.column_stack(WCS_OF[0].world_to_pixel(one)) for one in (
        SkyCoord(table['ra'], table['dec']), sky)]
    away, row = cKDTree(places[0]).query(places[1])
    inside = ((places[1] > 4) & (places[1] < 95)).all(axis=1)
    true = np.flatnonzero((away < radius) & inside)
    return true, row[true]


def small_tile(x, y, fluxes, frames=WCS_OF[:2], shape=(31, 31), *,
               scales=None, bands=None, factors=None):
    """Return a tile without noise or sky, and maps to its images."""
    shift = [WCS.deepcopy(one) for one in frames]
    for one in shift:
        one.wcs.crpix -= 35
    grid = PixelGrid.of(shift, [shape] * len(shift))
    parts, maps = [], []
    for k, flux in enumerate(fluxes):
        to_image = grid.to_image[k]
        data = draw(MIXTURES[k], *to_image(x, y), flux, shape)
        parts.append(TileJob(data, np.ones(shape), LocalPSF.of(PSFS[k]),
                             OPTIONS, (0, 0), None))
        maps.append(TileMap(to_image, grid.to_grid[k], (0, 0), (0, 0)))
    n = len(fluxes)
    scales = np.ones(n) if scales is None else np.array(scales)
    bands = np.arange(n) if bands is None else np.array(bands)
    factors = np.tile(np.eye(2), (n, 1, 1)) if factors is None else factors
    return ManyTile(ManyJob(parts, maps, np.arange(n), scales, factors, bands,
                            OPTIONS, grid.shape, (0, 0), None, n))


X, Y = np.array([14.2, 16.1, 20.5]), np.array([18.1, 16.6, 17.0])
FLUXES = np.array([[900.0, 300.0, 500.0], [700.0, 20.0, 600.0]])


def design(tile, k, x, y, flux):
    """Return numerical derivatives (pixels, 3 n) of the image of a tile."""
    to_image = tile.job.maps[k]
    shape = tile.models[k].data.shape
    columns = []
    for i in range(x.size):
        one = np.eye(x.size)[i]
        columns.append(draw(MIXTURES[k], *to_image(x, y), one, shape))
        for dx, dy in ((1e-4, 0), (0, 1e-4)):
            after, before = (draw(
                MIXTURES[k], *to_image(x + s * dx * one, y + s * dy * one),
                flux * one, shape) for s in (1, -1))
            columns.append((after - before) / 2e-4)
    return np.array([one.ravel() for one in columns]).T


def dense(tile, x, y, fluxes):
    """Return the normal matrix of fluxes (E, n), then places (n, p)."""
    n, n_images, p = x.size, len(fluxes), tile.job.factors.shape[2]
    size = n * (n_images + p)
    matrix = np.zeros((size, size))
    place = n * n_images + np.arange(p * n).reshape(n, p)
    for k, flux in enumerate(fluxes):
        a = design(tile, k, x, y, flux).reshape(-1, n, 3)
        a = np.concatenate([a[:, :, :1], a[:, :, 1:] @ tile.job.factors[k]],
                           axis=2).reshape(len(a), -1)
        at = np.column_stack([k * n + np.arange(n), place]).ravel()
        matrix[np.ix_(at, at)] += a.T @ a
    return matrix


def test_covariances_are_those_of_the_dense_problem():
    tile = small_tile(X, Y, FLUXES)
    tile.start(Stars(X, Y, FLUXES[0]), FLUXES)
    place, variance, correlation = tile.equations.covariances()
    exact = np.linalg.inv(dense(tile, X, Y, FLUXES))
    # Stamps are 7 and 9 pixels wide, beyond which there is little to know.
    assert_allclose(variance.ravel(), np.diag(exact)[:6], rtol=0.02)
    for i in range(3):
        at = 6 + 2 * i + np.arange(2)
        assert_allclose(place[i], exact[np.ix_(at, at)], rtol=0.05,
                        atol=0.02 * np.trace(exact[np.ix_(at, at)]))
    expected = exact[0, 1] / np.sqrt(exact[0, 0] * exact[1, 1])
    assert_allclose(correlation[0, 0], expected, atol=0.02)


def test_one_step_is_that_of_the_dense_problem():
    tile = small_tile(X, Y, FLUXES)
    start = FLUXES + np.array([[5.0, -3.0, 2.0], [-4.0, 6.0, 1.0]])
    x = X + np.array([0.004, -0.002, 0.001])
    y = Y + np.array([-0.003, 0.002, 0.002])
    tile.start(Stars(x, y, start[0]), start)
    light, place, _ = tile.equations.solve(0.0)
    assert_allclose(light, FLUXES - start, atol=0.3)
    for step, true in ((place[:, 0], X - x), (place[:, 1], Y - y)):
        assert_allclose(step, true, atol=2e-4)


def test_gauss_newton_finds_a_noiseless_blend_again():
    tile = small_tile(X, Y, FLUXES)
    start = FLUXES * [[1.2, 0.7, 1.1], [0.8, 2.0, 0.9]]
    tile.start(Stars(X + 0.1, Y - 0.15, start[0]), start)
    tile.polish(0.0, 12)
    assert_allclose(tile.stars.x, X, atol=1e-4)
    assert_allclose(tile.stars.y, Y, atol=1e-4)
    assert_allclose(tile.fluxes, FLUXES, rtol=1e-3)


# Two images of a band, the second of 0.7 of the light, a year before and after
# the mean time. The last star varies.
SCALES = np.array([1.0, 0.7])
ALIKE = np.array([90.0, 60.0, 80.0]) * SCALES[:, None]
TIED = np.array([True, True, False])
NEAR_X, NEAR_Y = np.array([14.2, 15.3, 16.5]), np.array([18.1, 17.6, 16.7])
MOVING = np.array([np.column_stack([np.eye(2), dt * np.eye(2)])
                   for dt in (-1, 1)])


def tied_tile(fluxes):
    tile = small_tile(NEAR_X, NEAR_Y, fluxes, scales=SCALES, bands=[0, 0],
                      factors=MOVING)
    begin(tile, NEAR_X, NEAR_Y, ALIKE)
    return tile


def begin(tile, x, y, fluxes):
    """Start a tile with some stars tied."""
    tile.start(Stars(x, y, fluxes[0]), fluxes)
    tile.stars.constant = tile.stars.tied = TIED.copy()
    tile.refresh()


def joined():
    """Return how fluxes (2, 3), then places, are made of what is free."""
    out = np.zeros((18, 16))
    for i in range(3):
        out[i, i] = 1
        out[3 + i, i if TIED[i] else 3] = SCALES[1] if TIED[i] else 1
    out[6:, 4:] = np.eye(12)
    return out


def test_fluxes_of_a_band_are_one_unknown():
    tile = tied_tile(ALIKE)
    start = ALIKE + np.array([[5, -3, 2], [3.5, -2.1, -4]])
    begin(tile, NEAR_X + 0.004, NEAR_Y - 0.003, start)
    light, place, _ = tile.equations.solve(0.0)
    assert_allclose(light, ALIKE - start, atol=0.15)
    assert_allclose(light[1, :2], 0.7 * light[0, :2], rtol=1e-12)
    assert_allclose(place, np.tile([-0.004, 0.003, 0, 0], (3, 1)), atol=2e-3)


def test_places_are_better_known_where_fluxes_are_one():
    tile = tied_tile(ALIKE)
    place, _, _ = tile.equations.covariances()
    whole = dense(tile, NEAR_X, NEAR_Y, ALIKE)
    exact = np.linalg.inv(joined().T @ whole @ joined())
    for i in range(3):
        at = 4 + 4 * i + np.arange(4)
        assert_allclose(place[i], exact[np.ix_(at, at)], rtol=0.05,
                        atol=0.02 * np.trace(exact[np.ix_(at, at)]))
    free = np.linalg.inv(whole)[6:10, 6:10]
    assert np.trace(place[0]) < 0.9 * np.trace(free)


def test_each_flux_is_measured_where_one_was_fitted():
    fluxes = ALIKE * np.array([[1.3, 0.9, 1.0], [0.8, 1.1, 1.5]])
    tile = tied_tile(fluxes)
    tile.measure()
    assert_allclose(tile.measured, fluxes, rtol=5e-3)


def test_only_stars_that_vary_or_are_bright_get_their_own_fluxes():
    fluxes = ALIKE * np.array([[1.0, 1.0, 1.0], [1.0, 1.0, 2.0]])
    tile = small_tile(X, Y, fluxes, scales=SCALES, bands=[0, 0])
    tile.start(Stars(X, Y, ALIKE[0]), ALIKE)
    assert tile.stars.tied.all()
    tile.polish(0.0, 12)
    assert tile.stars.constant.tolist() == [True, True, False]
    tile.polish(0.0, 12)
    assert tile.stars.tied.tolist() == [True, True, False]
    assert_allclose(tile.fluxes, fluxes, rtol=0.01)
    bright = small_tile(X, Y, 10 * fluxes, scales=SCALES, bands=[0, 0])
    bright.start(Stars(X, Y, 10 * ALIKE[0]), 10 * ALIKE)
    bright.refresh()
    assert not bright.stars.tied.any()
    other = small_tile(X, Y, fluxes, scales=SCALES, bands=[0, 1])
    other.start(Stars(X, Y, ALIKE[0]), ALIKE)
    assert not other.stars.tied.any()


def test_a_grid_knows_the_pixels_of_all_images(rng):
    grid = PixelGrid.of(WCS_OF, [(100, 100)] * 4)
    places = rng.uniform(5, 95, (2, 50))
    for wcs, there, back in zip(WCS_OF, grid.to_image, grid.to_grid,
                                strict=True):
        sky = wcs.pixel_to_world(*places)
        at = grid.positions(np.asarray(sky.cartesian.xyz.value))
        assert_allclose(there(*at), places, atol=1e-6)
        assert_allclose(back(*places), at, atol=1e-6)
        slope = (there(at[0] + 0.5, at[1]) - there(at[0] - 0.5, at[1])).T
        assert_allclose(there.slopes(*at)[:, :, 0], slope, atol=1e-6)


def test_stars_are_found_and_fitted(field, fitted):
    _, sky, fluxes = field
    true, _ = pair_up(fitted, sky)
    inside = np.all([(one > 4) & (one < 95) for one in
                     WCS_OF[0].world_to_pixel(sky)], axis=0)
    bright = inside & (fluxes[0] > 1000)
    assert np.isin(np.flatnonzero(bright), true).mean() > 0.95
    assert len(fitted) < 1.1 * len(sky)
    assert fitted['flux'].shape == fitted['x_fit'].shape == (len(fitted), 4)


def test_errors_of_fluxes_and_places_are_honest(field, fitted):
    _, sky, fluxes = field
    true, row = pair_up(fitted, sky)
    pulls = ((fitted['flux'][row] - fluxes[:, true].T)
             / fitted['flux_err'][row]).T
    assert (np.abs(np.nanmedian(pulls, axis=1)) < 0.4).all()
    assert abs(np.nanmedian(pulls)) < 0.15
    assert 0.8 < 1.48 * np.nanmedian(np.abs(pulls)) < 1.35
    away = sky[true].spherical_offsets_to(SkyCoord(fitted['ra'],
                                                   fitted['dec'])[row])
    for one, name in zip(away, ('ra_error', 'dec_error'), strict=True):
        pull = (one / fitted[name][row]).to_value(u.one)
        assert 0.8 < 1.48 * np.median(np.abs(pull)) < 1.35


def test_a_star_too_faint_for_each_image_is_found_in_all():
    sky = WCS_OF[0].pixel_to_world([30.0, 60.3, 44.1], [40.2, 61.0, 70.5])
    images = expose(sky, np.full((4, 3), 85.0), 3)
    alone = [len(CrowdedMixturePhotometry(psf)(data))
             for data, psf, _ in images]
    table = CrowdedMixturePhotometry(None).fit_images(images)
    true, row = pair_up(table, sky)
    assert len(true) == 3 > max(alone)
    signal = np.asarray(table['flux'] / table['flux_err'])[row]
    assert np.nanmean(signal) < 4.5 < table['significance'][row].min()


def test_one_image_gives_what_it_gives_alone(field):
    image, _, wcs = field[0][0]
    alone = CrowdedMixturePhotometry(PSFS[0])(image)
    table = CrowdedMixturePhotometry(PSFS[0]).fit_images(
        [(image, None, wcs)])
    tree = cKDTree(np.column_stack([alone['x_fit'], alone['y_fit']]))
    away, row = tree.query(np.column_stack([table['x_fit'][:, 0].value,
                                            table['y_fit'][:, 0].value]))
    bright = alone['flux_fit'][row] / alone['flux_err'][row] > 20
    assert np.median(away[bright]) < 0.01
    assert_allclose(np.median(table['flux'][:, 0][bright]
                              / alone['flux_fit'][row][bright]), 1,
                    atol=0.01)


@pytest.mark.long
def test_tiles_and_processes_do_not_change_a_star(field, fitted, tmp_path):
    images = [(data, psf, wcs) for data, psf, wcs in field[0]]
    with ProcessPoolExecutor(1, get_context('spawn')) as pool:
        tiled = CrowdedMixturePhotometry(
            None, tile_shape=64, executor=pool, checkpoint=tmp_path,
            overlap=64).fit_images(images)
    assert len(list(tmp_path.iterdir())) > 1
    one, other = (SkyCoord(table['ra'], table['dec']) for table in (fitted,
                                                                    tiled))
    _, away, _ = one.match_to_catalog_sky(other)
    # A pixel is 72 mas.
    strong = fitted['significance'] > 8
    assert np.mean(away[strong] < 0.1 * u.mas) > 0.9
    kept = CrowdedMixturePhotometry(
        None, tile_shape=64, checkpoint=tmp_path,
        overlap=64).fit_images(images)
    assert_array_equal(kept['flux'], tiled['flux'])


def test_a_list_keeps_its_order_and_gets_fluxes_everywhere(field, fitted):
    _, sky, fluxes = field
    # One star, nothing, no place at all, a place off all images.
    star = int(np.argmax(fluxes[0]))
    ra = [sky.ra.deg[star], 210.0005, np.nan, 211.0]
    dec = [sky.dec.deg[star], 54.0003, 54, 54]
    for find in (True, False):
        table = CrowdedMixturePhotometry(
            None, find_neighbors=find).fit_images(
                field[0], Table({'ra': ra, 'dec': dec}))
        assert len(table) == 4
        # Alone, it takes the light of its neighbours.
        assert_allclose(table['flux'][0, 0], fluxes[0, star],
                        rtol=0.05 if find else 0.3)
        assert np.isfinite(table['flux'][1]).sum() >= 2
        assert np.isnan(table['flux'][2:]).all()
    words = decode_psf_flags(table['flags'])
    assert 'no_overlap' in words[3]


def test_forced_fluxes_of_nothing_are_noise_about_nothing(rng):
    sky = WCS_OF[0].pixel_to_world(*np.meshgrid(np.arange(10, 91, 8.0),
                                                np.arange(10, 91, 8.0)))
    images = expose(sky.ravel()[:0], np.zeros((2, 0)), 4)
    table = CrowdedMixturePhotometry(None).fit_images(images, sky.ravel())
    pull = np.asarray(table['flux'][:, 0] / table['flux_err'][:, 0])
    assert (pull < 0).sum() > 20
    assert abs(np.nanmean(pull)) < 0.4


def test_epochs_are_images_too(field):
    images = [ImageEpoch(data, psf, wcs, 2026.0 + k)
              for k, (data, psf, wcs) in enumerate(field[0][:2])]
    part = CrowdedMixturePhotometry(None).fit_images(images)
    same = CrowdedMixturePhotometry(None).fit_images(field[0][:2])
    assert_array_equal(part['ra'], same['ra'])


def test_units_come_back(field):
    images = [(NDData(data.data * u.electron, StdDevUncertainty(
        data.uncertainty.array * u.electron)), psf, wcs)
        for data, psf, wcs in field[0][:2]]
    table = CrowdedMixturePhotometry(None).fit_images(images)
    assert table['flux'].unit == table['flux_err'].unit == u.electron


def test_what_cannot_be_images_is_told(field):
    phot = CrowdedMixturePhotometry(None)
    data, psf, wcs = field[0][0]
    for images, error, word in (
            ([], ValueError, 'at least one'),
            ([data], TypeError, 'psf, wcs'),
            ([(data, psf, None)], TypeError, 'wcs'),
            ([(data, 3, wcs)], TypeError, 'PSF'),
            ([(data.data * u.Jy, psf, wcs), (data.data, psf, wcs)],
             ValueError, 'one unit'),
            ([(data, psf, wcs), (data, psf, a_wcs(0, 2000))],
             ValueError, 'lie on each other')):
        with pytest.raises(error, match=word):
            phot.fit_images(images)
    with pytest.raises(ValueError, match='dec'):
        phot.fit_images([(data, psf, wcs)], Table({'x': [1.0]}))


def test_motions_of_crowded_stars_are_fitted_with_their_errors():
    rng = np.random.default_rng(12)
    places, motion = rng.uniform(3, 60, (2, 80)), rng.normal(0, 0.06, (2, 80))
    flux = 10**rng.uniform(3, 4.3, 80)
    images = []
    for k, year in enumerate((-2.0, 0.0, 2.0)):
        x, y = WCS_OF[k].world_to_pixel(WCS_OF[0].pixel_to_world(
            *(places + motion * year)))
        image = SKY + draw(MIXTURES[k], x, y, flux, (64, 64))
        data, error = rng.normal(image, np.sqrt(image)), np.sqrt(image)
        images.append(ImageEpoch(data, PSFS[k], WCS_OF[k], 2028.0 + year,
                                 error=error))
    table = CrowdedMixturePhotometry(None).fit_images(images, motions=True)
    x, y = WCS_OF[0].world_to_pixel(SkyCoord(table['ra'], table['dec']))
    away, row = cKDTree(np.column_stack([x, y])).query(places.T)
    good = (away < 0.4) & (flux > 2000)
    assert good.sum() > 30
    # A pixel is 72 mas, and columns run against right ascension.
    for name, true in (('pmra', -72 * motion[0]), ('pmdec', 72 * motion[1])):
        pull = (table[name][row].value - true) / table[
            f'{name}_error'][row].value
        assert 0.7 < 1.48 * np.nanmedian(np.abs(pull[good])) < 1.4
    assert_allclose(table['ref_epoch'].value, 2028)


def test_a_variable_star_among_faint_ones_keeps_its_fluxes():
    rng = np.random.default_rng(21)
    places, motion = rng.uniform(3, 60, (2, 60)), rng.normal(0, 0.06, (2, 60))
    places[:, 0] = 30.0, 31.0
    flux = np.tile(10**rng.uniform(2.4, 3.2, 60), (5, 1))
    flux[:, 0] = 600, 600, 3000, 600, 1200
    images = []
    for k, year in enumerate((-2.0, -1.0, 0.0, 1.0, 2.0)):
        wcs = WCS_OF[k % 3]
        image = SKY + draw(SHARP, *wcs.world_to_pixel(WCS_OF[0].pixel_to_world(
            *(places + motion * year))), flux[k], (64, 64))
        images.append(ImageEpoch(
            rng.normal(image, np.sqrt(image)), PSFS[0], wcs, 2028.0 + year,
            error=np.sqrt(image), band='g'))
    table = CrowdedMixturePhotometry(None).fit_images(images, motions=True)
    x, y = WCS_OF[0].world_to_pixel(SkyCoord(table['ra'], table['dec']))
    away, row = cKDTree(np.column_stack([x, y])).query(places.T)
    assert away[0] < 0.3
    pull = (table['flux'][row[0]] - flux[:, 0]) / table['flux_err'][row[0]]
    assert np.abs(pull).max() < 4
    good = away < 0.4
    pull = (table['flux'][row[good]] - flux.T[good]) / table['flux_err'][
        row[good]]
    assert 0.7 < 1.48 * np.nanmedian(np.abs(pull)) < 1.4


def test_motions_need_times(field):
    with pytest.raises(ValueError, match='two times'):
        CrowdedMixturePhotometry(None).fit_images(field[0], motions=True)
