"""The PSF of a crowded image from its own stars."""
import re
import sys
import warnings
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
    Instrument,
    MixtureField,
    crowded_field,
    csst_psf,
    fit_crowded_psf,
    inject_and_recover,
    render_stars,
    simulate,
)
from photutils_mgauss.crowded import psf_loop
from photutils_mgauss.field import fit as field_fit
from photutils_mgauss.field.growth import Wings
from photutils_mgauss.utils.image import read_pixels

pytestmark = pytest.mark.long
SHAPE = (160, 160)
QUICK = {'n_components': 3, 'degree': 1, 'radius': 10, 'max_stars': 100}


# What does not depend on where the loop ends need not wait for its end.
SHORT = QUICK | {'max_passes': 4}
unfinished = pytest.mark.filterwarnings('ignore:the PSF still changes')


@cache
def scene():
    psf = csst_psf(SHAPE)
    return psf, simulate(crowded_field(SHAPE, rng=3), psf=psf, rng=4,
                         instrument=Instrument(shape=SHAPE))


def image():
    seen = scene()[1]
    return {'data': seen.image, 'error': seen.error, 'mask': seen.mask}


@cache
def field():
    return fit_crowded_psf(**image(), **QUICK)


def corner():
    """Return a part of the image that a PSF is quickly made of."""
    return {name: array[:80, :80] for name, array in image().items()}


@cache
def field_of_corner():
    return fit_crowded_psf(**corner(), **SHORT)


def test_a_warning_of_the_last_pass_is_given_once(rng):
    from scipy.ndimage import gaussian_filter
    mixture = GaussianMixture([1], [(0, 0)], [[[1.2, 0], [0, 1.0]]])
    data = 100 + gaussian_filter(rng.normal(0, 10, (140, 140)), 0.8)
    for x, y in rng.uniform(8, 132, (60, 2)):
        data += mixture.render(data.shape, x, y,
                               flux=10 ** rng.uniform(3.3, 4.5))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        fit_crowded_psf(data, error=np.full(data.shape, 3.3), n_components=1,
                        degree=0, radius=8)
    said = [str(one.message) for one in caught]
    assert len([one for one in said if 'is correlated' in one]) == 1, said


@cache
def measured():
    """Return the stars, with the true PSF and with the image's own."""
    pixels = image()
    return [CrowdedMixturePhotometry(psf)(
        pixels['data'], error=pixels['error'], mask=pixels['mask'])
        for psf in (scene()[0], psf_loop.grid_of(field()))]


def beside_truth(table, low, high):
    """Return position errors (n,) and flux ratios of true stars found."""
    truth = scene()[1].truth
    magnitude = truth['mag'].value
    truth = truth[truth['inside'] & (magnitude > low) & (magnitude < high)]
    place, true = (np.array([t[x], t[y]]).T for t, x, y in (
        (table, 'x_fit', 'y_fit'), (truth, 'x', 'y')))
    gap, row = cKDTree(place).query(true)
    error = (place[row] - true)[gap < 0.5]
    ratio = np.asarray(table['flux_fit'])[row] / truth['flux']
    # Where in a PSF its centre is has no meaning.
    return np.hypot(*(error - np.median(error, axis=0)).T), ratio[gap < 0.5]


@pytest.mark.parametrize(('low', 'high', 'ratio'), [
    (17, 20, 1.6), (20, 22, 1.1)])
def test_stars_are_measured_almost_as_with_the_true_psf(low, high, ratio):
    # Three Gaussians: the brightest stars ask for more.
    true, own = (beside_truth(table, low, high) for table in measured())
    assert len(own[0]) >= 0.98 * len(true[0])
    assert np.median(own[0]) < ratio * np.median(true[0])
    assert abs(np.median(own[1]) - np.median(true[1])) < 0.015


def test_each_bright_star_is_used_or_has_a_reason_why_not():
    used, dropped = field().stars, field().dropped
    ids = np.concatenate([used['id'], dropped['id']])
    assert_array_equal(np.sort(np.unique(ids)), np.arange(1, ids.max() + 1))
    assert set(dropped['reason']) <= {
        'edge', 'masked', 'faint', 'extended', 'blended', 'surplus',
        'deviant'}
    assert (dropped['reason'] == 'edge').sum() > 3
    assert QUICK['max_stars'] / 2 < len(used) <= QUICK['max_stars']
    margin = np.min([used['x'], used['y'], 159 - used['x'],
                     159 - used['y']], axis=0)
    assert margin.min() > QUICK['radius']


def test_the_stars_are_spread_over_the_image():
    x, y = (np.asarray(field().stars[name]) for name in 'xy')
    count = np.histogram2d(x, y, bins=2, range=[[10, 149], [10, 149]])[0]
    assert count.min() > 0.5 * count.mean()


def test_none_is_the_psf_of_the_image(monkeypatch):
    seen, real = [], psf_loop.fit_field

    def quickly(image, options, *others):
        seen.append(options)
        return real(image, replace(options, n_components=3, degree=1),
                    *others)
    monkeypatch.setattr(psf_loop, 'fit_field', quickly)
    data = image()['data'][:80, :80]
    error = image()['error'][:80, :80]
    phot = CrowdedMixturePhotometry(None)
    table = phot(data, error=error)
    own = fit_crowded_psf(data, error=error)
    assert seen[0] == seen[1]
    assert_array_equal(phot.field.coefficients, own.coefficients)
    again = CrowdedMixturePhotometry(psf_loop.grid_of(own))(data, error=error)
    assert_array_equal(table['x_fit'], again['x_fit'])
    residual = phot.make_residual_image(data, include_local_bkg=True)
    assert np.median(np.abs(residual / error)) < 1
    phot = CrowdedMixturePhotometry(psf_loop.grid_of(own))
    assert phot.field is None


def test_artificial_stars_have_the_psf_of_the_image(monkeypatch):
    known = field()
    monkeypatch.setattr(psf_loop, 'fit_field', lambda *_args, **_kw: known)
    pixels = image()
    result = inject_and_recover(
        CrowdedMixturePhotometry(None), pixels['data'], (3e4, 6e4),
        error=pixels['error'], mask=pixels['mask'], rng=1)
    assert result.stars['recovered'].mean() > 0.8


@unfinished
def test_only_the_stars_of_a_list_are_used():
    chosen = field().stars[::2]
    stars = Table({'x': chosen['x_fit'], 'y': chosen['y_fit'],
                   'selected': np.arange(len(chosen)) > 4})
    own = fit_crowded_psf(**image(), **SHORT, stars=stars)
    gap, row = cKDTree(np.column_stack([stars['x'], stars['y']])).query(
        np.column_stack([own.stars['x'], own.stars['y']]))
    assert gap.max() < 1.5
    assert row.min() == 5


@unfinished
def test_the_unit_of_the_image_comes_back(tmp_path):
    pixels = corner()
    own = fit_crowded_psf(pixels['data'] * u.electron,
                          error=pixels['error'] * u.electron,
                          mask=pixels['mask'], **SHORT)
    assert len(own.stars) > 3
    assert len(own.dropped) > 3
    assert own.stars['flux_fit'].unit == own.dropped['flux'].unit == u.electron
    assert_allclose(own.coefficients, field_of_corner().coefficients)
    own.write(tmp_path / 'field.fits')
    again = MixtureField.read(tmp_path / 'field.fits')
    assert_array_equal(again.dropped['reason'], own.dropped['reason'])


def test_of_a_large_image_windows_are_used(monkeypatch):
    monkeypatch.setattr(psf_loop, '_LARGEST', 100)
    monkeypatch.setattr(psf_loop, '_WINDOW', 70)
    monkeypatch.setattr(psf_loop, '_WINDOWS', 2)
    own = fit_crowded_psf(**image(), **QUICK)
    for name in 'xy':
        place = np.asarray(own.stars[name])
        assert (((place > 10) & (place < 59))
                | ((place > 100) & (place < 149))).all()
    assert psf_loop.difference(own, field()) < 0.05


@unfinished
def test_a_checkpoint_gives_the_same(tmp_path):
    first, again = (fit_crowded_psf(**corner(), **SHORT,
                                    checkpoint=tmp_path / 'kept')
                    for _ in range(2))
    assert_array_equal(first.coefficients, again.coefficients)
    assert_array_equal(first.coefficients, field_of_corner().coefficients)


@unfinished
def test_a_bar_shows_the_passes(capfd, monkeypatch):
    monkeypatch.setattr(sys.stderr, 'isatty', lambda: True, raising=False)
    fit_crowded_psf(**corner(), **QUICK, max_passes=2, progress_bar=True)
    assert 'stars=' in capfd.readouterr().err


def test_a_psf_that_still_changes_is_said():
    with pytest.warns(AstropyUserWarning, match='still changes .* after '
                                                'max_passes=1'):
        fit_crowded_psf(**image(), **QUICK, max_passes=1)


@unfinished
def test_only_what_concerns_the_last_psf_is_said(monkeypatch):
    number, real = [], psf_loop.field_of_stars

    def outspoken(*given):
        number.append(len(number))
        warnings.warn(f'fit {number[-1]}', AstropyUserWarning, stacklevel=1)
        return real(*given)
    monkeypatch.setattr(psf_loop, 'field_of_stars', outspoken)
    with pytest.warns(AstropyUserWarning, match='fit') as told:
        fit_crowded_psf(**corner(), **SHORT)
    said = [str(one.message) for one in told]
    assert [one for one in said if one[:3] == 'fit'] == [f'fit {number[-1]}']
    assert len(number) > 3


@unfinished
def test_where_no_list_is_given_no_stars_of_it_are_missing(monkeypatch):
    monkeypatch.setattr(field_fit, '_LOST', -1)
    monkeypatch.setattr(field_fit, '_FEWEST_LOST', 0)
    fit_crowded_psf(**corner(), **SHORT)


@pytest.mark.parametrize(('changes', 'words'), [
    ({'max_passes': 0}, 'max_passes must be at least 1'),
    ({'radius': 1}, 'radius must be at least 5'),
    ({'min_snr': -1}, 'min_snr must be'),
    ({'degree': -1}, 'degree must be at least 0'),
    ({'min_snr': 1e7}, 'at least 5 stars good for the PSF, got 0 of .*faint'),
    ({'saturation': 25.0}, 'data must show'),
    ({'stars': Table({'x': [3.0], 'y': [4.0]})}, 'at least 5 stars'),
])
def test_what_cannot_be_is_said(changes, words):
    with pytest.raises(ValueError, match=words):
        fit_crowded_psf(**image() | changes)


def test_an_image_without_stars_is_said():
    data = np.random.default_rng(1).normal(100, 10, (100, 100))
    with pytest.raises(ValueError, match='data must show at least'):
        fit_crowded_psf(data, error=10.0)
    with pytest.raises(ValueError, match='data must have pixels'), (
            pytest.warns(AstropyUserWarning, match='no pixel')):
        fit_crowded_psf(data, error=10.0, mask=np.ones((100, 100), bool))


def test_faint_stars_of_a_dense_field_are_no_wings_of_the_psf():
    # One star in 27 pixels, all of them above ten times the noise.
    n, rng = 100, np.random.default_rng(5)
    psf = GaussianMixture.from_stddevs(
        [0.75, 0.23, 0.02], np.zeros((3, 2)), [(.95, .95), (1.6, 1.6), (4, 4)])
    x, y = rng.uniform(-5, n + 5, (2, 450))
    flux = np.minimum(300 * (rng.pareto(1.1, x.size) + 1), 3e5)
    light = render_stars(GriddedMixturePSF([psf], [(50, 50)]), x, y, flux,
                         (n, n)) + 50
    error = np.sqrt(light + 9)
    found = fit_crowded_psf(rng.normal(light, error), error=error,
                            n_components=3, degree=0, radius=12)
    for radius in (5, 8, 10):
        assert_allclose(found.mixture_at(50, 50).encircled_energy(radius),
                        psf.encircled_energy(radius), atol=0.01)


@pytest.mark.parametrize('few', [True, False])
def test_it_is_said_that_few_gaussians_miss_light(few):
    n, rng = 80, np.random.default_rng(6)
    psf = GaussianMixture.from_stddevs(
        [0.7, 0.3], np.zeros((2, 2)), [(.95, .95), (2.2, 2.2)])
    x, y = rng.uniform(0, n, (2, 60))
    light = render_stars(GriddedMixturePSF([psf], [(40, 40)]), x, y,
                         rng.uniform(1e4, 1e5, x.size), (n, n)) + 50
    data, error = rng.normal(light, np.sqrt(light)), np.sqrt(light)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter('always')
        fit_crowded_psf(data, error=error, n_components=1 if few else 2,
                        degree=0, radius=8)
    told = [str(one.message) for one in told if 'misses' in str(one.message)]
    assert len(told) == few
    if few:
        assert re.search(r'n_components=1 misses \d+\.\d% of the light .* '
                         r'n_components=6 0\.\d%', told[0])


@pytest.mark.parametrize(('places', 'n_passes'), [
    # Slowly on and on, then here and there.
    ([9, 5, 3, 2, 1, 0.8, 0.64, 0.5, 0.4, 0.33, 0.35, 0.2], 10),
    # At rest.
    ([9, 5, 3, 2, 1, 0.8, 0.64, 0.64], 7),
    # What a deeper pass changes says nothing of how it goes on.
    ([9, 5, 3, 2, 1, 2, 1.5, 1.2, 1.3], 8)])
def test_the_loop_ends_where_the_psf_no_longer_goes_one_way(
        monkeypatch, places, n_passes):
    fields = [SimpleNamespace(place=place, degree=0, n_components=6,
                              stars=Table({'used': [True]}))
              for place in places]
    passes = iter(fields[1:])
    monkeypatch.setattr(psf_loop, 'scale_of', lambda _: 1.0)
    for name, instead in {
            'first_field': lambda *_: fields[0],
            'next_field': lambda *_: (next(passes), None),
            'difference': lambda a, b: abs(a.place - b.place),
            '_with_far_light': lambda field, *_: field,
            '_with_unit': lambda field, _: field}.items():
        monkeypatch.setattr(psf_loop, name, instead)
    pixels = read_pixels(np.ones((9, 9)), np.ones((9, 9)))
    found = psf_loop.fit_field(pixels, psf_loop.LoopOptions(degree=0), None,
                               1.0)
    assert found is fields[n_passes]


@pytest.mark.long
def test_few_stars_tell_what_they_can_of_slopes():
    n, rng = 240, np.random.default_rng(2)
    psf = csst_psf((n, n), 'i', rng=2)
    x, y = rng.uniform(0, n, (2, 160))
    flux = 10**np.append(rng.uniform(4, 5.3, 30), rng.uniform(2.3, 3.6, 130))
    light = render_stars(psf, x, y, flux, (n, n)) + 60
    data, error = rng.normal(light, np.sqrt(light)), np.sqrt(light)
    listed = Table({'x': x, 'y': y, 'flux': flux})
    scatter = []
    for degree in (0, 'auto'):
        field = fit_crowded_psf(data, error=error, degree=degree)
        table = CrowdedMixturePhotometry(field)(
            data, error=error, init_params=listed)[:30]
        scatter.append(np.std(table['x_fit'] - x[:30])
                       + np.std(table['y_fit'] - y[:30]))
    assert field.degree > 0
    assert scatter[1] < 0.6 * scatter[0]


@unfinished
def test_light_beyond_the_stamps_is_in_the_psf(monkeypatch):
    known, light = field_of_corner(), 0.02
    for significance, share in ((20.0, light / (1 + light)), (2.0, 0.0)):
        wings = Wings.of(light, 0.001, significance, (1.0, 0.0),
                         QUICK['radius'])
        monkeypatch.setattr(psf_loop, 'far_light',
                            lambda *_, wings=wings: wings)
        own = psf_loop._with_far_light(known, known, None)
        assert_allclose(own.wing_share, share)
        assert_allclose(own.stars['flux_fit'],
                        known.stars['flux_fit'] / (1 - share))
