"""Fields whose PSF depends on the colour of a star."""
import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_allclose
from photutils.psf import SourceGrouper

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureField,
    MixturePSFPhotometry,
    fit_mixture_field,
)
from photutils_mgauss.psf.centre import centres

SHAPE = (420, 460)
SKY = 30.0
COLOURS = 0.2, 1.8


def psf_at(x, y, colour):
    """Return a PSF that is wider and more askew for red stars."""
    u, c = x / 230 - 1, colour - 1
    size = 1 + 0.04 * c
    stddevs = np.array([[1.1 + 0.05 * u, 1.2], [2.3, 2.2]]) * size
    return GaussianMixture.from_stddevs(
        [0.75, 0.25], [[0, 0], [0.3 + 0.15 * c, 0.1 - 0.1 * c * u]], stddevs,
        [0.05, 0])


def lateral(x, y, colour):
    """Return how far the light of a star is moved [pix]."""
    u, v = x / 230 - 1, y / 210 - 1
    return np.array([0.03 + 0.02 * u, -0.02 + 0.015 * v]) * (colour - 1)


def draw(stars, shift=False):
    """Return data and error of an image of stars."""
    rng = np.random.default_rng(8)
    clean = np.zeros(SHAPE)
    for x, y, flux, colour in stars.iterrows('x', 'y', 'flux', 'colour'):
        dx, dy = lateral(x, y, colour) if shift else (0, 0)
        i, j = max(round(x) - 25, 0), max(round(y) - 25, 0)
        part = clean[j:j + 51, i:i + 51]
        part += psf_at(x, y, colour).render(part.shape, x + dx - i,
                                            y + dy - j, flux=flux)
    return rng.poisson(clean + SKY) - SKY, np.sqrt(clean + SKY)


def catalogue(seed, flux, spacing=30):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[15:SHAPE[0] - 10:spacing,
                    15:SHAPE[1] - 10:spacing].reshape(2, -1)
    n = x.size
    return Table({'x': x + rng.uniform(-4, 4, n),
                  'y': y + rng.uniform(-4, 4, n), 'flux': np.full(n, flux),
                  'colour': rng.uniform(*COLOURS, n)})


def core_centre(mixture, stddev):
    return centres(mixture.weights[None], mixture.means[None],
                   mixture.covariances[None], stddev)[0]


def offsets(table, stars, field, shift=False):
    """Return measured positions less those of the cores' centres, mpix."""
    rows = zip(*(stars[name] for name in ('x', 'y', 'colour')), strict=True)
    truth = np.array([
        np.array([x, y]) + (0 if shift else core_centre(
            psf_at(x, y, c), field.centre_stddev)) for x, y, c in rows])
    return 1e3 * (np.column_stack([table['x_fit'], table['y_fit']]) - truth)


def red_less_blue(found, colour):
    """Return the mean offset of red stars less that of blue ones."""
    red = colour > 1
    return found[red].mean(axis=0) - found[~red].mean(axis=0)


@pytest.fixture(scope='module')
def stars():
    return catalogue(1, 3e5)


@pytest.fixture(scope='module')
def image(stars):
    return draw(stars)


def fit(image, stars, **options):
    data, error = image
    return fit_mixture_field(data, stars, error=error, n_components=2,
                             degree=1, radius=10, **options)


@pytest.fixture(scope='module')
def field(image, stars):
    return fit(image, stars, contexts=('colour',))


@pytest.fixture(scope='module')
def plain(image, stars):
    return fit(image, stars)


@pytest.mark.parametrize('colour', [0.3, 1.0, 1.7])
def test_the_psf_of_each_colour_is_near_the_truth(field, colour):
    steps = np.arange(-6, 6.1, 0.5)
    for x, y in [(60, 90), (380, 300)]:
        true = psf_at(x, y, colour)
        x_0, y_0 = core_centre(true, field.centre_stddev)
        truth = true.evaluate(steps + x_0, steps[:, None] + y_0)
        mine = field.mixture_at(x, y, colour=colour).evaluate(
            steps, steps[:, None])
        assert np.abs(mine - truth).max() < 0.005 * truth.max()


def test_without_a_colour_it_is_the_psf_of_the_mean_star(field, stars):
    mean = float(np.mean(stars['colour']))
    assert_allclose(field.mixture_at(50, 60).covariances,
                    field.mixture_at(50, 60, colour=mean).covariances)


def test_colours_beyond_those_of_the_stars_are_as_the_last(field, stars):
    last = float(np.max(stars['colour']))
    assert (field.mixture_at(50, 60, colour=9.0)
            == field.mixture_at(50, 60, colour=last))


def test_the_stars_of_all_colours_fit_better(field, plain):
    assert 0.9 < np.median(field.stars['reduced_chi2']) < 1.1
    assert field.accuracy < 0.3 * plain.accuracy


def test_photometry_gives_each_star_the_psf_of_its_colour(field, plain):
    stars = catalogue(2, 3e5)
    data, error = draw(stars)
    colour = np.asarray(stars['colour'])
    found = {}
    for psf in (field, plain):
        table = MixturePSFPhotometry(psf, 15)(data, error=error,
                                              init_params=QTable(stars))
        off = offsets(table, stars, field)
        ratio = table['flux_fit'] / stars['flux']
        found[psf] = (np.abs(red_less_blue(off, colour)).max(),
                      ratio[colour > 1].mean() - ratio[colour < 1].mean())
    shift, flux = found[field]
    assert shift < 0.5
    assert abs(flux) < 0.0008
    assert found[plain][0] > 5
    assert abs(found[plain][1]) > 0.0015


def test_red_and_blue_stars_stay_where_they_are_to_each_other(field):
    # Without noise, many stars: only the PSF is left.
    stars = catalogue(3, 3e5, 20)
    clean = draw(stars)[1] ** 2 - SKY
    table = MixturePSFPhotometry(field.to_grid((5, 5)), 15)(
        clean, error=np.sqrt(clean + SKY), init_params=QTable(stars))
    off = offsets(table, stars, field)
    assert np.abs(red_less_blue(off, np.asarray(stars['colour']))).max() < 0.2


def test_grouped_stars_of_different_colours_are_fitted_together(field):
    stars = Table({'x': [100.0, 104, 300], 'y': [100.0, 101, 200],
                   'flux': [3e5, 2e5, 1e5], 'colour': [0.3, 1.7, 1.0]})
    data, error = draw(stars)
    table = MixturePSFPhotometry(field, 15, grouper=SourceGrouper(8))(
        data, error=error, init_params=QTable(stars))
    assert table['group_size'].tolist() == [2, 2, 1]
    assert_allclose(table['flux_fit'], stars['flux'], rtol=0.012)
    assert np.abs(offsets(table, stars, field)).max() < 15
    assert table['reduced_chi2'].max() < 1.4


def test_a_star_of_unknown_colour_has_the_mean_one_and_it_is_said(field,
                                                                  image,
                                                                  stars):
    data, error = image
    known = QTable(stars[:4])
    unknown = QTable(stars[:4])
    unknown['colour'][1:3] = np.nan
    known['colour'][1:3] = field.contexts['mean'][0]
    expected = MixturePSFPhotometry(field, 15)(data, error=error,
                                               init_params=known)
    photometry = MixturePSFPhotometry(field, 15)
    with pytest.warns(AstropyUserWarning, match='2 of 4 stars have no colour'):
        table = photometry(data, error=error, init_params=unknown)
    assert_allclose(table['x_fit'], expected['x_fit'])
    with pytest.warns(AstropyUserWarning, match='4 of 4 stars have no colour'):
        MixturePSFPhotometry(field, 15)(data, error=error, init_params=known[
            'x', 'y', 'flux'])


def test_a_grid_of_one_colour_is_that_of_the_field(field):
    grid = field.to_grid((3, 4), colour=1.6)
    assert grid.contexts == ()
    assert_allclose(grid.mixture_at(0, 0).evaluate(1, 1),
                    field.mixture_at(0, 0, colour=1.6).evaluate(1, 1))
    free = field.to_grid((3, 4))
    assert [one.name for one in free.contexts] == ['colour']
    assert_allclose(free.at_context(colour=1.6).mixture_at(0, 0).evaluate(
        1, 1), field.mixture_at(0, 0, colour=1.6).evaluate(1, 1), rtol=1e-3)
    assert_allclose(free.evaluate(5, 5, 1, 5, 5),
                    field.mixture_at(5, 5).evaluate(0, 0), rtol=1e-2)


@pytest.mark.parametrize('name', ['psf.fits', 'psf.asdf'])
def test_files_keep_colours(field, tmp_path, name):
    for psf in (field, field.to_grid((2, 3)), field.to_grid((1, 1))):
        psf.write(tmp_path / name, overwrite=True)
        again = type(psf).read(tmp_path / name)
        if isinstance(psf, MixtureField):
            assert again.mixture_at(9, 9, colour=0.4) == psf.mixture_at(
                9, 9, colour=0.4)
        else:
            one, two = (each.at_context(colour=0.4) for each in (psf, again))
            assert isinstance(again, GriddedMixturePSF)
            assert one.mixture_at(9, 9) == two.mixture_at(9, 9)


@pytest.mark.long
def test_lateral_colour_is_found_from_positions_that_know_nothing_of_it():
    stars = catalogue(4, 1e6, 20)
    image = draw(stars, shift=True)
    field = fit(image, stars, contexts=('colour',), centre='catalogue')
    colour = np.asarray(stars['colour'])
    off = 1e3 * np.column_stack([field.stars['x_fit'] - stars['x'],
                                 field.stars['y_fit'] - stars['y']])
    assert np.abs(red_less_blue(off, colour)).max() < 0.3
    # In photometry of other stars.
    others = catalogue(5, 1e6, 20)
    data, error = draw(others, shift=True)
    table = MixturePSFPhotometry(field, 15)(data, error=error,
                                            init_params=QTable(others))
    off = offsets(table, others, field, shift=True)
    assert np.abs(red_less_blue(off, np.asarray(others['colour']))
                  ).max() < 0.5


@pytest.mark.parametrize(('options', 'text'), [
    ({'contexts': ('redness',)}, 'stars must have the column redness'),
    ({'contexts': ('flux',)}, 'contexts must be different names'),
    ({'contexts': ('same',)}, 'contexts must differ between stars'),
    ({'centre': 'catalogue'}, "centre must be 'core' or 'flux' without"),
])
def test_contexts_that_make_no_sense_are_errors(image, stars, options, text):
    table = stars.copy()
    table['same'] = 1.0
    with pytest.raises(ValueError, match=text):
        fit(image, table, **options)


def test_a_context_the_field_does_not_know_is_an_error(field, plain):
    with pytest.raises(ValueError, match="one of colour, got 'airmass'"):
        field.mixture_at(1, 1, airmass=2.0)
    with pytest.raises(ValueError, match="one of none, got 'colour'"):
        plain.to_grid((2, 2), colour=1.0)
