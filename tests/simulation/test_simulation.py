"""Simulated scenes: what they must conserve, repeat and agree with."""
from concurrent.futures import ThreadPoolExecutor

import asdf
import astropy.units as u
import erfa
import numpy as np
import pytest
from astropy.coordinates import Distance, SkyCoord
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS as FITSWCS
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import PSFPhotometry

from helpers.small_camera import SMALL, one_star
from photutils_mgauss.psf.gridded import GriddedMixturePSF
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.simulation import (
    CSST_BANDS,
    Band,
    DetectorEffects,
    Exposure,
    Instrument,
    crowded_field,
    csst_psf,
    paper_exposures,
    render_stars,
    simulate,
    simulate_catalogues,
    simulate_epochs,
    sky_field,
    sparse_field,
)
from photutils_mgauss.simulation.bound import covariances

# The instrument and the bands.

def test_the_zeropoint_is_the_photons_of_3631_jansky():
    band = Band('v', (500.0, 600.0), 1.0, 22.0)
    nu = np.linspace(3e14, 7e14, 400_001) * u.Hz
    wavelength = nu.to_value(u.nm, u.spectral())
    inside = (wavelength > 500) & (wavelength < 600)
    energy = (3631 * u.Jy * (1 * u.m)**2 * np.pi).to(u.W / u.Hz)
    photons = energy * inside / nu.to(u.J, u.spectral())
    rate = np.trapezoid(photons.to_value(1 / u.s / u.Hz), nu.value)
    assert_allclose(band.rate(0), rate, rtol=1e-4)


def test_two_exposures_in_g_reach_26_3_mag_at_a_signal_to_noise_of_5():
    band, camera = CSST_BANDS['g'], Instrument()
    star = csst_psf((99, 99)).render([49.3, 49.0], [49, 49.4], [1.0, 1.0],
                                     (31, 31)).mean(axis=0)
    flux = band.rate(26.3) * 300
    noise = 2 * (camera.sky(band) + camera.dark_level
                 + camera.readout_variance)
    signal_to_noise = flux * np.sqrt((star**2 / (noise + flux * star)).sum())
    assert_allclose(signal_to_noise, 5, rtol=0.1)


@pytest.mark.parametrize('name', ['gain', 'full_well', 'pixel_scale'])
def test_an_instrument_of_nonsense_is_refused(name):
    with pytest.raises(ValueError, match=f'{name} must be greater than 0'):
        Instrument(**{name: 0})


def test_a_band_refuses_wavelengths_that_do_not_ascend():
    with pytest.raises(ValueError, match='wavelengths must be positive'):
        Band('g', (500, 400), 0.5, 22)


# The PSF field and the drawing of stars.

def test_a_stellar_image_in_g_is_0_144_arcsec_wide():
    mixture = csst_psf((2001, 2001), variation=0).mixture_at(1000, 1000)
    x = np.linspace(-3, 3, 6001)
    profile = mixture.evaluate(x, 0, pixel_integrated=True)
    width = np.ptp(x[profile > profile.max() / 2]) * 0.074
    assert_allclose(width, 0.144, rtol=0.02)


def test_the_flux_centroid_of_the_psf_is_at_the_star():
    psf = csst_psf((500, 700), 'i', variation=2)
    assert_allclose([m.moments().mean for m in psf.mixtures], 0, atol=1e-12)
    sizes = [np.trace(m.moments().covariance) for m in psf.mixtures]
    assert np.ptp(sizes) > 0.05 * np.mean(sizes)


@pytest.mark.parametrize('interpolation', ['blend', 'components'])
@pytest.mark.parametrize('integrated', [False, True])
def test_many_stars_are_the_sum_of_stars_drawn_one_by_one(
        integrated, interpolation, rng):
    nodes = csst_psf((300, 200), variation=3)
    psf = GriddedMixturePSF(nodes.mixtures, nodes.grid_xypos,
                            pixel_integrated=integrated,
                            interpolation=interpolation)
    x = rng.uniform(-20, 220, 40)
    y = rng.uniform(-20, 320, 40)
    flux = 10 ** rng.uniform(1, 6, 40)
    image = render_stars(psf, x, y, flux, (300, 200), faintest=1e-7)
    expected = sum(psf.mixture_at(a, b).render(
        (300, 200), a, b, flux=f, pixel_integrated=integrated)
        for a, b, f in zip(x, y, flux, strict=True))
    assert_allclose(image, expected, rtol=0, atol=2e-5 * image.max())


def test_a_very_thin_gaussian_is_integrated_over_pixels():
    mixture = GaussianMixture.from_stddevs([1], [[0.1, 0]], [[0.05, 0.9]],
                                           [0.6])
    psf = GriddedMixturePSF([mixture], [(0, 0)], pixel_integrated=True)
    image = render_stars(psf, [10.2], [11.4], [1e4], (20, 22))
    expected = mixture.render((20, 22), 10.2, 11.4, flux=1e4,
                              pixel_integrated=True)
    assert_allclose(image, expected, rtol=0, atol=1e-5 * expected.max())


def test_the_image_of_a_star_keeps_its_flux():
    image = render_stars(csst_psf((128, 128)), [60.3], [66.8], [1e5],
                         (128, 128))
    assert_allclose(image.sum(), 1e5, rtol=2e-5)


# The image.

def test_a_seed_gives_the_same_pixels_with_any_number_of_threads():
    camera = Instrument(shape=(400, 200))
    stars = crowded_field(camera.shape, rng=1)
    scenes = [simulate(stars, instrument=camera, rng=7)]
    for n in (1, 3):
        with ThreadPoolExecutor(n) as pool:
            scenes.append(simulate(stars, instrument=camera, rng=7,
                                   executor=pool))
    for scene in scenes[1:]:
        assert_array_equal(scene.image, scenes[0].image)
        assert_array_equal(scene.flags, scenes[0].flags)
    other = simulate(stars, instrument=camera, rng=8)
    assert (other.image != scenes[0].image).mean() > 0.5


def test_an_empty_field_has_the_moments_of_sky_dark_and_readout():
    camera = Instrument(shape=(500, 500))
    scene = simulate(one_star(-60, -60, 0), instrument=camera, rng=1)
    n = scene.image.size
    variance = (scene.background + camera.dark_level + camera.read_noise**2
                + camera.gain**2 / 12)
    mean_error = np.sqrt(variance / n)
    assert abs(scene.image.mean() - scene.background) < 4 * mean_error
    assert_allclose(scene.image.var(), variance, rtol=4 * np.sqrt(2 / n))
    assert_allclose((scene.error**2).mean(), variance, rtol=0.01)


def test_rows_and_tiles_have_noise_of_their_own():
    camera = Instrument(shape=(512, 256))
    image = simulate(one_star(-60, -60, 0), instrument=camera, rng=1).image
    image = (image - image.mean()) / image.std()
    for lag in (1, 128, 256):
        correlation = (image[lag:] * image[:-lag]).mean()
        assert abs(correlation) < 4 / np.sqrt(image.size - lag * 256)


def test_the_variance_of_a_pixel_grows_with_its_light():
    camera = Instrument(shape=(21, 21))
    star = one_star(10.2, 9.9, 2e4)
    psf, n = csst_psf((21, 21)), 200
    images = np.stack([simulate(star, instrument=camera, psf=psf, rng=i).image
                       for i in range(n)])
    expected = render_stars(psf, [10.2], [9.9], [2e4], (21, 21))
    level = expected + camera.sky(CSST_BANDS['g'])
    pulls = ((images.mean(axis=0) - level)
             / np.sqrt((level + camera.dark_level + camera.readout_variance)
                       / n))
    assert abs(pulls.std() - 1) < 0.15
    variance = level + camera.dark_level + camera.readout_variance
    assert_allclose(images.var(axis=0).sum(), variance.sum(), rtol=0.04)


def test_values_are_whole_counts():
    scene = simulate(one_star(30, 40, 1e4), instrument=SMALL, rng=1)
    counts = (scene.image + SMALL.bias + SMALL.dark_level) / SMALL.gain
    assert_allclose(counts, np.rint(counts), atol=1e-4)


def test_a_star_over_the_full_well_is_clipped_and_flagged():
    scene = simulate(one_star(150, 100, 2e6), instrument=SMALL, rng=1)
    assert scene.mask.sum() > 5
    assert scene.mask[100, 150]
    assert_allclose(scene.image[scene.mask], SMALL.full_well, rtol=5e-4)
    assert scene.image[~scene.mask].max() < SMALL.full_well + 30


def test_a_magnitude_is_the_flux_of_its_band():
    stars = QTable({'x': [50.0] * u.pix, 'y': [50.0] * u.pix,
                    'mag_g': [20.0] * u.mag, 'mag_r': [19.0] * u.mag})
    for band, mag in (('g', 20), ('r', 19)):
        scene = simulate(stars, Exposure(band=band), instrument=SMALL, rng=1)
        assert_allclose(scene.truth['flux'],
                        150 * CSST_BANDS[band].rate(mag))


def test_a_true_flux_starts_photutils_as_it_is():
    scene = simulate(one_star(50.2, 60.1, 1e5), instrument=SMALL, rng=1)
    table = PSFPhotometry(scene.psf.local_model(50, 60), 7)(
        scene.image - scene.background,
        init_params=scene.truth['x', 'y', 'flux'])
    assert_allclose(table['flux_fit'], 1e5, rtol=0.02)


def test_sources_without_brightness_are_refused():
    stars = one_star(1, 2, 3)
    stars.remove_column('flux')
    with pytest.raises(ValueError, match="'flux', 'mag_g' or 'mag'"):
        simulate(stars, instrument=SMALL, rng=1)


def test_nddata_has_the_arrays_and_the_wcs():
    scene = simulate(one_star(30, 40, 1e4), instrument=SMALL, rng=1)
    data = scene.to_nddata()
    assert data.unit == u.electron
    assert_array_equal(data.data, scene.image)
    assert_array_equal(data.uncertainty.array, scene.error)
    assert data.wcs.low_level_wcs is scene.wcs


# Fields of stars.

def test_stars_of_a_sparse_field_are_apart():
    stars = sparse_field((500, 400), rng=3)
    x, y = stars['x'].value, stars['y'].value
    gaps = np.hypot(x - x[:, None], y - y[:, None])
    assert gaps[~np.eye(len(x), dtype=bool)].min() >= 23
    assert (x > 0).all()
    assert (x < 400).all()
    assert (y < 500).all()


def test_the_crowded_field_has_the_density_and_luminosity_function_stated():
    stars = crowded_field((800, 800), rng=1)
    assert_allclose(len(stars), 5.4e6 / (9216 * 9232) * 848**2, rtol=0.02)
    mag = stars['mag'].value
    assert mag.min() > 16
    assert mag.max() < 26
    counts = np.histogram(mag, [22, 23, 24, 25, 26])[0]
    assert_allclose(np.diff(np.log10(counts)), 0.2, atol=0.02)


def test_quasars_do_not_move():
    sources = sky_field(50, 40, rng=1)
    qsos = sources[sources['kind'] == 'qso']
    assert len(qsos) == 40
    for name in ('pmra', 'pmdec', 'parallax'):
        assert not qsos[name].value.any()
        assert sources[name][sources['kind'] == 'star'].value.all()
    far = sky_field(50, 40, rng=1, parallaxes=False)
    assert not far['parallax'].value.any()


def test_sources_keep_the_separation_asked_for():
    sources = sky_field(60, 0, size=1, separation=3.0, rng=1)
    places = SkyCoord(sources['ra'], sources['dec'])
    assert places.match_to_catalog_sky(places, 2)[1].min() > 2.999 * u.arcsec
    with pytest.raises(ValueError, match='separation must leave room'):
        sky_field(60, 0, size=0.2, separation=3.0, rng=1)


# Motion, pointing and distortion.

def moving_star(ra=80.0, dec=-65.0):
    return QTable({'ra': [ra] * u.deg, 'dec': [dec] * u.deg,
                   'pmra': [2500.0] * u.mas / u.yr,
                   'pmdec': [-1800.0] * u.mas / u.yr,
                   'parallax': [250.0] * u.mas, 'ref_epoch': [2016.0] * u.yr,
                   'mag': [15.0] * u.mag})


@pytest.mark.parametrize(('ra', 'dec'), [(80, -65), (359.9999, 27),
                                         (10, 89.99)])
def test_a_star_moves_as_erfa_says(ra, dec):
    star = moving_star(ra, dec)
    exposure = Exposure('2026-05-30T17:27:18', ra=ra, dec=dec)
    x, y = exposure.pixels(star, (401, 401), 0.074)
    seen = exposure.wcs((401, 401), 0.074)(x, y, with_bounding_box=False)
    years = exposure.time.tdb.jyear - 2016
    pmra = 2500 / np.cos(np.radians(dec)) * 1e-3 * erfa.DAS2R
    earth = erfa.epv00(exposure.time.tdb.jd1, exposure.time.tdb.jd2)[1][0]
    expected = erfa.pmpx(np.radians(ra), np.radians(dec), pmra,
                         -1.8 * erfa.DAS2R, 0.25, 0.0, years, earth)
    lon, lat = np.radians(np.ravel(seen))
    assert erfa.sepp(erfa.s2c(lon, lat), expected) < 1e-12


def test_parallax_and_motion_agree_with_skycoord():
    star = moving_star()
    time = Time(2031.3, format='jyear', scale='tdb')
    exposure = Exposure(time, ra=80.0, dec=-65.0)
    x, y = exposure.pixels(star, (401, 401), 0.074)
    seen = SkyCoord(*exposure.wcs((401, 401), 0.074)(
        x, y, with_bounding_box=False), unit='deg')
    here = SkyCoord(80 * u.deg, -65 * u.deg, Distance(parallax=250 * u.mas),
                    pm_ra_cosdec=2500 * u.mas / u.yr,
                    pm_dec=-1800 * u.mas / u.yr,
                    radial_velocity=0 * u.km / u.s,
                    obstime=Time(2016, format='jyear', scale='tdb'))
    there = here.apply_space_motion(time).cartesian.xyz.to(u.au)
    earth = erfa.epv00(time.jd1, time.jd2)[1][0] * u.au
    apparent = SkyCoord(*(there - earth), representation_type='cartesian')
    # The light takes up to eight minutes more or less, 0.05 mas here.
    assert apparent.separation(seen[0]) < 0.06 * u.mas


def test_aberration_changes_the_scale_by_the_speed_of_the_earth():
    sources = sky_field(40, 0, size=11, rng=1, parallaxes=False)
    plain = Exposure('2026-05-30T17:27:18')
    seen = Exposure('2026-05-30T17:27:18', aberration=True)
    shape = (9000, 9000)
    x = np.stack([e.pixels(sources, shape, 0.074) for e in (plain, seen)])
    vectors = [erfa.s2c(*np.radians([s['ra'].value, s['dec'].value]))
               for s in sources[:2]]
    _, velocity = erfa.epv00(plain.time.tdb.jd1, plain.time.tdb.jd2)[1]
    beta = velocity * erfa.DAU / erfa.DAYSEC / erfa.CMPS
    inverse = np.sqrt(1 - beta @ beta)
    moved = [erfa.ab(v, beta, 1.0, inverse) for v in vectors]
    true = erfa.sepp(*moved) / erfa.sepp(*vectors)
    gaps = np.hypot(*(x[:, :, 0] - x[:, :, 1]).T)
    assert abs(true - 1) > 1e-6
    assert_allclose(gaps[1] / gaps[0] - 1, true - 1, atol=2e-8)
    assert np.abs(x[1] - x[0]).max() < 1.5


@pytest.mark.parametrize('dec', [0.0, 80.0, 89.99, 90.0])
@pytest.mark.parametrize('rotation', [0.0, 20.0, 90.0, 200.0])
def test_pixels_and_wcs_are_inverse_to_each_other(dec, rotation, rng):
    cubic = np.add(*np.indices((4, 4))) <= 3
    distortion = 0.5 * rng.standard_normal((2, 4, 4)) * cubic
    exposure = Exposure(ra=0.0, dec=dec, rotation=rotation, scale=1.0003,
                        distortion=distortion)
    wcs = exposure.wcs((900, 1000), 0.074)
    x, y = rng.uniform(0, 900, (2, 50))
    ra, dec = wcs(x, y)
    sources = QTable({'ra': ra * u.deg, 'dec': dec * u.deg})
    assert_allclose(exposure.pixels(sources, (900, 1000), 0.074), [x, y],
                    atol=1e-7)
    assert_allclose(wcs.invert(ra, dec, with_bounding_box=False), [x, y],
                    atol=1e-5)


def test_the_epochs_of_the_paper_are_those_of_its_table():
    exposures = paper_exposures(rng=1)
    assert [e.detector for e in exposures] == [24, 23, 8, 7, 24, 22, 9]
    assert [e.time.utc.isot[:10] for e in exposures][::6] == [
        '2024-12-12', '2028-07-21']
    assert len({e.rotation for e in exposures}) == 7


def test_every_epoch_shows_the_stars_where_its_wcs_says():
    sources = sky_field(25, 15, size=0.35, separation=2, rng=1,
                        magnitudes=(19, 20))
    camera = Instrument(shape=(340, 320))
    for scene in simulate_epochs(sources, paper_exposures(rng=3)[::3],
                                 instrument=camera, rng=4):
        inner = scene.truth[scene.truth['inside']]
        x, y = inner['x'].value, inner['y'].value
        used = np.abs(x - 160) < 150
        used &= np.abs(y - 170) < 160
        for a, b in zip(x[used], y[used], strict=True):
            i, j = round(a), round(b)
            stamp = (scene.image[j - 3:j + 4, i - 3:i + 4]
                     - scene.background).astype(float)
            weights = np.hypot(*np.mgrid[-3:4, -3:4]) < 3.4
            total = (stamp * weights).sum()
            dx = (stamp * weights * np.arange(-3, 4)).sum() / total
            dy = (stamp * weights * np.arange(-3, 4)[:, None]).sum() / total
            assert np.hypot(i + dx - a, j + dy - b) < 0.35


def test_a_distortion_of_higher_order_is_refused():
    distortion = np.zeros((2, 4, 4))
    distortion[0, 3, 1] = 1
    with pytest.raises(ValueError, match='distortion must be a cubic'):
        Exposure(distortion=distortion)


def test_a_time_that_is_none_is_named():
    with pytest.raises(ValueError, match=r"Time or a date, got 'yesterday'$"):
        Exposure('yesterday')


# Files.

@pytest.fixture(scope='module')
def small_scene():
    sources = sky_field(20, 10, size=0.3, rng=1, magnitudes=(18, 22))
    return simulate(sources, paper_exposures()[1], rng=2,
                    instrument=Instrument(shape=(240, 250)),
                    effects=DetectorEffects.typical())


def test_a_scene_is_read_back_from_extensions(small_scene, tmp_path):
    paths = small_scene.write(tmp_path / 'a.fits')
    assert [p.name for p in paths] == ['a.fits', 'a_truth.ecsv', 'a_wcs.asdf']
    with fits.open(paths[0]) as hdus:
        assert_array_equal(hdus['SCI'].data, small_scene.image)
        assert_array_equal(hdus['ERR'].data, small_scene.error)
        assert_array_equal(hdus['DQ'].data, small_scene.flags)
        header = hdus['SCI'].header
    truth = QTable.read(paths[1])
    assert_allclose(truth['x'].value, small_scene.truth['x'].value)
    assert truth['pmra'].unit == u.mas / u.yr
    assert truth['flux'].unit == header['BUNIT'] == u.electron
    x, y = truth['x'].value, truth['y'].value
    ra, dec = small_scene.wcs(x, y, with_bounding_box=False)
    with asdf.open(paths[2]) as file:
        assert_allclose(file['wcs'](x, y, with_bounding_box=False),
                        [ra, dec], rtol=0, atol=1e-13)
    assert_allclose(FITSWCS(header).all_pix2world(x, y, 0), [ra, dec],
                    rtol=0, atol=1e-3 / 3.6e6)


def test_a_scene_is_read_back_from_the_csst_layout(small_scene, tmp_path):
    paths = small_scene.write(tmp_path / 'b', layout='csst')
    assert [p.name for p in paths[:3]] == ['b.fits', 'b_flg.fits',
                                           'b_wht.fits']
    image, flags, weight = (fits.getdata(p) for p in paths[:3])
    assert_allclose(image * 150, small_scene.image, rtol=1e-6)
    assert_array_equal(flags, small_scene.flags)
    good = ~small_scene.mask
    assert_allclose(weight[good]**-0.5 * 150, small_scene.error[good],
                    rtol=1e-5)
    assert not weight[~good].any()
    assert fits.getheader(paths[0])['BUNIT'] == 'electron / s'


def test_files_are_not_overwritten_unasked(small_scene, tmp_path):
    small_scene.write(tmp_path / 'c')
    with pytest.raises(FileExistsError, match='overwrite'):
        small_scene.write(tmp_path / 'c')
    small_scene.write(tmp_path / 'c', overwrite=True)
    with pytest.raises(ValueError, match='layout must be one of'):
        small_scene.write(tmp_path / 'd', layout='fits')


# Catalogues at the bound.

def test_errors_of_a_bound_catalogue_are_those_of_the_fisher_matrix():
    psf = csst_psf((200, 200))
    model = psf.copy()
    y, x = np.mgrid[84:115, 84:115].astype(float)
    value, by_x, by_y = model.fit_deriv(x, y, 3000.0, 99.7, 99.2)
    inverse_variance = 1 / (50.0 + 3000 * value)
    jacobian = np.stack([by_x, by_y, value]).reshape(3, -1)
    fisher = (jacobian * inverse_variance.ravel()) @ jacobian.T
    bound = covariances(psf, np.array([99.7]), np.array([99.2]),
                        np.array([3000.0]), 50.0, None)[0]
    assert_allclose(bound, np.linalg.inv(fisher), rtol=0.01, atol=1e-5)


def test_catalogues_scatter_as_their_errors_say():
    sources = sky_field(300, 0, size=2, rng=1, magnitudes=(19, 26))
    camera = Instrument(shape=(1500, 1500))
    catalogue, = simulate_catalogues(sources, [Exposure()], rng=2,
                                     instrument=camera)
    table, truth = catalogue.table, catalogue.truth
    assert len(table) < 300
    assert (table['flux_fit'] / table['flux_err']).min() > 2
    for name in ('x', 'y', 'flux'):
        pulls = ((table[f'{name}_fit'] - truth[name])
                 / table[f'{name}_err']).value
        assert abs(pulls.std() - 1) < 4 / np.sqrt(2 * len(pulls))
        assert abs(pulls.mean()) < 4 / np.sqrt(len(pulls))
    assert_array_equal(table['id'], truth['id'])


def test_every_exposure_needs_its_psf():
    with pytest.raises(ValueError, match='psfs must have one element'):
        simulate_epochs(sky_field(1, 0, rng=1), paper_exposures()[:2],
                        psfs=[None], rng=1)


def test_the_header_is_the_wcs_with_any_cubic(rng):
    cubic = np.add(*np.indices((4, 4))) <= 3
    exposure = Exposure(ra=0.001, dec=-80.0, rotation=33.0, scale=0.999,
                        distortion=rng.standard_normal((2, 4, 4)) * cubic)
    x, y = rng.uniform(0, 700, (2, 100))
    header = FITSWCS(exposure.fits_header((700, 800), 0.074))
    expected = exposure.wcs((700, 800), 0.074)(x, y)
    assert_allclose(header.all_pix2world(x, y, 0), expected, rtol=0,
                    atol=1e-11)
