"""Pulls, bounds, biases and pixel phases of measured stars."""
import numpy as np
from astropy.table import QTable
from photometry_scenes import add_stars
from psf_stamps import make_stamps

from photutils_mgauss import (
    GaussianMixture,
    GriddedMixturePSF,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
    cramer_rao,
    fit_mixture,
    pixel_phase_error,
)

# An exposure of 150 s with the zeropoint and the sky of a survey camera.
EXPOSURE, ZEROPOINT = 150.0, 25.8
SKY, READ_NOISE = 20.0, 5.0  # electrons in a pixel
FIT_SHAPE = 11
STEP = 25
MIXTURE = GaussianMixture.from_stddevs(
    [0.6, 0.3, 0.1], [[0, 0], [0.05, 0.02], [-0.1, 0.1]],
    [[0.8, 0.85], [1.4, 1.3], [2.6, 2.9]], [0.1, -0.05, 0.02])
PSF = GriddedMixturePSF([MIXTURE], [(0, 0)])


def observe(flux, n, rng):
    """Return an image of n stars of one flux, and where they are."""
    side = int(np.ceil(np.sqrt(n)))
    x, y = (axis.ravel()[:n] * STEP + 12 + rng.uniform(-0.5, 0.5, n)
            for axis in np.meshgrid(np.arange(side), np.arange(side)))
    light = np.zeros((STEP * side + 1,) * 2)
    add_stars(light, PSF, x, y, np.full(n, flux))
    data = (rng.poisson(light + SKY) - SKY
            + rng.normal(0, READ_NOISE, light.shape))
    return data, QTable({'x': x, 'y': y, 'flux': np.full(n, flux)})


def measure(data, stars, variance):
    """Return the table of photometry with model- or data-based variance."""
    error = np.full(data.shape, np.sqrt(SKY + READ_NOISE**2))
    phot = MixturePSFPhotometry(PSF, FIT_SHAPE, effective_gain=1,
                                variance=variance)
    return phot(data, error=error, init_params=stars)


def compare_errors(rng, n=2000, magnitudes=(18, 20, 22, 23, 24, 25, 25.5, 26)):
    """Print pulls and scatter over the Cramer-Rao bound, by magnitude."""
    print(f'{n} isolated stars of each magnitude, true PSF, variance from '
          'the model; near: within a pixel of the truth')
    print(' mag   S/N  pulls x    y flux  scatter/bound x    y flux  '
          'not near, near only: pull and scatter of x')
    for magnitude in magnitudes:
        flux = EXPOSURE * 10 ** (-0.4 * (magnitude - ZEROPOINT))
        data, stars = observe(flux, n, rng)
        table = measure(data, stars, 'model')
        bound = cramer_rao(PSF, flux, SKY, x=stars['x'], y=stars['y'],
                           read_noise=READ_NOISE, fit_shape=FIT_SHAPE)
        print(f'{magnitude:4.1f} {flux / bound.flux_err.mean():5.0f}'
              + _error_line(table, stars, bound))


def _error_line(table, stars, bound):
    off = {name: np.asarray(table[f'{name}_fit'] - stars[name])
           for name in ('x', 'y', 'flux')}
    pulls = {name: off[name] / table[f'{name}_err'] for name in off}
    ratios = {name: off[name] / getattr(bound, f'{name}_err')
              for name in off}
    good = np.isfinite(pulls['x']) & np.isfinite(pulls['y'])
    near = good & (np.hypot(off['x'], off['y']) < 1)
    cells = [np.std(values[name][good]) for values in (pulls, ratios)
             for name in off]
    return ('   ' + ' '.join(f'{c:5.3f}' for c in cells[:3])
            + '        ' + ' '.join(f'{c:5.3f}' for c in cells[3:])
            + f'{np.count_nonzero(~near):8d}'
            + f'   {np.std(pulls["x"][near]):5.3f}'
            + f' {np.std(ratios["x"][near]):5.3f}'
            + f'  {np.count_nonzero(table["flags"] & 8)} not converged')


def compare_variances(rng, n=2000, magnitudes=(22, 23, 24, 24.5, 25)):
    """Print the bias of fluxes with each variance, in magnitudes."""
    print('bias of the mean flux [mag], variance from the model, the data:')
    for magnitude in magnitudes:
        flux = EXPOSURE * 10 ** (-0.4 * (magnitude - ZEROPOINT))
        data, stars = observe(flux, n, rng)
        cells = []
        for variance in ('model', 'data'):
            found = np.asarray(measure(data, stars, variance)['flux_fit'])
            cells.append(-2.5 * np.log10(np.mean(found) / flux))
        scatter = 1.0857 * np.std(found) / flux / np.sqrt(n)
        print(f'{magnitude:4.1f}  {cells[0]:+.4f}  {cells[1]:+.4f}  '
              f'(+- {scatter:.4f})')


def compare_phases(n_components=(1, 3, 5), n_side=4):
    """Print the pixel-phase errors of mixtures of optical PSFs."""
    stamps = make_stamps(n_side, oversampling=4)
    print(f'pixel phase, half peak to peak [mpix], {len(stamps)} optical '
          'PSFs: median and largest')
    for weighting in ('uniform', 'astrometric'):
        for k in n_components:
            ranges = []
            for stamp in stamps:
                mixture = fit_mixture(stamp, k, oversampling=4,
                                      weighting=weighting).mixture
                ranges += _half_ranges(MultiGaussianPSFModel(mixture), stamp)
            print(f'{weighting}, K = {k}: {1e3 * np.median(ranges):.2f}, '
                  f'{1e3 * np.max(ranges):.2f}')


def _half_ranges(psf, truth):
    """Return the half ranges in x and y of stars at 16 phases."""
    places, found = [], []
    phot = MixturePSFPhotometry(psf, FIT_SHAPE)
    for j, i in np.ndindex(4, 4):
        star = truth[j::4, i::4]
        place = (np.array([i, j]) * -1.0 + (len(truth) - 1) / 2) / 4
        start = QTable({'x': [place[0]], 'y': [place[1]], 'flux': [1.0]})
        table = phot(star, init_params=start)
        places.append(place)
        found.append([table['x_fit'][0], table['y_fit'][0]])
    return [pixel_phase_error(a, b, n_bins=4).half_range
            for a, b in zip(np.transpose(places), np.transpose(found),
                            strict=True)]
