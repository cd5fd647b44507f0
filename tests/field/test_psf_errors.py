"""What a fitted PSF may be off, and what stars measured with it know of it."""
from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
)

SHAPE = (150, 160)
SKY = 60.0


def truth(x, y, bend=0.0):
    """
    Return the PSF at a place; its shape bends over the detector.

    It is symmetric, so that its centre is its origin.
    """
    u, v = x / 80 - 1, y / 75 - 1
    size = 1.1 + 0.1 * u + bend * (u * u - v * v)
    return GaussianMixture.from_stddevs(
        [0.75, 0.25], [[0, 0], [0, 0]], [[size, size], [2.2, 2.0]],
        [0.05 * u + bend * u * v, 0.1])


def image(seed, n_psf, *, bend=0.0, photons=4e4):
    """Return clean data, error, stars of the PSF and stars to measure."""
    rng = np.random.default_rng(seed)
    grid = np.mgrid[14:SHAPE[1] - 12:19, 14:SHAPE[0] - 12:19].reshape(2, -1)
    x, y = grid + rng.uniform(-2, 2, grid.shape)
    clean = sum(truth(*place, bend).render(SHAPE, *place, flux=photons)
                for place in zip(x, y, strict=True))
    stars = Table({'x': x, 'y': y, 'flux': np.full(x.size, photons)})
    chosen = np.isin(np.arange(x.size), rng.permutation(x.size)[:n_psf])
    return clean, np.sqrt(clean + SKY), stars[chosen], stars[~chosen]


def noisy(clean, error, seed):
    return clean + np.random.default_rng(seed).normal(0, error)


def fit(clean, error, stars, seed, degree=1, **options):
    return fit_mixture_field(
        noisy(clean, error, seed), stars, error=error, n_components=2,
        degree=degree, radius=8, **options)


@pytest.fixture(scope='module')
def scene():
    return image(3, 20)


@pytest.fixture(scope='module')
def field(scene):
    return fit(*scene[:3], 4)


def measure(psf, clean, error, test, **options):
    return MixturePSFPhotometry(psf, 11, **options)(
        clean, error=error, init_params=test)


def test_the_images_of_changes_are_differences_of_mixtures(field):
    errors = field.psf_errors()
    node = 7
    mixture = [array[node] for array in (
        errors.grid.weights, errors.grid.means, errors.grid.covariances)]
    phase = np.array([0.2]), np.array([-0.4])
    found = errors.images(np.array([node]), *phase, (9, 11))[0]
    y, x = np.mgrid[-4:5, -5:6].reshape(2, -1)

    def drawn(change):
        covariance = change[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
        weights = mixture[0] + change[:, 0]
        total = weights.sum()
        return total * GaussianMixture(
            weights / total, mixture[1] + change[:, 1:3],
            mixture[2] + covariance).evaluate(x - phase[0], y - phase[1])

    assert_allclose(found[0], drawn(np.zeros((2, 6))), rtol=1e-10)
    step = 1e-4
    for image_, change in zip(found[3:], errors.changes[node], strict=True):
        expected = (drawn(step * change) - drawn(-step * change)) / (2 * step)
        assert_allclose(image_, expected, atol=1e-6 * np.abs(expected).max())
    moved = GaussianMixture(*mixture)
    slope = (moved.evaluate(x - phase[0] - step, y - phase[1])
             - moved.evaluate(x - phase[0] + step, y - phase[1])) / (2 * step)
    assert_allclose(found[1], slope, atol=1e-7)


def test_integrated_images_are_those_of_integrated_mixtures(field):
    errors = field.psf_errors()
    mixture = errors.grid.node(0)
    found = errors.images(np.zeros(1, int), np.array([0.3]), np.array([0.1]),
                          (9, 9), integrated=True)[0, 0]
    y, x = np.mgrid[-4:5, -4:5].reshape(2, -1)
    expected = mixture.evaluate(x - 0.3, y - 0.1, pixel_integrated=True)
    assert_allclose(found, expected, atol=1e-3 * expected.max())


@pytest.mark.long
def test_few_directions_hold_what_the_whole_covariance_does(scene, field):
    """Fields along all axes of the covariance move stars as it says."""
    clean, error, _, test = scene
    test = test[:12]
    values, axes = np.linalg.eigh(field.covariance)
    n_terms = len(field.coefficients)

    def places(change):
        coefficients = field.coefficients.copy()
        coefficients.reshape(n_terms, -1)[:, 3:] += change.reshape(
            -1, n_terms).T
        changed = replace(field, coefficients=coefficients)
        table = measure(changed.to_grid((7, 7)), clean, error, test,
                        psf_errors=False)
        return np.array([table[f'{name}_fit'] for name in ('x', 'y', 'flux')])

    # A tenth of a standard deviation, for which fits are linear.
    found = [5 * (places(0.1 * axis) - places(-0.1 * axis))
             for axis in (axes * np.sqrt(values)).T]
    exact = replace(field, unmodelled=None)
    table = measure(exact.to_grid((7, 7)), clean, error, test)
    for name, squares in zip(('x', 'y', 'flux'), np.square(found).sum(axis=0),
                             strict=True):
        ratio = table[f'{name}_psf_err'] / np.sqrt(squares)
        assert 0.9 < np.sqrt(np.mean(ratio**2)) < 1.1
        # At the nearest of 49 places, not at the star.
        assert (np.abs(ratio - 1) < 0.2).all()


@pytest.mark.parametrize('n_psf', [8, 25])
def test_stated_errors_contain_those_of_the_psf(n_psf):
    squares = []
    for seed in range(4):
        clean, error, stars, test = image(20 + seed, n_psf)
        psf = fit(clean, error, stars, 40 + seed).to_grid((5, 5))
        # Without noise of their own, stars show the errors of the PSF alone.
        table = measure(psf, clean, error, test)
        squares.append([np.mean(((table[f'{name}_fit'] - test[name])
                                 / table[f'{name}_psf_err'])**2)
                        for name in ('x', 'y')])
    assert 0.6 < np.sqrt(np.mean(squares)) < 1.5


def test_what_the_polynomials_miss_is_found_in_stars_left_out():
    squares, missed = [], []
    for seed in range(3):
        clean, error, stars, test = image(60 + seed, 14, bend=0.12)
        field = fit(clean, error, stars, 70 + seed)
        missed.append(field.unmodelled.max())
        table = measure(field.to_grid((5, 5)), clean, error, test)
        without = measure(replace(field, unmodelled=None).to_grid((5, 5)),
                          clean, error, test)
        assert (table['x_psf_err'] > without['x_psf_err']).all()
        squares.append(np.mean(((table['flux_fit'] - test['flux'])
                                / table['flux_psf_err'])**2))
    assert min(missed) > 1e-4
    assert 0.5 < np.sqrt(np.mean(squares)) < 1.6


@pytest.mark.long
def test_few_stars_have_a_degree_more_than_they_bear_by_themselves():
    squares, off = [], []
    for seed in range(4):
        clean, error, stars, test = image(60 + seed, 12, bend=0.06)
        tables = []
        for degree in ('auto', 1):
            field = fit(clean, error, stars, 70 + seed, degree=degree)
            tables.append(measure(field.to_grid((5, 5)), clean, error, test))
        # Degree 2 is too high for so few to choose it themselves.
        off.append([np.std(table['flux_fit'] / test['flux'])
                    for table in tables])
        squares.append(np.mean(((tables[0]['flux_fit'] - test['flux'])
                                / tables[0]['flux_psf_err'])**2))
    more, plain = np.sqrt(np.mean(np.square(off), axis=0))
    assert more < 0.8 * plain
    assert 0.6 < np.sqrt(np.mean(squares)) < 1.5


def test_nothing_is_missed_where_the_polynomials_are_the_truth(field):
    assert field.unmodelled.shape == (9,)
    assert field.unmodelled.max() < 1e-4


def test_the_part_of_the_psf_can_be_left_out(scene, field):
    clean, error, _, test = scene
    grid = field.to_grid((5, 5))
    table = measure(grid, clean, error, test, xy_cov=True)
    without = measure(grid, clean, error, test, xy_cov=True,
                      psf_errors=False)
    plain = measure(GriddedMixturePSF(grid.mixtures, grid.grid_xypos), clean,
                    error, test, xy_cov=True)
    assert not any('psf_err' in name for name in without.colnames)
    for name in without.colnames:
        assert_array_equal(without[name], plain[name])
    for name in ('x', 'y', 'flux'):
        assert_allclose(table[f'{name}_err']**2,
                        without[f'{name}_err']**2
                        + table[f'{name}_psf_err']**2)
        assert_array_equal(table[f'{name}_fit'], without[f'{name}_fit'])
    assert (np.abs(table['xy_cov'] - without['xy_cov'])
            <= table['x_psf_err'] * table['y_psf_err']).all()


def test_forced_fluxes_have_the_part_of_the_psf_alone(scene, field):
    clean, error, _, test = scene
    grid = field.to_grid((5, 5))
    grid.x_0.fixed = grid.y_0.fixed = True
    table = measure(grid, clean, error, test)
    assert np.isfinite(table['flux_psf_err']).all()
    assert np.isnan(table['x_psf_err']).all()
    with_sky = measure(field, clean, error, test, fit_sky=True)
    assert (with_sky['flux_psf_err'] > 0).all()


@pytest.mark.parametrize('suffix', ['fits', 'asdf'])
def test_files_keep_what_the_psf_may_be_off(tmp_path, scene, field, suffix):
    clean, error, _, test = scene
    expected = measure(field.to_grid((5, 5)), clean, error, test)
    for name, psf in (('field', field), ('grid', field.to_grid((5, 5)))):
        path = tmp_path / f'{name}.{suffix}'
        psf.write(path)
        again = type(psf).read(path)
        if name == 'field':
            assert_array_equal(again.unmodelled, field.unmodelled)
            again = again.to_grid((5, 5))
        table = measure(again, clean, error, test)
        for column in ('x_err', 'x_psf_err', 'flux_psf_err'):
            assert_array_equal(table[column], expected[column])


def test_files_without_the_errors_of_a_psf_are_read(tmp_path, field):
    old = {'grid': (field.to_grid((3, 3)), 'PSF_ERRORS'),
           'field': (field, 'UNMODELLED')}
    for name, (psf, table) in old.items():
        psf.write(tmp_path / 'new.fits')
        with fits.open(tmp_path / 'new.fits') as hdus:
            del hdus[table]
            hdus.writeto(tmp_path / f'{name}.fits')
        (tmp_path / 'new.fits').unlink()
    assert GriddedMixturePSF.read(tmp_path / 'grid.fits').errors is None
    again = MixtureField.read(tmp_path / 'field.fits')
    assert again.unmodelled is None
    assert_allclose(again.to_grid((3, 3)).errors.changes.shape[0], 49)


def test_damaged_errors_of_a_psf_are_refused(tmp_path, field):
    field.to_grid((3, 3)).write(tmp_path / 'a.fits')
    with fits.open(tmp_path / 'a.fits') as hdus:
        hdus['PSF_ERRORS'].data['change'][0] = np.nan
        hdus.writeto(tmp_path / 'b.fits', checksum=True)
    with pytest.raises(ValueError, match='errors of a PSF must be finite'):
        GriddedMixturePSF.read(tmp_path / 'b.fits')


def test_errors_are_convolved_with_the_psf(scene, field):
    grid = field.to_grid((5, 5))
    kernel = np.array([[0.4, 0.1], [0.1, 0.3]])
    errors = grid.convolve(kernel).errors
    assert_allclose(errors.grid.covariances,
                    grid.errors.grid.covariances + kernel)
    assert_array_equal(errors.changes, grid.errors.changes)
    pair = GaussianMixture([0.6, 0.4], [[0, 0], [0.5, 0]],
                           [np.eye(2), 2 * np.eye(2)])
    both = grid.convolve(pair).errors
    node, zero = np.zeros(1, int), np.zeros(1)
    one, two = (grid.convolve(GaussianMixture(
        [1], pair.means[[i]], pair.covariances[[i]])).errors.images(
            node, zero, zero, (11, 11)) for i in (0, 1))
    assert_allclose(both.images(node, zero, zero, (11, 11)),
                    0.6 * one + 0.4 * two, atol=1e-12)


def test_only_errors_of_a_psf_are_taken(field):
    grid = field.to_grid((3, 3))
    with pytest.raises(TypeError, match='errors must be PSFErrors or None'):
        GriddedMixturePSF(grid.mixtures, grid.grid_xypos, errors=0.1)


def test_tuned_fields_and_exposures_know_their_errors(scene, field):
    clean, error, stars, test = scene
    archive = field.to_grid((3, 3))
    tuned = fit(clean, error, stars, 9, start=archive)
    assert tuned.unmodelled.shape == (6,)
    table = measure(tuned.to_grid(), clean, error, test)
    assert (table['x_psf_err'] > 0).all()
    single = fit(clean, error, stars, 9)
    table, free = (measure(one.to_grid((3, 3)), clean, error, test)
                   for one in (tuned, single))
    assert np.median(table['flux_psf_err']) < np.median(free['flux_psf_err'])


def test_crowded_photometry_adds_the_part_of_the_psf(scene, field):
    clean, error, _, test = scene
    data = noisy(clean, error, 12)
    grid = field.to_grid((5, 5))
    tables = [CrowdedMixturePhotometry(grid, psf_errors=on)(
        data, error=error, init_params=test) for on in (True, False)]
    table, without = tables
    assert 'x_psf_err' not in without.colnames
    single = measure(grid, data, error, test)
    assert_allclose(table['x_psf_err'], single['x_psf_err'], rtol=0.3)
    assert_allclose(table['flux_err'], np.hypot(without['flux_err'],
                                                table['flux_psf_err']))


def test_units_of_fluxes_are_those_of_the_image(scene, field):
    import astropy.units as u
    clean, error, _, test = scene
    test = QTable(test)
    plain = measure(field, clean, error, test)
    test['flux'] = test['flux'] * u.electron
    table = measure(field, clean * u.electron, error * u.electron, test)
    assert table['flux_psf_err'].unit == u.electron
    assert_allclose(table['flux_psf_err'].value, plain['flux_psf_err'])
