"""Positions and fluxes of stars, one star or group at a time.

`psf_photometry` has `MixturePSFPhotometry`, photutils' class with its fits in
compiled code: `engine` fits the stars in several threads, `table` fills
photutils' columns, and `flags` gives the meaning of each flag. `fitter` is a
fitter for photutils' own classes, `noise` has the noise of pixels and the
Cramer-Rao bound, and `pixel_phase` the errors of position as a function of the
sub-pixel phase. `many_images` fits one position on the sky to many images; it
is the only module here that needs both a PSF and a WCS. Columns, keywords and
flags have photutils' names.
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
