"""Laws of positions on the sky and of fits to several images."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.star_images import MIXTURE, PSF
from photutils_mgauss import (
    MixturePSFPhotometry,
    add_sky_positions,
    cramer_rao,
    fit_many,
)

SHAPE = (161, 161)
SKY = 100.0


def make_wcs(angle=0.0, shift=(0, 0), ra=150.0, dec=40.0):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.crval = ra, dec
    wcs.wcs.crpix = 81 + shift[0], 81 + shift[1]
    c, s = np.cos(angle) * 2e-5, np.sin(angle) * 2e-5
    wcs.wcs.cd = [[-c, s], [s, c]]
    return wcs


def lattice(rng):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(20.0, 150, 20),
                                           np.arange(20.0, 150, 20)))
    return (x + rng.uniform(-0.5, 0.5, x.size),
            y + rng.uniform(-0.5, 0.5, x.size))


def observe(sky, wcs, flux, rng):
    """Return an image of the stars with its errors."""
    light = np.zeros(SHAPE)
    for x, y, f in zip(*wcs.world_to_pixel(sky), flux, strict=True):
        light += MIXTURE.render(SHAPE, x, y, flux=f)
    data = rng.poisson(light + SKY) - SKY
    return NDData(data, uncertainty=StdDevUncertainty(np.sqrt(light + SKY)),
                  unit='electron')


def images(rng, flux, n=3):
    x, y = lattice(rng)
    sky = make_wcs().pixel_to_world(x, y)
    frames = [make_wcs(0.3 * k, (0.4 * k, -0.3 * k)) for k in range(n)]
    flux = np.full(x.size, flux)
    return sky, [(observe(sky, wcs, flux, rng), PSF, wcs) for wcs in frames]


def test_one_image_gives_what_photometry_gives(rng):
    sky, (frame, *_) = images(rng, 2e4)
    data, _, wcs = frame
    x, y = wcs.world_to_pixel(sky)
    start = QTable({'x': x, 'y': y, 'flux': np.full(x.size, 2e4)
                    * u.electron})
    table = MixturePSFPhotometry(PSF, 11, xy_cov=True)(data,
                                                       init_params=start)
    want = add_sky_positions(table, wcs)
    got = fit_many([frame], sky)
    for name in ('ra', 'dec'):
        assert_allclose(got[name].to_value(u.mas), want[name].to_value(u.mas),
                        rtol=0, atol=1e-3)
    for name in ('ra_error', 'dec_error', 'radec_cov'):
        assert_allclose(got[name].value, want[name].value, rtol=1e-3,
                        atol=1e-3)
    assert_allclose(got['flux_fit'][:, 0].value, table['flux_fit'].value,
                    rtol=1e-6)


def test_several_images_have_joint_errors_that_are_true(rng):
    offsets, errors = [], []
    for _ in range(3):
        sky, frames = images(rng, 3e3)
        table = fit_many(frames, sky)
        assert table['converged'].all()
        found = SkyCoord(table['ra'], table['dec'])
        east, north = sky.spherical_offsets_to(found)
        offsets += [east.to_value(u.mas), north.to_value(u.mas)]
        errors += [table['ra_error'].value, table['dec_error'].value]
    pulls = np.concatenate(offsets) / np.concatenate(errors)
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert abs(pulls.std() - 1) < 4 / np.sqrt(2 * pulls.size)
    single = cramer_rao(MIXTURE, 3e3, SKY, fit_shape=11).x_err[0] * 72
    assert_allclose(np.mean(errors), single / np.sqrt(3), rtol=0.05)


def test_a_common_flux_is_better_known(rng):
    sky, frames = images(rng, 3e3)
    each = fit_many(frames, sky)
    one = fit_many(frames, sky, common_flux=True)
    assert one['flux_fit'].shape == (len(sky),)
    ratio = np.median(each['flux_err'].mean(axis=1) / one['flux_err'])
    assert_allclose(ratio, np.sqrt(3), rtol=0.02)


def test_a_star_off_one_image_is_measured_on_the_others(rng):
    sky, frames = images(rng, 2e4)
    far = (frames[0][0], PSF, make_wcs(shift=(500, 0)))
    with_far = fit_many([*frames, far], sky)
    without = fit_many(frames, sky)
    assert np.isnan(with_far['flux_fit'][:, 3]).all()
    assert_allclose(with_far['ra'].value, without['ra'].value, atol=1e-12)
    assert_allclose(with_far['ra_error'].value, without['ra_error'].value)


def test_a_coordinate_nobody_sees_is_not_a_number(rng):
    sky, frames = images(rng, 2e4)
    lost = SkyCoord([sky[0].ra.deg, 10], [sky[0].dec.deg, -80], unit='deg')
    table = fit_many(frames, lost)
    assert np.isfinite(table['ra_error'][0])
    assert np.isnan(table['ra_error'][1])


def test_positions_at_the_pole_have_errors_along_the_parallel():
    wcs = make_wcs(0.4, ra=10, dec=90)
    stars = QTable({'x_fit': [81.0, 10.0], 'y_fit': [80.0, 140.0],
                    'x_err': [0.01, 0.01], 'y_err': [0.01, 0.01]})
    table = add_sky_positions(stars, wcs)
    for name in ('ra_error', 'dec_error'):
        assert_allclose(table[name].value, 0.72, rtol=1e-6)


def test_faint_stars_converge_in_one_image_and_in_three(rng):
    # At a signal to noise of four; where undamped steps have to do, one in
    # seven does not.
    for n, flux in ((1, 180.0), (3, 120.0)):
        sky, frames = images(rng, flux, n)
        assert np.mean(fit_many(frames, sky)['converged']) > 0.95


def real_or_linear_wcs(request, realdata):
    """Return a gwcs of a real instrument, or a FITS WCS."""
    if request == 'fits':
        return make_wcs(0.4)
    asdf = pytest.importorskip('asdf')
    with asdf.open(realdata('nircam_wcs') / f'{request}wcs.asdf') as tree:
        return tree['wcs']


@pytest.mark.parametrize('which', ['fits', 'nircam', 'miri'])
def test_photometry_on_the_sky_has_the_scatter_of_the_pixels(
        which, realdata, rng):
    wcs = real_or_linear_wcs(which, realdata)
    x, y = lattice(rng)
    light = sum(MIXTURE.render(SHAPE, a, b, flux=2e3)
                for a, b in zip(x, y, strict=True))
    error = np.sqrt(light + SKY)
    data = light + error * rng.standard_normal(SHAPE)
    start = QTable({'x': x, 'y': y, 'flux': np.full(x.size, 2e3)})
    table = MixturePSFPhotometry(PSF, 11, xy_cov=True)(
        data, error=error, init_params=start)
    sky = add_sky_positions(table, wcs)
    there = wcs.pixel_to_world(np.asarray(table['x_fit']),
                               np.asarray(table['y_fit'])).icrs
    found = SkyCoord(sky['ra'], sky['dec'])
    assert found.separation(there).max() < 1e-3 * u.mas
    # The covariance by throwing dice: pixels of one star, seen on the sky.
    row = sky[7]
    cross = row['xy_cov']
    xy = rng.multivariate_normal(
        [row['x_fit'], row['y_fit']],
        [[row['x_err']**2, cross], [cross, row['y_err']**2]], 20_000)
    east, north = there[7].spherical_offsets_to(
        wcs.pixel_to_world(*xy.T).icrs)
    want = np.cov(east.to_value(u.mas), north.to_value(u.mas))
    got = [[row['ra_error'].value**2, row['radec_cov'].value],
           [row['radec_cov'].value, row['dec_error'].value**2]]
    assert_allclose(got, want, rtol=0.05, atol=0.02 * np.trace(want))


@pytest.mark.parametrize(('images', 'error'), [
    ([], ValueError), ([(np.zeros((9, 9)), PSF)], ValueError),
    ([(np.zeros((9, 9)), PSF, None)], TypeError),
    ([(np.zeros((9, 9)), 'psf', make_wcs())], TypeError)])
def test_wrong_images_are_refused(images, error):
    with pytest.raises(error, match=r'images|wcs'):
        fit_many(images, SkyCoord([150], [40], unit='deg'))


def test_a_table_without_a_measured_star_has_no_places():
    table = QTable({'x_fit': [np.nan], 'y_fit': [np.nan], 'x_err': [np.nan],
                    'y_err': [np.nan]})
    places = add_sky_positions(table, make_wcs())
    assert np.isnan(places['ra'].value).all()
    assert np.isnan(places['ra_error'].value).all()
