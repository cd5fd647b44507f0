"""A field from the stars of a real survey chip, beside PSFEx's model."""
import numpy as np
import pytest
from astropy.table import QTable
from photutils.psf import PSFPhotometry

from helpers.decam_chip import decam_chip, fit_spline, psfex_spline
from photutils_mgauss import (
    MixturePSFPhotometry,
    fit_mixture_field,
    read_psfex,
)

PSFEX = 'DECam_00241238_01_psfex_samp0.5_deg2.psf'
SIZE = 25


@pytest.fixture
def chip(realdata):
    """Return a chip with nothing but 117 stars."""
    return decam_chip(realdata('decam_psfex'))


def test_left_out_stars_are_described_as_well_as_by_psfex(chip, realdata):
    data, error, stars = chip
    out = np.arange(len(stars)) % 4 == 0
    field = fit_mixture_field(data, stars[~out], error=error, n_components=4,
                              degree=2, radius=12)
    start = QTable({'x_init': stars['x'][out], 'y_init': stars['y'][out]})
    psf = field.to_grid((12, 6))
    result = MixturePSFPhotometry(psf, SIZE, aperture_radius=6)(
        data, mask=~np.isfinite(data), error=error, init_params=start)
    model = read_psfex(realdata('decam_psfex') / PSFEX)
    theirs = [fit_spline(psfex_spline(model, x, y), data, error, x, y)[2]
              for x, y in stars[out].iterrows()]
    whole = np.asarray(result['n_pixels_fit']) == SIZE**2
    # PSFEx has seen these stars, the field has not.
    assert np.median(result['reduced_chi2'][whole]) < 1.1 * np.median(theirs)
    assert field.stars['used'].sum() > 0.8 * (~out).sum()


def test_the_field_goes_into_photutils_photometry(chip):
    data, error, stars = chip
    field = fit_mixture_field(data, stars, error=error, n_components=3,
                              degree=1, radius=10)
    few = QTable({'x_init': stars['x'][20:24], 'y_init': stars['y'][20:24]})
    result = PSFPhotometry(field.to_grid((5, 5)), (11, 11),
                           aperture_radius=6)(
        data, mask=~np.isfinite(data), error=error, init_params=few)
    rows = np.searchsorted(field.stars['id'], np.arange(21, 25))
    for name in ('x_fit', 'y_fit'):
        offset = np.asarray(result[name]) - field.stars[name][rows]
        assert np.abs(offset).max() < 0.03
