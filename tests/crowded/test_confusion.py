"""Errors and fluxes that allow for stars that were not found."""
import numpy as np
import pytest
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table
from astropy.wcs import WCS

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.crowded.confusion import (
    Hidden,
    _Beside,
    power_of_counts,
)
from photutils_mgauss.crowded.injection import match
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.psf.renderer import MixtureRenderer

PSF = GriddedMixturePSF(
    [GaussianMixture([0.8, 0.2], [(0, 0), (0, 0)],
                     [[[0.8, 0.1], [0.1, 0.7]], [[2.5, 0], [0, 2.5]]])],
    [(0, 0)])
SKY, LIMIT, SLOPE, SEEN = 45.0, 3.5, 1.5, 0.05
COLUMNS = ('x_confusion_err', 'y_confusion_err', 'flux_confusion_err',
           'flux_confusion')


def scene(size, density, seed, faintest=125.0):
    """Return data, errors and the stars of a field with counts f^-1.5."""
    rng = np.random.default_rng(seed)
    n = rng.poisson(density * size**2)
    stars = np.array([*rng.uniform(-0.5, size - 0.5, (2, n)),
                      faintest * rng.uniform(1e-4, 1, n)**-2])
    stars[2] = np.minimum(stars[2], 1e6)
    light = MixtureRenderer(PSF).image(stars, 1e-3, (size, size))
    data = rng.normal(light + SKY, np.sqrt(light + SKY))
    return data, np.sqrt(light + SKY), stars


def drawn_errors(flux, number, rng, n=20000):
    """Draw stars with hidden ones beside them; return errors (n, 2)."""
    half, reach = 8, 4.5
    grid = np.arange(2 * half + 1) - half
    mixture = PSF.mixture_at(0, 0)

    def star(x, y):
        return mixture.evaluate(grid[None] - x, grid[:, None] - y).ravel()
    e = 1e-4
    design = np.stack([star(0, 0), flux * (star(e, 0) - star(-e, 0)) / 2 / e,
                       flux * (star(0, e) - star(0, -e)) / 2 / e])
    weight = 1 / (SKY + flux * design[0])
    covariance = np.linalg.inv((design * weight) @ design.T)
    error = np.sqrt(np.diag(covariance))
    out = rng.normal(size=(n, 2))
    low = LIMIT * np.sqrt(SKY / (design[0] @ design[0]))
    density = number * (low**-0.5 - flux**-0.5) / 0.5
    count = rng.poisson(density * np.pi * reach**2, n)
    owner = np.repeat(np.arange(n), count)
    m = owner.size
    distance = reach * np.sqrt(rng.uniform(size=m))
    angle = rng.uniform(0, 2 * np.pi, m)
    g = (low**-0.5 - rng.uniform(size=m) * (low**-0.5 - flux**-0.5))**-2
    # On a fine polar grid of places, once and for all.
    near = np.rint(distance * 10).astype(int)
    turn = np.rint(angle / (2 * np.pi) * 24).astype(int) % 24
    for k in np.unique(near * 24 + turn):
        d, a = k // 24 / 10, k % 24 * 2 * np.pi / 24
        here = np.flatnonzero(near * 24 + turn == k)
        other = star(d * np.cos(a), d * np.sin(a))
        common = (design * weight) @ other
        answer = covariance @ common
        own = (other**2 * weight).sum()
        left = 1 - common @ answer / own
        strength = g[here] * np.sqrt(own * max(left, 1e-12))
        hidden = (left < SEEN) | (rng.normal(size=here.size)
                                  > strength - LIMIT)
        move = g[here, None] * (answer / error)[:2] * hidden[:, None]
        np.add.at(out, owner[here], move)
    return out


@pytest.mark.parametrize(('flux', 'number'), [
    (2e3, 0.3), (2e4, 0.3), (3e5, 0.3), (2e4, 1.0)])
def test_the_law_is_that_of_drawn_stars(flux, number):
    errors = drawn_errors(flux, number, np.random.default_rng(3))
    median = np.median(errors[:, 0])
    wide = [np.percentile(np.abs(errors[:, 0] - median), 68.27),
            np.percentile(np.abs(errors[:, 1]), 68.27)]
    beside = _Beside(LocalPSF.of(PSF), 0.0, 0.0)
    noise = np.sqrt(SKY)
    squares, medians = beside.law(
        flux / noise, flux / SKY,
        LIMIT / np.sqrt(beside.star @ beside.star),
        Hidden(LIMIT, SLOPE, np.nan),
        np.array([0, number * noise**(1 - SLOPE)]))
    assert squares[:, 0] == pytest.approx(0, abs=2e-3)
    assert np.sqrt(1 + squares[:, 1]) == pytest.approx(wide, rel=0.04)
    assert medians == pytest.approx([0, median], abs=0.06)


def counts(slope, end, n=5000):
    """Draw fluxes above limits, and below an end times the least limit."""
    rng = np.random.default_rng(2)
    limit = rng.uniform(200, 400, n)
    part = rng.uniform((end * 200 / limit)**(1 - slope), 1)
    return limit * part**(1 / (1 - slope)), limit


@pytest.mark.parametrize('slope', [1.3, 1.5, 2.2])
@pytest.mark.parametrize('end', [15, 1e3, 1e9])
def test_counts_have_their_power_wherever_they_end(slope, end):
    assert power_of_counts(*counts(slope, end)) == pytest.approx(slope,
                                                                 abs=0.06)


def test_the_power_of_curved_counts_is_that_near_the_limit():
    flux, limit = counts(1.5, 1e9)
    # Further up counts fall much faster.
    bend = 30 * limit
    flux = np.where(flux > bend, bend * (flux / bend)**0.2, flux)
    assert power_of_counts(flux, limit) == pytest.approx(1.5, abs=0.06)


@pytest.mark.parametrize('n', [0, 1, 2])
def test_where_few_stars_tell_counts_have_the_usual_power(n):
    flux = np.array([250.0, 2e3])[:n]
    assert power_of_counts(flux, np.full(n, 200.0)) == pytest.approx(
        1.5, abs=0.1)


@pytest.fixture(scope='module')
def crowd():
    data, error, stars = scene(200, 1 / 16, 4)
    return data, error, stars, CrowdedMixturePhotometry(PSF)(data,
                                                             error=error)


def pulls(table, stars, faintest=1e3):
    """Return the pulls (n, 3) of x, y and flux of the brighter stars."""
    bright = stars[:, stars[2] > faintest]
    fitted = tuple(np.asarray(table[f'{name}_fit'])
                   for name in ('x', 'y', 'flux'))
    none = (np.empty(0),) * 3
    row = match(bright, fitted, none, 0.5, 2.0)
    table, bright = table[row[row >= 0]], bright[:, row >= 0]
    return np.column_stack([
        (np.asarray(table[f'{name}_fit']) - bright[k])
        / np.asarray(table[f'{name}_err'])
        for k, name in enumerate(('x', 'y', 'flux'))])


def scatter(values):
    return 1.4826 * np.median(np.abs(values))


@pytest.fixture(scope='module')
def plain(crowd):
    return CrowdedMixturePhotometry(PSF, confusion=False)(crowd[0],
                                                          error=crowd[1])


def test_pulls_in_a_crowd_are_nearer_to_one(crowd, plain):
    with_term, without = (pulls(table, crowd[2])
                          for table in (crowd[3], plain))
    for k in (np.s_[:2], 2):
        new, old = (each[:, k] for each in (with_term, without))
        assert 0.8 < scatter(new - np.median(new)) < 1.2
        assert scatter(old - np.median(old)) > 1.2
    assert abs(np.median(with_term[:, 2])) < abs(np.median(without[:, 2]))


def test_the_term_has_its_columns_and_a_switch(crowd, plain):
    table = crowd[3]
    assert 'confusion' in table.meta
    assert 'confusion' not in plain.meta
    assert not set(COLUMNS) & set(plain.colnames)
    assert len(plain) == len(table)
    for name in ('x', 'y', 'flux'):
        part = table[f'{name}_confusion_err']
        assert (part >= 0).all()
        assert (part > 0).mean() > 0.99
        np.testing.assert_allclose(
            np.hypot(plain[f'{name}_err'], part), table[f'{name}_err'])
    np.testing.assert_allclose(
        plain['flux_fit'] - table['flux_confusion'], table['flux_fit'])
    np.testing.assert_array_equal(plain['x_fit'], table['x_fit'])


def test_covariance_of_x_and_y_stays_one(crowd):
    table = crowd[3]
    assert (np.abs(table['xy_cov'])
            < table['x_err'] * table['y_err']).all()


def test_in_a_sparse_field_nothing_is_hidden():
    data, error, _ = scene(200, 5e-4, 5)
    table = CrowdedMixturePhotometry(PSF)(data, error=error)
    for name in ('x', 'y', 'flux'):
        assert (table[f'{name}_confusion_err']
                < 0.15 * table[f'{name}_err']).all()
    alone = CrowdedMixturePhotometry(PSF, confusion=False)(data, error=error)
    assert np.median(table['x_err'] / alone['x_err']) < 1.005


def test_the_term_follows_the_density():
    parts = [scene(128, density, seed) for density, seed in
             ((0.004, 6), (0.08, 7))]
    data, error = (np.hstack([part[k] for part in parts]) for k in (0, 1))
    table = CrowdedMixturePhotometry(PSF)(data, error=error)
    faint = (table['flux_fit'] > 1e3) & (table['flux_fit'] < 1e4)
    share = np.asarray(table['x_confusion_err'] / table['x_err'])
    left = np.median(share[faint & (table['x_fit'] < 80)])
    right = np.median(share[faint & (table['x_fit'] > 176)])
    assert left < 0.5 * right


def test_a_complete_list_hides_nothing():
    data, error, stars = scene(100, 1 / 16, 8)
    table = CrowdedMixturePhotometry(PSF, find_neighbors=False)(
        data, error=error, init_params=Table(stars.T, names=('x', 'y',
                                                             'flux')))
    known = np.isfinite(table['x_err'])
    assert known.mean() > 0.9
    assert (table['x_confusion_err'][known] == 0).all()
    assert (table['flux_confusion'] == 0).all()


@pytest.mark.long
def test_fluxes_in_many_images_know_of_hidden_stars_too():
    _, error, stars = scene(200, 1 / 16, 4)
    light = MixtureRenderer(PSF).image(stars, 1e-3, error.shape) + SKY
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.cdelt = ('RA---TAN', 'DEC--TAN'), (-1e-5, 1e-5)
    wcs.wcs.crpix = 100, 100
    rng = np.random.default_rng(9)
    images = [(NDData(rng.normal(light, error), StdDevUncertainty(error)),
               PSF, wcs) for _ in range(3)]
    found = []
    for confusion in (True, False):
        table = CrowdedMixturePhotometry(
            None, confusion=confusion).fit_images(images)
        bright = stars[:, stars[2] > 1e3]
        row = match(bright, (table['x_fit'][:, 0].value,
                             table['y_fit'][:, 0].value,
                             np.asarray(table['flux'][:, 0])),
                    (np.empty(0),) * 3, 0.5, 2.0)
        true, row = bright[2, row >= 0, None], row[row >= 0]
        found.append((np.asarray(table['flux'])[row] - true)
                     / np.asarray(table['flux_err'])[row])
        assert ('flux_confusion' in table.colnames) == confusion
    new, old = (scatter(pull - np.median(pull)) for pull in found)
    assert 0.8 < new < 1.25 < old
    assert abs(np.median(found[0])) < abs(np.median(found[1]))
