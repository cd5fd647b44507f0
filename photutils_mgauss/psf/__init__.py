"""PSFs: mixtures of Gaussians, astropy models, grids and their shapes.

`mixture` has `GaussianMixture`, a frozen value with its algebra. `model` and
`gridded` are the two astropy models that photutils accepts; `base` is what
they share. `grid` holds a detector grid as arrays, `local` the grid at the
places of many stars, `renderer` draws stars on an image, and `convert`
translates from and to the PSFs of other programs. `shapes` measures sizes and
ellipticities and `assessment` compares them with a known truth. Nothing here
fits images: constructors that need a fit call the room `fitting` when they
run.
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
