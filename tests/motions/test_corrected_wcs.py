"""The WCS handed back contain the maps that were found."""
import copy
import io

import asdf
import astropy.units as u
import numpy as np
import pytest
from astropy import coordinates as coord
from astropy.coordinates import SkyCoord
from astropy.table import Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.motion_scenes import TIMES, make_truth, observe
from helpers.wcs import make_gwcs, tan_wcs
from photutils_mgauss import (
    Epoch,
    ProperMotionFitter,
    barycentric_observer,
    invert_wcs,
)
from photutils_mgauss.sky.wcs import pixel_to_vectors

BOX = ((-0.5, 999.5), (-0.5, 799.5))


def gwcs_epochs(rng, dec, *, rotation=0.0, frame=None, box=None, n=80,
                offset=40.0, observer=None):
    """Return two epochs of one field through wrong gwcs, and quasars."""
    x, y = rng.uniform(0, 999, n), rng.uniform(0, 799, n)
    true = make_gwcs(0.0, dec, rotation=rotation, frame=frame)
    sky = SkyCoord(*np.degrees(_angles(pixel_to_vectors(true, x, y))),
                   unit='deg')
    epochs = []
    for year in (2020.0, 2023.0):
        ra, dec_ = np.array([0.0, dec]) + rng.normal(0, offset, 2) / 3.6e6
        wcs = make_gwcs(ra, min(dec_, 90.0), rotation=rotation
                        + rng.normal(0, 1e-3), frame=frame, box=box)
        px, py = invert_wcs(wcs, sky)
        errors = np.full(n, 0.005)
        table = Table({'id': np.arange(n), 'x_fit': px + rng.normal(
            0, 0.005, n), 'y_fit': py + rng.normal(0, 0.005, n),
            'x_err': errors, 'y_err': errors})
        wcs.pixel_shape = (1000, 800)
        epochs.append(Epoch(table, wcs, year, observer=observer))
    return epochs


def _angles(vectors):
    x, y, z = vectors
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def separation(wcs, row):
    """Return the angle [mas] between a WCS's forward and aligned places."""
    got = pixel_to_vectors(wcs, row['px'], row['py'], bounded=False)
    ra, dec = (np.radians(row[name].to_value(u.deg))
               for name in ('ra', 'dec'))
    want = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra),
                     np.sin(dec)])
    away = np.sqrt(np.sum((got - want)**2, axis=0))
    return np.nanmax(away) * np.degrees(1) * 3.6e6


def aligned(solution, e):
    """Return the aligned places of epoch e with the pixels they came from."""
    rows = solution.residuals[solution.residuals['epoch'] == e]
    table = solution.epochs[e].table
    rows['px'] = np.asarray(table['x_fit'])[rows['row']]
    rows['py'] = np.asarray(table['y_fit'])[rows['row']]
    return rows[np.isfinite(rows['ra'])]


@pytest.mark.parametrize('dec', [0.0, 80.0, 89.9, 90.0])
@pytest.mark.parametrize('rotation', [0.0, 20.0, 90.0])
@pytest.mark.parametrize('transform', ['affine', 'poly-2'])
def test_a_corrected_gwcs_gives_the_aligned_places(dec, rotation, transform,
                                                   rng):
    epochs = gwcs_epochs(rng, dec, rotation=rotation, box=BOX)
    fit = ProperMotionFitter(references=np.arange(80),
                             transform=transform).fit(epochs)
    for e, epoch in enumerate(fit.epochs):
        assert separation(epoch.wcs, aligned(fit, e)) < 1e-6
    assert (fit.alignment['wcs_residual'] < 1e-6 * u.mas).all()


def test_a_corrected_gwcs_keeps_what_the_first_one_had(rng):
    epochs = gwcs_epochs(rng, 30.0, box=BOX)
    before = copy.deepcopy(epochs[0].wcs)
    wcs = ProperMotionFitter(references=np.arange(80)).fit(
        epochs).epochs[0].wcs
    assert wcs.pixel_shape == (1000, 800)
    assert wcs.bounding_box == before.bounding_box
    assert wcs.available_frames == ['detector', 'world_unaligned', 'world']
    assert wcs.output_frame.name == 'world'
    assert epochs[0].wcs.available_frames == ['detector', 'world']
    assert epochs[0].wcs(10.0, 20.0) == before(10.0, 20.0)


@pytest.mark.parametrize('transform', ['rigid', 'affine', 'poly-3'])
def test_a_corrected_gwcs_survives_asdf_and_inverts(transform, rng):
    epochs = gwcs_epochs(rng, 60.0, box=BOX, rotation=20.0)
    wcs = ProperMotionFitter(references=np.arange(80),
                             transform=transform).fit(epochs).epochs[1].wcs
    stream = io.BytesIO()
    asdf.AsdfFile({'wcs': wcs}).write_to(stream)
    stream.seek(0)
    x, y = rng.uniform(0, 790, (2, 30))
    with asdf.open(stream) as tree:
        again = tree['wcs']
        assert_allclose(again(x, y), wcs(x, y), rtol=0, atol=1e-13)
        back = again.invert(*again(x, y), with_bounding_box=False)
    assert_allclose(back, (x, y), atol=1e-6)


@pytest.mark.parametrize('frame', [coord.Galactic(), coord.FK5(),
                                   coord.FK5(equinox='J2010')])
def test_a_gwcs_of_another_frame_stays_in_it(frame, rng):
    epochs = gwcs_epochs(rng, 20.0, frame=frame, rotation=20.0)
    fit = ProperMotionFitter(references=np.arange(80)).fit(epochs)
    for e, epoch in enumerate(fit.epochs):
        assert separation(epoch.wcs, aligned(fit, e)) < 1e-6
        assert epoch.wcs.output_frame.reference_frame.name == frame.name


def test_correcting_twice_adds_a_second_step(rng):
    epochs = gwcs_epochs(rng, 30.0)
    fitter = ProperMotionFitter(references=np.arange(80))
    first = fitter.fit(epochs)
    second = fitter.fit(first.epochs)
    names = second.epochs[0].wcs.available_frames
    assert names == ['detector', 'world_unaligned', 'world_unaligned2',
                     'world']
    assert np.abs(second.alignment['shift']).max() < 0.05 * u.mas


def test_aberration_removed_is_in_the_corrected_gwcs(rng):
    observer = barycentric_observer('earth', 2020.0, velocity=True)
    epochs = gwcs_epochs(rng, 30.0, observer=observer)
    fit = ProperMotionFitter(references=np.arange(80)).fit(epochs)
    for e, epoch in enumerate(fit.epochs):
        assert separation(epoch.wcs, aligned(fit, e)) < 1e-4


@pytest.mark.parametrize('dec', [0.0, 27.0, 89.9, 90.0])
@pytest.mark.parametrize('transform', ['shift', 'affine', 'poly-3'])
def test_a_corrected_header_gives_the_aligned_places(dec, transform, rng):
    truth = make_truth(rng, n_stars=50, n_qso=100, dec=dec, ra=0.0, sigma=0.3)
    epochs = observe(truth, rng, times=TIMES[[0, 6]], edge=3.0,
                     wcs=tan_wcs(0.0, dec, rotation=20.0))
    fit = ProperMotionFitter(references='qso',
                             transform=transform).fit(epochs)
    for e, epoch in enumerate(fit.epochs):
        again = WCS(epoch.wcs.to_header(relax=True))
        assert separation(again, aligned(fit, e)) < 1e-3
        assert epoch.wcs.pixel_shape == (9000, 9000)


def test_a_header_keeps_its_distortion(rng):
    truth = make_truth(rng, n_stars=50, n_qso=100, ra=10.0)
    wcs = tan_wcs(10.0, 27.1283)
    header = wcs.to_header()
    header['CTYPE1'], header['CTYPE2'] = 'RA---TAN-SIP', 'DEC--TAN-SIP'
    header['A_ORDER'] = header['B_ORDER'] = 3
    header['A_2_0'], header['B_1_1'], header['A_0_3'] = 1e-7, -2e-7, 1e-11
    epochs = [Epoch(epoch.table, WCS(header), epoch.time) for epoch in
              observe(truth, rng, times=TIMES[[0, 6]], offset=0, wcs=wcs)]
    fit = ProperMotionFitter(references='qso').fit(epochs)
    for e, epoch in enumerate(fit.epochs):
        assert separation(epoch.wcs, aligned(fit, e)) < 1e-3
        assert epoch.wcs.wcs.radesys == 'ICRS'


def test_a_plane_tied_to_the_sky_gets_a_wcs(rng):
    truth = make_truth(rng, n_stars=50, n_qso=100, sigma=0.5)
    epochs = observe(truth, rng, times=TIMES[[0, 6]], missing=0)
    bare = Epoch(epochs[1].table, time=epochs[1].time)
    fit = ProperMotionFitter(references='qso',
                             match_by='id').fit([epochs[0], bare])
    assert separation(fit.epochs[1].wcs, aligned(fit, 1)) < 1e-3
    away = fit.epochs[1].wcs.pixel_to_world(4500, 4500).separation(
        epochs[1].wcs.pixel_to_world(4500, 4500))
    assert away < 1 * u.arcsec


def test_real_instruments_are_aligned_to_the_centroid_noise(realdata, rng):
    """Two visits, the second turned and moved, of stars on a NIRCam."""
    with asdf.open(realdata('nircam_wcs') / 'nircamwcs.asdf') as tree:
        wcs = copy.deepcopy(tree['wcs'])
    n, noise = 300, 0.01
    x, y = rng.uniform(100, 1900, (2, n))
    sky = wcs.pixel_to_world(x, y)
    centre = wcs.pixel_to_world(1000.0, 1000.0)
    frame = centre.skyoffset_frame()
    # The second visit was really 0.2 arcsec off and turned by 0.01 deg,
    # which its WCS does not know.
    c, s = np.cos(np.radians(0.01)), np.sin(np.radians(0.01))
    offset = sky.transform_to(frame)
    lon, lat = offset.lon.wrap_at('180d'), offset.lat
    moved = SkyCoord(c * lon - s * lat + 0.2 * u.arcsec,
                     s * lon + c * lat - 0.1 * u.arcsec,
                     frame=frame).icrs
    epochs = []
    for places, year in ((sky, 2023.0), (moved, 2025.0)):
        px, py = invert_wcs(wcs, places)
        table = Table({'id': np.arange(n), 'x_fit': px + rng.normal(
            0, noise, n), 'y_fit': py + rng.normal(0, noise, n),
            'x_err': np.full(n, noise), 'y_err': np.full(n, noise)})
        epochs.append(Epoch(table, wcs, year))
    fit = ProperMotionFitter(references=np.arange(n),
                             transform='rigid').fit(epochs)
    ratio = fit.residuals['dra'] / fit.residuals['dra_error']
    assert_allclose(np.sqrt(np.nanmean(ratio**2)), np.sqrt(0.5), atol=0.06)
    for e, epoch in enumerate(fit.epochs):
        assert separation(epoch.wcs, aligned(fit, e)) < 1e-6
