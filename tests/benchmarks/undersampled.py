"""A camera with coarse pixels: its scene, and what fields make of it."""
import time
from pathlib import Path

import numpy as np
from astropy.table import QTable, vstack
from field_bound import Bound

from photutils_mgauss import MixturePSFPhotometry, fit_mixture_field

SIZE, SKY, READ_NOISE = 2048, 60.0, 5.0
N_TEST = 600
ZERO_POINT = 25.8 + 2.5 * np.log10(150)
RADIUS = 8
PHASES = 8


def scatter(values):
    return 1.4826 * np.median(np.abs(values))


def scene(truth_psf, seed, n_psf):
    """Return data, error, stars of the PSF and stars to measure."""
    rng = np.random.default_rng(seed)
    cells = int(np.ceil(np.sqrt(n_psf + N_TEST)))
    step = SIZE / cells
    place = rng.permutation(cells**2)[:n_psf + N_TEST]
    x, y = (np.array([place % cells, place // cells]) + 0.5) * step
    # Stamps of neighbours do not touch.
    x, y = np.array([x, y]) + rng.uniform(14 - step / 2, step / 2 - 14,
                                          (2, x.size))
    faintest = np.where(np.arange(x.size) < n_psf, 20.5, 20.0)
    flux = 10 ** (0.4 * (ZERO_POINT - rng.uniform(18, faintest)))
    clean = np.zeros((SIZE, SIZE))
    truth_psf.render(clean, x, y, flux, 18)
    variance = np.maximum(clean, 0) + SKY + READ_NOISE**2
    stars = QTable({'x': x, 'y': y, 'flux': flux})
    return (rng.normal(clean, np.sqrt(variance)), np.sqrt(variance),
            stars[:n_psf], stars[n_psf:])


def measured(psf, data, error, stars):
    start = QTable({'x_init': stars['x'] + 0.05, 'y_init': stars['y'] - 0.05,
                    'flux_init': stars['flux']})
    return MixturePSFPhotometry(psf, 2 * RADIUS + 1)(
        data, error=error, init_params=start)


def corrected(x, y, off):
    """Return offsets (n, 2) less their cubic polynomials."""
    u, v = 2 * x / SIZE - 1, 2 * y / SIZE - 1
    terms = np.stack([u**i * v**j for i in range(4) for j in range(4 - i)], 1)
    out = np.empty(off.shape)
    for axis in range(2):
        fair = np.abs(off[:, axis]) < 4 * scatter(off[:, axis])
        found = np.linalg.lstsq(terms[fair], off[fair, axis], rcond=None)[0]
        out[:, axis] = off[:, axis] - terms @ found
    return out


def phase_errors(field, truth_psf):
    """Return rms changes of flux and of x, y with the place in a pixel."""
    step, half = 40, 20
    lattice = np.arange(PHASES) * step + half
    phase = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(lattice + phase,
                                                 lattice + phase))
    off = []
    for place in 256 * np.mgrid[1:8:2, 1:8:2].reshape(2, -1).T:
        image = np.zeros((PHASES * step,) * 2)
        for one in zip(x, y, strict=True):
            corner = np.rint(one).astype(int) - half
            stamp = np.s_[corner[1]:corner[1] + 2 * half + 1,
                          corner[0]:corner[0] + 2 * half + 1]
            truth_psf.render(image[stamp], *np.array([one - corner]).T,
                             np.array([1e5]), 18, place - half)
        found = measured(field.to_grid((30, 30)).local_model(*place), image,
                         np.sqrt(np.maximum(image, 0) + SKY), QTable(
                             {'x': x, 'y': y, 'flux': np.full(x.size, 1e5)}))
        off.append(np.column_stack([found['flux_fit'] / 1e5, found['x_fit']
                                    - x, found['y_fit'] - y]).std(axis=0))
    flux, *sides = np.sqrt(np.mean(np.square(off), axis=0))
    return flux, np.sqrt(np.mean(np.square(sides)))


def print_camera(name, truth_psf, fit_with_truth, seed, n_psf, *,
                 bound=False, **how):
    """
    Print a line on a camera whose true PSF is known.

    With ``bound`` another one: what no fit can go below. ``how`` are options
    of the fit.
    """
    data, error, stars, test = scene(truth_psf, seed, n_psf)
    start = time.process_time()
    field = fit_mixture_field(data, stars['x', 'y'], error=error,
                              radius=RADIUS, **how)
    seconds = time.process_time() - start
    table = measured(field.to_grid((12, 12)), data, error, test)
    best = fit_with_truth(truth_psf, {'origin': (0, 0)}, data, error**2, test)
    x, y = np.asarray(test['x']), np.asarray(test['y'])

    def off(*places):
        return corrected(x, y, np.column_stack(places) - np.column_stack(
            [x, y]))
    mine = off(table['x_fit'], table['y_fit'])
    ideal = off(*best[:, :2].T)
    errors = np.column_stack([table['x_err'], table['y_err']])
    flux = np.asarray(table['flux_fit'] / test['flux'])
    pull = (flux - np.median(flux)) * test['flux'] / table['flux_err']
    phase_flux, phase_place = phase_errors(field, truth_psf)
    print(f'{Path(name).stem:16s} {n_psf} stars, integrated '
          f'{field.pixel_integrated!s:5s} positions '
          f'{scatter(mine) / scatter(ideal):.2f} times the true '
          f"PSF's; pulls of x, y {scatter(mine / errors):.2f}, of flux "
          f'{scatter(pull):.2f}; with phase: flux {phase_flux:.3%}, x, y '
          f'{1e3 * phase_place:.2f} mpix; {seconds:.0f} s CPU', flush=True)
    if bound:
        def offsets(field, image):
            table = measured(field.to_grid((12, 12)), image, error, test)
            return off(table['x_fit'], table['y_fit'])
        clean = error**2 - SKY - READ_NOISE**2
        found = Bound(field, clean, error, stars['x', 'y'],
                      vstack([stars, test])['x', 'y'], offsets)
        print('    ' + found.report(
            ideal, lambda errors: scatter(errors) / scatter(ideal)),
            flush=True)
