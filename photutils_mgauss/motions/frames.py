"""
Frames tied to one another: the maps, what fixes them, what leaves them open.

A frame is one epoch's map onto the common plane. Given the stars' reduced
equations (see ``joint``) this module finds the maps, says in words which
combinations of them nothing determines.
"""
from dataclasses import dataclass

import numpy as np

NULL = 1e-10  # relative to the information before stars are eliminated


@dataclass(frozen=True, eq=False)
class Frames:
    """
    Corrections of all maps, and how well they are known.

    Parameters
    ----------
    correction : (E, 2, b) `~numpy.ndarray`
        Changes of the maps' coefficients.
    factor : (M, q) `~numpy.ndarray`
        Their covariance is ``factor @ factor.T``, M = 2 E b.
    undetermined : tuple of str
        A sentence for each family of corrections the data cannot tell.
    """

    correction: np.ndarray
    factor: np.ndarray
    undetermined: tuple

    def covariance(self, epoch):
        """Return the covariance (2 b, 2 b) of one map's coefficients."""
        n_epochs, _, b = self.correction.shape
        rows = self.factor.reshape(n_epochs, 2 * b,
                                   self.factor.shape[1])[epoch]
        return rows @ rows.T


POSITIONS = ('Positions are relative: no reference object has a known '
             'position, so they are in the mean frame of the epochs given.')
MOTIONS = ('Motions are relative: no reference object has a known motion, so '
           'the mean motion of the stars is set to zero{field}.')
PARALLAXES = ('Parallaxes are relative: no reference object has a known '
              'parallax, so the mean parallax of the stars is set to zero.')
OTHERS = ('{n} combinations of the maps are undetermined: some epochs share '
          'too few stars with the others; their maps change least.')


@dataclass(frozen=True, eq=False)
class Gauge:
    """
    The corrections of all frames together that stars can absorb.

    Each family is an (M, k) array of corrections: the same one in every
    epoch (positions), one growing with time (motions), and one following
    the parallax factors.
    """

    positions: np.ndarray
    motions: np.ndarray
    parallaxes: np.ndarray

    @classmethod
    def of(cls, problem):
        """Return the gauge of the frames of a `MotionProblem`."""
        transform, dt = problem.transform, problem.dt.mean(axis=1)
        generators = transform.generators
        motions = [np.kron(dt[:, None], generators)]
        if problem.acceleration:
            motions.append(np.kron(dt[:, None]**2 / 2, generators))
        parallaxes = np.empty((len(dt) * len(generators), 0))
        if problem.observer is not None:
            # The parallax factors (2, E) at the centre of the field.
            parallaxes = _parallax_family(
                transform, problem.plane.parallax_factors(
                    np.array(transform.centre)[:, None],
                    problem.observer.mean(axis=2)))
        return cls(np.kron(np.ones((len(dt), 1)), generators),
                   np.hstack(motions), parallaxes)


def _parallax_family(transform, factors):
    """Corrections like parallaxes that vary over the field as the basis."""
    b = transform.n_terms
    family = np.concatenate([np.kron(factors[:, e, None], np.eye(b))
                             for e in range(factors.shape[1])])
    blocks = np.kron(np.eye(factors.shape[1]), transform.generators)
    inside = blocks @ (np.linalg.pinv(blocks) @ family)
    allowed = np.abs(inside - family).max(axis=0) < 1e-9
    return family[:, allowed]


def fixed_frames(problem):
    """Return the `Frames` of a problem whose maps may not change."""
    shape = (problem.n_epochs, 2, problem.transform.n_terms)
    return Frames(np.zeros(shape), np.zeros((np.prod(shape), 0)), ())


def solve_frames(problem, reduced, *, relative=False):
    """
    Return the `Frames` of a problem from its `Reduced` equations.

    What the data do not determine stays as it is. With ``relative=True`` the
    stars themselves are the reference: common motions and parallaxes are
    left alone even where rows of different times seem to determine them.
    """
    transform = problem.transform
    n_epochs, size, _ = reduced.direct.shape
    shape = (n_epochs, 2, size // 2)
    # An epoch of which nothing is used has no map to be found.
    known = np.einsum('ekk->e', reduced.direct) > 0
    free = np.kron(np.eye(n_epochs)[:, known], transform.generators)
    matrix, rhs = free.T @ reduced.matrix @ free, free.T @ reduced.rhs
    information = np.einsum('ij,ij->j', free,
                            _blocks_times(reduced.direct, free))
    scale = 1 / np.sqrt(np.where(information > 0, information, 1))
    gauge = Gauge.of(problem)
    matrix = matrix * np.outer(scale, scale)
    basis, null = _split(matrix, information, _forced(
        gauge, free, scale) if relative else None)
    inner = np.linalg.cholesky(basis.T @ matrix @ basis)
    factor = scale[:, None] * np.linalg.solve(inner, basis.T).T
    correction = free @ (factor @ (factor.T @ rhs))
    return Frames(correction.reshape(shape), free @ factor,
                  _sentences(null, gauge, free, scale, transform))


def _blocks_times(blocks, columns):
    n, size, _ = blocks.shape
    return np.einsum('eij,ejk->eik', blocks,
                     columns.reshape(n, size, -1)).reshape(columns.shape)


def _forced(gauge, free, scale):
    """Return an orthonormal basis of the gauge, in scaled unknowns."""
    families = np.hstack([gauge.positions, gauge.motions, gauge.parallaxes])
    return _orthonormal(_in_scaled(families, free, scale))


def _in_scaled(families, free, scale):
    return np.linalg.lstsq(free, families, rcond=None)[0] / scale[:, None]


def _orthonormal(columns):
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-10 * singular.max(initial=1e-300)]


def _split(matrix, information, forced):
    """Return bases of the determined and the undetermined unknowns."""
    size = len(matrix)
    null = np.eye(size)[:, information <= 0]
    if forced is not None:
        null = _orthonormal(np.hstack([null, forced]))
    basis = _complement(null, size)
    values, vectors = np.linalg.eigh(basis.T @ matrix @ basis)
    weak = values < NULL
    return basis @ vectors[:, ~weak], np.hstack([null,
                                                 basis @ vectors[:, weak]])


def _complement(null, size):
    if null.shape[1] == 0:
        return np.eye(size)
    full = np.linalg.qr(null, mode='complete')[0]
    return full[:, null.shape[1]:]


def _sentences(null, gauge, free, scale, transform):
    """Say which families of corrections the undetermined ones contain."""
    if null.shape[1] == 0:
        return ()
    said, explained = [], 0
    field = ('' if transform.kind == 'shift' else
             ', and so is the part of their motions the maps can take up')
    for family, sentence in ((gauge.positions, POSITIONS),
                             (gauge.motions, MOTIONS.format(field=field)),
                             (gauge.parallaxes, PARALLAXES)):
        if family.shape[1] == 0:
            continue
        unit = _orthonormal(_in_scaled(family, free, scale))
        overlap = np.linalg.svd(null.T @ unit, compute_uv=False)
        count = int(np.sum(overlap > 0.99))
        explained += count
        if count:
            said.append(sentence)
    if null.shape[1] > explained:
        said.append(OTHERS.format(n=null.shape[1] - explained))
    return tuple(said)
