"""
Residuals for different numbers of Gaussians.

The residuals of fits with one to five Gaussians, on one scale, as in Appendix
B of Nie et al. :doc:`/tasks/how_many_gaussians` explains what they mean for
positions.
"""
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import AiryDisk2D
from scipy.ndimage import convolve1d

from photutils_mgauss import compare_n_components
from photutils_mgauss.plotting import plot_comparison_of_numbers

y, x = np.mgrid[-32:33, -32:33] / 4
image = AiryDisk2D(radius=2.2)(0.96 * x + 0.1 * y, y)
for axis in (0, 1):  # averaged over the pixel, four samples wide
    image = convolve1d(image, np.array([1, 2, 2, 2, 1]) / 8, axis)

table = compare_n_components(image, (1, 2, 3, 4, 5), oversampling=4)
figure, axes = plt.subplots(3, 2, figsize=(3.5, 4.3), layout='constrained')
plot_comparison_of_numbers(image, table, axes=axes)
