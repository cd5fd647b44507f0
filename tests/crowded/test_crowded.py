"""Crowded fields: laws of the joint fit, of finding, and of tiles."""
import sys
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest
from astropy import units as u
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from helpers.compiled import compiled
from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    MultiGaussianPSFModel,
    UnfinishedTilesError,
    inject_and_recover,
    kernels,
)
from photutils_mgauss.crowded.background import Mesh
from photutils_mgauss.crowded.plan import Plan
from photutils_mgauss.crowded.stars import Neighbours, Stars
from photutils_mgauss.crowded.table import NOT_SEEN, REPEATED
from photutils_mgauss.crowded.tile import Tile, TileJob, TileOptions
from photutils_mgauss.kernels.crowded_stamps import add_wings
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.utils.image import PixelData

ADD_WINGS = compiled(add_wings)

MIXTURE = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
                          [[[0.6, 0.05], [0.05, 0.5]], [[3, 0], [0, 3]]])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])
OPTIONS = TileOptions(threshold=4.5, keep=2.5, background_size=64,
                      psf_error=0.0, gain=None, floor=1.0, noise=1.0,
                      max_rounds=6)


def photometry(**kwargs):
    return CrowdedMixturePhotometry(PSF, **kwargs)


def draw(x, y, flux, shape, level=20.0):
    image = np.full(shape, level)
    for a, b, f in zip(x, y, flux, strict=True):
        image += MIXTURE.render(shape, a, b, flux=f)
    return image


def expose(image, seed):
    """Return data and error with photon and read-out noise."""
    rng = np.random.default_rng(seed)
    data = rng.poisson(image) + rng.normal(0, 5, image.shape)
    return data, np.sqrt(np.clip(data, 0, None) + 25)


@pytest.fixture(scope='module')
def crowd():
    """Return a field of one star for every 30 pixels, and its truth."""
    rng = np.random.default_rng(5)
    shape = (120, 140)
    n = 560
    x, y = rng.uniform(-0.5, 139.5, n), rng.uniform(-0.5, 119.5, n)
    flux = 10**rng.uniform(2.7, 5, n)
    data, error = expose(draw(x, y, flux, shape), 6)
    return data, error, x, y, flux


@pytest.fixture(scope='module')
def fitted(crowd):
    return photometry()(crowd[0], error=crowd[1])


def nearest(table, x, y):
    tree = cKDTree(np.column_stack([table['x_fit'], table['y_fit']]))
    return tree.query(np.column_stack([x, y]))


def small_tile(x, y, flux, noise=1.0):
    data = draw(x, y, flux, (31, 31), level=5.0)
    local = LocalPSF.from_nodes(
        np.zeros(1), np.zeros(1), MIXTURE.weights[None], MIXTURE.means[None],
        MIXTURE.covariances[None], False)
    return Tile(TileJob(data, np.full(data.shape, noise**2), local, OPTIONS,
                        (0, 0), (0, 31, 0, 31)))


def test_stamps_hold_the_psf_and_its_derivatives():
    tile = small_tile([], [], [])
    tile.start(Stars([12.3], [14.6], [1.0]))
    stamps = tile.model.stamps
    w = stamps.width[0]
    derivatives = stamps.derivatives.reshape(3, w, w)
    model = MultiGaussianPSFModel(MIXTURE)
    j, i = np.indices((w, w))
    exact = model.fit_deriv(i + stamps.left[0], j + stamps.bottom[0], 1,
                            12.3, 14.6, *model.parameters[3:])[:3]
    assert_allclose(derivatives, exact, atol=1e-14)


def test_the_joint_normal_matrix_is_that_of_the_dense_problem():
    x, y, flux = [12.3, 14.1, 15.2], [14.6, 15.4, 13.2], [900., 500., 300.]
    tile = small_tile(x, y, flux)
    tile.start(Stars(x, y, flux))
    stamps = tile.model.stamps
    columns = []
    for k in range(3):
        w, first = stamps.width[k], stamps.offset[k]
        stamp = stamps.derivatives[:, first:first + w * w]
        for m, scale in enumerate((1, flux[k], flux[k])):
            plane = np.zeros(tile.model.data.shape)
            plane[stamps.bottom[k]:stamps.bottom[k] + w,
                  stamps.left[k]:stamps.left[k] + w] = (
                      scale * stamp[m].reshape(w, w))
            columns.append(plane.ravel())
    design = np.array(columns)
    dense = np.linalg.inv(design @ design.T)
    covariance, correlation = tile.equations.covariances()
    for k in range(3):
        block = slice(3 * k, 3 * k + 3)
        assert_allclose(covariance[k], dense[block, block], rtol=1e-9)
        other = 3 * tile.equations.neighbours.nearest[k]
        want = dense[3 * k, other] / np.sqrt(dense[3 * k, 3 * k]
                                             * dense[other, other])
        assert_allclose(correlation[k], want, rtol=1e-9)


def test_gauss_newton_finds_a_noiseless_blend_again():
    x, y = np.array([12.3, 13.5, 15.2]), np.array([14.6, 15.3, 13.2])
    flux = np.array([9000.0, 5000.0, 300.0])
    tile = small_tile(x, y, flux)
    tile.start(Stars(x + 0.15, y - 0.1, 0.8 * flux))
    for _ in range(40):
        tile.step()
    assert_allclose(tile.model.stars.x, x, atol=2e-3)
    assert_allclose(tile.model.stars.flux, flux, rtol=2e-3)
    assert_allclose(tile.model.level, 5, atol=0.02)


def test_the_background_of_a_plane_is_that_plane():
    mesh = Mesh((100, 130), (32, 64), 40)
    y, x = np.indices((100, 130))
    node_y, node_x = np.meshgrid(mesh.y, mesh.x, indexing='ij')
    image = mesh.image((3 + 0.1 * node_x - 0.2 * node_y).ravel())
    inside = ((x >= mesh.x[0]) & (x <= mesh.x[-1]) & (y >= mesh.y[0])
              & (y <= mesh.y[-1]))
    assert_allclose(image[inside], (3 + 0.1 * x - 0.2 * y)[inside],
                    atol=1e-12)


def test_every_pixel_belongs_to_its_nearest_multiple_of_the_spacing():
    mesh = Mesh((100, 130), (32, 64), 40)
    y, x = np.indices((100, 130))
    node_y, node_x = np.meshgrid(np.arange(40.0, 121, 40) - 32,
                                 np.arange(80.0, 201, 40) - 64, indexing='ij')
    _, nearest_node = cKDTree(np.column_stack(
        [node_x.ravel(), node_y.ravel() + 1e-6])).query(
            np.column_stack([x.ravel() + 1e-3, y.ravel() + 2e-3]))
    image = np.random.default_rng(1).normal(size=x.shape)
    weight = np.abs(image)
    sums = mesh.sums(weight, image, 0 * image + 2, 1.2)
    # Stars are above the sky; what is far below it counts, but no more.
    near = image * np.sqrt(weight) <= 1.2
    level = np.maximum(image, -1.2 / np.sqrt(weight)) + 2
    for total, part in zip(sums, (weight, weight * near,
                                  weight * near * level), strict=True):
        want = np.bincount(nearest_node, part.ravel(), node_x.size)
        assert_allclose(total, want, atol=1e-10)
    assert_array_equal(mesh.owners(x.ravel(), y.ravel()), nearest_node)


@pytest.mark.parametrize(('shape', 'origin', 'spacing'), [
    ((100, 130), (0, 0), 40), ((97, 201), (0, 37), 64), ((70, 65), (5, 0), 32),
    ((20, 150), (0, 0), 64)])
def test_a_plane_is_a_background_up_to_the_edges(shape, origin, spacing):
    mesh = Mesh(shape, origin, spacing)
    y, x = np.indices(shape, dtype=float)
    plane = 100 + 0.7 * x - 0.4 * y
    weight = np.ones(shape)
    count, _, total = mesh.sums(weight, plane, np.zeros(shape), 1e9)
    # The levels of nodes are means of pixels.
    level = 100 + 0.7 * np.tile(mesh.x, mesh.y.size) - 0.4 * np.repeat(
        mesh.y, mesh.x.size)
    assert_allclose(total[count > 0] / count[count > 0], level[count > 0])
    assert_allclose(mesh.image(level), plane)
    places = np.array([[0.2, shape[1] - 1.3], [0.7, shape[0] - 1.1]])
    node, share = mesh.shares(*places)
    assert_allclose((level[node] * share).sum(axis=1),
                    100 + 0.7 * places[0] - 0.4 * places[1])


def test_fluxes_at_the_edges_of_a_steep_sky_are_unbiased():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[7:250:12, 7:250:12].reshape(2, -1)
    x, y = x + rng.uniform(-1, 1, x.size), y + rng.uniform(-1, 1, x.size)
    image = draw(x, y, np.full(x.size, 6000.0), (256, 256))
    j, i = np.indices(image.shape)
    image += 0.6 * i - 0.9 * (j - 255)
    error = np.sqrt(image)
    table = photometry()(rng.normal(image, error), error=error)
    _, row = cKDTree(np.column_stack([table['x_fit'], table['y_fit']])).query(
        np.column_stack([x, y]))
    pull = (table['flux_fit'][row] - 6000) / table['flux_err'][row]
    for edge in (x < 15, x > 240, y < 15, y > 240):
        # Some 21 stars each.
        assert abs(np.mean(pull[edge])) < 0.8


def test_wings_are_those_of_the_exact_gaussian(rng):
    y, x = np.indices((40, 40))
    for _ in range(60):
        (a, b), rho = rng.uniform(0.35, 8, 2), rng.uniform(-0.9, 0.9)
        covariance = np.array([[a * a, rho * a * b], [rho * a * b, b * b]])
        det = np.linalg.det(covariance)
        row = np.array([3.0, 0.2, -0.1, covariance[1, 1] / det,
                        covariance[0, 1] / covariance[1, 1],
                        1 / covariance[1, 1]])
        cx, cy = rng.uniform(-6, 46, 2)
        image = np.zeros((40, 40))
        ADD_WINGS(row[None], 1.0, cx, cy, None, 1e-6,
                  kernels.WingScratch.empty(40), image)
        offset = np.stack([x - cx - 0.2, y - cy + 0.1], axis=-1)
        exact = 3 * np.exp(-0.5 * np.einsum(
            '...i,ij,...j', offset, np.linalg.inv(covariance), offset))
        assert_allclose(image, exact, atol=1.1e-6)


def test_neighbours_are_listed_both_ways():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 30, (2, 60))
    pairs = Neighbours.of(x, y, 5.0)
    assert (pairs.owner[pairs.twin] == pairs.neighbour).all()
    assert (pairs.neighbour[pairs.twin] == pairs.owner).all()


def test_merged_gaussians_are_the_blend_of_the_grid():
    shapes = [0.6, 0.61, 0.605, 0.62]
    nodes = [GaussianMixture([0.7 + i / 100, 0.3 - i / 100],
                             [[0.01 * i, 0], [0, 0]],
                             [[[s, 0], [0, s]], [[3, 0], [0, 3 + s]]])
             for i, s in enumerate(shapes)]
    # The order of Gaussians is arbitrary.
    flipped = [GaussianMixture(m.weights[::-1], m.means[::-1],
                               m.covariances[::-1]) for m in nodes[:1]]
    psf = GriddedMixturePSF(flipped + nodes[1:],
                            [(0, 0), (50, 0), (0, 50), (50, 50)])
    phot = CrowdedMixturePhotometry(psf)
    assert phot._psf.n_rows == 2
    stamp = phot._psf.stamp(22, 31, 6)
    exact = psf.render(22, 31, 1, 13)[0]
    assert_allclose(stamp, exact, atol=1e-3 * exact.max())


def test_stars_are_found_and_false_ones_are_rare(crowd, fitted):
    _, _, x, y, flux = crowd
    distance, row = nearest(fitted, x, y)
    bright = flux > 5000
    matched = (distance < 0.5) & (np.abs(np.log(
        fitted['flux_fit'][row] / flux)) < 0.7)
    assert matched[bright].mean() > 0.96
    tree = cKDTree(np.column_stack([x, y]))
    gap, _ = tree.query(np.column_stack([fitted['x_fit'], fitted['y_fit']]))
    assert (gap > 0.7).mean() < 0.06


def test_errors_are_honest(crowd, fitted):
    _, _, x, y, flux = crowd
    distance, row = nearest(fitted, x, y)
    good = (distance < 0.5) & (flux > 2000)
    pull = np.concatenate([
        (fitted[f'{c}_fit'][row] - true)[good] / fitted[f'{c}_err'][row][good]
        for c, true in (('x', x), ('y', y))])
    assert 0.8 < 1.4826 * np.median(np.abs(pull)) < 1.4


def test_the_background_is_that_of_the_sky(fitted):
    assert abs(np.median(fitted['local_bkg']) - 20) < 4


def test_the_table_has_the_columns_of_photutils(fitted):
    assert {'id', 'group_id', 'group_size', 'local_bkg', 'x_init', 'y_init',
            'flux_init', 'x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err',
            'flux_err', 'n_pixels_fit', 'qfit', 'cfit', 'reduced_chi2',
            'flags'} <= set(fitted.colnames)
    assert ((fitted['crowding'] > 0) & (fitted['crowding'] <= 1)).all()
    assert (np.abs(fitted['neighbor_correlation']) <= 1).all()


@pytest.mark.long
def test_tiles_do_not_change_a_star():
    rng = np.random.default_rng(8)
    n = 1800
    x, y = rng.uniform(-0.5, 229.5, (2, n))
    flux = 10**rng.uniform(2.3, 5, n)
    data, error = expose(draw(x, y, flux, (230, 230)), 9)
    whole = photometry()(data, error=error)
    tiles = photometry(tile_shape=(115, 120))(data, error=error)
    distance, row = nearest(tiles, whole['x_fit'], whole['y_fit'])
    assert len(tiles) == pytest.approx(len(whole), rel=0.002)
    bright = whole['flux_fit'] > 5 * whole['flux_err']
    assert (distance < 1e-3)[bright].mean() > 0.998
    error = np.hypot(whole['x_err'], whole['y_err'])
    assert np.nanpercentile(distance / error, 99.5) < 0.05
    change = tiles['flux_fit'][row] / whole['flux_fit'] - 1
    assert np.percentile(np.abs(change), 99) < 1e-3


@pytest.mark.long
def test_processes_give_what_threads_give(crowd, fitted):
    with ProcessPoolExecutor(1, get_context('spawn')) as pool:
        table = photometry(tile_shape=70, executor=pool)(crowd[0],
                                                         error=crowd[1])
    threads = photometry(tile_shape=70)(crowd[0], error=crowd[1])
    assert_allclose(table['x_fit'], threads['x_fit'], atol=1e-9)


def test_dask_gives_what_threads_give(crowd, fitted):
    distributed = pytest.importorskip('distributed')
    with distributed.Client(processes=False, n_workers=1,
                            threads_per_worker=1,
                            dashboard_address=None) as client:
        pool = client.get_executor()
        table = photometry(tile_shape=70, executor=pool)(crowd[0],
                                                         error=crowd[1])
    threads = photometry(tile_shape=70)(crowd[0], error=crowd[1])
    assert_allclose(table['x_fit'], threads['x_fit'], atol=1e-9)


def test_the_residual_image_is_noise(crowd):
    data, error = crowd[:2]
    phot = photometry()
    phot(data, error=error)
    residual = phot.make_residual_image(data, include_local_bkg=True)
    chi = (residual / error)[12:-12, 12:-12]
    assert 1.4826 * np.median(np.abs(chi)) < 1.15


def wide_winged():
    """Return photometry of a bright star with wide wings, and its truth."""
    mixture = GaussianMixture([0.9, 0.1], np.zeros((2, 2)),
                              [np.eye(2), 144 * np.eye(2)])
    y, x = np.indices((111, 111))
    true = 1e7 * mixture.evaluate(x - 55, y - 55)
    error = np.sqrt(true + 100)
    phot = CrowdedMixturePhotometry(GriddedMixturePSF([mixture], [(0, 0)]),
                                    background_size=None)
    phot(true, error=error)
    return phot, true


def test_the_model_image_has_all_of_the_wings_that_can_be_seen():
    phot, true = wide_winged()
    model = phot.make_model_image(true.shape)
    assert true[55, 86] == pytest.approx(39.3, abs=0.1)
    # A hundredth of the noise.
    assert_allclose(model, true, rtol=1e-3, atol=0.1)


def test_the_model_image_has_no_more_of_a_star_than_is_asked_for():
    phot, true = wide_winged()
    model = phot.make_model_image(true.shape, psf_shape=(9, 21))
    inside = np.zeros(true.shape, bool)
    inside[51:60, 45:66] = True
    assert_allclose(model[inside], true[inside], rtol=1e-3)
    assert not model[~inside].any()


def test_given_positions_are_fitted_in_their_order(crowd):
    data, error, x, y, flux = crowd
    bright = np.flatnonzero((flux > 3000) & (x > 2) & (y > 2) & (x < 137)
                            & (y < 117))
    init = Table({'x': x[bright] + 0.1, 'y': y[bright]})
    table = photometry(tile_shape=80)(data, error=error, init_params=init)
    assert len(table) == len(init)
    assert_allclose(table['x_init'], init['x'])
    gap = np.hypot(table['x_fit'] - x[bright], table['y_fit'] - y[bright])
    assert np.median(gap) < 0.05


def offset(table, x, y):
    return np.hypot(table['x_fit'] - x, table['y_fit'] - y)


@pytest.fixture(scope='module')
def half_listed(crowd):
    """Return half of the visible stars, and their rows fitted as a list."""
    data, error, x, y, flux = crowd
    inside = (x > 2) & (y > 2) & (x < 137) & (y < 117)
    rows = np.flatnonzero((flux > 1500) & inside)[::2]
    init = Table({'x': x[rows] + 0.1, 'y': y[rows] - 0.1})
    return rows, init, photometry()(data, error=error, init_params=init)


def test_half_a_list_is_fitted_as_well_as_all_of_it(crowd, half_listed):
    data, error, x, y, _ = crowd
    rows, _, table = half_listed
    whole = photometry(find_neighbors=False)(
        data, error=error, init_params=Table({'x': x, 'y': y}))
    gap, best = offset(table, x[rows], y[rows]), offset(whole, x, y)[rows]
    assert np.median(gap) < 1.1 * np.median(best)
    assert (gap > 0.5).mean() < (best > 0.5).mean() + 0.03


def test_stars_that_are_not_listed_are_fitted_but_not_reported(
        crowd, half_listed):
    data, error, x, y, _ = crowd
    rows, init, table = half_listed
    assert len(table) == len(init)
    assert_allclose(table['x_init'], init['x'])
    assert (np.abs(table['x_fit'] - init['x']) < 1 + 1e-9).all()
    alone = photometry(find_neighbors=False)(data, error=error,
                                             init_params=init)
    gap, far = (offset(t, x[rows], y[rows]) for t in (table, alone))
    assert np.median(gap) < 0.7 * np.median(far)


def test_a_list_of_what_is_found_changes_nothing(crowd):
    moves = []
    # One blend that ends otherwise takes its neighbours along: two images.
    for seed in (6, 8):
        data, error = expose(draw(*crowd[2:], crowd[0].shape), seed)
        found = photometry()(data, error=error)
        init = Table({'x': found['x_fit'], 'y': found['y_fit']})
        table = photometry()(data, error=error, init_params=init)
        assert not (table['flags'] & REPEATED).any()
        moves.append(offset(table, init['x'], init['y'])
                     / np.hypot(found['x_err'], found['y_err']))
    assert np.percentile(np.concatenate(moves), 99) < 0.1


def test_tiles_do_not_change_a_listed_star(crowd, half_listed):
    _, init, whole = half_listed
    table = photometry(tile_shape=(70, 80))(crowd[0], error=crowd[1],
                                            init_params=init)
    moved = offset(table, whole['x_fit'], whole['y_fit'])
    assert (moved < 1e-3).mean() > 0.97
    assert (np.abs(table['flags'] & REPEATED)
            == whole['flags'] & REPEATED).mean() > 0.99


def test_an_entry_where_nothing_is_keeps_its_row_and_says_so():
    data, error = expose(draw([20.3], [21.1], [2e4], (62, 62)), 3)
    init = Table({'x': [45.0, 20.3], 'y': [40.0, 21.1]})
    table = photometry()(data, error=error, init_params=init)
    assert list(table['flags'] & NOT_SEEN > 0) == [True, False]
    assert abs(table['flux_fit'][0]) < 4 * table['flux_err'][0]
    # Its place is known no worse than the list says.
    assert abs(table['x_fit'][0] - 45) < 1
    assert 0.4 < table['x_err'][0] < 0.7
    assert abs(table['x_fit'][1] - 20.3) < 0.05


def test_two_entries_for_one_star_are_told():
    data, error = expose(draw([20.3], [21.1], [2e4], (62, 62)), 3)
    init = Table({'x': [20.5, 20.3], 'y': [21.0, 21.1]})
    phot = photometry()
    table = phot(data, error=error, init_params=init)
    assert list(table['flags'] & REPEATED > 0) == [True, False]
    assert_allclose(table['flux_fit'], table['flux_fit'][1])
    assert_allclose(table['x_init'], init['x'])
    assert_allclose(phot.make_model_image((62, 62)).sum(), 2e4, rtol=0.03)


def test_a_listed_star_stays_within_bounds_and_says_so():
    data, error = expose(draw([20.3], [21.1], [2e4], (62, 62)), 3)
    init = Table({'x': [19.9], 'y': [21.1]})
    for find in (True, False):
        phot = photometry(find_neighbors=find, xy_bounds=0.15)
        table = phot(data, error=error, init_params=init)
        assert_allclose(table['x_fit'], 20.05)
        assert table['flags'][0] & 32


def test_entries_outside_the_image_keep_their_rows():
    data, error = expose(draw([20.3], [21.1], [2e4], (62, 62)), 3)
    init = Table({'x': [-30.0, 20.3, np.nan], 'y': [5.0, 21.1, 3.0]})
    table = photometry()(data, error=error, init_params=init)
    assert list(np.isfinite(table['x_fit'])) == [False, True, False]
    assert list(table['flags'] & 64 > 0) == [True, False, True]


def test_an_entry_midway_between_two_stars_takes_the_brighter():
    data, error = expose(draw([20.0, 21.6], [21.1, 21.1], [5e4, 3e4],
                              (62, 62)), 3)
    table = photometry()(data, error=error,
                         init_params=Table({'x': [20.82], 'y': [21.1]}))
    assert abs(table['x_fit'][0] - 20) < 0.05
    assert abs(table['flux_fit'][0] / 5e4 - 1) < 0.05


def test_noise_alone_holds_no_stars():
    rng = np.random.default_rng(2)
    table = photometry()(rng.normal(50, 7, (150, 150)),
                         error=np.full((150, 150), 7.0))
    assert len(table) <= 1


@pytest.mark.parametrize('mask', [True, False])
def test_an_image_without_pixels_gives_an_empty_table(mask):
    data = np.full((40, 40), 1.0 if mask else np.nan)
    words = 'all are masked' if mask else 'all are NaN or infinite'
    with pytest.warns(AstropyUserWarning, match=words):
        table = photometry()(data, error=np.ones((40, 40)),
                             mask=np.full((40, 40), mask))
    assert len(table) == 0
    assert 'x_fit' in table.colnames


def test_nan_borders_are_left_out(crowd, fitted):
    data, error = crowd[0].copy(), crowd[1]
    data[:, :20] = np.nan
    table = photometry()(data, error=error)
    inner = fitted[fitted['x_fit'] > 40]
    distance, _ = nearest(table, inner['x_fit'], inner['y_fit'])
    assert (distance < 0.01).mean() > 0.9


def test_a_saturated_star_is_one_star():
    image = draw([30.3, 12.0], [31.1, 45.0], [3e6, 5e4], (62, 62))
    data, error = expose(image, 3)
    mask = data > 9e4
    table = photometry()(np.minimum(data, 9e4), error=error, mask=mask)
    near = np.hypot(table['x_fit'] - 30.3, table['y_fit'] - 31.1) < 12
    star = table[near][np.argmax(table[near]['flux_fit'])]
    assert near.sum() <= 2
    assert abs(star['flux_fit'] / 3e6 - 1) < 0.05
    assert star['flags'] & 65536


def galaxy(x, y):
    return 4000 * np.exp(-np.hypot(x - 45, (y - 44) / 0.6) / 6)


def concentrated_galaxy(x, y):
    radius = np.hypot(x - 45, (y - 44) / 0.7)
    return 4e4 * np.exp(-7.67 * (radius / 15)**0.25)


def nebula(x, y):
    waves = 1 + 0.5 * np.sin(x / 7) * np.cos(y / 5)
    return 300 * np.exp(-np.hypot(x - 50, y - 40)**2 / 800) * waves


@pytest.mark.parametrize('light', [galaxy, concentrated_galaxy, nebula])
def test_what_is_made_of_extended_light_is_flagged(light):
    y, x = np.indices((90, 90))
    data, error = expose(20 + light(x, y), 4)
    table = photometry()(data, error=error)
    unflagged = table['flags'] & (262144 | 8) == 0
    assert len(table) < 500
    assert unflagged.sum() <= 0.15 * len(table)


def test_stars_of_a_crowd_are_not_flagged_as_something_else(fitted):
    assert (fitted['flags'] & 262144 > 0).mean() < 0.02


def test_faint_neighbours_are_fitted_but_not_reported(crowd):
    deep = photometry(threshold=3.5)(crowd[0], error=crowd[1])
    table = photometry()(crowd[0], error=crowd[1])
    assert len(table) < len(deep)
    distance, _ = nearest(deep, table['x_fit'], table['y_fit'])
    assert np.percentile(distance, 99) < 1e-9


def test_numbers_of_stars_make_faint_fluxes_fainter_and_no_bright_ones():
    data, error = expose(draw([20.3, 45.0], [21.1, 40.0], [5e4, 260],
                              (62, 62)), 3)
    flat, steep = (photometry(count_slope=slope, background_size=None)(
        data - 20, error=error) for slope in (0, 1.5))
    assert len(flat) == len(steep) == 2
    faint, bright = np.argsort(flat['flux_fit'])
    change = steep['flux_fit'] - flat['flux_fit']
    assert abs(change[bright] / flat['flux_fit'][bright]) < 1e-4
    # The top of likelihood times flux**-slope.
    want = -1.5 * flat['flux_err'][faint]**2 / flat['flux_fit'][faint]
    assert_allclose(change[faint], want, rtol=0.3)


@pytest.mark.parametrize('kind', ['f4', '>f4', 'i4', 'u2', 'F'])
def test_any_kind_of_numbers_gives_the_same_stars(kind):
    data, error = expose(draw([20.3], [21.1], [2e4], (62, 62), level=60.0), 3)
    data = np.rint(data)
    kinds = {'F': np.asfortranarray(data)}
    other = kinds[kind] if kind in kinds else data.astype(kind)
    table = photometry()(other, error=error)
    assert_allclose(table['x_fit'], photometry()(data, error=error)['x_fit'])


def test_masked_arrays_mask_pixels(crowd):
    data, error = crowd[0][:60, :60], crowd[1][:60, :60]
    bad = np.zeros(data.shape, bool)
    bad[20:30] = True
    masked = photometry()(np.ma.masked_array(data, bad), error=error)
    table = photometry()(data, error=error, mask=bad)
    assert_allclose(masked['x_fit'], table['x_fit'])


def test_tiles_are_even_and_cover_the_image():
    for shape in ((9232, 9216), (2048, 2048), (500, 1700)):
        image = PixelData(np.empty(shape), np.empty(shape), None, None)
        cores = Plan(image, None, OPTIONS, None, 48, None).cores
        sizes = np.array([(c[1] - c[0], c[3] - c[2]) for c in cores])
        assert sizes.prod(axis=1).sum() == np.prod(shape)
        assert sizes.max() <= 2048
        assert len(cores) >= (4 if min(shape) > 1024 else 1)


@pytest.mark.parametrize(('factor', 'word'), [(1.8, 'wide'), (0.5, 'narrow')])
def test_a_wrong_psf_is_reported(crowd, factor, word):
    wrong = GaussianMixture(MIXTURE.weights, MIXTURE.means,
                            factor * MIXTURE.covariances)
    phot = CrowdedMixturePhotometry(GriddedMixturePSF([wrong], [(0, 0)]),
                                    maxiters=1)
    with pytest.warns(UserWarning, match=f'too {word}'):
        phot(crowd[0][:70, :70], error=crowd[1][:70, :70])


@pytest.mark.parametrize('factor', [0.3, 2.5])
@pytest.mark.filterwarnings('ignore:the PSF is too')
def test_a_wrong_psf_does_not_make_the_sky_run_away(crowd, factor):
    wrong = GaussianMixture(MIXTURE.weights, MIXTURE.means,
                            factor * MIXTURE.covariances)
    phot = CrowdedMixturePhotometry(GriddedMixturePSF([wrong], [(0, 0)]))
    data, error = crowd[0][:90, :90], crowd[1][:90, :90]
    table = phot(data, error=error)
    nothing = (((data - np.median(data)) / error)**2).mean()
    assert table.meta['reduced_chi2'] < nothing
    assert np.abs(table['local_bkg']).max() < 200


def test_limits_of_the_sky_hold_a_sky_of_noise_and_stars(crowd):
    data = crowd[0]
    mesh = Mesh(data.shape, (0, 0), 64)
    good = np.ones(data.shape, bool)
    good[:32, :32] = False
    low, high = mesh.limits(data, good, 7.0)
    assert (low < 15).all()
    assert (high > 25).all()
    assert not np.isfinite(low[0])
    assert np.isfinite(low[1:]).all()


def test_units_pass_through(crowd):
    data, error = crowd[0][:50, :50], crowd[1][:50, :50]
    plain = photometry()(data, error=error)
    table = photometry()(data * u.electron, error=error * u.electron)
    assert table['flux_fit'].unit == u.electron
    assert_allclose(table['flux_fit'].value, plain['flux_fit'])
    nddata = NDData(data, uncertainty=StdDevUncertainty(error))
    assert_allclose(photometry()(nddata)['x_fit'], plain['x_fit'])


class DyingExecutor(Executor):
    """Runs the first job and fails the others, as a killed worker does."""

    def __init__(self):
        self.n = 0

    def submit(self, function, *args):
        future = Future()
        self.n += 1
        if self.n == 1:
            future.set_result(function(*args))
        else:
            future.set_exception(RuntimeError('killed'))
        return future


def test_a_killed_worker_leaves_the_finished_tiles(crowd):
    phot = photometry(tile_shape=70, executor=DyingExecutor())
    with pytest.raises(UnfinishedTilesError, match='3 tiles') as caught:
        phot(crowd[0], error=crowd[1])
    assert 'the first ended with RuntimeError: killed' in str(caught.value)
    assert len(caught.value.table) > 50
    assert (0, 64, 70, 140) in caught.value.unfinished


def test_the_progress_bar_tells_of_stars_and_chi2(crowd, capsys,
                                                  monkeypatch):
    phot = photometry(progress_bar=True)
    corner = crowd[0][:50, :50], crowd[1][:50, :50]
    phot(corner[0], error=corner[1])
    assert capsys.readouterr().err == ''  # no terminal
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    phot(corner[0], error=corner[1])
    shown = capsys.readouterr().err
    assert 'stars=' in shown
    assert 'chi2=' in shown


@pytest.mark.parametrize(('keyword', 'said'), [
    ('finder', ': it finds the stars itself, .* "init_params"'),
    ('localbkg_estimator', ': the background is fitted: see "background_'),
    ('fot', '$')])
def test_what_replaces_keywords_of_photutils_is_said(keyword, said):
    with pytest.raises(TypeError, match=f"no keyword '{keyword}'.*{said}"):
        photometry(**{keyword: 3})


@pytest.mark.parametrize(('keyword', 'value', 'error'), [
    ('threshold', -1, ValueError), ('keep', 'x', TypeError),
    ('background_size', 2, ValueError), ('tile_shape', 5, ValueError),
    ('overlap', 2, ValueError), ('maxiters', 0, ValueError),
    ('xy_bounds', 0, ValueError)])
def test_bad_keywords_are_named(keyword, value, error):
    with pytest.raises(error, match=keyword):
        photometry(**{keyword: value})


@pytest.mark.parametrize(('sign', 'factor', 'sentence'), [
    (-1, 1, 'PSF is too narrow.*Use the PSF of this image'),
    (1, 1 / 4, 'do not describe the image')])
def test_an_image_that_stars_do_not_describe_is_said(crowd, sign, factor,
                                                     sentence):
    with pytest.warns(AstropyUserWarning, match=sentence):
        photometry(maxiters=1)(sign * crowd[0], error=factor * crowd[1])


def test_bad_images_are_named():
    with pytest.raises(ValueError, match='data must have'):
        photometry()(np.ones(5))
    with pytest.raises(ValueError, match='error must have'):
        photometry()(np.ones((50, 50)), error=np.ones((5, 5)))
    with pytest.raises(TypeError, match='psf_model'):
        CrowdedMixturePhotometry('psf')
    with pytest.raises(ValueError, match='y_init'):
        photometry()(np.ones((50, 50)), init_params=Table({'x': [1]}))


def test_bright_artificial_stars_come_back(crowd):
    result = inject_and_recover(photometry(), crowd[0], (2e3, 6e4), rng=1,
                                error=crowd[1], separation=25)
    stars = result.stars
    assert stars['recovered'][stars['flux_true'] > 1e4].mean() > 0.9
    assert (result.curves['n_injected'].sum() == len(stars))
    again = inject_and_recover(photometry(), crowd[0], (2e3, 6e4), rng=1,
                               error=crowd[1], separation=25)
    assert_allclose(again.stars['x_fit'], stars['x_fit'])


def test_what_cannot_be_injected_is_named(crowd):
    with pytest.raises(TypeError, match='photometry must be a Crowded'):
        inject_and_recover(photometry().psf_model, crowd[0], (2e3, 6e4))
    with pytest.raises(ValueError, match=r'flux must be \(lower, higher\)'):
        inject_and_recover(photometry(), crowd[0], (6e4, 2e3))


def test_the_solution_of_conjugate_gradients_solves_the_equations():
    rng = np.random.default_rng(4)
    n = 5
    a = rng.normal(size=(3 * n + 4, 40))
    full = a @ a.T
    matrix = np.array([full[3*i:3*i + 3, 3*i:3*i + 3] for i in range(n)])
    i, j = np.nonzero(~np.eye(n, dtype=bool))
    blocks = np.array([full[3*p:3*p + 3, 3*q:3*q + 3]
                       for p, q in zip(i, j, strict=True)])
    indptr = np.arange(n + 1) * (n - 1)
    node = np.tile(np.arange(4), (n, 1))
    reach = rng.normal(size=(n, 3))
    share = np.full((n, 4), 0.25)
    # The nodes are a square, of which each is tied to two.
    full[15:, 15:] = np.diag(rng.uniform(3, 4, 4)) - 0.7 * (
        np.isin(np.bitwise_xor.outer(np.arange(4), np.arange(4)), (1, 2)))
    full[:15, 15:] = np.repeat(reach.ravel()[:, None] / 4, 4, axis=1)
    full[15:, :15] = full[:15, 15:].T
    right = rng.normal(size=3 * n + 4)
    step = np.zeros(3 * n + 4)
    kernels.solve_joint(
        kernels.StarEquations(matrix, right[:15].reshape(n, 3).copy(), reach,
                              blocks),
        kernels.Pairs(indptr, j.astype(np.int64), np.empty(0, np.int64)),
        kernels.MeshEquations(np.diag(full)[15:].copy(), right[15:].copy(),
                              0.7, 2, node, share), 1e-12, 200,
        np.empty((n, 3, 3)), np.empty((4, step.size)), step)
    assert_allclose(step, np.linalg.solve(full, right), rtol=1e-6)
