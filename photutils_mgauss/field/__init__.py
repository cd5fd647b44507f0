"""The PSF of an image, made from stars of the same image.

`fit` has `fit_mixture_field`. `selection` chooses stars, `input` and `stamps`
cut them out, and `stages` fits fields of rising degree and drops stars that do
not fit; `normal` adds up the normal equations and `forms` has the kinds of
field they are for. `choice` validates numbers of Gaussians and degrees with
stars left out of the fit, and `beyond` adds further degrees when there are few
stars. `covariance`, `noise` and `misfit` give the errors of the field, and
`growth` measures the light beyond the stamps. The results are `mixture_field`,
`tuned_field` and `empirical`, a PSF of pixels, all on `base`. A field gives a
mixture at any place and a grid for the room `photometry`; it knows neither sky
nor time.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'EmpiricalPSF': 'empirical',
    'fit_mixture_field': 'fit',
    'MixtureField': 'mixture_field',
    'select_psf_stars': 'selection',
    'TunedMixtureField': 'tuned_field',
})
