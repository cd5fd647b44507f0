"""The HST WFC3/UVIS library of effective PSFs as a grid of mixtures."""
import warnings

import numpy as np
import pytest
from astropy.nddata import NDData
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose
from photutils.psf import GriddedPSFModel, PSFPhotometry, STDPSFGrid

from photutils_mgauss import (
    GriddedMixturePSF,
    MixturePSFPhotometry,
    adaptive_moments,
)

NX = 7
INNER = [j * NX + i for j in (1, 2) for i in range(1, NX - 1)]


# Positions change by more than 0.002 pix with the pixel phase.
pytestmark = pytest.mark.filterwarnings(
    'ignore:positions measured with these mixtures')
# Fluxes change by more than 0.3 % with the pixel phase here, which is said.
PHASES = pytest.mark.filterwarnings(
    'ignore:fluxes measured with these mixtures')


@pytest.fixture
def library(realdata):
    """Return all ePSFs of the file, of both chips."""
    path = realdata('hst_wfc3uvis_f814w') / 'PSFSTD_WFC3UV_F814W.fits'
    with warnings.catch_warnings():
        # The file has bytes after its data and letters outside ASCII.
        warnings.simplefilter('ignore')
        return STDPSFGrid(path)


@pytest.fixture
def chip(library):
    """Return photutils' own model of the lower chip."""
    data = np.array(library.data[:28], float)
    data[data == -0.1] = 0
    places = [tuple(map(float, xy)) for xy in library.grid_xypos[:28]]
    return GriddedPSFModel(NDData(data, meta={'grid_xypos': places,
                                              'oversampling': 4}))


@PHASES
def test_fill_values_at_the_seam_and_the_edges_are_not_seen(library):
    psf = GriddedMixturePSF.from_gridded_psf(library, 3)
    assert psf.grid_shape == (8, 7)
    report = psf.report
    assert (report['status'] == 0).all()
    # Nodes with a border of -0.1 are like the others.
    filled = np.array([(image == -0.1).any() for image in library.data])
    assert filled.sum() == 20
    assert np.ptp(psf.scales) < 0.01
    assert np.ptp(report['size_error']) < 0.01
    everywhere = GriddedMixturePSF.from_gridded_psf(library, 3, radius=17)
    assert np.ptp(everywhere.scales) < 0.03


def leave_one_out(psf, images, m):
    """Return shapes of a node and of its predictions from the corners."""
    corners = [m - NX - 1, m - NX + 1, m + NX - 1, m + NX + 1]
    places = psf.grid_xypos
    around = GriddedMixturePSF([psf.mixtures[n] for n in corners],
                               places[corners], scales=psf.scales[corners])
    index, share = around._grid.neighbours(*places[m])
    bilinear = np.tensordot(share, images[corners][index], 1)
    steps = (np.arange(81) - 40) / 4
    mixture = around.mixture_at(*places[m]).evaluate(steps, steps[:, None])
    return adaptive_moments(np.array([images[m], bilinear, mixture]),
                            oversampling=4)


@PHASES
def test_nodes_left_out_are_predicted_as_well_as_by_photutils(chip):
    psf = GriddedMixturePSF.from_gridded_psf(chip, 5)
    images = np.asarray(chip.data)[:, 10:91, 10:91]
    size, shape, centre = [], [], []
    for m in INNER:
        s = leave_one_out(psf, images, m)
        size.append(1 - s.r2[1:] / s.r2[0])
        shape.append(s.ellipticity[0] - s.ellipticity[1:])
        centre.append(np.hypot(s.x[1:] - s.x[0], s.y[1:] - s.y[0]))
    size, shape, centre = map(np.array, (size, shape, centre))
    # Columns: bilinear interpolation of ePSF pixels, and mixtures. What the
    # spacing of the nodes costs is the same for both.
    assert size[:, 1].std() < 1.05 * size[:, 0].std()
    assert np.sqrt((shape[:, 1] ** 2).mean()) < 1.1 * np.sqrt(
        (shape[:, 0] ** 2).mean())
    # The rest is what five Gaussians cost at the nodes themselves.
    own = psf.report['size_error'][INNER].mean()
    assert abs(size[:, 1].mean() - size[:, 0].mean() - own) < 5e-4
    assert np.median(centre[:, 1]) < np.median(centre[:, 0]) + 1e-3


def make_scene(chip, rng, n=(25, 16), flux=1e5, snr=200):
    """Return image, error and stars drawn with photutils' model."""
    x, y = (axis.ravel() for axis in np.meshgrid(
        np.linspace(60, 4030, n[0]), np.linspace(60, 1990, n[1])))
    x, y = x + rng.uniform(-20, 20, x.size), y + rng.uniform(-20, 20, x.size)
    image, peaks = np.zeros((2048, 4096)), []
    for x_0, y_0 in zip(x, y, strict=True):
        part = np.s_[round(y_0) - 11:round(y_0) + 12,
                     round(x_0) - 11:round(x_0) + 12]
        rows, columns = np.mgrid[part]
        star = chip.evaluate(columns, rows, flux, x_0, y_0)
        image[part] += star
        peaks.append((star[8:15, 8:15] ** 2).sum())
    # The error of a flux fitted on 7 x 7 pixels is flux / snr.
    sigma = np.sqrt(np.mean(peaks)) / snr
    image += rng.normal(0, sigma, image.shape)
    return image, np.full(image.shape, sigma), QTable(
        {'x': x, 'y': y, 'flux': np.full(x.size, flux)})


def measure(psf, image, error, stars, photometry=PSFPhotometry):
    start = stars.copy()
    start['x'] += 0.08
    start['y'] -= 0.06
    start['flux'] *= 0.9
    result = photometry(psf, (7, 7))(image, error=error, init_params=start)
    result.sort('id')
    return result


@PHASES
def test_photometry_agrees_with_photutils_within_the_stated_phase_error(
        chip, rng):
    image, error, stars = make_scene(chip, rng)
    peer = measure(chip, image, error, stars)
    noise = np.std(np.concatenate([peer['x_fit'] - stars['x'],
                                   peer['y_fit'] - stars['y']]))
    for k in (3, 5):
        psf = GriddedMixturePSF.from_gridded_psf(chip, k)
        ours = measure(psf, image, error, stars)
        assert (ours['flags'] == peer['flags']).all()
        shift = np.concatenate([ours[c] - peer[c]
                                for c in ('x_fit', 'y_fit')])
        rms = np.sqrt((shift**2).mean())
        # Half the range over pixel phases is the amplitude of an error that
        # is about a sine of the phase: its rms is less.
        assert rms < np.median(psf.report['phase_error'])
        # At S/N 200 that of five Gaussians is less than the noise.
        assert k == 3 or rms < noise
        flux = (ours['flux_fit'] - peer['flux_fit']) / stars['flux']
        assert np.sqrt((flux**2).mean()) < 1 / 200
        assert abs(flux.mean()) < 2e-3
        ratio = np.median(ours['x_err'] / peer['x_err'])
        assert abs(ratio - 1) < 0.01
        fast = measure(psf, image, error, stars, MixturePSFPhotometry)
        assert (fast['flags'] == ours['flags']).all()
        for name in ('x_fit', 'y_fit'):
            assert np.abs(fast[name] - ours[name]).max() < 1e-5


@pytest.fixture
def undersampled(realdata):
    """Return the ePSFs of a strongly undersampled camera."""
    folder = realdata('hst_wfc3ir_f110w')
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        grid = STDPSFGrid(next(folder.glob('*.fits')))
    places = [tuple(map(float, xy)) for xy in grid.grid_xypos]
    return GriddedPSFModel(NDData(np.array(grid.data, float), meta={
        'grid_xypos': places, 'oversampling': 4}))


def flux_scatter(psf, library, node):
    """Return the scatter of fluxes of noiseless stars over pixel phases."""
    x, y = np.rint(library.grid_xypos[node])
    data, stars = np.zeros((161, 161)), []
    pixels = np.mgrid[-10:11, -10:11]
    for n, (i, j) in enumerate(np.ndindex(8, 8)):
        # Each star at another phase, all with the PSF of one node.
        at = np.array([10 + 20 * i, 10 + 20 * j])
        phase = np.array([(n % 8) / 8, (n // 8) / 8]) - 0.5 + 1 / 16
        part = np.s_[at[1] - 10:at[1] + 11, at[0] - 10:at[0] + 11]
        data[part] = library.evaluate(
            pixels[1] + x, pixels[0] + y, 1e5, x + phase[0], y + phase[1])
        stars.append((*at + phase, 9e4))
    stars = QTable(rows=stars, names=('x', 'y', 'flux'))
    model = psf.local_model(x, y)
    model.flux, scale = 1, model.flux.value
    table = MixturePSFPhotometry(model, 5)(
        data, error=np.sqrt(np.maximum(data, 0) + 300), init_params=stars)
    return np.std(table['flux_fit']) / 1e5 / scale


@pytest.mark.long
def test_the_fluxes_of_an_undersampled_camera_do_not_change_with_the_phase(
        undersampled):
    psf = GriddedMixturePSF.from_gridded_psf(undersampled)
    assert (psf.report['flux_phase_error'] < 0.003).all()
    for node in (0, 2, 4):
        scatter = flux_scatter(psf, undersampled, node)
        # For these bright stars; the report has the worse of bright and
        # faint.
        assert scatter < 1.1 * psf.report['flux_phase_error'][node]


def test_too_few_gaussians_for_the_fluxes_are_warned_of(undersampled):
    with pytest.warns(AstropyUserWarning, match=r'by up to 2\.3 % rms.*'
                      'at 9 of 9 nodes'):
        psf = GriddedMixturePSF.from_gridded_psf(undersampled, 3)
    scatter = flux_scatter(psf, undersampled, 4)
    assert_allclose(psf.report['flux_phase_error'][4], scatter, rtol=0.2)
