"""
Photometry of a crowded field.

A simulated field with one star of 16 to 26 mag per 16 pixels, the stars found
in it, and the residual image in units of the error.
"""
import matplotlib.pyplot as plt
import numpy as np
from gallery_scenes import star_image

from photutils_mgauss import CrowdedMixturePhotometry, crowded_field

shape = (140, 140)
psf, scene = star_image(crowded_field(shape, rng=3), shape)
photometry = CrowdedMixturePhotometry(psf)
stars = photometry(scene.image, error=scene.error, mask=scene.mask)
residual = photometry.make_residual_image(
    scene.image, include_local_bkg=True) / scene.error

figure = plt.figure(figsize=(3.5, 4.6), layout='constrained')
# Each part has a layout of its own, so that bars are where their images are.
upper, lower = figure.subfigures(2, 1, height_ratios=(1, 1.15))
axes = [*upper.subplots(1, 2), lower.subplots()]
light = np.arcsinh((scene.image - scene.background) / 10)
for ax in axes[:2]:
    shown = ax.imshow(light, origin='lower', cmap='gray', vmin=-1, vmax=7)
axes[1].plot(stars['x_fit'], stars['y_fit'], '.', color='#E69F00',
             markersize=0.8)
upper.colorbar(shown, ax=axes[:2], shrink=0.8, location='bottom',
               label='asinh(light / 10 electrons)')
left = axes[2].imshow(residual, origin='lower', cmap='RdBu_r', vmin=-5,
                      vmax=5)
lower.colorbar(left, ax=axes[2], label='residual / error')
for ax, title in zip(axes, ('image', f'{len(stars)} stars found',
                            'residual'), strict=True):
    ax.set(title=title, xlabel='x [pix]', ylabel='y [pix]',
           xlim=(-0.5, 139.5), ylim=(-0.5, 139.5))
