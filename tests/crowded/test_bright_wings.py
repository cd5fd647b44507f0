"""What the PSF leaves of saturated stars, measured on the image itself."""
import numpy as np

from photutils_mgauss import (
    CrowdedMixturePhotometry,
    GaussianMixture,
    GriddedMixturePSF,
)
from photutils_mgauss.psf.renderer import MixtureRenderer

SKY, FULL, N, PIECE = 40.0, 6e4, 160, 0.001
# On one side more than on the other.
ARMS = np.array([(7, 0), (-7, 0), (0, 5), (0, -5), (4, 4)])


def psf(piece):
    """Return a PSF with pieces of light beside it."""
    n = len(ARMS)
    return GriddedMixturePSF([GaussianMixture(
        [0.8, 0.2 - n * piece, *[piece] * n], [(0, 0), (0, 0), *ARMS],
        [width * np.eye(2) for width in (0.9, 3.5, *[0.7] * n)])], [(0, 0)])


def field(n_telling, n_faint=0, seed=1):
    """Return an image, its errors, and its stars, four of them saturated."""
    rng = np.random.default_rng(seed)
    axis = np.arange(14, N, 26)
    places = np.reshape(np.meshgrid(axis, axis), (2, -1))
    places = rng.permutation(places, axis=1)[:, :4 + n_telling]
    places = np.hstack([places + rng.uniform(-3, 3, places.shape),
                        rng.uniform(0, N, (2, n_faint))])
    flux = np.r_[np.full(4, 3e6), rng.uniform(3e5, 4e5, n_telling),
                 10**rng.uniform(2, 3.5, n_faint)]
    stars = np.vstack([places, flux])
    light = SKY + MixtureRenderer(psf(PIECE)).image(stars, 1e-3, (N, N))
    return np.minimum(rng.poisson(light), FULL), np.sqrt(light), stars


def solved(data, error):
    """Return what is found with a PSF that lacks the pieces."""
    return CrowdedMixturePhotometry(psf(0), saturation=FULL - 500)(
        data, error=error)


def nearest(table, stars):
    """Return the stars of a table nearest to some (3, n)."""
    far = np.hypot(*(np.asarray(table[f'{c}_fit'])[:, None] - at
                     for c, at in zip('xy', stars[:2], strict=True)))
    return table[far.argmin(axis=0)], far.min(axis=1)


def saturated(table, stars, n_telling=25):
    """
    Return errors of places (2, 4), and of fluxes (4,) beside the others'.

    And what else is listed near saturated stars.
    """
    bright = stars[:, :4 + n_telling]
    found, _ = nearest(table, bright)
    ratio = np.asarray(found['flux_fit']) / bright[2]
    assert (found['flags'][:4] & 65536).all()
    off = np.stack([found[f'{c}_fit'][:4] - at[:4]
                    for c, at in zip('xy', stars[:2], strict=True)])
    _, far = nearest(table, stars[:, :4])
    return (off, ratio[:4] / np.median(ratio[4:]) - 1,
            np.count_nonzero((far > 1) & (far < 12)))


def test_saturated_stars_are_where_and_as_bright_as_they_are():
    data, error, stars = field(25)
    table = solved(data, error)
    off, flux, n_false = saturated(table, stars)
    assert np.sqrt(np.mean(off**2)) < 0.002
    assert np.abs(flux).max() < 0.005
    # Each of them has five pieces that could be taken for stars.
    assert n_false < 10
    assert table.meta['saturated_wings'].endswith('and subtracted')


def test_stars_that_are_everywhere_are_no_part_of_bright_ones():
    data, error, stars = field(25, n_faint=1200)
    off, flux, _ = saturated(solved(data, error), stars)
    assert np.median(np.abs(off)) < 0.006
    assert abs(np.mean(flux)) < 0.01


def test_it_says_where_too_few_stars_tell():
    data, error, _ = field(3)
    assert 'not measured in 1 of 1 tiles' in solved(data, error).meta[
        'saturated_wings']


def test_without_saturated_stars_there_is_nothing_to_say():
    data, error, _ = field(3)
    table = CrowdedMixturePhotometry(psf(0))(data[:, :60], error=error[:, :60])
    assert ('saturated_wings' in table.meta) == bool(
        (table['flags'] & 65536).any())
