"""Grids of mixtures and of ePSFs whose truth is known."""
import numpy as np
from astropy.nddata import NDData
from numpy.testing import assert_allclose
from photutils.psf import GriddedPSFModel

from photutils_mgauss import GaussianMixture, GriddedMixturePSF

PLACES = [(x, y) for y in (0, 40, 100) for x in (0, 50, 80)]


def some_mixture(rng, k=3):
    """Return a random mixture of k Gaussians."""
    return GaussianMixture.from_stddevs(
        rng.dirichlet(np.ones(k)), rng.normal(0, 0.2, (k, 2)),
        rng.uniform(0.8, 3, (k, 2)), rng.uniform(-0.5, 0.5, k))


def make_grid(x_grid=(0, 30, 100), y_grid=(0, 50), *, seed=3, shuffle=False,
              **kwargs):
    """Return a grid of random mixtures of 2 or 3 Gaussians."""
    rng = np.random.default_rng(seed)
    positions = [(x, y) for y in y_grid for x in x_grid]
    mixtures = [some_mixture(rng, 2 + i % 2) for i in range(len(positions))]
    if shuffle:
        order = rng.permutation(len(positions))
        positions = [positions[i] for i in order]
        mixtures = [mixtures[i] for i in order]
    return GriddedMixturePSF(mixtures, positions, **kwargs)


def truth_at(x, y, k=2):
    """Return a mixture that changes with position."""
    sizes = np.array([1.2, 2.6, 4.5])[:k]
    stddevs = np.column_stack([sizes * (1 + x / 1000), sizes * (1 + y / 800)])
    weights = np.array([0.7, 0.2, 0.1])[:k]
    return GaussianMixture.from_stddevs(
        weights / weights.sum(), np.column_stack([x * sizes, y * sizes])
        / 2000, stddevs, np.full(k, 0.1))


def truth_grid():
    """Return the grid of these mixtures."""
    return GriddedMixturePSF([truth_at(x, y) for x, y in PLACES], PLACES)


def epsf_grid(change=None, oversampling=3):
    """Return photutils' grid of the truth, its images changed."""
    grid = truth_grid()
    steps = np.arange(-36, 37) / oversampling
    data = np.array([1.06 * mixture.evaluate(steps, steps[:, None])
                     for mixture in grid.mixtures])
    if change is not None:
        change(data)
    meta = {'grid_xypos': PLACES, 'oversampling': oversampling}
    if np.isnan(data).any():
        # Photutils refuses such images in a model; files hold them.
        return PlainGrid(data, meta)
    return GriddedPSFModel(NDData(data, meta=meta))


class PlainGrid:
    """What `GriddedPSFModel` has, with any images in it."""

    def __init__(self, data, meta):
        self.data = data
        self.grid_xypos = meta['grid_xypos']
        self.oversampling = meta['oversampling']


def assert_is_truth(psf, scale=1.06, nodes=range(9), rtol=1e-3):
    """Check the mixtures of some nodes, and the scales of their fluxes."""
    steps = np.arange(-6, 7.0)
    for m in nodes:
        expected = truth_at(*PLACES[m]).evaluate(steps, steps[:, None])
        found = psf.mixtures[m].evaluate(steps, steps[:, None])
        assert_allclose(found, expected, atol=rtol * expected.max())
    assert_allclose(psf.scales[list(nodes)], scale, rtol=1e-3)
