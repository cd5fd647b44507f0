"""
The posterior of a mixture.

Draws of the weight and the width of one of two Gaussians, from PyMC, as in
Appendix A of Nie et al.: histograms, and the traces of the two chains.
"""
import matplotlib.pyplot as plt
import numpy as np

from photutils_mgauss import GaussianMixture, sample_mixture
from photutils_mgauss.plotting import plot_posterior, plot_trace

truth = GaussianMixture.from_stddevs(
    weights=[0.7, 0.3], means=[(0, 0), (0.2, -0.1)],
    stddevs=[(0.9, 1.0), (2.1, 1.8)], rho=[0.0, 0.3])
noise = np.random.default_rng(1).normal(0, 2e-4, (17, 17))
image = truth.render((17, 17), 8, 8) + noise

posterior = sample_mixture(image, 2, draws=300, tune=300, chains=2,
                           rng=1)
figure, axes = plt.subplots(2, 2, figsize=(3.5, 4), layout='constrained')
for row, name in zip(axes, ('weight_1', 'x_stddev_1'), strict=True):
    plot_posterior(posterior, name, ax=row[0])
    plot_trace(posterior, name, ax=row[1])
for ax in axes.flat:
    # One curve each, which its axis names.
    ax.get_legend().remove()
    ax.locator_params(axis='x', nbins=4)
