"""What the effects of a detector do to an image, and what they leave alone."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import label

from helpers.small_camera import SMALL, one_star
from photutils_mgauss.simulation import (
    Band,
    DetectorEffects,
    Exposure,
    Instrument,
    Optics,
    crowded_field,
    csst_psf,
    simulate,
)
from photutils_mgauss.simulation.brighter_fatter import (
    OpticsPhotons,
    _converted,
)
from photutils_mgauss.simulation.effects import (
    bleed,
    illumination,
    pattern,
)
from photutils_mgauss.simulation.renderer import widen


def test_without_effects_nothing_is_flagged_and_a_pattern_is_flat():
    scene = simulate(one_star(30, 40, 1e4), instrument=SMALL, rng=1)
    assert not scene.mask.any()
    fixed = pattern(DetectorEffects(), 3, slice(0, 50), 60)
    assert_array_equal(fixed.response, 1)
    assert_array_equal(fixed.dark, 0)


def test_bad_pixels_belong_to_the_detector_not_to_the_exposure():
    effects = DetectorEffects(hot_pixels=1e-3, dead_pixels=1e-3,
                              bad_columns=2)
    flags = [simulate(one_star(30, 40, 1e4), Exposure(detector=detector),
                      instrument=SMALL, effects=effects, rng=rng).flags
             for detector, rng in ((8, 1), (8, 2), (9, 1))]
    assert_array_equal(flags[0], flags[1])
    assert (flags[0] != flags[2]).any()
    columns = (flags[0] & 16).any(axis=0)
    assert columns.sum() == 2
    assert (flags[0][:, columns] & 16).all()
    n = flags[0].size * 1e-3
    for bit in (4, 8):
        assert abs(((flags[0] & bit) != 0).sum() - n) < 5 * np.sqrt(n)


def test_hot_pixels_are_bright_and_dead_ones_and_bad_columns_dark():
    camera = Instrument(shape=(300, 300), exposure_time=600)
    effects = DetectorEffects(hot_pixels=2e-3, dead_pixels=2e-3,
                              bad_columns=2)
    scene = simulate(one_star(-50, -50, 0), instrument=camera,
                     effects=effects, rng=1)
    level = {bit: scene.image[scene.flags == bit].mean()
             for bit in (4, 8, 16)}
    assert level[4] > scene.background + 1000
    assert abs(level[8] - 0.05 * scene.background) < 3
    assert abs(level[16] - 0.4 * scene.background) < 3
    good = scene.image[~scene.mask]
    assert abs(good.mean() - scene.background) < 0.2


def test_the_response_of_pixels_is_removed_but_its_noise_stays():
    camera = Instrument(shape=(300, 300))
    scene = simulate(one_star(-50, -50, 0), instrument=camera, rng=1,
                     effects=DetectorEffects(prnu=0.3))
    plain = simulate(one_star(-50, -50, 0), instrument=camera, rng=1)
    assert_allclose(np.median(scene.image), scene.background, atol=0.7)
    assert scene.image.std() > 1.05 * plain.image.std()
    pulls = (scene.image - scene.background) / scene.error
    assert_allclose(pulls.std(), 1, atol=0.05)


def test_cosmic_rays_come_at_their_rate_and_are_flagged():
    camera = Instrument(shape=(1000, 1000))
    scene = simulate(one_star(-50, -50, 0), instrument=camera, rng=1,
                     effects=DetectorEffects(cosmic_rays=2.0))
    hit = (scene.flags & 2) != 0
    tracks = label(hit, np.ones((3, 3)))[1]
    assert abs(tracks - 300) < 5 * np.sqrt(300)
    excess = scene.image - scene.background
    assert excess[hit].sum() / 300 > 1000
    assert excess[~hit].max() < 6 * scene.error.mean()


def test_bleeding_conserves_charge_and_stays_in_the_column():
    rng = np.random.default_rng(4)
    electrons = rng.uniform(0, 50, (80, 30)).astype(np.float32)
    before = electrons.copy()
    electrons[40, 7] = 1200
    electrons[41, 7] = 900
    electrons[60, 20] = 333
    expected = electrons.sum(axis=0, dtype=float)
    bleed(electrons, 100.0)
    assert_allclose(electrons.sum(axis=0, dtype=float), expected, rtol=1e-6)
    assert electrons.max() <= 100
    still = np.ones(30, bool)
    still[[7, 20]] = False
    assert_array_equal(electrons[:, still], before[:, still])
    full = np.flatnonzero(electrons[:, 7] == 100)
    assert_array_equal(full, np.arange(full[0], full[-1] + 1))
    assert abs(full.mean() - 40.5) <= 1.5


def test_charge_that_reaches_the_end_of_a_column_is_lost():
    electrons = np.full((10, 1), 90, np.float32)
    electrons[5] = 1e4
    bleed(electrons, 100.0)
    assert_array_equal(electrons, 100)


def test_a_saturated_star_bleeds_up_and_down():
    scene = simulate(one_star(150, 100, 5e6), instrument=SMALL, rng=1,
                     effects=DetectorEffects(bleeding=True))
    rows, columns = np.nonzero(scene.mask)
    assert np.ptp(rows) > 3 * np.ptp(columns)
    assert scene.image.max() < SMALL.full_well + 50
    light = (scene.image - scene.background).sum()
    assert_allclose(light, 5e6, rtol=2e-3)


def test_nonlinearity_takes_its_share_at_the_full_well():
    star = one_star(150, 100, 4e5)
    scenes = [simulate(star, instrument=SMALL, rng=1,
                       effects=DetectorEffects(nonlinearity=loss))
              for loss in (0, 0.05)]
    charge = scenes[0].image[100, 150]
    lost = 1 - scenes[1].image[100, 150] / charge
    assert charge > 0.5 * SMALL.full_well
    assert_allclose(lost, 0.05 * charge / SMALL.full_well, rtol=0.05)


def test_charge_diffusion_widens_the_true_psf():
    star = one_star(150, 100, 1e4)
    plain = simulate(star, instrument=SMALL, rng=1)
    wide = simulate(star, instrument=SMALL, rng=1,
                    effects=DetectorEffects(charge_diffusion=0.5))
    gain = (wide.psf.mixture_at(9, 9).moments().covariance
            - plain.psf.mixture_at(9, 9).moments().covariance)
    assert_allclose(gain, 0.25 * np.eye(2), atol=1e-12)
    assert wide.image.max() < plain.image.max()


def stars_on_uneven_pixels(prnu, strength):
    return simulate(
        QTable({'x': np.arange(20.0, 120, 20), 'y': np.full(5, 30.0),
                'flux': np.full(5, 3e5)}),
        psf=csst_psf((64, 128)), instrument=Instrument(shape=(64, 128)),
        exposure=Exposure(), rng=1, effects=DetectorEffects(
            prnu=prnu, brighter_fatter=strength))


@pytest.mark.parametrize('strength', [0.0, 1e-6, 1.0])
def test_the_pattern_of_the_response_is_gone_from_bright_stars(strength):
    if strength:
        pytest.importorskip('galsim')
    uneven, even = (stars_on_uneven_pixels(prnu, strength).image
                    for prnu in (0.2, 0.0))
    bright = even > 5000
    ratio = uneven[bright] / even[bright]
    # Photon noise is 1.4 % and charge that moved 1 %; the pattern is 20 %.
    assert ratio.std() < 0.03
    assert_allclose(ratio.mean(), 1, atol=0.005)


def test_photons_are_turned_into_charge_by_the_pixel_they_fall_on(rng):
    response = np.full((49, 49), 0.5)
    response[24, 25] = 1.5
    places = rng.uniform(-2.5, 2.5, (2, 200_000))
    kept = np.rint(_converted(places, response, rng)).astype(int)
    counts = np.zeros((5, 5))
    np.add.at(counts, (kept[1] + 2, kept[0] + 2), 1)
    expected = 8000 * response[22:27, 22:27] / 1.5
    assert (np.abs(counts - expected) < 5 * np.sqrt(expected)).all()


def test_all_effects_together_do_not_depend_on_threads():
    camera = Instrument(shape=(300, 200))
    stars = crowded_field(camera.shape, rng=1)
    with ThreadPoolExecutor(1) as pool:
        one, many = (simulate(stars, instrument=camera, rng=7,
                              effects=DetectorEffects.typical(), executor=e)
                     for e in (pool, None))
    assert_array_equal(one.image, many.image)
    assert_array_equal(one.error, many.error)
    assert_array_equal(one.flags, many.flags)


@pytest.mark.parametrize(('name', 'value'), [
    ('prnu', -0.1), ('hot_pixels', 2), ('cosmic_rays', -1),
    ('bad_columns', -1)])
def test_effects_of_nonsense_are_refused(name, value):
    with pytest.raises(ValueError, match=f'{name} must be at'):
        DetectorEffects(**{name: value})


def test_the_shutter_exposes_the_first_rows_longer_and_the_noise_keeps_it():
    camera = Instrument(shape=(400, 400), exposure_time=10)
    effects = DetectorEffects(shutter=4.0)
    light = illumination(effects, 1, camera, slice(0, 400))
    # The blade is at row y after t y / 400 s and there again that much
    # before the end: by hand, 10 + 4 - 2 * 4 * (y + 0.5) / 400 seconds.
    seconds = 10 + 4 - 8 * (np.arange(400) + 0.5) / 400
    assert_allclose(light, seconds[:, None] / 10 * np.ones(400))
    scene = simulate(one_star(-50, -50, 0), instrument=camera,
                     effects=effects, rng=1)
    rows = (scene.image - scene.background).mean(axis=1)
    assert abs(rows[:100].mean() - rows[300:].mean()) < 0.15
    # Rows seen longer have less noise for the same light.
    assert scene.image[:100].std() < 0.65 * scene.image[300:].std()
    pulls = (scene.image - scene.background) / scene.error
    assert_allclose(pulls.std(), 1, atol=0.05)


def test_a_shutter_slower_than_the_exposure_is_refused():
    with pytest.raises(ValueError, match='the shutter of effects'):
        simulate(one_star(9, 9, 1), rng=1, effects=DetectorEffects(shutter=6),
                 instrument=Instrument(shape=(20, 20), exposure_time=10))


def test_the_large_scale_flat_is_smooth_has_its_size_and_is_divided_out():
    camera = Instrument(shape=(300, 300))
    effects = DetectorEffects(large_scale_flat=0.05)
    light = illumination(effects, 5, camera, slice(0, 300))
    assert_allclose(light.std(), 0.05, rtol=0.01)
    assert_allclose(light.mean(), 1, atol=1e-3)
    # Markov: a polynomial of degree 4 between -1 and 1 climbs at most 16.
    assert (np.abs(np.diff(light, axis=0)).max()
            < 16 * np.abs(light - 1).max() * 2 / 300)
    assert_allclose(illumination(effects, 5, camera, slice(128, 256)),
                    light[128:256])
    assert (illumination(effects, 6, camera, slice(0, 300)) != light).any()
    star = one_star(150, 100, 1e5)
    flat, even = (simulate(star, instrument=camera, rng=1, effects=e)
                  for e in (effects, None))
    assert_allclose(flat.image[95:106, 145:156].sum(),
                    even.image[95:106, 145:156].sum(), rtol=0.015)
    assert_allclose(flat.image[:50].mean(), even.image[:50].mean(), rtol=0.01)


def test_the_error_of_the_flat_field_stays_the_same_in_all_exposures():
    effects = DetectorEffects(prnu=0.01, flat_error=0.02)
    fixed = pattern(effects, 3, slice(0, 128), 200)
    ratio = fixed.flat / fixed.response
    assert_allclose(ratio.std(), 0.02, rtol=0.03)
    assert_array_equal(pattern(effects, 3, slice(0, 128), 200).flat,
                       fixed.flat)
    assert_array_equal(
        pattern(DetectorEffects(prnu=0.01), 3, slice(0, 128), 200).response,
        fixed.response)


def test_warm_pixels_are_flagged_and_their_current_is_that_asked_for():
    camera = Instrument(shape=(300, 300), exposure_time=600)
    effects = DetectorEffects(warm_pixels=0.01, hot_pixels=1e-3)
    scene = simulate(one_star(-50, -50, 0), instrument=camera,
                     effects=effects, rng=1)
    warm, hot = ((scene.flags & bit) != 0 for bit in (32, 4))
    assert not (warm & hot).any()
    n = scene.flags.size * 0.01
    assert abs(warm.sum() - n) < 5 * np.sqrt(n)
    excess = (scene.image[warm] - scene.background).mean()
    assert_allclose(excess, 0.3 * 600, rtol=5 / np.sqrt(n))
    only_hot = DetectorEffects(hot_pixels=1e-3)
    assert_array_equal(pattern(only_hot, 1, slice(0, 128), 300).flags == 4,
                       pattern(effects, 1, slice(0, 128), 300).flags == 4)


@pytest.fixture(scope='module')
def optics():
    pytest.importorskip('galsim')
    return Optics((64, 128), n_wavelengths=2)


def test_photons_of_optics_fall_where_its_table_says(optics, rng):
    psf = optics.to_gridded_psf(2, radius=24)
    places = OpticsPhotons(psf)(40.0, 30.0, 400_000, rng)
    # Counted in pixels they are the table's image, which has the pixel.
    counts = np.zeros((9, 9))
    column, row = np.rint(places).astype(int) + 4
    inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < 9)
    np.add.at(counts, (row[inside], column[inside]), 1)
    y, x = np.mgrid[26:35, 36:45]
    expected = 400_000 * psf.evaluate(x, y, 1, 40.0, 30.0)
    # The stamp holds all photons; 2 % of the table's light is outside it.
    expected *= counts.sum() / expected.sum()
    assert_allclose(counts, expected, rtol=0.02,
                    atol=5 * np.sqrt(expected.max() * 0.02))


def test_stars_of_optics_grow_with_their_flux(optics):
    camera = Instrument(shape=(64, 128))
    psf = optics.to_gridded_psf(2, radius=24)
    stars = QTable({'x': [40.0, 88.0], 'y': [32.0, 32.0],
                    'flux': [3e5, 3e5]})

    def share(strength):
        scene = simulate(stars, psf=psf, instrument=camera, rng=1,
                         effects=DetectorEffects(brighter_fatter=strength))
        light = scene.image - scene.background
        return sum(light[32, x] for x in (40, 88)) / 6e5
    assert share(1.0) < 0.99 * share(1e-6)
    x = np.array([40.0, 88.0])
    peaks = [psf.evaluate(x[i:i + 1], np.array([32.0]), 1, x[i], 32.0)
             for i in (0, 1)]
    assert_allclose(share(1e-6), np.mean(peaks), rtol=0.02)


def test_diffusion_reaches_the_photons_of_optics(optics):
    psf = widen(optics.to_gridded_psf(2, radius=8), 0.3)
    wide, narrow = psf.meta['optics'], optics
    assert_allclose(wide.diffusion**2 - narrow.diffusion**2,
                    (0.3 * 0.074)**2)


def test_light_of_optics_is_drawn_once_for_all_exposures(optics, monkeypatch):
    drawn, light = [], Optics.light
    monkeypatch.setattr(Optics, 'light', lambda self, *place, **options: (
        drawn.append(place), light(self, *place, **options))[1])
    psf = optics.to_gridded_psf(2, radius=8)
    effects = DetectorEffects(charge_diffusion=0.1, brighter_fatter=1.0)
    images = [simulate(one_star(30, 30, 1e4), psf=psf, rng=1,
                       instrument=Instrument(shape=(64, 128)),
                       effects=effects).image for _ in range(2)]
    assert len(drawn) == 4
    assert_array_equal(*images)
    # Another diffusion has another light.
    simulate(one_star(30, 30, 1e4), psf=psf, rng=1,
             instrument=Instrument(shape=(64, 128)),
             effects=DetectorEffects(brighter_fatter=1.0))
    assert len(drawn) == 8


def test_a_table_of_unknown_optics_cannot_repel_charge():
    pytest.importorskip('galsim')
    psf = csst_psf((64, 64)).to_gridded_psf(oversampling=2)
    with pytest.raises(ValueError, match=r'made by Optics\.to_gridded_psf'):
        simulate(one_star(30, 30, 1e4), psf=psf, rng=1,
                 instrument=Instrument(shape=(64, 64)),
                 effects=DetectorEffects(brighter_fatter=1.0))


def test_wavelengths_count_as_the_response_of_the_band_says():
    pytest.importorskip('galsim')
    blue, red = (Optics((64, 64), Band('g', (401, 547), 0.4, 22.6,
                                       response=response), wavefront=0,
                        variation=0, jitter=1e-3, diffusion=1e-3)
                 for response in ((1, 0), (0, 1)))
    widths = [one.profile(30, 30).calculateFWHM() for one in (blue, red)]
    # A disk of diffraction is as wide as its wavelength.
    lengths = [np.dot(*one.band.colours(4)) for one in (blue, red)]
    assert_allclose(widths[1] / widths[0], lengths[1] / lengths[0], rtol=0.02)


@pytest.mark.parametrize('response', [(1.0,), (-1, 2), (0, 0)])
def test_a_response_of_nonsense_is_refused(response):
    with pytest.raises(ValueError, match='response must have two or more'):
        Band('g', (401, 547), 0.4, 22.6, response=response)
