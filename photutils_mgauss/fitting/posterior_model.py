r"""
A Gaussian mixture as a model of PyMC (Nie et al., Eqs. 1-4).

The model is sampled in coordinates in which the least-squares solution is the
origin and its covariance the unit matrix: the posterior is the same, and a
step of the sampler is as long in every direction.
"""
from typing import NamedTuple

import numpy as np

from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.quiet import without_warnings
from photutils_mgauss.utils.waiting import has_screen, progress

# The paper's priors, in arcsec: Eq. 4.
_PAPER_ALPHA, _PAPER_BETA, _PAPER_GAMMA, _PAPER_SIGMA = 0.037, 1.0, 0.9, 1.0

# An image that differs from its solution by less of its peak has no noise.
_ROUNDING = 1e-12

# In vectors the numbers of each Gaussian are log flux, x, y, log beta_x,
# log beta_y, atanh gamma.

class SamplingData(NamedTuple):
    """
    Pixels, priors and the solution, in the unit of length of the priors.

    Fluxes are relative to that of the solution. ``u0`` (6K,) is the solution
    and ``spread`` (6K, n) its errors in n independent directions.
    """

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray
    error: np.ndarray | None
    u0: np.ndarray
    spread: np.ndarray
    log_sigma: float
    sigma_width: float
    flux_width: float | None
    centre: np.ndarray
    alpha_width: float
    beta_prior: tuple
    gamma_width: float
    prior: str
    unit: float
    ordered: list

    @classmethod
    def prepare(cls, image, fit, prior, unit, options):
        """Return what is sampled of an image and its `MixtureFit`."""
        x, y, centre = _lattice(image, options)
        scale = fit.flux * unit**2
        used = fit.used
        values = np.asarray(image, float)[used] / scale
        error = options.get('error')
        if error is not None:
            error = np.broadcast_to(error, used.shape)[used] / scale
        noise = fit.residual[used] / scale
        _check_noise(noise, values)
        sigma = (noise if error is None else noise / error).std()
        shapes = adaptive_moments(image, mask=~used,
                                  oversampling=options.get('oversampling', 1),
                                  origin=options.get('origin'))
        size = unit * np.sqrt(shapes.r2 / 2)
        paper = prior == 'paper'
        tied = options.get('normalize', 'free') == 'tied'
        if not paper:
            centre = np.array([shapes.x, shapes.y])
        alpha_width = _PAPER_ALPHA if paper else size
        u0, spread = _whiten(fit, unit, tied, alpha_width)
        return cls(
            x=unit * x[used], y=unit * y[used], values=values, error=error,
            u0=u0, spread=spread, log_sigma=float(np.log(sigma)),
            sigma_width=_PAPER_SIGMA if paper else float(
                values.max() if error is None else 10.0),
            flux_width=None if tied else 2.0, centre=unit * centre,
            alpha_width=alpha_width,
            beta_prior=(_PAPER_BETA,) if paper else (np.log(size), 1.0),
            gamma_width=_PAPER_GAMMA, prior=prior, unit=unit,
            ordered=_well_ordered(u0, spread))


def _check_noise(noise, values):
    """Raise if an image is its solution, to rounding."""
    share = noise.std() / np.abs(values).max()
    if share < _ROUNDING:
        msg = ('image must have noise: it differs from the least-squares '
               f'solution by {share:.0e} of its peak, which is rounding, and '
               'nothing says how wide the posterior is; add the noise that '
               'is expected, as image + rng.normal(0, sigma, image.shape)')
        raise ValueError(msg)


def _lattice(image, options):
    """Return x and y of the pixels, and the stamp's centre [pix]."""
    shape = np.shape(image)
    oversampling = np.broadcast_to(options.get('oversampling', 1), 2)
    pitch = np.array(oversampling[::-1], float)
    middle = (np.array(shape[::-1]) - 1) / 2
    origin = options.get('origin')
    origin = middle if origin is None else np.asarray(origin, float)
    y, x = np.indices(shape)
    return ((x - origin[0]) / pitch[0], (y - origin[1]) / pitch[1],
            (middle - origin) / pitch)


def _whiten(fit, unit, tied, alpha_width):
    """Return u0 (6K,) and spread (6K, n) of a least-squares solution."""
    m = fit.mixture
    k = m.n_components
    u0 = np.column_stack([np.log(m.weights), unit * m.means,
                          np.log(unit * m.stddevs), np.arctanh(m.rho)])
    slopes = np.column_stack([
        1 / (m.weights * fit.flux), np.full((k, 2), unit), 1 / m.stddevs,
        1 / (1 - m.rho**2)]).ravel()
    covariance = slopes[:, None] * fit.covariance * slopes
    # Where the image says little, the prior ends the steps.
    width = np.tile([1, alpha_width, alpha_width, 1, 1, 1], k)
    basis = np.eye(6 * k)
    if tied:  # only ratios of the fluxes can vary
        fluxes = np.arange(0, 6 * k, 6)
        directions = np.linalg.svd(np.ones((1, k)))[2][1:]
        rest = np.setdiff1d(np.arange(6 * k), fluxes)
        basis = basis[:, rest]
        lift = np.zeros((6 * k, k - 1))
        lift[fluxes] = directions.T
        basis = np.column_stack([lift, basis])
    reduced = (basis / width[:, None]).T @ covariance @ (basis
                                                         / width[:, None])
    values, vectors = np.linalg.eigh(reduced)
    # Smaller ones are rounding, whatever the noise is.
    values = np.maximum(values, 1e-16 * min(values.max(), 1.0))
    root = vectors * np.sqrt(values / (1 + values))
    return u0.ravel(), width[:, None] * (basis @ root)


def _well_ordered(u0, spread):
    """Return the k whose size is surely less than that of k + 1."""
    k = len(u0) // 6
    pairs = []
    for i in range(k - 1):
        row = np.zeros(6 * k)
        row[[6 * i + 3, 6 * i + 4]] = -1
        row[[6 * i + 9, 6 * i + 10]] = 1
        if row @ u0 > 6 * np.linalg.norm(row @ spread):
            pairs.append(i)
    return pairs


@without_warnings('PyTensor could not link to a BLAS')
def build_model(data):
    """Return the PyMC model."""
    import pymc as pm
    import pytensor.tensor as pt

    with pm.Model() as model:
        n = data.spread.shape[1]
        z = pm.Flat('z', shape=n + 1, initval=np.zeros(n + 1))
        # A sum, not a dot product, which would call for a BLAS.
        u = data.u0 + pt.sum(data.spread * z[None, :n], axis=1)
        u = u.reshape((-1, 6))
        log_sigma = data.log_sigma + z[n] / np.sqrt(2 * data.values.size)
        sigma = pm.Deterministic('sigma', pt.exp(log_sigma))
        fluxes = pt.exp(u[:, 0])
        total = fluxes.sum()
        omega = pm.Deterministic('omega', fluxes / total)
        flux = pm.Deterministic('flux', total if data.flux_width else
                                pt.ones_like(total))
        alpha = pm.Deterministic('alpha', u[:, 1:3])
        beta = pm.Deterministic('beta', pt.exp(u[:, 3:5]))
        gamma = pm.Deterministic('gamma', pt.tanh(u[:, 5]))
        mu = flux * _mean(data.x, data.y, omega, alpha, beta, gamma)
        pm.Potential('prior', _log_prior(data, u, log_sigma, omega, flux,
                                         alpha, beta, gamma))
        if data.ordered:
            size = u[:, 3] + u[:, 4]
            rising = pt.stack([size[i] < size[i + 1] for i in data.ordered])
            pm.Potential('order', pt.switch(pt.all(rising), 0.0, -np.inf))
        error = 1.0 if data.error is None else data.error
        pm.Normal('pixels', mu=mu, sigma=sigma * error, observed=data.values)
    return model


def _mean(x, y, omega, alpha, beta, gamma):
    """Return Eqs. 2-3 at the points (n,)."""
    import pytensor.tensor as pt

    root = pt.sqrt(1 - gamma**2)
    height = omega / (2 * np.pi * beta[:, 0] * beta[:, 1] * root)
    u = (x[None, :] - alpha[:, :1]) / beta[:, :1]
    v = (y[None, :] - alpha[:, 1:]) / beta[:, 1:]
    shear = (u - gamma[:, None] * v) / root[:, None]
    return pt.sum(height[:, None] * pt.exp(-0.5 * (shear**2 + v**2)), axis=0)


def _log_prior(data, u, log_sigma, omega, flux, alpha, beta, gamma):
    """Return the log of the prior density in the coordinates sampled."""
    import pytensor.tensor as pt

    total = -0.5 * (pt.exp(log_sigma) / data.sigma_width)**2 + log_sigma
    total += -0.5 * pt.sum(((alpha - data.centre) / data.alpha_width)**2)
    if data.prior == 'paper':
        total += pt.sum(-0.5 * (beta / data.beta_prior[0])**2 + u[:, 3:5])
    else:
        mean, width = data.beta_prior
        total += -0.5 * pt.sum(((u[:, 3:5] - mean) / width)**2)
    total += pt.sum(-0.5 * (gamma / data.gamma_width)**2
                    + pt.log(1 - gamma**2))
    # Dir(1) is flat in omega, whose volume is that of the logs times omega.
    total += pt.sum(pt.log(omega))
    if data.flux_width:
        total += -0.5 * (flux / data.flux_width)**2 + pt.log(flux)
    return total


@without_warnings('PyTensor could not link to a BLAS')
def sample(model, sampler, *, progress_bar, **options):
    """Draw from a model; return arviz's object."""
    import pymc as pm

    if options['cores'] is None:
        del options['cores']
    n_draws = options['chains'] * (options['tune'] + options['draws'])
    # Other samplers have bars of their own.
    own = sampler == 'pymc'
    with model, progress(total=n_draws, desc='Sampling', unit=' draws',
                         shown=own and progress_bar) as bar:
        if not bar.disable:
            options['callback'] = lambda trace, draw: bar.update()
        return pm.sample(nuts_sampler=sampler, target_accept=0.9,
                         compute_convergence_checks=False, quiet=True,
                         progressbar=progress_bar and not own
                         and has_screen(), **options)
