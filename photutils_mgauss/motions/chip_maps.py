r"""
The polynomials of chips, solved for together with frames and stars.

They are unknowns like the maps of the frames, with a design
:math:`A_c = J B`, the change of the plane by the pixels times polynomials in
them. A star touches few chips, so that their equations are sums over groups
of stars on the same ones; eliminating them leaves those of the frames,

.. math::
    S' = S_{ee} - S_{ec} (S_{cc} + \Lambda)^{-1} S_{ce},

with :math:`\Lambda` what is expected of the polynomials. What all chips of a
camera have in common with the map of an exposure is that map's: polynomials
have none of it.
"""
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from photutils_mgauss.motions.joint import eliminate
from photutils_mgauss.motions.problem import CHUNK

MOST_NUMBERS = 20_000_000  # in one array of a group of stars


@dataclass(frozen=True, eq=False)
class ChipEquations:
    """
    The equations of the chips once the stars are eliminated.

    ``matrix`` (M, M) and ``rhs`` (M,) for M coefficients, ``cross`` (N, M)
    with the N of the frames.
    """

    matrix: np.ndarray
    cross: np.ndarray
    rhs: np.ndarray


def chip_equations(problem, distortion, shape):
    """
    Return the `ChipEquations` of stars alone, nothing expected of chips.

    ``shape`` is that of the coefficients (C, 2, b).
    """
    n_chips, _, b = shape
    size, frames = 2 * b, problem.n_epochs * 2 * problem.transform.n_terms
    total = ChipEquations(np.zeros((n_chips * size, n_chips * size)),
                          np.zeros((frames, n_chips * size)),
                          np.zeros(n_chips * size))
    tying = np.flatnonzero(problem.ties)
    # Stars on the same chips stand together, so that groups are slices.
    number = np.where(problem.weights[0] > 0, distortion.number, -1)[:, tying]
    tying = tying[np.lexsort(number)]
    touched = min(n_chips, problem.n_epochs) * size
    step = int(np.clip(MOST_NUMBERS // (2 * problem.n_epochs * touched), 64,
                       CHUNK))
    for start in range(0, len(tying), step):
        _add_stars(total, problem, distortion, tying[start:start + step])
    return total


def prior_weights(distortion):
    """Return what is expected of coefficients as inverse variances (M,)."""
    shape = distortion.none().shape
    return np.broadcast_to(np.asarray(distortion.sigma)**-2.0, shape).ravel()


def reduce_chips(problem, distortion, coefficients):
    """Return the `ChipEquations` of a problem."""
    total = chip_equations(problem, distortion, coefficients.shape)
    known, weight = coefficients.ravel(), prior_weights(distortion)
    firm = np.diag(total.matrix).max(initial=weight.min())
    total.matrix[np.diag_indices(len(known))] += weight
    rhs = total.rhs - weight * known
    if distortion.has_maps:
        common = _common_fields(problem, distortion)
        total.matrix[:] += firm * common @ common.T
        rhs -= firm * common @ (common.T @ known)
    return replace(total, rhs=rhs)


def chip_covariance(chips, factor):
    """
    Return the covariance (M, M) of the coefficients, frames' included.

    ``factor`` is that of the frames' covariance.
    """
    own = np.linalg.inv(chips.matrix)
    through = own @ chips.cross.T @ factor
    return own + through @ through.T


def _common_fields(problem, distortion):
    """
    Return polynomials of all chips that are maps of an exposure, (M, m).

    An orthonormal basis of those of each set of chips seen together.
    """
    n_chips, b = len(distortion.names), len(distortion.basis)
    fields, done = [], []
    for e, number in enumerate(distortion.number):
        seen = np.unique(number[number >= 0])
        if not len(seen) or any(np.isin(seen, one).any() for one in done):
            continue
        done.append(seen)
        field = np.zeros((n_chips, 2, b,
                          problem.transform.generators.shape[1]))
        for k in seen:
            field[k] = _field_of_chip(problem, distortion, e, k)
        fields.append(field.reshape(n_chips * 2 * b, -1))
    left, singular, _ = np.linalg.svd(np.hstack(fields), full_matrices=False)
    return left[:, singular > 1e-8 * singular.max(initial=1e-300)]


def _field_of_chip(problem, distortion, e, k):
    """Return what the map of an exposure is in the pixels of a chip."""
    stars = np.flatnonzero(distortion.number[e] == k)
    basis = problem.transform.basis(problem.origin[:, stars])
    generators = problem.transform.generators.reshape(2, len(basis), -1)
    inverse = np.linalg.inv(np.moveaxis(
        distortion.jacobian[:, :, e, stars], 2, 0))
    moved = np.einsum('ncx,xbj,bn->ncj', inverse, generators, basis)
    own = distortion.basis[:, e, stars].T
    found = np.linalg.lstsq(own, moved.reshape(len(stars), -1), rcond=None)[0]
    return np.moveaxis(found.reshape(-1, *moved.shape[1:]), 0, 1)


def _add_stars(total, problem, distortion, chosen):
    """Add some stars to the equations, group by group."""
    part = problem.select(chosen)
    stars = eliminate(part)
    weights = part.weights * stars.solved
    number = np.where(weights[0] > 0, distortion.number[:, chosen], -1)
    edges = np.flatnonzero((np.diff(number, axis=1) != 0).any(axis=0)) + 1
    for group in np.split(np.arange(len(chosen)), edges):
        chips = number[:, group[0]]
        if (chips >= 0).any():
            _add_group(total, part, stars, weights, distortion,
                       (group, chosen[group], chips))


def _add_group(total, part, stars, weights, distortion, where):
    """Add stars that are on the same chips in all epochs."""
    group, chosen, chips = where
    own, design = _design(distortion, chosen, chips)
    xx, xy, yy = (one[:, group, None] for one in weights)
    weighted = np.stack([xx * design[0] + xy * design[1],
                         xy * design[0] + yy * design[1]])
    coupled = np.einsum('pxen,xenq->pnq', stars.coupling[..., group], design,
                        optimize=True)
    flat = coupled.reshape(-1, coupled.shape[2])
    at = np.ix_(own, own)
    q = len(own)
    total.matrix[at] += (design.reshape(-1, q).T @ weighted.reshape(-1, q)
                         - flat.T @ flat)
    basis = stars.basis[:, group]
    cross = np.einsum('bn,xenq->exbq', basis, weighted, optimize=True)
    cross = cross.reshape(-1, q)
    for k in range(len(coupled)):
        rows = (stars.coupling[k][..., group].swapaxes(0, 1)[:, :, None]
                * basis)
        cross -= rows.reshape(-1, len(group)) @ coupled[k]
    total.cross[:, own] += cross
    total.rhs[own] += (np.einsum('pnq,pn->q', coupled, stars.y[:, group])
                       - np.einsum('xenq,xen->q', weighted,
                                   part.offsets[..., group]))


def _design(distortion, chosen, chips):
    """
    Return the numbers (q,) of a group's unknowns, and A (2, E, m, q).

    ``chosen`` (m,) are its stars, ``chips`` (E,) where they are.
    """
    b = len(distortion.basis)
    different = np.unique(chips[chips >= 0])
    design = np.zeros((2, len(chips), len(chosen), len(different), 2, b))
    for e in np.flatnonzero(chips >= 0):
        k = np.searchsorted(different, chips[e])
        design[:, e, :, k] = np.einsum(
            'xcn,bn->xncb', distortion.jacobian[:, :, e][..., chosen],
            distortion.basis[:, e, chosen])
    own = (different[:, None] * 2 * b + np.arange(2 * b)).ravel()
    return own, design.reshape(*design.shape[:3], -1)


def without_chips(reduced, chips):
    """
    Return the frames' `Reduced` equations with the chips eliminated.

    And what the corrections (E, 2, b) of the frames say of those of the
    chips.
    """
    factor = cho_factor(chips.matrix)
    inner = cho_solve(factor, np.column_stack([chips.cross.T, chips.rhs]))

    def back(correction):
        return cho_solve(factor, chips.rhs - chips.cross.T
                         @ correction.ravel())
    return replace(reduced, matrix=reduced.matrix
                   - chips.cross @ inner[:, :-1],
                   rhs=reduced.rhs - chips.cross @ inner[:, -1]), back
