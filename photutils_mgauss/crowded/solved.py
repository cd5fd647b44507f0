"""The solution of a crowded image: tiles solved, and put together."""
import warnings
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.crowded.correlated import allow_for_correlation
from photutils_mgauss.crowded.plan import run
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.table import (
    as_qtable,
    in_given_order,
    no_stars,
)
from photutils_mgauss.crowded.unfinished import UnfinishedTilesError
from photutils_mgauss.psf.residual import FEWEST
from photutils_mgauss.utils.correlated_noise import correlation_of, no_pairs

# A PSF whose size is off by more than this fraction is warned of.
_WIDTH_TOLERANCE = 0.1
# Otherwise, so is a share of pixels like this that are far off the model.
_FAR_OFF = 0.1
_CONFUSION = ('errors and fluxes allow for stars that were not found; what of '
              'their light the background takes is calibrated on simulated '
              'fields')


@dataclass(frozen=True)
class Solved:
    """
    The stars of an image, what is unfinished of it, and why.

    ``correlation`` is the `NoiseCorrelation` of the image, or None.
    """

    table: QTable
    unfinished: list
    errors: list
    correlation: object = None

    @classmethod
    def of(cls, plan, executor, progress_bar, *, stacklevel):
        """Solve all tiles of a `Plan`, and put their stars together."""
        outcomes, errors = run(plan, executor, progress_bar)
        unfinished = [core for core, outcome in zip(plan.cores, outcomes,
                                                    strict=True)
                      if outcome is None]
        table, correlation = _table(outcomes, plan, stacklevel + 1)
        return cls(table, unfinished, errors, correlation)

    def tell_of_correlation(self, stacklevel):
        """Warn if the noise of the image is correlated."""
        if self.correlation is not None:
            warnings.warn(f'{self.correlation} Errors are enlarged for it, '
                          'and limits of stars are in units of these.',
                          AstropyUserWarning, stacklevel=stacklevel)

    def check(self):
        """Raise an error if not all is finished."""
        if self.unfinished:
            raise UnfinishedTilesError(self.unfinished,
                                       self.table) from self.errors[0]


def _table(outcomes, plan, stacklevel):
    """Return the table of all tiles and the noise; empties the list."""
    done = [outcome for outcome in outcomes if outcome is not None]
    outcomes.clear()
    stars = Stars.joined([no_stars(), *(outcome.stars for outcome in done)])
    report = _report(done, plan.options, stacklevel + 1)
    correlation = correlation_of(sum((one.pairs for one in done), no_pairs()))
    del done
    stars = allow_for_correlation(stars, correlation, plan.psf, plan.options)
    meta = {'n_stars': len(stars), **report,
            'noise_correlation': str(correlation or '')}
    if plan.given is not None:
        stars = in_given_order(stars, plan.given)
    else:
        stars.sort('y', 'x')
    confusion = plan.options.confusion
    if confusion:
        meta['confusion'] = _CONFUSION
    return as_qtable(stars, plan.image.unit, meta,
                     confusion=confusion), correlation


def _report(done, options, stacklevel):
    widths = np.concatenate([o.widths for o in done]) if done else []
    n_pixels = sum(o.n_pixels for o in done)
    chi2 = sum(o.chi2 for o in done) / max(n_pixels, 1)
    far = sum(o.n_far for o in done) / max(n_pixels, 1)
    # Undetected companions broaden stars: look at those least broadened.
    width = float(np.percentile(widths, 25)) if len(widths) >= 5 else np.nan
    if abs(width) > _WIDTH_TOLERANCE:
        word, more = 'narrow', ('Where most bright stars are blends, the '
                                'PSF may be right')
        if width < 0:
            word, more = 'wide', ('A PSF that includes the pixel must have '
                                  'pixel_integrated=False')
        warnings.warn(f'the PSF is too {word}: the variance of the light '
                      f'of bright stars differs by {width:+.0%}. Use the '
                      'PSF of this image: psf_model=None (no --psf) makes '
                      f'one from its stars. {more}', AstropyUserWarning,
                      stacklevel=stacklevel)
    elif far > _FAR_OFF and options.find_neighbors:
        warnings.warn(
            f'stars and background do not describe the image, {far:.0%} of '
            'its pixels are off by more than 5 standard deviations: check '
            'that error is right, that the PSF is that of the image, and '
            'that its light is positive', AstropyUserWarning,
            stacklevel=stacklevel)
    return {'reduced_chi2': chi2, 'psf_size_difference': width,
            **_of_saturated(done)}


def _of_saturated(done):
    """Return what was done for saturated stars, nothing if there are none."""
    known = [o.known for o in done if o.saturated]
    if not known:
        return {}
    if all(known):
        return {'saturated_wings': (
            'what the PSF leaves of saturated stars was measured on bright '
            'stars and subtracted')}
    return {'saturated_wings': (
        'what the PSF leaves of saturated stars was not measured in '
        f'{known.count(False)} of {len(known)} tiles with saturated stars: '
        f'{FEWEST} bright stars that are not saturated are needed')}
