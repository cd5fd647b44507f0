"""A focal plane fitted on many machines, one of which is lost."""
import os
import signal
import warnings

import pytest
from numpy.testing import assert_array_equal

from helpers.psf_grids import assert_is_truth, epsf_grid
from photutils_mgauss import GriddedMixturePSF

distributed = pytest.importorskip('distributed')


class LossyExecutor:
    """An executor one of whose machines dies when the first piece is done."""

    def __init__(self, executor, pids):
        self.executor = executor
        self.pids = pids
        self.n_done = 0

    def map(self, function, *columns):
        futures = [self.executor.submit(function, *column)
                   for column in zip(*columns, strict=True)]
        results = [futures[0].result()]
        if self.pids:
            os.kill(self.pids.pop(), signal.SIGKILL)
        results += [future.result() for future in futures[1:]]
        self.n_done += len(futures)
        return results


@pytest.fixture
def client():
    with warnings.catch_warnings():
        # Which port the dashboard gets is of no interest.
        warnings.simplefilter('ignore')
        with distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, dashboard_address=None,
                ) as cluster, distributed.Client(cluster) as client:
            yield client


@pytest.mark.filterwarnings('ignore')  # of distributed, when a worker dies
def test_a_worker_killed_in_the_middle_loses_nothing(client):
    pids = list(client.run(os.getpid).values())[:1]
    executor = LossyExecutor(client.get_executor(), pids)
    detectors = {name: epsf_grid() for name in 'AB'}
    psfs = GriddedMixturePSF.from_gridded_psf(detectors, 2, executor=executor)
    assert not pids
    assert executor.n_done > 8
    here = GriddedMixturePSF.from_gridded_psf(detectors['A'], 2)
    for psf in psfs.values():
        assert_is_truth(psf, rtol=1e-6)
        assert_array_equal(psf._grid.weights, here._grid.weights)
