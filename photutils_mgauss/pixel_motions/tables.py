"""The tables of stars and fluxes, and what speaks against the images."""
import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.motions.baseline import period
from photutils_mgauss.motions.tables import add_parameters, groups_in_time
from photutils_mgauss.pixel_motions.campaign import light_unit
from photutils_mgauss.sky.space_motion import turned
from photutils_mgauss.utils.star_columns import words_column

NO_SOLUTION, BAD_POSITION, RELATIVE = 1, 4, 256
NOT_CONVERGED, POSITION_ONLY, WANDERED = 65536, 131072, 262144

# Shifts of an image against the others that are told: in pixels, and in
# standard errors; and from how many stars of what significance.
_SHIFT, _SURE, _FEW, _BRIGHT = 0.05, 6.0, 5, 5.0
# Misfits are told from this part of the stars on, with chi2 of so many times
# the degrees of freedom.
_MANY, _MISFIT = 0.05, 2.0


def star_table(campaign, listed, solved, errors, *, forced, relative):
    """Return the table of n stars."""
    seen = solved.weights > 0
    solved_for = _solved_for(errors, solved, forced)
    table = QTable({'id': listed.ids})
    _add_values(table, campaign, solved, errors, solved_for, forced)
    table['ref_epoch'] = np.full(len(table), campaign.working_year) * u.yr
    _add_quality(table, campaign, solved, seen)
    unit, scale = light_unit(campaign), campaign.scale
    shown = np.where(seen, solved.fluxes * (1 - errors.flux_bias), np.nan)
    table['flux'] = shown * scale * unit
    table['flux_err'] = errors.flux_error * scale * unit
    table['n_images'] = seen.sum(axis=1)
    table['significance'] = significance(solved)
    table['reference'] = words_column(np.full(len(table), '', 'U8'))
    moved = np.abs(np.where(seen[..., None], solved.pixels - solved.given,
                            0))
    far = np.nan_to_num(moved).max(axis=(1, 2), initial=0)
    away = far > np.median(_box_sides(solved, seen)) / 2
    table['flags'] = (
        NO_SOLUTION * ~solved_for + BAD_POSITION * ~seen.any(axis=1)
        + RELATIVE * np.full(len(table), relative)
        + NOT_CONVERGED * (seen.any(axis=1) & ~solved.converged)
        + POSITION_ONLY * (seen.any(axis=1) & ~solved.enough & ~np.full(
            len(table), forced)) + WANDERED * away)
    table.meta['TIMESYS'] = 'TDB'
    return table


def _box_sides(solved, seen):
    sides = np.sqrt(solved.n_pixels[seen])
    return sides if sides.size else np.array([np.inf])


def _solved_for(errors, solved, forced):
    """Return whether each star has a position (n,), given or fitted."""
    if forced:
        return (solved.weights > 0).any(axis=1)
    return np.isfinite(errors.covariance[0, 0])


def _add_values(table, campaign, solved, errors, solved_for, forced):
    known = np.isfinite(errors.covariance)
    # A NaN would spread when the axes turn.
    values, covariance = turned(campaign.plane, solved.values.T,
                                np.where(known, errors.covariance, 0))
    covariance[~known] = np.nan
    values[:, ~solved_for] = np.nan
    if not forced:
        values[2:, ~solved.enough] = np.nan
    add_parameters(table, values, covariance, u.mas, on_sky=True,
                   parallax=campaign.parallax,
                   acceleration=campaign.acceleration)


def _add_quality(table, campaign, solved, seen):
    chi2, dof = chi2_of(campaign, solved)
    table['n_obs'] = seen.sum(axis=1)
    table['n_good_obs'] = seen.sum(axis=1)
    gap = period(np.ptp(campaign.years))
    table['visibility_periods_used'] = groups_in_time(
        campaign.years[:, None], gap, seen.T)
    table['chi2'], table['dof'] = chi2, dof
    with np.errstate(divide='ignore', invalid='ignore'):
        table['reduced_chi2'] = chi2 / dof
        table['uwe'] = np.sqrt(chi2 / dof)


def chi2_of(campaign, solved):
    """Return chi2 and degrees of freedom (n,) of each star's group."""
    n = len(solved.values)
    chi2, dof = np.full(n, np.nan), np.full(n, np.nan)
    for group, state in zip(solved.groups, solved.states, strict=True):
        shown = state.n_pixels > 0
        free = (solved.free[group].sum(axis=(1, 2))
                + (np.einsum('gcii->gci', state.known) > 0).sum(axis=(1, 2))
                + campaign.joint.fit_sky * shown.sum(axis=1))
        left = state.n_pixels.sum(axis=1) - free
        good = left > 0
        # Where images have no noise rounding makes it less than zero.
        chi2[group[good]] = np.maximum(state.chi2[good, None], 0)
        dof[group[good]] = left[good, None]
    return chi2, dof


def significance(solved):
    """Return the signal to noise (n,) of all images together."""
    squares = np.sign(solved.fluxes) * solved.fluxes**2 * solved.weights
    return np.sqrt(np.maximum(squares.sum(axis=1), 0))


def flux_table(campaign, listed, solved, errors):
    """Return one row for each star and image that shows it."""
    star, image = np.nonzero(solved.weights > 0)
    at = star, image
    weight = solved.weights[at]
    flux = (solved.fluxes * (1 - errors.flux_bias))[at]
    error = errors.flux_error[at]
    if campaign.joint.n_fluxes < campaign.n_images:
        # The flux of the image alone, at the common place.
        flux = flux + solved.excess[at] / weight
        error = np.maximum(error, 1 / np.sqrt(weight))
    unit, scale = light_unit(campaign), campaign.scale
    table = QTable({'id': listed.ids[star], 'image': image})
    table['time'] = campaign.years[image] * u.yr
    bands = [epoch.band or '' for epoch in campaign.epochs]
    table['band'] = words_column(np.array(bands, 'U16')[image])
    table['x'], table['y'] = solved.pixels[at].T * u.pix
    table['flux'], table['flux_err'] = (flux * scale * unit,
                                        error * scale * unit)
    table['upper_limit'] = (np.maximum(flux, 0) + 3 * error) * scale * unit
    if campaign.joint.fit_sky:
        table['local_bkg'] = solved.sky[at] * scale * unit
    table.meta['TIMESYS'] = 'TDB'
    return table


def image_table(campaign, solved, errors):
    """Return one row for each image: its stars and its shift from the rest."""
    seen = solved.weights > 0
    shift, error = image_shifts(solved, errors)
    table = QTable({'image': np.arange(campaign.n_images)})
    table['time'] = campaign.years * u.yr
    bands = [epoch.band or '' for epoch in campaign.epochs]
    table['band'] = words_column(np.array(bands, 'U16'))
    table['n_stars'] = seen.sum(axis=0)
    table['shift'], table['shift_err'] = shift * u.pix, error * u.pix
    return table


def image_shifts(solved, errors):
    """
    Return how images lie against the others (E, 2), and errors, NaN if few.

    The residual of each star with a place of its own in the image, left out
    of the star's fit; of all stars the median.
    """
    n_images = solved.weights.shape[1]
    shift, error = np.full((2, n_images, 2), np.nan)
    bright = solved.converged & (significance(solved) > _BRIGHT)
    for k in range(n_images):
        curve = solved.curves[:, k] * solved.fluxes[:, k, None, None]**2
        sound = bright & (solved.fluxes[:, k]**2 * solved.weights[:, k] > 9)
        sound &= np.linalg.det(curve) > 0
        if sound.sum() < _FEW:
            continue
        away, spread = _left_out(solved, errors, k, sound, curve[sound])
        good = np.isfinite(away).all(axis=1) & (spread > 0).all(axis=1)
        if good.sum() < _FEW:
            continue
        shift[k] = np.median(away[good], axis=0)
        mad = 1.48 * np.median(np.abs(away[good] - shift[k]), axis=0)
        error[k] = 1.25 * mad / np.sqrt(good.sum())
    return shift, error


def _left_out(solved, errors, k, stars, curve):
    """Return offsets (r, 2) of stars in image k from a fit without it."""
    slope, plain = solved.slopes[stars, k], errors.plain[stars]
    alone = np.linalg.inv(curve)
    away = np.einsum('nij,nj->ni', alone, solved.pulls[stars, k])
    model = np.einsum('nip,npq,njq->nij', slope, plain, slope)
    left = alone - model
    with np.errstate(all='ignore'):
        # Where the image alone fixes the star nothing can be said.
        sure = np.linalg.det(left) > 0.05 * np.linalg.det(alone)
        left[~sure] = np.eye(2)
        out = np.einsum('nij,njk,nk->ni', alone, np.linalg.inv(left), away)
    out[~sure] = np.nan
    return out, np.einsum('nii->ni', alone)


def shift_notes(table):
    """Return a sentence for each image that lies beside the others."""
    shift, error = table['shift'].value, table['shift_err'].value
    away, sure = np.hypot(*shift.T), np.hypot(*error.T)
    with np.errstate(invalid='ignore'):
        wrong = (away > _SHIFT) & (away > _SURE * sure)
    # One wrong image draws the stars, and then others lie beside them, too.
    worst = sorted(np.flatnonzero(wrong), key=lambda k: -away[k] / sure[k])
    return tuple(
        f'Image {k} lies {away[k]:.2f} pixels ({shift[k, 0]:+.2f}, '
        f'{shift[k, 1]:+.2f}) beside the place that its WCS and the other '
        'images give: correct the WCS with ProperMotionFitter'
        + (f' (perhaps only because of image {worst[0]}).' if n else '.')
        for n, k in enumerate(worst))


def misfit_notes(table, estimated):
    """Return a sentence if many stars are not what the images show."""
    # Scaled errors hide it.
    if estimated or not len(table):
        return ()
    with np.errstate(invalid='ignore', divide='ignore'):
        misfits = table['reduced_chi2'] > np.maximum(
            _MISFIT, 1 + _SURE * np.sqrt(2 / table['dof']))
    n, many = int(misfits.sum()), len(table)
    if n < max(2, _MANY * many):
        return ()
    note = (f'The residuals of {n} of {many} stars are larger than their '
            f'errors allow (reduced_chi2 above {_MISFIT:g}); their motions '
            'may be wrong by more than their errors. Mask cosmic rays and bad '
            'pixels, and look at the PSFs and at close pairs with '
            'solution.cutouts.')
    return (note,)
