"""Files are written whole or not at all, and read without keeping memory."""
import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from helpers.psf_grids import make_grid, some_mixture
from photutils_mgauss import GaussianMixture, GriddedMixturePSF
from photutils_mgauss.files.tables import read_table
from photutils_mgauss.files.whole import whole_file

NAMES = ('a.fits', 'a.asdf', 'a.fits.gz')

FULL_DISK = """
import resource, sys
import numpy as np
from photutils_mgauss import GaussianMixture
rng = np.random.default_rng(1)
n = 3000
big = GaussianMixture(np.full(n, 1 / n), rng.normal(size=(n, 2)),
                      np.tile(np.eye(2), (n, 1, 1)))
resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
try:
    big.write(sys.argv[1], overwrite=True)
except OSError:
    sys.exit(3)
"""


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize('name', NAMES)
def test_the_old_file_survives_a_full_disk(tmp_path, name):
    some_mixture(np.random.default_rng(1)).write(tmp_path / name)
    before = (tmp_path / name).read_bytes()
    run = subprocess.run([sys.executable, '-c', FULL_DISK, tmp_path / name],
                         check=False)
    assert run.returncode == 3
    assert (tmp_path / name).read_bytes() == before
    assert names_in(tmp_path) == [name]


@pytest.mark.parametrize('name', NAMES)
def test_a_new_file_on_a_full_disk_leaves_nothing(tmp_path, name):
    run = subprocess.run([sys.executable, '-c', FULL_DISK, tmp_path / name],
                         check=False)
    assert run.returncode == 3
    assert names_in(tmp_path) == []


@pytest.mark.parametrize('stop', [KeyboardInterrupt, OSError])
def test_whatever_goes_wrong_nothing_is_left(tmp_path, stop):
    path = tmp_path / 'a.txt'
    path.write_text('old')
    with pytest.raises(stop), whole_file(path) as draft:  # noqa: PT012
        draft.write_text('new')
        assert path.read_text() == 'old'
        raise stop
    assert path.read_text() == 'old'
    assert names_in(tmp_path) == ['a.txt']


def test_a_file_that_exists_is_not_replaced_unasked(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('old')
    with pytest.raises(FileExistsError, match=r'a\.txt.*exists'), whole_file(
            path, overwrite=False):
        raise AssertionError
    path.unlink()
    with (pytest.raises(FileExistsError, match='exists'),  # noqa: PT012
          whole_file(path, overwrite=False) as draft):
        draft.write_text('new')
        path.write_text('made meanwhile')
    assert path.read_text() == 'made meanwhile'
    assert names_in(tmp_path) == ['a.txt']


def test_links_and_permissions_stay(tmp_path):
    path, link = tmp_path / 'a.fits', tmp_path / 'link.fits'
    mixture = some_mixture(np.random.default_rng(1))
    mixture.write(path)
    path.chmod(0o640)
    link.symlink_to(path)
    mixture.write(link, overwrite=True)
    assert link.is_symlink()
    assert path.stat().st_mode & 0o777 == 0o640
    assert names_in(tmp_path) == ['a.fits', 'link.fits']


def test_a_pipe_is_written_to(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with whole_file(pipe) as draft:
        assert draft == pipe.resolve()
        draft.write_text('through')
    assert os.read(reader, 100) == b'through'
    os.close(reader)
    assert pipe.is_fifo()


@pytest.mark.parametrize('name', ['a.txt', 'a'])
def test_a_name_must_tell_the_format(tmp_path, name):
    with pytest.raises(ValueError, match=r'a.*must end with \.fits or \.asdf'):
        make_grid().write(tmp_path / name)
    assert names_in(tmp_path) == []


def test_a_compressed_file_is_written_and_read(tmp_path):
    psf = make_grid()
    psf.write(tmp_path / 'a.fits.gz')
    assert (tmp_path / 'a.fits.gz').read_bytes()[:2] == b'\x1f\x8b'
    again = GriddedMixturePSF.read(tmp_path / 'a.fits.gz')
    np.testing.assert_array_equal(again.grid.means, psf.grid.means)


@pytest.mark.long
@pytest.mark.parametrize('name', ['a.asdf', 'a.fits'])
def test_two_hundred_reads_keep_no_memory(tmp_path, name):
    make_grid().write(tmp_path / name)

    def read(n):
        for _ in range(n):
            GriddedMixturePSF.read(tmp_path / name)
        # In kilobytes, on macOS in bytes.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == 'darwin' else 2**10)

    before = read(30)
    assert read(200) - before < 4


def test_a_folder_and_an_empty_file_are_named(tmp_path):
    (tmp_path / 'folder.fits').mkdir()
    (tmp_path / 'empty.fits').touch()
    with pytest.raises(OSError, match=r'/folder\.fits'):
        GriddedMixturePSF.read(tmp_path / 'folder.fits')
    with pytest.raises(ValueError, match=r'/empty\.fits: must be'):
        GaussianMixture.read(tmp_path / 'empty.fits')


@pytest.mark.parametrize('content', [
    b'', b'\x8a\x00', b'SIMPLE  =', b'%ECSV', b'<?xml version="1.0"?>'])
@pytest.mark.parametrize('name', ['a.ecsv', 'a.fits', 'a.xml'])
def test_what_is_no_table_is_named(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=r'/a\.\w+: must be'):
        read_table(tmp_path / name)
