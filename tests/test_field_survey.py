"""A field from the stars of a real survey chip, beside PSFEx's model."""
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from photutils.psf import PSFPhotometry
from scipy.interpolate import RectBivariateSpline

from photutils_mgauss import (
    MixturePSFPhotometry,
    fit_mixture_field,
    read_psfex,
)

CATALOGUE = 'DECam_00241238_01_psfcat_tb_maxmag_17.0_magcut_3.0_findstars.fits'
PSFEX = 'DECam_00241238_01_psfex_samp0.5_deg2.psf'
SIZE = 25


@pytest.fixture
def chip(realdata):
    """Paste the vignettes of 117 stars into an empty chip."""
    rows = fits.getdata(realdata('decam_psfex') / CATALOGUE, 2)
    data = np.full((4096, 2048), np.nan)
    x, y = rows['X_IMAGE'] - 1.0, rows['Y_IMAGE'] - 1.0
    for vignette, x_0, y_0 in zip(rows['VIGNET'], x, y, strict=True):
        left, bottom = int(np.rint(x_0)) - 31, int(np.rint(y_0)) - 31
        y_in, x_in = np.mgrid[bottom:bottom + 63, left:left + 63]
        inside = ((x_in >= 0) & (y_in >= 0) & (x_in < 2048) & (y_in < 4096)
                  & (vignette > -1e29))
        data[y_in[inside], x_in[inside]] = vignette[inside]
    # Sky noise 9 ADU, 3.9 electrons per ADU.
    error = np.sqrt(81 + np.maximum(np.nan_to_num(data), 0) / 3.9)
    return data, error, Table({'x': x, 'y': y})


def psfex_chi2(model, data, error, x, y):
    """Fit x, y and flux of PSFEx's model; return the reduced chi^2."""
    image = model.image_at(x, y)
    steps = [(np.arange(n) - origin) * model.sampling for n, origin in
             zip(image.shape[::-1], model.origin, strict=True)]
    spline = RectBivariateSpline(steps[1], steps[0], image)
    left, bottom = int(np.rint(x)) - SIZE // 2, int(np.rint(y)) - SIZE // 2
    cut = np.s_[bottom:bottom + SIZE, left:left + SIZE]
    y_in, x_in = np.mgrid[cut]
    good = np.isfinite(data[cut])
    pixels, sigma = data[cut][good], error[cut][good]
    place = np.array([x, y])
    for _ in range(6):
        offset = y_in[good] - place[1], x_in[good] - place[0]
        profile, by_y, by_x = (spline.ev(*offset, dx=dx, dy=dy) for dx, dy
                               in ((0, 0), (1, 0), (0, 1)))
        flux = (profile / sigma**2) @ pixels / np.sum((profile / sigma)**2)
        slopes = np.column_stack([profile, -flux * by_x, -flux * by_y])
        residual = (pixels - flux * profile) / sigma
        step = np.linalg.lstsq(slopes / sigma[:, None], residual)[0]
        place += step[1:]
    return np.sum((residual - slopes @ step / sigma) ** 2) / (good.sum() - 3)


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
    theirs = [psfex_chi2(model, data, error, x, y)
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
