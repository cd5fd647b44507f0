"""Photometry of whatever users hand over: each trouble stays where it is."""
import signal
import sys
import time
import warnings
from functools import partial
from itertools import product
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import PSFPhotometry, SourceGrouper

from helpers.star_images import MIXTURE, PSF
from photutils_mgauss import (
    CrowdedMixturePhotometry,
    MixtureField,
    MixtureFitter,
    MixturePSFPhotometry,
    decode_psf_flags,
)

SHAPE = (121, 141)


def observe(x, y, flux, rng, shape=SHAPE):
    light = np.zeros(shape)
    for star in zip(x, y, flux, strict=True):
        light += MIXTURE.render(shape, star[0], star[1], flux=star[2])
    error = np.sqrt(np.abs(light) + 25)
    return light + error * rng.standard_normal(shape), error


def lattice(rng):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(15.0, 130, 20),
                                           np.arange(15.0, 110, 20)))
    return (x + rng.uniform(-0.5, 0.5, x.size),
            y + rng.uniform(-0.5, 0.5, x.size))


def quiet(photometry, *args, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        return photometry(*args, **kwargs)


def test_all_troubles_at_once_are_flagged_and_spoil_no_other_star(rng):
    x, y = lattice(rng)
    flux = np.full(x.size, 2e4)
    flux[3] = -2e4
    data, error = observe(x, y, flux, rng)
    data += MIXTURE.render(SHAPE, 140.4, 120.3, flux=2e4)
    good = QTable({'x': x, 'y': y, 'flux': flux})
    clean = MixturePSFPhotometry(PSF, 9)(data, error=error, init_params=good)
    mask = np.zeros(SHAPE, bool)
    near = [np.rint(a).astype(int) for a in (x, y)]
    mask[near[1][5] - 4:near[1][5] + 5, near[0][5] - 4:near[0][5] + 5] = True
    data[near[1][7] + 1, near[0][7]] = np.nan
    data[near[1][8] - 4:near[1][8] + 5, near[0][8] - 4:near[0][8] + 5] = np.inf
    error[0, 0] = 0  # Under nobody.
    bad = QTable({'x': [-50.0, np.nan, 1e9, x[11], 140.4, -0.6],
                  'y': [10.0, 20, 30, y[11], 120.3, 60],
                  'flux': [1.0, 1, 1, 2e4, 2e4, np.inf]})
    bad.add_row([75.0, np.inf, 5.0])
    start = QTable({name: np.concatenate([good[name], bad[name]])
                    for name in good.colnames})
    theirs, ours = (quiet(cls(PSF, 9), data, mask=mask | ~np.isfinite(data),
                          error=error, init_params=start)
                    for cls in (PSFPhotometry, MixturePSFPhotometry))
    table = quiet(MixturePSFPhotometry(PSF, 9), data, mask=mask, error=error,
                  init_params=start)
    for name in table.colnames:
        assert_array_equal(table[name], ours[name], name)
    assert ours['flags'][3] & 4
    # A start with an infinite flux or at nowhere is nobody's to fit.
    known = np.isfinite(start['x']) & np.isfinite(start['y']) & np.isfinite(
        start['flux'])
    assert_array_equal(ours['flags'][known], theirs['flags'][known])
    assert ours['flags'][5] & 128
    assert ours['flags'][8] & 128
    assert_array_equal(ours['flags'][x.size:x.size + 3] & (64 | 512) > 0,
                       True)
    own = np.setdiff1d(np.arange(x.size), [5, 7, 8])
    for name in ('x_fit', 'y_fit', 'flux_fit', 'x_err', 'flags'):
        assert_array_equal(table[name][own], clean[name][own], name)
    # Two entries for one star, not grouped, both find it.
    assert_allclose(table['x_fit'][x.size + 3], table['x_fit'][11],
                    atol=1e-6)


@pytest.mark.parametrize('shape', [(1, 41), (41, 1), (1, 1), (2, 2)])
def test_thin_images_are_fitted_or_flagged_as_photutils_does(rng, shape):
    middle = (shape[1] - 1) / 2 + 0.1, (shape[0] - 1) / 2
    data, error = observe([middle[0]], [middle[1]], [1e4], rng, shape)
    start = QTable({'x': [middle[0]], 'y': [middle[1]], 'flux': [9e3]})
    ours = quiet(MixturePSFPhotometry(PSF, 9), data, error=error,
                 init_params=start)
    assert ours['n_pixels_fit'][0] == min(shape[0], 9) * min(shape[1], 9)
    assert ours['flags'][0] & 1
    if data.size < 3:
        assert ours['flags'][0] & 256


@pytest.mark.parametrize('apart', [0, 0.1, 0.3, 0.6])
def test_stars_almost_in_one_place_fit_at_least_as_well_as_in_photutils(
        rng, apart):
    for _ in range(5):
        x, y = np.array([15.2, 15.2 + apart]), np.array([14.9, 14.9])
        data, error = observe(x, y, [1e4, 7e3], rng, (31, 31))
        start = QTable({'x': x, 'y': y, 'flux': [1e4, 7e3],
                        'group_id': [1, 1]})
        theirs, ours = (quiet(cls(PSF, 9), data, error=error,
                              init_params=start)
                        for cls in (PSFPhotometry, MixturePSFPhotometry))
        chi2 = [float(np.sum(t['reduced_chi2'])) for t in (theirs, ours)]
        assert chi2[1] < chi2[0] * (1 + 1e-3)
        if apart >= 0.3:
            assert not (ours['flags'] & 8).any()


def test_a_field_is_taken_as_its_grid(rng):
    x, y = lattice(rng)
    flux = np.full(x.size, 2e4)
    data, error = observe(x, y, flux, rng)
    coefficients = rng.normal(0, 0.02, (3, 2, 6))
    coefficients[0] = [[0, 0, 0, 1, 1, 0], [-1, 0, 0, 0.5, 0.5, 0]]
    field = MixtureField(coefficients, SHAPE, 5.5, np.eye(27),
                         QTable({'x': [1.0], 'y': [2.0], 'used': [True]}))
    start = QTable({'x': x, 'y': y, 'flux': flux})
    by_field, by_grid = (
        MixturePSFPhotometry(psf, 9)(data, error=error, init_params=start)
        for psf in (field, field.to_grid()))
    for name in by_grid.colnames:
        assert_array_equal(by_field[name], by_grid[name], name)


@pytest.mark.parametrize('name', ['x', 'flux'])
def test_a_masked_start_is_none_whatever_lies_under_the_mask(rng, name):
    x, y = lattice(rng)
    data, error = observe(x, y, np.full(x.size, 2e4), rng)
    start = Table({'x': x, 'y': y, 'flux': np.full(x.size, 2e4)}, masked=True)
    start[name].mask[3] = True
    theirs, ours = (quiet(cls(PSF, 9), data, error=error, init_params=start)
                    for cls in (PSFPhotometry, MixturePSFPhotometry))
    assert_array_equal(ours['flags'], theirs['flags'])
    assert np.isnan(ours['flux_fit'][3])
    assert_allclose(ours['flux_fit'], theirs['flux_fit'], rtol=1e-5)


def test_a_masked_background_is_not_subtracted(rng):
    x, y = lattice(rng)
    data, error = observe(x, y, np.full(x.size, 2e4), rng)
    start = Table({'x': x, 'y': y, 'flux': np.full(x.size, 2e4),
                   'local_bkg': np.ma.array(np.full(x.size, 99.0), mask=True)})
    got = MixturePSFPhotometry(PSF, 9)(data, error=error, init_params=start)
    start.remove_column('local_bkg')
    want = MixturePSFPhotometry(PSF, 9)(data, error=error, init_params=start)
    assert_array_equal(got['flux_fit'], want['flux_fit'])


@pytest.mark.parametrize(('steps', 'kind'), [
    (0, ValueError), (-1, ValueError), (1.5, TypeError), ('a', TypeError)])
def test_a_number_of_steps_that_is_none_is_refused(rng, steps, kind):
    data, _ = observe([20.0], [20.0], [2e4], rng)
    start = QTable({'x': [20.0], 'y': [20.0], 'flux': [2e4]})
    # Some versions of photutils refuse it themselves.
    with pytest.raises((ValueError, TypeError), match='maxiters must be'):
        MixturePSFPhotometry(PSF, 9, fitter_maxiters=steps)(
            data, init_params=start)
    with pytest.raises(kind, match=f'maxiter must be .*{steps}'):
        MixtureFitter()(PSF, [0, 1, 2, 3], [0, 1, 1, 0], [1, 1, 1, 1],
                        maxiter=steps)


@pytest.mark.parametrize('name', ['finder', 'grouper',
                                  'local_bkg_estimator'])
def test_what_cannot_be_called_is_named(name):
    with pytest.raises(TypeError, match=f'{name} must be callable.* got 3'):
        MixturePSFPhotometry(PSF, 9, **{name: 3})


def test_a_progress_bar_is_shown_on_terminals_if_asked_for(
        rng, capsys, monkeypatch):
    x, y = lattice(rng)
    flux = np.full(x.size, 2e4)
    data, error = observe(x, y, flux, rng)
    start = QTable({'x': x, 'y': y, 'flux': flux})
    for wanted, terminal in product((False, True), repeat=2):
        monkeypatch.setattr(sys.stderr, 'isatty',
                            partial(bool, terminal), raising=False)
        MixturePSFPhotometry(PSF, 9, progress_bar=wanted)(
            data, error=error, init_params=start)
        written = capsys.readouterr()
        assert ('100%' in written.err) == (wanted and terminal)
        assert not written.out


def test_an_interrupt_ends_all_threads_within_a_second(rng):
    x, y = lattice(rng)
    data, error = observe(x, y, np.full(x.size, 2e4), rng)
    start = QTable({'x': np.tile(x, 20_000), 'y': np.tile(y, 20_000),
                    'flux': np.full(x.size * 20_000, 1e4)})
    fit = MixturePSFPhotometry(PSF, 9)
    fit(data, error=error, init_params=start[:50])
    at = []

    def interrupt(*_):
        at.append(time.process_time())
        raise KeyboardInterrupt
    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, 2)
    try:
        with pytest.raises(KeyboardInterrupt):
            fit(data, error=error, init_params=start)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    # On all cores together.
    assert time.process_time() - at[0] < 1


@pytest.mark.parametrize(('table', 'error', 'words'), [
    (Table({'x': [], 'y': []}), ValueError, 'at least one row, got none'),
    (Table({'ra': [1.0], 'dec': [2.0]}), ValueError,
     r"such as x_init and y_init, or x and y, got \['ra', 'dec'\]"),
    (Table({'x': ['a'], 'y': [2.0]}), TypeError,
     "column 'x' must hold numbers"),
    (QTable({'x': [2.0] * u.deg, 'y': [2.0] * u.deg}), ValueError,
     "column 'x' must have a unit like pix, got deg"),
])
def test_a_list_that_is_none_of_places_in_pixels_is_said(table, error, words):
    photometry = MixturePSFPhotometry(PSF, 9, aperture_radius=3)
    with pytest.raises(error, match=words):
        photometry(np.ones((31, 31)), error=1.0, init_params=table)


@pytest.mark.parametrize('masked', [True, False])
def test_a_star_without_a_place_spoils_no_other_if_fluxes_are_unknown(
        rng, masked):
    x, y = np.array([15.2, 40.3, 70.1, 100.4]), np.full(4, 30.6)
    data, error = observe(x, y, np.full(4, 2e4), rng)
    photometry = MixturePSFPhotometry(PSF, 9, aperture_radius=3,
                                      grouper=SourceGrouper(5))
    clean = photometry(data, error=error, init_params=Table(
        {'x': x[2:], 'y': y[2:]}))
    if masked:
        bad = Table({'x': np.ma.array(x, mask=[1, 0, 0, 0]),
                     'y': np.ma.array(y, mask=[0, 1, 0, 0])})
    else:
        bad = Table({'x': [np.nan, *x[1:]], 'y': [y[0], np.inf, *y[2:]]})
    with warnings.catch_warnings():
        warnings.simplefilter('error', RuntimeWarning)
        table = photometry(data, error=error, init_params=bad)
    assert len(table) == 4
    assert np.isnan(table['x_fit'][:2]).all()
    assert_allclose(table['x_fit'][2:], clean['x_fit'], atol=1e-12)
    assert_allclose(table['flux_fit'][2:], clean['flux_fit'], rtol=1e-12)
    assert not np.isfinite(table['x_init'][0] + table['y_init'][0])
    assert all('no_overlap' in words or 'non_finite_position' in words
               for words in decode_psf_flags(table['flags'][:2]))


def test_a_mixture_is_no_model_and_the_sentence_says_what_is():
    for call in (lambda: MixturePSFPhotometry(MIXTURE, 9),
                 lambda: CrowdedMixturePhotometry(MIXTURE)):
        with pytest.raises(TypeError, match=r'MultiGaussianPSFModel\(mix'):
            call()


@pytest.mark.parametrize(('psf', 'words'), [
    (MIXTURE, r'a GaussianMixture: give MultiGaussianPSFModel\(mixture\)'),
    (SimpleNamespace(mixture=MIXTURE), r'MultiGaussianPSFModel\(fit\.mix'),
    (SimpleNamespace(grid_xypos=[]), 'from_gridded_psf makes one of it'),
    ('psf.fits', r"'psf\.fits': GriddedMixturePSF\.from_file reads"),
    (3, 'a flux, got 3$')])
@pytest.mark.parametrize('make', [lambda psf: MixturePSFPhotometry(psf, 5),
                                  CrowdedMixturePhotometry])
def test_what_is_no_model_is_named_with_what_makes_one(make, psf, words):
    with pytest.raises(TypeError, match=words):
        make(psf)
