"""The command that measures motions in the pixels of all images."""
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from photutils_mgauss import (
    Epoch,
    ImageEpoch,
    Instrument,
    PixelMotionFitter,
    ProperMotionFitter,
    paper_exposures,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.cli import main
from photutils_mgauss.cli.motions import wcs_writer
from photutils_mgauss.cli.psf_files import read_psf, write_psf
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.files.image_layers import read_wcs
from photutils_mgauss.motions.frame_errors import FrameErrors
from photutils_mgauss.sky.tangent_plane import TangentPlane
from photutils_mgauss.sky.transforms import Transform

NIGHTS = ('night1', 'night2', 'night3')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Write three exposures, their PSFs and their stars."""
    out = tmp_path_factory.mktemp('pixels')
    sources = sky_field(12, 4, size=0.15, magnitudes=(21, 23),
                        parallaxes=False, separation=1.0, rng=5)
    scenes = simulate_epochs(sources, paper_exposures()[1::2], rng=6,
                             instrument=Instrument(shape=(200, 200)))
    for name, scene in zip(NIGHTS, scenes, strict=True):
        scene.write(out / f'{name}.fits')
        write_psf(scene.psf, out / f'{name}_psf.fits', {})
    sources.write(out / 'truth.ecsv')
    return out


def run(folder, *more):
    return main(['motions', '--pixels',
                 *(str(folder / f'{name}.fits') for name in NIGHTS),
                 '--psf', *(str(folder / f'{name}_psf.fits')
                            for name in NIGHTS),
                 '--wcs', *(str(folder / f'{name}_wcs.asdf')
                            for name in NIGHTS), *map(str, more)])


def test_images_become_motions_and_light_curves(folder):
    out = folder / 'deep'
    assert run(folder, '--output', out) in (0, None)
    stars, true = (QTable.read(path) for path in (
        out / 'motions.ecsv', folder / 'truth.ecsv'))
    index, away, _ = SkyCoord(stars['ra'], stars['dec']).match_to_catalog_sky(
        SkyCoord(true['ra'], true['dec']))
    near = away.arcsec < 0.1
    assert len(np.unique(index[near])) >= 15
    pull = ((stars['pmra'] - true['pmra'][index]) / stars['pmra_error'])[near]
    assert np.abs(pull).max() < 4.5
    curves = QTable.read(out / 'light_curves.ecsv')
    assert len(curves) == stars['n_images'].sum()
    assert len(QTable.read(out / 'images.ecsv')) == 3
    strip = QTable.read(out / 'cutouts.ecsv')
    assert strip['residual'].shape[1:] == (15, 15)
    assert strip.meta['SIGNIF'] == stars['significance'][
        stars['flags'] == 0].min()


def test_the_page_shows_a_faint_star_and_the_gain(folder):
    pytest.importorskip('matplotlib')
    frames, out = folder / 'frames', folder / 'gain'
    frames.mkdir()
    before = QTable.read(folder / 'truth.ecsv')['ra', 'dec', 'pmra']
    before['pmra_error'] = np.where(np.arange(len(before)) < 5, 0.5,
                                    np.nan) * before['pmra'].unit
    before.write(frames / 'motions.ecsv')
    for name in NIGHTS:
        (frames / f'{name}_wcs.asdf').write_bytes(
            (folder / f'{name}_wcs.asdf').read_bytes())
    assert run(folder, '--output', out, '--frames', frames,
               '--refine-frames') in (0, None)
    page = folder / 'page.html'
    assert main(['report', str(out), '--output', str(page)]) in (0, None)
    words = page.read_text()
    assert 'A faint star' in words
    assert 'With proper motions from catalogues' in words
    stars = QTable.read(out / 'motions.ecsv')
    gain = stars.meta['mgauss']['catalogues']
    assert gain['motions'] == 5
    assert gain['both'] == 5
    assert gain['median_error_catalogues'] == 0.5
    assert 0 < gain['median_error_pixels'] < 20


def frames_of(folder):
    """Return frames of poor measurements, and write them to a folder."""
    true = QTable.read(folder / 'truth.ecsv')
    rng, epochs = np.random.default_rng(3), []
    for name, exposure in zip(NIGHTS, paper_exposures()[1::2], strict=True):
        wcs = read_wcs(folder / f'{name}_wcs.asdf')
        table = QTable({'id': true['id']})
        for axis, place in zip('xy', wcs.world_to_pixel(
                SkyCoord(true['ra'], true['dec'])), strict=True):
            table[f'{axis}_fit'] = place + rng.normal(0, 0.05, len(true))
            table[f'{axis}_err'] = np.full(len(true), 0.05)
        epochs.append(Epoch(table, wcs, exposure.time))
    solution = ProperMotionFitter(transform='shift', systematic=None,
                                  match_by='id').fit(epochs)
    out = folder / 'poor'
    out.mkdir()
    for name, epoch in zip(NIGHTS, solution.epochs, strict=True):
        suffix, write = wcs_writer(epoch.wcs, epoch.mean_year, {})
        write((out / f'{name}_wcs').with_suffix(suffix))
    FrameErrors.of(solution).to_table().write(out / 'frame_errors.ecsv')
    return solution, out


def test_errors_of_frames_are_in_those_of_stars(folder, capsys):
    solution, frames = frames_of(folder)
    command = ['motions', '--pixels', *(str(folder / f'{name}.fits')
                                        for name in NIGHTS),
               '--psf', *(str(folder / f'{name}_psf.fits')
                          for name in NIGHTS),
               '--targets', str(folder / 'truth.ecsv'),
               '--frames', str(frames), '--output']
    assert main([*command, str(folder / 'known')]) in (0, None)
    assert 'exact' not in capsys.readouterr().out
    (frames / 'frame_errors.ecsv').unlink()
    assert main([*command, str(folder / 'exact')]) in (0, None)
    assert 'the frames count as exact' in capsys.readouterr().out
    known, exact = (QTable.read(folder / name / 'motions.ecsv')
                    for name in ('known', 'exact'))
    images = []
    for name, exposure, epoch in zip(NIGHTS, paper_exposures()[1::2],
                                     solution.epochs, strict=True):
        seen = read_image(folder / f'{name}.fits', Reading())
        images.append(ImageEpoch(
            seen.without_sky * seen.unit, read_psf(
                folder / f'{name}_psf.fits'), epoch.wcs, exposure.time,
            mask=seen.mask, error=seen.noise.background * seen.unit))
    stars = QTable.read(folder / 'truth.ecsv')
    expected = PixelMotionFitter(references=solution).fit(images, stars).stars
    for name in ('pmra_error', 'dec_error'):
        assert_allclose(known[name].value, expected[name].value, rtol=1e-3)
        assert (known[name] > exact[name]).all()


def test_errors_of_frames_are_kept_in_tables(folder, tmp_path):
    solution = FrameErrors(
        np.array([2024.5, 2026.0]), np.random.default_rng(1).normal(
            size=(2, 2, 3, 4)), TangentPlane(12.5, -3.0),
        Transform('affine', 1, (3.0, 4.0), 1e5), relative=True)
    for name in ('a.ecsv', 'a.fits'):
        solution.to_table().write(tmp_path / name)
        again = FrameErrors.from_table(QTable.read(tmp_path / name))
        assert_array_equal(again.factor, solution.factor)
        assert_array_equal(again.years, solution.years)
        assert again.plane == solution.plane
        assert again.relative
        points = np.array([[1e4, 2.0], [3.0, -5e4]])
        assert_allclose(again.transform.basis(points),
                        solution.transform.basis(points))


def test_places_given_are_kept_and_results_too(folder):
    out, kept = folder / 'forced', folder / 'kept'
    options = ('--targets', folder / 'truth.ecsv', '--forced', '--output',
               out, '--checkpoint', kept)
    assert run(folder, *options) in (0, None)
    stars, true = (QTable.read(path) for path in (
        out / 'motions.ecsv', folder / 'truth.ecsv'))
    assert np.abs((stars['pmra'] - true['pmra']).value).max() < 1e-5
    before = {path: path.stat().st_mtime_ns for path in kept.iterdir()}
    assert run(folder, *options) in (0, None)
    assert before == {path: path.stat().st_mtime_ns for path in
                      kept.iterdir()}


@pytest.mark.parametrize(('options', 'words'), [
    (['--forced'], '--targets'),
    (['--forced', '--targets', 'x.ecsv', '--refine-frames'], 'without'),
    (['--frames', 'nowhere'], '--frames'),
    (['--plane'], '--plane'), (['--targets', 'nowhere.ecsv'], 'nowhere')])
def test_wrong_options_are_told(folder, options, words, capsys):
    try:
        code = run(folder, '--output', folder / 'wrong', *options)
    except SystemExit as stop:
        code = stop.code
    assert code not in (0, None)
    assert words in capsys.readouterr().err
    assert not (folder / 'wrong').exists()


def test_options_of_pixels_alone_are_told(folder, capsys):
    try:
        code = main(['motions', str(folder / 'night1.fits'), '--psf', 'x'])
    except SystemExit as stop:
        code = stop.code
    assert code not in (0, None)
    assert '--pixels' in capsys.readouterr().err
