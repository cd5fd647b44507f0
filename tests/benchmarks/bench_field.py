"""
Positions with a PSF field from 150 stars, against the Cramer-Rao bound.

    python tests/benchmarks/bench_field.py --harness DIR SCENE [SCENE ...]
        [--stars 150] [--n-components 6] [--degree 4]
        [--peers psfex,empirical,epsf] [--time]
    python tests/benchmarks/bench_field.py --harness DIR --variants
        SCENE [SCENE ...] [--bound]
    python tests/benchmarks/bench_field.py --harness DIR --undersampled
        TABLE [TABLE ...] [--seed 5] [--stars 150] [--bound]
    python tests/benchmarks/bench_field.py --decam DIR

A scene is a folder with sci.fits, mask.fits, vartrue.fits, truth.ecsv and
meta.json; the harness is the folder of the modules that made it (csst_psf,
metrics, peers), which know the true PSF. Stars that were not used for the PSF
are fitted with the field's grid and with the true PSF, on the same pixels
with the same variance. Errors are in units of each star's bound, after the
cubic correction of positions that the harness makes. Peers are made of the
same stars and fitted by photutils with their own pixels, and as mixtures of
three Gaussians made of those pixels; 'empirical' is EmpiricalPSF. Shapes are
compared with the truth on a 30 x 30 grid. --time measures 150 and 3,000 stars
with K = 5 and degree 3.

--variants prints one table of the defaults: RMS of positions over that with
the true PSF, and the bias of fluxes, both with the light beyond the stamps,
for 150, 30 and 15 stars of the first scene, for 150 of its stars under 1,500
cosmic rays, and for 150 stars of each other scene (steep, aberrated, ...).

--undersampled takes tables of true PSFs on coarse pixels (of the class TruePSF
of the harness) and prints a line for each: stars of 18 to 20 mag are fitted
with the field of other stars and with the true PSF, and stars without
noise at 64 places in a pixel say how fluxes and positions change with that.

--bound adds what no field of as many Gaussians and this degree from these
stars can go below (field_bound.py), to lines of --undersampled and to those
of --variants with 150 stars.

--decam needs the folder with 117 stars of a DECam chip (decam_psfex) and
psfex on the path, which models the same three quarters of the stars; the last
quarter is fitted with both.
"""
import argparse
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
from astropy.table import QTable, Table

from photutils_mgauss import (
    EmpiricalPSF,
    GriddedMixturePSF,
    MixturePSFPhotometry,
    assess_psf,
    fit_mixture_field,
    select_psf_stars,
)

sys.path.insert(0, str(Path(__file__).parents[1]))
from field_bound import Bound
from undersampled import print_camera

from helpers.decam_chip import (
    decam_chip,
    find_catalogue,
    fit_spline,
    psfex_spline,
)

EDGES = np.arange(18, 27)
# Of stamps, and how far the light of stars is drawn [pix].
RADIUS, FAR = 10, 40


def scatter(values):
    return 1.4826 * np.median(np.abs(values))


def read_scene(path, harness):
    """Return meta, images, truth table and true PSF."""
    from csst_psf import TruePSF
    from run_bench import load
    meta, images, truth = load(path)
    return meta, images, truth, TruePSF(harness / meta['psf'])


def number(text):
    return text if text == 'auto' else int(text)


def fit_field(meta, images, options):
    """Select stars and fit the field, timed after compilation."""
    data = images['sci'] - meta['bkg']
    stars = select_psf_stars(data, error=images['err'], mask=images['mask'],
                             fwhm=1.8, radius=RADIUS, saturation=7e4,
                             max_stars=options.stars)
    n = int(stars['selected'].sum())
    wall, cpu = time.perf_counter(), time.process_time()
    field = fit_mixture_field(
        data, stars, error=images['err'], mask=images['mask'],
        n_components=options.n_components, degree=options.degree,
        radius=RADIUS)
    print(f'  {n} stars selected, {field}: '
          f'{time.perf_counter() - wall:.1f} s, '
          f'{time.process_time() - cpu:.1f} s CPU', flush=True)
    return stars, field


def test_stars(meta, truth, stars):
    """Return the rows of truth that are whole and not PSF stars."""
    n = meta['n']
    x, y = np.asarray(truth['x']), np.asarray(truth['y'])
    keep = ~truth['sat'] & (np.minimum(x, y) > 12) & (
        np.maximum(x, y) < n - 13)
    chosen = stars[stars['selected']]
    for star in chosen:
        keep &= np.hypot(x - star['x'], y - star['y']) > 2
    return truth[keep]


def fit_with_field(psf, data, error, test):
    start = QTable({'x_init': np.asarray(test['x']) + 0.05,
                    'y_init': np.asarray(test['y']) - 0.05,
                    'flux_init': np.asarray(test['flux'])})
    result = MixturePSFPhotometry(psf, 2 * RADIUS + 1)(
        data, error=error, init_params=start)
    names = 'x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err', 'flux_err'
    return np.column_stack([np.asarray(result[name]) for name in names])


def fit_with_truth(psf, meta, data, variance, test):
    """Fit x, y, flux by Gauss-Newton steps with the true PSF."""
    place = np.column_stack([np.asarray(test[name], float)
                             for name in ('x', 'y', 'flux')])
    corner = np.floor(place[:, :2] + 0.5).astype(int) - RADIUS
    cut = [np.s_[y:y + 2 * RADIUS + 1, x:x + 2 * RADIUS + 1]
           for x, y in corner]
    pixels = np.array([data[one] for one in cut])
    weights = np.array([1 / variance[one] for one in cut])
    for _ in range(4):
        stamps = psf.stamps(place[:, 0], place[:, 1], RADIUS, meta['origin'])
        moved = np.floor(place[:, :2] + 0.5).astype(int) - RADIUS - corner
        for i in np.flatnonzero(moved.any(axis=1)):
            for stamp in stamps:
                stamp[i] = np.roll(stamp[i], moved[i, ::-1], (0, 1))
        flux = place[:, 2, None, None]
        slopes = np.stack([flux * stamps[1], flux * stamps[2], stamps[0]], 1)
        residual = pixels - flux * stamps[0]
        matrix = np.einsum('nihw,njhw,nhw->nij', slopes, slopes, weights)
        right = np.einsum('nihw,nhw,nhw->ni', slopes, residual, weights)
        place += np.linalg.solve(matrix, right[..., None])[..., 0]
    return place


def errors_in_bounds(meta, truth_psf, images, test, fitted):
    """Return x and y errors over the bound after the cubic correction."""
    import metrics
    bound = metrics.crlb(truth_psf, test, images['vartrue'], meta['origin'])
    x, y, mag = (np.asarray(test[name]) for name in ('x', 'y', 'mag'))
    dx, dy = metrics.poly_correct(x, y, fitted[:, 0] - x, fitted[:, 1] - y,
                                  mag < 21.5, meta['n'])
    return np.column_stack([dx, dy]), bound[:, :2]


def run_scene(path, options):
    """Return a list of (method, magnitudes, errors/bound, pulls)."""
    meta, images, truth, truth_psf = read_scene(path, options.harness)
    print(path, flush=True)
    data, variance = images['sci'] - meta['bkg'], images['vartrue']
    stars, field = fit_field(meta, images, options)
    test = test_stars(meta, truth, stars)
    grid = field.to_grid((30, 30))
    print_shapes('field', grid, truth_psf)
    print_profiles('field', grid, truth_psf)
    mag = np.asarray(test['mag'])
    rows = []
    for name, fitted in [
            ('true PSF', fit_with_truth(truth_psf, meta, data, variance,
                                        test)),
            ('field', fit_with_field(grid, data, np.sqrt(variance), test)),
            *peers(path, meta, images, stars, test, truth_psf,
                   options)]:
        error, bound = errors_in_bounds(meta, truth_psf, images, test, fitted)
        pull = (error / fitted[:, 3:5] if fitted.shape[1] > 3
                else np.full(error.shape, np.nan))
        rows.append((name, mag, error / bound, pull))
    return rows


def with_cosmic_rays(images, n, rng):
    """Return the images with n tracks of light, unmasked."""
    data, variance = images['sci'].copy(), images['err']**2
    ny, nx = data.shape
    for _ in range(n):
        length = 1 + rng.exponential(5)
        steps = np.arange(0, length, 0.5)
        angle, light = rng.uniform(0, 2 * np.pi), 10 ** rng.uniform(2, 4)
        x = (rng.uniform(0, nx) + steps * np.cos(angle)).astype(int)
        y = (rng.uniform(0, ny) + steps * np.sin(angle)).astype(int)
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        share = light / steps.size
        for image in (data, variance):
            np.add.at(image, (y[inside], x[inside]), share)
    return dict(images, sci=data, err=np.sqrt(variance))


def run_variant(label, path, options, n_stars, n_rays=0):
    """Print a row: RMS over that with the true PSF, bias of the fluxes."""
    meta, images, truth, truth_psf = read_scene(path, options.harness)
    data, variance = images['sci'] - meta['bkg'], images['vartrue']
    seen = with_cosmic_rays(images, n_rays, np.random.default_rng(5))
    stars = select_psf_stars(
        seen['sci'] - meta['bkg'], error=seen['err'], mask=seen['mask'],
        fwhm=1.8, saturation=7e4, max_stars=n_stars)
    cpu = time.process_time()
    field = fit_mixture_field(
        seen['sci'] - meta['bkg'], stars, error=seen['err'],
        mask=seen['mask'], normalise='curve-of-growth')
    cpu = time.process_time() - cpu
    test = test_stars(meta, truth, stars)
    test = test[test['mag'] < 22]
    fits = (fit_with_truth(truth_psf, meta, data, variance, test),
            fit_with_field(field.to_grid((30, 30)), data, np.sqrt(variance),
                           test))
    best, mine = (errors_in_bounds(meta, truth_psf, images, test, one)[0]
                  for one in fits)
    mag = np.floor(np.asarray(test['mag']))

    def ratios(errors):
        return [np.sqrt(np.mean(errors[mag == low]**2)
                        / np.mean(best[mag == low]**2))
                for low in range(18, 22)]
    bias = np.median((fits[1][:, 2] / np.asarray(test['flux']))[mag < 20]) - 1
    print(f'{label:24s} K={field.n_components} degree={field.degree} '
          + ' '.join(f'{ratio:.3f}' for ratio in ratios(mine))
          + f'  mean {np.mean(ratios(mine)):.3f}  worst '
          f'{1000 * np.abs(mine[mag < 20]).max():.0f} mpix  '
          f'flux {100 * bias:+.2f} % +- {100 * field.wing_error:.2f}  '
          f'{cpu:.0f} s CPU', flush=True)
    if options.bound and n_stars >= 150 and not n_rays:
        def offsets(psf, image):
            fitted = fit_with_field(psf.to_grid((30, 30)), image,
                                    np.sqrt(variance), test)
            return errors_in_bounds(meta, truth_psf, images, test, fitted)[0]
        clean = np.zeros(data.shape)
        truth_psf.render(clean, *(np.asarray(truth[name]) for name in (
            'x', 'y', 'flux')), FAR, meta['origin'])
        every = truth['x', 'y', 'flux']
        every['selected'] = np.isin(truth['x'], test['x'])
        found = Bound(field, clean, np.sqrt(variance), stars, every, offsets)
        print('    ' + found.report(
            best, lambda errors: np.mean(ratios(errors))), flush=True)


def print_variants(options):
    """Print one table of all variants, with what is chosen by default."""
    print('RMS over that with the true PSF at 18-19, 19-20, 20-21, 21-22 mag')
    first, *others = options.scenes
    for n_stars in (150, 30, 15):
        run_variant(f'{n_stars} stars', first, options, n_stars)
    run_variant('1,500 cosmic rays', first, options, 150, 1500)
    for path in others:
        run_variant(Path(path).name, path, options, 150)


def print_shapes(label, psf, truth_psf):
    """Compare a PSF that has mixtures or is a photutils model."""
    def truth(x, y):
        return truth_psf.epsf(x, y, 2, 61)

    steps = np.arange(-30, 31) / 2
    dx, dy = np.meshgrid(steps, steps)

    def pixels(x, y):
        return psf.evaluate(x + dx.ravel(), y + dy.ravel(), 1, x, y).reshape(
            dx.shape)

    model = psf if hasattr(psf, 'mixture_at') else pixels
    report = assess_psf(model, truth, (30, 30), oversampling=2,
                        shape=(int(truth_psf.chip),) * 2)
    print(f'  {label}:', ', '.join(
        f'{name} {np.median(values):+.4f} +- {values.std():.4f} (robust '
        f'{scatter(values - np.median(values)):.4f})'
        for name, values in ((name, np.asarray(report.table[name]))
                             for name in ('size_error', 'ellipticity_error'))),
          flush=True)


def print_profiles(label, psf, truth_psf):
    """Print how far a PSF's samples are from the truth, shifted upon it."""
    steps = np.arange(-20, 21) / 2
    places = np.linspace(0, truth_psf.chip - 1, 6)
    deviations = [deviation(psf, truth_psf, steps, x, y)
                  for x in places for y in places]
    print(f'  {label}: deviation from the true profile, median over the '
          f'detector: {1000 * np.median(deviations):.2f} thousandths of the '
          'peak', flush=True)


def deviation(psf, truth_psf, steps, x, y):
    """Return the RMS over 7 x 7 pixels in shares of the peak."""
    from scipy.interpolate import RectBivariateSpline
    truth = RectBivariateSpline(steps, steps, truth_psf.epsf(x, y, 2, 41))
    inner = steps[6:-6]
    dx, dy = np.meshgrid(inner, inner)
    model = (psf.mixture_at(x, y).evaluate(dx, dy)
             if hasattr(psf, 'mixture_at') else
             psf.evaluate((x + dx).ravel(), (y + dy).ravel(), 1, x,
                          y).reshape(dx.shape))
    shift = np.zeros(2)
    for _ in range(8):
        design = np.stack([truth.ev(dy - shift[1], dx - shift[0], dx=i, dy=j)
                           .ravel() for i, j in ((0, 0), (0, 1), (1, 0))], 1)
        found = np.linalg.lstsq(design, model.ravel())[0]
        shift -= found[1:] / found[0]
    residual = model.ravel() - design @ found
    return np.sqrt(np.mean(residual**2)) / (found[0] * truth.ev(0, 0))


def peers(path, meta, images, stars, test, truth_psf, options):
    """Yield name and fits of the peers asked for."""
    chosen = stars[stars['selected']]
    data, error = images['sci'] - meta['bkg'], np.sqrt(images['vartrue'])
    for name in options.peers:
        psf = make_peer(name, path, meta, images, chosen)
        print_shapes(name, psf, truth_psf)
        print_profiles(name, psf, truth_psf)
        yield name, fit_with_photutils(psf, data, error, test)
        if name != 'epsf':
            chain = GriddedMixturePSF.from_gridded_psf(psf, 3, radius=7)
            print_shapes(f'{name} -> K = 3', chain, truth_psf)
            yield f'{name} -> K = 3', fit_with_field(chain, data, error,
                                                     test)


def make_peer(name, path, meta, images, stars):
    """Return the PSF as a model of photutils."""
    import peers as harness
    data = images['sci'] - meta['bkg']
    if name == 'epsf':
        table = Table({'x': stars['x'], 'y': stars['y']})
        return harness.build_epsf(data, table)
    if name == 'empirical':
        return EmpiricalPSF.from_stars(
            data, stars, error=images['err'], mask=images['mask'],
            radius=RADIUS).to_gridded_psf((15, 15))
    with tempfile.TemporaryDirectory() as work:
        catalogue, _ = harness.run_sex(Path(path) / 'sci.fits', work,
                                       vignet=True)
        file = harness.run_psfex(keep_stars(catalogue, stars), work,
                                 SAMPLE_AUTOSELECT='N')
        return harness.gridded(harness.psfex_grid(file, meta['n']))


def keep_stars(catalogue, stars):
    """Write a copy of an LDAC catalogue that holds only the stars."""
    from astropy.io import fits
    with fits.open(catalogue) as hdus:
        rows = hdus[2].data
        near = np.hypot(
            rows['XWIN_IMAGE'][:, None] - 1 - np.asarray(stars['x']),
            rows['YWIN_IMAGE'][:, None] - 1 - np.asarray(stars['y']))
        hdus[2].data = rows[near.min(axis=1) < 2]
        out = Path(catalogue).with_name('chosen.ldac')
        hdus.writeto(out, overwrite=True)
    return out


def fit_with_photutils(psf, data, error, test):
    from photutils.psf import PSFPhotometry
    start = QTable({'x_init': np.asarray(test['x']) + 0.05,
                    'y_init': np.asarray(test['y']) - 0.05,
                    'flux_init': np.asarray(test['flux'])})
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        result = PSFPhotometry(psf, (11, 11))(data, error=error,
                                              init_params=start)
    return np.column_stack([np.asarray(result[name]) for name in
                            ('x_fit', 'y_fit', 'flux_fit', 'x_err', 'y_err',
                             'flux_err')])


def print_table(rows):
    """Print robust errors over the bound, and over those of the truth."""
    reference = rows[0]
    for name, mag, error, pull in rows:
        ratios = []
        print(f'{name}: error over bound, over that with the true PSF, pull')
        for low in EDGES[:-1]:
            here = (mag >= low) & (mag < low + 1)
            mine, best = scatter(error[here]), scatter(reference[2][here])
            ratios.append(mine / best)
            print(f'  {low}-{low + 1} mag  {here.sum():4d} stars  '
                  f'{mine:5.2f}  {ratios[-1]:5.3f}  '
                  f'{scatter(pull[here]):5.2f}')
        print(f'  mean ratio 18-22 mag {np.mean(ratios[:4]):.3f}, largest '
              f'{max(ratios):.3f}', flush=True)


def pooled(scenes):
    """Join the rows of the scenes, method by method."""
    return [(parts[0][0], *(np.concatenate([part[i] for part in parts])
                            for i in (1, 2, 3)))
            for parts in zip(*scenes, strict=True)]


def print_times(path, options):
    """Time 150 and 3,000 stars of 21x21, K = 5, degree 3, when compiled."""
    meta, _, _, truth_psf = read_scene(path, options.harness)
    rng = np.random.default_rng(1)
    for n, size in ((30, 2048), (150, 2048), (3000, 4096)):
        data, error, stars = many_stars(truth_psf, n, size, meta['bkg'], rng)
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            wall, cpu = time.perf_counter(), time.process_time()
            field = fit_mixture_field(data, stars, error=error, degree=3,
                                      n_components=5, radius=RADIUS)
        print(f'{field}: {time.perf_counter() - wall:.1f} s, '
              f'{time.process_time() - cpu:.1f} s CPU; largest memory '
              f'{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f}'
              ' GB, images included', flush=True)


def many_stars(truth_psf, n, size, sky, rng):
    """Draw n stars with the true PSF stretched over a detector."""
    chip, truth_psf.chip = truth_psf.chip, size
    stars = Table({'x': rng.uniform(15, size - 16, n),
                   'y': rng.uniform(15, size - 16, n)})
    clean = np.zeros((size, size))
    truth_psf.render(clean, np.asarray(stars['x']), np.asarray(stars['y']),
                     10 ** rng.uniform(4, 5.3, n), 20)
    truth_psf.chip = chip
    variance = np.maximum(clean, 0) + sky + 25
    return rng.normal(clean, np.sqrt(variance)), np.sqrt(variance), stars


def psfex_of(file, keep):
    """Return psfex's model of some rows of an LDAC catalogue."""
    from astropy.io import fits

    from photutils_mgauss import read_psfex
    with tempfile.TemporaryDirectory() as work, fits.open(file) as hdus:
        hdus[2].data = hdus[2].data[keep]
        some = Path(work) / 'some.fits'
        hdus.writeto(some)
        subprocess.run(
            ['psfex', str(some), '-BASIS_TYPE', 'PIXEL', '-PSF_SAMPLING',
             '0.5', '-PSF_SIZE', '63,63', '-PSFVAR_DEGREES', '2',
             '-SAMPLE_AUTOSELECT', 'N', '-PSF_DIR', work, '-CHECKPLOT_DEV',
             'NULL', '-CHECKIMAGE_TYPE', 'NONE', '-WRITE_XML', 'N'],
            check=True, capture_output=True, cwd=work)
        return read_psfex(some.with_suffix('.psf'))


def print_decam(folder):
    """Fit left-out stars of a DECam chip with both PSFs."""
    from scipy.interpolate import RectBivariateSpline
    data, error, stars = decam_chip(folder)
    near = np.minimum(stars['x'], stars['y']) > 14
    near &= (stars['x'] < 2048 - 15) & (stars['y'] < 4096 - 15)
    out = np.arange(len(stars)) % 4 == 0
    field = fit_mixture_field(data, stars[~out], error=error, degree=2,
                              n_components=5, radius=12)
    psfex = partial(psfex_spline, psfex_of(find_catalogue(folder), ~out))
    lattice = np.arange(-36, 37) / 2

    def mine(x, y):
        image = field.mixture_at(x, y).evaluate(lattice, lattice[:, None])
        return RectBivariateSpline(lattice, lattice, image)

    print(f'{field}; {np.sum(out & near)} stars left out')
    results = {}
    for name, psf in (('field', mine), ('psfex', psfex)):
        fits = np.array([[fit_spline(psf(x, y), data, error, x, y, half)
                          for half in (None, 0, 1)]
                         for x, y in stars[out & near].iterrows()])
        change = fits[:, 1, :2] - fits[:, 2, :2]
        results[name] = np.median(fits[:, 0, 2]), scatter(change) / 2
        print(f'{name}: reduced chi^2 median {results[name][0]:.3f}, centroid '
              f'repeatability (halves of the pixels) {results[name][1]:.4f} '
              'pix', flush=True)
    print('field over psfex: chi^2 {:.3f}, repeatability {:.3f}'.format(
        *np.divide(results['field'], results['psfex'])))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('scenes', nargs='*')
    parser.add_argument('--harness', type=Path)
    parser.add_argument('--decam', type=Path)
    parser.add_argument('--stars', type=int, default=150)
    parser.add_argument('--n-components', type=number, default=6)
    parser.add_argument('--degree', type=number, default=4)
    parser.add_argument('--peers', type=lambda s: s.split(','), default=[])
    parser.add_argument('--variants', action='store_true')
    parser.add_argument('--undersampled', nargs='+', default=[])
    parser.add_argument('--seed', type=int, default=5)
    parser.add_argument('--bound', action='store_true')
    parser.add_argument('--time', action='store_true')
    options = parser.parse_args()
    if options.decam:
        print_decam(options.decam)
    if not options.scenes and not options.undersampled:
        return
    if options.harness is None:
        parser.error('scenes need --harness, the folder of its modules')
    sys.path.insert(0, str(options.harness))
    for name in options.undersampled:
        from csst_psf import TruePSF
        print_camera(name, TruePSF(name), fit_with_truth, options.seed,
                     options.stars, bound=options.bound,
                     n_components=options.n_components,
                     degree=options.degree)
    if not options.scenes:
        return
    if options.variants:
        print_variants(options)
        return
    scenes = [run_scene(path, options) for path in options.scenes]
    print_table(pooled(scenes))
    if options.time:
        print_times(options.scenes[0], options)


if __name__ == '__main__':
    main()
