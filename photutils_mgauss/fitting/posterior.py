r"""
The posterior of a Gaussian mixture, sampled with PyMC (Nie et al., Sec. 2.2).

The model is Eqs. 1-4: pixels :math:`P \sim N(\mu, \sigma^2)` about
:math:`\mu = \sum_k \omega_k G(x, y | \alpha_k, \beta_k, \gamma_k)`, with
priors on :math:`\sigma, \omega, \alpha, \beta, \gamma`. It is sampled in
coordinates in which the least-squares solution is the origin and its
covariance the unit matrix: the posterior is the same, and a step of the
sampler is as long in every direction.
"""
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from astropy.table import QTable
from scipy.optimize import linear_sum_assignment

from photutils_mgauss.fitting.convergence import effective_size, split_r_hat
from photutils_mgauss.fitting.image import (
    MixtureFit,
    fit_mixture,
    fit_with_unit,
)
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.psf.shapes import adaptive_moments
from photutils_mgauss.utils.image import read_pixels, with_unit
from photutils_mgauss.utils.notebook import with_table
from photutils_mgauss.utils.quiet import without_warnings
from photutils_mgauss.utils.validation import (
    as_choice,
    as_integer,
    as_real,
    as_rng,
)

__all__ = ['MixturePosterior', 'sample_mixture']

# The paper's priors, in arcsec: Eq. 4.
_PAPER_ALPHA, _PAPER_BETA, _PAPER_GAMMA, _PAPER_SIGMA = 0.037, 1.0, 0.9, 1.0
# What of `fit_mixture` has a meaning for the posterior.
_FIT_KEYWORDS = ('oversampling', 'origin', 'error', 'mask', 'radius',
                 'enclosed_flux', 'normalize', 'start')


@dataclass(frozen=True, eq=False, repr=False)
class MixturePosterior:
    """
    Draws from the posterior of a mixture, their labels sorted out.

    Arrays have the shape (chains, draws, ...); lengths are in native pixels.

    Attributes
    ----------
    weights : (c, d, K) `~numpy.ndarray`
        The fraction of the flux in each Gaussian, the paper's omega.
    means : (c, d, K, 2) `~numpy.ndarray`
        The centres (x, y) relative to the origin [pix], alpha.
    stddevs : (c, d, K, 2) `~numpy.ndarray`
        Standard deviations along x and y [pix], beta.
    rho : (c, d, K) `~numpy.ndarray`
        Correlation coefficients, gamma.
    flux : (c, d) `~numpy.ndarray`
        The total flux.
    sigma : (c, d) `~numpy.ndarray`
        The standard deviation of the pixels [image unit], or the factor on
        the errors where these were given.
    fit : MixtureFit
        The least-squares solution the chains started from.
    idata : `arviz.InferenceData` or `xarray.DataTree`
        What PyMC returned: the paper's names, labels as sampled, lengths in
        arcsec for the paper's priors, fluxes relative to ``fit.flux``.

    Examples
    --------
    `sample_mixture` returns one. This one has draws made by hand, two chains
    of 50 around one Gaussian:

    >>> import numpy as np
    >>> from photutils_mgauss import GaussianMixture, fit_mixture
    >>> from photutils_mgauss import MixturePosterior
    >>> psf = GaussianMixture([1], [[0, 0]], [[[2, 0], [0, 2]]])
    >>> fit = fit_mixture(psf.render((15, 15), 7, 7), 1)
    >>> noise = 0.01 * np.random.default_rng(1).standard_normal((2, 50, 1))
    >>> posterior = MixturePosterior(
    ...     weights=np.ones((2, 50, 1)),
    ...     means=np.stack([noise, -noise], axis=-1),
    ...     stddevs=np.sqrt(2) + np.stack([noise, noise], axis=-1),
    ...     rho=noise, flux=1 + noise[..., 0],
    ...     sigma=0.1 + 0 * noise[..., 0], fit=fit, idata=None)
    >>> posterior
    <MixturePosterior of 1 Gaussians, 2 chains of 50 draws>
    >>> posterior.mixture.stddevs.round(2)
    array([[1.41, 1.41]])
    >>> len(posterior.draws(10))
    10
    >>> table = posterior.summary()
    >>> for name in ('mean', 'std', 'r_hat'):
    ...     table[name].info.format = '.2f'
    >>> table['parameter', 'mean', 'std', 'r_hat'][1:4].pprint()
    parameter   mean std  r_hat
    ---------- ----- ---- -----
      x_mean_1 -0.00 0.01  0.98
      y_mean_1  0.00 0.01  0.98
    x_stddev_1  1.41 0.01  0.98
    """

    weights: np.ndarray
    means: np.ndarray
    stddevs: np.ndarray
    rho: np.ndarray
    flux: np.ndarray
    sigma: np.ndarray
    fit: MixtureFit
    idata: object = field(repr=False)

    def __repr__(self):
        chains, draws, k = self.weights.shape
        return (f'<MixturePosterior of {k} Gaussians, {chains} chains of '
                f'{draws} draws>')

    def _repr_html_(self):
        return with_table(repr(self), self.summary())

    @property
    def mixture(self):
        """The mixture whose parameters are the posterior means."""
        mean = (0, 1)
        weights = self.weights.mean(axis=mean)
        return GaussianMixture.from_stddevs(
            weights / weights.sum(), self.means.mean(axis=mean),
            self.stddevs.mean(axis=mean), self.rho.mean(axis=mean))

    def draws(self, n):
        """
        Return n mixtures of the posterior, spread evenly over all draws.

        Parameters
        ----------
        n : int
            How many.

        Returns
        -------
        list of GaussianMixture

        Raises
        ------
        ValueError
            If there are fewer draws than that.
        """
        weights, means, stddevs, rho = (
            a.reshape(-1, *a.shape[2:])
            for a in (self.weights, self.means, self.stddevs, self.rho))
        n = as_integer(n, 'n', minimum=1, maximum=len(weights))
        chosen = np.linspace(0, len(weights) - 1, n).round().astype(int)
        return [GaussianMixture.from_stddevs(
            weights[i] / weights[i].sum(), means[i], stddevs[i], rho[i])
            for i in chosen]

    def parameters(self):
        """
        Return the draws of every scalar parameter by name.

        Returns
        -------
        dict of str to (c, d) `~numpy.ndarray`
            ``weight_k`` and, named as in `MultiGaussianPSFModel`,
            ``x_mean_k``, ``y_mean_k``, ``x_stddev_k``, ``y_stddev_k`` and
            ``rho_k`` for k = 1 to K; ``flux``, ``sigma``.
        """
        columns = {}
        for k in range(self.weights.shape[2]):
            columns |= {
                f'weight_{k + 1}': self.weights[..., k],
                f'x_mean_{k + 1}': self.means[..., k, 0],
                f'y_mean_{k + 1}': self.means[..., k, 1],
                f'x_stddev_{k + 1}': self.stddevs[..., k, 0],
                f'y_stddev_{k + 1}': self.stddevs[..., k, 1],
                f'rho_{k + 1}': self.rho[..., k]}
        return columns | {'flux': np.asarray(self.flux),
                          'sigma': np.asarray(self.sigma)}

    def summary(self):
        """
        Return mean, scatter and convergence of every parameter.

        Returns
        -------
        `~astropy.table.QTable`
            ``parameter``, ``mean``, ``std``, the quantiles ``q16``, ``q50``
            and ``q84``, the rank-normalised split ``r_hat`` and the bulk
            effective sample size ``ess`` (Vehtari et al. 2021). The last two
            are NaN for a parameter that is the same in all draws.
        """
        rows = []
        for name, draws in self.parameters().items():
            quantiles = np.quantile(draws, [0.16, 0.5, 0.84])
            rows.append((name, draws.mean(), draws.std(), *quantiles,
                         split_r_hat(draws), effective_size(draws)))
        return QTable(rows=rows, names=('parameter', 'mean', 'std', 'q16',
                                        'q50', 'q84', 'r_hat', 'ess'))

    def plot(self, names=None, *, axes=None):
        """
        Draw the posterior of each parameter, and of each pair of them.

        Parameters
        ----------
        names, axes
            See `photutils_mgauss.plotting.plot_corner`.

        Returns
        -------
        (n, n) `~numpy.ndarray` of `~matplotlib.axes.Axes`
        """
        from photutils_mgauss.plotting import plot_corner
        return plot_corner(self, names, axes=axes)


def sample_mixture(image, n_components=3, *, prior='scaled',
                   pixel_scale=None, draws=1000, tune=500, chains=4,
                   sampler='pymc', cores=None, progress_bar=False, rng=None,
                   **kwargs):
    r"""
    Sample the posterior of the mixture that an image is, with PyMC.

    The likelihood is Eq. 1 with the mean of Eqs. 2-3. The paper's priors
    (Eq. 4), with lengths in arcsec and the image as the flux density of a
    star of unit flux per square arcsec, are

    .. math::

        \sigma \sim |N(0, 1)|,\ \omega \sim \mathrm{Dir}(1),\
        \alpha \sim N(\text{centre of the stamp}, 0.037^2),\
        \beta \sim |N(0, 1)|,\ \gamma \sim N(0, 0.9^2) \text{ in } (-1, 1).

    The scaled priors follow the size r of the image, its flux and its centre
    (adaptive moments): :math:`\sigma \sim |N(0, \text{peak})|`,
    :math:`F \sim |N(0, (2 F_0)^2)|`, :math:`\alpha \sim N(\text{centre},
    r^2)`, :math:`\ln\beta \sim N(\ln r, 1)`, the others as above.

    Parameters
    ----------
    image : (ny, nx) array_like or NDData
        See `fit_mixture`.
    n_components : int, optional
        The number K of Gaussians.
    prior : {'scaled', 'paper'}, optional
        Which priors. With the paper's the total flux is that of the stamp;
        with the scaled ones it is free unless ``normalize='tied'``.
    pixel_scale : float, optional
        Arcsec per native pixel; needed by the paper's priors alone.
    draws, tune, chains : int, optional
        Draws of each chain, steps before them, chains.
    sampler : {'pymc', 'nutpie', 'numpyro'}, optional
        Whose NUTS; the last two where they are installed.
    cores : int, optional
        Processes to run chains in; None is PyMC's choice.
    progress_bar : bool, optional
        Whether PyMC shows its progress.
    rng : int or `~numpy.random.Generator`, optional
        Makes the result repeatable.
    **kwargs
        The keywords of `fit_mixture`, which finds where to start:
        ``oversampling``, ``origin``, ``error``, ``mask``, ``radius``,
        ``enclosed_flux``, ``normalize``, ``start``. The model has positive
        weights and free means, so the others are refused. PyMC's own word
        for ``rng``, ``random_seed``, is taken in its place.

    Returns
    -------
    MixturePosterior

    Raises
    ------
    TypeError, ValueError
        As by `fit_mixture`; also for a stack of images, without
        ``pixel_scale`` for the paper's priors, or if a Gaussian has no flux
        in the least-squares solution, so that its shape has no posterior of
        its own: use fewer.

    Notes
    -----
    Labels: the posterior is the same under any exchange of the Gaussians, and
    chains that start apart settle on different orders. Here all chains start
    at the least-squares solution with its Gaussians in order of size, the
    model forbids neighbours well apart in size to change their order, and
    each draw is finally given the labels that bring it nearest to the
    solution.

    Mean-field variational inference is not offered: on such images it ends
    far from the posterior (an R^2 wrong by 60 %) without a warning.

    Examples
    --------
    The model is compiled first, which takes about half a minute:

    >>> import numpy as np
    >>> from photutils_mgauss import GaussianMixture, sample_mixture
    >>> psf = GaussianMixture([1], [[0, 0]], [[[1.5, 0.2], [0.2, 1]]])
    >>> rng = np.random.default_rng(1)
    >>> image = psf.render((9, 9), 4, 4) + rng.normal(0, 1e-3, (9, 9))
    >>> posterior = sample_mixture(image, 1, draws=20, tune=20, chains=1,
    ...                            rng=1)  # doctest: +SKIP
    >>> posterior  # doctest: +SKIP
    <MixturePosterior of 1 Gaussians, 1 chains of 20 draws>
    >>> posterior.mixture.stddevs.round(1)  # doctest: +SKIP
    array([[1.2, 1. ]])
    """
    rng = kwargs.pop('random_seed', rng)
    _check_keywords(kwargs)
    pixels = read_pixels(image, kwargs.pop('error', None),
                         kwargs.pop('mask', None), name='image',
                         broadcast=True)
    image = pixels.data
    kwargs |= {'error': pixels.error, 'mask': pixels.mask}
    prior = as_choice(prior, 'prior', ('scaled', 'paper'))
    as_choice(sampler, 'sampler', ('pymc', 'nutpie', 'numpyro'))
    if prior == 'paper':
        if pixel_scale is None:
            msg = "pixel_scale must be given with prior='paper', got None"
            raise ValueError(msg)
        kwargs = {'normalize': 'tied', **kwargs}
    unit = 1.0 if prior == 'scaled' else as_real(pixel_scale, 'pixel_scale',
                                                 above=0)
    fit = fit_mixture(image, n_components, **kwargs)
    if fit.mixture is None:
        msg = f'image must be one that `fit_mixture` can fit: {fit.message}'
        raise ValueError(msg)
    if (fit.mixture.weights <= 0).any():
        msg = (f'n_components must be smaller, got {n_components}: in the '
               'least-squares solution a Gaussian has no flux')
        raise ValueError(msg)
    draws = as_integer(draws, 'draws', minimum=4)
    data = _Data.prepare(image, fit, prior, unit, kwargs)
    model = _build(data)
    seed = None if rng is None else int(as_rng(rng).integers(2**31))
    idata = _sample(model, sampler, progressbar=progress_bar, cores=cores,
                    random_seed=seed, draws=draws,
                    tune=as_integer(tune, 'tune', minimum=0),
                    chains=as_integer(chains, 'chains', minimum=1))
    return _posterior(idata, data, fit, pixels.unit)


def _check_keywords(keywords):
    unknown = sorted(set(keywords) - set(_FIT_KEYWORDS))
    if unknown:
        msg = ('sample_mixture takes, beside its own, the keywords '
               f'{", ".join(_FIT_KEYWORDS)}, got {unknown[0]}')
        raise TypeError(msg)


# From the least-squares solution to a model of PyMC. In vectors the numbers
# of each Gaussian are log flux, x, y, log beta_x, log beta_y, atanh gamma.

class _Data(NamedTuple):
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
        x, y, centre = _lattice(image, options)
        scale = fit.flux * unit**2
        used = fit.used
        values = np.asarray(image, float)[used] / scale
        error = options.get('error')
        if error is not None:
            error = np.broadcast_to(error, used.shape)[used] / scale
        noise = fit.residual[used] / scale / (1 if error is None else error)
        sigma = max(noise.std(), 1e-12 * abs(values).max())
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
    values = np.maximum(values, 1e-16)
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
def _build(data):
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
def _sample(model, sampler, **options):
    import pymc as pm

    if options['cores'] is None:
        del options['cores']
    with model:
        return pm.sample(nuts_sampler=sampler, target_accept=0.9,
                         compute_convergence_checks=False,
                         quiet=not options['progressbar'], **options)


# Labels.

def _posterior(idata, data, fit, unit):
    """Return the draws in native pixels and image units, relabelled."""
    draws = {name: np.asarray(idata['posterior'][name].values)
             for name in ('omega', 'alpha', 'beta', 'gamma', 'flux', 'sigma')}
    omega, alpha, beta, gamma = relabel(
        draws['omega'], draws['alpha'] / data.unit, draws['beta'] / data.unit,
        draws['gamma'], fit.mixture)
    sigma = draws['sigma']
    if data.error is None:
        sigma = with_unit(sigma * fit.flux * data.unit**2, unit)
    flux = with_unit(draws['flux'] * fit.flux, unit)
    return MixturePosterior(omega, alpha, beta, gamma, flux, sigma,
                            fit_with_unit(fit, unit), idata)


def relabel(omega, alpha, beta, gamma, reference):
    """
    Give the Gaussians of every draw the labels nearest to a reference.

    Parameters
    ----------
    omega, alpha, beta, gamma : (..., K), (..., K, 2), (..., K, 2), (..., K)
        Draws of weights, means, standard deviations and correlations.
    reference : GaussianMixture
        The mixture whose labels to take; near means in log weight, in means
        over standard deviations, in log standard deviations and in
        correlation.

    Returns
    -------
    omega, alpha, beta, gamma : `~numpy.ndarray`
        The draws in their new order.
    """
    scale = np.sqrt(reference.stddevs.prod(axis=1))[:, None]
    want = np.column_stack([
        np.log(reference.weights), reference.means / scale,
        np.log(reference.stddevs), reference.rho])
    distance = 0
    for j in range(6):
        for_all = _coordinate(j, omega, alpha, beta, gamma)
        per_label = 1 / scale[:, 0] if j in (1, 2) else np.ones(len(want))
        distance = distance + (for_all[..., None, :] * per_label[:, None]
                               - want[:, j, None])**2
    order = distance.argmin(axis=-1)
    clash = (np.sort(order, axis=-1) != np.arange(len(want))).any(axis=-1)
    for index in zip(*np.nonzero(clash), strict=True):
        order[index] = linear_sum_assignment(distance[index])[1]
    take = np.take_along_axis
    return (take(omega, order, -1), take(alpha, order[..., None], -2),
            take(beta, order[..., None], -2), take(gamma, order, -1))


def _coordinate(j, omega, alpha, beta, gamma):
    if j == 0:
        return np.log(omega)
    if j < 3:
        return alpha[..., j - 1]
    return np.log(beta[..., j - 3]) if j < 5 else gamma
