"""
Errors of a PSF made from stars.

The size and ellipticity of a mixture field, fitted to the stars of one
simulated image, minus those of the true PSF.
"""
import matplotlib.pyplot as plt
from gallery_scenes import star_image

from photutils_mgauss import (
    assess_psf,
    fit_mixture_field,
    select_psf_stars,
    sparse_field,
)
from photutils_mgauss.plotting import plot_shape_map

shape = (700, 700)
truth, scene = star_image(sparse_field(shape, rng=1), shape)
data = scene.image - scene.background
stars = select_psf_stars(data, error=scene.error, mask=scene.mask)
field = fit_mixture_field(data, stars, error=scene.error, mask=scene.mask,
                          n_components=3, degree=2)


report = assess_psf(field, truth, (9, 9))
figure, axes = plt.subplots(2, 1, figsize=(3.5, 5.4), layout='constrained')
for ax, name, label in (
        (axes[0], 'size_error', r'$\delta(R^2)/R^2$'),
        (axes[1], 'ellipticity_error', r'$\delta\epsilon$')):
    table = report.table
    plot_shape_map(table['x'], table['y'], table[name], label=label, ax=ax)
