"""
Errors of motions.

The errors of proper motions against magnitude, with all seven epochs of Nie
et al. (as their Fig. 12), and their median for two to seven epochs (as Fig.
11).
"""
import matplotlib.pyplot as plt
import numpy as np

from photutils_mgauss import (
    Epoch,
    Instrument,
    ProperMotionFitter,
    paper_exposures,
    simulate_catalogues,
    sky_field,
)
from photutils_mgauss.plotting import (
    plot_errors_by_epochs,
    plot_motion_errors,
)

sources = sky_field(200, 100, size=1.2, magnitudes=(19, 23.5), separation=1,
                    parallaxes=False, rng=1)
catalogues = simulate_catalogues(sources, paper_exposures(), rng=2,
                                 instrument=Instrument(shape=(1000, 1000)))
epochs = [Epoch(one.table, one.wcs, one.time) for one in catalogues]
quasars = sources['id'][sources['kind'] == 'qso']
fitter = ProperMotionFitter(references=list(quasars))
campaigns = ((0, 6), (0, 3, 6), (0, 1, 3, 6), (0, 1, 3, 5, 6),
             (0, 1, 2, 3, 5, 6), range(7))
solutions = [fitter.fit([epochs[i] for i in campaign])
             for campaign in campaigns]

figure, axes = plt.subplots(1, 2, figsize=(9.5, 4), layout='constrained')
stars = solutions[-1].stars
magnitude = dict(zip(sources['id'], sources['mag_g'].value, strict=True))
plot_motion_errors(axes[0], stars,
                   np.array([magnitude[name] for name in stars['id']]))
plot_errors_by_epochs(axes[1], solutions)
