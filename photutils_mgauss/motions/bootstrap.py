"""
Bootstrap errors: of medians of a sample, and of the frames.

A resampling draws each object a Poisson number of times with mean one, which
for more than a few objects is the same as drawing with replacement and needs
no index arrays: ten thousand resamplings are one matrix product.
"""
from dataclasses import dataclass

import numpy as np

from photutils_mgauss.motions.joint import eliminate, scaled_rows
from photutils_mgauss.motions.problem import parts
from photutils_mgauss.utils.validation import as_floats, as_integer, as_rng

BATCH = 500  # resamplings worked on at a time
SAMPLE = 2000  # stars whose mean response to the frames is taken


def bootstrap_median(values, *, n_resamples=10000, rng=None):
    """
    Return medians of resampled values.

    Parameters
    ----------
    values : (n,) array_like
        The sample; NaN are left out.
    n_resamples : int, optional
        Number of resamplings; the paper has 10,000.
    rng : `~numpy.random.Generator` or int, optional
        Source of the random draws.

    Returns
    -------
    (n_resamples,) `~numpy.ndarray`
        The medians; their standard deviation is the error of the median.

    Raises
    ------
    ValueError
        If there are fewer than two finite values.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import bootstrap_median
    >>> values = np.random.default_rng(1).normal(size=400)
    >>> draws = bootstrap_median(values, rng=2)
    >>> print(f'{draws.std():.3f}')  # on average sqrt(pi / 800) = 0.063
    0.049
    """
    n_resamples = as_integer(n_resamples, 'n_resamples', minimum=1)
    values = as_floats(values, 'values', shape=(None,), finite=False)
    values = np.sort(values[np.isfinite(values)])
    if len(values) < 2:
        msg = f'values must hold at least 2 finite ones, got {len(values)}'
        raise ValueError(msg)
    rng = as_rng(rng)
    draws = [_medians(values, rng, min(BATCH, n_resamples - start))
             for start in range(0, n_resamples, BATCH)]
    return np.concatenate(draws)


def _medians(values, rng, n):
    """Return the medians of n Poisson resamplings of sorted values."""
    above = np.cumsum(_weights(rng, n, len(values)), axis=1)
    # The middle of an odd number, the mean of the two middle ones of an even.
    total = above[:, -1:]
    low = np.sum(above < (total + 1) // 2, axis=1)
    high = np.sum(above < total // 2 + 1, axis=1)
    return (values[low] + values[high]) / 2


def _weights(rng, n, size):
    """Return Poisson weights (n, size), none of which are all zero."""
    weights = rng.poisson(1.0, (n, size))
    empty = ~weights.any(axis=1)
    weights[empty, rng.integers(size, size=empty.sum())] = 1
    return weights


@dataclass(frozen=True, eq=False)
class FrameDraws:
    """
    Frames from resampled reference objects.

    Parameters
    ----------
    shift : (B, E, 2) `~numpy.ndarray`
        What the resampling adds to each map at the centre of the field
        [mas].
    motion : (B, 2) `~numpy.ndarray`
        What it adds to the motions (pmra, pmdec) of all stars in the mean
        over the field [mas / yr]: the systematic error all have in common.
    """

    shift: np.ndarray
    motion: np.ndarray


def bootstrap_frames(fit, n_resamples, rng):
    """Return the `FrameDraws` of a `Fit`."""
    rng = as_rng(rng)
    stars = np.flatnonzero(_tying(fit))
    problem = fit.problem.select(stars)
    basis = _determined(fit)
    matrices, rhs = _contributions(problem, basis)
    setup = fit.setup
    centre = np.reshape(setup.transform.centre, (2, 1))
    at_centre = setup.transform.basis(centre)[:, 0]
    mean_motion = _mean_motion(fit, basis)
    shifts, motions = [], []
    for start in range(0, n_resamples, BATCH):
        n = min(BATCH, n_resamples - start)
        change = _resolve(matrices, rhs, _weights(rng, n, len(stars)))
        full = (change @ basis.T).reshape(n, len(setup.dt), 2, -1)
        shifts.append(full @ at_centre)
        motions.append(change @ mean_motion.T)
    return FrameDraws(np.concatenate(shifts), np.concatenate(motions))


def _tying(fit):
    """Return the references if there are any, else all that tie frames."""
    ties = fit.problem.ties & fit.setup.anchors
    ties[fit.state.dropped] = False
    return ties


def _determined(fit):
    """Return an orthonormal basis (M, q) of what determines the maps."""
    left, singular, _ = np.linalg.svd(fit.frames.factor,
                                      full_matrices=False)
    return left[:, singular > 1e-9 * singular.max(initial=1e-300)]


def _contributions(problem, basis):
    """Return each star's share of S (n, q, q) and of the residual rhs."""
    matrices, rhs = [], []
    for part in parts(problem):
        stars = eliminate(part)
        weights = part.weights * stars.solved
        total = _direct_of_each(weights, stars.basis, basis)
        vector = -_rhs_of_each(weights, part.offsets, stars.basis, basis)
        for k in range(part.n_parameters):
            rows = stars.rows(k).T @ basis
            total -= rows[:, :, None] * rows[:, None, :]
            vector += rows * stars.y[k][:, None]
        matrices.append(total)
        rhs.append(vector)
    return np.concatenate(matrices), np.concatenate(rhs)


def _blocks(basis, n_epochs, functions):
    """Return the design A of each star and epoch, (E, 2, n, q)."""
    shaped = basis.reshape(n_epochs, 2, len(functions), -1)
    return np.einsum('ecbq,bn->ecnq', shaped, functions)


def _direct_of_each(weights, functions, basis):
    x, y = np.moveaxis(_blocks(basis, weights.shape[1], functions), 1, 0)
    xx, xy, yy = weights
    half_x = xx[..., None] * x + xy[..., None] * y
    half_y = xy[..., None] * x + yy[..., None] * y
    return (np.einsum('enq,enr->nqr', x, half_x)
            + np.einsum('enq,enr->nqr', y, half_y))


def _rhs_of_each(weights, offsets, functions, basis):
    x, y = np.moveaxis(_blocks(basis, weights.shape[1], functions), 1, 0)
    (xx, xy, yy), (dx, dy) = weights, offsets
    return (np.einsum('en,enq->nq', xx * dx + xy * dy, x)
            + np.einsum('en,enq->nq', xy * dx + yy * dy, y))


def _resolve(matrices, rhs, weights):
    """Return the solutions (B, q) minus the one of the whole sample."""
    n, q = rhs.shape
    sums = (weights @ matrices.reshape(n, -1)).reshape(-1, q, q)
    whole = matrices.sum(axis=0)
    # A resampling may lack what determines some map: those stay as they are.
    tiny = 1e-9 * np.trace(whole) / q
    sums = sums + tiny * np.eye(q)
    found = np.linalg.solve(sums, (weights @ rhs)[..., None])[..., 0]
    return found - np.linalg.solve(whole + tiny * np.eye(q), rhs.sum(axis=0))


def _mean_motion(fit, basis):
    """Return what the maps (q,) add to the mean motion, (2, q)."""
    others = np.flatnonzero(~fit.setup.anchors)
    stars = others if len(others) else np.arange(fit.n_stars)
    stars = stars[:: max(1, len(stars) // SAMPLE)]
    some = eliminate(fit.problem.select(stars))
    moved = np.einsum('kin,knq->inq', some.factor, scaled_rows(some, basis))
    return moved[2:4, some.solved].mean(axis=1)
