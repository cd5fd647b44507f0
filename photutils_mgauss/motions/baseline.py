"""
The time between what was measured: epochs, and the places of references.

A catalogue whose places have errors and an epoch of their own is as good as
another exposure: one epoch and such a catalogue make motions.
"""
import numpy as np

from photutils_mgauss.sky.space_motion import NO_ERROR

PERIOD = 4 / 365.25  # years between detections that count as two
COMMON = 0.5   # part of an epoch's stars in another one, if all is well


def placed(catalogue):
    """
    Return which objects (k,) of a catalogue have places that count.

    Those are places with errors, at a known time.
    """
    variance = np.einsum('kkn->kn', catalogue.covariance)[:2]
    return (np.isfinite(catalogue.values[:2]).all(axis=0)
            & (variance < NO_ERROR).all(axis=0)
            & np.isfinite(catalogue.year))


def period(baseline):
    """
    Return the years between detections that count as two.

    That is 4 days (as Gaia counts them), or 1 per cent of the whole baseline
    where that is shorter.
    """
    return min(PERIOD, baseline / 100)


def whole_baseline(years, catalogue):
    """
    Return the years (a float) from the first to the last of what is known.

    Parameters
    ----------
    years : (...) array_like
        Of the detections; NaN where there are none.
    catalogue : `~photutils_mgauss.motions.references.Catalogue` or None
        The reference objects that were seen.
    """
    if catalogue is not None:
        years = np.append(years, catalogue.year[placed(catalogue)])
    return float(np.nanmax(years) - np.nanmin(years))


def check_baseline(years, catalogue):
    """
    Raise unless epochs, or a catalogue with them, span some time.

    ``years`` are the mean years of the epochs, ``catalogue`` is None where
    there is none with places.
    """
    if max(years) - min(years) > 0:
        return
    if catalogue is not None and whole_baseline(years, catalogue) > 0:
        return
    remedy = ('; without one, references are needed that have positions with '
              'errors (ra_error, dec_error), of another time (ref_epoch)')
    if len(years) < 2:
        msg = f'epochs must be at least 2, got {len(years)}'
    else:
        msg = (f'epochs must have a time baseline, got all '
               f'{len(years)} at {years[0]:.6f}')
    raise ValueError(msg + remedy)


def check_rows(detections, catalogue):
    """
    Return what is wrong with epochs none of whose rows can be used.

    Parameters
    ----------
    detections : list of `~photutils_mgauss.motions.detections.Detections`
        What the epochs say.
    catalogue : `~photutils_mgauss.motions.references.Catalogue` or None
        The reference objects.

    Returns
    -------
    tuple of str
        A sentence for each such epoch.

    Raises
    ------
    ValueError
        If too few other epochs are left for motions.
    """
    said = []
    for e, one in enumerate(detections):
        if one.usable.any() or not one.usable.size:
            continue
        what = ('errors is positive and finite' if one.found.any() else
                'positions is finite (dec within 90 degrees)')
        said.append(f'epoch {e}: none of the {one.usable.size} {what}')
    needed = 2 if catalogue is None or not placed(catalogue).any() else 1
    if said and sum(one.usable.any() for one in detections) < needed:
        msg = f'epochs must have rows that can be used; {"; ".join(said)}'
        raise ValueError(msg)
    return tuple(f'E{one[1:]}.' for one in said)


def check_common(found, stars, catalogue):
    """
    Raise unless some star was found twice.

    Parameters
    ----------
    found : (E, n) bool `~numpy.ndarray`
        Where stars were detected.
    stars : (k,) int `~numpy.ndarray`
        The stars that are the objects of the ``catalogue``.
    """
    count = found.sum(axis=0)
    count[stars[placed(catalogue)]] += 1
    if (count > 1).any():
        return
    if len(found) == 1:
        msg = ('the epoch must have stars in common with the references, '
               'got none: do they have the identifiers of the epoch, or '
               'places in this field?')
    else:
        msg = ('epochs must have stars in common, got none that is in two '
               'of them')
    raise ValueError(msg)


def few_in_common(seen, stars, catalogue):
    """
    Return a sentence for each epoch most of whose stars are alone.

    The arguments are those of `check_common`.
    """
    count = seen.sum(axis=0)
    count[stars[placed(catalogue)]] += 1
    if len(seen) == 1:  # It may well be deeper than the catalogue.
        return ()
    shared = (seen & (count > 1)).sum(axis=1)
    return tuple(
        f'Only {some} of the {total} stars of epoch {e} were found in another '
        'epoch: if there should be more, its pointing may be off by more '
        'than matching looks for (see match_by and match_radius), or stars '
        'may move faster than max_motion.'
        for e, (some, total) in enumerate(zip(shared, seen.sum(axis=1),
                                              strict=True))
        if some < COMMON * total)


def few_references(places, known, catalogue):
    """
    Return a sentence if a single epoch has few of a catalogue's objects.

    Parameters
    ----------
    places : (2, n) `~numpy.ndarray`
        Where the stars of the epoch are.
    known : (m,) int `~numpy.ndarray`
        The star of each of the objects of the ``catalogue``, -1 where it was
        not found.
    """
    low, high = np.nanmin(places, axis=1), np.nanmax(places, axis=1)
    with np.errstate(invalid='ignore'):
        inside = ((catalogue.values[:2] > low[:, None])
                  & (catalogue.values[:2] < high[:, None])).all(axis=0)
    found = (known >= 0) & inside
    if found.sum() >= COMMON * inside.sum():
        return ()
    words = (f'Only {found.sum()} of the {inside.sum()} reference objects '
             'in the field were found among the stars of the epoch: if there '
             'should be more, its pointing may be off by more than matching '
             'looks for (see match_by and match_radius), or objects without '
             'a known motion may move faster than max_motion.')
    return (words,)
