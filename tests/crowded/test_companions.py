"""Companions behind the masked middles of saturated stars."""
import numpy as np
import pytest

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.crowded import companions, table
from photutils_mgauss.psf.renderer import MixtureRenderer

SKY, FULL, N = 40.0, 6e4, 90
PSF = GriddedMixturePSF([GaussianMixture(
    [0.8, 0.2], [(0, 0), (0, 0)], [0.9 * np.eye(2), 3.5 * np.eye(2)])],
    [(0, 0)])


def scene(n_others, seed=1):
    """Return an image and its errors, a saturated star in the middle."""
    rng = np.random.default_rng(seed)
    stars = np.hstack([[[N / 2 + 0.2], [N / 2 - 0.3], [3e6]], np.stack([
        *rng.uniform(0, N, (2, n_others)),
        400 * rng.pareto(0.8, n_others).clip(0, 300) + 400])])
    light = SKY + MixtureRenderer(PSF).image(stars, 1e-3, (N, N))
    return np.minimum(rng.poisson(light), FULL), np.sqrt(light)


def solved(monkeypatch, n_others):
    """Return the saturated star, and what `with_companions` was asked."""
    asked = []

    def keep(*args):
        asked.append(args)
        return companions.with_companions(*args)
    monkeypatch.setattr(table, 'with_companions', keep)
    data, error = scene(n_others)
    stars = CrowdedMixturePhotometry(PSF, saturation=FULL - 500)(
        data, error=error)
    return stars[np.argmax(stars['flux_fit'])], asked[0]


def test_errors_hold_what_is_drawn_behind_a_saturated_star(monkeypatch):
    _, (before, model, covariances) = solved(monkeypatch, 500)
    out = companions.with_companions(before, model, covariances)
    star, = np.flatnonzero(model.stars.seeded)
    errors = np.sqrt(np.diagonal(covariances[star]))
    flux, number = companions._counts(
        model.stars, np.sqrt(covariances[:, 0, 0]), model.good.sum())
    doubt = model.doubtful_light(model.options.psf_error)
    _, hidden = companions._moves(model, star, doubt, flux)
    row, column, design, variance, _ = companions.pixels_of(model, star)
    reach = (int(np.sqrt(len(hidden))) - 1) // 2
    y, x = (at.ravel() for at in np.indices((2 * reach + 1,) * 2) - reach)
    rng, moved = np.random.default_rng(3), []
    for _ in range(3000):
        place, step = np.nonzero(rng.poisson(hidden * number))
        light = MixtureRenderer(PSF).image(np.stack([
            model.stars.x[star] + x[place], model.stars.y[star] + y[place],
            flux[step]]), 1e-6, (N, N))[row, column]
        moved.append(np.linalg.lstsq((design / np.sqrt(variance)).T,
                                     light / np.sqrt(variance))[0])
    pulls = np.abs(np.array(moved) / errors + rng.normal(size=(3000, 3)))
    width = np.percentile(pulls, 68.27, axis=0)
    assert width[0] > 1.5
    assert np.hypot(1, out.flux[star]) == pytest.approx(width[0], rel=0.1)
    assert np.hypot(1, out.position[star]) == pytest.approx(
        width[1:].mean(), rel=0.1)
    others = np.arange(len(model.stars)) != star
    np.testing.assert_array_equal(out.flux[others], before.flux[others])


def test_without_other_stars_there_are_no_companions(monkeypatch):
    star, _ = solved(monkeypatch, 0)
    assert star['flags'] & 65536
    assert star['x_confusion_err'] == 0 == star['flux_confusion_err']
