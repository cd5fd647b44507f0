"""Bright stars that are wider than faint ones."""
import warnings

import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose

from photutils_mgauss import (
    GaussianMixture,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
)

SHAPE = (420, 420)
SKY = 30.0
LARGEST = 4e5
# What the brightest star adds, xx, xy, yy [pix^2].
ADDED = np.array([0.05, 0.005, 0.07])


def psf_at(x, y, flux, added=ADDED):
    u = x / 210 - 1
    psf = GaussianMixture.from_stddevs(
        [0.8, 0.2], [[0, 0], [0.2, 0.1]],
        [[1.1 + 0.05 * u, 1.2], [2.4, 2.3]], [0.05, 0])
    xx, xy, yy = added * flux / LARGEST
    return psf.convolve([[xx, xy], [xy, yy]])


def image(added, seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[20:410:30, 20:410:30].reshape(2, -1)
    n = x.size
    stars = Table({'x': x + rng.uniform(-4, 4, n),
                   'y': y + rng.uniform(-4, 4, n),
                   'flux': LARGEST * 10 ** rng.uniform(-1.2, 0, n)})
    clean = np.zeros(SHAPE)
    for x, y, flux in stars.iterrows():
        i, j = max(round(x) - 25, 0), max(round(y) - 25, 0)
        part = clean[j:j + 51, i:i + 51]
        part += psf_at(x, y, flux, added).render(part.shape, x - i, y - j,
                                                 flux=flux)
    return rng.poisson(clean + SKY) - SKY, np.sqrt(clean + SKY), stars


def fit(given, **options):
    data, error, stars = given
    return fit_mixture_field(
        data, stars, error=error, n_components=2, degree=1, radius=10,
        **{'brighter_fatter': 'auto', **options})


@pytest.fixture(scope='module')
def given():
    return image(ADDED, 1)


@pytest.fixture(scope='module')
def field(given):
    with pytest.warns(AstropyUserWarning, match='bright stars are wider'):
        return fit(given)


def test_the_coefficient_is_found_within_its_error(field):
    row = field.brighter_fatter[0]
    found, errors = (np.array([row[f'{name}{end}'] for name in
                               ('xx', 'xy', 'yy')]) for end in ('', '_err'))
    assert np.abs((found - ADDED / LARGEST) / errors).max() < 3
    assert np.all(errors * LARGEST < 0.005)


@pytest.mark.parametrize('flux', [0.0, 2e5, 4e5])
def test_the_psf_of_each_flux_is_near_the_truth(field, flux):
    mine, truth = field.mixture_at(200, 150, flux=flux), psf_at(200, 150,
                                                                flux)
    assert_allclose(*(one.moments()[1] for one in (mine, truth)), atol=0.03)


def test_without_a_flux_it_is_the_psf_of_faint_stars(field):
    assert field.mixture_at(200, 150) == field.mixture_at(200, 150, flux=0)


@pytest.mark.parametrize('seed', [2, 3])
def test_stars_of_one_width_change_nothing(seed):
    given = image(0 * ADDED, seed)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        auto, off = fit(given), fit(given, brighter_fatter=False)
    assert auto.brighter_fatter is None
    assert auto == off


@pytest.mark.long
def test_it_can_be_asked_for_and_refused(given):
    assert fit(given, brighter_fatter=False).brighter_fatter is None
    narrow = fit(image(0 * ADDED, 4), brighter_fatter=True)
    assert narrow.brighter_fatter['significance'][0] < 25
    with pytest.raises(ValueError, match='brighter_fatter must be False for'):
        fit((given[0], given[1], given[2][:8]), brighter_fatter=True)
    with pytest.raises(ValueError, match="brighter_fatter must be 'auto'"):
        fit(given, brighter_fatter='yes')


def test_photometry_gives_each_star_the_psf_of_its_flux(field):
    data, error, stars = image(ADDED, 5)
    bright = np.asarray(stars['flux']) > 0.5 * LARGEST
    found = {}
    for name, psf in (('own', field), ('faint', field.to_grid((5, 5),
                                                              flux=0))):
        table = MixturePSFPhotometry(psf, 15)(data, error=error,
                                              init_params=QTable(stars))
        found[name] = table[bright]
    ratio = np.median(found['own']['flux_fit'] / stars['flux'][bright])
    assert abs(ratio - 1) < 0.001
    own, faint = (np.median(found[name]['reduced_chi2'])
                  for name in ('own', 'faint'))
    assert 0.9 < own < 1.1 < 1.3 < faint


@pytest.mark.parametrize('name', ['field.fits', 'field.asdf'])
def test_files_keep_it(field, tmp_path, name):
    field.write(tmp_path / name)
    again = MixtureField.read(tmp_path / name)
    assert again.mixture_at(5, 9, flux=1e5) == field.mixture_at(5, 9,
                                                                flux=1e5)


@pytest.mark.long
def test_exposures_share_it():
    given = [image(ADDED, seed) for seed in (6, 7)]
    with pytest.warns(AstropyUserWarning, match='bright stars are wider'):
        field = fit([list(one) for one in zip(*given, strict=True)])
    assert abs(field.brighter_fatter['xx'][0] * LARGEST - 0.05) < 0.005
    assert np.abs(field.exposures['xx']).max() < 0.01


def repelled(x, y, flux):
    """Return a scene of stars whose charge repels, in silicon."""
    from photutils_mgauss.simulation import (
        DetectorEffects,
        Instrument,
        csst_psf,
        simulate,
    )
    camera = Instrument(shape=(280, 280), read_noise=3.0, dark=0.0,
                        full_well=1e7, exposure_time=1.0)
    return simulate(QTable({'x': x, 'y': y, 'flux': flux}), instrument=camera,
                    psf=csst_psf((280, 280), variation=0), rng=3,
                    effects=DetectorEffects(brighter_fatter=4.0))


def weighted_size(stamp):
    """Return the second moment of a star in the middle, under a Gaussian."""
    half = len(stamp) // 2
    y, x = np.mgrid[-half:half + 1, -half:half + 1]
    weight = stamp * np.exp(-(x**2 + y**2) / 8)
    return (weight * (x**2 + y**2)).sum() / weight.sum()


def test_repulsion_in_silicon_is_found():
    pytest.importorskip('galsim')
    rng = np.random.default_rng(4)
    y, x = np.mgrid[20:270:34, 20:270:34].reshape(2, -1).astype(float)
    flux = 10 ** rng.uniform(3.8, 5.2, x.size)
    scene = repelled(x + rng.uniform(-0.5, 0.5, x.size),
                     y + rng.uniform(-0.5, 0.5, x.size), flux)
    with pytest.warns(AstropyUserWarning, match='bright stars are wider'):
        field = fit_mixture_field(
            scene.image - scene.background,
            QTable({'x': x, 'y': y, 'flux': flux}), error=scene.error,
            n_components=3, degree=0, brighter_fatter='auto')
    # What silicon does to stars in the middle of pixels, on other images.
    levels = 1e4, 1.5e5
    sizes = []
    for level, n in zip(levels, (64, 16), strict=True):
        again = repelled(x[:n], y[:n], np.full(n, level))
        light = again.image - again.background
        sizes.append(weighted_size(np.mean([
            light[int(b) - 8:int(b) + 9, int(a) - 8:int(a) + 9]
            for a, b in zip(x[:n], y[:n], strict=True)], axis=0)))
    found = [weighted_size(field.mixture_at(150, 150, flux=level).render(
        (17, 17), 8, 8, pixel_integrated=field.pixel_integrated))
        for level in levels]
    expected = sizes[1] - sizes[0]
    row = field.brighter_fatter[0]
    error = (row['xx_err'] + row['yy_err']) / (row['xx'] + row['yy'])
    assert abs((found[1] - found[0]) / expected - 1) < 0.1 + 2 * error
