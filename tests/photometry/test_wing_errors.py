"""Errors of saturated stars whose PSF is off over pixels together."""
import numpy as np
from numpy.testing import assert_allclose
from scipy.ndimage import gaussian_filter

from photutils_mgauss.photometry.wing_errors import Wings, _correlation

SIDE, SPREAD, NOISE, SCALE = 17, 3.0, 4.0, 0.8


def wings(place):
    """Return the pixels of a star around those that are hidden."""
    row, column = np.indices((SIDE, SIDE)).reshape(2, -1)
    dy, dx = row - SIDE // 2, column - SIDE // 2
    seen = np.hypot(dy, dx) > 3
    light = np.exp(-np.hypot(dy, dx) / 3)
    design = np.array([light, light * dx, light * dy])[:, seen]
    spread = np.full(seen.sum(), SPREAD)
    noise = np.full(seen.sum(), NOISE)
    weighed = design / (spread**2 + noise**2)
    shifts = np.linalg.solve(weighed @ design.T, weighed)
    return Wings(row[seen] + place, column[seen], design, shifts, spread,
                  noise)


def misfit(rng):
    """Return smooth noise of one standard deviation."""
    wide = gaussian_filter(rng.normal(size=(SIDE + 20,) * 2), SCALE)
    return wide[10:-10, 10:-10] * 2 * np.sqrt(np.pi) * SCALE


def test_correlations_and_errors_are_those_of_the_misfit():
    rng, every, left, moved = np.random.default_rng(4), [], [], []
    for k in range(300):
        star = wings(k * SIDE)
        image = SPREAD * misfit(rng) + NOISE * rng.normal(size=(SIDE, SIDE))
        values = image[star.row - k * SIDE, star.column]
        shift = star.shifts @ values
        image[star.row - k * SIDE, star.column] = values - (
            shift @ star.design)
        every.append(star)
        left.append(image)
        moved.append(shift)
    out = _correlation(every, np.concatenate(left))
    dy, dx = np.indices(out.shape) - 3
    assert_allclose(out, np.exp(-(dx**2 + dy**2) / (4 * SCALE**2)), atol=0.08)
    noise = (every[0].shifts * NOISE**2) @ every[0].shifts.T
    stated = np.sqrt(np.diag(every[0].covariance(out) + noise))
    assert_allclose(np.std(moved, axis=0), stated, rtol=0.12)
    # Pixels that are each off for themselves would move stars less.
    alone = (every[0].shifts * (NOISE**2 + SPREAD**2)) @ every[0].shifts.T
    assert (np.std(moved, axis=0) > 1.15 * np.sqrt(np.diag(alone))).all()
