"""Grids of mixtures from everything that photutils and PSFEx hand over."""
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import EPSFBuilder, EPSFStar, EPSFStars, ImagePSF
from scipy.ndimage import uniform_filter
from scipy.special import j1

from helpers.psf_grids import (
    PLACES,
    PlainGrid,
    assert_is_truth,
    epsf_grid,
    truth_at,
)
from helpers.psfex_models import MODELS, X, Y, write_model
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    fit_mixture,
    read_psfex,
)
from photutils_mgauss.fitting import grid as fitting_grid

# Positions of stars as narrow as most of these change with the pixel phase.
pytestmark = pytest.mark.filterwarnings(
    'ignore:positions measured with these mixtures')


def test_the_mixtures_of_an_epsf_grid_and_its_flux_scale_come_back():
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid(), 2)
    assert_is_truth(psf, rtol=1e-6)
    assert_array_equal(psf.grid_xypos, PLACES)


def test_the_report_tells_that_an_exact_fit_is_exact():
    report = GriddedMixturePSF.from_gridded_psf(epsf_grid(), 2).report
    assert isinstance(report, QTable)
    assert len(report) == 9
    for name in ('chi2', 'size_error', 'ellipticity_error', 'phase_error'):
        assert np.abs(report[name]).max() < 1e-5
    assert (report['n_components'] == 2).all()
    assert_allclose(report['enclosed_flux'], 1, atol=0.05)
    assert (report['status'] == 0).all()
    assert not report['bridged'].any()


def test_the_report_tells_what_too_few_gaussians_cost():
    truth = GaussianMixture.from_stddevs(
        [0.6, 0.4], [[0, 0], [0.1, 0]], [[0.45, 0.5], [1, 1]], [0, 0])
    steps = np.arange(-40, 41) / 4
    image = ImagePSF(truth.evaluate(steps, steps[:, None]), oversampling=4)
    with (pytest.warns(AstropyUserWarning, match='fluxes measured with these'),
          pytest.warns(AstropyUserWarning, match='positions measured with '
                       '.*by up to 0.0.*of 1 nodes.*astrometric')):
        psf = GriddedMixturePSF.from_image_psf(image, 1)
    mixture, scale = psf.mixtures[0], psf.scales[0]
    # The pixel-phase error by hand: stars of the truth, measured with the
    # mixture.
    pixels = np.arange(-5.0, 6)
    shifts = []
    for phase in np.arange(4) / 4:
        x, y = np.meshgrid(pixels + phase, pixels)
        inside = np.hypot(x, y) <= 5.5
        design = scale * np.stack([
            mixture.evaluate(x, y),
            *np.moveaxis(-mixture.gradient(x, y), -1, 0)])[:, inside]
        shifts.append(np.linalg.lstsq(
            design.T, truth.evaluate(x, y)[inside] - design[0],
            rcond=None)[0][1])
    assert np.ptp(shifts) > 0.01
    assert_allclose(psf.report['phase_error'], np.ptp(shifts) / 2, rtol=0.3)
    # That of the flux of a faint star, in 5 x 5 pixels around the star.
    fluxes = []
    pixels = np.arange(-2.0, 3)
    for i, j in np.ndindex(8, 8):
        phase = np.array([i, j]) / 8 - 0.5
        x, y = np.meshgrid(pixels + phase[0], pixels + phase[1])
        design = np.stack([mixture.evaluate(x, y),
                           *np.moveaxis(mixture.gradient(x, y), -1, 0)])
        fluxes.append(np.linalg.lstsq(
            design.reshape(3, -1).T, truth.evaluate(x, y).ravel(),
            rcond=None)[0][0])
    faint = np.std(fluxes) / np.mean(fluxes)
    assert faint > 0.003
    assert_allclose(psf.report['flux_phase_error'], faint, rtol=0.05)


def airy_grid(fwhm, obscuration, oversampling=4, fine=20, half=11):
    """Return a grid of Airy patterns integrated over square pixels."""
    n = (half + 1) * fine
    steps = np.arange(-n, n + 1) / fine
    r = np.pi * np.hypot(*np.meshgrid(steps, steps)) / (fwhm / 1.029) + 1e-9
    light = (2 * j1(r) / r - obscuration * 2 * j1(obscuration * r) / r) ** 2
    pixel = (uniform_filter(light, fine)
             + uniform_filter(light, fine + 1)) / 2
    cut = slice(fine, -fine, fine // oversampling)
    image = pixel[cut, cut] * oversampling**2 / pixel[cut, cut].sum()
    return PlainGrid(image[None], {'grid_xypos': [(0, 0)],
                                   'oversampling': oversampling})


@pytest.mark.long
@pytest.mark.parametrize(('fwhm', 'obscuration'), [(1.0, 0.0), (1.25, 0.3)])
def test_defaults_keep_the_fluxes_of_undersampled_airy_patterns(
        fwhm, obscuration):
    psf = GriddedMixturePSF.from_gridded_psf(airy_grid(fwhm, obscuration))
    assert psf.n_components > 3
    assert psf.report['flux_phase_error'][0] < 0.003


def test_the_default_stays_at_three_where_three_do():
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid())
    three = GriddedMixturePSF.from_gridded_psf(epsf_grid(), 3)
    assert psf.n_components == 3
    assert psf.mixtures == three.mixtures


def test_blank_nodes_are_bridged_and_reported():
    def blank(data):
        data[4] = 0
        data[0] = np.nan
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid(blank), 2)
    report = psf.report
    assert list(np.flatnonzero(report['bridged'])) == [0, 4]
    assert list(np.flatnonzero(report['status'])) == [0, 4]
    assert 'no positive flux' in report['message'][4]
    assert_is_truth(psf, nodes=[1, 2, 3, 5, 6, 7, 8], rtol=1e-5)
    # A bridge over smooth changes is not far off; a corner has neighbours on
    # one side only.
    assert_is_truth(psf, nodes=[4], rtol=0.03)
    assert_is_truth(psf, nodes=[0], rtol=0.1)


@pytest.mark.parametrize(('name', 'words'), [
    ('from_gridded_psf', 'psf must be a GriddedPSFModel, got 3'),
    ('from_image_psf', 'psf must be made of ImagePSF models, got 3'),
    ('from_field', 'field must be a MixtureField, got 3')])
def test_a_source_of_another_type_is_refused(name, words):
    with pytest.raises(TypeError, match=words):
        getattr(GriddedMixturePSF, name)(3)


def test_a_grid_of_blank_nodes_is_an_error():
    grid = epsf_grid(lambda data: data.fill(0))
    with pytest.raises(ValueError, match='at least one image that can be fi'):
        GriddedMixturePSF.from_gridded_psf(grid)


def test_fill_values_at_the_edge_are_not_fitted():
    def fill(data):
        data[2, :, -1] = -0.1
        data[3, -2:] = -0.1
        data[4, 0] = data[4, :, 0] = 7
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid(fill), 2, radius=20)
    assert_is_truth(psf, rtol=1e-6)
    assert np.abs(psf.report['size_error']).max() < 1e-5


def test_nodes_may_look_for_their_own_start():
    psf = GriddedMixturePSF.from_gridded_psf(epsf_grid(), 2, start='own')
    assert_is_truth(psf, rtol=1e-4)
    with pytest.raises(ValueError, match="start must be one of 'centre', 'o"):
        GriddedMixturePSF.from_gridded_psf(epsf_grid(), 2, start='best')


def test_one_call_does_a_focal_plane_on_any_executor(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    with ThreadPoolExecutor(1) as pool:
        psfs = GriddedMixturePSF.from_gridded_psf(
            {'A': epsf_grid(), 'B': epsf_grid(oversampling=2)}, 2,
            executor=pool, progress_bar=True, interpolation='components')
    assert set(psfs) == {'A', 'B'}
    assert psfs['B'].interpolation == 'components'
    assert_is_truth(psfs['A'], rtol=1e-6)
    assert_is_truth(psfs['B'], rtol=1e-6)
    assert 'Fitting nodes' in capsys.readouterr().err


def test_two_chips_side_by_side_have_a_seam():
    data = epsf_grid().data[:1].repeat(8, axis=0)
    places = [(x, y) for y in (0, 20, 20, 40) for x in (5, 9)]
    psf = GriddedMixturePSF.from_gridded_psf(
        PlainGrid(data, {'grid_xypos': places, 'oversampling': 3}), 2)
    assert_array_equal(psf.grid_xypos[::2, 1], [0, 20, 21, 40])
    assert_array_equal(psf.grid_xypos[:2, 0], [5, 9])


def two_chips():
    """Return nodes at one place, sorted as photutils 3.0 does."""
    data = epsf_grid().data[:1].repeat(8, axis=0)
    places = sorted([(x, y) for y in (0, 20, 20, 40) for x in (5, 9)],
                    key=lambda place: place[::-1])
    return PlainGrid(data, {'grid_xypos': places, 'oversampling': 3})


def no_lattice():
    data = epsf_grid().data[:4]
    return PlainGrid(data, {'grid_xypos': [(0, 0), (5, 0), (0, 5), (6, 6)],
                            'oversampling': 3})


@pytest.mark.parametrize(('grid', 'words'), [
    (two_chips, r'got 2 nodes at \(5\.0, 20\.0\): .* covers several chips'),
    (no_lattice, 'grid_xypos must form a rectangular grid')])
def test_wrong_places_are_refused_before_anything_is_fitted(
        monkeypatch, grid, words):
    def fit(*args, **kwargs):
        raise AssertionError
    monkeypatch.setattr(fitting_grid, 'fit_nodes', fit)
    with pytest.raises(ValueError, match=words):
        GriddedMixturePSF.from_gridded_psf(grid(), 1)


def test_the_grids_of_two_chips_are_taken_one_by_one():
    first, second = epsf_grid(), epsf_grid()
    psfs = GriddedMixturePSF.from_gridded_psf({1: first, 2: second}, 2)
    assert_is_truth(psfs[2], rtol=1e-6)


def test_the_name_of_a_file_is_no_grid():
    with pytest.raises(TypeError, match='from_file reads files'):
        GriddedMixturePSF.from_gridded_psf('PSFSTD_WFC3UV_F814W.fits')


def test_one_image_psf_makes_a_grid_of_one_node():
    steps = np.arange(-30, 31) / 2
    data = truth_at(0, 0).evaluate(steps - 0.25, steps[:, None] + 0.5)
    # The star is half a sample right of the middle and one below.
    image = ImagePSF(data, oversampling=2, origin=(30.5, 29))
    psf = GriddedMixturePSF.from_image_psf(image, 2)
    assert psf.grid_shape == (1, 1)
    assert_allclose(psf.mixtures[0].means, 0, atol=1e-6)
    y, x = np.mgrid[:15, :15]
    for model in (image, psf):
        model.x_0, model.y_0, model.flux = 7.5, 7, 3
    assert_allclose(psf(x, y), image(x, y), atol=2e-4)


def test_image_psfs_at_positions_make_a_grid_and_missing_ones_are_bridged():
    steps = np.arange(-36, 37) / 3
    images = [ImagePSF(truth_at(x, y).evaluate(steps, steps[:, None]),
                       oversampling=3) for x, y in PLACES]
    psf = GriddedMixturePSF.from_image_psf(images[:4] + images[5:], 2,
                                           grid_xypos=PLACES[:4] + PLACES[5:])
    assert psf.grid_shape == (3, 3)
    assert list(np.flatnonzero(psf.report['bridged'])) == [4]
    assert_is_truth(psf, scale=1, nodes=[0, 1, 2, 3, 5, 6, 7, 8], rtol=1e-5)


def test_image_psfs_must_be_alike():
    one = ImagePSF(np.ones((9, 9)))
    other = ImagePSF(np.ones((9, 9)), oversampling=2)
    with pytest.raises(ValueError, match='of one shape, origin and oversa'):
        GriddedMixturePSF.from_image_psf([one, other],
                                         grid_xypos=[(0, 0), (1, 0)])
    with pytest.raises(TypeError, match='made of ImagePSF models, got 3'):
        GriddedMixturePSF.from_image_psf(3)
    with pytest.raises(ValueError, match=r'must have shape \(1, 2\)'):
        GriddedMixturePSF.from_image_psf(one, grid_xypos=[(0, 0), (1, 0)])
    with pytest.raises(ValueError, match='two nodes at one place'):
        GriddedMixturePSF.from_image_psf([one, one],
                                         grid_xypos=[(0, 0), (0, 0)])


def test_what_the_epsf_builder_returns_is_taken(rng):
    mixture = truth_at(0, 0)
    stars = []
    for x, y in rng.uniform(11.5, 13.5, (16, 2)):
        stars.append(EPSFStar(mixture.render((25, 25), x, y, flux=100),
                              cutout_center=(x, y)))
    result = EPSFBuilder(oversampling=2, maxiters=3, progress_bar=False)(
        EPSFStars(stars))
    psf = GriddedMixturePSF.from_image_psf(result, 2)
    assert_allclose(psf.scales, 1, atol=0.05)
    assert_allclose(psf.mixtures[0].moments().covariance[0, 0],
                    mixture.moments().covariance[0, 0], rtol=0.2)


def test_a_psfex_model_becomes_a_grid_of_unit_flux(tmp_path):
    # Planes of a linear change along x; the star is on sample n // 2, and a
    # sample is 0.8 pixels.
    steps = (np.arange(40) - 20) * 0.8
    left, right = (truth_at(x, 50).evaluate(steps, steps[:, None])
                   for x in (0, 100))
    planes = 5 * np.array([(left + right) / 2, right - left, 0 * left])
    path = write_model(tmp_path / 'a.psf', planes, degrees=(1,),
                       contexts=(X, Y))
    psf = GriddedMixturePSF.from_psfex(path, 4, grid_shape=(2, 3))
    assert_allclose(psf.grid_xypos[:3], [(-1, 9), (99, 9), (199, 9)])
    assert_allclose(psf.scales, 1)
    y, x = np.mgrid[-6:7, -6:7]
    for place, expected in ((-1, left), (199, right)):
        model = truth_at(0 if place < 0 else 100, 50)
        assert_allclose(psf.mixture_at(place, 30).evaluate(x, y),
                        model.evaluate(x, y), atol=1e-3)
        assert expected.max() > 0


def test_a_constant_psfex_model_is_one_node(tmp_path):
    steps = (np.arange(31) - 15) * 0.8
    path = write_model(tmp_path / 'a.psf', [truth_at(0, 0).evaluate(
        steps, steps[:, None])])
    psf = GriddedMixturePSF.from_psfex(read_psfex(path), 2)
    assert psf.grid_shape == (1, 1)
    y, x = np.mgrid[-6:7, -6:7]
    assert_allclose(psf.mixtures[0].evaluate(x, y),
                    truth_at(0, 0).evaluate(x, y), atol=1e-5)


@pytest.mark.parametrize('name', MODELS)
def test_a_real_psfex_model_is_followed_between_the_nodes(name, realdata,
                                                          rng):
    path = realdata('decam_psfex') / name
    psf = GriddedMixturePSF.from_psfex(path, 4, grid_shape=(6, 4))
    assert (psf.report['status'] < 4).all()
    model = read_psfex(path)
    x_range, y_range = model.position_range
    n = model.planes.shape[1]
    steps = (np.arange(n) - n // 2) * model.sampling
    for x, y in zip(rng.uniform(*x_range, 10), rng.uniform(*y_range, 10),
                    strict=True):
        image = model.image_at(x, y)
        fit = fit_mixture(image, 4, origin=model.origin, radius=n // 2 - 2)
        found = psf.mixture_at(x, y).evaluate(steps, steps[:, None])
        found *= fit.flux * model.sampling**2
        own = np.abs(fit.residual[4:-4, 4:-4]).max()
        worst = np.abs(found - image)[4:-4, 4:-4].max()
        # Blending adds little to what the mixture itself leaves.
        assert worst < own + 0.01 * image.max()


@pytest.mark.parametrize(('weighting', 'positions', 'fluxes'), [
    ('uniform', "or weighting='astrometric' make",
     "or weighting='photometric' make"),
    ('photometric', "weighting='astrometric' (which is worse for fluxes) make",
     'more Gaussians make this'),
    ('astrometric', 'more Gaussians make this',
     "weighting='photometric' (which is worse for positions) make")])
def test_no_remedy_is_one_that_is_taken_already(weighting, positions, fluxes):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        GriddedMixturePSF.from_gridded_psf(airy_grid(1.0, 0.0), 2,
                                           weighting=weighting)
    said = {str(one.message).partition(' ')[0]: str(one.message)
            for one in caught}
    assert positions in said['positions']
    assert fluxes in said['fluxes']
