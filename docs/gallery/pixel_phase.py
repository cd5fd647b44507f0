"""
Pixel-phase errors.

Bright stars at all positions within a pixel, measured with the true PSF and
with a single Gaussian. If the PSF is wrong, the measured position depends on
where in its pixel the star lies.
"""
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from photutils_mgauss import (
    GaussianMixture,
    MixturePSFPhotometry,
    MultiGaussianPSFModel,
    fit_mixture,
    pixel_phase_error,
)

psf = GaussianMixture.from_stddevs(
    weights=[0.7, 0.3], means=[(0, 0), (0.15, 0)],
    stddevs=[(0.65, 0.65), (1.6, 1.5)], rho=[0.0, 0.2])
rng = np.random.default_rng(1)
x = 15 + 25 * np.arange(400) + rng.uniform(-0.5, 0.5, 400)
y = 12 + rng.uniform(-0.5, 0.5, 400)
image = np.zeros((25, 10025))
for i in range(400):
    left = 25 * i
    image[:, left:left + 30] += psf.render((25, 30), x[i] - left, y[i],
                                           flux=1e5)
error = np.sqrt(image + 25)
image += rng.normal(0, error)
one = fit_mixture(psf.render((81, 81), 40, 40), 1, radius=3).mixture

figure, axes = plt.subplots(2, 1, figsize=(3.5, 4), layout='constrained',
                            sharex=True, sharey=True)
start = QTable({'x': x, 'y': y, 'flux': np.full(400, 1e5)})
for ax, mixture, title in ((axes[0], psf, 'the true PSF'),
                           (axes[1], one, 'one Gaussian')):
    photometry = MixturePSFPhotometry(MultiGaussianPSFModel(mixture), (7, 7),
                                      aperture_radius=3)
    table = photometry(image, error=error, init_params=start)
    pixel_phase_error(x, table['x_fit']).plot(ax=ax)
    ax.set_title(title)
    ax.label_outer()
