"""
The PSF of an image, made of the image's own stars.

`selection` chooses the stars, `input` and `stamps` cut them out, `fit` has
`fit_mixture_field`, which goes through `stages` of rising degree and drops
what does not fit, on the normal equations of `normal` for the forms of
`forms`; `choice` validates numbers of Gaussians and degrees, `beyond`
adds one more degree for few stars, `covariance`, `noise` and `misfit` say how
far all may be off, `growth` measures the light beyond the stamps. The results
are `mixture_field`, `tuned_field` and, with pixels on top, `empirical`, all on
`base`. A field gives a mixture at any place and a grid for the room
`photometry`; it knows neither sky nor time.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'EmpiricalPSF': 'empirical',
    'fit_mixture_field': 'fit',
    'MixtureField': 'mixture_field',
    'select_psf_stars': 'selection',
    'TunedMixtureField': 'tuned_field',
})
