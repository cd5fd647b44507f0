"""
From images to motions.

A simulated image of stars, the PSF made from these stars, and proper motions
from two such images taken 3.6 years apart.
"""
import matplotlib.pyplot as plt
import numpy as np
from photutils.detection import DAOStarFinder

from photutils_mgauss import (
    Epoch,
    Instrument,
    MixturePSFPhotometry,
    ProperMotionFitter,
    fit_mixture_field,
    paper_exposures,
    select_psf_stars,
    simulate_epochs,
    sky_field,
)
from photutils_mgauss.plotting import plot_mixture, plot_proper_motions

sources = sky_field(120, 60, size=0.6, magnitudes=(18, 22), separation=1.0,
                    parallaxes=False, rng=1)
exposures = paper_exposures(offset=1.0)
scenes = simulate_epochs(sources, [exposures[0], exposures[6]], rng=2,
                         instrument=Instrument(shape=(450, 450)))
epochs = []
for scene in scenes:
    data = scene.image - np.median(scene.image)
    stars = select_psf_stars(data, error=scene.error, mask=scene.mask)
    field = fit_mixture_field(data, stars, error=scene.error,
                              mask=scene.mask, n_components=3, degree=1)
    photometry = MixturePSFPhotometry(
        field, 11, finder=DAOStarFinder(100, 2.0), aperture_radius=3,
        xy_cov=True)
    table = photometry(data, error=scene.error, mask=scene.mask)
    table.remove_column('id')
    epochs.append(Epoch(table[table['flags'] == 0], scene.wcs, scene.time))
quasars = sources[sources['kind'] == 'qso']['ra', 'dec']
quasars['class'] = 'qso'
solution = ProperMotionFitter(references=quasars).fit(epochs)

figure, axes = plt.subplot_mosaic('AB;CC', figsize=(3.5, 4),
                                  height_ratios=(1, 1.9),
                                  layout='constrained')
axes = list(axes.values())
axes[0].imshow(np.arcsinh(data / 30), origin='lower', cmap='gray_r')
axes[0].set(title='an image', xlabel='x [pix]', ylabel='y [pix]')
plot_mixture(field.mixture_at(225, 225), ax=axes[1])
axes[1].set_title('its PSF')
plot_proper_motions(solution.stars, ax=axes[2])
axes[2].set_title('proper motions')
