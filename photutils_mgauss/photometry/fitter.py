r"""
A fitter with analytic derivatives, for photutils' and astropy's interfaces.

Levenberg-Marquardt on the normal equations: with weighted residuals r and
Jacobian J each step solves

.. math::

    (J^T J + \lambda\, \mathrm{diag}\, J^T J)\, \delta = J^T r .

Photutils fits groups of stars without derivatives; here each star of a group
contributes those of its own PSF.
"""
import numpy as np
from astropy.modeling.fitting import fitter_unit_support
from scipy.linalg import cho_solve, cholesky

from photutils_mgauss import kernels
from photutils_mgauss.psf.base import PSFModel
from photutils_mgauss.utils import compat
from photutils_mgauss.utils.per_thread import PerThread, keep
from photutils_mgauss.utils.validation import as_integer

__all__ = ['MixtureFitter']

MESSAGES = {
    0: 'The fit stopped at its largest number of iterations.',
    2: 'The sum of squares does not get smaller any more.',
    3: 'The next step is expected to be below the tolerance.',
}

_MAX_STEPS = 100

# Of the expected next step, see _State.length.
_TOLERANCE = 1e-6

# Matrices scaled to a diagonal of one whose Cholesky factor has a smaller
# square than this on its diagonal are taken for singular.
_SINGULAR = 1e-14

# Added to norms that may be zero.
_SMALLEST = np.finfo(float).tiny

# The step of numerical derivatives, for models without analytic ones.
_EPSILON = np.sqrt(np.finfo(float).eps)


class MixtureFitter:
    """
    Levenberg-Marquardt with analytic derivatives, for single stars and groups.

    Pass it as ``fitter`` to `photutils.psf.PSFPhotometry` or
    `photutils.psf.IterativePSFPhotometry`, or use it as any astropy fitter of
    two-dimensional models. Bounds and fixed parameters are respected; tied
    parameters are not supported.

    Attributes
    ----------
    fit_info : dict
        Of the last fit: ``param_cov`` (covariance of the free parameters,
        or None), ``fun`` (weighted model minus data), ``status`` (1 to 4
        for success), ``message`` and ``nfev``. If several threads use the
        object, each sees the result of its own last fit.

    Examples
    --------
    >>> import numpy as np
    >>> from photutils_mgauss import (GaussianMixture, MixtureFitter,
    ...                               MultiGaussianPSFModel)
    >>> mixture = GaussianMixture([1], [[0, 0]], [[[1, 0], [0, 1]]])
    >>> y, x = np.mgrid[:11, :11]
    >>> model = MultiGaussianPSFModel(mixture, flux=90, x_0=5, y_0=5)
    >>> data = mixture.render(11, 5.2, 4.9, flux=100)
    >>> fitted = MixtureFitter()(model, x, y, data)
    >>> [round(float(p), 6) for p in fitted.parameters[:3]]
    [100.0, 5.2, 4.9]
    """

    supported_constraints = ('fixed', 'bounds')
    fit_info = PerThread('How the last fit went, a dictionary.')

    def __init__(self):
        self.fit_info = {}

    def __repr__(self):
        return '<MixtureFitter()>'

    def __call__(self, model, x, y, z, weights=None, *, maxiter=100,
                 inplace=False):
        """
        Fit a model to the pixels.

        Parameters
        ----------
        model : `~astropy.modeling.Fittable2DModel`
            The model to start from.
        x, y : array_like
            The positions of the pixels.
        z : array_like
            Their values.
        weights : array_like, optional
            One over their standard deviations. Without, the covariance is
            scaled by the scatter of the residuals.
        maxiter : int or None, optional
            The largest number of steps; None stands for 100.
        inplace : bool, optional
            Whether to change ``model`` itself.

        Returns
        -------
        `~astropy.modeling.Fittable2DModel`
            The model with the fitted parameters.

        Raises
        ------
        ValueError
            If nothing is free, a parameter is tied, ``maxiter`` is below 1,
            or the arrays differ in size or hold values that are masked or
            not finite.
        """
        return self._fit_with_units(model, x, y, z=z, weights=weights,
                                    maxiter=as_max_steps(maxiter, 'maxiter'),
                                    inplace=inplace)

    @fitter_unit_support
    def _fit_with_units(self, model, x, y, z, *, weights, maxiter, inplace):
        problem = _PixelProblem(model, x, y, z, weights)
        state, status, n_steps = _minimize(problem, maxiter)
        keep(self, fit_info={
            'param_cov': problem.covariance(state), 'fun': state.residuals,
            'status': status, 'message': MESSAGES[status], 'nfev': n_steps})
        fitted = model if inplace else model.copy()
        fitted.parameters = problem.full(state.values)
        return fitted


def as_max_steps(value, name):
    """Return the largest number of steps, given it or None."""
    if value is None:
        return _MAX_STEPS
    return as_integer(value, name, minimum=1)


class _State:
    """
    Parameter values and what a step from them needs.

    norms (n,) are those of the weighted image of each parameter's own star,
    sigma is the scatter that weighted residuals are expected to have.
    """

    def __init__(self, values, residuals, jacobian, norms, sigma):
        self.values = values
        self.residuals = residuals
        self.chi2 = residuals @ residuals
        self.matrix = jacobian @ jacobian.T
        self.gradient = -(jacobian @ residuals)
        self.norms = norms
        self.sigma = sigma

    @property
    def scale(self):
        """The square roots of the matrix's diagonal, 1 where it is zero."""
        scale = np.sqrt(np.diag(self.matrix))
        return np.where(scale > 0, scale, 1)

    def length(self, step):
        """
        Return the largest step, in a measure without units.

        It is the change that a step makes to the image of its star, over the
        image itself or, for faint stars, over a tenth of the noise.
        """
        change = np.abs(step) * self.scale
        return np.max(change / (self.norms + 0.1 * self.sigma + _SMALLEST),
                      initial=0)


class _PixelProblem:
    """Weighted residuals and Jacobian as functions of the free parameters."""

    def __init__(self, model, x, y, z, weights):
        self.base, self.n_sources = compat.group_members(model)
        self.x, self.y, self.z = (
            _as_plain(a, name).astype(float)
            for a, name in ((x, 'x'), (y, 'y'), (z, 'z')))
        self.weights = None if weights is None else _as_plain(weights,
                                                              'weights')
        self.start = np.array(model.parameters, dtype=float)
        names = model.param_names
        # Each access to these properties visits all parameters of a group.
        fixed, limits = model.fixed, model.bounds
        self.free = np.array([not fixed[name] for name in names])
        bounds = [limits[name] for name in names]
        self.lower = np.array([-np.inf if low is None else low
                               for low, _ in bounds])[self.free]
        self.upper = np.array([np.inf if high is None else high
                               for _, high in bounds])[self.free]
        self._check(model)

    def _check(self, model):
        tied = [name for name, tie in model.tied.items() if tie]
        if tied:
            msg = f'model must not have tied parameters, got {tied}'
            raise ValueError(msg)
        if not self.free.any():
            msg = 'model must have a free parameter, got none'
            raise ValueError(msg)
        sizes = {a.size for a in (self.x, self.y, self.z, self.weights)
                 if a is not None}
        if len(sizes) > 1:
            msg = f'x, y, z and weights must have one size, got {sizes}'
            raise ValueError(msg)
        if not np.isfinite(self.z).all() or (
                self.weights is not None
                and not np.isfinite(self.weights).all()):
            msg = 'z and weights must be finite'
            raise ValueError(msg)

    def full(self, values):
        """Return all parameters, given the free ones."""
        parameters = self.start.copy()
        parameters[self.free] = values
        return parameters

    def evaluate(self, values):
        """Return the state at the values of the free parameters."""
        parameters = self.full(values).reshape(self.n_sources, -1)
        free = self.free.reshape(self.n_sources, -1)
        total = np.zeros(self.z.size)
        rows, norms = [], []
        for own, is_free in zip(parameters, free, strict=True):
            value, derivatives = _derivatives(self.base, self.x, self.y, own,
                                              is_free)
            total += value
            rows += derivatives
            if self.weights is not None:
                value = value * self.weights
            norms += [np.linalg.norm(value)] * len(derivatives)
        residuals, jacobian = total - self.z, np.array(rows)
        if self.weights is not None:
            residuals *= self.weights
            jacobian *= self.weights
        return _State(values, residuals, jacobian, np.array(norms),
                      self._expected_scatter(residuals))

    def _expected_scatter(self, residuals):
        if self.weights is not None:
            return 1.0
        dof = max(self.z.size - np.count_nonzero(self.free), 1)
        return np.linalg.norm(residuals) / np.sqrt(dof)

    def covariance(self, state):
        """Return the covariance of the free parameters, or None."""
        dof = self.z.size - state.values.size
        if dof <= 0 or not np.isfinite(state.matrix).all():
            return None
        covariance = _inverse(state.matrix, state.scale)
        return covariance * (1 if self.weights is not None
                             else state.chi2 / dof)


def _as_plain(values, name):
    """Return values flat; a mask that hides any is refused."""
    if np.ma.is_masked(values):
        msg = (f'{name} must not have masked values, got '
               f'{np.ma.count_masked(values)}')
        raise ValueError(msg)
    return np.ravel(np.ma.getdata(values))


def _inverse(matrix, scale):
    """Return the inverse, or the pseudo-inverse of a singular matrix."""
    outer = np.outer(scale, scale)
    factor = _factor(matrix / outer)
    if factor is None:
        inverse = np.linalg.pinv(matrix / outer, rcond=_SINGULAR,
                                 hermitian=True)
    else:
        inverse = cho_solve((factor, True), np.eye(scale.size),
                            check_finite=False)
    return inverse / outer


def _factor(matrix):
    """Return the lower Cholesky factor, or None of a singular matrix."""
    try:
        factor = cholesky(matrix, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return None
    if not (np.diag(factor) ** 2 > _SINGULAR).all():
        return None
    return factor


def _derivatives(model, x, y, parameters, free):
    """Return a model's values and its derivatives by what is free."""
    if isinstance(model, PSFModel):
        columns = model.fit_deriv(x, y, *parameters)
        value = parameters[0] * columns[0] if not model.flux.fixed else (
            model.evaluate(x, y, *parameters))
    else:
        value = model.evaluate(x, y, *parameters)
        columns = (_numerical(model, x, y, parameters, value, free)
                   if model.fit_deriv is None
                   else model.fit_deriv(x, y, *parameters))
    return value, [np.ravel(column) for column, is_free
                   in zip(columns, free, strict=True) if is_free]


def _numerical(model, x, y, parameters, value, free):
    columns = []
    for i, is_free in enumerate(free):
        moved = parameters.copy()
        step = _EPSILON * max(abs(parameters[i]), 1)
        moved[i] += step
        columns.append((model.evaluate(x, y, *moved) - value) / step
                       if is_free else value)
    return columns


def _minimize(problem, max_steps):
    """Return the best state, the status and the number of evaluations."""
    values = np.clip(problem.start[problem.free], problem.lower,
                     problem.upper)
    state = problem.evaluate(values)
    damping, last, steepest = 0.0, 0.0, np.zeros(values.size)
    fall = np.inf
    for n in range(max_steps):
        steepest = np.maximum(steepest, np.diag(state.matrix))
        step = _bounded_step(problem, state, damping * steepest)
        if step is None:
            damping = max(10 * damping, 1e-6)
            continue
        new = problem.evaluate(state.values + step)
        if not new.chi2 <= state.chi2 * (1 + 1e-12):
            if state.length(step) < 1e-3 * _TOLERANCE or damping > 1e12:
                return state, 2, n + 2
            damping, last = max(10 * damping, 1e-3), 0.0
            continue
        length = state.length(_undamped(problem, state, step, damping))
        gain, fall = _gain(state, new, step), state.chi2 - new.chi2
        state = new
        if kernels.remainder(length, last) < _TOLERANCE:
            return state, 3, n + 2
        last, damping = length, kernels.next_damping(
            damping, gain)
    status = 2 if fall < kernels.LEAST_FALL * state.chi2 else 0
    return state, status, max_steps + 1


def _gain(state, new, step):
    """Return what a step brought over what the normal equations promised."""
    expected = step @ (2 * state.gradient - state.matrix @ step)
    if expected > 1e-9 * state.chi2:
        return (state.chi2 - new.chi2) / expected
    # Of a smaller fall nothing is left after rounding: keep the damping.
    return kernels.POOR_GAIN


def _undamped(problem, state, step, damping):
    """Lengthen a damped step to what each parameter alone would go."""
    if damping == 0:
        return step
    alone = np.abs(state.gradient) / state.scale**2
    return np.where(_presses(problem, state), step,
                    np.maximum(np.abs(step), alone))


def _presses(problem, state):
    """Return which parameters a bound keeps from moving."""
    return ((state.values <= problem.lower) & (state.gradient < 0)
            | (state.values >= problem.upper) & (state.gradient > 0))


def _bounded_step(problem, state, damping):
    """
    Return a step that stays within bounds, or None if it is singular.

    damping (n,) is added to the diagonal of the matrix. It is in units of
    the largest diagonal so far: as a star gets faint its position must not
    become free to run away.
    """
    moves = ~_presses(problem, state) & (np.diag(state.matrix) > 0)
    step = np.zeros(state.values.size)
    if moves.any():
        scale = state.scale[moves]
        matrix = state.matrix[np.ix_(moves, moves)] / np.outer(scale, scale)
        matrix[np.diag_indices_from(matrix)] += (damping[moves] / scale**2)
        factor = _factor(matrix)
        if factor is None:
            return None
        step[moves] = cho_solve((factor, True), state.gradient[moves] / scale,
                                check_finite=False) / scale
    end = np.clip(state.values + step, problem.lower, problem.upper)
    return end - state.values
