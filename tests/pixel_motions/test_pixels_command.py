"""The command that measures motions in the pixels of all images."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.testing import assert_allclose, assert_array_equal

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    Epoch,
    GaussianMixture,
    GriddedMixturePSF,
    ImageEpoch,
    Instrument,
    PixelMotionFitter,
    ProperMotionFitter,
    paper_exposures,
    render_stars,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.cli import main
from photutils_mgauss.cli.motions import wcs_writer
from photutils_mgauss.cli.psf_files import read_psf, write_psf
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.files.image_layers import read_wcs
from photutils_mgauss.motions.frame_errors import FrameErrors
from photutils_mgauss.pixel_motions.errors import add_frame_errors
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.fixture(scope='module')
def crowd(tmp_path_factory):
    """Write three exposures of stars that overlap, and their PSF."""
    out = tmp_path_factory.mktemp('crowd')
    rng = np.random.default_rng(8)
    psf = GriddedMixturePSF([GaussianMixture.from_stddevs(
        [0.7, 0.3], [(0, 0), (0, 0)], [(0.8, 0.85), (1.6, 1.7)])], [(0, 0)])
    write_psf(psf, out / 'psf.fits', {})
    places = rng.uniform(2, 125, (2, 250))
    motion = rng.normal(0, 0.05, (2, 250))
    flux = 10**rng.uniform(3.2, 4.4, 250)
    for name, year in zip(NIGHTS, (-2.0, 0.5, 2.0), strict=True):
        wcs = WCS(naxis=2)
        wcs.wcs.ctype, wcs.wcs.crval = ('RA---TAN', 'DEC--TAN'), (30.0, 5.0)
        wcs.wcs.crpix, wcs.wcs.cdelt = (64, 64), (-2e-5, 2e-5)
        light = 30 + render_stars(psf, *(places + year * motion), flux,
                                  (128, 128))
        error = np.sqrt(light)
        header = wcs.to_header()
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(
            rng.normal(light, error), header, name='SCI'),
            fits.ImageHDU(error, name='ERR')]).writeto(out / f'{name}.fits')
    sky = wcs.pixel_to_world(*places)
    QTable({'ra': sky.ra, 'dec': sky.dec, 'flux': flux,
            # A pixel is 72 mas, and columns run against right ascension.
            'pmra': -72 * motion[0] * u.mas / u.yr,
            'pmdec': 72 * motion[1] * u.mas / u.yr}).write(
                out / 'truth.ecsv')
    return out


def run_crowded(folder, *more):
    return main(['motions', '--pixels', '--crowded',
                 *(str(folder / f'{name}.fits') for name in NIGHTS), '--time',
                 '2026.0', '2028.5', '2030.0', *map(str, more)])


def test_stars_that_overlap_get_motions(crowd):
    out = crowd / 'out'
    assert run_crowded(crowd, '--psf', crowd / 'psf.fits', '--output',
                       out) in (0, None)
    assert [path.name for path in out.iterdir()] == ['motions.ecsv']
    stars, true = (QTable.read(path) for path in (
        out / 'motions.ecsv', crowd / 'truth.ecsv'))
    index, away, _ = SkyCoord(true['ra'], true['dec']).match_to_catalog_sky(
        SkyCoord(stars['ra'], stars['dec']))
    good = (away.arcsec < 0.04) & (true['flux'] > 5000)
    assert good.sum() > 80
    for name in ('pmra', 'pmdec'):
        pull = ((stars[name][index] - true[name])
                / stars[f'{name}_error'][index])[good]
        assert 0.6 < 1.48 * np.nanmedian(np.abs(pull)) < 1.4
    assert stars['flux'].shape == (len(stars), 3)
    images = []
    for name, year in zip(NIGHTS, (2026.0, 2028.5, 2030.0), strict=True):
        seen = read_image(crowd / f'{name}.fits', Reading())
        images.append(ImageEpoch(
            seen.data, read_psf(crowd / 'psf.fits'), seen.wcs, year,
            error=seen.noise.total, mask=seen.mask))
    expected = CrowdedMixturePhotometry(None).fit_images(images, motions=True)
    assert_allclose(stars['pmra'].value, expected['pmra'].value)


def test_a_crowd_needs_no_psf_and_takes_targets(crowd, monkeypatch):
    asked, out = [], crowd / 'targets'

    def own_psf(image, _):
        asked.append(image.path.stem)
        return read_psf(crowd / 'psf.fits')
    # It takes minutes, and has tests of its own.
    monkeypatch.setattr('photutils_mgauss.cli.photometry.own_psf', own_psf)
    assert run_crowded(crowd, '--output', out, '--dry-run') in (0, None)
    assert not out.exists()
    assert not asked
    assert run_crowded(crowd, '--output', out, '--targets',
                       crowd / 'truth.ecsv', '--band', 'g') in (0, None)
    stars, true = (QTable.read(path) for path in (
        out / 'motions.ecsv', crowd / 'truth.ecsv'))
    assert asked == list(NIGHTS)
    assert len(stars) == len(true)
    bright = true['flux'] > 10000
    assert np.nanmedian(np.abs((stars['pmra'] - true['pmra'])[bright])) < (
        1 * u.mas / u.yr)


def test_errors_of_frames_are_in_those_of_a_crowd():
    years = np.array([2026.0, 2028.5, 2030.0])
    # Shifts of each image, known to 0.4 mas east and 0.3 mas north.
    factor = np.zeros((3, 2, 1, 6))
    for k in range(3):
        factor[k, 0, 0, 2 * k], factor[k, 1, 0, 2 * k + 1] = 0.4, 0.3
    known = FrameErrors(years, factor, TangentPlane(30.0, 5.0), Transform(
        'polynomial', 0, (0.0, 0.0), 1e5), relative=False)
    table = QTable({'ra': [30.0] * u.deg, 'dec': [5.0] * u.deg,
                    'flux': [[100.0, 400.0, 200.0]],
                    'flux_err': [[10.0, 20.0, 20.0]],
                    'ref_epoch': [years.mean()] * u.yr})
    for name in ('ra', 'dec', 'pmra', 'pmdec'):
        table[f'{name}_error'] = [0.2] * (
            u.mas / u.yr if 'pm' in name else u.mas)
    table['radec_cov'], table['pmra_pmdec_corr'] = [0.01] * u.mas**2, [0.5]
    add_frame_errors(table, known, years)
    # A straight line through three points of weights 100, 400 and 100.
    weight = np.diag([100.0, 400.0, 100.0])
    design = np.column_stack([np.ones(3), years - years.mean()])
    answer = np.linalg.inv(design.T @ weight @ design) @ design.T @ weight
    place, motion = np.sum(answer**2, axis=1)
    for name, more in (('ra', 0.16 * place), ('dec', 0.09 * place),
                       ('pmra', 0.16 * motion), ('pmdec', 0.09 * motion)):
        assert_allclose(table[f'{name}_error'].value,
                        np.sqrt(0.04 + more), rtol=1e-9)
    assert_allclose(table['radec_cov'].value, 0.01)
    assert_allclose(table['pmra_pmdec_corr'], 0.02 / (
        table['pmra_error'] * table['pmdec_error']).value)


@pytest.mark.parametrize('option', ['--forced', '--refine-frames',
                                    '--parallax'])
def test_what_crowds_do_not_know_is_told(crowd, option, capsys):
    try:
        code = run_crowded(crowd, '--output', crowd / 'wrong', option)
    except SystemExit as stop:
        code = stop.code
    assert code not in (0, None)
    assert option in capsys.readouterr().err


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
