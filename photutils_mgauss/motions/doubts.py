"""What makes a solution doubtful, in sentences that say what to look at."""
import numpy as np

from photutils_mgauss.motions.stacked import variance_2x2
from photutils_mgauss.sky.space_motion import NO_ERROR

FAR = 7.0     # times the detections' errors: no systematic error is so large
DISTANT = 60e3  # mas: no pointing is off by more
SOME = 8      # detections of an epoch of which a quarter says anything
MANY = 0.25   # part of what was given that may be rejected without a word

CHECK = ('check that they are the right objects, and the epoch, the units '
         'and the errors of their catalogue and of the detections')


def doubts(fit):
    """
    Return what speaks against the references of a `Fit`, a tuple of str.

    References that the detections contradict make a solution that looks
    like any other; only what had to be added to the errors, or to be left
    out, shows it.
    """
    found = (*fit.setup.sightings.doubts, *_motions_without_errors(fit))
    if fit.setup.options.recipe == 'paper':
        return found
    return (*found, *_large_floor(fit), *_lost_references(fit))


def unsolved(fit, stars):
    """Say what is missing where a table has no star with a motion."""
    if not len(stars) or np.isfinite(stars['pmra']).any():
        return
    options = fit.setup.options
    what = ', '.join(['position', 'motion', *['parallax'] * bool(
        options.parallax), *['acceleration'] * options.acceleration])
    enough = -(-fit.problem.n_parameters // 2)
    most = int(fit.state.used.sum(axis=0).max(initial=0))
    yield (f'No star has a motion: {" and ".join(what.rsplit(", ", 1))} take '
           f'good detections at {enough} times or more, far enough apart, '
           f'and no star has more than {most}.'
           + (' Give more epochs, or leave the parallax out.'
              if options.parallax else ''))


def remarks(fit):
    """Return what else is not as it should be, a tuple of str."""
    return (*_positions_without_errors(fit), *_far_away(fit), *_misfit(fit),
            *_lost_detections(fit), *_unfinished(fit),
            *_no_straight_motions(fit))


def _large_floor(fit):
    setup, floor = fit.setup, fit.state.floor
    ratios = [_floor_ratio(fit, e) for e in range(len(floor))]
    worst = int(np.argmax(ratios))
    if ratios[worst] > FAR and setup.options.fits_floor:
        yield (f'The systematic error found for epoch {worst} '
               f'({np.sqrt(floor[worst]):.3g} {setup.sightings.unit}) is '
               f'{ratios[worst]:.0f} times the error of a detection there: '
               f'the {_what(fit)} contradict the detections; {CHECK}.')


def _what(fit):
    return 'stars' if fit.setup.relative else 'reference objects'


def _positions_without_errors(fit):
    on_sky = fit.setup.sightings.plane is not None
    names = ('ra', 'dec') if on_sky else ('x', 'y')
    kinds = fit.setup.sightings.catalogue.kinds
    return _without_errors(fit, 'positions', slice(0, 2), names,
                           np.ones(len(kinds), dtype=bool))


def _motions_without_errors(fit):
    return _without_errors(fit, 'motions', slice(2, 4), ('pmra', 'pmdec'),
                           fit.setup.sightings.catalogue.kinds == 'star')


def _without_errors(fit, what, rows, names, among):
    """Say what of the catalogue is not used for want of its error."""
    catalogue = fit.setup.sightings.catalogue
    known = among & np.isfinite(catalogue.values[rows]).all(axis=0)
    variance = np.einsum('kkn->kn', catalogue.covariance)[rows][:, known]
    lacking = [name for name, some in zip(names, variance, strict=True)
               if some.size and not (some < NO_ERROR).any()]
    if lacking:
        if len(lacking) == 1:
            what = f'values of {lacking[0]!r}'
        yield (f'The {what} of the reference objects are not used, because '
               'the table has no positive errors of them (a column like '
               f"'{lacking[0]}_error').")


def _far_away(fit):
    """Name the epoch that the references move far over the sky."""
    sightings, transform = fit.setup.sightings, fit.setup.transform
    if sightings.plane is None:
        return
    centre = np.array(transform.centre)[:, None]
    moved = [0.0 if tie is not None else np.hypot(
        *(transform.apply(one, centre) - centre)[:, 0])
        for one, tie in zip(fit.state.maps, sightings.ties.maps,
                            strict=True)]
    worst = int(np.argmax(moved))
    if moved[worst] > DISTANT:
        yield (f'Epoch {worst} was moved by {moved[worst] / 1e3:.0f} arcsec: '
               'are its WCS and the references of the same field?')


def _ties(fit):
    """Return the stars (n,) that say where the frames are."""
    ties = fit.setup.anchors & ~fit.state.untied
    ties[fit.state.dropped] = False
    return ties


def _floor_ratio(fit, e):
    """Return the floor of an epoch over the error of a typical detection."""
    variance = variance_2x2(fit.setup.sightings.covariance[
        :, e, fit.state.used[e] & _ties(fit)])
    if not variance.size:
        return 0.0
    return np.sqrt(np.max(fit.state.floor[e]) / np.median(variance))


def _misfit(fit):
    """Compare the chi-square of what ties the frames with the expected."""
    ties = _ties(fit)
    dof = np.sum(fit.dof[ties])
    chi2 = np.nansum(fit.chi2[ties])
    if dof > 0 and chi2 > FAR**2 * dof:
        yield (f'The {_what(fit)} scatter {np.sqrt(chi2 / dof):.0f} times '
               'more than the errors allow, so they contradict the '
               f'detections; {CHECK}.')


def _lost_references(fit):
    setup, state = fit.setup, fit.state
    if setup.relative:
        return
    lost = setup.anchors & state.untied
    lost[state.dropped] = True
    n = int(setup.anchors.sum())
    if lost.sum() > MANY * n:
        yield (f'{lost.sum()} of the {n} reference objects were rejected, '
               f'because the detections contradict them: {CHECK}.')


def _lost_detections(fit):
    usable, used = fit.setup.sightings.usable, fit.state.used
    lost, whole = (usable & ~used).sum(axis=1), usable.sum(axis=1)
    many = np.flatnonzero((lost > MANY * whole) & (whole >= SOME))
    parts = [f'{lost[e]} of the {whole[e]} detections of epoch {e}'
             for e in many]
    if not parts and lost.sum() > MANY * whole.sum():
        parts = [f'{lost.sum()} of all {whole.sum()} detections']
    if parts:
        yield (f'More than a quarter was rejected as outliers: '
               f'{", ".join(parts)}. Check the errors of the detections, '
               'which may be too small or in another unit, and whether rows '
               'of one star are of different ones.')


def _unfinished(fit):
    if fit.state.unfinished:
        yield ('The search for outliers was ended before it came to rest: '
               'there may be more. Check the errors of the detections, or '
               'give clip=None.')


def _no_straight_motions(fit):
    untied = fit.state.untied
    several = fit.setup.sightings.usable.sum(axis=0) > 1
    n, total = int((untied & several).sum()), int(several.sum())
    if n > MANY * total:
        yield (f'The detections of {n} of the {total} stars do not agree '
               'with one straight motion each: check that rows with one '
               'identifier are one star, and the errors of the detections.')
