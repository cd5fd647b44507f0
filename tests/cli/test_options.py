"""What can be said of images and observers that their files do not say."""
import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import (
    CartesianRepresentation,
    Distance,
    SkyCoord,
    get_body_barycentric,
)
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.time import Time
from numpy.testing import assert_allclose

from photutils_mgauss.cli.observers import check_observer, observer_at
from photutils_mgauss.cli.star_image import Reading, read_image
from photutils_mgauss.cli.targets import (
    check_targets,
    only_targets,
    seen_directions,
)
from photutils_mgauss.files.image_header import Cards


@pytest.mark.parametrize('value', [
    'JD 2458961.9214392', '2458961.9214392', 2458961.9214392, 58961.4214392,
    'MJD 58961.4214392', '2020-113T10:06:52.348', '2020-04-22T10:06:52.348',
    '2020-04-22 10:06:52.348', 2020.30642])
def test_a_keyword_has_the_time_in_any_form(value):
    time = Cards({'WHEN': value}).time_at('WHEN')
    assert abs((time - Time('2020-04-22T10:06:52.348')).to_value('min')) < 6
    assert time.scale == ('tdb' if value == 2020.30642 else 'utc')


def test_the_scale_of_a_keyword_is_that_of_the_header():
    cards = Cards({'WHEN': 58961.5, 'TIMESYS': 'TDB'})
    assert cards.time_at('WHEN').scale == 'tdb'


@pytest.mark.parametrize(('value', 'said'), [
    (None, 'the keyword WHEN must have the time, but is not there'),
    ('noon', "must be a date, a Julian date or a Julian year, got 'noon'"),
    (3.0, 'got 3.0'), (-2458961.0, 'got -2458961.0'), ('JD 58961', 'got')])
def test_a_keyword_without_a_time_is_named(value, said):
    with pytest.raises(ValueError, match=said):
        Cards({'WHEN': value}).time_at('WHEN')


@pytest.fixture
def image(tmp_path, rng):
    """Write an image whose extensions have names of their own."""
    data = rng.normal(1, 2, (60, 60)).astype('f4')
    error = np.where(data < 0, 0, np.sqrt(4 + np.abs(data) / 10))
    flags = np.zeros((60, 60), np.int16)
    flags[3, 5] = 1
    data[7, 7], error[7, 7] = 5, 0
    path = tmp_path / 'odd.fits'
    fits.HDUList([
        fits.PrimaryHDU(data), fits.ImageHDU(error, name='Errors of it'),
        fits.ImageHDU(flags, name='Bits of it')]).writeto(path)
    return path


def reading(**more):
    return Reading(ext='0', error_ext='Errors of it', flags_ext='2', **more)


def test_extensions_of_any_name_can_be_said(image):
    with pytest.warns(UserWarning, match='pixels are negative and have'):
        read = read_image(image, reading())
    with fits.open(image, memmap=False) as hdus:
        data, error, _ = (hdu.data for hdu in hdus)
    assert read.mask.sum() == 2
    assert read.mask[3, 5]
    assert read.mask[7, 7]  # no error, for no reason that is known
    assert read.layers.sources['error'] == 'ERRORS OF IT'
    negative = (data < 0) & ~read.mask
    faint = (error > 0) & (data <= np.median(data))
    assert_allclose(read.noise.total[negative], np.median(error[faint]))
    assert_allclose(read.noise.total[data > 0], error[data > 0])


@pytest.mark.parametrize(('name', 'option'), [
    ('error_ext', '--error-ext'), ('flags_ext', '--flags-ext')])
def test_an_extension_that_is_not_there_is_named(image, name, option):
    with pytest.raises(ValueError, match=f'{option} must name an image of 2 '
                       r'dimensions \(0, ERRORS OF IT, BITS OF IT\), got NO'):
        read_image(image, Reading(ext='0', **{name: 'NO'}))


# Observers.

def test_places_between_times_are_interpolated(tmp_path):
    days = 2458960.5 + np.arange(0, 12, 2.0)
    places = get_body_barycentric('earth', Time(days, format='jd',
                                                scale='tdb')).xyz
    path = str(tmp_path / 'earth.ecsv')
    QTable({'JDTDB': days, 'X': places[0], 'Y': places[1].to('km'),
            'Z': places[2]}).write(path)
    check_observer(path, 3)
    time = Time(2458965.1, format='jd', scale='tdb')
    place = observer_at(path, 'b', ['a', 'b', 'c'], time)
    true = get_body_barycentric('earth', time).xyz.to_value(u.au)
    assert_allclose(place.xyz.to_value(u.au), true, atol=1e-6)
    with pytest.raises(ValueError, match='must have places at all times'):
        observer_at(path, 'b', ['a', 'b', 'c'], 2024.0)


def test_places_may_be_listed_with_the_exposures(tmp_path):
    path = str(tmp_path / 'places.csv')
    Table({'x': [1.0, 2], 'y': [3.0, 4], 'z': [5.0, 6]}).write(path)
    check_observer(path, 2)
    place = observer_at(path, 'b', ['a', 'b'], 2020.0)
    assert_allclose(place.xyz.to_value(u.au), [2, 4, 6])
    with pytest.raises(ValueError, match='a row for each of the 3 exposures'):
        check_observer(path, 3)


@pytest.mark.parametrize(('columns', 'said'), [
    ({'x': [1.0], 'y': [1.0]}, 'must have the columns x, y and z'),
    ({'x': [1.0], 'y': [1.0], 'z': [1.0], 'time': ['noon']}, 'noon')])
def test_a_table_of_no_places_is_refused(tmp_path, columns, said):
    path = str(tmp_path / 'bad.csv')
    Table(columns).write(path)
    with pytest.raises(ValueError, match=rf'bad\.csv: .*{said}'):
        check_observer(path, 1)


def test_an_observer_that_is_nobody_is_refused():
    with pytest.raises(ValueError, match='must be earth, leo, l2 or the name'):
        check_observer('moon', 2)
    check_observer('L2', 2)
    assert observer_at(None, 'a', ['a'], 2020.0) is None


# Single objects.

@pytest.fixture
def targets():
    return Table({'id': ['near', 'far'], 'ra': [217.39, 10.0],
                  'dec': [-62.676, 89.99], 'pmra': [-3781.7, 5.0],
                  'pmdec': [769.5, -7.0], 'parallax': [768.0, 0.0],
                  'ref_epoch': [2016.0, 2016.0]})


@pytest.mark.filterwarnings('ignore:ERFA')  # of infinite distances
def test_objects_are_where_astropy_sees_them(targets):
    observer = CartesianRepresentation(13.5, -42.0, -16.4, unit='au')
    start = SkyCoord(
        targets['ra'] * u.deg, targets['dec'] * u.deg,
        distance=Distance(parallax=np.maximum(targets['parallax'], 1e-6)
                          * u.mas),
        pm_ra_cosdec=targets['pmra'] * u.mas / u.yr,
        pm_dec=targets['pmdec'] * u.mas / u.yr,
        obstime=Time(2016.0, format='jyear', scale='tdb'))
    moved = start.apply_space_motion(Time(2020.3, format='jyear',
                                          scale='tdb'))
    seen = moved.cartesian.xyz - observer.xyz[:, None]
    seen = (seen / np.linalg.norm(seen, axis=0)).value
    away = seen_directions(targets, 2020.3, observer) - seen
    # Perspective, which is not known without a velocity, is left out.
    assert np.degrees(np.abs(away)).max() * 3.6e6 < 1.5


def test_only_objects_near_their_places_are_taken(targets):
    place = SkyCoord(seen_directions(targets, 2020.3, None).T,
                     representation_type='cartesian')
    place.representation_type = 'unitspherical'
    place = place.directional_offset_by(90 * u.deg, [0.5, 9] * u.arcsec)
    stars = Table({'ra': [*place.ra.deg, 50.0], 'dec': [*place.dec.deg, 2.0],
                   'id': [4, 5, 6]})
    found, words = only_targets(stars, targets, 2020.3, None, None)
    assert list(found['id']) == ['near']
    assert words[0] == 'near is 500 mas from where it should be seen'
    assert words[1].endswith('which is more than 3000')
    assert len(only_targets(stars, targets, 2020.3, None, 1e4)[0]) == 2


def test_a_table_of_objects_needs_its_columns(targets):
    check_targets(targets)
    targets.remove_column('parallax')
    with pytest.raises(ValueError, match='got no parallax'):
        check_targets(targets)
