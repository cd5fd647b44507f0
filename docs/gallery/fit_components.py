"""
The Gaussians of a PSF.

A PSF with Airy rings, the three Gaussians fitted to it, and the residual: the
image summed along y (Fig. 3a of Nie et al.), its brightest row on a
logarithmic scale (Fig. 3b), and the one-sigma ellipse of each Gaussian.
"""
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import AiryDisk2D
from scipy.ndimage import convolve1d

from photutils_mgauss import fit_mixture
from photutils_mgauss.plotting import (
    plot_ellipses,
    plot_profile,
    plot_projection,
)

y, x = np.mgrid[-32:33, -32:33] / 4
image = AiryDisk2D(radius=2.2)(0.96 * x + 0.1 * y, y)
for axis in (0, 1):  # averaged over the pixel, four samples wide
    image = convolve1d(image, np.array([1, 2, 2, 2, 1]) / 8, axis)

fit = fit_mixture(image, 3, oversampling=4)
figure, axes = plt.subplots(3, 1, figsize=(3.5, 6.6), layout='constrained')
plot_projection(fit, image, oversampling=4, ax=axes[0])
plot_profile(fit, image, ax=axes[1])
plot_ellipses(fit.mixture, ax=axes[2])
axes[2].legend(loc='center left', bbox_to_anchor=(1, 0.5))
for ax, title in zip(axes, ('summed along y', 'the brightest row',
                            'one-sigma ellipses'), strict=True):
    ax.set_title(title)
