"""
Errors of a grid.

Mixtures of three Gaussians fitted to a grid of ePSFs with Airy rings: the
error of the size at each node (as Figs. 4 to 7 of Nie et al.), the pixel-phase
error, and the ellipticity as whiskers along the long axis. The lower row shows
the residual of the worst ePSF for two, three and five Gaussians. If one more
Gaussian could describe the pattern, use more Gaussians.
"""
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import AiryDisk2D
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel
from scipy.ndimage import convolve1d

from photutils_mgauss import GriddedMixturePSF
from photutils_mgauss.plotting import (
    plot_node_map,
    plot_whiskers,
    plot_worst_node,
)


def airy(x_0, y_0):
    """Return an Airy disk that changes over the detector [0, 1000]."""
    y, x = np.mgrid[-24:25, -24:25] / 3
    shear = 0.1 * (x_0 - y_0) / 1000
    image = AiryDisk2D(radius=2.6 + 0.4 * y_0 / 1000)(x + shear * y, y)
    for axis in (0, 1):  # averaged over the pixel, three samples wide
        image = convolve1d(image, np.full(3, 1 / 3), axis)
    return 9 * image / image.sum()


lines = np.linspace(0, 1000, 9)
places = [(x, y) for y in lines for x in lines]
epsfs = GriddedPSFModel(NDData(
    np.array([airy(*place) for place in places]),
    meta={'grid_xypos': places, 'oversampling': 3}))
psfs = {k: GriddedMixturePSF.from_gridded_psf(epsfs, n_components=k)
        for k in (2, 3, 5)}

figure, axes = plt.subplots(2, 3, figsize=(7.1, 3.8), layout='constrained')
maps, worst = axes
plot_node_map(psfs[3], 'size_error', ax=maps[0])
plot_node_map(psfs[3], 'phase_error', ax=maps[1])
plot_whiskers(psfs[3], ax=maps[2])
for ax, (k, psf) in zip(worst, psfs.items(), strict=True):
    plot_worst_node(psf, epsfs, ax=ax)
    ax.set_title(f'K = {k}')
maps[0].set_title('size')
maps[1].set_title('pixel phase')
bars = [bar for ax in axes.flat for bar in ax.child_axes]
for bar, label in zip(bars, (r'$\delta(R^2)/R^2$', 'shift [pix]',
                             *3 * ['% of the peak']), strict=True):
    bar.set_ylabel(label)
