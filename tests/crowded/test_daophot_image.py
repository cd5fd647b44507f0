"""
DAOPHOT's own test image: nine stars at whole pixels, some of them blended.

ALLSTAR's positions are within 0.040 pixels rms per axis of the truth.
"""
import numpy as np
import pytest
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from astropy.table import QTable
from photutils.psf import PSFPhotometry, SourceGrouper

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    MixturePSFPhotometry,
    fit_mixture_field,
)

STARS = np.array([(41, 4), (8, 23), (31, 25), (29, 34), (36, 42), (23, 7),
                  (18, 8), (36, 22), (26, 22)]) - 1.0
ALLSTAR_RMS = 0.040


@pytest.fixture
def image(realdata):
    """Return the image without its background, and its errors."""
    data = fits.getdata(realdata('daophot_test') / 'fits3.fits').astype(float)
    _, background, noise = sigma_clipped_stats(data)
    light = np.maximum(data - background, 0)
    return data - background, np.sqrt(light + noise**2)


@pytest.mark.parametrize('photometry', [PSFPhotometry, MixturePSFPhotometry])
@pytest.mark.parametrize('n_components', [1, 2])
def test_positions_are_better_than_those_of_allstar(image, rng, photometry,
                                                    n_components):
    data, error = image
    x, y = STARS.T + rng.normal(0, 0.3, (2, 9))
    start = QTable({'id': np.arange(9), 'x': x, 'y': y})
    psf = fit_mixture_field(data, start, error=error, degree=0,
                            n_components=n_components, radius=8).to_grid(1)
    phot = photometry(psf, (11, 11), grouper=SourceGrouper(15),
                      aperture_radius=4)
    result = phot(data, error=error, init_params=start)
    result.sort('id')
    offsets = np.column_stack([result['x_fit'], result['y_fit']]) - STARS
    rms = np.sqrt((offsets**2).mean(axis=0))
    assert (rms < ALLSTAR_RMS).all(), rms


def test_all_nine_are_found_and_better_than_with_allstar(image):
    data, error = image
    x, y = STARS.T
    psf = fit_mixture_field(data, QTable({'x': x, 'y': y}), error=error,
                            degree=0, n_components=2, radius=8).to_grid(1)
    found = CrowdedMixturePhotometry(psf)(data + 100, error=error)
    bright = found[np.argsort(-found['flux_fit'])[:9]]
    position = np.column_stack([bright['x_fit'], bright['y_fit']])
    gap = np.linalg.norm(position[:, None] - STARS, axis=2)
    offsets = position[gap.argmin(axis=0)] - STARS
    assert (np.sqrt((offsets**2).mean(axis=0)) < ALLSTAR_RMS).all()
    assert len(found) <= 10
