"""
Errors of proper motions.

The errors against magnitude with all seven epochs of Nie et al. (as their
Fig. 12), and the median error for two to seven epochs (as Fig. 11).
"""
import matplotlib.pyplot as plt
import numpy as np
from gallery_scenes import moving_stars

from photutils_mgauss import ProperMotionFitter
from photutils_mgauss.plotting import (
    plot_errors_by_epochs,
    plot_motion_errors,
)

sources, epochs = moving_stars(range(7))
quasars = sources['id'][sources['kind'] == 'qso']
fitter = ProperMotionFitter(references=list(quasars))
campaigns = ((0, 6), (0, 3, 6), (0, 1, 3, 6), (0, 1, 3, 5, 6),
             (0, 1, 2, 3, 5, 6), range(7))
solutions = [fitter.fit([epochs[i] for i in campaign])
             for campaign in campaigns]

figure, axes = plt.subplots(2, 1, figsize=(3.5, 5), layout='constrained')
stars = solutions[-1].stars
magnitude = dict(zip(sources['id'], sources['mag_g'].value, strict=True))
plot_motion_errors(stars,
                   np.array([magnitude[name] for name in stars['id']]),
                   ax=axes[0])
plot_errors_by_epochs(solutions, ax=axes[1])
