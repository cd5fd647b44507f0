"""
Proper motions.

Stars and quasars of a simulated field at five epochs of Nie et al.: the
diagram of their motions, and the measured motions against the true ones.
"""
import matplotlib.pyplot as plt
import numpy as np
from gallery_scenes import moving_stars

from photutils_mgauss import ProperMotionFitter
from photutils_mgauss.plotting import plot_comparison, plot_proper_motions

sources, epochs = moving_stars((0, 1, 3, 5, 6))
quasars = sources['id'][sources['kind'] == 'qso']
fitter = ProperMotionFitter(references=list(quasars))
solution = fitter.fit(epochs)

stars = solution.stars
figure, axes = plt.subplots(2, 1, figsize=(3.5, 5.8), layout='constrained')
plot_proper_motions(stars, ax=axes[0])
row = {name: i for i, name in enumerate(sources['id'])}
true = sources[[row[name] for name in stars['id']]]
some = np.isfinite(stars['pmra'].value) & (true['kind'] == 'star')
plot_comparison(true['pmra'][some].value, stars['pmra'][some].value,
                stars['pmra_error'][some].value, label=r'$\mu_{\alpha*}$',
                unit='mas / yr', ax=axes[1])
