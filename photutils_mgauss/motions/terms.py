r"""
Displacements that depend on what a star is, not only on where it is.

In each epoch the detections may be displaced by functions of magnitude,
colour, and of magnitude times row, as imperfect charge transfer does it.
They are unknowns like the distortions of chips, with an epoch in place of a
chip, and solved for with frames and stars at once. Which of the kinds asked
for are real is found by cross-validation: the equations of four fifths of the
stars predict those of the fifth, without solving anything anew.
"""
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np
from astropy.table import QTable

from photutils_mgauss.motions.chip_maps import (
    ChipEquations,
    chip_equations,
    prior_weights,
)
from photutils_mgauss.motions.columns import COLUMNS
from photutils_mgauss.motions.distortion import Distortion
from photutils_mgauss.motions.joint import Reduced, reduce_all

# Functions of each kind of term: powers of magnitude, of colour, of row.
FUNCTIONS = {'magnitude': ((1, 0, 0), (2, 0, 0)),
             'colour': ((0, 1, 0), (0, 2, 0)),
             'y': ((1, 0, 1), (2, 0, 1))}
WIDE = 100.0  # errors of a detection: more is not expected of any term
FOLDS = 5
SURE = 2.0  # standard errors by which a term must improve predictions


@dataclass(frozen=True, eq=False)
class Terms(Distortion):
    """
    Terms as distortions of as many chips as there are epochs.

    ``kinds`` (b,) says what each function belongs to, ``middle`` and
    ``half`` (2,) how magnitudes and colours are scaled, ``rows`` (E,) how
    many there are.
    """

    kinds: tuple
    middle: np.ndarray
    half: np.ndarray
    rows: np.ndarray

    has_maps = False

    def only(self, kinds):
        """Return the terms of some kinds."""
        keep = np.isin(self.kinds, kinds)
        return replace(self, basis=self.basis[keep], sigma=self.sigma[:, keep],
                       kinds=tuple(np.array(self.kinds)[keep]))


def terms_of(sightings, options, magnitudes):
    """Return the `Terms` of all kinds asked for, None if there are none."""
    kinds = options.terms
    if not kinds:
        return None
    _check(sightings, options)
    values = np.stack([magnitudes, np.zeros_like(magnitudes),
                       np.zeros_like(magnitudes)])
    if 'colour' in kinds:
        values[1] = _mean_colours(sightings.colour)
    jacobian, row, pixel = _pixels(sightings, 'y' in kinds)
    values[2] = row
    number = np.where(np.isfinite(values).all(axis=0) & sightings.usable,
                      np.arange(len(row))[:, None], -1)
    seen = number >= 0
    middle, half = np.zeros(2), np.ones(2)
    for k in range(2):
        low, high = np.quantile(values[k][seen], [0.01, 0.99])
        middle[k], half[k] = (low + high) / 2, max((high - low) / 2, 1e-9)
        values[k] = np.clip((values[k] - middle[k]) / half[k], -1.5, 1.5)
    rows = np.array([one.max(initial=1.0, where=where) for one, where in zip(
        row, seen, strict=True)])
    values[2] /= rows[:, None]
    powers = [power for kind in kinds for power in FUNCTIONS[kind]]
    basis = np.where(seen, np.stack([np.prod(
        [one**p for one, p in zip(values, power, strict=True)], axis=0)
        for power in powers]), 0.0)
    names = tuple(kind for kind in kinds for _ in FUNCTIONS[kind])
    error = np.sqrt(sightings.typical_variance)
    sigma = np.full((2, len(names)), WIDE * error / pixel)
    sigma[0, np.array(names) == 'y'] = 1e-6 * error / pixel
    return Terms(list(range(len(row))), number, basis,
                 np.where(seen, jacobian, 0.0), [], sigma, names, middle,
                 half, rows)


def _check(sightings, options):
    """Raise where something else may find what terms find."""
    if sightings.chips and options.distortion.kind != 'none':
        msg = ('distortion must be None for terms of epochs of chips, got '
               f'{options.distortion.kind!r}: one fit finds either of them')
        raise ValueError(msg)
    if options.transform.kind == 'none' or options.recipe == 'paper':
        msg = ('terms need maps between the epochs: give a transform, and '
               "the recipe 'joint' or 'two-step'")
        raise ValueError(msg)


def _mean_colours(each):
    """Return the mean colour of each star in every epoch, (E, n)."""
    known = np.isfinite(each)
    if not known.any():
        msg = (f"epochs must have a column {' or '.join(COLUMNS['colour'])} "
               "for terms='colour', got none")
        raise ValueError(msg)
    mean = np.where(known, each, 0.0).sum(axis=0) / np.maximum(
        known.sum(axis=0), 1)
    return np.broadcast_to(np.where(known.any(axis=0), mean, np.nan),
                           each.shape)


def _pixels(sightings, needed):
    """Return d(plane)/d(pixel), the rows (E, n), and a pixel's size."""
    on_sky = [e for e, epoch in enumerate(sightings.epochs)
              if not epoch.is_pixels]
    if on_sky and needed:
        msg = (f"epoch {on_sky[0]} must have pixels for terms='y', got "
               'positions in the sky')
        raise ValueError(msg)
    shape = sightings.usable.shape
    jacobian, row = np.zeros((2, 2, *shape)), np.zeros(shape)
    if sightings.pixels is not None:
        jacobian = np.nan_to_num(sightings.jacobian)
        row = sightings.pixels[1].copy()
    # There a pixel is what positions are in.
    jacobian[:, :, on_sky] = np.eye(2)[..., None, None]
    row[on_sky] = 0.0
    size = np.abs(np.linalg.det(np.moveaxis(
        jacobian[..., sightings.usable], 2, 0)))
    return jacobian, row, np.sqrt(np.median(size))


def chosen_terms(problem, terms, executor):
    """
    Return which kinds of `Terms` predict stars they were not fitted to.

    The best kind is added first, then the best of the others, as long as
    the chi-square of the stars left out falls by more than ``SURE`` times
    the standard error of that.
    """
    folds = [_equations(problem, terms, k, executor) for k in range(FOLDS)]
    chosen, left = [], list(dict.fromkeys(terms.kinds))
    before = _predictions(folds, terms, chosen)
    while left:
        tried = {kind: _predictions(folds, terms, [*chosen, kind])
                 for kind in left}
        best = min(left, key=lambda kind: tried[kind].sum())
        gain = before - tried[best]
        if not gain.sum() > SURE * np.sqrt(FOLDS) * gain.std(ddof=1):
            break
        chosen.append(best)
        left.remove(best)
        before = tried[best]
    return chosen


def _equations(problem, terms, k, executor):
    """Return the equations of frames and terms of a fifth of the stars."""
    numbers = np.flatnonzero(problem.ties)
    ties = np.zeros_like(problem.ties)
    ties[numbers[k::FOLDS]] = True
    part = replace(problem, ties=ties)
    return (reduce_all(part, executor),
            chip_equations(part, terms, terms.none().shape))


def _predictions(folds, terms, kinds):
    """Return the chi-squares of each fold, from the fit to the others."""
    keep = np.flatnonzero(np.broadcast_to(
        np.isin(terms.kinds, kinds), terms.none().shape).ravel())
    weight = prior_weights(terms)[keep]
    whole = [_joined(*one, keep) for one in folds]
    out = []
    for k, (matrix, rhs) in enumerate(whole):
        others = [one for j, one in enumerate(whole) if j != k]
        normal = sum(one for one, _ in others)
        n = len(normal) - len(keep)
        normal[np.arange(n, len(normal)), np.arange(n, len(normal))] += weight
        found = _solved(normal, sum(one for _, one in others))
        out.append(found @ matrix @ found - 2 * found @ rhs)
    return np.array(out)


def _joined(reduced: Reduced, chips: ChipEquations, keep):
    cross = chips.cross[:, keep]
    return (np.block([[reduced.matrix, cross],
                      [cross.T, chips.matrix[np.ix_(keep, keep)]]]),
            np.concatenate([reduced.rhs, chips.rhs[keep]]))


def _solved(matrix, rhs):
    """Return the solution of equations, 0 where they say nothing."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix * np.outer(scale, scale))
    inverse = np.where(values > 1e-9, 1 / np.where(values > 0, values, 1), 0)
    return scale * (vectors @ (inverse * (vectors.T @ (scale * rhs))))


def terms_table(terms, coefficients, covariance, times):
    """Return the `~astropy.table.QTable` of the terms of all epochs."""
    sigma = np.sqrt(np.diag(covariance)).reshape(coefficients.shape)
    n_epochs, _, b = coefficients.shape
    seen = dict.fromkeys(terms.kinds, 0)
    functions = []
    for kind in terms.kinds:
        functions.append(FUNCTIONS[kind][seen[kind]])
        seen[kind] += 1
    table = QTable({
        'epoch': np.repeat(np.arange(n_epochs), b),
        'time': np.repeat(times, b) * u.yr,
        'term': np.tile(np.array(terms.kinds, dtype='U9'), n_epochs),
        'powers': np.tile(functions, (n_epochs, 1))})
    for k, name in enumerate('xy'):
        table[f'd{name}'] = coefficients[:, k].ravel() * u.pix
        table[f'd{name}_error'] = sigma[:, k].ravel() * u.pix
    table.meta.update(magnitude_middle=terms.middle[0],
                      magnitude_half_range=terms.half[0],
                      colour_middle=terms.middle[1],
                      colour_half_range=terms.half[1],
                      rows=[float(one) for one in terms.rows])
    return table
