"""Objects in FITS and ASDF files: what is read is what was written."""
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path

import asdf
import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning
from numpy.testing import assert_array_equal

from helpers.psf_grids import make_grid, some_mixture
from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixtureField,
    MultiGaussianPSFModel,
)
from photutils_mgauss.files.asdf_extension import enabled

ROOT = Path(__file__).parents[2]


def free_model():
    """Return a model with bounds, units and freed shapes."""
    model = MultiGaussianPSFModel(
        some_mixture(np.random.default_rng(3)), flux=7 * u.nJy, x_0=1 / 3,
        name='star', pixel_integrated=True).free_shape()
    model.x_0.bounds = (-1, None)
    return model


def small_field():
    """Return a field with invented numbers in all its parts."""
    rng = np.random.default_rng(6)
    stars = QTable({'id': [1, 3], 'x': [4.0, 5.5], 'y': [7.0, 8 / 3],
                    'used': [True, False], 'reason': ['', 'deviant']})
    return MixtureField(
        rng.normal(size=(3, 2, 6)), (30, 40), 5.5, rng.normal(size=(27, 27)),
        stars, rng.normal(size=(2, 5, 5)), 1e-3,
        QTable({'id': [3], 'reason': ['deviant']}))


OBJECTS = {
    'field': small_field,
    'one field': lambda: MixtureField(
        np.zeros((1, 1, 6)), (3, 3), 2, np.ones((3, 3)),
        QTable({'x': [1.0], 'y': [2.0], 'used': [True]})),
    'mixture of 1': lambda: GaussianMixture([1], [[0.1, 0]], [np.eye(2)]),
    'mixture of 3': lambda: some_mixture(np.random.default_rng(4)),
    'model': free_model,
    'model of 1': lambda: MultiGaussianPSFModel(n_components=1),
    'grid': lambda: make_grid(flux=0.1, x_0=3, name='chip 3'),
    'one node': lambda: GriddedMixturePSF(
        [GaussianMixture([1], [[0, 0]], [np.eye(2)])], [(4, 5)],
        outside='nan'),
    'column': lambda: make_grid((5,), (0, 3, 11), pixel_integrated=True),
    'matched': lambda: make_grid((5, 6), (0, 3), scales=[1, 1.1, 1, 1 / 3],
                                 interpolation='components'),
}


@pytest.fixture(params=OBJECTS)
def stored(request):
    """Return each object in turn."""
    return OBJECTS[request.param]()


def assert_same(a, b):
    """Compare every bit of every column."""
    assert type(a) is type(b)
    tables = a._to_tables(), b._to_tables()
    assert tables[0].keys() == tables[1].keys()
    for name, columns in tables[0].items():
        assert columns.keys() == tables[1][name].keys()
        for column, values in columns.items():
            first = np.asarray(values)
            second = np.asarray(tables[1][name][column])
            assert first.shape == second.shape
            if first.dtype.kind == 'f' and first.size:
                assert second.dtype == first.dtype
                assert first.tobytes() == second.tobytes()
            else:
                assert_array_equal(first, second)


@pytest.mark.parametrize('name', ['a.fits', 'a.asdf'])
def test_round_trips_keep_every_bit(stored, name, tmp_path):
    stored.write(tmp_path / name)
    again = type(stored).read(tmp_path / name)
    assert_same(stored, again)
    assert repr(again) == repr(stored)


@pytest.mark.parametrize('fmt', ['fits', 'asdf'])
def test_open_files_and_odd_names_work_too(stored, fmt, tmp_path):
    stored.write(tmp_path / 'psf', format=fmt)
    assert_same(type(stored).read(tmp_path / 'psf'), stored)
    with (tmp_path / 'psf').open('rb') as file:
        assert_same(type(stored).read(file), stored)


@pytest.mark.parametrize('name', ['a.fits', 'a.asdf'])
def test_files_are_not_overwritten_by_accident(stored, name, tmp_path):
    stored.write(tmp_path / name)
    with pytest.raises(OSError, match='exist'):
        stored.write(tmp_path / name)
    stored.write(tmp_path / name, overwrite=True)
    with pytest.raises(FileNotFoundError):
        type(stored).read(tmp_path / 'missing' / name)


def test_asdf_opens_what_any_tree_holds(stored, tmp_path):
    with enabled():
        asdf.AsdfFile({'a': {'b': [stored]}}).write_to(tmp_path / 'a.asdf')
        with asdf.open(tmp_path / 'a.asdf') as file:
            assert_same(file['a']['b'][0], stored)


def test_the_report_travels_with_the_grid(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.fits')
    again = GriddedMixturePSF.read(tmp_path / 'a.fits').report
    assert again.colnames == psf.report.colnames
    assert_array_equal(again['message'], psf.report['message'])


def test_any_fits_tool_can_read_the_tables(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.fits')
    nodes = Table.read(tmp_path / 'a.fits', hdu='NODES')
    assert nodes.colnames == ['X', 'Y', 'SCALE', 'WEIGHT', 'MEAN',
                              'COVARIANCE']
    assert_array_equal(nodes['X'], psf.grid_xypos[:, 0])
    assert nodes['COVARIANCE'].shape == (6, 3, 2, 2)
    assert nodes['COVARIANCE'].unit == u.pix**2


@pytest.mark.parametrize('name', ['a.fits', 'a.asdf'])
def test_a_file_of_another_class_is_refused(name, tmp_path):
    some_mixture(np.random.default_rng(1)).write(tmp_path / name)
    with pytest.raises(ValueError, match=r'must hold a GriddedMixturePSF, got '
                       r'a GaussianMixture; GaussianMixture\.read takes it'):
        GriddedMixturePSF.read(tmp_path / name)


def test_files_of_others_are_refused(tmp_path):
    fits.PrimaryHDU(np.ones((2, 2))).writeto(tmp_path / 'a.fits')
    asdf.AsdfFile({'a': 3}).write_to(tmp_path / 'a.asdf')
    for name in ('a.fits', 'a.asdf'):
        with pytest.raises(ValueError, match='got a file of another pro'):
            GriddedMixturePSF.read(tmp_path / name)


def test_one_of_several_objects_is_not_taken_unasked(tmp_path):
    one, two = make_grid(), make_grid(seed=4)
    mixture = some_mixture(np.random.default_rng(1))
    with enabled():
        asdf.AsdfFile({'A1': one, 'B1': two, 'mean': mixture}).write_to(
            tmp_path / 'a.asdf')
    with pytest.raises(ValueError, match=r'a\.asdf: .* got 2, A1, B1; asdf'):
        GriddedMixturePSF.read(tmp_path / 'a.asdf')
    with pytest.raises(ValueError, match='got 3, A1, B1, mean; asdf'):
        GriddedMixturePSF.from_file(tmp_path / 'a.asdf')
    assert_same(GaussianMixture.read(tmp_path / 'a.asdf'), mixture)


def test_images_with_extensions_are_refused_in_words(tmp_path):
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.ones((2, 2)), name='SCI')
                  ]).writeto(tmp_path / 'image.fits')
    with pytest.raises(ValueError, match=r'image\.fits: must hold a .*'
                       'from_file takes the PSFs of other programs'):
        GriddedMixturePSF.read(tmp_path / 'image.fits')


def test_a_newer_version_is_refused_by_name(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.fits')
    fits.setval(tmp_path / 'a.fits', 'MGVERS', value=2)
    with fits.open(tmp_path / 'a.fits', mode='update') as hdus:
        hdus[0].add_checksum()
    with pytest.raises(ValueError, match='got version 2: it was written by a '
                       'newer photutils_mgauss'):
        GriddedMixturePSF.read(tmp_path / 'a.fits')


def test_a_newer_version_in_asdf_is_refused_by_name(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.asdf')
    content = (tmp_path / 'a.asdf').read_bytes()
    for old, new, message in [
            (b'version: 1\n', b'version: 2\n', 'newer photutils_mgauss'),
            (b'GriddedMixturePSF-1.0.0', b'GriddedMixturePSF-9.0.0',
             'GriddedMixturePSF-9.0.0')]:
        assert content.count(old) == 1
        (tmp_path / 'b.asdf').write_bytes(content.replace(old, new))
        with pytest.raises(ValueError, match=message):
            GriddedMixturePSF.read(tmp_path / 'b.asdf')


@pytest.mark.parametrize('name', ['a.fits', 'a.asdf'])
@pytest.mark.parametrize('fraction', [0.3, 0.6, 0.95])
def test_truncated_files_are_refused(name, fraction, tmp_path):
    psf = make_grid(np.arange(12), np.arange(12))
    psf.write(tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[:int(fraction * len(content))])
    with pytest.raises(ValueError, match='must be undamaged'):
        GriddedMixturePSF.read(tmp_path / name)


def test_a_changed_byte_in_fits_is_noticed(tmp_path):
    make_grid().write(tmp_path / 'a.fits')
    with fits.open(tmp_path / 'a.fits') as hdus:
        where = hdus['NODES'].fileinfo()['datLoc'] + 100
    content = bytearray((tmp_path / 'a.fits').read_bytes())
    content[where] ^= 1
    (tmp_path / 'a.fits').write_bytes(content)
    with pytest.raises(ValueError, match=r'(?i)undamaged, got .*checksum'):
        GriddedMixturePSF.read(tmp_path / 'a.fits')


def test_a_missing_column_is_named(tmp_path):
    make_grid().write(tmp_path / 'a.fits')
    with fits.open(tmp_path / 'a.fits') as hdus:
        left = [column for column in hdus['NODES'].columns
                if column.name != 'SCALE']
        hdus['NODES'] = fits.BinTableHDU.from_columns(left, name='NODES')
        hdus.writeto(tmp_path / 'b.fits', checksum=True)
    with pytest.raises(ValueError, match="got none for 'scale' of 'nodes'"):
        GriddedMixturePSF.read(tmp_path / 'b.fits')


@pytest.mark.parametrize(('column', 'value', 'message'), [
    ('WEIGHT', 0.7, 'weights must sum to 1'),
    ('COVARIANCE', -1.0, 'covariances must be'),
    ('X', np.nan, 'nodes must be finite'),
    ('Y', 77.0, 'rectangular grid'),
    ('SCALE', -1.0, 'scales must be positive'),
])
def test_values_in_a_file_are_checked(column, value, message, tmp_path):
    make_grid().write(tmp_path / 'a.fits')
    with fits.open(tmp_path / 'a.fits') as hdus:
        hdus['NODES'].data[column].reshape(6, -1)[0, 0] = value
        hdus.writeto(tmp_path / 'b.fits', checksum=True)
    with pytest.raises(ValueError, match=message):
        GriddedMixturePSF.read(tmp_path / 'b.fits')


def install(folder):
    """Make the package look installed, with the project's entry points."""
    project = tomllib.loads((ROOT / 'pyproject.toml').read_text())['project']
    info = folder / 'photutils_mgauss-0.1.dist-info'
    info.mkdir()
    (info / 'METADATA').write_text(
        'Metadata-Version: 2.1\nName: photutils_mgauss\nVersion: 0.1\n')
    lines = []
    for group, points in project['entry-points'].items():
        lines += [f'[{group}]', *(f'{k} = {v}' for k, v in points.items())]
    (info / 'entry_points.txt').write_text('\n'.join(lines))


def test_asdf_finds_the_package_by_its_entry_points(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.asdf')
    asdf.AsdfFile({'a': 3}).write_to(tmp_path / 'b.asdf')
    install(tmp_path)
    code = f"""
import sys, asdf
sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]
from photutils_mgauss.files import asdf_extension
asdf_extension.extensions(), asdf_extension.resource_mappings()
heavy = {{'photutils', 'numba', 'scipy', 'astropy.modeling'}}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
asdf.open({str(tmp_path / 'b.asdf')!r}).close()
assert 'photutils_mgauss.psf.gridded' not in sys.modules
with asdf.open({str(tmp_path / 'a.asdf')!r}) as file:
    print(file['psf'])
    assert 'photutils_mgauss.psf.gridded' in sys.modules
"""
    out = subprocess.run([sys.executable, '-W', 'error::UserWarning', '-c',
                          code], check=True, capture_output=True, text=True)
    assert 'GriddedMixturePSF' in out.stdout


def test_reading_leaves_other_warnings_alone(tmp_path):
    make_grid().write(tmp_path / 'a.fits')
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        GriddedMixturePSF.read(tmp_path / 'a.fits')
        warnings.warn('still seen', AstropyUserWarning, stacklevel=1)
    assert [str(w.message) for w in caught] == ['still seen']
