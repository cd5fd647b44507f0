"""
Point-spread functions as sums of Gaussians, and the astrometry made with them.

The data flow, top to bottom::

    star images -> field -> GaussianMixture -> GriddedMixturePSF
    PSF images  -> fitting / sampling ^                  |
                                          photometry, crowded
                 one QTable per exposure  <--------------+
                            |
       matching, alignment -> proper_motion -> tables, plotting

Every public name is loaded on first use, so that importing the package costs
little more than importing photutils.
"""
from importlib import import_module

try:
    from photutils_mgauss._version import version as __version__
except ImportError:  # a source tree that was never installed
    __version__ = '0.1.0.dev0'

# Public name -> the module that owns it.
_OWNERS = {
    'EmpiricalPSF': 'field.empirical',
    'CrowdedMixturePhotometry': 'crowded.photometry',
    'InjectionResult': 'crowded.photometry',
    'UnfinishedTilesError': 'crowded.photometry',
    'inject_and_recover': 'crowded.photometry',
    'GriddedMixturePSF': 'psf.gridded',
    'PSFAssessment': 'psf.assessment',
    'assess_psf': 'psf.assessment',
    'MixtureField': 'field.mixture_field',
    'TunedMixtureField': 'field.tuned_field',
    'fit_mixture_field': 'field.mixture_field',
    'select_psf_stars': 'field.selection',
    'MultiGaussianPSFModel': 'psf.model',
    'GaussianMixture': 'psf.mixture',
    'PSFExModel': 'files.psfex',
    'blend': 'psf.mixture',
    'CSST_BANDS': 'simulation.scene',
    'Band': 'simulation.scene',
    'DetectorEffects': 'simulation.scene',
    'Exposure': 'simulation.scene',
    'Instrument': 'simulation.scene',
    'Optics': 'simulation.scene',
    'Scene': 'simulation.scene',
    'SimulatedCatalogue': 'simulation.scene',
    'crowded_field': 'simulation.scene',
    'csst_psf': 'simulation.scene',
    'paper_exposures': 'simulation.scene',
    'render_stars': 'simulation.scene',
    'simulate': 'simulation.scene',
    'simulate_catalogues': 'simulation.scene',
    'simulate_epochs': 'simulation.scene',
    'sky_field': 'simulation.scene',
    'sparse_field': 'simulation.scene',
    'Epoch': 'motions.fitter',
    'MotionSolution': 'motions.fitter',
    'ProperMotionFitter': 'motions.fitter',
    'barycentric_observer': 'sky.observers',
    'bootstrap_median': 'motions.fitter',
    'decode_motion_flags': 'motions.fitter',
    'invert_wcs': 'sky.wcs',
    'read_psfex': 'files.psfex',
    'adaptive_moments': 'psf.shapes',
    'compare_n_components': 'fitting.n_components',
    'FitStatus': 'fitting.image',
    'MixtureFit': 'fitting.image',
    'Shapes': 'psf.shapes',
    'ShapeStatus': 'psf.shapes',
    'fit_mixture': 'fitting.image',
    'CramerRao': 'photometry.noise',
    'cramer_rao': 'photometry.noise',
    'pixel_error': 'photometry.noise',
    'add_sky_positions': 'photometry.many_images',
    'fit_many': 'photometry.many_images',
    'PixelPhaseError': 'photometry.pixel_phase',
    'pixel_phase_error': 'photometry.pixel_phase',
    'MixturePosterior': 'fitting.posterior',
    'sample_mixture': 'fitting.posterior',
    'select_n_components': 'fitting.n_components',
    'MixtureFitter': 'photometry.fitter',
    'MixturePSFPhotometry': 'photometry.psf_photometry',
}

__all__ = ['__version__', *_OWNERS]


def __getattr__(name):
    if name not in _OWNERS:
        msg = f'module {__name__!r} has no attribute {name!r}'
        raise AttributeError(msg)
    value = getattr(import_module(f'{__name__}.{_OWNERS[name]}'), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *__all__})
