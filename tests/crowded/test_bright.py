"""What a search finds beside the hidden middles of saturated stars."""
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.nddata import NDData, StdDevUncertainty
from astropy.wcs import WCS

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.crowded.search import weakest
from photutils_mgauss.crowded.stars import Stars

SKY, FULL, FLUX, TOP = 40.0, 6e4, 2.5e6, 34.8
ANGLES = 0.3 + 2 * np.pi * np.arange(5) / 5


def mixture(piece, radius=3):
    """Return a PSF with five pieces of light around it, as on a ring."""
    places = radius * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
    widths = 0.9, 3.5, *[0.5] * 5
    return GaussianMixture([0.75, 0.25 - 5 * piece, *[piece] * 5],
                           [(0, 0), (0, 0), *places],
                           [width * np.eye(2) for width in widths])


PSF = GriddedMixturePSF([mixture(0)], [(0, 0)])


def scene(stars, piece=0.003, seed=0, radius=3):
    """Return an image and its errors: stars of a PSF that is not known."""
    rng = np.random.default_rng(seed)
    light = SKY + sum(mixture(piece, radius).render((70, 70), x, y, flux=flux)
                      for x, y, flux in stars)
    seen = np.minimum(rng.normal(light, np.sqrt(light)), FULL)
    return seen, np.sqrt(light)


def measured(x, y, *image):
    """Return the star of an image that is nearest to a place."""
    data, error = image
    table = CrowdedMixturePhotometry(PSF, saturation=FULL - 500)(
        data, error=error)
    return table[np.argmin(np.hypot(table['x_fit'] - x, table['y_fit'] - y))]


@pytest.mark.parametrize('seed', [0, 3])
def test_what_the_psf_leaves_of_a_saturated_star_does_not_push_it(seed):
    x = 35 + 0.1 * seed
    star = measured(x, TOP, *scene([(x, TOP, FLUX)], seed=seed))
    assert star['flags'] & 65536
    assert abs(star['x_fit'] - x) < 0.01
    assert abs(star['y_fit'] - TOP) < 0.01
    assert star['flux_fit'] == pytest.approx(FLUX, rel=0.03)


@pytest.mark.parametrize('seed', [0, 3])
def test_what_the_psf_leaves_in_bright_wings_is_no_star(seed):
    # Pieces that the noise lets stand out ten standard errors.
    data, error = scene([(35, TOP, 4 * FLUX)], 2e-4, seed, radius=5)
    phot = CrowdedMixturePhotometry(PSF, saturation=FULL - 500)
    assert len(phot(data, error=error)) == 1
    # Who says that the PSF has no errors gets all that it leaves.
    phot = CrowdedMixturePhotometry(PSF, saturation=FULL - 500, psf_error=0)
    assert len(phot(data, error=error)) > 2


def test_a_star_that_is_too_bright_for_that_is_found():
    star = measured(38.4, 36.1, *scene([(35.3, TOP, FLUX), (38.4, 36.1, 1e5)],
                                       piece=0))
    assert star['flux_fit'] == pytest.approx(1e5, rel=0.05)


def test_a_bad_column_through_a_bright_star_hides_no_stars_beside_it():
    y = np.arange(10.0, 200, 10)
    x = np.where(np.arange(y.size) % 2, 31.3, 28.2)
    flux = np.full(y.size, 3000.0)
    x[9], flux[9] = 29.9, 1e6
    light = SKY + sum(mixture(0).render((210, 60), *star, flux=brightness)
                      for *star, brightness in zip(x, y, flux, strict=True))
    bad = np.zeros(light.shape, bool)
    bad[:, 30] = True
    table = CrowdedMixturePhotometry(PSF)(
        np.random.default_rng(1).normal(light, np.sqrt(light)),
        error=np.sqrt(light), mask=bad)
    gap = np.hypot(table['x_fit'] - x[:, None],
                   table['y_fit'] - y[:, None]).min(axis=1)
    assert (gap < 0.3).all()
    assert table.meta['reduced_chi2'] < 1.1


def test_it_is_the_same_in_many_images():
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.cdelt = -1e-5, 1e-5
    images = []
    for seed in (0, 3):
        data, error = scene([(35.0, TOP, FLUX)], seed=seed)
        images.append((NDData(data, StdDevUncertainty(error)), PSF, wcs))
    table = CrowdedMixturePhotometry(
        None, saturation=FULL - 500).fit_images(images)
    star = table[np.argmax(table['flux'][:, 0])]
    assert np.abs(np.asarray(star['x_fit']) - 35).max() < 0.01
    assert np.abs(np.asarray(star['y_fit']) - TOP).max() < 0.01
    np.testing.assert_allclose(np.asarray(star['flux']), FLUX, rtol=0.03)


@pytest.mark.parametrize(('distance', 'seeded', 'listed', 'goes'), [
    (0.4, True, False, True), (0.4, True, True, False),
    (0.4, False, False, False), (0.7, True, False, False)])
def test_what_becomes_one_with_a_star_seen_by_its_wings_goes(
        distance, seeded, listed, goes):
    stars = Stars([20, 20 + distance], [20, 20], [1e6, 4e5],
                  seeded=[seeded, False], number=[-1, 3 if listed else -1])
    pairs = SimpleNamespace(owner=np.array([0, 1]),
                            neighbour=np.array([1, 0]))
    weak = weakest(stars, pairs, np.array([900.0, 300.0]), 5.0, (40, 40))
    assert weak.tolist() == [False, goes]
