"""The stars of one crowded field in many images: from images to the table."""
import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from astropy.utils.exceptions import AstropyUserWarning

from photutils_mgauss.crowded.alignment import tell_of_misplaced
from photutils_mgauss.crowded.correlated import allow_in_each
from photutils_mgauss.crowded.many_equations import FARTHEST, reach_of
from photutils_mgauss.crowded.many_plan import ManyPlan
from photutils_mgauss.crowded.many_table import (
    as_qtable,
    no_motion,
    no_stars,
)
from photutils_mgauss.crowded.plan import run
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.table import NO_COVARIANCE, NO_OVERLAP
from photutils_mgauss.photometry.many_images import (
    add_motions,
    add_places,
    grid_positions,
    read_field,
)
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.utils.checkpoint import Checkpoint
from photutils_mgauss.utils.correlated_noise import correlation_of, no_pairs
from photutils_mgauss.utils.flags import MOTIONLESS


class Settings(NamedTuple):
    """
    What `CrowdedMixturePhotometry` knows.

    ``options_of`` returns the `TileOptions` of a `PixelData`, ``model_of`` the
    PSF of one that comes without; the others are as of the class.
    """

    options_of: object
    model_of: object
    bound: float
    tile_shape: tuple | None
    overlap: int
    executor: object
    progress_bar: bool
    checkpoint: Checkpoint
    saturation: object = None


def fit_images(images, listed, settings, *, motions):
    """
    Return the table of all images, what is unfinished, and errors.

    Parameters
    ----------
    images, listed, motions
        As of the method of `CrowdedMixturePhotometry`.
    settings : Settings
    """
    field = read_field(images, settings.saturation)
    given = None
    if listed is not None:
        u, v = grid_positions(listed, field.grid)
        given = Stars(u, v, np.zeros(u.size), number=np.arange(u.size),
                      bound=settings.bound)
    models = [settings.model_of(pixels) if psf is None else psf
              for psf, pixels in zip(field.psfs, field.pixels, strict=True)]
    psfs = _local(models)
    scales = [psf.scale for psf in psfs]
    each = [settings.options_of(pixels).widened(scale)
            for pixels, scale in zip(field.pixels, scales, strict=True)]
    tell_of_misplaced(field, models, scales, motions=motions)
    plan = ManyPlan(
        field.pixels, psfs,
        # What is known of fluxes and places is said once for all images.
        [replace(one, count_slope=0.0) for one in each],
        replace(each[int(np.argmax(scales))], gain=None), field.grid,
        np.ones(len(each)), _factors(field, motions), _bands(field, motions),
        settings.tile_shape, round(settings.overlap * max(scales)), given,
        settings.checkpoint).with_scales()
    outcomes, errors = run(plan, settings.executor, settings.progress_bar)
    left = [core for core, outcome in zip(plan.cores, outcomes, strict=True)
            if outcome is None]
    return _table(plan, outcomes, field), left, errors


def _factors(field, motions):
    """Return how images see places and, if asked for, motions (E, 2, p)."""
    factors = np.tile(np.eye(2), (len(field.pixels), 1, 2 if motions else 1))
    if motions:
        factors[:, :, 2:] *= field.time_since_mean()[:, None, None]
    return factors


def _bands(field, motions):
    """Return the number (E,) of what may have fluxes in common."""
    # Without motions images are there for their fluxes.
    if not motions:
        return np.arange(len(field.pixels))
    return np.unique(field.bands, return_inverse=True)[1]


def _local(models):
    """Return the PSF of each image, made once where images have the same."""
    made = {id(model): LocalPSF.of(model)
            for model in {id(model): model for model in models}.values()}
    return [made[id(model)] for model in models]


def _table(plan, outcomes, field):
    done = [outcome for outcome in outcomes if outcome is not None]
    stars = Stars.joined([no_stars(len(plan.images),
                                   plan.factors.shape[2]),
                          *(outcome.stars for outcome in done)])
    n_pixels = sum(outcome.n_pixels for outcome in done)
    meta = {'n_stars': len(stars), 'scales': plan.scales,
            'reduced_chi2': sum(one.chi2 for one in done) / max(n_pixels, 1)}
    correlations = [correlation_of(sum((
        one.pairs[k] for one in done if one.pairs.ndim > 3), no_pairs()))
        for k in range(len(plan.images))]
    stars = allow_in_each(stars, correlations, plan.psfs, plan.options.keep)
    meta['noise_correlation'] = [str(one or '') for one in correlations]
    _tell_of(correlations)
    if plan.given is not None:
        stars = _in_given_order(stars, plan.given)
    else:
        stars.sort('y', 'x')
    place = stars.x, stars.y, stars.place
    # Of what is not seen only what was taken before comes out.
    reach = reach_of(plan.factors)[2:]
    spread = np.sqrt(np.einsum('nii->ni', stars.place[:, 2:, 2:]))
    rate = np.where(spread * reach < FARTHEST / 2, stars.rate, np.nan)
    table = as_qtable(stars, field.unit, meta,
                      confusion=plan.options.confusion)
    add_places(table, plan.grid, *place)
    if plan.factors.shape[2] > 2:
        add_motions(table, plan.grid, *place, rate, field.years.mean())
    return table


def _tell_of(correlations):
    """Warn of images with correlated noise."""
    numbers = [k for k, one in enumerate(correlations) if one is not None]
    if numbers:
        warnings.warn(
            f'In {len(numbers)} of {len(correlations)} images, the first is '
            f'image {numbers[0]}: {correlations[numbers[0]]} Errors are '
            'enlarged and significances reduced for it: stars of a '
            'significance below the threshold may be noise.',
            AstropyUserWarning, stacklevel=5)


def _in_given_order(stars, given):
    """Return one row for each place; NaN where nothing was fitted."""
    columns = {}
    for name, column in vars(stars).items():
        fill = np.nan if column.dtype.kind == 'f' else 0
        columns[name] = np.full((len(given), *column.shape[1:]), fill,
                                column.dtype)
        columns[name][stars.number] = column
    missing = np.ones(len(given), bool)
    missing[stars.number] = False
    columns['flags'][missing] |= NO_COVARIANCE | NO_OVERLAP
    columns['flags'][missing & no_motion(columns['place'])] |= MOTIONLESS
    return Stars.of_columns(columns)
