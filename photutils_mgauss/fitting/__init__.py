"""Mixtures fitted to PSF images, by least squares or with PyMC.

`image` has `fit_mixture` for one image or a stack of images, and `search`
finds the starting points of a fit. `grid`, `nodes` and `node_images` fit all
nodes of a detector grid, whatever its source, and report on each; `phases`
computes the errors of positions that residuals cause. `posterior` samples the
posterior of `posterior_model` with PyMC, and `n_components` compares numbers
of Gaussians. The images here are PSFs, at any sampling; stars of an image,
with noise and neighbours, belong to the room `field`.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'fit_mixture': 'image',
    'FitStatus': 'image',
    'MixtureFit': 'image',
    'compare_n_components': 'n_components',
    'select_n_components': 'n_components',
    'MixturePosterior': 'posterior',
    'sample_mixture': 'posterior',
})
