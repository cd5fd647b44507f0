"""
What a PSF is: mixtures of Gaussians, the astropy models, grids, shapes.

`mixture` has `GaussianMixture`, a frozen value with its algebra; `model` and
`gridded` are the two astropy models, drop-in for photutils, on what `base`
has in common for them; `grid` is a detector grid as arrays, `local` the same
at the places of many stars, `renderer` draws them on an image, `convert` is
what other programs call a PSF.
`shapes` measures sizes and ellipticities, `assessment` compares them with a
truth. Nothing here fits an image: constructors that must fit call the room
`fitting` when they are called.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'assess_psf': 'assessment',
    'PSFAssessment': 'assessment',
    'GriddedMixturePSF': 'gridded',
    'blend': 'blending',
    'GaussianMixture': 'mixture',
    'MultiGaussianPSFModel': 'model',
    'adaptive_moments': 'shapes',
    'Shapes': 'shapes',
    'ShapeStatus': 'shapes',
})
