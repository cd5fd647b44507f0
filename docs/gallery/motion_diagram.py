"""
Proper motions.

Stars and quasars of a simulated field at five epochs of Nie et al.: the
diagram of their motions, and the measured motions beside the true ones.
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
from photutils_mgauss.plotting import plot_comparison, plot_proper_motions

sources = sky_field(200, 100, size=1.2, magnitudes=(19, 23.5), separation=1,
                    parallaxes=False, rng=1)
exposures = paper_exposures()
catalogues = simulate_catalogues(
    sources, [exposures[i] for i in (0, 1, 3, 5, 6)], rng=2,
    instrument=Instrument(shape=(1000, 1000)))
quasars = sources['id'][sources['kind'] == 'qso']
fitter = ProperMotionFitter(references=list(quasars))
solution = fitter.fit([Epoch(one.table, one.wcs, one.time)
                       for one in catalogues])

stars = solution.stars
figure, axes = plt.subplots(1, 2, figsize=(9.5, 4.4), layout='constrained')
plot_proper_motions(axes[0], stars)
row = {name: i for i, name in enumerate(sources['id'])}
true = sources[[row[name] for name in stars['id']]]
some = np.isfinite(stars['pmra'].value) & (true['kind'] == 'star')
plot_comparison(axes[1], true['pmra'][some].value, stars['pmra'][some].value,
                stars['pmra_error'][some].value, label=r'$\mu_{\alpha*}$',
                unit='mas / yr')
