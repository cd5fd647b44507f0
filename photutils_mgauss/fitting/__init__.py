"""
PSF images to mixtures and grids of them, by least squares or PyMC.

`image` has `fit_mixture` for one image or a stack, `search` the search for
the starts of a fit, `grid`, `nodes` and `node_images` the fits at all nodes
of a detector grid, from whatever source, with their report; `phases` tells
what residuals do to positions. `posterior` samples the same model with PyMC,
as `posterior_model` writes it down, `n_components` compares numbers of
Gaussians. The images are PSFs, sampled finely or not; stars of an image, with
noise and neighbours, are the business of the room `field`.
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
