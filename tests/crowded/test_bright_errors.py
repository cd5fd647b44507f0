"""Errors of saturated stars of a tile whose PSF is off over pixels."""
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from photutils_mgauss.crowded.bright_errors import with_wing_errors

N, SIDE, SPREAD, NOISE, FLUX = 150, 17, 3.0, 4.0, 50.0
DY, DX = np.indices((SIDE, SIDE)) - SIDE // 2
SEEN = np.hypot(DY, DX) > 3
LIGHT = np.exp(-np.hypot(DY, DX) / 3)
DESIGN = np.stack([LIGHT, LIGHT * DX, LIGHT * DY])


def tile(seed):
    """
    Return a tile of stars one above the other, and their errors (N, 3).

    With the covariances (N, 3, 3) of pixels that are off each for itself.
    """
    rng = np.random.default_rng(seed)
    design = DESIGN * np.array([1, FLUX, FLUX])[:, None, None]
    variance = np.where(SEEN, SPREAD**2 + NOISE**2, np.inf)
    covariance = np.linalg.inv(np.einsum('ajk,bjk,jk->ab', design, design,
                                         1 / variance))
    residual, moved = [], []
    for _ in range(N):
        misfit = gaussian_filter(rng.normal(size=(SIDE + 20,) * 2), 0.8)[
            10:-10, 10:-10] * 1.6 * np.sqrt(np.pi)
        image = SPREAD * misfit + NOISE * rng.normal(size=(SIDE, SIDE))
        moved.append(covariance @ (design * image / variance).sum((1, 2)))
        residual.append(image - np.tensordot(moved[-1], design, 1))
    model = SimpleNamespace(
        stars=SimpleNamespace(seeded=np.ones(N, bool), flux=np.full(N, FLUX)),
        stamps=SimpleNamespace(
            left=np.zeros(N, int), bottom=SIDE * np.arange(N),
            width=np.full(N, SIDE), offset=SIDE**2 * np.arange(N),
            derivatives=np.tile(DESIGN.reshape(3, -1), N)),
        residual=np.concatenate(residual),
        weight=np.tile(1 / variance, (N, 1)),
        wing_variance=np.full((N * SIDE, SIDE), SPREAD**2))
    return model, np.array(moved), np.tile(covariance, (N, 1, 1))


def test_errors_are_those_of_wings_that_are_off_over_pixels_together():
    model, moved, alone = tile(4)
    stated = np.sqrt(np.diagonal(with_wing_errors(model, alone),
                                 axis1=1, axis2=2))
    assert_allclose(np.std(moved, axis=0), stated.mean(axis=0), rtol=0.12)
    assert (np.std(moved, axis=0) > 1.15 * np.sqrt(np.diag(alone[0]))).all()


@pytest.mark.parametrize('known', [False, True])
def test_other_stars_have_the_errors_that_they_had(known):
    model, _, alone = tile(4)
    model.stars.seeded[::2] = False
    if not known:
        model.wing_variance = None
    out = with_wing_errors(model, alone)
    assert (out[::2] == alone[::2]).all()
    assert (out[1::2, 0, 0] > alone[1::2, 0, 0]).all() == known
