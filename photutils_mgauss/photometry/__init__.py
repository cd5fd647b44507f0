"""
Positions and fluxes of stars, one star or group at a time.

`psf_photometry` has `MixturePSFPhotometry`, photutils' class with the fits in
compiled code: `engine` fits, spread over threads, and `table` puts the
numbers into photutils' columns; `flags` says in words what the bits of their
flags mean. `fitter` is a fitter for photutils' own
classes, `noise` the noise of pixels and the bound it sets, `pixel_phase` the
errors of position against the sub-pixel phase. `many_images` fits one place
of the sky in many images, and is the only module that needs both PSFs and the
sky. Names of columns, keywords and flags are photutils'.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'MixtureFitter': 'fitter',
    'decode_psf_flags': 'flags',
    'add_sky_positions': 'many_images',
    'fit_many': 'many_images',
    'to_flux_densities': 'many_images',
    'cramer_rao': 'noise',
    'background_error': 'noise',
    'CramerRao': 'noise',
    'pixel_error': 'noise',
    'pixel_phase_error': 'pixel_phase',
    'PixelPhaseError': 'pixel_phase',
    'aperture_correction': 'apertures',
    'MixturePSFPhotometry': 'psf_photometry',
})
