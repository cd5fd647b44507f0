"""fit_mixture on images as they come: unnormalised, negative, damaged."""
import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import (
    FitStatus,
    GaussianMixture,
    adaptive_moments,
    fit_mixture,
    read_psfex,
)

TRUTH = GaussianMixture.from_stddevs(
    [0.7, 0.3], [[0.1, -0.05], [-0.2, 0.1]], [[0.9, 1.0], [1.9, 1.7]],
    [0.1, -0.3])
GOOD = 5 * TRUTH.render((15, 15), 7, 7)


@pytest.mark.parametrize(('name', 'sums'), [
    ('DECam_00241238_01_*deg2.psf', (36, 39)),
    ('DECam_00154912_12_psfcat.psf', (1.13, 1.17))])
def test_planes_of_psfex_are_fitted_as_they_are(realdata, name, sums):
    (path,) = realdata('decam_psfex').glob(name)
    model = read_psfex(path)
    limits = [np.linspace(*axis, 3) for axis in model.position_range]
    planes = np.array([model.image_at(x, y) for y in limits[1]
                       for x in limits[0]])
    totals = planes.sum(axis=(1, 2))
    assert sums[0] < totals.min() < totals.max() < sums[1]
    for plane, total, fit in zip(planes, totals, fit_mixture(planes, 3),
                                 strict=True):
        assert fit.status == FitStatus.CONVERGED
        assert_allclose(fit.flux, total, rtol=0.02)
        shapes = adaptive_moments(plane)
        fitted = adaptive_moments(plane - fit.residual)
        assert abs(shapes.relative_size_error(fitted)) < 0.003
        # Three Gaussians follow the core of such a PSF to half a percent.
        assert abs(shapes.ellipticity_error(fitted)) < 0.005


def test_negative_wings_count_as_they_are(rng):
    noise = 0.005 * rng.standard_normal((200, *GOOD.shape))
    images = GOOD + noise
    fluxes = {}
    for name, stack in (('as it is', images),
                        ('clipped', np.clip(images, 0, None))):
        fits = fit_mixture(stack, 2, start=TRUTH, error=0.005)
        error = np.mean([np.sqrt(f.covariance[::6, ::6].sum()) for f in fits])
        off = np.mean([f.flux for f in fits]) - 5
        fluxes[name] = off / error * np.sqrt(len(fits))
    assert abs(fluxes['as it is']) < 4
    assert fluxes['clipped'] > 10


def one_bad_of(kind):
    """Return images (3, ny, nx), of which the second is bad, and a mask."""
    images = np.array([GOOD, GOOD, 2 * GOOD])
    mask = np.zeros(images.shape, bool)
    if kind == 'zero':
        images[1] = 0
    elif kind == 'negative':
        images[1] *= -1
    elif kind == 'nan':
        images[1, 3, 4] = np.nan
    elif kind == 'infinite':
        images[1, 3, 4] = np.inf
    elif kind == 'masked':
        mask[1] = True
    elif kind == 'small':
        mask[1, 3:] = True
        mask[1, :, 3:] = True
    return images, mask


@pytest.mark.parametrize('options', [
    {}, {'radius': 5}, {'enclosed_flux': 0.98}, {'normalize': 'tied'},
    {'weighting': 'astrometric', 'oversampling': 2}])
@pytest.mark.parametrize(('kind', 'status', 'words'), [
    ('zero', FitStatus.EMPTY, 'no positive flux'),
    ('negative', FitStatus.EMPTY, 'no positive flux'),
    ('nan', FitStatus.NOT_FINITE, 'NaN or infinite; mask them'),
    ('infinite', FitStatus.NOT_FINITE, 'NaN or infinite; mask them'),
    ('masked', FitStatus.TOO_FEW_PIXELS, 'Fewer pixels'),
    ('small', FitStatus.TOO_FEW_PIXELS, 'larger stamp')])
def test_a_bad_image_has_its_status_and_leaves_the_others_alone(
        kind, status, words, options):
    images, mask = one_bad_of(kind)
    fits = fit_mixture(images, 2, mask=mask, **options)
    assert fits[1].status == status
    assert words in fits[1].message
    assert fits[1].mixture is None
    assert np.isnan([fits[1].flux, fits[1].chi2, fits[1].bic]).all()
    alone = fit_mixture(images[2], 2, **options)
    assert_allclose(fits[2].mixture.means, alone.mixture.means, atol=1e-12)
    with pytest.raises(ValueError, match=words):
        fit_mixture(images[1], 2, mask=mask[1], **options)


def test_more_gaussians_than_the_pixels_allow_are_refused():
    image = TRUTH.render((5, 5), 2, 2)
    assert fit_mixture(image, 4).mixture.n_components == 4  # 24 of 25 pixels
    with pytest.raises(ValueError, match='fewer Gaussians'):
        fit_mixture(image, 5)
    statuses = {fit.status for fit in fit_mixture([image, image], 5)}
    assert statuses == {FitStatus.TOO_FEW_PIXELS}


@pytest.mark.parametrize('signed', [False, True])
@pytest.mark.parametrize('weighting', ['uniform', 'astrometric'])
def test_images_of_noise_do_not_crash(rng, weighting, signed):
    noise = rng.standard_normal((30, 15, 15))
    fits = fit_mixture(noise, 3, oversampling=2, weighting=weighting,
                       signed=signed)
    for fit in fits:
        assert (fit.mixture is not None) == fit.status.usable
        assert np.isfinite(fit.chi2) == fit.status.usable
