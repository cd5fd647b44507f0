"""
Point-spread functions as sums of Gaussians, and the astrometry made with them.

The data flow, top to bottom::

    star images -> field ---> GaussianMixture -> GriddedMixturePSF
    PSF images  -> fitting ------^  psf                  |
    PSF files   -> files                  photometry, crowded
                 one QTable per exposure  <--------------+
                            |
                         motions -> tables, corrected WCS, plotting
                            |
            images -> pixel_motions -> tables, light curves

Every public name is loaded on first use, so that importing the package costs
little more than importing photutils.
"""
from photutils_mgauss.utils.lazy import hand_on, offer_formats

try:
    from photutils_mgauss._version import version as __version__
except ImportError:  # a source tree that was never installed
    __version__ = '0.1.0.dev0'

# Public name -> the room that owns it.
_OWNERS = {
    'adaptive_moments': 'psf',
    'assess_psf': 'psf',
    'blend': 'psf',
    'GaussianMixture': 'psf',
    'GriddedMixturePSF': 'psf',
    'MultiGaussianPSFModel': 'psf',
    'PSFAssessment': 'psf',
    'Shapes': 'psf',
    'ShapeStatus': 'psf',
    'compare_n_components': 'fitting',
    'fit_mixture': 'fitting',
    'FitStatus': 'fitting',
    'MixtureFit': 'fitting',
    'MixturePosterior': 'fitting',
    'sample_mixture': 'fitting',
    'select_n_components': 'fitting',
    'PSFExModel': 'files',
    'read_psfex': 'files',
    'EmpiricalPSF': 'field',
    'fit_mixture_field': 'field',
    'MixtureField': 'field',
    'select_psf_stars': 'field',
    'TunedMixtureField': 'field',
    'add_sky_positions': 'photometry',
    'cramer_rao': 'photometry',
    'CramerRao': 'photometry',
    'decode_psf_flags': 'photometry',
    'fit_many': 'photometry',
    'MixtureFitter': 'photometry',
    'MixturePSFPhotometry': 'photometry',
    'pixel_error': 'photometry',
    'pixel_phase_error': 'photometry',
    'PixelPhaseError': 'photometry',
    'to_flux_densities': 'photometry',
    'CrowdedMixturePhotometry': 'crowded',
    'fit_crowded_psf': 'crowded',
    'inject_and_recover': 'crowded',
    'InjectionResult': 'crowded',
    'UnfinishedTilesError': 'crowded',
    'barycentric_observer': 'sky',
    'invert_wcs': 'sky',
    'bootstrap_median': 'motions',
    'decode_motion_flags': 'motions',
    'Epoch': 'motions',
    'MotionSolution': 'motions',
    'ProperMotionFitter': 'motions',
    'ImageEpoch': 'pixel_motions',
    'PixelMotionFitter': 'pixel_motions',
    'PixelMotionSolution': 'pixel_motions',
    'Band': 'simulation',
    'crowded_field': 'simulation',
    'CSST_BANDS': 'simulation',
    'csst_psf': 'simulation',
    'DetectorEffects': 'simulation',
    'Exposure': 'simulation',
    'Instrument': 'simulation',
    'Optics': 'simulation',
    'paper_exposures': 'simulation',
    'paper_scene': 'simulation',
    'render_stars': 'simulation',
    'Scene': 'simulation',
    'simulate': 'simulation',
    'simulate_catalogues': 'simulation',
    'simulate_epochs': 'simulation',
    'SimulatedCatalogue': 'simulation',
    'sky_field': 'simulation',
    'sparse_field': 'simulation',
}

__getattr__, __dir__, _names = hand_on(__name__, _OWNERS, ('plotting',))
__all__ = ['__version__', *_names]

# Table.read(file, format='mgauss.dolphot') and its likes.
offer_formats(('hst1pass', 'dolphot', 'daophot', 'starfinder', 'sextractor'),
              f'{__name__}.files.star_lists', 'read_star_list')
