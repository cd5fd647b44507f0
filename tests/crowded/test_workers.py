"""Tiles of crowded images on workers that die."""
import os
import signal
import threading
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)

MIXTURE = GaussianMixture([0.8, 0.2], [[0, 0], [0.1, 0]],
                          [[[0.6, 0.05], [0.05, 0.5]], [[3, 0], [0, 3]]])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])


def image(shape=(200, 70), n=450):
    rng = np.random.default_rng(5)
    data = np.full(shape, 20.0)
    for y, x, flux in zip(*rng.uniform(0, np.array(shape)[:, None], (2, n)),
                          10**rng.uniform(2.7, 5, n), strict=True):
        data += MIXTURE.render(shape, x, y, flux=flux)
    return rng.poisson(data) + rng.normal(0, 5, shape), np.sqrt(data + 25)


def kill_once(pids, folder):
    """Kill -9 the workers soon after a tile has been kept."""
    while not list(folder.glob('*.npz')):
        time.sleep(0.05)
    time.sleep(0.5)
    for pid in pids:
        os.kill(pid, signal.SIGKILL)


def test_a_worker_that_is_killed_costs_its_tile_and_no_more(tmp_path,
                                                            caplog):
    distributed = pytest.importorskip('distributed')
    data, error = image()
    with distributed.Client(n_workers=1, threads_per_worker=1,
                            dashboard_address=None) as client:
        pids = list(client.run(os.getpid).values())
        killer = threading.Thread(target=kill_once, args=(pids, tmp_path),
                                  daemon=True)
        killer.start()
        phot = CrowdedMixturePhotometry(
            PSF, tile_shape=70, overlap=32, checkpoint=tmp_path,
            executor=client.get_executor())
        table = phot(data, error=error)
        killer.join(timeout=60)
        assert not killer.is_alive()
        assert set(client.run(os.getpid).values()).isdisjoint(pids)
    assert len(list(tmp_path.glob('*.npz'))) == 3
    assert 'was killed by signal 9' in caplog.text
    # What has come back from a worker is not done again when it dies.
    assert 'lose already computed' not in caplog.text
    here = CrowdedMixturePhotometry(PSF, tile_shape=70, overlap=32)(
        data, error=error)
    assert_allclose(table['x_fit'], here['x_fit'], atol=1e-9)
