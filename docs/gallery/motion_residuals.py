"""
Residuals of an alignment.

The residuals of one of three epochs whose frames differ by rotation, scale
and distortion, aligned with shifts alone and with polynomials of degree 3.
Arrows in a pattern show distortion; random arrows show noise.
"""
import matplotlib.pyplot as plt

from photutils_mgauss import (
    Epoch,
    Exposure,
    Instrument,
    ProperMotionFitter,
    paper_exposures,
    simulate_catalogues,
    sky_field,
)
from photutils_mgauss.plotting import plot_residual_vectors

camera = Instrument(shape=(1000, 1000))
sources = sky_field(150, 150, size=1.2, magnitudes=(19, 22), separation=1,
                    parallaxes=False, rng=1)
exposures = [paper_exposures(distortion=0.05)[i] for i in (0, 3, 6)]
epochs = []
for one, exposure in zip(simulate_catalogues(
        sources, exposures, instrument=camera, rng=2), exposures,
        strict=True):
    naive = Exposure(exposure.time, ra=exposure.ra, dec=exposure.dec)
    epochs.append(Epoch(one.table, naive.wcs(camera.shape, 0.074), one.time))
quasars = list(sources['id'][sources['kind'] == 'qso'])

figure, axes = plt.subplots(2, 1, figsize=(3.5, 6.4), layout='constrained')
for ax, transform in zip(axes, ('shift', 'poly-3'), strict=True):
    solution = ProperMotionFitter(
        transform=transform, references=quasars, systematic=None,
        clip=None).fit(epochs)
    plot_residual_vectors(solution, 1, ax=ax)
    ax.set_title(f"transform='{transform}'", loc='left', fontsize='medium')
