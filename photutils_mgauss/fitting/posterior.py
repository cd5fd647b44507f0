r"""
The posterior of a Gaussian mixture, sampled with PyMC (Nie et al., Sec. 2.2).

The model is Eqs. 1-4: pixels :math:`P \sim N(\mu, \sigma^2)` about
:math:`\mu = \sum_k \omega_k G(x, y | \alpha_k, \beta_k, \gamma_k)`, with
priors on :math:`\sigma, \omega, \alpha, \beta, \gamma`.
"""
from dataclasses import dataclass, field

import numpy as np
from astropy.table import QTable
from scipy.optimize import linear_sum_assignment

from photutils_mgauss.fitting.convergence import effective_size, split_r_hat
from photutils_mgauss.fitting.image import (
    MixtureFit,
    fit_mixture,
    fit_with_unit,
)
from photutils_mgauss.fitting.posterior_model import (
    SamplingData,
    build_model,
    sample,
)
from photutils_mgauss.psf.mixture import GaussianMixture
from photutils_mgauss.utils.image import read_pixels, with_unit
from photutils_mgauss.utils.notebook import with_table
from photutils_mgauss.utils.validation import (
    as_choice,
    as_integer,
    as_real,
    as_rng,
)
from photutils_mgauss.utils.waiting import waiting

__all__ = ['MixturePosterior', 'sample_mixture']

# The columns of a summary, and how numbers are shown in them.
_SHOWN = {'mean': '.4g', 'std': '.2g', 'q16': '.4g', 'q50': '.4g',
          'q84': '.4g', 'r_hat': '.3f', 'ess': '.0f'}
# What of `fit_mixture` has a meaning for the posterior.
_FIT_KEYWORDS = ('oversampling', 'origin', 'error', 'mask', 'radius',
                 'enclosed_flux', 'normalize', 'start')


@dataclass(frozen=True, eq=False, repr=False)
class MixturePosterior:
    """
    Draws from the posterior of a mixture, with matched labels.

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
        the errors if these were given.
    fit : MixtureFit
        The least-squares solution at which the chains started.
    idata : `arviz.InferenceData` or `xarray.DataTree`
        The output of PyMC: the paper's names, labels as sampled, lengths
        in arcsec for the paper's priors, fluxes relative to ``fit.flux``.

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
        table = QTable(rows=rows, names=('parameter', *_SHOWN))
        # So that the whole table is seen in a terminal of 80 columns.
        for name, digits in _SHOWN.items():
            table[name].info.format = digits
        return table

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
        from photutils_mgauss.plotting.posterior import plot_corner
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
        ``pixel_scale`` for the paper's priors, if a Gaussian has no flux
        in the least-squares solution, so that its shape has no posterior of
        its own: use fewer; or for an image without noise, which says nothing
        of the width of its posterior: add what is expected.

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
    data = SamplingData.prepare(image, fit, prior, unit, kwargs)
    seed = None if rng is None else int(as_rng(rng).integers(2**31))
    with waiting('sample_mixture', progress_bar):
        idata = sample(build_model(data), sampler, progress_bar=progress_bar,
                       cores=cores, random_seed=seed, draws=draws,
                       tune=as_integer(tune, 'tune', minimum=0),
                       chains=as_integer(chains, 'chains', minimum=1))
    return _posterior(idata, data, fit, pixels.unit)


def _check_keywords(keywords):
    unknown = sorted(set(keywords) - set(_FIT_KEYWORDS))
    if unknown:
        msg = ('sample_mixture takes, beside its own, the keywords '
               f'{", ".join(_FIT_KEYWORDS)}, got {unknown[0]}')
        raise TypeError(msg)


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
