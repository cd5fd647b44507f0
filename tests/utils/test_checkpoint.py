"""Long work goes on where it was stopped, with the same result."""
import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.psf_grids import epsf_grid
from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.crowded import plan
from photutils_mgauss.fitting import kept
from photutils_mgauss.utils.checkpoint import Checkpoint, digest_of


@dataclass(frozen=True)
class Thing:
    numbers: np.ndarray
    name: str


def test_equal_things_have_equal_digests():
    one, same = (Thing(np.arange(3.0), 'a') for _ in range(2))
    assert digest_of(one, {'b': 1}) == digest_of(same, {'b': 1})


@pytest.mark.parametrize('other', [
    Thing(np.arange(3.0), 'b'), Thing(np.arange(3), 'a'),
    Thing(np.arange(3.0)[None], 'a'), [np.arange(3.0), 'a'], None, 1, 1.0,
    True, '1', b'1', [1], [[1]], [], np.array(1), np.array([1]), np.float32(1)
])
def test_other_things_have_other_digests(other):
    things = [Thing(np.arange(3.0), 'a'), 2, '', np.zeros(0)]
    assert digest_of(other) not in [digest_of(one) for one in things]
    assert digest_of(other) == digest_of(other)
    assert digest_of(other, 1) != digest_of(other)


def test_the_order_of_bytes_in_memory_does_not_count():
    array = np.arange(6.0).reshape(2, 3)
    assert digest_of(array) == digest_of(np.asfortranarray(array))
    assert digest_of(array) != digest_of(array.T)


def test_what_was_kept_comes_back(tmp_path):
    store = Checkpoint(tmp_path / 'new')
    assert store.load('key') is None
    assert not (tmp_path / 'new').exists()
    store.save('key', {'a': np.arange(3), 'b/c': np.array('words')})
    back = store.load('key')
    assert_array_equal(back['a'], np.arange(3))
    assert str(back['b/c']) == 'words'
    assert [path.name for path in (tmp_path / 'new').iterdir()] == ['key.npz']


def test_a_damaged_piece_is_made_again(tmp_path):
    store = Checkpoint(tmp_path)
    store.save('key', {'a': np.arange(3)})
    path = tmp_path / 'key.npz'
    path.write_bytes(path.read_bytes()[:100])
    with pytest.warns(UserWarning, match='key.npz cannot be read and is made'):
        assert store.load('key') is None


def test_what_is_no_folder_is_refused(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(ValueError, match='must be a folder, but'):
        Checkpoint(tmp_path / 'file')
    with pytest.raises(TypeError, match='must be the name of a folder'):
        Checkpoint(3)


class Stopped(Exception):  # noqa: N818
    pass


def stop_after(monkeypatch, module, name, n):
    """Have a function of a module fail from its n-th call on."""
    right, calls = getattr(module, name), []

    def wrong(*args, **kwargs):
        calls.append(args)
        if len(calls) > n:
            raise Stopped
        return right(*args, **kwargs)
    monkeypatch.setattr(module, name, wrong)
    return calls


def test_a_grid_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    detectors = {name: epsf_grid() for name in 'AB'}
    detectors['B'].data[0] *= 1.01
    whole = GriddedMixturePSF.from_gridded_psf(detectors, 2)
    with monkeypatch.context() as patch:
        stop_after(patch, kept, 'fit_mixture', 1)
        with pytest.raises(Stopped):
            GriddedMixturePSF.from_gridded_psf(detectors, 2,
                                               checkpoint=tmp_path)
    with monkeypatch.context() as patch:
        calls = stop_after(patch, kept, 'fit_mixture', 1)
        psfs = GriddedMixturePSF.from_gridded_psf(detectors, 2,
                                                  checkpoint=tmp_path)
        assert len(calls) == 1
    for name, psf in psfs.items():
        for part in ('weights', 'means', 'covariances', 'scales'):
            assert_array_equal(getattr(psf._grid, part),
                               getattr(whole[name]._grid, part))
        assert (psf.report == whole[name].report).all()


@pytest.fixture(scope='module')
def scene():
    mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 200, (2, 150))
    data = 50 + sum(mixture.render((200, 200), *place, flux=3e3)
                    for place in zip(x, y, strict=True))
    error = np.sqrt(data)
    return (GriddedMixturePSF([mixture], [(0, 0)]),
            data + error * rng.normal(size=data.shape), error)


def assert_same(one, other):
    assert one.colnames == other.colnames
    for name in one.colnames:
        assert_array_equal(one[name], other[name])
        assert one[name].dtype == other[name].dtype
    assert one.meta == other.meta


@pytest.mark.long
@pytest.mark.parametrize('given', [False, True])
def test_tiles_go_on_where_they_were_stopped(scene, given, tmp_path,
                                             monkeypatch):
    psf, data, error = scene
    options = {'tile_shape': 100, 'overlap': 16}
    stars = None
    whole = CrowdedMixturePhotometry(psf, **options)(data, error=error)
    if given:
        stars = whole['x_fit', 'y_fit', 'flux_fit']
        whole = CrowdedMixturePhotometry(psf, **options)(
            data, error=error, init_params=stars)
    phot = CrowdedMixturePhotometry(psf, checkpoint=tmp_path, **options)
    with monkeypatch.context() as patch:
        stop_after(patch, plan, 'solve_tile', 3)
        with pytest.raises(RuntimeError, match='not finished'):
            phot(data, error=error, init_params=stars)
    with monkeypatch.context() as patch:
        calls = stop_after(patch, plan, 'solve_tile', 1)
        assert_same(phot(data, error=error, init_params=stars), whole)
        assert len(calls) == 1
        assert_same(phot(data, error=error, init_params=stars), whole)
    other = phot(data + 1, error=error, init_params=stars)
    assert (other['flux_fit'] != whole['flux_fit']).any()


def test_tiles_solved_elsewhere_are_kept_here(scene, tmp_path):
    distributed = pytest.importorskip('distributed')
    psf, data, error = scene
    options = {'tile_shape': 100, 'overlap': 16}
    whole = CrowdedMixturePhotometry(psf, **options)(data, error=error)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        with distributed.Client(n_workers=1, threads_per_worker=1,
                                processes=False,
                                dashboard_address=None) as client:
            phot = CrowdedMixturePhotometry(
                psf, checkpoint=tmp_path, executor=client.get_executor(),
                **options)
            assert_same(phot(data, error=error), whole)
    assert len(list(tmp_path.iterdir())) == 4
    # Nothing is left to be done by workers that are gone.
    assert_same(phot(data, error=error), whole)
