"""
The worst node of a grid.

Where a mixture describes its ePSF worst, and what is left there, for two,
three and five Gaussians. A pattern that one component could take up asks for
more of them.
"""
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import AiryDisk2D
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel
from scipy.ndimage import convolve1d

from photutils_mgauss import GriddedMixturePSF
from photutils_mgauss.plotting import plot_worst_node


def airy(x_0, y_0):
    """Return an Airy disk that changes over the detector [0, 1000]."""
    y, x = np.mgrid[-24:25, -24:25] / 3
    shear = 0.1 * (x_0 - y_0) / 1000
    image = AiryDisk2D(radius=2.6 + 0.4 * y_0 / 1000)(x + shear * y, y)
    for axis in (0, 1):  # averaged over the pixel, three samples wide
        image = convolve1d(image, np.full(3, 1 / 3), axis)
    return 9 * image / image.sum()


lines = np.linspace(0, 1000, 3)
places = [(x, y) for y in lines for x in lines]
epsfs = GriddedPSFModel(NDData(
    np.array([airy(*place) for place in places]),
    meta={'grid_xypos': places, 'oversampling': 3}))
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout='constrained')
for ax, k in zip(axes, (2, 3, 5), strict=True):
    psf = GriddedMixturePSF.from_gridded_psf(epsfs, n_components=k)
    plot_worst_node(ax, psf, epsfs)
    ax.set_title(f'K = {k}\n{ax.get_title()}', fontsize='medium')
