"""``mgauss compile``: every compiled function, made before it is needed."""
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from multiprocessing import get_context

from photutils_mgauss.cli import tools
from photutils_mgauss.utils.parallel import available_cores


def add(commands):
    """Add the command to the parser's."""
    tools.command(
        commands, 'compile', 'compile all fits once, before they are needed',
        'Compile all loops that the package would otherwise compile at the '
        'first call of each kind, and keep them. Use it when you build a '
        'container, or for the workers of a cluster that share a folder '
        '(NUMBA_CACHE_DIR).', 'mgauss compile', run)


def run(options):
    """Compile everything and say what was done."""
    start = time.perf_counter()
    ready, kept = set(), None
    for words, seconds, names, folder in compile_all():
        ready.update(names)
        kept = folder
        tools.say(options, f'{words:40} {seconds:6.1f} s')
    total = time.perf_counter() - start
    tools.say(options, f'{len(ready)} functions ready in {total:.1f} s, '
              + (f'kept in {kept}' if kept else 'not kept: no folder for '
                 'them can be written, see NUMBA_CACHE_DIR'))


def compile_all():
    """
    Compile all examples, one on each core; yield as they are through.

    A compiler works on one core, so that each takes a process. What is
    yielded is the example's words, its seconds, the names of the functions
    that its process has ready, and the folder of their code or None.
    """
    names = list(examples())
    workers = min(available_cores(), len(names))
    if workers == 1:
        yield from map(_compile, names)
        return
    with ProcessPoolExecutor(workers, get_context('spawn')) as pool:
        for task in as_completed([pool.submit(_compile, words)
                                  for words in names]):
            yield task.result()


def _compile(words):
    from photutils_mgauss.kernels import jit

    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        examples()[words]()
    ready = [name for name, one in jit.KERNELS.items() if one.signatures]
    return words, time.perf_counter() - start, ready, jit.folder()


@cache
def examples():
    """Return {words: call} of calls that need all kernels between them."""
    import photutils_mgauss as package

    psf, data, error, stars = _scene(package)
    stamp = psf.mixture_at(20, 20).render((15, 15), 7, 7)
    integrated, matched = (package.GriddedMixturePSF(
        psf.mixtures, psf.grid_xypos, pixel_integrated=True,
        interpolation=how) for how in ('blend', 'components'))
    # What takes longest comes first, so that all cores end together.
    return {
        'photometry': lambda: [
            package.MixturePSFPhotometry(one, (5, 5), aperture_radius=3)(
                data, error=error, init_params=stars, mask=error < 0)
            for one in (psf, integrated)],
        'mixtures of PSF images': lambda: [
            package.fit_mixture(stamp, 2, oversampling=2, weighting=weighting)
            for weighting in ('uniform', 'astrometric')],
        'crowded fields': lambda: [
            package.CrowdedMixturePhotometry(one)(data, error=error)
            for one in (psf, integrated)],
        'models and errors': lambda: _use_models(
            package, psf, matched, data, error),
        'photometry of several images': lambda: _fit_many(
            package, (psf, integrated), data, error),
        'PSF of stars': lambda: package.fit_mixture_field(
            data, stars, error=error, n_components=1, degree=0),
        'crowded fields in many images': lambda: _fit_images(
            package, psf, data, error),
        'simulated images': lambda: _simulate(package, psf, matched),
        'moments': lambda: [package.adaptive_moments(one) for one in (
            stamp, psf.mixture_at(0, 0))],
    }


def _scene(package):
    """Return a PSF, and 16 stars of it with noise."""
    import numpy as np
    from astropy.table import QTable

    mixture = package.GaussianMixture.from_stddevs(
        [0.8, 0.2], np.zeros((2, 2)), [(1.2, 1.1), (2, 2.1)], [0.1, 0])
    corners = [(0, 0), (99, 0), (0, 99), (99, 99)]
    psf = package.GriddedMixturePSF([mixture] * 4, corners)
    y, x = np.mgrid[20:100:20, 20:100:20].reshape(2, -1)
    stars = QTable({'x_0': x + 0.3, 'y_0': y - 0.2,
                    'flux': np.full(x.size, 5e4)})
    data = package.render_stars(psf, x + 0.3, y - 0.2, stars['flux'],
                                (100, 100))
    error = np.sqrt(data + 25)
    data = data + np.random.default_rng(1).normal(0, error)
    return psf, data, error, stars


def _fit_many(package, psfs, data, error):
    """Fit two stars to an image with a WCS, by each of some PSFs."""
    image, wcs = _on_sky(data, error)
    for psf in psfs:
        package.fit_many([(image, psf, wcs)],
                         wcs.pixel_to_world([20.3, 40.3], [19.8, 39.8]))


def _fit_images(package, psf, data, error):
    """Find the stars of an image with a WCS as if it were of many."""
    image, wcs = _on_sky(data, error)
    package.CrowdedMixturePhotometry(psf).fit_images([(image, psf, wcs)])


def _on_sky(data, error):
    """Return an image with its errors, and a WCS."""
    from astropy.nddata import NDData, StdDevUncertainty
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN', 'DEC--TAN'
    wcs.wcs.cdelt = -1e-5, 1e-5
    return NDData(data, uncertainty=StdDevUncertainty(error)), wcs


def _use_models(package, psf, matched, data, error):
    """Evaluate all models, and fit with photutils."""
    import numpy as np
    from astropy.table import QTable
    from photutils.psf import PSFPhotometry

    y, x = np.mgrid[:9, :9]
    single = package.MultiGaussianPSFModel(psf.mixtures[0])
    for model in (psf, matched, single):
        model.evaluate(x, y, 1.0, 4.0, 4.0)
        model.fit_deriv(x.ravel(), y.ravel(), 1.0, 4.0, 4.0,
                        *model.parameters[3:])
        package.cramer_rao(model, 1e4, 5.0, x=20.0, y=20.0)
    free = single.free_shape()
    free.fit_deriv(x.ravel(), y.ravel(), *free.parameters)
    for grid in (psf, matched):
        grid.render([3.2], [4.1], 100, 9)
    psf.mixtures[0].gradient(x, y)
    psf.mixtures[0].render((9, 9), 4, 4)
    PSFPhotometry(psf, (5, 5), fitter=package.MixtureFitter(),
                  aperture_radius=3)(
        data, error=error,
        init_params=QTable({'x': [20.3], 'y': [19.8], 'flux': [5e4]}))


def _simulate(package, psf, matched):
    """Draw stars with every kind of PSF, and charge that overflows."""
    import numpy as np

    from photutils_mgauss.simulation.effects import bleed

    bleed(np.array([[9.0], [1.0]]), 5)
    star = [20.3], [30.1], [1e4]
    for one in (psf, matched, psf.to_gridded_psf(radius=5)):
        package.render_stars(one, *star, (60, 60))
