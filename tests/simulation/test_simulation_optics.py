"""PSFs from optics, against GalSim's own drawing."""
from dataclasses import replace

import numpy as np
import pytest
from astropy.nddata import NDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import GriddedPSFModel

from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.simulation import (
    DetectorEffects,
    Exposure,
    Instrument,
    Optics,
    csst_psf,
    render_stars,
    simulate,
    simulate_catalogues,
)
from photutils_mgauss.simulation.brighter_fatter import (
    OpticsPhotons,
    photons,
)
from photutils_mgauss.simulation.optics import _interpolation
from photutils_mgauss.simulation.renderer import widen


@pytest.fixture(scope='module')
def uniform_optics():
    pytest.importorskip('galsim')
    return Optics((121, 131), variation=0, n_wavelengths=2)


@pytest.fixture(scope='module')
def uniform_psf(uniform_optics):
    return uniform_optics.to_gridded_psf(2, radius=20)


def galsim_star(optics, x, y, half):
    galsim = pytest.importorskip('galsim')
    i, j = round(x), round(y)
    image = optics.profile(x, y).drawImage(
        nx=2 * half + 1, ny=2 * half + 1, scale=optics.pixel_scale,
        offset=(x - i, y - j), method='auto', dtype=float)
    assert isinstance(image, galsim.Image)
    return image.array, slice(j - half, j + half + 1), slice(i - half,
                                                             i + half + 1)


@pytest.mark.parametrize(('x', 'y'), [(60.0, 61.0), (60.31, 60.77),
                                      (64.5, 58.49)])
def test_a_star_is_what_galsim_draws_to_1e_3_of_its_peak(
        uniform_optics, uniform_psf, x, y):
    image = render_stars(uniform_psf, [x], [y], [1e5], (121, 131))
    expected, rows, columns = galsim_star(uniform_optics, x, y, 15)
    assert_allclose(image[rows, columns] / 1e5, expected, rtol=0,
                    atol=1e-3 * expected.max())
    outside = image.copy()
    outside[rows, columns] = 0
    assert_allclose(image.sum() / 1e5, 1, atol=0.02)
    assert outside.sum() / 1e5 < 0.02


def test_the_psf_of_a_node_is_what_galsim_draws_there():
    pytest.importorskip('galsim')
    optics = Optics((102, 103), n_wavelengths=1)
    psf = optics.to_gridded_psf(3, radius=12)
    image = render_stars(psf, [51.0], [50.5], [1e5], (102, 103))
    expected, rows, columns = galsim_star(optics, 51.0, 50.5, 10)
    assert_allclose(image[rows, columns] / 1e5, expected, rtol=0,
                    atol=1e-3 * expected.max())
    assert np.ptp([image.max() for image in psf.data]) > 0.05


@pytest.mark.parametrize('oversampling', [2, 3, 4])
def test_a_table_is_what_galsim_draws_through_the_pixel(oversampling):
    galsim = pytest.importorskip('galsim')
    optics = Optics((102, 103), 'NUV', n_wavelengths=1)
    psf = optics.to_gridded_psf(2, oversampling=oversampling, radius=8)
    # Large and fine: GalSim folds what is beyond its image in both spaces.
    expected = galsim.Convolve([
        optics.profile(0, 0), galsim.Pixel(0.074)]).drawImage(
        nx=601, ny=601, scale=0.074 / 12, method='no_pixel',
        dtype=float).array * 144
    step = 12 // oversampling
    expected = expected[300 - 96:301 + 96:step, 300 - 96:301 + 96:step]
    assert_allclose(psf.data[0], expected, rtol=0, atol=1e-6 * expected.max())


def test_photons_are_drawn_from_the_light_of_the_table():
    pytest.importorskip('galsim')
    optics = Optics((102, 103), n_wavelengths=1)
    wide = widen(optics.to_gridded_psf(2, n_samples=2, radius=8), 0.2)
    table = wide.meta['light']
    side = table.images.shape[1]
    # Interpolated to the nodes like the table, and as wide as the table.
    expected = replace(optics, diffusion=float(np.hypot(
        0.026, 0.2 * 0.074))).light(0, 0, oversampling=table.oversampling)
    assert expected.shape == (side, side)
    assert_allclose(table.images[0], expected, rtol=0,
                    atol=2e-3 * expected.max())
    places = OpticsPhotons(wide)(0, 0, 20_000, np.random.default_rng(1))
    drawn = np.histogram2d(*places[::-1], bins=side, range=[[
        -24.125, 24.125]] * 2)[0]
    steps = np.abs(np.arange(side) - side // 2)
    core = np.add.outer(steps, steps) < 3 * table.oversampling
    share = expected[core].sum() / expected.sum()
    assert abs(drawn[core].sum() / 20_000 - share) < 0.015


def test_aberrations_are_zernikes_from_defocus_on():
    pytest.importorskip('galsim')
    optics = Optics((50, 60), rng=3)
    assert not optics.aberrations(3, 4)[:4].any()
    corner, centre = optics.aberrations(0, 0), optics.aberrations(29.5, 24.5)
    assert (np.abs(corner - centre)[4:] > 0).all()


def test_scenes_and_catalogues_take_images_of_psfs(uniform_psf):
    camera = Instrument(shape=(121, 131))
    stars = QTable({'x': [60.3, 30.0], 'y': [61.2, 80.7],
                    'flux': [3e4, 2e3]})
    scene = simulate(stars, instrument=camera, psf=uniform_psf, rng=1)
    light = render_stars(uniform_psf, [60.3, 30.0], [61.2, 80.7], [3e4, 2e3],
                         (121, 131))
    pulls = (scene.image - scene.background - light) / scene.error
    assert abs(pulls.std() - 1) < 0.05
    sources = QTable({'ra': [Exposure().ra], 'dec': [Exposure().dec],
                      'mag': [21.0]})
    catalogue, = simulate_catalogues(sources, [Exposure()], rng=1,
                                     instrument=camera, psfs=[uniform_psf])
    assert 0.005 < catalogue.table['x_err'][0].value < 0.05


def test_polynomials_through_chebyshev_points_give_polynomials_back():
    places = np.polynomial.chebyshev.chebpts1(5)
    nodes = np.linspace(-1, 1, 11)
    share = _interpolation(places, nodes)
    assert_allclose(share @ (places**4 - places), nodes**4 - nodes,
                    atol=1e-12)
    assert_allclose(_interpolation(nodes, nodes), np.eye(11), atol=1e-6)


def test_interpolated_nodes_agree_with_drawn_ones():
    pytest.importorskip('galsim')
    optics = Optics((300, 300), wavefront=10, variation=5, n_wavelengths=1)
    psf = optics.to_gridded_psf(5, n_samples=4, radius=8)
    drawn = optics.to_gridded_psf(2, radius=8)
    corners = psf.data.reshape(5, 5, 65, 65)[::4, ::4].reshape(4, 65, 65)
    assert_allclose(corners, drawn.data, atol=0.01 * drawn.data.max())
    assert_array_equal(np.asarray(psf.grid_xypos)[6], (74.75, 74.75))


# Images of PSFs need no optics.

@pytest.fixture(scope='module')
def mixture_psf():
    mixtures = [GaussianMixture.from_stddevs(
        [0.8, 0.2], [(0.1, 0), (0, -0.1)], [(s, 0.9), (2.0, 2.0 + s)],
        [0.2, 0]) for s in (0.9, 1.0, 1.1, 1.2)]
    return GriddedMixturePSF(mixtures, [(0, 0), (99, 0), (0, 99), (99, 99)])


def test_mixtures_and_their_images_draw_the_same_stars(mixture_psf, rng):
    x, y = rng.uniform(-5, 105, (2, 30))
    flux = 10 ** rng.uniform(2, 5, 30)
    images = mixture_psf.to_gridded_psf(4, radius=24)
    shape = 100, 100
    expected = render_stars(mixture_psf, x, y, flux, shape)
    assert_allclose(render_stars(images, x, y, flux, shape), expected, rtol=0,
                    atol=3e-4 * expected.max())


def test_a_star_of_an_image_is_the_one_photutils_evaluates(mixture_psf):
    images = mixture_psf.to_gridded_psf(4, radius=12)
    shape = 60, 60
    y, x = np.mgrid[:60, :60]
    image = render_stars(images, [31.37], [28.81], [100.0], shape,
                         faintest=1e-9)
    expected = images.evaluate(x, y, 100.0, 31.37, 28.81)
    near = (np.abs(x - 31) < 10) & (np.abs(y - 29) < 10)
    assert_allclose(image[near], expected[near], rtol=0,
                    atol=1e-4 * expected.max())


def test_both_kinds_of_psf_widen_alike(mixture_psf):
    wide = widen(mixture_psf, 0.4)
    images = widen(mixture_psf.to_gridded_psf(4, radius=20), 0.4)
    expected = render_stars(wide, [50.2], [49.6], [1e4], (100, 100))
    assert_allclose(render_stars(images, [50.2], [49.6], [1e4], (100, 100)),
                    expected, rtol=0, atol=1e-3 * expected.max())
    assert widen(wide, 0) is wide


def test_other_psfs_are_refused():
    with pytest.raises(TypeError, match='psf must be a GriddedMixturePSF'):
        render_stars('psf', [1], [1], [1], (9, 9))


def test_unequal_oversampling_is_refused():
    psf = GriddedPSFModel(NDData(np.ones((4, 25, 25)), meta={
        'grid_xypos': [(0, 0), (9, 0), (0, 9), (9, 9)],
        'oversampling': (2, 4)}))
    with pytest.raises(ValueError, match='the same oversampling'):
        render_stars(psf, [1], [1], [1], (9, 9))


# The brighter-fatter effect.

def moment_of_star(flux, strength):
    camera = Instrument(shape=(41, 41), read_noise=0.0, dark=0.0,
                        full_well=1e7, exposure_time=1e-3)
    stars = QTable({'x': [20.0], 'y': [20.0], 'flux': [flux]})
    psf = csst_psf((41, 41), variation=0)
    scene = simulate(stars, instrument=camera, psf=psf, rng=1,
                     effects=DetectorEffects(brighter_fatter=strength))
    y, x = np.mgrid[-20:21, -20:21]
    weight = scene.image * np.exp(-(x**2 + y**2) / 8)
    return scene, (weight * (x**2 + y**2)).sum() / weight.sum()


def test_bright_stars_are_wider_where_charge_repels():
    pytest.importorskip('galsim')
    bright, width = moment_of_star(2e6, 1.0)
    _, without = moment_of_star(2e6, 0.0)
    _, faint = moment_of_star(2e5, 1.0)
    assert width > 1.008 * without
    assert abs(faint / without - 1) < 0.5 * abs(width / without - 1)
    assert abs(bright.image.sum() / 2e6 - 1) < 0.01


def test_photons_have_the_moments_of_the_mixture(mixture_psf, rng):
    mixture = mixture_psf.mixture_at(40, 60)
    places = photons(mixture, 100_000, rng)
    mean, covariance = mixture.moments()
    assert_allclose(places.mean(axis=1), mean, atol=0.02)
    assert_allclose(np.cov(places), covariance, atol=0.05)


def test_repulsion_needs_mixtures_before_the_pixel(mixture_psf):
    stars = QTable({'x': [20.0], 'y': [20.0], 'flux': [100.0]})
    with pytest.raises(ValueError, match='pixel_integrated=True'):
        simulate(stars, instrument=Instrument(shape=(41, 41)), rng=1,
                 psf=mixture_psf,
                 effects=DetectorEffects(brighter_fatter=1.0))
