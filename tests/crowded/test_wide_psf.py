"""Wide PSFs: all lengths follow the width of the PSF."""
import numpy as np
import pytest
from astropy.nddata import NDData, StdDevUncertainty
from astropy.wcs import WCS
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    fit_crowded_psf,
    render_stars,
)


def scene(width, *, n=32, seed=3, squares=20):
    """
    Return an image whose PSF and distances grow together, and its stars.

    One star in so many squares of the FWHM; n is the side of the image in
    FWHM.
    """
    stddev = width / 2.3548
    psf = GaussianMixture.from_stddevs(
        [0.7, 0.25, 0.05], np.zeros((3, 2)),
        [2 * (factor * stddev,) for factor in (0.9, 1.6, 3.5)])
    side, rng = round(n * width), np.random.default_rng(seed)
    x, y = rng.uniform(0, side, (2, n * n // squares))
    flux = 230 * width * np.minimum(rng.pareto(1.1, x.size) + 0.3, 1e3)
    light = 50 + render_stars(GriddedMixturePSF([psf], [(0, 0)]), x, y, flux,
                              (side, side))
    error = np.sqrt(light)
    return psf, rng.normal(light, error), error, x, y, flux


@pytest.mark.parametrize('width', [2.5, 8, 12])
def test_stars_of_any_width_are_found_and_measured(width):
    psf, data, error, x, y, flux = scene(width)
    table = CrowdedMixturePhotometry(GriddedMixturePSF([psf], [(0, 0)]))(
        data, error=error)
    side, places = len(data), np.column_stack([x, y])
    gap = cKDTree(places).query(places, k=2)[0][:, 1]
    alone = ((gap > width) & (np.abs(places / side - 0.5) < 0.45).all(axis=1)
             & (flux * psf.evaluate(0, 0) * width > 30 * np.sqrt(50)))
    assert alone.sum() > 8
    distance, row = cKDTree(np.column_stack(
        [table['x_fit'], table['y_fit']])).query(places[alone])
    assert np.mean(distance < 0.25 * width) >= 0.95
    off = np.asarray(table['flux_fit'])[row] - flux[alone]
    assert np.median(np.abs(off) / table['flux_err'][row]) < 1.1
    assert abs(np.median(off / flux[alone])) < 0.02
    assert table.meta['reduced_chi2'] < 1.1


@pytest.mark.parametrize('seed', [1, 4])
def test_no_star_of_a_dense_field_is_thrown_away(seed):
    # Of equations that leave out much of what stars share one step took three
    # magnitudes off a bright star.
    psf, data, error, *_ = scene(6, n=40, seed=seed, squares=4)
    table = CrowdedMixturePhotometry(GriddedMixturePSF([psf], [(0, 0)]))(
        data, error=error)
    assert table.meta['reduced_chi2'] < 1.1


def frame(side, x, turn):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crpix, wcs.wcs.crval = (side / 2 + x, side / 2), (150, 2)
    c, s = 2e-5 * np.cos(turn), 2e-5 * np.sin(turn)
    wcs.wcs.cd = [[-c, s], [s, c]]
    return wcs


@pytest.mark.long
def test_wide_stars_are_found_and_measured_in_many_images():
    width = 12
    psf, data, _, x, y, flux = scene(width, n=18, squares=5)
    side, grid = len(data), GriddedMixturePSF([psf], [(0, 0)])
    frames = [frame(side, *how) for how in ((0, 0), (7, 0.1))]
    sky, rng = frames[0].pixel_to_world(x, y), np.random.default_rng(1)
    images = []
    for wcs in frames:
        light = 50 + render_stars(grid, *wcs.world_to_pixel(sky), flux,
                                  data.shape)
        images.append((NDData(rng.normal(light, np.sqrt(light)),
                              StdDevUncertainty(np.sqrt(light))), grid, wcs))
    table = CrowdedMixturePhotometry(None).fit_images(images)
    places = np.column_stack([x, y])
    gap = cKDTree(places).query(places, k=2)[0][:, 1]
    alone = ((gap > width) & (np.abs(places / side - 0.5) < 0.4).all(axis=1)
             & (flux * np.sqrt(psf.evaluate(0, 0) / 100) > 8))
    assert alone.sum() > 10
    distance, row = cKDTree(np.column_stack(
        [table['x_fit'][:, 0], table['y_fit'][:, 0]])).query(places[alone])
    assert np.mean(distance < 0.25 * width) > 0.95
    pull = (table['flux'][row] - flux[alone, None]) / table['flux_err'][row]
    assert 1.48 * np.nanmedian(np.abs(pull)) < 1.2
    assert table.meta['reduced_chi2'] < 1.1


@pytest.mark.long
@pytest.mark.filterwarnings('ignore:the PSF still changes',
                            'ignore:n_components=2 misses')
def test_the_psf_of_wide_stars_is_that_of_the_image():
    psf, data, error, *_ = scene(8, n=48)
    field = fit_crowded_psf(data, error=error, n_components=2, degree=0,
                            max_passes=2, max_stars=60)
    own = field.mixture_at(190, 190)
    for radius in (4, 8, 16):
        assert_allclose(own.encircled_energy(radius),
                        psf.encircled_energy(radius), atol=0.02)


def test_an_image_too_small_for_the_width_of_its_stars_is_said():
    _, data, error, *_ = scene(12, n=8)
    with pytest.raises(ValueError, match='data must show at least'):
        fit_crowded_psf(data, error=error)
