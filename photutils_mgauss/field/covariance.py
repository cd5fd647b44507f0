r"""
How far a field may be off, and what it does to a PSF at one place.

The inverse of the normal equations is the covariance of the coefficients if
the PSF of every star is the polynomial. Where few stars allow only a low
degree it is not: the shapes of star s deviate by numbers of a covariance
:math:`\tau^2 S`, with S the variances by which shapes vary over the detector,
as the prior has learnt them. Stars left out of the fit show it. With the
equations :math:`A_s, b_s` of star s, at the fit to all of them and its own
numbers eliminated, and M those of the whole field, prior included, the
gradient of star s at the field fitted to the others is

.. math::

    g_s = b_s + A_s V_s b_s, \quad
    V_s = B_s^T (M - A_s \otimes B_s B_s^T)^{-1} B_s ,

and is drawn from a Gaussian of covariance

.. math::

    A_s + A_s \left(V_s + \tau^2 S + \tau^2 U_s\right) A_s ,

where :math:`\tau^2 U_s` is what the deviations of the others do to the field
at star s. The most likely :math:`\tau^2` is taken.

Several exposures may show a star at one place: s is then the place. Its n
detections count as one, so that :math:`A_s` and :math:`b_s` are the means of
their equations, but the noise in them is that of all, :math:`A_s / n`. They
share what is wrong there, as the light of faint neighbours: noise that does
not become less with n and is spread over pixels, :math:`\psi A_s`. With
repeated places the gradient is drawn from a Gaussian of covariance

.. math::

    A_s (1 / n + \psi) + A_s \left(W_s + \tau^2 S + \tau^2 U_s\right) A_s ,

where :math:`W_s` is what such noise of the others does to the field at s. The
most likely :math:`\psi` and :math:`\tau^2` are taken.
"""
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from photutils_mgauss.field.base import covariance_of
from photutils_mgauss.field.normal import Workers, equations, to_vector
from photutils_mgauss.psf.errors import PSFErrors, responses
from photutils_mgauss.psf.grid import Grid

# Stars that are left out in turn, at most.
_MOST_STARS = 150
# With fewer, nothing is known of how the others predict one.
_FEWEST_STARS = 3
# Between what tau^2 is looked for, and by how much it must make the stars
# more likely, in 2 log(likelihood).
_RANGE = (1e-5, 1e3)
_GAIN = 1.0
# Where psi and tau^2 are looked for together from, and how closely.
_FIRST_SHARES = (0.3, 1e-3)
_SHARE_TOLERANCES = {'xatol': 0.1, 'fatol': 0.1}
# How many directions the errors at a place have. Positions and fluxes of
# bright and of faint stars, in small and in large stamps, need no more.
_DIRECTIONS = 6
# The stamps and the backgrounds, as a share of the peak, of those stars.
_HALF_SIZES = (2, 5)
_BACKGROUNDS = (1e-3, 10.0)
# Steps of numerical derivatives.
_STEP = 1e-4


def honest_covariance(fit):
    """
    Return the covariance of the coefficients and what is not modelled.

    Parameters
    ----------
    fit : FieldFit

    Returns
    -------
    covariance : (N, N) `~numpy.ndarray`
        What the stars' deviations from the polynomials add is included, and
        what is wrong with all detections of a place.
    unmodelled : (P,) `~numpy.ndarray`
        The variances of the P shapes about their polynomials.
    """
    covariance = covariance_of(fit)
    scale = variation(fit)
    used = _by_place(fit.problem)
    if len(used) < _FEWEST_STARS:
        return covariance, np.zeros(scale.size)
    some = np.linspace(0, len(used) - 1, min(len(used),
                                             _MOST_STARS)).astype(int)
    noise = _noise_of_detections(fit)
    stars = _left_out(fit, covariance, [used[i] for i in some], noise)
    spread = sum(np.kron((star.matrix * scale) @ star.matrix,
                         np.outer(star.basis, star.basis)) for star in stars)
    spread *= len(used) / some.size
    stars = [star.whitened(scale, spread) for star in stars]
    if noise is None:
        share = _most_likely(stars)
    else:
        common, share = _both_most_likely(stars)
        covariance = covariance @ (
            noise + common * fit.equations.matrix) @ covariance
    added = covariance_of(fit) @ spread @ covariance_of(fit)
    return covariance + share * added, share * scale


def plain_covariance(fit):
    """Return the covariance of the coefficients that noise alone makes."""
    covariance, noise = covariance_of(fit), _noise_of_detections(fit)
    return covariance if noise is None else covariance @ noise @ covariance


def _noise_of_detections(fit):
    """
    Return the covariance (N, N) of the gradient, the prior's included.

    None if all detections count fully: it is the matrix of the equations.
    """
    problem = fit.problem
    shares = problem.shares()
    if (shares[problem.used] == 1).all():
        return None
    # That a detection counts less does not make it noisier.
    twice = replace(problem, weights=problem.weights * shares[:, None, None])
    with Workers() as workers:
        found = equations(twice, fit.coefficients, workers)
    return found.matrix + np.diag(to_vector(fit.prior.precision))


def _by_place(problem):
    """Return the detections that are used, a list for each place."""
    used = np.flatnonzero(problem.used)
    order = used[np.argsort(problem.place[used], kind='stable')]
    edges = np.flatnonzero(np.diff(problem.place[order])) + 1
    return np.split(order, edges) if used.size else []


def variation(fit):
    """Return the variances (P,) by which shapes vary over the field."""
    variance = 1 / to_vector(fit.prior.precision).reshape(
        -1, len(fit.coefficients))
    # Without terms of degree 1 the ratios of the constants must do.
    return variance[:, 1:3].mean(axis=1) if len(
        fit.coefficients) > 1 + fit.problem.n_extra else variance[:, 0]


@dataclass
class _LeftOut:
    """
    A star left out of the fit, with all its detections at one place.

    Attributes
    ----------
    matrix, gradient : (P, P), (P,) `~numpy.ndarray`
        Its own equations at the fit to the others.
    basis : (T,) `~numpy.ndarray`
    to_others : (N, P) `~numpy.ndarray`
        The covariance of the coefficients and the shapes at the star.
    noise : float
        The noise of the gradient, in units of the matrix.
    prediction, common : (P, P) `~numpy.ndarray`
        The covariance of the shapes that the others predict, and what is
        added to it if each has noise that its detections share.
    """

    matrix: np.ndarray
    gradient: np.ndarray
    basis: np.ndarray
    to_others: np.ndarray
    noise: float
    prediction: np.ndarray
    common: np.ndarray

    def whitened(self, scale, spread):
        """
        Return gradient, covariance of it, what psi = 1 and tau^2 = 1 add.

        In units in which the matrix is a unit matrix.
        """
        values, vectors = np.linalg.eigh(self.matrix)
        seen = values > 1e-10 * values.max()
        root = np.sqrt(values[seen])
        vectors = vectors[:, seen]
        own = _at(self.to_others, self.basis) @ self.matrix
        others = (self.to_others.T @ spread @ self.to_others
                  - own * scale @ own.T)
        unmodelled = others + np.diag(scale)
        prediction, common, unmodelled = (
            root[:, None] * (vectors.T @ one @ vectors) * root
            for one in (self.prediction, self.common, unmodelled))
        unit = np.eye(root.size)
        return (vectors.T @ self.gradient / root,
                self.noise * unit + prediction, unit + common, unmodelled)


def _at(coefficients, basis):
    """Return the shapes (P, Q) at a place for coefficients (P T, Q)."""
    return np.einsum('ptq,t->pq', coefficients.reshape(
        -1, basis.size, coefficients.shape[1]), basis)


def _left_out(fit, covariance, stars, noise):
    """
    Return the stars as they look to the fit to all others.

    ``noise`` is the covariance of the gradient where it is not the matrix of
    the equations, else None.
    """
    found = []
    with Workers() as workers:
        for star in stars:
            # The detections of one place differ little in theirs.
            basis = fit.problem.basis[star].mean(axis=0)
            matrix, gradient = (sum(one) / len(star) for one in zip(*(
                _own_equations(fit, one, workers) for one in star),
                strict=True))
            size = len(matrix)
            # M^-1 B, and without this star by Woodbury's identity.
            towards = covariance.reshape(-1, size, basis.size) @ basis
            here = _at(towards, basis)
            without = np.linalg.inv(np.eye(size) - matrix @ here)
            prediction = here @ without
            towards = towards @ without
            gradient = gradient + matrix @ (prediction @ gradient)
            common = np.zeros_like(prediction)
            if noise is not None:
                own = prediction.T @ matrix @ prediction
                common = towards.T @ fit.equations.matrix @ towards - own
                prediction = towards.T @ noise @ towards - own / len(star)
            found.append(_LeftOut(
                matrix, gradient, basis, towards, 1 / len(star),
                (prediction + prediction.T) / 2, (common + common.T) / 2))
    return found


def _own_equations(fit, star, workers):
    """Return the equations of the shapes at one star, from its pixels."""
    problem = fit.problem.subset(np.array([star]))
    shapes = np.tensordot(problem.basis, fit.coefficients, 1)
    problem.basis = np.ones((1, 1))
    found = equations(problem, shapes, workers)
    return found.matrix, found.right


def _most_likely(stars):
    """Return the tau^2 under which the left-out stars are most likely."""
    def cost(share):
        return _cost(stars, 0.0, share)

    best = minimize_scalar(lambda log: cost(np.exp(log)),
                           bounds=np.log(_RANGE), method='bounded',
                           options={'xatol': 0.1})
    return np.exp(best.x) if cost(0.0) - best.fun > _GAIN else 0.0


def _both_most_likely(stars):
    """Return psi and tau^2 under which left-out places are most likely."""
    best = minimize(lambda logs: _cost(stars, *np.exp(logs)),
                    np.log(_FIRST_SHARES), method='Nelder-Mead',
                    bounds=np.log([_RANGE, _RANGE]),
                    options=_SHARE_TOLERANCES)
    common, share = np.exp(best.x)
    needed = _cost(stars, common, 0.0) - best.fun > _GAIN
    return common, share if needed else 0.0


def _cost(stars, common, share):
    """Return -2 log(likelihood) of psi and tau^2, up to a constant."""
    total = 0
    for gradient, expected, by_common, unmodelled in stars:
        values, vectors = np.linalg.eigh(
            expected + common * by_common + share * unmodelled)
        values = np.maximum(values, 1e-3)
        total += np.sum(np.log(values) + (vectors.T @ gradient) ** 2 / values)
    return total


def shape_covariance(covariance, unmodelled, basis):
    """
    Return the covariance of the shapes at places.

    Parameters
    ----------
    covariance : (P T, P T) `~numpy.ndarray`
    unmodelled : (P,) `~numpy.ndarray`
    basis : (n, T) `~numpy.ndarray`

    Returns
    -------
    (n, P, P) `~numpy.ndarray`
    """
    n_terms = basis.shape[1]
    size = len(covariance) // n_terms
    blocks = covariance.reshape(size, n_terms, size, n_terms)
    half = np.einsum('ptqu,nu->nptq', blocks, basis)
    return np.einsum('nptq,nt->npq', half, basis) + np.diag(unmodelled)


def psf_errors(at, covariance, unmodelled, degree, shape, integrated,
               more=(), misfit=0.0):
    """
    Return the errors of a field's PSF.

    Parameters
    ----------
    at : callable
        ``at(x, y, change)`` returns the polynomials (n, T), weights, means
        and covariances at places (n,), with P numbers added to the shapes
        and Q to others.
    covariance, unmodelled : (N, N), (P,) `~numpy.ndarray`
    degree : int
    shape : (int, int)
        Of the detector.
    integrated : bool
        Whether the mixtures are to be integrated over pixels.
    more : (Q,) sequence of float, optional
        The variances of the other numbers, the same everywhere.
    misfit : float, optional
        By what share of it the light in pixels is off.

    Returns
    -------
    PSFErrors
    """
    # The covariance is a polynomial of twice the degree. Each place stands for
    # the cell in the middle of which it is.
    n = max(2 * degree + 1, 7) if degree else 1
    axes = [(np.arange(n) + 0.5) * size / n - 0.5 for size in shape[::-1]]
    x, y = (axis.ravel() for axis in np.meshgrid(*axes))
    n_shapes = unmodelled.size
    size = n_shapes + len(more)
    basis, *mixtures = at(x, y, np.zeros(size))
    every = np.moveaxis(slopes(lambda change: _numbers(at(x, y, change)),
                               size), 0, 1)
    grid = Grid(*axes, *mixtures, np.ones(x.size))
    found = np.tile(np.diag([0.0] * n_shapes + list(more)), (x.size, 1, 1))
    found[:, :n_shapes, :n_shapes] = shape_covariance(covariance, unmodelled,
                                                      basis)
    return PSFErrors(grid, _directions(PSFErrors(grid, every), found,
                                       integrated), misfit)


def slopes(of, size):
    """
    Return the derivatives of something by each of the shapes.

    Parameters
    ----------
    of : callable
        ``of(change)`` returns an array for a change (P,) of the shapes.
    size : int
        P.

    Returns
    -------
    (P, ...) `~numpy.ndarray`
    """
    return np.array([(of(step) - of(-step)) / (2 * _STEP)
                     for step in _STEP * np.eye(size)])


def _numbers(found):
    """Return the numbers (n, K, 6) of mixtures."""
    _, weight, mean, covariance = found
    return np.concatenate([weight[..., None], mean, covariance[..., 0, :],
                           covariance[..., 1, 1:]], axis=-1)


def _directions(every, covariance, integrated):
    """
    Return the few changes that matter to stars, (n, R, K, 6).

    Those that shift positions and fluxes most, each kind of star in units of
    its own standard deviation.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0))[:, None]
    kinds = np.concatenate([
        _shifts(every, half, background, integrated) for half in _HALF_SIZES
        for background in _BACKGROUNDS], axis=1) @ root
    size = np.sqrt((kinds**2).sum(axis=2, keepdims=True))
    _, _, right = np.linalg.svd(
        np.divide(kinds, size, where=size > 0, out=np.zeros_like(kinds)),
        full_matrices=False)
    kept = right[:, :_DIRECTIONS] @ root.transpose(0, 2, 1)
    return np.einsum('nrp,npki->nrki', kept, every.changes)


def _shifts(every, half, background, integrated):
    """Return the shifts (n, 3, P) of stars by each change of the PSF."""
    middle = np.zeros(len(every.changes))
    images = every.images(np.arange(middle.size), middle, middle,
                          (2 * half + 1, 2 * half + 1),
                          integrated=integrated)
    light = np.maximum(images[:, 0], 0)
    weight = 1 / (light + background * light.max(axis=1, keepdims=True))
    return responses(images[:, :3], weight, images[:, 3:])[0]
