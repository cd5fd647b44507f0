"""
Errors of positions against magnitude.

Stars of one simulated image, measured with the true PSF: the true errors of
their positions and the stated errors of the fit (as Figs. 9 and 10 of Nie et
al.).
"""
import matplotlib.pyplot as plt
import numpy as np
from gallery_scenes import star_image

from photutils_mgauss import (
    Instrument,
    MixturePSFPhotometry,
    sparse_field,
)
from photutils_mgauss.plotting import plot_error_curve

shape = (1500, 1500)
psf, scene = star_image(sparse_field(shape, rng=1, psf_fraction=0.1,
                                     magnitudes=(18, 24.5)), shape)
stars = scene.truth[scene.truth['inside']]
table = MixturePSFPhotometry(psf, (11, 11), aperture_radius=3)(
    scene.image - scene.background, error=scene.error, mask=scene.mask,
    init_params=stars['x', 'y', 'flux'])

mas = 1e3 * Instrument().pixel_scale
residuals = mas * np.column_stack([table[f'{c}_fit'] - stars[c].value
                                   for c in 'xy'])
errors = mas * np.column_stack([table[f'{c}_err'] for c in 'xy'])
figure, ax = plt.subplots(figsize=(3.5, 2.7), layout='constrained')
plot_error_curve(stars['mag'].value, residuals, errors, unit='mas', ax=ax)
ax.set_ylim(bottom=0.01)
