"""The scenes of the paper have the numbers that it prints."""
import numpy as np
import pytest
from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import kstest

from photutils_mgauss import (
    DetectorEffects,
    Instrument,
    crowded_field,
    csst_psf,
    paper_scene,
)

PIXELS = 9216 * 9232


def test_the_bulge_has_the_density_and_magnitudes_of_section_5():
    scene = paper_scene('bulge', (300, 400), rng=3)
    n = int(scene.truth['inside'].sum())
    expected = 5.4e6 / PIXELS * 120_000
    assert abs(n - expected) < 4 * np.sqrt(expected)
    mag = scene.truth['mag'].value
    assert mag.min() > 16
    assert mag.max() < 26
    many = crowded_field((1500, 1500), rng=8)['mag'].value
    assert kstest(mag, many).pvalue > 1e-3
    place = SkyCoord(scene.exposure.ra, scene.exposure.dec, unit='deg')
    ecliptic = place.transform_to(GeocentricTrueEcliptic())
    assert_allclose([ecliptic.lon.deg, ecliptic.lat.deg], [266, 5], atol=0.02)
    assert scene.exposure.detector == 8


def test_a_cut_out_of_the_pole_has_the_density_of_section_4():
    scene = paper_scene('ngp', 3000, rng=4)
    inside = scene.truth[scene.truth['inside']]
    # 614 stars and 590 quasars in a square of 11.3 arcmin.
    area = 3000**2 / (11.3 * 60 / 0.074)**2
    for kind, number in (('star', 614), ('qso', 590)):
        expected = number * area
        found = np.sum(inside['kind'] == kind)
        assert abs(found - expected) < 4 * np.sqrt(expected)
    mag = inside['mag_g'].value
    stars = inside['kind'] == 'star'
    # As the text has it, most stars are fainter than 18 mag and most
    # quasars than 20.
    assert np.mean(mag[stars] > 18) > 0.5
    assert np.mean(mag[~stars] > 20) > 0.5
    assert np.all(inside['pmra'][~stars].value == 0)
    assert np.any(inside['parallax'][stars].value > 0)


def test_the_stars_of_all_pointings_are_those_of_section_2():
    scene = paper_scene('ngp-psf', (1500, 2000), rng=5)
    degrees = 3e6 * (0.074 / 3600)**2
    expected = 135 * 1523 / 2.17 * degrees
    assert abs(len(scene.truth) - expected) < 4 * np.sqrt(expected)
    assert scene.truth['inside'].all()


@pytest.mark.parametrize(('epoch', 'time', 'detector', 'band'), [
    (1, '2024-12-12T08:07:10', 24, 'i'), (2, '2026-05-30T17:27:18', 23, 'g'),
    (7, '2028-07-21T20:02:14', 9, 'r')])
def test_epochs_are_the_rows_of_table_2(epoch, time, detector, band):
    exposure = paper_scene('ngp', 40, epoch=epoch).exposure
    assert exposure.time.utc.isot[:19] == time
    assert (exposure.detector, exposure.band.name) == (detector, band)
    assert exposure.aberration


def test_all_epochs_of_a_seed_show_the_same_sources_in_other_noise():
    first, second = (paper_scene('ngp', 400, epoch=epoch, rng=6)
                     for epoch in (1, 7))
    both = np.intersect1d(first.truth['id'], second.truth['id'])
    assert len(both) > 0.5 * len(first.truth)
    rows = [np.flatnonzero(np.isin(s.truth['id'], both))
            for s in (first, second)]
    assert_array_equal(first.truth['ra'][rows[0]],
                       second.truth['ra'][rows[1]])
    assert (first.image != second.image).mean() > 0.5
    again = paper_scene('ngp', 400, epoch=1, rng=6)
    assert_array_equal(again.image, first.image)
    other = paper_scene('ngp', 400, epoch=1, rng=7)
    assert not np.isin(other.truth['ra'], first.truth['ra']).any()


def test_a_cut_out_has_the_psf_and_the_distortion_of_the_middle():
    scene = paper_scene('bulge', (60, 80), effects=DetectorEffects())
    whole = csst_psf(rng=8)
    ny, nx = Instrument().shape
    middle = whole.mixture_at((nx - 1) / 2 + 10, (ny - 1) / 2 - 7)
    assert_allclose(
        scene.psf.mixture_at(39.5 + 10, 29.5 - 7).moments().covariance,
        middle.moments().covariance, rtol=1e-9)
    # Quadratic terms of half a pixel over a half diagonal of 6523 pixels.
    assert np.abs(scene.exposure.distortion).max() < 1e-3
    assert np.abs(scene.exposure.distortion).max() > 0


def test_effects_are_on_unless_others_are_given():
    flags = paper_scene('bulge', (200, 200)).flags
    assert flags.any()
    assert not paper_scene('bulge', (64, 64), effects=DetectorEffects(),
                           rng=2).flags.any()


@pytest.mark.parametrize(('options', 'message'), [
    ({'field': 'pole'}, 'field must be one of'),
    ({'shape': 10_000}, 'shape must be at most that of the detector'),
    ({'epoch': 8}, 'epoch must be at most 7'),
    ({'shape': 64, 'rng': -1}, 'rng must be at least 0')])
def test_a_scene_of_nonsense_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        paper_scene(**options)


@pytest.mark.parametrize('psf', ['what', 1.0, {'a': 1}])
def test_what_is_no_psf_is_refused_whatever_the_detector_does(psf):
    for effects in (None, DetectorEffects()):
        with pytest.raises(TypeError, match='psf must be a GriddedMixture'):
            paper_scene('ngp', (40, 50), psf=psf, effects=effects)
